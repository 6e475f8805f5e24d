"""QP solvers inside CasADi: qpOASES and QRQP (active set), HPIPM (interior point for problems in stages)."""

from __future__ import annotations

import contextlib
import io
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from problems.errors import FormError
from problems.forms.stages import find_stages
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.qp_support import Backend, Warm, checked_settings, interior_tolerance, native

_LIMITED = "SOLVER_RET_LIMITED"


class _Conic(Backend):
    """A plugin of `casadi.conic`, called through a buffer: no CasADi matrix is made per solve."""

    dense: ClassVar[bool] = False
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "casadi"
    module: ClassVar[str] = "casadi"

    @abstractmethod
    def _plugin_options(self) -> dict[str, Any]:
        """Options of the plugin, translated from ours."""

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        self._make(self._P, self._A)

    def _make(self, P: Any, A: Any) -> None:
        lib, (m, n) = self._library, A.shape
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

    Without N, nx, nu and ng they are found (`problems.forms.stages`), a program without a chain is one stage. With
    them the unknowns are ordered ``x_0, u_0, x_1, u_1, ..., x_N``, the rows ``dynamics_0, others_0, dynamics_1, ...``
    with dynamics ``A_k x_k + B_k u_k - x_{k+1} = b_k``; P joins only unknowns of the same stage.

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
    """QP backend ``hpipm``: interior point in stages, found in the program or stated by the settings.

    Attributes:
        stages: N, nx, nu and ng in use, once the library's object is built.

    Raises:
        FormError: the stages are given in part, or P and A do not have the structure they say.
    """

    name: ClassVar[str] = "hpipm"
    warm_starts: ClassVar[bool] = False
    settings_type: ClassVar[type[HPIPMSettings]] = HPIPMSettings
    stages: dict[str, Any]

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None:
        settings = checked_settings(HPIPMSettings, options.extra, self.name)
        self._stated = {name: getattr(settings, name) for name in ("N", "nx", "nu", "ng")}
        missing = [name for name, value in self._stated.items() if value is None]
        if 0 < len(missing) < len(self._stated):
            raise FormError(
                "solver hpipm: stages are stated by the settings N, nx, nu and ng together, and "
                f"{', '.join(missing)} is missing; without any of them the stages are found"
            )
        super().__init__(P, q, A, l, u, options)

    def _plugin_options(self) -> dict[str, Any]:
        common = self._options
        tolerance = interior_tolerance(common.tolerance)
        inner = native(
            self._settings,
            res_g_max=tolerance,
            res_b_max=tolerance,
            # the rounding of what stands for an infinite bound is what the residual of bounds cannot get below
            res_d_max=max(tolerance, 4.0 * np.finfo(float).eps * self._infinity),
            res_m_max=tolerance,
            # with its own, large one it ends at the first step where the minimiser of the costs violates bounds
            mu0=None if self._scaling is None else 1.0,
            lam_min=1e-25,
            iter_max=common.iteration_limit,
        )
        for name in ("N", "nx", "nu", "ng", "inf"):
            inner.pop(name, None)
        return {**self.stages, "inf": self._infinity, "hpipm": inner}

    @property
    def _infinity(self) -> float:
        return self._settings.inf or 1e8

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        n, m = self._n, self._m
        self._unknowns, self._order = np.arange(n), np.arange(m)
        self._dynamics = np.empty(0, np.intp)
        if self._stated["N"] is not None:
            self.stages = self._stated
        else:
            self.stages = {"N": 0, "nx": (n,), "nu": (0,), "ng": (m,)}
            found = find_stages(self._P, self._A, l == u)
            if found is not None:
                sizes = {"nx": found.states, "nu": found.controls, "ng": found.others}
                self.stages = {"N": found.states.size - 1} | {k: tuple(v.tolist()) for k, v in sizes.items()}
                self._unknowns, self._order = found.unknowns, found.rows
                self._dynamics = np.flatnonzero(found.defining[found.rows] >= 0)
                self._defined = found.defining[self._order[self._dynamics]]
        self._taken_P = _Entries(self._P, self._unknowns, self._unknowns)
        self._taken_A = _Entries(self._A, self._order, self._unknowns)
        self._scale = np.ones(m)
        P, A = self._staged()
        try:
            self._make(P, A)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise FormError(f"solver hpipm: P and A do not have the stages N, nx, nu, ng say: {reason}") from error

    def _staged(self) -> tuple[Any, Any]:
        """P and A in the order of the stages, dynamics scaled so that the state they define has the factor -1."""
        P, A = self._taken_P(self._P), self._taken_A(self._A)
        if self._dynamics.size:
            factors = self._A[self._order[self._dynamics], self._defined]
            self._scale[self._dynamics] = -1.0 / np.asarray(factors).ravel()
            A.data *= self._scale[A.indices]
        return P, A

    def _renew(self) -> None:
        if not (self._taken_P.hold(self._P) and self._taken_A.hold(self._A)):
            self._stale = True
            return
        P, A = self._staged()
        self._h[:] = P.data
        self._a[:] = A.data
        self._stale = not np.isfinite(self._scale).all()

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        rows, scale, limit = self._order, self._scale, self._infinity
        dynamics = rows[self._dynamics]
        if (l[dynamics] != u[dynamics]).any():  # an equality no more
            self._build(q, l, u)
            return self._run(q, l, u, warm)
        lower, upper = np.clip(l[rows], -limit, limit) * scale, np.clip(u[rows], -limit, limit) * scale
        result = super()._run(q[self._unknowns], lower, upper, warm)
        if result.x is None or result.y is None:
            return result
        x, y = np.empty(self._n), np.empty(self._m)
        x[self._unknowns] = result.x
        y[rows] = result.y * scale
        return replace(result, x=x, y=y)

    def _failed(self, x: np.ndarray, y: np.ndarray, iterations: int, message: str, unified: str) -> QPResult:
        # At its limit, or where steps get too small, it stops at a point that is often good: the residuals tell.
        reasons = {"1": "iteration limit reached", "2": "step length too small"}
        if message in reasons:
            status = Status.ITERATION_LIMIT if message == "1" else Status.FAILED
            return QPResult(x, y, status, iterations, reasons[message])
        reason = "NaN in the iterates" if message == "3" else f"status {message}"
        return QPResult(None, None, Status.FAILED, iterations, reason)


def _sparsity(library: Any, matrix: Any) -> Any:
    return library.Sparsity(*matrix.shape, matrix.indptr.tolist(), matrix.indices.tolist())


class _Entries:
    """Entries of a sparse matrix that are not zero, its rows and columns in another order; refilled by copying."""

    def __init__(self, matrix: Any, rows: np.ndarray, columns: np.ndarray) -> None:
        self._zero = np.flatnonzero(matrix.data == 0)
        numbered = matrix.copy()
        numbered.data[:] = np.arange(1.0, matrix.nnz + 1)
        numbered.data[self._zero] = 0.0
        numbered.eliminate_zeros()
        ordered = numbered.tocsr()[rows].tocsc()[:, columns]
        ordered.sort_indices()
        self._source = ordered.data.astype(np.intp) - 1
        self._matrix = ordered

    def hold(self, matrix: Any) -> bool:
        """Whether a matrix of the same pattern has no further entries."""
        return not matrix.data[self._zero].any()

    def __call__(self, matrix: Any) -> Any:
        self._matrix.data[:] = matrix.data[self._source]
        return self._matrix
