"""`SporadicDesign`: everything of an estimator with detections that is settled before the first reading.

Source: dmhe-sporadic-fov 4 (off-line) and section 5.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from mhe.observers import kalman_gain
from mhe.polyhedron import Polyhedron
from mhe.sporadic.blocks import Blocks, blocks_of
from mhe.sporadic.options import SporadicOptions, options_of
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.readings import Reading
from mhe.sporadic.rows import half_planes, require_bounded
from mhe.sporadic.window import WindowShape
from problems.errors import DefinitionError, ModelWarning, SettingError, ShapeError, UnstableError
from problems.models import LinearModel, Model
from problems.networks import Network, Weights, given_weights, metropolis_weights, uniform_weights
from problems.networks.observability import observability_rank

Gains = Sequence[Any] | float | None


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
        self.own_sensors = self._placed(placement)
        self._regions = [
            np.concatenate([self.own_sensors[j] for j in network.in_neighborhood(i)]) for i in range(network.count)
        ]
        self.fields = self._fields(fields)
        self.blocks: Blocks = blocks_of(model)
        self._gains = self._observer(gains, require_sound)
        self.weights = self._weights(weight_matrix)
        self._check_growth()

    def _placed(self, placement: Sequence[Hashable] | None) -> tuple[np.ndarray, ...]:
        count, sensors = self.network.count, len(self.model.sensors)
        if placement is None:
            if sensors % count:
                raise ShapeError(
                    f"{sensors} sensors cannot be shared out evenly among {count} nodes; pass placement= with the "
                    "label of the node that each sensor belongs to"
                )
            return tuple(np.arange(sensors).reshape(count, -1))
        if len(placement) != sensors:
            raise ShapeError(
                f"placement: expected the label of a node for each of {sensors} sensors, got {len(placement)}"
            )
        nodes = np.array([self.network.index(label) for label in placement], dtype=np.intp)
        return tuple(np.flatnonzero(nodes == node) for node in range(count))

    def _fields(self, fields: Any) -> tuple[Polyhedron | None, ...]:
        network = self.network
        if fields is None:
            if self.options.rows != "none":
                raise SettingError(f"rows={self.options.rows!r} need fields=, the convex set of each node's sensors")
            return (None,) * network.count
        if isinstance(fields, Mapping):
            found: list[Polyhedron | None] = [None] * network.count
            for label, polyhedron in fields.items():
                found[network.index(label)] = polyhedron
        else:
            found = list(fields)
        if len(found) != network.count:
            raise ShapeError(f"fields: expected one entry for each of {network.count} nodes, got {len(found)}")
        for node, polyhedron in enumerate(found):
            if polyhedron is None:
                continue
            for sensor in self.own_sensors[node]:
                size = self._size(sensor)
                if polyhedron.size != size:
                    raise ShapeError(
                        f"fields: the set of node {network.names([node])} is on {polyhedron.size} component(s), its "
                        f"sensor {self.model.sensors[sensor].name!r} has {size}"
                    )
            require_bounded(polyhedron, f"node {network.names([node])}")
        return tuple(found)

    def _size(self, sensor: int) -> int:
        rows = self.model.rows(self.model.sensors[sensor].name)
        return len(range(self.model.measurement_size)[rows])

    def _output(self, sensor: int) -> tuple[np.ndarray, np.ndarray]:
        """C (p, n) and R (p, p) of a sensor."""
        rows = self.model.rows(self.model.sensors[sensor].name)
        return self.model.C[rows], self.model.R[rows, rows]

    # Observer

    def _observer(self, gains: Gains, require_sound: bool) -> list[dict[int, np.ndarray]] | None:
        """Per node, the gain (n, p) of every sensor that feeds its observer."""
        if self.options.disturbance != "observer":
            if gains is not None:
                raise SettingError("gains= belong to disturbance='observer'; with process noise leave them out")
            return None
        feeding = self.own_sensors if self.options.observer == "local" else self._regions
        if gains is None:
            rule = self._kalman
        elif np.ndim(gains) == 0:
            rule = self._blended
        else:
            rule = None
        found: list[dict[int, np.ndarray]] = []
        if rule is None:
            if len(gains) != self.network.count:  # type: ignore[arg-type]
                raise ShapeError(f"gains: expected one for each of {self.network.count} nodes")
            for node, sensors in enumerate(feeding):
                found.append(self._given(node, sensors, gains[node]))  # type: ignore[index]
            pairs = [pair for by_sensor in found for pair in by_sensor.items()]
            self.blocks = blocks_of(self.model, pairs)
        else:
            found = [rule(sensors, gains) for sensors in feeding]
        for node, by_sensor in enumerate(found):
            self._check_observer(node, by_sensor, require_sound)
        return found

    def _given(self, node: int, sensors: np.ndarray, gain: Any) -> dict[int, np.ndarray]:
        sizes = [self._size(s) for s in sensors]
        array = np.asarray(gain, dtype=float)
        if array.shape != (self.model.state_size, sum(sizes)) or not np.isfinite(array).all():
            raise ShapeError(
                f"node {self.network.names([node])}: expected a finite gain of shape "
                f"{(self.model.state_size, sum(sizes))}, got {array.shape}"
            )
        ends = np.cumsum([0, *sizes])
        return {int(s): array[:, a:b] for s, a, b in zip(sensors, ends, ends[1:], strict=False)}

    def _blended(self, sensors: np.ndarray, share: Any) -> dict[int, np.ndarray]:
        parts = [self._part(s) for s in sensors]
        out = {}
        for sensor, part in zip(sensors, parts, strict=True):
            C, _ = self._output(sensor)
            out[int(sensor)] = float(share) / parts.count(part) * self.model.A @ np.linalg.pinv(C)
        return out

    def _kalman(self, sensors: np.ndarray, _: Any) -> dict[int, np.ndarray]:
        """Part by part, so that rounding couples none."""
        n, out = self.model.state_size, {int(s): np.zeros((self.model.state_size, self._size(s))) for s in sensors}
        for part in sorted({self._part(s) for s in sensors}):
            own = [int(s) for s in sensors if self._part(s) == part]
            states = self.blocks.states[part]
            A, Q = (matrix[np.ix_(states, states)] for matrix in (self.model.A, self.model.process_covariance))
            outputs = [self._output(s) for s in own]
            R = np.zeros((sum(len(r) for _, r in outputs),) * 2)
            ends = np.cumsum([0, *(len(r) for _, r in outputs)]).tolist()
            for (_, r), a, b in zip(outputs, ends, ends[1:], strict=False):
                R[a:b, a:b] = r
            gain = np.zeros((n, len(R)))
            gain[states] = kalman_gain(A, np.vstack([C[:, states] for C, _ in outputs]), Q, R).gain
            for s, a, b in zip(own, ends, ends[1:], strict=False):
                out[s] = gain[:, a:b]
        return out

    def _check_observer(self, node: int, by_sensor: dict[int, np.ndarray], require_sound: bool) -> None:
        """Section 5: A - L C with all detections, and with any single one, lets no observed error grow."""
        alone = [[sensor] for sensor in by_sensor]
        for sensors in (list(by_sensor), *(alone if len(alone) > 1 else ())):
            for part, states in enumerate(self.blocks.states):
                seeing = [s for s in sensors if self._part(s) == part]
                if not seeing:
                    continue
                A = self.model.A[np.ix_(states, states)]
                C = np.vstack([self._output(s)[0][:, states] for s in seeing])
                L = np.hstack([by_sensor[s][states] for s in seeing])
                radius = float(np.abs(np.linalg.eigvals(A - L @ C)).max())
                if radius < 1 or observability_rank(A, C, len(A)) < len(A):
                    continue
                names = [self.model.sensors[s].name for s in seeing]
                text = (
                    f"the observer of node {self.network.names([node])} has spectral radius {radius:.6g} when "
                    f"{', '.join(names[:3])} detect, although these observe everything; choose smaller or Kalman gains"
                )
                if require_sound:
                    raise UnstableError(text)
                warnings.warn(text, ModelWarning, stacklevel=4)

    def _part(self, sensor: int) -> int:
        """Part of the model that a sensor sees."""
        column = int(np.flatnonzero((self._output(sensor)[0] != 0).any(axis=0))[0])
        return int(np.flatnonzero((self.blocks.states == column).any(axis=1))[0])

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
            "width": max((self._size(s) for s in range(len(model.sensors))), default=0),
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
        sets = rows = 0
        for node in range(self.network.count):
            parts = [self._part(s) for s in self._row_owner(node)]
            sets = max([sets, *(parts.count(part) for part in parts)])
        for polyhedron in self.fields:
            if polyhedron is not None and sets:
                rows = max(rows, len(half_planes(polyhedron)[0]))
        return sets, rows

    def _plan(self, node: int, sets: int, common: dict[str, Any]) -> SporadicPlan:
        members, region = self.network.in_neighborhood(node), self._regions[node]
        ends = np.cumsum([0, *(self.own_sensors[j].size for j in members)]).tolist()
        parts = np.array([self._part(s) for s in region], dtype=np.intp)
        states = self.blocks.states
        outputs = [self._output(s) for s in region]
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
            sizes=tuple(self._size(s) for s in region),
            parts=parts,
            outputs=tuple(C[:, states[v]] for (C, _), v in zip(outputs, parts, strict=True)),
            precisions=tuple(np.linalg.inv(R) for _, R in outputs),
            gains=gains,
            sets=self._sets_at(node),
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
        parts = zip(
            self._split(values, self._rows, "values"), self._split(flags, self.own_sensors, "flags"), strict=True
        )
        found = [Reading(value, flag) for value, flag in parts]
        for time, then, mask in late:
            pieces = zip(
                self._split(then, self._rows, "values"), self._split(mask, self.own_sensors, "flags"), strict=True
            )
            found = [
                node if value is None else node._replace(late=(*node.late, (time, value, flag)))
                for node, (value, flag) in zip(found, pieces, strict=True)
            ]
        return found

    @cached_property
    def _rows(self) -> tuple[np.ndarray, ...]:
        """Components of the collective measurement that belong to each node."""
        position = np.arange(self.model.measurement_size)
        of_sensor = [position[self.model.rows(sensor.name)] for sensor in self.model.sensors]
        return tuple(np.concatenate([position[:0], *(of_sensor[s] for s in own)]) for own in self.own_sensors)

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
