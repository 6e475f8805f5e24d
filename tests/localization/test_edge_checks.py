"""The statistic of a measurement equals leaving it out; wrong loop closures are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from localization.edge_checks import check_edges, whitened_residuals
from localization.io import PoseGraph, open_recording
from localization.io.recording import Edges
from localization.pose_graph import graph_problem
from problems import Cauchy, Gaussian, GemanMcClure, Problem, Vector
from problems.errors import DataError

Make = Callable[..., PoseGraph]


def appended(g: PoseGraph, first: int, second: int, value: list[float]) -> PoseGraph:
    e = g.relative_poses
    return replace(
        g,
        relative_poses=Edges(
            np.r_[e.first, first], np.r_[e.second, second], np.vstack([e.value, value]),
            np.concatenate([e.information, e.information[:1]]), np.r_[e.time, np.nan],
        ),
    )  # fmt: skip


def solved(g: PoseGraph, losses: Any = None, **settings: Any) -> tuple[Any, Any]:
    problem, initial = graph_problem(g, losses=losses)
    session = problem.compile("gauss-newton", **settings)
    return session, session.solve(initial=initial)


def linear(loss: Any = None) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """y = C x + noise with unequal sigmas, one bad row, as a problem and as arrays."""
    rng = np.random.default_rng(0)
    C, sigma = rng.normal(size=(30, 3)), rng.uniform(0.5, 2.0, 30)
    y = C @ [1.0, -2.0, 0.5] + sigma * rng.normal(size=30)
    y[17] += 12
    problem = Problem()
    x = problem.variables("x", Vector(3))
    row, value = problem.data("row", 3, 30, C), problem.data("value", (), 30, y)
    problem.cost("rows", lambda x, c, v: c.T @ x - v, x, (row, value), Gaussian(sigma=sigma[:, None]), loss)
    return problem, C / sigma[:, None], y / sigma, sigma


@pytest.mark.parametrize("loss", [None, Cauchy(1.5)])
def test_the_statistic_is_the_prediction_of_all_others(loss: Any) -> None:
    problem, A, b, _ = linear(loss)
    session = problem.compile("gauss-newton")
    solution = session.solve()
    checks = check_edges(session, solution, 30)
    assert len(checks) == 30 and checks[0].row == 17
    r = A @ solution["x"][0] - b
    np.testing.assert_allclose(whitened_residuals(session, solution)["rows"][:, 0], r)
    weight = np.ones(30) if loss is None else 1 / (1 + r**2 / 1.5**2)
    for check in checks:
        k = check.row
        assert check.weight == pytest.approx(weight[k])
        rest = np.arange(30) != k
        # one reweighted least squares without the row, about the same point
        H = (A[rest] * weight[rest, None]).T @ A[rest]
        x = np.linalg.solve(H, (A[rest] * weight[rest, None]).T @ b[rest])
        predicted = A[k] @ x - b[k]
        expected = predicted**2 / (1 + A[k] @ np.linalg.solve(H, A[k]))
        assert check.statistic == pytest.approx(expected, rel=1e-3)
        leverage = weight[k] * A[k] @ np.linalg.solve(H + weight[k] * np.outer(A[k], A[k]), A[k])
        assert check.redundancy == pytest.approx(1 - leverage)


def test_p_values_are_uniform_where_the_noise_is_what_it_says(loop: Make) -> None:
    g = loop(2, np.random.default_rng(6), 0.1)  # its information is that of 0.1
    session, solution = solved(g)
    checks = check_edges(session, solution, len(g.relative_poses))
    assert kstest([check.p_against_others for check in checks], "uniform").pvalue > 0.01
    assert all(0 < check.redundancy < 1 and check.freedom == 3 for check in checks)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_measurement_that_nothing_controls_is_not_tested(loop: Make, dimension: int) -> None:
    g = loop(dimension, np.random.default_rng(7), 0.0, 30)
    e = g.relative_poses
    chain = replace(
        g, relative_poses=Edges(*(getattr(e, f)[:29] for f in ("first", "second", "value", "information", "time")))
    )
    session, solution = solved(chain)
    for check in check_edges(session, solution, 5):
        assert check.freedom == 0 and np.isnan(check.p_against_others)
        assert check.redundancy == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("losses", [None, {"loop_closures": GemanMcClure(3.0)}])
def test_a_wrong_loop_closure_is_the_worst_edge(loop: Make, losses: Any) -> None:
    g = appended(loop(2, np.random.default_rng(8), 0.05), 4, 29, [0.3, -0.2, 2.0])
    session, solution = solved(g, losses, graduated=losses is not None)
    worst, second, *_ = check_edges(session, solution, 5)
    assert dict(worst.unknowns).keys() == {"pose"} and [k for _, k in worst.unknowns] == [4, 29]
    assert worst.p_against_others < 1e-12
    if losses:
        assert worst.weight < 1e-3 and second.p_against_others > 1e-4


def test_missing_data_are_not_the_worst(real_data: Callable[[str], Path]) -> None:
    problem, A, _, sigma = linear()
    y = (A @ [1.0, -2.0, 0.5]) * sigma
    y[3] = np.nan
    session = problem.compile("gauss-newton")
    solution = session.solve({"value": y})
    rows = {check.row for check in check_edges(session, solution, 30)}
    assert rows == set(range(30)) - {3}
    with pytest.raises(DataError, match="worst must be at least 1"):
        check_edges(session, solution, 0)


def test_a_wrong_closure_of_manhattan_is_found(real_data: Callable[[str], Path]) -> None:
    g = appended(open_recording(real_data("g2o/manhattan.g2o")), 1093, 2084, [0.0, 0.0, 1.0])
    session, solution = solved(g)
    worst = check_edges(session, solution, 3)[0]
    assert [k for _, k in worst.unknowns] == [1093, 2084]
    assert solution.objective > 2 * 1774.520535
