"""What readers return: plain containers of arrays, one row per measurement and no object per row.

Conventions as everywhere: SI units, radians counter-clockwise in (-pi, pi], instances first. SE2 is stored as
(x, y, theta), SE3 as (x, y, z, qx, qy, qz, qw); matrices are in the tangent of the body frame, translation first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Values over time.

    Attributes:
        time: (m,) seconds from the recording's start, never decreasing; equal times can occur.
        value: (m, d).
        covariance: (m, k, k) of each value, NaN where the file says it is unknown; None where there is none.
    """

    time: np.ndarray
    value: np.ndarray
    covariance: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class UwbRecording:
    """Ranges of one tag to anchors at known places, with whatever else the folder holds.

    Attributes:
        name: the folder's name.
        anchors: (k, p) positions, m; p is 3 outdoors and 2 where the file gives no height.
        anchor_names: one name per anchor.
        time: (m,) stamps of the ranges, s from the start, never decreasing.
        anchor: (m,) which anchor each range belongs to.
        ranges: (m,) m, as measured (biased; far too short in places).
        range_variance: (m,) m^2 as stated by the file, or None.
        start: nanoseconds of time zero (0 where the file's own clock starts at zero).
        trajectory: "A" or "B" for a recording scored inside a published window, else None.
        tag_height: how much higher the tag is than the point whose truth is given, m.
        truth: positions (n, p), or None.
        heading: (n,) heading at the truth's times, or None.
        gnss: fixes in the east-north-up frame at `gnss_origin`, with covariances, or None. That frame is rotated and
            shifted against the frame of truth and anchors.
        gnss_origin: latitude (deg), longitude (deg), altitude (m) of the first fix, or None.
        odometry: body twist (forward m/s, sideways m/s, turn rad/s) with covariances, or None.
        published: positions (n, 3) of published estimates by method ("ls", "eskf"); rows repeated in a file are kept.
        figures: published errors by method and metric: ``figures["eskf"]["rmse_2d"]``, m.
    """

    name: str
    anchors: np.ndarray
    anchor_names: tuple[str, ...]
    time: np.ndarray
    anchor: np.ndarray
    ranges: np.ndarray
    range_variance: np.ndarray | None = None
    start: int = 0
    trajectory: str | None = None
    tag_height: float = 0.0
    truth: TimeSeries | None = None
    heading: np.ndarray | None = None
    gnss: TimeSeries | None = None
    gnss_origin: tuple[float, float, float] | None = None
    odometry: TimeSeries | None = None
    published: dict[str, TimeSeries] = field(default_factory=dict)
    figures: dict[str, dict[str, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Edges:
    """Measurements between two nodes of a graph, all of one kind.

    Attributes:
        first, second: (m,) node indices; what they count is said where the edges are held.
        value: (m, d) measurements.
        information: (m, k, k) inverse covariances, positive definite.
        time: (m,) seconds, NaN where the format has none.
    """

    first: np.ndarray
    second: np.ndarray
    value: np.ndarray
    information: np.ndarray
    time: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def none(cls, value: int, weight: int) -> Edges:
        """No edge at all, with arrays of the right widths."""
        index = np.zeros(0, dtype=np.intp)
        return cls(index, index, np.zeros((0, value)), np.zeros((0, weight, weight)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Priors:
    """Direct measurements of nodes: like `Edges` with one end."""

    index: np.ndarray
    value: np.ndarray
    information: np.ndarray
    time: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    @classmethod
    def none(cls, value: int, weight: int) -> Priors:
        """No prior at all, with arrays of the right widths."""
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, value)), np.zeros((0, weight, weight)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses of one or more robots, landmarks, and the measurements among them (g2o, PyFG).

    A *node* is a pose (0 .. poses-1) or a landmark (poses .. poses+landmarks-1).

    Attributes:
        name: the file's name without its suffix.
        dimension: 2 or 3.
        keys: (n,) the file's name of each pose.
        time: (n,) seconds, NaN where the format has none.
        robots: (n,) letter of the robot of each pose, "" where the format has none.
        landmark_keys: (l,) names of landmarks.
        relative_poses: pose to pose, value SE2 (m, 3) or SE3 (m, 7) of the second seen from the first.
        sightings: pose to landmark (`second` counts landmarks), the landmark in the pose's frame, (m, 2) or (m, 3).
        ranges: node to node, distances (m, 1).
        pose_priors, landmark_priors: direct measurements, world frame.
        initial, landmark_initial: (n, 3 | 7), (l, 2 | 3) starting values of the file, or None.
        truth, landmark_truth: recorded truth of the same shapes, or None. Truth is never a starting value.
        fixed: (f,) poses held at their initial value.
    """

    name: str
    dimension: int
    keys: np.ndarray
    time: np.ndarray
    robots: np.ndarray
    landmark_keys: np.ndarray
    relative_poses: Edges
    sightings: Edges
    ranges: Edges
    pose_priors: Priors
    landmark_priors: Priors
    initial: np.ndarray | None = None
    landmark_initial: np.ndarray | None = None
    truth: np.ndarray | None = None
    landmark_truth: np.ndarray | None = None
    fixed: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    @property
    def has_initial(self) -> bool:
        """Whether the file gives starting values (else chain the odometry)."""
        return self.initial is not None


@dataclass(frozen=True, eq=False)
class TeamRecording:
    """Odometry of a team and what its robots see of each other and of landmarks (MRCLAM).

    A *node* is a robot (0 .. robots-1) or a landmark (robots .. robots+landmarks-1).

    Attributes:
        name: the folder's name.
        start: Unix seconds of time zero.
        robots: (r,) subject number of each robot.
        odometry: per robot, (m, 2) forward velocity (m/s) and turn rate (rad/s); sorted by time, as stamps of the
            files can go backwards.
        sighting_time: (s,) seconds, never decreasing.
        observer: (s,) robot that sees.
        subject: (s,) node that is seen.
        range_bearing: (s, 2) m and rad, in the observer's frame.
        landmarks: (l, 2) positions, m.
        landmark_subjects: (l,) subject numbers.
        landmark_sigma: (l, 2) standard deviations of the positions, m.
        truth: per robot, (n, 3) x, y, theta; None where the folder has none.
        dropped: sightings left out because their barcode belongs to nobody in the folder.
    """

    name: str
    start: float
    robots: np.ndarray
    odometry: tuple[TimeSeries, ...]
    sighting_time: np.ndarray
    observer: np.ndarray
    subject: np.ndarray
    range_bearing: np.ndarray
    landmarks: np.ndarray
    landmark_subjects: np.ndarray
    landmark_sigma: np.ndarray
    truth: tuple[TimeSeries, ...] | None = None
    dropped: int = 0


Recording = UwbRecording | PoseGraph | TeamRecording
