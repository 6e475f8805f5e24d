"""`NetworkDesign`: everything of a distributed estimator that is settled before the first measurement.

Source: dmhe-pre-estimation 4.1 and section 5.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from mhe.covariance import CAP_FACTOR, NetworkCovariances, network_covariances, prior_error_maps, regional_information
from mhe.distributed import checks
from mhe.distributed.options import DistributedOptions, options_of
from mhe.distributed.plan import ArrivalSchedule, NodePlan
from mhe.distributed.pool import WindowPool
from mhe.observers import ObserverGain, given_gain, stationary_gain
from mhe.placement import Placement
from mhe.polyhedron import Polyhedron
from mhe.window import prefers_quadratic
from problems.errors import DefinitionError, ModelWarning, SettingError, ShapeError
from problems.models import LinearModel, Model
from problems.networks import (
    Network,
    ObservabilityReport,
    Weights,
    consensus_reach,
    convergence_rate,
    covariance_growth,
    fusion_coefficients,
    given_weights,
    metropolis_weights,
    mixed_weights,
    rank_weights,
    regional_ranks,
    uniform_weights,
)

LONGEST_SCHEDULE = 1000  # updates worked out for a run of unknown length; what has not settled by then stays as it is


class NetworkDesign:
    """Model, network and options of a distributed estimator, checked, with weights, gains and covariances.

    Args:
        model: linear, with a prior and the sensors of all nodes.
        network: who hears whom.
        method: ``dmhe_f``, ``dmhe_pre``, ``dmhe_w_pre``, or options.
        placement: label of the node that each sensor of the model belongs to; by default sensor k belongs to node k. A
            node may have several sensors or none.
        weight_matrix: (count, count) K for the weights ``given``, or the reference ``given`` of ``mixed``.
        gains: one L^i (n, p_bar) or `ObserverGain` per node, its columns the sensors of the in-neighbourhood in
            ascending order of the nodes; by default stationary Kalman gains, for undetectable nodes those of the
            smallest reachable spectral radius.
        state_bounds, disturbance_bounds: X and W.
        require_sound: refuse a network that does not observe the model and gains that let errors grow; if False, warn.
        pool: compiled windows to share with other designs.
        overrides: options by name, see `DistributedOptions`.

    Raises:
        UnknownNameError, SettingError, ShapeError, DefinitionError: about the arguments.
        TopologyError: weights that do not fit the graph.
        UnobservableError, UnstableError: see `require_sound`.
        NoiseError: the covariance G Q G' of the disturbance is singular.

    Warns:
        ModelWarning: see `mhe.distributed.checks`.

    Attributes:
        options: of the method.
        regional: the model with the sensors of each in-neighbourhood.
        own_rows, regional_rows: rows of the collective measurement that belong to each node, and to its region.
        weights, coefficients: k_ij, and c_ij of the fused covariance.
        gains: an `ObserverGain` per node, or None with process noise.
        observability: what the nodes observe; None where all together do not observe the model.
        reach, growth: phi and gamma of section 5.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | DistributedOptions = "dmhe_f",
        *,
        placement: Sequence[Hashable] | None = None,
        weight_matrix: Any = None,
        gains: Sequence[Any] | None = None,
        state_bounds: Polyhedron | None = None,
        disturbance_bounds: Polyhedron | None = None,
        require_sound: bool = True,
        pool: WindowPool | None = None,
        **overrides: Any,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise DefinitionError(f"distributed estimators need a LinearModel, got {model!r}")
        model.prior()
        self.options = options = options_of(method, **overrides)
        self.model, self.network = model, network
        self.state_bounds, self.disturbance_bounds = state_bounds, disturbance_bounds
        self.pool = WindowPool() if pool is None else pool
        if disturbance_bounds is not None:
            disturbance_bounds.warn_without_origin("disturbance bounds")
        self.placement = Placement(model, network, placement)
        self.own_rows = self.placement.rows
        regions = [network.in_neighborhood(node) for node in range(network.count)]
        self.regional_rows = tuple(np.concatenate([self.own_rows[j] for j in region]) for region in regions)
        self.regional = tuple(self.placement.seen_by(region) for region in regions)
        self.outputs = [model.C[rows] for rows in self.own_rows]
        self.noises = [model.R[np.ix_(rows, rows)] for rows in self.own_rows]
        self.observability: ObservabilityReport | None = checks.checked_observability(
            network, model.A, self.outputs, require_sound=require_sound
        )
        self.weights = self._weights(weight_matrix)
        self.coefficients = fusion_coefficients(self.weights, options.weight_fusion)
        self.gains = self._gains(gains)
        if self.observability is not None:
            checks.check_horizon(options.horizon, self.observability, network)
        if self.gains is not None:
            checks.check_gains(self.gains, options.horizon, network, require_sound=require_sound)
        self.reach = consensus_reach(self.weights, model.A, self.outputs)
        self.growth = covariance_growth(self.coefficients, model.A, self.outputs)
        self.cap = CAP_FACTOR * float(np.trace(model.prior()[1]))
        checks.check_reach(self.reach)
        checks.check_growth(self.growth, self.cap)
        if self.growth >= 1 and self.gains is None and options.form is None and prefers_quadratic(options.solver):
            # F2 loses the digits of arrival costs that weigh next to nothing beside the disturbances
            self.options = replace(options, form="F3")
        self._covariances: tuple[int, NetworkCovariances] | None = None

    def _weights(self, matrix: Any) -> Weights:
        options, network = self.options, self.network
        uses = options.weights == "given" or (options.weights == "mixed" and options.reference == "given")
        if uses != (matrix is not None):
            raise SettingError(
                "weights 'given' need weight_matrix=, a (count, count) matrix K"
                if uses
                else f"weight_matrix= was given, but the weights are {options.weights!r}; set weights='given'"
            )
        if options.weights in ("rank", "mixed"):
            ranks = regional_ranks(network, self.model.A, self.outputs, options.horizon)
            by_rank = rank_weights(network, ranks)
            if options.weights == "rank":
                return by_rank
            return mixed_weights(by_rank, self._plain(options.reference, matrix), options.share)
        return self._plain(options.weights, matrix)

    def _plain(self, rule: str, matrix: Any) -> Weights:
        if rule == "given":
            return given_weights(self.network, matrix)
        return uniform_weights(self.network) if rule == "uniform" else metropolis_weights(self.network)

    def _gains(self, gains: Sequence[Any] | None) -> tuple[ObserverGain, ...] | None:
        if self.options.disturbance == "process_noise":
            if gains is not None:
                raise SettingError(
                    "gains were given, but the method estimates disturbances; set disturbance='observer'"
                )
            return None
        if gains is None:
            return tuple(stationary_gain(one.A, one.C, one.process_covariance, one.R) for one in self.regional)
        if len(gains) != self.network.count:
            raise ShapeError(f"expected one gain per node ({self.network.count}), got {len(gains)}")
        found = []
        for node, gain in enumerate(gains):
            region = self.regional[node]
            try:
                found.append(gain if isinstance(gain, ObserverGain) else given_gain(region.A, region.C, gain))
            except ShapeError as error:
                raise ShapeError(f"node {self.network.names([node])}: {error}") from None
            if found[-1].gain.shape != region.C.shape[::-1]:
                raise ShapeError(
                    f"node {self.network.names([node])}: expected a gain of shape {region.C.shape[::-1]}, got "
                    f"{found[-1].gain.shape}"
                )
        return tuple(found)

    def covariances(self, updates: int = LONGEST_SCHEDULE) -> NetworkCovariances:
        """Arrival covariances of all nodes, off-line (4.1 item 3).

        Args:
            updates: how many; fewer if the sequence settles before.
        """
        known = self._covariances
        if known is None or (known[1].settled is None and known[0] < updates):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ModelWarning)  # gamma was reported when the design was made
                found = network_covariances(
                    self.coefficients,
                    self.model.A,
                    self.model.process_covariance,
                    self.outputs,
                    self.noises,
                    self.options.horizon,
                    self.model.prior()[1],
                    updates,
                    rule=self.options.pi_update,
                    cap=self.cap,
                )
            self._covariances = known = updates, found
        return known[1]

    def convergence_rate(self) -> float:
        """Factor by which errors shrink per step in the long run, without noise and bounds (section 5 item 8)."""
        observers = None if self.gains is None else np.array([gain.error_matrix for gain in self.gains])
        maps = prior_error_maps(
            self.covariances().fused[-1],
            self.model.A,
            self.model.process_covariance,
            regional_information(self.network, self.outputs, self.noises),
            self.options.horizon,
            observers,
        )
        return convergence_rate(self.weights, maps)

    @cached_property
    def plans(self) -> tuple[NodePlan, ...]:
        """What every node is told."""
        known = self.covariances() if self.options.covariances == "offline" else None
        return tuple(self._plan(node, known) for node in range(self.network.count))

    def _plan(self, node: int, known: NetworkCovariances | None) -> NodePlan:
        members = self.network.in_neighborhood(node)
        ends = np.cumsum([0, *(self.own_rows[j].size for j in members)]).tolist()
        schedule = None
        if known is not None:
            schedule = ArrivalSchedule(known.fused[:, node].copy(), known.local[:, members].copy(), known.horizon)
        return NodePlan(
            index=node,
            label=self.network.labels[node],
            members=tuple(members.tolist()),
            member_rows=tuple(slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)),
            model=self.regional[node],
            gain=None if self.gains is None else self.gains[node].gain,
            weights=self.weights.row(node).copy(),
            coefficients=self.coefficients.row(node).copy(),
            power=1 if self.options.weight_fusion == "convex" else 2,
            options=self.options,
            state_bounds=self.state_bounds,
            disturbance_bounds=self.disturbance_bounds,
            schedule=schedule,
            cap=self.cap if self.growth >= 1 else None,
            period=self.model.dt or 1.0,
        )

    def by_node(self, measurements: Any) -> list[Any]:
        """One entry per node from what `step` was given, see `Placement.by_node`."""
        return self.placement.by_node(measurements)
