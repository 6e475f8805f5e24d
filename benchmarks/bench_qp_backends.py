"""What our layer costs: each QP backend beside the bare calls of its library, on the windows of a small linear model.

Two problems of the same model (4 states, horizon 5, 24 two-sided rows, active in 30 % of the steps): 4 unknowns (the
first state of a window without process noise) and 24 unknowns (all states, process noise penalized). Both sides start
warm where the library can, have the same tolerance, and solve the same sequence.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from problems.errors import MissingExtraError
from problems.solvers.base import Options, Status
from problems.solvers.qp_check import judge

TOLERANCE = 1e-8
STEPS = 64
BACKENDS = {
    "daqp": "qp_daqp:DAQP",
    "osqp": "qp_osqp:OSQP",
    "proxqp": "qp_proxqp:ProxQP",
    "piqp": "qp_piqp:PIQP",
    "quadprog": "qp_quadprog:Quadprog",
    "clarabel": "qp_clarabel:Clarabel",
    "highs": "qp_highs:HiGHS",
    "qpoases": "qp_casadi:QPOASES",
    "qrqp": "qp_casadi:QRQP",
}


class Window:
    """Matrices of one form of the window, and the vectors of `STEPS` successive steps."""

    def __init__(self, unknowns: int) -> None:
        rng = np.random.default_rng(0)
        states, horizon = 4, 5
        F = np.eye(states) + 0.1 * rng.normal(size=(states, states))
        C = rng.normal(size=(2, states))
        powers = [np.linalg.matrix_power(F, k) for k in range(horizon + 1)]
        if unknowns == states:
            self.A = np.ascontiguousarray(np.vstack(powers))
            self.P = np.eye(states) + sum(G.T @ C.T @ C @ G for G in powers)
        else:
            self.A = np.eye(unknowns)
            self.P = np.kron(np.eye(horizon + 1), C.T @ C)
            self.P[:states, :states] += np.eye(states)
            for k in range(horizon):
                G = np.zeros((states, unknowns))
                G[:, k * states : (k + 1) * states] = F
                G[:, (k + 1) * states : (k + 2) * states] = -np.eye(states)
                self.P += 10.0 * G.T @ G
        walk = np.cumsum(rng.normal(size=(STEPS, unknowns)), axis=0)
        targets = [-np.linalg.solve(self.P, q) for q in walk]
        values = np.abs(np.array([self.A @ x for x in targets]))
        edge = values.max(axis=0)
        edge *= np.quantile((values / edge).max(axis=1), 0.7)
        self.l, self.u, self.qs = -edge, edge, list(walk)


def library_step(name: str, window: Window) -> Callable[[np.ndarray], Any]:
    """One solve by the bare library, as its documentation writes it."""
    P, A, l, u, q = window.P, window.A, window.l, window.u, window.qs[0]
    n, m = len(q), len(l)
    if name == "daqp":
        import daqp

        model = daqp.Model()
        model.setup(P, q, A, u, l)

        def step(q: np.ndarray) -> Any:
            model.update(f=q, bupper=u, blower=l)
            return model.solve()
    elif name == "osqp":
        import osqp

        splitting = osqp.OSQP()
        half = 0.5 * TOLERANCE
        splitting.setup(sp.csc_matrix(sp.triu(P)), q, sp.csc_matrix(A), l, u, eps_abs=half, eps_rel=half, verbose=False)

        def step(q: np.ndarray) -> Any:
            splitting.update(q=q, l=l, u=u)
            return splitting.solve(raise_error=False)
    elif name == "proxqp":
        from proxsuite import proxqp

        proximal = proxqp.dense.QP(n, 0, m)
        proximal.settings.eps_abs = proximal.settings.eps_rel = 0.1 * TOLERANCE
        proximal.settings.check_duality_gap = True
        proximal.init(P, q, None, None, A, l, u)
        point = [np.zeros(n), np.zeros(m)]

        def step(q: np.ndarray) -> Any:
            proximal.update(g=q, l=l, u=u)
            proximal.solve(point[0], None, point[1])
            point[:] = proximal.results.x.copy(), proximal.results.z.copy()
    elif name == "piqp":
        import piqp

        interior = piqp.SparseSolver() if n == m else piqp.DenseSolver()
        interior.settings.eps_abs = interior.settings.eps_rel = 0.5 * TOLERANCE
        convert: Any = sp.csc_matrix if n == m else np.asfortranarray
        interior.setup(convert(P), q, None, None, convert(A), l, u)

        def step(q: np.ndarray) -> Any:
            interior.update(c=q, h_l=l, h_u=u)
            interior.solve()
            return interior.result.x, interior.result.z_l, interior.result.z_u
    elif name == "quadprog":
        import quadprog

        inverse = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(P)).T)
        normals = np.ascontiguousarray(np.vstack([A, -A]).T)

        def step(q: np.ndarray) -> Any:
            return quadprog.solve_qp(inverse, -q, normals, np.concatenate([l, -u]), 0, True)
    elif name == "clarabel":
        clarabel: Any = importlib.import_module("clarabel")

        settings: Any = clarabel.DefaultSettings()
        settings.verbose = settings.presolve_enable = False
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = 0.1 * TOLERANCE
        cone = [clarabel.NonnegativeConeT(2 * m)]
        stacked = sp.csc_matrix(np.vstack([A, -A]))
        conic: Any = clarabel.DefaultSolver(sp.csc_matrix(sp.triu(P)), q, stacked, np.append(u, -l), cone, settings)

        def step(q: np.ndarray) -> Any:
            conic.update(q=q, b=np.append(u, -l))
            found = conic.solve()
            return found.x, found.z
    elif name == "highs":
        import highspy

        solver: Any = highspy.Highs()
        solver.silent()
        solver.setOptionValue("qp_regularization_value", 1e-3 * TOLERANCE)
        for side in ("primal", "dual"):
            solver.setOptionValue(f"{side}_feasibility_tolerance", 0.1 * TOLERANCE)
        lp: Any = highspy.HighsLp()
        rows, lower = sp.csc_array(A), sp.csc_array(sp.tril(P))
        lp.num_col_, lp.num_row_, lp.col_cost_, lp.row_lower_, lp.row_upper_ = n, m, q, l, u
        lp.col_lower_, lp.col_upper_ = np.full(n, -np.inf), np.full(n, np.inf)
        lp.a_matrix_.num_col_, lp.a_matrix_.num_row_ = n, m
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = rows.indptr, rows.indices, rows.data
        hessian: Any = highspy.HighsHessian()
        hessian.dim_, hessian.start_, hessian.index_, hessian.value_ = n, lower.indptr, lower.indices, lower.data
        model_: Any = highspy.HighsModel()
        model_.lp_, model_.hessian_ = lp, hessian
        solver.passModel(model_)
        columns, numbers = np.arange(n, dtype=np.int32), np.arange(m, dtype=np.int32)

        def step(q: np.ndarray) -> Any:
            solver.changeColsCost(n, columns, q)
            solver.changeRowsBounds(m, numbers, l, u)
            solver.run()
            found = solver.getSolution()
            return found.col_value, found.row_dual
    else:
        import casadi

        prints = {"print_iter": False, "print_header": False, "print_info": False}
        quiet: dict[str, Any] = {"printLevel": "none"} if name == "qpoases" else prints
        structure = {"h": casadi.Sparsity.dense(n, n), "a": casadi.DM(sp.csc_matrix(A)).sparsity()}
        function = casadi.conic("qp", name, structure, {"error_on_fail": False, **quiet})
        h, a = casadi.DM(P), casadi.DM(sp.csc_matrix(A))
        warm: dict[str, Any] = {"x0": np.zeros(n), "lam_a0": np.zeros(m)}

        def step(q: np.ndarray) -> Any:
            found = function(h=h, g=q, a=a, lba=l, uba=u, **warm)
            good = function.stats()["success"]
            warm.update(x0=found["x"] if good else np.zeros(n), lam_a0=found["lam_a"] if good else np.zeros(m))

    return step


def our_step(name: str, window: Window) -> Callable[[np.ndarray], Any]:
    """One solve by our backend, warm where it can be, with a check that the answers are right."""
    module, _, attribute = BACKENDS[name].partition(":")
    cls = getattr(importlib.import_module(f"problems.solvers.{module}"), attribute)
    P, A = (window.P, window.A) if cls.dense else (sp.csc_array(window.P), sp.csc_array(window.A))
    backend = cls(P, window.qs[0], A, window.l, window.u, Options(tolerance=TOLERANCE))
    good = active = 0
    for q in window.qs:
        result = backend.solve(q, window.l, window.u)
        status, result = judge(result, P, q, A, window.l, window.u, TOLERANCE)
        good += status is Status.SOLVED
        active += result.y is not None and bool((np.abs(result.y) > 1e-6).any())
    if name != "qrqp":  # it cycles on some steps, and says so
        assert good >= 0.95 * STEPS, f"{name}: {good} of {STEPS} steps solved"
        assert 0.25 <= active / STEPS <= 0.35
    last: list[Any] = [None]

    def step(q: np.ndarray) -> Any:
        result = backend.solve(q, window.l, window.u, last[0])
        last[0] = None if result.x is None else (result.x, result.y)
        return result

    return step


def cycled(step: Callable[[np.ndarray], Any], window: Window) -> Callable[[], Any]:
    """`step` on the vectors forth and back, so that the problem never jumps."""
    order = [*window.qs, *window.qs[::-1]]
    position = [0]

    def run() -> Any:
        position[0] = (position[0] + 1) % len(order)
        return step(order[position[0]])

    return run


def medians(*steps: Callable[[], Any], rounds: int = 400) -> list[float]:
    """Median microseconds of steps run in turn, so that the machine's moods meet all of them."""
    taken: list[list[float]] = [[] for _ in steps]
    for _ in range(rounds):
        for step, times in zip(steps, taken, strict=True):
            start = time.perf_counter()
            step()
            times.append(time.perf_counter() - start)
    return [1e6 * float(np.median(times)) for times in taken]


@pytest.mark.parametrize("unknowns", [4, 24])
@pytest.mark.parametrize("name", list(BACKENDS))
def test_backend_beside_its_library(name: str, unknowns: int, benchmark: Any) -> None:
    window = Window(unknowns)
    try:
        ours = cycled(our_step(name, window), window)
    except MissingExtraError as error:
        pytest.skip(str(error))
    bare = cycled(library_step(name, window), window)
    benchmark.group = f"{unknowns} unknowns"
    benchmark.pedantic(ours, rounds=400, iterations=1, warmup_rounds=20)
    own, library = medians(ours, bare)
    benchmark.extra_info.update(
        ours_us=round(own, 1), library_us=round(library, 1), overhead_us=round(own - library, 1)
    )
    print(f"\n{name:9} {unknowns:3} unknowns: ours {own:7.1f} us, library {library:7.1f} us, {own - library:+7.1f} us")
    if name == "daqp":
        assert own < 3.0 * library
