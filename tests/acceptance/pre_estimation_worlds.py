"""Models, gains and networks of the spec. Its matrices are written out here once more, so that a wrong number in a
scenario does not excuse itself.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import numpy as np

from mhe.distributed import NetworkDesign
from mhe.observers import place_gain
from problems import LinearModel, Sensor, simulate
from problems.errors import ModelWarning
from problems.networks import (
    Network,
)

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])


Q = np.diag([0.0012, 0.038, 0.0012, 0.038])


X1, X3 = [[1.0, 0, 0, 0]], [[0, 0, 1.0, 0]]


CENTRAL = np.array(
    [[-0.010952] * 2 + [0.000129] * 2, [0.136488] * 2 + [-0.000229] * 2]
    + [[0.001491] * 2 + [0.190002] * 2, [0.001786] * 2 + [0.086202] * 2]
)


GREEN = np.array([[-0.021903, -0.000248], [0.272975, 0.000441], [-0.002865, 0.380003], [-0.003432, 0.172404]])


PRINTED = [
    GREEN,
    np.array([[0.174050] * 2, [-0.062841] * 2, [0.0] * 2, [0.0] * 2]),
    GREEN,
    np.array([[0.0] * 2, [0.0] * 2, [0.24] * 2, [0.1502] * 2]),
]


RING_K = [[0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]]


EDGES = "1-2 1-5 1-6 2-3 2-4 3-4 3-6 3-9 4-8 4-9 5-6 5-7 7-8 8-9"


NINE = {**dict.fromkeys((1, 2, 6), X1), **dict.fromkeys((3, 4, 9), X3)}


CHOSEN = {
    (True, True): [0.9, 0.6, 0.7, 0.8],
    (True, False): [0.45, 0.58],
    (False, True): [0.7, 0.8],
    (False, False): [],
}


# The two examples of section 6
def model_of(outputs: Any, variance: float = 1.0, **other: Any) -> LinearModel:
    sensors = [Sensor(f"s{k}", C, covariance=1.0) for k, C in enumerate(outputs)]
    return LinearModel(A, other.pop("Q", Q), sensors=sensors, mean=np.zeros(4), covariance=variance * np.eye(4))


def ring_model() -> LinearModel:
    return model_of([X1, X1, X3, X3])


def ring_network() -> Network:
    return Network.from_edges([(4, 1), (1, 2), (2, 3), (3, 4)], nodes=[1, 2, 3, 4])


def ring_design(method: str, **options: Any) -> NetworkDesign:
    weights: dict[str, Any] = {"weights": "given", "weight_matrix": RING_K} if "weights" not in options else {}
    if method == "dmhe_f":
        return NetworkDesign(ring_model(), ring_network(), method, **weights, **options)
    return NetworkDesign(ring_model(), ring_network(), method, **({"gains": PRINTED} | weights | options))


def graph_of(text: str) -> Network:
    pairs = [tuple(int(end) for end in pair.split("-")) for pair in text.split()]
    return Network.from_edges(pairs, nodes=range(1, 10), undirected=True)


def nine_outputs() -> list[Any]:
    return [NINE.get(node, [[0.0] * 4]) for node in range(1, 10)]


def nine_gains(network: Network) -> list[Any]:
    found = []
    for node in range(9):
        C = np.vstack([nine_outputs()[j] for j in network.in_neighborhood(node)])
        found.append(place_gain(A, C, CHOSEN[bool(C[:, 0].any()), bool(C[:, 2].any())]))
    return found


def nine_design(network: Network, method: str, variance: float = 1.0, **options: Any) -> NetworkDesign:
    gains = {} if method == "dmhe_f" else {"gains": nine_gains(network)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return NetworkDesign(model_of(nine_outputs(), variance), network, method, **({"horizon": 4} | gains | options))


def nine_trials(trials: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    return simulate(model_of(nine_outputs()), 50, rng, initial=rng.uniform(-100, 100, (trials, 4)), trials=trials)


def responses(estimator: Any, steps: int) -> np.ndarray:
    """An unconstrained estimator with mu_0 = 0 is a linear map: (steps + 1, n, steps + 1, p) from y to x_{t|t}."""
    p = estimator.model.measurement_size
    found = np.zeros((steps + 1, 4, steps + 1, p))
    for k in range(steps + 1):
        for row in range(p):
            y = np.zeros((steps + 1, p))
            y[k, row] = 1.0
            estimator.reset()
            found[:, :, k, row] = [estimator.step(now).state for now in y]
    return found


def applied(maps: np.ndarray, measurements: np.ndarray) -> np.ndarray:
    """(trials, steps + 1, n) estimates of all trials."""
    return np.einsum("tnkp,ikp->itn", maps, measurements, optimize=True)


@cache
def ring_trials() -> Any:
    return simulate(ring_model(), 20, np.random.default_rng(20), trials=2000)


def rmse(states: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(2.34) of estimates (..., 21, 4)."""
    return np.sqrt((np.linalg.norm(states - truth, axis=-1)[..., 5:] ** 2).sum(axis=-1) / 15)
