"""What one node of an estimator with detections is told before a run, and nothing else."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from mhe.polyhedron import Polyhedron
from mhe.sporadic.blocks import Blocks
from mhe.sporadic.options import SporadicOptions
from mhe.sporadic.window import WindowShape


@dataclass(frozen=True, eq=False)
class SporadicPlan:
    """Off-line knowledge of one node.

    Attributes:
        index, label: of the node.
        members: its in-neighbourhood, itself included, ascending.
        member_sensors: sensors of each member among those of the region.
        names, sizes: of the sensors of the region.
        width: components of the largest sensor of the network.
        blocks: parts of the model; all matrices below are by part.
        transition, disturbance: A and G Q G' (parts, m, m).
        noise_gain, noise: G (parts, m, q) and Q (parts, q, q).
        mean, start: mu_0 (parts, m) and Pi_0 (parts, m, m).
        parts: part that each sensor of the region sees.
        outputs, precisions: C (p, m) on that part and R^-1 (p, p) of each sensor.
        gains: L (m, p) of each sensor of the region on its part, None where it does not feed the observer; None with
            process noise.
        sets: convex set of the output of each sensor, None where the node has none.
        pieces: convex pieces of that set, for sensors where they count; else empty.
        unseen_pieces: convex pieces of where a vehicle is that nobody of the region sees; empty where they do
            not count.
        row_sensors: (parts, sets) sensors that make rows on a part, -1 for none.
        shape: sizes of the window.
        weights: (members,) row of K; None where it follows the detections.
        listeners: (members,) factor of k_ij^2 in (2.23), or None for (4.11).
        state_names: n names.
        options: of the method.
        period: time between steps.
    """

    index: int
    label: Hashable
    members: tuple[int, ...]
    member_sensors: tuple[slice, ...]
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    width: int
    blocks: Blocks
    transition: np.ndarray
    disturbance: np.ndarray
    noise_gain: np.ndarray
    noise: np.ndarray
    mean: np.ndarray
    start: np.ndarray
    parts: np.ndarray
    outputs: tuple[np.ndarray, ...]
    precisions: tuple[np.ndarray, ...]
    gains: tuple[np.ndarray | None, ...] | None
    sets: tuple[Polyhedron | None, ...]
    pieces: tuple[tuple[Polyhedron, ...], ...]
    unseen_pieces: tuple[Polyhedron, ...]
    row_sensors: np.ndarray
    shape: WindowShape
    weights: np.ndarray | None
    listeners: np.ndarray | None
    state_names: tuple[str, ...]
    options: SporadicOptions
    period: float

    @property
    def own(self) -> int:
        """Place of the node among its members."""
        return self.members.index(self.index)
