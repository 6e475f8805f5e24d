"""Networks of nodes that relay, for several test files."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from mhe.relay import RelayEstimator, RelayWindows
from mhe.scenarios.sensor_field_world import POSITION, A, field_model
from problems.models import LinearModel, Sensor
from problems.networks import Network, random_digraph, ring

RING = ring(4, directed=True)


WINDOWS = RelayWindows()


def on_ring(l: int = 3, **options: Any) -> RelayEstimator:
    options = {"horizon": 3, "weights": "uniform", **options}
    return RelayEstimator(field_model([0]), RING, "dmhe_l_pre", placement=[0], l=l, windows=WINDOWS, **options)


def small(seed: int = 5, count: int = 9) -> tuple[LinearModel, Network, list[int]]:
    """A random digraph with different sensors at some nodes, one of which has two."""
    rng = np.random.default_rng(seed)
    network = next(g for g in (random_digraph(count, 0.25, rng) for _ in range(100)) if g.is_strongly_connected)
    B = np.array([[0.5, 0], [0, 0.5], [1, 0], [0, 1]])
    sensors = [
        Sensor("a", POSITION, sigma=3.0),
        Sensor("b", [[1.0, 0, 0, 0]], sigma=2.0),
        Sensor("c", [[1.0, 1, 0, 0], [0, 1, 0, 1]], covariance=[[4.0, 1], [1, 3]]),
        Sensor("d", [[0, 0, 0, 1.0]], sigma=0.5),
        Sensor("e", POSITION, sigma=3.0),
    ]
    model = LinearModel(A, 0.1 * np.eye(4), B, sensors=sensors, covariance=np.diag([100.0, 100, 1, 1]))
    return model, network, [0, 3, 5, 5, 7]


@cache
def recorded(steps: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    model = small()[0]
    rng = np.random.default_rng(2)
    x, states, inputs = rng.normal(size=4) * [10, 10, 1, 1], [], rng.normal(size=(steps - 1, 2))
    for k in range(steps):
        if k:
            x = A @ x + model.B @ inputs[k - 1] + 0.3 * rng.normal(size=4)
        states.append(x)
    clean = np.array(states) @ model.C.T
    return np.array(states), clean + 2 * rng.normal(size=clean.shape), inputs
