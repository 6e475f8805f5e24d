"""Which factorization Gauss-Newton takes, that all give the same answer, and when one is used again."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, SE3, Gaussian, Problem, Vector
from problems.errors import MissingExtraError, SettingError
from problems.solvers import factorizations

SOLVERS = ["dense", "banded", "qdldl", "superlu", "pardiso", "cholmod", "block"]
PACKAGES = {"pardiso": "pypardiso", "cholmod": "cvxopt"}


def between(a: Any, b: Any, z: Any) -> Any:
    return SE3(z).between(a.between(b)).log()


def poses(count: int, rng: np.random.Generator, noise: float = 0.02) -> tuple[Problem, np.ndarray]:
    """A ring of poses in space with chords, and the truth."""
    step = np.array([1.0, 0.2, 0.1, 0.05, -0.03, 2 * np.pi / count])
    truth = [SE3.identity()]
    for _ in range(count - 1):
        truth.append(SE3.retract_array(truth[-1][None], step[None])[0])
    x = np.array(truth)
    first = np.concatenate([np.arange(count), rng.integers(0, count // 2, count // 2)])
    second = np.concatenate([np.roll(np.arange(count), -1), rng.integers(count // 2, count, count // 2)])
    one = np.broadcast_to(SE3.identity(), (first.size, 7))
    z = SE3.retract_array(one, SE3.local_array(x[first], x[second]) + noise * rng.normal(size=(first.size, 6)))
    problem = Problem("ring")
    pose = problem.variables("pose", SE3, count)
    data = problem.data("z", 7, first.size, z)
    problem.cost("between", between, (pose[first], pose[second]), data, Gaussian(sigma=[0.1] * 3 + [0.05] * 3))
    problem.cost("first", lambda T: T.local(), pose[0])
    return problem, x


def chain(space: Any, count: int, all_pairs: bool = False) -> Problem:
    problem = Problem("chain")
    x = problem.variables("x", space, count)
    i, j = np.triu_indices(count, 1) if all_pairs else (np.arange(count - 1), np.arange(1, count))
    size = space.dim

    def difference(a: Any, b: Any) -> Any:
        return b - a if isinstance(space, Vector) else a.between(b).local() - ca.DM.ones(size)

    problem.cost("pairs", difference, (x[i], x[j]))
    problem.cost("first", (lambda a: a) if isinstance(space, Vector) else (lambda a: a.local()), x[0])
    return problem


def work(problem: Problem) -> float:
    return problem.compile("gauss-newton").form_.pattern.work  # type: ignore[attr-defined]


def test_work_is_what_elimination_takes() -> None:
    # a chain fills nothing: every column of a block has its own block and one more below
    assert work(chain(SE2, 60)) == 59 * 3 * 6**2 + 3 * 3**2
    assert work(chain(Vector(2), 10)) == 9 * 2 * 4**2 + 2 * 2**2
    # where all are joined, the order does not matter
    assert work(chain(SE2, 8, all_pairs=True)) == sum(3 * (3 * k) ** 2 for k in range(1, 9))


@pytest.mark.parametrize("name", SOLVERS)
def test_every_linear_solver_reaches_the_same_optimum(name: str) -> None:
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    problem, truth = poses(60, np.random.default_rng(0))
    start = SE3.retract_array(truth, 0.1 * np.random.default_rng(1).normal(size=(60, 6)))
    expected = problem.compile("gauss-newton", linear_solver="qdldl").solve(initial={"pose": start})
    session: Any = problem.compile("gauss-newton", linear_solver=name)
    assert session._linear.name == name
    for one in (session, session.fork()):
        solution = one.solve(initial={"pose": start})
        assert solution.status == "solved"
        assert solution.objective == pytest.approx(expected.objective, rel=1e-9)
        np.testing.assert_allclose(SE3.local_array(expected["pose"], solution["pose"]), 0, atol=1e-6)


def test_auto_goes_by_size_and_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen(problem: Problem) -> str:
        session: Any = problem.compile("gauss-newton")
        return session._linear.name

    assert chosen(chain(SE2, 40)) == "banded"
    assert chosen(chain(SE2, 1000)) == "banded"
    for count, name in ((40, "dense"), (60, "qdldl")):
        closed = chain(SE2, count)
        x = closed.unknowns["x"]
        closed.cost("last", lambda a, b: a.between(b).local(), (x[0], x[count - 1]))
        assert chosen(closed) == name
    dense = chain(Vector(6), 60, all_pairs=True)
    assert factorizations.DENSE_SIZE < 360
    monkeypatch.setattr(factorizations, "HEAVY_WORK", work(dense))
    monkeypatch.setattr(factorizations, "FILLED_WORK", work(dense))
    monkeypatch.setattr(factorizations, "find_spec", lambda name: None)
    assert chosen(dense) == "superlu"
    monkeypatch.setattr(factorizations, "FILLED_WORK", 2 * work(dense))
    assert chosen(dense) == "qdldl"
    if find_spec("pypardiso") is not None:
        monkeypatch.setattr(factorizations, "find_spec", find_spec)
        assert chosen(dense) == "pardiso"


def test_auto_takes_blocks_where_they_repay_their_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen(problem: Problem) -> str:
        session: Any = problem.compile("gauss-newton")
        return session._linear.name

    joined = chain(SE2, 60, all_pairs=True)
    monkeypatch.setattr(factorizations, "BLOCK_SIZE", 181)
    assert chosen(joined) == "qdldl"
    monkeypatch.setattr(factorizations, "BLOCK_SIZE", 180)
    assert chosen(joined) == "block"
    monkeypatch.setattr(factorizations, "BLOCK_WORK", work(joined))
    monkeypatch.setattr(factorizations, "find_spec", lambda name: None)
    assert chosen(joined) == "block"
    monkeypatch.setattr(factorizations, "find_spec", find_spec)
    if find_spec("pypardiso") is not None:
        assert chosen(joined) == "pardiso"
    # scalars, blocks that are too large, and dimensions that differ
    assert chosen(chain(Vector(1), 180, all_pairs=True)) != "block"
    assert chosen(chain(Vector(7), 30, all_pairs=True)) != "block"
    landmark = joined.variables("landmark", Vector(2))
    joined.cost("seen", lambda a, b: a.translation - b, (joined.unknowns["x"][0], landmark))
    assert chosen(joined) != "block"
    with pytest.raises(SettingError, match="one dimension, at most 6; these have 2, 3"):
        joined.compile("gauss-newton", linear_solver="block")


def test_unknown_and_missing_linear_solvers_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = chain(SE2, 60)
    with pytest.raises(SettingError, match="linear_solver"):
        problem.compile("gauss-newton", linear_solver="mumps")
    monkeypatch.setattr(factorizations, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"horizonet\[pardiso\]"):
        problem.compile("gauss-newton", linear_solver="pardiso")


def test_the_last_factorization_serves_again() -> None:
    problem, truth = poses(60, np.random.default_rng(2), noise=0.15)
    start = {"pose": SE3.retract_array(truth, 0.2 * np.random.default_rng(3).normal(size=(60, 6)))}
    session: Any = problem.compile("gauss-newton", linear_solver="qdldl")
    calls, inner = [], session._linear.factor

    def factor(values: np.ndarray) -> None:
        calls.append(len(calls))
        inner(values)

    session._linear.factor = factor
    solution = session.solve(initial=start)
    assert solution.status == "solved"
    assert len(calls) <= solution.iterations - 2
    exact = problem.compile("gauss-newton", tolerance=1e-13, linear_solver="qdldl").solve(initial=start)
    assert solution.objective - exact.objective <= 1e-9 * max(1.0, exact.objective)
    # warm: one linearization and no factorization more than the test of convergence takes
    again = len(calls)
    assert session.solve().iterations == 1
    assert len(calls) == again + 1
