"""What one node of an l-step neighbourhood is told before a run (dmhe-l-step, Algorithms, off-line), nothing else."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mhe.polyhedron import Polyhedron
from mhe.relay.options import RelayOptions
from problems.models import LinearModel

if TYPE_CHECKING:
    from mhe.relay.design import RelayDesign


@dataclass(frozen=True, eq=False)
class RelayPlan:
    """Off-line knowledge of one node.

    Attributes:
        index, label: of the node.
        members: direct in-neighbours and the node itself, ascending.
        weights: (m,) row of pi.
        member_sizes: (m,) components that each of them measures.
        sources: nodes within l hops that have sensors, in the order of the regional measurement.
        source_rows: rows of the regional measurement of each source.
        model: with the sensors of the sources.
        mean: xhat_0 (n,).
        prior: P_0 (n, n).
        own_output, own_gain: C^i (p_i, n) and L^i (n, p_i).
        gain: (N, n, p) of the transitions of a full window; zeros where disturbances are estimated.
        held: (N + 1, p) bool, what is held of a full window if nothing is lost.
        prediction: (n, n) A_L^i, or Phi_0 with ``omega="hessian"``.
        data: (N + 1, n, n) information in windows of 0..N transitions.
        omega: (n, n) information that (3.15) adds.
        inverse_S: (n, n).
        local: (k, m, n, n) P^j of the members, entry t at time t; None if weights are exchanged.
        fused: (k, n, n) Xi^i; None if weights are exchanged.
        options: of the method.
        state_bounds: X, or None.
        residual_bounds: V by name of the model's sensors.
        period: time between steps.
    """

    index: int
    label: Hashable
    members: tuple[int, ...]
    weights: np.ndarray
    member_sizes: tuple[int, ...]
    sources: tuple[int, ...]
    source_rows: tuple[slice, ...]
    model: LinearModel
    mean: np.ndarray
    prior: np.ndarray
    own_output: np.ndarray
    own_gain: np.ndarray
    gain: np.ndarray
    held: np.ndarray
    prediction: np.ndarray
    data: np.ndarray
    omega: np.ndarray
    inverse_S: np.ndarray
    local: np.ndarray | None
    fused: np.ndarray | None
    options: RelayOptions
    state_bounds: Polyhedron | None
    residual_bounds: Mapping[str, Polyhedron]
    period: float

    def gain_at(self, phase: int) -> np.ndarray:
        """(N, n, p) gains of a window of `phase` transitions: they depend on the age of the instant left."""
        if phase == len(self.gain):
            return self.gain
        result = np.zeros_like(self.gain)
        result[:phase] = self.gain[len(self.gain) - phase :]
        return result


def plan_of(design: RelayDesign, node: int) -> RelayPlan:
    """What `node` needs of a design."""
    network, options, problem = design.network, design.options, design.local(node)
    members = network.in_neighborhood(node)
    sources = design.sources[node]
    ends = np.cumsum([0, *(design.own_rows[j].size for j in sources)]).tolist()
    model = design.regional[node]
    local = fused = None
    if options.exchange == "offline":
        schedule = design.schedule()
        local, fused = schedule.local[:, members], schedule.fused[:, node]
    own = design.own(node)
    seed = options.omega == "seed"
    names = [sensor.name for sensor in model.sensors]
    return RelayPlan(
        index=node,
        label=network.labels[node],
        members=tuple(members.tolist()),
        weights=design.weights.row(node).copy(),
        member_sizes=tuple(design.own_rows[j].size for j in members),
        sources=tuple(sources.tolist()),
        source_rows=tuple(slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)),
        model=model,
        mean=design.mean,
        prior=design.information,
        own_output=own.C,
        own_gain=own.gain,
        gain=problem.gains(options.horizon),
        held=problem.held(options.horizon),
        prediction=design.prediction_maps[node],
        data=problem.data_information,
        omega=design.own_information[node] if seed else problem.data_information[-1],
        inverse_S=design.inverse_S,
        local=local,
        fused=fused,
        options=options,
        state_bounds=design.state_bounds,
        residual_bounds={name: design.residual_bounds[name] for name in names if name in design.residual_bounds},
        period=design.model.dt or 1.0,
    )
