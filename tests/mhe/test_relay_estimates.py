"""Nodes that relay: what they estimate against Algorithm 2 written out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from relay_worlds import WINDOWS, on_ring, recorded, small

from mhe.named import dmhe_b
from mhe.relay import RelayDesign, RelayEstimate, RelayEstimator
from mhe.relay.node import RelayNode
from mhe.relay.plan import plan_of
from mhe.scenarios.sensor_field_world import A, draw_trial, sensor_field
from problems.errors import DataError, ShapeError
from problems.networks import complete
from problems.solvers import qp_session


def written_out(design: RelayDesign, measurements: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Algorithm 2 in closed form, from the data rule; (steps, count, n)."""
    model, network, options = design.model, design.network, design.options
    N, l, count, n = options.horizon, options.steps, network.count, model.state_size
    distance, pi = network.distances().T, design.weights.matrix()
    S1, Q = np.linalg.inv(model.process_covariance), model.process_covariance
    noisy = options.disturbance == "process_noise"
    pushed = np.vstack([np.zeros(n), inputs @ model.B.T])
    found = np.zeros((len(measurements), count, n))
    P = np.tile(np.linalg.inv(model.covariance), (count, 1, 1))
    states: list[np.ndarray] = [np.zeros((1, n))] * count
    Xi = H = P
    own = [
        (model.C[r], np.linalg.inv(model.R[np.ix_(r, r)]), design.own(i).gain) for i, r in enumerate(design.own_rows)
    ]
    AL = [A - L @ C for C, _, L in own]
    for t in range(1, len(measurements)):
        m, first = min(t, N), max(0, t - N)
        if t > N:
            guess = np.zeros((count, n))
            new = []
            for i, (C, W, L) in enumerate(own):
                step = A if noisy else AL[i]
                y = measurements[first - 1][design.own_rows[i]]
                guess[i] = A @ states[i][0] + pushed[first] + (0 if noisy else L @ (y - C @ states[i][0]))
                omega = Xi[i].copy()
                if noisy:
                    omega += marginal(C, W, N, Q)
                else:
                    F = np.vstack([C @ np.linalg.matrix_power(AL[i], k) for k in range(N + 1)])
                    omega += F.T @ np.kron(np.eye(N + 1), W) @ F
                if options.omega == "hessian":
                    omega, guess[i] = H[i], states[i][1]
                    step = A if noisy else A - design.gains(i, N)[0] @ model.C[design.regional_rows[i]]
                new.append(np.linalg.inv(step @ np.linalg.inv(omega) @ step.T + np.linalg.inv(S1)))
            P = options.alpha / options.arrival_divisor * np.array(new)
        else:
            guess = np.array([s[0] for s in states])
            if options.startup == "literal":
                guess = np.zeros((count, n))
            elif t > 1:
                new = np.linalg.inv(np.linalg.inv(H) + np.linalg.inv(S1))
                P = options.alpha / options.arrival_divisor * new
        Xi = np.einsum("ij,jab->iab", pi, P)
        xi = np.einsum("ij,jab,jb->ia", pi, P, guess)
        H, states = np.zeros((count, n, n)), []
        for i in range(count):
            rows = design.regional_rows[i]
            gains = design.gains(i, m)
            unknowns = (m + 1) * n if noisy else n
            big, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
            T, b = np.eye(n, unknowns), np.zeros(n)
            big[:n, :n] += Xi[i]
            right[:n] += xi[i]
            trajectory = []
            for s in range(m + 1):
                k = first + s
                trajectory.append((T, b))
                near = [j for j in design.sources[i] if j == i or distance[i, j] <= min(l, t - k + 1 - options.latency)]
                for j in near:
                    C, W, _ = own[j]
                    y = measurements[k][design.own_rows[j]]
                    big += T.T @ C.T @ W @ C @ T
                    right += T.T @ C.T @ W @ (y - C @ b)
                if s == m:
                    break
                if noisy:
                    w = np.zeros((n, unknowns))
                    w[:, (s + 1) * n : (s + 2) * n] = np.eye(n)
                    big += w.T @ S1 @ w
                    T, b = A @ T + w, A @ b + pushed[k + 1]
                else:
                    mine = np.isin(rows, np.concatenate([design.own_rows[j] for j in [*near, i]])).astype(float)
                    C, L = model.C[rows], gains[s] * mine
                    T, b = (A - L @ C) @ T, (A - L @ C) @ b + L @ measurements[k][rows] + pushed[k + 1]
            z = np.linalg.solve(big, right)
            states.append(np.array([T @ z + b for T, b in trajectory]))
            H[i] = big[:n, :n] - big[:n, n:] @ np.linalg.solve(big[n:, n:], big[n:, :n]) if noisy else big
            found[t, i] = states[i][-1]
    return found


def marginal(C: np.ndarray, W: np.ndarray, N: int, Q: np.ndarray) -> np.ndarray:
    """Information about the first state in the outputs of a window, disturbances integrated out."""
    n = len(A)
    big = np.zeros(((N + 1) * n,) * 2)
    T = np.eye(n, (N + 1) * n)
    for s in range(N + 1):
        big += T.T @ C.T @ W @ C @ T
        if s < N:
            w = np.zeros((n, (N + 1) * n))
            w[:, (s + 1) * n : (s + 2) * n] = np.eye(n)
            big += w.T @ np.linalg.inv(Q) @ w
            T = A @ T + w
    return big[:n, :n] - big[:n, n:] @ np.linalg.solve(big[n:, n:], big[n:, :n])


# Estimates
@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_1_pre", "dmhe_b"])
@pytest.mark.parametrize("startup", ["literal", "fuse"])
@pytest.mark.parametrize("omega", ["seed", "hessian"])
@pytest.mark.parametrize("exchange", ["offline", "online"])
def test_estimates_equal_the_algorithm_written_out(method: str, startup: str, omega: str, exchange: str) -> None:
    model, network, placement = small()
    options: dict[str, Any] = {"horizon": 3, "weights": "uniform", "startup": startup, "omega": omega}
    estimator = RelayEstimator(
        model, network, method, placement=placement, exchange=exchange, windows=WINDOWS, **options
    )
    _, measurements, inputs = recorded()
    found = [estimator.step(y, None if t == 0 else inputs[t - 1]).states for t, y in enumerate(measurements)]
    expected = written_out(estimator.design, measurements, inputs)
    assert np.abs(np.array(found) - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("gains", "latency"), [("mean", 0), ("sum", 0), ("joint", 1)])
def test_gains_and_latency_equal_the_algorithm_written_out(gains: str, latency: int) -> None:
    model, network, placement = small()
    estimator = RelayEstimator(
        model, network, placement=placement, horizon=3, weights="uniform", gains=gains, latency=latency, windows=WINDOWS
    )
    _, measurements, inputs = recorded()
    found = [estimator.step(y, None if t == 0 else inputs[t - 1]).states for t, y in enumerate(measurements)]
    expected = written_out(estimator.design, measurements, inputs)
    assert np.abs(np.array(found) - expected).max() < 1e-7 * np.abs(expected).max()


def test_incremental_and_batch_relay_give_equal_estimates_bit_by_bit() -> None:
    model, network, placement = small()
    _, measurements, inputs = recorded()
    runs = []
    for relay in ("incremental", "batch"):
        estimator = RelayEstimator(model, network, placement=placement, weights="uniform", relay=relay, windows=WINDOWS)
        runs.append([estimator.step(y, inputs[t - 1] if t else None).states for t, y in enumerate(measurements)])
    assert np.array_equal(*runs)


def test_fused_cost_differs_from_the_sum_by_a_constant() -> None:
    model, network, placement = small()
    design = RelayDesign(model, network, placement=placement, weights="uniform")
    node = RelayNode(plan_of(design, 4))
    rng = np.random.default_rng(0)
    members, t = node._plan.members, 6
    guesses = dict(zip(members, rng.normal(size=(len(members), 4)) * 50, strict=True))
    for member, guess in guesses.items():
        node._fusion.receive(member, float(t), guess)
    reference, information, linear = node._fusion.arrival(t)
    P = design.schedule().local[design.schedule().at(t)]

    def difference(x: np.ndarray) -> float:
        d = x - reference
        summed = sum(
            w * (x - guesses[j]) @ P[j] @ (x - guesses[j]) for w, j in zip(node._plan.weights, members, strict=True)
        )
        return float(summed - (d @ information @ d + 2 * linear @ d))

    values = np.array([difference(rng.normal(size=4) * 50) for _ in range(20)])
    assert np.ptp(values) < 1e-9 * abs(values.mean())
    # (3.14) is zero at its centre, (3.10) is not where predictions differ
    centre = reference - np.linalg.solve(information, linear)
    at_centre = information @ (centre - reference) + linear
    assert np.abs(at_centre).max() < 1e-9 and difference(centre) + linear @ np.linalg.solve(information, linear) > 1


def test_a_node_without_data_propagates_the_fused_prior() -> None:
    estimator = on_ring(1)  # nodes 3 and 4 never hold anything
    rng = np.random.default_rng(0)
    for t in range(9):
        result = estimator.step([rng.normal(size=2) * 10, None, None, None])
        node = result.nodes[3]
        assert isinstance(node, RelayEstimate) and node.held.shape[1] == 0 and node.window is not None
        if t:
            moved = np.linalg.matrix_power(A, len(node.window) - 1) @ node.window[0]
            assert np.abs(node.state - moved).max() < 1e-9
    reference, information, linear = estimator._simulation._host._nodes[3]._fusion.arrival(8)  # type: ignore[attr-defined]
    assert np.abs(node.window[0] - (reference - np.linalg.solve(information, linear))).max() < 1e-9


def test_nodes_of_a_complete_graph_agree() -> None:
    field = sensor_field(nodes=12, share=0.25, radius=2000)
    assert field.network == complete(12)
    trial = draw_trial(field, 20, np.random.default_rng(1))
    for method in ("dmhe_1_pre", "dmhe_b"):
        for weights in ("uniform", "metropolis"):
            with RelayEstimator(
                field.model, field.network, method, placement=field.placement, weights=weights
            ) as estimator:
                states = np.array([estimator.step(y).states for y in trial.measurements])
            assert np.ptp(states, axis=1).max() < 1e-8


# Work that is done once
def test_no_matrix_is_factorized_once_the_weights_have_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    made = 0
    original = qp_session.DenseMap.__init__

    def counted(self: Any, *given: Any) -> None:
        nonlocal made
        made += 1
        original(self, *given)

    monkeypatch.setattr(qp_session.DenseMap, "__init__", counted)
    for exchange in ("offline", "online"):
        field = sensor_field(nodes=20)
        estimator = RelayEstimator(field.model, field.network, placement=field.placement, exchange=exchange)
        trial = draw_trial(field, 40, np.random.default_rng(1))
        for y in trial.measurements[:36]:
            estimator.step(y)
        before, counted_before, floats = made, estimator.factorizations, estimator.counters.floats
        estimator.step(trial.measurements[36])
        per_link = estimator.counters.floats - floats
        for y in trial.measurements[37:]:
            result = estimator.step(y)
        assert before > 100 and counted_before > 100
        assert (made, estimator.factorizations) == (before, counted_before)
        assert not any(node.factorized for node in result.nodes)  # type: ignore[union-attr]
        assert per_link.max() <= 4 + 2 * len(field.active)  # P (10 numbers) is no longer sent


def test_nodes_with_equal_regions_share_a_window() -> None:
    field = sensor_field()
    estimator = RelayEstimator(field.model, field.network, placement=field.placement)
    assert len(estimator.windows._compiled) < 10 < len(estimator.design.problems)


def test_bad_measurements_are_named() -> None:
    estimator = on_ring()
    with pytest.raises(ShapeError, match="node 0: expected 2 measurement"):
        estimator.step([[1.0], None, None, None])
    with pytest.raises(DataError, match="infinite"):
        on_ring().step([[np.inf, 0.0], None, None, None])
    with pytest.raises(ShapeError, match="one entry per node"):
        on_ring().step([None])


def test_registered_names_make_estimators() -> None:
    field = sensor_field(nodes=20)
    estimator = dmhe_b(field.model, field.network, placement=field.placement, horizon=2)
    assert estimator.options.disturbance == "process_noise" and estimator.options.steps == 1
