"""The Schur complement gives the steps of the other factorizations, and picks instances that share no term."""

from __future__ import annotations

import numpy as np
import pytest

from localization import measurements as meas
from problems import SE2, Gaussian, Problem, Vector
from problems.forms.layout import Layout
from problems.forms.least_squares import LeastSquares
from problems.solvers.factorizations import SingularError, factorization
from problems.solvers.schur import SchurComplement


def survey(poses: int = 6, landmarks: int = 80) -> tuple[Problem, dict, dict]:
    rng = np.random.default_rng(4)
    places = rng.uniform(-10, 10, (landmarks, 2))
    truth = np.column_stack([rng.uniform(-3, 3, (poses, 2)), rng.uniform(-3, 3, poses)])
    i, j = np.nonzero(rng.random((poses, landmarks)) < 0.7)
    c, s = np.cos(truth[i, 2]), np.sin(truth[i, 2])
    d = places[j] - truth[i, :2]
    seen = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]]) + 0.05 * rng.normal(size=d.shape)
    problem = Problem("survey")
    pose, mark = problem.variables("pose", SE2, poses), problem.variables("mark", Vector(2), landmarks)
    z, first = problem.data("z", 2, len(i)), problem.data("first", 3, value=truth[0])
    problem.cost("start", meas.pose, on=pose[0], data=first, noise=Gaussian(0.01))
    problem.cost("near", lambda m: m, on=mark, noise=Gaussian(20.0))
    problem.cost("seen", meas.landmark, on=(pose[i], mark[j]), data=z, noise=Gaussian(0.05))
    start = {"pose": truth + 0.1 * rng.normal(size=truth.shape), "mark": places + 0.3 * rng.normal(size=places.shape)}
    return problem, {"z": seen}, start


def test_same_solution_as_the_other_factorizations() -> None:
    problem, data, start = survey()
    found = {
        name: problem.compile("gauss-newton", linear_solver=name, tolerance=1e-10).solve(data, initial=start)
        for name in ("schur", "qdldl", "superlu")
    }
    assert all(solution.solved for solution in found.values())
    for name in ("qdldl", "superlu"):
        np.testing.assert_allclose(found["schur"].point, found[name].point, atol=1e-9)
        assert found["schur"].iterations == found[name].iterations


def test_landmarks_are_what_is_eliminated() -> None:
    problem, data, start = survey()
    session = problem.compile("gauss-newton")
    session.update(**data)
    layout = Layout(problem)
    form = LeastSquares(problem, layout)
    (gone,) = form.pattern.independent_blocks()
    assert gone.shape == (80, 2) and gone.min() == layout.start["mark"]
    _, gradient, values = form.bind(session.store).linearize(layout.point(start))
    rights = np.column_stack([gradient, np.arange(gradient.size)])
    schur, ldl = SchurComplement(form.pattern), factorization(form.pattern, "qdldl")
    for scale in (1.0, 3.0):  # the second time with new numbers in the old places
        schur.factor(scale * values)
        ldl.factor(scale * values)
        np.testing.assert_allclose(schur.solve(rights), ldl.solve(rights), rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(schur.solve(gradient), ldl.solve(gradient), rtol=1e-8, atol=1e-10)


def test_a_free_gauge_is_singular() -> None:
    problem, data, start = survey()
    layout = Layout(problem)
    form = LeastSquares(problem, layout)
    values = np.zeros(form.pattern.nonzeros)
    with pytest.raises(SingularError):
        SchurComplement(form.pattern).factor(values)
