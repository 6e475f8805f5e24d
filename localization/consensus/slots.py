"""Neighbours of every node in tables of equal width, so that many nodes act in one array operation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from problems.errors import TopologyError
from problems.networks import Network


@dataclass(frozen=True, eq=False)
class NeighborSlots:
    """The neighbours of node i in ascending order, row i; what is left of a row points at an idle node `count`.

    Attributes:
        count: nodes; tables have one row more, that of the idle node.
        neighbor: (count + 1, width) node indices, `count` where there is none.
        back: (count + 1, width) the slot that node i has in the row of its neighbour.
        degree: (count + 1,) neighbours, the node itself not included.
    """

    count: int
    neighbor: np.ndarray
    back: np.ndarray
    degree: np.ndarray

    @classmethod
    def of(cls, network: Network) -> NeighborSlots:
        """Tables of an undirected network.

        Raises:
            TopologyError: a link without its opposite, or no link at all.
        """
        network.require_undirected("a table of neighbours")
        edges = network.edges
        if not len(edges):
            raise TopologyError("no node has a neighbour, so there is nothing to exchange")
        count = network.count
        degree = np.append(network.in_degree - 1, 0)
        column = np.arange(len(edges)) - (np.cumsum(degree) - degree)[edges[:, 1]]
        neighbor = np.full((count + 1, degree.max()), count)
        neighbor[edges[:, 1], column] = edges[:, 0]
        back = np.zeros_like(neighbor)
        # Links are sorted by receiver, then sender, so sorting them by sender, then receiver pairs opposites up.
        opposite = np.lexsort((edges[:, 1], edges[:, 0]))
        back[edges[:, 1], column] = column[opposite]
        return cls(count, neighbor, back, degree)

    @property
    def width(self) -> int:
        """Largest degree."""
        return self.neighbor.shape[1]

    def locate(self, node: np.ndarray, neighbor: np.ndarray) -> np.ndarray:
        """Slots (m,) that the `neighbor` (m,) have in the rows of `node` (m,)."""
        return np.argmax(self.neighbor[node] == neighbor[:, None], axis=1)
