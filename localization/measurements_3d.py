"""Measurement templates in space: residuals of orientation, direction, range and relative pose on SO3 and SE3.

As in `localization.measurements`, whose position, range, displacement and landmark templates serve both dimensions and
are repeated here by name. Directions are vectors (3,) of any length. Residuals equal those of gtsam's factors component
by component (gtsam puts rotation before translation: `problems.spatial.GTSAM_ORDER`). Spec
``gps-range-bearing-localization`` 10, 3-D. Units: metres and radians.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from localization.measurements import chordal, distance, landmark, position, relative_position
from problems.spaces import wrap
from problems.spatial import SE3, SO3, cross

__all__ = [
    "attitude",
    "bearing",
    "bearing_range",
    "distance",
    "heading",
    "heading_chordal",
    "landmark",
    "orientation",
    "pose",
    "pose_log",
    "position",
    "relative_orientation",
    "relative_pose",
    "relative_pose_log",
    "relative_position",
]

SMALL = 1e-5  # squared sine of an angle below which a series is exact to rounding
OPPOSITE = 1e-24  # squared sine below which two opposite directions have no shortest way between them


def _orientation(element: Any) -> Any:
    return element.rotation if hasattr(element, "rotation") else element


def _unit(v: Any) -> Any:
    return v / ca.norm_2(v)


def _tangent_plane(n: Any) -> tuple[Any, Any]:
    """Two unit vectors across the unit vector n, chosen as gtsam's Unit3 does: from n's smallest component."""
    x, y, z = ca.fabs(n[0]), ca.fabs(n[1]), ca.fabs(n[2])
    along_x = ca.logic_and(x <= y, x <= z)
    along_y = ca.logic_and(ca.logic_not(along_x), y <= z)
    axis = ca.vertcat(along_x, along_y, 1 - along_x - along_y)
    first = _unit(cross(n, axis))
    return first, cross(n, first)


def attitude(element: Any, reference: Any, measured: Any) -> Any:
    """Body direction `measured` that is `reference` in the world, such as gravity: roll and pitch only (2,).

    Zero where ``R measured = reference``; sines of the error across `reference` (gtsam's attitude factor), so the
    opposite direction is a second zero: start within a right angle. Data: reference (3,), measured (3,).
    """
    n = _unit(reference)
    first, second = _tangent_plane(n)
    seen = _orientation(element).rotate(_unit(measured))
    return ca.vertcat(ca.dot(first, seen), ca.dot(second, seen))


def heading(element: Any, z: Any) -> Any:
    """Compass, geodesic: wrapped error (1,) of the heading of the body's x axis; undefined where it stands upright."""
    return wrap(_orientation(element).yaw - z)


def heading_chordal(element: Any, z: Any) -> Any:
    """Compass, chordal (1,)."""
    return chordal(_orientation(element).yaw - z)


def orientation(element: Any, z: Any) -> Any:
    """Prior on the orientation of a pose or rotation: ``Log(z^-1 R)`` (3,), data a quaternion (x, y, z, w)."""
    return SO3(z).between(_orientation(element)).log()


def relative_orientation(a: Any, b: Any, z: Any) -> Any:
    """Orientation of b seen from a: ``Log(z^-1 Ra^-1 Rb)`` (3,), data a quaternion (x, y, z, w)."""
    return SO3(z).between(_orientation(a).between(_orientation(b))).log()


def _direction_error(seen: Any, z: Any) -> Any:
    """Angle from the unit vector `seen` to the direction z, along its shortest way (2,)."""
    n = _unit(z)
    first, second = _tangent_plane(seen)
    across = ca.vertcat(ca.dot(first, n), ca.dot(second, n))
    along, sine2 = ca.dot(seen, n), ca.sumsqr(across)
    small = ca.logic_and(sine2 < SMALL, along > 0)
    opposite = ca.logic_and(sine2 < OPPOSITE, along < 0)
    sine = ca.sqrt(ca.if_else(ca.logic_or(small, opposite), 1, sine2))
    series = 1 + sine2 * (1 / 6 + sine2 * (3 / 40 + sine2 * 5 / 112))
    factor = ca.if_else(small, series, ca.atan2(sine, along) / sine)
    return ca.if_else(opposite, ca.vertcat(-ca.pi, 0), -factor * across)


def _target(pose: Any, target: Any) -> Any:
    """Position of a pose or point in the frame of `pose`."""
    return pose.transform_to(target.translation if hasattr(target, "translation") else target)


def bearing(pose: Any, target: Any, z: Any) -> Any:
    """Direction of `target` in the frame of `pose`: angles (2,) across the direction seen, as gtsam's Unit3.

    The two components span the plane across the direction and turn with it: give them one sigma.
    """
    return _direction_error(_unit(_target(pose, target)), z)


def bearing_range(pose: Any, target: Any, z: Any) -> Any:
    """Direction and range of `target` from `pose`: data (direction, range) (4,); residual (two angles, range error)."""
    local = _target(pose, target)
    length = ca.norm_2(local)
    return ca.vertcat(_direction_error(local / length, z[0:3]), length - z[3])


def relative_pose(a: Any, b: Any, z: Any) -> Any:
    """Odometry or loop closure ``z^-1 (a^-1 b)`` (6,), plain chart: position in the frame of z, rotation vector."""
    return SE3(z).between(a.between(b)).local()


def relative_pose_log(a: Any, b: Any, z: Any) -> Any:
    """As `relative_pose` in gtsam's chart: the full logarithm of SE(3), translation first."""
    return SE3(z).between(a.between(b)).log()


def pose(element: Any, z: Any) -> Any:
    """Prior on a pose, plain chart: ``z^-1 T`` (6,)."""
    return SE3(z).between(element).local()


def pose_log(element: Any, z: Any) -> Any:
    """Prior on a pose in gtsam's chart."""
    return SE3(z).between(element).log()
