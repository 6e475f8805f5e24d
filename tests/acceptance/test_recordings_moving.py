"""Goals 2 and 4 of spec `recordings` 6: the labyrinth and MRCLAM set 7, one fixed set of settings each.

Labyrinth: positions against the truth of the same stamps, all of them. MRCLAM: every robot's newest pose at every
keyframe, from when the odometry of all robots has begun to the end, against truth interpolated to it; root mean square
distance, mean over robots. Nothing is aligned.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from localization.io import mrclam, uwb_labyrinth
from localization.io.scoring import rmse_2d
from localization.tracking.team_tracker import TeamTrackerSettings, team_errors, track_start, track_team, true_poses
from localization.tracking.wheeled_tracker import WheeledTrackerSettings, track_wheels


def found(folder: Path) -> Path:
    if not folder.is_dir():
        pytest.skip(f"the recording {folder} is not there")
    return folder


@cache
def labyrinth_error(folder: Path, batch: bool = False, bias: bool = True) -> float:
    recording = uwb_labyrinth.read(folder)
    settings = replace(WheeledTrackerSettings(), bias=bias)
    made = track_wheels(recording, settings=settings, batch=batch)
    assert made.status == {"solved": len(recording.time)}
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.truth.time, made.estimate.time)
    return rmse_2d(made.estimate.value, recording.truth.value)


def test_labyrinth_batch_with_its_bias_estimated(data_dir: Path) -> None:
    assert labyrinth_error(found(data_dir / "uwb-labyrinth"), batch=True) <= 0.035


def test_labyrinth_causal_with_its_bias_estimated(data_dir: Path) -> None:
    folder = found(data_dir / "uwb-labyrinth")
    assert labyrinth_error(folder) <= 0.10
    assert labyrinth_error(folder) <= 0.6 * labyrinth_error(folder, bias=False)


@cache
def team_error(folder: Path, loss: float | None = None, off: bool = False) -> np.ndarray:
    """(robots,) m."""
    recording = mrclam.read(folder)
    settings = TeamTrackerSettings() if loss is None else replace(TeamTrackerSettings(), loss=loss)
    start = true_poses(recording, track_start(recording))
    if off:
        turn = 2 * np.pi * np.arange(len(start)) / len(start)
        start = start + np.column_stack([0.3 * np.cos(turn), 0.3 * np.sin(turn), 0.1 * (-1.0) ** np.arange(len(start))])
    made = track_team(recording, start, settings)
    assert made.status == {"solved": len(made.time)}
    assert made.dropped <= 0.02 * len(recording.sighting_time)
    return team_errors(recording, made)


def test_team_of_five_among_known_landmarks(data_dir: Path) -> None:
    errors = team_error(found(data_dir / "mrclam7"))
    assert errors.mean() <= 0.20
    assert errors.max() <= 0.222  # the worst robot of the reference


def test_team_from_starts_that_are_off_by_0_3_m(data_dir: Path) -> None:
    assert team_error(found(data_dir / "mrclam7"), off=True).mean() <= 0.20


def test_team_robust_against_plain_least_squares(data_dir: Path) -> None:
    folder = found(data_dir / "mrclam7")
    assert team_error(folder).mean() <= 0.8 * team_error(folder, loss=0.0).mean()
