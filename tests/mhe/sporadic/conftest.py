"""A small scene for the estimators with detections: cameras along a line, vehicles that drive past."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.sporadic import SporadicEstimator
from problems.models import LinearModel, Sensor
from problems.networks import Network, band


def square(center: float, half: float = 1.0) -> Polyhedron:
    return Polyhedron(np.vstack([np.eye(2), -np.eye(2)]), np.array([center + half, half, half - center, half]))


@dataclass
class Scene:
    """`nodes` cameras, `vehicles` single integrators; readings (T, nodes, vehicles, 2), NaN where not detected."""

    nodes: int = 5
    vehicles: int = 2
    noise: float = 1.0
    truth: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def model(self, vehicles: int | None = None) -> LinearModel:
        count = self.vehicles if vehicles is None else vehicles
        n = 2 * count
        sensors = [
            Sensor(f"c{i} v{v}", np.eye(2, n, 2 * v), covariance=self.noise * np.eye(2))
            for i in range(self.nodes)
            for v in range(count)
        ]
        return LinearModel(np.eye(n), np.eye(n), sensors=sensors, mean=np.zeros(n), covariance=1e5 * np.eye(n))

    def fields(self) -> list[Polyhedron]:
        return [square(2.0 * i) for i in range(self.nodes)]

    def build(self, method: str, network: Network | None = None, **options: Any) -> SporadicEstimator:
        if options.get("disturbance") != "process_noise" and not method.startswith("dmhe_f"):
            options.setdefault("gains", 0.3)
        options.setdefault("fields", self.fields())
        vehicles = options.pop("vehicles", None)
        return SporadicEstimator(self.model(vehicles), network or band(self.nodes, 1), method, **options)

    def readings(self, steps: int, rng: np.random.Generator, sigma: float = 0.5, detect: float = 0.7) -> np.ndarray:
        along = np.linspace(-1, 2 * self.nodes - 1, steps)[:, None] - 0.6 * np.arange(self.vehicles)
        self.truth = np.stack([along, np.zeros_like(along)], axis=2)
        centers = 2.0 * np.arange(self.nodes)
        seen = np.abs(along[:, None] - centers[None, :, None]) < 1.0
        seen &= rng.random(seen.shape) < detect
        values = self.truth[:, None] + sigma * rng.normal(size=(*seen.shape, 2))
        return np.where(seen[..., None], values, np.nan)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    return Scene


@pytest.fixture
def run() -> Callable[..., list[Any]]:
    """Steps of an estimator on readings; returns what each step gave."""

    def steps(estimator: SporadicEstimator, values: np.ndarray, flags: np.ndarray | None = None) -> list[Any]:
        return [estimator.step(y, None if flags is None else flags[t]) for t, y in enumerate(values)]

    return steps
