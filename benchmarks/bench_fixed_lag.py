"""Fixed-lag smoothing: what a step costs does not depend on how long the smoother has run.

One SE(2) robot with odometry and fixes over 10 000 keyframes, for several lags. The exponent b of ``step ~ k**b`` is
fitted to medians of blocks of 500 keyframes; block medians bear what else the machine does. Peak memory is the resident
set's high-water mark, read after a warm-up and at the end. Times are wall times of `FixedLagSmoother.step`.
"""

from __future__ import annotations

import resource

import numpy as np
import pytest

from benchmarks.record import Row, record
from localization import measurements as meas
from localization.smoothing import FixedLagSmoother, Kind, Readings
from problems.noise import Gaussian
from problems.spaces import SE2

KEYFRAMES, BLOCK = 10_000, 500


def smoother_of(lag: int) -> FixedLagSmoother:
    kinds = {
        "odometry": Kind(meas.relative_pose, ("before", "pose"), (3,), Gaussian(sigma=[0.05, 0.05, 0.02])),
        "gps": Kind(meas.position, ("pose",), (2,), Gaussian(1.0)),
    }
    return FixedLagSmoother(
        SE2, lag, kinds, start=[0, 0, 0], start_sigma=[1, 1, 0.1], iterations=1,
        predict=lambda states, given: SE2.retract_array(states, given["odometry"].values),
    )  # fmt: skip


@pytest.mark.parametrize("lag", [5, 20])
def test_step_time_does_not_depend_on_run_length(lag: int) -> None:
    smoother, rng, where = smoother_of(lag), np.random.default_rng(0), np.array([0])
    x, turn = np.zeros((1, 3)), np.array([[0.3, 0.0, 0.06]])
    seconds, error, warm = np.empty(KEYFRAMES), np.empty(KEYFRAMES), 0
    for k in range(KEYFRAMES):
        given = {}
        if k:
            x = SE2.retract_array(x, turn)
            given["odometry"] = Readings(turn + rng.normal(size=(1, 3)) * [0.05, 0.05, 0.02], where)
        given["gps"] = Readings(x[:, :2] + rng.normal(size=(1, 2)), where)
        estimate = smoother.step(given)
        seconds[k], error[k] = estimate.seconds, np.linalg.norm(estimate.state[0, :2] - x[0, :2])
        if k == 2 * BLOCK:
            warm = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - warm
    medians = np.median(seconds[BLOCK:].reshape(-1, BLOCK), axis=1)  # the first block fills the window
    middle = BLOCK * (1.5 + np.arange(len(medians)))
    exponent, _ = np.polyfit(np.log(middle), np.log(medians), 1)
    print(
        f"\nlag {lag}: step {1e6 * np.median(seconds):.0f} us (p95 {1e6 * np.percentile(seconds, 95):.0f}), "
        f"first block {1e6 * medians[0]:.0f}, last {1e6 * medians[-1]:.0f} us, exponent {exponent:+.3f}; peak memory "
        f"grew by {grown} kB after keyframe {2 * BLOCK}; error {np.sqrt(np.mean(error**2)):.3f} m"
    )
    name = f"growth with run length, fixed-lag step, lag {lag}"
    record(Row(name, "", float(abs(exponent)), unit="(exponent)", wanted=0.15))
    assert abs(exponent) < 0.15
    assert grown < 4096  # kB; a thousand bytes kept from every keyframe would be 9 000
    assert np.sqrt(np.mean(error**2)) < 0.5
