"""`SporadicDesign`: everything of an estimator with detections that is settled before the first reading.

Source: dmhe-sporadic-fov 4 (off-line) and section 5.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from mhe.placement import Placement
from mhe.polyhedron import Polyhedron
from mhe.sporadic.blocks import Blocks, blocks_of
from mhe.sporadic.gains import (
    BySensor,
    blended_gains,
    check_observer,
    given_gains,
    kalman_gains,
    part_seen,
    sensor_output,
    sensor_size,
)
from mhe.sporadic.options import SporadicOptions, options_of
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.readings import Reading
from mhe.sporadic.rows import half_planes, require_bounded
from mhe.sporadic.window import WindowShape
from problems.errors import DefinitionError, ModelWarning, SettingError, ShapeError
from problems.models import LinearModel, Model
from problems.networks import Network, Weights, given_weights, metropolis_weights, uniform_weights

Gains = Sequence[Any] | Mapping[Hashable, Any] | float | None


class SporadicDesign:
    """Model, network and options of an estimator with detections, checked.

    Args:
        model: linear, without inputs, with a prior and the sensors of all nodes. A camera is one sensor of the model
            for each vehicle: detections are flagged sensor by sensor.
        network: who hears whom; strongly connected.
        method: ``dmhe_w_pre``, ``dmhe_w_pre_s``, ``dmhe_f``, ``dmhe_f_s``, or options.
        placement: label of the node that each sensor belongs to; by default sensors are shared out evenly and in order
            (the first node has the first ones).
        fields: convex set of the outputs of each node's sensors, by label, or one entry per node in their order; None
            where a node has none.
        convex_pieces: of each node's set, in the same forms, for ``pieces="detected"`` or ``"both"``.
        unseen_pieces: convex pieces of where a vehicle is that nobody of a node's neighbourhood sees, in the same
            forms, for ``pieces="unseen"`` or ``"both"``.
        weight_matrix: (count, count) K for the weights ``given``.
        gains: observer gains: a number l for ``L = l A C^+`` of each sensor (shared among the sensors of a part where
            the observer is regional), one array L^i per node, (n, own components) or, regional, (n, components of the
            region, nodes ascending), or None for stationary Kalman gains of all that feeds the observer.
        require_sound: refuse gains that let errors grow; if False, warn.
        pool: compiled windows to share with other designs.
        overrides: options by name, see `SporadicOptions`.

    Raises:
        UnknownNameError, SettingError, ShapeError, DefinitionError, NoiseError: about the arguments.
        TopologyError: a network that is not strongly connected, weights that do not fit it.
        UnstableError: see `require_sound`.

    Warns:
        ModelWarning: (2.23) with weights whose fused covariances grow (E3).

    Attributes:
        options: of the method.
        own_sensors: sensors of each node.
        blocks: parts of the model that nothing couples.
        weights: k_ij, None where they follow the detections.
    """

    def __init__(
        self,
        model: Model,
        network: Network,
        method: str | SporadicOptions = "dmhe_w_pre",
        *,
        placement: Sequence[Hashable] | None = None,
        fields: Mapping[Hashable, Polyhedron] | Sequence[Polyhedron | None] | None = None,
        convex_pieces: Mapping[Hashable, Sequence[Polyhedron]] | Sequence[Sequence[Polyhedron] | None] | None = None,
        unseen_pieces: Mapping[Hashable, Sequence[Polyhedron]] | Sequence[Sequence[Polyhedron] | None] | None = None,
        weight_matrix: Any = None,
        gains: Gains = None,
        require_sound: bool = True,
        pool: DetectionPool | None = None,
        **overrides: Any,
    ) -> None:
        if not isinstance(model, LinearModel):
            raise DefinitionError(f"estimators with detections need a LinearModel, got {model!r}")
        if model.input_size:
            raise DefinitionError(
                "estimators with detections are for models without inputs; a vehicle does not tell them"
            )
        model.prior()
        network.require_strongly_connected()
        self.model, self.network = model, network
        self.options = options_of(method, **overrides)
        self.pool = DetectionPool() if pool is None else pool
        self.placement = self._placed(placement)
        self.own_sensors = tuple(np.array(numbers, dtype=np.intp) for numbers in self.placement.owned)
        self._regions = [
            np.concatenate([self.own_sensors[j] for j in network.in_neighborhood(i)]) for i in range(network.count)
        ]
        self.fields = self._fields(fields)
        self.convex_pieces = self._cells(convex_pieces, "convex_pieces", ("detected", "both"))
        self.unseen_pieces = self._cells(unseen_pieces, "unseen_pieces", ("unseen", "both"))
        self.blocks: Blocks = blocks_of(model)
        self._gains = self._observer(gains, require_sound)
        self.weights = self._weights(weight_matrix)
        self._check_growth()

    def _placed(self, placement: Sequence[Hashable] | None) -> Placement:
        count, sensors = self.network.count, len(self.model.sensors)
        if placement is None:
            if sensors % count:
                raise ShapeError(
                    f"{sensors} sensors cannot be shared out evenly among {count} nodes; pass placement= with the "
                    "label of the node that each sensor belongs to"
                )
            placement = [label for label in self.network.labels for _ in range(sensors // count)]
        return Placement(self.model, self.network, placement)

    def _fields(self, fields: Any) -> tuple[Polyhedron | None, ...]:
        if fields is None:
            if self.options.rows != "none":
                raise SettingError(f"rows={self.options.rows!r} need fields=, the convex set of each node's sensors")
            return (None,) * self.network.count
        found = self._each(fields, "fields")
        for node, polyhedron in enumerate(found):
            if polyhedron is not None:
                self._check_set(node, polyhedron, "fields")
                require_bounded(polyhedron, f"node {self.network.names([node])}")
        return tuple(found)

    def _cells(self, given: Any, what: str, rules: tuple[str, ...]) -> tuple[tuple[Polyhedron, ...], ...]:
        """Pieces by node; none where the options do not use them."""
        if self.options.pieces not in rules:
            return ((),) * self.network.count
        if given is None:
            raise SettingError(f"pieces={self.options.pieces!r} need {what}=, convex sets for each node")
        found = tuple(tuple(entry or ()) for entry in self._each(given, what))
        for node, entries in enumerate(found):
            for polyhedron in entries:
                self._check_set(node, polyhedron, what)
        return found

    def _each(self, given: Any, what: str) -> list[Any]:
        """One entry per node from a mapping by label or a sequence."""
        network = self.network
        if isinstance(given, Mapping):
            found: list[Any] = [None] * network.count
            for label, entry in given.items():
                found[network.index(label)] = entry
        else:
            found = list(given)
        if len(found) != network.count:
            raise ShapeError(f"{what}: expected one entry for each of {network.count} nodes, got {len(found)}")
        return found

    def _check_set(self, node: int, polyhedron: Polyhedron, what: str) -> None:
        for sensor in self.own_sensors[node]:
            size = sensor_size(self.model, sensor)
            if polyhedron.size != size:
                raise ShapeError(
                    f"{what}: a set of node {self.network.names([node])} is on {polyhedron.size} component(s), its "
                    f"sensor {self.model.sensors[sensor].name!r} has {size}"
                )

    def _observer(self, gains: Gains, require_sound: bool) -> list[BySensor] | None:
        """Per node, the gain (n, p) of every sensor that feeds its observer."""
        if self.options.disturbance != "observer":
            if gains is not None:
                raise SettingError("gains= belong to disturbance='observer'; with process noise leave them out")
            return None
        model, labels = self.model, [self.network.names([node]) for node in range(self.network.count)]
        feeding = self.own_sensors if self.options.observer == "local" else self._regions
        if gains is None:
            found = [kalman_gains(model, self.blocks, sensors) for sensors in feeding]
        elif isinstance(gains, (int, float)):
            found = [blended_gains(model, self.blocks, sensors, float(gains)) for sensors in feeding]
        else:
            given = zip(feeding, self._each(gains, "gains"), labels, strict=True)
            found = [given_gains(model, sensors, gain, label) for sensors, gain, label in given]
            self.blocks = blocks_of(model, [pair for by_sensor in found for pair in by_sensor.items()])
        for by_sensor, label in zip(found, labels, strict=True):
            check_observer(model, self.blocks, by_sensor, label, require_sound=require_sound)
        return found

    @cached_property
    def _parts(self) -> list[int]:
        """Part of the model that each sensor sees."""
        return [part_seen(self.model, self.blocks, s) for s in range(len(self.model.sensors))]

    # Weights

    def _weights(self, matrix: Any) -> Weights | None:
        rule = self.options.weights
        if (rule == "given") != (matrix is not None):
            raise SettingError(
                "weights='given' need weight_matrix=, a (count, count) matrix K"
                if rule == "given"
                else f"weight_matrix= was given, but the weights are {rule!r}; set weights='given'"
            )
        if rule == "given":
            return given_weights(self.network, matrix)
        if rule == "rank":
            return None
        return uniform_weights(self.network) if rule == "uniform" else metropolis_weights(self.network)

    @cached_property
    def _listeners(self) -> np.ndarray:
        """n_S^j of (2.23) for every node."""
        return self.network.out_degree if self.options.weight_fusion == "out_degree" else self.network.in_degree

    def _check_growth(self) -> None:
        """E3: (2.23) lets the covariance of what nobody sees grow where [n_S^j k_ij^2] has spectral radius above 1."""
        if self.options.weight_fusion == "convex":
            return
        network = self.network
        if self.weights is not None:
            candidates = [self.weights.values]
        else:
            # rank weights while one camera sees everything
            candidates = []
            for active in range(network.count):
                ranks = np.full(network.count, self.options.rank_floor)
                ranks[network.out_neighborhood(active)] = self.model.state_size
                ranks[active] = self.model.state_size
                scores = ranks[network.senders]
                candidates.append(scores / np.add.reduceat(scores, network.offsets[:-1])[network.receivers])
        radius = 0.0
        for values in candidates:
            coefficients = Weights(network, self._listeners[network.senders] * values**2)
            radius = max(radius, float(np.abs(np.linalg.eigvals(coefficients.matrix())).max()))
        if radius > 1 + 1e-9:
            warnings.warn(
                f"weight_fusion={self.options.weight_fusion!r} with {self.options.weights} weights: the spectral "
                f"radius of [n_S^j k_ij^2] is {radius:.4g} > 1, covariances of what nobody sees grow by it every step; "
                f"they are capped at {self.options.covariance_cap:g}. weight_fusion='convex' has no such growth",
                ModelWarning,
                stacklevel=3,
            )

    # Plans

    @cached_property
    def plans(self) -> tuple[SporadicPlan, ...]:
        """What every node is told."""
        sets, rows = self._row_sizes()
        blocks, model = self.blocks, self.model
        shape = WindowShape(
            horizon=self.options.horizon,
            parts=blocks.count,
            size=blocks.size,
            disturbances=blocks.disturbances.shape[1] if self._gains is None else 0,
            sets=sets,
            rows=rows,
        )
        mean, start = model.prior()
        gain = model.G[blocks.states[:, :, None], blocks.disturbances[:, None, :]]
        noise = model.Q[blocks.disturbances[:, :, None], blocks.disturbances[:, None, :]]
        common = {
            "width": max((sensor_size(self.model, s) for s in range(len(model.sensors))), default=0),
            "blocks": blocks,
            "transition": blocks.of(model.A),
            "disturbance": blocks.of(model.process_covariance),
            "noise_gain": gain,
            "noise": noise,
            "mean": blocks.apart(mean),
            "start": blocks.of(start),
            "shape": shape,
            "state_names": model.state_names,
            "options": self.options,
            "period": model.dt or 1.0,
        }
        return tuple(self._plan(node, sets, common) for node in range(self.network.count))

    def _row_owner(self, node: int) -> list[int]:
        """Sensors that make rows at a node."""
        if self.options.rows == "none":
            return []
        sensors = self.own_sensors[node] if self.options.row_scope == "own" else self._regions[node]
        return [int(s) for s in sensors if self._set_of(s) is not None]

    def _set_of(self, sensor: int) -> Polyhedron | None:
        node = next(i for i, own in enumerate(self.own_sensors) if sensor in own)
        return self.fields[node]

    def _row_sizes(self) -> tuple[int, int]:
        """Most sets of rows on a part and most rows of a set, over all nodes."""
        sets, rows = 0, 0
        for node in range(self.network.count):
            parts = [self._parts[s] for s in self._row_owner(node)]
            sets = max([sets, *(parts.count(part) for part in parts)])
        if sets:
            known = [polyhedron for polyhedron in self.fields if polyhedron is not None]
            known += [piece for entries in (*self.convex_pieces, *self.unseen_pieces) for piece in entries]
            rows = max(len(half_planes(polyhedron)[0]) for polyhedron in known)
        return sets, rows

    def _plan(self, node: int, sets: int, common: dict[str, Any]) -> SporadicPlan:
        members, region = self.network.in_neighborhood(node), self._regions[node]
        ends = np.cumsum([0, *(self.own_sensors[j].size for j in members)]).tolist()
        parts = np.array([self._parts[s] for s in region], dtype=np.intp)
        states = self.blocks.states
        outputs = [sensor_output(self.model, s) for s in region]
        gains = None
        if self._gains is not None:
            known = self._gains[node]
            gains = tuple(
                known[int(s)][states[v]] if int(s) in known else None for s, v in zip(region, parts, strict=True)
            )
        row_sensors = np.full((self.blocks.count, sets), -1)
        for sensor in self._row_owner(node):
            place = int(np.flatnonzero(region == sensor)[0])
            part = parts[place]
            row_sensors[part, int((row_sensors[part] >= 0).sum())] = place
        return SporadicPlan(
            index=node,
            label=self.network.labels[node],
            members=tuple(members.tolist()),
            member_sensors=tuple(slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)),
            names=tuple(self.model.sensors[s].name for s in region),
            sizes=tuple(sensor_size(self.model, s) for s in region),
            parts=parts,
            outputs=tuple(C[:, states[v]] for (C, _), v in zip(outputs, parts, strict=True)),
            precisions=tuple(np.linalg.inv(R) for _, R in outputs),
            gains=gains,
            sets=self._sets_at(node),
            pieces=tuple(self.convex_pieces[node] if s in self.own_sensors[node] else () for s in region),
            unseen_pieces=self.unseen_pieces[node],
            row_sensors=row_sensors,
            weights=None if self.weights is None else self.weights.row(node).copy(),
            listeners=None if self.options.weight_fusion == "convex" else self._listeners[members].astype(float),
            **common,
        )

    def _sets_at(self, node: int) -> tuple[Polyhedron | None, ...]:
        """Sets a node knows: its own, and its neighbours' where it makes rows of their detections or is fed by them."""
        options = self.options
        wide = options.rows != "none" and (
            options.row_scope == "regional" or (options.rows == "projected" and options.observer == "regional")
        )
        own = set(self.own_sensors[node].tolist())
        return tuple(self._set_of(s) if wide or int(s) in own else None for s in self._regions[node])

    # Readings

    def by_node(self, values: Any, flags: Any = None, late: Sequence[tuple[float, Any, Any]] = ()) -> list[Reading]:
        """One `Reading` per node from what `step` was given.

        Args:
            values: one entry per node (or None), an array whose first axis is the nodes, or the collective vector (p,).
            flags: one entry per node, an array whose first axis is the nodes, or one flag per sensor of the model.
            late: (time, values, flags) of earlier instants, in the same forms.

        Raises:
            ShapeError: anything else.
        """
        if values is not None and len(values) == self.network.count and isinstance(values[0], Reading):
            return list(values)
        found = [Reading(value, flag) for value, flag in self._parted(values, flags)]
        for time, then, mask in late:
            found = [
                node if value is None else node._replace(late=(*node.late, (time, value, flag)))
                for node, (value, flag) in zip(found, self._parted(then, mask), strict=True)
            ]
        return found

    def _parted(self, values: Any, flags: Any) -> Iterator[tuple[Any, Any]]:
        """Values and flags of every node."""
        split = self._split(values, self.placement.rows, "values"), self._split(flags, self.own_sensors, "flags")
        return zip(*split, strict=True)

    def _split(self, given: Any, places: tuple[np.ndarray, ...], what: str) -> list[Any]:
        count, size = self.network.count, sum(part.size for part in places)
        if given is None:
            return [None] * count
        if isinstance(given, np.ndarray) and given.ndim == 1 and given.shape[0] == size:
            return [given[part] for part in places]
        if len(given) != count:
            raise ShapeError(
                f"{what}: expected one entry for each of {count} nodes or {size} number(s), got {len(given)}"
            )
        return list(given)
