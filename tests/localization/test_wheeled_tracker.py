"""A robot with wheels among anchors: ranges with a common bias, heading unknown at the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.io.recording import TimeSeries, UwbRecording
from localization.tracking.wheeled_tracker import WheeledTrackerSettings, start_pose, track_wheels
from problems.errors import DataError, SettingError
from problems.noise import L2
from problems.spaces import SE2

ANCHORS = np.array([[0.0, 0.0], [0.0, 2.4], [2.4, 2.4], [2.4, 0.0]])
BIAS = 0.15


def recording(seed: int, wild: float = 0.0) -> UwbRecording:
    """Round a circle at 8 Hz after standing for 2 s; one range per stamp, all of them too long by the same bias."""
    rng = np.random.default_rng(seed)
    time = 0.125 * np.arange(1, 161)
    twist = np.where(time[:, None] < 2, 0.0, [[0.3, 0.0, 0.5]])
    poses = [np.array([[1.7, 1.2, 2.0]])]
    for k in range(len(time) - 1):
        u = twist[k] * 0.125
        poses.append(SE2.retract_array(poses[-1], np.array([[u[0], u[0] * u[2] / 2, u[2]]])))
    truth = np.vstack(poses)[:, :2]
    anchor = np.arange(len(time)) % 4
    ranges = np.linalg.norm(truth - ANCHORS[anchor], axis=1) + BIAS + 0.05 * rng.normal(size=len(time))
    ranges += (rng.random(len(time)) < wild) * rng.uniform(0.5, 2, len(time))
    measured = twist + rng.normal(size=twist.shape) * [0.02, 0.005, 0.05]
    return UwbRecording(
        name="circle", anchors=ANCHORS, anchor_names=("a", "b", "c", "d"), time=time, anchor=anchor, ranges=ranges,
        truth=TimeSeries(time, truth), odometry=TimeSeries(time, measured),
    )  # fmt: skip


def error(made: UwbRecording, **settings: object) -> tuple[float, float]:
    """Causal and batch root mean square error, m."""
    assert made.truth is not None
    tuned = replace(WheeledTrackerSettings(), **settings)
    out = []
    for batch in (False, True):
        place = track_wheels(made, settings=tuned, batch=batch).estimate.value[:, :2]
        out.append(float(np.sqrt(np.mean(np.sum((place - made.truth.value) ** 2, axis=1)))))
    return out[0], out[1]


def test_bias_and_heading_are_found() -> None:
    made = recording(0)
    track = track_wheels(made)
    assert track.bias == pytest.approx(BIAS, abs=0.03)
    assert track.status == {"solved": 160}
    causal, batch = error(made)
    assert causal < 0.08 and batch < 0.03
    without = error(made, bias=False)
    assert without[0] > causal and without[1] > 2 * batch


def test_a_robust_loss_bears_long_ranges() -> None:
    made = recording(1, wild=0.1)
    robust, plain = error(made), error(made, loss=L2())
    assert robust[1] < 0.05 and robust[1] < 0.7 * plain[1]


def test_covariance_tells_the_error() -> None:
    track = track_wheels(recording(2), batch=True)
    sigma = np.sqrt(np.diag(track.last.marginal_covariance(keyframe=80)))
    assert 0.005 < sigma[0] < 0.1 and 0.005 < sigma[1] < 0.1


def test_a_start_is_found_from_ranges_alone() -> None:
    made = recording(3)
    assert np.linalg.norm(start_pose(made)[:2] - [1.7, 1.2]) < 0.3


def test_wrong_arguments_are_refused() -> None:
    made = recording(0)
    with pytest.raises(DataError, match="odometry"):
        track_wheels(replace(made, odometry=None))
    with pytest.raises(SettingError, match="bias_sigma"):
        WheeledTrackerSettings(bias_sigma=-1.0)
