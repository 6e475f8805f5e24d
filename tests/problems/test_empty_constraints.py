"""Constraint sets without a point are named when the problem is compiled; those that depend on data are a status."""

from __future__ import annotations

import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.errors import EmptyConstraintError


def pull() -> tuple[Problem, object]:
    problem = Problem("pull")
    x = problem.variables("x", Vector(2))
    problem.cost("pull", lambda x: x - 1, on=x, noise=Gaussian(1.0))
    return problem, x


@pytest.mark.parametrize("solver", ["auto", "osqp"])
def test_inequalities_that_contradict_each_other_are_named(solver: str) -> None:
    problem, x = pull()
    problem.inequality("above", lambda x: x[0] + x[1], on=x, lower=3.0, upper=np.inf)
    problem.inequality("below", lambda x: x, on=x, upper=1.0)
    with pytest.raises(EmptyConstraintError, match="inequality 'above', inequality 'below' contradict each other"):
        problem.compile(solver)


def test_an_equality_outside_of_the_bounds_is_named() -> None:
    problem, x = pull()
    problem.equality("sum", lambda x: x[0] + x[1] - 5, on=x)
    problem.inequality("box", lambda x: x, on=x, lower=-1.0, upper=2.0)
    with pytest.raises(EmptyConstraintError, match="equality 'sum', inequality 'box'"):
        problem.compile()


def test_a_set_with_a_single_point_is_not_empty() -> None:
    problem, x = pull()
    problem.inequality("above", lambda x: x[0] + x[1], on=x, lower=3.0, upper=np.inf)
    problem.inequality("below", lambda x: x, on=x, upper=1.5)
    solution = problem.compile().solve()
    assert solution.solved
    np.testing.assert_allclose(solution["x"][0], 1.5, atol=1e-7)


def test_bounds_that_are_data_are_judged_when_they_are_given() -> None:
    problem, x = pull()
    floor = problem.data("floor", 2)
    problem.inequality("above", lambda x: x, on=x, lower=floor, upper=np.inf)
    problem.inequality("below", lambda x: x, on=x, upper=0.5)
    session = problem.compile()
    assert session.solve({"floor": [1.0, 0.0]}).status == "infeasible"
    assert session.solve({"floor": [0.0, 0.0]}).solved
