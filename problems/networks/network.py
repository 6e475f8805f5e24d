"""Directed communication graphs with a self-loop at every node."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import TopologyError

if TYPE_CHECKING:
    import networkx
    from scipy.sparse import csr_array

_NAMES_SHOWN = 5


class Network:
    """An immutable digraph: edge (j, i) means that node j sends to node i.

    Every node hears itself: self-loops belong to all neighbourhoods and degrees and never to `edges`. Nodes are the
    indices 0..count-1; `labels` are names for people and for messages. Stored row by row (compressed sparse rows, row
    i = receiver i, senders ascending), so that ten thousand nodes are cheap.

    Source: dmhe-pre-estimation section 2 (graph, in-neighbourhood, out-degree d_j).

    Args:
        count: number of nodes, at least 1.
        edges: (E, 2) pairs (sender, receiver) of node indices; repeated pairs and self-loops are harmless.
        undirected: every pair is a link in both directions.
        labels: `count` different hashable names; by default the indices.

    Raises:
        TopologyError: no nodes, an edge that leaves the node set, or labels that do not fit.

    Attributes:
        count: number of nodes.
        senders: (E + count,) sender of every link, self-loops included, receiver by receiver in ascending order.
        offsets: (count + 1,) receiver i hears ``senders[offsets[i]:offsets[i + 1]]``.
        labels: names of the nodes.
    """

    count: int
    senders: np.ndarray
    offsets: np.ndarray
    labels: tuple[Hashable, ...]

    def __init__(
        self,
        count: int,
        edges: ArrayLike = (),
        *,
        undirected: bool = False,
        labels: Sequence[Hashable] | None = None,
    ) -> None:
        if count < 1:
            raise TopologyError(f"a network needs at least one node, got count={count}")
        pairs = np.asarray(edges)
        if pairs.size == 0:
            pairs = np.empty((0, 2), dtype=np.int64)
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise TopologyError(f"edges are pairs (sender, receiver): expected shape (E, 2), got {pairs.shape}")
        if not np.issubdtype(pairs.dtype, np.integer):
            raise TopologyError(
                f"edges hold node indices, got {pairs.dtype}; use Network.from_edges for edges between named nodes"
            )
        outside = np.flatnonzero(((pairs < 0) | (pairs >= count)).any(axis=1))
        if outside.size:
            raise TopologyError(f"edge {tuple(pairs[outside[0]].tolist())} leaves the nodes 0..{count - 1}")
        pairs = pairs.astype(np.int64, copy=False)
        nodes = np.arange(count, dtype=np.int64)
        keys = [pairs[:, 1] * count + pairs[:, 0], nodes * count + nodes]
        if undirected:
            keys.append(pairs[:, 0] * count + pairs[:, 1])
        self._fill(count, np.unique(np.concatenate(keys)), labels)

    def _fill(self, count: int, keys: np.ndarray, labels: Sequence[Hashable] | None) -> None:
        """Take the sorted unique keys ``receiver * count + sender``, self-loops included."""
        receivers, senders = np.divmod(keys, count)
        names = tuple(range(count)) if labels is None else tuple(labels)
        if len(names) != count or len(set(names)) != count:
            raise TopologyError(f"{count} nodes need {count} different labels, got {len(set(names))} of {len(names)}")
        self.count = count
        self.senders = senders
        self.offsets = np.searchsorted(receivers, np.arange(count + 1))
        self.labels = names
        for array in (self.senders, self.offsets):
            array.setflags(write=False)
        self._sealed = True

    def __setattr__(self, name: str, value: Any) -> None:
        if getattr(self, "_sealed", False):
            raise AttributeError(f"a Network does not change; build a new one instead of setting {name!r}")
        super().__setattr__(name, value)

    @classmethod
    def from_edges(
        cls,
        edges: Iterable[tuple[Hashable, Hashable]],
        nodes: Iterable[Hashable] | None = None,
        *,
        undirected: bool = False,
    ) -> Network:
        """A network of named nodes from pairs (sender, receiver) of names.

        Args:
            edges: pairs of names.
            nodes: the names in the order of the node indices; by default in order of appearance.
            undirected: every pair is a link in both directions.

        Raises:
            TopologyError: an edge names a node that is not in `nodes`.
        """
        pairs = [(sender, receiver) for sender, receiver in edges]
        names = list(nodes) if nodes is not None else list(dict.fromkeys(name for pair in pairs for name in pair))
        index = {name: i for i, name in enumerate(names)}
        unknown = next((name for pair in pairs for name in pair if name not in index), None)
        if unknown is not None:
            raise TopologyError(f"an edge names node {unknown!r}, which is not among the {len(names)} nodes given")
        numbered = np.array([(index[j], index[i]) for j, i in pairs], dtype=np.int64).reshape(-1, 2)
        return cls(len(names), numbered, undirected=undirected, labels=names)

    @classmethod
    def from_networkx(cls, graph: networkx.Graph) -> Network:
        """A network from a networkx graph; an arc (u, v) of a digraph means that u sends to v.

        Node order and labels are those of ``graph.nodes``; an undirected graph gives links in both directions.
        """
        return cls.from_edges(
            ((edge[0], edge[1]) for edge in graph.edges()), graph.nodes, undirected=not graph.is_directed()
        )

    @classmethod
    def from_adjacency(cls, adjacency: ArrayLike, *, labels: Sequence[Hashable] | None = None) -> Network:
        """A network from a square matrix whose entry (i, j) is nonzero where j sends to i; the diagonal is ignored.

        Raises:
            TopologyError: the matrix is not square.
        """
        matrix = np.asarray(adjacency)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
            raise TopologyError(f"an adjacency matrix is square, got shape {matrix.shape}")
        receivers, senders = np.nonzero(matrix)
        return cls(matrix.shape[0], np.column_stack([senders, receivers]), labels=labels)

    def to_networkx(self) -> Any:
        """The same graph for networkx, without self-loops, nodes named by `labels`.

        Returns:
            A ``networkx.Graph`` if the network is undirected, else a ``networkx.DiGraph``.
        """
        import networkx

        graph = networkx.Graph() if self.is_undirected else networkx.DiGraph()
        graph.add_nodes_from(self.labels)
        graph.add_edges_from((self.labels[j], self.labels[i]) for j, i in self.edges)
        return graph

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Network):
            return NotImplemented
        return (
            self.labels == other.labels
            and np.array_equal(self.offsets, other.offsets)
            and np.array_equal(self.senders, other.senders)
        )

    def __hash__(self) -> int:
        return hash((self.count, self.senders.tobytes(), self.offsets.tobytes(), self.labels))

    def __repr__(self) -> str:
        kind = "undirected" if self.is_undirected else "directed"
        return f"Network({self.count} nodes, {len(self.edges)} directed links, {kind})"

    def _repr_html_(self) -> str:
        from problems.display import Table

        rows = [(label, self.names(self.in_neighborhood(i))) for i, label in enumerate(self.labels)]
        return Table(repr(self), ("node", "hears"), rows)._repr_html_()

    def index(self, label: Hashable) -> int:
        """Index of the node with this label.

        Raises:
            TopologyError: no node has it.
        """
        try:
            return self._index_of[label]
        except KeyError:
            raise TopologyError(f"no node is called {label!r}; nodes: {self.names(range(self.count))}") from None

    def names(self, nodes: Iterable[int]) -> str:
        """Labels of some nodes as text for a message, the first few and how many more."""
        listed = list(nodes)
        text = ", ".join(str(self.labels[i]) for i in listed[:_NAMES_SHOWN])
        return text if len(listed) <= _NAMES_SHOWN else f"{text} and {len(listed) - _NAMES_SHOWN} more"

    @cached_property
    def _index_of(self) -> dict[Hashable, int]:
        return {label: i for i, label in enumerate(self.labels)}

    @cached_property
    def receivers(self) -> np.ndarray:
        """(E + count,) receiver of every link, aligned with `senders`."""
        return _sealed(np.repeat(np.arange(self.count), np.diff(self.offsets)))

    @cached_property
    def edges(self) -> np.ndarray:
        """(E, 2) links (sender, receiver) between different nodes, sorted by receiver, then sender."""
        apart = self.senders != self.receivers
        return _sealed(np.column_stack([self.senders[apart], self.receivers[apart]]))

    @cached_property
    def in_degree(self) -> np.ndarray:
        """(count,) size n_S^i of every in-neighbourhood, the node itself included."""
        return _sealed(np.diff(self.offsets))

    @cached_property
    def out_degree(self) -> np.ndarray:
        """(count,) number d_j of nodes that hear node j, itself included."""
        return _sealed(np.bincount(self.senders, minlength=self.count))

    @cached_property
    def _outgoing(self) -> tuple[np.ndarray, np.ndarray]:
        order = np.argsort(self.senders, kind="stable")
        return self.receivers[order], np.concatenate([[0], np.cumsum(self.out_degree)])

    def in_neighborhood(self, node: int) -> np.ndarray:
        """Ascending indices of the nodes that `node` hears, itself included."""
        return self.senders[self.offsets[node] : self.offsets[node + 1]]

    def out_neighborhood(self, node: int) -> np.ndarray:
        """Ascending indices of the nodes that hear `node`, itself included."""
        receivers, offsets = self._outgoing
        return receivers[offsets[node] : offsets[node + 1]]

    def adjacency(self) -> csr_array:
        """(count, count) sparse pattern, 1.0 where column j sends to row i, self-loops included."""
        from scipy.sparse import csr_array

        return csr_array((np.ones(len(self.senders)), self.senders, self.offsets), shape=(self.count, self.count))

    @cached_property
    def is_undirected(self) -> bool:
        """Every link has its opposite."""
        return self._one_way() is None

    def _one_way(self) -> tuple[int, int] | None:
        forward = self.receivers * self.count + self.senders
        backward = np.sort(self.senders * self.count + self.receivers)
        only = np.flatnonzero(~np.isin(forward, backward, assume_unique=True))
        return None if not only.size else (int(self.senders[only[0]]), int(self.receivers[only[0]]))

    @cached_property
    def is_balanced(self) -> bool:
        """Every node hears as many nodes as hear it."""
        return bool(np.array_equal(self.in_degree, self.out_degree))

    @cached_property
    def is_strongly_connected(self) -> bool:
        """Every node reaches every other along directed links."""
        return len(self.components()) == 1

    def components(self, *, strong: bool = True) -> list[np.ndarray]:
        """Node indices of every strongly (or, with ``strong=False``, weakly) connected component."""
        from scipy.sparse.csgraph import connected_components

        found, member = connected_components(self.adjacency(), directed=True, connection="strong" if strong else "weak")
        order = np.argsort(member, kind="stable")
        parts = np.split(order, np.searchsorted(member[order], np.arange(1, found)))
        return sorted(parts, key=lambda part: int(part[0]))

    def distances(self, sources: ArrayLike | None = None) -> np.ndarray:
        """Hop counts of shortest directed paths.

        Args:
            sources: node indices; all nodes by default.

        Returns:
            (len(sources), count) integers, entry (s, i) = links from source s to node i, -1 where there is no path.
        """
        chosen = np.arange(self.count) if sources is None else np.atleast_1d(np.asarray(sources, dtype=np.int64))
        forward = self.adjacency().T.tocsr()
        return np.array([_hops(forward, int(source)) for source in chosen]).reshape(len(chosen), self.count)

    def within(self, steps: int) -> tuple[Network, np.ndarray]:
        """Everything that reaches a node along at most `steps` links.

        Source: dmhe-l-step, Definition 3.1 (N_l^i; here the node itself belongs to it).

        Args:
            steps: path length l >= 0.

        Returns:
            A network whose in-neighbourhoods are the l-step in-neighbourhoods of this one, and the hop count of each
            of its links, aligned with its `senders` (0 at self-loops).

        Raises:
            TopologyError: `steps` is negative.
        """
        if steps < 0:
            raise TopologyError(f"a neighbourhood of {steps} steps does not exist; steps must be at least 0")
        from scipy.sparse import csr_array, eye_array

        pattern = self.adjacency()
        frontier: Any = eye_array(self.count, format="csr")
        keys = np.arange(self.count, dtype=np.int64) * (self.count + 1)
        hops = np.zeros(self.count, dtype=np.int64)
        for distance in range(1, steps + 1):
            reached = csr_array(pattern @ frontier).tocoo()
            candidates = np.asarray(reached.row, dtype=np.int64) * self.count + reached.col
            new = np.setdiff1d(candidates, keys)
            if not new.size:
                break
            keys, hops = np.concatenate([keys, new]), np.concatenate([hops, np.full(new.size, distance)])
            rows, columns = np.divmod(new, self.count)
            frontier = csr_array((np.ones(new.size), (rows, columns)), shape=(self.count, self.count))
        order = np.argsort(keys)
        network = Network.__new__(Network)
        network._fill(self.count, keys[order], self.labels)
        return network, hops[order]

    @cached_property
    def diameter(self) -> int:
        """Largest hop count between two nodes.

        Raises:
            TopologyError: some node does not reach some other.
        """
        self.require_strongly_connected()
        backward = self.adjacency()
        forward = backward.T.tocsr()
        upper = np.full(self.count, self.count - 1)
        lower = np.zeros(self.count, dtype=np.int64)
        largest, central = 0, False
        # Bounds ecc(v) <= d(v, s) + ecc(s), ecc(v) >= d(v, s): alternately the likeliest end and the likeliest centre.
        while (open_nodes := np.flatnonzero(upper > largest)).size:
            pick = np.argmin(lower[open_nodes]) if central else np.argmax(upper[open_nodes])
            source = int(open_nodes[pick])
            eccentricity = int(_hops(forward, source).max())
            towards = _hops(backward, source)
            largest = max(largest, eccentricity)
            np.minimum(upper, towards + eccentricity, out=upper)
            np.maximum(lower, towards, out=lower)
            upper[source] = eccentricity
            central = not central
        return largest

    def require_strongly_connected(self) -> None:
        """Refuse a graph in which some node does not reach some other.

        Raises:
            TopologyError: names pairs without a path.
        """
        if self.is_strongly_connected:
            return
        adjacency = self.adjacency()
        missed = np.flatnonzero(_hops(adjacency.T.tocsr(), 0) < 0)
        if missed.size:
            first, last = self.names([0]), self.names(missed)
        else:
            first, last = self.names(np.flatnonzero(_hops(adjacency, 0) < 0)), self.names([0])
        sizes = sorted((len(part) for part in self.components()), reverse=True)
        raise TopologyError(
            f"the graph is not strongly connected: no path from node {first} to node {last} "
            f"({len(sizes)} strong components, the largest of {sizes[0]} of {self.count} nodes); "
            "add links, or estimate every component on its own"
        )

    def require_undirected(self, purpose: str) -> None:
        """Refuse a graph with a link that has no opposite; `purpose` says in the message who asks.

        Raises:
            TopologyError: names such a link.
        """
        link = self._one_way()
        if link is not None:
            sender, receiver = self.names([link[0]]), self.names([link[1]])
            raise TopologyError(
                f"{purpose}: the graph must be undirected, but node {sender} sends to node {receiver} without hearing "
                "it; add the opposite links or use uniform weights"
            )

    def require_balanced(self, purpose: str) -> None:
        """Refuse a graph in which a node hears more or fewer nodes than hear it.

        Raises:
            TopologyError: names such nodes.
        """
        unequal = np.flatnonzero(self.in_degree != self.out_degree)
        if unequal.size:
            node = int(unequal[0])
            raise TopologyError(
                f"{purpose} needs a balanced graph, but node {self.names([node])} hears {self.in_degree[node]} and is "
                f"heard by {self.out_degree[node]} nodes (itself included); unbalanced: {self.names(unequal)}"
            )


def _sealed(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def _hops(follow: Any, source: int) -> np.ndarray:
    """Links from `source` to every node along ``follow[u, v]`` (u to v), -1 where there is no path."""
    from scipy.sparse.csgraph import breadth_first_order

    order, before = breadth_first_order(follow, source)
    jump = np.where(before < 0, source, before).astype(np.int64)
    hops = (np.arange(len(jump)) != source).astype(np.int64)
    # Pointer doubling over the search tree: each pass doubles the stretch of path that is already counted.
    while (jump != source).any():
        hops += hops[jump]
        jump = jump[jump]
    reached = np.zeros(len(jump), dtype=bool)
    reached[order] = True
    return np.where(reached, hops, -1)
