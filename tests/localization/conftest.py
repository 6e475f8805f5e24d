"""Real recordings (HORIZONET_DATA, else ../shared/data beside the repository) and generated graphs for tests."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.io import PoseGraph
from localization.io.recording import Edges, Priors
from localization.io.samples import write_samples
from problems import SE2, SE3

SPACES: dict[int, Any] = {2: SE2, 3: SE3}


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """A function from a path inside the data folder to the file or folder; the test is skipped where it is missing."""
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    root = Path(os.environ.get("HORIZONET_DATA") or beside)

    def find(name: str) -> Path:
        path = root / name
        if not path.exists():
            pytest.skip(f"needs the recording {name}, which is not in {root}")
        return path

    return find


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Generated recordings of every kind; to be read only."""
    return write_samples(tmp_path_factory.mktemp("samples"), np.random.default_rng(7))


def _between(space: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return space.retract_array(np.broadcast_to(space.identity(), a.shape), space.local_array(a, b))


def _edges(first: Any, second: Any, value: np.ndarray, size: int, weight: float = 100.0) -> Edges:
    first = np.asarray(first, dtype=np.intp)
    information = np.tile(weight * np.eye(size), (len(first), 1, 1))
    return Edges(first, np.asarray(second, dtype=np.intp), value, information, np.full(len(first), np.nan))


def _loop(dimension: int, rng: np.random.Generator, noise: float, poses: int = 40) -> PoseGraph:
    """Several turns of a walk with loop closures; truth is known."""
    space = SPACES[dimension]
    x = [space.identity()]
    for _ in range(poses - 1):
        turn = 0.35 + 0.1 * rng.normal(size=space.dim - dimension)
        x.append(space.retract_array(x[-1][None], np.r_[1.0, np.zeros(dimension - 1), turn][None])[0])
    truth = np.array(x)
    first = np.r_[np.arange(poses - 1), rng.integers(0, poses // 2, 30)]
    second = np.r_[np.arange(1, poses), rng.integers(poses // 2, poses, 30)]
    z = space.retract_array(
        _between(space, truth[first], truth[second]), noise * rng.normal(size=(len(first), space.dim))
    )
    return PoseGraph(
        name="loop",
        dimension=dimension,
        keys=np.arange(poses).astype(str),
        time=np.full(poses, np.nan),
        robots=np.full(poses, ""),
        landmark_keys=np.zeros(0, dtype=str),
        relative_poses=_edges(first, second, z, space.dim),
        sightings=Edges.none(dimension, dimension),
        ranges=Edges.none(1, 1),
        pose_priors=Priors.none(space.ambient, space.dim),
        landmark_priors=Priors.none(dimension, dimension),
        truth=truth,
    )


def _team(rng: np.random.Generator, ranges_only: bool) -> PoseGraph:
    """Two robots in frames of their own that see three landmarks, or only measure ranges to each other."""
    one = _loop(2, rng, 0.0, 20).truth
    assert one is not None
    # the range-only robot follows a curve that no reflection maps onto itself
    other = SE2.retract_array(np.tile([4.0, 1.0, 2.0], (20, 1)), one * np.array([1.0, 1.3, 1.0]))
    truth = np.vstack([one, other])
    first = np.r_[np.arange(19), 20 + np.arange(19)]
    z = _between(SE2, truth[first], truth[first + 1])
    marks = np.array([[1.0, 2.0], [4.0, 0.0], [2.0, -2.0]])
    seer, seen = np.repeat([0, 7, 21, 33], 3), np.tile(np.arange(3), 4)
    away = marks[seen] - truth[seer, :2]
    c, s = np.cos(truth[seer, 2]), np.sin(truth[seer, 2])
    local = np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]])
    a, b = np.arange(20), 20 + np.arange(20)[::-1]
    distance = np.linalg.norm(truth[a, :2] - truth[b, :2], axis=1)[:, None]
    return PoseGraph(
        name="two",
        dimension=2,
        keys=np.array([f"{'AB'[k // 20]}{k % 20}" for k in range(40)]),
        time=np.arange(40.0),
        robots=np.repeat(["A", "B"], 20),
        landmark_keys=np.zeros(0, str) if ranges_only else np.array(["L0", "L1", "L2"]),
        relative_poses=_edges(first, first + 1, z, 3),
        sightings=Edges.none(2, 2) if ranges_only else _edges(seer, seen, local, 2),
        ranges=_edges(a, b, distance, 1) if ranges_only else Edges.none(1, 1),
        pose_priors=Priors.none(3, 3),
        landmark_priors=Priors.none(2, 2),
        truth=truth,
    )


@pytest.fixture(scope="session")
def loop() -> Callable[..., PoseGraph]:
    """See `_loop`."""
    return _loop


@pytest.fixture(scope="session")
def team() -> Callable[..., PoseGraph]:
    """See `_team`."""
    return _team
