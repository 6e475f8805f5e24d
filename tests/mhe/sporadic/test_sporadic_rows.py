"""Field-of-view rows: dmhe-sporadic-fov C2, C3, C7, C13, C17."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.sporadic.rows import Projection, half_planes
from mhe.sporadic.window import DetectionWindow, WindowShape
from problems.errors import DefinitionError, ShapeError
from problems.networks import Network
from problems.solvers.base import Status


def excess(scene, steps, values):
    """Largest violation of a row that must hold, at every step and node; of windows whose rows were not relaxed."""
    seen = ~np.isnan(values).any(axis=3)
    worst = []
    for t, step in enumerate(steps):
        if not t:
            continue
        for i, node in enumerate(step.nodes):
            first = t + 1 - len(node.window)
            G, h = half_planes(scene.fields()[i])
            for k in range(first, t + 1):
                for v in np.flatnonzero(seen[k, i]):
                    if f"c{i} v{v}" not in node.infeasible:
                        worst.append((G @ node.window[k - first, 2 * v : 2 * v + 2] - h).max())
    return np.array(worst)


@pytest.mark.parametrize("method", ["dmhe_w_pre", "dmhe_f"])
@pytest.mark.parametrize("rows", ["hard", "soft"])
def test_rows_hold_at_every_instant_of_an_own_detection(scene, run, method, rows):
    values = scene.readings(60, np.random.default_rng(1), sigma=0.8)
    assert excess(scene, run(scene.build(method), values), values).max() > 0.1
    assert excess(scene, run(scene.build(method, rows=rows), values), values).max() < 1e-6


def test_a_vehicle_lost_since_keeps_its_row(make_scene):
    """Seen far outside at t - 1 and not at t: the row acts at t - 1, and at t through the model."""
    scene = make_scene(nodes=1, vehicles=1)
    results = []
    for rows in ("hard", "none"):
        estimator = scene.build("dmhe_f", Network(1), rows=rows)
        for _ in range(6):
            estimator.step(np.zeros((1, 1, 2)))
        estimator.step(np.array([[[3.0, 0.0]]]))
        results.append(estimator.step(np.full((1, 1, 2), np.nan)).nodes[0].window)
    assert results[0][-2, 0] == pytest.approx(1.0, abs=1e-9) and results[0][-1, 0] == pytest.approx(1.0, abs=1e-9)
    assert results[1][-2, 0] > 1.2


def test_a_set_of_a_node_that_never_detects_does_not_matter(scene, run):
    values = scene.readings(30, np.random.default_rng(2))
    values[:, 2] = np.nan
    fields = scene.fields()
    plain = [step.states for step in run(scene.build("dmhe_w_pre_s"), values)]
    fields[2] = Polyhedron(*half_planes(fields[2]))
    fields[2].upper = fields[2].upper + 50.0
    moved = [step.states for step in run(scene.build("dmhe_w_pre_s", fields=fields), values)]
    assert np.array_equal(plain, moved)


def test_rows_reach_others_through_messages_only(make_scene, run):
    scene = make_scene(nodes=5, vehicles=1)
    values = np.zeros((14, 5, 1, 2))
    values[8, 0] = 0.9
    fields = [scene.fields()[0]] * 5
    tight = [Polyhedron.box([-0.05, -0.05], [0.05, 0.05]), *fields[1:]]
    plain, other = (
        np.array([s.states for s in run(scene.build("dmhe_f_s", fields=f), values)]) for f in (fields, tight)
    )
    difference = np.abs(plain - other).max(axis=2)
    first = (difference > 0).argmax(axis=0)
    assert first[0] <= 8 and difference[8, 0] > 0.01
    at = first[0]
    assert all(first[i] >= at + max(i, 1) for i in range(1, 5))


def test_regional_rows_bind_the_neighbors_of_who_detects(make_scene, run):
    scene = make_scene(nodes=3, vehicles=1)
    values = np.full((12, 3, 1, 2), np.nan)
    values[:, 0] = [1.6, 0.0]
    own, regional = (
        run(scene.build("dmhe_f_s", row_scope=scope), values)[-1].states[:, 0] for scope in ("own", "regional")
    )
    assert own[0] == pytest.approx(1.0, abs=1e-8) and own[1] > 1.05
    assert regional[:2] == pytest.approx([1.0, 1.0], abs=1e-8)


def test_soft_rows_are_exact_where_hard_ones_can_hold(scene, run):
    values = scene.readings(60, np.random.default_rng(3), sigma=0.7)
    hard = run(scene.build("dmhe_w_pre_s"), values)
    soft = run(scene.build("dmhe_w_pre_s", rows="soft"), values)
    assert np.abs(np.array([a.states - b.states for a, b in zip(hard, soft, strict=True)])).max() < 1e-6
    # a penalty below the multipliers gives way, and says so
    weak = scene.build("dmhe_w_pre_s", rows="soft", penalty=1e-3)
    steps = run(weak, values)
    assert weak.status[Status.INFEASIBLE] > 10
    assert np.abs(np.array([a.states - b.states for a, b in zip(hard, steps, strict=True)])).max() > 0.05


@pytest.mark.parametrize("unmet", ["soft", "predict"])
def test_rows_that_contradict_each_other_are_counted_and_answered(scene, run, unmet):
    values = scene.readings(60, np.random.default_rng(4), sigma=1.5)
    estimator = scene.build("dmhe_w_pre_s", gains=0.9, unmet=unmet)
    steps = run(estimator, values)
    events = [event for step in steps for event in step.infeasible]
    assert len(events) == estimator.status[Status.INFEASIBLE] > 5
    assert all(event.bounds and event.bounds[0].startswith(f"c{event.node} ") for event in events)
    assert all(np.isfinite(step.states).all() for step in steps)
    # a vehicle whose rows can hold keeps to them in the same step
    if unmet == "soft":
        assert excess(scene, steps, values).max() < 1e-6


@pytest.mark.parametrize("gain", [0.3, 0.7, 1.0])
def test_projected_readings_keep_every_window_feasible(scene, run, gain):
    values = scene.readings(60, np.random.default_rng(5), sigma=1.5)
    estimator = scene.build("dmhe_w_pre_s", gains=gain, rows="projected")
    steps = run(estimator, values)
    assert set(estimator.status) == {Status.SOLVED}
    assert excess(scene, steps, values).max() < 1e-6


def test_projection_is_the_nearest_point():
    rng = np.random.default_rng(6)
    G = np.array([[1.0, 0], [0, 1], [-1, -1], [1, 2]])
    h = np.array([1.0, 0.8, 0.5, 2.0])
    polyhedron = Polyhedron(G, h)
    project = Projection(polyhedron)
    inside = rng.uniform(-3, 3, (4000, 2))
    inside = inside[(inside @ G.T <= h).all(axis=1)]
    for point in rng.normal(scale=3, size=(50, 2)):
        nearest = project(point)
        assert (G @ nearest - h).max() < 1e-8
        # obtuse angle to every point of the set
        assert ((inside - nearest) @ (point - nearest)).max() < 1e-7
    assert np.array_equal(project(np.zeros(2)), np.zeros(2))


def test_readings_outside_the_set_are_reported(make_scene):
    scene = make_scene(nodes=1, vehicles=1)
    estimator = scene.build("dmhe_w_pre_s", Network(1))
    assert estimator.step(np.array([[[4.0, 0.0]]])).nodes[0].outside.tolist() == [3.0]
    assert estimator.step(np.array([[[0.5, 0.0]]])).nodes[0].outside.tolist() == [0.0]


def test_sets_that_cannot_be_are_refused(scene):
    with pytest.raises(DefinitionError, match="unbounded"):
        scene.build("dmhe_f_s", fields=[Polyhedron(np.array([[1.0, 0.0]]), 1.0)] * 5)
    with pytest.raises(ShapeError, match="on 3 component"):
        scene.build("dmhe_f_s", fields=[Polyhedron.box([0] * 3, [1] * 3)] * 5)


def test_pre_estimation_has_the_first_state_as_its_only_unknown():
    eye = np.tile(np.eye(2), (5, 1, 1))
    for N in (3, 4):
        observer = DetectionWindow(WindowShape(N, 5, 2, 0, 1, 4)).compile("auto")
        noise = DetectionWindow(WindowShape(N, 5, 2, 2, 1, 4), eye, eye).compile("auto")
        assert observer.code.size == 10 and noise.code.size == 10 * (N + 1)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("solver", "settings", "close"),
    [
        ("quadprog", {}, 1e-9),
        ("daqp", {}, 1e-9),
        ("piqp", {"tolerance": 1e-10}, 1e-6),
        ("clarabel", {"tolerance": 1e-10}, 1e-6),
        ("proxqp", {"tolerance": 1e-10}, 1e-6),
        ("highs", {"tolerance": 1e-9}, 1e-6),
        ("osqp", {"tolerance": 1e-9}, 1e-5),
    ],
)
def test_solvers_agree_on_the_window_with_disturbances(make_scene, run, solver, settings, close):
    scene = make_scene(nodes=2, vehicles=5)
    values = scene.readings(14, np.random.default_rng(7), sigma=0.8)
    reference = run(scene.build("dmhe_f_s"), values)
    options = {"tolerance": settings.get("tolerance", 1e-8)}
    steps = run(scene.build("dmhe_f_s", solver=solver, **options), values)
    assert all(set(step.status) <= {Status.SOLVED, Status.INACCURATE} for step in steps)
    assert np.abs(np.array([a.states - b.states for a, b in zip(steps, reference, strict=True)])).max() < close
