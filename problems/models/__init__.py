"""Dynamics and sensors in symbols, their simulation, and what their measurements determine."""

from problems.models.base import Model
from problems.models.linear import LinearModel
from problems.models.nonlinear import NonlinearModel
from problems.models.observability import ObservabilityReport, observability, pair_observability, require_observable
from problems.models.sensor import Sensor
from problems.models.simulation import Trajectory, simulate

__all__ = [
    "LinearModel",
    "Model",
    "NonlinearModel",
    "ObservabilityReport",
    "Sensor",
    "Trajectory",
    "observability",
    "pair_observability",
    "require_observable",
    "simulate",
]
