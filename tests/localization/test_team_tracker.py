"""Causal localization of a team: dead reckoning, sightings at their own times, scales of the odometry, starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.io.recording import TeamRecording, TimeSeries
from localization.io.samples import team_sample
from localization.smoothing import FixedLagSmoother, Kind, Lasting, Readings
from localization.tracking.team_tracker import (
    DeadReckoning,
    TeamTrackerSettings,
    team_errors,
    track_start,
    track_team,
    true_poses,
)
from problems.errors import DataError, DefinitionError, SettingError
from problems.noise import Gaussian
from problems.spaces import SE2, Vector


@pytest.fixture(scope="module")
def team() -> TeamRecording:
    return team_sample(np.random.default_rng(4))[0]


def followed(team: TeamRecording, **settings: object) -> np.ndarray:
    start = true_poses(team, track_start(team)) + [0.2, -0.2, 0.1]
    return team_errors(team, track_team(team, start, replace(TeamTrackerSettings(), **settings)))


def test_dead_reckoning_goes_round_a_circle() -> None:
    steady = DeadReckoning(TimeSeries(np.arange(0, 10, 0.01), np.tile([2.0, 0.5], (1000, 1))))
    poses, driven, turned = steady.at(np.array([-1.0, 0.0, 3.005, 9.0]))
    when = np.array([0.0, 0.0, 3.005, 9.0])
    expected = np.column_stack([4 * np.sin(0.5 * when), 4 * (1 - np.cos(0.5 * when)), 0.5 * when])
    np.testing.assert_allclose(poses, expected, atol=1e-5)
    np.testing.assert_allclose(driven, 2 * when, atol=1e-9)
    np.testing.assert_allclose(turned, 0.5 * when, atol=1e-9)


def test_the_team_is_found_from_a_start_that_is_off(team: TeamRecording) -> None:
    errors = followed(team)
    assert (errors < 0.12).all()
    reckoned = [DeadReckoning(series) for series in team.odometry]
    start = true_poses(team, 0.0) + [0.2, -0.2, 0.1]
    for robot, one in enumerate(reckoned):
        assert team.truth is not None
        moved = SE2.retract_array(np.tile(start[robot], (300, 1)), one.at(team.truth[robot].time)[0])
        alone = np.sqrt(np.mean(np.sum((moved[:, :2] - team.truth[robot].value[:, :2]) ** 2, axis=1)))
        assert errors[robot] < alone / 2


def test_sightings_are_used_at_their_own_time(team: TeamRecording) -> None:
    """Keyframes three seconds apart, robots that drive half a metre meanwhile."""
    late = np.max(followed(team, period=3.0, capacity=30, pair_capacity=4))
    assert late < 0.2


def test_scales_of_the_odometry_are_estimated(team: TeamRecording) -> None:
    slow = replace(team, odometry=tuple(TimeSeries(o.time, o.value * [1.25, 0.8]) for o in team.odometry))
    track = track_team(slow, true_poses(slow, 0.0), TeamTrackerSettings(scale_sigma=0.3))
    np.testing.assert_allclose(track.scale, np.tile([0.8, 1.25], (2, 1)), atol=0.12)
    fixed = track_team(slow, true_poses(slow, 0.0), TeamTrackerSettings(scale_sigma=1e-4))
    assert team_errors(slow, track).mean() < team_errors(slow, fixed).mean()


def test_outliers_need_a_loss(team: TeamRecording) -> None:
    rng = np.random.default_rng(2)
    wild = team.range_bearing.copy()
    wild[rng.random(len(wild)) < 0.1, 0] += 2.0
    spoiled = replace(team, range_bearing=wild)
    assert followed(spoiled).mean() < 0.15
    assert followed(spoiled).mean() < 0.6 * followed(spoiled, loss=0.0).mean()


def test_covariances_and_counts(team: TeamRecording) -> None:
    track = track_team(team, true_poses(team, 0.0), covariances=True)
    assert track.covariance is not None and track.covariance.shape == (len(track.time), 2, 3, 3)
    assert np.linalg.eigvalsh(track.covariance).min() > 0
    assert track.status == {"solved": len(track.time)} and track.dropped == 0
    crowded = track_team(team, true_poses(team, 0.0), TeamTrackerSettings(capacity=1))
    assert crowded.dropped > 0


def test_wrong_arguments_are_refused(team: TeamRecording) -> None:
    with pytest.raises(DataError, match="one pose"):
        track_team(team, np.zeros(3))
    with pytest.raises(DataError, match="no truth"):
        true_poses(replace(team, truth=None), 0.0)
    with pytest.raises(SettingError, match="range_sigma"):
        TeamTrackerSettings(range_sigma=0.0)


def offset(pose: object, bias: object, z: object) -> object:
    return pose + bias - z  # type: ignore[operator]


def test_own_unknowns_are_read_by_their_robot_alone() -> None:
    """Biased fixes of two robots, one of them also told where it is: only its bias is found."""
    kinds = {
        "biased": Kind(offset, ("pose", "bias"), (1,), Gaussian(0.1)),
        "exact": Kind(lambda pose, z: pose - z, ("pose",), (1,), Gaussian(0.01)),
        "odometry": Kind(lambda before, pose, z: pose - before - z, ("before", "pose"), (1,), Gaussian(0.01)),
    }
    bias = {"bias": Lasting(Vector(1), 2, [0.0], 5.0, own=True)}
    smoother = FixedLagSmoother(Vector(1), 2, kinds, start=[0.0], start_sigma=10.0, robots=2, lasting=bias)
    for k in range(5):
        given = {
            "biased": Readings(np.array([[k + 1.5], [k - 0.7]]), np.array([0, 1])),
            "exact": Readings(np.array([[float(k)]]), np.array([0])),
        }
        if k:
            given["odometry"] = Readings(np.ones((2, 1)), np.array([0, 1]))
        estimate = smoother.step(given)
    assert estimate.lasting["bias"][0, 0] == pytest.approx(1.5, abs=0.01)
    # the other's share of 10^2 and 5^2
    assert estimate.lasting["bias"][1, 0] == pytest.approx(-0.7 * 25 / 125, abs=0.01)
    with pytest.raises(DefinitionError, match="one for each"):
        wrong = {"bias": Lasting(Vector(1), 3, [0.0], 5.0, own=True)}
        FixedLagSmoother(Vector(1), 2, kinds, start=[0.0], start_sigma=1.0, robots=2, lasting=wrong)
