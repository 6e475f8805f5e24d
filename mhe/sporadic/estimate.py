"""What a node with detections reports after a step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mhe.estimate import Estimate


@dataclass(frozen=True, eq=False, repr=False)
class DetectionEstimate(Estimate):
    """An `Estimate` and what made it; `covariance` is None and ``infeasible`` names the sensors whose rows are not met.

    Attributes:
        detected: (own sensors,) flags of this instant; the node is active where any is 1.
        rank: rho_O of its neighbourhood; None without rank weights.
        weights: (members,) consensus weights used, zero for neighbours that were left out; None where none were needed.
        arrival_covariance: (parts, m, m) Pi_bar of the first state of the window, by part of the model (vehicle).
        unseen: (parts,) steps since anyone of the neighbourhood detected the part (a vehicle), counted from the first
            step where nobody did.
        outside: (own sensors,) how far the reading lies outside the sensor's set, 0 where it is inside or missing.
        too_late: readings that came after their instant had left the window; they were not used.
    """

    detected: np.ndarray
    rank: int | None
    weights: np.ndarray | None
    arrival_covariance: np.ndarray
    unseen: np.ndarray
    outside: np.ndarray
    too_late: int
