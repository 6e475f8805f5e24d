"""The unit of a benchmark: a job (what to run) and its row (what came out)."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from problems.errors import FormError, NotAffineError

IMPOSSIBLE = (FormError.__name__, NotAffineError.__name__)  # kinds of failures that say a pairing does not exist


@dataclass(frozen=True)
class Job:
    """One trial of one method with one solver and one complete set of settings (JSON types)."""

    scenario: str
    method: str
    solver: str
    settings: dict[str, Any]
    seed: int
    trial: int

    @cached_property
    def key(self) -> str:
        """Identity of the job: equal for equal content, in every process and on every machine."""
        content = [self.scenario, self.method, self.solver, self.settings, self.seed, self.trial]
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True)
class Failure:
    """Why a row has no result."""

    kind: str
    message: str
    traceback: str


@dataclass(frozen=True)
class Row:
    """Result of a job.

    Attributes:
        job: what was run.
        metrics: value by metric name; None where it has none.
        options: the method's set of options.
        times: seconds by part (`problems.bench.scenario.TIMES`).
        steps: number of timed steps.
        step_median, step_p95, step_max: seconds of one step; None without steps.
        status: steps by status name.
        iterations: solver iterations of all steps.
        residual: worst recomputed residual.
        curves: {"at", "values", "over"} by name, thinned to at most `problems.bench.measure.POINTS` points.
        consistency: {"mean", "inside", "degrees", "samples"} by name: mean of the squared normalized errors per degree
            of freedom (1 where the covariance is right), and the share of them in the interval that holds 95 % then.
        wall, cpu: seconds of the whole trial, without drawing it.
        memory: bytes the peak of the process's memory grew by during the trial; None where the system does not tell.
        warnings: distinct warnings raised on the way.
        failure: None when the trial finished.
    """

    job: Job
    metrics: dict[str, float | None] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    times: dict[str, float] = field(default_factory=dict)
    steps: int = 0
    step_median: float | None = None
    step_p95: float | None = None
    step_max: float | None = None
    status: dict[str, int] = field(default_factory=dict)
    iterations: int = 0
    residual: float | None = None
    curves: dict[str, dict[str, Any]] = field(default_factory=dict)
    consistency: dict[str, dict[str, float]] = field(default_factory=dict)
    wall: float | None = None
    cpu: float | None = None
    memory: int | None = None
    warnings: list[str] = field(default_factory=list)
    failure: Failure | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON types only; `from_dict` reads it back."""
        record = _shallow(self) | {"job": _shallow(self.job)}
        return record | {"failure": _shallow(self.failure) if self.failure else None}

    @property
    def impossible(self) -> bool:
        """Whether the solver cannot take the problem at all, so that there is nothing to measure or to try again."""
        return self.failure is not None and self.failure.kind in IMPOSSIBLE

    @staticmethod
    def from_dict(record: dict[str, Any]) -> Row:
        failure = record["failure"]
        return Row(**(record | {"job": Job(**record["job"]), "failure": Failure(**failure) if failure else None}))


def _shallow(value: Any) -> dict[str, Any]:
    # dataclasses.asdict copies deeply, which costs more than all the rest of writing a row
    return {item.name: getattr(value, item.name) for item in fields(value)}


def finite(value: Any) -> float | None:
    """A number for JSON: None for None, NaN and infinities, which JSON does not have."""
    if value is None:
        return None
    number = float(value)
    return number if math.isfinite(number) else None
