"""Multilateration: exact ranges give the place, false ones do not move it, anchors on a line leave a mirror image."""

from __future__ import annotations

import numpy as np
import pytest

from localization.tracking.multilateration import multilaterate, prepare, spread_of
from problems import registry
from problems.errors import DataError, FormError
from problems.solvers.base import Status

ANCHORS = np.array([[0.0, 0.0, 2.0], [4.0, 0.5, 2.0], [1.0, 3.0, 0.5], [-2.0, 1.0, 1.0]])


def ranges_to(place: np.ndarray, anchors: np.ndarray = ANCHORS, height: float = 1.0) -> np.ndarray:
    return np.linalg.norm(np.append(place, height) - anchors, axis=1)


@pytest.mark.parametrize("seed", range(20))
def test_exact_ranges_give_the_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    anchors = np.column_stack([rng.uniform(-5, 5, (3 + seed % 4, 2)), rng.uniform(0, 3, 3 + seed % 4)])
    place = rng.uniform(-15, 15, 2)
    found = multilaterate(anchors, ranges_to(place, anchors, 0.7), 0.7)
    np.testing.assert_allclose(found.position, place, atol=1e-5)
    assert found.cost < 1e-9
    assert found.status is Status.SOLVED
    assert found.iterations > 0


def test_the_height_counts() -> None:
    place = np.array([1.0, 1.0])
    wrong = multilaterate(ANCHORS, ranges_to(place, height=1.0), 4.0)
    assert np.linalg.norm(wrong.position - place) > 0.1


@pytest.mark.parametrize("far", [0, 1, 2])
def test_a_false_range_among_good_ones_hardly_moves_it(far: int) -> None:
    place = np.array([7.0, -3.0])
    ranges = np.tile(ranges_to(place), 3)
    ranges[far] -= 5.0
    found = multilaterate(np.tile(ANCHORS, (3, 1)), ranges, 1.0)
    assert np.linalg.norm(found.position - place) < 0.05


def test_anchors_on_a_line_leave_a_mirror_image_that_near_decides() -> None:
    line = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [7.0, 0.0, 1.0]])
    place, mirror = np.array([3.0, 5.0]), np.array([3.0, -5.0])
    ranges = ranges_to(place, line)
    found = multilaterate(line, ranges, 1.0)
    assert min(np.linalg.norm(found.position - p) for p in (place, mirror)) < 1e-4
    for near in (place, mirror):
        chosen = multilaterate(line, ranges, 1.0, near=near + [0.5, -0.5])
        np.testing.assert_allclose(chosen.position, near, atol=1e-4)
        assert chosen.cost == pytest.approx(found.cost, abs=1e-9)
    assert (spread_of(line), spread_of(line[:1]), spread_of(ANCHORS)) == (1, 0, 2)
    assert spread_of(ANCHORS[[0, 0, 0]]) == 0


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
@pytest.mark.parametrize("solver", ["ipopt", "gtsam-lm", "sqp:daqp"])
def test_the_solver_that_is_named_finds_the_same(solver: str) -> None:
    if solver.partition(":")[0] not in registry.names("solvers"):
        pytest.skip(f"solver {solver} is not registered")
    ranges = ranges_to(np.array([7.0, -3.0])) + [0.1, -0.2, 0.05, 0.1]
    own, other = multilaterate(ANCHORS, ranges, 1.0), multilaterate(ANCHORS, ranges, 1.0, solver=solver)
    np.testing.assert_allclose(other.position, own.position, atol=1e-3)
    assert other.cost == pytest.approx(own.cost, rel=1e-6)


def test_answers_do_not_depend_on_what_was_asked_before() -> None:
    ranges = ranges_to(np.array([7.0, -3.0])) + [0.1, -0.2, 0.05, 0.1]
    first = multilaterate(ANCHORS, ranges, 1.0)
    multilaterate(np.tile(ANCHORS, (4, 1)), np.tile(ranges_to(np.array([-9.0, 9.0])), 4), 1.0)
    again = multilaterate(ANCHORS, ranges, 1.0)
    assert again.position.tobytes() == first.position.tobytes()
    assert prepare(np.array([3, 30, 40])) > 0


@pytest.mark.parametrize(
    ("anchors", "ranges", "told"),
    [
        (ANCHORS[:2], np.ones(2), "at least three ranges"),
        (ANCHORS[:, :2], np.ones(4), "anchors of shape"),
        (ANCHORS[[1, 1, 1]], np.ones(3), "anchors at different places"),
    ],
)
def test_what_leaves_the_place_open_is_refused(anchors: np.ndarray, ranges: np.ndarray, told: str) -> None:
    with pytest.raises(DataError, match=told):
        multilaterate(anchors, ranges)


def test_a_solver_of_quadratic_programs_is_refused() -> None:
    with pytest.raises(FormError, match="quadratic programs only"):
        multilaterate(ANCHORS, np.ones(4), solver="osqp")
