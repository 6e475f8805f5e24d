"""Arrays that define a model, checked once: shape, finite numbers, definite covariances."""

from __future__ import annotations

from typing import Any

import numpy as np

from problems.errors import DefinitionError, NoiseError, ShapeError

# Smallest eigenvalue of a correlation matrix that still counts as definite: below it a covariance is singular to
# rounding, as the rank-deficient covariance of a noise that enters through fewer inputs is.
_DEFINITE = 1e-13


def _numbers(value: Any, what: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise DefinitionError(f"{what}: expected an array of numbers, got {type(value).__name__}") from error
    if not np.isfinite(array).all():
        raise DefinitionError(f"{what}: every number must be finite, got {array[~np.isfinite(array)][0]}")
    return array


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def vector(value: Any, size: int, what: str) -> np.ndarray:
    """`value` as a read-only (size,) array. Raises `ShapeError` or `DefinitionError`."""
    array = np.atleast_1d(_numbers(value, what))
    if array.shape != (size,):
        raise ShapeError(f"{what}: expected shape ({size},), got {np.shape(value)}")
    return _frozen(array)


def matrix(value: Any, rows: int | None, columns: int | None, what: str) -> np.ndarray:
    """`value` as a read-only matrix; None leaves a dimension free. Raises `ShapeError` or `DefinitionError`."""
    array = _numbers(value, what)
    fits = array.ndim == 2 and rows in (None, array.shape[0]) and columns in (None, array.shape[1])
    if not fits:
        expected = f"of shape ({'any' if rows is None else rows}, {'any' if columns is None else columns})"
        if rows is None and columns is None:
            expected = "with a row for each component, such as [[1.0, 0.0]]"
        raise ShapeError(f"{what}: expected a matrix {expected}, got shape {array.shape}")
    return _frozen(np.ascontiguousarray(array))


def covariance(value: Any, size: int, what: str) -> np.ndarray:
    """`value` as a read-only symmetric positive definite (size, size) matrix; a number where `size` is 1.

    Raises:
        ShapeError: wrong shape.
        NoiseError: not finite, not symmetric or not positive definite.
    """
    try:
        array = _numbers(value, what)
    except DefinitionError as error:
        raise NoiseError(str(error)) from error
    if size == 1 and array.size == 1:
        array = array.reshape(1, 1)
    if array.shape != (size, size):
        hint = "; write numpy.diag(...) around variances" if array.shape == (size,) else ""
        raise ShapeError(f"{what}: expected a covariance of shape ({size}, {size}), got shape {np.shape(value)}{hint}")
    skew = np.abs(array - array.T).max(initial=0.0)
    if skew > 1e-9 * np.abs(array).max(initial=0.0):
        raise NoiseError(f"{what}: a covariance is symmetric, the largest difference here is {skew:.3g}")
    array = (array + array.T) / 2
    variances = np.diag(array)
    if (variances <= 0).any():
        worst = int(np.argmin(variances))
        raise NoiseError(f"{what}: must be positive definite, variance {worst} is {variances[worst]:.3g}")
    scale = np.sqrt(variances)
    if size and np.linalg.eigvalsh(array / np.outer(scale, scale))[0] <= _DEFINITE:
        raise NoiseError(
            f"{what}: must be positive definite, its smallest eigenvalue is {np.linalg.eigvalsh(array)[0]:.3g}; "
            "a disturbance of lower rank is stated by a gain G and the covariance of fewer disturbances"
        )
    return _frozen(array)


def deviations(value: Any, size: int, what: str) -> np.ndarray:
    """Covariance (size, size) of independent components with standard deviations `value`: a number or (size,).

    Raises:
        ShapeError: wrong shape.
        NoiseError: not positive and finite.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise DefinitionError(f"{what}: sigma must be numbers, got {type(value).__name__}") from error
    if array.ndim > 1 or (array.size != 1 and array.shape != (size,)):
        raise ShapeError(f"{what}: sigma must be a number or have shape ({size},), got shape {array.shape}")
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise NoiseError(f"{what}: sigma must be positive and finite, got {value!r}")
    return _frozen(np.diag(np.broadcast_to(array.ravel(), (size,)) ** 2))
