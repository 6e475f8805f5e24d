"""Pre-estimation gains: the Luenberger observers that replace the disturbance sequence of a window.

Source: dmhe-pre-estimation 3.5 and section 5 item 4. Only the observable part of a node can be assigned; eigenvalues of
its unobservable part stay in A - L C whatever L is, so the smallest reachable spectral radius is the largest modulus
among them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import DefinitionError, ModelWarning, NoiseError, ShapeError, UnstableError
from problems.networks.observability import RANK_TOLERANCE, observable_split, system_matrices

RADIUS_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class ObserverGain:
    """A pre-estimation gain and what it achieves. Gains are not unique with several outputs: report `gain` itself.

    Attributes:
        A: (n, n) state matrix.
        C: (p, n) output matrix the gain belongs to (local, regional or collective).
        gain: L (n, p) in x_{k+1} = A x_k + L (y_k - C x_k).
        method: how it was found.
        error_matrix: Phi = A - L C (n, n).
        eigenvalues: (n,) of Phi, largest modulus first.
        spectral_radius: largest modulus of them.
        observable_rank: dimension of the part that the outputs observe.
        fixed_eigenvalues: (n - observable_rank,) unobservable eigenvalues of A, which no gain moves.
        reachable_radius: smallest spectral radius that any gain reaches: 0 if all is observable.
    """

    A: np.ndarray
    C: np.ndarray
    gain: np.ndarray
    method: str
    error_matrix: np.ndarray = field(init=False)
    eigenvalues: np.ndarray = field(init=False)
    spectral_radius: float = field(init=False)
    observable_rank: int = field(init=False)
    fixed_eigenvalues: np.ndarray = field(init=False)
    reachable_radius: float = field(init=False)

    def __post_init__(self) -> None:
        state, output = _one_system(self.A, self.C)
        gain = np.asarray(self.gain, dtype=float)
        if gain.shape != output.shape[::-1]:
            raise ShapeError(f"a gain for {len(output)} outputs has shape {output.shape[::-1]}, got {gain.shape}")
        error_matrix = state - gain @ output
        eigenvalues = np.linalg.eigvals(error_matrix)
        basis, rank = observable_split(state, output)
        hidden = basis[:, rank:]
        fixed = np.linalg.eigvals(hidden.T @ state @ hidden)
        values = {
            "A": state,
            "C": output,
            "gain": gain,
            "error_matrix": error_matrix,
            "eigenvalues": eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")],
            "spectral_radius": float(np.abs(eigenvalues).max()),
            "observable_rank": int(rank),
            "fixed_eigenvalues": fixed,
            "reachable_radius": float(np.abs(fixed).max(initial=0.0)),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)


def given_gain(A: ArrayLike, C: ArrayLike, gain: ArrayLike) -> ObserverGain:
    """A gain from elsewhere, with its eigenvalues worked out.

    Args:
        A: (n, n).
        C: (p, n).
        gain: L (n, p); zeros for no observer.

    Raises:
        ShapeError: shapes do not fit.
    """
    return ObserverGain(*_one_system(A, C), np.asarray(gain, dtype=float), "given")


def place_gain(A: ArrayLike, C: ArrayLike, eigenvalues: ArrayLike) -> ObserverGain:
    """Gain that gives the observable part of A - L C chosen eigenvalues.

    The observable part is split off by the singular vectors of the observability matrix; dependent rows of its outputs
    are reduced to independent ones for the placement, and the gain is spread back over all rows by the pseudo-inverse.

    Source: dmhe-pre-estimation 3.5; placement by scipy (Tits and Yang 1996).

    Args:
        A: (n, n).
        C: (p, n), also with redundant or zero rows.
        eigenvalues: as many as the rank of the observability matrix; complex ones in conjugate pairs; none repeated
            more often than there are independent outputs.

    Raises:
        ShapeError: shapes do not fit.
        DefinitionError: the number of eigenvalues is not the observable rank, or they cannot be placed.
    """
    state, output = _one_system(A, C)
    wanted = np.atleast_1d(np.asarray(eigenvalues))
    basis, rank = observable_split(state, output)
    if wanted.ndim != 1 or len(wanted) != rank:
        fixed = np.linalg.eigvals(basis[:, rank:].T @ state @ basis[:, rank:])
        raise DefinitionError(
            f"these {len(output)} outputs observe {rank} of {len(state)} states, so {rank} eigenvalues can be placed, "
            f"got {wanted.size}; the others stay at {np.round(fixed, 4).tolist()}"
        )
    gain = np.zeros(output.shape[::-1])
    if rank:
        seen = basis[:, :rank]
        gain = seen @ _place_observable(seen.T @ state @ seen, output @ seen, wanted)
    return ObserverGain(state, output, gain, "place")


def _place_observable(state: np.ndarray, output: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    from scipy.optimize import linear_sum_assignment
    from scipy.signal import place_poles

    # Independent combinations of the outputs: the right singular vectors with nonzero singular value.
    _, size, directions = np.linalg.svd(output, full_matrices=False)
    independent = directions[: np.count_nonzero(size > RANK_TOLERANCE * size[0])]
    with warnings.catch_warnings():
        # The eigenvalues reached are checked below; the warning is about the robustness iteration.
        warnings.simplefilter("ignore", UserWarning)
        try:
            placed: Any = place_poles(state.T, independent.T, wanted)
        except ValueError as error:
            raise DefinitionError(f"eigenvalues {wanted.tolist()} cannot be placed: {error}") from error
    gain = placed.gain_matrix.T @ np.linalg.pinv(output @ independent.T)
    reached = np.linalg.eigvals(state - gain @ output)
    apart = np.abs(reached[:, None] - wanted)
    if apart[linear_sum_assignment(apart)].max() > RADIUS_TOLERANCE:
        raise DefinitionError(
            f"eigenvalues {wanted.tolist()} cannot be placed accurately with these outputs; reached "
            f"{np.round(reached, 6).tolist()}; spread the eigenvalues or add an output"
        )
    return gain


def kalman_gain(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike) -> ObserverGain:
    """Stationary Kalman predictor gain ``A P C' (C P C' + R)^-1`` of the observable part, zero on the rest.

    Where everything is observable this is the usual gain from the algebraic Riccati equation.

    Source: dmhe-pre-estimation 3.5, dmhe-l-step E2 (H2 gains).

    Args:
        A: (n, n).
        C: (p, n).
        Q: (n, n) covariance of the disturbance, positive definite on the observable part.
        R: (p, p) covariance of the measurement noise, positive definite.

    Raises:
        ShapeError: shapes do not fit.
        NoiseError: Q or R do not allow a stationary solution.
    """
    state, output = _one_system(A, C)
    return ObserverGain(state, output, _riccati_gain(state, output, Q, R, scale=None), "kalman")


def minimal_radius_gain(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike) -> ObserverGain:
    """Kalman-like gain of a node with an unobservable part that reaches the smallest possible spectral radius.

    The observable part is stabilized within the radius r of the unobservable one by a Riccati equation for A / r.

    Source: dmhe-pre-estimation 3.5 (smallest reachable spectral radius).

    Args:
        A: (n, n).
        C: (p, n).
        Q: (n, n) as for `kalman_gain`.
        R: (p, p).

    Raises:
        ShapeError: shapes do not fit.
        DefinitionError: every radius can be reached, because everything that matters is observable: choose
            eigenvalues with `place_gain` or use `kalman_gain`.
        NoiseError: Q or R do not allow a stationary solution.
    """
    state, output = _one_system(A, C)
    radius = given_gain(state, output, np.zeros(output.shape[::-1])).reachable_radius
    if radius <= RADIUS_TOLERANCE:
        raise DefinitionError(
            "no unobservable eigenvalue limits the spectral radius of this observer; choose eigenvalues with "
            "place_gain or use kalman_gain"
        )
    return ObserverGain(state, output, _riccati_gain(state, output, Q, R, scale=radius), "minimal_radius")


def stationary_gain(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike) -> ObserverGain:
    """The gain a node has where none is given: `kalman_gain`, where no gain makes errors decay `minimal_radius_gain`.

    Args:
        A: (n, n).
        C: (p, n).
        Q: (n, n) covariance of the disturbance on the state, positive semidefinite.
        R: (p, p) covariance of the measurement noise, positive definite.

    Raises:
        ShapeError, NoiseError: see `kalman_gain`.
    """
    none = given_gain(A, C, np.zeros(np.shape(C)[::-1]))
    if not none.observable_rank:
        return none
    rule = kalman_gain if none.reachable_radius < 1 else minimal_radius_gain
    return rule(A, C, Q, R)


def _riccati_gain(state: np.ndarray, output: np.ndarray, Q: ArrayLike, R: ArrayLike, scale: float | None) -> np.ndarray:
    from scipy.linalg import solve_discrete_are

    disturbance, noise = np.asarray(Q, dtype=float), np.asarray(R, dtype=float)
    n, p = len(state), len(output)
    if disturbance.shape != (n, n) or noise.shape != (p, p):
        raise ShapeError(f"expected Q {(n, n)} and R {(p, p)}, got {disturbance.shape} and {noise.shape}")
    basis, rank = observable_split(state, output)
    gain = np.zeros((n, p))
    if not rank:
        return gain
    seen = basis[:, :rank]
    inner, sees, shaken = seen.T @ state @ seen, output @ seen, seen.T @ disturbance @ seen
    # A gain for A / r and C / r with poles in the unit circle is, times r, one for A with poles within r; without an
    # unobservable part to respect r is 1.
    limit = 1.0 if scale is None else scale
    try:
        np.linalg.cholesky(noise)
        covariance = solve_discrete_are((inner / limit).T, sees.T, shaken, noise)
    except np.linalg.LinAlgError as error:
        raise NoiseError(
            f"no stationary Kalman gain: {error}; R must be positive definite and Q must excite everything observed"
        ) from error
    innovation = sees @ covariance @ sees.T + noise
    return seen @ inner @ np.linalg.solve(innovation, sees @ covariance).T


def check_gain(observer: ObserverGain, *, node: object = None, allow_unstable: bool = False) -> None:
    """Refuse gains that let errors grow where they need not, warn of gains worse than necessary.

    Source: dmhe-pre-estimation section 5 item 4.

    Args:
        observer: the gain.
        node: name of the node for the message; None for the centralized observer.
        allow_unstable: only warn, for studies with unstable or zero gains.

    Raises:
        UnstableError: everything is observable, yet the spectral radius is 1 or more.

    Warns:
        ModelWarning: the same with `allow_unstable`; or something is unobservable and the spectral radius is larger
            than the smallest reachable one by more than 1e-6.
    """
    who = "the centralized observer" if node is None else f"the observer of node {node}"
    radius, reachable = observer.spectral_radius, observer.reachable_radius
    if observer.observable_rank == len(observer.A):
        if radius < 1:
            return
        text = (
            f"{who} ({observer.method}) has spectral radius {radius:.6g}, although its outputs observe everything; "
            "choose eigenvalues inside the unit circle, or allow it explicitly"
        )
        if not allow_unstable:
            raise UnstableError(text)
        warnings.warn(text, ModelWarning, stacklevel=2)
    elif radius > reachable + RADIUS_TOLERANCE:
        warnings.warn(
            f"{who} ({observer.method}) has spectral radius {radius:.6g}, while {reachable:.6g} can be reached with "
            f"its outputs (unobservable eigenvalues {np.round(observer.fixed_eigenvalues, 4).tolist()})",
            ModelWarning,
            stacklevel=2,
        )


def _one_system(A: ArrayLike, C: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    state, output = system_matrices(A, C)
    if state.ndim != 2 or output.ndim != 2:
        raise ShapeError(f"expected one system, A (n, n) and C (p, n), got {state.shape} and {output.shape}")
    return state, output
