"""assembly='code': the same program as the maps', whatever changes from solve to solve."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.errors import FormError, UnknownNameError
from problems.soft import Soft
from problems.solvers.base import Status


def spd(rng, count, size):
    roots = rng.normal(size=(count, size, size))
    return roots @ roots.transpose(0, 2, 1) + np.eye(size)


def stated(soft=None, equality_left=False):
    """A chain x_{k+1} = F_k x_k + b_k with weights, flags, missing data, bounds as data, linear costs."""
    problem = Problem("chain")
    x = problem.variables("x", Vector(2), 4)
    y = problem.data("y", 2, 4)
    F, b = problem.data("F", (2, 2), 3), problem.data("b", 2, 3)
    problem.cost("prior", lambda x: x, on=x[0], noise=Gaussian(information=problem.data("W", (2, 2))))
    problem.cost("measured", lambda x, y: x - y, on=x, data=y, noise=Gaussian(sigma=problem.data("s", 2)))
    problem.cost("pull", lambda x: x[0], on=x, linear=problem.data("l", 1, 4), active=problem.data("on", (), 4))
    problem.equality("moved", lambda x, ahead, F, b: ahead - F @ x - b, on=(x[:-1], x[1:]), data=(F, b))
    if equality_left:
        problem.equality("sum", lambda x: x[0] + x[1] - 1, on=x[0])
    problem.inequality(
        "wall",
        lambda x, H: H @ x,
        on=x,
        data=problem.data("H", (3, 2), 4),
        lower=problem.data("low", 3, 4),
        upper=problem.data("up", 3, 4),
        active=problem.data("wall on", (), 4),
        soft=soft,
    )
    problem.inequality("box", lambda x: x, on=x, lower=[-4.0, -np.inf], upper=4.0)
    return problem, x


def numbers(rng):
    data = {
        "y": rng.normal(size=(4, 2)),
        "F": rng.normal(size=(3, 2, 2)),
        "b": rng.normal(size=(3, 2)),
        "W": spd(rng, 1, 2)[0],
        "s": rng.uniform(0.5, 2, 2),
        "l": rng.normal(size=(4, 1)),
        "on": (rng.random(4) < 0.5).astype(float),
        "H": rng.normal(size=(4, 3, 2)),
        "low": np.full((4, 3), -np.inf),
        "up": rng.uniform(0.2, 1.0, (4, 3)),
        "wall on": (rng.random(4) < 0.6).astype(float),
    }
    data["y"][rng.random(4) < 0.3] = np.nan
    data["up"][rng.random((4, 3)) < 0.2] = np.inf
    data["low"][rng.random((4, 3)) < 0.3] = -2.0
    return data


@pytest.mark.parametrize("soft", [None, Soft(3.0, 1.0)])
@pytest.mark.parametrize("left", [False, True])
@pytest.mark.parametrize("solver", ["auto", "daqp", "quadprog", "clarabel"])
def test_same_answers_as_the_maps(soft, left, solver):
    problem, x = stated(soft, left)
    maps = problem.compile("daqp", eliminate=[x[1:]])
    code = problem.compile(solver, eliminate=[x[1:]], assembly="code")
    rng, solved = np.random.default_rng(1), 0
    tolerance = 1e-5 if solver == "clarabel" else 1e-9
    for _ in range(25):
        data = numbers(rng)
        one, other = maps.solve(data), code.solve(data)
        assert one.status is other.status
        if one.status is not Status.SOLVED:
            continue
        solved += 1
        assert np.abs(one["x"] - other["x"]).max() < tolerance
        assert other.objective == pytest.approx(one.objective, abs=1e-5 if solver == "clarabel" else 1e-9)
        assert max(other.residuals.values()) < 1e-6
        if solver != "clarabel":
            for name, value in one.multipliers.items():
                assert np.abs(value - other.multipliers[name]).max() < 1e-6
    assert solved > 8


def test_forks_keep_their_own_data():
    problem, x = stated()
    base = problem.compile("auto", eliminate=[x[1:]], assembly="code")
    rng = np.random.default_rng(2)
    first, second = base.fork(), base.fork()
    one, two = numbers(rng), numbers(rng)
    for data in (one, two):
        data["wall on"] = np.zeros(4)
    a = first.solve(one)["x"].copy()
    b = second.solve(two)["x"].copy()
    assert np.abs(a - b).max() > 1e-3
    assert np.array_equal(first.solve()["x"], a) and np.array_equal(second.solve()["x"], b)


def test_process_noise_is_condensed_to_first_state_and_disturbances():
    problem = Problem("noise")
    x, w = problem.variables("x", Vector(2), 4), problem.variables("w", Vector(1), 3)
    G = ca.DM([0.5, 1.0])
    problem.cost("prior", lambda x: x - 1, on=x[0])
    problem.cost("w", lambda w: w, on=w)
    problem.cost("y", lambda x, y: x[0] - y, on=x, data=problem.data("y", (), 4))
    problem.equality("moved", lambda x, w, ahead: ahead - x - G * w, on=(x[:-1], w, x[1:]))
    code = problem.compile("auto", eliminate=[x[1:]], assembly="code")
    assert code.code.size == 5  # type: ignore[attr-defined]
    y = np.array([0.3, -1.0, 2.0, 0.5])
    wanted = problem.compile("auto").solve({"y": y})
    assert np.abs(code.solve({"y": y})["x"] - wanted["x"]).max() < 1e-12


def test_what_code_cannot_assemble_is_refused():
    problem, x = stated()
    with pytest.raises(UnknownNameError, match="maps"):
        problem.compile("auto", assembly="both")
    ring = Problem("ring")
    z = ring.variables("z", Vector(1), 2)
    a = ring.data("a")
    ring.cost("c", lambda z: z, on=z)
    ring.equality("scaled", lambda z, a: a * z - 1, on=z[0], data=a)
    with pytest.raises(FormError, match="constant"):
        ring.compile("auto", eliminate=[z[0]], assembly="code")
    noisy = Problem("noisy")
    v = noisy.variables("v", Vector(1))
    noisy.cost("c", lambda v: v, on=v, noise=Gaussian(covariance=noisy.data("R", (1, 1))))
    with pytest.raises(FormError, match="sigma or information"):
        noisy.compile("auto", assembly="code")


def test_marginals_follow_the_weights_of_the_last_solve():
    problem = Problem("pair")
    x = problem.variables("x", Vector(1), 2)
    problem.cost("prior", lambda x: x, on=x[0], noise=Gaussian(information=problem.data("W", (1, 1))))
    problem.cost("moved", lambda x, ahead: ahead - x, on=(x[:-1], x[1:]))
    session = problem.compile("auto", assembly="code")
    for weight in (1.0, 4.0):
        session.solve({"W": [[weight]]})
        wanted = 1 / (1 / weight + 1)
        assert session.marginal(x[0], x[1]).information == pytest.approx(wanted, rel=1e-12)
