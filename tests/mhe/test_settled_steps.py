"""Steps of a settled window beside ordinary ones, which a named solver always takes."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from mhe import Polyhedron, mhe, mhe_pre
from problems import LinearModel, Sensor, simulate
from problems.errors import DataError
from problems.solvers.qp_recursion import RecursionSolution

STEPS = 400


def oscillator(inputs: bool = False) -> LinearModel:
    return LinearModel(
        [[0.99, 0.2, 0], [-0.2, 0.9, 0], [0.05, 0, 0.8]],
        np.diag([0.05, 0.1, 0.08]),
        B=[[0.0], [0.5], [0.2]] if inputs else None,
        sensors=[Sensor("first", [[1.0, 0, 0]], sigma=0.3), Sensor("third", [[0, 0.3, 1.0]], sigma=0.5)],
        covariance=np.eye(3),
    )


def pair(make: Any = mhe, horizon: int = 4, inputs: bool = False, **options: Any) -> tuple[Any, Any]:
    """The estimator that settles, and one whose every step asks the solver."""
    model = oscillator(inputs)
    return make(model, horizon, **options), make(model, horizon, solver="daqp", **options)


def measured(seed: int = 0) -> np.ndarray:
    return simulate(oscillator(), STEPS - 1, np.random.default_rng(seed)).measurements


def box(share: float) -> Polyhedron:
    edge = np.quantile(np.abs(simulate(oscillator(), STEPS, np.random.default_rng(0)).states), share, axis=0)
    return Polyhedron.box(-edge, edge)


def same(got: Any, want: Any) -> None:
    assert (got.status, got.time, got.missing, got.late) == (want.status, want.time, want.missing, want.late)
    np.testing.assert_allclose(got.state, want.state, atol=1e-7)
    np.testing.assert_allclose(got.window, want.window, atol=1e-7)


def settled(estimate: Any) -> bool:
    return isinstance(estimate.solution, RecursionSolution)


CASES: dict[str, dict[str, Any]] = {
    "filter": {},
    "seed": {"prior": "seed"},
    "constant": {"prior": "seed", "arrival_covariance": "constant"},
    "smoothing": {"prior": "smoothing"},
    "horizon 1": {"horizon": 1},
    "sparse": {"horizon": 130},
    "F1": {"form": "F1"},
    "observer": {"make": mhe_pre},
    "inputs": {"inputs": True},
    "inputs, smoothing": {"inputs": True, "prior": "smoothing"},
    "inputs, observer": {"inputs": True, "make": mhe_pre},
    "box": {"state_bounds": 0.8},
    "box, F3": {"state_bounds": 0.8, "form": "F3"},
    "box, F1, one side": {
        "state_bounds": 0.8,
        "form": "F1",
        "disturbance_bounds": Polyhedron.box([-0.2] * 3, [9.0] * 3),
    },
    "box, observer, inputs": {"state_bounds": 0.8, "make": mhe_pre, "inputs": True},
}


@pytest.mark.parametrize("case", CASES)
def test_they_find_what_ordinary_steps_find(case: str) -> None:
    options = dict(CASES[case])
    if "state_bounds" in options:
        options["state_bounds"] = box(options["state_bounds"])
    ours, theirs = pair(**options)
    rng, kept, active = np.random.default_rng(1), [], 0
    for y in measured():
        u = rng.normal(size=1) if options.get("inputs") else None
        got, want = ours.step(y, u), theirs.step(y, u)
        same(got, want)
        kept.append(got)
        if not settled(got):
            continue
        for name, expected in want.solution.multipliers.items():
            np.testing.assert_allclose(got.solution.multipliers[name], expected, atol=1e-5)
        active += any(np.abs(v).max() > 1e-9 for n, v in got.solution.multipliers.items() if "bounds" in n)
        assert max(got.solution.residuals.values()) < 1e-8
        assert got.solution.objective == pytest.approx(want.solution.objective, abs=1e-6)
    solved = [one for one in kept[250:] if one.status == "solved"]
    assert len(solved) > 75 and np.mean([settled(one) for one in solved]) > 0.95
    assert active > 20 or "box" not in case
    if kept[-1].covariance is not None:
        np.testing.assert_allclose(kept[-1].covariance, want.covariance, atol=1e-7)


def test_what_is_not_regular_takes_the_long_way_and_they_go_on_after_it() -> None:
    ours, theirs = pair(state_bounds=box(0.85), prior="seed", arrival_covariance="constant")
    measurements = measured()
    measurements[60, 0] = measurements[61] = measurements[200, 1] = np.nan
    found = []
    for t, y in enumerate(measurements):
        options: dict[str, Any] = {"time": float(t)} if t % 3 else {}
        if t == 100:
            options["late"] = [(97.0, [0.4, np.nan])]
        got, want = ours.step(y.tolist() if t % 2 else y, **options), theirs.step(y, **options)
        same(got, want)
        found.append(settled(got))
        if t == 150:
            np.testing.assert_allclose(ours.session.store["y"], theirs.session.store["y"])
            np.testing.assert_allclose(ours.session.store["reference"], theirs.session.store["reference"], atol=1e-7)
    assert all(found[t] for t in (50, 70, 110, 151, 152, 210)) and not any(found[t] for t in (60, 61, 64, 100, 200))


@pytest.mark.parametrize("bad", [[np.inf, 0.0], [1.0], "text"])
def test_a_refused_measurement_changes_nothing(bad: Any) -> None:
    ours, theirs = pair(prior="seed", arrival_covariance="constant")
    for t, y in enumerate(measured()[:60]):
        if t == 40:
            with pytest.raises(ValueError):
                ours.step(bad)
        same(ours.step(y), theirs.step(y))
    with pytest.raises(DataError, match="time"):
        ours.step([0.0, 0.0], time=3.0)


def test_estimates_stay_as_they_were() -> None:
    estimator, _ = pair(state_bounds=box(0.8), prior="seed", arrival_covariance="constant")
    measurements = measured()
    seen = []
    for y in measurements[:120]:
        one = estimator.step(y)
        seen.append((one, one.state.copy()))
        one.state[:] += 100.0  # the caller's own
        y[:] = 7.0
    again, _ = pair(state_bounds=box(0.8), prior="seed", arrival_covariance="constant")
    for (one, state), y in zip(seen, measured()[:120], strict=True):
        want = again.step(y)
        np.testing.assert_array_equal(state, want.state)
        np.testing.assert_array_equal(one.window, want.window)
        np.testing.assert_array_equal(one.solution.point, want.solution.point)


def test_residuals_bound_those_of_the_rows() -> None:
    estimator, _ = pair(state_bounds=box(0.8), prior="seed", arrival_covariance="constant")
    for y in measured()[:200]:
        solution = estimator.step(y).solution
        if isinstance(solution, RecursionSolution):
            exact, stated = solution._check.residuals(), solution.residuals
            assert exact["dual"] <= stated["dual"] < 1e-10
            assert exact["primal"] <= stated["primal"] + 1e-14
            assert exact["gap"] <= stated["gap"] + 1e-13


def test_windows_without_a_point_are_reported_and_left_behind() -> None:
    # with an observer the window has the freedom of one state
    ours, theirs = pair(mhe_pre, state_bounds=box(0.8))
    statuses = set()
    for y in measured():
        got, want = ours.step(y), theirs.step(y)
        same(got, want)
        assert got.infeasible == want.infeasible
        statuses.add(str(got.status))
    assert statuses == {"solved", "infeasible"}


def test_they_travel_and_start_afresh() -> None:
    estimator, _ = pair(prior="seed", arrival_covariance="constant")
    first = [estimator.step(y) for y in measured()[:40]]
    copy = pickle.loads(pickle.dumps(first[-1]))
    np.testing.assert_array_equal(copy.window, first[-1].window)
    np.testing.assert_array_equal(copy.covariance, first[-1].covariance)
    assert copy.solution is None
    estimator.reset()
    for y, before in zip(measured()[:40], first, strict=True):
        np.testing.assert_allclose(estimator.step(y).state, before.state, atol=1e-12)


def test_preparing_leaves_them() -> None:
    ours, theirs = pair(prior="seed", arrival_covariance="constant")
    for t, y in enumerate(measured()[:80]):
        if 40 < t < 50:
            ours.prepare()
        got = ours.step(y)
        same(got, theirs.step(y))
        assert settled(got) is (t > 5 and not 40 < t < 50)
