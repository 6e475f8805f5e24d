"""Roads, fields of view and the sets they give: clipped polygons, their hulls as half-spaces, and convex pieces.

Source: dmhe-sporadic-fov 3.4 (4.5), sections 5, 6 and 10. All lengths in metres, areas are shapely polygons.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from mhe.polyhedron import Polyhedron
from problems.errors import DataError, EmptyConstraintError, ModelWarning, SettingError, ShapeError

SMALLEST_AREA = 1e-9  # m^2; a set without area holds a point only by chance
STRAIGHT = 1e-9  # rad; corners flatter than this are none
OFF_ROAD = 0.25  # share of a hull off the road from which on it is worth a warning


def road(centre_line: Any, half_width: float, *, extension: float = 0.0) -> shapely.Polygon:
    """The area of a road with mitred corners; it need not be convex.

    Args:
        centre_line: (points, 2), at least two different ones.
        half_width: of the road, positive.
        extension: by which both ends go on straight.

    Raises:
        ShapeError, DataError: no such points.
        SettingError: a length outside its range.
        EmptyConstraintError: the line folds back on itself so that no polygon is left.
    """
    points = line_points(centre_line)
    if not half_width > 0 or not math.isfinite(half_width):
        raise SettingError(f"half_width: expected a positive length (m), got {half_width!r}")
    if not extension >= 0 or not math.isfinite(extension):
        raise SettingError(f"extension: expected a length (m) of at least 0, got {extension!r}")
    first, last = points[0] - points[1], points[-1] - points[-2]
    points[0] += extension * first / np.linalg.norm(first)
    points[-1] += extension * last / np.linalg.norm(last)
    area = shapely.LineString(points).buffer(half_width, cap_style="flat", join_style="mitre")
    if not isinstance(area, shapely.Polygon) or area.area < SMALLEST_AREA:
        raise EmptyConstraintError(f"a road {half_width:g} m to each side of {points.tolist()} is no single polygon")
    return area


def line_points(centre_line: Any) -> np.ndarray:
    """The points (points, 2) of a centre line, checked; see `road`."""
    points = np.array(centre_line, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise ShapeError(f"centre_line: expected at least two points (points, 2), got shape {points.shape}")
    if not np.isfinite(points).all():
        raise DataError("centre_line: expected finite coordinates (m), got a NaN or inf")
    repeated = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) == 0)
    if repeated.size:
        raise DataError(f"centre_line: points {repeated[0]} and {repeated[0] + 1} are the same")
    return points


def along_line(centre_line: Any, distance: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where on a centre line, and which way it goes there.

    Args:
        centre_line: (points, 2).
        distance: (count,) from the first point along the line (m), cut to its length. At a corner the next leg counts.

    Returns:
        Positions (count, 2) and headings (count,) in radians.
    """
    points = line_points(centre_line)
    legs = np.diff(points, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    corners = np.concatenate([[0.0], np.cumsum(lengths)])
    where = np.clip(np.asarray(distance, dtype=float), 0.0, corners[-1])
    leg = np.clip(np.searchsorted(corners, where, side="right") - 1, 0, len(legs) - 1)
    share = (where - corners[leg]) / lengths[leg]
    return points[leg] + share[:, None] * legs[leg], np.arctan2(legs[leg, 1], legs[leg, 0])


def line_length(centre_line: Any) -> float:
    """Length of a centre line (m)."""
    return float(np.linalg.norm(np.diff(line_points(centre_line), axis=0), axis=1).sum())


def rectangle(centre: Any, heading: float, along: float, across: float, *, sideways: float = 0.0) -> shapely.Polygon:
    """A rectangular footprint.

    Args:
        centre: (2,).
        heading: direction of its length (rad).
        along, across: half sizes, positive.
        sideways: shift of the centre to the left of the heading.
    """
    if not (along > 0 and across > 0):
        raise SettingError(f"a rectangle needs positive half sizes (m), got along={along!r} and across={across!r}")
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]])
    middle = _point(centre, "centre") + sideways * left
    return shapely.Polygon(
        [middle + a * along * forward + b * across * left for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    )


def sector(
    apex: Any, heading: float, opening: float, reach: float, *, nearest: float = 0.0, sides: int = 16
) -> shapely.Polygon:
    """The footprint of a sensor limited in bearing and range, as a polygon around it (spec section 10).

    Args:
        apex: (2,) where the sensor is.
        heading: of its axis (rad).
        opening: whole angle (rad), in (0, 2 pi].
        reach: largest range, positive.
        nearest: smallest range; the footprint is not convex if it is positive, as with openings of more than pi.
        sides: of the polygon that replaces the outer arc. It lies outside of the arc, so that whatever the sensor can
            see is in it; chords of the inner arc lie inside of that one for the same reason.
    """
    if not 0 < opening <= 2 * math.pi or not 0 <= nearest < reach or not math.isfinite(reach) or sides < 3:
        raise SettingError(
            "a sector needs 0 < opening <= 2 pi (rad), 0 <= nearest < reach (m) and at least 3 sides, got "
            f"opening={opening!r}, nearest={nearest!r}, reach={reach!r}, sides={sides!r}"
        )
    apex = _point(apex, "apex")
    step = opening / sides
    edges = heading - opening / 2 + step * np.arange(sides + 1)
    middles = edges[:-1] + step / 2
    inner = apex + nearest * _directions(edges)
    if opening == 2 * math.pi:
        outer = shapely.Polygon(apex + reach / math.cos(step / 2) * _directions(middles))
        return outer if nearest == 0 else shapely.Polygon(outer.exterior, [inner[:-1]])
    corners = [apex + reach * _directions(edges[:1]), apex + reach / math.cos(step / 2) * _directions(middles)]
    corners += [apex + reach * _directions(edges[-1:]), inner[::-1] if nearest > 0 else apex[None]]
    return shapely.Polygon(np.concatenate(corners))


def _directions(angles: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _point(value: Any, what: str) -> np.ndarray:
    point = np.asarray(value, dtype=float)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise DataError(f"{what}: expected two finite coordinates (m), got {value!r}")
    return point


def hull(area: BaseGeometry, what: str = "the area") -> shapely.Polygon:
    """The smallest convex polygon around an area of one or several pieces.

    Its vertices are vertices of the area, counter-clockwise, without those in the middle of a straight side.

    Raises:
        EmptyConstraintError: there is no area.
    """
    if area.area < SMALLEST_AREA:
        raise EmptyConstraintError(f"{what} is {area.geom_type if not area.is_empty else 'empty'}, without any area")
    corners = shapely.get_coordinates(shapely.orient_polygons(shapely.convex_hull(area)))[:-1]
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    return shapely.Polygon(corners[turn > STRAIGHT])


def halfspaces(polygon: shapely.Polygon) -> Polyhedron:
    """``G z <= h`` of a convex polygon, one row with a unit normal per side.

    Raises:
        DataError: the polygon is not convex.
        EmptyConstraintError: it has no area.
    """
    convex = hull(polygon, "the polygon")
    missing = convex.area - polygon.area
    if missing > 1e-9 * convex.area:
        raise DataError(
            f"a polygon given as half-spaces must be convex; this one leaves out {missing:g} m^2 of its hull. Take "
            "its hull, or its convex pieces"
        )
    corners = shapely.get_coordinates(convex)
    sides = np.diff(corners, axis=0)
    normals = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    reach = (shapely.get_coordinates(polygon) @ normals.T).max(axis=0)  # no vertex is out, not even by rounding
    return Polyhedron(normals, reach)


def polygon_of(polyhedron: Polyhedron) -> shapely.Polygon:
    """The polygon of rows in the plane.

    Raises:
        ShapeError: rows that are not about two components.
        EmptyConstraintError: rows that leave a set without area, or an unbounded one.
    """
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection

    if polyhedron.size != 2:
        raise ShapeError(f"a set in the plane has rows of 2 components, got {polyhedron.size}")
    normals = np.vstack([polyhedron.matrix, -polyhedron.matrix])
    reach = np.concatenate([polyhedron.upper, -polyhedron.lower])
    normals, reach = normals[np.isfinite(reach)], reach[np.isfinite(reach)]
    for direction in np.vstack([np.eye(2), -np.eye(2)]):
        if linprog(-direction, A_ub=normals, b_ub=reach, bounds=(None, None)).status == 3:
            raise EmptyConstraintError(f"the set is unbounded in direction {direction.tolist()}; add rows")
    # centre of the largest inscribed circle
    norms = np.linalg.norm(normals, axis=1)
    found = linprog(
        [0, 0, -1], A_ub=np.column_stack([normals, norms]), b_ub=reach, bounds=[(None, None)] * 2 + [(0, 1)]
    )
    if found.status != 0 or found.x[2] ** 2 < SMALLEST_AREA:
        raise EmptyConstraintError("the rows leave a set without area: no position is found in it but by chance")
    corners = HalfspaceIntersection(np.column_stack([normals, -reach]), found.x[:2]).intersections
    return hull(shapely.MultiPoint(corners).convex_hull)


def convex_pieces(area: BaseGeometry) -> tuple[shapely.Polygon, ...]:
    """Convex polygons that cover an area and overlap in sides only; few, not fewest.

    Triangles with the corners of the area are joined as long as the result is convex (Hertel and Mehlhorn), so pieces
    are at most four times as many as needed.
    """
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    pieces = [piece for piece in triangles.tolist() if piece.area >= SMALLEST_AREA]
    joined = True
    while joined:
        joined = False
        for first in range(len(pieces)):
            for second in range(first + 1, len(pieces)):
                union = shapely.union(pieces[first], pieces[second])
                if isinstance(union, shapely.Polygon) and _is_convex(union):
                    pieces[first] = union
                    del pieces[second]
                    joined = True
                    break
            if joined:
                break
    return tuple(hull(piece) for piece in pieces)


def _is_convex(polygon: shapely.Polygon) -> bool:
    around = shapely.convex_hull(polygon).area
    return around - polygon.area <= 1e-12 * max(around, 1.0)


@dataclass(frozen=True)
class FieldOfView:
    """What a detection by a sensor says about the position, (4.5): ``S = Co(road and footprint)``.

    Attributes:
        footprint: F, what the sensor looks at.
        seen: the part of the road in it, of one piece or several.
        hull: S, the smallest convex set around `seen`; it bridges several pieces and the inner side of bends.
        rows: ``G z <= h`` of S, unit normals.
        off_road: share of the area of S off the road.
    """

    footprint: shapely.Polygon
    seen: BaseGeometry
    hull: shapely.Polygon
    rows: Polyhedron
    off_road: float

    @classmethod
    def of(cls, road: BaseGeometry, footprint: shapely.Polygon, name: str = "the sensor") -> FieldOfView:
        """The set of one sensor.

        Args:
            road: its area.
            footprint: of the sensor.
            name: for messages.

        Raises:
            DataError: one of the two is no valid polygon.
            EmptyConstraintError: there is no road in the footprint.

        Warns:
            ModelWarning: a large part of the hull is off the road.
        """
        for what, area in (("the road", road), (f"the footprint of {name}", footprint)):
            if not area.is_valid:
                raise DataError(f"{what} is no valid polygon: {shapely.is_valid_reason(area)}")
        seen = shapely.intersection(road, footprint)
        if seen.area < SMALLEST_AREA:
            x, y = footprint.centroid.coords[0]
            raise EmptyConstraintError(
                f"{name} looks at no part of the road (footprint around {x:.2f}, {y:.2f} m, "
                f"{shapely.distance(road, footprint):.2f} m beside it), so a detection would mean nothing; move it or "
                "leave it out"
            )
        convex = hull(seen)
        off_road = 1.0 - seen.area / convex.area
        if off_road > OFF_ROAD:
            warnings.warn(
                f"{100 * off_road:.0f} % of the convex hull of what {name} sees of the road is off the road",
                ModelWarning,
                stacklevel=2,
            )
        return cls(footprint, seen, convex, halfspaces(convex), max(off_road, 0.0))

    @cached_property
    def pieces(self) -> tuple[Polyhedron, ...]:
        """`seen` itself as convex pieces: the position is in at least one of them."""
        return tuple(halfspaces(piece) for piece in convex_pieces(self.seen))


def unseen_pieces(road: BaseGeometry, footprints: Sequence[BaseGeometry]) -> tuple[Polyhedron, ...]:
    """Convex pieces of the road that no footprint covers: where a vehicle nobody detects would be.

    It holds only where detection in view is certain (spec section 10); with none left, everything is seen.
    """
    rest = shapely.difference(road, shapely.union_all(list(footprints)))
    return () if rest.area < SMALLEST_AREA else tuple(halfspaces(piece) for piece in convex_pieces(rest))
