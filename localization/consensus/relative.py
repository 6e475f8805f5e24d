"""Node coordinates from noisy differences: what is measured, and the optimum that consensus algorithms head for.

Source: spec ``gps-range-bearing-localization`` 3.1 (problem A).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from localization import measurements as meas
from localization.consensus.slots import NeighborSlots
from problems.errors import DataError, NoiseError, ShapeError, TopologyError
from problems.networks import Network
from problems.noise import Gaussian
from problems.problem import Problem
from problems.spaces import Vector


@dataclass(frozen=True, eq=False)
class RelativeVectors:
    """Measured differences ``z = x[tail] - x[head] + noise`` (2.1).

    Attributes:
        count: nodes.
        tail, head: (m,) nodes; at most one measurement for each ordered pair, held by the tail.
        z: (m, l) differences.
        variance: (m,) of every component, the square of the unit of `z`.

    Raises:
        TopologyError: nodes that do not exist, a node measured against itself, or an ordered pair that comes twice.
        ShapeError: arrays that do not fit together.
        NoiseError: a variance that is not positive and finite.
        DataError: a difference that is not finite.
    """

    count: int
    tail: np.ndarray
    head: np.ndarray
    z: np.ndarray
    variance: np.ndarray

    def __post_init__(self) -> None:
        m = len(self.tail)
        if self.z.ndim != 2 or not (self.tail.shape == self.head.shape == self.variance.shape == self.z.shape[:1]):
            raise ShapeError(
                "tail, head and variance have shape (m,) and z (m, l), got "
                f"{self.tail.shape}, {self.head.shape}, {self.variance.shape} and {self.z.shape}"
            )
        ends = np.concatenate([self.tail, self.head])
        if m == 0 or ends.min() < 0 or ends.max() >= self.count:
            raise TopologyError(f"expected measurements between nodes 0 to {self.count - 1}, got {m} measurement(s)")
        key = self.tail * self.count + self.head
        if (self.tail == self.head).any() or len(np.unique(key)) < m:
            raise TopologyError("every ordered pair of different nodes is measured at most once; fuse repeated ones")
        bad = np.flatnonzero(~((self.variance > 0) & np.isfinite(self.variance)))
        if bad.size:
            raise NoiseError(
                f"variance {self.variance[bad[0]]:g} of measurement {bad[0]} ({self.tail[bad[0]]} to "
                f"{self.head[bad[0]]}) is not a positive finite number"
            )
        if not np.isfinite(self.z).all():
            raise DataError("a measured difference is not finite; leave missing measurements out")

    @cached_property
    def network(self) -> Network:
        """Who talks to whom: measured pairs, in both directions."""
        return Network(self.count, np.column_stack([self.tail, self.head]), undirected=True)

    @cached_property
    def slots(self) -> NeighborSlots:
        """Neighbours in tables."""
        return NeighborSlots.of(self.network)

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """(m,) slot of the head in the row of the tail, and the other way round."""
        there = self.slots.locate(self.tail, self.head)
        return there, self.slots.back[self.tail, there]

    @cached_property
    def information(self) -> np.ndarray:
        """(count + 1, width) sum of 1/R over the measurements between a node and each neighbour."""
        total = np.zeros(self.slots.neighbor.shape)
        there, back = self.places
        np.add.at(total, (self.tail, there), 1 / self.variance)
        np.add.at(total, (self.head, back), 1 / self.variance)
        return total

    @cached_property
    def pull(self) -> np.ndarray:
        """(count + 1, width, l) sum of z/R seen from a node, measurements held by the neighbour with opposite sign."""
        total = np.zeros((*self.slots.neighbor.shape, self.z.shape[1]))
        there, back = self.places
        scaled = self.z / self.variance[:, None]
        np.add.at(total, (self.tail, there), scaled)
        np.add.at(total, (self.head, back), -scaled)
        return total

    @cached_property
    def group(self) -> np.ndarray:
        """(count,) number of the connected component of every node."""
        label = np.empty(self.count, dtype=np.int64)
        for k, nodes in enumerate(self.network.components()):
            label[nodes] = k
        return label

    def require_connected(self) -> None:
        """Check that the differences determine all coordinates up to one translation.

        Raises:
            TopologyError: names the components.
        """
        parts = self.network.components()
        if len(parts) > 1:
            listed = "; ".join(self.network.names(part) for part in parts[:8])
            raise TopologyError(
                f"measurements leave {len(parts)} components that nothing connects: {listed}; "
                "measure a pair across them, or localize every component on its own"
            )

    def require_both_ways(self, method: str) -> None:
        """Check that both nodes of a pair measure, with one variance throughout, as the method's formulas assume.

        Raises:
            TopologyError: a pair measured in one direction only.
            NoiseError: unequal variances.
        """
        forward, backward = self.tail * self.count + self.head, self.head * self.count + self.tail
        lone = np.flatnonzero(~np.isin(backward, forward))
        if lone.size:
            i, j = self.tail[lone[0]], self.head[lone[0]]
            raise TopologyError(f"{method} needs both differences of every pair; {i} measures {j} but not vice versa")
        if np.ptp(self.variance) > 1e-12 * self.variance.max():
            raise NoiseError(
                f"{method} assumes equal variances, got {self.variance.min():g} to {self.variance.max():g}; "
                "s_cl and a_cl weigh measurements"
            )

    def spread(self, error: np.ndarray) -> np.ndarray:
        """``||A error||`` of coordinate errors (count, l), one for each connected component; blind to translations."""
        squares = np.sum((error[self.tail] - error[self.head]) ** 2, axis=1)
        return np.sqrt(np.bincount(self.group[self.tail], squares, self.group.max() + 1))


def union(parts: Sequence[RelativeVectors]) -> RelativeVectors:
    """Several networks side by side as one, nodes in the order of the parts, so that one run serves them all."""
    first = np.cumsum([0, *(part.count for part in parts)])
    return RelativeVectors(
        int(first[-1]),
        np.concatenate([part.tail + k for part, k in zip(parts, first, strict=False)]),
        np.concatenate([part.head + k for part, k in zip(parts, first, strict=False)]),
        np.concatenate([part.z for part in parts]),
        np.concatenate([part.variance for part in parts]),
    )


def measure_differences(
    network: Network, x: np.ndarray, variance: float | np.ndarray, rng: np.random.Generator
) -> RelativeVectors:
    """Every node measures its difference to each node it hears.

    Args:
        network: who measures whom.
        x: (count, l) true coordinates.
        variance: one for all, or (m,) in the order of ``network.edges``.
        rng: source of the noise.
    """
    edges = network.edges
    variances = np.broadcast_to(np.asarray(variance, dtype=float), (len(edges),)).copy()
    tail, head = edges[:, 1], edges[:, 0]
    noise = np.sqrt(np.maximum(variances, 0))[:, None] * rng.normal(size=(len(edges), x.shape[1]))
    return RelativeVectors(network.count, tail, head, x[tail] - x[head] + noise, variances)


def relative_problem(vectors: RelativeVectors) -> Problem:
    """Least squares of coordinates: variables ``x``, of which the first of every component is held at zero."""
    problem = Problem("relative vectors")
    dim = vectors.z.shape[1]
    x = problem.variables("x", Vector(dim), vectors.count)
    z = problem.data("z", dim, len(vectors.tail), value=vectors.z)
    sigma = np.sqrt(vectors.variance)[:, None].repeat(dim, axis=1)
    problem.cost(
        "difference", meas.relative_position, on=(x[vectors.head], x[vectors.tail]), data=z, noise=Gaussian(sigma)
    )
    _, held = np.unique(vectors.group, return_index=True)
    problem.equality("gauge", lambda element: element, on=x[held])
    return problem


def optimum(vectors: RelativeVectors) -> np.ndarray:
    """Least-squares coordinates (count, l) of minimum norm: every component has mean zero (2.2)."""
    x = relative_problem(vectors).compile("gauss-newton", tolerance=1e-13).solve()["x"]
    size = np.bincount(vectors.group)
    mean = np.stack([np.bincount(vectors.group, column) / size for column in x.T], axis=1)
    return x - mean[vectors.group]
