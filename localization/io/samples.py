"""Small generated recordings in the layouts of the real ones, for running everything without them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.io import g2o, mrclam, pyfg, uwb_outdoor
from localization.io.recording import Edges, PoseGraph, Priors, TeamRecording, TimeSeries, UwbRecording
from problems.spaces import SE2, wrap

_UWB_ANCHORS = np.array([[2.6, 0.9, 2.0], [2.6, -0.9, 2.0], [2.6, -0.9, 0.5], [0.7, 0.9, 0.5]])
_UWB_WAYPOINTS = np.array([[-2.5, -4.0], [50.0, -4.0], [50.0, 4.5], [30.0, -4.0], [10.0, 4.5], [10.0, -4.0]])
UWB_LATENCY = 0.2  # s
UWB_SPEED = 2.0  # m/s


def write_samples(folder: str | Path, rng: np.random.Generator) -> dict[str, Path]:
    """Write one sample of every kind.

    Returns:
        Path by kind: ``uwb_outdoor``, ``mrclam`` (folders), ``pyfg``, ``pyfg_3d``, ``g2o``, ``g2o_3d`` (files).
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {
        "uwb_outdoor": folder / "sample-trajectory_a-case_1",
        "mrclam": folder / "mrclam",
        "pyfg": folder / "team.pyfg",
        "pyfg_3d": folder / "team3d.pyfg",
        "g2o": folder / "loop.g2o",
        "g2o_3d": folder / "loop3d.g2o",
    }
    uwb_outdoor.write(paths["uwb_outdoor"], uwb_sample(rng))
    team, codes = team_sample(rng)
    mrclam.write(paths["mrclam"], team, codes)
    for suffix, dimension in (("", 2), ("_3d", 3)):
        pyfg.write(paths["pyfg" + suffix], range_graph_sample(rng, dimension))
        g2o.write(paths["g2o" + suffix], loop_sample(rng, dimension))
    return paths


def uwb_sample(rng: np.random.Generator) -> UwbRecording:
    """A vehicle driving the published window of trajectory A at `UWB_SPEED`; 9 Hz ranges of 4 anchors near the origin.

    Like the recordings (spec ``recordings`` 1), ranges tell where the tag was `UWB_LATENCY` before their stamp. They
    have 0.08 m noise, one bias of about 0.1 m per anchor, and in 2 % of the rows are 1 to 8 m too short.
    """
    legs = np.linalg.norm(np.diff(_UWB_WAYPOINTS, axis=0), axis=1)
    arrival = np.concatenate([[0.0], np.cumsum(legs) / UWB_SPEED])

    def place(time: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(time, arrival, column) for column in _UWB_WAYPOINTS.T])

    truth_time = np.arange(0.0, arrival[-1], 0.125)
    leg = np.searchsorted(arrival, truth_time, side="right") - 1
    course = np.diff(_UWB_WAYPOINTS, axis=0)[leg]
    time = np.arange(0.02, arrival[-1], 1 / 36)
    anchor = np.arange(len(time)) % len(_UWB_ANCHORS)
    tag = np.column_stack([place(time - UWB_LATENCY), np.full(len(time), uwb_outdoor.TAG_HEIGHT)])
    bias = 0.1 + 0.05 * rng.standard_normal(len(_UWB_ANCHORS))
    noise = 0.08 * rng.standard_normal(len(time)) + bias[anchor]
    blocked = rng.random(len(time)) < 0.02
    ranges = np.linalg.norm(tag - _UWB_ANCHORS[anchor], axis=1) + noise
    ranges = np.maximum(ranges - blocked * rng.uniform(1, 8, len(time)), 0.1)
    return UwbRecording(
        name="sample-trajectory_a-case_1",
        anchors=_UWB_ANCHORS,
        anchor_names=("A3", "A5", "A9", "A12"),
        time=time,
        anchor=anchor,
        ranges=ranges,
        start=1_700_000_000_000_000_000,
        trajectory="A",
        tag_height=uwb_outdoor.TAG_HEIGHT,
        truth=TimeSeries(truth_time, np.column_stack([place(truth_time), np.zeros(len(truth_time))])),
        heading=np.arctan2(course[:, 1], course[:, 0]),
    )


def team_sample(rng: np.random.Generator) -> tuple[TeamRecording, np.ndarray]:
    """Two robots circling among five landmarks for 30 s: 10 Hz odometry, 1 Hz sightings of all nodes nearer than 4 m.

    Returns:
        The recording and the barcode of each node.
    """
    time = np.arange(0.0, 30.0, 0.1)
    landmarks = np.array([[2.0, 2.0], [-2.0, 2.0], [-2.0, -2.0], [2.0, -2.0], [0.0, 3.0]])
    odometry, truth = [], []
    for start, speed, turn in (((1.5, 0.0, np.pi / 2), 0.15, 0.1), ((-1.0, -1.0, 0.0), 0.1, 0.12)):
        twist = np.array([speed, turn]) + 0.02 * np.column_stack([np.sin(0.3 * time), np.cos(0.2 * time)])
        poses = np.empty((len(time), 3))
        poses[0] = start
        for k in range(1, len(time)):
            step = np.array([[0.1 * twist[k - 1, 0], 0.0, 0.1 * twist[k - 1, 1]]])
            poses[k] = SE2.retract_array(poses[k - 1 : k], step)[0]
        odometry.append(TimeSeries(time, twist + rng.normal(0, (0.01, 0.02), twist.shape)))
        truth.append(TimeSeries(time, poses))
    rows = []
    for k in range(5, len(time), 10):
        points = np.vstack([*(series.value[k, :2] for series in truth), landmarks])
        for observer, series in enumerate(truth):
            away = points - series.value[k, :2]
            distance = np.linalg.norm(away, axis=1)
            for node in np.flatnonzero((distance > 0) & (distance < 4)):
                bearing = np.arctan2(away[node, 1], away[node, 0]) - series.value[k, 2]
                rows.append((time[k], observer, node, distance[node], bearing))
    table = np.array(rows)
    seen = table[:, 3:] + rng.normal(0, (0.05, 0.03), (len(table), 2))
    seen[:, 1] = wrap(seen[:, 1])
    recording = TeamRecording(
        name="mrclam",
        start=1_200_000_000.0,
        robots=np.array([1, 2]),
        odometry=tuple(odometry),
        sighting_time=table[:, 0],
        observer=table[:, 1].astype(np.intp),
        subject=table[:, 2].astype(np.intp),
        range_bearing=seen,
        landmarks=landmarks,
        landmark_subjects=np.arange(6, 6 + len(landmarks)),
        landmark_sigma=np.full(landmarks.shape, 1e-3),
        truth=tuple(truth),
    )
    return recording, rng.permutation(np.arange(5, 95))[: 2 + len(landmarks)]


def loop_sample(rng: np.random.Generator, dimension: int) -> PoseGraph:
    """One robot, 40 poses, two rounds of a circle (a helix in 3-D): odometry and loop closures; chained start."""
    count, lap = 40, 20
    poses = _round_trip(count, lap, dimension)
    first = np.concatenate([np.arange(count - 1), np.arange(count - lap)])
    second = np.concatenate([np.arange(1, count), np.arange(lap, count)])
    relative = _relative_poses(rng, poses, first, second)
    start = poses[:1]
    for k in range(count - 1):
        start = np.vstack([start, _compose(start[-1:], relative.value[k : k + 1])])
    return PoseGraph(
        name="loop" if dimension == 2 else "loop3d",
        dimension=dimension,
        keys=np.arange(count).astype(str),
        time=np.full(count, np.nan),
        robots=np.full(count, "", dtype="U1"),
        landmark_keys=np.zeros(0, dtype="U1"),
        relative_poses=relative,
        sightings=Edges.none(dimension, dimension),
        ranges=Edges.none(1, 1),
        pose_priors=Priors.none(poses.shape[1], _tangent(dimension)),
        landmark_priors=Priors.none(dimension, dimension),
        initial=start,
    )


def range_graph_sample(rng: np.random.Generator, dimension: int) -> PoseGraph:
    """Two robots with odometry, ranges to three landmarks and each other, sightings of landmarks, and priors."""
    count, lap = 20, 20
    poses = np.vstack([_round_trip(count, lap, dimension), _round_trip(count, lap, dimension)])
    poses[count:, 0] += 3.0
    steps = np.concatenate([np.arange(count - 1), count + np.arange(count - 1)])
    landmarks = np.array([[6.0, 0.0, 1.0], [-3.0, 5.0, 0.0], [1.0, -6.0, 2.0]])[:, :dimension]
    points = np.vstack([poses[:, :dimension], landmarks])
    seers = np.arange(0, 2 * count, 2)
    marks = seers // 2 % len(landmarks)
    near = np.concatenate([seers + 1, np.arange(0, count, 5)])
    far = np.concatenate([2 * count + (marks + 1) % len(landmarks), count + np.arange(0, count, 5)])
    distance = np.linalg.norm(points[near] - points[far], axis=1) + 0.1 * rng.standard_normal(len(near))
    body = _into_body(poses[seers], landmarks[marks]) + 0.05 * rng.standard_normal((len(seers), dimension))
    time = np.tile(np.arange(count) * 0.5, 2)
    return PoseGraph(
        name="team" if dimension == 2 else "team3d",
        dimension=dimension,
        keys=np.array([f"{letter}{k}" for letter in "AB" for k in range(count)]),
        time=time,
        robots=np.repeat(["A", "B"], count),
        landmark_keys=np.array([f"L{k}" for k in range(len(landmarks))]),
        relative_poses=_relative_poses(rng, poses, steps, steps + 1, time[steps + 1]),
        sightings=Edges(seers, marks, body, _diagonal(len(seers), np.full(dimension, 0.05)), time[seers]),
        ranges=Edges(near, far, distance[:, None], _diagonal(len(near), np.array([0.1])), time[near]),
        pose_priors=Priors(np.array([0]), poses[:1], _diagonal(1, _sigma(dimension)), time[:1]),
        landmark_priors=Priors(np.array([0]), landmarks[:1], _diagonal(1, np.full(dimension, 0.2)), time[:1]),
        truth=poses,
        landmark_truth=landmarks,
    )


def _tangent(dimension: int) -> int:
    return 3 if dimension == 2 else 6


def _sigma(dimension: int) -> np.ndarray:
    return np.array([0.05, 0.05, 0.02]) if dimension == 2 else np.array([0.05] * 3 + [0.02] * 3)


def _diagonal(count: int, sigma: np.ndarray) -> np.ndarray:
    return np.tile(np.diag(sigma**-2.0), (count, 1, 1))


def _round_trip(count: int, lap: int, dimension: int) -> np.ndarray:
    """Poses on a circle of radius 3 m, heading along it; in 3-D climbing, quaternions about the vertical."""
    angle = 2 * np.pi * np.arange(count) / lap
    place = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    heading = wrap(angle + np.pi / 2)
    if dimension == 2:
        return np.column_stack([place, heading])
    zero = np.zeros(count)
    return np.column_stack([place, 0.1 * np.arange(count), zero, zero, np.sin(heading / 2), np.cos(heading / 2)])


def _relative_poses(
    rng: np.random.Generator, poses: np.ndarray, first: np.ndarray, second: np.ndarray, time: np.ndarray | None = None
) -> Edges:
    dimension = 2 if poses.shape[1] == 3 else 3
    sigma = _sigma(dimension)
    noise = sigma * rng.standard_normal((len(first), len(sigma)))
    if dimension == 2:
        value = SE2.local_array(poses[first], poses[second]) + noise
        value[:, 2] = wrap(value[:, 2])
    else:
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_quat(poses[first, 3:]).inv() * Rotation.from_quat(poses[second, 3:])
        place = _into_body(poses[first], poses[second, :3]) + noise[:, :3]
        value = np.column_stack([place, (turn * Rotation.from_rotvec(noise[:, 3:])).as_quat()])
    stamp = np.full(len(first), np.nan) if time is None else time
    return Edges(first, second, value, _diagonal(len(first), sigma), stamp)


def _compose(pose: np.ndarray, relative: np.ndarray) -> np.ndarray:
    if pose.shape[1] == 3:
        return SE2.retract_array(pose, relative)
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(pose[:, 3:])
    place = pose[:, :3] + turn.apply(relative[:, :3])
    return np.column_stack([place, (turn * Rotation.from_quat(relative[:, 3:])).as_quat()])


def _into_body(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    if poses.shape[1] == 3:
        return SE2.local_array(poses, np.column_stack([points, poses[:, 2]]))[:, :2]
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(poses[:, 3:]).inv().apply(points - poses[:, :3])
