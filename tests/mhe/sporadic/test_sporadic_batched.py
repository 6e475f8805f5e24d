"""All nodes in many trials on arrays: equal to the nodes that send messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.sporadic import BatchedDetections, SporadicEstimator
from problems.errors import DataError, ShapeError
from problems.models import LinearModel, Sensor
from problems.networks import Network, band
from problems.solvers.base import Status

STEPS = 14
ONE_WAY = Network(5, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (2, 0)])


def compared(estimator: SporadicEstimator, values: np.ndarray) -> list[Any]:
    """Steps of the batch on values (trials, steps, ...), after they were compared with those of the nodes."""
    trials = len(values)
    batch = BatchedDetections(estimator.design, trials)
    singles = []
    for trial in range(trials):
        estimator.reset()
        singles.append([estimator.step(y) for y in values[trial]])
    steps = [batch.step(values[:, k]) for k in range(values.shape[1])]
    for k, step in enumerate(steps):
        for trial in range(trials):
            single = singles[trial][k]
            np.testing.assert_allclose(step.states[trial], single.states, rtol=1e-9, atol=1e-9)
            assert tuple(step.status[trial]) == single.status
            assert step.unmet[trial].any(axis=1).tolist() == [bool(node.infeasible) for node in single.nodes]
    return steps


def readings(scene: Any, trials: int = 3, **more: Any) -> np.ndarray:
    return np.stack([scene.readings(STEPS, np.random.default_rng(trial), **more) for trial in range(trials)])


@pytest.mark.parametrize("method", ["dmhe_w_pre", "dmhe_w_pre_s", "dmhe_f", "dmhe_f_s"])
def test_the_four_methods(scene: Any, method: str) -> None:
    compared(scene.build(method), readings(scene))


@pytest.mark.parametrize(
    "options",
    [
        {"observer": "regional", "weights": "uniform", "pi_update": "exact", "growth_prior": "consensus"},
        {"prior": "filter", "pi_update": "onestep", "growth_prior": "mean", "horizon": 1},
        {"rows": "projected", "observer": "regional", "gains": 0.9},
        {"rows": "projected", "gains": 0.9},
        {"disturbance": "process_noise", "gains": None, "weight_fusion": "in_degree", "covariance_cap": 50.0},
    ],
)
@pytest.mark.filterwarnings("ignore:weight_fusion='in_degree':problems.errors.ModelWarning")
def test_options(scene: Any, options: dict[str, Any]) -> None:
    compared(scene.build("dmhe_w_pre_s", ONE_WAY, **options), readings(scene))


@pytest.mark.parametrize(
    "options",
    [
        {"unmet": "soft"},
        {"unmet": "predict"},
        {"rows": "soft"},
        {"rows": "soft", "penalty": 1.0},
        {"row_scope": "regional"},
    ],
)
def test_rows_that_contradict_each_other(scene: Any, options: dict[str, Any]) -> None:
    steps = compared(scene.build("dmhe_w_pre_s", gains=0.9, **options), readings(scene, sigma=1.5))
    assert sum((step.status == Status.INFEASIBLE).sum() for step in steps) > 5


def two_kinds() -> tuple[LinearModel, list[Polyhedron]]:
    """Two double integrators with different disturbances, seen by position with full R."""
    A, G = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.125], [0.5]])
    R = np.array([[0.5, 0.2], [0.2, 0.4]])
    both = np.kron(np.eye(2), A), np.kron(np.eye(2), G)
    sees = np.kron(np.eye(2), [[1.0, 0.0]])  # x, y of a vehicle with states (x, vx, y, vy)
    sensors = [
        Sensor(f"c{i} v{v}", np.hstack([np.zeros((2, 4 * v)), sees, np.zeros((2, 4 - 4 * v))]), covariance=(1 + i) * R)
        for i in range(3)
        for v in range(2)
    ]
    model = LinearModel(
        np.kron(np.eye(2), both[0]),
        np.diag([0.3, 0.3, 2.0, 2.0]),
        G=np.kron(np.eye(2), both[1]),
        sensors=sensors,
        mean=np.zeros(8),
        covariance=50 * np.eye(8),
    )
    return model, [Polyhedron.box([-1.0 - i, -1.0], [1.0, 1.0]) for i in range(3)]


@pytest.mark.parametrize("method", ["dmhe_w_pre_s", "dmhe_f_s"])
def test_parts_that_differ(method: str) -> None:
    model, fields = two_kinds()
    values = np.random.default_rng(3).normal(size=(2, STEPS, 3, 2, 2))
    values[np.random.default_rng(4).random(values.shape[:4]) < 0.4] = np.nan
    compared(SporadicEstimator(model, band(3, 1), method, fields=fields), values)


def test_reset_starts_again(scene: Any) -> None:
    values = readings(scene, 2)
    batch = BatchedDetections(scene.build("dmhe_w_pre_s").design, 2)
    first = [batch.step(values[:, k]).states for k in range(STEPS)]
    batch.reset()
    np.testing.assert_array_equal(first, [batch.step(values[:, k]).states for k in range(STEPS)])


def test_flags_and_wrong_input(scene: Any) -> None:
    design = scene.build("dmhe_w_pre").design
    values = readings(scene, 2)
    flags = ~np.isnan(values[..., 0])
    batch, other = BatchedDetections(design, 2), BatchedDetections(design, 2)
    placeholder = np.where(np.isnan(values), 77.0, values)
    for k in range(STEPS):
        np.testing.assert_array_equal(
            batch.step(values[:, k]).states, other.step(placeholder[:, k], flags[:, k]).states
        )
    with pytest.raises(ShapeError, match="2 trial"):
        batch.step(values[:1, 0])
    with pytest.raises(DataError, match="trial 0, time step .* flag 1"):
        batch.step(values[:, 0], np.ones_like(flags[:, 0]))
    with pytest.raises(DataError, match="at least one trial"):
        BatchedDetections(design, 0)
