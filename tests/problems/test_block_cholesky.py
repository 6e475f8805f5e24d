"""Cholesky by blocks in machine code against dense algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from problems import SE2, Problem, Vector
from problems.errors import SettingError
from problems.forms.layout import Layout
from problems.forms.least_squares import LeastSquares
from problems.forms.sparsity import HessianPattern
from problems.solvers.base import Status
from problems.solvers.block_cholesky import BlockCholesky
from problems.solvers.factorizations import SingularError

DIMS = [1, 2, 3, 6]


def pattern_of(dim: int, count: int, rng: np.random.Generator, links: int) -> HessianPattern:
    """Of instances in two variables that random pairs join; some stay alone."""
    problem = Problem()
    half = count // 2
    x, y = problem.variables("x", Vector(dim), half), problem.variables("y", Vector(dim), count - half)
    i, j = rng.integers(0, half, links), rng.integers(0, count - half, links)
    problem.cost("across", lambda a, b: a - b, (x[i], y[j]))
    i, j = rng.integers(0, half - 1, links), rng.integers(0, half - 1, links)
    problem.cost("within", lambda a, b: a - b, (x[i], x[np.where(i == j, half - 1, j)]))
    problem.cost("own", lambda a: a, (y[np.arange(count - half)],))
    return LeastSquares(problem, Layout(problem)).pattern


def positive(pattern: HessianPattern, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Entries of a positive definite matrix, with every entry of the pattern, and the matrix."""
    n = pattern.size
    entries = rng.normal(size=pattern.nonzeros)
    H = np.zeros((n, n))
    H[pattern.indices, pattern.columns] = H[pattern.columns, pattern.indices] = entries
    np.fill_diagonal(H, 0.0)
    # hardly larger than what makes it singular
    entries[pattern.diagonal] = -np.linalg.eigvalsh(H)[0] + 0.1 + rng.random(n)
    np.fill_diagonal(H, entries[pattern.diagonal])
    return entries, H


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("links", [1, 8, 60])
def test_solutions_are_those_of_dense_algebra(dim: int, links: int) -> None:
    rng = np.random.default_rng(10 * dim + links)
    pattern = pattern_of(dim, 24, rng, links)
    solver = BlockCholesky(pattern)
    assert pattern.common_dim == dim
    for _ in range(3):  # other values in the same order
        entries, H = positive(pattern, rng)
        b = rng.normal(size=(pattern.size, 5))
        given = entries.copy()
        solver.factor(given)
        np.testing.assert_array_equal(given, entries)
        want = np.linalg.solve(H, b)
        for right in (b, np.asfortranarray(b), b[:, ::2], b[:, :1], b[:, :0]):
            columns = [int(np.flatnonzero((b == column[:, None]).all(axis=0))[0]) for column in right.T]
            np.testing.assert_allclose(solver.solve(right), want[:, columns], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(solver.solve(b[:, 1]), want[:, 1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dim", DIMS)
def test_pinned_instances_do_not_move(dim: int) -> None:
    rng = np.random.default_rng(dim)
    pattern = pattern_of(dim, 20, rng, 40)
    entries, H = positive(pattern, rng)
    pinned = np.arange(2 * dim, 3 * dim)
    touched = np.isin(pattern.indices, pinned) | np.isin(pattern.columns, pinned)
    entries[touched] = 0.0
    entries[pattern.diagonal[pinned]] = 1.0
    free = np.setdiff1d(np.arange(pattern.size), pinned)
    b = rng.normal(size=pattern.size)
    b[pinned] = 0.0
    solver = BlockCholesky(pattern)
    solver.factor(entries)
    x = solver.solve(b)
    np.testing.assert_array_equal(x[pinned], 0.0)
    np.testing.assert_allclose(x[free], np.linalg.solve(H[np.ix_(free, free)], b[free]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dim", DIMS)
def test_what_is_not_positive_definite_or_finite_is_refused_and_the_next_one_is_taken(dim: int) -> None:
    rng = np.random.default_rng(dim)
    pattern = pattern_of(dim, 20, rng, 40)
    entries, H = positive(pattern, rng)
    solver = BlockCholesky(pattern)
    b = rng.normal(size=pattern.size)
    indefinite = entries.copy()
    indefinite[pattern.diagonal] -= np.linalg.eigvalsh(H)[0] + 0.01
    wrong = [(indefinite, "not positive definite"), (np.zeros_like(entries), "not positive definite")]
    middle = pattern.diagonal[pattern.size // 2]
    for place in (0, int(middle), int(middle) - 1, pattern.nonzeros - 1):
        for value in (np.nan, np.inf, -np.inf):
            bad = entries.copy()
            bad[place] = value
            wrong.append((bad, "not finite"))
    for bad, message in wrong:
        with pytest.raises(SingularError, match=message):
            solver.factor(bad)
        solver.factor(entries)
        np.testing.assert_allclose(solver.solve(b), np.linalg.solve(H, b), rtol=1e-9, atol=1e-9)


def test_the_instance_without_curvature_is_named() -> None:
    rng = np.random.default_rng(3)
    pattern = pattern_of(3, 12, rng, 1)
    entries, _ = positive(pattern, rng)
    entries[pattern.diagonal[3 * 7 + 1]] = 0.0
    with pytest.raises(SingularError, match="variable instance 7 "):
        BlockCholesky(pattern).factor(entries)


def test_units_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    pattern = pattern_of(3, 20, rng, 40)
    entries, H = positive(pattern, rng)
    scale = 10.0 ** rng.uniform(-6, 6, pattern.size)
    solver = BlockCholesky(pattern)
    solver.factor(entries * scale[pattern.indices] * scale[pattern.columns])
    right = scale * (H @ np.ones(pattern.size))
    np.testing.assert_allclose(scale * solver.solve(right), 1.0, rtol=1e-9)


def test_forks_have_factors_of_their_own_and_the_order_is_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def ring(count: int) -> Problem:
        problem = Problem()
        x = problem.variables("x", SE2, count)
        z = problem.data("z", 3, value=np.array([1.0, 0.0, 0.1]))
        i = np.arange(count)
        problem.cost("steps", lambda a, b, z: a.between(b).local() - z, (x[i], x[(i + 1) % count]), z)
        problem.cost("first", lambda a: a.local(), x[0])
        return problem

    session: Any = ring(60).compile("gauss-newton", linear_solver="block")
    import qdldl

    monkeypatch.setattr(qdldl, "Solver", None)  # not again
    fork = session.fork()
    assert fork._linear.name == "block" and fork._linear is not session._linear
    first, second = session.solve(), fork.solve({"z": np.array([1.0, 0.1, 0.12])})
    assert first.status is Status.SOLVED and second.status is Status.SOLVED
    again = fork.solve({"z": np.array([1.0, 0.0, 0.1])}, initial={"x": first["x"]})
    assert again.objective == pytest.approx(first.objective, rel=1e-9)


def test_large_and_mixed_instances_are_refused() -> None:
    problem = Problem()
    x, y = problem.variables("x", Vector(7), 3), problem.variables("y", Vector(2), 3)
    problem.cost("x", lambda a: a, x)
    with pytest.raises(SettingError, match="at most 6; these have 2, 7"):
        BlockCholesky(LeastSquares(problem, Layout(problem)).pattern)
    assert y is not None
