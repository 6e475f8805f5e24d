"""Folders of indoor UWB ranges and wheel odometry (Labyrinth).

Source: spec recordings 2, which corrects the data set's readme: column 3 of ``odom2diff`` is the left wheel, 4 the
right one, and column 6 is half the distance between them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.io.recording import TimeSeries, UwbRecording
from localization.io.records import Block, Record, read_records
from problems.errors import ReadError

layout = "uwb_labyrinth: a folder with one *_Input.txt (range2 and odom2diff lines) and its *_GT.txt"

_RANGE = Record("range2", keys=0, value=7)
_ODOMETRY = Record("odom2diff", keys=0, value=8)
_TRUTH = Record("point2", keys=0, value=7)


def _inputs(path: Path) -> list[Path]:
    return sorted(path.glob("*_Input.txt")) if path.is_dir() else []


def matches(path: str | Path) -> bool:
    """Whether `path` looks like a folder of this layout."""
    return bool(_inputs(Path(path)))


def read(path: str | Path) -> UwbRecording:
    """Read a folder. Positions are in the plane; times start with the file's own clock.

    Raises:
        ReadError: no or several input files, or a malformed one; names file, line and what was expected.
    """
    path = Path(path)
    files = _inputs(path)
    if len(files) != 1:
        raise ReadError(path, None, "one file *_Input.txt", f"{len(files)}")
    blocks = read_records(files[0], (_RANGE, _ODOMETRY))
    ranges = blocks["range2"]
    if not len(ranges):
        raise ReadError(files[0], None, "at least one range2 line", "none")
    time, distance, variance, x, y, module, _ = ranges.value.T
    _require(ranges, module == np.round(module), "a whole number as module ID")
    _require(ranges, variance > 0, "a positive variance")
    numbers, first, anchor = np.unique(module, return_index=True, return_inverse=True)
    places = np.column_stack([x, y])
    anchors = places[first]
    _require(ranges, (places == anchors[anchor]).all(axis=1), "one position per module")
    order = np.argsort(time, kind="stable")
    truth_file = files[0].with_name(files[0].name.replace("_Input.txt", "_GT.txt"))
    return UwbRecording(
        name=path.resolve().name,
        anchors=anchors,
        anchor_names=tuple(str(int(number)) for number in numbers),
        time=time[order],
        anchor=anchor[order],
        ranges=distance[order],
        range_variance=variance[order],
        truth=_truth(truth_file) if truth_file.exists() else None,
        odometry=_odometry(blocks["odom2diff"]) if len(blocks["odom2diff"]) else None,
    )


def _require(block: Block, good: np.ndarray, expected: str) -> None:
    bad = np.flatnonzero(~good)
    if bad.size:
        raise block.rows.error(int(bad[0]), expected, repr(block.rows.texts[bad[0]]))


def _truth(file: Path) -> TimeSeries:
    block = read_records(file, (_TRUTH,))["point2"]
    time, place = block.value[:, 0], block.value[:, 1:3]
    _require(block, np.r_[True, np.diff(time) > 0], "times that increase")
    return TimeSeries(time, place)


def _odometry(block: Block) -> TimeSeries:
    time, left, right, sideways, half_width, var_left, var_right, var_sideways = block.value.T
    _require(block, half_width > 1e-6, "a distance between the wheels (m)")
    _require(block, np.minimum(np.minimum(var_left, var_right), var_sideways) > 0, "positive variances")
    value = np.column_stack([(left + right) / 2, sideways, (right - left) / (2 * half_width)])
    covariance = np.zeros((len(block), 3, 3))
    covariance[:, 0, 0] = (var_left + var_right) / 4
    covariance[:, 1, 1] = var_sideways
    covariance[:, 2, 2] = (var_left + var_right) / (2 * half_width) ** 2
    covariance[:, 0, 2] = covariance[:, 2, 0] = (var_right - var_left) / (4 * half_width)
    order = np.argsort(time, kind="stable")
    return TimeSeries(time[order], value[order], covariance[order])
