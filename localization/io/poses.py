"""Estimated poses as files: ``poses.csv`` with covariances, and TUM trajectories.

Source: design section 4. Columns of ``poses.csv``: time, key, x, y, theta in 2-D; time, key, x, y, z, qx, qy, qz, qw in
3-D; then, where there are covariances, their upper triangle in the world frame (``cov_x_x``, ``cov_x_y``, ...; rotation
axes are called theta, or rx, ry, rz). An empty field is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.io.records import normalized
from localization.io.text import Csv, data_rows, shorten
from problems.errors import DataError, ReadError

_POSITION = {2: ("x", "y"), 3: ("x", "y", "z")}
_ORIENTATION = {2: ("theta",), 3: ("qx", "qy", "qz", "qw")}
_AXES = {2: ("x", "y", "theta"), 3: ("x", "y", "z", "rx", "ry", "rz")}


@dataclass(frozen=True, eq=False)
class Poses:
    """A table of poses; NaN is not known (a heading nobody estimated, the time of a landmark).

    Attributes:
        time: (m,) seconds.
        keys: (m,) names.
        position: (m, 2) or (m, 3), m.
        orientation: (m, 1) heading in rad, or (m, 4) quaternion x y z w; NaN rows where there is none.
        covariance: (m, 3, 3) or (m, 6, 6), world frame, translation first; or None.

    Raises:
        DataError: shapes that do not fit each other.
    """

    time: np.ndarray
    keys: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    covariance: np.ndarray | None = None

    def __post_init__(self) -> None:
        count, dimension = self.position.shape if self.position.ndim == 2 else (0, 0)
        if dimension not in _POSITION:
            raise DataError(f"positions must be (count, 2) or (count, 3), got {self.position.shape}")
        size = len(_AXES[dimension])
        expected = {"time": (count,), "keys": (count,), "orientation": (count, len(_ORIENTATION[dimension]))}
        if self.covariance is not None:
            expected["covariance"] = (count, size, size)
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise DataError(
                    f"{name} must be {shape} for positions {count, dimension}, got {getattr(self, name).shape}"
                )

    def __len__(self) -> int:
        return len(self.time)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.position.shape[1]

    def chosen(self, rows: np.ndarray) -> Poses:
        """Some of the rows."""
        covariance = None if self.covariance is None else self.covariance[rows]
        return Poses(self.time[rows], self.keys[rows], self.position[rows], self.orientation[rows], covariance)


def _columns(dimension: int, covariance: bool) -> tuple[str, ...]:
    axes = _AXES[dimension]
    pairs = [f"cov_{a}_{b}" for k, a in enumerate(axes) for b in axes[k:]] if covariance else []
    return (*_POSITION[dimension], *_ORIENTATION[dimension], *pairs)


def write_poses(path: str | Path, poses: Poses) -> None:
    """Write ``poses.csv``.

    Raises:
        DataError: a key holds a comma or a line break, or a value is infinite.
    """
    parts = [poses.position, poses.orientation]
    if poses.covariance is not None:
        row, column = np.triu_indices(poses.covariance.shape[1])
        parts.append(poses.covariance[:, row, column])
    numbers = np.hstack(parts)
    if np.isinf(numbers).any() or np.isinf(poses.time).any():
        raise DataError("poses must be finite, or NaN where not known, to be written")
    lines = ["time,key," + ",".join(_columns(poses.dimension, poses.covariance is not None))]
    for stamp, key, values in zip(poses.time.tolist(), poses.keys.tolist(), numbers.tolist(), strict=True):
        if any(mark in str(key) for mark in ",\r\n"):
            raise DataError(f"a key must have no comma and no line break, got {key!r}")
        lines.append(",".join([_field(stamp), str(key), *map(_field, values)]))
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _field(value: float) -> str:
    return "" if value != value else repr(value)


def read_poses(path: str | Path) -> Poses:
    """Read ``poses.csv``.

    Raises:
        ReadError: another header, wrong count of fields, no number; names the line.
    """
    table = Csv(path, ("time", "key", "x", "y"))
    dimension = 3 if "z" in table.header else 2
    covariance = any(name.startswith("cov_") for name in table.header)
    names = _columns(dimension, covariance)
    if table.header != ["time", "key", *names]:
        raise ReadError(path, 1, f"the header time,key,{','.join(names)}", shorten(",".join(table.header)))
    numbers = table.numbers("time", *names, missing=True)
    split = 1 + dimension
    end = split + len(_ORIENTATION[dimension])
    matrices = None
    if covariance:
        size = len(_AXES[dimension])
        row, column = np.triu_indices(size)
        matrices = np.empty((len(table), size, size))
        matrices[:, row, column] = matrices[:, column, row] = numbers[:, end:]
    keys = np.array(table.texts("key"), dtype=str)
    return Poses(numbers[:, 0], keys, numbers[:, 1:split], numbers[:, split:end], matrices)


def write_tum(path: str | Path, poses: Poses) -> None:
    """Write a trajectory as ``time x y z qx qy qz qw`` lines; rows without time (landmarks) are left out.

    A pose in the plane gets height zero; one without orientation the identity.

    Raises:
        DataError: a position is not finite.
    """
    kept = ~np.isnan(poses.time)
    position, quaternion = poses.position[kept], np.zeros((int(kept.sum()), 4))
    if poses.dimension == 2:
        heading = poses.orientation[kept, 0]
        quaternion[:, 2], quaternion[:, 3] = np.sin(heading / 2), np.cos(heading / 2)
        position = np.column_stack([position, np.zeros(len(position))])
    else:
        quaternion[:] = poses.orientation[kept]
    quaternion[np.isnan(quaternion).any(axis=1)] = (0, 0, 0, 1)
    table = np.column_stack([poses.time[kept], position, quaternion])
    if not np.isfinite(table).all():
        raise DataError("a TUM trajectory needs finite times and positions")
    Path(path).write_text("".join(" ".join(map(repr, row)) + "\n" for row in table.tolist()), encoding="utf-8")


def read_tum(path: str | Path) -> Poses:
    """Read a TUM trajectory; keys count the rows.

    Raises:
        ReadError: wrong count of numbers, no number, NaN, a quaternion not of length one; names the line.
    """
    rows = data_rows(path)
    table = rows.numbers(8, "time x y z qx qy qz qw")
    return Poses(table[:, 0], np.arange(len(table)).astype(str), table[:, 1:4], normalized(rows, table[:, 4:]))
