"""Pieces of gtsam graphs: values, noise models, linear factors, and our residuals as error functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DataError, FormError, MissingExtraError
from problems.forms.layout import DataStore, Layout, TermLayout, constant_rows, noise_numbers
from problems.forms.native_factors import NativeFactor
from problems.forms.residual_code import residual_code
from problems.forms.template import Template, template_of
from problems.noise import L2, Loss, whitening
from problems.problem import DataSlot
from problems.spaces import SE2, SO2, Space, Vector
from problems.spatial import GTSAM_ORDER, SE3, SO3


def gtsam_module() -> Any:
    try:
        import gtsam
    except ModuleNotFoundError as error:
        raise MissingExtraError("the form graph", "gtsam") from error
    return gtsam


def to_gtsam(space: Space) -> Callable[[np.ndarray], Any]:
    """Makes gtsam's value of a row of stored coordinates. Raises FormError for a space gtsam does not have."""
    if isinstance(space, Vector):
        return lambda row: row
    gtsam = gtsam_module()
    if space == SE2:
        return lambda row: gtsam.Pose2(row[0], row[1], row[2])
    if space == SO2:
        return lambda row: gtsam.Rot2(row[0])
    if space == SO3:
        return lambda row: gtsam.Rot3.Quaternion(row[3], row[0], row[1], row[2])
    if space == SE3:
        return lambda row: gtsam.Pose3(gtsam.Rot3.Quaternion(row[6], row[3], row[4], row[5]), row[:3])
    raise FormError(f"the space {space.name} has no counterpart among gtsam's values here; use solver='gauss-newton'")


def reader(space: Space) -> Callable[[Any, int], Any]:
    """Stored coordinates of a key in ``gtsam.Values``."""
    readers: dict[Any, Callable[[Any, int], Any]] = {SE2: _pose2, SO2: _angle, SO3: _quaternion, SE3: _pose3}
    return readers.get(space, lambda values, key: values.atVector(key))


def _pose2(values: Any, key: int) -> tuple[float, float, float]:
    pose = values.atPose2(key)
    return pose.x(), pose.y(), pose.theta()


def _angle(values: Any, key: int) -> tuple[float]:
    return (values.atRot2(key).theta(),)


def _quaternion(values: Any, key: int) -> tuple[float, ...]:
    q = values.atRot3(key).toQuaternion()
    return q.x(), q.y(), q.z(), q.w()


def _pose3(values: Any, key: int) -> tuple[float, ...]:
    pose = values.atPose3(key)
    q = pose.rotation().toQuaternion()
    return (*pose.translation(), q.x(), q.y(), q.z(), q.w())


class PointCode:
    """Residual and Jacobian of a template at one point, called through buffers."""

    def __init__(self, template: Template) -> None:
        self.dim, self._dims = template.dim, template.dims
        outputs = ca.cse([template.residual, ca.densify(template.jacobian)])
        function = ca.Function("factor", [template.point, template.numbers], outputs)
        buffer: Any
        buffer, self._run = function.buffer()
        self._x, self._d = np.zeros(template.point.shape[0]), np.zeros(max(template.numbers.shape[0], 1))
        self._r, self._j = np.zeros(self.dim), np.zeros((template.width, self.dim))
        for i, array in enumerate((self._x, self._d)):
            buffer.set_arg(i, array.data)
        for i, array in enumerate((self._r, self._j)):
            buffer.set_res(i, array.ravel().data)
        self._buffer = buffer

    def error(
        self, spaces: Sequence[Space], keys: Sequence[int], numbers: np.ndarray, shift: np.ndarray
    ) -> Callable[..., np.ndarray]:
        """Error function of the factor of one instance; an instance in two slots has one block."""
        places = list(dict.fromkeys(keys))
        ends = np.cumsum(self._dims)
        blocks = [
            [slice(end - dim, end) for key, end, dim in zip(keys, ends, self._dims, strict=True) if key == place]
            for place in places
        ]
        slots = [(reader(space), key) for space, key in zip(spaces, keys, strict=True)]
        turned = [spaces[list(keys).index(place)] == SE3 for place in places]

        def error(_: Any, values: Any, jacobians: Any) -> np.ndarray:
            self._x[:] = np.concatenate([read(values, key) for read, key in slots])
            self._d[: numbers.size] = numbers
            self._run()
            if jacobians is not None:
                for k, parts in enumerate(blocks):
                    block = self._j[parts[0]]
                    for part in parts[1:]:
                        block = block + self._j[part]
                    jacobians[k] = np.asfortranarray(block[GTSAM_ORDER].T if turned[k] else block.T)
            return self._r + shift

        return error


def roots(entry: TermLayout, store: DataStore) -> np.ndarray:
    """Square-root information of the instances, as `problems.noise.whitening` gives it."""
    noise, dim = entry.term.noise, template_of(entry.term).dim
    assert noise is not None
    return whitening(noise.kind, noise_numbers(entry.term, dim, store), dim, entry.term.count, entry.term.what)


def noise_models(root: np.ndarray, native: NativeFactor | None, loss: Loss) -> list[Any]:
    model = gtsam_module().noiseModel
    order = None if native is None or native.order is None else list(native.order)
    if root.ndim == 2:
        sigmas = 1 / (root if order is None else root[:, order])
        noises = [model.Diagonal.Sigmas(row) for row in sigmas]
    else:
        if order is not None:
            root = np.linalg.qr(root[:, :, order])[1]
        noises = [model.Gaussian.SqrtInformation(matrix, False) for matrix in root]
    if isinstance(loss, L2):
        return noises
    # gtsam's names of losses are ours, with the same scale and on the same norm
    estimator = getattr(model.mEstimator, type(loss).__name__).Create(loss.scale)
    return [model.Robust.Create(estimator, noise) for noise in noises]


def completing_shift(entry: TermLayout, layout: Layout, root: np.ndarray, numbers: np.ndarray) -> np.ndarray | None:
    """(count, dim) solutions s of ``W s = linear``, or None where there is no linear part."""
    term, dim = entry.term, template_of(entry.term).dim
    if term.linear is None:
        return None
    if isinstance(term.linear, DataSlot):
        linear = np.broadcast_to(numbers[layout.numbers(term.linear)], (term.count, dim))
    else:
        linear = constant_rows(term.linear, dim, term.count, f"{term.what}: linear")
    if root.ndim == 2:
        return linear / root**2
    W = root.swapaxes(1, 2) @ root
    shift = (np.linalg.pinv(W, hermitian=True) @ linear[:, :, None])[:, :, 0]
    left = np.abs((W @ shift[:, :, None])[:, :, 0] - linear).max(axis=1)
    bad = np.flatnonzero(left > 1e-7 * np.maximum(np.abs(linear).max(axis=1), 1e-300))
    if bad.size:
        raise DataError(
            f"{term.what}: the linear part of instance {bad[0]} points where its information is zero, so no square "
            "holds it; use solver='gauss-newton' or 'ipopt'"
        )
    return shift


def data_rows_of(entry: TermLayout, numbers: np.ndarray, active: np.ndarray) -> Any:
    """For each active instance the flat rows of its data."""
    rows = numbers[entry.numbers[active]]
    ends = np.cumsum([slot.source.size for slot in entry.term.data])
    parts = np.split(rows, ends[:-1], axis=1) if ends.size else []
    return zip(*parts, strict=True) if parts else [()] * active.size


def at_zero(entry: TermLayout, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians (count, dim[, width]) of an affine term at zero."""
    count, stored = numbers.shape[0], entry.stored.shape[1]
    inputs = [np.zeros(count)] * stored + [np.ascontiguousarray(column) for column in numbers.T]
    return residual_code(entry.term).residual_and_jacobian(inputs, count)


def linear_factors(
    entry: TermLayout, keys: Sequence[Sequence[int]], jacobian: np.ndarray, residual: np.ndarray, noise: Any
) -> list[Any]:
    gtsam = gtsam_module()
    dims = template_of(entry.term).dims
    ends = np.cumsum(dims)
    out = []
    for row, J, r in zip(keys, jacobian, residual, strict=True):
        blocks: dict[int, np.ndarray] = {}
        for key, end, dim in zip(row, ends, dims, strict=True):
            block = J[:, end - dim : end]
            blocks[key] = blocks[key] + block if key in blocks else block
        at, parts = gtsam.Values(), []
        for key, block in blocks.items():
            at.insert(key, np.zeros(block.shape[1]))
            parts += [key, block]
        out.append(gtsam.LinearContainerFactor(gtsam.JacobianFactor(*parts, -r, noise), at))
    return out


def _measured(row: np.ndarray, spaces: tuple[Space, ...]) -> np.ndarray:
    """A measurement of random numbers; one of the size of an element is an element: of quaternions, the unit ones."""
    for space in spaces:
        if row.size == space.ambient:
            return space.normalize_array(row[None])[0]
    return row


@lru_cache(maxsize=256)
def is_the_residual(native: NativeFactor, template: Template, spaces: tuple[Space, ...]) -> bool:
    """Compare a native factor with our residual, errors and Jacobians, at random points."""
    gtsam = gtsam_module()
    code = PointCode(template)
    rng = np.random.default_rng(20)
    order = list(range(template.dim)) if native.order is None else list(native.order)
    for _ in range(3):
        values, parts = gtsam.Values(), []
        for key, space in enumerate(spaces):
            parts.append(space.normalize_array(2 * rng.normal(size=(1, space.ambient)))[0])
            values.insert(key, to_gtsam(space)(parts[-1]))
        rows = [_measured(rng.normal(size=symbol.shape[0]), spaces) for symbol in template.data]
        jacobians: list[Any] = [None] * len(spaces)
        keys = list(range(len(spaces)))
        error = code.error(spaces, keys, np.concatenate([*rows, []]), np.zeros(code.dim))
        residual = error(None, values, jacobians)
        factor = native.build(*keys, *rows, gtsam.noiseModel.Unit.Create(template.dim))
        A, b = factor.linearize(values).jacobian()
        ends = np.cumsum([template.dims[k] for k in factor.keys()])
        found = dict(zip(factor.keys(), np.split(A, ends[:-1], axis=1), strict=True))
        ours = np.concatenate([residual[order], *(jacobians[k][order].ravel() for k in keys)])
        theirs = np.concatenate([-b, *(found[k].ravel() for k in keys)])
        if not np.allclose(ours, theirs, rtol=1e-8, atol=1e-8):
            return False
    return True
