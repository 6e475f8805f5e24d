"""Sessions: nothing is built twice, forks do not meet, what was solved is forgotten when asked."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from session_problems import (
    ALL,
    equal,
    outputs,
    sequence,
    team,
    team_data,
    window,
)

import problems.solvers.qp_session as qp_session
from problems import registry
from problems.solvers.qp_support import Backend


@pytest.mark.parametrize("solver", ["auto", "daqp", "proxqp", "osqp", "piqp"])
def test_a_second_solve_constructs_nothing(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    kind = registry.load("solvers", "daqp" if solver == "auto" else solver)
    for name in ("__init__", "_build"):
        original = getattr(kind, name)

        def counted(self: Any, *a: Any, original: Any = original, name: str = name) -> Any:
            made.append(name)
            return original(self, *a)

        monkeypatch.setattr(kind, name, counted)
    maps: list[int] = []
    dense_map = qp_session.DenseMap
    monkeypatch.setattr(qp_session, "DenseMap", lambda *a: maps.append(1) or dense_map(*a))
    session = window().compile(solver)
    first = session.solve({"y": outputs(0)})
    assert first.solved and first.method == solver
    assert made == ["__init__", "_build"]
    before = len(maps)
    for k in range(1, 8):
        assert session.solve({"y": outputs(k)}).solved
    assert made == ["__init__", "_build"] and len(maps) == before


def test_a_second_solve_of_a_graph_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    p, *_ = team(fence=5.0)
    data, initial = team_data()
    session = p.compile("gauss-newton")
    assert session.solve(data, initial).solved
    made: list[str] = []
    real = ca.Function
    monkeypatch.setattr(ca, "Function", lambda *a, **k: made.append("function") or real(*a, **k))
    monkeypatch.setattr(Backend, "__init__", lambda *a: made.append("backend"))
    for seed in range(1, 4):
        data, initial = team_data(seed=seed)
        assert session.solve(data, initial).solved
    assert made == []


def test_the_maps_of_patterns_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    maps: list[int] = []
    dense_map = qp_session.DenseMap
    monkeypatch.setattr(qp_session, "DenseMap", lambda *a: maps.append(1) or dense_map(*a))
    session = window().compile()
    session.solve({"y": outputs(0)})
    maps.clear()
    holes = [outputs(k) for k in range(4)]
    for k, y in enumerate(holes):
        y[k] = np.nan
    for _ in range(3):
        for y in holes:
            session.solve({"y": y})
    assert len(maps) == 4
    for _ in range(3):
        session.solve({"y": outputs(1), "on": [1, 1, 0, 1, 1]})
        session.solve({"on": [1, 1, 1, 1, 1]})
    assert len(maps) == 5
    session.solve({"R": 0.5, "P": np.eye(2), "C": [[1.0, 0.3]]})  # the same numbers again
    assert len(maps) == 5
    session.solve({"R": 0.6})
    assert len(maps) == 6


def fork_case(solver: str) -> tuple[Any, list[dict[str, Any]], list[dict[str, Any]]]:
    """A session that has solved once, and the data of two forks."""
    if solver != "fence":
        session = window().compile(solver)
        session.solve({"y": outputs(9)})
        return session, sequence(5), sequence(6)
    p, *_ = team(fence=5.0)
    session = p.compile("gauss-newton")
    session.solve(*team_data(seed=9))
    return session, [team_data(seed=k)[0] for k in range(3)], [team_data(seed=k)[0] for k in range(3, 6)]


@pytest.mark.parametrize("solver", [*ALL, "fence"])
def test_forks_do_not_meet(solver: str) -> None:
    base, first, second = fork_case(solver)
    alone = []
    for steps in (first, second):
        fork = base.fork()
        alone.append([fork.solve(data).point.copy() for data in steps])
    one, two = base.fork(), base.fork()
    for a, b, want_a, want_b in zip(first, second, *alone, strict=True):
        equal(one.solve(a).point, want_a, solver)
        equal(two.solve(b).point, want_b, solver)
    again = base.fork()
    equal(again.solve(first[0]).point, alone[0][0], solver)


@pytest.mark.parametrize("solver", ALL)
def test_a_fork_owns_its_data(solver: str) -> None:
    base = window().compile(solver)
    want = base.solve({"y": outputs(0)}).point.copy()
    fork = base.fork()
    fork.update(y=outputs(1), R=3.0)
    np.testing.assert_allclose(base.solve().point, want, atol=1e-7)
    np.testing.assert_allclose(base.fork().solve().point, want, atol=1e-7)
    assert np.abs(fork.solve().point - want).max() > 1e-3


@pytest.mark.parametrize("solver", [*ALL, "fence"])
def test_reset_forgets_what_was_solved(solver: str) -> None:
    def fresh() -> Any:
        if solver == "fence":
            return team(fence=5.0)[0].compile("gauss-newton")
        return window().compile(solver)

    steps = [team_data(seed=k) for k in range(2)] if solver == "fence" else [(d, None) for d in sequence(7, 3)]
    used = fresh()
    for data, initial in steps:
        used.solve(data, initial)
    used.reset()
    new = fresh()
    data, initial = steps[0]
    if solver != "fence":
        known: dict[str, Any] = {}
        for d, _ in steps:
            known |= d
        data = known
    equal(used.solve(data, initial).point, new.solve(data, initial).point, solver)


@pytest.mark.parametrize("solver", ALL)
def test_a_solution_stays_what_it_was(solver: str) -> None:
    session = window().compile(solver)
    solution = session.solve({"y": outputs(0)})
    point = solution.point.copy()
    other = window()
    copy = other.compile(solver).solve({"y": outputs(0)})
    session.solve({"y": outputs(1), "R": 2.0, "P": 3 * np.eye(2), "on": [0, 1, 1, 1, 1]})
    np.testing.assert_array_equal(solution.point, point)
    # computed only now, from the data of its own solve
    assert solution.objective == pytest.approx(copy.objective, rel=1e-9)
    for name, y in copy.multipliers.items():
        np.testing.assert_allclose(solution.multipliers[name], y, atol=1e-9)
    x, x_copy = session.problem.unknowns["x"], other.unknowns["x"]
    np.testing.assert_allclose(solution.covariance(x), copy.covariance(x_copy), atol=1e-10)
    assert max(solution.residuals.values()) < 1e-6


def test_reset_sessions_answer_to_the_bit_whatever_weights_they_knew() -> None:
    """Weights met for the first time are answered without the map that those that come back get."""
    sessions = [window().compile() for _ in range(2)]
    weights = [0.5, 0.7, 0.5, 0.5, 0.9]

    def run(session: Any) -> list[np.ndarray]:
        session.reset()
        return [session.solve({"y": outputs(k), "R": R})["x"].copy() for k, R in enumerate(weights)]

    first = run(sessions[0])
    for R in weights:
        sessions[1].solve({"y": outputs(9), "R": R})
    for repeated in (run(sessions[0]), run(sessions[1])):
        assert all(np.array_equal(one, other) for one, other in zip(first, repeated, strict=True))
    sessions[1].update(R=0.9)
    np.testing.assert_allclose(sessions[1].solve({"y": outputs(4)})["x"], first[4], atol=1e-12)
