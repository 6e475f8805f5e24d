"""Spaces on which variables live: `Vector(n)`, `SO2`, `SE2`.

A space knows how a point is stored (``ambient`` numbers), how many degrees of freedom it has (``dim``) and how to move
from one point to another in local coordinates, once in symbols (for derivatives) and once on arrays (for updates).
One convention for all of them: the tangent is in the body frame, translation first. Residual functions never see
coordinates; they are given *elements* (`Rotation2`, `Pose2`; for `Vector` the CasADi column itself).
"""

from __future__ import annotations

import math
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from problems.errors import DataError, DefinitionError


def wrap(angle: Any) -> Any:
    """Angle in (-pi, pi], for floats, arrays and CasADi expressions (radians)."""
    ceil: Any = ca.ceil if isinstance(angle, (ca.SX, ca.MX, ca.DM)) else np.ceil
    return angle - 2 * math.pi * ceil((angle - math.pi) / (2 * math.pi))


@runtime_checkable
class Space(Protocol):
    """What a variable's space provides. `x`, `y` are points (ambient,), `d` a tangent vector (dim,).

    The ``_array`` methods act on many points at once: (count, ambient) and (count, dim).
    """

    @property
    def name(self) -> str: ...
    @property
    def ambient(self) -> int: ...
    @property
    def dim(self) -> int: ...
    def element(self, x: Any) -> Any: ...
    def retract(self, x: Any, d: Any) -> Any: ...
    def local(self, x: Any, y: Any) -> Any: ...
    def retract_array(self, x: np.ndarray, d: np.ndarray) -> np.ndarray: ...
    def local_array(self, x: np.ndarray, y: np.ndarray) -> np.ndarray: ...
    def identity(self) -> np.ndarray: ...
    def normalize_array(self, x: np.ndarray) -> np.ndarray: ...


class Vector:
    """R^n; its element is the CasADi column of n numbers."""

    def __init__(self, size: int) -> None:
        if int(size) != size or size < 1:
            raise DefinitionError(f"Vector needs a positive whole number of components, got {size!r}")
        self.ambient = self.dim = int(size)
        self.name = f"Vector({self.dim})"

    def __repr__(self) -> str:
        return self.name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Vector) and other.dim == self.dim

    def __hash__(self) -> int:
        return hash((Vector, self.dim))

    def element(self, x: Any) -> Any:
        return x

    def retract(self, x: Any, d: Any) -> Any:
        return x + d

    def local(self, x: Any, y: Any) -> Any:
        return y - x

    retract_array = retract
    local_array = local

    def identity(self) -> np.ndarray:
        return np.zeros(self.dim)

    def normalize_array(self, x: np.ndarray) -> np.ndarray:
        return x


class Rotation2:
    """Element of SO2: a rotation in the plane, given by its angle (radians)."""

    def __init__(self, angle: Any) -> None:
        self.angle = angle

    @property
    def matrix(self) -> Any:
        """Rotation matrix (2, 2): body to world."""
        c, s = ca.cos(self.angle), ca.sin(self.angle)
        return ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))

    @property
    def coordinates(self) -> Any:
        return self.angle

    def rotate(self, v: Any) -> Any:
        """Body vector (2,) expressed in the world frame."""
        c, s = ca.cos(self.angle), ca.sin(self.angle)
        return ca.vertcat(c * v[0] - s * v[1], s * v[0] + c * v[1])

    def unrotate(self, v: Any) -> Any:
        """World vector (2,) expressed in the body frame."""
        c, s = ca.cos(self.angle), ca.sin(self.angle)
        return ca.vertcat(c * v[0] + s * v[1], c * v[1] - s * v[0])

    def inverse(self) -> Rotation2:
        return Rotation2(-self.angle)

    def __matmul__(self, other: Rotation2) -> Rotation2:
        return Rotation2(self.angle + other.angle)

    def between(self, other: Rotation2) -> Rotation2:
        """The rotation from this one to `other`: ``self^-1 other``."""
        return Rotation2(other.angle - self.angle)

    def log(self) -> Any:
        """Angle in (-pi, pi]."""
        return wrap(self.angle)


class Pose2:
    """Element of SE2: position (m) and heading (rad) of a body in the plane."""

    def __init__(self, translation: Any, angle: Any) -> None:
        self.translation = translation
        self.angle = angle

    @property
    def rotation(self) -> Rotation2:
        return Rotation2(self.angle)

    @property
    def coordinates(self) -> Any:
        return ca.vertcat(self.translation, self.angle)

    def inverse(self) -> Pose2:
        return Pose2(-self.rotation.unrotate(self.translation), -self.angle)

    def __matmul__(self, other: Pose2) -> Pose2:
        return Pose2(self.translation + self.rotation.rotate(other.translation), self.angle + other.angle)

    def between(self, other: Pose2) -> Pose2:
        """`other` seen from this pose: ``self^-1 other``."""
        return Pose2(self.rotation.unrotate(other.translation - self.translation), other.angle - self.angle)

    def transform_to(self, point: Any) -> Any:
        """World point (2,) in the body frame (m)."""
        return self.rotation.unrotate(point - self.translation)

    def transform_from(self, point: Any) -> Any:
        """Body point (2,) in the world frame (m)."""
        return self.translation + self.rotation.rotate(point)

    def local(self) -> Any:
        """Plain chart at the identity: (translation, wrapped angle)."""
        return ca.vertcat(self.translation, wrap(self.angle))

    def log(self) -> Any:
        """Full logarithm of SE(2) (the chart of gtsam's prior and between factors)."""
        angle = wrap(self.angle)
        small = angle * angle < 1e-6
        safe = ca.if_else(small, 1.0, angle)
        # theta/2 cot(theta/2): the series is exact to rounding below 1e-3 and has finite derivatives at zero
        a = ca.if_else(small, 1 - angle**2 / 12 - angle**4 / 720, safe / 2 / ca.tan(safe / 2))
        half = angle / 2
        x, y = self.translation[0], self.translation[1]
        return ca.vertcat(a * x + half * y, a * y - half * x, angle)


class _SO2:
    name, ambient, dim = "SO2", 1, 1

    def __repr__(self) -> str:
        return self.name

    def __call__(self, x: Any) -> Rotation2:
        return self.element(x)

    def element(self, x: Any) -> Rotation2:
        return Rotation2(x[0])

    def retract(self, x: Any, d: Any) -> Any:
        return x + d

    def local(self, x: Any, y: Any) -> Any:
        return wrap(y - x)

    def retract_array(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return wrap(x + d)

    def local_array(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return wrap(y - x)

    def identity(self) -> np.ndarray:
        return np.zeros(1)

    def normalize_array(self, x: np.ndarray) -> np.ndarray:
        return wrap(x)


class _SE2:
    name, ambient, dim = "SE2", 3, 3

    def __repr__(self) -> str:
        return self.name

    def __call__(self, x: Any) -> Pose2:
        return self.element(x)

    def element(self, x: Any) -> Pose2:
        return Pose2(x[0:2], x[2])

    def retract(self, x: Any, d: Any) -> Any:
        return ca.vertcat(x[0:2] + Rotation2(x[2]).rotate(d[0:2]), x[2] + d[2])

    def local(self, x: Any, y: Any) -> Any:
        return self.element(x).between(self.element(y)).local()

    def retract_array(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        out = np.empty_like(x)
        out[:, 0] = x[:, 0] + c * d[:, 0] - s * d[:, 1]
        out[:, 1] = x[:, 1] + s * d[:, 0] + c * d[:, 1]
        out[:, 2] = wrap(x[:, 2] + d[:, 2])
        return out

    def local_array(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        dx, dy = y[:, 0] - x[:, 0], y[:, 1] - x[:, 1]
        return np.column_stack([c * dx + s * dy, c * dy - s * dx, wrap(y[:, 2] - x[:, 2])])

    def identity(self) -> np.ndarray:
        return np.zeros(3)

    def normalize_array(self, x: np.ndarray) -> np.ndarray:
        out = x.copy()
        out[:, 2] = wrap(x[:, 2])
        return out


SO2 = _SO2()
SE2 = _SE2()


def points(space: Space, values: Any, count: int, what: str) -> np.ndarray:
    """`values` as a checked, normalized (count, ambient) array; one point is repeated.

    Raises:
        DataError: wrong shape or values that are not finite.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim == 1 and array.size == space.ambient:
        array = np.broadcast_to(array, (count, space.ambient))
    elif array.ndim == 1 and space.ambient == 1 and array.size == count:
        array = array[:, None]
    if array.shape != (count, space.ambient):
        raise DataError(
            f"{what}: expected shape ({count}, {space.ambient}) for {count} instance(s) on {space.name}, "
            f"got {np.shape(values)}"
        )
    flat = array.ravel()
    # one product tells that all are finite, unless they are huge
    if not flat.dot(flat) < np.inf and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise DataError(f"{what}: instance {row} is not finite ({array[row]})")
    return space.normalize_array(np.array(array))
