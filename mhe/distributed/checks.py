"""Conditions of dmhe-pre-estimation section 5 on a network, as errors and warnings that name node and matrix."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from mhe.observers import ObserverGain, check_gain
from problems.errors import ModelWarning, UnobservableError
from problems.networks import Network, ObservabilityReport, observability_report

FORGETTING = 0.2  # rho(Phi)^N below which the first state of a window hardly reaches its last one


def checked_observability(
    network: Network, A: np.ndarray, outputs: Sequence[np.ndarray], *, require_sound: bool
) -> ObservabilityReport | None:
    """Report on what the nodes observe (item 3).

    Raises:
        UnobservableError: all sensors together do not observe the system; without `require_sound` a warning, and None.
    """
    try:
        return observability_report(network, A, outputs)
    except UnobservableError as error:
        if require_sound:
            raise
        warnings.warn(str(error), ModelWarning, stacklevel=3)
        return None


def check_horizon(horizon: int, report: ObservabilityReport, network: Network) -> None:
    """Warns with `ModelWarning` where N is below a node's observability index (item 5)."""
    short = np.flatnonzero(report.index > horizon)
    if short.size:
        warnings.warn(
            f"horizon N={horizon} is below the observability index {int(report.index[short].max())} of nodes "
            f"{network.names(short)}; their windows observe less than longer ones would, and rank weights count less",
            ModelWarning,
            stacklevel=3,
        )


def check_gains(gains: Sequence[ObserverGain], horizon: int, network: Network, *, require_sound: bool) -> None:
    """Gains of all nodes (items 4 and 5).

    Raises:
        UnstableError: a node that observes everything has rho(Phi) >= 1; without `require_sound` a warning.

    Warns:
        ModelWarning: a node's rho(Phi) exceeds the smallest reachable one; or rho(Phi)^N is so small that its window
            is little more than the observer alone.
    """
    for node, gain in enumerate(gains):
        check_gain(gain, node=network.labels[node], allow_unstable=not require_sound)
    forgetful = [node for node, gain in enumerate(gains) if gain.spectral_radius**horizon < FORGETTING]
    if forgetful:
        radius = max(gains[node].spectral_radius for node in forgetful)
        warnings.warn(
            f"horizon N={horizon} is long for the observers of nodes {network.names(forgetful)}: rho(Phi)^N is "
            f"{radius**horizon:.2g} or less, so their estimates are little more than those of the observers alone; "
            "choose a shorter horizon or slower eigenvalues",
            ModelWarning,
            stacklevel=3,
        )


def check_reach(reach: float) -> None:
    """Warns with `ModelWarning` where errors grow that no node's data can stop, phi >= 1 (item 6)."""
    if reach >= 1:
        warnings.warn(
            f"consensus does not reach what the nodes cannot observe (phi = {reach:.4g} >= 1): errors grow there; "
            "choose other weights or add links",
            ModelWarning,
            stacklevel=3,
        )


def check_growth(growth: float, cap: float) -> None:
    """Warns with `ModelWarning` where fused covariances grow without bound, gamma >= 1 (item 7)."""
    if growth >= 1:
        warnings.warn(
            f"fused arrival covariances grow without bound (gamma = {growth:.4g} >= 1), their eigenvalues are capped "
            f"at {cap:.3g}; estimates stay usable, only directions without information inflate",
            ModelWarning,
            stacklevel=3,
        )
