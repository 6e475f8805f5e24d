"""Scenario ``surveillance``: cameras with limited fields of view locate vehicles on a road.

Source: dmhe-sporadic-fov section 6.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic

from mhe.scenarios._surveillance_metrics import METRICS, error_norms, errors_of, in_window, outside, over_nodes, share
from mhe.scenarios._surveillance_settings import Settings
from mhe.scenarios._surveillance_world import Drawn, World, draw, world_of
from mhe.sporadic import METHODS, BatchedDetections, SporadicEstimator
from mhe.sporadic.recordings import write_positions, write_readings
from problems.bench.scenario import Curve, Outcome
from problems.errors import ModelWarning
from problems.models import LinearModel, Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FACTORS = ("disturbance", "weights", "weight_fusion", "pi_update", "prior", "growth_prior", "row_scope", "unmet")


@dataclass(frozen=True, eq=False)
class Trace:
    """What a method estimated in one trial.

    Attributes:
        estimates: (instants, n_S, n_V, 2) of x_{t|t}.
        unmet: (instants, n_S, n_V) whether rows of a vehicle could not be met.
    """

    estimates: np.ndarray
    unmet: np.ndarray


class Surveillance:
    """See the module, and `problems.bench.scenario.Scenario`."""

    name = "surveillance"
    source = (
        "spec dmhe-sporadic-fov 6.1 (gazebo) and 6.2 (cases 1 to 3). rmse_all, rmse_active: mean over time and nodes "
        "of the error norm of all vehicles together, rmse_detected: root mean square error of what a camera detects; "
        "infeasible_share: of the problems of a node and a vehicle with rows, those whose rows contradict each other; "
        "outside_share: of the detections, those whose estimate is outside of the camera's part of the road"
    )
    methods: tuple[str, ...] = tuple(METHODS)
    metrics: tuple[str, ...] = METRICS
    settings: type[pydantic.BaseModel] = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        return draw(settings, rng)

    def world(self, settings: Settings) -> World:
        """Road, cameras, graph and true positions, the same object for the same settings."""
        return world_of(settings)

    def estimator(self, settings: Settings, method: str, solver: str = "auto") -> SporadicEstimator:
        """A method as the settings say, at instant 0.

        Args:
            settings: of the scenario.
            method: one of `methods`.
            solver: registered name.
        """
        world, count = world_of(settings), settings.vehicles
        identity, noise = np.eye(2 * count), settings.measurement_variance * np.eye(2)
        sensors = [
            Sensor(_name(camera, vehicle), identity[2 * vehicle : 2 * vehicle + 2], covariance=noise)
            for camera in world.network.labels
            for vehicle in range(count)
        ]
        model = LinearModel(
            identity,
            settings.process_variance * identity,
            sensors=sensors,
            mean=np.tile(settings.initial, count),
            covariance=settings.prior_variance * identity,
            dt=settings.sampling,
        )
        chosen = {name: getattr(settings, name) for name in FACTORS if getattr(settings, name) is not None}
        base = METHODS[method]
        observes = chosen.get("disturbance", base.disturbance) == "observer"
        if base.rows != "none":
            # projection is about what feeds an observer
            chosen["rows"] = "hard" if settings.rows == "projected" and not observes else settings.rows
            chosen["pieces"] = settings.pieces
            if settings.pieces in ("detected", "both"):
                chosen["convex_pieces"] = [view.pieces for view in world.views]
            if settings.pieces in ("unseen", "both"):
                chosen["unseen_pieces"] = world.unseen
        return SporadicEstimator(
            model,
            world.network,
            method,
            fields=[view.rows for view in world.views],
            gains=settings.gain if observes else None,
            horizon=settings.horizon,
            observer=settings.observer,
            solver=solver,
            tolerance=settings.tolerance,
            **chosen,
        )

    def run(self, settings: Settings, method: str, solver: str, drawn: Drawn) -> Outcome:
        estimator, seconds = self._prepared(settings, method, solver)
        started = time.perf_counter()
        estimator.reset()
        times = {"compile": seconds, "setup": time.perf_counter() - started, "update": 0.0, "solve": 0.0}
        estimates = np.empty((len(drawn.times), settings.cameras, settings.vehicles, 2))
        unmet = np.zeros(estimates.shape[:3], dtype=bool)
        steps, status = [], Counter[str]()
        for k, (readings, flags) in enumerate(zip(drawn.readings, drawn.detected, strict=True)):
            estimate = estimator.step(readings, flags)
            estimates[k] = estimate.states.reshape(estimates.shape[1:])
            if k == 0:  # reports the prior, nothing is solved
                continue
            for i, node in enumerate(estimate.nodes):
                assert node is not None
                steps.append(node.seconds)
                status[str(node.status)] += 1
                for name in node.infeasible:
                    unmet[k, i, _vehicle(name)] = True
        times["solve"] = float(np.sum(steps))
        if unmet.any():
            k, i, vehicle = np.argwhere(unmet)[0].tolist()
            warnings.warn(
                f"{method}: the rows of {int(unmet.sum())} problem(s) of a camera and a vehicle contradicted each "
                f"other; first {_name(i + 1, vehicle)} at {drawn.times[k]:g} s",
                ModelWarning,
                stacklevel=2,
            )
        return Outcome(
            metrics=self.score(settings, drawn, Trace(estimates, unmet)),
            options=estimator.options.as_dict() | {"gain": settings.gain},
            times=times,
            step_seconds=np.array(steps),
            status=status,
            curves=_curves(drawn, estimates),
            trace=Trace(estimates, unmet),
        )

    def campaign(self, settings: Settings, method: str, drawn: Sequence[Drawn], solver: str = "auto") -> list[Trace]:
        """What `run` estimates in many trials, worked out for all of them at once.

        Args:
            settings: of the scenario.
            method: one of `methods`.
            drawn: the trials.
            solver: registered name.
        """
        estimator, _ = self._prepared(settings, method, solver)
        batch = BatchedDetections(estimator.design, len(drawn))
        readings, flags = (np.stack([getattr(one, name) for one in drawn], axis=1) for name in ("readings", "detected"))
        steps = [batch.step(*given) for given in zip(readings, flags, strict=True)]
        estimates = np.stack([step.states for step in steps], axis=1)
        estimates = estimates.reshape(*estimates.shape[:3], settings.vehicles, 2)
        unmet = np.stack([step.unmet for step in steps], axis=1)
        return [Trace(*one) for one in zip(estimates, unmet, strict=True)]

    def score(self, settings: Settings, drawn: Drawn, trace: Trace) -> dict[str, float | None]:
        """Metrics over the instants from ``score_from`` to ``score_until``, instant 0 left out.

        Args:
            settings: of the scenario.
            drawn: the trial.
            trace: of a method.
        """
        end = np.inf if settings.score_until is None else settings.score_until
        kept = (drawn.times >= settings.score_from) & (drawn.times <= end)
        kept[0] = False
        over = outside(trace.estimates, drawn, world_of(settings).views)
        return errors_of(trace.estimates, drawn, kept) | {
            "infeasible_share": share(trace.unmet, in_window(drawn.detected, settings.horizon), kept),
            "outside_share": share(over, drawn.detected, kept),
        }

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        """The scene at ``settings.instants`` (default: four), and below it the errors over time."""
        from mhe.scenarios._surveillance_plot import plot

        wanted = [int(np.abs(drawn.times - instant).argmin()) for instant in settings.instants or ()]
        traces = {label: outcome.trace.estimates for label, outcome in outcomes.items()}
        return plot(world_of(settings), drawn, traces, wanted)

    @lru_cache(maxsize=32)
    def _prepared(self, settings: Any, method: str, solver: str) -> tuple[SporadicEstimator, float]:
        # trials differ in data only, so they share everything compiled
        started = time.perf_counter()
        return self.estimator(settings, method, solver), time.perf_counter() - started


def export(drawn: Drawn, readings: str | Path, positions: str | Path | None = None) -> None:
    """Write a trial as the CSV files that ``replay`` and ``replay_truth`` read; formats in `mhe.sporadic.recordings`.

    Args:
        drawn: the trial.
        readings: file of what was detected.
        positions: file of the truth.

    Raises:
        WriteError: a file that cannot be written.
    """
    write_readings(readings, drawn.times, drawn.detected, drawn.readings)
    if positions is not None and drawn.positions is not None:
        write_positions(positions, drawn.times, drawn.positions)


def _name(camera: Any, vehicle: int) -> str:
    return f"camera {camera}, vehicle {vehicle + 1}"


def _vehicle(name: str) -> int:
    return int(name.rpartition(" ")[2]) - 1


def _curves(drawn: Drawn, estimates: np.ndarray) -> dict[str, Curve]:
    if drawn.positions is None:
        return {}
    norms = error_norms(estimates, drawn.positions)
    return {
        "error, all cameras (m)": Curve(over_nodes(norms), drawn.times, "time (s)"),
        "error, active cameras (m)": Curve(over_nodes(norms, drawn.active), drawn.times, "time (s)"),
    }


scenario = Surveillance()
