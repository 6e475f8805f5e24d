"""The world of the scenario `surveillance`: road, cameras, vehicles in formation, and what the cameras report.

Source: dmhe-sporadic-fov 3.1 to 3.4, 6.1 and 6.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mhe.scenarios._surveillance_settings import Settings
from problems.networks import Network, band

if TYPE_CHECKING:
    import shapely

    from mhe.polyhedron import Polyhedron
    from mhe.sporadic.geometry import FieldOfView

CORNERS = np.array([(0, 0), (-1, 1), (-1, -1), (1, -1), (1, 1)])  # leader, then the followers


@dataclass(frozen=True, eq=False)
class World:
    """What does not change from trial to trial.

    Attributes:
        road: its area.
        centres: (n_S, 2) of the footprints.
        views: by camera.
        network: the radius graph, labels 1..n_S.
        times: (steps + 1,) in s.
        positions: (steps + 1, n_V, 2) of the vehicles.
    """

    road: shapely.Polygon
    centres: np.ndarray
    views: tuple[FieldOfView, ...]
    network: Network
    times: np.ndarray
    positions: np.ndarray

    @cached_property
    def unseen(self) -> list[tuple[Polyhedron, ...]]:
        """By camera, convex pieces of the road that neither it nor a neighbour looks at."""
        from mhe.sporadic.geometry import unseen_pieces

        regions = [self.network.in_neighborhood(camera) for camera in range(self.network.count)]
        return [unseen_pieces(self.road, [self.views[j].footprint for j in region]) for region in regions]


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial.

    Attributes:
        times: (steps + 1,) in s.
        positions: (steps + 1, n_V, 2), or None where the truth of a replay is not known.
        detected: (steps + 1, n_S, n_V), whether a reading exists.
        readings: (steps + 1, n_S, n_V, 2), NaN where there is none.
    """

    times: np.ndarray
    positions: np.ndarray | None
    detected: np.ndarray
    readings: np.ndarray

    @property
    def active(self) -> np.ndarray:
        """(steps + 1, n_S), whether a camera detects any vehicle (definition 4.1)."""
        return np.asarray(self.detected.any(axis=2))


def world_of(settings: Settings) -> World:
    """The world of settings, the same object for equal ones."""
    return _world(settings)


@lru_cache(maxsize=16)
def _world(settings: Any) -> World:
    from mhe.sporadic import geometry

    area = geometry.road(settings.centre_line, settings.half_width, extension=settings.extension)
    gap = geometry.line_length(settings.centre_line) / (settings.cameras - 1)
    places, headings = geometry.along_line(settings.centre_line, gap * np.arange(settings.cameras))
    along = settings.per_camera("along", settings.overlap * gap + settings.margin)
    shapes = zip(along, settings.per_camera("across"), settings.per_camera("sideways"), strict=True)
    footprints = [
        geometry.rectangle(place, heading, length, width, sideways=shift)
        for place, heading, (length, width, shift) in zip(places, headings, shapes, strict=True)
    ]
    names = [f"camera {number}" for number in range(1, settings.cameras + 1)]
    views = tuple(geometry.FieldOfView.of(area, shape, name) for shape, name in zip(footprints, names, strict=True))
    times = settings.sampling * np.arange(settings.steps + 1)
    graph = band(settings.cameras, settings.radius)
    return World(
        road=area,
        centres=np.array([shape.centroid.coords[0] for shape in footprints]),
        views=views,
        network=Network(graph.count, graph.edges, labels=range(1, settings.cameras + 1)),
        times=times,
        positions=_positions(settings, times),
    )


def _positions(settings: Settings, times: np.ndarray) -> np.ndarray:
    from mhe.sporadic.geometry import along_line, line_length

    moving = np.minimum(times, settings.stop)
    target, _ = along_line(settings.centre_line, line_length(settings.centre_line) * moving / settings.stop)
    share = 1.0 if settings.lag == 0 else -np.expm1(-settings.sampling / settings.lag)
    leader = target.copy()
    for k in range(1, len(leader)):
        leader[k] = leader[k - 1] + share * (target[k] - leader[k - 1])
    numbers = np.arange(1, settings.vehicles + 1)
    wobble = settings.wobble * np.sin(0.7 * moving[:, None] + 1.3 * numbers)
    return leader[:, None] + settings.half_side * CORNERS[: settings.vehicles] + wobble[..., None]


def draw(settings: Settings, rng: np.random.Generator) -> Drawn:
    """Readings of one trial: constant errors of the cameras' poses, noise, and detections that were missed.

    A longer duration goes on where a shorter one ends, and other rates, variances and graphs meet the same random
    numbers.
    """
    if settings.replay is not None:
        return _replayed(settings)
    world = world_of(settings)
    of_cameras, of_noise, of_detections = rng.spawn(3)
    shape = (len(world.times), settings.cameras, settings.vehicles)
    shift = np.sqrt(settings.bias) * of_cameras.standard_normal((settings.cameras, 2))
    turn = settings.rotation_bias * of_cameras.standard_normal(settings.cameras)
    noise = np.sqrt(settings.noise) * of_noise.standard_normal((*shape, 2))
    lucky = of_detections.random(shape) < settings.detection_rate
    detected = lucky & np.stack([_inside(view, world.positions) for view in world.views], axis=1)
    # a camera whose pose is wrong maps positions about its footprint's centre
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    offset = world.positions[:, None] - world.centres[:, None]
    seen = world.centres[:, None] + np.einsum("iab,kivb->kiva", rotation, offset) + shift[:, None]
    return Drawn(world.times, world.positions, detected, np.where(detected[..., None], seen + noise, np.nan))


def _inside(view: FieldOfView, positions: np.ndarray) -> np.ndarray:
    from mhe.sporadic.geometry import halfspaces

    rows = halfspaces(view.footprint)
    return np.asarray((positions @ rows.matrix.T <= rows.upper).all(axis=-1))


def _replayed(settings: Settings) -> Drawn:
    from mhe.sporadic.recordings import read_positions, read_readings

    assert settings.replay is not None
    times = settings.sampling * np.arange(settings.steps + 1)
    detected, readings = read_readings(settings.replay, times, settings.cameras, settings.vehicles)
    truth = None
    if settings.replay_truth is not None:
        truth = read_positions(settings.replay_truth, times, settings.vehicles)
    return Drawn(times, truth, detected, readings)
