"""Clarabel: interior point for conic problems; accurate, no warm start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, RowBlock, Rows, UpperTriangle, Warm, interior_tolerance, native

_STATUS = {
    "Solved": Status.SOLVED,
    "AlmostSolved": Status.INACCURATE,
    "InsufficientProgress": Status.INACCURATE,
    "PrimalInfeasible": Status.INFEASIBLE,
    "AlmostPrimalInfeasible": Status.INFEASIBLE,
    "DualInfeasible": Status.UNBOUNDED,
    "AlmostDualInfeasible": Status.UNBOUNDED,
    "MaxIterations": Status.ITERATION_LIMIT,
    "MaxTime": Status.TIME_LIMIT,
}

_ROUNDING = 1e-9


@dataclass(frozen=True)
class ClarabelSettings:
    """Settings of `Clarabel`; None keeps the library's default or what follows from `Options`.

    Attributes:
        tol_feas: tolerance of primal and dual residual.
        tol_gap_abs: absolute tolerance of the gap.
        tol_gap_rel: relative tolerance of the gap.
        tol_infeas_abs: absolute tolerance of a certificate of infeasibility.
        tol_infeas_rel: relative tolerance of the same.
        max_iter: iterations of one solve.
        time_limit: seconds of one solve.
        max_step_fraction: share of the way to the boundary taken per step.
        equilibrate_enable: scale rows and columns.
        equilibrate_max_iter: passes of that scaling.
        static_regularization_enable: regularize the linear system.
        iterative_refinement_enable: refine every linear solve.
        iterative_refinement_max_iter: refinement steps per linear solve.
        direct_solve_method: factorization of the linear system.
        max_threads: threads of the factorization, 0 for the library's choice.
    """

    tol_feas: float | None = None
    tol_gap_abs: float | None = None
    tol_gap_rel: float | None = None
    tol_infeas_abs: float | None = None
    tol_infeas_rel: float | None = None
    max_iter: int | None = None
    time_limit: float | None = None
    max_step_fraction: float | None = None
    equilibrate_enable: bool | None = None
    equilibrate_max_iter: int | None = None
    static_regularization_enable: bool | None = None
    iterative_refinement_enable: bool | None = None
    iterative_refinement_max_iter: int | None = None
    direct_solve_method: Literal["auto", "qdldl", "faer", "pardiso-mkl", "pardiso-panua"] | None = None
    max_threads: int | None = None


class Clarabel(Backend):
    """QP backend ``clarabel``.

    Rows go in as the cones ``A_eq x + s = b, s = 0`` and ``[A_u; -A_l] x + s = [u; -l], s >= 0`` over the finite
    bounds; a new object is built when a row changes between equal, one-sided, two-sided and free.
    """

    name: ClassVar[str] = "clarabel"
    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = False
    extra: ClassVar[str | None] = "solvers"
    package: ClassVar[str] = "clarabel"
    module: ClassVar[str] = "clarabel"
    settings_type: ClassVar[type[ClarabelSettings]] = ClarabelSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, common = self._library, self._options
        self._rows = rows = Rows.of(l, u)
        settings = lib.DefaultSettings()
        tolerance = interior_tolerance(common.tolerance)
        values = native(
            self._settings,
            # A full step leaves rounding alone of the residuals of the rows; the library takes rounding above its
            # tolerance for divergence and stops far from the optimum.
            tol_feas=max(tolerance, _ROUNDING),
            tol_gap_abs=tolerance,
            tol_gap_rel=tolerance,
            max_iter=common.iteration_limit,
            time_limit=common.time_limit,
            verbose=False,
            presolve_enable=False,  # it drops rows, and forbids updates
        )
        for name, value in values.items():
            setattr(settings, name, value)
        self._upper = UpperTriangle(self._P)
        self._block = RowBlock(self._A, [(rows.equal, 1.0), (rows.upper, 1.0), (rows.lower, -1.0)])
        sides = len(rows.upper) + len(rows.lower)
        cones = [lib.ZeroConeT(len(rows.equal))] if len(rows.equal) else []
        cones += [lib.NonnegativeConeT(sides)] if sides else []
        self._bounds = np.empty(len(rows.equal) + sides)
        self._solver = lib.DefaultSolver(self._upper.matrix, q, self._block.matrix, self._filled(l, u), cones, settings)

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        if Rows.key_of(l, u) != self._rows.key:
            self._build(q, l, u)
        else:
            self._solver.update(q=q, b=self._filled(l, u))
        found = self._solver.solve()
        claim = str(found.status)
        status = _STATUS.get(claim, Status.FAILED)
        if status in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED):
            return QPResult(None, None, status, found.iterations, claim)
        rows, z = self._rows, np.array(found.z)
        equalities = len(rows.equal)
        uppers = equalities + len(rows.upper)
        y = np.zeros(self._m)
        y[rows.equal] = z[:equalities]
        y[rows.upper] = z[equalities:uppers]
        y[rows.lower] -= z[uppers:]
        return QPResult(np.array(found.x), y, status, found.iterations, claim)

    def _renew(self) -> None:
        self._upper.refill(self._P)
        self._block.refill(self._A)
        self._solver.update(P=self._upper.matrix.data, A=self._block.matrix.data)

    def _filled(self, l: np.ndarray, u: np.ndarray) -> np.ndarray:
        rows, b = self._rows, self._bounds
        equalities = len(rows.equal)
        uppers = equalities + len(rows.upper)
        b[:equalities] = u[rows.equal]
        b[equalities:uppers] = u[rows.upper]
        np.negative(l[rows.lower], out=b[uppers:])
        return b
