"""Arrival costs: equality with the Kalman filter where it holds, the known difference where not, what is passed on."""

from __future__ import annotations

import numpy as np
import pytest

from mhe import KalmanFilter, mhe, mhe_pre
from mhe.covariance import riccati_step
from problems import LinearModel, Sensor, simulate
from problems.errors import SettingError, UnknownNameError

RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])


def ring(**settings):
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=1.0), Sensor("third", [[0, 0, 1.0, 0]], sigma=0.5)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, **({"covariance": np.eye(4)} | settings))


def pushed():
    """Inputs, a disturbance of lower rank, a prior mean, correlated sensor noise."""
    return LinearModel(
        [[1.0, 0.5, 0], [0, 0.9, 0.2], [0, 0, 1.0]],
        [[0.3, 0.1], [0.1, 0.2]],
        B=[[0.0], [1.0], [0.0]],
        G=[[1.0, 0], [0, 1.0], [0, 0]],
        sensors=[Sensor("s", [[1.0, 0, 1.0], [0, 1.0, 0]], covariance=[[0.5, 0.2], [0.2, 0.4]])],
        mean=[1.0, -1.0, 0.5],
        covariance=np.diag([1.0, 2.0, 0.5]),
    )


def replay(estimator, run):
    inputs = [None, *run.inputs] if run.inputs.shape[1] else [None] * len(run.measurements)
    return [estimator.step(y, u) for y, u in zip(run.measurements, inputs, strict=True)]


def states(estimates):
    return np.array([estimate.state for estimate in estimates])


def drop(run, share, rng):
    run.measurements[rng.random(run.measurements.shape) < share] = np.nan
    return run


@pytest.mark.parametrize("horizon", [1, 3, 5, 10])
@pytest.mark.parametrize("prior", ["filter", "smoothing"])
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_unconstrained_it_is_the_kalman_filter(horizon, prior, missing):
    model, rng = ring(), np.random.default_rng(4)
    run = drop(simulate(model, 40, rng), missing, rng)
    expected = replay(KalmanFilter(model), run)
    for form in ("F1", "F2", "F3"):
        found = replay(mhe(model, horizon, prior=prior, form=form), run)
        np.testing.assert_allclose(states(found), states(expected), atol=1e-9)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9)


@pytest.mark.parametrize("prior", ["filter", "smoothing"])
def test_with_inputs_a_mean_and_a_disturbance_of_lower_rank(prior):
    model, rng = pushed(), np.random.default_rng(0)
    run = simulate(model, 40, rng, inputs=rng.normal(size=(40, 1)))
    run.measurements[rng.random(41) < 0.2] = np.nan
    expected = states(replay(KalmanFilter(model), run))
    for horizon in (1, 4):
        np.testing.assert_allclose(states(replay(mhe(model, horizon, prior=prior), run)), expected, atol=1e-9)


def test_seed_counts_data_twice_and_approaches_the_filter_with_the_horizon():
    model = ring()
    run = simulate(model, 60, np.random.default_rng(0))
    expected = states(replay(KalmanFilter(model), run))
    difference = [np.abs(states(replay(mhe(model, N, prior="seed"), run)) - expected).max() for N in (3, 10, 20)]
    assert difference[0] > 0.05
    assert difference[0] > difference[1] > difference[2]


def seed_window(model, N, run, weights):
    """States of the seed's MHE, window by window from dense normal equations; `weights` are Pi by steps after N."""
    n, out, sequence = model.state_size, [], np.tile(model.mean, (N + 1, 1))
    W, V = np.linalg.inv(model.process_covariance), np.linalg.inv(model.R)
    for t in range(len(run.measurements)):
        s = max(0, t - N)
        reference = sequence[1] if s else model.mean
        count = t - s + 1
        H, g = np.zeros((count * n, count * n)), np.zeros(count * n)
        information = np.linalg.inv(weights[s])
        H[:n, :n] += information
        g[:n] -= information @ reference
        for k in range(count):
            part = slice(k * n, (k + 1) * n)
            H[part, part] += model.C.T @ V @ model.C
            g[part] -= model.C.T @ V @ run.measurements[s + k]
            if k:
                J = np.zeros((n, count * n))
                J[:, (k - 1) * n : k * n], J[:, part] = -model.A, np.eye(n)
                H += J.T @ W @ J
        sequence = np.linalg.solve(H, -g).reshape(count, n)
        out.append(sequence[-1])
    return np.array(out)


def test_seed_has_the_weight_of_the_riccati_recursion_from_the_first_full_window_on():
    model, N, T = ring(), 3, 20
    run = simulate(model, T, np.random.default_rng(1))
    weights = [model.covariance]
    for _ in range(T):
        weights.append(riccati_step(weights[-1], model.A, model.C, model.process_covariance, model.R))
    found = states(replay(mhe(model, N, prior="seed"), run))
    np.testing.assert_allclose(found, seed_window(model, N, run, weights), atol=1e-9)
    constant = states(replay(mhe(model, N, prior="seed", arrival_covariance="constant"), run))
    np.testing.assert_allclose(constant, seed_window(model, N, run, [model.covariance] * (T + 1)), atol=1e-9)


def test_growth_prior_own_moves_the_reference_while_the_window_fills():
    model = ring(mean=[1.0, 0, 2.0, 0])
    run = simulate(model, 4, np.random.default_rng(2))
    mean, own = (replay(mhe(model, 10, growth_prior=choice), run) for choice in ("mean", "own"))
    np.testing.assert_allclose(mean[0].state, own[0].state, atol=1e-12)
    assert np.abs(mean[3].state - own[3].state).max() > 1e-3
    # the reference is the first entry of the sequence found before: a window of one more slot around it
    shifted = mhe(ring(mean=own[2].window[0]), 10)
    for y in run.measurements[:3]:
        shifted.step(y)
    np.testing.assert_allclose(shifted.step(run.measurements[3]).window, own[3].window, atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"prior": "smoothing"}, {"prior": "seed"}])
def test_in_steady_state_only_vectors_are_passed_on(options, monkeypatch):
    model, rng = ring(), np.random.default_rng(3)
    estimator = mhe(model, 3, **options)
    for y in rng.normal(size=(300, 2)):
        estimator.step(y)
    made = []
    session = estimator.session
    original = session._make
    monkeypatch.setattr(session, "_make", lambda *given: made.append(1) or original(*given))
    before = session.store["information"].copy()
    for y in rng.normal(size=(20, 2)):
        estimator.step(y)
    np.testing.assert_array_equal(estimator.session.store["information"], before)
    assert not made
    estimator.step([np.nan, 0.0])
    assert made


def test_the_weight_recovers_after_missing_data():
    model = ring()
    measurements = np.random.default_rng(6).normal(size=(340, 2))
    measurements[300:304, 0] = np.nan
    for prior in ("filter", "smoothing"):
        estimators = mhe(model, 2, prior=prior), KalmanFilter(model)
        for y in measurements:
            found, expected = (estimator.step(y) for estimator in estimators)
            np.testing.assert_allclose(found.state, expected.state, atol=1e-9)
            np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-9)


def test_what_does_not_go_together_is_refused():
    model = ring()
    with pytest.raises(UnknownNameError, match="flter"):
        mhe(model, 3, prior="flter")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UnknownNameError, match="growth prior"):
        mhe(model, 3, growth_prior="none")
    with pytest.raises(SettingError, match="goes with prior='seed'"):
        mhe(model, 3, arrival_covariance="constant")
    with pytest.raises(SettingError, match="use 'seed'"):
        mhe_pre(model, 3, prior="filter")
