"""Value, gradient and Gauss-Newton Hessian of all costs of a problem, and residual rows of its constraints.

Two ways with one interface: array code over all instances of a term, and, for small problems where the call overhead of
NumPy would dominate, one compiled function of the whole problem.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from problems.forms.kernels import CostKernel, cost_kernel
from problems.forms.layout import Activity, DataStore, Layout, TermLayout, constant_rows, noise_numbers
from problems.forms.residual_code import residual_code
from problems.forms.sparsity import HessianPattern
from problems.forms.template import template_of
from problems.noise import whitening
from problems.problem import DataSlot, Problem

Flags = Mapping[str, np.ndarray | None]  # active instances (count,) by term; None or left out: all

WHOLE_LIMIT = 300  # instances up to which one function of the whole problem is faster (measured)


def whitening_numbers(entry: TermLayout, dim: int, store: DataStore) -> np.ndarray:
    """Whitening of a cost as kernel inputs: (dim or dim(dim+1)/2, 1 or count)."""
    noise = entry.term.noise
    assert noise is not None
    root = whitening(noise.kind, noise_numbers(entry.term, dim, store), dim, entry.term.count, entry.term.what)
    if root.ndim == 2:
        return root.T
    a, b = np.triu_indices(dim)
    return root[:, a, b].T


class _Cost:
    """One cost term: where it reads and writes."""

    def __init__(self, layout: Layout, entry: TermLayout, switched: bool) -> None:
        term = entry.term
        assert term.noise is not None
        self.entry = entry
        self.template = template_of(term)
        full = term.noise.kind != "sigma" and self.template.dim > 1
        self.full = full
        self.kernel: CostKernel = cost_kernel(self.template, full, term.linear is not None, term.loss, switched)
        self.single = np.concatenate(
            [np.full(s.source.space.ambient, len(s.indices) == 1 and term.count > 1) for s in term.slots]
        )
        shared = [np.full(s.source.size, len(s.indices) == 1 and term.count > 1) for s in term.data]
        self.shared = np.concatenate(shared) if shared else np.zeros(0, bool)
        if isinstance(term.noise.value, DataSlot):
            self.fixed_whitening = None
        else:
            self.fixed_whitening = whitening_numbers(entry, self.template.dim, DataStore(layout))

    def parameters(self, layout: Layout, store: DataStore, numbers: np.ndarray) -> list[Any]:
        """Kernel inputs after the point: data, whitening, linear part; arrays (count,) or numbers."""
        term, count = self.entry.term, self.entry.term.count
        rows = numbers[self.entry.numbers]
        values: list[Any] = [rows[0, k] if one else rows[:, k].copy() for k, one in enumerate(self.shared)]
        white = self.fixed_whitening
        if white is None:
            white = whitening_numbers(self.entry, self.template.dim, store)
        values += [w if w.size == count and count > 1 else float(w[0]) for w in white]
        if term.linear is not None:
            if isinstance(term.linear, DataSlot):
                index = layout.numbers(term.linear)
                linear = np.broadcast_to(numbers[index], (count, self.template.dim))
            else:
                linear = constant_rows(term.linear, self.template.dim, count, f"{term.what}: linear")
            values += [column.copy() for column in linear.T]
        return values


class LeastSquares:
    """Costs and constraints of a problem, ready to be bound to data (`bind`)."""

    def __init__(self, problem: Problem, layout: Layout, whole: bool | None = None) -> None:
        self.problem, self.layout = problem, layout
        self.activity = Activity(layout)
        costs = [entry for entry in layout.terms if entry.term.kind == "cost"]
        instances = sum(entry.term.count for entry in costs)
        self.whole = instances <= WHOLE_LIMIT if whole is None else whole
        self.costs = [_Cost(layout, entry, self.whole) for entry in costs]
        self.pattern = HessianPattern(layout, [(c.entry, c.kernel.pairs) for c in self.costs])
        self._function = _whole_function(self) if self.whole else None

    def bind(self, store: DataStore) -> Bound:
        """Costs as functions of the point alone, for the data in `store`."""
        flags = self.activity.flags(store.numbers)
        store.require_finite()
        by_name = {e.term.name: f for e, f in zip(self.layout.terms, flags, strict=True)}
        return (WholeBound if self.whole else ArrayBound)(self, store, by_name)


class Bound(ABC):
    """Costs for fixed data. `flags` tells which instances are on."""

    def __init__(self, form: LeastSquares, store: DataStore, flags: Flags) -> None:
        self.form, self.store, self.flags = form, store, flags
        self.numbers = np.where(np.isnan(store.numbers), 0.0, store.numbers)

    @abstractmethod
    def cost(self, point: np.ndarray) -> float: ...

    @abstractmethod
    def linearize(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, gradient (size,), Hessian entries in the order of the pattern."""


class ArrayBound(Bound):
    def __init__(self, form: LeastSquares, store: DataStore, flags: Flags) -> None:
        super().__init__(form, store, flags)
        self._parameters = [c.parameters(form.layout, store, self.numbers) for c in form.costs]
        self._out = [np.empty((c.kernel.code.outputs, c.entry.term.count)) for c in form.costs]

    def _inputs(self, k: int, point: np.ndarray) -> list[Any]:
        cost = self.form.costs[k]
        stored = cost.entry.stored
        values: list[Any] = [
            point[stored[0, j]] if one else point.take(stored[:, j]) for j, one in enumerate(cost.single)
        ]
        return values + self._parameters[k]

    def cost(self, point: np.ndarray) -> float:
        total = 0.0
        for k, cost in enumerate(self.form.costs):
            out = cost.kernel.value_code(self._inputs(k, point), cost.entry.term.count)[0]
            on = self.flags[cost.entry.term.name]
            total += float(out.sum() if on is None else out[on].sum())
        return total

    def linearize(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        pattern = self.form.pattern
        total = 0.0
        gradient, hessian = np.zeros(pattern.size), np.zeros(pattern.nonzeros)
        for k, cost in enumerate(self.form.costs):
            out = cost.kernel.code(self._inputs(k, point), cost.entry.term.count, self._out[k])
            on = self.flags[cost.entry.term.name]
            if on is not None:
                out[:, ~on] = 0.0
            width = cost.template.width
            total += float(out[0].sum())
            gradient += np.bincount(cost.entry.columns.T.ravel(), out[1 : 1 + width].ravel(), pattern.size)
            positions, twice = pattern.positions[k]
            entries = out[1 + width :]
            if positions.size:
                hessian += np.bincount(positions.ravel(), entries.ravel(), pattern.nonzeros)
            if twice is not None:
                use = twice >= 0
                hessian += np.bincount(twice[use], entries[use], pattern.nonzeros)
        return total, gradient, hessian


class WholeBound(Bound):
    def __init__(self, form: LeastSquares, store: DataStore, flags: Flags) -> None:
        super().__init__(form, store, flags)
        assert form._function is not None
        parts = [self.numbers]
        for c in form.costs:
            if c.fixed_whitening is None:
                white = whitening_numbers(c.entry, c.template.dim, store)
                parts.append(np.broadcast_to(white, (white.shape[0], c.entry.term.count)).T.ravel())
        for c in form.costs:
            on = flags[c.entry.term.name]
            parts.append(np.ones(c.entry.term.count) if on is None else on.astype(float))
        self._function = form._function
        self._parameters = np.concatenate(parts)

    def cost(self, point: np.ndarray) -> float:
        return self._function.value(point, self._parameters)

    def linearize(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        return self._function.all(point, self._parameters)


class _Whole:
    """Compiled function of the whole problem, called through buffers."""

    def __init__(self, x: ca.SX, p: ca.SX, value: ca.SX, gradient: ca.SX, hessian: ca.SX) -> None:
        self._x, self._p = np.zeros(x.shape[0]), np.zeros(max(p.shape[0], 1))
        self._one, self._value = ca.Function("value", [x, p], [value]), np.zeros(1)
        every = ca.cse([value, gradient, hessian])
        self._every = ca.Function("every", [x, p], every)
        self._cost, self._gradient = np.zeros(1), np.zeros(gradient.shape[0])
        self._hessian = np.zeros(hessian.shape[0])
        self._buffers = [self._one.buffer(), self._every.buffer()]
        for (buffer, _), results in zip(
            self._buffers, ([self._value], [self._cost, self._gradient, self._hessian]), strict=True
        ):
            access: Any = buffer  # its stubs know only calls with a size
            access.set_arg(0, self._x.data)
            access.set_arg(1, self._p.data)
            for k, result in enumerate(results):
                access.set_res(k, result.data)

    def value(self, point: np.ndarray, parameters: np.ndarray) -> float:
        self._x[:] = point
        self._p[: parameters.size] = parameters
        self._buffers[0][1]()
        return float(self._value[0])

    def all(self, point: np.ndarray, parameters: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self._x[:] = point
        self._p[: parameters.size] = parameters
        self._buffers[1][1]()
        return float(self._cost[0]), self._gradient.copy(), self._hessian.copy()


def _whole_function(form: LeastSquares) -> _Whole:
    layout, pattern = form.layout, form.pattern
    x = ca.SX.sym("x", layout.stored_size)
    numbers = ca.SX.sym("d", layout.data_size)
    weights, switches = [], []
    value = ca.SX(0)
    gradient: list[Any] = [ca.SX(0)] * pattern.size
    hessian: list[Any] = [ca.SX(0)] * pattern.nonzeros
    for k, cost in enumerate(form.costs):
        kernel, term, entry = cost.kernel, cost.entry.term, cost.entry
        function = ca.Function("kernel", [kernel.inputs], [kernel.value, kernel.gradient, kernel.hessian])
        rows = kernel.inputs.shape[0] - entry.stored.shape[1] - entry.numbers.shape[1] - 1
        rows -= cost.template.dim if term.linear is not None else 0
        if cost.fixed_whitening is None:
            w = ca.SX.sym("w", rows * term.count)
            weights.append(w)
        on = ca.SX.sym("on", term.count)
        switches.append(on)
        positions, twice = pattern.positions[k]
        for i in range(term.count):
            inputs: list[Any] = [x[entry.stored[i].tolist()]]
            if entry.numbers.shape[1]:
                inputs.append(numbers[entry.numbers[i].tolist()])
            if cost.fixed_whitening is None:
                inputs.append(w[i * rows : (i + 1) * rows])
            else:
                white = cost.fixed_whitening
                inputs.append(ca.DM(white[:, i if white.shape[1] > 1 else 0]))
            if isinstance(term.linear, DataSlot):
                index = np.broadcast_to(layout.numbers(term.linear), (term.count, cost.template.dim))[i]
                inputs.append(numbers[index.tolist()])
            elif term.linear is not None:
                linear = constant_rows(term.linear, cost.template.dim, term.count, term.what)[i]
                inputs.append(ca.DM(linear))
            v, g, h = function(ca.vertcat(*inputs, on[i]))
            value += v
            for j, c in enumerate(entry.columns[i]):
                gradient[c] += g[j]
            for j in range(len(kernel.pairs)):
                hessian[positions[j, i]] += h[j]
                if twice is not None and twice[j, i] >= 0:
                    hessian[positions[j, i]] += h[j]
    p = ca.vertcat(numbers, *weights, *switches)
    return _Whole(x, p, value, ca.vertcat(*gradient), ca.vertcat(*hessian))


class Constraints:
    """Residual rows and Jacobian of equalities (first) and inequalities at a point.

    Attributes:
        size: number of rows; the first `equalities` are equalities.
    """

    def __init__(self, layout: Layout, skip: frozenset[str] = frozenset()) -> None:
        self.layout = layout
        kinds = ("equality", "inequality")
        self.terms = [e for kind in kinds for e in layout.terms if e.term.kind == kind and e.term.name not in skip]
        self._codes = [residual_code(e.term) for e in self.terms]
        self.dims = [template_of(e.term).dim for e in self.terms]
        sizes = [e.term.count * d for e, d in zip(self.terms, self.dims, strict=True)]
        self.size = sum(sizes)
        self.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        self.equalities = sum(s for s, e in zip(sizes, self.terms, strict=True) if e.term.kind == "equality")
        rows, cols = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        for e, d, start in zip(self.terms, self.dims, self.starts, strict=False):
            at = start + np.arange(e.term.count * d).reshape(e.term.count, d, 1)
            shape = (e.term.count, d, e.columns.shape[1])
            rows.append(np.broadcast_to(at, shape).ravel())
            cols.append(np.broadcast_to(e.columns[:, None], shape).ravel())
        self.rows, self.columns = np.concatenate(rows), np.concatenate(cols)

    def evaluate(self, point: np.ndarray, numbers: np.ndarray, flags: Flags) -> tuple[np.ndarray, np.ndarray]:
        """Rows (size,) and Jacobian entries in the order of `rows`, `columns` (entries that repeat add up).

        Those of instances that are off are zero, whatever their data would give.
        """
        values, entries = [np.zeros(0)], [np.zeros(0)]
        for e, code in zip(self.terms, self._codes, strict=True):
            inputs = [*point[e.stored].T, *numbers[e.numbers].T]
            r, J = code.residual_and_jacobian([np.ascontiguousarray(v) for v in inputs], e.term.count)
            on = flags.get(e.term.name)
            if on is not None:
                r[~on], J[~on] = 0.0, 0.0
            values.append(r.ravel())
            entries.append(J.ravel())
        return np.concatenate(values), np.concatenate(entries)

    def residual(self, point: np.ndarray, numbers: np.ndarray, flags: Flags) -> np.ndarray:
        """Rows alone."""
        values = [np.zeros(0)]
        for e, code in zip(self.terms, self._codes, strict=True):
            inputs = [*point[e.stored].T, *numbers[e.numbers].T]
            r = code.residual([np.ascontiguousarray(v) for v in inputs], e.term.count)
            on = flags.get(e.term.name)
            if on is not None:
                r[~on] = 0.0
            values.append(r.ravel())
        return np.concatenate(values)

    def bounds(self, numbers: np.ndarray, flags: Flags) -> tuple[np.ndarray, np.ndarray]:
        """(size,) bounds; zero for equalities, infinite for instances that are off."""
        lower, upper = np.zeros(self.size), np.zeros(self.size)
        for k, (e, d) in enumerate(zip(self.terms, self.dims, strict=True)):
            if e.term.kind == "equality":
                continue
            part = slice(self.starts[k], self.starts[k + 1])
            for out, value in ((lower, e.term.lower), (upper, e.term.upper)):
                rows = (
                    numbers[self.layout.numbers(value)]
                    if isinstance(value, DataSlot)
                    else constant_rows(value, d, e.term.count, e.term.what)
                )
                out[part] = np.broadcast_to(rows, (e.term.count, d)).ravel()
            on = flags.get(e.term.name)
            if on is not None:
                off = np.repeat(~on, d)
                lower[part][off], upper[part][off] = -np.inf, np.inf
        return lower, upper
