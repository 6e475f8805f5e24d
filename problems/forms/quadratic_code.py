"""A quadratic program as code of all its data: for problems whose weights and matrices change at every solve.

`QuadraticProgram` works out maps once for each set of weights, matrices and pattern of missing data, which pays when
they come back. Here P, q, A and the rest are one function of the data, written from the symbols of the terms with the
eliminated unknowns replaced, so its zeros stay unwritten: a new pattern costs as much as a known one.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np

from problems.errors import FormError
from problems.forms.affine import Bounds
from problems.forms.layout import INFINITE, TermLayout, constant_rows
from problems.forms.quadratic import QuadraticProgram
from problems.forms.template import Template, template_of
from problems.noise import information_matrix
from problems.problem import DataSlot


class Assembled(NamedTuple):
    """``1/2 v'Pv + q'v`` subject to ``l <= A v <= u`` and all unknowns ``Z v + offset``, for one set of data.

    The first `equalities` rows of A are equalities.
    """

    P: np.ndarray
    q: np.ndarray
    A: np.ndarray
    l: np.ndarray
    u: np.ndarray
    Z: np.ndarray
    offset: np.ndarray


class QuadraticCode:
    """Code of a program, dense; unknowns are those the program does not eliminate.

    Args:
        program: the lowered problem with what it eliminates.

    Raises:
        FormError: a noise covariance that is data (give its information), or an elimination that is more than
            replacing one unknown after another.

    Attributes:
        size, equalities: unknowns and equality rows that are left.
        has_lower: some inequality has a lower bound.
    """

    def __init__(self, program: QuadraticProgram) -> None:
        self.program, layout = program, program.layout
        self._d = ca.SX.sym("d", layout.data_size)
        kinds: dict[str, list[TermLayout]] = {"cost": [], "equality": [], "inequality": []}
        for entry in layout.terms:
            kinds[entry.term.kind].append(entry)
        self._costs, self._bounded = kinds["cost"], kinds["inequality"]
        count = sum(entry.term.count for entry in self._costs)
        self._on = ca.SX.sym("on", count)
        self._all_on = np.ones(count)
        free, Z, offset, rest = self._eliminated(kinds["equality"])
        self.size, self.equalities = len(free), rest[0].shape[0]
        P, q = self._cost(Z, offset)
        inner = [self._rows(entry, Z, offset) for entry in self._bounded]
        A, shift = (ca.vertcat(first, *(part[k] for part in inner)) for k, first in enumerate(rest))
        # transposed, because CasADi stores columns and numpy rows
        shapes = [(self.size, self.size), (self.size,), (A.shape[0], self.size), (A.shape[0],)]
        shapes += [(layout.size, self.size), (layout.size,)]
        self._pieces, self._index, ends = self._packed([P.T, q.T, A.T, shift.T, Z.T, offset.T])
        self._total = ends[-1]
        self._parts = [(slice(a, b), shape) for a, b, shape in zip([0, *ends], ends, shapes, strict=False)]
        self._compile()
        rows = [_Instances(entry, template_of(entry.term).dim) for entry in self._bounded]
        self._limits = [_Limit(Bounds.of(layout, cast(Any, rows), key)) for key in ("lower", "upper")]
        self.has_lower = not self._limits[0].absent
        self._has_cost_switch = any(entry.term.active is not None for entry in self._costs)
        self._row_flags = np.concatenate([np.zeros(0, np.intp), *self._switches(rows)])
        always = self._row_flags < 0
        self._always_on = always if always.any() else None

    def _compile(self) -> None:
        self._function = ca.Function("assemble", [self._d, self._on], [self._pieces])
        self._values = np.empty(self._pieces.shape[0])
        pair: Any = self._function.buffer()
        self._buffer, self._run = pair
        self._buffer.set_res(0, self._values.data)

    def _switches(self, rows: list[_Instances]) -> list[np.ndarray]:
        """Position of the flag of every inequality row, -1 where it has none."""
        out = []
        for row in rows:
            active = row.layout.term.active
            index = np.full(row.count, -1, np.intp)
            if isinstance(active, DataSlot):
                index = np.broadcast_to(self.program.layout.numbers(active)[:, 0], row.count)
            out.append(np.repeat(index, row.dim))
        return out

    def _packed(self, parts: list[Any]) -> tuple[Any, np.ndarray, list[int]]:
        """Entries of all parts that are not zero, their positions, and where each part ends."""
        values, index, start, ends = [], [], 0, []
        for part in parts:
            part = ca.sparsify(part)
            rows, columns = (np.array(k, dtype=np.intp) for k in part.sparsity().get_triplet())
            values.append(ca.vec(part.nz[:]))
            index.append(start + columns * part.shape[0] + rows)
            start += part.numel()
            ends.append(start)
        return ca.vertcat(*values), np.concatenate(index), ends

    def __call__(self, numbers: np.ndarray, flags: dict[str, np.ndarray | None] | None = None) -> Assembled:
        """The program for given data.

        Args:
            numbers: as laid out, finite.
            flags: active instances by name of the term; None where only switches that are data matter.
        """
        on, off = self._all_on, None
        if flags is not None or self._has_cost_switch:
            flags = self.program.flags(numbers) if flags is None else flags
            parts = [(flags[e.term.name], e.term.count) for e in self._costs]
            on = np.concatenate([np.ones(count) if flag is None else flag.astype(float) for flag, count in parts])
            parts = [(flags[r.term.name], template_of(r.term).dim, r.term.count) for r in self._bounded]
            off = np.concatenate(
                [np.zeros(0, bool)]
                + [np.zeros(n * dim, bool) if flag is None else np.repeat(~flag, dim) for flag, dim, n in parts]
            )
        elif self._row_flags.size:
            off = numbers[self._row_flags] == 0
            if self._always_on is not None:
                off[self._always_on] = False
        self._buffer.set_arg(0, numbers.data)
        self._buffer.set_arg(1, on.data)
        self._run()
        flat = np.zeros(self._total)
        flat[self._index] = self._values
        P, q, A, shift, Z, offset = (flat[part].reshape(shape) for part, shape in self._parts)
        l, u = self._bounds(numbers, shift, off)
        return Assembled(P, q, A, l, u, Z, offset)

    def _bounds(self, numbers: np.ndarray, shift: np.ndarray, off: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        l, u = -shift, -shift
        if shift.size > self.equalities:
            for into, limit, infinite in zip((l, u), self._limits, (-np.inf, np.inf), strict=True):
                limit.add(into[self.equalities :], numbers, infinite)
                if off is not None:
                    into[self.equalities :][off] = infinite
        return l, u

    # Symbols

    def _given(self, entry: TermLayout, template: Template, instance: int, z: Any) -> list[Any]:
        """Arguments of the functions of a template: its slots taken from the column z, then its data."""
        columns, numbers = entry.columns[instance], entry.numbers[instance]
        out, at = [], 0
        for symbol in template.x:
            out.append(z[columns[at : at + symbol.shape[0]].tolist()])
            at += symbol.shape[0]
        at = 0
        for symbol in template.data:
            out.append(self._d[numbers[at : at + symbol.shape[0]].tolist()])
            at += symbol.shape[0]
        return out

    def _affine(self, entry: TermLayout, Z: Any, offset: Any) -> list[tuple[Any, Any]]:
        """Coefficients (dim, size) and constants (dim,) of every instance in the unknowns of the columns of Z."""
        template = template_of(entry.term)
        arguments = [*template.x, *template.data]
        residual = ca.Function("residual", arguments, [template.residual])
        jacobian = ca.Function("jacobian", arguments, [template.jacobian])
        out = []
        for instance in range(entry.term.count):
            given = self._given(entry, template, instance, offset)
            out.append((jacobian(*given) @ Z[entry.columns[instance].tolist(), :], residual(*given)))
        return out

    def _rows(self, entry: TermLayout, Z: Any, offset: Any) -> tuple[Any, Any]:
        parts = self._affine(entry, Z, offset)
        return ca.vertcat(*(J for J, _ in parts)), ca.vertcat(*(r for _, r in parts))

    def _eliminated(self, equalities: list[TermLayout]) -> tuple[list[int], Any, Any, tuple[Any, Any]]:
        """Unknowns that stay, all unknowns as ``Z v + offset``, and the equality rows that are left."""
        program, size = self.program, self.program.layout.size
        chosen: set[int] = set()
        for slot in program.eliminated:
            chosen |= set(program.layout.columns(slot).ravel().tolist())
        free = [k for k in range(size) if k not in chosen]
        nothing = ca.SX(size, 1)
        whole = [self._rows(entry, ca.SX.eye(size), nothing) for entry in equalities]
        R = ca.vertcat(ca.SX(0, size), *(J for J, _ in whole))
        c = ca.vertcat(ca.SX(0, 1), *(r for _, r in whole))
        Z, offset = ca.SX(size, len(free)), ca.SX(size, 1)
        for place, column in enumerate(free):
            Z[column, place] = 1
        pending, rest = set(chosen), []
        rows = [(k, np.array(R[k, :].sparsity().get_triplet()[1], dtype=int).tolist()) for k in range(R.shape[0])]
        while rows:
            left = []
            for k, columns in rows:
                unknown = [column for column in columns if column in pending]
                if len(unknown) == 1 and R[k, unknown[0]].is_constant():
                    by = -R[k, :] / R[k, unknown[0]]
                    by[unknown[0]] = 0
                    by = ca.sparsify(by)
                    Z[unknown[0], :] = ca.sparsify(by @ Z)
                    offset[unknown[0]] = by @ offset - c[k] / R[k, unknown[0]]
                    pending.discard(unknown[0])
                elif unknown:
                    left.append((k, columns))
                else:
                    rest.append(k)
            if len(left) == len(rows):
                break
            rows = left
        if pending:
            raise FormError(
                "assembly 'code' eliminates unknowns that equalities give one after another, with constant "
                f"coefficients; {len(pending)} unknown(s) are left over. Use assembly='maps', or eliminate nothing"
            )
        Z, offset = ca.sparsify(Z), ca.densify(offset)
        return free, Z, offset, (R[rest, :] @ Z, R[rest, :] @ offset + c[rest])

    def _cost(self, Z: Any, offset: Any) -> tuple[Any, Any]:
        P, q, start = ca.SX(self.size, self.size), ca.SX.zeros(self.size), 0
        for entry in self._costs:
            weights, linear = self._weights(entry), self._linear(entry)
            for instance, (J, r) in enumerate(self._affine(entry, Z, offset)):
                W = weights[instance if len(weights) > 1 else 0]
                gradient = W @ r if linear is None else W @ r + linear[instance if len(linear) > 1 else 0]
                on = self._on[start + instance] if entry.term.active is not None or self._reads(entry) else 1
                P += on * (J.T @ (W @ J))
                q += on * (J.T @ gradient)
            start += entry.term.count
        return P, q

    def _reads(self, entry: TermLayout) -> bool:
        return bool(entry.numbers.size) or entry.linear is not None

    def _weights(self, entry: TermLayout) -> list[Any]:
        term = entry.term
        assert term.noise is not None
        dim, kind, value = template_of(term).dim, term.noise.kind, term.noise.value
        if not isinstance(value, DataSlot):
            return [ca.DM(W) for W in information_matrix(kind, value, dim, term.count, term.what)]
        rows = [self._d[index.tolist()] for index in self.program.layout.numbers(value)]
        if kind == "sigma":
            return [ca.diag(1 / (row if row.shape[0] == dim else ca.repmat(row, dim, 1)) ** 2) for row in rows]
        if kind != "information":
            raise FormError(f"{term.what}: assembly 'code' takes noise that is data as sigma or information")
        return [ca.reshape(row, dim, dim) if row.shape[0] > 1 else row for row in rows]

    def _linear(self, entry: TermLayout) -> list[Any] | None:
        term = entry.term
        if term.linear is None:
            return None
        if entry.linear is not None:
            dim = template_of(term).dim
            return [ca.repmat(self._d[i.tolist()], dim // len(i), 1) for i in entry.linear]
        return [ca.DM(row) for row in constant_rows(term.linear, template_of(term).dim, term.count, term.what)]


class _Limit:
    """One side of the bounds: constants, and for some rows a number of the data."""

    def __init__(self, bounds: Bounds) -> None:
        by_data = bounds.index >= 0
        self._constant = np.where(by_data, 0.0, bounds.constant)
        self._rows: Any = slice(None) if by_data.all() else by_data
        self._places = bounds.index[by_data] if by_data.any() else None
        self.absent = not by_data.any() and bool(np.isinf(bounds.constant).all())

    def add(self, into: np.ndarray, numbers: np.ndarray, infinite: float) -> None:
        if self.absent:
            into[:] = infinite
            return
        into += self._constant
        if self._places is not None:
            given = numbers[self._places]
            given[given >= INFINITE if infinite > 0 else given <= -INFINITE] = infinite
            into[self._rows] += given


class _Instances:
    """What `Bounds.of` reads of the rows of a term."""

    def __init__(self, layout: TermLayout, dim: int) -> None:
        self.layout, self.dim, self.count = layout, dim, layout.term.count
