"""Sessions of Gauss-Newton: optima, preparation and feedback, equalities, damping."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.optimize
from session_problems import (
    differences,
    outputs,
    team,
    team_data,
    team_residuals,
    window,
)

from problems import SE2, Cauchy, Huber, Problem, Vector
from problems.errors import DataError, FormError, UnobservableError
from problems.solvers.base import Status


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
