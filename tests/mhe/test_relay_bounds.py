"""Nodes that relay: bounded residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from relay_worlds import WINDOWS

from mhe.polyhedron import Polyhedron
from mhe.relay import RelayEstimate, RelayEstimator
from mhe.scenarios.sensor_field_world import POSITION, draw_trial, sensor_field
from problems.solvers.base import Status


# Bounds
def bounded(bounds: str, size: float, method: str = "dmhe_l_pre", **options: Any) -> tuple[list[Any], np.ndarray]:
    field = sensor_field(nodes=30, share=0.2)
    trial = draw_trial(field, 8, np.random.default_rng(1))
    estimator = RelayEstimator(
        field.model,
        field.network,
        method,
        placement=field.placement,
        residual_bounds=Polyhedron.box([-size] * 2, [size] * 2),
        bounds=bounds,
        windows=WINDOWS,
        **options,
    )
    return [estimator.step(y) for y in trial.measurements], trial.states


@pytest.mark.filterwarnings("ignore")
def test_hard_residual_bounds_that_cannot_be_met_are_reported_per_node_and_instant() -> None:
    results, _ = bounded("hard", 10.0, gains="sum")
    reported = [entry for result in results for entry in result.infeasible]
    status = [s for result in results for s in result.status]
    assert len(reported) == status.count(Status.INFEASIBLE) > 10
    assert all(entry.bounds and entry.bounds[0].startswith("residual node ") for entry in reported)
    names = {name for entry in reported for name in entry.bounds}
    assert len(names) > 1  # named by the sensors of the node, not by those of the window it shares


def test_soft_residual_bounds_never_fail_and_wide_ones_do_nothing() -> None:
    tight, _ = bounded("soft", 10.0)
    assert all(status is Status.SOLVED for result in tight for status in result.status)
    assert any(result.infeasible for result in tight)
    free, wide = (bounded("soft", size)[0] for size in (1e9, 1000.0))
    for a, b in zip(free, wide, strict=True):
        assert np.abs(a.states - b.states).max() < 1e-9
        assert not b.infeasible


def test_residual_bounds_hold_where_they_are_feasible() -> None:
    results, _ = bounded("hard", 9.0, method="dmhe_b")
    field = sensor_field(nodes=30, share=0.2)
    trial = draw_trial(field, 8, np.random.default_rng(1))
    touched = 0
    for t, result in enumerate(results[1:], 1):
        assert result.status.count(Status.SOLVED) == 30
        for node in result.nodes:
            assert isinstance(node, RelayEstimate) and node.window is not None
        for i in field.active:
            node = result.nodes[i]
            rows = [2 * i, 2 * i + 1]
            residual = trial.measurements[t - len(node.window) + 1 : t + 1][:, rows] - node.window @ POSITION.T
            assert np.abs(residual).max() < 9 + 1e-6
            touched += np.abs(residual).max() > 9 - 1e-6
    assert touched
