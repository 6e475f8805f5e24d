"""Folders of outdoor UWB ranges with RTK truth and published estimates.

Source: spec recordings 1. One ``A<number>.csv`` per anchor; the rest is optional: ``trajectory.csv`` (truth),
``gnss.csv``, ``LS.csv`` and ``ESKF.csv`` (published estimates), ``published-rmse.txt``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from localization.io.recording import TimeSeries, UwbRecording
from localization.io.records import require_definite
from localization.io.text import Csv, Rows, read_text, shorten
from problems.errors import DataError, ReadError, SettingError
from problems.spaces import wrap

layout = "uwb_outdoor: a folder of A<number>.csv files (UWB ranges, one file per anchor)"

TAG_HEIGHT = 1.0
"""The tag rides this much above the point whose truth is given (m)."""

_ANCHOR = re.compile(r"A(\d+)\.csv", re.ASCII)
_FIGURE = re.compile(r"(\w+) (RMSE(?:_2d)?): *(\S+?)(?: *m)?", re.ASCII)
_PLACE = ("field.x", "field.y", "field.z")
_FIX = ("field.latitude", "field.longitude", "field.altitude")
_COVARIANCE = tuple(f"field.position_covariance{k}" for k in range(9))


def matches(path: str | Path) -> bool:
    """Whether `path` looks like a folder of this layout."""
    path = Path(path)
    return path.is_dir() and any(_ANCHOR.fullmatch(file.name) for file in path.iterdir())


def read(path: str | Path, *, trajectory: str | None = None) -> UwbRecording:
    """Read a folder.

    Args:
        path: the folder.
        trajectory: "A" or "B", the published scoring window; None takes it from the folder's name
            (``...trajectory_a...``), and without it there the whole recording is scored.

    Raises:
        ReadError: no anchor file, or a malformed one; names file, line and what was expected.
        SettingError: `trajectory` is neither A nor B.
    """
    path = Path(path)
    if trajectory is None:
        named = re.search(r"trajectory[_-]?([ab])(?![a-z])", path.resolve().name, re.IGNORECASE)
        trajectory = named[1] if named else None
    if trajectory is not None and trajectory.upper() not in ("A", "B"):
        raise SettingError(f"trajectory must be A or B, got {trajectory!r}")
    if not path.is_dir():
        raise ReadError(path, None, "a folder", "no folder")
    files = {int(match[1]): file for file in path.iterdir() if (match := _ANCHOR.fullmatch(file.name))}
    if not files:
        raise ReadError(path, None, "at least one anchor file A<number>.csv", "none")
    numbers = sorted(files)
    parts = [_anchor(files[number]) for number in numbers]
    stamp = np.concatenate([part[0] for part in parts])
    truth = _truth(path / "trajectory.csv")
    start = int(stamp.min()) if truth is None else min(int(stamp.min()), int(truth[0][0]))
    order = np.argsort(stamp, kind="stable")
    anchor = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    gnss, origin = _gnss(path / "gnss.csv", start)
    return UwbRecording(
        name=path.resolve().name,
        anchors=np.array([part[1] for part in parts]),
        anchor_names=tuple(f"A{number}" for number in numbers),
        time=_seconds(stamp[order], start),
        anchor=anchor[order],
        ranges=np.concatenate([part[2] for part in parts])[order],
        start=start,
        trajectory=trajectory.upper() if trajectory else None,
        tag_height=TAG_HEIGHT,
        truth=None if truth is None else TimeSeries(_seconds(truth[0], start), truth[1]),
        heading=None if truth is None else truth[2],
        gnss=gnss,
        gnss_origin=origin,
        published={
            method.lower(): _published(path / f"{method}.csv", start)
            for method in ("LS", "ESKF")
            if (path / f"{method}.csv").exists()
        },
        figures=_figures(path / "published-rmse.txt"),
    )


def _seconds(stamp: np.ndarray, start: int) -> np.ndarray:
    return (stamp - start) / 1e9


def _anchor(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    table = Csv(file, ("field.stamp", *_PLACE, "field.distanceFromTag"))
    place = table.numbers(*_PLACE)
    moved = np.flatnonzero((place != place[0]).any(axis=1))
    if moved.size:
        expected = f"one anchor position in the whole file, {place[0].tolist()}"
        raise table.error(int(moved[0]), expected, f"{place[moved[0]].tolist()}")
    return table.nanoseconds("field.stamp"), place[0], table.numbers("field.distanceFromTag")[:, 0]


def _truth(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    if not file.exists():
        return None
    table = Csv(file, ("timestamp", "x", "y", "z", "heading_degrees"))
    stamp = table.nanoseconds("timestamp")
    late = np.flatnonzero(np.diff(stamp) <= 0)
    if late.size:
        raise table.error(int(late[0]) + 1, "stamps that increase", f"{stamp[late[0] + 1]} after {stamp[late[0]]}")
    return stamp, table.numbers("x", "y", "z"), wrap(np.deg2rad(table.numbers("heading_degrees")[:, 0]))


def _published(file: Path, start: int) -> TimeSeries:
    table = Csv(file, ("timestamp", "x", "y", "z"))
    stamp = table.nanoseconds("timestamp")
    order = np.argsort(stamp, kind="stable")
    return TimeSeries(_seconds(stamp[order], start), table.numbers("x", "y", "z")[order])


def _gnss(file: Path, start: int) -> tuple[TimeSeries | None, tuple[float, float, float] | None]:
    if not file.exists():
        return None, None
    import pymap3d

    needed = ("field.header.stamp", "field.status.status", *_FIX, *_COVARIANCE, "field.position_covariance_type")
    table = Csv(file, needed)
    fixed = table.numbers("field.status.status")[:, 0] >= 0
    stamp = table.nanoseconds("field.header.stamp")
    place = table.numbers(*_FIX, missing=True)
    covariance = table.numbers(*_COVARIANCE, missing=True).reshape(-1, 3, 3)
    known = fixed & (table.numbers("field.position_covariance_type")[:, 0] > 0)
    for row in np.flatnonzero(fixed):
        if not (abs(place[row, 0]) <= 90 and abs(place[row, 1]) <= 180 and np.isfinite(place[row, 2])):
            raise table.error(int(row), "latitude, longitude (deg) and altitude (m)", f"{place[row].tolist()}")
    symmetric = (covariance == covariance.swapaxes(1, 2)).all(axis=(1, 2))
    bad = np.flatnonzero(known & ~symmetric)
    if bad.size:
        raise table.error(int(bad[0]), "a symmetric covariance", f"{covariance[bad[0]].tolist()}")
    require_definite(table.rows(np.flatnonzero(known)), covariance[known], "covariance")
    if not fixed.any():
        return None, None
    covariance[~known] = np.nan
    kept = np.flatnonzero(fixed)
    kept = kept[np.argsort(stamp[kept], kind="stable")]
    latitude, longitude, altitude = place[kept].T
    origin = (float(latitude[0]), float(longitude[0]), float(altitude[0]))
    local = np.column_stack(pymap3d.geodetic2enu(latitude, longitude, altitude, *origin))
    return TimeSeries(_seconds(stamp[kept], start), local, covariance[kept]), origin


def _figures(file: Path) -> dict[str, dict[str, float]]:
    figures: dict[str, dict[str, float]] = {}
    if not file.exists():
        return figures
    for number, line in enumerate(read_text(file).split("\n"), 1):
        if not line.strip():
            continue
        match = _FIGURE.fullmatch(line.strip())
        if match is None:
            raise ReadError(file, number, "a line such as 'ESKF RMSE_2d: 1.1'", shorten(line.strip()))
        value = Rows(file, [number], [match[3]]).numbers(1, f"{match[2]} of {match[1]}")
        figures.setdefault(match[1].lower(), {})[match[2].lower()] = float(value[0, 0])
    return figures


def write(path: str | Path, recording: UwbRecording) -> None:
    """Write ranges, truth, published estimates and figures of a recording as a folder of this layout.

    Fixes are not written.

    Raises:
        DataError: anchors without height, or names that are not ``A<number>``.
    """
    path = Path(path)
    if recording.anchors.shape[1] != 3:
        raise DataError(f"{recording.name}: anchors need three coordinates, got {recording.anchors.shape[1]}")
    path.mkdir(parents=True, exist_ok=True)
    stamps = recording.start + np.round(recording.time * 1e9).astype(np.int64)
    for k, name in enumerate(recording.anchor_names):
        if not _ANCHOR.fullmatch(f"{name}.csv"):
            raise DataError(f"{recording.name}: anchors are named A<number>, got {name!r}")
        own = recording.anchor == k
        place = ",".join(repr(v) for v in recording.anchors[k].tolist())
        lines = ["%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag"]
        for stamp, distance in zip(stamps[own].tolist(), recording.ranges[own].tolist(), strict=True):
            lines.append(f"{stamp},{stamp},{name[1:]},{place},{distance!r}")
        _write_lines(path / f"{name}.csv", lines)
    if recording.truth is not None and recording.heading is not None:
        table = np.column_stack([recording.truth.value, np.rad2deg(recording.heading)])
        _write_series(path / "trajectory.csv", "x,y,z,heading_degrees", recording, recording.truth.time, table)
    for method, series in recording.published.items():
        _write_series(path / f"{method.upper()}.csv", "x,y,z", recording, series.time, series.value)
    if recording.figures:
        lines = [
            f"{method.upper()} {metric.replace('rmse', 'RMSE')}: {value!r}"
            for method, metrics in recording.figures.items()
            for metric, value in metrics.items()
        ]
        _write_lines(path / "published-rmse.txt", lines)


def _write_series(file: Path, columns: str, recording: UwbRecording, time: np.ndarray, values: np.ndarray) -> None:
    stamps = (recording.start + np.round(time * 1e9).astype(np.int64)).tolist()
    rows = [",".join([str(t), *map(repr, row)]) for t, row in zip(stamps, values.tolist(), strict=True)]
    _write_lines(file, ["timestamp," + columns, *rows])


def _write_lines(file: Path, lines: list[str]) -> None:
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
