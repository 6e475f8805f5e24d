"""Rotations and poses in space: `SO3`, `SE3` and their elements `Rotation3`, `Pose3`.

Conventions as in `problems.spaces`: tangents are in the body frame, translation first. Points are stored as unit
quaternions (x, y, z, w) and as (x, y, z, qx, qy, qz, qw); q and -q are the same rotation. gtsam's Pose3 puts the
rotation first: `GTSAM_ORDER` takes vectors and matrices of one order to the other.

An element may be *displaced*: it carries a small tangent vector, and every operation returns what the displaced element
would give, exact to first order. Compositions move the tangent with the adjoint, logarithms with the inverse right
Jacobian, so derivatives taken in it (`problems.forms.template`) keep the structure of the group instead of
differentiating quaternions. Formulas: Sola, Deray, Atchuthan, A micro Lie theory for state estimation in robotics
(2018), sections on SO(3) and SE(3).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DataError

SMALL = 1e-5  # squared sine of half the angle below which series are exact to rounding
GTSAM_ORDER = np.array([3, 4, 5, 0, 1, 2])  # vector[GTSAM_ORDER] in gtsam's order; its own inverse


def cross(a: Any, b: Any) -> Any:
    """Vector product of (3,) columns."""
    return ca.vertcat(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def skew(a: Any) -> Any:
    """(3, 3) matrix of ``cross(a, .)``."""
    return ca.vertcat(ca.horzcat(0, -a[2], a[1]), ca.horzcat(a[2], 0, -a[0]), ca.horzcat(-a[1], a[0], 0))


def _sum(a: Any, b: Any) -> Any:
    """Sum of two tangents, where None is zero."""
    return b if a is None else a if b is None else a + b


def _turn(q: Any, v: Any) -> Any:
    """v rotated by the unit quaternion q."""
    u = q[0:3]
    t = 2 * cross(u, v)
    return v + q[3] * t + cross(u, t)


def _conjugate(q: Any) -> Any:
    return ca.vertcat(-q[0], -q[1], -q[2], q[3])


def _product(a: Any, b: Any) -> Any:
    vector = a[3] * b[0:3] + b[3] * a[0:3] + cross(a[0:3], b[0:3])
    return ca.vertcat(vector, a[3] * b[3] - ca.dot(a[0:3], b[0:3]))


class _Logarithm:
    """What the logarithm of a unit quaternion and its derivative are made of; finite with all derivatives at zero.

    Attributes:
        vector: rotation vector phi (3,), angle at most pi.
        square: angle^2.
        c: ``(1 - theta/2 cot(theta/2)) / theta^2``.
    """

    def __init__(self, q: Any) -> None:
        v = q[0:3]
        sign = ca.if_else(q[3] < 0, -1, 1)  # of q and -q, the one with the smaller angle
        w = sign * q[3]
        sine2 = ca.dot(v, v)
        self._small = sine2 < SMALL
        self._sine2 = ca.if_else(self._small, 1, sine2)
        sine = ca.sqrt(self._sine2)
        series = 2 + sine2 * (1 / 3 + sine2 * (3 / 20 + sine2 * 5 / 56))
        factor = ca.if_else(self._small, series, 2 * ca.atan2(sine, w) / sine)
        self.vector = sign * factor * v
        self.square = factor * factor * sine2
        self._square = ca.if_else(self._small, 1, self.square)
        t = self.square
        series = 1 / 12 + t * (1 / 720 + t / 30240)
        self.c = ca.if_else(self._small, series, (1 - factor * w / 2) / self._square)

    @cached_property
    def slope(self) -> Any:
        """Derivative of c by the angle, divided by the angle."""
        t = self.square
        series = 1 / 360 + t * (1 / 7560 + t / 201600)
        exact = (1 / (4 * self._sine2) - 1 / self._square - self.c) / self._square
        return ca.if_else(self._small, series, exact)

    @cached_property
    def jacobian(self) -> Any:
        """Inverse right Jacobian (3, 3): ``log(R Exp(d)) = phi + jacobian d`` to first order."""
        phi, c = self.vector, self.c
        return skew(phi) / 2 + c * ca.mtimes(phi, phi.T) + (1 - c * self.square) * ca.DM.eye(3)


class Rotation3:
    """Element of SO3: a rotation in space, body to world, given by its unit quaternion (x, y, z, w).

    `tangent` displaces it by a small rotation vector in its body frame (see the module).
    """

    def __init__(self, quaternion: Any, tangent: Any = None) -> None:
        self._q = quaternion
        self._tangent = tangent

    @classmethod
    def exp(cls, vector: Any) -> Rotation3:
        """The rotation about a rotation vector (3,), rad."""
        square = ca.dot(vector, vector)
        small = square < SMALL
        half = ca.sqrt(ca.if_else(small, 1, square)) / 2
        series = 0.5 - square * (1 / 48 - square * (1 / 3840 - square / 645120))
        factor = ca.if_else(small, series, ca.sin(half) / (2 * half))
        series = 1 - square * (1 / 8 - square * (1 / 384 - square / 46080))
        return cls(ca.vertcat(factor * vector, ca.if_else(small, series, ca.cos(half))))

    @property
    def coordinates(self) -> Any:
        """Quaternion (4,)."""
        if self._tangent is None:
            return self._q
        return self._q + _product(self._q, ca.vertcat(self._tangent / 2, 0))

    @cached_property
    def _matrix(self) -> Any:
        x, y, z, w = (self._q[k] for k in range(4))
        x2, y2, z2 = 2 * x, 2 * y, 2 * z
        xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
        wx, wy, wz = w * x2, w * y2, w * z2
        return ca.vertcat(
            ca.horzcat(1 - (yy + zz), xy - wz, xz + wy),
            ca.horzcat(xy + wz, 1 - (xx + zz), yz - wx),
            ca.horzcat(xz - wy, yz + wx, 1 - (xx + yy)),
        )

    @property
    def matrix(self) -> Any:
        """Rotation matrix (3, 3): body to world."""
        if self._tangent is None:
            return self._matrix
        return self._matrix + ca.mtimes(self._matrix, skew(self._tangent))

    @property
    def yaw(self) -> Any:
        """Heading of the body's x axis, in the horizontal plane from the world's x axis (rad); undefined upright."""
        forward = self.rotate(ca.vertcat(1, 0, 0))
        return ca.atan2(forward[1], forward[0])

    def rotate(self, v: Any) -> Any:
        """Body vector (3,) expressed in the world frame."""
        moved = v if self._tangent is None else v + cross(self._tangent, v)
        return _turn(self._q, moved)

    def unrotate(self, v: Any) -> Any:
        """World vector (3,) expressed in the body frame."""
        u = _turn(_conjugate(self._q), v)
        return u if self._tangent is None else u - cross(self._tangent, u)

    def inverse(self) -> Rotation3:
        tangent = None if self._tangent is None else -ca.mtimes(self._matrix, self._tangent)
        return Rotation3(_conjugate(self._q), tangent)

    def __matmul__(self, other: Rotation3) -> Rotation3:
        carried = None if self._tangent is None else ca.mtimes(other._matrix.T, self._tangent)
        return Rotation3(_product(self._q, other._q), _sum(carried, other._tangent))

    def between(self, other: Rotation3) -> Rotation3:
        """The rotation from this one to `other`: ``self^-1 other``."""
        relative = Rotation3(_product(_conjugate(self._q), other._q))
        carried = None if self._tangent is None else -ca.mtimes(relative._matrix.T, self._tangent)
        return Rotation3(relative._q, _sum(carried, other._tangent))

    def log(self) -> Any:
        """Rotation vector (3,), angle at most pi (rad)."""
        log = _Logarithm(self._q)
        return log.vector if self._tangent is None else log.vector + ca.mtimes(log.jacobian, self._tangent)


class Pose3:
    """Element of SE3: position (m) and orientation of a body in space.

    `tangent` displaces it by a small (translation, rotation) in its body frame (see the module).
    """

    def __init__(self, translation: Any, rotation: Rotation3, tangent: Any = None) -> None:
        self._t = translation
        self._rotation = rotation
        self._tangent = tangent

    @property
    def translation(self) -> Any:
        """Position (3,) in the world frame."""
        return self._t if self._tangent is None else self._t + self._rotation.rotate(self._tangent[0:3])

    @property
    def rotation(self) -> Rotation3:
        return self._rotation if self._tangent is None else Rotation3(self._rotation._q, self._tangent[3:6])

    @property
    def coordinates(self) -> Any:
        return ca.vertcat(self.translation, self.rotation.coordinates)

    def _backwards(self, tangent: Any) -> Any:
        """A tangent in the frame before this pose, seen in its own frame: ``Ad(T^-1) tangent``."""
        v, w = tangent[0:3], tangent[3:6]
        back = self._rotation._matrix.T
        return ca.vertcat(ca.mtimes(back, v + cross(w, self._t)), ca.mtimes(back, w))

    def inverse(self) -> Pose3:
        turned = self._rotation.inverse()
        result = Pose3(-turned.rotate(self._t), turned)
        tangent = None if self._tangent is None else -result._backwards(self._tangent)
        return Pose3(result._t, turned, tangent)

    def __matmul__(self, other: Pose3) -> Pose3:
        carried = None if self._tangent is None else other._backwards(self._tangent)
        translation = self._t + self._rotation.rotate(other._t)
        return Pose3(translation, self._rotation @ other._rotation, _sum(carried, other._tangent))

    def between(self, other: Pose3) -> Pose3:
        """`other` seen from this pose: ``self^-1 other``."""
        relative = Pose3(self._rotation.unrotate(other._t - self._t), self._rotation.between(other._rotation))
        carried = None if self._tangent is None else -relative._backwards(self._tangent)
        return Pose3(relative._t, relative._rotation, _sum(carried, other._tangent))

    def transform_to(self, point: Any) -> Any:
        """World point (3,) in the body frame (m)."""
        local = self._rotation.unrotate(point - self._t)
        if self._tangent is None:
            return local
        return local - self._tangent[0:3] - cross(self._tangent[3:6], local)

    def transform_from(self, point: Any) -> Any:
        """Body point (3,) in the world frame (m)."""
        if self._tangent is not None:
            point = point + self._tangent[0:3] + cross(self._tangent[3:6], point)
        return self._t + self._rotation.rotate(point)

    def local(self) -> Any:
        """Plain chart at the identity: (translation, rotation vector)."""
        return ca.vertcat(self.translation, self.rotation.log())

    def log(self) -> Any:
        """Full logarithm of SE(3), translation first (the chart of gtsam's prior and between factors)."""
        log, t = _Logarithm(self._rotation._q), self._t
        phi, c = log.vector, log.c
        once = cross(phi, t)
        twice = cross(phi, once)
        value = ca.vertcat(t - once / 2 + c * twice, phi)
        if self._tangent is None:
            return value
        # derivative of the translation part by phi, at a fixed t
        bend = skew(t) / 2 + c * ca.dot(phi, t) * ca.DM.eye(3)
        bend += c * ca.mtimes(phi, t.T) + ca.mtimes(log.slope * twice - 2 * c * t, phi.T)
        v, w = self._tangent[0:3], self._tangent[3:6]
        upper = ca.mtimes(log.jacobian, v) + ca.mtimes(ca.mtimes(bend, log.jacobian), w)
        return value + ca.vertcat(upper, ca.mtimes(log.jacobian, w))


class _SO3:
    name, ambient, dim = "SO3", 4, 3

    def __repr__(self) -> str:
        return self.name

    def __call__(self, x: Any) -> Rotation3:
        return self.element(x)

    def element(self, x: Any) -> Rotation3:
        return Rotation3(x[0:4])

    def displaced(self, x: Any, d: Any) -> Rotation3:
        """The element of ``retract(x, d)``, exact to first order in d."""
        return Rotation3(x[0:4], d)

    def retract(self, x: Any, d: Any) -> Any:
        return _product(x, Rotation3.exp(d).coordinates)

    def local(self, x: Any, y: Any) -> Any:
        return self.element(x).between(self.element(y)).log()

    def retract_array(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        return _unit(quaternion_product(x, quaternion_exp(d)))

    def local_array(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return quaternion_log(quaternion_product(quaternion_conjugate(x), y))

    def identity(self) -> np.ndarray:
        return np.array([0.0, 0.0, 0.0, 1.0])

    def normalize_array(self, x: np.ndarray) -> np.ndarray:
        """Unit quaternions. Raises DataError where one is zero."""
        length = np.linalg.norm(x, axis=-1)
        if not (length > 1e-6).all():
            row = int(np.flatnonzero(~(length > 1e-6))[0])
            raise DataError(f"instance {row}: the quaternion (x, y, z, w) = {x[row]} is zero and gives no rotation")
        return x / length[..., None]


class _SE3:
    name, ambient, dim = "SE3", 7, 6

    def __repr__(self) -> str:
        return self.name

    def __call__(self, x: Any) -> Pose3:
        return self.element(x)

    def element(self, x: Any) -> Pose3:
        return Pose3(x[0:3], Rotation3(x[3:7]))

    def displaced(self, x: Any, d: Any) -> Pose3:
        """The element of ``retract(x, d)``, exact to first order in d."""
        return Pose3(x[0:3], Rotation3(x[3:7]), d)

    def retract(self, x: Any, d: Any) -> Any:
        return ca.vertcat(x[0:3] + _turn(x[3:7], d[0:3]), SO3.retract(x[3:7], d[3:6]))

    def local(self, x: Any, y: Any) -> Any:
        return self.element(x).between(self.element(y)).local()

    def retract_array(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        turned = SO3.retract_array(x[:, 3:], d[:, 3:])
        return np.hstack([x[:, :3] + rotate_array(x[:, 3:], d[:, :3]), turned])

    def local_array(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        t = rotate_array(quaternion_conjugate(x[:, 3:]), y[:, :3] - x[:, :3])
        return np.hstack([t, SO3.local_array(x[:, 3:], y[:, 3:])])

    def identity(self) -> np.ndarray:
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

    def normalize_array(self, x: np.ndarray) -> np.ndarray:
        """The same positions with unit quaternions. Raises DataError where one is zero."""
        return np.hstack([x[:, :3], SO3.normalize_array(x[:, 3:])])


SO3 = _SO3()
SE3 = _SE3()


def quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (count, 4) of quaternions (x, y, z, w), row by row."""
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    w = aw * bw - ax * bx - ay * by - az * bz
    out = np.empty((*w.shape, 4))
    out[..., 0] = aw * bx + bw * ax + ay * bz - az * by
    out[..., 1] = aw * by + bw * ay + az * bx - ax * bz
    out[..., 2] = aw * bz + bw * az + ax * by - ay * bx
    out[..., 3] = w
    return out


def quaternion_conjugate(q: np.ndarray) -> np.ndarray:
    """Inverse rotations (count, 4)."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def quaternion_exp(vectors: np.ndarray) -> np.ndarray:
    """Unit quaternions (count, 4) of rotation vectors (count, 3), rad."""
    half = np.sqrt(np.einsum("...k,...k", vectors, vectors))[..., None] / 2
    return np.concatenate([np.sinc(half / np.pi) / 2 * vectors, np.cos(half)], axis=-1)


def quaternion_log(q: np.ndarray) -> np.ndarray:
    """Rotation vectors (count, 3) of unit quaternions, angle at most pi (rad)."""
    sign = np.where(q[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    cosine = sign * q[..., 3:]
    angle = 2 * np.arctan2(sine, cosine)
    # to first order both sides are 2 where the sine vanishes
    return sign * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-150) * q[..., :3]


def rotate_array(q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (count, 3) turned by unit quaternions (count, 4), row by row."""
    # np.cross takes longer than all the rest where rows are few
    ux, uy, uz, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    vx, vy, vz = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    tx, ty, tz = 2 * (uy * vz - uz * vy), 2 * (uz * vx - ux * vz), 2 * (ux * vy - uy * vx)
    x = vx + w * tx + uy * tz - uz * ty
    out = np.empty((*x.shape, 3))
    out[..., 0] = x
    out[..., 1] = vy + w * ty + uz * tx - ux * tz
    out[..., 2] = vz + w * tz + ux * ty - uy * tx
    return out


def _unit(q: np.ndarray) -> np.ndarray:
    return q / np.sqrt(np.einsum("...k,...k", q, q))[..., None]
