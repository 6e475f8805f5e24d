"""Measurement templates: residuals of position, heading, range, bearing, relative pose and odometry, in symbols.

Every function is the residual of a cost: it takes the elements of its slots, then its data, and returns the residual to
be whitened. Angles come in two forms that agree to third order (spec ``gps-range-bearing-localization`` 3.5): a
*geodesic* residual is the wrapped angle (what gtsam uses), a *chordal* one ``2 sin(e/2)`` (the von Mises likelihood).
Units: metres and radians.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from problems.spaces import SE2, wrap


def _xy(element: Any) -> Any:
    """Position of a pose, or the point itself."""
    return element.translation if hasattr(element, "translation") else element


def chordal(angle: Any) -> Any:
    """``2 sin(e/2)`` of an angle error, radians."""
    return 2 * ca.sin(angle / 2)


def position(element: Any, z: Any) -> Any:
    """Position fix (GPS) of a pose or point: (2,) or (3,), metres."""
    return _xy(element) - z


def heading(pose: Any, z: Any) -> Any:
    """Compass, geodesic: wrapped heading error (1,)."""
    return wrap(pose.angle - z)


def heading_chordal(pose: Any, z: Any) -> Any:
    """Compass, chordal (1,)."""
    return chordal(pose.angle - z)


def distance(a: Any, b: Any, z: Any) -> Any:
    """Range between two poses or points: ``|b - a| - z`` (1,), metres."""
    return ca.norm_2(_xy(b) - _xy(a)) - z


def _bearing(pose: Any, target: Any) -> Any:
    local = pose.transform_to(_xy(target))
    return ca.atan2(local[1], local[0])


def bearing(pose: Any, target: Any, z: Any) -> Any:
    """Bearing of `target` in the frame of `pose`, geodesic (1,)."""
    return wrap(_bearing(pose, target) - z)


def bearing_chordal(pose: Any, target: Any, z: Any) -> Any:
    """Bearing, chordal (1,)."""
    return chordal(_bearing(pose, target) - z)


def bearing_range(pose: Any, target: Any, z: Any) -> Any:
    """Bearing and range of `target` from `pose`: data (bearing, range); residual (bearing error, range error)."""
    local = pose.transform_to(_xy(target))
    return ca.vertcat(wrap(ca.atan2(local[1], local[0]) - z[0]), ca.norm_2(local) - z[1])


def bearing_range_chordal(pose: Any, target: Any, z: Any) -> Any:
    """As `bearing_range` with the chordal bearing error."""
    local = pose.transform_to(_xy(target))
    return ca.vertcat(chordal(ca.atan2(local[1], local[0]) - z[0]), ca.norm_2(local) - z[1])


def relative_position(a: Any, b: Any, z: Any) -> Any:
    """World-frame displacement ``b - a`` (2,) or (3,): the linear model of the spec, (3.6)."""
    return _xy(b) - _xy(a) - z


def landmark(pose: Any, point: Any, z: Any) -> Any:
    """Point seen in the body frame of `pose`: (x, y), metres."""
    return pose.transform_to(_xy(point)) - z


def relative_pose(a: Any, b: Any, z: Any) -> Any:
    """Odometry or loop closure ``z^-1 (a^-1 b)``, plain chart: (x, y) in the frame of z, wrapped angle."""
    return SE2(z).between(a.between(b)).local()


def relative_pose_log(a: Any, b: Any, z: Any) -> Any:
    """As `relative_pose` in gtsam's chart: the full logarithm of SE(2)."""
    return SE2(z).between(a.between(b)).log()


def pose(element: Any, z: Any) -> Any:
    """Prior on a pose, plain chart: ``z^-1 T`` (3,)."""
    return SE2(z).between(element).local()


def pose_log(element: Any, z: Any) -> Any:
    """Prior on a pose in gtsam's chart."""
    return SE2(z).between(element).log()
