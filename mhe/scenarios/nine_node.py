"""Scenario ``nine-node``: nine nodes, three of which measure nothing, started far from the prior (spec 6.2)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
import pydantic

from mhe.polyhedron import Polyhedron
from mhe.scenarios._network_runs import NetworkScenario
from mhe.scenarios._network_world import X1, X3, A, Drawn, Gains, NetworkSettings, World, consensus_weights
from problems.bench.scenario import DISTANCE
from problems.models import simulate
from problems.networks import Network, draw_connected, erdos_renyi, observability_report

NODES = tuple(range(1, 10))
OUTPUTS = {1: X1, 2: X1, 6: X1, 3: X3, 4: X3, 9: X3}
EDGES = (
    (1, 2), (1, 5), (1, 6), (2, 3), (2, 4), (3, 4), (3, 6), (3, 9), (4, 8), (4, 9), (5, 6), (5, 7), (7, 8), (8, 9),
)  # fmt: skip
CYCLE = (1, 2, 3, 4, 9, 8, 7, 5, 6)
DENSITY = 0.35  # of random graphs, about that of the default one
CLASSES = {"green", "yellow", "orange", "red"}
REACH = 100.0  # |x_0| per component
TRANSIENT = 9  # last instant of the transient


class Settings(NetworkSettings):
    """Settings of the scenario."""

    horizon: int = pydantic.Field(4, ge=1, le=100, description="N, transitions in the window")
    duration: int = pydantic.Field(50, gt=TRANSIENT, le=10_000, description="t_f, steps")
    case: Literal[1, 2] = pydantic.Field(
        1, description="2: all distributed methods mix rank weights and those of `weights` (2.38)"
    )
    share: float = pydantic.Field(1.0, ge=0, le=1, description="epsilon, the share of rank weights in case 2")
    graph: Literal["default", "cycle", "random"] = "default"
    graph_seed: int = pydantic.Field(0, ge=0, description="of graph=random, drawn until it shows all four classes")
    gains: Literal["place", "kalman"] = pydantic.Field("place", description="of pre-estimation")
    central: Literal["two", "all"] = pydantic.Field(
        "two", description="measurements the centralized methods are given: of nodes 1 and 3 as in the source, or all"
    )
    prior_variance: float = pydantic.Field(
        1.0, gt=0, description="Pi_0 / I; 1 as in the source contradicts |x_0| <= 100, 3333 matches it"
    )

    @pydantic.model_validator(mode="after")
    def _case(self) -> Settings:
        if self.case == 2 and self.weights not in ("uniform", "metropolis"):
            raise ValueError(f"case=2 mixes rank weights with uniform or metropolis ones, not with {self.weights}")
        if self.case == 1 and self.share != 1:
            raise ValueError(f"share={self.share:g} belongs to case=2")
        return self


class NineNode(NetworkScenario):
    """See the module."""

    name = "nine-node"
    source = (
        "spec dmhe-pre-estimation 6.2; sums of the mean error norm over the nodes: transient t = 1 to 9, steady from "
        "t = 10, total both"
    )
    metrics = ("transient", "steady", "total", DISTANCE)
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        initial = rng.uniform(-REACH, REACH, 4)
        made = simulate(self.world(settings).model, settings.duration, rng, initial=initial)
        # x3 and x4 grow, so bounds on magnitudes hold nothing until the end; x1 and x2 end at one side of their range
        box = Polyhedron.box(made.states.min(axis=0), made.states.max(axis=0))
        return Drawn(made.states, made.measurements, box)

    def world(self, settings: Settings) -> World:
        return _world(settings.graph, settings.graph_seed, settings.central, settings.prior_variance)

    def gains(self, settings: Settings, world: World) -> Gains:
        if settings.gains == "kalman":
            return Gains(None, None)
        return Gains(world.placed_gain(world.central.C).gain, [world.placed_gain(output) for output in world.regional])

    def weights(self, settings: Settings, world: World, method: str) -> dict[str, Any]:
        if settings.case == 2:
            return {"weights": "mixed", "share": settings.share, "reference": settings.weights}
        return {} if method == "dmhe_w_pre" else consensus_weights(world.network, settings.weights)

    def score(self, errors: np.ndarray) -> dict[str, float | None]:
        mean = errors.mean(axis=1)
        transient, steady = float(mean[1 : TRANSIENT + 1].sum()), float(mean[TRANSIENT + 1 :].sum())
        return {"transient": transient, "steady": steady, "total": transient + steady}


def graph(kind: str, seed: int = 0) -> Network:
    """The default graph, the cycle, or a random graph that shows all four observability classes."""
    if kind == "default":
        return Network.from_edges(EDGES, NODES, undirected=True)
    if kind == "cycle":
        return Network.from_edges(zip(CYCLE, (*CYCLE[1:], CYCLE[0]), strict=True), NODES, undirected=True)
    rng = np.random.default_rng(seed)
    outputs = [OUTPUTS.get(node, np.zeros((0, 4))) for node in NODES]
    while True:
        drawn = draw_connected(lambda: erdos_renyi(len(NODES), DENSITY, rng))
        if CLASSES == set(observability_report(drawn, A, outputs).classes):
            return Network(drawn.count, drawn.edges, labels=NODES)


@lru_cache(maxsize=64)
def _world(kind: str, seed: int, central: str, variance: float) -> World:
    given = (1, 3) if central == "two" else tuple(OUTPUTS)
    return World.of(graph(kind, seed), OUTPUTS, given, variance)


scenario = NineNode()
