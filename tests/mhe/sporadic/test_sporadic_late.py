"""Delayed, lost and repeated readings, late and missing neighbours: dmhe-sporadic-fov section 10."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.filters import KalmanFilter
from mhe.sporadic import Reading
from problems.networks import Network, band, complete
from problems.runtime import Links, Outage

N = 3
FILTER = {"prior": "filter", "pi_update": "onestep", "growth_prior": "mean", "horizon": N}


def delayed(values, delays):
    """Readings of a single node with one sensor, reading k delivered at step k + delays[k]."""
    for t in range(len(values)):
        late = [(float(k), values[k, 0], None) for k in range(t) if k + delays[k] == t]
        now = values[t, 0] if delays[t] == 0 else None
        yield [Reading(now, None, late)]


def test_filter_prior_is_the_kalman_filter_with_missing_readings(make_scene, run):
    scene = make_scene(nodes=1, vehicles=1)
    rng = np.random.default_rng(1)
    values = rng.normal(size=(30, 1, 1, 2))
    values[rng.random(30) < 0.4] = np.nan
    kalman = KalmanFilter(scene.model())
    steps = run(scene.build("dmhe_f", Network(1), **FILTER), values)
    for t, step in enumerate(steps):
        wanted = kalman.step(values[t].ravel())
        if t:
            assert np.abs(step.states[0] - wanted.state).max() < 1e-10


def test_delays_up_to_the_horizon_leave_the_arrival_cost_as_it_is(make_scene, run):
    scene = make_scene(nodes=1, vehicles=1)
    rng = np.random.default_rng(2)
    T = 40
    values = rng.normal(size=(T, 1, 1, 2))
    delays = rng.integers(0, N + 1, T)
    delays[-8:] = 0
    on_time = run(scene.build("dmhe_f", Network(1), **FILTER), values)
    estimator = scene.build("dmhe_f", Network(1), **FILTER)
    steps = [estimator.step(entry) for entry in delayed(values, delays)]
    apart = [np.abs(a.states - b.states).max() for a, b in zip(on_time, steps, strict=True)]
    for a, b in zip(on_time, steps, strict=True):
        assert np.array_equal(a.nodes[0].arrival_covariance, b.nodes[0].arrival_covariance)
        assert b.nodes[0].too_late == 0
    assert max(apart[5:30]) > 0.1
    # all readings of the window are in again
    assert max(apart[-4:]) < 1e-12
    assert sum(len(step.nodes[0].late) for step in steps) == (delays[: T - N] > 0).sum()


def test_the_seed_prior_does_feel_delays(make_scene, run):
    scene = make_scene(nodes=1, vehicles=1)
    values = np.random.default_rng(3).normal(size=(25, 1, 1, 2))
    delays = np.zeros(25, dtype=int)
    delays[10] = 2
    on_time = run(scene.build("dmhe_f", Network(1), horizon=N), values)
    estimator = scene.build("dmhe_f", Network(1), horizon=N)
    steps = [estimator.step(entry) for entry in delayed(values, delays)]
    assert np.abs(on_time[14].states - steps[14].states).max() > 1e-6


def test_a_reading_whose_instant_has_left_is_dropped_and_counted(make_scene, run):
    scene = make_scene(nodes=1, vehicles=1)
    values = np.random.default_rng(4).normal(size=(20, 1, 1, 2))
    delays = np.zeros(20, dtype=int)
    delays[8] = N + 1
    estimator = scene.build("dmhe_f", Network(1), **FILTER)
    steps = [estimator.step(entry) for entry in delayed(values, delays)]
    lost = values.copy()
    lost[8] = np.nan
    without = run(scene.build("dmhe_f", Network(1), **FILTER), lost)
    assert [step.nodes[0].too_late for step in steps] == [int(t == 8 + N + 1) for t in range(20)]
    assert np.array_equal([s.states for s in steps], [s.states for s in without])


def test_a_reading_that_comes_twice_counts_once(make_scene, run):
    scene = make_scene(nodes=1, vehicles=1)
    values = np.random.default_rng(5).normal(size=(12, 1, 1, 2))
    once = run(scene.build("dmhe_w_pre", Network(1)), values)
    estimator = scene.build("dmhe_w_pre", Network(1))
    twice = []
    for t in range(12):
        again = [(float(k), values[k, 0], None) for k in range(max(0, t - 2), t)]
        twice.append(estimator.step([Reading(values[t, 0], None, again)]))
    assert np.array_equal([s.states for s in once], [s.states for s in twice])


def test_a_late_reading_reaches_the_neighbors_with_its_own_time_stamp(make_scene):
    scene = make_scene(nodes=2, vehicles=1)
    values = np.zeros((2, 1, 2))
    windows = []
    for late in (False, True):
        estimator = scene.build("dmhe_f", complete(2), **FILTER)
        for t in range(9):
            now = values.copy()
            now[0] = 1.0 if t == 6 else 0.0
            if late and t == 6:
                now[0] = np.nan
            extra = [(6.0, [np.ones((1, 2)), None], None)] if late and t == 8 else []
            step = estimator.step(now, None, extra)
        windows.append(step.nodes[1])
    assert np.array_equal(windows[0].window, windows[1].window)
    assert windows[1].late == (6.0,)


def test_links_that_delay_and_lose_do_no_more_than_cost_accuracy(scene, run):
    rng = np.random.default_rng(6)
    values = scene.readings(60, rng, sigma=0.3)
    truth = scene.truth.reshape(60, 1, -1)
    errors = {}
    for name, links in {"ideal": None, "late": Links(delay=2), "lossy": Links(loss=0.3)}.items():
        estimator = scene.build("dmhe_w_pre", links=links, rng=np.random.default_rng(7))
        steps = run(estimator, values)
        states = np.array([step.states for step in steps])
        assert np.isfinite(states).all()
        errors[name] = np.abs(states - truth)[20:].mean()
        for step in steps[5:]:
            for node in step.nodes:
                assert node.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert errors["ideal"] < errors["late"] < 3 * errors["ideal"]
    assert errors["ideal"] < errors["lossy"] < 3 * errors["ideal"]


def test_covariances_of_late_neighbors_grow_by_q_per_step(make_scene, run):
    """Two nodes, messages d steps late, nobody sees anything: Pi of the other is its Pi of d steps ago and d Q more."""
    scene, d = make_scene(nodes=2, vehicles=1), 2
    estimator = scene.build("dmhe_w_pre", band(2, 1), links=Links(delay=d), horizon=N)
    found = [step.nodes[0].arrival_covariance[0, 0, 0] for step in run(estimator, np.full((14, 2, 1, 2), np.nan))]
    # own Pi at t: PiBar(t - 1) + q; the other's: what it published d steps before, inflated
    for t in range(N + 1 + d, 14):
        own, other = found[t - 1] + 1.0, found[t - 1 - d] + 1.0 + d
        assert found[t] == pytest.approx((own + other) / 2, rel=1e-12)


def test_a_node_that_is_down_is_left_out_and_comes_back(scene, run):
    values = scene.readings(40, np.random.default_rng(8), sigma=0.3)
    estimator = scene.build("dmhe_w_pre", outages=[Outage(2, 10, 25)], forget_after=3)
    steps = run(estimator, values)
    assert steps[12].nodes[2] is None and np.isnan(steps[12].states[2]).all()
    # remembered for three steps, then without weight
    assert steps[12].nodes[1].weights[2] > 0 and steps[14].nodes[1].weights[2] == 0.0
    assert steps[14].nodes[1].weights.sum() == pytest.approx(1.0)
    back = steps[26].nodes[2]
    assert back is not None and np.isfinite(back.state).all()
    assert np.abs(back.state - steps[26].nodes[1].state).max() < 3.0
