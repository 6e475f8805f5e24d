"""Soft inequalities: exact where the price exceeds the multipliers, a compromise below, never infeasible."""

from __future__ import annotations

import numpy as np
import pytest

from problems import SE2, Gaussian, Problem, Vector
from problems.errors import SettingError, ShapeError
from problems.soft import Soft


def pulled(soft: Soft | None, low: float | None = None) -> Problem:
    """Three numbers pulled to 1, 2, 3 with weights 1, bounded by 1.5 from above: multipliers 0, 0.5, 1.5."""
    problem = Problem("pulled")
    x = problem.variables("x", Vector(1), 3)
    problem.cost("pull", lambda x, z: x - z, on=x, data=problem.data("z", (), 3, value=[1.0, 2.0, 3.0]))
    problem.inequality("cap", lambda x: x, on=x, upper=1.5, lower=-np.inf if low is None else low, soft=soft)
    return problem


@pytest.mark.parametrize("solver", ["auto", "daqp", "proxqp", "gauss-newton", "ipopt"])
def test_a_price_above_every_multiplier_is_exact(solver: str) -> None:
    session = pulled(Soft(2.0)).compile(solver)
    solution = session.solve()
    np.testing.assert_allclose(solution["x"].ravel(), [1.0, 1.5, 1.5], atol=1e-6)
    np.testing.assert_allclose(solution["cap slack"].ravel(), 0.0, atol=1e-6)
    assert solution.solved


def test_a_price_below_a_multiplier_gives_way() -> None:
    # per component: min (x - z)^2/2 + p s + s^2/2 with s = x - 1.5 > 0 gives x = (z - p + 1.5) / 2
    solution = pulled(Soft(1.0)).compile().solve()
    np.testing.assert_allclose(solution["x"].ravel(), [1.0, 1.5, (3.0 - 1.0 + 1.5) / 2], atol=1e-8)


def test_a_linear_price_alone_and_a_quadratic_one_alone() -> None:
    linear = pulled(Soft(1.0, 0.0)).compile().solve()
    np.testing.assert_allclose(linear["x"].ravel(), [1.0, 1.5, 2.0], atol=2e-6)
    quadratic = pulled(Soft(0.0, 3.0)).compile().solve()  # x = (z + 3 * 1.5) / 4
    np.testing.assert_allclose(quadratic["x"].ravel(), [1.0, (2 + 4.5) / 4, (3 + 4.5) / 4], atol=1e-7)


def test_contradicting_bounds_are_never_infeasible() -> None:
    problem = pulled(Soft(50.0))
    problem.inequality("floor", lambda x: x, on=problem.unknowns["x"], lower=2.0, upper=np.inf)
    solution = problem.compile().solve()
    assert solution.solved
    np.testing.assert_allclose(solution["x"].ravel(), 2.0, atol=1e-8)
    np.testing.assert_allclose(solution["cap slack"].ravel(), 0.5, atol=1e-8)


def test_both_sides_and_data_bounds() -> None:
    problem = Problem("sides")
    x = problem.variables("x", Vector(2))
    problem.cost("pull", lambda x: x - np.array([5.0, -5.0]), on=x)
    cap = problem.data("cap", 2)
    problem.inequality("box", lambda x: x, on=x, lower=-1.0, upper=cap, soft=Soft(100.0))
    session = problem.compile()
    np.testing.assert_allclose(session.solve({"cap": [2.0, 2.0]})["x"][0], [2.0, -1.0], atol=1e-8)
    np.testing.assert_allclose(session.solve({"cap": [3.0, np.inf]})["x"][0], [3.0, -1.0], atol=1e-8)


def test_soft_fence_on_poses() -> None:
    problem = Problem("pose")
    pose = problem.variables("pose", SE2)
    problem.cost("prior", lambda T: SE2(np.array([3.0, 0.0, 0.2])).between(T).local(), on=pose, noise=Gaussian(1.0))
    problem.inequality("fence", lambda T: T.translation[0], on=pose, upper=2.0, soft=Soft(5.0))
    solution = problem.compile("gauss-newton").solve()
    assert solution.solved
    assert solution["pose"][0, 0] == pytest.approx(2.0, abs=1e-7)


def test_bad_prices_and_nothing_to_soften() -> None:
    for prices in ((-1.0, 1.0), (np.nan, 1.0), (0.0, 0.0)):
        with pytest.raises(SettingError, match="Soft needs finite prices"):
            Soft(*prices)
    problem = Problem()
    x = problem.variables("x", Vector(1))
    with pytest.raises(ShapeError, match="no bound is finite"):
        problem.inequality("none", lambda x: x, on=x, upper=np.inf, soft=Soft(1.0))
