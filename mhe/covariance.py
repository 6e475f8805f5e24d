"""Arrival-cost covariances without data: the recursions of one node, of many at once and of a whole network.

Every function takes leading axes (nodes, groups, trials). What a window tells about its first state enters only as an
n x n information matrix, so neighbourhoods of any size have arrays of one shape. Results are symmetrized in every step.

Source: dmhe-pre-estimation 3.1, 3.3 and section 5 items 7 and 8.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import ModelWarning, NoiseError, ShapeError, UnknownNameError
from problems.networks.network import Network
from problems.networks.reports import covariance_growth
from problems.networks.weights import Weights

CovarianceUpdate = Literal["seed", "exact"]
DetectionUpdate = Literal["literal", "exact", "onestep"]

CAP_FACTOR = 1e8
SETTLED_TOLERANCE = 1e-13


def symmetrized(matrix: np.ndarray) -> np.ndarray:
    """Symmetric part (..., n, n): recursions lose symmetry, then definiteness, by rounding."""
    return (matrix + np.swapaxes(matrix, -1, -2)) / 2


def conditioned(covariance: np.ndarray, information: np.ndarray) -> np.ndarray:
    """``(covariance^-1 + information)^-1`` without inverting either; symmetric and definite by construction.

    Args:
        covariance: (..., n, n) positive definite.
        information: (..., n, n) positive semidefinite.

    Raises:
        NoiseError: a covariance is not positive definite.
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise NoiseError("a covariance of the recursion is not positive definite") from None
    inner = np.eye(root.shape[-1]) + np.swapaxes(root, -1, -2) @ information @ root
    half = np.linalg.solve(np.linalg.cholesky(symmetrized(inner)), np.swapaxes(root, -1, -2))
    return np.swapaxes(half, -1, -2) @ half


def riccati_step(covariance: ArrayLike, A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike) -> np.ndarray:
    """One step of the Kalman predictor's covariance, ``Q + A Pi A' - A Pi C' (R + C Pi C')^-1 C Pi A'``.

    Source: dmhe-pre-estimation (2.15).

    Args:
        covariance: Pi (..., n, n).
        A: (n, n).
        C: (..., p, n).
        Q: (n, n).
        R: (..., p, p), positive definite.

    Returns:
        (..., n, n).
    """
    state, output = np.asarray(A, dtype=float), np.asarray(C, dtype=float)
    before = np.asarray(covariance, dtype=float)
    cross = output @ before
    innovation = np.asarray(R, dtype=float) + cross @ np.swapaxes(output, -1, -2)
    after = before - np.swapaxes(cross, -1, -2) @ np.linalg.solve(innovation, cross)
    return symmetrized(state @ after @ state.T + np.asarray(Q, dtype=float))


def disturbance_response(A: ArrayLike, C: ArrayLike, horizon: int) -> np.ndarray:
    """How disturbances reach the outputs of a window: block (r, c) is C A^(r-1-c) for r > c, else 0.

    Source: dmhe-pre-estimation 3.3 step 2.

    Args:
        A: (n, n).
        C: (..., p, n).
        horizon: N block rows; N - 1 block columns.

    Returns:
        (..., p N, n (N - 1)).
    """
    state, output = np.asarray(A, dtype=float), np.asarray(C, dtype=float)
    p, n = output.shape[-2:]
    response = np.zeros(output.shape[:-2] + (p * horizon, n * (horizon - 1)))
    power = output
    for lag in range(1, horizon):
        for column in range(horizon - lag):
            row = column + lag
            response[..., p * row : p * (row + 1), n * column : n * (column + 1)] = power
        power = power @ state
    return response


def window_noise(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike, horizon: int) -> np.ndarray:
    """Covariance R*_N of the outputs of a window given its first state.

    Source: dmhe-pre-estimation (2.26)-(2.28).

    Args:
        A: (n, n).
        C: (..., p, n).
        Q: (n, n).
        R: (..., p, p).
        horizon: N >= 1 instants.

    Returns:
        (..., p N, p N).
    """
    response = disturbance_response(A, C, horizon)
    shaken = response @ np.kron(np.eye(horizon - 1), np.asarray(Q, dtype=float)) @ np.swapaxes(response, -1, -2)
    noise = np.asarray(R, dtype=float)
    p = noise.shape[-1]
    diagonal = np.zeros(noise.shape[:-2] + (p * horizon, p * horizon))
    for block in range(horizon):
        diagonal[..., p * block : p * (block + 1), p * block : p * (block + 1)] = noise
    return symmetrized(diagonal + shaken)


def output_information(C: ArrayLike, R: ArrayLike) -> np.ndarray:
    """``C' R^-1 C`` (..., n, n), the information of one measurement.

    Raises:
        NoiseError: R is not symmetric positive definite.
        ShapeError: shapes do not fit.
    """
    output, noise = np.asarray(C, dtype=float), np.asarray(R, dtype=float)
    if output.ndim < 2 or noise.shape[-2:] != (output.shape[-2],) * 2:
        raise ShapeError(f"expected C (..., p, n) and R (..., p, p), got {output.shape} and {noise.shape}")
    if not output.shape[-2]:
        return np.zeros(output.shape[:-2] + (output.shape[-1],) * 2)
    if not np.allclose(noise, np.swapaxes(noise, -1, -2), rtol=1e-9, atol=0):
        raise NoiseError("R is not symmetric")
    try:
        half = np.linalg.solve(np.linalg.cholesky(noise), output)
    except np.linalg.LinAlgError:
        raise NoiseError("R is not positive definite") from None
    return np.swapaxes(half, -1, -2) @ half


def window_information(informations: Sequence[np.ndarray] | np.ndarray, A: ArrayLike, Q: ArrayLike) -> np.ndarray:
    """What the measurements of a window tell about its first state, disturbances integrated out.

    Equals ``O_N' R*_N^-1 O_N``, from the newest instant backwards: J_k = M_k + A' (I + J_{k+1} Q)^-1 J_{k+1} A.

    Source: dmhe-sporadic-fov 3.8; dmhe-pre-estimation (2.24)-(2.28).

    Args:
        informations: M_k (..., n, n) of every instant, oldest first; see `output_information`.
        A: (n, n), or with the leading axes of M_k.
        Q: the same, may be singular.

    Returns:
        (..., n, n).
    """
    state, disturbance = np.asarray(A, dtype=float), np.asarray(Q, dtype=float)
    known = np.asarray(informations[-1], dtype=float)
    identity, transposed = np.eye(state.shape[-1]), np.swapaxes(state, -1, -2)
    for instant in range(len(informations) - 2, -1, -1):
        forgotten = np.linalg.solve(identity + known @ disturbance, known)
        known = symmetrized(informations[instant] + transposed @ forgotten @ state)
    return known


def arrival_update(
    fused: np.ndarray,
    A: np.ndarray,
    Q: np.ndarray,
    information: np.ndarray,
    window: np.ndarray,
    rule: CovarianceUpdate = "seed",
) -> np.ndarray:
    """Covariance Pi of the first state of a window from the fused one of the window before.

    Source: dmhe-pre-estimation (2.29)-(2.30) and E2; with detections dmhe-sporadic-fov 3.8.

    Args:
        fused: Pi_bar (..., n, n) at t-N-1, positive definite.
        A, Q: (n, n), or with the leading axes of Pi_bar.
        information: C' R^-1 C (..., n, n) of instant t-N-1.
        window: information of the N measurements, `window_information`: of instants t-N-1..t-2 for ``seed``, of
            t-N..t-1 for ``exact`` (the same where the outputs are constant).
        rule: ``"seed"``, the printed predictor form (2.30); ``"exact"``, the covariance of x_{t-N} given the prior and
            the measurements t-N-1..t-1.

    Returns:
        (..., n, n).

    Raises:
        NoiseError: a covariance is not positive definite.
        UnknownNameError: an unknown rule.
    """
    if rule == "seed":
        return symmetrized(A @ conditioned(fused, information + window) @ np.swapaxes(A, -1, -2) + Q)
    if rule == "exact":
        return conditioned(predicted(fused, A, Q, information), window)
    raise UnknownNameError("covariance update", rule, get_args(CovarianceUpdate))


def predicted(fused: np.ndarray, A: np.ndarray, Q: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Covariance of the next state after a measurement, ``Q + A (Pi^-1 + M)^-1 A'`` (``onestep`` in the spec below).

    Source: dmhe-sporadic-fov 3.8.

    Args:
        fused: Pi (..., n, n), positive definite.
        A, Q: (n, n), or with the leading axes of Pi.
        information: M = C' R^-1 C (..., n, n).

    Returns:
        (..., n, n).

    Raises:
        NoiseError: a covariance is not positive definite.
    """
    return symmetrized(A @ conditioned(fused, information) @ np.swapaxes(A, -1, -2) + Q)


def detection_update(
    fused: np.ndarray, A: np.ndarray, Q: np.ndarray, informations: np.ndarray, rule: DetectionUpdate = "literal"
) -> np.ndarray:
    """Covariance Pi of x_{t-N} from the fused one of x_{t-N-1}, with what was detected at each instant.

    Source: dmhe-sporadic-fov 3.8.

    Args:
        fused: Pi_bar (..., n, n) at t-N-1, positive definite.
        A, Q: (n, n), or with the leading axes of Pi_bar.
        informations: M_k (N + 1, ..., n, n) of instants t-N-1..t-1.
        rule: ``literal``, the printed (2.29)-(2.30), which uses instant t-N-1 twice; ``exact``, given the readings
            t-N-1..t-1; ``onestep``, given the reading of t-N-1 alone (the filter's covariance).

    Returns:
        (..., n, n).

    Raises:
        NoiseError: a covariance is not positive definite.
        UnknownNameError: an unknown rule.
    """
    if rule == "onestep":
        return predicted(fused, A, Q, informations[0])
    if rule not in get_args(DetectionUpdate):
        raise UnknownNameError("covariance update", rule, get_args(DetectionUpdate))
    literal = rule == "literal"
    window = window_information(informations[:-1] if literal else informations[1:], A, Q)
    return arrival_update(fused, A, Q, informations[0], window, "seed" if literal else "exact")


def centralized_covariances(
    A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike, initial: ArrayLike, steps: int
) -> np.ndarray:
    """Pi of (2.15) from Pi_0 on.

    Args:
        A: (n, n).
        C: (p, n) collective output.
        Q: (n, n).
        R: (p, p).
        initial: Pi_0 (n, n).
        steps: number of steps.

    Returns:
        (steps + 1, n, n), first Pi_0.
    """
    sequence = [np.asarray(initial, dtype=float)]
    for _ in range(steps):
        sequence.append(riccati_step(sequence[-1], A, C, Q, R))
    return np.array(sequence)


@dataclass(frozen=True, eq=False)
class NetworkCovariances:
    """Arrival covariances of all nodes of a network, worked out before any data.

    Attributes:
        local: (m, count, n, n) Pi^i before fusion; entry k belongs to t = N + 1 + k.
        fused: (m + 1, count, n, n) Pi_bar^i; entry 0 is Pi_0, used while t <= N; entry k to t = N + k.
        growth: gamma of spec section 5 item 7; at 1 or above the fused covariances were capped.
        settled: first k from which on the fused covariances are constant; None if they were still changing.
        horizon: N.
    """

    local: np.ndarray
    fused: np.ndarray
    growth: float
    settled: int | None
    horizon: int

    def fused_at(self, time: int) -> np.ndarray:
        """(count, n, n) Pi_bar used at step `time`.

        Raises:
            ShapeError: the sequence neither reaches so far nor has settled.
        """
        entry = max(0, time - self.horizon)
        if entry >= len(self.fused):
            if self.settled is None:
                raise ShapeError(
                    f"covariances were computed up to step {self.horizon + len(self.fused) - 1} and had not settled; "
                    f"step {time} needs more steps"
                )
            entry = -1
        return self.fused[entry]


def network_covariances(
    coefficients: Weights,
    A: ArrayLike,
    Q: ArrayLike,
    outputs: Sequence[ArrayLike],
    noises: Sequence[ArrayLike],
    horizon: int,
    initial: ArrayLike,
    steps: int,
    *,
    rule: CovarianceUpdate = "seed",
    cap: float | None = None,
) -> NetworkCovariances:
    """The whole sequence of arrival covariances of a static network, off-line.

    Source: dmhe-pre-estimation 3.3 steps 1-5, (2.23), 4.1 item 3, section 5 item 7.

    Args:
        coefficients: fusion coefficients, `problems.networks.fusion_coefficients`.
        A: (n, n).
        Q: (n, n) covariance of the disturbance.
        outputs: C^i (p_i, n) of every node; p_i may be 0.
        noises: R^i (p_i, p_i) of every node.
        horizon: N >= 1.
        initial: Pi_0 (n, n), or (count, n, n) one per node.
        steps: most updates to compute; fewer if the sequence settles (relative change below 1e-13).
        rule: see `arrival_update`.
        cap: largest eigenvalue of fused covariances where they grow without bound (gamma >= 1); by default
            1e8 times the trace of Pi_0.

    Returns:
        The sequence.

    Raises:
        ShapeError: shapes do not fit, N < 1.
        NoiseError: Q, Pi_0 or an R^i is not symmetric positive definite.

    Warns:
        ModelWarning: gamma >= 1, the fused covariances are capped.
    """
    network = coefficients.network
    state, disturbance = np.asarray(A, dtype=float), definite("Q", Q)
    if state.shape != disturbance.shape or horizon < 1 or len(outputs) != network.count or len(noises) != network.count:
        raise ShapeError(
            f"expected A and Q of one shape, N >= 1 and one output and noise for each of {network.count} nodes, got "
            f"{state.shape}, {disturbance.shape}, N={horizon}, {len(outputs)} and {len(noises)}"
        )
    start = definite("Pi_0", initial)
    growth = covariance_growth(coefficients, state, outputs)
    bound = _cap(start, cap) if growth >= 1 else None
    if bound is not None:
        warnings.warn(
            f"fused arrival covariances grow without bound (gamma = {growth:.4g} >= 1), their eigenvalues are capped "
            f"at {bound:.3g}; estimates stay usable, only directions without information inflate",
            ModelWarning,
            stacklevel=2,
        )
    information = regional_information(network, outputs, noises)
    window = window_information([information] * horizon, state, disturbance)
    fused = [np.array(np.broadcast_to(start, information.shape))]
    local: list[np.ndarray] = []
    settled = None
    for step in range(steps):
        local.append(arrival_update(fused[-1], state, disturbance, information, window, rule))
        following = symmetrized(coefficients.combine(local[-1]))
        if bound is not None:
            following = capped(following, bound)
        change = np.abs(following - fused[-1]).max(axis=(-1, -2)) / np.abs(following).max(axis=(-1, -2))
        fused.append(following)
        if change.max() <= SETTLED_TOLERANCE:
            settled = step
            break
    shape = (len(local), *information.shape)
    return NetworkCovariances(np.array(local).reshape(shape), np.array(fused), growth, settled, horizon)


def regional_information(network: Network, outputs: Sequence[ArrayLike], noises: Sequence[ArrayLike]) -> np.ndarray:
    """``C_bar^i' (R_bar^i)^-1 C_bar^i`` (count, n, n): the information of a neighbourhood's measurements.

    Raises:
        NoiseError: an R^i is not symmetric positive definite; names the node.
        ShapeError: shapes do not fit.
    """
    own: list[np.ndarray] = []
    for node, (output, noise) in enumerate(zip(outputs, noises, strict=True)):
        try:
            own.append(output_information(output, noise))
        except (NoiseError, ShapeError) as error:
            raise type(error)(f"node {network.names([node])}: {error}") from None
    return Weights(network, np.ones(len(network.senders))).combine(own)


def prior_error_maps(
    fused: ArrayLike,
    A: ArrayLike,
    Q: ArrayLike,
    information: ArrayLike,
    horizon: int,
    observers: ArrayLike | None = None,
) -> np.ndarray:
    """Noise-free, unconstrained maps T from the error of a node's prior to the error of the state it hands on.

    With `problems.networks.convergence_rate` they give the exact rate of a network.

    Source: dmhe-pre-estimation section 5 item 8.

    Args:
        fused: stationary Pi_bar (..., n, n).
        A: (n, n).
        Q: (n, n).
        information: C_bar' R_bar^-1 C_bar (..., n, n), see `regional_information`.
        horizon: N.
        observers: error matrices Phi (..., n, n) of windows with pre-estimation; None for windows that estimate the
            disturbance.

    Returns:
        (..., n, n).
    """
    covariance, state = np.asarray(fused, dtype=float), np.asarray(A, dtype=float)
    disturbance, measured = np.asarray(Q, dtype=float), np.asarray(information, dtype=float)
    identity = np.eye(len(state))
    if observers is None:
        later = window_information([measured] * horizon, state, disturbance)
        whole = window_information([measured] * (horizon + 1), state, disturbance)
        moved = np.linalg.solve(identity + disturbance @ later, np.broadcast_to(state, later.shape))
    else:
        moved = np.asarray(observers, dtype=float)
        whole = measured
        for _ in range(horizon):
            whole = measured + np.swapaxes(moved, -1, -2) @ whole @ moved
    return moved @ np.linalg.inv(identity + covariance @ whole)


def capped(covariances: np.ndarray, bound: float) -> np.ndarray:
    """Covariances (..., n, n) with eigenvalues limited to `bound`; those below it are returned as they are."""
    high = np.trace(covariances, axis1=-2, axis2=-1) > bound
    if not high.any():
        return covariances
    values, vectors = np.linalg.eigh(covariances[high])
    result = covariances.copy()
    result[high] = symmetrized((vectors * np.minimum(values, bound)[..., None, :]) @ np.swapaxes(vectors, -1, -2))
    return result


def definite(name: str, matrix: ArrayLike) -> np.ndarray:
    """The matrix (..., n, n) as floats, checked to be symmetric positive definite.

    Raises:
        NoiseError: it is not; `name` says which.
        ShapeError: it is not square.
    """
    array = np.asarray(matrix, dtype=float)
    if array.ndim < 2 or array.shape[-1] != array.shape[-2]:
        raise ShapeError(f"{name} is a square matrix, got shape {array.shape}")
    if not np.allclose(array, np.swapaxes(array, -1, -2), rtol=1e-9, atol=0):
        raise NoiseError(f"{name} is not symmetric")
    if not np.isfinite(array).all() or np.linalg.eigvalsh(array).min() <= 0:
        raise NoiseError(f"{name} is not positive definite; give a covariance with positive eigenvalues")
    return array


def _cap(initial: np.ndarray, cap: float | None) -> float:
    return CAP_FACTOR * float(np.trace(initial, axis1=-2, axis2=-1).max()) if cap is None else cap
