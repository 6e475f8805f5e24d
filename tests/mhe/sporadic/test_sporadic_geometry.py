"""Roads, footprints, their hulls and convex pieces (spec dmhe-sporadic-fov 3.4, 5, 6.2, check C14)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from mhe.polyhedron import Polyhedron
from mhe.sporadic.geometry import (
    FieldOfView,
    along_line,
    convex_pieces,
    halfspaces,
    hull,
    line_length,
    polygon_of,
    rectangle,
    road,
    sector,
    unseen_pieces,
)
from problems.errors import DataError, EmptyConstraintError, ModelWarning, SettingError, ShapeError

LINE = [(-1.75, -3.25), (-1.75, 0.0), (0.75, 0.0), (0.75, 4.0)]
ROAD = road(LINE, 0.55, extension=1.0)


def corners(area: Any) -> set[tuple[float, float]]:
    return {(round(x, 9), round(y, 9)) for x, y in shapely.get_coordinates(area).tolist()}


def inside(rows: Polyhedron, points: Any) -> np.ndarray:
    return (np.atleast_2d(points) @ rows.matrix.T <= rows.upper + 1e-9).all(axis=1)


def points_in(area: Any, count: int, seed: int = 0) -> np.ndarray:
    x0, y0, x1, y1 = area.bounds
    points = np.random.default_rng(seed).uniform((x0, y0), (x1, y1), (4 * count, 2))
    return points[shapely.contains_xy(area, points)][:count]


def test_a_road_has_mitred_corners_and_longer_ends() -> None:
    assert corners(ROAD) == {
        (-2.3, -4.25), (-2.3, 0.55), (0.2, 0.55), (0.2, 5), (1.3, 5), (1.3, -0.55), (-1.2, -0.55), (-1.2, -4.25),
    }  # fmt: skip
    assert not ROAD.equals(ROAD.convex_hull)


def test_places_along_a_line() -> None:
    assert line_length(LINE) == 9.75
    places, headings = along_line(LINE, [0, 3.25, 4.0, 9.75, 50])
    np.testing.assert_allclose(places, [(-1.75, -3.25), (-1.75, 0), (-1, 0), (0.75, 4), (0.75, 4)])
    np.testing.assert_allclose(headings, [math.pi / 2, 0, 0, math.pi / 2, math.pi / 2])


def test_camera_5_of_the_spec() -> None:
    gap = 9.75 / 11
    places, headings = along_line(LINE, [4 * gap])
    view = FieldOfView.of(ROAD, rectangle(places[0], headings[0], 0.62 * gap + 0.30, 0.66))
    vertices = shapely.get_coordinates(view.hull)[:-1]
    expected = [(-2.3, -0.66), (-1.2, -0.66), (-0.605, -0.55), (-0.605, 0.55), (-2.3, 0.55)]
    assert len(vertices) == 5
    for point in expected:
        assert np.linalg.norm(vertices - point, axis=1).min() < 1e-3
    assert view.off_road == pytest.approx(0.016, abs=5e-4)
    assert view.rows.matrix.shape == (5, 2)
    np.testing.assert_allclose(np.linalg.norm(view.rows.matrix, axis=1), 1.0, rtol=1e-14)


@given(
    x=st.floats(-3, 2),
    y=st.floats(-4, 5),
    heading=st.floats(-3.2, 3.2),
    along=st.floats(0.2, 3),
    across=st.floats(0.2, 3),
)
def test_the_set_holds_the_clip_and_is_the_smallest_convex_one(
    x: float, y: float, heading: float, along: float, across: float
) -> None:
    footprint = rectangle((x, y), heading, along, across)
    clip = shapely.intersection(ROAD, footprint)
    if clip.area < 1e-6:
        return
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        view = FieldOfView.of(ROAD, footprint)
    clip_corners = shapely.get_coordinates(clip)
    assert inside(view.rows, clip_corners).all()
    vertices = shapely.get_coordinates(view.hull)
    assert all(np.abs(clip_corners - vertex).max(axis=1).min() == 0 for vertex in vertices)  # smallest: no other corner
    assert view.hull.area == pytest.approx(shapely.convex_hull(clip).area, rel=1e-9)
    assert view.off_road == pytest.approx(shapely.difference(view.hull, ROAD).area / view.hull.area, abs=1e-6)


def test_the_hull_bridges_pieces() -> None:
    two = shapely.union_all([shapely.box(0, 0, 1, 1), shapely.box(3, 0, 4, 1)])
    with pytest.warns(ModelWarning, match="50 % .* camera 3 .* off the road"):
        view = FieldOfView.of(two, shapely.box(-1, -1, 5, 2), "camera 3")
    assert view.off_road == 0.5
    assert inside(view.rows, (2, 0.5)).all()
    assert len(view.pieces) == 2
    assert not any(inside(piece, (2, 0.5)).any() for piece in view.pieces)


@pytest.mark.parametrize("area", [ROAD, sector((0, 0), 0.4, 5.0, 2.0, nearest=0.7), shapely.box(0, 0, 2, 1)])
def test_convex_pieces_cover_the_area_and_nothing_else(area: Any) -> None:
    pieces = convex_pieces(area)
    assert sum(piece.area for piece in pieces) == pytest.approx(area.area, rel=1e-9)
    assert shapely.symmetric_difference(shapely.union_all(list(pieces)), area).area < 1e-9
    rows = [halfspaces(piece) for piece in pieces]  # raises for a piece that is not convex
    points = points_in(area, 200)
    assert np.any([inside(piece, points) for piece in rows], axis=0).all()


def test_few_pieces() -> None:
    assert len(convex_pieces(shapely.box(0, 0, 2, 1))) == 1
    assert len(convex_pieces(ROAD)) == 3
    ell = road([(0, 0), (4, 0), (4, 4)], 0.5)
    assert len(convex_pieces(ell)) == 2


def test_where_nobody_looks() -> None:
    footprint = rectangle((-0.5, 0), 0, 0.5, 2)
    pieces = unseen_pieces(ROAD, [footprint])
    rest = shapely.difference(ROAD, footprint)
    points = points_in(rest, 300)
    assert np.any([inside(piece, points) for piece in pieces], axis=0).all()
    seen = points_in(shapely.intersection(ROAD, footprint).buffer(-1e-3), 100)
    assert not np.any([inside(piece, seen) for piece in pieces], axis=0).any()
    assert unseen_pieces(ROAD, [shapely.box(-9, -9, 9, 9)]) == ()


def test_rectangles() -> None:
    turned = rectangle((1, 2), math.pi / 2, 3, 1, sideways=0.5)
    assert corners(turned) == {(-0.5, 5), (-0.5, -1), (1.5, -1), (1.5, 5)}


@pytest.mark.parametrize("opening", [0.5, 2.0, 4.0, 2 * math.pi])
@pytest.mark.parametrize("nearest", [0.0, 0.8])
def test_a_sector_holds_all_that_can_be_seen(opening: float, nearest: float) -> None:
    rng = np.random.default_rng(3)
    footprint = sector((1, -1), 2.5, opening, 3.0, nearest=nearest, sides=12)
    angle = 2.5 + rng.uniform(-0.5, 0.5, 500) * opening * (1 - 1e-9)
    distance = np.concatenate([rng.uniform(nearest, 3, 250), np.full(125, 3.0), np.full(125, nearest + 1e-9)])
    seen = np.array([1, -1]) + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    assert (shapely.distance(footprint, shapely.points(seen)) < 1e-9).all()
    exact = opening / 2 * (9 - nearest**2)
    assert exact < footprint.area < 1.06 * exact
    assert footprint.is_valid
    assert (footprint.area > (1 - 1e-9) * footprint.convex_hull.area) == (
        nearest == 0 and (opening < math.pi or opening == 2 * math.pi)
    )


def test_rows_and_polygons_are_inverse() -> None:
    shape = hull(shapely.MultiPoint([(0, 0), (2, 0), (3, 1), (1, 2), (1, 1)]).convex_hull)
    assert corners(polygon_of(halfspaces(shape))) == corners(shape)
    assert corners(polygon_of(Polyhedron.box([0, -1], [2, 3]))) == {(0, -1), (2, -1), (2, 3), (0, 3)}


def test_hulls_leave_out_corners_that_are_none() -> None:
    assert len(corners(hull(shapely.Polygon([(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)])))) == 4


def test_a_camera_without_road() -> None:
    with pytest.raises(
        EmptyConstraintError, match=r"camera 7 looks at no part of the road .*5\.00, 5\.00.* 3\.\d+ m beside"
    ):
        FieldOfView.of(ROAD, rectangle((5, 5), 0, 0.6, 0.6), "camera 7")


def test_a_footprint_that_touches_the_road_only() -> None:
    with pytest.raises(EmptyConstraintError, match="no part of the road"):
        FieldOfView.of(shapely.box(0, 0, 1, 1), shapely.box(1, 0, 2, 1))


def test_a_footprint_that_crosses_itself() -> None:
    with pytest.raises(DataError, match="the footprint of camera 2 is no valid polygon: Self-intersection"):
        FieldOfView.of(ROAD, shapely.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]), "camera 2")


def test_sets_without_area_and_unbounded_ones() -> None:
    with pytest.raises(EmptyConstraintError, match="without any area"):
        hull(shapely.LineString([(0, 0), (1, 1)]))
    with pytest.raises(EmptyConstraintError, match="without area"):
        polygon_of(Polyhedron.box([0, 0], [0, 1]))
    with pytest.raises(EmptyConstraintError, match=r"unbounded in direction \[1\.0, 0\.0\]"):
        polygon_of(Polyhedron([[-1, 0], [0, 1], [0, -1]], [0, 1, 1]))
    with pytest.raises(ShapeError, match="2 components, got 3"):
        polygon_of(Polyhedron.box([0, 0, 0], [1, 1, 1]))


def test_half_spaces_of_a_shape_that_is_not_convex() -> None:
    with pytest.raises(DataError, match="must be convex"):
        halfspaces(ROAD)


@pytest.mark.parametrize(
    ("line", "width", "error", "match"),
    [
        ([(0, 0)], 1, ShapeError, "at least two points"),
        ([(0, 0), (0, 0)], 1, DataError, "points 0 and 1 are the same"),
        ([(0, 0), (math.nan, 0)], 1, DataError, "finite"),
        ([(0, 0), (1, 0)], 0, SettingError, "half_width"),
    ],
)
def test_roads_that_are_none(line: Any, width: float, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        road(line, width)


def test_sectors_and_rectangles_that_are_none() -> None:
    with pytest.raises(SettingError, match="opening"):
        sector((0, 0), 0, 7, 1)
    with pytest.raises(SettingError, match="nearest"):
        sector((0, 0), 0, 1, 1, nearest=1)
    with pytest.raises(SettingError, match="half sizes"):
        rectangle((0, 0), 0, 0, 1)
    with pytest.raises(DataError, match="centre"):
        rectangle((0, math.inf), 0, 1, 1)
