"""Sessions: nothing is built twice, forks do not meet, what a solution tells is true, failures are statuses."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.optimize

import problems.solvers.qp_session as qp_session
from problems import SE2, Cauchy, Gaussian, Huber, Problem, Vector, registry, wrap
from problems.errors import DataError, FormError, MissingExtraError, UnknownNameError, UnobservableError
from problems.solvers.base import Status
from problems.solvers.qp_projection import Projection
from problems.solvers.qp_support import Backend

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
N = 4
QP = ["auto", "daqp", "proxqp", "osqp"]
ALL = [*QP, "gauss-newton"]


def window() -> Problem:
    """States in a box, weights and a matrix as data."""
    p = Problem("window")
    x, w = p.variables("x", Vector(2), N + 1), p.variables("w", Vector(2), N)
    y, C, R = p.data("y", 1, N + 1), p.data("C", (1, 2), value=[[1.0, 0.3]]), p.data("R", (), value=0.5)
    prior, P = p.data("prior", 2, value=[0.0, 0.0]), p.data("P", (2, 2), value=np.eye(2))
    on = p.data("on", (), N + 1, value=np.ones(N + 1))
    p.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(covariance=P))
    p.cost("output", lambda x, y, C: y - C @ x, on=x, data=(y, C), noise=Gaussian(R), active=on)
    p.cost("effort", lambda w: w, on=w, noise=Gaussian(0.4))
    p.equality("moves", lambda x, w, n: n - A @ x - w, on=(x[:-1], w, x[1:]))
    p.inequality("box", lambda x: x, on=x, lower=-0.5, upper=0.5)
    return p


def outputs(seed: int, scale: float = 4.0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(N + 1, 1))


def sequence(seed: int, steps: int = 6) -> list[dict[str, Any]]:
    """Data of several solves: measurements, some missing, now and then new weights."""
    rng = np.random.default_rng(seed)
    out: list[dict[str, Any]] = []
    for k in range(steps):
        y = 3.0 * rng.normal(size=(N + 1, 1))
        y[rng.random(N + 1) < 0.2] = np.nan
        out.append({"y": y})
        if k % 3 == 2:
            out[-1]["P"] = (1 + rng.random()) * np.eye(2)
            out[-1]["R"] = 0.3 + rng.random()
        if k % 3 == 1:
            out[-1]["C"] = np.array([[1.0, rng.random()]])
    return out


def team(count: int = 5, fence: float | None = None, loss: Any = None, gauge: bool = False) -> tuple[Problem, Any, Any]:
    """Robots on a line that see their neighbours' range and bearing."""
    p = Problem("team")
    robot = p.variables("robot", SE2, count)
    i = np.arange(count - 1)
    gps, heading = p.data("gps", 2, count), p.data("heading", (), count)
    z = p.data("z", 2, count - 1)

    def see(a: Any, b: Any, z: Any) -> Any:
        local = a.transform_to(b.translation)
        return ca.vertcat(ca.norm_2(local) - z[0], wrap(ca.atan2(local[1], local[0]) - z[1]))

    p.cost("see", see, on=(robot[i], robot[i + 1]), data=z, noise=Gaussian([0.1, 0.05]), loss=loss)
    p.cost("heading_", lambda T, z: wrap(T.angle - z), on=robot, data=heading, noise=Gaussian(0.1))
    if not gauge:
        p.cost("gps_", lambda T, z: T.translation - z, on=robot, data=gps, noise=Gaussian(1.0))
    if fence is not None:
        p.inequality("fence", lambda T: T.translation[0] + 0.02 * T.translation[1] ** 2, on=robot, upper=fence)
    return p, robot, z


def team_data(count: int = 5, seed: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    rng = np.random.default_rng(seed)
    truth = np.column_stack([2.0 * np.arange(count), rng.normal(size=count), rng.uniform(-3, 3, count)])
    d = truth[1:, :2] - truth[:-1, :2]
    bearing = wrap(np.arctan2(d[:, 1], d[:, 0]) - truth[:-1, 2])
    z = np.column_stack([np.linalg.norm(d, axis=1), bearing]) + [0.1, 0.05] * rng.normal(size=(count - 1, 2))
    data = {
        "gps": truth[:, :2] + rng.normal(size=(count, 2)),
        "heading": wrap(truth[:, 2] + 0.1 * rng.normal(size=count)),
        "z": z,
    }
    return data, {"robot": np.column_stack([data["gps"], data["heading"]])}


def team_residuals(point: np.ndarray, data: dict[str, Any]) -> np.ndarray:
    """Whitened residuals in NumPy, range-bearing pairs first."""
    T = point.reshape(-1, 3)
    d = T[1:, :2] - T[:-1, :2]
    c, s = np.cos(T[:-1, 2]), np.sin(T[:-1, 2])
    u, v = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    see = np.column_stack([np.hypot(u, v) - data["z"][:, 0], wrap(np.arctan2(v, u) - data["z"][:, 1])]) / [0.1, 0.05]
    return np.concatenate([see.ravel(), wrap(T[:, 2] - data["heading"]) / 0.1, (T[:, :2] - data["gps"]).ravel()])


def differences(function: Any, at: np.ndarray) -> np.ndarray:
    """Derivatives in tangent coordinates of the SE2 point `at` (n, 3) by central differences."""
    h, out = 1e-6, []
    for e in np.eye(at.size):
        up, down = (SE2.retract_array(at, s * h * e.reshape(at.shape)) for s in (1, -1))
        out.append((np.asarray(function(up)) - np.asarray(function(down))) / (2 * h))
    return np.stack(out, axis=-1)


# --- set up once -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["auto", "daqp", "proxqp", "osqp", "piqp"])
def test_a_second_solve_constructs_nothing(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    kind = registry.load("solvers", "daqp" if solver == "auto" else solver)
    for name in ("__init__", "_build"):
        original = getattr(kind, name)

        def counted(self: Any, *a: Any, original: Any = original, name: str = name) -> Any:
            made.append(name)
            return original(self, *a)

        monkeypatch.setattr(kind, name, counted)
    maps: list[int] = []
    dense_map = qp_session.DenseMap
    monkeypatch.setattr(qp_session, "DenseMap", lambda *a: maps.append(1) or dense_map(*a))
    session = window().compile(solver)
    first = session.solve({"y": outputs(0)})
    assert first.solved and first.method == solver
    assert made == ["__init__", "_build"]
    before = len(maps)
    for k in range(1, 8):
        assert session.solve({"y": outputs(k)}).solved
    assert made == ["__init__", "_build"] and len(maps) == before


def test_a_second_solve_of_a_graph_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    p, *_ = team(fence=5.0)
    data, initial = team_data()
    session = p.compile("gauss-newton")
    assert session.solve(data, initial).solved
    made: list[str] = []
    real = ca.Function
    monkeypatch.setattr(ca, "Function", lambda *a, **k: made.append("function") or real(*a, **k))
    monkeypatch.setattr(Backend, "__init__", lambda *a: made.append("backend"))
    for seed in range(1, 4):
        data, initial = team_data(seed=seed)
        assert session.solve(data, initial).solved
    assert made == []


def test_the_maps_of_patterns_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    maps: list[int] = []
    dense_map = qp_session.DenseMap
    monkeypatch.setattr(qp_session, "DenseMap", lambda *a: maps.append(1) or dense_map(*a))
    session = window().compile()
    session.solve({"y": outputs(0)})
    maps.clear()
    holes = [outputs(k) for k in range(4)]
    for k, y in enumerate(holes):
        y[k] = np.nan
    for _ in range(3):
        for y in holes:
            session.solve({"y": y})
    assert len(maps) == 4
    for _ in range(3):
        session.solve({"y": outputs(1), "on": [1, 1, 0, 1, 1]})
        session.solve({"on": [1, 1, 1, 1, 1]})
    assert len(maps) == 5
    session.solve({"R": 0.5, "P": np.eye(2), "C": [[1.0, 0.3]]})  # the same numbers again
    assert len(maps) == 5
    session.solve({"R": 0.6})
    assert len(maps) == 6


# --- ways to the same answer -----------------------------------------------------------------------------------------


def equal(got: np.ndarray, want: np.ndarray, solver: str) -> None:
    """To the bit; proxqp rounds by where its memory happens to lie, auto by whether it knows the weights."""
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 if solver in ("auto", "proxqp") else 0.0)


@pytest.mark.parametrize("solver", ALL)
def test_update_and_solve_are_one(solver: str) -> None:
    p = window()
    one, two = p.compile(solver), p.compile(solver)
    for data in sequence(1):
        a = one.solve(data)
        two.update(**{k: v for k, v in data.items() if k != "y"})
        two.update(y=data["y"])
        b = two.solve()
        equal(a.point, b.point, solver)
        assert a.status is b.status


@pytest.mark.parametrize("solver", ALL)
def test_a_session_equals_a_new_one_at_every_step(solver: str) -> None:
    p = window()
    session, known = p.compile(solver), {}
    for data in sequence(2, 9):
        known |= data
        a, b = session.solve(data), p.compile(solver).solve(known)
        assert a.solved and b.solved
        np.testing.assert_allclose(a.point, b.point, atol=1e-6)
        assert a.objective == pytest.approx(b.objective, rel=1e-7)


@pytest.mark.parametrize("solver", ["daqp", "proxqp", "osqp", "piqp"])
def test_warm_and_cold_starts_find_the_same(solver: str) -> None:
    p = window()
    warm, cold = p.compile(solver), p.compile(solver, warm=False)
    for data in sequence(3, 8):
        a, b = warm.solve(data), cold.solve(data)
        assert a.solved and b.solved
        np.testing.assert_allclose(a.point, b.point, atol=1e-6)


@pytest.mark.parametrize("solver", ALL)
def test_all_solvers_agree(solver: str) -> None:
    p = window()
    reference, session = p.compile("daqp", tolerance=1e-10), p.compile(solver)
    for data in sequence(4, 8):
        a, b = reference.solve(data), session.solve(data)
        assert b.solved
        np.testing.assert_allclose(b.point, a.point, atol=1e-6)
        np.testing.assert_array_equal(b.active_set["box"], a.active_set["box"])
        for name, y in a.multipliers.items():
            np.testing.assert_allclose(b.multipliers[name], y, atol=1e-5 * max(1.0, np.abs(y).max()))


@pytest.mark.parametrize("solver", ["auto", "daqp", "gauss-newton"])
def test_equalities_may_come_and_go_with_the_data_under_active_rows(solver: str) -> None:
    p = Problem()
    x, y = p.variables("x", Vector(1), 3), p.data("y", 1, 3)
    p.cost("level", lambda x: x - 1, on=x)
    p.equality("seen", lambda x, y, there: there * (x - y), on=x, data=(y, p.presence(y)))
    p.inequality("top", lambda x: x, on=x, upper=0.5)
    session = p.compile(solver)
    for y in ([0.0, np.nan, 0.2], [np.nan] * 3, [0.1, 0.2, np.nan], [0.0, 0.1, 0.2], [0.3, np.nan, np.nan]):
        got = session.solve({"y": y})
        assert got.solved
        np.testing.assert_allclose(got["x"].ravel(), np.where(np.isnan(y), 0.5, y), atol=1e-7)
    assert session.solve({"y": [0.0, 0.7, 0.2]}).status is Status.INFEASIBLE


def test_auto_answers_linearly_until_a_row_is_violated_and_a_named_solver_is_always_called() -> None:
    p = window()
    auto, named = p.compile(), p.compile("daqp")
    small, large = {"y": 0.01 * outputs(0)}, {"y": 3 * outputs(0)}
    assert (auto.solve(small).method, auto.solve(large).method) == ("linear", "auto")
    assert auto.solve(small).iterations == 0
    assert named.solve(small).method == named.solve(large).method == "daqp"
    np.testing.assert_allclose(auto.solve(small).point, named.solve(small).point, atol=1e-9)
    np.testing.assert_allclose(auto.solve(large).point, named.solve(large).point, atol=1e-7)
    assert not auto.solve(small).active_set["box"].any()


# --- forks -----------------------------------------------------------------------------------------------------------


def fork_case(solver: str) -> tuple[Any, list[dict[str, Any]], list[dict[str, Any]]]:
    """A session that has solved once, and the data of two forks."""
    if solver != "fence":
        session = window().compile(solver)
        session.solve({"y": outputs(9)})
        return session, sequence(5), sequence(6)
    p, *_ = team(fence=5.0)
    session = p.compile("gauss-newton")
    session.solve(*team_data(seed=9))
    return session, [team_data(seed=k)[0] for k in range(3)], [team_data(seed=k)[0] for k in range(3, 6)]


@pytest.mark.parametrize("solver", [*ALL, "fence"])
def test_forks_do_not_meet(solver: str) -> None:
    base, first, second = fork_case(solver)
    alone = []
    for steps in (first, second):
        fork = base.fork()
        alone.append([fork.solve(data).point.copy() for data in steps])
    one, two = base.fork(), base.fork()
    for a, b, want_a, want_b in zip(first, second, *alone, strict=True):
        equal(one.solve(a).point, want_a, solver)
        equal(two.solve(b).point, want_b, solver)
    again = base.fork()
    equal(again.solve(first[0]).point, alone[0][0], solver)


@pytest.mark.parametrize("solver", ALL)
def test_a_fork_owns_its_data(solver: str) -> None:
    base = window().compile(solver)
    want = base.solve({"y": outputs(0)}).point.copy()
    fork = base.fork()
    fork.update(y=outputs(1), R=3.0)
    np.testing.assert_allclose(base.solve().point, want, atol=1e-7)
    np.testing.assert_allclose(base.fork().solve().point, want, atol=1e-7)
    assert np.abs(fork.solve().point - want).max() > 1e-3


@pytest.mark.parametrize("solver", [*ALL, "fence"])
def test_reset_forgets_what_was_solved(solver: str) -> None:
    def fresh() -> Any:
        if solver == "fence":
            return team(fence=5.0)[0].compile("gauss-newton")
        return window().compile(solver)

    steps = [team_data(seed=k) for k in range(2)] if solver == "fence" else [(d, None) for d in sequence(7, 3)]
    used = fresh()
    for data, initial in steps:
        used.solve(data, initial)
    used.reset()
    new = fresh()
    data, initial = steps[0]
    if solver != "fence":
        known: dict[str, Any] = {}
        for d, _ in steps:
            known |= d
        data = known
    equal(used.solve(data, initial).point, new.solve(data, initial).point, solver)


@pytest.mark.parametrize("solver", ALL)
def test_a_solution_stays_what_it_was(solver: str) -> None:
    session = window().compile(solver)
    solution = session.solve({"y": outputs(0)})
    point = solution.point.copy()
    other = window()
    copy = other.compile(solver).solve({"y": outputs(0)})
    session.solve({"y": outputs(1), "R": 2.0, "P": 3 * np.eye(2), "on": [0, 1, 1, 1, 1]})
    np.testing.assert_array_equal(solution.point, point)
    # computed only now, from the data of its own solve
    assert solution.objective == pytest.approx(copy.objective, rel=1e-9)
    for name, y in copy.multipliers.items():
        np.testing.assert_allclose(solution.multipliers[name], y, atol=1e-9)
    x, x_copy = session.problem.unknowns["x"], other.unknowns["x"]
    np.testing.assert_allclose(solution.covariance(x), copy.covariance(x_copy), atol=1e-10)
    assert max(solution.residuals.values()) < 1e-6


# --- what a solution tells -------------------------------------------------------------------------------------------


def test_a_solution_has_values_names_and_times() -> None:
    session = window().compile()
    assert session.compile_seconds > 0 and session.solver == "auto" and session.form == "quadratic"
    session.update(y=outputs(0))
    solution = session.solve()
    assert set(solution.values) == {"x", "w"} and solution["w"].shape == (N, 2)
    np.testing.assert_array_equal(solution["x"], solution.values["x"])
    assert set(solution.seconds) >= {"update", "solve"} and min(solution.seconds.values()) >= 0
    assert session.solve().seconds["update"] == 0.0
    assert repr(solution).startswith("Solution: solved by auto")


@pytest.mark.parametrize("solver", ALL)
def test_multipliers_and_active_set_satisfy_the_optimality_conditions(solver: str) -> None:
    session = window().compile(solver)
    seen = 0
    for data in ({"y": outputs(k)} for k in range(4)):
        solution = session.solve(data)
        x, w, y = solution["x"], solution["w"], data["y"]
        lam, mu, state = solution.multipliers["moves"], solution.multipliers["box"], solution.active_set["box"]
        C = np.array([[1.0, 0.3]])
        g_x = -(y - x @ C.T) @ C / 0.25 + mu
        g_x[0] += x[0]
        g_x[1:] += lam
        g_x[:-1] -= lam @ A
        np.testing.assert_allclose(g_x, 0.0, atol=1e-6)
        np.testing.assert_allclose(w / 0.16 - lam, 0.0, atol=1e-6)
        np.testing.assert_allclose(x[1:], x[:-1] @ A.T + w, atol=1e-7)
        assert (np.abs(x) <= 0.5 + 1e-7).all()
        np.testing.assert_allclose(mu[state == 0], 0.0, atol=1e-6)
        assert (mu[state == 1] >= -1e-9).all() and (mu[state == -1] <= 1e-9).all()
        np.testing.assert_allclose(x[state != 0], 0.5 * state[state != 0], atol=1e-6)
        seen += int(np.abs(state).sum())
        cost = 0.5 * ((y - x @ C.T) ** 2).sum() / 0.25 + 0.5 * (w**2).sum() / 0.16 + 0.5 * x[0] @ x[0]
        assert solution.objective == pytest.approx(cost, rel=1e-9)
        assert set(solution.residuals) == {"primal", "dual", "gap"}
        assert max(solution.residuals.values()) < 1e-6
    assert seen > 4


@pytest.mark.parametrize("loss", [None, Huber(0.8)], ids=repr)
def test_constraints_on_manifolds_satisfy_the_optimality_conditions(loss: Any) -> None:
    p, *_ = team(fence=5.0, loss=loss)
    data, initial = team_data()
    solution = p.compile("gauss-newton", tolerance=1e-12).solve(data, initial)
    assert solution.solved

    def cost(T: np.ndarray) -> float:
        r = team_residuals(T, data)
        pairs = (r[:8].reshape(-1, 2) ** 2).sum(axis=1)
        return float(sum(s / 2 if loss is None else loss.rho(s) for s in pairs) + 0.5 * r[8:] @ r[8:])

    def fence(T: np.ndarray) -> np.ndarray:
        return T[:, 0] + 0.02 * T[:, 1] ** 2

    T, mu, state = solution["robot"], solution.multipliers["fence"].ravel(), solution.active_set["fence"].ravel()
    assert solution.objective == pytest.approx(cost(T), rel=1e-9)
    assert (fence(T) <= 5.0 + 1e-9).all() and state.sum() >= 1
    np.testing.assert_allclose(fence(T)[state == 1], 5.0, atol=1e-7)
    assert (mu >= 0).all() and (mu[state == 0] == 0).all()
    gradient = differences(cost, T) + mu @ differences(fence, T)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-5 * max(1.0, mu.max()))


def test_multipliers_of_pinned_instances() -> None:
    p = Problem()
    x = p.variables("x", Vector(2), 2)
    p.cost("pull", lambda x: x - 3, on=x)
    p.cost("step", lambda a, b: b - a, on=(x[0], x[1]), noise=Gaussian(0.5))
    p.equality("start", lambda x: 2 * x - 1, on=x[0])
    exact = p.compile("daqp").solve()
    graph = p.compile("gauss-newton").solve()
    np.testing.assert_allclose(graph["x"][0], 0.5)
    np.testing.assert_allclose(graph.point, exact.point, atol=1e-8)
    np.testing.assert_allclose(graph.multipliers["start"], exact.multipliers["start"], atol=1e-6)


def whole_hessian(session: Any, point: np.ndarray) -> np.ndarray:
    form = session.form_
    entries = form.bind(session.store).linearize(point)[2]
    n = form.pattern.size
    H = np.zeros((n, n))
    H[form.pattern.indices, np.repeat(np.arange(n), np.diff(form.pattern.indptr))] = entries
    return H + np.triu(H, 1).T


@pytest.mark.parametrize("solver", ALL)
def test_covariances_of_a_window(solver: str) -> None:
    p = window()
    session = p.compile(solver)
    y = outputs(0)
    y[2] = np.nan
    solution = session.solve({"y": y, "on": [1, 1, 1, 0, 1], "P": [[2.0, 0.5], [0.5, 1.0]]})
    # the covariance of (x_0, w_0, ..., w_3) from their information, then of every state
    M = [np.eye(2, 2 + 2 * N)]
    for k in range(N):
        M.append(A @ M[-1] + np.eye(2 + 2 * N)[2 + 2 * k : 4 + 2 * k])
    info = np.zeros((2 + 2 * N, 2 + 2 * N))
    info[:2, :2] = np.linalg.inv([[2.0, 0.5], [0.5, 1.0]])
    info[2:, 2:] = np.eye(2 * N) / 0.16
    C = np.array([[1.0, 0.3]])
    for k in (0, 1, 4):
        info += (C @ M[k]).T @ (C @ M[k]) / 0.25
    S = np.linalg.inv(info)
    x, w = p.unknowns["x"], p.unknowns["w"]
    np.testing.assert_allclose(solution.covariance(x[2]), M[2] @ S @ M[2].T, atol=1e-9)
    J = np.vstack([M[4], M[0]])
    np.testing.assert_allclose(solution.covariance(x[[4, 0]]), J @ S @ J.T, atol=1e-9)
    J = np.vstack([np.eye(10)[4:6], M[1]])
    np.testing.assert_allclose(solution.covariance(w[1], x[1]), J @ S @ J.T, atol=1e-9)


def test_covariances_on_manifolds_with_pins_and_equalities() -> None:
    p, robot, _ = team()
    data, initial = team_data()
    p.equality("start", lambda T: T.coordinates, on=robot[0])
    p.equality("level", lambda a, b: a.translation[1] - b.translation[1] - 0.3, on=(robot[1], robot[2]))
    session = p.compile("gauss-newton", tolerance=1e-12)
    solution = session.solve(data, initial)
    T = solution["robot"]
    np.testing.assert_allclose(T[0], 0.0, atol=1e-12)
    assert T[1, 1] - T[2, 1] == pytest.approx(0.3)
    J = differences(lambda T: team_residuals(T, data), T)
    F = np.vstack(
        [np.eye(3, 15), differences(lambda T: T[1, 1] - T[2, 1], T)[None]]
    )  # the pin leaves no step of robot 0
    Z = np.linalg.svd(F)[2][4:].T
    S = Z @ np.linalg.inv(Z.T @ J.T @ J @ Z) @ Z.T
    np.testing.assert_allclose(solution.covariance(robot[1:3]), S[3:9, 3:9], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(solution.covariance(robot[[2, 0]])[3:], 0.0, atol=1e-15)
    np.testing.assert_allclose(solution.covariance(robot[4], robot[1])[:3, 3:], S[12:15, 3:6], rtol=1e-5, atol=1e-8)
    assert np.linalg.matrix_rank(solution.covariance(robot[1:3]), 1e-9) == 5


def test_inequalities_do_not_count_in_a_covariance() -> None:
    data, initial = team_data()
    free, fenced = (team(fence=f)[0] for f in (None, 1e3))
    a, b = (p.compile("gauss-newton").solve(data, initial).covariance(p.unknowns["robot"]) for p in (free, fenced))
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def test_a_covariance_that_does_not_exist_is_named() -> None:
    p, robot, _ = team(gauge=True)
    data, initial = team_data()
    solution = p.compile("gauss-newton").solve(data, initial)
    assert solution.objective < 1e3
    with pytest.raises(UnobservableError, match=r"the costs leave robot\[0\] and 4 more free"):
        solution.covariance(robot[1])


# --- statuses --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ALL)
def test_a_pattern_that_hides_a_variable_is_a_status_and_the_session_goes_on(solver: str) -> None:
    p = Problem()
    x, z = p.variables("x", Vector(1), 2), p.data("z", (), 2)
    p.cost("see", lambda x, z: x - z, on=x, data=z)
    session = p.compile(solver)
    assert session.solve({"z": [1.0, 2.0]}).solved
    hidden = session.solve({"z": [3.0, np.nan]})
    assert hidden.status is Status.UNBOUNDED and "determine" in hidden.message or "x[1]" in hidden.message
    got = session.solve({"z": [4.0, 5.0]})
    assert got.solved
    np.testing.assert_allclose(got["x"].ravel(), [4.0, 5.0], atol=1e-7)


@pytest.mark.parametrize("solver", ALL)
def test_rows_that_cannot_hold_are_a_status_and_the_session_goes_on(solver: str) -> None:
    p = Problem()
    x, top = p.variables("x", Vector(2)), p.data("top", ())
    p.cost("pull", lambda x: x - 1, on=x)
    p.inequality("low", lambda x: x[0] + x[1], on=x, lower=0.5, upper=np.inf)
    p.inequality("high", lambda x: x[0] + x[1], on=x, upper=top)
    session = p.compile(solver)
    assert session.solve({"top": 1.0}).solved
    bad = session.solve({"top": 0.0})
    assert bad.status is Status.INFEASIBLE and bad.message
    got = session.solve({"top": 0.8})
    assert got.solved
    np.testing.assert_allclose(got["x"], [[0.4, 0.4]], atol=1e-6)


def test_limits_are_statuses_and_the_session_goes_on() -> None:
    p, *_ = team()
    data, initial = team_data()
    slow = p.compile("gauss-newton", time_limit=1e-9).solve(data, initial)
    assert slow.status is Status.TIME_LIMIT and slow.iterations == 0
    session = p.compile("gauss-newton", iteration_limit=1)
    short = session.solve(data, initial)
    assert short.status is Status.ITERATION_LIMIT and short.iterations == 1
    for _ in range(20):  # each solve starts where the last one stopped
        last = session.solve()
    exact = p.compile("gauss-newton").solve(data, initial)
    np.testing.assert_allclose(last["robot"], exact["robot"], atol=1e-4)
    qp = window().compile("osqp", iteration_limit=1)
    assert qp.solve({"y": outputs(0)}).status in (Status.ITERATION_LIMIT, Status.INACCURATE)


def test_a_cost_that_is_not_finite_is_a_status() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.cost("c", lambda x: ca.log(x), on=x)
    session = p.compile("gauss-newton")
    assert session.solve(initial={"x": [[-1.0]]}).status is Status.FAILED
    got = session.solve(initial={"x": [[0.5]]})
    assert got.solved and got["x"].item() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("solver", ["auto", "daqp"])
def test_a_backend_that_breaks_is_a_status_and_the_next_solve_starts_afresh(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = registry.load("solvers", "daqp")
    session = window().compile(solver)
    want = session.solve({"y": outputs(0)}).point

    def broken(*_: Any) -> Any:
        raise RuntimeError("the library crashed")

    with monkeypatch.context() as patch:
        patch.setattr(kind, "solve", broken)
        patch.setattr(Projection, "__call__", lambda *_: None)  # which would answer without the backend
        failed = session.solve({"y": outputs(1)})
        assert failed.status is Status.FAILED and "the library crashed" in failed.message
    np.testing.assert_allclose(session.solve({"y": outputs(0)}).point, want, atol=1e-9)


def test_a_backend_whose_package_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.load("solvers", "daqp"), "module", "no_such_package")
    with pytest.raises(MissingExtraError, match="solver daqp needs the package daqp"):
        window().compile("daqp").solve({"y": outputs(0)})


# --- Gauss-Newton ----------------------------------------------------------------------------------------------------


def test_gauss_newton_finds_the_optimum_of_scipy() -> None:
    p, *_ = team()
    for seed in range(3):
        data, initial = team_data(seed=seed)
        got = p.compile("gauss-newton", tolerance=1e-12).solve(data, initial)
        start = np.asarray(initial["robot"]).ravel()
        want = scipy.optimize.least_squares(team_residuals, start, args=(data,), xtol=1e-14, ftol=1e-14, gtol=1e-12)
        assert got.solved and got.objective == pytest.approx(want.cost, rel=1e-9)
        np.testing.assert_allclose(SE2.local_array(got["robot"], want.x.reshape(-1, 3)), 0.0, atol=1e-6)


@pytest.mark.parametrize("loss", [Huber(0.7), Cauchy(1.0)], ids=repr)
def test_robust_optima_are_stationary_and_robust(loss: Any) -> None:
    data, initial = team_data()
    data["z"][1, 0] += 5.0
    plain = team()[0].compile("gauss-newton").solve(data, initial)
    got = team(loss=loss)[0].compile("gauss-newton", tolerance=1e-13).solve(data, initial)
    assert got.solved

    def cost(T: np.ndarray) -> float:
        r = team_residuals(T, data)
        return float(sum(loss.rho(s) for s in (r[:8].reshape(-1, 2) ** 2).sum(axis=1)) + 0.5 * r[8:] @ r[8:])

    assert got.objective == pytest.approx(cost(got["robot"]), rel=1e-9)
    np.testing.assert_allclose(differences(cost, got["robot"]), 0.0, atol=2e-5)
    assert cost(got["robot"]) < cost(plain["robot"])


def test_preparation_and_feedback_are_one_gauss_newton_step() -> None:
    p, *_ = team()
    data, initial = team_data()
    session = p.compile("gauss-newton")
    old = data | {"gps": data["gps"] + 0.3}
    session.update(**old)
    session.prepare(initial)
    got = session.solve({"gps": data["gps"]})
    T = np.asarray(initial["robot"])
    J = differences(lambda T: team_residuals(T, data), T)  # the Jacobian does not read gps
    step = -np.linalg.lstsq(J, team_residuals(T, data), rcond=None)[0]
    np.testing.assert_allclose(got["robot"], SE2.retract_array(T, step.reshape(-1, 3)), atol=1e-6)
    assert got.iterations == 1 and got.solved and "feedback" in got.message
    once = p.compile("gauss-newton", iterations=1).solve(data, initial)
    np.testing.assert_allclose(once.point, got.point, atol=1e-9)
    assert session.solve().iterations > 1  # the preparation is used up


def test_feedback_leaves_pinned_instances_where_they_are() -> None:
    p, robot, _ = team()
    p.equality("start", lambda T: T.coordinates, on=robot[1])
    data, initial = team_data()
    session = p.compile("gauss-newton")
    session.update(**data)
    session.prepare(initial)
    got = session.solve()
    np.testing.assert_allclose(got["robot"][1], 0.0, atol=1e-12)
    np.testing.assert_allclose(got.point, p.compile("gauss-newton", iterations=1).solve(data, initial).point, atol=1e-9)


def test_feedback_respects_constraints() -> None:
    p, *_ = team(fence=5.0)
    data, initial = team_data()
    session = p.compile("gauss-newton")
    session.update(**data)
    session.prepare(initial)
    got = session.solve()
    once = p.compile("gauss-newton", iterations=1).solve(data, initial)
    np.testing.assert_allclose(got.point, once.point, atol=1e-8)
    T, U = np.asarray(initial["robot"]), got["robot"]
    step = SE2.local_array(T, U)
    slope = differences(lambda T: T[:, 0] + 0.02 * T[:, 1] ** 2, T)
    assert (T[:, 0] + 0.02 * T[:, 1] ** 2 + slope @ step.ravel() <= 5.0 + 1e-6).all()


def test_a_fixed_number_of_steps_is_that_number_unless_one_fails() -> None:
    p, *_ = team()
    data, initial = team_data()
    three = p.compile("gauss-newton", iterations=3).solve(data, initial)
    assert three.iterations == 3 and three.solved
    one = p.compile("gauss-newton", iterations=1)
    one.solve(data, initial)
    one.solve()
    np.testing.assert_allclose(one.solve().point, three.point, atol=1e-12)
    q = Problem()
    x = q.variables("x", Vector(1))
    q.cost("c", lambda x: x - 1, on=x)
    q.inequality("a", lambda x: x, on=x, upper=0.0)
    q.inequality("b", lambda x: x, on=x, lower=1.0, upper=2.0)
    assert q.compile("gauss-newton", iterations=3).solve().status is Status.INFEASIBLE


def test_preparation_needs_a_form_that_has_it_data_and_something_to_factorize() -> None:
    session = window().compile()
    session.update(y=outputs(0))
    with pytest.raises(FormError, match="solver 'auto' on the quadratic form has no preparation phase"):
        session.prepare()
    p, robot, _ = team()
    with pytest.raises(DataError, match="never given"):
        p.compile("gauss-newton").prepare()
    p = Problem()
    p.cost("c", lambda T: T.translation, on=p.variables("robot", SE2))
    with pytest.raises(UnobservableError, match="prepare: the costs leave a direction free"):
        p.compile("gauss-newton").prepare()


def test_equalities_that_no_value_satisfies_are_a_status() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.cost("c", lambda x: x, on=x)
    p.equality("none", lambda x: x**2 + 1, on=x)
    got = p.compile("gauss-newton").solve(initial={"x": [[0.5]]})
    assert got.status is Status.INFEASIBLE and "none" in got.message
    assert got.residuals["primal"] >= 1.0


def test_the_second_of_two_equalities_on_one_instance_is_not_lost() -> None:
    p = Problem()
    x, z = p.variables("x", Vector(1)), p.data("z")
    p.cost("c", lambda x: x, on=x)
    p.equality("a", lambda x: x - 1, on=x)
    p.equality("b", lambda x, z: x - z, on=x, data=z)
    session = p.compile("gauss-newton")
    assert session.solve({"z": 1.0}).solved
    assert session.solve({"z": 2.0}).status is Status.INFEASIBLE
    assert session.solve({"z": 1.0}).solved


def test_gauss_newton_damps_where_the_full_step_fails() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.cost("c", lambda x: ca.atan(x), on=x)  # the full step from 3 leads away
    got = p.compile("gauss-newton").solve(initial={"x": [[3.0]]})
    assert got.solved and abs(got["x"].item()) < 1e-3


def test_reset_sessions_answer_to_the_bit_whatever_weights_they_knew() -> None:
    """Weights met for the first time are answered without the map that those that come back get."""
    sessions = [window().compile() for _ in range(2)]
    weights = [0.5, 0.7, 0.5, 0.5, 0.9]

    def run(session: Any) -> list[np.ndarray]:
        session.reset()
        return [session.solve({"y": outputs(k), "R": R})["x"].copy() for k, R in enumerate(weights)]

    first = run(sessions[0])
    for R in weights:
        sessions[1].solve({"y": outputs(9), "R": R})
    for repeated in (run(sessions[0]), run(sessions[1])):
        assert all(np.array_equal(one, other) for one, other in zip(first, repeated, strict=True))
    sessions[1].update(R=0.9)
    np.testing.assert_allclose(sessions[1].solve({"y": outputs(4)})["x"], first[4], atol=1e-12)


def test_covariances_by_name() -> None:
    problem = Problem("two")
    x, y = problem.variables("x", Vector(1)), problem.variables("y", Vector(1))
    problem.cost("x", lambda x: x, on=x, noise=Gaussian(sigma=2.0))
    problem.cost("step", lambda x, y: y - x, on=(x, y), noise=Gaussian(sigma=1.0))
    solution = problem.compile().solve()
    np.testing.assert_allclose(solution.covariance("x", "y"), [[4.0, 4.0], [4.0, 5.0]])
    np.testing.assert_allclose(solution.covariance("y"), solution.covariance(y))
    with pytest.raises(UnknownNameError, match="unknown variable 'z'"):
        solution.covariance("z")
