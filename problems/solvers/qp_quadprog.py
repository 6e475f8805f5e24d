"""quadprog: dual active-set method of Goldfarb and Idnani for small dense problems (licence: GPL, an extra)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from problems.errors import FormError
from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, Rows, Warm, positive_definite


@dataclass(frozen=True)
class QuadprogSettings:
    """quadprog has no settings: it ends at an exact vertex, without tolerance, time or iteration limit."""


class Quadprog(Backend):
    """QP backend ``quadprog``.

    The library keeps no object. What it would redo at every call is done once: the inverse Cholesky factor of P and the
    matrix of one-sided rows. A singular P is made definite on the equality rows (`positive_definite`).

    Raises:
        FormError: P is not positive definite on the equality rows.
    """

    name: ClassVar[str] = "quadprog"
    dense: ClassVar[bool] = True
    warm_starts: ClassVar[bool] = False
    extra: ClassVar[str | None] = "gpl"
    package: ClassVar[str] = "quadprog"
    module: ClassVar[str] = "quadprog"
    settings_type: ClassVar[type[QuadprogSettings]] = QuadprogSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        A = self._A
        rows = Rows.of(l, u)
        hessian, self._weight = positive_definite(self._P, A, rows.equal)
        try:
            factor = np.linalg.cholesky(hessian)
        except np.linalg.LinAlgError as error:
            raise FormError(
                "solver quadprog takes quadratic programs whose P is positive definite, or is so on the equality rows; "
                "use piqp, proxqp or osqp"
            ) from error
        self._factor = np.ascontiguousarray(np.linalg.inv(factor).T), True
        self._arrange(rows)

    def _renew(self) -> None:
        # a factor that serves one solve only is the library's own work; a second solve has one made
        self._stale = bool(self._weight)
        self._factor = self._P, False
        self._rows = replace(self._rows, key=b"none")

    def _arrange(self, rows: Rows) -> None:
        A, self._rows = self._A, rows
        self._normals = np.ascontiguousarray(np.concatenate([A[rows.equal], A[rows.lower], -A[rows.upper]]).T)
        self._ends = len(rows.equal), len(rows.equal) + len(rows.lower)
        self._bounds = np.empty(self._normals.shape[1])

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        factor, factorized = self._factor
        if Rows.key_of(l, u) != self._rows.key and not factorized:
            self._arrange(Rows.of(l, u))
        elif Rows.key_of(l, u) != self._rows.key or not factorized:
            self._build(q, l, u)
            factor, factorized = self._factor
        rows, bounds, (equalities, lowers) = self._rows, self._bounds, self._ends
        bounds[:equalities] = l[rows.equal]
        bounds[equalities:lowers] = l[rows.lower]
        np.negative(u[rows.upper], out=bounds[lowers:])
        y = np.zeros(self._m)
        try:
            if not len(bounds):
                return QPResult(self._library.solve_qp(factor, -q, factorized=factorized)[0], y, Status.SOLVED)
            x, _, _, iterations, multipliers, _ = self._library.solve_qp(
                factor, -q, self._normals, bounds, equalities, factorized
            )
        except ValueError as error:
            if "inconsistent" in str(error):
                return QPResult(None, None, Status.INFEASIBLE, message=str(error))
            if factorized:
                raise
            self._build(q, l, u)
            return self._run(q, l, u, warm)
        y[rows.equal] = -multipliers[:equalities]
        if self._weight:
            y[rows.equal] += self._weight * u[rows.equal]
        y[rows.lower] = -multipliers[equalities:lowers]
        y[rows.upper] += multipliers[lowers:]
        return QPResult(x, y, Status.SOLVED, int(iterations[0]))
