"""Trials and nodes on a leading axis equal message passing, trial by trial (design 3.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mhe.distributed import BatchedNetwork, DistributedEstimator, NetworkDesign, WindowPool, options_of, run_trials
from mhe.observers import given_gain, place_gain
from mhe.polyhedron import Polyhedron
from problems.errors import DataError, ShapeError
from problems.models import LinearModel, Sensor, simulate
from problems.networks import Network, circulant, ring
from problems.solvers.base import Status
from problems.solvers.batch import QPBatch

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
B = np.array([[0.5], [0.0], [0.1], [0.0]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
NOTHING, FIRST, THIRD = [[0.0, 0, 0, 0]], [[1.0, 0, 0, 0]], [[0, 0, 1.0, 0]]
EDGES = "1-2 1-5 1-6 2-3 2-4 3-4 3-6 3-9 4-8 4-9 5-6 5-7 7-8 8-9"
METHODS = ("dmhe_f", "dmhe_pre", "dmhe_w_pre")

pytestmark = pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")


def network_of(name: str) -> tuple[list[Any], Network]:
    if name == "ring":
        return [FIRST, FIRST, THIRD, THIRD], ring(4, directed=True)
    if name == "circulant":
        return [FIRST, THIRD, NOTHING] * 4, circulant(12, [1, 2])
    seen = {**dict.fromkeys((1, 2, 6), FIRST), **dict.fromkeys((3, 4, 9), THIRD)}
    edges = [tuple(int(end) for end in pair.split("-")) for pair in EDGES.split()]
    return [seen.get(node, NOTHING) for node in range(1, 10)], Network.from_edges(edges, range(1, 10), undirected=True)


def gains_of(outputs: list[Any], network: Network) -> list[Any]:
    chosen = {(True, True): [0.9, 0.6, 0.7, 0.8], (True, False): [0.45, 0.58], (False, True): [0.7, 0.8]}
    found = []
    for node in range(network.count):
        C = np.vstack([outputs[j] for j in network.in_neighborhood(node)])
        eigenvalues = chosen.get((C[:, 0].any(), C[:, 2].any()))
        zero = given_gain(A, C, np.zeros(C.shape[::-1]))
        found.append(zero if eigenvalues is None else place_gain(A, C, eigenvalues))
    return found


def case(
    name: str, method: str, *, inputs: bool = False, **options: Any
) -> tuple[LinearModel, Network, dict[str, Any]]:
    outputs, network = network_of(name)
    sensors = [Sensor(f"s{k}", C, covariance=1.0) for k, C in enumerate(outputs)]
    model = LinearModel(A, Q, B if inputs else None, sensors=sensors, covariance=np.eye(4))
    if options_of(method).disturbance == "observer":
        options["gains"] = gains_of(outputs, network)
    return model, network, {"method": method, **options}


def by_messages(
    model: LinearModel, network: Network, options: dict[str, Any], y: Any, u: Any = None
) -> tuple[Any, Any]:
    """(trials, steps, count, n) and the steps by status."""
    states, estimator = [], DistributedEstimator(model, network, **options)
    total: Any = {}
    for trial in range(len(y)):
        estimator.reset()
        pushes = [None] * y.shape[1] if u is None else [None, *(u if u.ndim == 2 else u[trial])]
        states.append([estimator.step(row, push).states for row, push in zip(y[trial], pushes, strict=True)])
        total = estimator.status + total if total else estimator.status
    return np.array(states), total


def assert_equal(batched: Any, expected: Any) -> None:
    assert np.isfinite(batched).all()
    assert np.abs(batched - expected).max() <= 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["ring", "nine"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bounds", ["none", "tight"])
def test_batches_equal_message_passing(name: str, method: str, bounds: str) -> None:
    rng = np.random.default_rng(1)
    trials, steps = 2, 10
    model, network, options = case(name, method, horizon=4)
    truth = simulate(model, steps, rng, trials=trials)
    if bounds == "tight":
        limit = np.abs(truth.states).max(axis=(0, 1)) * (0.6 if method == "dmhe_f" else 0.9)
        options |= {"state_bounds": Polyhedron.box(-limit, limit), "tolerance": 1e-9}
        if method == "dmhe_f":
            options["disturbance_bounds"] = Polyhedron.box([-0.05] * 4, [0.05] * 4)
    expected, status = by_messages(model, network, options, truth.measurements)
    design = NetworkDesign(model, network, **options)
    found = run_trials(design, truth.measurements)
    assert_equal(found.states, expected)
    assert found.status == status
    if bounds == "tight":
        free = run_trials(
            NetworkDesign(*case(name, method, horizon=4)[:2], **case(name, method, horizon=4)[2]), truth.measurements
        )
        assert (np.abs(found.states - free.states).max(axis=3) > 1e-6).mean() > 0.1, "the bounds must bite"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("growth_prior", ["own", "mean"])
def test_missing_measurements_inputs_and_priors(method: str, growth_prior: str) -> None:
    rng = np.random.default_rng(2)
    model, network, options = case("ring", method, inputs=True, horizon=3, growth_prior=growth_prior)
    for inputs in (rng.normal(size=(9, 1)), rng.normal(size=(3, 9, 1))):
        y = simulate(model, 9, rng, trials=3, inputs=inputs).measurements.copy()
        y[rng.random(y.shape) < 0.25] = np.nan
        expected, _ = by_messages(model, network, options, y, inputs)
        assert_equal(run_trials(NetworkDesign(model, network, **options), y, inputs).states, expected)


def test_a_row_missing_in_all_trials_and_one_trial() -> None:
    model, network, options = case("ring", "dmhe_pre", horizon=3)
    y = simulate(model, 9, np.random.default_rng(3), trials=2).measurements.copy()
    y[:, 5, 1] = np.nan
    assert_equal(
        run_trials(NetworkDesign(model, network, **options), y).states, by_messages(model, network, options, y)[0]
    )
    assert_equal(
        run_trials(NetworkDesign(model, network, **options), y[:1]).states,
        by_messages(model, network, options, y[:1])[0],
    )


@pytest.mark.parametrize("method", METHODS)
def test_nodes_with_equal_problems_share_a_factorization(method: str) -> None:
    outputs, _ = network_of("circulant")
    model, network, options = case("circulant", method, horizon=3, state_bounds=Polyhedron.box([-9.0] * 4, [9.0] * 4))
    y = simulate(model, 8, np.random.default_rng(4), trials=2).measurements
    design = NetworkDesign(model, network, **options)
    batched = BatchedNetwork(design, 2)
    assert isinstance(batched._batch, QPBatch)
    batched.step(y[:, 0])
    batched.step(y[:, 1])
    kinds = len({sum(outputs[j][0][0] + 2 * outputs[j][0][2] for j in network.in_neighborhood(i)) for i in range(12)})
    assert 1 < kinds <= batched.factorizations < network.count  # gains of equal regions differ by rounding
    batched = BatchedNetwork(design, 2)
    states = np.stack([batched.step(row).states for row in y.swapaxes(0, 1)], axis=1)
    assert_equal(states, by_messages(model, network, options, y)[0])


@pytest.mark.parametrize("infeasible", ["predict", "soft"])
def test_infeasible_windows_name_trial_node_and_instant(infeasible: str) -> None:
    sensors = [Sensor("a", [[1.0]], sigma=1.0), Sensor("b", [[1.0]], sigma=1.0)]
    model = LinearModel([[1.0]], [[1.0]], sensors=sensors, covariance=[[1.0]])
    network = Network.from_edges([], ["left", "right"])
    options: dict[str, Any] = {
        "method": "dmhe_pre",
        "gains": [[[1.0]], [[1.0]]],
        "horizon": 2,
        "state_bounds": Polyhedron.box([-np.inf], [0.0]),
        "infeasible": infeasible,
    }
    y = np.full((3, 6, 2), -1.0)
    y[1, 3, 0] = y[2, 1, 1] = 2.0
    found = run_trials(NetworkDesign(model, network, **options), y)
    expected, status = by_messages(model, network, options, y)
    assert_equal(found.states, expected)
    assert found.status == status and found.status[Status.INFEASIBLE] == 4
    named = sorted((report.trial, report.node, report.instant) for report in found.infeasible)
    assert named == [(1, "left", 4), (1, "left", 5), (2, "right", 2), (2, "right", 3)]


def test_solvers_that_are_named_are_called_for_every_entry() -> None:
    model, network, options = case("ring", "dmhe_pre", horizon=3)
    y = simulate(model, 6, np.random.default_rng(5), trials=2).measurements
    called = run_trials(NetworkDesign(model, network, **options, solver="daqp", tolerance=1e-10), y)
    assert np.abs(called.states - run_trials(NetworkDesign(model, network, **options), y).states).max() < 1e-8


def test_a_pool_serves_designs_that_differ_in_weights_only() -> None:
    pool = WindowPool()
    model, network, options = case("nine", "dmhe_w_pre", horizon=4)
    y = simulate(model, 8, np.random.default_rng(6), trials=2).measurements
    for share in (0.0, 0.5, 1.0):
        mixed = options | {"weights": "mixed", "share": share}
        shared = run_trials(NetworkDesign(model, network, **mixed, pool=pool), y)
        assert_equal(shared.states, run_trials(NetworkDesign(model, network, **mixed), y).states)
    assert len(pool._compiled) <= network.count


def test_campaigns_that_do_not_fit_are_refused() -> None:
    model, network, options = case("ring", "dmhe_f", inputs=True)
    design = NetworkDesign(model, network, **options)
    with pytest.raises(ShapeError, match="trials, steps, p"):
        run_trials(design, np.zeros((5, 4)))
    with pytest.raises(ShapeError, match=r"\(4, 1\)"):
        run_trials(design, np.zeros((2, 5, 4)), np.zeros((5, 1)))
    with pytest.raises(ShapeError, match=r"\(2, 4\)"):
        BatchedNetwork(design, 2).step(np.zeros((2, 3)))
    with pytest.raises(DataError, match="infinite value at time step 0"):
        BatchedNetwork(design, 1).step(np.array([[0.0, np.inf, 0, 0]]))
    batched = BatchedNetwork(design, 1)
    batched.step(np.zeros((1, 4)))
    for _ in range(2):
        with pytest.raises(DataError, match="at time step 1"):
            batched.step(np.zeros((1, 4)))
    assert batched.step(np.zeros((1, 4)), [0.0]).instant == 1
    with pytest.raises(DataError, match="at least one trial"):
        BatchedNetwork(design, 0)


def test_longer_runs_need_more_covariances() -> None:
    """A run longer than the covariances that a shorter one asked for computes the rest."""
    model, network, options = case("ring", "dmhe_f", horizon=3)
    y = simulate(model, 30, np.random.default_rng(7), trials=1).measurements
    design = NetworkDesign(model, network, **options)
    short = run_trials(design, y[:, :8])
    assert len(design.covariances(4).fused) == 5
    whole = run_trials(design, y)
    np.testing.assert_array_equal(whole.states[:, :8], short.states)
    assert_equal(whole.states, by_messages(model, network, options, y)[0])
