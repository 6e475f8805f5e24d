"""Sets that are not convex: dmhe-sporadic-fov section 10, against trying every combination of pieces."""

from __future__ import annotations

import itertools

import daqp
import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.sporadic.rows import half_planes
from problems.errors import SettingError, ShapeError
from problems.networks import Network
from problems.solvers.base import Status

N, GAIN = 3, 0.2
HULL = Polyhedron.box([-1.0, -1.0], [1.0, 1.0])
PIECES = [
    Polyhedron.box([-1.0, -1.0], [-0.4, 1.0]),
    Polyhedron.box([0.4, -1.0], [1.0, 1.0]),
    Polyhedron.box([-1.0, 0.7], [1.0, 1.0]),
]


def built(scene, method, **options):
    fields = [HULL] * scene.nodes
    gains = {} if method.startswith("dmhe_f") else {"gains": GAIN}
    return scene.build(method, fields=fields, growth_prior="mean", horizon=N, **gains, **options)


def maps(values, observer):
    """Each state of the window as Z v + z0 in the unknowns, for one vehicle and A = C = R = Q = I."""
    if observer:
        Z, z0 = [np.eye(2)], [np.zeros(2)]
        for y in values[:-1]:
            on = 0.0 if np.isnan(y).any() else GAIN
            Z.append((1 - on) * Z[-1])
            z0.append((1 - on) * z0[-1] + on * np.nan_to_num(y))
        return Z, z0
    size = 2 * len(values)
    Z = [sum((np.eye(2, size, 2 * j) for j in range(k + 1)), np.zeros((2, size))) for k in range(len(values))]
    return Z, [np.zeros(2)] * len(values)


def cheapest(values, observer, sets):
    """Minimum over all choices of one set per instant, and the newest state there."""
    Z, z0 = maps(values, observer)
    size = Z[0].shape[1]
    P, q = np.eye(size) if not observer else np.zeros((2, 2)), np.zeros(size)
    P[:2, :2] = 1e-5 * np.eye(2)
    for k, y in enumerate(values):
        if not np.isnan(y).any():
            P = P + Z[k].T @ Z[k]
            q = q + Z[k].T @ (z0[k] - y)
    best = np.inf, None
    for chosen in itertools.product(*sets):
        rows, bounds = [], []
        for k, polyhedron in enumerate(chosen):
            if polyhedron is not None:
                G, h = half_planes(polyhedron)
                rows.append(G @ Z[k])
                bounds.append(h - G @ z0[k])
        A, b = np.ascontiguousarray(np.vstack(rows)), np.concatenate(bounds)
        v, value, flag, _ = daqp.solve(P, q, A, b, np.full(len(b), -1e30), np.zeros(len(b), np.intc), primal_tol=1e-11)
        if flag == 1 and value < best[0]:
            best = value, Z[-1] @ v + z0[-1]
    return best


@pytest.mark.parametrize("method", ["dmhe_f_s", "dmhe_w_pre_s"])
def test_detected_pieces_are_the_best_of_all_combinations(make_scene, method):
    scene = make_scene(nodes=1, vehicles=1)
    rng, changed, solved = np.random.default_rng(1), 0, 0
    observer = method == "dmhe_w_pre_s"
    exact = built(scene, method, network=Network(1), pieces="detected", convex_pieces=[PIECES])
    hull = built(scene, method, network=Network(1))
    for _ in range(25):
        values = 0.45 * rng.normal(size=(N + 1, 2))
        values[2] = np.nan
        exact.reset()
        hull.reset()
        for y in values:
            found, relaxed = exact.step(y[None, None]), hull.step(y[None, None])
        sets = [[None] if np.isnan(y).any() else PIECES for y in values]
        value, wanted = cheapest(values, observer, sets)
        if wanted is None:
            assert found.status == (Status.INFEASIBLE,) and found.nodes[0].infeasible == ("c0 v0",)
            continue
        solved += 1
        bound, _ = cheapest(values, observer, [[None] if np.isnan(y).any() else [HULL] for y in values])
        assert bound <= value + 1e-12
        assert found.status == (Status.SOLVED,)
        assert np.abs(found.states[0] - wanted).max() < 1e-7
        changed += bool(np.abs(found.states - relaxed.states).max() > 1e-3)
    assert solved > 8 and changed > 5


def test_vehicles_choose_their_pieces_apart(make_scene):
    scene = make_scene(nodes=1, vehicles=3)
    rng = np.random.default_rng(2)
    options = {"network": Network(1), "pieces": "detected", "convex_pieces": [PIECES]}
    together = built(scene, "dmhe_f_s", **options)
    alone = [built(scene, "dmhe_f_s", vehicles=1, **options) for _ in range(3)]
    for _ in range(12):
        y = 0.5 * rng.normal(size=(1, 3, 2))
        y[0, rng.random(3) < 0.3] = np.nan
        states = together.step(y).states[0]
        parts = [one.step(y[:, v : v + 1]).states[0] for v, one in enumerate(alone)]
        assert np.abs(states - np.concatenate(parts)).max() < 1e-8


def test_a_vehicle_nobody_sees_is_where_nobody_looks(make_scene):
    scene = make_scene(nodes=2, vehicles=1)
    away = [Polyhedron.box([1.5, -1.0], [3.0, 1.0]), Polyhedron.box([-2.0, -1.0], [-1.2, 1.0])]
    estimator = built(scene, "dmhe_f_s", pieces="unseen", unseen_pieces=[away, away])
    for _ in range(6):
        step = estimator.step(np.zeros((2, 1, 2)))
        assert np.abs(step.states).max() < 1e-6
    lost = estimator.step(np.full((2, 1, 2), np.nan))
    # the nearer of the two
    assert lost.states[:, 0] == pytest.approx([-1.2, -1.2], abs=1e-7)
    # what one node sees is seen for its neighbor too
    values = np.full((2, 1, 2), np.nan)
    values[0] = 0.0
    again = estimator.step(values)
    assert again.states[:, 0].min() > -1.0


def test_what_no_piece_can_meet_is_reported(make_scene):
    scene = make_scene(nodes=1, vehicles=1)
    far = [Polyhedron.box([5.0, 5.0], [6.0, 6.0])]
    estimator = built(scene, "dmhe_w_pre_s", network=Network(1), pieces="detected", convex_pieces=[far])
    for _ in range(6):
        step = estimator.step(np.zeros((1, 1, 2)))
    assert step.nodes[0].infeasible == ("c0 v0",) and step.status == (Status.INFEASIBLE,)
    assert np.abs(step.states).max() < 1e-3


def test_pieces_that_do_not_fit_are_refused(make_scene):
    scene = make_scene(nodes=1, vehicles=1)
    with pytest.raises(SettingError, match="need convex_pieces="):
        built(scene, "dmhe_f_s", network=Network(1), pieces="detected")
    with pytest.raises(SettingError, match="rows='hard'"):
        built(scene, "dmhe_f", network=Network(1), pieces="unseen", unseen_pieces=[PIECES])
    with pytest.raises(ShapeError, match="on 1 component"):
        wrong = [[Polyhedron.box([0.0], [1.0])]]
        built(scene, "dmhe_f_s", network=Network(1), pieces="detected", convex_pieces=wrong)
