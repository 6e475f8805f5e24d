"""Filters against dense least squares, against each other, and on what can go wrong."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from mhe.estimate import Estimate, Estimator
from mhe.filters import (
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
    kalman_gains,
    kalman_trials,
    kalman_update,
)
from problems.errors import DataError, DefinitionError, SettingError, ShapeError
from problems.models import LinearModel, NonlinearModel, Sensor, simulate
from problems.solvers.base import Status

RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
FILTERS = (KalmanFilter, ExtendedKalmanFilter, UnscentedKalmanFilter)


def ring(**settings):
    given = {"covariance": np.eye(4)} | settings
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=1.0), Sensor("third", [[0, 0, 1.0, 0]], sigma=0.5)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, **given)


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


BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def unicycle(mean=(2.0, 1.0, 0.2), **settings):
    def rate(x, u):
        return [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]]

    ranges = [Sensor(f"range{k}", lambda x, c=c: ca.norm_2(x[:2] - c), sigma=0.1) for k, c in enumerate(BEACONS)]
    given = {
        "sensors": [*ranges, Sensor("compass", lambda x: x[2], sigma=0.05, angles=[0], period=5)],
        "mean": mean,
        "covariance": np.diag([0.04, 0.04, 0.01]),
        "dt": 0.1,
    } | settings
    return NonlinearModel(rate, np.diag([1e-4, 1e-4, 1e-5]), 3, inputs=2, continuous=True, **given)


def replay(estimator, run) -> list[Estimate]:
    rows = [None, *run.inputs] if run.inputs.shape[1] else [None] * len(run.measurements)
    return [estimator.step(y, u) for y, u in zip(run.measurements, rows, strict=True)]


def batch_least_squares(model, run, t):
    """Mean and covariance of x_t given y_0..y_t, from one dense least-squares problem in x_0 and the disturbances."""
    n, q = model.state_size, model.disturbance_size
    unknowns = n + t * q
    prior = np.linalg.inv(np.linalg.cholesky(model.covariance))
    rows, right = [np.hstack([prior, np.zeros((n, t * q))])], [prior @ model.mean]
    half_Q = np.linalg.inv(np.linalg.cholesky(model.Q))
    state, offset = np.eye(n, unknowns), np.zeros(n)
    for k in range(t + 1):
        y = run.measurements[k]
        there = ~np.isnan(y)
        half_R = np.linalg.inv(np.linalg.cholesky(model.R[np.ix_(there, there)])) if there.any() else np.zeros((0, 0))
        rows.append(half_R @ (model.C @ state)[there])
        right.append(half_R @ (y - model.C @ offset)[there])
        if k < t:
            pick = np.zeros((q, unknowns))
            pick[:, n + k * q : n + (k + 1) * q] = np.eye(q)
            rows.append(half_Q @ pick)
            right.append(np.zeros(q))
            state = model.A @ state + model.G @ pick
            offset = model.A @ offset + model.B @ run.inputs[k]
    W, b = np.vstack(rows), np.hstack(right)
    solution = np.linalg.lstsq(W, b, rcond=None)[0]
    return state @ solution + offset, state @ np.linalg.inv(W.T @ W) @ state.T


@pytest.mark.parametrize("build", [ring, pushed])
@pytest.mark.parametrize("filter_class", FILTERS)
def test_equal_to_batch_least_squares(build, filter_class):
    model, rng = build(), np.random.default_rng(4)
    inputs = rng.normal(size=(12, model.input_size)) if model.input_size else None
    run = simulate(model, 12, rng, inputs=inputs)
    run.measurements[3, 0] = run.measurements[7] = np.nan
    for t, estimate in enumerate(replay(filter_class(model), run)):
        state, covariance = batch_least_squares(model, run, t)
        np.testing.assert_allclose(estimate.state, state, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimate.covariance, covariance, rtol=1e-9, atol=1e-10)
        assert estimate.status is Status.SOLVED and estimate.window is None
        assert estimate.missing == {3: (0,), 7: (0, 1)}.get(t, ())


def test_reporting_the_prior_first_changes_nothing_later():
    model = ring()
    run = simulate(model, 5, np.random.default_rng(0))
    updated, reported = replay(KalmanFilter(model), run), replay(KalmanFilter(model, initial_update=False), run)
    np.testing.assert_array_equal(reported[0].state, model.mean)
    np.testing.assert_array_equal(reported[0].covariance, model.covariance)
    assert np.abs(updated[0].state).max() > 0
    for a, b in zip(updated[1:], reported[1:], strict=True):
        np.testing.assert_array_equal(a.state, b.state)


def test_ten_thousand_steps_stay_definite_and_converge():
    from scipy.linalg import solve_discrete_are

    # one sensor a million times better than the disturbance, unstable modes: the plain form loses definiteness here
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=1e-6), Sensor("third", [[0, 0, 1.0, 0]], sigma=1e-6)]
    model = ring(covariance=1e8 * np.eye(4)).with_sensors(sensors)
    estimator = KalmanFilter(model)
    lowest = np.inf
    for _ in range(10_000):
        covariance = estimator.step(np.zeros(2)).covariance
        lowest = min(lowest, np.linalg.eigvalsh(covariance)[0])
        assert (covariance == covariance.T).all()
    assert lowest > 0
    predicted = solve_discrete_are(RING_A.T, model.C.T, RING_Q, model.R)
    np.testing.assert_allclose(covariance, kalman_update(predicted, model.C, model.R)[1], rtol=1e-6, atol=1e-15)


def test_steady_covariance_of_the_ring_example():
    # dmhe-pre-estimation 7.2: stationary diagonal of (2.15) with two unit-variance sensors on each of x1 and x3
    C = [[1.0, 0, 0, 0], [1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 0, 1.0, 0]]
    model = ring().with_sensors([Sensor("all", C, sigma=1.0)])
    gains = kalman_gains(model, 300)
    np.testing.assert_allclose(np.diag(gains.predicted[1]), [0.3700, 0.1965, 1.0012, 4.4464], atol=5e-5)
    np.testing.assert_allclose(np.diag(gains.predicted[-1]), [0.0297, 0.0462, 0.5424, 0.9823], atol=5e-5)


@pytest.mark.parametrize("build", [ring, pushed])
def test_trials_at_once_equal_the_filter_one_by_one(build):
    model, rng = build(), np.random.default_rng(5)
    inputs = rng.normal(size=(6, 15, model.input_size)) if model.input_size else None
    run = simulate(model, 15, rng, inputs=inputs, trials=6)
    run.measurements[:, 4, 1] = run.measurements[:, 9] = np.nan
    states = kalman_trials(model, run.measurements, run.inputs)
    gains = kalman_gains(model, 15, ~np.isnan(run.measurements[0]))
    np.testing.assert_array_equal(states, kalman_trials(model, run.measurements, run.inputs, gains))
    for trial in range(6):
        estimator = KalmanFilter(model)
        for k, y in enumerate(run.measurements[trial]):
            estimate = estimator.step(y, run.inputs[trial, k - 1] if k and model.input_size else None)
            np.testing.assert_allclose(states[trial, k], estimate.state, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(gains.updated[k], estimate.covariance, rtol=1e-12, atol=1e-14)


def test_errors_are_as_large_as_the_covariance_says():
    model, trials = pushed(), 4000
    inputs = np.sin(np.arange(10.0))[:, None]
    run = simulate(model, 10, np.random.default_rng(6), inputs=inputs, trials=trials)
    error = (kalman_trials(model, run.measurements, run.inputs) - run.states)[:, -1]
    covariance = kalman_gains(model, 10).updated[-1]
    squared = np.einsum("ti,ij,tj->t", error, np.linalg.inv(covariance), error)
    assert squared.mean() == pytest.approx(3, abs=5 * np.sqrt(2 * 3 / trials))


@pytest.mark.parametrize("build", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_nonlinear_filters_are_consistent_and_better_than_dead_reckoning(build):
    model, trials, steps = unicycle(), 40, 60
    inputs = np.column_stack([np.ones(steps), np.full(steps, 0.5)])
    run = simulate(model, steps, np.random.default_rng(7), inputs=inputs, trials=trials)
    squared, error, blind = [], [], []
    for trial in range(trials):
        estimator, reckoning = build(model), build(model)
        for k in range(steps + 1):
            u = inputs[max(k - 1, 0)]
            estimate = estimator.step(run.measurements[trial, k], u)
            without = reckoning.step(None, u)
            assert estimate.status is Status.SOLVED
            if k >= 20:
                e = estimate.state - run.states[trial, k]
                error.append(e[:2])
                blind.append((without.state - run.states[trial, k])[:2])
                squared.append(e @ np.linalg.solve(estimate.covariance, e))
    assert 2.6 < np.mean(squared) < 3.4
    assert np.linalg.norm(error) < 0.3 * np.linalg.norm(blind)


def test_headings_far_beyond_pi_are_no_surprise():
    model = unicycle(mean=(2.0, 1.0, 40 * np.pi + 3.1))
    for build in (ExtendedKalmanFilter, UnscentedKalmanFilter):
        estimator = build(model)
        estimate = estimator.step([np.nan, np.nan, np.nan, -3.1])
        assert estimate.state[2] - (40 * np.pi + 3.1) == pytest.approx((2 * np.pi - 6.2) * 0.01 / (0.01 + 0.0025))


def test_iterated_update_minimizes_the_nonlinear_least_squares():
    from scipy.optimize import least_squares

    sensor = Sensor("range", lambda x: ca.norm_2(x), sigma=0.05)
    mean, covariance = np.array([1.0, 0.4]), np.diag([0.5, 0.3])
    model = NonlinearModel(lambda x: x, np.eye(2), 2, sensors=[sensor], mean=mean, covariance=covariance)

    def residuals(x):
        return np.append((x - mean) / np.sqrt(np.diag(covariance)), (2.0 - np.linalg.norm(x)) / 0.05)

    best = least_squares(residuals, mean, xtol=1e-15, gtol=1e-15, ftol=1e-15).x
    once, often = (ExtendedKalmanFilter(model, iterations=k).step([2.0]).state for k in (1, 50))
    np.testing.assert_allclose(often, best, atol=1e-8)
    assert np.linalg.norm(once - best) > 1e-3


def test_unscented_moments_of_a_square():
    # E[x^2] = m^2 + s^2 and Var[x^2] = 4 m^2 s^2 + 2 s^4 for a scalar Gaussian
    mean, variance = 0.7, 0.4
    model = NonlinearModel(lambda x: x**2, [[0.1]], 1, mean=[mean], covariance=[[variance]])
    estimator = UnscentedKalmanFilter(model)
    estimator.step(None)
    estimate = estimator.step(None)
    assert estimate.state[0] == pytest.approx(mean**2 + variance)
    assert estimate.covariance is not None
    assert estimate.covariance[0, 0] == pytest.approx(4 * mean**2 * variance + 2 * variance**2 + 0.1)


def test_parameters_reach_the_model():
    model = NonlinearModel(lambda x, p: p * x, [[1.0]], 1, parameters=1, mean=[2.0], covariance=[[1.0]])
    for build in (ExtendedKalmanFilter, UnscentedKalmanFilter):
        estimator = build(model, parameters=3.0)
        estimator.step(None)
        assert estimator.step(None).state == pytest.approx([6.0])
        with pytest.raises(DataError, match="parameters"):
            build(model)


def test_outputs_that_depend_on_the_input_need_it_at_once():
    sensor = Sensor("s", lambda x, u: x + u, sigma=1.0)
    model = NonlinearModel(lambda x, u: x, [[1.0]], 1, inputs=1, sensors=[sensor], covariance=[[1.0]])
    with pytest.raises(DataError, match="inputs"):
        ExtendedKalmanFilter(model).step([1.0])
    assert ExtendedKalmanFilter(model).step([5.0], [3.0]).state == pytest.approx([1.0])


def test_reset_starts_over():
    model = ring()
    run = simulate(model, 5, np.random.default_rng(0))
    estimator = KalmanFilter(model)
    first = replay(estimator, run)
    estimator.reset()
    for a, b in zip(first, replay(estimator, run), strict=True):
        np.testing.assert_array_equal(a.state, b.state)
        assert a.time == b.time


def test_times():
    estimator = KalmanFilter(ring(dt=0.5))
    assert [estimator.step(None).time for _ in range(3)] == [0.0, 0.5, 1.0]
    assert estimator.step(None, time=9.0).time == 9.0
    assert estimator.step(None).time == 9.5
    with pytest.raises(DataError, match="9.5"):
        estimator.step(None, time=9.5)


def test_estimate_is_a_table_row():
    model = ring(state_names=["a", "b", "c", "d"], dt=2.0)
    estimator = KalmanFilter(model)
    estimator.step([1.0, 2.0])
    estimate = estimator.step([1.0, 2.0])
    row = estimate.to_pandas()
    assert row.index.tolist() == [2.0] and row.index.name == "time"
    assert row["c"].item() == estimate.state[2] and row["status"].item() == "solved"
    assert row["sigma_d"].item() == np.sqrt(estimate.covariance[3, 3])


@pytest.mark.parametrize("build", FILTERS)
def test_one_protocol_and_estimates_that_do_not_change(build):
    estimator = build(ring())
    assert isinstance(estimator, Estimator)
    first = estimator.step([1.0, 2.0])
    kept = first.state.copy(), first.covariance.copy()
    first.covariance[:] = 0
    second = estimator.step([5.0, 5.0])
    np.testing.assert_array_equal(first.state, kept[0])
    assert np.linalg.eigvalsh(second.covariance)[0] > 0.01


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("build", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_numbers_that_cease_to_be_finite_are_a_status(build):
    sensor = Sensor("log", lambda x: ca.log(x), sigma=0.1)
    model = NonlinearModel(lambda x, u: x + u, [[0.01]], 1, inputs=1, sensors=[sensor], mean=[1.0], covariance=[[1e-4]])
    estimator = build(model)
    estimator.step([0.0], [0.0])
    failed = estimator.step([0.0], [-5.0])
    assert failed.status is Status.FAILED
    assert failed.state[0] == pytest.approx(-4.0, abs=0.01)
    recovered = estimator.step([0.0], [5.0])
    assert recovered.status is Status.SOLVED and recovered.state[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (DefinitionError, "LinearModel.*ExtendedKalmanFilter", lambda: KalmanFilter(unicycle())),
        (DefinitionError, "LinearModel", lambda: kalman_gains(unicycle(), 3)),
        (DefinitionError, "prior", lambda: KalmanFilter(LinearModel(RING_A, RING_Q))),
        (ShapeError, "measurements", lambda: KalmanFilter(ring()).step([1.0])),
        (DataError, "component 1 is infinite", lambda: KalmanFilter(ring()).step([1.0, np.inf])),
        (ShapeError, "inputs", lambda: KalmanFilter(pushed()).step([1.0, 1.0], [1.0, 2.0])),
        (DataError, "finite", lambda: KalmanFilter(pushed()).step([1.0, 1.0], [np.nan])),
        (DataError, "time", lambda: KalmanFilter(ring()).step(None, time=np.nan)),
        (SettingError, "iterations", lambda: ExtendedKalmanFilter(ring(), iterations=0)),
        (SettingError, "alpha", lambda: UnscentedKalmanFilter(ring(), kappa=-4.0)),
        (SettingError, "steps", lambda: kalman_gains(ring(), -1)),
        (ShapeError, "available", lambda: kalman_gains(ring(), 2, np.ones((2, 2), dtype=bool))),
        (ShapeError, "measurements", lambda: kalman_trials(ring(), np.zeros((3, 4, 1)))),
        (DataError, "inputs", lambda: kalman_trials(pushed(), np.zeros((3, 4, 2)))),
        (ShapeError, "inputs", lambda: kalman_trials(pushed(), np.zeros((3, 4, 2)), np.zeros((4, 1)))),
        (DataError, "finite", lambda: kalman_trials(ring(), np.full((3, 4, 2), np.inf))),
        (DataError, "every trial", lambda: kalman_trials(ring(), np.array([[[1.0, np.nan]], [[1.0, 1.0]]]))),
        (DataError, "gains", lambda: kalman_trials(ring(), np.zeros((1, 3, 2)), gains=kalman_gains(ring(), 5))),
    ],
)
def test_refusals(error, message, call):
    with pytest.raises(error, match=message):
        call()


def test_a_missing_input_after_the_first_step_changes_nothing():
    estimator = KalmanFilter(pushed())
    estimator.step([1.0, 1.0])
    before = estimator.mean.copy()
    with pytest.raises(DataError, match="inputs"):
        estimator.step([1.0, 1.0])
    np.testing.assert_array_equal(estimator.mean, before)
    assert estimator.step([1.0, 1.0], [0.0]).time == 1.0
