"""Arrival covariances with detections: dmhe-sporadic-fov C6 and section 3.8, against conditioning by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.covariance import detection_update
from problems.errors import NoiseError, UnknownNameError
from problems.networks import Network, complete

N = 3


def random_case(rng):
    n, p = 4, 3
    A = rng.normal(size=(n, n))
    Q, start = (m @ m.T + 0.1 * np.eye(n) for m in rng.normal(size=(2, n, n)))
    C = rng.normal(size=(N + 1, p, n))
    roots = rng.normal(size=(N + 1, p, p))
    R = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(p)
    flags = rng.random(N + 1) < 0.6
    return A, Q, start, C, R, flags


def informations(C, R, flags):
    return np.array([flag * c.T @ np.linalg.inv(r) @ c for c, r, flag in zip(C, R, flags, strict=True)])


def posterior(A, Q, start, C, R, flags):
    """Covariance of x_1 given what was read of x_0..x_N: joint Gaussian, conditioned entry by entry."""
    n = len(A)
    powers = [np.linalg.matrix_power(A, k) for k in range(N + 1)]
    # x_k = A^k x_0 + sum_j A^(k-1-j) w_j
    maps = np.zeros(((N + 1) * n, (N + 1) * n))
    for k in range(N + 1):
        maps[k * n : (k + 1) * n, :n] = powers[k]
        for j in range(k):
            maps[k * n : (k + 1) * n, (j + 1) * n : (j + 2) * n] = powers[k - 1 - j]
    sources = np.kron(np.diag([0.0] + [1.0] * N), Q)
    sources[:n, :n] = start
    joint = maps @ sources @ maps.T
    rows = [k for k in range(N + 1) if flags[k]]
    one = joint[n : 2 * n, n : 2 * n]
    if not rows:
        return one
    H = np.zeros((len(rows) * C.shape[1], joint.shape[0]))
    noise = np.zeros((len(H), len(H)))
    p = C.shape[1]
    for place, k in enumerate(rows):
        H[place * p : (place + 1) * p, k * n : (k + 1) * n] = C[k]
        noise[place * p : (place + 1) * p, place * p : (place + 1) * p] = R[k]
    cross = joint[n : 2 * n] @ H.T
    return one - cross @ np.linalg.solve(H @ joint @ H.T + noise, cross.T)


def test_exact_update_is_the_covariance_given_the_readings():
    rng = np.random.default_rng(1)
    for _ in range(30):
        A, Q, start, C, R, flags = random_case(rng)
        found = detection_update(start, A, Q, informations(C, R, flags), "exact")
        wanted = posterior(A, Q, start, C, R, flags)
        assert np.abs(found - wanted).max() < 1e-10 * np.abs(wanted).max()
        alone = np.append(flags[:1], [False] * N)
        step = detection_update(start, A, Q, informations(C, R, flags), "onestep")
        assert step == pytest.approx(posterior(A, Q, start, C, R, alone), rel=1e-9)


def test_literal_update_is_the_printed_formula():
    """(2.28)-(2.30), dense: the readings t-N-1..t-2 as outputs of x_{t-N-1}, whose own reading counts twice."""
    rng = np.random.default_rng(2)
    for _ in range(30):
        A, Q, start, C, R, flags = random_case(rng)
        n, p = 4, 3
        O = np.vstack([flags[k] * C[k] @ np.linalg.matrix_power(A, k) for k in range(N)])
        response = np.zeros((p * N, n * (N - 1)))
        for k in range(N):
            for j in range(k):
                block = flags[k] * C[k] @ np.linalg.matrix_power(A, k - 1 - j)
                response[p * k : p * (k + 1), n * j : n * (j + 1)] = block
        noise = response @ np.kron(np.eye(N - 1), Q) @ response.T
        for k in range(N):
            noise[p * k : p * (k + 1), p * k : p * (k + 1)] += R[k]
        inner = np.linalg.inv(start) + informations(C, R, flags)[0] + O.T @ np.linalg.solve(noise, O)
        wanted = Q + A @ np.linalg.inv(inner) @ A.T
        found = detection_update(start, A, Q, informations(C, R, flags), "literal")
        assert np.abs(found - wanted).max() < 1e-10 * np.abs(wanted).max()


def test_updates_by_part_equal_the_update_of_the_whole():
    rng = np.random.default_rng(3)
    A, Q, start = (np.zeros((4, 4)) for _ in range(3))
    parts = {"A": [], "Q": [], "start": []}
    for k in (0, 2):
        root = rng.normal(size=(2, 2))
        blocks = {"A": rng.normal(size=(2, 2)), "Q": root @ root.T, "start": np.eye(2) + root @ root.T}
        for name, whole in (("A", A), ("Q", Q), ("start", start)):
            whole[k : k + 2, k : k + 2] = blocks[name]
            parts[name].append(blocks[name])
    M = rng.random((N + 1, 2, 1, 1)) * np.eye(2)
    whole = np.zeros((N + 1, 4, 4))
    whole[:, :2, :2], whole[:, 2:, 2:] = M[:, 0], M[:, 1]
    for rule in ("literal", "exact", "onestep"):
        split = detection_update(np.array(parts["start"]), np.array(parts["A"]), np.array(parts["Q"]), M, rule)
        together = detection_update(start, A, Q, whole, rule)
        assert np.abs(together[:2, :2] - split[0]).max() < 1e-12
        assert np.abs(together[2:, 2:] - split[1]).max() < 1e-12


def test_wrong_arguments_are_refused():
    with pytest.raises(UnknownNameError, match="exact"):
        detection_update(np.eye(1), np.eye(1), np.eye(1), np.zeros((4, 1, 1)), "seed")  # type: ignore[arg-type]
    with pytest.raises(NoiseError, match="positive definite"):
        detection_update(-np.eye(1), np.eye(1), np.eye(1), np.zeros((4, 1, 1)), "exact")


@pytest.mark.parametrize(("rule", "value"), [("literal", 1.296628), ("exact", 0.421722), ("onestep", (1 + 5**0.5) / 2)])
def test_steady_value_of_one_vehicle_always_seen_by_one_camera(make_scene, rule, value):
    scene = make_scene(nodes=1, vehicles=1)
    estimator = scene.build("dmhe_f", Network(1), pi_update=rule, horizon=N)
    for _ in range(60):
        step = estimator.step(np.zeros((1, 1, 2)))
    assert step.nodes[0].arrival_covariance[0] == pytest.approx(value * np.eye(2), abs=5e-7)


@pytest.mark.parametrize("rule", ["literal", "exact", "onestep"])
def test_covariance_of_a_vehicle_nobody_sees_grows_by_q_a_step(make_scene, rule):
    """On a complete graph all Pi are equal, so (4.11) keeps them; the other vehicle's covariance stays."""
    scene = make_scene(nodes=3, vehicles=2)
    estimator = scene.build("dmhe_w_pre", complete(3), pi_update=rule, horizon=N)
    values = np.zeros((3, 2, 2))
    for _ in range(40):
        estimator.step(values)
    values[:, 1] = np.nan
    found = []
    for _ in range(12):
        found.append(estimator.step(values).nodes[1].arrival_covariance)
    change = np.diff(np.array(found)[N:], axis=0)
    assert change[:, 1] == pytest.approx(np.tile(np.eye(2), (len(change), 1, 1)), abs=1e-9)
    assert np.abs(change[:, 0]).max() < 1e-9


def test_fusion_by_weights_squared_uses_the_number_of_listeners(make_scene, run):
    """(2.23) on a path with uniform weights: factors n_j k_ij^2, here for identical local covariances."""
    scene = make_scene(nodes=4, vehicles=1)
    estimator = scene.build("dmhe_f", horizon=N)
    for _ in range(N + 2):
        step = estimator.step(None)
    local = 1e5 + 1.0
    found = [node.arrival_covariance[0, 0, 0] / local for node in step.nodes]
    ends, inner = (2 + 3) / 4, (2 + 3 + 3) / 9
    assert found == pytest.approx([ends, inner, inner, ends], rel=1e-12)


def test_growth_of_squared_weights_is_announced_and_capped(make_scene, run):
    from problems.errors import ModelWarning

    scene = make_scene(nodes=6, vehicles=1)
    with pytest.warns(ModelWarning, match="spectral radius"):
        estimator = scene.build("dmhe_w_pre", weight_fusion="out_degree", covariance_cap=1e6)
    values = np.full((6, 1, 2), np.nan)
    values[0] = 0.0
    for _ in range(80):
        step = estimator.step(values)
    assert max(node.arrival_covariance.max() for node in step.nodes) <= 1e6 * (1 + 1e-9)
    assert np.isfinite(step.states).all()
