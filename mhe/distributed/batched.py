"""Many trials of a network at once, all nodes in one batch: DMHE, DMHE_pre and DMHE_w-pre without messages."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from mhe.arrival import inverse
from mhe.covariance import SETTLED_TOLERANCE
from mhe.distributed.design import NetworkDesign
from mhe.distributed.fallback import Fallback
from mhe.distributed.stacked import (
    BatchEstimate,
    StackedNetwork,
    TrialInfeasibility,
    TrialRun,
    series,
)
from mhe.distributed.summed import Outputs, Region, SummedWindow
from problems.errors import DataError

__all__ = ["BatchEstimate", "BatchedNetwork", "TrialInfeasibility", "TrialRun", "run_trials"]


class BatchedNetwork(StackedNetwork):
    """A network of `DistributedNode` in many trials at once, over ideal links.

    Args:
        design: of the network.
        trials: how many.
        updates: of the arrival covariances; at least as many as there will be steps after the first N, or the default
            for a run of unknown length.

    Attributes:
        design: of the network.
    """

    def __init__(self, design: NetworkDesign, trials: int, updates: int | None = None) -> None:
        if trials < 1:
            raise DataError(f"a batched network runs at least one trial, got {trials}")
        started = perf_counter()
        self.design = design
        options, model, network = design.options, design.model, design.network
        known = design.covariances() if updates is None else design.covariances(updates)
        self._fused = known.fused
        observer = design.gains is not None
        window = SummedWindow(
            model,
            options.horizon,
            form=options.form,
            observer=observer,
            state_bounds=design.state_bounds,
            disturbance_bounds=design.disturbance_bounds,
        )
        outputs = Outputs(model)
        sizes = [rows.size for rows in design.regional_rows]
        gains = None if design.gains is None else np.vstack([gain.gain.T for gain in design.gains])
        nodes, rows = np.repeat(np.arange(network.count), sizes), np.concatenate(design.regional_rows)
        region = Region(model, outputs, network.count, nodes, rows, gains)
        reach = np.zeros(options.horizon + 1, dtype=np.int64)
        settings = {"tolerance": options.tolerance, **options.settings}
        mean = model.prior()[0]
        super().__init__(
            model, network, mean, options.horizon, trials, window, [region], reach, outputs, options.solver, settings
        )
        self._published = self._states[:, :, 0].copy()
        self._entry_passed: np.ndarray | None = None
        self._passed: np.ndarray | None = None
        self._fallbacks: dict[int, Fallback] = {}
        self.phases["precompute"] = perf_counter() - started

    def _publish(self) -> None:
        if self._instant:
            self._published = self._states[:, :, 1 if self._newest == self._horizon else 0].copy()

    def _arrival(self) -> dict[str, Any]:
        rule = self.design.options.growth_prior
        if self._instant > self._horizon or rule == "consensus":
            reference = self.design.weights.combine(self._published)
        elif rule == "own":
            reference = self._published
        else:
            reference = np.broadcast_to(self.model.prior()[0], self._published.shape)
        return {"reference": reference.reshape(self._batch.count, -1), **self._information()}

    def _information(self) -> dict[str, Any]:
        entry = min(max(0, self._instant - self._horizon), len(self._fused) - 1)
        fused = self._fused[entry]
        if self._entry_passed is not None and (
            fused is self._entry_passed or np.array_equal(fused, self._entry_passed)
        ):
            return {}
        self._entry_passed = fused
        matrix = inverse(fused)
        if self._passed is not None:
            change, size = (np.abs(part).max(axis=(1, 2)) for part in (matrix - self._passed, matrix))
            if (change <= SETTLED_TOLERANCE * size).all():
                return {}
        self._passed = matrix
        return {"information": matrix}

    def _relaxed(self, node: int, trial: int, data: dict[str, Any]) -> tuple[np.ndarray | None, tuple[str, ...], bool]:
        design = self.design
        if node not in self._fallbacks:
            gain = None if design.gains is None else design.gains[node].gain
            bounds = design.state_bounds, design.disturbance_bounds
            self._fallbacks[node] = Fallback(
                design.pool, design.regional[node], gain, design.options, *bounds, self._window.bounds
            )
        y = data["y"][:, design.regional_rows[node]].reshape(-1, 1)
        data = data | ({"y": y} if y.size else {})
        if not y.size:
            data.pop("y")
        prediction = np.empty(0)
        states, unmet = self._fallbacks[node](data, prediction, self._newest)
        return None if states is prediction else states, tuple(unmet), False


def run_trials(design: NetworkDesign, measurements: Any, inputs: Any = None) -> TrialRun:
    """Run a network over recorded or simulated trials.

    Args:
        design: of the network.
        measurements: (trials, steps, p) of all sensors in the order of the model, instant 0 first; NaN where missing.
        inputs: (steps - 1, m) or (trials, steps - 1, m); row k acts from instant k to k + 1.

    Raises:
        ShapeError, DataError: they do not fit.
    """
    y, u = series(design.model, measurements, inputs)
    updates = max(0, y.shape[1] - 1 - design.options.horizon)
    return BatchedNetwork(design, y.shape[0], updates=updates).run(y, u)
