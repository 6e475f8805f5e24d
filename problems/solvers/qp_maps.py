"""The answer of a quadratic program while no inequality is active: one affine map of the vector data.

``[z; rows - upper; lower - rows] = T d + t`` gives all unknowns and all row violations by one product. `DenseMap` holds
T; `SparseMap` (large problems) keeps the factorized KKT system instead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg.lapack import dpotrf, dpotrs

from problems.errors import UnobservableError
from problems.forms.layout import DataStore
from problems.forms.quadratic import QuadraticProgram, Reduced

INDEPENDENT = 1e-13  # share of a Hessian diagonal left after elimination, below which a direction counts as free


class DenseMap:
    """See the module; also P, Q, q0 of the quadratic program in the coordinates of `reduced`."""

    def __init__(
        self, program: QuadraticProgram, reduced: Reduced, store: DataStore, flags: dict[str, Any], pattern: bytes
    ) -> None:
        self.reduced, self.flags = reduced, flags
        self.P, self.Q, self.q0 = reduced.weighted(store, flags, pattern)
        inner = reduced.inner
        if inner is None:
            H, G, g = self.P, self.Q, self.q0
        else:
            NP = inner.Z.T @ self.P
            H, G, g = NP @ inner.Z, inner.Z.T @ self.Q + NP @ inner.Y, inner.Z.T @ self.q0 + NP @ inner.z0
        self.free = _free_direction(H)
        if self.free is not None:
            self.free = reduced.map.Z @ (self.free if inner is None else inner.Z @ self.free)
            return
        factor, _ = dpotrf(H, lower=1)
        K, _ = dpotrs(factor, np.column_stack([G, g]), lower=1)
        V, v = -K[:, :-1], -K[:, -1]
        if inner is not None:
            V, v = inner.Z @ V + inner.Y, inner.Z @ v + inner.z0
        outer = reduced.map
        blocks, constants = [outer.Z @ V + outer.Y], [outer.Z @ v + outer.z0]
        m = reduced.equalities
        if reduced.bounded:
            G, g = reduced.A[m:] @ V + reduced.E[m:], reduced.A[m:] @ v + reduced.c[m:]
            off = reduced.off_rows(flags)
            for bound, sign in ((reduced.upper, 1.0), (reduced.lower, -1.0)):
                used = bound.used if off is None else bound.used & ~off
                rows, constant = sign * G[used], sign * (g[used] - bound.constant[used])
                index = bound.index[used]
                by_data = np.flatnonzero(index >= 0)
                rows[by_data, index[by_data]] -= sign
                blocks.append(rows)
                constants.append(constant)
        self.T = np.ascontiguousarray(np.vstack(blocks))
        self.t = np.concatenate(constants)
        self.size = program.layout.size

    def __call__(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All unknowns (n,) and the violations of all bounds (<= 0 where they hold)."""
        out = self.T @ numbers
        out += self.t
        return out[: self.size], out[self.size :]

    def many(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for many rows of numbers (count, data): (count, n) and (count, bounds)."""
        out = numbers @ self.T.T
        out += self.t
        return out[:, : self.size], out[:, self.size :]


def _free_direction(H: np.ndarray) -> np.ndarray | None:
    """A direction that costs nothing, or None where H is positive definite (scale-free test)."""
    factor, info = dpotrf(H, lower=1)
    if info == 0:
        left = np.diagonal(factor) ** 2
        if (left > INDEPENDENT * np.diagonal(H)).all():
            return None
    scale = np.sqrt(np.maximum(np.diagonal(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    if np.isfinite(values).all() and values[0] > 1e-12:
        return None
    return vectors[:, 0] / scale


class SparseMap:
    """The same through a sparse factorization of the KKT system, for large problems."""

    def __init__(
        self, program: QuadraticProgram, reduced: Reduced, store: DataStore, flags: dict[str, Any], pattern: bytes
    ) -> None:
        self.reduced, self.flags = reduced, flags
        self.P, self.Q, self.q0 = reduced.weighted(store, flags, pattern)
        m, n = reduced.equalities, reduced.size
        A = reduced.A[:m]
        kkt = sp.block_array([[self.P, A.T], [A, None]], format="csc") if m else sp.csc_array(self.P)
        self.free = None
        try:
            self._factor = spla.splu(kkt, permc_spec="MMD_AT_PLUS_A" if not m else "COLAMD")
            pivots = np.abs(self._factor.U.diagonal())
            if not m and (pivots.min() <= INDEPENDENT * pivots.max() ** 0 * np.abs(kkt.diagonal()).min()):
                self.free = np.zeros(n)
        except RuntimeError:
            self.free = np.zeros(n)
        if self.free is not None:
            self.free[int(np.argmin(np.abs(self.P.diagonal())))] = 1.0
            self.free = reduced.map.Z @ self.free

    def __call__(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        reduced = self.reduced
        m = reduced.equalities
        q = self.Q @ numbers + self.q0
        shift = reduced.E @ numbers + reduced.c
        v = self._factor.solve(np.concatenate([-q, -shift[:m]]))[: reduced.size]
        z = reduced.map.Z @ v + reduced.map.Y @ numbers + reduced.map.z0
        l, u = reduced.bounds(numbers, self.flags)
        rows = reduced.A[m:] @ v
        return z, np.concatenate([rows - u[m:], l[m:] - rows])

    def many(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for many rows of numbers."""
        answers = [self(row) for row in numbers]
        return np.array([z for z, _ in answers]), np.array([excess for _, excess in answers])


def require_observable(program: QuadraticProgram, free: np.ndarray) -> None:
    """Raises UnobservableError naming the unknowns that the costs leave free."""
    share = np.abs(free) / max(np.abs(free).max(), 1e-300)
    names = []
    for name, variable in program.problem.unknowns.items():
        start = program.layout.start[name]
        part = share[start : start + variable.count * variable.space.dim].reshape(variable.count, -1)
        rows = np.flatnonzero((part > 1e-3).any(axis=1))
        if rows.size:
            names.append(f"{name}[{rows[0]}]" + (f" and {rows.size - 1} more" if rows.size > 1 else ""))
    raise UnobservableError(
        f"the costs of problem {program.problem.name!r} do not determine {', '.join(names) or 'all unknowns'}; add a "
        "prior or a measurement that sees them"
    )
