"""The reference sensor field: positions, active nodes, links, model and truth of dmhe-l-step E2 and E3.

Positions, links and the active set of the published network are only in a picture; this one is drawn by a rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from problems.errors import TopologyError
from problems.models import LinearModel, Sensor
from problems.networks import Network, within_radius

DENSITY = 100.0  # nodes per square kilometre
RADIUS = 160.0  # m, nodes closer than this hear each other
DISTURBANCE = 0.5  # largest modulus of a component of w
NOISE = 10.0  # m, largest modulus of a component of v
PRIOR_INFORMATION = np.diag([1e-5, 1e-5, 1.0, 1.0])
SEEDS_TRIED = 1000

A = np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])
POSITION = np.eye(4)[:2]


@dataclass(frozen=True, eq=False)
class SensorField:
    """A network of nodes over a field, some of them with a position sensor.

    Attributes:
        positions: (count, 2) of the nodes (m).
        active: indices of the nodes with a sensor.
        network: who hears whom.
        model: x = (px, py, vx, vy) in m and m/s, one sensor per active node, prior and noise covariances of the source.
        placement: label of the node that each sensor belongs to.
        side: of the field (m).
        seed: that the positions were drawn with.
        drawn: nodes drawn; more than in the network where only its largest component was kept.
    """

    positions: np.ndarray
    active: np.ndarray
    network: Network
    model: LinearModel
    placement: tuple[int, ...]
    side: float
    seed: int
    drawn: int

    @cached_property
    def hops(self) -> np.ndarray:
        """(count,) hops from the nearest node with a sensor."""
        return self.network.distances(self.active).min(axis=0)


def sensor_field(
    seed: int = 1,
    nodes: int = 100,
    *,
    share: float = 0.1,
    radius: float = RADIUS,
    density: float = DENSITY,
    largest: bool = False,
) -> SensorField:
    """The reference network (seed 1, 100 nodes), or another one of the same density by the generator rule.

    Source: dmhe-l-step E2, chosen reference network.

    Args:
        seed: of ``numpy.random.default_rng``; increased until the graph is connected.
        nodes: how many are drawn.
        share: of the nodes that have a sensor, the first ones drawn.
        radius: m; strictly closer nodes are linked.
        density: nodes per square kilometre, which makes the side of the field.
        largest: instead of another seed, take the largest component: large fields of this density are never connected.

    Raises:
        TopologyError: no connected graph among a thousand seeds.
    """
    side = 1000.0 * float(np.sqrt(nodes / density))
    for tried in range(seed, seed + SEEDS_TRIED):
        positions = np.random.default_rng(tried).uniform(-side / 2, side / 2, (nodes, 2))
        network = within_radius(positions, radius, strict=True)
        active = np.arange(nodes) < max(1, round(share * nodes))
        if not network.is_strongly_connected:
            if not largest:
                continue
            kept = max(network.components(), key=len)
            positions, active = positions[kept], active[kept]
            network = within_radius(positions, radius, strict=True)
        sensing = np.flatnonzero(active)
        return SensorField(
            positions=positions,
            active=sensing,
            network=network,
            model=field_model(sensing.tolist()),
            placement=tuple(sensing.tolist()),
            side=side,
            seed=tried,
            drawn=nodes,
        )
    raise TopologyError(
        f"no connected field of {nodes} nodes within {radius:g} m among {SEEDS_TRIED} seeds from {seed} on; raise the "
        "radius, or take the largest component (largest=True)"
    )


def field_model(active: list[int]) -> LinearModel:
    """The moving target and one position sensor per active node.

    Source: dmhe-l-step E2; covariances of uniform noises are a third of their squared bounds.
    """
    noise = NOISE**2 / 3 * np.eye(2)
    return LinearModel(
        A,
        DISTURBANCE**2 / 3 * np.eye(4),
        sensors=[Sensor(f"node {node}", POSITION, covariance=noise) for node in active],
        mean=np.zeros(4),
        covariance=np.linalg.inv(PRIOR_INFORMATION),
        state_names=("px", "py", "vx", "vy"),
        dt=1.0,
    )


@dataclass(frozen=True, eq=False)
class FieldTrial:
    """Truth and measurements of one trial.

    Attributes:
        states: (duration + 1, 4).
        measurements: (duration + 1, p) of all sensors in the order of the model.
    """

    states: np.ndarray
    measurements: np.ndarray


def draw_trial(field: SensorField, duration: int, rng: np.random.Generator) -> FieldTrial:
    """A target from a uniform first state on, with uniform disturbances and measurement noise.

    Source: dmhe-l-step E2, E3 (first state: over the field, velocities up to 1 m/s).

    Args:
        field: the network.
        duration: seconds, which are steps.
        rng: of all draws.
    """
    states = np.empty((duration + 1, 4))
    reach = field.side / 2
    states[0] = rng.uniform([-reach, -reach, -1, -1], [reach, reach, 1, 1])
    for k in range(duration):
        states[k + 1] = A @ states[k] + rng.uniform(-DISTURBANCE, DISTURBANCE, 4)
    clean = states @ field.model.C.T
    return FieldTrial(states, clean + rng.uniform(-NOISE, NOISE, clean.shape))


def prmse(estimates: np.ndarray, states: np.ndarray) -> np.ndarray:
    """PRMSE(t): mean over the nodes of the norms of their position errors (m), [I2 0] at every node (errata 2).

    Args:
        estimates: (..., steps, count, 4).
        states: (..., steps, 4).

    Returns:
        (..., steps).
    """
    return np.linalg.norm(estimates[..., :2] - states[..., None, :2], axis=-1).mean(axis=-1)
