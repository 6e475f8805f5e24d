"""QP solvers inside CasADi: qpOASES and QRQP (active set), HPIPM (interior point for problems in stages)."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from problems.errors import FormError
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.qp_support import Backend, Warm, checked_settings, native

_LIMITED = "SOLVER_RET_LIMITED"


class _Conic(Backend):
    """A plugin of `casadi.conic`, called through a buffer: no CasADi matrix is made per solve."""

    dense: ClassVar[bool] = False
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "casadi"
    module: ClassVar[str] = "casadi"

    def _plugin_options(self) -> dict[str, Any]:
        raise NotImplementedError

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        lib, n, m = self._library, self._n, self._m
        P, A = self._P, self._A
        structure = {"h": _sparsity(lib, P), "a": _sparsity(lib, A)}
        # Some plugins announce themselves on standard output.
        with contextlib.redirect_stdout(io.StringIO()):
            function = lib.conic("qp", self.name, structure, {"error_on_fail": False, **self._plugin_options()})
            self._buffer, self._evaluate = function.buffer()
        self._function = function
        self._h, self._a = P.data.copy(), A.data.copy()
        self._q, self._l, self._u = np.empty(n), np.empty(m), np.empty(m)
        self._x0, self._y0 = np.zeros(n), np.zeros(m)
        free, zeros = np.full(n, np.inf), np.zeros(n)
        # The buffer keeps pointers only.
        self._inputs = (self._h, self._q, self._a, self._l, self._u, -free, free, self._x0, zeros, self._y0)
        for i, array in enumerate(self._inputs):
            self._buffer.set_arg(i, array.data)
        self._unused = np.empty(1), np.empty(n)

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        self._q[:] = q
        self._l[:] = l
        self._u[:] = u
        if self.warm_starts:
            self._x0[:], self._y0[:] = (0.0, 0.0) if warm is None else warm
        x, y = np.full(self._n, np.nan), np.full(self._m, np.nan)
        # Some plugins move the pointers to the results, so these are set for every call.
        for i, array in enumerate((x, self._unused[0], y, self._unused[1])):
            self._buffer.set_res(i, array.data)
        self._evaluate()
        stats = self._buffer.stats()
        iterations, message = int(stats.get("iter_count", 0)), str(stats["return_status"])
        if stats["success"]:
            return QPResult(x, y, Status.SOLVED, iterations, message)
        return self._failed(x, y, iterations, message, stats["unified_return_status"])

    def _failed(self, x: np.ndarray, y: np.ndarray, iterations: int, message: str, unified: str) -> QPResult:
        # After a failure qpOASES refuses every further problem.
        self._stale = True
        text = message.lower()
        if unified == _LIMITED:
            return QPResult(None, None, Status.ITERATION_LIMIT, iterations, message)
        if "infeasib" in text:
            return QPResult(None, None, Status.INFEASIBLE, iterations, message)
        if "unbounded" in text:
            return QPResult(None, None, Status.UNBOUNDED, iterations, message)
        return QPResult(None, None, Status.FAILED, iterations, message)

    def _renew(self) -> None:
        self._h[:] = self._P.data
        self._a[:] = self._A.data


@dataclass(frozen=True)
class QPOASESSettings:
    """Settings of `QPOASES`; None keeps the library's default or what follows from `Options`.

    Attributes:
        nWSR: changes of the working set in one solve.
        CPUtime: seconds of processor time of one solve.
        sparse: use the library's sparse matrices.
        hessian_type: what is known of P.
        terminationTolerance: relative distance to the end of the homotopy at which it stops.
        boundTolerance: rows whose bounds are closer than this are equalities.
        enableRegularisation: regularize a singular P.
        enableEqualities: keep equality rows in the working set.
        enableFarBounds: replace infinite bounds by far ones.
        enableFlippingBounds: let bounds flip on indefinite directions.
        enableRamping: perturb degenerate starts.
        numRefinementSteps: refinement steps per linear solve.
        numRegularisationSteps: regularization steps.
        epsRegularisation: size of the regularization.
    """

    nWSR: int | None = None
    CPUtime: float | None = None
    sparse: bool | None = None
    hessian_type: Literal["unknown", "posdef", "semidef", "indef", "zero", "identity"] | None = None
    terminationTolerance: float | None = None
    boundTolerance: float | None = None
    enableRegularisation: bool | None = None
    enableEqualities: bool | None = None
    enableFarBounds: bool | None = None
    enableFlippingBounds: bool | None = None
    enableRamping: bool | None = None
    numRefinementSteps: int | None = None
    numRegularisationSteps: int | None = None
    epsRegularisation: float | None = None


class QPOASES(_Conic):
    """QP backend ``qpoases``: follows the solution from the last problem to the new one.

    It always goes on from its own last problem, whatever `warm` says; CasADi offers neither a start from values nor a
    reset.
    """

    name: ClassVar[str] = "qpoases"
    warm_starts: ClassVar[bool] = True
    settings_type: ClassVar[type[QPOASESSettings]] = QPOASESSettings

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        # Without a feasible point it prints whatever its print level.
        with contextlib.redirect_stdout(io.StringIO()):
            return super()._run(q, l, u, warm)

    def _plugin_options(self) -> dict[str, Any]:
        common = self._options
        return native(self._settings, printLevel="none", nWSR=common.iteration_limit, CPUtime=common.time_limit)


@dataclass(frozen=True)
class QRQPSettings:
    """Settings of `QRQP`; None keeps the library's default or what follows from `Options`.

    Attributes:
        constr_viol_tol: violation of a row allowed.
        dual_inf_tol: dual residual allowed.
        max_iter: iterations of one solve (the library has no time limit).
        min_lam: multipliers below this start inactive.
    """

    constr_viol_tol: float | None = None
    dual_inf_tol: float | None = None
    max_iter: int | None = None
    min_lam: float | None = None


class QRQP(_Conic):
    """QP backend ``qrqp``: CasADi's own sparse active-set method; may cycle where many rows meet."""

    name: ClassVar[str] = "qrqp"
    warm_starts: ClassVar[bool] = True
    settings_type: ClassVar[type[QRQPSettings]] = QRQPSettings

    def _plugin_options(self) -> dict[str, Any]:
        common = self._options
        return native(
            self._settings,
            constr_viol_tol=0.5 * common.tolerance,
            dual_inf_tol=0.5 * common.tolerance,
            max_iter=common.iteration_limit,
            print_iter=False,
            print_header=False,
            print_info=False,
        )


@dataclass(frozen=True)
class HPIPMSettings:
    """Settings of `HPIPM`; None keeps the library's default or what follows from `Options`.

    Without N, nx, nu and ng there is one stage. Else the unknowns are ordered ``x_0, u_0, x_1, u_1, ..., x_N``, the
    rows ``dynamics_0, others_0, dynamics_1, ...`` with dynamics ``A_k x_k + B_k u_k - x_{k+1} = b_k``; P joins only
    unknowns of the same stage.

    Attributes:
        N: number of stages after the first.
        nx: states of each stage, N + 1 numbers.
        nu: controls of each stage, N + 1 numbers, the last one 0.
        ng: other rows of each stage, N + 1 numbers.
        mode: the library's trade of speed for robustness.
        iter_max: iterations of one solve (the library has no time limit).
        res_g_max: dual residual allowed.
        res_b_max: residual of the dynamics allowed.
        res_d_max: violation of other rows allowed.
        res_m_max: complementarity allowed.
        mu0: initial barrier weight.
        reg_prim: regularization of P.
        pred_corr: predictor-corrector steps (0 or 1).
        lam_min: lower limit of multipliers inside the method; has to be far below tolerance / inf.
        inf: what stands for an infinite bound.
    """

    N: int | None = None
    nx: tuple[int, ...] | None = None
    nu: tuple[int, ...] | None = None
    ng: tuple[int, ...] | None = None
    mode: Literal["speed_abs", "speed", "balance", "robust"] | None = None
    iter_max: int | None = None
    res_g_max: float | None = None
    res_b_max: float | None = None
    res_d_max: float | None = None
    res_m_max: float | None = None
    mu0: float | None = None
    reg_prim: float | None = None
    pred_corr: int | None = None
    lam_min: float | None = None
    inf: float | None = None


class HPIPM(_Conic):
    """QP backend ``hpipm``: any quadratic program as one dense stage, or in the stages that its settings state.

    Raises:
        FormError: the stages are given in part, or P and A do not have the structure they say.
    """

    name: ClassVar[str] = "hpipm"
    warm_starts: ClassVar[bool] = False
    settings_type: ClassVar[type[HPIPMSettings]] = HPIPMSettings

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None:
        settings = checked_settings(HPIPMSettings, options.extra, self.name)
        stages = {name: getattr(settings, name) for name in ("N", "nx", "nu", "ng")}
        missing = [name for name, value in stages.items() if value is None]
        if len(missing) == len(stages):
            one = {"N": 0, "nx": (P.shape[0],), "nu": (0,), "ng": (A.shape[0],)}
            options = replace(options, extra={**options.extra, **one})
        elif missing:
            raise FormError(
                "solver hpipm: stages are stated by the settings N, nx, nu and ng together, and "
                f"{', '.join(missing)} is missing; without any of them the program is one stage"
            )
        super().__init__(P, q, A, l, u, options)

    def _plugin_options(self) -> dict[str, Any]:
        common = self._options
        half = 0.5 * common.tolerance
        # An infinite bound takes part as this number, whose rounding the residual of bounds cannot get below.
        infinity = self._settings.inf or 1e8
        inner = native(
            self._settings,
            res_g_max=half,
            res_b_max=half,
            res_d_max=max(half, 4.0 * np.finfo(float).eps * infinity),
            res_m_max=half,
            lam_min=1e-25,
            iter_max=common.iteration_limit,
        )
        outer = {name: inner.pop(name) for name in ("N", "nx", "nu", "ng", "inf") if name in inner}
        return {**outer, "hpipm": inner}

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        try:
            super()._build(q, l, u)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise FormError(f"solver hpipm: P and A do not have the stages N, nx, nu, ng say: {reason}") from error

    def _failed(self, x: np.ndarray, y: np.ndarray, iterations: int, message: str, unified: str) -> QPResult:
        # The method stops at its limit with a point that is often good: the residuals tell.
        if message == "1":
            return QPResult(x, y, Status.ITERATION_LIMIT, iterations, "iteration limit reached")
        reasons = {"2": "step length too small", "3": "NaN in the iterates"}
        return QPResult(None, None, Status.FAILED, iterations, reasons.get(message, f"status {message}"))


def _sparsity(library: Any, matrix: Any) -> Any:
    return library.Sparsity(*matrix.shape, matrix.indptr.tolist(), matrix.indices.tolist())
