"""Terms of a quadratic program as affine rows ``R z + E d + c`` in the unknowns z and the vector data d.

Data have three speeds, found from the symbols: *vector* data enter affinely with constant coefficients, *weight* data
are noise and activity, *matrix* data are anything else (design section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np
import scipy.sparse as sp

from problems.errors import DataError, FormError, NotAffineError
from problems.forms.layout import DataStore, Layout, TermLayout, constant_rows, noise_numbers
from problems.forms.residual_code import ArrayCode
from problems.forms.template import Template, template_of
from problems.noise import L2, information_matrix
from problems.problem import DataSlot, Problem
from problems.spaces import Vector

Speed = Literal["vector", "weight", "matrix"]
Matrix = Any  # numpy array or scipy csr_array


def require_affine(problem: Problem) -> None:
    """Raises FormError or NotAffineError naming what keeps the problem from being a quadratic program."""
    for variable in problem.unknowns.values():
        if not isinstance(variable.space, Vector):
            raise FormError(
                f"a quadratic program has variables on Vector spaces only; {variable.name!r} is on "
                f"{variable.space.name}. Use a solver for graphs or nonlinear programs"
            )
    for term in problem.terms.values():
        if not isinstance(term.loss, L2):
            raise FormError(f"{term.what} has the loss {term.loss!r}, which no quadratic program can hold")
        if not template_of(term).affine:
            raise NotAffineError(
                f"{term.what} is not affine in its variables, so the problem is no quadratic program; use solver="
                "'gauss-newton' or 'ipopt', or state the residual affinely"
            )


def data_speeds(problem: Problem) -> dict[str, Speed]:
    """Speed of every datum of an affine problem, by name."""
    speeds: dict[str, Speed] = {name: "vector" for name in problem.inputs}
    read, weighs = set(), set()
    pairs: list[tuple[str, str]] = []
    for term in problem.terms.values():
        template = template_of(term)
        names = [slot.source.name for slot in term.data]
        read.update(names)
        for name, hard in zip(names, template.nonlinear_data, strict=True):
            if hard:
                speeds[name] = "matrix"
        pairs += [(names[i], names[j]) for i, j in template.products]
        for numbers in (term.noise.value if term.noise else None, term.active):
            if isinstance(numbers, DataSlot):
                weighs.add(numbers.source.name)
    for a, b in pairs:
        if "matrix" not in (speeds[a], speeds[b]):
            rank = {name: (problem.inputs[name].of is not None, len(problem.inputs[name].shape)) for name in (a, b)}
            speeds[a if rank[a] > rank[b] else b] = "matrix"
    for name in weighs:
        speeds[name] = "matrix" if name in read else "weight"
    return speeds


class _AffineCode:
    """Coefficients (J, E, c) of a template as array code of its matrix data."""

    def __init__(self, template: Template, matrix: tuple[bool, ...]) -> None:
        vectors = [d for d, m in zip(template.data, matrix, strict=True) if not m]
        slow = [d for d, m in zip(template.data, matrix, strict=True) if m]
        zeros = [*template.x, *vectors]
        v = ca.vertcat(*vectors) if vectors else ca.SX(0, 1)
        E = ca.jacobian(template.residual, v)
        c = ca.substitute([template.residual, template.jacobian, E], zeros, [ca.SX.zeros(z.shape) for z in zeros])
        self.dim, self.width, self.reads = template.dim, template.width, v.shape[0]
        inputs = ca.vertcat(*slow) if slow else ca.SX(0, 1)
        self.constant = not slow
        self.code = ArrayCode(inputs, ca.vertcat(ca.vec(ca.densify(c[1])), ca.vec(ca.densify(c[2])), c[0]))

    def __call__(self, numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """J (m, dim, width), E (m, dim, reads), c (m, dim) with m = 1 where nothing depends on matrix data."""
        m = 1 if self.constant else count
        out = self.code(list(numbers.T), m)
        a, b = self.dim * self.width, self.dim * self.reads
        J = out[:a].reshape(self.width, self.dim, m).transpose(2, 1, 0)
        E = out[a : a + b].reshape(self.reads, self.dim, m).transpose(2, 1, 0)
        return J, E, out[a + b :].T


@lru_cache(maxsize=1024)
def _affine_code(template: Template, matrix: tuple[bool, ...]) -> _AffineCode:
    return _AffineCode(template, matrix)


@dataclass(eq=False)
class Rows:
    """Affine rows of one term: ``R z + E d + c``, (count * dim) rows, instance after instance.

    `broken` marks instances (count,) whose coefficients are not finite for the matrix data given; they read as zero.
    """

    layout: TermLayout
    dim: int
    R: Matrix
    E: Matrix
    c: np.ndarray
    broken: np.ndarray | None = None

    def require_finite(self, on: np.ndarray | None) -> None:
        """Raises DataError where an instance that is on (None: all) is broken."""
        if self.broken is None:
            return
        bad = self.broken if on is None else self.broken & on
        if bad.any():
            raise DataError(
                f"{self.layout.term.what}: instance {int(np.flatnonzero(bad)[0])} has coefficients that are not finite "
                "for the data given"
            )

    @property
    def count(self) -> int:
        return self.layout.term.count


class AffineRows:
    """The rows of all terms for given matrix data, as dense arrays or, for large problems, sparse ones.

    Attributes:
        parts: of every term its layout, the code of its coefficients, and the positions (count, numbers) of the matrix
            data and of the vector data that its instances read.
    """

    def __init__(self, layout: Layout, speeds: dict[str, Speed], dense: bool) -> None:
        self.layout, self.dense = layout, dense
        self.parts = []
        for entry in layout.terms:
            template = template_of(entry.term)
            matrix = tuple(speeds[slot.source.name] == "matrix" for slot in entry.term.data)
            slow, fast = [], []
            for slot, is_matrix in zip(entry.term.data, matrix, strict=True):
                index = np.broadcast_to(layout.numbers(slot), (entry.term.count, slot.source.size))
                (slow if is_matrix else fast).append(index)
            empty = [np.zeros((entry.term.count, 0), np.intp)]
            self.parts.append(
                (entry, _affine_code(template, matrix), np.hstack(slow or empty), np.hstack(fast or empty))
            )
        self._constant: list[Rows | None] = [None] * len(self.parts)

    def evaluate(self, numbers: np.ndarray) -> list[Rows]:
        """Rows of every term, in the order of the problem. Raises DataError for an equality that is not finite."""
        out = []
        for k, (entry, code, slow, fast) in enumerate(self.parts):
            rows = self._constant[k]
            if rows is None:
                J, E, c = code(numbers[slow], entry.term.count)
                broken = ~(np.isfinite(J).all((1, 2)) & np.isfinite(E).all((1, 2)) & np.isfinite(c).all(1))
                if broken.any():
                    J, E, c = (np.where(broken.reshape(-1, *[1] * (a.ndim - 1)), 0.0, a) for a in (J, E, c))
                rows = Rows(
                    entry,
                    code.dim,
                    self._place(J, entry.columns, code.dim, self.layout.size),
                    self._place(E, fast, code.dim, self.layout.data_size),
                    np.broadcast_to(c, (entry.term.count, code.dim)).ravel(),
                    np.broadcast_to(broken, entry.term.count) if broken.any() else None,
                )
                if entry.term.kind == "equality":
                    rows.require_finite(None)
                if code.constant:
                    self._constant[k] = rows
            out.append(rows)
        return out

    def _place(self, values: np.ndarray, columns: np.ndarray, dim: int, size: int) -> Matrix:
        count, width = columns.shape
        values = np.broadcast_to(values, (count, dim, width))
        row = np.arange(count * dim).reshape(count, dim, 1)
        rows, cols = np.broadcast_to(row, values.shape).ravel(), np.broadcast_to(columns[:, None], values.shape).ravel()
        if self.dense:
            out = np.zeros((count * dim, size))
            np.add.at(out, (rows, cols), values.ravel())
            return out
        out = sp.coo_array((values.ravel(), (rows, cols)), shape=(count * dim, size)).tocsr()
        out.eliminate_zeros()
        return out


@dataclass(eq=False)
class Bounds:
    """Lower or upper bounds of inequality rows: constants plus vector data (index -1: none)."""

    constant: np.ndarray
    index: np.ndarray

    @classmethod
    def of(cls, layout: Layout, rows: list[Rows], key: str) -> Bounds:
        constants, indices = [np.zeros(0)], [np.zeros(0, np.intp)]
        for r in rows:
            value = getattr(r.layout.term, key)
            if isinstance(value, DataSlot):
                index = layout.numbers(value)
                indices.append(np.broadcast_to(index, (r.count, r.dim)).ravel())
                constants.append(np.zeros(r.count * r.dim))
            else:
                constants.append(constant_rows(value, r.dim, r.count, r.layout.term.what).ravel())
                indices.append(np.full(r.count * r.dim, -1, np.intp))
        return cls(np.concatenate(constants), np.concatenate(indices))

    @property
    def used(self) -> np.ndarray:
        """Rows that have this bound."""
        return np.isfinite(self.constant) | (self.index >= 0)

    def __call__(self, numbers: np.ndarray) -> np.ndarray:
        if not self.index.size or self.index.max() < 0:
            return self.constant
        return np.where(self.index >= 0, numbers[self.index], self.constant)


def information_of(rows: Rows, store: DataStore, on: np.ndarray | None) -> np.ndarray:
    """Information matrices (count, dim, dim) of a cost term, zero for instances that are off."""
    term = rows.layout.term
    assert term.noise is not None
    value = noise_numbers(term, rows.dim, store)
    W = information_matrix(term.noise.kind, value, rows.dim, term.count, term.what)
    if on is None:
        return W
    return np.broadcast_to(W, (term.count, rows.dim, rows.dim)) * on[:, None, None]


def weigh(rows: Rows, W: np.ndarray) -> Matrix:
    """``W R`` for block-diagonal W given as (1 or count, dim, dim)."""
    if isinstance(rows.R, np.ndarray):
        return (W @ rows.R.reshape(rows.count, rows.dim, -1)).reshape(rows.R.shape)
    return block_diagonal(W, rows.count) @ rows.R


def block_diagonal(W: np.ndarray, count: int) -> sp.csr_array:
    W = np.ascontiguousarray(np.broadcast_to(W, (count, *W.shape[1:])))
    size = count * W.shape[1]
    return sp.bsr_array((W, np.arange(count), np.arange(count + 1)), shape=(size, size)).tocsr()
