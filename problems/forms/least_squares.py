"""Value, gradient and Gauss-Newton Hessian of all costs of a problem, and residual rows of its constraints.

Costs are machine code (`problems.forms.costs`), constraints array code (`problems.forms.residual_code`).
"""

from __future__ import annotations

import numpy as np

from problems.forms.costs import Bound, Cost, CostCode, Flags
from problems.forms.layout import Activity, DataStore, Layout, constant_rows
from problems.forms.residual_code import residual_code
from problems.forms.sparsity import HessianPattern
from problems.forms.template import template_of
from problems.problem import DataSlot, Problem

PATTERNS = 32  # of active instances that are remembered


class LeastSquares:
    """Costs of a problem, ready to be bound to data (`bind`)."""

    def __init__(self, problem: Problem, layout: Layout) -> None:
        self.problem, self.layout = problem, layout
        self.activity = Activity(layout)
        self.costs = costs = [Cost(layout, entry) for entry in layout.terms if entry.term.kind == "cost"]
        self.pattern = HessianPattern(layout, [(c.entry, c.kernel.pairs) for c in costs])
        self.code = CostCode(layout, costs, self.pattern)
        self._flags: dict[bytes, Flags] = {}

    def bind(self, store: DataStore) -> Bound:
        """Costs as functions of the point alone, for the data in `store`."""
        numbers = store.numbers
        # one product tells that all are finite, unless they are huge
        finite = bool(numbers.dot(numbers) < np.inf)
        key = self.activity.key(numbers, finite)
        flags = self._flags.get(key)
        if flags is None:
            found = self.activity.flags(numbers)
            # machine code reads them byte by byte
            rows = [None if on is None else np.ascontiguousarray(on, dtype=bool) for on in found]
            flags = {e.term.name: on for e, on in zip(self.layout.terms, rows, strict=True)}
            if len(self._flags) >= PATTERNS:
                self._flags.clear()
            self._flags[key] = flags
        if not finite:
            store.require_finite()
        return self.code.bind(store, numbers if finite else np.where(np.isnan(numbers), 0.0, numbers), flags)


class Constraints:
    """Residual rows and Jacobian of equalities (first) and inequalities at a point.

    Attributes:
        size: number of rows; the first `equalities` are equalities.
    """

    def __init__(self, layout: Layout, skip: frozenset[str] = frozenset()) -> None:
        self.layout = layout
        kinds = ("equality", "inequality")
        self.terms = [e for kind in kinds for e in layout.terms if e.term.kind == kind and e.term.name not in skip]
        self.codes = [residual_code(e.term) for e in self.terms]
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
        for e, code in zip(self.terms, self.codes, strict=True):
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
        for e, code in zip(self.terms, self.codes, strict=True):
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
