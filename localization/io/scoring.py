"""How far an estimate is from recorded truth: the published UWB windows, and trajectory error after alignment."""

from __future__ import annotations

import numpy as np

from localization.io.recording import TimeSeries, UwbRecording
from problems.errors import DataError

HIGHEST_TRUTH = 0.5
"""Truth rows whose height deviates from zero by this much (m) or more are left out of the UWB score."""


def rmse_2d(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square horizontal distance (m) of matching positions (m, at least 2).

    Raises:
        DataError: no rows, different counts, or values that are not finite.
    """
    return _rms(_matching(estimate, truth, 2))


def align(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation that bring positions closest to the truth in least squares.

    Args:
        estimate: (m, p) positions, p = 2 or 3.
        truth: (m, p).

    Returns:
        Rotation (p, p), proper, and translation (p,): ``estimate @ rotation.T + translation`` is the aligned estimate.
        Umeyama (1991), equations 39 to 41, with the scale fixed to one.

    Raises:
        DataError: no rows, different shapes, or values that are not finite.
    """
    _matching(estimate, truth, np.shape(truth)[-1])
    center, target = estimate.mean(axis=0), truth.mean(axis=0)
    left, _, right = np.linalg.svd((truth - target).T @ (estimate - center))
    proper = np.ones(len(left))
    proper[-1] = np.sign(np.linalg.det(left @ right))
    rotation = (left * proper) @ right
    return rotation, target - rotation @ center


def ate(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Absolute trajectory error: root mean square distance (m) after the rigid alignment of `align`."""
    rotation, translation = align(estimate, truth)
    return _rms(estimate @ rotation.T + translation - truth)


def scoring_window(recording: UwbRecording) -> tuple[float, float]:
    """First and last time (s) that count, both included.

    Trajectory A counts from the first truth row with x > 49.3 and y > -5 to the first later one with x <= 12 and
    y > 3.4; B from x < 8.6 and y < -7 to x > 8.6 and y < -7 (m). Any other recording counts as long as its truth lasts.
    Source: spec recordings 1.

    Raises:
        DataError: there is no truth, or it never enters or never leaves the window.
    """
    truth = _truth(recording)
    if recording.trajectory is None:
        return float(truth.time[0]), float(truth.time[-1])
    x, y = truth.value[:, 0], truth.value[:, 1]
    if recording.trajectory == "A":
        enters, leaves = (x > 49.3) & (y > -5), (x <= 12) & (y > 3.4)
    else:
        enters, leaves = (x < 8.6) & (y < -7), (x > 8.6) & (y < -7)
    first = int(np.argmax(enters))
    last = first + int(np.argmax(leaves[first:]))
    if not (enters[first] and leaves[last]):
        raise DataError(
            f"{recording.name}: the truth never {'leaves' if enters[first] else 'enters'} the scoring window of "
            f"trajectory {recording.trajectory}; is it the other trajectory?"
        )
    return float(truth.time[first]), float(truth.time[last])


def uwb_scores(recording: UwbRecording, estimate: TimeSeries) -> dict[str, float]:
    """Errors of an estimated track, computed as the published figures are.

    Truth is interpolated linearly to the times of those estimates that lie inside `scoring_window`, and raised by the
    tag's height; every estimate inside counts once.

    Args:
        recording: with truth.
        estimate: positions (m, 2) or (m, 3) in the anchors' frame.

    Returns:
        ``rmse_2d``, and ``rmse`` in three dimensions where estimate and truth have heights (m).

    Raises:
        DataError: no truth, an estimate that is not finite or does not span the window of a trajectory.
    """
    begin, end = scoring_window(recording)
    truth = _truth(recording)
    inside = (estimate.time >= begin) & (estimate.time <= end)
    time = estimate.time[inside]
    spans = len(estimate) > 0 and estimate.time[0] <= begin and estimate.time[-1] >= end
    if not len(time) or (recording.trajectory is not None and not spans):
        lasts = f"lasts from {estimate.time[0]:.1f} s to {estimate.time[-1]:.1f} s" if len(estimate) else "is empty"
        raise DataError(f"{recording.name}: scoring needs an estimate from {begin:.1f} s to {end:.1f} s; it {lasts}")
    reference = np.column_stack([np.interp(time, truth.time, column) for column in truth.value.T])
    if reference.shape[1] == 3:
        reference[:, 2] += recording.tag_height
    position = estimate.value[inside]
    scores = {"rmse_2d": rmse_2d(position, reference)}
    if position.shape[1] == reference.shape[1] == 3:
        scores["rmse"] = _rms(position - reference)
    return scores


def _truth(recording: UwbRecording) -> TimeSeries:
    truth = recording.truth
    if truth is None:
        raise DataError(f"{recording.name}: scoring needs truth, and the recording has none")
    if truth.value.shape[1] < 3:
        return truth
    level = np.abs(truth.value[:, 2]) < HIGHEST_TRUTH
    if not level.any():
        raise DataError(f"{recording.name}: no truth row is within {HIGHEST_TRUTH} m of height zero")
    return TimeSeries(truth.time[level], truth.value[level])


def _matching(estimate: np.ndarray, truth: np.ndarray, columns: int) -> np.ndarray:
    if estimate.ndim != 2 or truth.ndim != 2 or len(estimate) != len(truth) or not len(truth):
        raise DataError(f"expected as many estimates as truths, one row each; got {estimate.shape} and {truth.shape}")
    if min(estimate.shape[1], truth.shape[1]) < columns:
        raise DataError(f"expected positions of {columns} coordinates; got {estimate.shape} and {truth.shape}")
    difference = estimate[:, :columns] - truth[:, :columns]
    if not np.isfinite(difference).all():
        row = int(np.flatnonzero(~np.isfinite(difference).all(axis=1))[0])
        raise DataError(f"positions must be finite; row {row}: estimate {estimate[row]}, truth {truth[row]}")
    return difference


def _rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
