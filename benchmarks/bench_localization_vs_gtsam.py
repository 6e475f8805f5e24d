"""Localizing a lattice team: our Gauss-Newton beside gtsam as its Python examples write it, in one process.

Both start at the linear least-squares positions and the compass headings and go to the same optimum: costs are
compared before times. gtsam: build the graph and the values, Levenberg-Marquardt with tolerances that reach the optimum
(the default ones can stop above it), read the poses. Ours: definition and compilation, once per team, and each solve.
Times are processor time, median of repetitions.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.record import Row, record
from localization.lattice import Measurements, draw_lattice, linear_start, team_data, team_problem
from problems.solvers.base import Status
from problems.solvers.session import Solution

gtsam = pytest.importorskip("gtsam")
ROBOTS = (100, 1_000, 10_000)
WANTED = {100: 3.2, 1_000: 8.0, 10_000: 8.5}  # gtsam's time over ours, at least
GOALS = {100: 2.0, 1_000: 6.0, 10_000: 9.0}


def by_gtsam(team: Measurements, start: np.ndarray) -> tuple[float, np.ndarray]:
    """Cost and poses of the optimum, with gtsam alone."""
    model, sigmas = gtsam.noiseModel, team.sigmas
    fix, compass = model.Isotropic.Sigma(2, sigmas.position), model.Isotropic.Sigma(1, sigmas.heading)
    seen = model.Diagonal.Sigmas(np.array([sigmas.bearing, sigmas.range]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (z, heading) in enumerate(zip(team.gps, team.compass.tolist(), strict=True)):
        graph.add(gtsam.PoseTranslationPrior2D(k, z, fix))
        graph.add(gtsam.PoseRotationPrior2D(k, gtsam.Rot2(heading), compass))
    pairs = zip(team.observer.tolist(), team.target.tolist(), team.bearing_range.tolist(), strict=True)
    for i, j, (bearing, distance) in pairs:
        graph.add(gtsam.BearingRangeFactorPose2(i, j, gtsam.Rot2(bearing), distance, seen))
    for k, (x, y, heading) in enumerate(start.tolist()):
        values.insert(k, gtsam.Pose2(x, y, heading))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    found = optimizer.optimize()
    return optimizer.error(), gtsam.utilities.extractPose2(found)


def by_scipy(team: Measurements, start: np.ndarray) -> np.ndarray:
    """Poses of the optimum by ``scipy.optimize.least_squares`` with residuals in arrays and their sparse Jacobian."""
    from scipy.optimize import least_squares
    from scipy.sparse import coo_array

    count, pairs, sigmas = len(start), len(team.observer), team.sigmas
    i, j = team.observer, team.target
    across, down = np.arange(count), np.arange(pairs)
    first = 3 * count + down
    rows = np.concatenate([2 * across, 2 * across + 1, 2 * count + across, *[first] * 5, *[first + pairs] * 4])
    ends = [3 * i, 3 * i + 1, 3 * j, 3 * j + 1]
    columns = np.concatenate([3 * across, 3 * across + 1, 3 * across + 2, *ends, 3 * i + 2, *ends])

    def wrapped(angle: np.ndarray) -> np.ndarray:
        return np.arctan2(np.sin(angle), np.cos(angle))

    def between(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x = flat.reshape(-1, 3)
        d = x[j, :2] - x[i, :2]
        return x, d, np.hypot(d[:, 0], d[:, 1])

    def residual(flat: np.ndarray) -> np.ndarray:
        x, d, away = between(flat)
        bearing = wrapped(np.arctan2(d[:, 1], d[:, 0]) - x[i, 2] - team.bearing_range[:, 0])
        return np.concatenate(
            [
                ((x[:, :2] - team.gps) / sigmas.position).ravel(),
                wrapped(x[:, 2] - team.compass) / sigmas.heading,
                bearing / sigmas.bearing,
                (away - team.bearing_range[:, 1]) / sigmas.range,
            ]
        )

    def jacobian(flat: np.ndarray) -> Any:
        _, d, away = between(flat)
        turn = np.column_stack([d[:, 1], -d[:, 0]]) / away[:, None] ** 2 / sigmas.bearing
        far = d / away[:, None] / sigmas.range
        own = [np.full(2 * count, 1 / sigmas.position), np.full(count, 1 / sigmas.heading)]
        seen = [turn[:, 0], turn[:, 1], -turn[:, 0], -turn[:, 1], np.full(pairs, -1 / sigmas.bearing)]
        values = np.concatenate([*own, *seen, -far[:, 0], -far[:, 1], far[:, 0], far[:, 1]])
        return coo_array((values, (rows, columns)), shape=(3 * count + 2 * pairs, 3 * count)).tocsr()

    # the default accuracy of LSMR ends 1e-5 m from the optimum
    tight = {"atol": 1e-12, "btol": 1e-12}
    found = least_squares(
        residual, start.ravel(), jacobian, tr_solver="lsmr", tr_options=tight, xtol=1e-12, ftol=1e-12, gtol=1e-8
    )
    return found.x.reshape(-1, 3)


def timed(run: Callable[[], Any], repetitions: int) -> tuple[float, Any]:
    """Median processor time, s, and the last result."""
    seconds, result = [], None
    for _ in range(repetitions):
        start = time.process_time()
        result = run()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds)), result


@pytest.mark.parametrize("robots", ROBOTS)
def test_localization_beside_gtsam(robots: int) -> None:
    team = draw_lattice(robots, np.random.default_rng(robots), pairs="both")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start, _ = linear_start(team)
    repetitions = max(1, min(15, 30_000 // robots))
    data = team_data(team)
    made, session = timed(lambda: team_problem(team).compile("gauss-newton"), 1)
    made_again, _ = timed(lambda: team_problem(team).compile("gauss-newton"), repetitions)

    def ours() -> Solution:
        session.reset()
        return session.solve(data, initial={"robot": start})

    solve, solution = timed(ours, repetitions)
    wrapped, other = timed(lambda: team_problem(team).compile("gtsam-lm").solve(data, {"robot": start}), 1)
    theirs, (cost, poses) = timed(lambda: by_gtsam(team, start), max(1, repetitions // 3))
    assert solution.status is Status.SOLVED and other.status is Status.SOLVED
    assert solution.objective == pytest.approx(cost, rel=1e-8)
    away = float(np.abs(solution["robot"][:, :2] - poses[:, :2]).max())
    assert away < 1e-5
    ratio = theirs / (made_again + solve)
    print(
        f"\n{robots} robots, {len(team.observer)} pairs: cost {cost:.6f}, ours {solution.objective - cost:+.1e}, "
        f"positions within {away:.0e} m\n"
        f"  ours: define and compile {1e3 * made_again:.1f} ms (first time {1e3 * made:.1f}), "
        f"solve {1e3 * solve:.1f} ms in {solution.iterations} iterations\n"
        f"  gtsam: build and optimize {1e3 * theirs:.1f} ms; through our graph form {1e3 * wrapped:.1f} ms\n"
        f"  gtsam / ours: {ratio:.1f} with compilation, {theirs / solve:.1f} without"
    )
    measure = f"localization, {robots} robots, build and solve"
    record(
        Row(
            measure, "gtsam LM", made_again + solve, theirs, wanted=GOALS[robots],
            note=f"first compilation in a process {1e3 * made:.0f} ms; solve alone {theirs / solve:.1f} times",
        )
    )  # fmt: skip
    if robots == 100:
        scipy_time, poses = timed(lambda: by_scipy(team, start), 3)
        assert np.abs(solution["robot"][:, :2] - poses[:, :2]).max() < 1e-5
        record(Row(measure, "scipy least_squares", made_again + solve, scipy_time))
    assert ratio >= WANTED[robots]
