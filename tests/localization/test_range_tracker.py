"""The range tracker: exact data give exact tracks, fixes alone give the dense least squares, and what ranges spoil."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from localization.io.recording import TimeSeries, UwbRecording
from localization.tracking.batch_track import batch_track, snapshot_track
from localization.tracking.range_tracker import (
    RangeTracker,
    RangeTrackerSettings,
    Track,
    arrivals,
    first_position,
    track,
)
from problems import registry
from problems.errors import DataError, FormError, ModelWarning, SettingError

ANCHORS = np.array([[0.0, 0.0, 2.0], [12.0, 0.0, 0.5], [0.0, 9.0, 1.5], [12.0, 9.0, 2.5]])
NONE = np.zeros(0, int), np.zeros(0), np.zeros(0)
PLAIN = RangeTrackerSettings(bias=False, lag=0.0)
Path = Callable[[np.ndarray], np.ndarray]


def straight(t: np.ndarray) -> np.ndarray:
    return np.column_stack([1.0 + 0.4 * t, 8.0 - 0.3 * t])


def curved(t: np.ndarray) -> np.ndarray:
    return np.column_stack([6 + 4 * np.cos(0.25 * t), 4.5 + 3 * np.sin(0.25 * t)])


def recording(
    path: Path = straight,
    seconds: float = 20.0,
    rate: float = 36.0,
    noise: float = 0.0,
    bias: Any = 0.0,
    blocked: float = 0.0,
    height: float = 1.0,
    seed: int = 0,
) -> UwbRecording:
    """Ranges to one anchor after the other; a share `blocked` of them 1 to 6 m too short."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1 / rate)
    anchor = np.arange(len(time)) % len(ANCHORS)
    tag = np.column_stack([path(time), np.full(len(time), height)])
    ranges = np.linalg.norm(tag - ANCHORS[anchor], axis=1) + np.broadcast_to(bias, len(ANCHORS))[anchor]
    ranges += noise * rng.normal(size=len(time))
    ranges -= (rng.random(len(time)) < blocked) * rng.uniform(1, 6, len(time))
    return UwbRecording(
        "made", ANCHORS, ("A1", "A2", "A3", "A4"), time, anchor, np.maximum(ranges, 0.05),
        truth=TimeSeries(time, np.column_stack([path(time), np.zeros(len(time))])),
    )  # fmt: skip


def error(made: Track, path: Path, ahead: float = 0.0) -> np.ndarray:
    return np.linalg.norm(made.estimate.value - path(made.estimate.time + ahead), axis=1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def without(data: UwbRecording, keep: np.ndarray) -> UwbRecording:
    return replace(data, time=data.time[keep], anchor=data.anchor[keep], ranges=data.ranges[keep])


# exact data


@pytest.mark.parametrize("horizon", [1, 5, 20])
def test_exact_ranges_of_a_steady_tag_give_its_track(horizon: int) -> None:
    start = np.concatenate([straight(np.zeros(1))[0], [0.4, -0.3]])
    made = track(recording(), start, replace(PLAIN, horizon=horizon, iterations=0))
    assert error(made, straight).max() < 1e-6
    np.testing.assert_allclose(made.velocity, np.tile([0.4, -0.3], (len(made.estimate), 1)), atol=1e-6)
    assert made.status == {"solved": len(made.estimate)}


def test_a_wrong_start_is_forgotten() -> None:
    made = track(recording(), straight(np.zeros(1))[0] + [0.5, -0.4], PLAIN)
    assert error(made, straight)[0] > 0.05
    assert error(made, straight)[50:].max() < 1e-3


def test_ranges_between_knots_are_used_at_their_own_times() -> None:
    data = recording(rate=40.0)
    shifted = replace(data, time=data.time + 0.07)  # were offsets ignored, the track would lag behind
    start = np.concatenate([straight(np.zeros(1))[0], [0.4, -0.3]])
    made = track(shifted, start, PLAIN)
    assert error(made, lambda t: straight(t - 0.07)).max() < 1e-6


def test_a_tag_coasts_where_nothing_is_heard() -> None:
    data = recording()
    gap = (data.time > 8) & (data.time < 12)
    start = np.concatenate([straight(np.zeros(1))[0], [0.4, -0.3]])
    made = track(without(data, ~gap), start, PLAIN, covariances=True)
    assert error(made, straight).max() < 1e-6
    assert made.covariance is not None
    spread = np.sqrt(np.trace(made.covariance, axis1=1, axis2=2))
    at = np.searchsorted(made.estimate.time, [7.9, 10.0, 11.9, 13.0])
    assert spread[at[0]] < 0.2 < spread[at[1]] < spread[at[2]] / 1.5
    assert spread[at[3]] < 0.2


def test_an_anchor_that_falls_silent_does_not_spoil_the_track() -> None:
    data = recording(curved, noise=0.05, seed=3)
    silent = (data.anchor == 2) & (data.time > 5)
    made = track(without(data, ~silent), curved(np.zeros(1))[0], PLAIN)
    assert rms(error(made, curved)) < 0.15


# against dense least squares


def dense(
    fixes: dict[int, np.ndarray], count: int, start: np.ndarray, s: RangeTrackerSettings
) -> tuple[np.ndarray, np.ndarray]:
    """States (count, 4) and covariance of all knots at once from fixes, prior and constant velocity."""
    n, dt = 4 * count, s.period
    H, g = np.zeros((n, n)), np.zeros(n)
    F = np.eye(4) + dt * np.eye(4, k=2)
    Q = np.kron(s.acceleration * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
    prior = np.diag([s.start_sigma**-2] * 2 + [s.speed_sigma**-2] * 2)
    H[:4, :4] += prior
    g[:4] += prior @ start
    for k in range(count - 1):
        J = np.zeros((4, n))
        J[:, 4 * k : 4 * k + 4], J[:, 4 * k + 4 : 4 * k + 8] = -F, np.eye(4)
        H += J.T @ np.linalg.inv(Q) @ J
    for k, (x, y, offset) in fixes.items():
        J = np.zeros((2, n))
        J[:, 4 * k : 4 * k + 4] = np.hstack([np.eye(2), offset * np.eye(2)])
        H += J.T @ J / s.gps_sigma**2
        g += J.T @ np.array([x, y]) / s.gps_sigma**2
    covariance = np.linalg.inv(H)
    return (covariance @ g).reshape(count, 4), covariance


@pytest.mark.parametrize("delay", [0.0, 0.3])
@pytest.mark.parametrize("horizon", [3, 6, 40])
def test_fixes_alone_give_the_dense_least_squares_for_every_horizon(horizon: int, delay: float) -> None:
    s = RangeTrackerSettings(horizon=horizon, delay=delay, lag=0.2)
    rng = np.random.default_rng(5)
    start = np.array([1.0, 2.0, 0.3, -0.1])
    tracker = RangeTracker(ANCHORS, start, s)
    fixes: dict[int, np.ndarray] = {}
    back = round(delay / s.period)
    for k in range(25):
        fix = None if k % 4 == 1 else np.array([*rng.normal(size=2), -0.1 * rng.random()])
        if fix is not None:
            fixes[k] = fix
        state = tracker.step(NONE, fix)
        states, covariance = dense(fixes, k + 1, start, s)
        row = max(k - back, 0)
        np.testing.assert_allclose(state, states[row], atol=1e-9)
        block = covariance[4 * row : 4 * row + 4, 4 * row : 4 * row + 4]
        np.testing.assert_allclose(tracker.covariance(), block, atol=1e-9)
    ahead = np.hstack([np.eye(2), 0.2 * np.eye(2)])
    predicted = ahead @ block @ ahead.T + s.acceleration * 0.2**3 / 3 * np.eye(2)
    np.testing.assert_allclose(tracker.advanced_covariance(), predicted, atol=1e-9)
    np.testing.assert_allclose(tracker.advanced(state), state[:2] + 0.2 * state[2:])


def test_biases_that_walk_lose_information_in_every_period() -> None:
    start, s = np.array([3.0, 3.0]), RangeTrackerSettings(horizon=2, bias_walk=0.05)
    tracker = RangeTracker(ANCHORS, start, s)
    for _ in range(12):
        tracker.step(NONE, np.array([3.0, 3.0, 0.0]))
    spread = np.sqrt(np.diag(tracker.solution.covariance(tracker.problem.unknowns["bias"])))
    slid = 12 - 3  # knots that have left the window
    np.testing.assert_allclose(spread, np.sqrt(0.05**2 + slid * 0.05**2 * 0.1), rtol=1e-9)


# what recordings are like


def test_the_length_of_the_window_hardly_matters() -> None:
    data = recording(curved, seconds=20, noise=0.08, bias=0.1, blocked=0.02, seed=1)
    start = curved(np.zeros(1))[0]
    tracks = [track(data, start, RangeTrackerSettings(horizon=n, lag=0.0)) for n in (2, 20)]
    assert rms(tracks[0].estimate.value - tracks[1].estimate.value) < 0.02
    assert all(rms(error(made, curved)) < 0.1 for made in tracks)


def test_a_robust_loss_survives_what_least_squares_does_not() -> None:
    data = recording(curved, seconds=20, noise=0.08, blocked=0.05, seed=2)
    start = curved(np.zeros(1))[0]
    robust = rms(error(track(data, start, PLAIN), curved))
    plain = rms(error(track(data, start, replace(PLAIN, loss=0.0)), curved))
    assert robust < 0.12
    assert plain > 3 * robust


def test_biases_are_estimated() -> None:
    true = np.array([0.02, 0.08, 0.14, 0.2])
    data = recording(curved, seconds=45, noise=0.05, bias=true, seed=4)
    start = curved(np.zeros(1))[0]
    with_bias = track(data, start, RangeTrackerSettings(lag=0.0))
    np.testing.assert_allclose(with_bias.bias, true, atol=0.025)
    late = slice(200, None)
    without_bias = track(data, start, PLAIN)
    assert np.abs(without_bias.bias).max() < 1e-6
    assert rms(error(with_bias, curved)[late]) < 0.8 * rms(error(without_bias, curved)[late])


def test_the_latency_is_made_up_for() -> None:
    data = recording(curved, seconds=20, noise=0.02)
    late = replace(data, time=data.time + 0.2)  # a range tells where the tag was 0.2 s before its stamp
    start = curved(np.zeros(1))[0]
    behind = rms(error(track(late, start, PLAIN), curved)[20:])
    made_up = rms(error(track(late, start, replace(PLAIN, lag=0.2)), curved)[20:])
    assert behind == pytest.approx(0.2 * 0.88, rel=0.25)  # mean speed of the path
    assert made_up < 0.4 * behind


def test_a_delayed_track_has_earlier_stamps_and_smaller_errors() -> None:
    data = recording(curved, seconds=20, noise=0.15, seed=6)
    start = curved(np.zeros(1))[0]
    now, later = track(data, start, PLAIN), track(data, start, replace(PLAIN, delay=1.0))
    assert later.estimate.time[0] == pytest.approx(now.estimate.time[0])
    assert later.estimate.time[-1] == pytest.approx(now.estimate.time[-1] - 1.0)
    assert rms(error(later, curved)) < 0.8 * rms(error(now, curved))


def test_coarse_fixes_help_where_two_anchors_leave_a_mirror_image() -> None:
    data = recording(curved, seconds=20, noise=0.05, seed=7)
    few = without(data, data.anchor < 2)
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 20.0, 1.0)
    fixes = TimeSeries(times, curved(times) + rng.normal(size=(20, 2)))
    start = np.array([10.0, -4.5])  # the mirror image of the true start
    lost = rms(error(track(few, start, replace(PLAIN, start_sigma=5.0)), curved)[100:])
    found = rms(error(track(few, start, replace(PLAIN, start_sigma=5.0), fixes), curved)[100:])
    assert lost > 5
    assert found < 0.3


# bookkeeping


def test_every_range_belongs_to_the_knot_that_follows_it() -> None:
    data = recording(rate=33.0)
    knots, steps = arrivals(data, PLAIN, None)
    assert len(knots) == len(steps)
    offsets = np.concatenate([step[0][2] for step in steps])
    times = np.concatenate([knot + step[0][2] for knot, step in zip(knots, steps, strict=True)])
    np.testing.assert_allclose(times, data.time, atol=1e-12)
    assert offsets.max() <= 1e-9
    assert offsets.min() > -PLAIN.period - 1e-9


def test_a_full_knot_keeps_the_newest_ranges_in_whatever_order_they_come() -> None:
    offsets = np.array([-0.03, -0.09, -0.01, -0.05])
    tracker = RangeTracker(ANCHORS, np.array([3.0, 3.0]), PLAIN)
    other = RangeTracker(ANCHORS, np.array([3.0, 3.0]), PLAIN)
    ranges = 5 + offsets
    got = tracker.step((np.zeros(4, int), ranges, offsets))
    newest = np.array([0, 2])
    expected = other.step((np.zeros(2, int), ranges[newest], offsets[newest]))
    np.testing.assert_allclose(got, expected, atol=1e-12)
    assert (tracker.dropped, other.dropped) == (2, 0)


def test_ranges_left_out_are_reported_and_a_larger_capacity_keeps_them() -> None:
    data = recording(seconds=5.0, rate=200.0)
    start = straight(np.zeros(1))[0]
    with pytest.warns(ModelWarning, match=r"\d+ of 1000 ranges are left out.*larger capacity"):
        track(data, start, PLAIN)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        track(data, start, replace(PLAIN, capacity=6))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"range_sigma": 0.0}, "range_sigma must be positive"),
        ({"period": float("nan")}, "period must be positive"),
        ({"lag": -0.1}, "lag must not be negative"),
        ({"delay": 2.1}, "delay 2.1 s is longer than the window of 2 s"),
    ],
)
def test_settings_without_meaning_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(SettingError, match=told):
        RangeTrackerSettings(**wrong)


def test_bad_anchors_and_solvers_are_refused() -> None:
    with pytest.raises(DataError, match=r"anchors are \(k, 3\)"):
        RangeTracker(ANCHORS[:, :2], np.zeros(2))
    with pytest.raises(FormError, match="quadratic programs only"):
        RangeTracker(ANCHORS, np.zeros(2), solver="osqp")


# where it starts


def test_the_start_is_found_from_the_first_ranges() -> None:
    data = recording(noise=0.02, bias=0.1, blocked=0.05)
    found = first_position(data, RangeTrackerSettings())
    assert np.linalg.norm(found - straight(np.array([0.5]))[0]) < 0.3


def test_a_start_without_three_anchors_is_refused_and_says_what_to_do() -> None:
    data = recording()
    early = data.time < 3
    with pytest.raises(DataError, match=r"in its first 1 s only A2, A3 are heard.*--set 'start=\[x, y\]'"):
        first_position(without(data, ~early | (data.anchor == 1) | (data.anchor == 2)), PLAIN)
    in_line = replace(data, anchors=ANCHORS * [1, 0, 1])
    with pytest.raises(DataError, match="three anchors that are not on one line"):
        first_position(in_line, PLAIN)


# other estimators and solvers


@pytest.mark.parametrize("solver", ["ipopt", "gtsam-lm", "sqp:daqp"])
def test_other_solvers_find_the_same_track(solver: str) -> None:
    if solver.partition(":")[0] not in registry.names("solvers"):
        pytest.skip(f"solver {solver} is not registered")
    data = recording(curved, seconds=2.0, noise=0.05, seed=8)
    start, s = curved(np.zeros(1))[0], replace(PLAIN, horizon=5, bias=True, iterations=0)
    reference = track(data, start, s, tolerance=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no native factors
        other = track(data, start, s, solver=solver, tolerance=1e-12)
    np.testing.assert_allclose(other.estimate.value, reference.estimate.value, atol=1e-4)


def test_all_knots_at_once_are_better_than_one_after_the_other() -> None:
    data = recording(curved, seconds=20, noise=0.15, blocked=0.03, seed=9)
    start = curved(np.zeros(1))[0]
    causal, whole = track(data, start, PLAIN), batch_track(data, start, PLAIN)
    assert rms(error(whole, curved)) < 0.7 * rms(error(causal, curved))
    assert whole.status == {"solved": 1}
    assert whole.residual is not None
    assert whole.residual < 0.1


def test_multilateration_at_every_knot_needs_three_anchors_there() -> None:
    data = recording(curved, seconds=10)
    gap = (data.time > 4) & (data.time < 5)
    made = snapshot_track(without(data, ~gap), curved(np.zeros(1))[0], replace(PLAIN, height=1.0))
    blind = (made.estimate.time > 4.45) & (made.estimate.time < 5.0)
    assert made.status["failed"] >= 5
    assert made.status["solved"] + made.status["failed"] == len(made.estimate)
    assert np.ptp(made.estimate.value[blind], axis=0).max() == 0  # the last position is kept
    seen = (made.estimate.time > 0.5) & (made.estimate.time < 4)
    assert error(made, curved, -0.25)[seen].max() < 0.2  # of half a second, so a quarter behind
