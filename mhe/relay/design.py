"""`RelayDesign`: everything of an l-step neighbourhood estimator that is settled before the first measurement.

Nothing here is dense in the number of nodes, so that ten thousand are possible; nodes with equal local problems share
one `LocalProblem`.

Source: dmhe-l-step, Algorithms (off-line), Assumptions and conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from mhe.covariance import definite, window_information
from mhe.observers import ObserverGain, stationary_gain
from mhe.placement import Placement
from mhe.polyhedron import Polyhedron
from mhe.relay.local import GainTable, LocalProblem, Output
from mhe.relay.options import RelayOptions, relay_options_of
from mhe.relay.prior import prior_information
from mhe.relay.report import RelayReport, relay_report
from mhe.relay.schedule import RelaySchedule, relay_schedule
from mhe.window import prefers_quadratic
from problems.errors import DefinitionError, SettingError, ShapeError, TopologyError
from problems.models import LinearModel, Model
from problems.networks import Network, Weights, given_weights, metropolis_weights, uniform_weights

LONGEST_SCHEDULE = 1000  # updates worked out for a run of unknown length; what has not settled by then stays as it is
ROW_SUM_TOLERANCE = 1e-12

T = TypeVar("T")


class PerNode(Sequence[T], Generic[T]):
    """One item per node, made when it is first asked for."""

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._count, self._make = count, make
        self._made: dict[int, T] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, node: Any) -> Any:
        index = range(self._count)[node]
        if index not in self._made:
            self._made[index] = self._make(index)
        return self._made[index]

    def __iter__(self) -> Iterator[T]:
        return (self[node] for node in range(self._count))


class RelayDesign:
    """Model, network and options of an l-step neighbourhood estimator, checked, with gains and arrival weights.

    A *source* of a node is a member of its l-step neighbourhood that has a sensor. Sources are sorted by hops, then by
    what they measure, then by index: nodes that see equal sensors at equal distances have equal regional models,
    gains and windows, `problem`.

    Args:
        model: linear, with the sensors of all nodes; its mean is xhat_0, its covariance the prior unless `cov` or
            `info` says it.
        network: who hears whom.
        method: ``dmhe_l_pre``, ``dmhe_1_pre``, ``dmhe_b``, or options.
        placement: label of the node that each sensor of the model belongs to; by default sensor k belongs to node k. A
            node may have several sensors or none.
        cov: prior covariance of x_0 (n, n).
        info: instead, its inverse P_0.
        weight_matrix: (count, count) pi for the weights ``given``.
        own_gains: L^i (n, p_i) or `ObserverGain` of every node with a sensor; by default stationary Kalman gains. They
            give the predictions (3.9), the weights (3.15) and the gains ``mean`` and ``sum``.
        state_bounds: X.
        residual_bounds: V, of every sensor or by sensor name.
        require_sound: refuse networks and gains that do not meet the conditions of the source; if False, warn.
        overrides: options by name, see `RelayOptions`.

    Raises:
        UnknownNameError, SettingError, ShapeError, DefinitionError, NoiseError: about the arguments.
        TopologyError: a graph that is not strongly connected, or weights that do not fit it.
        UnobservableError: all sensors together do not detect the state.
        UnstableError: an own gain that lets errors grow which its sensors detect.

    Warns:
        ModelWarning: conditions met in part, see `mhe.relay.report`.

    Attributes:
        options: of the method.
        mean, information: xhat_0 (n,) and P_0 (n, n).
        inverse_S: (n, n).
        weights: pi, row-stochastic.
        own_rows: (count) rows of the collective measurement that belong to each node.
        members, hops: (count) nodes within l hops, the node itself included, ascending, and their distances.
        sources, source_hops: (count) those with sensors, in the order of the regional measurement, and their distances.
        regional_rows: (count) rows of the collective measurement that the sources have.
        regional: (count) the model with the sensors of the sources.
        problem: (count,) number of each node's local problem in `problems`.
        problems: the different local problems.
        report: what the nodes and the network can observe.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | RelayOptions = "dmhe_l_pre",
        *,
        placement: Sequence[Hashable] | None = None,
        cov: Any = None,
        info: Any = None,
        weight_matrix: Any = None,
        own_gains: Sequence[Any] | None = None,
        state_bounds: Polyhedron | None = None,
        residual_bounds: Polyhedron | Mapping[str, Polyhedron] | None = None,
        require_sound: bool = True,
        **overrides: Any,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise DefinitionError(f"distributed estimators need a LinearModel, got {model!r}")
        self.options = options = relay_options_of(method, **overrides)
        estimated = options.disturbance == "process_noise"
        if estimated and options.form is None and prefers_quadratic(options.solver):
            # F2 loses digits where arrival costs weigh next to nothing, as those of nodes far from all sensors do
            self.options = replace(options, form="F3")
        self.model, self.network = model, network
        self.state_bounds = state_bounds
        self.residual_bounds = residual_bounds_of(model, residual_bounds)
        network.require_strongly_connected()
        self.placement = Placement(model, network, placement)
        self.own_rows = self.placement.rows
        self.mean, self.information = prior_information(model, cov, info)
        self.inverse_S = self._design_matrix()
        self.weights = self._weights(weight_matrix)
        self.kinds, self._outputs = self._measured(own_gains)
        self._spread()
        self._schedule: tuple[int, RelaySchedule] | None = None
        self.report: RelayReport = relay_report(self, require_sound=require_sound)

    @property
    def own_outputs(self) -> list[np.ndarray]:
        """C^i (p_i, n) of every node."""
        return [self.model.C[rows] for rows in self.own_rows]

    def own(self, node: int) -> Output:
        """What a node measures itself, with its own gain."""
        return self._outputs[self.kinds[node]]

    def local(self, node: int) -> LocalProblem:
        """The local problem of a node."""
        return self.problems[self.problem[node]]

    def gains(self, node: int, phase: int) -> np.ndarray:
        """(N, n, p) gains of the transitions of a node's window at time t, phase m = min(t, N); zero beyond m.

        The columns are the rows of its regional measurement.
        """
        return self.local(node).gains(phase)

    def held(self, node: int, phase: int) -> np.ndarray:
        """(m + 1, p) bool: components of the regional measurement that a node holds of every slot (data rule)."""
        return self.local(node).held(phase)

    def schedule(self, updates: int = LONGEST_SCHEDULE) -> RelaySchedule:
        """Arrival weights of all nodes, off-line (Algorithms, off-line 5).

        Args:
            updates: how many after the windows are full; fewer if the sequence settles before.
        """
        known = self._schedule
        if known is None or (known[1].settled is None and known[0] < updates):
            data = np.array([problem.data_information for problem in self.problems])[self.problem]
            found = relay_schedule(
                self.weights,
                self.information,
                self.options,
                np.moveaxis(data, 1, 0),
                self.own_information if self.options.omega == "seed" else None,
                self.prediction_maps,
                self.inverse_S,
                updates,
            )
            self._schedule = known = updates, found
        return known[1]

    @cached_property
    def prediction_maps(self) -> np.ndarray:
        """(count, n, n): A_L^i of (3.9) and (3.16); with ``omega="hessian"`` Phi_0 of the node's window."""
        if self.options.disturbance == "process_noise":
            return np.broadcast_to(self.model.A, (self.network.count, *self.model.A.shape))
        if self.options.omega == "hessian":
            return np.array([p.transition(self.options.horizon) for p in self.problems])[self.problem]
        return np.array([output.transition for output in self._outputs])[self.kinds]

    @cached_property
    def own_information(self) -> np.ndarray:
        """(count, n, n): F' Psi F of (3.15); with process noise, disturbances integrated out."""
        model, horizon = self.model, self.options.horizon
        found = []
        for output in self._outputs:
            if self.options.disturbance == "process_noise":
                found.append(
                    window_information([output.information] * (horizon + 1), model.A, model.process_covariance)
                )
                continue
            total = np.zeros_like(model.A)
            for _ in range(horizon + 1):
                total = output.information + output.transition.T @ total @ output.transition
            found.append(total)
        return np.array(found)[self.kinds]

    def condition(self) -> np.ndarray:
        """(count,) condition number of H^i of full windows, once the arrival weights have settled."""
        data = np.array([problem.data_information[-1] for problem in self.problems])[self.problem]
        return np.linalg.cond(self.schedule().fused[-1] + data)

    def by_node(self, measurements: Any) -> list[Any]:
        """One entry per node from what `step` was given, see `Placement.by_node`."""
        return self.placement.by_node(measurements)

    def _design_matrix(self) -> np.ndarray:
        n, given = self.model.state_size, self.options.S
        if given is None:
            what = "the disturbance covariance G Q G' (S of (3.16) is its inverse)"
            return definite(what, self.model.process_covariance)
        S = np.asarray(given, dtype=float)
        if S.shape not in ((), (n, n)):
            raise ShapeError(f"S: expected a number or an information matrix of shape {(n, n)}, got {S.shape}")
        return np.linalg.inv(definite("S", S * np.eye(n) if S.ndim == 0 else S))

    def _weights(self, matrix: Any) -> Weights:
        rule = self.options.weights
        if (rule == "given") != (matrix is not None):
            raise SettingError(
                "weights 'given' need weight_matrix=, a (count, count) matrix pi"
                if rule == "given"
                else f"weight_matrix= was given, but the weights are {rule!r}; set weights='given'"
            )
        if rule != "given":
            return uniform_weights(self.network) if rule == "uniform" else metropolis_weights(self.network)
        weights = given_weights(self.network, matrix)
        wrong = np.flatnonzero(np.abs(np.asarray(matrix).sum(axis=1) - 1) > ROW_SUM_TOLERANCE)
        unused = np.flatnonzero(weights.values <= 0)
        if wrong.size or unused.size:
            what = (
                f"sum to 1 within {ROW_SUM_TOLERANCE:g}, not so at nodes {self.network.names(wrong)}"
                if wrong.size
                else f"are positive on every link, not so at nodes {self.network.names(self.network.receivers[unused])}"
            )
            raise TopologyError(f"fusion weights {what}")
        return weights

    def _measured(self, gains: Sequence[Any] | None) -> tuple[np.ndarray, list[Output]]:
        """Kind of output of every node, and the kinds: nodes with equal C^i, R^i and L^i are of one kind."""
        model, count = self.model, self.network.count
        if gains is not None and len(gains) != count:
            raise ShapeError(f"own_gains: expected one per node ({count}), got {len(gains)}")
        if gains is not None and self.options.disturbance == "process_noise":
            raise SettingError(
                "own_gains were given, but the method estimates disturbances; set disturbance='observer'"
            )
        known: dict[tuple[bytes, ...], int] = {}
        outputs: list[Output] = []
        kinds = np.zeros(count, dtype=np.int64)
        for node, rows in enumerate(self.own_rows):
            C, R = model.C[rows], model.R[np.ix_(rows, rows)]
            gain = None if gains is None or not rows.size else _gain(gains[node], C, self.network, node)
            key = (C.tobytes(), R.tobytes(), b"" if gain is None else gain.tobytes())
            if key not in known:
                known[key] = len(outputs)
                if gain is None:
                    estimated = self.options.disturbance == "process_noise"
                    gain = np.zeros(C.shape[::-1])
                    if not estimated:
                        gain = stationary_gain(model.A, C, model.process_covariance, R).gain
                outputs.append(Output(model.A, C, R, gain))
            kinds[node] = known[key]
        return kinds, outputs

    def _spread(self) -> None:
        """Neighbourhoods, sources and the different local problems."""
        count = self.network.count
        near, distances = self.network.within(self.options.steps)
        self.reach_network, self.reach_hops = near, distances
        starts = near.offsets
        self.members = PerNode(count, lambda i: near.senders[starts[i] : starts[i + 1]])
        self.hops = PerNode(count, lambda i: distances[starts[i] : starts[i + 1]])
        sizes = np.array([rows.size for rows in self.own_rows])
        heard = np.flatnonzero(sizes[near.senders] > 0)
        receivers, senders, hops = near.receivers[heard], near.senders[heard], distances[heard]
        order = np.lexsort((senders, self.kinds[senders], hops, receivers))
        senders, hops, kinds = senders[order], hops[order], self.kinds[senders[order]]
        ends = np.searchsorted(receivers[order], np.arange(count + 1))
        self.sources = PerNode(count, lambda i: senders[ends[i] : ends[i + 1]])
        self.source_hops = PerNode(count, lambda i: hops[ends[i] : ends[i + 1]])
        nothing = np.zeros(0, dtype=np.int64)
        self.regional_rows = PerNode(
            count, lambda i: np.concatenate([nothing, *(self.own_rows[j] for j in self.sources[i])])
        )
        self.regional = PerNode(count, lambda i: self.placement.seen_by(self.sources[i]))
        table = GainTable(self.model, self._outputs, self.options)
        seen = np.stack([kinds, hops], axis=1)
        numbers: dict[bytes, int] = {}
        self.problems: list[LocalProblem] = []
        self.problem = np.zeros(count, dtype=np.int64)
        for node in range(count):
            content = seen[ends[node] : ends[node + 1]]
            number = numbers.setdefault(content.tobytes(), len(numbers))
            if number == len(self.problems):
                self.problems.append(LocalProblem(table, content[:, 0].tolist(), content[:, 1].tolist()))
            self.problem[node] = number


def residual_bounds_of(
    model: LinearModel, bounds: Polyhedron | Mapping[str, Polyhedron] | None
) -> dict[str, Polyhedron]:
    """Residual bounds by sensor name from one set for all sensors, or some by name.

    Raises:
        UnknownNameError: no sensor of that name.
        ShapeError: a set of another size than a sensor's measurement.
    """
    by_name = bounds
    if bounds is None:
        return {}
    if isinstance(bounds, Polyhedron):
        by_name = {sensor.name: bounds for sensor in model.sensors}
    assert isinstance(by_name, Mapping)
    for name, bound in by_name.items():
        rows = model.rows(name)
        if bound.size != rows.stop - rows.start:
            raise ShapeError(
                f"residual bounds of sensor {name!r}: expected a polyhedron on {rows.stop - rows.start} component(s), "
                f"got {bound!r}"
            )
    return dict(by_name)


def _gain(given: Any, C: np.ndarray, network: Network, node: int) -> np.ndarray:
    gain = np.asarray(given.gain if isinstance(given, ObserverGain) else given, dtype=float)
    if gain.shape != C.shape[::-1] or not np.isfinite(gain).all():
        raise ShapeError(
            f"own_gains: node {network.names([node])}: expected finite numbers of shape {C.shape[::-1]}, got shape "
            f"{gain.shape}"
        )
    return gain
