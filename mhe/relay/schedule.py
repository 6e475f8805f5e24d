"""Arrival weights of all nodes before any data: the recursion (3.12), (3.15), (3.16) on arrays of nodes.

Source: dmhe-l-step, Models and equations, start-up option, errata 6-8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mhe.covariance import symmetrized
from mhe.relay.options import RelayOptions
from problems.networks import Weights

SETTLED = 1e-10  # relative change of every arrival weight at which the sequence ends


def arrival_weight(
    omega: np.ndarray, transition: np.ndarray | None, inverse_S: np.ndarray, factor: float
) -> np.ndarray:
    """P of (3.16) from Omega: ``factor (Phi Omega^-1 Phi' + S^-1)^-1``.

    Args:
        omega: (..., n, n) information about the first state of the window before, all its data included.
        transition: Phi (..., n, n) to the first state of this window; None where that is the same instant.
        inverse_S: S^-1 (n, n).
        factor: alpha over the divisor.

    Returns:
        (..., n, n), symmetric positive definite.
    """
    covariance = np.linalg.inv(omega)
    if transition is not None:
        covariance = transition @ covariance @ np.swapaxes(transition, -1, -2)
    return factor * symmetrized(np.linalg.inv(symmetrized(covariance) + inverse_S))


@dataclass(frozen=True, eq=False)
class RelaySchedule:
    """Information matrices of the arrival costs of all nodes; entry t is used at time t, the last one from then on.

    Attributes:
        local: (k, count, n, n) P^i before fusion.
        fused: (k, count, n, n) Xi^i (3.12).
        settled: first t from which on nothing changes any more; None if it still changed at the end.
    """

    local: np.ndarray
    fused: np.ndarray
    settled: int | None

    def at(self, instant: int) -> int:
        """Which entry is used at time t."""
        return min(instant, len(self.fused) - 1)


def relay_schedule(
    weights: Weights,
    prior: np.ndarray,
    options: RelayOptions,
    data: np.ndarray,
    own: np.ndarray | None,
    transitions: np.ndarray,
    inverse_S: np.ndarray,
    updates: int,
) -> RelaySchedule:
    """The sequence until it stops changing (relative 1e-10) or for some instants.

    Args:
        weights: pi.
        prior: P_0 (n, n).
        options: of the method.
        data: (N + 1, count, n, n), entry m: what the windows of m transitions tell about their first states.
        own: (count, n, n) F' Psi F of (3.15), or None with ``omega="hessian"``, where a full window of `data` counts.
        transitions: (count, n, n) A_L of (3.16), or Phi_0.
        inverse_S: S^-1 (n, n).
        updates: instants at most, beyond those in which windows fill.
    """
    horizon, factor = options.horizon, options.alpha / options.arrival_divisor
    start = np.broadcast_to(prior, transitions.shape)
    local, fused = [start], [weights.combine(start)]
    settled = None
    for instant in range(1, horizon + 1 + updates):
        if instant > horizon:
            omega = fused[-1] + (data[horizon] if own is None else own)
            local.append(arrival_weight(omega, transitions, inverse_S, factor))
        elif instant == 1 or options.startup == "literal":
            local.append(local[0])
            fused.append(fused[0])
            continue
        else:
            local.append(arrival_weight(fused[-1] + data[instant - 1], None, inverse_S, factor))
        fused.append(weights.combine(local[-1]))
        if instant > horizon + 1 and max(_change(*local[-2:]), _change(*fused[-2:])) <= SETTLED:
            settled = instant
            break
    return RelaySchedule(np.array(local), np.array(fused), settled)


def _change(before: np.ndarray, after: np.ndarray) -> float:
    """Largest relative change of a node's matrix."""
    return float((np.abs(after - before).max(axis=(-2, -1)) / np.abs(after).max(axis=(-2, -1))).max())
