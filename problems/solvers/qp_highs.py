"""HiGHS: active-set method for sparse problems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, Warm, native

_STATUS = {
    "kOptimal": Status.SOLVED,
    "kInfeasible": Status.INFEASIBLE,
    "kUnbounded": Status.UNBOUNDED,
    "kUnboundedOrInfeasible": Status.INFEASIBLE,
    "kTimeLimit": Status.TIME_LIMIT,
    "kIterationLimit": Status.ITERATION_LIMIT,
}


@dataclass(frozen=True)
class HiGHSSettings:
    """Settings of `HiGHS`; None keeps the library's default or what follows from `Options`.

    Attributes:
        primal_feasibility_tolerance: violation of a row allowed, at least 1e-10.
        dual_feasibility_tolerance: dual residual allowed, at least 1e-10.
        qp_iteration_limit: iterations of one solve.
        qp_nullspace_limit: largest dimension of the null space of the active rows.
        qp_regularization_value: added to the diagonal of P; ours is proportional to the tolerance, since the library's
            own 1e-7 spoils the dual residual.
        time_limit: seconds of one solve.
        presolve: whether the library simplifies the problem first.
        threads: threads, 0 for the library's choice; one number per process, the library refuses a second one.
    """

    primal_feasibility_tolerance: float | None = None
    dual_feasibility_tolerance: float | None = None
    qp_iteration_limit: int | None = None
    qp_nullspace_limit: int | None = None
    qp_regularization_value: float | None = None
    time_limit: float | None = None
    presolve: Literal["off", "choose", "on"] | None = None
    threads: int | None = None


class HiGHS(Backend):
    """QP backend ``highs``."""

    name: ClassVar[str] = "highs"
    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = False
    extra: ClassVar[str | None] = "solvers"
    package: ClassVar[str] = "highspy"
    module: ClassVar[str] = "highspy"
    settings_type: ClassVar[type[HiGHSSettings]] = HiGHSSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        common = self._options
        solver = _quiet(self._library)()
        tolerance = max(0.1 * common.tolerance, 1e-10)
        values = native(
            self._settings,
            output_flag=False,
            primal_feasibility_tolerance=tolerance,
            dual_feasibility_tolerance=tolerance,
            qp_iteration_limit=common.iteration_limit,
            qp_regularization_value=1e-3 * common.tolerance,
            time_limit=common.time_limit,
        )
        for name, value in values.items():
            if solver.setOptionValue(name, value).name != "kOk":
                raise ValueError(f"the library refused {name} = {value!r}")
        self._time_limit = values["time_limit"]
        self._columns, self._row_numbers = np.arange(self._n, dtype=np.int32), np.arange(self._m, dtype=np.int32)
        self._solver = solver
        self._pass(q, l, u)

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        solver = self._solver
        solver.changeColsCost(self._n, self._columns, q)
        solver.changeRowsBounds(self._m, self._row_numbers, l, u)
        # The library's clock runs on from solve to solve.
        solver.setOptionValue("time_limit", solver.getRunTime() + self._time_limit)
        solver.run()
        claim = solver.getModelStatus().name
        status = _STATUS.get(claim, Status.FAILED)
        iterations = max(solver.getInfo().qp_iteration_count, 0)
        message = solver.modelStatusToString(solver.getModelStatus())
        if status in (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED):
            return QPResult(None, None, status, iterations, message)
        found = solver.getSolution()
        y = np.negative(found.row_dual) if self._m else np.empty(0)
        return QPResult(np.array(found.col_value), y, status, iterations, message)

    def _renew(self) -> None:
        free = np.full(self._m, np.inf)
        self._pass(np.zeros(self._n), -free, free)

    def _pass(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, n, m, A = self._library, self._n, self._m, self._A
        lp = lib.HighsLp()
        lp.num_col_, lp.num_row_ = n, m
        lp.col_cost_, lp.row_lower_, lp.row_upper_ = q, l, u
        lp.col_lower_, lp.col_upper_ = np.full(n, -np.inf), np.full(n, np.inf)
        matrix = lp.a_matrix_
        matrix.format_ = lib.MatrixFormat.kColwise
        matrix.num_col_, matrix.num_row_ = n, m
        matrix.start_, matrix.index_, matrix.value_ = A.indptr, A.indices, A.data
        hessian = lib.HighsHessian()
        lower = _lower_triangle(self._P)
        hessian.dim_, hessian.format_ = n, lib.HessianFormat.kTriangular
        hessian.start_, hessian.index_, hessian.value_ = lower.indptr, lower.indices, lower.data
        model = lib.HighsModel()
        model.lp_, model.hessian_ = lp, hessian
        if self._solver.passModel(model).name == "kError":
            raise ValueError("the library refused the matrices")


def _lower_triangle(P: Any) -> Any:
    from scipy.sparse import csc_array, tril

    return csc_array(tril(P, format="csc"))


def _quiet(library: Any) -> type[Any]:
    class Quiet(library.Highs):
        def enableCallbacks(self) -> None:
            """Enabling them prints the library's banner before output can be switched off; none is used here."""

    return Quiet
