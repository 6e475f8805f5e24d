"""All nodes in arrays equal message passing: l-step methods on any model and graph (design 3.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mhe.distributed import DistributedEstimator, NetworkDesign, run_trials
from mhe.polyhedron import Polyhedron
from mhe.relay import RelayDesign, RelayEstimator
from mhe.relay.engine import RelayNetwork, run_relay_trials
from problems.errors import DataError, ShapeError
from problems.models import LinearModel, Sensor, simulate
from problems.networks import Network, random_digraph, random_geometric, ring
from problems.solvers.base import Status

A = np.block([[np.eye(2), np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
POSITION = np.eye(2, 4)

pytestmark = pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")


def small(seed: int = 5, count: int = 9) -> tuple[LinearModel, Network, list[int]]:
    """A random digraph with inputs and different sensors, one node with two of them, one sensor correlated."""
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


def seven_states() -> tuple[LinearModel, Network, list[int]]:
    """A random stable model of seven states; nine sensors at thirty nodes of a digraph."""
    rng = np.random.default_rng(11)
    network = next(g for g in (random_digraph(30, 0.12, rng) for _ in range(500)) if g.is_strongly_connected)
    half = rng.normal(size=(7, 7))
    state = 0.97 * half / np.abs(np.linalg.eigvals(half)).max()
    sensors = [Sensor(f"s{k}", rng.normal(size=(1 + k % 3, 7)), sigma=1.0) for k in range(9)]
    model = LinearModel(state, 0.1 * np.eye(7), sensors=sensors, covariance=np.eye(7))
    return model, network, [1, 4, 4, 8, 13, 17, 21, 25, 29]


def by_messages(estimator: Any, y: np.ndarray, u: Any = None) -> tuple[np.ndarray, Any, list[Any]]:
    found, total, reports = [], None, []
    for trial in range(len(y)):
        estimator.reset()
        pushes = [None] * y.shape[1] if u is None else [None, *(u if u.ndim == 2 else u[trial])]
        steps = [estimator.step(row, push) for row, push in zip(y[trial], pushes, strict=True)]
        found.append([step.states for step in steps])
        reports += [(trial, r.instant, str(r.node), r.bounds) for step in steps for r in step.infeasible]
        total = estimator.status if total is None else total + estimator.status
    return np.array(found), total, reports


def assert_equal(found: np.ndarray, expected: np.ndarray) -> None:
    assert np.isfinite(found).all()
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()


VARIANTS: list[dict[str, Any]] = [
    {},
    {"l": 1},
    {"l": 2, "latency": 1},
    {"latency": 1, "gains": "mean"},
    {"omega": "hessian", "arrival_divisor": 2.0},
    {"startup": "literal", "gains": "mean"},
    {"l": 2, "weights": "uniform", "form": "P1"},
    {"method": "dmhe_b"},
    {"method": "dmhe_b", "l": 2, "omega": "hessian", "startup": "literal"},
]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("missing", [False, True])
def test_l_step_methods_equal_message_passing(variant: dict[str, Any], missing: bool) -> None:
    model, network, placement = small()
    options = {"method": "dmhe_l_pre", "weights": "uniform", "placement": placement, "horizon": 3, **variant}
    rng = np.random.default_rng(1)
    u = rng.normal(size=(8, 2)) if missing else rng.normal(size=(2, 8, 2))
    y = simulate(model, 8, rng, trials=2, inputs=u).measurements.copy()
    if missing:
        y[rng.random(y.shape) < 0.2] = np.nan
    method = options.pop("method")
    expected, status, _ = by_messages(RelayEstimator(model, network, method, **options), y, u)
    found = run_relay_trials(RelayDesign(model, network, method, **options), y, u)
    assert_equal(found.states, expected)
    assert found.status == status


@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b", "dmhe_f", "dmhe_pre"])
def test_a_random_model_of_seven_states_on_thirty_nodes(method: str) -> None:
    model, network, placement = seven_states()
    y = simulate(model, 9, np.random.default_rng(2), trials=1).measurements
    options: dict[str, Any] = {"placement": placement, "horizon": 4, "require_sound": False}
    if method in ("dmhe_l_pre", "dmhe_b"):
        options["weights"] = "uniform"
        expected = by_messages(RelayEstimator(model, network, method, **options), y)[0]
        found = run_relay_trials(RelayDesign(model, network, method, **options), y).states
    else:
        expected = by_messages(DistributedEstimator(model, network, method, **options), y)[0]
        found = run_trials(NetworkDesign(model, network, method, **options), y).states
    assert_equal(found, expected)


@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b"])
def test_the_ring_and_the_sensor_field(method: str) -> None:
    sensor = [Sensor("s", POSITION, sigma=5.8)]
    model = LinearModel(A, np.eye(4) / 12, sensors=sensor, covariance=np.diag([1e5, 1e5, 1, 1]))
    y = simulate(model, 12, np.random.default_rng(3), trials=2).measurements
    # priors of nodes far from sensors are so weak that states as unknowns (F2) keep nine digits only
    form = "F3" if method == "dmhe_b" else None
    options: dict[str, Any] = {"placement": [0], "weights": "uniform", "horizon": 3, "form": form}
    network = ring(4, directed=True)
    expected = by_messages(RelayEstimator(model, network, method, **options), y)[0]
    assert_equal(run_relay_trials(RelayDesign(model, network, method, **options), y).states, expected)
    field = random_geometric(60, 200.0, np.random.default_rng(4), low=-400.0, high=400.0)[0]
    sensors = [Sensor(f"s{k}", POSITION, sigma=5.8) for k in range(8)]
    model = LinearModel(A, np.eye(4) / 12, sensors=sensors, covariance=np.diag([1e5, 1e5, 1, 1]))
    y = simulate(model, 7, np.random.default_rng(5), trials=1).measurements
    options = {"placement": list(range(8)), "horizon": 4, "form": form}
    expected = by_messages(RelayEstimator(model, field, method, **options), y)[0]
    assert_equal(run_relay_trials(RelayDesign(model, field, method, **options), y).states, expected)


@pytest.mark.parametrize("hardness", ["hard", "soft"])
@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b"])
def test_bounded_residuals_and_states(hardness: str, method: str) -> None:
    model, network, placement = small()
    rng = np.random.default_rng(6)
    u = 0.1 * rng.normal(size=(7, 2))
    y = simulate(model, 7, rng, trials=2, inputs=u).measurements.copy()
    y[rng.random(y.shape) < 0.1] = np.nan
    options: dict[str, Any] = {
        "placement": placement,
        "weights": "uniform",
        "horizon": 3,
        "bounds": hardness,
        "tolerance": 1e-10,
        "residual_bounds": {
            "a": Polyhedron.box([-3.0, -3.0], [3.0, 3.0]),
            "c": Polyhedron([[1.0, 1.0]], [3.0]),
            "d": Polyhedron.box([-0.6], [0.6]),
        },
        "state_bounds": Polyhedron.box([-40.0] * 4, [40.0] * 4),
    }
    expected, status, reports = by_messages(RelayEstimator(model, network, method, **options), y, u)
    found = run_relay_trials(RelayDesign(model, network, method, **options), y, u)
    assert np.abs(found.states - expected).max() <= 1e-6 * np.abs(expected).max()
    assert found.status == status
    assert sorted((r.trial, r.instant, str(r.node), r.bounds) for r in found.infeasible) == sorted(reports)
    free = {name: value for name, value in options.items() if "bounds" not in name}
    unbounded = run_relay_trials(RelayDesign(model, network, method, **free), y, u).states
    assert (np.abs(unbounded - found.states).max(axis=3) > 1e-6).mean() > 0.1, "the bounds must bite"
    assert method == "dmhe_b" or reports


@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b"])
def test_nothing_is_factorized_once_the_arrival_weights_have_settled(method: str) -> None:
    model, network, placement = small()
    model = LinearModel(A, 0.1 * np.eye(4), sensors=model.sensors, covariance=model.covariance)
    design = RelayDesign(model, network, method, placement=placement, weights="uniform", horizon=3)
    y = simulate(model, 70, np.random.default_rng(7), trials=2).measurements
    engine = RelayNetwork(design, 2)
    settled = design.schedule().settled
    assert settled is not None and settled < 60
    counts = []
    for row in y.swapaxes(0, 1):
        estimate = engine.step(row)
        counts.append(engine.factorizations)
        assert set(estimate.phases) == {"update", "solve"} and estimate.violated == 0
    assert counts[settled + 1] == counts[-1] and counts[settled] > counts[3]
    assert engine.phases["precompute"] > 0 and engine.nbytes > 2 * network.count * 16 * 16 * 8


def test_what_does_not_fit_is_refused() -> None:
    model, network, placement = small()
    design = RelayDesign(model, network, placement=placement, weights="uniform", horizon=3)
    with pytest.raises(DataError, match="at least one trial"):
        RelayNetwork(design, 0)
    with pytest.raises(ShapeError, match=r"\(2, 8\)"):
        RelayNetwork(design, 2).step(np.zeros((2, 3)))
    with pytest.raises(ShapeError, match="trials, steps, p"):
        run_relay_trials(design, np.zeros((5, 8)))
    engine = RelayNetwork(design, 1)
    assert engine.step(np.full((1, 8), np.nan)).status[0, 0] is Status.SOLVED
