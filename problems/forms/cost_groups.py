"""Three ways to evaluate the costs of a problem, behind one interface: array code over all instances of a term, the
loop of CasADi over its instances, and one compiled function of the whole problem.

Array code costs a NumPy call per instruction, CasADi's loop a few nanoseconds per instruction and instance, and the
whole problem as one function saves the loop's copies but takes its time to compile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Protocol

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf  # type: ignore[attr-defined]

from problems.forms.kernels import CostKernel, cost_kernel
from problems.forms.layout import DataStore, Layout, TermLayout, constant_rows, constant_whitening, noise_numbers
from problems.forms.residual_code import buffered
from problems.forms.sparsity import HessianPattern
from problems.forms.template import template_of
from problems.noise import whitening
from problems.problem import DataSlot, Slot

Flags = Mapping[str, np.ndarray | None]  # active instances (count,) by term; None or left out: all
Linearization = tuple[float, np.ndarray, np.ndarray]  # cost, gradient, Hessian entries in the order of the pattern


def _single_root(matrix: np.ndarray) -> np.ndarray | None:
    """Upper triangle of the Cholesky factor of one information matrix; None where it needs a closer look."""
    skew = (matrix - matrix.T).ravel()
    root, info = dpotrf(matrix, lower=0)
    if info != 0 or not skew.dot(skew) <= (1e-8 * matrix[0, 0]) ** 2:
        return None
    return root[_upper(len(matrix))][:, None]


@cache
def _upper(dim: int) -> tuple[np.ndarray, np.ndarray]:
    return np.triu_indices(dim)


def whitening_numbers(entry: TermLayout, dim: int, store: DataStore) -> np.ndarray:
    """Whitening of a cost as kernel inputs: (dim or dim(dim+1)/2, 1 or count)."""
    noise = entry.term.noise
    assert noise is not None
    if noise.kind == "information" and isinstance(noise.value, DataSlot) and len(noise.value.indices) == 1:
        rows = store[noise.value.source.name]
        if rows.shape[1] == dim * dim and dim > 1:
            root = _single_root(rows[noise.value.indices[0]].reshape(dim, dim))
            if root is not None:
                return root
    if isinstance(noise.value, DataSlot):
        root = whitening(noise.kind, noise_numbers(entry.term, dim, store), dim, entry.term.count, entry.term.what)
    else:
        root = constant_whitening(entry.term, dim)
    if root.ndim == 2:
        return root.T
    a, b = _upper(dim)
    return root[:, a, b].T


class Cost:
    """One cost term: where it reads and writes, and its whitening."""

    def __init__(self, layout: Layout, entry: TermLayout) -> None:
        term = entry.term
        assert term.noise is not None
        self.entry, self.term, self.count = entry, term, term.count
        self.template = template_of(term)
        self._full = term.noise.kind != "sigma" and self.template.dim > 1
        self._last: tuple[bytes, np.ndarray] | None = None
        self.fixed_whitening: np.ndarray | None = None
        if not isinstance(term.noise.value, DataSlot):
            self.fixed_whitening = self._whitening(DataStore(layout))
        self.dynamic = self.fixed_whitening is None
        dim = self.template.dim
        self.whitening_size = dim * (dim + 1) // 2 if self._full else dim

    def kernel(self, switched: bool = False) -> CostKernel:
        return cost_kernel(self.template, self._full, self.term.linear is not None, self.term.loss, switched)

    def whitening(self, store: DataStore) -> np.ndarray:
        """Whitening as kernel inputs: (numbers, 1 or count). Worked out again only where its data changed."""
        if self.fixed_whitening is not None:
            return self.fixed_whitening
        assert self.term.noise is not None
        value = self.term.noise.value
        given = store[value.source.name].tobytes()
        last = self._last
        if last is None or last[0] != given:
            self._last = last = given, self._whitening(store)
        return last[1]

    def _whitening(self, store: DataStore) -> np.ndarray:
        return whitening_numbers(self.entry, self.template.dim, store)

    def linear_rows(self) -> np.ndarray:
        """(count, dim) constant linear part."""
        return constant_rows(self.term.linear, self.template.dim, self.count, f"{self.term.what}: linear")


class BoundCosts(Protocol):
    """Costs of a group for fixed data, as functions of the point alone."""

    def cost(self, point: np.ndarray) -> float: ...

    def gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]: ...

    def linearize(self, point: np.ndarray) -> Linearization: ...


class CostGroup(Protocol):
    def bind(self, store: DataStore, numbers: np.ndarray, flags: Flags) -> BoundCosts: ...


class ArrayCosts:
    """Terms by array code. `parts` are their numbers in the pattern."""

    def __init__(self, layout: Layout, costs: Sequence[Cost], parts: Sequence[int], pattern: HessianPattern) -> None:
        self.layout, self.costs, self.pattern = layout, costs, pattern
        self.kernels = [cost.kernel() for cost in costs]
        self.positions = [pattern.positions[k] for k in parts]
        self.columns = [np.ascontiguousarray(cost.entry.columns.T) for cost in costs]
        self.stored = [np.ascontiguousarray(cost.entry.stored.T) for cost in costs]
        self.single = [_repeated(c.term.slots, [s.source.space.ambient for s in c.term.slots], c.count) for c in costs]
        self.shared = [_repeated(c.term.data, [s.source.size for s in c.term.data], c.count) for c in costs]

    def bind(self, store: DataStore, numbers: np.ndarray, flags: Flags) -> _BoundArrays:
        return _BoundArrays(self, store, numbers, flags)

    def parameters(self, k: int, store: DataStore, numbers: np.ndarray) -> list[Any]:
        """Kernel inputs after the point: data, whitening, linear part; arrays (count,) or numbers."""
        cost = self.costs[k]
        term, count = cost.term, cost.count
        at = cost.entry.numbers
        values: list[Any] = [numbers[at[0, j]] if one else numbers[at[:, j]] for j, one in enumerate(self.shared[k])]
        values += [w if w.size == count and count > 1 else float(w[0]) for w in cost.whitening(store)]
        if term.linear is not None:
            if isinstance(term.linear, DataSlot):
                linear = np.broadcast_to(numbers[self.layout.numbers(term.linear)], (count, cost.template.dim))
            else:
                linear = cost.linear_rows()
            values += [column.copy() for column in linear.T]
        return values


class _BoundArrays:
    def __init__(self, group: ArrayCosts, store: DataStore, numbers: np.ndarray, flags: Flags) -> None:
        self._group, self._flags = group, flags
        self._parameters = [group.parameters(k, store, numbers) for k in range(len(group.costs))]
        self._out = [np.empty((k.code.outputs, c.count)) for k, c in zip(group.kernels, group.costs, strict=True)]

    def _inputs(self, k: int, point: np.ndarray) -> list[Any]:
        columns = zip(self._group.stored[k], self._group.single[k], strict=True)
        values: list[Any] = [point[index[0]] if one else point.take(index) for index, one in columns]
        return values + self._parameters[k]

    def cost(self, point: np.ndarray) -> float:
        total = 0.0
        for k, cost in enumerate(self._group.costs):
            out = self._group.kernels[k].value_code(self._inputs(k, point), cost.count)[0]
            on = self._flags[cost.term.name]
            total += float(out.sum() if on is None else out[on].sum())
        return total

    def gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        total, gradient = 0.0, np.zeros(self._group.pattern.size)
        for k, cost in enumerate(self._group.costs):
            width = cost.template.width
            code = self._group.kernels[k].gradient_code
            out = code(self._inputs(k, point), cost.count, self._out[k][: 1 + width])
            on = self._flags[cost.term.name]
            if on is not None:
                out[:, ~on] = 0.0
            total += float(out[0].sum())
            gradient += np.bincount(self._group.columns[k].ravel(), out[1:].ravel(), gradient.size)
        return total, gradient

    def linearize(self, point: np.ndarray) -> Linearization:
        pattern = self._group.pattern
        total = 0.0
        gradient, hessian = np.zeros(pattern.size), np.zeros(pattern.nonzeros)
        for k, cost in enumerate(self._group.costs):
            out = self._group.kernels[k].code(self._inputs(k, point), cost.count, self._out[k])
            on = self._flags[cost.term.name]
            if on is not None:
                out[:, ~on] = 0.0
            width = cost.template.width
            total += float(out[0].sum())
            gradient += np.bincount(self._group.columns[k].ravel(), out[1 : 1 + width].ravel(), pattern.size)
            positions, twice = self._group.positions[k]
            entries = out[1 + width :]
            if positions.size:
                hessian += np.bincount(positions.ravel(), entries.ravel(), pattern.nonzeros)
            if twice is not None:
                use = twice >= 0
                hessian += np.bincount(twice[use], entries[use], pattern.nonzeros)
        return total, gradient, hessian


class _Source:
    """One array that holds all a kernel may read (point, data, whitening, linear parts), and where terms read in it."""

    def __init__(self, layout: Layout, costs: Sequence[Cost]) -> None:
        constants: list[np.ndarray] = []
        self.start, self.size = layout.stored_size, layout.stored_size + layout.data_size
        self._dynamic = [cost for cost in costs if cost.dynamic]
        whitenings: dict[int, np.ndarray] = {}
        for cost in self._dynamic:
            rows = cost.count * cost.whitening_size
            whitenings[id(cost)] = self.size + np.arange(rows).reshape(cost.count, cost.whitening_size)
            self.size += rows
        self.free = self.size  # what follows never changes
        self.inputs: list[np.ndarray] = []

        def constant(rows: np.ndarray) -> np.ndarray:
            constants.append(rows.ravel())
            self.size += rows.size
            return self.size - rows.size + np.arange(rows.size).reshape(rows.shape)

        for cost in costs:
            parts = [cost.entry.stored, layout.stored_size + cost.entry.numbers]
            white = cost.fixed_whitening
            parts.append(whitenings[id(cost)] if white is None else constant(white.T))
            if isinstance(cost.term.linear, DataSlot):
                parts.append(layout.stored_size + layout.numbers(cost.term.linear))
            elif cost.term.linear is not None:
                parts.append(constant(cost.linear_rows()))
            self.inputs.append(np.hstack([np.broadcast_to(part, (cost.count, part.shape[1])) for part in parts]))
        self.constants = np.concatenate([np.zeros(0), *constants])

    def write(self, out: np.ndarray, store: DataStore, numbers: np.ndarray) -> None:
        """Data and whitenings made of data, the first entries of `out`."""
        out[: numbers.size] = numbers
        at = numbers.size
        for cost in self._dynamic:
            white = cost.whitening(store)
            size = white.shape[0] * cost.count
            out[at : at + size].reshape(cost.count, white.shape[0])[:] = white.T
            at += size


class MappedCosts:
    """Terms by CasADi's loop over their instances, called through buffers."""

    def __init__(self, layout: Layout, costs: Sequence[Cost], parts: Sequence[int], pattern: HessianPattern) -> None:
        self.costs, self.pattern = costs, pattern
        self.source = source = _Source(layout, costs)
        self.index = np.concatenate([index.ravel() for index in source.inputs])
        self.values = np.zeros(source.size)
        self.values[source.free :] = source.constants
        self.flat = np.empty(self.index.size)
        kernels = [cost.kernel() for cost in costs]
        self._outputs = [kernel.code.outputs for kernel in kernels]
        self.out = np.empty(sum(n * c.count for n, c in zip(self._outputs, costs, strict=True)))
        self.one = np.empty(sum(cost.count for cost in costs))
        self.linearizations, self.evaluations = [], []
        read = write = single = 0
        for kernel, cost, outputs in zip(kernels, costs, self._outputs, strict=True):
            inputs = self.flat[read : read + cost.count * kernel.code.inputs]
            results = self.out[write : write + cost.count * outputs]
            self.linearizations.append(buffered(kernel.code.function.map(cost.count), [inputs], results))
            values = self.one[single : single + cost.count]
            self.evaluations.append(buffered(kernel.value_code.function.map(cost.count), [inputs], values))
            read, write, single = read + inputs.size, write + results.size, single + cost.count
        self.rows, self.take = scatter(costs, parts, pattern)

    def off(self, flags: Flags) -> tuple[np.ndarray, np.ndarray] | None:
        """Outputs of instances that are off: of linearizations and of values."""
        if all(flags[cost.term.name] is None for cost in self.costs):
            return None
        masks = []
        for cost in self.costs:
            on = flags[cost.term.name]
            masks.append(np.zeros(cost.count, bool) if on is None else ~on)
        single = np.concatenate(masks)
        every = np.concatenate([np.repeat(mask, n) for mask, n in zip(masks, self._outputs, strict=True)])
        return np.flatnonzero(every), np.flatnonzero(single)

    def bind(self, store: DataStore, numbers: np.ndarray, flags: Flags) -> _BoundMapped:
        parameters = np.empty(self.source.free - self.source.start)
        self.source.write(parameters, store, numbers)
        return _BoundMapped(self, parameters, flags)


class _BoundMapped:
    def __init__(self, group: MappedCosts, parameters: np.ndarray, flags: Flags) -> None:
        self._group, self._parameters, self._off = group, parameters, group.off(flags)

    def _enter(self, point: np.ndarray) -> None:
        group = self._group
        group.values[: point.size] = point
        group.values[point.size : group.source.free] = self._parameters
        group.values.take(group.index, out=group.flat, mode="clip")

    def cost(self, point: np.ndarray) -> float:
        group = self._group
        self._enter(point)
        for run in group.evaluations:
            run()
        if self._off is not None:
            group.one[self._off[1]] = 0.0
        return float(group.one.sum())

    def gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        return self.linearize(point)[:2]

    def linearize(self, point: np.ndarray) -> Linearization:
        group = self._group
        self._enter(point)
        for run in group.linearizations:
            run()
        if self._off is not None:
            group.out[self._off[0]] = 0.0
        out = group.out if group.take is None else group.out[group.take]
        size = group.pattern.size
        sums = np.bincount(group.rows, out, 1 + size + group.pattern.nonzeros)
        return float(sums[0]), sums[1 : 1 + size], sums[1 + size :]


class WholeCosts:
    """All costs as one compiled function, called through buffers."""

    def __init__(self, layout: Layout, costs: Sequence[Cost], pattern: HessianPattern) -> None:
        self.costs, self.pattern, self.source = costs, pattern, _Source(layout, costs)
        known = self.source.free - self.source.start
        instances = sum(cost.count for cost in costs)
        x, data, flags = ca.SX.sym("x", layout.stored_size), ca.SX.sym("d", known), ca.SX.sym("on", instances)
        p, everything = ca.vertcat(data, flags), ca.vertcat(x, data, ca.SX(self.source.constants))
        outputs, value, at = [], ca.SX(0), 0
        for cost, index in zip(costs, self.source.inputs, strict=True):
            given = ca.reshape(everything[index.ravel().tolist()], index.shape[1], cost.count)
            on = flags[at : at + cost.count].T
            found = cost.kernel(switched=True).code.function(ca.vertcat(given, on))
            value += ca.sum2(found[0, :])
            outputs.append(ca.vec(found))
            at += cost.count
        rows, take = scatter(costs, range(len(costs)), pattern)
        columns = np.arange(rows.size) if take is None else take
        shape = (1 + pattern.size + pattern.nonzeros, sum(found.numel() for found in outputs))
        collect = sp.csc_matrix((np.ones(rows.size), (rows, columns)), shape=shape)
        sums = ca.densify(ca.mtimes(ca.DM(collect), ca.vertcat(*outputs))) if outputs else ca.SX.zeros(shape[0])
        self._x, self._p = np.zeros(x.shape[0]), np.zeros(max(p.shape[0], 1))
        self._value, self._sums = np.zeros(1), np.zeros(shape[0])
        self._evaluate = buffered(ca.Function("value", [x, p], [value]), [self._x, self._p], self._value)
        self._linearize = buffered(ca.Function("sums", [x, p], [sums]), [self._x, self._p], self._sums)

    def bind(self, store: DataStore, numbers: np.ndarray, flags: Flags) -> _BoundWhole:
        parameters = np.ones(self._p.size)
        self.source.write(parameters, store, numbers)
        at = self.source.free - self.source.start
        for cost in self.costs:
            on = flags[cost.term.name]
            if on is not None:
                parameters[at : at + cost.count] = on
            at += cost.count
        return _BoundWhole(self, parameters)

    def cost(self, point: np.ndarray, parameters: np.ndarray) -> float:
        self._x[:] = point
        self._p[:] = parameters
        self._evaluate()
        return float(self._value[0])

    def linearize(self, point: np.ndarray, parameters: np.ndarray) -> Linearization:
        self._x[:] = point
        self._p[:] = parameters
        self._linearize()
        sums, size = self._sums.copy(), self.pattern.size
        return float(sums[0]), sums[1 : 1 + size], sums[1 + size :]


class _BoundWhole:
    def __init__(self, group: WholeCosts, parameters: np.ndarray) -> None:
        self._group, self._parameters = group, parameters

    def cost(self, point: np.ndarray) -> float:
        return self._group.cost(point, self._parameters)

    def gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        return self.linearize(point)[:2]

    def linearize(self, point: np.ndarray) -> Linearization:
        return self._group.linearize(point, self._parameters)


def scatter(
    costs: Sequence[Cost], parts: Sequence[int], pattern: HessianPattern
) -> tuple[np.ndarray, np.ndarray | None]:
    """Where outputs, instance after instance, are added: row 0 is the cost, then come gradient and Hessian entries; and
    which outputs, if not all of them in their order."""
    rows, again, again_rows, start = [np.zeros(0, np.intp)], [], [], 0
    for k, cost in zip(parts, costs, strict=True):
        positions, twice = pattern.positions[k]
        head = np.zeros((cost.count, 1), np.intp)
        targets = np.hstack([head, 1 + cost.entry.columns, 1 + pattern.size + positions.T])
        rows.append(targets.ravel())
        if twice is not None:
            entry, instance = np.nonzero(twice >= 0)
            again.append(start + instance * targets.shape[1] + 1 + cost.template.width + entry)
            again_rows.append(1 + pattern.size + twice[entry, instance])
        start += targets.size
    if not again:
        return np.concatenate(rows), None
    return np.concatenate([*rows, *again_rows]), np.concatenate([np.arange(start), *again])


def _repeated(slots: Sequence[Slot] | Sequence[DataSlot], sizes: Sequence[int], count: int) -> np.ndarray:
    """For every number of the slots: one instance serves all of the term."""
    parts = [np.full(size, len(slot.indices) == 1 and count > 1) for slot, size in zip(slots, sizes, strict=True)]
    return np.concatenate([np.zeros(0, bool), *parts])
