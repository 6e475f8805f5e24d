"""Small quadratic programs for the tests of QP backends, with references computed here."""

from __future__ import annotations

import importlib
import itertools
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from problems.errors import MissingExtraError, UnknownNameError
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.qp_check import judge
from problems.solvers.qp_qpsolvers import qpsolvers_backend

CLASSES = {
    "daqp": "qp_daqp:DAQP",
    "osqp": "qp_osqp:OSQP",
    "proxqp": "qp_proxqp:ProxQP",
    "piqp": "qp_piqp:PIQP",
    "quadprog": "qp_quadprog:Quadprog",
    "clarabel": "qp_clarabel:Clarabel",
    "highs": "qp_highs:HiGHS",
    "qpoases": "qp_casadi:QPOASES",
    "qrqp": "qp_casadi:QRQP",
    "qpsolvers:cvxopt": "",
    "qpsolvers:daqp": "",
}
# QRQP cycles on some problems and says so; the other backends solve practically all.
UNRELIABLE = {"qrqp"}


def backend_class(name: str) -> type[Any]:
    if name.startswith("qpsolvers:"):
        try:
            return qpsolvers_backend(name.partition(":")[2])
        except UnknownNameError as error:
            pytest.skip(str(error))
    module, _, attribute = CLASSES[name].partition(":")
    cls = getattr(importlib.import_module(f"problems.solvers.{module}"), attribute)
    try:
        cls.version()
    except MissingExtraError as error:
        pytest.skip(str(error))
    return cls


class QP:
    """A problem with its matrices as a backend wants them."""

    def __init__(self, P: Any, q: Any, A: Any, l: Any, u: Any) -> None:
        self.P, self.q, self.A, self.l, self.u = (np.array(v, dtype=float) for v in (P, q, A, l, u))

    def matrices(self, cls: type[Any]) -> tuple[Any, Any]:
        if cls.dense:
            return np.ascontiguousarray(self.P), np.ascontiguousarray(self.A)
        return sp.csc_array(self.P), sp.csc_array(self.A)

    def backend(self, cls: type[Any], **options: Any) -> Any:
        P, A = self.matrices(cls)
        return cls(P, self.q, A, self.l, self.u, Options(**options))

    def judged(self, backend: Any, tolerance: float = 1e-8, warm: Any = None) -> tuple[Status, Any]:
        result = backend.solve(self.q, self.l, self.u, warm)
        assert isinstance(result, QPResult)
        P, A = self.matrices(type(backend))
        return judge(result, P, self.q, A, self.l, self.u, tolerance)

    def violation(self, x: np.ndarray, y: np.ndarray) -> float:
        """Largest violation of the KKT conditions, complementarity row by row; written out for the test."""
        stationarity = np.abs(self.P @ x + self.q + self.A.T @ y).max()
        r = self.A @ x
        feasibility = max([0.0, *(r - self.u), *(self.l - r)])
        complementarity = 0.0
        for i, multiplier in enumerate(y):
            slack = self.u[i] - r[i] if multiplier > 0 else r[i] - self.l[i] if multiplier < 0 else 0.0
            complementarity = max(complementarity, min(abs(multiplier), abs(slack)))
        return max(stationarity, feasibility, complementarity)

    def enumerated(self) -> Any:
        """The minimiser, by solving the equality problem of every active set; None if there is none."""
        n, m = len(self.q), len(self.l)
        choices = []
        for low, up in zip(self.l, self.u, strict=True):
            sides = [0] if low < up else []
            choices.append(sides + [1] * bool(np.isfinite(up)) + [-1] * bool(np.isfinite(low) and low < up))
        for signs in itertools.product(*choices):
            rows = [i for i in range(m) if signs[i]]
            if len(rows) > n:
                continue
            b = [self.u[i] if signs[i] > 0 else self.l[i] for i in rows]
            A = self.A[rows].reshape(len(rows), n)
            kkt = np.block([[self.P, A.T], [A, np.zeros((len(rows), len(rows)))]])
            if np.linalg.matrix_rank(kkt) < len(kkt):
                continue
            solved = np.linalg.solve(kkt, np.concatenate([-self.q, b]))
            x, y = solved[:n], solved[n:]
            right_sign = all(self.l[i] == self.u[i] or signs[i] * y[k] >= -1e-10 for k, i in enumerate(rows))
            r = self.A @ x
            if right_sign and (r <= self.u + 1e-9).all() and (r >= self.l - 1e-9).all():
                return x
        return None


def random_qp(rng: np.random.Generator, n: int, m: int, equal: int, *, pull: float = 3.0) -> QP:
    """A feasible strictly convex problem with one-sided, two-sided, free and `equal` equality rows, some active."""
    M = rng.normal(size=(n + 2, n))
    P = M.T @ M + 0.1 * np.eye(n)
    A = rng.normal(size=(m, n))
    r = A @ rng.normal(size=n)
    l, u = r - rng.uniform(0.05, 1, m), r + rng.uniform(0.05, 1, m)
    kind = rng.integers(0, 8, m)
    l[kind == 1] = -np.inf
    u[kind == 2] = np.inf
    l[kind == 3], u[kind == 3] = -np.inf, np.inf
    l[:equal] = u[:equal] = r[:equal]
    return QP(P, pull * rng.normal(size=n), A, l, u)


def window_qp(rng: np.random.Generator, steps: int = 5) -> QP:
    """A window with process equations as equalities: P is singular, definite on the equalities only."""
    nx, n = 3, 3 * (steps + 1)
    F = np.eye(nx) + 0.2 * rng.normal(size=(nx, nx))
    C = rng.normal(size=(1, nx))
    P = np.zeros((n, n))
    P[:nx, :nx] = np.eye(nx)
    equalities = np.zeros((nx * steps, n))
    for k in range(steps + 1):
        P[k * nx : (k + 1) * nx, k * nx : (k + 1) * nx] += 10 * C.T @ C
        if k < steps:
            equalities[k * nx : (k + 1) * nx, k * nx : (k + 1) * nx] = F
            equalities[k * nx : (k + 1) * nx, (k + 1) * nx : (k + 2) * nx] = -np.eye(nx)
    b = 0.1 * rng.normal(size=nx * steps)
    return QP(
        P,
        5 * rng.normal(size=n),
        np.vstack([equalities, np.eye(n)]),
        np.concatenate([b, np.full(n, -0.8)]),
        np.concatenate([b, np.full(n, 0.8)]),
    )


def boxed(n: int = 4) -> QP:
    rng = np.random.default_rng(13)
    M = rng.normal(size=(n + 2, n))
    return QP(
        M.T @ M + 0.1 * np.eye(n),
        rng.normal(size=n),
        np.vstack([np.eye(n), np.ones((1, n))]),
        [-1] * (n + 1),
        [1] * (n + 1),
    )


class Counter:
    def __init__(self, original: Any) -> None:
        self.original, self.calls = original, 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        return self.original(*args, **kwargs)
