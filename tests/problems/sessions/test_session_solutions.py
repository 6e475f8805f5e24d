"""What a solution tells is true: multipliers, active sets, covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from session_problems import (
    ALL,
    A,
    N,
    differences,
    outputs,
    team,
    team_data,
    team_residuals,
    window,
)

from problems import Gaussian, Huber, Problem, Vector
from problems.errors import UnknownNameError, UnobservableError


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
