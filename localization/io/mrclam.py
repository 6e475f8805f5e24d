"""Folders of the UTIAS multi-robot cooperative localization and mapping data sets (MRCLAM).

Source: spec recordings 4. The second column of a measurement file is a *barcode*, although its header says subject;
``Barcodes.dat`` translates. Stamps of the odometry can repeat and go backwards.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from localization.io.recording import TeamRecording, TimeSeries
from localization.io.text import Rows, data_rows
from problems.errors import ReadError
from problems.spaces import wrap

layout = "mrclam: a folder of Robot<k>_Odometry.dat, Robot<k>_Measurement.dat, Barcodes.dat, Landmark_Groundtruth.dat"

_ROBOT = re.compile(r"Robot(\d+)_(Odometry|Measurement|Groundtruth)\.dat", re.ASCII)


def _robots(path: Path) -> list[int]:
    if not path.is_dir():
        return []
    return sorted({int(match[1]) for file in path.iterdir() if (match := _ROBOT.fullmatch(file.name))})


def matches(path: str | Path) -> bool:
    """Whether `path` looks like a folder of this layout."""
    return bool(_robots(Path(path)))


def read(path: str | Path) -> TeamRecording:
    """Read a folder. Sightings of codes that nobody in the folder wears are dropped and counted.

    Raises:
        ReadError: a file is missing (truth may be absent, for all robots) or malformed, a subject or a code occurs
            twice, or a robot or landmark has no code; names file, line and what was expected.
    """
    path = Path(path)
    robots = _robots(path)
    if not robots:
        raise ReadError(path, None, "a folder with files Robot<k>_Odometry.dat", "none")
    marks = data_rows(path / "Landmark_Groundtruth.dat")
    landmark = marks.numbers(5, "subject, x, y, standard deviations of x and y")
    subjects = _whole(marks, landmark[:, 0], "subject")
    _require_unique(marks, subjects, "subject")
    if (landmark[:, 3:] < 0).any():
        row = int(np.flatnonzero((landmark[:, 3:] < 0).any(axis=1))[0])
        raise marks.error(row, "standard deviations that are not negative", f"{landmark[row, 3:].tolist()}")
    taken = np.flatnonzero(np.isin(subjects, robots))
    if taken.size:
        raise marks.error(int(taken[0]), "a subject that is no robot", f"{subjects[taken[0]]}")
    wearers = [*robots, *subjects.tolist()]
    node_of_code = _codes(path / "Barcodes.dat", wearers)

    odometry = [_series(path / f"Robot{k}_Odometry.dat", 3, "time, forward velocity, turn rate") for k in robots]
    sightings = [_series(path / f"Robot{k}_Measurement.dat", 4, "time, barcode, range, bearing") for k in robots]
    truth_files = [path / f"Robot{k}_Groundtruth.dat" for k in robots]
    truth = []
    if any(file.exists() for file in truth_files):
        truth = [_series(file, 4, "time, x, y, orientation") for file in truth_files]
    start = float(min(table[0, 0] for table in (*odometry, *sightings, *truth)))

    seen = np.vstack(sightings)
    observer = np.repeat(np.arange(len(robots)), [len(table) for table in sightings])
    subject = np.array([node_of_code.get(code, -1) for code in seen[:, 1].tolist()], dtype=np.intp)
    kept = np.flatnonzero((subject >= 0) & (subject != observer))
    kept = kept[np.argsort(seen[kept, 0], kind="stable")]
    return TeamRecording(
        name=path.resolve().name,
        start=start,
        robots=np.array(robots),
        odometry=tuple(TimeSeries(table[:, 0] - start, table[:, 1:]) for table in odometry),
        sighting_time=seen[kept, 0] - start,
        observer=observer[kept],
        subject=subject[kept],
        range_bearing=np.column_stack([seen[kept, 2], wrap(seen[kept, 3])]),
        landmarks=landmark[:, 1:3],
        landmark_subjects=subjects,
        landmark_sigma=landmark[:, 3:],
        truth=tuple(
            TimeSeries(table[:, 0] - start, np.column_stack([table[:, 1:3], wrap(table[:, 3])])) for table in truth
        )
        or None,
        dropped=len(seen) - len(kept),
    )


def _series(file: Path, columns: int, what: str) -> np.ndarray:
    """Rows sorted by their first column, the time; equal times keep their order."""
    table = data_rows(file).numbers(columns, what)
    return table[np.argsort(table[:, 0], kind="stable")]


def _whole(rows: Rows, values: np.ndarray, what: str) -> np.ndarray:
    wrong = np.flatnonzero((values != np.round(values)) | (np.abs(values) > 2**31))
    if wrong.size:
        raise rows.error(int(wrong[0]), f"a whole number as {what}", f"{values[wrong[0]]}")
    return values.astype(np.int64)


def _require_unique(rows: Rows, values: np.ndarray, what: str) -> None:
    first = np.unique(values, return_index=True)[1]
    again = np.setdiff1d(np.arange(len(values)), first)
    if again.size:
        row = int(again[0])
        other = rows.lines[int(np.flatnonzero(values == values[row])[0])]
        raise rows.error(row, f"a {what} not used before", f"{values[row]}, also in line {other}")


def _codes(file: Path, wearers: list[int]) -> dict[float, int]:
    """Node of each barcode; `wearers` are the subjects of the nodes in order."""
    rows = data_rows(file)
    table = rows.numbers(2, "subject, barcode")
    subjects, codes = _whole(rows, table[:, 0], "subject"), _whole(rows, table[:, 1], "barcode")
    _require_unique(rows, subjects, "subject")
    _require_unique(rows, codes, "barcode")
    code_of = dict(zip(subjects.tolist(), codes.tolist(), strict=True))
    for subject in wearers:
        if subject not in code_of:
            raise ReadError(file, None, f"a barcode for subject {subject}", "none")
    return {float(code_of[subject]): node for node, subject in enumerate(wearers)}


def write(path: str | Path, team: TeamRecording, barcodes: np.ndarray) -> None:
    """Write a recording as a folder of this layout.

    Args:
        path: the folder, made where it does not exist.
        team: the recording.
        barcodes: (robots + landmarks,) code of each node.
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    wearers = [*team.robots.tolist(), *team.landmark_subjects.tolist()]
    _write(path / "Barcodes.dat", "Subject #    Barcode #", zip(wearers, barcodes.tolist(), strict=True))
    marks = np.hstack([team.landmarks, team.landmark_sigma]).tolist()
    _write(
        path / "Landmark_Groundtruth.dat",
        "Subject #    x [m]    y [m]    x std-dev [m]    y std-dev [m]",
        ([subject, *row] for subject, row in zip(team.landmark_subjects.tolist(), marks, strict=True)),
    )
    for k, robot in enumerate(team.robots.tolist()):
        odometry = np.column_stack([team.start + team.odometry[k].time, team.odometry[k].value])
        header = "Time [s]    forward velocity [m/s]    angular velocity[rad/s]"
        _write(path / f"Robot{robot}_Odometry.dat", header, odometry.tolist())
        own = team.observer == k
        times = (team.start + team.sighting_time[own]).tolist()
        codes = barcodes[team.subject[own]].tolist()
        rows = zip(times, codes, *team.range_bearing[own].T.tolist(), strict=True)
        _write(path / f"Robot{robot}_Measurement.dat", "Time [s]    Subject #    range [m]    bearing [rad]", rows)
        if team.truth is not None:
            truth = np.column_stack([team.start + team.truth[k].time, team.truth[k].value])
            header = "Time [s]    x [m]    y [m]    orientation [rad]"
            _write(path / f"Robot{robot}_Groundtruth.dat", header, truth.tolist())


def _write(file: Path, header: str, rows: Iterable[Sequence[float]]) -> None:
    lines = [f"# {header}"] + [" \t ".join(map(repr, row)) for row in rows]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
