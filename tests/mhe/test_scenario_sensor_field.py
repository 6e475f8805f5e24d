"""The scenario `sensor-field`: settings, both engines, metrics against sums written out here, large fields, plot."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pydantic
import pytest
from typer.testing import CliRunner

from mhe.scenarios.sensor_field import Settings, Trace, scenario
from problems import registry
from problems.bench.scenario import trial_rng
from problems.cli.main import app

SMALL = {"nodes": 30, "radius": 260.0, "density": 60.0, "share": 0.15, "duration": 9, "horizon": 3, "network_seed": 4}
DISTRIBUTED = ("dmhe_f", "dmhe_pre", "dmhe_b", "dmhe_l_pre", "dmhe_1_pre")


def drawn(settings: Settings, trial: int = 0) -> Any:
    return scenario.draw(settings, trial_rng(11, scenario.name, trial))


def test_it_is_registered_and_refuses_what_it_does_not_know() -> None:
    assert registry.load("scenarios", "sensor-field") is scenario
    assert (Settings().duration, Settings(case=2).duration, Settings(case=2, duration=7).duration) == (40, 20, 7)
    assert Settings.model_validate({"case": 2}).duration == 20
    with pytest.raises(pydantic.ValidationError, match=r"l=5 exceeds horizon=4"):
        Settings(l=5)
    with pytest.raises(pydantic.ValidationError):
        Settings.model_validate({"sensors": 3})


@pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")
@pytest.mark.parametrize("method", DISTRIBUTED)
@pytest.mark.parametrize(
    "options", [{}, {"startup": "literal", "latency": 1, "omega": "hessian", "weights": "uniform"}]
)
def test_arrays_equal_messages(method: str, options: dict[str, Any]) -> None:
    arrays, messages = Settings(**SMALL, **options), Settings(**SMALL, **options, engine="messages")
    trial = drawn(arrays)
    one, other = (scenario.run(settings, method, "auto", trial) for settings in (arrays, messages))
    assert np.allclose(one.trace.errors, other.trace.errors, rtol=1e-9, atol=1e-7)
    assert one.metrics == pytest.approx(other.metrics)
    assert +one.status == +other.status and sum(one.status.values()) == 30 * 9
    assert one.options == other.options
    assert set(one.times) == set(other.times) == {"compile", "setup", "update", "solve"}
    assert one.step_seconds.shape == (9,) and other.step_seconds.shape == (30 * 9,)


@pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")
@pytest.mark.parametrize("bounds", ["hard", "soft"])
@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b"])
def test_bounds(method: str, bounds: str) -> None:
    tight = {"bounds": bounds, "width": 10.0, "gains": "sum"}
    arrays, messages = Settings(**SMALL, **tight), Settings(**SMALL, **tight, engine="messages")
    trial = drawn(arrays)
    one, other = (scenario.run(settings, method, "auto", trial) for settings in (arrays, messages))
    assert np.allclose(one.trace.errors, other.trace.errors, rtol=1e-6, atol=1e-6)
    assert +one.status == +other.status
    assert (one.status["infeasible"] > 0) == (bounds == "hard" and method == "dmhe_l_pre")
    wide = scenario.run(Settings(**SMALL, bounds=bounds, width=1000.0), method, "auto", trial)
    assert np.allclose(wide.trace.errors, scenario.run(Settings(**SMALL), method, "auto", trial).trace.errors)


def test_infeasible_bounds_are_warned_of() -> None:
    tight = Settings(**SMALL, bounds="hard", width=4.0)
    with pytest.warns(
        UserWarning, match=r"dmhe_l_pre: \d+ local problem\(s\) had no sequence within the bounds; first"
    ):
        scenario.run(tight, "dmhe_l_pre", "auto", drawn(tight))


def test_metrics() -> None:
    settings = Settings(**SMALL)
    field = scenario.field(settings)
    errors = np.full((10, 30), 4.0)
    errors[0] = 1000.0  # t = 0 is the prior
    errors[1], errors[2], errors[4] = 40.0, 9.0, 12.0
    errors[:, field.active] *= 0.5
    share = len(field.active) / 30
    mean = errors.mean(axis=1)
    found = scenario.score(settings, Trace(errors))
    assert found["prmse"] == pytest.approx(mean[1:].sum() / 9)
    assert found["prmse_at_1"] == pytest.approx(mean[1]) and found["steady_prmse"] == pytest.approx(mean[5:].mean())
    assert found["convergence_time"] == 5  # the second time below 10 m
    assert found["prmse_literal"] == pytest.approx(errors[1:, field.active].sum() / 30 / 9)
    errors[-1] = 11.0
    assert scenario.score(settings, Trace(errors))["convergence_time"] is None
    central = scenario.score(settings, Trace(np.full((10, 1), 3.0)))
    assert central["convergence_time"] == 1 and central["prmse_literal"] == pytest.approx(3.0 * share)


def test_centralized_methods_and_registered_estimators() -> None:
    settings = Settings(**SMALL, prior="filter")
    trial = drawn(settings)
    kalman, central = (scenario.run(settings, method, "auto", trial) for method in ("kf", "mhe"))
    assert np.allclose(kalman.trace.errors, central.trace.errors, atol=1e-7)
    seed = scenario.run(Settings(**SMALL), "mhe", "auto", trial)
    assert seed.metrics["prmse"] > central.metrics["prmse"] and sum(seed.status.values()) == 9
    assert scenario.run(settings, "mhe_pre", "auto", trial).trace.errors.shape == (10, 1)  # only registered


def test_a_campaign_is_its_trials() -> None:
    settings = Settings(**SMALL)
    trials = [drawn(settings, trial) for trial in range(3)]
    for method in ("dmhe_1_pre", "mhe"):
        for trace, trial in zip(scenario.campaign(settings, method, trials), trials, strict=True):
            assert np.allclose(trace.errors, scenario.run(settings, method, "auto", trial).trace.errors, atol=1e-9)


@pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")
@pytest.mark.parametrize("solver", ["daqp", "gauss-newton"])
@pytest.mark.parametrize("method", ["dmhe_f", "dmhe_1_pre"])
def test_a_named_solver_is_called(method: str, solver: str) -> None:
    settings = Settings(**SMALL)
    trial = drawn(settings)
    free, called = (scenario.run(settings, method, name, trial) for name in ("auto", solver))
    assert np.allclose(free.trace.errors, called.trace.errors, atol=1e-6)
    assert called.options["solver"] == solver


def test_the_largest_component_of_a_large_field() -> None:
    settings = Settings(nodes=600, duration=6)
    field = scenario.field(settings)
    assert 500 < field.network.count < 600 == field.drawn and field.network.is_strongly_connected
    assert field.side == pytest.approx(1000 * np.sqrt(6))
    outcome = scenario.run(settings, "dmhe_l_pre", "auto", drawn(settings))
    assert outcome.options["nodes"] == field.network.count and outcome.options["nodes_drawn"] == 600
    assert outcome.trace.errors.shape == (7, field.network.count)


def test_hops_to_the_nearest_sensor_and_the_reference_network() -> None:
    field = scenario.field(Settings())
    assert np.bincount(field.hops).tolist() == [10, 56, 28, 6] and len(field.network.edges) == 2 * 352


def test_plot() -> None:
    settings = Settings(**SMALL)
    trial = drawn(settings)
    outcomes = {name: scenario.run(settings, name, "auto", trial) for name in ("mhe", "dmhe_l_pre")}
    left, right = scenario.plot(settings, trial, outcomes).axes
    assert left.get_yscale() == "log"
    for line, outcome in zip(left.lines, outcomes.values(), strict=False):
        assert np.allclose(line.get_ydata(), outcome.trace.errors.mean(axis=1)[1:])
    shown = sum(len(group.get_offsets()) for group in right.collections[1:])
    assert shown == 30 and len(right.collections[0].get_segments()) == len(scenario.field(settings).network.edges) // 2


def test_the_command() -> None:
    words = "run sensor-field --method dmhe_l_pre --method mhe --trials 2 --seed 3 --json --set duration=6"
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["rows"]
    assert [row["method"] for row in rows] == ["dmhe_l_pre", "mhe"]
    assert rows[0]["metrics"]["prmse"] > rows[1]["metrics"]["prmse"] > 0
    assert rows[0]["status"]["solved"] == 2 * 6 * 100 and rows[0]["options"]["links"] == 352
