"""30 000 range-bearing terms from arrays: stated, and evaluated beside hand-written NumPy; importing the package.

The hand-written version computes residuals and both Jacobian blocks of all measurements with whole-array operations,
the way one writes them for one measurement model. Equality is checked before anything is timed; the two take turns.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

import numpy as np

from localization import measurements as meas
from problems import SE2, Gaussian, Problem, wrap
from problems.forms.layout import Layout
from problems.forms.residual_code import residual_code

ROBOTS, TERMS = 10_000, 30_000
DEFINITION_LIMIT = 0.5  # s
RATIO_LIMIT = 3.0
IMPORT_LIMIT = 0.6  # s


def case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (robots, 3), pairs (terms, 2) and measurements (terms, 2) of bearing and range."""
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(0, 400, (ROBOTS, 2)), rng.uniform(-np.pi, np.pi, ROBOTS)])
    first = rng.integers(0, ROBOTS, TERMS)
    pairs = np.column_stack([first, (first + rng.integers(1, ROBOTS, TERMS)) % ROBOTS])
    d = poses[pairs[:, 1], :2] - poses[pairs[:, 0], :2]
    bearing = wrap(np.arctan2(d[:, 1], d[:, 0]) - poses[pairs[:, 0], 2])
    return poses, pairs, np.column_stack([bearing, np.hypot(*d.T)]) + 0.05 * rng.normal(size=(TERMS, 2))


def state(pairs: np.ndarray, z: np.ndarray) -> Problem:
    team = Problem("team")
    robot = team.variables("robot", SE2, ROBOTS)
    data = team.data("bearing_range", 2, count=TERMS, value=z)
    on = (robot[pairs[:, 0]], robot[pairs[:, 1]])
    team.cost("seen", meas.bearing_range, on=on, data=data, noise=Gaussian(sigma=[0.03, 0.1]))
    return team


def by_hand(poses: np.ndarray, pairs: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (terms, 2) and Jacobians (terms, 2, 6) in tangent coordinates of both poses."""
    a, b = poses[pairs[:, 0]], poses[pairs[:, 1]]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    u, v = c * dx + s * dy, c * dy - s * dx
    square = u * u + v * v
    distance = np.sqrt(square)
    r = np.empty((len(pairs), 2))
    r[:, 0] = wrap(np.arctan2(v, u) - z[:, 0])
    r[:, 1] = distance - z[:, 1]
    ru, rv = u / distance, v / distance
    bu, bv = -v / square, u / square
    turn = b[:, 2] - a[:, 2]
    ct, st = np.cos(turn), np.sin(turn)
    J = np.zeros((len(pairs), 2, 6))
    J[:, 0, 0], J[:, 0, 1], J[:, 0, 2] = -bu, -bv, -1.0
    J[:, 1, 0], J[:, 1, 1] = -ru, -rv
    J[:, 0, 3], J[:, 0, 4] = bu * ct + bv * st, bv * ct - bu * st
    J[:, 1, 3], J[:, 1, 4] = ru * ct + rv * st, rv * ct - ru * st
    return r, J


def test_thirty_thousand_terms_are_stated_at_once() -> None:
    _, pairs, z = case()
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        problem = state(pairs, z)
        seconds.append(time.perf_counter() - start)
    print(f"\nstating {TERMS} terms: first {seconds[0] * 1e3:.1f} ms, then {min(seconds) * 1e3:.2f} ms")
    assert problem.terms["seen"].count == TERMS
    assert seconds[0] < DEFINITION_LIMIT


def test_residuals_and_jacobians_cost_at_most_three_times_hand_written_numpy() -> None:
    poses, pairs, z = case()
    problem = state(pairs, z)
    entry, code = Layout(problem).terms[0], residual_code(problem.terms["seen"])
    point, columns = poses.ravel(), list(z.T.copy())

    def ours() -> tuple[np.ndarray, np.ndarray]:
        stored = [point.take(entry.stored[:, k]) for k in range(entry.stored.shape[1])]
        return code.residual_and_jacobian(stored + columns, TERMS)

    for got, want in zip(ours(), by_hand(poses, pairs, z), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-10)
    times: dict[str, list[float]] = {"ours": [], "by hand": []}
    for _ in range(30):
        for name, run in (("ours", ours), ("by hand", lambda: by_hand(poses, pairs, z))):
            start = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - start)
    median = {name: statistics.median(seconds) for name, seconds in times.items()}
    ratio = median["ours"] / median["by hand"]
    ours_ms, hand_ms = median["ours"] * 1e3, median["by hand"] * 1e3
    print(f"\n{TERMS} terms: ours {ours_ms:.2f} ms, by hand {hand_ms:.2f} ms, ratio {ratio:.2f}")
    assert ratio < RATIO_LIMIT


def test_importing_problems_is_quick() -> None:
    code = "import time; start = time.perf_counter(); import problems; print(time.perf_counter() - start)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(5)]
    seconds = sorted(float(run.stdout) for run in runs)
    print(f"\nimport problems: {seconds[0]:.3f} to {seconds[-1]:.3f} s")
    assert statistics.median(seconds) < IMPORT_LIMIT
