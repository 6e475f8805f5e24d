"""Which sensors of a model belong to which node of a network."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from problems.errors import ShapeError
from problems.models import LinearModel
from problems.networks import Network


class Placement:
    """Sensors of the collective model, sorted by the nodes they sit at.

    Args:
        model: with the sensors of all nodes.
        network: the nodes.
        owners: label of the node that each sensor belongs to; by default sensor k belongs to node k. A node may have
            several sensors or none.

    Raises:
        ShapeError: not one owner per sensor.
        TopologyError: a label that no node has.

    Attributes:
        owned: (count) numbers of the sensors of each node.
        rows: (count) rows of the collective measurement that belong to each node.
    """

    def __init__(self, model: LinearModel, network: Network, owners: Sequence[Hashable] | None = None) -> None:
        labels = network.labels if owners is None else tuple(owners)
        if len(labels) != len(model.sensors):
            raise ShapeError(
                f"the model has {len(model.sensors)} sensors for {len(labels)} "
                f"{'nodes' if owners is None else 'labels in placement'}; pass placement= with the label of the node "
                "that each sensor belongs to"
            )
        owned: list[list[int]] = [[] for _ in range(network.count)]
        for number, label in enumerate(labels):
            owned[network.index(label)].append(number)
        position = np.arange(model.measurement_size)
        rows = [position[model.rows(sensor.name)] for sensor in model.sensors]
        self.model, self.network = model, network
        self.owned = tuple(tuple(numbers) for numbers in owned)
        self.rows = tuple(np.concatenate([position[:0], *(rows[k] for k in numbers)]) for numbers in owned)

    def seen_by(self, nodes: Sequence[int] | np.ndarray) -> LinearModel:
        """The model with the sensors of some nodes, node by node."""
        return self.model.with_sensors([self.model.sensors[k] for node in nodes for k in self.owned[node]])

    def by_node(self, measurements: Any) -> list[Any]:
        """One entry per node from what an estimator's `step` was given.

        Args:
            measurements: one entry (p_i,) or None per node, a matrix (count, p), or the collective vector (p,) of all
                sensors in the order of the model; None where nothing was measured.

        Raises:
            ShapeError: anything else.
        """
        count = self.network.count
        if measurements is None:
            return [None] * count
        if isinstance(measurements, np.ndarray) and measurements.ndim == 1:
            if measurements.shape != (self.model.measurement_size,):
                raise ShapeError(
                    f"measurements: a vector holds all {self.model.measurement_size} component(s) of the model's "
                    f"sensors, got shape {measurements.shape}; or give one entry per node"
                )
            return [measurements[rows] for rows in self.rows]
        if len(measurements) != count:
            raise ShapeError(f"measurements: expected one entry per node ({count}), got {len(measurements)}")
        return list(measurements)
