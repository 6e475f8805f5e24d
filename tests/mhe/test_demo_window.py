"""Scenario ``demo-window``: bounds bite and help, solvers meet, what a row needs is there."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.scenarios.demo_window import Settings, scenario
from problems.bench.scenario import trial_rng


def drawn(trial, settings):
    return scenario.draw(settings, trial_rng(1, scenario.name, trial))


def test_bounds_are_active_in_a_third_to_half_of_the_steps_and_help():
    settings = Settings()
    errors = {"tight": [], "none": [], "kf": []}
    share = []
    for trial in range(12):
        world = drawn(trial, settings)
        assert (world.states >= 0).all()
        for bounds in ("tight", "none"):
            outcome = scenario.run(Settings(bounds=bounds), "mhe", "auto", world)
            errors[bounds].append(outcome.metrics["rmse"])
            if bounds == "tight":
                share.append(outcome.metrics["active_share"])
                assert outcome.trace.states.min() > -1e-7
        errors["kf"].append(scenario.run(settings, "kf", "none", world).metrics["rmse"])
    assert 0.3 < np.mean(share) < 0.5
    np.testing.assert_allclose(errors["none"], errors["kf"], atol=1e-9)
    assert np.mean(errors["tight"]) < 0.97 * np.mean(errors["kf"])


@pytest.mark.parametrize("method", ["mhe", "mhe_pre"])
@pytest.mark.parametrize("solver", ["auto", "daqp", "osqp", "proxqp", "ipopt", "gauss-newton"])
def test_every_solver_comes_to_the_reference_as_its_tolerance_allows(method, solver):
    world = drawn(0, Settings(duration=25))
    for tolerance, distance in ((1e-4, 1e-1), (1e-8, 1e-5)):
        settings = Settings(duration=25, tolerance=tolerance)
        outcome = scenario.run(settings, method, solver, world)
        assert outcome.estimate is not None
        away = np.linalg.norm(outcome.estimate - scenario.reference(settings, method, world), axis=1)
        assert away.max() < distance
        assert outcome.status == {"solved": 26}
        assert outcome.step_seconds.shape == (26,)
        assert set(outcome.times) == {"compile", "update", "solve"} and min(outcome.times.values()) > 0
        assert outcome.options["solver"] == solver


def test_the_form_is_taken_where_it_belongs():
    world = drawn(0, Settings(duration=5))
    forms = {
        method: scenario.run(Settings(duration=5, form="F3"), method, "daqp", world).options["form"]
        for method in ("mhe", "mhe_pre")
    }
    assert forms == {"mhe": "F3", "mhe_pre": "P2"}


def test_the_picture_shows_every_outcome():
    settings = Settings(duration=10)
    world = drawn(0, settings)
    outcomes = {method: scenario.run(settings, method, "auto", world) for method in scenario.methods}
    figure = scenario.plot(settings, world, outcomes)
    labels = [line.get_label() for line in figure.axes[1].get_lines()]
    assert {"truth", "measured", *outcomes} <= set(labels)


def test_the_filter_is_consistent_on_its_own_model_and_says_where_it_is_not():
    """Rain is no Gaussian noise with mean zero; on measurements of the model itself the squares average the degrees."""
    from mhe.scenarios.demo_window import Drawn, _model
    from problems.models import simulate

    rng = np.random.default_rng(3)
    squares = {"nees": [], "nis": []}
    for _ in range(40):
        made = simulate(_model(), 30, rng)
        settings = Settings(bounds="none")
        world = Drawn(made.states, made.measurements)
        filtered = scenario.run(settings, "kf", "none", world)
        window = scenario.run(settings, "mhe", "auto", world)
        np.testing.assert_allclose(window.consistency["nees"].squared, filtered.consistency["nees"].squared, rtol=1e-6)
        for name, found in squares.items():
            found.append(filtered.consistency[name].squared / filtered.consistency[name].degrees)
    for found in squares.values():
        each = np.mean(found, axis=1)
        assert abs(each.mean() - 1) < 4 * each.std() / np.sqrt(len(each))
    assert "nees" not in scenario.run(Settings(), "mhe_pre", "auto", drawn(0, Settings())).consistency
