"""Standard graphs, regular and random. Every random draw comes from the generator passed in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import TopologyError
from problems.networks.network import Network

_ATTEMPTS = 1000

Connect = Literal["component", "radius"]


def complete(count: int) -> Network:
    """Every node hears every other."""
    return Network.from_adjacency(np.ones((count, count)))


def line(count: int) -> Network:
    """Undirected path 0 - 1 - ... - (count - 1)."""
    return circulant(count, [1], closed=False)


def ring(count: int, *, directed: bool = False) -> Network:
    """Cycle; with `directed`, node i sends to node i + 1 only."""
    return circulant(count, [1], directed=directed)


def star(count: int) -> Network:
    """Undirected star with node 0 in the middle."""
    others = np.arange(1, count)
    return Network(count, np.column_stack([np.zeros_like(others), others]), undirected=True)


def band(count: int, width: int) -> Network:
    """Undirected graph in which nodes i and j are linked iff ``|i - j| <= width``.

    Source: dmhe-sporadic-fov 6.2 (Definition 4.3, radius in node numbering).
    """
    return circulant(count, range(1, width + 1), closed=False)


def circulant(count: int, offsets: Sequence[int], *, directed: bool = False, closed: bool = True) -> Network:
    """Node i sends to nodes i + offset, indices taken modulo `count`.

    Args:
        count: number of nodes.
        offsets: steps in the numbering; m different offsets below count / 2 give an undirected 2m-regular graph.
        directed: leave the opposite links out.
        closed: wrap around; otherwise links that would leave 0..count-1 are absent.
    """
    nodes, steps = np.arange(count)[:, None], np.asarray(offsets, dtype=np.int64).reshape(1, -1)
    senders, receivers = np.broadcast_arrays(nodes, nodes + steps)
    edges = np.column_stack([senders.ravel(), receivers.ravel()])
    edges = edges % count if closed else edges[(edges[:, 1] >= 0) & (edges[:, 1] < count)]
    return Network(count, edges, undirected=not directed)


def lattice(shape: Sequence[int], *, diagonal: bool = False) -> Network:
    """Undirected rectangular grid in any dimension; node index = row-major index of the grid point.

    Args:
        shape: points per axis.
        diagonal: link also the diagonal neighbours.
    """
    return _grid(shape, diagonal=diagonal, closed=False)


def torus(shape: Sequence[int]) -> Network:
    """Undirected rectangular grid that wraps around on every axis."""
    return _grid(shape, diagonal=False, closed=True)


def _grid(shape: Sequence[int], *, diagonal: bool, closed: bool) -> Network:
    sizes = np.asarray(shape, dtype=np.int64)
    if sizes.ndim != 1 or not sizes.size or (sizes < 1).any():
        raise TopologyError(f"a grid needs at least one point on every axis, got shape {tuple(shape)}")
    points = np.indices(tuple(sizes)).reshape(len(sizes), -1).T
    steps = np.indices((3,) * len(sizes)).reshape(len(sizes), -1).T - 1
    length = np.abs(steps).sum(axis=1)
    steps = steps[(length > 0) if diagonal else (length == 1)]
    edges = []
    for step in steps:
        target = points + step
        inside = np.full(len(points), True) if closed else ((target >= 0) & (target < sizes)).all(axis=1)
        pair = np.stack([points[inside], target[inside] % sizes])
        edges.append(np.stack([np.ravel_multi_index(tuple(end.T), tuple(sizes)) for end in pair], axis=1))
    return Network(int(sizes.prod()), np.concatenate(edges))


def within_radius(positions: ArrayLike, radius: float, *, strict: bool = False) -> Network:
    """Undirected graph linking nodes no further apart than `radius`.

    Args:
        positions: (count, dimension), metres.
        radius: metres.
        strict: link only nodes closer than `radius` (dmhe-l-step E2) instead of up to it (target-tracking-dkns 3.3).

    Raises:
        TopologyError: positions are not finite numbers of shape (count, dimension), or the radius is negative.
    """
    from scipy.spatial import KDTree

    points = np.asarray(positions, dtype=float)
    if points.ndim != 2 or not np.isfinite(points).all():
        raise TopologyError(f"positions are finite numbers of shape (count, dimension), got shape {points.shape}")
    if not radius >= 0:
        raise TopologyError(f"a radius is at least 0, got {radius}")
    near = KDTree(points).query_pairs(radius * (1 + 1e-9), output_type="ndarray").reshape(-1, 2)
    apart = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1)
    return Network(len(points), near[(apart < radius) if strict else (apart <= radius)], undirected=True)


def random_geometric(
    count: int,
    radius: float,
    rng: np.random.Generator,
    *,
    low: ArrayLike = 0.0,
    high: ArrayLike = 1.0,
    dimension: int = 2,
    strict: bool = False,
) -> tuple[Network, np.ndarray]:
    """Uniform random positions linked within a radius, redrawn until the graph is connected.

    Args:
        count: number of nodes.
        radius: metres.
        rng: source of the positions.
        low: lower corner of the field, metres, a number or (dimension,).
        high: upper corner.
        dimension: of the positions.
        strict: as in `within_radius`.

    Returns:
        The network and the positions (count, dimension).

    Raises:
        TopologyError: no connected graph among a thousand draws.
    """
    positions = np.empty((0, dimension))

    def draw() -> Network:
        nonlocal positions
        positions = rng.uniform(np.asarray(low, dtype=float), np.asarray(high, dtype=float), (count, dimension))
        return within_radius(positions, radius, strict=strict)

    network = draw_connected(draw)
    return network, positions


def random_field(
    count: int,
    radius: float,
    rng: np.random.Generator,
    *,
    density: float,
    connect: Connect = "component",
    reference: int = 100,
    strict: bool = False,
) -> tuple[Network, np.ndarray, np.ndarray]:
    """Uniform random positions in a square of constant density, linked within a radius, for any number of nodes.

    At constant density and radius large graphs are practically never connected: either the largest component is kept,
    or the radius grows with ``sqrt(ln count)``, which keeps the chance of a connected graph, and then is redrawn until
    it is.

    Args:
        count: nodes drawn.
        radius: metres; with ``connect="radius"`` that of a network of `reference` nodes.
        rng: source of the positions.
        density: nodes per square metre.
        connect: ``component`` or ``radius``.
        reference: see `radius`.
        strict: as in `within_radius`.

    Returns:
        The network, the positions (nodes, 2) around the origin, and which of the drawn nodes (nodes,) are in it.

    Raises:
        TopologyError: no nodes, a density that is not positive, no such rule, no connected graph in a thousand draws.
    """
    if count < 1 or not density > 0 or connect not in get_args(Connect):
        raise TopologyError(
            f"a field needs nodes, a positive density and connect='component' or 'radius', got {count} node(s), "
            f"density {density:g}, connect={connect!r}"
        )
    half = np.sqrt(count / density) / 2
    if connect == "radius":
        grown = radius * float(np.sqrt(np.log(max(count, 2)) / np.log(max(reference, 2))))
        network, positions = random_geometric(count, grown, rng, low=-half, high=half, strict=strict)
        return network, positions, np.arange(count)
    positions = rng.uniform(-half, half, (count, 2))
    kept = max(within_radius(positions, radius, strict=strict).components(), key=len)
    return within_radius(positions[kept], radius, strict=strict), positions[kept], kept


def erdos_renyi(count: int, probability: float, rng: np.random.Generator) -> Network:
    """Undirected graph in which every pair is linked independently with `probability`."""
    upper = _draw_distinct(count * (count - 1) // 2, probability, rng)
    # Pair number m lies in row r of the strictly lower triangle, which starts at r (r - 1) / 2.
    rows = ((1 + np.sqrt(1 + 8 * upper.astype(float))) / 2).astype(np.int64)
    rows -= rows * (rows - 1) // 2 > upper
    rows += rows * (rows + 1) // 2 <= upper
    return Network(count, np.column_stack([upper - rows * (rows - 1) // 2, rows]), undirected=True)


def random_digraph(count: int, probability: float, rng: np.random.Generator) -> Network:
    """Digraph in which every ordered pair is linked independently with `probability`."""
    chosen = _draw_distinct(count * (count - 1), probability, rng)
    senders, rest = np.divmod(chosen, max(count - 1, 1))
    return Network(count, np.column_stack([senders, rest + (rest >= senders)]))


def _draw_distinct(population: int, probability: float, rng: np.random.Generator) -> np.ndarray:
    if not 0 <= probability <= 1:
        raise TopologyError(f"a link probability lies in [0, 1], got {probability}")
    return np.sort(rng.choice(population, rng.binomial(population, probability), replace=False)).astype(np.int64)


def random_regular(count: int, degree: int, rng: np.random.Generator) -> Network:
    """Random undirected graph in which every node has `degree` neighbours besides itself.

    Raises:
        TopologyError: no such graph exists (count * degree odd, or degree >= count).
    """
    import networkx

    if not 0 <= degree < count or count * degree % 2:
        raise TopologyError(
            f"no graph of {count} nodes has {degree} neighbours at every node; "
            "count * degree must be even and degree less than count"
        )
    return Network(count, list(networkx.random_regular_graph(degree, count, seed=rng).edges()), undirected=True)


def draw_connected(draw: Callable[[], Network], attempts: int = _ATTEMPTS) -> Network:
    """Call `draw` until it returns a strongly connected network.

    Raises:
        TopologyError: none of `attempts` draws was.
    """
    for _ in range(attempts):
        network = draw()
        if network.is_strongly_connected:
            return network
    raise TopologyError(f"no strongly connected graph in {attempts} draws; raise the radius, degree or probability")
