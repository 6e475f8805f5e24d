"""ProxQP: proximal augmented Lagrangian, dense and sparse; accurate, also where P is singular or rows depend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, RowBlock, Warm, native

_STATUS = {
    "PROXQP_SOLVED": Status.SOLVED,
    "PROXQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "PROXQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "PROXQP_SOLVED_CLOSEST_PRIMAL_FEASIBLE": Status.INFEASIBLE,
    "PROXQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
}
# A solvable problem takes a few dozen. The library has no time limit, and its own limits, 10 000 outer and 1 500 inner
# iterations, take minutes on infeasible windows of four unknowns.
_ITERATIONS, _INNER_ITERATIONS = 250, 50
# Measured: the dense implementation is the faster one up to windows of some 80 unknowns, or if P and A are filled.
_DENSE_SIZE = 10_000
_DENSE_FILLING = 0.3


@dataclass(frozen=True)
class ProxQPSettings:
    """Settings of `ProxQP`; None keeps the library's default or what follows from `Options`.

    Attributes:
        backend: which of the library's two implementations; "auto" chooses by size and filling.
        eps_abs: absolute tolerance of primal and dual residual.
        eps_rel: relative tolerance of the same.
        check_duality_gap: whether the gap counts for termination.
        eps_duality_gap_abs: absolute tolerance of the gap.
        eps_duality_gap_rel: relative tolerance of the gap.
        eps_primal_inf: tolerance of a certificate of infeasibility.
        eps_dual_inf: tolerance of a certificate of unboundedness.
        max_iter: outer iterations of one solve, 250 by default (the library has no time limit).
        max_iter_in: inner iterations per outer iteration, 50 by default.
        default_rho: initial primal proximal weight.
        default_mu_eq: initial penalty of equality rows.
        default_mu_in: initial penalty of inequality rows.
        mu_update_factor: factor between two penalties.
        nb_iterative_refinement: refinement steps per linear solve.
    """

    backend: Literal["auto", "dense", "sparse"] = "auto"
    eps_abs: float | None = None
    eps_rel: float | None = None
    check_duality_gap: bool | None = None
    eps_duality_gap_abs: float | None = None
    eps_duality_gap_rel: float | None = None
    eps_primal_inf: float | None = None
    eps_dual_inf: float | None = None
    max_iter: int | None = None
    max_iter_in: int | None = None
    default_rho: float | None = None
    default_mu_eq: float | None = None
    default_mu_in: float | None = None
    mu_update_factor: float | None = None
    nb_iterative_refinement: int | None = None


class ProxQP(Backend):
    """QP backend ``proxqp``.

    Warm starts are given by values. The library's own "with previous result" mode is not used: set before the first
    solve it ends the process, set later it can claim infeasibility of a solvable problem.
    """

    name: ClassVar[str] = "proxqp"
    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "proxsuite"
    module: ClassVar[str] = "proxsuite"
    settings_type: ClassVar[type[ProxQPSettings]] = ProxQPSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, common = self._library.proxqp, self._options
        equal = l == u
        self._key = equal.tobytes()
        self._equal, self._between = np.flatnonzero(equal), np.flatnonzero(~equal)
        kind, numbers = self._settings.backend, self._P.nnz + self._A.nnz
        size = self._n * (self._n + self._m)
        few = size < _DENSE_SIZE or numbers > _DENSE_FILLING * size
        self._is_dense = kind == "dense" or (kind == "auto" and few)
        self._blocks = RowBlock(self._A, [(self._equal, 1.0)]), RowBlock(self._A, [(self._between, 1.0)])
        module = lib.dense if self._is_dense else lib.sparse
        qp = module.QP(self._n, len(self._equal), len(self._between))
        values = native(
            self._settings,
            eps_abs=0.1 * common.tolerance,
            eps_rel=0.1 * common.tolerance,
            check_duality_gap=True,
            eps_duality_gap_abs=0.1 * common.tolerance,
            eps_duality_gap_rel=0.1 * common.tolerance,
            max_iter=common.iteration_limit or _ITERATIONS,
            max_iter_in=_INNER_ITERATIONS,
        )
        values.pop("backend")
        for name, value in values.items():
            setattr(qp.settings, name, value)
        P, A, C = self._matrices()
        qp.init(P, q, A, l[self._equal], C, l[self._between], u[self._between])
        self._qp = qp

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        if (l == u).tobytes() != self._key:
            self._build(q, l, u)
        qp, equal, between = self._qp, self._equal, self._between
        if len(equal):
            qp.update(None, q, None, l[equal], None, l[between], u[between])
        else:
            qp.update(None, q, None, None, None, l, u)
        guess = self._library.proxqp.InitialGuess
        if warm is None:
            qp.settings.initial_guess = guess.NO_INITIAL_GUESS
            qp.solve()
        else:
            qp.settings.initial_guess = guess.WARM_START
            x, y = warm
            qp.solve(x, y[equal], y[between])
        found = qp.results
        claim = found.info.status.name
        status = _STATUS.get(claim, Status.FAILED)
        iterations = found.info.iter_ext
        if status in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED):
            return QPResult(None, None, status, iterations, claim)
        if len(equal):
            y = np.empty(self._m)
            y[equal] = found.y
            y[between] = found.z
        else:
            y = found.z.copy()
        return QPResult(found.x.copy(), y, status, iterations, claim)

    def _renew(self) -> None:
        for block in self._blocks:
            block.refill(self._A)
        P, A, C = self._matrices()
        self._qp.update(P, None, A, None, C, None, None, update_preconditioner=True)

    def _matrices(self) -> tuple[Any, Any, Any]:
        A, C = (block.matrix for block in self._blocks)
        if self._is_dense:
            return self._P.toarray(), A.toarray(), C.toarray()
        return self._P, A, C
