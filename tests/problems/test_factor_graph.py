"""Factor graphs: what each term becomes, costs and optima equal to ours, refusals, honest statuses."""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, SO2, Cauchy, Gaussian, GemanMcClure, Huber, Problem, Tukey, Vector, wrap
from problems.errors import DataError, DefinitionError, FormError, SlowPathWarning, UnknownNameError
from problems.forms import native_factors
from problems.forms.factor_graph import FactorGraph
from problems.forms.least_squares import LeastSquares
from problems.forms.native_factors import NativeFactor, register_native
from problems.noise import Loss
from problems.solvers.base import Status
from problems.solvers.gtsam_solvers import GtsamSession
from problems.spatial import SE3, SO3

gtsam = pytest.importorskip("gtsam")
OPTIMIZERS = ["gtsam-lm", "gtsam-gn", "gtsam-dogleg", "gtsam-isam2"]
LINEAR = 0.05 * np.arange(6.0)
LOSSES = [None, Huber(0.7), Cauchy(0.8), GemanMcClure(1.5), Tukey(3.0)]


def window(horizon: int = 8, bend: float = 0.0) -> Problem:
    A, B = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.0], [0.1]])
    p = Problem("window")
    x, w = p.variables("x", Vector(2), horizon + 1), p.variables("w", Vector(1), horizon)
    y, prior, M, slope = p.data("y", (), horizon + 1), p.data("prior", 2), p.data("M", (2, 2)), p.data("slope", 2)
    p.cost("arrival", lambda x, z: x - z, x[0], prior, Gaussian(information=M), linear=slope)
    p.cost("output", lambda x, y: x[0] - y, x, y, Gaussian(0.1))
    p.cost("noise", lambda w: w, w, noise=Gaussian(2.0))
    p.equality("model", lambda x, w, n: A @ x + B @ w - n + bend * ca.vertcat(0, x[0] * x[1]), (x[:-1], w, x[1:]))
    return p


def window_data(seed: int = 0, horizon: int = 8) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    y = np.sin(0.7 * np.arange(horizon + 1)) + 0.1 * rng.normal(size=horizon + 1)
    y[3] = np.nan
    return {"y": y, "prior": rng.normal(size=2), "M": [[2.0, 0.3], [0.3, 1.0]], "slope": rng.normal(size=2)}


@pytest.mark.parametrize("solver", OPTIMIZERS)
def test_a_window_as_a_graph_equals_the_quadratic_program(solver: str) -> None:
    problem, data = window(), window_data()
    reference = problem.compile("auto").solve(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # everything is linear: no slow path
        session = problem.compile(solver, tolerance=1e-12)
    solution = session.solve(data)
    assert solution.status is Status.SOLVED, solution
    np.testing.assert_allclose(solution.point, reference.point, atol=1e-8)
    assert solution.objective == pytest.approx(reference.objective, rel=1e-10)
    np.testing.assert_allclose(solution.multipliers["model"], reference.multipliers["model"], atol=1e-6)
    again = session.solve(window_data(1))
    np.testing.assert_allclose(again.point, problem.compile("auto").solve(window_data(1)).point, atol=1e-8)
    x = problem.unknowns["x"]
    np.testing.assert_allclose(again.covariance(x), problem.compile("auto").solve(window_data(1)).covariance(x), 1e-8)


def test_nonlinear_equalities_go_to_gauss_newton_only() -> None:
    problem, data = window(bend=0.3), window_data()
    reference = problem.compile("ipopt").solve(data)
    with pytest.warns(SlowPathWarning) as caught:
        assert FactorGraph(problem).terms[-1].kind == "constraint"
        solution = problem.compile("gtsam-gn").solve(data)
    assert all("model" in str(w.message) for w in caught)
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.point, reference.point, atol=1e-6)
    for solver in ("gtsam-lm", "gtsam-dogleg"):
        with pytest.raises(FormError, match="equality 'model' is not affine"), pytest.warns(SlowPathWarning):
            problem.compile(solver)


def bearing(T: Any, x: Any, z: Any) -> Any:
    local = T.transform_to(x)
    return ca.vertcat(ca.norm_2(local) - z[0], wrap(ca.atan2(local[1], local[0]) - z[1]))


def mixed(loss: Loss | None = None) -> tuple[Problem, dict[str, Any], dict[str, Any]]:
    """Linear and custom terms on every space, diagonal and full noise, shared data, missing rows."""
    rng = np.random.default_rng(3)
    p = Problem("mixed")
    pose, mark = p.variables("pose", SE2, 3), p.variables("mark", Vector(2), 2)
    turn, far, spin = p.variables("turn", SO2), p.variables("far", SE3, 2), p.variables("spin", SO3)
    z, fix, W = p.data("z", 2, 4), p.data("fix", 3, 3), p.data("W", (2, 2), 4)
    p.cost("seen", bearing, (pose[[0, 1, 2, 2]], mark[[0, 0, 1, 0]]), z, Gaussian(information=W), loss)
    p.cost("fixed", lambda T, z: ca.vertcat(T.translation, T.angle) - z, pose, fix, Gaussian([0.5, 0.7, 0.2]), loss)
    p.cost("near", lambda x: x, mark, noise=Gaussian(sigma=3.0))
    p.cost("turned", lambda T, R: ca.sin(T.angle - R.angle), (pose, turn), noise=Gaussian(0.5), loss=loss)
    p.cost("moved", lambda a, b: a.between(b).log(), (far[0], far[1]), noise=Gaussian(2.0), linear=LINEAR)
    p.cost("placed", lambda a: a.log(), far, noise=Gaussian(sigma=[1.0, 2.0, 3.0, 1.0, 1.0, 1.0]))
    p.cost("spun", lambda R, T: R.between(T.rotation).log(), (spin, far[1]), noise=Gaussian(0.3))
    data = {
        "z": np.column_stack([rng.uniform(1, 4, 4), rng.uniform(-1, 1, 4)]),
        "fix": rng.normal(size=(3, 3)),
        "W": np.stack([L @ L.T + np.eye(2) for L in rng.normal(size=(4, 2, 2))]),
    }
    data["z"][2, 0] = np.nan
    one = np.tile(SE3.identity(), (2, 1))
    point = {
        "pose": data["fix"] + 0.1 * rng.normal(size=(3, 3)),
        "mark": rng.normal(size=(2, 2)),
        "turn": [[0.3]],
        "far": SE3.retract_array(one, 0.5 * rng.normal(size=(2, 6))),
        "spin": SO3.retract_array(SO3.identity()[None], rng.normal(size=(1, 3))),
    }
    return p, data, point


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
@pytest.mark.parametrize("loss", LOSSES, ids=repr)
def test_the_error_of_the_graph_is_the_cost_up_to_the_completed_squares(loss: Loss | None) -> None:
    problem, data, point = mixed(loss)
    form = FactorGraph(problem)
    graph, values, key = form.to_gtsam(data, point)
    # seen, one of it missing; fixed; near; turned; moved; placed; spun
    assert graph.size() == 3 + 3 + 2 + 3 + 1 + 2 + 1
    np.testing.assert_allclose(values.atPose2(key("pose", 2)).theta(), point["pose"][2, 2], rtol=1e-12)
    np.testing.assert_allclose(form.point(values), form.layout.point(point), rtol=1e-12, atol=1e-12)
    session = problem.compile("gauss-newton")
    session.update(**data)
    bound = LeastSquares(problem, form.layout).bind(session.store)
    here = form.layout.point(point)
    there = form.layout.retract(here, 0.2 * np.random.default_rng(4).normal(size=form.layout.size))
    completed = 0.5 * float((LINEAR**2 * 4).sum())  # of `moved`: linear' W^-1 linear / 2
    for x in (here, there):
        assert graph.error(form.gtsam_values(x)) == pytest.approx(bound.cost(x) + completed, rel=1e-12)


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
@pytest.mark.parametrize("solver", OPTIMIZERS)
@pytest.mark.parametrize("loss", LOSSES, ids=repr)
def test_mixed_problems_have_one_optimum(loss: Loss | None, solver: str) -> None:
    problem, data, point = mixed(loss)
    ours = problem.compile("gauss-newton", tolerance=1e-13).solve(data, initial=point)
    theirs = problem.compile(solver, tolerance=1e-11).solve(data, initial=point)
    assert theirs.objective == pytest.approx(ours.objective, rel=1e-8)
    assert theirs.status is Status.SOLVED, theirs
    for name in ("pose", "mark", "turn"):
        np.testing.assert_allclose(theirs[name], ours[name], atol=2e-5)
    assert np.abs(SE3.local_array(theirs["far"], ours["far"])).max() < 1e-5


def test_terms_and_reasons_are_shown() -> None:
    problem, _, _ = mixed()
    with pytest.warns(SlowPathWarning) as caught:
        form = FactorGraph(problem)
    kinds = {t.name: t.kind for t in form.terms}
    assert kinds == {
        "seen": "custom",
        "fixed": "custom",
        "near": "linear",
        "turned": "custom",
        "moved": "custom",
        "placed": "custom",
        "spun": "custom",
    }
    assert len(caught) == 6 and "cost 'seen'" in str(caught[0].message) and "bearing" in str(caught[0].message)
    assert "'near': 2 linear factor(s)" in repr(form) and "SE2 x Vector(2)" in repr(form)


def test_keys_are_symbols() -> None:
    p = Problem("names")
    p.variables("robot", SE2, 3)
    p.variables("range_bias", Vector(1))
    p.cost("c", lambda x: x, p.unknowns["range_bias"])
    form = FactorGraph(p)
    symbol = gtsam.Symbol(form.key("robot", 2))
    assert (chr(symbol.chr()), symbol.index()) == ("r", 2)
    assert len({form.key("robot", k) for k in range(3)} | {form.key("range_bias")}) == 4
    with pytest.raises(UnknownNameError, match="robot"):
        form.key("robots")
    with pytest.raises(DefinitionError, match="3 instance"):
        form.key("robot", 3)


def test_one_instance_in_two_slots_is_one_key() -> None:
    p = Problem("repeated")
    x = p.variables("x", Vector(2), 2)
    with pytest.warns(SlowPathWarning):
        p.cost("linear", lambda a, b: 2 * a - b - 1, (x[[0, 0]], x[[0, 1]]), noise=Gaussian(0.5))
        p.cost("curved", lambda a, b: ca.sin(a) - b, (x[[0, 0]], x[[0, 1]]), noise=Gaussian(0.5))
        theirs = p.compile("gtsam-lm").solve(initial={"x": np.ones((2, 2))})
    ours = p.compile("gauss-newton", tolerance=1e-12).solve(initial={"x": np.ones((2, 2))})
    assert theirs.status is Status.SOLVED
    np.testing.assert_allclose(theirs["x"], ours["x"], atol=1e-6)


def test_inequalities_are_refused_with_the_reason() -> None:
    p = Problem("bounded")
    x = p.variables("x", Vector(2))
    p.cost("c", lambda x: x - 1, x)
    p.inequality("limit", lambda x: x, x)
    for lower in (lambda: FactorGraph(p), lambda: p.compile("gtsam-lm")):
        with pytest.raises(FormError, match="inequality 'limit'.*gauss-newton.*ipopt"):
            lower()


def test_linear_parts_where_nothing_is_known_are_refused() -> None:
    p = Problem("arrival")
    x, M, m = p.variables("x", Vector(2)), p.data("M", (2, 2)), p.data("m", 2)
    p.cost("arrival", lambda x: x, x, noise=Gaussian(information=M), linear=m)
    p.cost("other", lambda x: x - 1, x)
    session = p.compile("gtsam-lm")
    half = np.diag([4.0, 0.0])
    solution = session.solve({"M": half, "m": [2.0, 0.0]})
    np.testing.assert_allclose(solution["x"], [[-1 / 5, 1]], atol=1e-9)
    with pytest.raises(DataError, match="'arrival'.*instance 0"):
        session.solve({"M": half, "m": [2.0, 1.0]})


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registrations of one test."""
    native_factors.native_factor(lambda: None, ())  # what is installed is loaded once
    monkeypatch.setattr(native_factors, "_REGISTERED", dict(native_factors._REGISTERED))


@pytest.mark.usefixtures("registered")
def test_a_registered_factor_is_used_if_it_is_the_residual() -> None:
    def make(order: tuple[int, ...] | None) -> Problem:
        def residual(T: Any, x: Any, z: Any) -> Any:
            return bearing(T, x, z)

        def build(i: int, j: int, z: np.ndarray, noise: Any) -> Any:
            return gtsam.BearingRangeFactor2D(i, j, gtsam.Rot2(z[1]), z[0], noise)

        register_native(residual, (SE2, Vector(2)), build, order)
        p = Problem("sight")
        T, x, z = p.variables("T", SE2), p.variables("x", Vector(2)), p.data("z", 2)
        p.cost("seen", residual, (T, x), z, Gaussian([0.1, 0.03]))
        return p

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        form = FactorGraph(make((1, 0)))
    assert form.terms[0].kind == "native"
    data, point = {"z": [2.0, 0.4]}, {"T": [0.1, 0.2, 0.3], "x": [1.5, 1.0]}
    graph, values, _ = form.to_gtsam(data, point)
    assert type(graph.at(0)).__name__ == "BearingRangeFactor2D"
    for wrong in (None, (0, 1)):
        with pytest.warns(SlowPathWarning, match="is not that residual"):
            other = FactorGraph(make(wrong))
        assert other.terms[0].kind == "custom"
        # the same cost all the same
        assert other.to_gtsam(data, point)[0].error(values) == pytest.approx(graph.error(values), rel=1e-12)


@pytest.mark.usefixtures("registered")
def test_a_second_factor_for_a_residual_is_an_error() -> None:
    def build(*_: Any) -> None:
        return None

    register_native(bearing, (SE2, Vector(2)), build)
    register_native(bearing, (SE2, Vector(2)), build)
    assert native_factors.native_factor(bearing, (SE2, Vector(2))) == NativeFactor(build)
    assert native_factors.native_factor(bearing, (SE2, SE2)) is None
    with pytest.raises(DefinitionError, match="bearing"):
        register_native(bearing, (SE2, Vector(2)), lambda *_: None)


def line() -> Problem:
    p = Problem("line")
    x, z = p.variables("x", Vector(1), 3), p.data("z", (), 3)
    p.cost("fix", lambda x, z: x - z, x, z)
    p.cost("smooth", lambda a, b: a - b, (x[:-1], x[1:]))
    return p


def test_factors_are_kept_while_their_data_are_the_same() -> None:
    session = line().compile("gtsam-lm")
    assert isinstance(session, GtsamSession)
    made: list[str] = []
    factors = session.graph.factors
    session.graph.factors = lambda term, *rest: made.append(term.name) or factors(term, *rest)  # type: ignore[method-assign]
    session.update(z=[1.0, 2.0, 3.0])
    assert made == ["fix", "smooth"]
    first = session.solve()
    assert made == ["fix", "smooth"] and set(first.seconds) == {"setup", "update", "solve"}
    session.solve({"z": [1.0, np.nan, 3.0]})
    assert made == ["fix", "smooth", "fix"]
    fork = session.fork()
    fork.solve({"z": [7.0, 8.0, 9.0]})
    session.solve()
    assert made == ["fix", "smooth", "fix", "fix"]
    np.testing.assert_allclose(session.solve({"z": [1.0, 2.0, 3.0]})["x"], first["x"], atol=1e-9)


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
def test_limits_and_crashes_are_statuses(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, data, point = mixed()
    few = problem.compile("gtsam-lm", iteration_limit=1).solve(data, initial=point)
    assert few.status is Status.ITERATION_LIMIT and few.iterations == 1
    short = problem.compile("gtsam-gn", time_limit=1e-9).solve(data, initial=point)
    assert short.status is Status.TIME_LIMIT and short.iterations == 1
    session = problem.compile("gtsam-dogleg")
    with monkeypatch.context() as patch:
        patch.setattr(gtsam, "DoglegOptimizer", lambda *_: (_ for _ in ()).throw(RuntimeError("out of order")))
        broken = session.solve(data, initial=point)
    assert broken.status is Status.FAILED and "out of order" in broken.message
    assert session.solve(data, initial=point).status is Status.SOLVED


@pytest.mark.parametrize("solver", OPTIMIZERS)
def test_what_is_missing_can_leave_unknowns_free(solver: str) -> None:
    p = Problem("loose")
    x, z = p.variables("x", Vector(1), 3), p.data("z", (), 3)
    p.cost("fix", lambda x, z: x - z, x, z)
    session = p.compile(solver)
    loose = session.solve({"z": [1.0, np.nan, 3.0]})
    assert loose.status is Status.UNBOUNDED and "x[1]" in loose.message
    np.testing.assert_allclose(session.solve({"z": [1.0, 2.0, 3.0]})["x"][:, 0], [1, 2, 3], atol=1e-8)


def test_a_fixed_value_is_exact() -> None:
    """Pinned instances of every kind; their gauge is gone and their covariance zero."""
    rng = np.random.default_rng(6)
    p = Problem("pinned")
    x, T, at = p.variables("x", Vector(2), 3), p.variables("T", SE2, 2), p.data("at", 2)
    p.cost("steps", lambda a, b: b - a - 1, (x[:-1], x[1:]), noise=Gaussian(0.1))
    p.cost("placed", lambda x, T: T.translation - x, (x[1:], T), noise=Gaussian(0.5))
    p.cost("turned", lambda a, b: a.between(b).angle, (T[0], T[1]), noise=Gaussian(0.5))
    p.equality("start", lambda x, z: x - z, x[0], at)
    p.equality("pose", lambda T: ca.vertcat(T.translation - 1, T.angle - 0.5), T[0])
    with pytest.warns(SlowPathWarning):
        session = p.compile("gtsam-lm")
    solution = session.solve({"at": [2.0, 3.0]}, initial={"x": rng.normal(size=(3, 2))})
    ours = p.compile("gauss-newton", tolerance=1e-12).solve({"at": [2.0, 3.0]})
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution["x"][0], [2, 3], atol=1e-14)
    np.testing.assert_allclose(solution.point, ours.point, atol=1e-6)
    assert not solution.covariance(x[0]).any()
    np.testing.assert_allclose(session.solve({"at": [0.0, 0.0]})["x"][0], 0, atol=1e-14)
