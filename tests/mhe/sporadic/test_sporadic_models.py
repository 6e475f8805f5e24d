"""Any linear model: double integrators, C = [I 0], full R, vehicles of different sizes, several cameras at a node."""

from __future__ import annotations

import daqp
import numpy as np
import pytest

from mhe.filters import KalmanFilter
from mhe.polyhedron import Polyhedron
from mhe.sporadic import SporadicEstimator
from mhe.sporadic.blocks import blocks_of
from mhe.sporadic.rows import half_planes
from problems.errors import DefinitionError, ShapeError
from problems.models import LinearModel, Sensor
from problems.networks import Network, complete
from problems.solvers.base import Status

T, N = 0.5, 3
R = np.array([[0.5, 0.2], [0.2, 0.3]])
DOUBLE = np.kron(np.array([[1, T], [0, 1]]), np.eye(2))  # states (position, velocity) of one vehicle
PUSH = np.kron(np.array([[T**2 / 2], [T]]), np.eye(2))
SEES = np.hstack([np.eye(2), np.zeros((2, 2))])
FENCE = Polyhedron.box([-1.0, -1.0], [1.0, 1.0])


def vehicles_model(kinds, nodes):
    """`kinds` of vehicles, ``double`` or ``single`` integrators, each seen by `nodes` cameras with full R."""
    parts = {"double": (DOUBLE, PUSH, SEES), "single": (np.eye(2), np.eye(2), np.eye(2))}
    sizes = [len(parts[kind][0]) for kind in kinds]
    n, q = sum(sizes), 2 * len(kinds)
    A, G = np.zeros((n, n)), np.zeros((n, q))
    starts = np.cumsum([0, *sizes])
    for v, kind in enumerate(kinds):
        own = slice(starts[v], starts[v + 1])
        A[own, own], G[own, 2 * v : 2 * v + 2] = parts[kind][:2]
    sensors = []
    for i in range(nodes):
        for v, kind in enumerate(kinds):
            C = np.zeros((2, n))
            C[:, starts[v] : starts[v + 1]] = parts[kind][2]
            sensors.append(Sensor(f"c{i} v{v}", C, covariance=R * (1 + i)))
    return LinearModel(A, 0.3 * np.eye(q), G=G, sensors=sensors, mean=np.zeros(n), covariance=100 * np.eye(n))


def draws(rng, steps, nodes, vehicles, scale=0.9):
    values = scale * rng.normal(size=(steps, nodes, vehicles, 2))
    values[rng.random((steps, nodes, vehicles)) < 0.35] = np.nan
    return values


def reference(model, gain, values, fields, steps):
    """Algorithm 3 for one node alone, written out: everything in all states, dense, solved by daqp."""
    n, A = model.state_size, model.A
    mean, start = model.prior()
    GQG = model.process_covariance
    C, Rinv = model.C, np.linalg.inv(model.R)
    sensors = len(model.sensors)
    flags = ~np.isnan(values).any(axis=3)[:, 0]
    D = np.array([np.kron(np.diag(f.astype(float)), np.eye(2)) for f in flags])
    y = np.nan_to_num(values.reshape(len(values), -1))
    M = np.array([(d @ C).T @ Rinv @ (d @ C) for d in D])
    window, cover, out = np.tile(mean, (N + 1, 1)), start, [mean]
    for t in range(1, steps):
        first = max(0, t - N)
        count = t - first + 1
        if t > N:
            # onestep covariance
            cover = GQG + A @ np.linalg.inv(np.linalg.inv(cover) + M[first - 1]) @ A.T
        prior = window[0] if t <= N else window[1]
        # states as Z v + z0
        if gain is not None:
            Z, z0 = [np.eye(n)], [np.zeros(n)]
            for k in range(first, t):
                F = A - gain @ D[k] @ C
                Z.append(F @ Z[-1])
                z0.append(F @ z0[-1] + gain @ D[k] @ y[k])
            extra = np.zeros((n, n))
        else:
            q = model.disturbance_size
            size = n + q * (count - 1)
            Z, z0 = [np.eye(n, size)], [np.zeros(n)] * count
            for k in range(count - 1):
                step = A @ Z[-1]
                step[:, n + q * k : n + q * (k + 1)] += model.G
                Z.append(step)
            extra = np.zeros((size, size))
            extra[n:, n:] = np.kron(np.eye(count - 1), np.linalg.inv(model.Q))
        size = Z[0].shape[1]
        W = np.linalg.inv(cover)
        P, g = extra, np.zeros(size)
        P = P + Z[0].T @ W @ Z[0]
        g = g - Z[0].T @ W @ prior
        rows, bounds = [np.zeros((0, size))], [np.zeros(0)]
        for k in range(count):
            d = D[first + k] @ C
            P = P + Z[k].T @ d.T @ Rinv @ d @ Z[k]
            g = g + Z[k].T @ d.T @ Rinv @ (d @ z0[k] - D[first + k] @ y[first + k])
            if fields is None:
                continue
            G, h = half_planes(fields)
            for s in range(sensors):
                if flags[first + k, s]:
                    output = G @ C[2 * s : 2 * s + 2]
                    rows.append(output @ Z[k])
                    bounds.append(h - output @ z0[k])
        rows, bounds = np.vstack(rows), np.concatenate(bounds)
        if len(rows):
            lower, sense = np.full(len(rows), -1e30), np.zeros(len(rows), dtype=np.intc)
            v, _, flag, _ = daqp.solve(P, g, np.ascontiguousarray(rows), bounds, lower, sense, primal_tol=1e-11)
            assert flag == 1
        else:
            v = -np.linalg.solve(P, g)
        window = np.array([z @ v + c for z, c in zip(Z, z0, strict=True)])
        out.append(window[-1])
    return np.array(out)


@pytest.mark.parametrize("kinds", [("double", "double"), ("double", "single")])
@pytest.mark.parametrize("disturbance", ["observer", "process_noise"])
@pytest.mark.parametrize("rows", ["none", "hard"])
def test_one_node_equals_the_problem_written_out(kinds, disturbance, rows):
    model = vehicles_model(kinds, 1)
    values = draws(np.random.default_rng(1), 25, 1, 2, scale=0.6)
    options = {"disturbance": disturbance, "rows": rows, "pi_update": "onestep", "weights": "uniform", "horizon": N}
    estimator = SporadicEstimator(model, Network(1), "dmhe_w_pre", fields=[FENCE], **options)
    gain = None
    if disturbance == "observer":
        known = estimator.design._gains[0]
        gain = np.hstack([known[s] for s in sorted(known)])
        assert np.abs(np.linalg.eigvals(model.A - gain @ model.C)).max() < 1
    found = np.array([estimator.step(y).states[0] for y in values])
    assert set(estimator.status) == {Status.SOLVED}
    wanted = reference(model, gain, values, FENCE if rows == "hard" else None, 25)
    assert np.abs(found - wanted).max() < 1e-7
    if rows == "hard":
        free = SporadicEstimator(model, Network(1), "dmhe_w_pre", **(options | {"rows": "none"}))
        assert np.abs(found - np.array([free.step(y).states[0] for y in values])).max() > 0.02


def test_parts_of_one_size_are_worked_on_apart():
    assert blocks_of(vehicles_model(("double", "double"), 2)).states.tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert blocks_of(vehicles_model(("double", "single"), 2)).states.tolist() == [[0, 1, 2, 3, 4, 5]]
    coupled = np.zeros((4, 2))
    coupled[2, 0] = 0.1
    model = vehicles_model(("single", "single"), 1)
    assert blocks_of(model).count == 2
    assert blocks_of(model, [(0, coupled)]).count == 1


@pytest.mark.parametrize("method", ["dmhe_w_pre_s", "dmhe_f_s"])
def test_vehicles_of_different_sizes_equal_vehicles_one_by_one(method):
    nodes, kinds = 3, ("double", "single")
    values = draws(np.random.default_rng(2), 25, nodes, 2, scale=0.5)
    options = {"weights": "uniform", "fields": [FENCE] * nodes}
    together = SporadicEstimator(vehicles_model(kinds, nodes), complete(nodes), method, **options)
    states = np.array([together.step(y).states for y in values])
    for v, own in enumerate((slice(0, 4), slice(4, 6))):
        alone = SporadicEstimator(vehicles_model(kinds[v : v + 1], nodes), complete(nodes), method, **options)
        separate = np.array([alone.step(y[:, v : v + 1]).states for y in values])
        assert np.abs(states[:, :, own] - separate).max() < 1e-8


def test_filter_prior_of_double_integrators_is_the_kalman_filter():
    model = vehicles_model(("double", "double"), 2)
    values = draws(np.random.default_rng(3), 30, 2, 2)
    options = {"prior": "filter", "pi_update": "onestep", "growth_prior": "mean"}
    placement = [0] * 4
    estimator = SporadicEstimator(model, Network(1), "dmhe_f", placement=placement, **options)
    kalman = KalmanFilter(model)
    for t, y in enumerate(values):
        found, wanted = estimator.step(y.ravel()).states[0], kalman.step(y.ravel()).state
        if t:
            assert np.abs(found - wanted).max() < 1e-8


def test_two_cameras_of_one_node_count_like_two_nodes_that_share_everything():
    """Information adds up, whoever owns the sensor."""
    model = vehicles_model(("double",), 2)
    values = draws(np.random.default_rng(4), 20, 2, 1)
    one = SporadicEstimator(model, Network(1), "dmhe_f", placement=[0, 0])
    two = SporadicEstimator(model, complete(2), "dmhe_f")
    for y in values:
        alone, shared = one.step(y.ravel()).states, two.step(y).states
        assert np.abs(shared - alone).max() < 1e-8


def test_states_in_any_order_are_sorted_into_vehicles():
    straight = vehicles_model(("double", "double"), 2)
    order = np.random.default_rng(5).permutation(8)
    sensors = [
        Sensor(s.name, straight.C[straight.rows(s.name)][:, order], covariance=R * (1 + k // 2))
        for k, s in enumerate(straight.sensors)
    ]
    mixed = LinearModel(
        straight.A[np.ix_(order, order)],
        straight.Q,
        G=straight.G[order],
        sensors=sensors,
        mean=np.zeros(8),
        covariance=100 * np.eye(8),
    )
    values = draws(np.random.default_rng(6), 15, 2, 2)
    for method in ("dmhe_w_pre", "dmhe_f"):
        one, other = (SporadicEstimator(m, complete(2), method) for m in (straight, mixed))
        for y in values:
            assert np.abs(one.step(y).states[:, order] - other.step(y).states).max() < 1e-9


def test_models_that_do_not_fit_are_refused():
    model = vehicles_model(("single",), 1)
    driven = LinearModel(np.eye(2), np.eye(2), np.eye(2), sensors=list(model.sensors), covariance=np.eye(2))
    with pytest.raises(DefinitionError, match="without inputs"):
        SporadicEstimator(driven, Network(1), "dmhe_f")
    with pytest.raises(ShapeError, match="gain of shape"):
        SporadicEstimator(model, Network(1), "dmhe_w_pre", gains=[np.eye(3)])
    with pytest.raises(ShapeError, match="placement"):
        SporadicEstimator(model, Network(1), "dmhe_f", placement=[0, 0])
