"""A batch equals one session per entry, entry by entry, for shared and own weights, missing data and violated rows."""

from __future__ import annotations

import numpy as np
import pytest

from problems import SE2, Gaussian, Problem, Vector
from problems.errors import DataError, ShapeError, UnknownNameError
from problems.solvers.batch import ForkBatch, QPBatch

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
N = 4


def window() -> Problem:
    problem = Problem("window")
    x = problem.variables("x", Vector(2), N + 1)
    y = problem.data("y", (), N + 1)
    prior, cov = problem.data("prior", 2), problem.data("cov", (2, 2), value=np.eye(2))
    box = problem.data("corner", 2, value=[np.inf, 0.4])
    problem.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(covariance=cov))
    problem.cost("output", lambda x, y: x[0] - y, on=x, data=y, noise=Gaussian(0.3))
    problem.cost("moves", lambda x, n: n - A @ x, on=(x[:-1], x[1:]), noise=Gaussian(0.1))
    problem.inequality("box", lambda x: x, on=x, upper=box)
    return problem


@pytest.mark.parametrize("own_weights", [False, True])
@pytest.mark.parametrize("missing", [False, True])
def test_batch_equals_single_sessions(own_weights: bool, missing: bool) -> None:
    rng = np.random.default_rng(11)
    count = 40
    y, prior = rng.normal(size=(count, N + 1)), rng.normal(size=(count, 2))
    if missing:
        y[rng.random(y.shape) < 0.2] = np.nan
    scale = rng.uniform(0.5, 2.0, count) if own_weights else np.ones(count)
    cov = scale[:, None, None] * np.eye(2)
    session = window().compile("auto")
    batch = session.batch(count)
    assert isinstance(batch, QPBatch)
    batch.update(cov=cov if own_weights else np.eye(2))
    solution = batch.solve({"y": y, "prior": prior})
    methods = set()
    for k in range(count):
        one = session.fork().solve({"y": y[k], "prior": prior[k], "cov": cov[k]})
        methods.add(one.method)
        assert solution.method[k] == one.method
        assert solution.status[k] == one.status == "solved"
        np.testing.assert_allclose(solution["x"][k], one["x"], rtol=0, atol=1e-9)
    assert len(methods) == 2, "the data must reach the affine answer and the QP"


def test_changes_of_weights_patterns_and_shared_data_are_seen() -> None:
    rng = np.random.default_rng(3)
    session = window().compile("auto")
    batch = session.batch(6)
    batch.update(prior=np.zeros(2))
    for step in range(4):
        y = rng.normal(size=(6, N + 1))
        if step == 2:
            y[3, 1] = np.nan
        cov = np.eye(2) * (1 + step)
        solution = batch.solve({"y": y, "cov": cov})
        for k in range(6):
            one = session.fork().solve({"y": y[k], "prior": np.zeros(2), "cov": cov})
            np.testing.assert_allclose(solution["x"][k], one["x"], rtol=0, atol=1e-9)


def test_a_graph_runs_one_fork_per_entry() -> None:
    problem = Problem("poses")
    pose = problem.variables("pose", SE2, 1)
    z = problem.data("z", 3)
    problem.cost("prior", lambda T, z: SE2(z).between(T).local(), on=pose, data=z)
    batch = problem.compile("gauss-newton").batch(3)
    assert isinstance(batch, ForkBatch)
    z = np.array([[0.0, 1.0, 0.5], [2.0, 0.0, -3.0], [1.0, 1.0, 3.0]])
    solution = batch.solve({"z": z})
    np.testing.assert_allclose(solution["pose"][:, 0], z, atol=1e-9)
    assert solution.solved


def test_bad_data_are_named() -> None:
    batch = window().compile("auto").batch(3)
    with pytest.raises(DataError, match="prior, y|y, prior"):
        batch.solve()
    with pytest.raises(UnknownNameError, match="did you mean prior"):
        batch.update(priors=np.zeros(2))
    with pytest.raises(ShapeError, match=r"\(3, 5\)"):
        batch.update(y=np.zeros((3, 4)))
