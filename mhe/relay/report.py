"""Conditions of the source on model, network and gains: a report, errors and warnings that name the nodes.

Source: dmhe-l-step, Assumptions and conditions to CHECK.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from problems.errors import ModelWarning, UnobservableError, UnstableError
from problems.networks import regional_outputs, unobservable_eigenvalues
from problems.networks.observability import EIGENVALUE_TOLERANCE, stacked_outputs

if TYPE_CHECKING:
    from mhe.relay.design import RelayDesign


@dataclass(frozen=True, eq=False)
class RelayReport:
    """What the nodes of an l-step design observe.

    Attributes:
        inactive: (count,) bool, no sensor.
        locally_undetectable: (count,) bool, (A, C^i).
        regionally_undetectable: (count,) bool, A with the outputs of the node and its direct neighbours (Definition
            3.3).
        rank: (count,) of the information in a full window; n if it determines the state without a prior.
        own_radius: (count,) spectral radius of A - L^i C^i (of A where disturbances are estimated).
        radius: (count, l) spectral radii of Phi_s for what is within 1..l hops.
        prior_deviations: (n,) prior standard deviations of x_0, in the units of the state (metres for positions).
    """

    inactive: np.ndarray
    locally_undetectable: np.ndarray
    regionally_undetectable: np.ndarray
    rank: np.ndarray
    own_radius: np.ndarray
    radius: np.ndarray
    prior_deviations: np.ndarray


def relay_report(design: RelayDesign, *, require_sound: bool = True) -> RelayReport:
    """Check the conditions and say what was found.

    Args:
        design: with its local problems made.
        require_sound: raise where a condition is broken; if False, warn.

    Raises:
        UnobservableError: all sensors together leave an eigenvalue of modulus 1 or more unobserved.
        UnstableError: an own gain that lets errors grow although (A, C^i) is detectable.

    Warns:
        ModelWarning: everything together is detectable but not observable; a gain of sources that observe everything
            lets errors grow within the window (errata 4).
    """
    A, outputs = design.model.A, design.own_outputs
    _check_together(A, design.model.C, require_sound)
    local_hidden = unobservable_eigenvalues(A, stacked_outputs(design.network, outputs))
    regional_hidden = unobservable_eigenvalues(A, regional_outputs(design.network, outputs))
    transitions = np.array([design.own(node).transition for node in range(design.network.count)])
    report = RelayReport(
        inactive=np.array([rows.size == 0 for rows in design.own_rows]),
        locally_undetectable=_grows(local_hidden),
        regionally_undetectable=_grows(regional_hidden),
        rank=np.array([problem.rank for problem in design.problems])[design.problem],
        own_radius=np.abs(np.linalg.eigvals(transitions)).max(axis=1),
        radius=np.array([problem.radii for problem in design.problems])[design.problem],
        prior_deviations=np.sqrt(np.diagonal(np.linalg.inv(design.information))),
    )
    if design.options.disturbance == "observer":
        _check_gains(design, report, require_sound)
    return report


def _check_together(A: np.ndarray, C: np.ndarray, require_sound: bool) -> None:
    hidden = unobservable_eigenvalues(A, C)
    hidden = hidden[~np.isnan(hidden)]
    if not hidden.size:
        return
    text = f"all sensors together leave eigenvalues {np.round(hidden, 6).tolist()} of A unobserved"
    if require_sound and (np.abs(hidden) >= 1 - EIGENVALUE_TOLERANCE).any():
        raise UnobservableError(f"{text}; add a sensor that sees them")
    warnings.warn(f"{text}; errors there decay only as the model itself lets them", ModelWarning, stacklevel=4)


def _check_gains(design: RelayDesign, report: RelayReport, require_sound: bool) -> None:
    network = design.network
    growing = np.flatnonzero((report.own_radius >= 1) & ~report.locally_undetectable)
    if growing.size:
        text = (
            f"the own gains of nodes {network.names(growing)} have spectral radius "
            f"{report.own_radius[growing].max():.6g}, although their sensors detect everything; choose eigenvalues "
            "inside the unit circle"
        )
        if require_sound:
            raise UnstableError(text)
        warnings.warn(text, ModelWarning, stacklevel=4)
    needless = np.array([(p.radii >= 1).any() and p.observes(design.options.steps) for p in design.problems])
    worse = np.flatnonzero(needless[design.problem] & ((report.radius >= 1) & _seeing(design)).any(axis=1))
    if worse.size:
        warnings.warn(
            f"gains {design.options.gains!r}: errors grow within the windows of nodes {network.names(worse)} (spectral "
            f"radius of Phi up to {report.radius[worse].max():.3g}, condition of H up to "
            f"{design.condition()[worse].max():.2g}); use gains 'joint' or 'mean'",
            ModelWarning,
            stacklevel=4,
        )


def _seeing(design: RelayDesign) -> np.ndarray:
    """(count, l) bool: whether the sources within 1..l hops observe everything."""
    steps = range(1, design.options.steps + 1)
    return np.array([[problem.observes(near) for near in steps] for problem in design.problems])[design.problem]


def _grows(hidden: np.ndarray) -> np.ndarray:
    # the NaN that fill up the rows compare as false
    return np.asarray((np.abs(hidden) >= 1 - EIGENVALUE_TOLERANCE).any(axis=-1))
