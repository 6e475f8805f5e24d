"""What one node is told before a run (dmhe-pre-estimation 4.1), and nothing else."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from mhe.distributed.options import DistributedOptions
from mhe.polyhedron import Polyhedron
from problems.models import LinearModel


@dataclass(frozen=True, eq=False)
class ArrivalSchedule:
    """Arrival covariances of one node worked out before the run.

    Attributes:
        fused: (k + 1, n, n) Pi_bar; entry 0 up to t = N, entry e at t = N + e, the last one from then on.
        local: (k, m, n, n) Pi^j of its in-neighbourhood before fusion; entry e at t = N + 1 + e.
        horizon: N.
    """

    fused: np.ndarray
    local: np.ndarray
    horizon: int

    def local_at(self, instant: int) -> np.ndarray:
        """(m, n, n) Pi^j behind it, for ``instant > N``."""
        return self.local[min(max(0, instant - self.horizon - 1), len(self.local) - 1)]

    def entry(self, instant: int) -> int:
        """Which entry of `fused` is used at step `instant`."""
        return min(max(0, instant - self.horizon), len(self.fused) - 1)


@dataclass(frozen=True, eq=False)
class NodePlan:
    """Off-line knowledge of one node.

    Attributes:
        index, label: of the node.
        members: its in-neighbourhood, itself included, ascending.
        member_rows: rows of the regional measurement of each member.
        model: with the sensors of the region; the prior is mu_0, Pi_0.
        gain: L^i (n, p_bar) or None.
        weights: (m,) row of K.
        coefficients: (m,) c_ij of the fused covariance ``sum c_ij Pi^j``.
        power: of k_ij in c_ij, 2 or 1.
        options: of the method.
        schedule: covariances worked out before the run; None if they are exchanged.
        cap: largest eigenvalue of fused covariances, or None.
        period: time between steps.
    """

    index: int
    label: Hashable
    members: tuple[int, ...]
    member_rows: tuple[slice, ...]
    model: LinearModel
    gain: np.ndarray | None
    weights: np.ndarray
    coefficients: np.ndarray
    power: int
    options: DistributedOptions
    state_bounds: Polyhedron | None
    disturbance_bounds: Polyhedron | None
    schedule: ArrivalSchedule | None
    cap: float | None
    period: float

    @property
    def own(self) -> int:
        """Place of the node among its members."""
        return self.members.index(self.index)
