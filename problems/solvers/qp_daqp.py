"""DAQP: dual active-set method for small dense problems; the fastest backend for windows of a few dozen variables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from problems.solvers.base import QPResult, Status
from problems.solvers.qp_support import Backend, Rows, Warm, native, positive_definite

_STATUS = {
    1: (Status.SOLVED, ""),
    4: (Status.INACCURATE, "optimal up to rounding only"),
    -1: (Status.INFEASIBLE, "no point satisfies all rows"),
    -2: (Status.FAILED, "the active set cycles"),
    -3: (Status.UNBOUNDED, "the cost has no lower bound"),
    -4: (Status.ITERATION_LIMIT, "iteration limit reached"),
    -5: (Status.FAILED, "P is not positive semidefinite"),
    -6: (Status.FAILED, "more rows were fixed at the start than there are unknowns, or they are dependent"),
    -7: (Status.TIME_LIMIT, "time limit reached"),
}
# Working-set flags by sign of a multiplier: active at the lower bound, inactive, active at the upper bound.
_SENSE = np.array([3, 0, 1], dtype=np.intc)


@dataclass(frozen=True)
class DAQPSettings:
    """Settings of `DAQP`; None keeps the library's default or what follows from `Options`.

    Attributes:
        primal_tol: violation of a row allowed, in units of the row scaled by P.
        dual_tol: size below which a multiplier of the wrong sign is accepted.
        zero_tol: pivots and bounds closer than this are taken as zero and equal.
        pivot_tol: pivots below it make the factorization exchange rows.
        progress_tol: increase of the dual objective that counts as progress.
        cycle_tol: iterations without progress before giving up.
        iter_limit: iterations of one solve.
        fval_bound: cost above which the problem counts as infeasible.
        eps_prox: proximal weight for a singular P; negative only where needed, positive always, zero never.
        eta_prox: step below which proximal iterations stop.
        sing_tol: pivot below which the working set counts as dependent.
        refactor_tol: pivot below which the factors are computed anew.
        time_limit: seconds of one solve.
        eq_reduction: eliminate equality rows first: -1 never, 0 when it pays for one solve, 1 always.
    """

    primal_tol: float | None = None
    dual_tol: float | None = None
    zero_tol: float | None = None
    pivot_tol: float | None = None
    progress_tol: float | None = None
    cycle_tol: int | None = None
    iter_limit: int | None = None
    fval_bound: float | None = None
    eps_prox: float | None = None
    eta_prox: float | None = None
    sing_tol: float | None = None
    refactor_tol: float | None = None
    time_limit: float | None = None
    eq_reduction: int | None = None


class DAQP(Backend):
    """QP backend ``daqp``.

    Leading rows of A that are rows of the identity go in as bounds on variables. A singular P is made definite on the
    equality rows (`positive_definite`); what remains singular goes through the library's proximal iterations.
    """

    name: ClassVar[str] = "daqp"
    dense: ClassVar[bool] = True
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "daqp"
    module: ClassVar[str] = "daqp"
    settings_type: ClassVar[type[DAQPSettings]] = DAQPSettings

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        A, common = self._A, self._options
        self._bounded = _leading_identity(A)
        self._equal = Rows.of(l, u).equal
        self._hessian, self._weight = positive_definite(self._P, A, self._equal)
        model = self._library.Model()
        # The method ends at an exact vertex of the working set, so a tight tolerance costs nothing.
        tolerance = min(max(0.01 * common.tolerance, 1e-12), 1e-6)
        model.settings = native(
            self._settings,
            primal_tol=tolerance,
            eta_prox=0.1 * tolerance,
            time_limit=common.time_limit,
            iter_limit=common.iteration_limit,
        )
        # The library cannot update a problem without rows: it gets an unbounded variable.
        self._no_rows = (np.full(1, -np.inf), np.full(1, np.inf)) if not self._m else None
        if self._no_rows:
            l, u = self._no_rows
        self._cold = np.zeros(len(l), dtype=np.intc)
        flag, _ = model.setup(self._hessian, q, A[self._bounded :], u, l, self._cold)
        self._model = model if flag >= 0 else None
        self._setup_flag = flag

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        model = self._model
        if model is None:
            self._stale = True
            return _without_point(self._setup_flag, 0)
        weight = self._weight
        if weight and not (l[self._equal] == u[self._equal]).all():
            self._build(q, l, u)
            return self._run(q, l, u, None)
        if self._no_rows:
            l, u = self._no_rows
            warm = None
        if warm is not None and l.dot(l) + u.dot(u) == np.inf and _unbounded(warm[1], l, u):
            # The library would keep a row active at a bound that is gone.
            warm = None
        if warm is None:
            sense = self._cold
        elif warm[1] is self._last_y:
            sense = None
        else:
            sense = _SENSE[np.sign(warm[1]).astype(np.intp) + 1]
        flag = model.update(None, q, None, u, l, sense)
        if flag == -6 and warm is not None:
            flag = model.update(None, q, None, u, l, self._cold)
        if flag < 0:
            # The workspace is unusable after a refused update, although it would go on claiming success.
            self._stale = True
            return _without_point(flag, 0)
        x, self._value, flag, info = model.solve()
        if flag == 1 or flag == 4:
            y = info["lam"][: self._m]
            if weight:
                y[self._equal] += weight * u[self._equal]
            status, message = _STATUS[flag]
            return QPResult(x, y, status, info["iterations"], message)
        self._stale = True
        return _without_point(flag, info["iterations"])

    def _is_finite(self, x: np.ndarray, y: np.ndarray | None) -> bool:
        # The cost sums up both.
        return self._value - self._value == 0.0

    def _renew(self) -> None:
        A = self._A
        if self._model is None or _leading_identity(A) != self._bounded:
            self._stale = True
            return
        self._hessian = self._P
        if self._weight:
            self._hessian, self._weight = positive_definite(self._P, A, self._equal)
        # the library reads the first row of what it is given, even where there is none
        rows = A[self._bounded :] if len(A) > self._bounded else None
        self._stale = self._model.update(self._hessian, None, rows, None, None, self._cold) < 0


def _without_point(flag: int, iterations: int) -> QPResult:
    status, message = _STATUS.get(flag, (Status.FAILED, f"flag {flag}"))
    return QPResult(None, None, status, iterations, message)


def _unbounded(y: np.ndarray, l: np.ndarray, u: np.ndarray) -> bool:
    """Whether a multiplier belongs to a side without a bound."""
    return bool((((y > 0) & (u == np.inf)) | ((y < 0) & (l == -np.inf))).any())


def _leading_identity(A: np.ndarray) -> int:
    """How many leading rows of A (m, n) are those of the identity."""
    size = min(A.shape)
    if not size or A[0, 0] != 1.0:
        return 0
    same = (A[:size] == np.eye(size, A.shape[1])).all(axis=1)
    return size if same.all() else int(np.argmin(same))
