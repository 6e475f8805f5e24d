"""Data per block of a batch: one value for several consecutive entries, as networks give weights per node."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.errors import DataError, ShapeError
from problems.solvers.batch import BatchSession, ForkBatch, QPBatch

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
BLOCKS, PER_BLOCK, SLOTS = 3, 4, 5
COUNT = BLOCKS * PER_BLOCK


def window(box: float) -> Problem:
    problem = Problem("window")
    x = problem.variables("x", Vector(2), SLOTS)
    y = problem.data("y", (), SLOTS)
    prior, information = problem.data("prior", 2), problem.data("information", (2, 2))
    bound = problem.data("bound", 2, value=[box, np.inf])
    problem.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(information=information))
    problem.cost("output", lambda x, y: x[0] - y, on=x, data=y, noise=Gaussian(0.3))
    problem.cost("moves", lambda x, n: n - A @ x, on=(x[:-1], x[1:]), noise=Gaussian(0.1))
    problem.inequality("box", lambda x: x, on=x, upper=bound)
    return problem


def compare(session: Any, batch: BatchSession, data: dict[str, np.ndarray]) -> set[str]:
    """Solve both ways; what answered."""
    found = batch.solve(data)
    whole = {name: np.repeat(value, COUNT // len(value), axis=0) for name, value in data.items()}
    for entry in range(COUNT):
        one = session.fork().solve({name: value[entry] for name, value in whole.items()})
        assert (found.status[entry], found.method[entry]) == (one.status, one.method)
        np.testing.assert_allclose(found["x"][entry], one["x"], rtol=0, atol=1e-9)
        kept = batch.data_of(entry)
        for name, value in whole.items():
            np.testing.assert_array_equal(np.ravel(kept[name]), np.ravel(value[entry]))
    return set(found.method)


@pytest.mark.parametrize("box", [np.inf, 0.4])
@pytest.mark.parametrize("missing", ["nothing", "one slot", "by block", "by entry"])
def test_blocks_equal_single_sessions(box: float, missing: str) -> None:
    rng = np.random.default_rng(1)
    session = window(box).compile("auto")
    batch = session.batch(COUNT)
    assert isinstance(batch, QPBatch)
    answered = set()
    for step in range(3):
        y = rng.normal(size=(COUNT, SLOTS))
        if missing == "one slot":
            y[:, step] = np.nan
        elif missing == "by block":
            y = np.repeat(rng.normal(size=(BLOCKS, SLOTS)), 1, axis=0)
            y[step % BLOCKS, 1] = np.nan
        elif missing == "by entry":
            y[rng.random(y.shape) < 0.2] = np.nan
        scale = rng.uniform(0.5, 2.0, BLOCKS)[:, None, None]
        data = {"y": y, "prior": rng.normal(size=(COUNT, 2)), "information": scale * np.eye(2)}
        answered |= compare(session, batch, data)
    assert answered == ({"linear"} if box == np.inf else {"linear", "auto"})


def test_blocks_of_different_sizes_meet_in_the_common_ones() -> None:
    rng = np.random.default_rng(2)
    session = window(0.4).compile("auto")
    batch = session.batch(COUNT)
    data = {
        "y": rng.normal(size=(COUNT, SLOTS)),
        "prior": rng.normal(size=(2, 2)),
        "information": rng.uniform(0.5, 2.0, 3)[:, None, None] * np.eye(2),
    }
    compare(session, batch, data)
    data["information"] = rng.uniform(0.5, 2.0, COUNT)[:, None, None] * np.eye(2)
    compare(session, batch, data)
    data["information"] = rng.uniform(0.5, 2.0, 1)[:, None, None] * np.eye(2)
    compare(session, batch, data)


def test_forks_take_blocks_too() -> None:
    rng = np.random.default_rng(3)
    session = window(0.4).compile("auto")
    data = {
        "y": rng.normal(size=(COUNT, SLOTS)),
        "prior": rng.normal(size=(3, 2)),
        "information": rng.uniform(0.5, 2.0, 4)[:, None, None] * np.eye(2),
    }
    compare(session, ForkBatch(session, COUNT), data)


def test_blocks_that_do_not_divide_the_batch_and_infinite_data_are_named() -> None:
    batch = window(0.4).compile("auto").batch(COUNT)
    with pytest.raises(ShapeError, match=r"divides 12 \(one per block\), got \(5, 2, 2\)"):
        batch.update(information=np.tile(np.eye(2), (5, 1, 1)))
    with pytest.raises(DataError, match="'prior' have an infinite value"):
        batch.update(prior=np.array([np.inf, 0.0]))
