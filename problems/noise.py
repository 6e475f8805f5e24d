"""Noise models and robust losses of cost terms.

A loss acts on the squared whitened norm ``s`` of a whole instance; a cost instance contributes ``rho(s)``, which is
``s/2`` without a loss. All loss scales are in units of the standard deviation. Definitions as in the M-estimation
literature (Huber 1981; Holland and Welsch 1977).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from problems.errors import NoiseError, SettingError

Kind = Literal["sigma", "covariance", "information"]


class Gaussian:
    """Zero-mean Gaussian noise, stated in exactly one way.

    Args:
        sigma: standard deviations, a number, (dim,), or per instance (count, dim).
        covariance: (dim, dim) or (count, dim, dim), symmetric positive definite.
        information: inverse covariance, same shapes; positive semidefinite (a zero block means "nothing known").

    Each may also be a data handle of the problem, so that the numbers change from solve to solve; sigma data may be one
    number per instance for all its components.

    Raises:
        NoiseError: none or several of the three given.
    """

    def __init__(self, sigma: Any = None, *, covariance: Any = None, information: Any = None) -> None:
        stated: dict[Kind, Any] = {"sigma": sigma, "covariance": covariance, "information": information}
        given: list[tuple[Kind, Any]] = [(kind, value) for kind, value in stated.items() if value is not None]
        if len(given) != 1:
            raise NoiseError(
                f"Gaussian takes exactly one of sigma, covariance, information; got {[k for k, _ in given] or 'none'}"
            )
        self.kind: Kind = given[0][0]
        self.value: Any = given[0][1]

    def __repr__(self) -> str:
        return f"Gaussian({self.kind}={self.value!r})"


def whitening(kind: Kind, value: Any, dim: int, count: int, what: str) -> np.ndarray:
    """Square-root information of a noise model.

    Returns:
        (1 or count, dim) reciprocals of standard deviations where the noise is diagonal, else upper-triangular factors
        (1 or count, dim, dim) with ``U'U`` = information.

    Raises:
        NoiseError: wrong shape, not finite, not symmetric or not positive definite; names the term and the instance.
    """
    if kind == "sigma":
        return 1.0 / _sigmas(value, dim, count, what)
    array = _matrices(kind, value, dim, count, what)
    if kind == "information":
        return _semidefinite_root(array, what)
    lower_inverse = np.linalg.inv(_cholesky(array, kind, what))
    upper = np.linalg.qr(lower_inverse)[1]
    return upper * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, :, None]


def information_matrix(kind: Kind, value: Any, dim: int, count: int, what: str) -> np.ndarray:
    """Information matrices (1 or count, dim, dim) of a noise model. Errors as for `whitening`."""
    if kind == "sigma":
        return _sigmas(value, dim, count, what)[:, :, None] ** -2 * np.eye(dim)
    array = _matrices(kind, value, dim, count, what)
    if kind == "information":
        _semidefinite_root(array, what)
        return array
    _cholesky(array, kind, what)
    return np.linalg.inv(array)


def _array(value: Any, kind: Kind, what: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise NoiseError(f"{what}: {kind} must be numbers, got {value!r}") from None


def chosen_rows(noise: Gaussian, dim: int, count: int, rows: np.ndarray, what: str) -> Gaussian:
    """The noise of chosen instances of a term with `count` instances. Errors as for `whitening`."""
    kind = noise.kind
    array = (
        _sigmas(noise.value, dim, count, what) if kind == "sigma" else _matrices(kind, noise.value, dim, count, what)
    )
    return Gaussian(**{kind: array if array.shape[0] == 1 else array[rows]})


def _sigmas(value: Any, dim: int, count: int, what: str) -> np.ndarray:
    array = _array(value, "sigma", what)
    if array.ndim == 0 or array.size == 1:
        array = np.full((1, dim), float(array.ravel()[0]))
    elif array.shape == (dim,):
        array = array[None]
    elif array.shape == (count,) and dim == 1:
        array = array[:, None]
    if array.shape not in ((1, dim), (count, dim)):
        raise NoiseError(f"{what}: sigma must be a number, ({dim},) or ({count}, {dim}); got shape {np.shape(value)}")
    bad = ~(np.isfinite(array) & (array > 0)).all(axis=1)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise NoiseError(f"{what}: sigma must be positive and finite; instance {row} has {array[row]}")
    return array


def _matrices(kind: Kind, value: Any, dim: int, count: int, what: str) -> np.ndarray:
    array = _array(value, kind, what)
    if dim == 1 and array.size in (1, count):
        array = array.reshape(-1, 1, 1)
    elif array.shape == (dim, dim):
        array = array[None]
    if array.shape not in ((1, dim, dim), (count, dim, dim)):
        raise NoiseError(
            f"{what}: {kind} must be ({dim}, {dim}) or ({count}, {dim}, {dim}); got shape {np.shape(value)}"
        )
    _check_symmetric(array, kind, what)
    return array


def _check_symmetric(array: np.ndarray, kind: str, what: str) -> None:
    flat = array.ravel()
    if flat.dot(flat) < np.inf and (array == array.swapaxes(1, 2)).all():
        return  # nearly always, and told in a tenth of the time of what follows
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))[0])
        raise NoiseError(f"{what}: {kind} of instance {row} is not finite")
    skew = np.abs(array - array.swapaxes(1, 2)).max(axis=(1, 2))
    bad = skew > 1e-8 * np.maximum(np.abs(array).max(axis=(1, 2)), 1e-300)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise NoiseError(f"{what}: {kind} of instance {row} is not symmetric (largest difference {skew[row]:.3g})")


def _cholesky(array: np.ndarray, kind: str, what: str) -> np.ndarray:
    try:
        return np.linalg.cholesky(array)
    except np.linalg.LinAlgError:
        low = np.linalg.eigvalsh(array)[:, 0]
        row = int(np.argmin(low))
        raise NoiseError(
            f"{what}: {kind} of instance {row} is not positive definite (smallest eigenvalue {low[row]:.3g})"
        ) from None


def _semidefinite_root(information: np.ndarray, what: str) -> np.ndarray:
    try:
        return np.linalg.cholesky(information).swapaxes(1, 2)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        floor = -1e-10 * np.maximum(np.abs(values).max(axis=1), 1e-300)
        if (values[:, 0] < floor).any():
            row = int(np.argmin(values[:, 0]))
            raise NoiseError(
                f"{what}: information of instance {row} is not positive semidefinite "
                f"(smallest eigenvalue {values[row, 0]:.3g})"
            ) from None
        root = np.sqrt(np.maximum(values, 0))[:, :, None] * vectors.swapaxes(1, 2)
        return np.linalg.qr(root)[1]


@dataclass(frozen=True)
class L2:
    """No robustness: ``rho(s) = s/2``."""

    def rho(self, s: Any) -> Any:
        return s / 2

    def weight(self, s: Any) -> Any:
        """Weight ``2 rho'(s)`` of iteratively reweighted least squares."""
        return 1.0


@dataclass(frozen=True)
class _Scaled:
    scale: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise SettingError(f"{type(self).__name__} needs a positive scale, got {self.scale!r}")


@dataclass(frozen=True)
class Huber(_Scaled):
    """Quadratic up to `scale` standard deviations, linear beyond (1.345: 95 % efficiency on Gaussian noise)."""

    scale: float = 1.345

    def rho(self, s: Any) -> Any:
        k = self.scale
        return ca.if_else(s <= k**2, s / 2, k * (ca.sqrt(ca.fmax(s, k**2)) - k / 2))

    def weight(self, s: Any) -> Any:
        return self.scale / ca.sqrt(ca.fmax(s, self.scale**2))


@dataclass(frozen=True)
class Cauchy(_Scaled):
    """Logarithmic growth; redescending influence."""

    scale: float = 2.385

    def rho(self, s: Any) -> Any:
        return self.scale**2 / 2 * ca.log(1 + s / self.scale**2)

    def weight(self, s: Any) -> Any:
        return 1 / (1 + s / self.scale**2)


@dataclass(frozen=True)
class GemanMcClure(_Scaled):
    """Bounded: approaches ``scale**2 / 2`` for gross outliers."""

    scale: float = 1.0

    def rho(self, s: Any) -> Any:
        return self.scale**2 * s / (2 * (self.scale**2 + s))

    def weight(self, s: Any) -> Any:
        return (self.scale**2 / (self.scale**2 + s)) ** 2


@dataclass(frozen=True)
class Tukey(_Scaled):
    """Bounded, with exactly zero influence beyond `scale` standard deviations."""

    scale: float = 4.685

    def rho(self, s: Any) -> Any:
        inside = ca.fmax(1 - s / self.scale**2, 0)
        return self.scale**2 / 6 * (1 - inside**3)

    def weight(self, s: Any) -> Any:
        return ca.fmax(1 - s / self.scale**2, 0) ** 2


Loss = L2 | Huber | Cauchy | GemanMcClure | Tukey
