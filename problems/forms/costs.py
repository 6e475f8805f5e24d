"""The costs of a problem as machine code: one loop over the instances of each term that reads what it needs where it
stands and adds cost, gradient and Hessian entries where they belong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy.linalg.lapack import dpotrf  # type: ignore[attr-defined]

from problems.forms.kernels import CostKernel, cost_kernel
from problems.forms.layout import DataStore, Layout, TermLayout, constant_rows, constant_whitening, noise_numbers
from problems.forms.loops import SUM_TASK, Program, address, summing_loop
from problems.forms.machine_code import Code
from problems.forms.sparsity import HessianPattern
from problems.forms.template import template_of
from problems.noise import whitening
from problems.problem import DataSlot

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

    @cached_property
    def kernel(self) -> CostKernel:
        return cost_kernel(self.template, self._full, self.term.linear is not None, self.term.loss)

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


class CostCode:
    """Cost, gradient and Gauss-Newton Hessian of all costs at a point.

    The numbers kernels read beside the point stand in one array: data, whitenings made of data, then what never
    changes.

    Attributes:
        size, nonzeros: of gradient and Hessian.
        point, sums: what programs read and add to: cost, gradient, Hessian entries, and one place of no account.
    """

    def __init__(self, layout: Layout, costs: Sequence[Cost], pattern: HessianPattern) -> None:
        self._costs, self.size, self.nonzeros = costs, pattern.size, pattern.nonzeros
        self._dynamic: list[tuple[Cost, slice]] = []  # whose whitening is made of data, and where it stands
        self._index: list[np.ndarray] = []
        constants = self._place(layout)
        self._values = np.concatenate([np.zeros(self.free), *constants])
        self.point = np.zeros(layout.stored_size)
        self.sums = np.zeros(2 + self.size + self.nonzeros)  # the last one takes what is added nowhere
        added = [self._added(cost, positions) for cost, positions in zip(costs, pattern.positions, strict=True)]
        self._targets, self._outputs = [one[0] for one in added], [one[1] for one in added]
        self._tasks = np.array(
            [
                (c.count, 0, address(index), address(targets), targets.shape[1], *map(address, shared))
                for c, index, targets in zip(costs, self._index, self._targets, strict=True)
                for shared in [(self.point, self._values, self.sums)]
            ],
            np.int64,
        ).reshape(len(costs), len(SUM_TASK))
        self._entered: Bound | None = None
        self._flags: Flags | None = None

    def bind(self, store: DataStore, numbers: np.ndarray, flags: Flags) -> Bound:
        """The costs for the data `numbers` (missing ones read as zero) and the weights in `store`."""
        parameters = np.empty(self.free)
        parameters[: numbers.size] = numbers
        for cost, part in self._dynamic:
            white = cost.whitening(store)
            if white.shape[1] == cost.count:
                parameters[part] = white.T.ravel()
            else:
                parameters[part].reshape(cost.count, -1)[:] = white.T
        return Bound(self, parameters[: numbers.size], flags, parameters)

    def enter(self, bound: Bound) -> None:
        """Let programs read what is bound."""
        if self._entered is not bound:
            self._values[: self.free] = bound.parameters
            if bound.flags is not self._flags:  # one object for each pattern
                on = [bound.flags[cost.term.name] for cost in self._costs]
                self._tasks[:, SUM_TASK.index("flags")] = [0 if one is None else address(one) for one in on]
                self._flags = bound.flags
            self._entered = bound

    def sums_of(self, bound: Bound, point: np.ndarray, run: Program, size: int) -> np.ndarray:
        """The first `size` sums that a program makes of what is bound."""
        self.enter(bound)
        self.point[:] = point
        self.sums[:size] = 0.0
        run()
        return self.sums[:size].copy()

    @cached_property
    def cost(self) -> Program:
        return self._program("value_function", [(0,)] * len(self._costs))

    @cached_property
    def gradient(self) -> Program:
        return self._program("gradient_function", [tuple(range(1 + c.template.width)) for c in self._costs])

    @cached_property
    def linearization(self) -> Program:
        return self._program("function", self._outputs)

    def _program(self, function: str, outputs: Sequence[tuple[int, ...]]) -> Program:
        """Adds `outputs` of a function of every kernel."""
        codes = [_loop(c.kernel, function, wanted) for c, wanted in zip(self._costs, outputs, strict=True)]
        return Program(codes, self._tasks)

    def _place(self, layout: Layout) -> list[np.ndarray]:
        """Where every cost reads its inputs; what follows the first `free` numbers."""
        size = layout.data_size
        whitenings: dict[int, np.ndarray] = {}
        for cost in (one for one in self._costs if one.dynamic):
            rows = cost.count * cost.whitening_size
            whitenings[id(cost)] = size + np.arange(rows).reshape(cost.count, cost.whitening_size)
            self._dynamic.append((cost, slice(size, size + rows)))
            size += rows
        self.free = size
        constants: list[np.ndarray] = []

        def constant(rows: np.ndarray) -> np.ndarray:
            nonlocal size
            constants.append(rows.ravel())
            size += rows.size
            return size - rows.size + np.arange(rows.size).reshape(rows.shape)

        for cost in self._costs:
            white = cost.fixed_whitening
            parts = [cost.entry.stored, cost.entry.numbers]
            parts.append(whitenings[id(cost)] if white is None else constant(white.T))
            if isinstance(cost.term.linear, DataSlot):
                parts.append(layout.numbers(cost.term.linear))
            elif cost.term.linear is not None:
                parts.append(constant(cost.linear_rows()))
            self._index.append(_side_by_side(parts, cost.count))
        return constants

    def _added(self, cost: Cost, positions: tuple[np.ndarray, np.ndarray | None]) -> tuple[np.ndarray, tuple[int, ...]]:
        """Where outputs of every instance are added, and which outputs these are, in turn."""
        places, twice = positions
        start = 1 + self.size
        parts = [np.zeros((1, 1), np.intp), 1 + cost.entry.columns, start + places.T]
        outputs = list(range(1 + cost.template.width + places.shape[0]))
        if twice is not None:
            again = np.flatnonzero((twice >= 0).any(axis=1))
            parts.append(np.where(twice[again] >= 0, start + twice[again], start + self.nonzeros).T)
            outputs += [1 + cost.template.width + int(k) for k in again]
        return _side_by_side(parts, cost.count), tuple(outputs)


class Bound:
    """Costs for fixed data, as functions of the point alone.

    Attributes:
        code: of which they are.
        numbers: the data, zeros where they are missing.
        flags: which instances are on, by name of the term.
        parameters: what kernels read beside the point, as far as it may change.
    """

    def __init__(self, code: CostCode, numbers: np.ndarray, flags: Flags, parameters: np.ndarray) -> None:
        self.code, self.numbers, self.flags, self.parameters = code, numbers, flags, parameters

    def cost(self, point: np.ndarray) -> float:
        return float(self.code.sums_of(self, point, self.code.cost, 1)[0])

    def gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and gradient (size,), in new arrays."""
        code = self.code
        sums = code.sums_of(self, point, code.gradient, 1 + code.size)
        return float(sums[0]), sums[1:]

    def linearize(self, point: np.ndarray) -> Linearization:
        """Cost, gradient (size,), Hessian entries in the order of the pattern, in new arrays."""
        code = self.code
        start = 1 + code.size
        sums = code.sums_of(self, point, code.linearization, start + code.nonzeros)
        return float(sums[0]), sums[1:start], sums[start:]


@lru_cache(maxsize=1024)
def _loop(kernel: CostKernel, function: str, outputs: tuple[int, ...]) -> Code:
    return summing_loop(getattr(kernel, function), kernel.stored, outputs)


def _side_by_side(parts: Sequence[np.ndarray], count: int) -> np.ndarray:
    """(1 or count, k) arrays as one of 32-bit integers, single rows repeated."""
    out = np.empty((count, sum(part.shape[1] for part in parts)), np.int32)
    at = 0
    for part in parts:
        out[:, at : at + part.shape[1]] = part
        at += part.shape[1]
    return out
