"""Problems, forms and solvers that do not go together are named."""

from __future__ import annotations

import numpy as np
import pytest
from stated_problems import SOLVERS, difference, pair, same

from problems import SE2, Cauchy, Gaussian, Problem, Vector
from problems.errors import (
    DataError,
    DefinitionError,
    EmptyConstraintError,
    FormError,
    NotAffineError,
    SettingError,
    UnknownNameError,
    UnobservableError,
)


def test_what_no_quadratic_program_holds_is_named() -> None:
    p, x, z = pair()
    p.cost("bent", lambda x: x**2, on=x)
    with pytest.raises(NotAffineError, match="cost 'bent' is not affine"):
        p.compile("auto", form="quadratic")
    with pytest.raises(FormError, match="solver 'daqp' takes quadratic programs only: cost 'bent' is not affine"):
        p.compile("daqp")
    p, x, z = pair()
    p.cost("robust", same, on=x, loss=Cauchy())
    with pytest.raises(FormError, match="cost 'robust' has the loss Cauchy.*which no quadratic program can hold"):
        p.compile("osqp")
    p, x, z = pair()
    p.equality("bent", lambda x: x[0] * x[1], on=x)
    with pytest.raises(FormError, match="equality 'bent' is not affine"):
        p.compile("daqp")
    p = Problem()
    p.cost("prior", lambda T: T.translation, on=p.variables("robot", SE2))
    with pytest.raises(FormError, match="'daqp' .*variables on Vector spaces only; 'robot' is on SE2"):
        p.compile("daqp")


def test_solvers_forms_and_settings_are_checked() -> None:
    p, x, z = pair()
    with pytest.raises(UnknownNameError, match="unknown solver 'gaus-newton'; did you mean gauss-newton"):
        p.compile("gaus-newton")
    with pytest.raises(FormError, match="no form 'qp'; forms: quadratic, nonlinear, graph"):
        p.compile(form="qp")
    with pytest.raises(FormError, match="solver 'daqp' takes the form quadratic, not 'graph'"):
        p.compile("daqp", form="graph")
    with pytest.raises(FormError, match="eliminate condenses quadratic programs"):
        p.compile("gauss-newton", eliminate=[x])
    with pytest.raises(DefinitionError, match="eliminate takes variables"):
        p.compile(eliminate=["x"])
    for solver in SOLVERS:
        for bad in (0.0, -1.0, "small", True, None):
            with pytest.raises(SettingError, match="tolerance must be a positive number"):
                p.compile(solver, tolerance=bad)
        with pytest.raises(SettingError, match="iteration_limitt"):
            p.compile(solver, iteration_limitt=3).solve({"z": np.full((3, 2), 1.0)})
    with pytest.raises(SettingError, match="iterations"):
        p.compile("gauss-newton", iterations=0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_problem_needs_variables_and_costs(solver: str) -> None:
    p = Problem("nothing")
    with pytest.raises(DefinitionError, match="problem 'nothing' has no variables"):
        p.compile(solver)
    p.variables("x", Vector(1))
    with pytest.raises(DefinitionError, match="problem 'nothing' has no cost"):
        p.compile(solver)


@pytest.mark.parametrize("solver", ["auto", "daqp", "osqp"])
def test_an_unobservable_problem_is_named_before_any_solve(solver: str) -> None:
    p, x, z = pair()
    p.variables("bias", Vector(2), 4)
    with pytest.raises(UnobservableError, match=r"problem 'pair' do not determine bias\[0\]"):
        p.compile(solver)
    p = Problem()
    x = p.variables("x", Vector(1), 4)
    p.cost("steps", lambda a, b: b - a, on=(x[:-1], x[1:]))
    with pytest.raises(UnobservableError, match=r"x\[0\] and 3 more"):
        p.compile(solver)


def test_an_inequality_does_not_make_a_problem_observable() -> None:
    p, x, z = pair()
    y = p.variables("y", Vector(1))
    p.inequality("box", same, on=y, lower=0.0, upper=1.0)
    with pytest.raises(UnobservableError, match=r"determine y\[0\]"):
        p.compile()


@pytest.mark.parametrize("solver", ["auto", "daqp", "proxqp", "clarabel"])
def test_a_linear_cost_and_an_inequality_hold_a_variable_together(solver: str) -> None:
    p = Problem()
    x, slack = p.variables("x", Vector(1)), p.variables("slack", Vector(1))
    target = p.data("target")
    p.cost("pull", difference, on=x, data=target)
    p.cost("penalty", same, on=slack, noise=Gaussian(information=0.0), linear=0.5)
    p.inequality("soft", lambda x, s: x - s, on=(x, slack), upper=1.0)
    p.inequality("positive", same, on=slack, lower=0.0, upper=np.inf)
    session = p.compile(solver)
    for target, x, slack in ((0.3, 0.3, 0.0), (1.2, 1.0, 0.0), (4.0, 3.5, 2.5)):
        got = session.solve({"target": target})
        assert got.solved
        np.testing.assert_allclose([got["x"].item(), got["slack"].item()], [x, slack], atol=1e-6)


def test_equalities_that_contradict_each_other_are_named() -> None:
    p, x, z = pair()
    p.equality("a", lambda x: x - 1, on=x[0])
    p.equality("b", lambda x: x - 2, on=x[0])
    for solver in ("auto", "daqp"):
        with pytest.raises(EmptyConstraintError, match="contradict each other"):
            p.compile(solver)


def test_coefficients_that_are_not_finite_are_named() -> None:
    p = Problem()
    x, y = p.variables("x", Vector(1), 2), p.data("y", 2, 2)
    p.cost("prior", same, on=x)
    p.cost("scaled", lambda x, y: (x - y[0]) / y[1], on=x, data=y)
    session = p.compile()
    np.testing.assert_allclose(session.solve({"y": [[1, 1], [np.nan, np.nan]]})["x"].ravel(), [0.5, 0.0])
    with pytest.raises(DataError, match="cost 'scaled': instance 1 has coefficients that are not finite"):
        session.solve({"y": [[1, 1], [1, 0]]})
    np.testing.assert_allclose(session.solve({"y": [[1, 1], [1, 1]]})["x"].ravel(), [0.5, 0.5])
