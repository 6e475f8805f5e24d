"""gtsam's own factors for the measurement templates of `localization.measurements`.

gtsam orders bearing before range, stores what it measures as group elements, and has no chordal residuals: those become
custom factors. Spec ``gps-range-bearing-localization`` 7.4.
"""

from __future__ import annotations

import gtsam
import numpy as np

from localization import measurements as meas
from localization import measurements_3d as meas_3d
from problems.forms.native_factors import register_native
from problems.spaces import SE2, SO2, Vector
from problems.spatial import GTSAM_ORDER, SE3, SO3

POINT2, POINT3 = Vector(2), Vector(3)


TURNED = tuple(GTSAM_ORDER.tolist())


def _pose(z: np.ndarray) -> gtsam.Pose2:
    return gtsam.Pose2(z[0], z[1], z[2])


def _rotation(z: np.ndarray) -> gtsam.Rot3:
    x, y, z, w = z / np.linalg.norm(z)
    return gtsam.Rot3.Quaternion(w, x, y, z)


def _pose_3d(z: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(_rotation(z[3:]), z[:3])


register_native(meas.position, (SE2,), lambda i, z, noise: gtsam.PoseTranslationPrior2D(i, z, noise))
register_native(meas.heading, (SE2,), lambda i, z, noise: gtsam.PoseRotationPrior2D(i, gtsam.Rot2(z[0]), noise))
register_native(meas.heading, (SO2,), lambda i, z, noise: gtsam.PriorFactorRot2(i, gtsam.Rot2(z[0]), noise))
register_native(meas.pose_log, (SE2,), lambda i, z, noise: gtsam.PriorFactorPose2(i, _pose(z), noise))
register_native(
    meas.relative_pose_log, (SE2, SE2), lambda i, j, z, noise: gtsam.BetweenFactorPose2(i, j, _pose(z), noise)
)
for _space in (Vector(1), POINT2, POINT3):
    register_native(meas.position, (_space,), lambda i, z, noise: gtsam.PriorFactorVector(i, z, noise))
    register_native(
        meas.relative_position, (_space, _space), lambda i, j, z, noise: gtsam.BetweenFactorVector(i, j, z, noise)
    )

register_native(
    meas_3d.pose_log, (SE3,), lambda i, z, noise: gtsam.PriorFactorPose3(i, _pose_3d(z), noise), order=TURNED
)
register_native(
    meas_3d.relative_pose_log,
    (SE3, SE3),
    lambda i, j, z, noise: gtsam.BetweenFactorPose3(i, j, _pose_3d(z), noise),
    order=TURNED,
)
register_native(meas_3d.orientation, (SO3,), lambda i, z, noise: gtsam.PriorFactorRot3(i, _rotation(z), noise))
register_native(
    meas_3d.relative_orientation,
    (SO3, SO3),
    lambda i, j, z, noise: gtsam.BetweenFactorRot3(i, j, _rotation(z), noise),
)
register_native(meas.position, (SE3,), lambda i, z, noise: gtsam.GPSFactor(i, z, noise))

register_native(meas.distance, (SE2, SE2), lambda i, j, z, noise: gtsam.RangeFactorPose2(i, j, z[0], noise))
register_native(meas.distance, (SE2, POINT2), lambda i, j, z, noise: gtsam.RangeFactor2D(i, j, z[0], noise))
register_native(meas.distance, (POINT2, SE2), lambda i, j, z, noise: gtsam.RangeFactor2D(j, i, z[0], noise))
register_native(meas.distance, (POINT2, POINT2), lambda i, j, z, noise: gtsam.RangeFactor2(i, j, z[0], noise))
register_native(meas.distance, (SE3, SE3), lambda i, j, z, noise: gtsam.RangeFactorPose3(i, j, z[0], noise))
register_native(meas.distance, (SE3, POINT3), lambda i, j, z, noise: gtsam.RangeFactor3D(i, j, z[0], noise))
register_native(meas.distance, (POINT3, SE3), lambda i, j, z, noise: gtsam.RangeFactor3D(j, i, z[0], noise))
register_native(meas.distance, (POINT3, POINT3), lambda i, j, z, noise: gtsam.RangeFactor3(i, j, z[0], noise))

register_native(
    meas.bearing, (SE2, SE2), lambda i, j, z, noise: gtsam.BearingFactorPose2(i, j, gtsam.Rot2(z[0]), noise)
)
register_native(
    meas.bearing, (SE2, POINT2), lambda i, j, z, noise: gtsam.BearingFactor2D(i, j, gtsam.Rot2(z[0]), noise)
)
register_native(
    meas.bearing_range,
    (SE2, SE2),
    lambda i, j, z, noise: gtsam.BearingRangeFactorPose2(i, j, gtsam.Rot2(z[0]), z[1], noise),
)
register_native(
    meas.bearing_range,
    (SE2, POINT2),
    lambda i, j, z, noise: gtsam.BearingRangeFactor2D(i, j, gtsam.Rot2(z[0]), z[1], noise),
)
