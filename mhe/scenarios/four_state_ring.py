"""Scenario ``four-state-ring``: four nodes on a directed ring, two of which observe only a part (spec 6.1)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
import pydantic

from mhe.observers import place_gain
from mhe.polyhedron import Polyhedron
from mhe.scenarios._network_runs import NetworkScenario
from mhe.scenarios._network_world import X1, X3, A, Drawn, Gains, NetworkSettings, World, consensus_weights
from problems.bench.scenario import DISTANCE
from problems.models import simulate
from problems.networks import Network

SETTLED = 5  # t_c, first instant that (2.34) counts
OUTPUTS = {1: X1, 2: X1, 3: X3, 4: X3}
# Printed in spec 6.1. Pole placement with two outputs is not unique, and the mean errors depend on the choice.
CENTRAL_GAIN = np.array(
    [
        [-0.010952, -0.010952, 0.000129, 0.000129],
        [0.136488, 0.136488, -0.000229, -0.000229],
        [0.001491, 0.001491, 0.190002, 0.190002],
        [0.001786, 0.001786, 0.086202, 0.086202],
    ]
)
OBSERVABLE_GAIN = np.array([[-0.021903, -0.000248], [0.272975, 0.000441], [-0.002865, 0.380003], [-0.003432, 0.172404]])
GAINS = {
    1: OBSERVABLE_GAIN,
    2: np.array([[0.174050, 0.174050], [-0.062841, -0.062841], [0.0, 0.0], [0.0, 0.0]]),
    3: OBSERVABLE_GAIN,
    4: np.array([[0.0, 0.0], [0.0, 0.0], [0.240000, 0.240000], [0.150200, 0.150200]]),
}
LITERAL = (1.17 + 0.98j, 1.17 - 0.98j)  # Table 2.1, row 4 (E4)


class Settings(NetworkSettings):
    """Settings of the scenario."""

    duration: int = pydantic.Field(20, gt=SETTLED, le=10_000, description="t_f, steps")
    gains: Literal["printed", "place", "literal", "kalman"] = pydantic.Field(
        "printed",
        description="of pre-estimation: as printed in spec 6.1, placed anew, with row 4 of Table 2.1, or Kalman gains",
    )


class FourStateRing(NetworkScenario):
    """See the module."""

    name = "four-state-ring"
    source = "spec dmhe-pre-estimation 6.1; rmse as (2.34), of a network the mean over its nodes"
    metrics = ("rmse", "rmse_1", "rmse_2", "rmse_3", "rmse_4", DISTANCE)
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        made = simulate(_world().model, settings.duration, rng)
        largest = np.abs(made.states).max(axis=0)
        return Drawn(made.states, made.measurements, Polyhedron.box(-largest, largest))

    def world(self, settings: Settings) -> World:
        return _world()

    def gains(self, settings: Settings, world: World) -> Gains:
        if settings.gains == "kalman":
            return Gains(None, None)
        if settings.gains == "place":
            return Gains(
                world.placed_gain(world.central.C).gain, [world.placed_gain(output) for output in world.regional]
            )
        nodes: list[Any] = list(GAINS.values())
        if settings.gains == "literal":
            nodes[3] = place_gain(A, world.regional[3], LITERAL)
        return Gains(CENTRAL_GAIN, nodes)

    def weights(self, settings: Settings, world: World, method: str) -> dict[str, Any]:
        return {} if method == "dmhe_w_pre" else consensus_weights(world.network, settings.weights)

    def score(self, errors: np.ndarray) -> dict[str, float | None]:
        each = np.sqrt((errors[SETTLED:] ** 2).sum(axis=0) / (len(errors) - 1 - SETTLED))
        metrics: dict[str, float | None] = {"rmse": float(each.mean())}
        if each.size > 1:
            metrics |= {f"rmse_{k + 1}": float(value) for k, value in enumerate(each)}
        return metrics


@lru_cache(maxsize=1)
def _world() -> World:
    network = Network.from_edges([(4, 1), (1, 2), (2, 3), (3, 4)], OUTPUTS)
    return World.of(network, OUTPUTS, central=tuple(OUTPUTS), variance=1.0)


scenario = FourStateRing()
