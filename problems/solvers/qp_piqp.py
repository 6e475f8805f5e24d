"""PIQP: proximal interior point, dense and sparse; few iterations, no warm start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, RowBlock, Rows, Warm, interior_tolerance, native

_STATUS = {
    "PIQP_SOLVED": Status.SOLVED,
    "PIQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "PIQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "PIQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
    "PIQP_NUMERICS": Status.INACCURATE,
}
# Measured: the sparse implementation is the faster one wherever P and A have zeros.
_DENSE_FILLING = 0.5


@dataclass(frozen=True)
class PIQPSettings:
    """Settings of `PIQP`; None keeps the library's default or what follows from `Options`.

    Attributes:
        backend: which of the library's two implementations; "auto" chooses by the filling of P and A.
        eps_abs: absolute tolerance of primal and dual residual.
        eps_rel: relative tolerance of the same.
        check_duality_gap: whether the gap counts for termination.
        eps_duality_gap_abs: absolute tolerance of the gap.
        eps_duality_gap_rel: relative tolerance of the gap.
        eps_primal_inf: tolerance of a certificate of infeasibility.
        eps_dual_inf: tolerance of a certificate of unboundedness.
        infeasibility_threshold: share of the proximal term from which infeasibility is looked for.
        max_iter: iterations of one solve (the library has no time limit).
        rho_init: initial primal proximal weight.
        delta_init: initial dual proximal weight.
        reg_lower_limit: smallest proximal weight.
        preconditioner_iter: passes of the scaling of rows and columns.
        preconditioner_scale_cost: whether the cost is scaled too.
        iterative_refinement_always_enabled: refine every linear solve.
        tau: share of the way to the boundary taken per step.
    """

    backend: Literal["auto", "dense", "sparse"] = "auto"
    eps_abs: float | None = None
    eps_rel: float | None = None
    check_duality_gap: bool | None = None
    eps_duality_gap_abs: float | None = None
    eps_duality_gap_rel: float | None = None
    eps_primal_inf: float | None = None
    eps_dual_inf: float | None = None
    infeasibility_threshold: float | None = None
    max_iter: int | None = None
    rho_init: float | None = None
    delta_init: float | None = None
    reg_lower_limit: float | None = None
    preconditioner_iter: int | None = None
    preconditioner_scale_cost: bool | None = None
    iterative_refinement_always_enabled: bool | None = None
    tau: float | None = None


class PIQP(Backend):
    """QP backend ``piqp``.

    The library has no interior for a row with ``l == u`` outside its equalities, and forgets a row both of whose bounds
    were infinite once. So rows are sorted by kind, and a new object is built when a row changes its kind.
    """

    name: ClassVar[str] = "piqp"
    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = False
    extra: ClassVar[str | None] = "solvers"
    package: ClassVar[str] = "piqp"
    module: ClassVar[str] = "piqp"
    settings_type: ClassVar[type[PIQPSettings]] = PIQPSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, common = self._library, self._options
        self._rows = rows = Rows.of(l, u)
        kind, numbers = self._settings.backend, self._P.nnz + self._A.nnz
        filled = numbers > _DENSE_FILLING * self._n * (self._n + self._m)
        self._is_dense = kind == "dense" or (kind == "auto" and filled)
        self._blocks = RowBlock(self._A, [(rows.equal, 1.0)]), RowBlock(self._A, [(rows.between, 1.0)])
        solver = lib.DenseSolver() if self._is_dense else lib.SparseSolver()
        tolerance = interior_tolerance(common.tolerance)
        values = native(
            self._settings,
            eps_abs=tolerance,
            eps_rel=tolerance,
            eps_duality_gap_abs=tolerance,
            eps_duality_gap_rel=tolerance,
            max_iter=common.iteration_limit,
        )
        values.pop("backend")
        for name, value in values.items():
            setattr(solver.settings, name, value)
        solver.setup(*self._arguments(q, l, u, self._matrices()))
        self._solver = solver

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        rows = self._rows
        if Rows.key_of(l, u) != rows.key:
            self._build(q, l, u)
            rows = self._rows
        else:
            self._solver.update(*self._arguments(q, l, u, (None, None, None)))
        claim = self._solver.solve().name
        found = self._solver.result
        status = _STATUS.get(claim, Status.FAILED)
        if status in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED):
            return QPResult(None, None, status, found.info.iter, claim)
        y = np.zeros(self._m)
        if len(rows.equal):
            y[rows.equal] = found.y
        if len(rows.between):
            y[rows.between] = found.z_u - found.z_l
        return QPResult(found.x.copy(), y, status, found.info.iter, claim)

    def _renew(self) -> None:
        for block in self._blocks:
            block.refill(self._A)
        P, A, G = self._matrices()
        self._solver.update(P, None, A, None, G)

    def _matrices(self) -> tuple[Any, Any, Any]:
        P, A, G = self._P, *(block.matrix for block in self._blocks)
        if self._is_dense:
            P, A, G = (np.asfortranarray(matrix.toarray()) for matrix in (P, A, G))
        return P, A if len(self._rows.equal) else None, G if len(self._rows.between) else None

    def _arguments(
        self, q: np.ndarray, l: np.ndarray, u: np.ndarray, matrices: tuple[Any, Any, Any]
    ) -> tuple[Any, ...]:
        P, A, G = matrices
        equal, between = self._rows.equal, self._rows.between
        b = l[equal] if len(equal) else None
        bounds = (l[between], u[between]) if len(between) else (None, None)
        return P, q, A, b, G, *bounds
