"""OSQP: operator splitting for sparse problems of any size; robust, of moderate accuracy per second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, UpperTriangle, Warm, native

_STATUS = {
    1: Status.SOLVED,
    2: Status.INACCURATE,
    3: Status.INFEASIBLE,
    4: Status.INFEASIBLE,
    5: Status.UNBOUNDED,
    6: Status.UNBOUNDED,
    7: Status.ITERATION_LIMIT,
    8: Status.TIME_LIMIT,
}
_INFINITY = 1e30


@dataclass(frozen=True)
class OSQPSettings:
    """Settings of `OSQP`; None keeps the library's default or what follows from `Options`.

    Attributes:
        eps_abs: absolute tolerance of primal residual, dual residual and gap.
        eps_rel: relative tolerance of the same.
        eps_prim_inf: tolerance of a certificate of infeasibility.
        eps_dual_inf: tolerance of a certificate of unboundedness.
        max_iter: iterations of one solve.
        time_limit: seconds of one solve.
        check_termination: iterations between two checks.
        check_dualgap: whether the gap counts for termination.
        rho: initial step size.
        sigma: regularization of the linear system.
        alpha: over-relaxation, between 0 and 2.
        adaptive_rho: whether the step size adapts.
        adaptive_rho_interval: iterations between two adaptations.
        adaptive_rho_tolerance: factor by which the step size must change to be worth a factorization.
        scaling: passes of the scaling of rows and columns, 0 for none.
        scaled_termination: whether the tolerances hold for the scaled problem.
        polishing: solve the equality problem of the guessed active rows at the end. The library announces on standard
            output when no row is active.
        delta: regularization of that problem.
        polish_refine_iter: refinement steps of that problem.
    """

    eps_abs: float | None = None
    eps_rel: float | None = None
    eps_prim_inf: float | None = None
    eps_dual_inf: float | None = None
    max_iter: int | None = None
    time_limit: float | None = None
    check_termination: int | None = None
    check_dualgap: bool | None = None
    rho: float | None = None
    sigma: float | None = None
    alpha: float | None = None
    adaptive_rho: bool | None = None
    adaptive_rho_interval: int | None = None
    adaptive_rho_tolerance: float | None = None
    scaling: int | None = None
    scaled_termination: bool | None = None
    polishing: bool | None = None
    delta: float | None = None
    polish_refine_iter: int | None = None


class OSQP(Backend):
    """QP backend ``osqp``.

    Works on the solver object below `osqp.OSQP`, whose `solve` copies every statistic into Python objects at each call.
    """

    name: ClassVar[str] = "osqp"
    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "osqp"
    module: ClassVar[str] = "osqp.ext_builtin"
    settings_type: ClassVar[type[OSQPSettings]] = OSQPSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, common, n, m = self._library, self._options, self._n, self._m
        settings = lib.OSQPSettings()
        lib.osqp_set_default_settings(settings)
        # The library allows eps_abs + eps_rel * size where we mean tolerance * max(1, size).
        values = native(
            self._settings,
            eps_abs=0.5 * common.tolerance,
            eps_rel=0.5 * common.tolerance,
            time_limit=common.time_limit,
            max_iter=common.iteration_limit,
            verbose=False,
            **self._fitting(),
        )
        for name, value in values.items():
            setattr(settings, name, value)
        self._rho = settings.rho
        self._upper = UpperTriangle(self._P)
        self._lower_buffer, self._upper_buffer = np.empty(m), np.empty(m)
        self._origin = np.zeros(n), np.zeros(m)
        l, u = self._clipped(l, u)
        self._solver = lib.OSQPSolver(lib.CSC(self._upper.matrix), q, lib.CSC(self._A), l, u, m, n, settings)

    def _fitting(self) -> dict[str, float]:
        """The library's own scaling off where it does harm.

        It scales the cost by q, which at a point far from the origin is large: P becomes small beside the
        regularization sigma. Without rows, thousands of steps of a millionth of the way follow. With rows they restrain
        it, unless weights differ much; and then ours has been there already, and a direction of little curvature is
        not yet one along which the cost falls for ever.
        """
        if not self._m:
            return {"scaling": 0, "alpha": 1.0}
        return {"scaling": 0, "eps_dual_inf": 1e-12} if self._scaling is not None else {}

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        solver = self._solver
        l, u = self._clipped(l, u)
        if solver.update_data_vec(q, l, u):
            raise ValueError("the library refused q, l or u")
        if warm is None:
            # The step size adapted to earlier problems would stay.
            solver.update_rho(self._rho)
            solver.warm_start(*self._origin)
        elif warm[1] is not self._last_y:
            solver.warm_start(*warm)
        solver.solve()
        info, solution = solver.info, solver.solution
        status = _STATUS.get(info.status_val, Status.FAILED)
        if status in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED):
            return QPResult(None, None, status, info.iter, info.status)
        return QPResult(solution.x, solution.y, status, info.iter, info.status)

    def _renew(self) -> None:
        self._upper.refill(self._P)
        self._stale = bool(self._solver.update_data_mat(self._upper.matrix.data, None, self._A.data, None))

    def _clipped(self, l: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # A real infinity in a row makes the library's gap NaN: it then runs into the iteration limit.
        np.maximum(l, -_INFINITY, out=self._lower_buffer)
        np.minimum(u, _INFINITY, out=self._upper_buffer)
        return self._lower_buffer, self._upper_buffer
