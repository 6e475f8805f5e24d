"""Recorded detections as CSV: ``time,sensor,vehicle,x,y``, one line per reading; no line means not detected.

Times are seconds from the first instant and must be instants of the sampling; sensors and vehicles count from 1. Order
does not matter. A line that repeats another one is the same message again. Positions of vehicles (the truth) are
``time,vehicle,x,y`` with a line for every vehicle and instant.

Source: dmhe-sporadic-fov 3.3, sections 5 and 10.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from problems.errors import ReadError, ShapeError, WriteError

READINGS = ("time", "sensor", "vehicle", "x", "y")
POSITIONS = ("time", "vehicle", "x", "y")
SAME_INSTANT = 1e-6  # share of the sampling time


def write_readings(path: str | Path, times: np.ndarray, detected: np.ndarray, readings: np.ndarray) -> None:
    """Write what was detected.

    Args:
        path: file.
        times: (instants,) in s.
        detected: (instants, sensors, vehicles).
        readings: (instants, sensors, vehicles, 2); only where detected.

    Raises:
        ShapeError: shapes that do not fit.
        WriteError: the file cannot be written.
    """
    if detected.ndim != 3 or len(times) != len(detected) or readings.shape != (*detected.shape, 2):
        raise ShapeError(
            "expected times (instants,), detected (instants, sensors, vehicles) and readings (..., 2), got "
            f"{times.shape}, {detected.shape} and {readings.shape}"
        )
    lines = [",".join(READINGS)]
    for k, sensor, vehicle in np.argwhere(detected).tolist():
        x, y = readings[k, sensor, vehicle].tolist()
        lines.append(f"{float(times[k])!r},{sensor + 1},{vehicle + 1},{x!r},{y!r}")
    _write(path, lines)


def read_readings(path: str | Path, times: np.ndarray, sensors: int, vehicles: int) -> tuple[np.ndarray, np.ndarray]:
    """Read what `write_readings` writes.

    Args:
        path: file.
        times: (instants,) in s, ascending.
        sensors, vehicles: how many there are.

    Returns:
        Flags (instants, sensors, vehicles) and readings (instants, sensors, vehicles, 2), NaN where nothing was
        detected.

    Raises:
        ReadError: names the line of a wrong header, field, number, sensor, vehicle or time, of a reading that is not
            finite (a detection has a reading), and of a second reading for the same sensor, vehicle and instant.
    """
    readings = np.full((len(times), sensors, vehicles, 2), np.nan)
    found: dict[tuple[int, int, int], int] = {}
    for line, fields in _lines(path, READINGS):
        k = _instant(path, line, fields[0], times)
        place = (
            k,
            _number(path, line, "sensor", fields[1], sensors),
            _number(path, line, "vehicle", fields[2], vehicles),
        )
        value = _coordinates(path, line, fields[3:])
        if place in found and not (readings[place] == value).all():
            raise ReadError(
                path,
                line,
                f"one reading per time, sensor and vehicle (another one is in line {found[place]})",
                ",".join(fields),
            )
        found[place] = line
        readings[place] = value
    return ~np.isnan(readings[..., 0]), readings


def write_positions(path: str | Path, times: np.ndarray, positions: np.ndarray) -> None:
    """Write positions (instants, vehicles, 2) at times (instants,); raises as `write_readings`."""
    if positions.ndim != 3 or len(times) != len(positions) or positions.shape[2] != 2:
        raise ShapeError(
            f"expected times (instants,) and positions (instants, vehicles, 2), got {times.shape} and {positions.shape}"
        )
    lines = [",".join(POSITIONS)]
    for time, points in zip(times.tolist(), positions.tolist(), strict=True):
        lines += [f"{time!r},{vehicle},{x!r},{y!r}" for vehicle, (x, y) in enumerate(points, start=1)]
    _write(path, lines)


def read_positions(path: str | Path, times: np.ndarray, vehicles: int) -> np.ndarray:
    """Positions (instants, vehicles, 2) of `write_positions`; raises `ReadError` also where one is missing."""
    positions = np.full((len(times), vehicles, 2), np.nan)
    for line, fields in _lines(path, POSITIONS):
        k = _instant(path, line, fields[0], times)
        positions[k, _number(path, line, "vehicle", fields[1], vehicles)] = _coordinates(path, line, fields[2:])
    missing = np.argwhere(np.isnan(positions[..., 0]))
    if len(missing):
        k, vehicle = missing[0]
        raise ReadError(
            path, None, "a position of every vehicle at every instant", f"none of {vehicle + 1} at {times[k]:g} s"
        )
    return positions


def _write(path: str | Path, lines: list[str]) -> None:
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise WriteError(path, str(error)) from error


def _lines(path: str | Path, names: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and fields, the header checked and empty lines left out."""
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = csv.reader(file)
            header = [name.strip() for name in next(rows, [])]
            if header != list(names):
                raise ReadError(path, 1, f"the header {','.join(names)}", ",".join(header) or "an empty file")
            for fields in rows:
                if not fields:
                    continue
                if len(fields) != len(names):
                    expected = f"{len(names)} fields ({','.join(names)})"
                    raise ReadError(path, rows.line_num, expected, f"{len(fields)}")
                yield rows.line_num, fields
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ReadError(path, None, f"a CSV file with the columns {','.join(names)}", str(error)) from error


def _float(path: str | Path, line: int, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ReadError(path, line, f"a finite number as {what}", repr(text))
    return value


def _coordinates(path: str | Path, line: int, fields: list[str]) -> list[float]:
    return [_float(path, line, f"{name} (m)", text) for name, text in zip("xy", fields, strict=True)]


def _number(path: str | Path, line: int, what: str, text: str, count: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if not 1 <= number <= count:
        raise ReadError(path, line, f"a {what} from 1 to {count}", repr(text))
    return number - 1


def _instant(path: str | Path, line: int, text: str, times: np.ndarray) -> int:
    time = _float(path, line, "time (s)", text)
    k = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
    k -= bool(k >= len(times) or time - times[k - 1] < times[k] - time)
    period = times[1] - times[0] if len(times) > 1 else 1.0
    if abs(times[k] - time) > SAME_INSTANT * period:
        near = f"the nearest one is {times[k]:g} s, the last one {times[-1]:g} s"
        raise ReadError(path, line, f"an instant of the sampling as time ({near})", repr(text))
    return k
