"""`NonlinearProgram`: a problem as a CasADi program ``min f(v; p)`` subject to ``lower <= g(v; p) <= upper``.

The decision variables v are tangent coordinates around a reference point, for every space. Parameters are this point,
the data, the whitening numbers of noise that is data, and the flags of instances that can be off. Each template becomes
one small function with exact derivatives that CasADi maps over all instances, and constant sparse matrices collect the
results. Differentiating the whole program instead takes 10 to 30 times longer to set up (measured).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.forms.costs import Flags, whitening_numbers
from problems.forms.kernels import cost_kernel, gate
from problems.forms.layout import Activity, DataStore, Layout, TermLayout, constant_rows
from problems.forms.least_squares import Constraints
from problems.forms.sparsity import HessianPattern
from problems.forms.template import Template, template_of
from problems.noise import Loss
from problems.problem import DataSlot, Problem, Term
from problems.spaces import Space


@dataclass(frozen=True, eq=False)
class _Kernel:
    """Functions of one instance: (reference, step, numbers, on) and, for `hessian`, the multipliers of its outputs.

    Attributes:
        value: the outputs, a cost or constraint rows.
        both: the outputs and their nonzero derivatives by the step, at `places`.
        hessian: upper triangle of the second derivative of ``multipliers' outputs``, at `pairs`; None where it is zero.
    """

    value: ca.Function
    both: ca.Function
    hessian: ca.Function | None
    places: tuple[tuple[int, int], ...]
    pairs: tuple[tuple[int, int], ...]


def _kernel(outputs: ca.SX, reference: ca.SX, step: ca.SX, rest: ca.SX, on: ca.SX) -> _Kernel:
    inputs = [reference, step, rest, on]
    slopes = ca.jacobian(outputs, step)
    weights = ca.SX.sym("weights", outputs.shape[0])
    curvature = ca.triu(ca.hessian(ca.dot(weights, outputs), step)[0])
    # derivatives of a gated expression are 0 * derivative, which is NaN where the derivative is
    value, first, second = (gate(on, e) for e in (ca.densify(outputs), slopes, curvature))
    places, pairs = (tuple(zip(*m.sparsity().get_triplet(), strict=True)) for m in (first, second))
    hessian = None
    if pairs:
        hessian = ca.Function("hessian", [*inputs, weights], [ca.cse(_entries(second))])
    flat = _entries(first)
    both = ca.Function("both", inputs, ca.cse([value, flat]))
    return _Kernel(ca.Function("value", inputs, [ca.cse(value)]), both, hessian, places, pairs)


def _entries(matrix: ca.SX) -> ca.SX:
    """The nonzero entries as a column, column by column."""
    return ca.vertcat(*(matrix.nz[k] for k in range(matrix.nnz()))) if matrix.nnz() else ca.SX(0, 1)


def _moved(template: Template, spaces: tuple[Space, ...]) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Reference and step of all slots, and the stored coordinates they lead to."""
    references = [ca.SX.sym("reference", space.ambient) for space in spaces]
    steps = [ca.SX.sym("step", space.dim) for space in spaces]
    moved = [space.retract(x, d) for space, x, d in zip(spaces, references, steps, strict=True)]
    return ca.vertcat(*references), ca.vertcat(*steps), ca.vertcat(*moved)


@lru_cache(maxsize=1024)
def _cost(template: Template, spaces: tuple[Space, ...], full: bool, linear: bool, loss: Loss) -> _Kernel:
    kernel = cost_kernel(template, full, linear, loss, True)
    reference, step, point = _moved(template, spaces)
    rest = ca.SX.sym("rest", kernel.inputs.shape[0] - point.shape[0] - 1)
    on = ca.SX.sym("on")
    value = ca.Function("cost", [kernel.inputs], [kernel.value])(ca.vertcat(point, rest, on))
    return _kernel(value, reference, step, rest, on)


@lru_cache(maxsize=1024)
def _rows(template: Template, spaces: tuple[Space, ...]) -> _Kernel:
    reference, step, point = _moved(template, spaces)
    rest, on = ca.SX.sym("rest", template.numbers.shape[0]), ca.SX.sym("on")
    residual = ca.Function("residual", [template.point, template.numbers], [template.residual])
    return _kernel(gate(on, residual(point, rest)), reference, step, rest, on)


class NonlinearProgram:
    """A problem lowered to a nonlinear program.

    Attributes:
        variables: v, tangent coordinates of all unknowns (`Layout.columns` says which are whose).
        parameter: p, as `parameters` fills it.
        objective: f, the costs with their losses and linear parts.
        constraints: g, equalities first; `rows` says which rows are whose.
        derivatives: ``grad_f``, ``jac_g`` and ``hess_lag`` as `casadi.nlpsol` takes them.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.layout = problem, Layout(problem)
        self.activity = Activity(self.layout)
        self._constraints = Constraints(self.layout)
        self._names = [entry.term.name for entry in self.layout.terms]
        self._costs = [entry for entry in self.layout.terms if entry.term.kind == "cost"]
        self._weighted = [e for e in self._costs if isinstance(_noise(e.term).value, DataSlot)]
        self._switched = [e for e in self.layout.terms if e.term.kind != "equality"]
        self.variables = ca.MX.sym("v", self.layout.size)
        self.parameter, self._parts = self._split()
        self._assemble()

    def __repr__(self) -> str:
        v, p, g = (part.shape[0] for part in (self.variables, self.parameter, self.constraints))
        return f"<NonlinearProgram of {self.problem.name!r}: {v} unknowns, {g} rows, {p} parameters>"

    def _repr_html_(self) -> str:
        from problems.display import Table

        rows = [(name, part.stop - part.start) for name, part in self.rows.items()]
        return Table(repr(self).strip("<>"), ("constraint", "rows"), rows)._repr_html_()

    @property
    def casadi(self) -> dict[str, ca.MX]:
        """``{"x", "p", "f", "g"}``, what `casadi.nlpsol` takes."""
        return {"x": self.variables, "p": self.parameter, "f": self.objective, "g": self.constraints}

    @cached_property
    def rows(self) -> dict[str, slice]:
        """Rows of g by the name of the constraint."""
        starts = self._constraints.starts
        return {
            e.term.name: slice(int(a), int(b))
            for e, a, b in zip(self._constraints.terms, starts[:-1], starts[1:], strict=True)
        }

    @property
    def equalities(self) -> int:
        """Number of rows of g that are equalities; they come first."""
        return self._constraints.equalities

    def store(self, data: Mapping[str, Any] | None = None) -> DataStore:
        """Data by name (defaults where left out), checked; what `parameters` and `bounds` take."""
        store = DataStore(self.layout)
        for name, value in (data or {}).items():
            store.set(name, value)
        store.require_all()
        return store

    def flags(self, store: DataStore) -> Flags:
        """Active instances (count,) of each term by name; None where all are."""
        return dict(zip(self._names, self.activity.flags(store.numbers), strict=True))

    def parameters(self, store: DataStore, reference: np.ndarray, flags: Flags | None = None) -> np.ndarray:
        """Numbers of `parameter` for given data around the point `reference` (all stored coordinates)."""
        flags = self.flags(store) if flags is None else flags
        parts = [reference, np.nan_to_num(store.numbers, nan=0.0)]
        for entry in self._weighted:
            white = whitening_numbers(entry, template_of(entry.term).dim, store)
            parts.append(np.broadcast_to(white, (white.shape[0], entry.term.count)).T.ravel())
        for entry in self._switched:
            on = flags[entry.term.name]
            parts.append(np.ones(entry.term.count) if on is None else on.astype(float))
        return np.concatenate(parts)

    def bounds(self, store: DataStore, flags: Flags | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of g; infinite for instances that are off."""
        return self._constraints.bounds(store.numbers, self.flags(store) if flags is None else flags)

    def _split(self) -> tuple[ca.MX, _Parts]:
        """The parameter and its parts, in the order of `parameters`."""
        layout = self.layout
        sizes = [layout.stored_size, layout.data_size]
        sizes += [_whitening_size(e) * e.term.count for e in self._weighted]
        sizes += [e.term.count for e in self._switched]
        p = ca.MX.sym("p", sum(sizes))
        reference, numbers, *others = ca.vertsplit(p, np.cumsum([0, *sizes]).tolist())
        named = [e.term.name for e in (*self._weighted, *self._switched)]
        cut = len(self._weighted)
        whitening, on = dict(zip(named[:cut], others, strict=False)), dict(zip(named[cut:], others[cut:], strict=True))
        return p, _Parts(reference, numbers, whitening, on)

    def _assemble(self) -> None:
        layout, v, p = self.layout, self.variables, self.parameter
        n = layout.size
        mapped = [self._instances(entry) for entry in (*self._costs, *self._constraints.terms)]
        costs, constraints = mapped[: len(self._costs)], mapped[len(self._costs) :]
        f, f_again, gradient = ca.MX(0), ca.MX(0), ca.MX(n, 1)
        for m in costs:
            f += ca.sum2(m.value())
            value, slope = m.both()
            f_again += ca.sum2(value)
            columns = m.entry.columns[:, [b for _, b in m.kernel.places]]
            gradient += _collect(columns.ravel(), n) @ ca.vec(slope)
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self._constraints.size)
        rows, rows_again, slopes = [ca.MX(0, 1)], [ca.MX(0, 1)], [ca.MX(0, 1)]
        at_row, at_column = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        curved: list[tuple[_Mapped, ca.MX]] = [(m, ca.repmat(lam_f, 1, m.entry.term.count)) for m in costs]
        starts = self._constraints.starts
        for m, dim, start in zip(constraints, self._constraints.dims, starts, strict=False):
            count = m.entry.term.count
            rows.append(ca.vec(m.value()))
            value, slope = m.both()
            rows_again.append(ca.vec(value))
            slopes.append(ca.vec(slope))
            a, b = (np.array([place[k] for place in m.kernel.places], np.intp) for k in (0, 1))
            at_row.append((start + dim * np.arange(count)[:, None] + a).ravel())
            at_column.append(m.entry.columns[:, b].ravel())
            curved.append((m, ca.reshape(lam_g[int(start) : int(start) + dim * count], dim, count)))
        self.objective, self.constraints = f, ca.vertcat(*rows)
        jacobian = _matrix(np.concatenate(at_row), np.concatenate(at_column), (lam_g.shape[0], n), ca.vertcat(*slopes))
        curved = [(m, weights) for m, weights in curved if m.kernel.hessian is not None]
        pattern = HessianPattern(layout, [(m.entry, m.kernel.pairs) for m, _ in curved])
        entries = ca.MX(pattern.nonzeros, 1)
        for (m, weights), (positions, twice) in zip(curved, pattern.positions, strict=True):
            values = ca.vec(m.hessian(weights))
            entries += _collect(positions.T.ravel(), pattern.nonzeros) @ values
            if twice is not None:
                entries += _collect(twice.T.ravel(), pattern.nonzeros) @ values
        upper = ca.Sparsity(n, n, pattern.indptr.tolist(), pattern.indices.tolist())
        hessian = ca.MX(upper, ca.densify(entries))
        self.derivatives = {
            "grad_f": ca.Function("nlp_grad_f", [v, p], [f_again, ca.densify(gradient)], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function(
                "nlp_jac_g", [v, p], [ca.vertcat(*rows_again), jacobian], ["x", "p"], ["g", "jac_g_x"]
            ),
            "hess_lag": ca.Function(
                "nlp_hess_l", [v, p, lam_f, lam_g], [hessian], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
            ),
        }

    def _instances(self, entry: TermLayout) -> _Mapped:
        """The kernel of a term and its inputs for all instances."""
        term, count = entry.term, entry.term.count
        template, spaces = template_of(term), tuple(slot.source.space for slot in term.slots)
        parts = self._parts
        rest = [_gather(parts.numbers, entry.numbers)]
        if term.kind == "cost":
            kernel = _cost(template, spaces, _is_full(entry), term.linear is not None, term.loss)
            if term.name in parts.whitening:
                rest.append(ca.reshape(parts.whitening[term.name], _whitening_size(entry), count))
            else:
                white = whitening_numbers(entry, template.dim, DataStore(self.layout))
                rest.append(ca.MX(ca.DM(np.broadcast_to(white, (white.shape[0], count)))))
            if isinstance(term.linear, DataSlot):
                rest.append(
                    _gather(parts.numbers, np.broadcast_to(self.layout.numbers(term.linear), (count, template.dim)))
                )
            elif term.linear is not None:
                linear = constant_rows(term.linear, template.dim, count, f"{term.what}: linear")
                rest.append(ca.MX(ca.DM(linear.T)))
        else:
            kernel = _rows(template, spaces)
        on = ca.MX(ca.DM.ones(1, count)) if term.kind == "equality" else parts.on[term.name].T
        inputs = [_gather(parts.reference, entry.stored), _gather(self.variables, entry.columns), ca.vertcat(*rest), on]
        return _Mapped(entry, kernel, inputs)


@dataclass(frozen=True, eq=False)
class _Parts:
    """Parts of the parameter."""

    reference: ca.MX
    numbers: ca.MX
    whitening: dict[str, ca.MX]
    on: dict[str, ca.MX]


@dataclass(frozen=True, eq=False)
class _Mapped:
    """A kernel over all instances of a term; results have one column per instance."""

    entry: TermLayout
    kernel: _Kernel
    inputs: list[ca.MX]

    def value(self) -> ca.MX:
        return self.kernel.value.map(self.entry.term.count)(*self.inputs)

    def both(self) -> tuple[ca.MX, ca.MX]:
        value, slopes = self.kernel.both.map(self.entry.term.count)(*self.inputs)  # type: ignore[misc]
        return value, slopes

    def hessian(self, weights: ca.MX) -> ca.MX:
        assert self.kernel.hessian is not None
        return self.kernel.hessian.map(self.entry.term.count)(*self.inputs, weights)


def _noise(term: Term) -> Any:
    assert term.noise is not None
    return term.noise


def _is_full(entry: TermLayout) -> bool:
    return _noise(entry.term).kind != "sigma" and template_of(entry.term).dim > 1


def _whitening_size(entry: TermLayout) -> int:
    dim = template_of(entry.term).dim
    return dim * (dim + 1) // 2 if _is_full(entry) else dim


def _gather(vector: ca.MX, positions: np.ndarray) -> ca.MX:
    """Entries of a vector as (width, count) for positions (count, width)."""
    count, width = positions.shape
    if not width:
        return ca.MX(0, count)
    return ca.reshape(vector[positions.ravel().tolist()], width, count)


def _collect(rows: np.ndarray, size: int) -> ca.DM:
    """The matrix that adds entry k of a vector to row ``rows[k]``, or nowhere where that is negative."""
    used = rows >= 0
    starts = np.concatenate([[0], np.cumsum(used)])
    return ca.DM.ones(ca.Sparsity(size, rows.size, starts.tolist(), rows[used].tolist()))


def _matrix(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], entries: ca.MX) -> ca.MX:
    """A sparse matrix from entries; those at the same place add up."""
    place, inverse = np.unique(columns * max(shape[0], 1) + rows, return_inverse=True)
    at = (place % max(shape[0], 1), place // max(shape[0], 1))
    starts = np.searchsorted(at[1], np.arange(shape[1] + 1))
    pattern = ca.Sparsity(shape[0], shape[1], starts.tolist(), at[0].tolist())
    return ca.MX(pattern, ca.densify(_collect(inverse.ravel(), place.size) @ entries))
