"""poses.csv and TUM files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localization.io import Poses, read_poses, read_tum, write_poses, write_tum
from problems.errors import DataError, ReadError


def some_poses(dimension: int, covariance: bool = True) -> Poses:
    rng = np.random.default_rng(dimension)
    size = 3 if dimension == 2 else 6
    root = rng.normal(size=(4, size, size))
    orientation = rng.normal(size=(4, 1 if dimension == 2 else 4))
    if dimension == 3:
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    orientation[3] = np.nan
    matrices = root @ root.swapaxes(1, 2)
    matrices[3, dimension:] = matrices[3, :, dimension:] = np.nan
    return Poses(
        np.array([0.0, 0.1, 1e9 + 0.125, np.nan]),
        np.array(["A0", "A1", "B 2", "L0"]),
        rng.normal(size=(4, dimension)),
        orientation,
        matrices if covariance else None,
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("covariance", [True, False])
def test_poses_keep_everything(tmp_path: Path, dimension: int, covariance: bool) -> None:
    poses = some_poses(dimension, covariance)
    write_poses(tmp_path / "poses.csv", poses)
    read = read_poses(tmp_path / "poses.csv")
    assert read.keys.tolist() == poses.keys.tolist() and len(read) == 4 and read.dimension == dimension
    for name in ("time", "position", "orientation", "covariance"):
        a, b = getattr(poses, name), getattr(read, name)
        assert (a is None) == (b is None)
        if a is not None:
            np.testing.assert_array_equal(a, b)


def test_columns_and_order_of_the_covariance(tmp_path: Path) -> None:
    covariance = np.array([[[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]])
    write_poses(
        tmp_path / "p.csv",
        Poses(np.zeros(1), np.array(["A"]), np.array([[7.0, 8.0]]), np.array([[np.nan]]), covariance),
    )
    header, row = (tmp_path / "p.csv").read_text().split()
    assert header == "time,key,x,y,theta,cov_x_x,cov_x_y,cov_x_theta,cov_y_y,cov_y_theta,cov_theta_theta"
    assert row == "0.0,A,7.0,8.0,,1.0,2.0,3.0,4.0,5.0,6.0"
    write_poses(tmp_path / "p.csv", some_poses(3, covariance=False))
    assert (tmp_path / "p.csv").read_text().startswith("time,key,x,y,z,qx,qy,qz,qw\n")


def test_tum(tmp_path: Path) -> None:
    poses = some_poses(3)
    write_tum(tmp_path / "t.tum", poses)
    read = read_tum(tmp_path / "t.tum")
    assert len(read) == 3  # the landmark has no time
    np.testing.assert_array_equal(read.position, poses.position[:3])
    np.testing.assert_allclose(read.orientation, poses.orientation[:3], atol=1e-15)
    np.testing.assert_array_equal(read.time, poses.time[:3])
    flat = Poses(
        np.array([1.0, 2.0]), np.array(["a", "b"]), np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[0.6], [np.nan]])
    )
    write_tum(tmp_path / "t.tum", flat)
    read = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(read.position, [[1, 2, 0], [3, 4, 0]])
    np.testing.assert_allclose(read.orientation, [[0, 0, np.sin(0.3), np.cos(0.3)], [0, 0, 0, 1]])


def test_bad_tables(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="orientation must be"):
        Poses(np.zeros(2), np.array(["a", "b"]), np.zeros((2, 2)), np.zeros((2, 4)))
    with pytest.raises(DataError, match="positions must be"):
        Poses(np.zeros(2), np.array(["a", "b"]), np.zeros((2, 4)), np.zeros((2, 4)))
    fine = Poses(np.zeros(1), np.array(["a"]), np.zeros((1, 2)), np.zeros((1, 1)))
    for bad in (
        Poses(np.zeros(1), np.array(["a,b"]), fine.position, fine.orientation),
        Poses(np.array([np.inf]), fine.keys, fine.position, fine.orientation),
    ):
        with pytest.raises(DataError):
            write_poses(tmp_path / "p.csv", bad)
    with pytest.raises(DataError, match="finite"):
        write_tum(tmp_path / "p.tum", Poses(np.zeros(1), fine.keys, np.full((1, 2), np.nan), fine.orientation))


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("time,key,x,y\n0,a,1,2\n", 1, "time,key,x,y,theta"),
        ("time,key,x,y,theta,cov_x_x\n0,a,1,2,3,4\n", 1, "cov_theta_theta"),
        ("time,key,x,y,theta\n0,a,1,2\n", 2, "5 fields"),
        ("time,key,x,y,theta\n0,a,1,2,b\n", 2, "a number"),
        ("time,key,x,y,theta\n0,a,1,2,inf\n", 2, "finite"),
    ],
)
def test_bad_pose_files_are_named(tmp_path: Path, text: str, line: int, expected: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(ReadError, match=expected) as caught:
        read_poses(tmp_path / "p.csv")
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("text", "expected"),
    [("1 2 3 4 0 0 0\n", "8 numbers"), ("1 2 3 4 0 0 0 nan\n", "finite"), ("1 2 3 4 0 0 0 3", "length")],
)
def test_bad_tum_files_are_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "t.tum").write_text("# comment\n0 0 0 0 0 0 0 1\n" + text)
    with pytest.raises(ReadError, match=expected) as caught:
        read_tum(tmp_path / "t.tum")
    assert caught.value.line == 3
