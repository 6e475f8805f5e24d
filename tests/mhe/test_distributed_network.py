"""Nodes and their messages: equal to Algorithm 1 written out, local, and alive without their neighbours."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from mhe.distributed import DistributedEstimator, NetworkDesign
from mhe.distributed import node as node_module
from mhe.distributed.node import DistributedNode
from mhe.observers import ObserverGain, place_gain
from mhe.polyhedron import Polyhedron
from problems.errors import DataError, ModelWarning, ShapeError
from problems.models import LinearModel, Sensor, simulate
from problems.networks import Network, complete, line, ring
from problems.runtime import Links, Message, Outage
from problems.solvers import qp_session
from problems.solvers.base import Status

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
B = np.array([[0.5], [0.0], [0.1], [0.0]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
FIRST, THIRD = [[1.0, 0, 0, 0]], [[0, 0, 1.0, 0]]
K = np.array([[0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]])
RING = ring(4, directed=True)
METHODS = ("dmhe_f", "dmhe_pre", "dmhe_w_pre")


def four_states(inputs: bool = False) -> LinearModel:
    sensors = [Sensor(f"s{k + 1}", FIRST if k < 2 else THIRD, covariance=1.0) for k in range(4)]
    return LinearModel(A, Q, B if inputs else None, sensors=sensors, covariance=np.eye(4))


def ring_gains() -> list[ObserverGain]:
    both = place_gain(A, [*FIRST, *THIRD], [0.9, 0.6, 0.7, 0.8])
    return [both, place_gain(A, FIRST * 2, [0.45, 0.58]), both, place_gain(A, THIRD * 2, [0.7, 0.8])]


def ring_options(method: str, **options: Any) -> dict[str, Any]:
    options |= {} if method == "dmhe_f" else {"gains": ring_gains()}
    return options | ({} if method == "dmhe_w_pre" else {"weights": "given", "weight_matrix": K})


def run(estimator: DistributedEstimator, measurements: Any, inputs: Any = None) -> np.ndarray:
    """(steps, count, n)."""
    rows = [None, *inputs] if inputs is not None else [None] * len(measurements)
    return np.array([estimator.step(y, u).states for y, u in zip(measurements, rows, strict=True)])


def written_out(design: NetworkDesign, measurements: np.ndarray, inputs: np.ndarray | None = None) -> np.ndarray:
    """Algorithm 1 with dense least squares, no bounds and no losses."""
    model, N, nodes = design.model, design.options.horizon, range(design.network.count)
    n, weights, known = model.state_size, design.weights.matrix(), design.covariances()
    pushes = np.zeros((len(measurements), n))
    if inputs is not None:
        pushes[1:] = inputs @ model.B.T
    windows = [np.zeros((1, n)) for _ in nodes]
    out = [np.zeros((len(nodes), n))]
    for t in range(1, len(measurements)):
        s, before = max(0, t - N), max(0, t - 1 - N)
        steps = t - s
        handed_on = [window[s - before] for window in windows]
        rule = design.options.growth_prior if t <= N else "consensus"
        for i in nodes:
            prior = {"consensus": weights[i] @ handed_on, "own": handed_on[i], "mean": np.zeros(n)}[rule]
            C, L = design.regional[i].C, None if design.gains is None else design.gains[i].gain
            unknowns = n * (1 if L is not None else steps + 1)
            move, shift = [np.eye(n, unknowns)], [np.zeros(n)]
            half = np.linalg.cholesky(np.linalg.inv(known.fused_at(t)[i])).T
            rows, right = [half @ np.eye(n, unknowns)], [half @ prior]
            for k in range(steps):
                y = measurements[s + k, design.regional_rows[i]]
                if L is None:
                    push = np.eye(n, unknowns, n * (k + 1))
                    move.append(A @ move[-1] + push)
                    shift.append(A @ shift[-1] + pushes[s + k + 1])
                    rows.append(push / np.sqrt(np.diag(Q))[:, None])
                    right.append(np.zeros(n))
                else:
                    move.append((A - L @ C) @ move[-1])
                    shift.append((A - L @ C) @ shift[-1] + L @ y + pushes[s + k + 1])
            for k in range(steps + 1):
                rows.append(C @ move[k])
                right.append(measurements[s + k, design.regional_rows[i]] - C @ shift[k])
            found = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
            windows[i] = np.array([m @ found + b for m, b in zip(move, shift, strict=True)])
        out.append(np.array([window[-1] for window in windows]))
    return np.array(out)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("growth_prior", ["consensus", "own", "mean"])
def test_nodes_do_what_the_algorithm_says(method: str, growth_prior: str) -> None:
    model = four_states(inputs=True)
    inputs = np.random.default_rng(1).normal(size=(18, 1))
    trial = simulate(model, 18, np.random.default_rng(2), inputs=inputs)
    options = ring_options(method, growth_prior=growth_prior, horizon=4)
    estimator = DistributedEstimator(model, RING, method, **options)
    expected = written_out(estimator.design, trial.measurements, inputs)
    assert np.abs(run(estimator, trial.measurements, inputs) - expected).max() < 1e-8 * np.abs(expected).max()
    assert estimator.status == {Status.SOLVED: 4 * 19}


@pytest.mark.parametrize("method", METHODS)
def test_exchanged_covariances_are_those_worked_out_before(method: str) -> None:
    trial = simulate(four_states(), 40, np.random.default_rng(3))
    for rule in ("seed", "exact"):
        runs = [
            run(
                DistributedEstimator(
                    four_states(), RING, method, **ring_options(method, pi_update=rule, covariances=c)
                ),
                trial.measurements,
            )
            for c in ("offline", "online")
        ]
        assert np.abs(runs[1] - runs[0]).max() < 1e-10 * np.abs(runs[0]).max()
        if rule == "seed":
            seed = runs[0]
        else:
            assert np.abs(runs[0] - seed).max() > 1e-4


def test_capped_covariances_are_the_same_both_ways() -> None:
    sensors = [Sensor(f"s{k}", FIRST if k < 3 else THIRD, covariance=1.0) for k in range(4)]
    model = LinearModel(A, Q, sensors=sensors, covariance=np.eye(4))
    net = Network(4, [(3, 2), (2, 1), (1, 0), (0, 1), (1, 2), (2, 3)])
    trial = simulate(model, 150, np.random.default_rng(3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        weights = np.diag([0.95, 0.9, 0.9, 0.95]) + np.diag([0.05] * 3, 1) + np.diag([0.05] * 3, -1)
        both = [
            DistributedEstimator(model, net, horizon=3, weights="given", weight_matrix=weights, covariances=c)
            for c in ("offline", "online")
        ]
    assert both[0].design.growth > 1
    assert np.linalg.eigvalsh(both[0].design.covariances().fused[-1]).max() == pytest.approx(4e8, rel=1e-6)
    offline, online = (run(estimator, trial.measurements) for estimator in both)
    assert np.abs(online - offline).max() < 1e-6 * np.abs(offline).max()


@pytest.mark.parametrize("method", METHODS)
def test_complete_graph_equals_one_node_with_all_data(method: str) -> None:
    model = four_states()
    trial = simulate(model, 25, np.random.default_rng(4))
    everything = np.vstack([FIRST, FIRST, THIRD, THIRD])
    gain = [] if method == "dmhe_f" else [place_gain(A, everything, [0.9, 0.6, 0.7, 0.8])]
    together = run(DistributedEstimator(model, complete(4), method, gains=gain * 4 or None), trial.measurements)
    single = DistributedEstimator(model, complete(1), method, placement=[0] * 4, gains=gain or None)
    assert np.abs(together - together[:, :1]).max() < 1e-12 * np.abs(together).max()
    assert np.abs(together - run(single, trial.measurements)).max() < 1e-10 * np.abs(together).max()


@pytest.mark.parametrize(("method", "rate"), [("dmhe_f", 0.8092), ("dmhe_pre", 0.6772)])
def test_noise_free_errors_decay_at_the_predicted_rate(method: str, rate: float) -> None:
    states = [np.array([1.0, -2.0, 0.5, 1.5])]
    for _ in range(60):
        states.append(A @ states[-1])
    truth = np.array(states)
    estimator = DistributedEstimator(four_states(), RING, method, **ring_options(method))
    errors = np.linalg.norm(run(estimator, truth @ estimator.model.C.T) - truth[:, None], axis=(1, 2))
    decay = np.exp(np.polyfit(np.arange(20, 61), np.log(errors[20:]), 1)[0])
    assert decay == pytest.approx(estimator.design.convergence_rate(), abs=0.01)
    assert decay == pytest.approx(rate, abs=2e-3)


def test_without_communication_nodes_that_do_not_observe_do_not_converge() -> None:
    truth = np.array([np.linalg.matrix_power(A, k) @ [1.0, -2.0, 0.5, 1.5] for k in range(61)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        estimator = DistributedEstimator(four_states(), RING, weights="given", weight_matrix=np.eye(4))
    errors = np.linalg.norm(run(estimator, truth @ estimator.model.C.T) - truth[:, None], axis=2)
    assert errors[60, 1] > 10 * errors[20, 1]
    assert errors[60, 0] < 1e-3 * errors[20, 0]


@pytest.mark.parametrize("method", METHODS)
def test_a_measurement_reaches_every_node_exactly_when_it_may(method: str) -> None:
    trial = simulate(four_states(), 14, np.random.default_rng(5))
    altered = trial.measurements.copy()
    altered[8, 2] += 1.0
    plain, changed = (
        run(DistributedEstimator(four_states(), RING, method, **ring_options(method)), y)
        for y in (trial.measurements, altered)
    )
    differs = (plain != changed).any(axis=2)
    assert [int(np.argmax(differs[:, node])) for node in range(4)] == [9, 10, 8, 8]
    assert differs.any(axis=0).all()


def test_messages_carry_five_numbers_or_fifteen_whatever_the_horizon() -> None:
    measurements = simulate(four_states(), 12, np.random.default_rng(6)).measurements
    for horizon in (2, 7):
        for covariances, floats in (("offline", 5), ("online", 15)):
            estimator = DistributedEstimator(four_states(), RING, horizon=horizon, covariances=covariances)
            run(estimator, measurements)
            np.testing.assert_array_equal(estimator.counters.messages, 13)
            np.testing.assert_array_equal(estimator.counters.floats, 1 + 12 * floats)
            np.testing.assert_array_equal(estimator.counters.bytes, 8 * (1 + 12 * floats))


def box_of(states: np.ndarray, share: float = 1.0) -> Polyhedron:
    limit = share * np.abs(states).max(axis=0)
    return Polyhedron.box(-limit, limit)


@pytest.mark.parametrize(
    ("method", "forms"), [("dmhe_f", ("F1", "F2", "F3")), ("dmhe_pre", ("P1", "P2")), ("dmhe_w_pre", ("P1", "P2"))]
)
def test_forms_and_solvers_agree_across_the_network_with_active_bounds(method: str, forms: tuple[str, ...]) -> None:
    truth = simulate(four_states(), 20, np.random.default_rng(7), trials=4)
    states, measurements = truth.states[1], truth.measurements[1]
    # an observer needs some room: hard bounds at the largest true state are infeasible for it now and then
    bounds = {"state_bounds": box_of(states, 1.0 if method == "dmhe_f" else 1.2)}
    if method == "dmhe_f":
        bounds["disturbance_bounds"] = Polyhedron.box([-0.05] * 4, [0.05] * 4)
    found = {}
    for solver, tolerance in (("auto", 1e-9), ("daqp", 1e-9), ("proxqp", 1e-9)):
        for form in forms:
            options = ring_options(method, form=form, solver=solver, tolerance=tolerance, **bounds)
            estimator = DistributedEstimator(four_states(), RING, method, **options)
            found[solver, form] = run(estimator, measurements)
            assert set(estimator.status) == {Status.SOLVED}
    free = run(DistributedEstimator(four_states(), RING, method, **ring_options(method)), measurements)
    first = found["auto", forms[-1]]
    assert (np.abs(first - free).max(axis=2) > 1e-3).mean() > 0.2, "the bounds must bite"
    for (solver, form), estimates in found.items():
        assert np.abs(estimates - first).max() < (1e-8 if solver != "proxqp" else 1e-6), (solver, form)
    assert bounds["state_bounds"].violation(first) < 1e-8


def scalar(infeasible: str) -> DistributedEstimator:
    """Deadbeat observer: x_1 is y_0, whatever the window does."""
    model = LinearModel(
        [[1.0]], [[1.0]], sensors=[Sensor("a", [[1.0]], sigma=1.0), Sensor("b", [[1.0]], sigma=1.0)], covariance=[[1.0]]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return DistributedEstimator(
            model,
            Network.from_edges([], ["left", "right"]),
            "dmhe_pre",
            gains=[[[1.0]], [[1.0]]],
            horizon=2,
            state_bounds=Polyhedron.box([-np.inf], [0.0]),
            infeasible=infeasible,
        )


def test_infeasible_windows_name_node_and_instant_and_the_estimate_still_comes() -> None:
    for rule in ("predict", "soft"):
        estimator = scalar(rule)
        for t, y in enumerate(([-1.0, -1.0], [-1.0, 2.0], [-1.0, -1.0])):
            estimate = estimator.step(y)
            assert np.isfinite(estimate.states).all()
            if t < 2:
                assert not estimate.infeasible
        (report,) = estimate.infeasible
        assert (report.node, report.instant, report.bounds) == ("right", 2, ("state bounds",))
        assert str(report) == "node right, time step 2: no sequence meets the state bounds"
        assert estimate.status == (Status.SOLVED, Status.INFEASIBLE)
        assert estimator.status == {Status.SOLVED: 5, Status.INFEASIBLE: 1}
        if rule == "soft":
            assert estimate.states[1, 0] == pytest.approx(2.0, abs=1e-6)


def test_losses_delays_and_outages_leave_the_estimates_usable() -> None:
    rng = np.random.default_rng(8)
    model = four_states()
    trial = simulate(model, 60, rng)
    for method in ("dmhe_f", "dmhe_w_pre"):
        for covariances in ("offline", "online"):
            errors = {}
            for name, trouble in {
                "none": {},
                "loss": {"links": Links(loss=0.3), "rng": np.random.default_rng(1)},
                "late": {"links": Links(delay=1)},
                "down": {"outages": [Outage(2, 30, 38), Outage(1, 0, 4)]},
            }.items():
                options = ring_options(method, covariances=covariances, **trouble)
                with DistributedEstimator(model, RING, method, **options) as estimator:
                    states = run(estimator, trial.measurements)
                down = np.isnan(states).any(axis=2)
                if name == "down":
                    assert down[30:38, 2].all() and down[:4, 1].all() and down.sum() == 12
                else:
                    assert not down.any()
                errors[name] = np.nanmean(np.linalg.norm(states - trial.states[:, None], axis=2)[42:])
            assert errors["loss"] < 2 * errors["none"] and errors["late"] < 3 * errors["none"]
            assert errors["down"] < 1.5 * errors["none"]
            assert errors["loss"] != errors["none"] and errors["late"] != errors["none"]


@pytest.mark.parametrize("covariances", ["offline", "online"])
@pytest.mark.parametrize("fusion", ["out_degree", "convex"])
@pytest.mark.parametrize("forget_after", [None, 1])
def test_a_missing_neighbour_is_propagated_inflated_and_renormalised(
    covariances: str, fusion: str, forget_after: int | None
) -> None:
    """Two lost messages, against the arrival cost written out."""
    model = four_states(inputs=True)
    trial = simulate(model, 12, np.random.default_rng(9), inputs=np.ones((12, 1)))
    inputs = np.random.default_rng(10).normal(size=(9, 1))
    options = ring_options(
        "dmhe_f", horizon=3, weight_fusion=fusion, forget_after=forget_after, covariances=covariances
    )
    estimator = DistributedEstimator(model, RING, **options)
    node = DistributedNode(estimator.design.plans[0])
    sender = DistributedNode(estimator.design.plans[3])
    for t in range(9):
        (said,) = sender.measure(float(t), (trial.measurements[t, 3:4], inputs[t]))
        sender.finish([])
        (spoken,) = node.measure(float(t), (trial.measurements[t, :1], inputs[t]))
        estimate = node.finish([Message(said.schema, 3, t, float(t), 0, said.payload)] if t < 7 else [])
        if t == 6:
            heard, theirs = unpacked(said)
    assert estimate.missing == (1,)
    own, mine = unpacked(spoken)
    if covariances == "offline":
        mine, theirs = estimator.design.covariances().local[8 - 4, [0, 3]]
    # sent at t = 6 about instant 3; the window of t = 8 begins at instant 5
    for k in (4, 5):
        heard = A @ heard + B @ inputs[k]
    reference = node._session.store["reference"][0]
    fused = np.linalg.inv(node._session.store["information"].reshape(4, 4))
    if forget_after is None:
        np.testing.assert_allclose(reference, 0.5 * own + 0.5 * heard, rtol=1e-12)
        np.testing.assert_allclose(fused, 0.5 * (mine + theirs + 2 * Q), rtol=1e-9)
    else:
        np.testing.assert_allclose(reference, own, rtol=1e-12)
        # all weight is its own, and d_j = 2 nodes hear it
        np.testing.assert_allclose(fused, (2.0 if fusion == "out_degree" else 1.0) * mine, rtol=1e-9)


def unpacked(said: Any) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance (zero where it does not travel) of a message with one measurement."""
    numbers, covariance = np.frombuffer(said.payload), np.zeros((4, 4))
    if numbers.size > 5:
        covariance[np.triu_indices(4)] = numbers[5:]
    return numbers[1:5], covariance + np.triu(covariance, 1).T


def test_late_measurements_fill_their_own_slot() -> None:
    model = four_states()
    trial = simulate(model, 15, np.random.default_rng(10))
    with DistributedEstimator(model, RING, links=Links(delay=2), **ring_options("dmhe_f")) as estimator:
        for y in trial.measurements:
            estimate = estimator.step(y)
        node = estimate.nodes[0]
        assert node is not None and node.late == (13.0,) and node.missing == (1,)


def test_steps_in_steady_state_pass_no_matrices_and_build_no_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = simulate(four_states(), 160, np.random.default_rng(11))
    for method in METHODS:
        for covariances in ("offline", "online"):
            estimator = DistributedEstimator(
                four_states(), RING, method, **ring_options(method, covariances=covariances)
            )
            run(estimator, trial.measurements[:150])
            with monkeypatch.context() as patch:
                patch.delattr(qp_session, "DenseMap")
                for name in ("inverse", "arrival_update", "capped", "symmetrized"):
                    patch.delattr(node_module, name)
                run(estimator, trial.measurements[150:])


def test_measurements_come_by_node_or_together() -> None:
    sensors = [Sensor("a", FIRST, sigma=1.0), Sensor("b", [*THIRD, *FIRST], sigma=1.0)]
    model = LinearModel(A, Q, sensors=sensors, covariance=np.eye(4), dt=0.5)
    make = lambda: DistributedEstimator(model, line(3), placement=[2, 0])  # noqa: E731
    one, two = make(), make()
    for k in range(3):
        first = one.step(np.array([1.0 + k, 2.0, 3.0]))
        second = two.step([[2.0, 3.0], None, 1.0 + k])
    np.testing.assert_array_equal(first.states, second.states)
    assert (first.instant, first.time) == (2, 1.0)
    assert one.step(None, time=7.0).time == 7.0
    with pytest.raises(DataError, match="later than"):
        one.step(None, time=7.0)
    with pytest.raises(ShapeError, match="all 3 component"):
        one.step(np.zeros(2))
    with pytest.raises(ShapeError, match="one entry per node"):
        one.step([[0.0], [1.0]])
    with pytest.raises(ShapeError, match="node 0: expected 2"):
        two.step([[2.0], None, 1.0])
    with pytest.raises(DataError, match="node 0: an infinite"):
        make().step(np.array([0.0, np.inf, 0.0]))
    with pytest.raises(DataError, match=r"needs 1 input\(s\) at time step 1"):
        run(DistributedEstimator(four_states(inputs=True), RING), np.zeros((2, 4)))


def test_reset_starts_again() -> None:
    trial = simulate(four_states(), 9, np.random.default_rng(12))
    estimator = DistributedEstimator(four_states(), RING)
    first = run(estimator, trial.measurements)
    estimator.reset()
    assert np.array_equal(run(estimator, trial.measurements), first)


@pytest.mark.serial
@pytest.mark.parametrize("method", ["dmhe_f", "dmhe_w_pre"])
def test_nodes_in_processes_give_the_same_trace(method: str) -> None:
    trial = simulate(four_states(), 8, np.random.default_rng(13))
    traces = []
    for processes in (False, True):
        options = ring_options(method, links=Links(loss=0.2), rng=np.random.default_rng(1), outages=[Outage(1, 3, 5)])
        bounds = box_of(trial.states)
        with DistributedEstimator(
            four_states(), RING, method, processes=processes, record=True, state_bounds=bounds, **options
        ) as estimator:
            run(estimator, trial.measurements)
            traces.append(estimator.trace)
    assert traces[0] is not None and traces[1] is not None
    assert traces[0].difference(traces[1]) is None and len(traces[0]) > 60
