"""Nonlinear programs: values and derivatives against CasADi's own, one optimum from every solver, honest statuses."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, SO2, Cauchy, Gaussian, Huber, Problem, Vector, registry
from problems.errors import FormError, SettingError, UnknownNameError
from problems.forms.least_squares import LeastSquares
from problems.forms.nonlinear import NonlinearProgram
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.nlp import FATROP_RELAXES, IPOPT
from problems.solvers.nlp import _tightened as tightened
from problems.solvers.optimality import Optimality
from problems.spatial import SE3


def seen(pose: Any, target: Any, z: Any) -> Any:
    local = pose.transform_to(target)
    return ca.vertcat(ca.norm_2(local) - z[0], ca.atan2(local[1], local[0]) - z[1])


def between(a: Any, b: Any, z: Any) -> Any:
    return SE2(z).between(a.between(b)).local()


def everything(rng: np.random.Generator) -> tuple[Problem, dict[str, Any], dict[str, Any]]:
    """A problem with every kind of part, its data and a point."""
    p = Problem("everything")
    pose, mark = p.variables("pose", SE2, 4), p.variables("mark", Vector(2), 3)
    turn, far = p.variables("turn", SO2), p.variables("far", SE3, 2)
    z, odometry = p.data("z", 2, 5), p.data("odometry", 3, 3)
    sigma, weight = p.data("sigma", (), 5), p.data("weight", (3, 3), 3)
    slope, limit, on = p.data("slope", 3), p.data("limit", (), 4), p.data("on", (), 5)
    p.cost(
        "seen", seen, (pose[[0, 1, 1, 2, 3]], mark[[0, 0, 1, 2, 2]]), z, Gaussian(sigma=sigma), Cauchy(2.0), active=on
    )
    p.cost("odometry", between, (pose[:-1], pose[1:]), odometry, Gaussian(information=weight), linear=slope)
    p.cost("near", lambda x: x, mark, noise=Gaussian(sigma=3.0), loss=Huber(0.1))
    p.cost("turned", lambda T, R: ca.sin(T.angle - R.angle), (pose, turn), noise=Gaussian(0.5))
    p.cost("far", lambda a, b: a.between(b).log(), (far[0], far[1]), noise=Gaussian(2.0))
    p.cost("prior", lambda a: a.log(), far, noise=Gaussian(sigma=[1.0, 2.0, 3.0, 1.0, 1.0, 1.0]))
    p.equality("anchor", lambda T: ca.vertcat(T.translation, T.angle), pose[0])
    p.equality("link", lambda a, b: ca.sumsqr(a - b) - 4.0, (mark[0], mark[1]))
    p.inequality("away", lambda T: ca.sumsqr(T.translation), pose, lower=-1.0, upper=limit)
    data = {
        "z": np.column_stack([rng.uniform(1, 4, 5), rng.uniform(-1, 1, 5)]),
        "odometry": rng.normal(size=(3, 3)),
        "sigma": rng.uniform(0.2, 1, 5),
        "weight": np.stack([L @ L.T + np.eye(3) for L in rng.normal(size=(3, 3, 3))]),
        "slope": rng.normal(size=3),
        "limit": np.array([50.0, 60, 70, 80]),
        "on": [1, 1, 0, 1, 1],
    }
    data["z"][0, 1] = np.nan
    point = {
        "pose": rng.normal(size=(4, 3)),
        "mark": rng.normal(size=(3, 2)),
        "turn": rng.normal(size=(1, 1)),
        "far": SE3.retract_array(np.tile(SE3.identity(), (2, 1)), rng.normal(size=(2, 6))),
    }
    return p, data, point


def evaluate(program: NonlinearProgram, v: np.ndarray, p: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    lam = rng.normal(size=program.constraints.shape[0])
    f, grad = program.derivatives["grad_f"](v, p)
    g, jac = program.derivatives["jac_g"](v, p)
    hess = program.derivatives["hess_lag"](v, p, 0.7, lam)
    return {"f": float(f), "grad": grad, "g": g, "jac": jac, "hess": ca.triu2symm(hess), "lam": lam}


def test_derivatives_are_those_casadi_finds() -> None:
    rng = np.random.default_rng(0)
    problem, data, point = everything(rng)
    program = NonlinearProgram(problem)
    store = program.store(data)
    p = program.parameters(store, program.layout.point(point))
    v = 0.3 * rng.normal(size=program.layout.size)
    found = evaluate(program, v, p, rng)
    x, P, f, g = (program.casadi[k] for k in "xpfg")
    reference = ca.Function(
        "r",
        [x, P],
        [f, ca.gradient(f, x), g, ca.jacobian(g, x), ca.hessian(0.7 * f + ca.dot(ca.DM(found["lam"]), g), x)[0]],
    )(v, p)
    for ours, theirs in zip((found[k] for k in ("f", "grad", "g", "jac", "hess")), reference, strict=True):
        np.testing.assert_allclose(ca.DM(ours).full(), theirs.full(), rtol=1e-10, atol=1e-10)


def test_objective_is_the_cost_at_the_retracted_point() -> None:
    rng = np.random.default_rng(1)
    problem, data, point = everything(rng)
    program = NonlinearProgram(problem)
    store = program.store(data)
    layout, reference = program.layout, program.layout.point(point)
    v = 0.5 * rng.normal(size=layout.size)
    bound = LeastSquares(problem, layout).bind(store)
    value = ca.Function("f", [program.variables, program.parameter], [program.objective])
    ours = float(value(v, program.parameters(store, reference)))
    assert ours == pytest.approx(bound.cost(layout.retract(reference, v)), rel=1e-12)
    lower, upper = program.bounds(store)
    assert program.equalities == 4 and (lower[:4] == 0).all() and (upper[:4] == 0).all()
    np.testing.assert_array_equal(upper[program.rows["away"]], data["limit"])


def test_missing_and_inactive_instances_add_exactly_nothing() -> None:
    """Also where their residual has no derivative: the two points coincide."""

    def build(rows: int) -> Problem:
        p = Problem("ranges")
        x = p.variables("x", Vector(2), 3)
        z, b = p.data("z", (), rows), p.data("b", (), rows)
        index = np.arange(rows)
        p.cost("prior", lambda x: x - 1, x, noise=Gaussian(2.0))
        p.cost("range", lambda a, b, z: ca.norm_2(a - b) - z, (x[index], x[(index + 1) % 3]), z, Gaussian(0.1))
        p.inequality("near", lambda a, b, z: ca.norm_2(a - b) - z, (x[index], x[(index + 1) % 3]), b)
        return p

    x = np.array([[0.0, 0.0], [1.0, 2.0], [0.0, 0.0]])
    z, b = np.array([1.0, 2.0, np.nan]), np.array([3.0, 3.0, np.nan])
    full, part = NonlinearProgram(build(3)), NonlinearProgram(build(2))
    rng = np.random.default_rng(2)
    results = []
    for program, rows in ((full, 3), (part, 2)):
        store = program.store({"z": z[:rows], "b": b[:rows]})
        p = program.parameters(store, program.layout.point({"x": x}))
        results.append(evaluate(program, np.zeros(6), p, np.random.default_rng(3)))
    assert results[0]["f"] == results[1]["f"]
    np.testing.assert_array_equal(results[0]["grad"].full(), results[1]["grad"].full())
    assert (results[0]["jac"].full()[2] == 0).all()
    lam = np.append(results[1]["lam"], rng.normal())
    store = full.store({"z": z, "b": b})
    p = full.parameters(store, full.layout.point({"x": x}))
    hess = ca.triu2symm(full.derivatives["hess_lag"](np.zeros(6), p, 0.7, lam))
    np.testing.assert_allclose(hess.full(), results[1]["hess"].full(), rtol=1e-14, atol=1e-14)
    lower, upper = full.bounds(store)
    assert upper[2] == np.inf and upper[1] == 0
    solution = build(3).compile("ipopt").solve({"z": z, "b": b}, initial={"x": x})
    assert solution.status is Status.SOLVED


def window(horizon: int = 8, box: float = np.inf) -> Problem:
    A, B = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.0], [0.1]])
    p = Problem("window")
    x, w = p.variables("x", Vector(2), horizon + 1), p.variables("w", Vector(1), horizon)
    y, prior, M = p.data("y", (), horizon + 1), p.data("prior", 2), p.data("M", (2, 2))
    p.cost("arrival", lambda x, z: x - z, x[0], prior, Gaussian(information=M))
    p.cost("output", lambda x, y: x[0] - y, x, y, Gaussian(0.1))
    p.cost("noise", lambda w: w, w, noise=Gaussian(2.0))
    p.equality("model", lambda x, w, n: A @ x + B @ w - n, (x[:-1], w, x[1:]))
    p.inequality("box", lambda w: w, w, lower=-box, upper=box)
    return p


def window_data(seed: int = 0, horizon: int = 8) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    y = np.sin(0.7 * np.arange(horizon + 1)) + 0.1 * rng.normal(size=horizon + 1)
    y[3] = np.nan
    return {"y": y, "prior": rng.normal(size=2), "M": np.array([[2.0, 0.3], [0.3, 1.0]])}


@pytest.mark.parametrize("solver", ["ipopt", "fatrop", "sqp:daqp", "sqp:proxqp", "gauss-newton"])
def test_window_with_active_rows_equals_the_quadratic_program(solver: str) -> None:
    problem, data = window(box=1.5), window_data()
    reference = problem.compile("daqp", tolerance=1e-11).solve(data)
    assert (np.abs(reference.active_set["box"]) == 1).sum() >= 3
    session = problem.compile(solver)
    solution = session.solve(data)
    assert solution.status is Status.SOLVED, solution
    assert solution.objective == pytest.approx(reference.objective, rel=1e-9)
    np.testing.assert_allclose(solution.point, reference.point, atol=2e-7)
    np.testing.assert_allclose(solution.multipliers["box"], reference.multipliers["box"], atol=1e-4)
    assert (solution.active_set["box"] == reference.active_set["box"]).all()
    again = session.solve(window_data(1))
    other = problem.compile("daqp", tolerance=1e-11).solve(window_data(1))
    np.testing.assert_allclose(again.point, other.point, atol=2e-7)


def ring(count: int = 6) -> tuple[Problem, dict[str, Any], np.ndarray]:
    """A pinned ring of poses kept inside a disc by an inequality."""
    rng = np.random.default_rng(5)
    angle = 2 * np.pi * np.arange(count) / count
    truth = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), angle])
    i = np.arange(count)
    j = (i + 1) % count
    z = SE2.local_array(truth[i], truth[j]) + [0.1, 0.1, 0.02] * rng.normal(size=(count, 3))
    p = Problem("ring")
    pose, data = p.variables("pose", SE2, count), p.data("z", 3, count)
    p.equality("pin", lambda T: ca.vertcat(T.translation - [3, 0], T.angle), pose[0])
    p.cost("between", between, (pose[i], pose[j]), data, Gaussian([0.1, 0.1, 0.02]), Huber(2.0))
    p.inequality("disc", lambda T: ca.norm_2(T.translation), pose[1:], upper=2.95)
    return p, {"z": z}, truth


def test_pinned_poses_inside_a_disc_agree_with_gauss_newton() -> None:
    problem, data, truth = ring()
    ours = problem.compile("gauss-newton", tolerance=1e-12).solve(data, initial={"pose": truth})
    found = problem.compile("ipopt").solve(data, initial={"pose": truth})
    assert found.status is Status.SOLVED and (ours.active_set["disc"] == 1).any()
    assert (found.active_set["disc"] == ours.active_set["disc"]).all()
    np.testing.assert_allclose(found["pose"], ours["pose"], atol=1e-6)
    np.testing.assert_allclose(found["pose"][0], [3, 0, 0], atol=1e-14)
    assert found.objective == pytest.approx(ours.objective, rel=1e-8)
    pose = problem.unknowns["pose"]
    np.testing.assert_allclose(found.covariance(pose[1:3]), ours.covariance(pose[1:3]), rtol=1e-4, atol=1e-9)


def test_a_second_solve_makes_no_solver_and_starts_warm(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, data, truth = ring()
    session = problem.compile("ipopt")
    monkeypatch.setattr(ca, "nlpsol", lambda *_: pytest.fail("a solver was made after compile"))
    first = session.solve(data, initial={"pose": truth})
    fork = session.fork()
    second = session.solve({"z": data["z"] + 1e-3})
    assert second.status is Status.SOLVED and 0 < second.iterations < first.iterations
    for _ in range(3):
        session.solve({"z": data["z"] + 0.1})
    # what the other session did in between leaves no trace
    np.testing.assert_array_equal(fork.solve({"z": data["z"] + 1e-3}).point, second.point)


def test_infeasible_rows_and_crossing_bounds_are_statuses() -> None:
    p = Problem("boxes")
    x, low = p.variables("x", Vector(1)), p.data("low")
    p.cost("c", lambda x: x, x)
    p.inequality("sphere", lambda x: x**2, x, upper=1.0)
    p.inequality("half", lambda x: x, x, lower=low, upper=5.0)
    session = p.compile("ipopt")
    assert session.solve({"low": 0.5}).status is Status.SOLVED
    contradicting = session.solve({"low": 3.0})
    assert contradicting.status is Status.INFEASIBLE
    crossing = session.solve({"low": 6.0})
    assert crossing.status is Status.INFEASIBLE and "cross" in crossing.message
    assert session.solve({"low": 0.5})["x"][0, 0] == pytest.approx(0.5, abs=1e-8)


def test_limits_are_statuses() -> None:
    problem, data, truth = ring()
    few = problem.compile("ipopt", iteration_limit=2).solve(data, initial={"pose": truth})
    assert few.status is Status.ITERATION_LIMIT and few.iterations == 2
    short = problem.compile("ipopt", time_limit=1e-9).solve(data, initial={"pose": truth})
    assert short.status is Status.TIME_LIMIT
    dense = problem.compile("fatrop", iteration_limit=2).solve(data, initial={"pose": truth})
    assert dense.status is Status.ITERATION_LIMIT


def test_a_crash_is_a_status_and_the_next_solve_works(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, data, truth = ring()
    session = problem.compile("ipopt")
    call = IPOPT._call

    def breaks(*_: Any) -> Any:
        raise RuntimeError("first line\nsegmentation of the matrix")

    monkeypatch.setattr(IPOPT, "_call", breaks)
    broken = session.solve(data, initial={"pose": truth})
    assert broken.status is Status.FAILED and "segmentation" in broken.message
    monkeypatch.setattr(IPOPT, "_call", call)
    assert session.solve(data, initial={"pose": truth}).status is Status.SOLVED


def test_a_false_claim_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, data, truth = ring()
    session = problem.compile("ipopt")
    call = IPOPT._call

    def lies(self: IPOPT, arguments: dict[str, Any]) -> Any:
        results, stats = call(self, arguments)
        return results | {"x": np.array(results["x"]).ravel() + 1e-3}, stats

    monkeypatch.setattr(IPOPT, "_call", lies)
    solution = session.solve(data, initial={"pose": truth})
    assert solution.status is Status.INACCURATE and "decrement" in solution.message


def test_unknowns_in_no_term_are_named() -> None:
    p = Problem("loose")
    x = p.variables("x", Vector(2), 3)
    p.cost("c", lambda x: x - 1, x[:2])
    solution = p.compile("ipopt").solve()
    assert solution.status is Status.UNBOUNDED and "x[2]" in solution.message


def test_verdicts() -> None:
    options = Options(tolerance=1e-8)
    good, off = Optimality(1.0, 1e-10, 0.0, ""), Optimality(1.0, 1e-3, 0.0, "")
    assert good.judge(Status.FAILED, "said so", options)[0] is Status.SOLVED
    assert off.judge(Status.SOLVED, "", options)[0] is Status.INACCURATE
    assert off.judge(Status.ITERATION_LIMIT, "", options)[0] is Status.ITERATION_LIMIT
    assert off.judge(Status.INFEASIBLE, "", options)[0] is Status.FAILED
    assert Optimality(1.0, 1e-3, 1.0, "").judge(Status.INFEASIBLE, "", options)[0] is Status.INFEASIBLE
    assert Optimality(np.nan, 0.0, 0.0, "").judge(Status.SOLVED, "", options)[0] is Status.FAILED
    assert Optimality(1.0, np.nan, 0.0, "").judge(Status.SOLVED, "", options)[0] is Status.INACCURATE


def test_bounds_for_fatrop_make_up_for_its_relaxation() -> None:
    lower, upper = np.array([-np.inf, 0.0, 7.0, 1.0]), np.array([100.0, np.inf, 7.0, 1.0 + 1e-9])
    inner, outer = tightened(lower, upper)
    np.testing.assert_array_equal(inner, [-np.inf, FATROP_RELAXES, 7.0, 1.0])
    np.testing.assert_array_equal(outer, [100.0 - 100 * FATROP_RELAXES, np.inf, 7.0, 1.0 + 1e-9])


class Lazy:
    """A QP backend that always answers zero and calls it a solution."""

    name, dense, warm_starts, extra = "lazy", True, False, None
    calls = 0

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None:
        self.size, self.rows = q.size, l.size

    def update(self, P: Any, A: Any) -> None:
        return

    def solve(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Any = None) -> QPResult:
        type(self).calls += 1
        return QPResult(np.zeros(self.size), np.zeros(self.rows), Status.SOLVED)


def test_sqp_calls_the_named_backend_and_does_not_believe_it(monkeypatch: pytest.MonkeyPatch) -> None:
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda kind, name: Lazy if name == "lazy" else load(kind, name))
    p = Problem("curve")
    x = p.variables("x", Vector(2))
    p.cost("c", lambda x: ca.vertcat(x[0] - 1, 10 * (x[1] - x[0] ** 2)), x)
    session = p.compile("sqp:lazy")
    assert session.solver == "sqp:lazy"
    solution = session.solve(initial={"x": [0.5, 0.1]})
    assert Lazy.calls >= 1 and solution.status is Status.INACCURATE
    solved = p.compile("sqp:osqp").solve(initial={"x": [0.5, 0.1]})
    assert solved.status is Status.SOLVED and solved.method == "sqp:osqp"
    np.testing.assert_allclose(solved["x"], [[1, 1]], atol=1e-6)


def test_named_errors() -> None:
    problem, _, _ = ring()
    with pytest.raises(SettingError, match="sqp:osqp"):
        problem.compile("sqp")
    with pytest.raises(FormError, match="no QP backend"):
        problem.compile("sqp:ipopt")
    with pytest.raises(UnknownNameError):
        problem.compile("sqp:nothing")
    with pytest.raises(UnknownNameError):
        problem.compile("ipopt:ma57")
    with pytest.raises(SettingError, match="max_iter"):
        problem.compile("ipopt", max_itr=3)
    with pytest.raises(SettingError, match="mu_init"):
        problem.compile("ipopt", mu_init="small")
    with pytest.raises(FormError, match="nonlinear"):
        problem.compile("ipopt", form="quadratic")
