"""Detection flags, information speed, agreement, weights: dmhe-sporadic-fov C1, C4, C5, C8, C9, C16."""

from __future__ import annotations

import numpy as np
import pytest

from mhe.sporadic import METHODS, Reading, SporadicEstimator, SporadicNode
from mhe.sporadic.ranks import WindowRank
from problems import registry
from problems.errors import DataError, SettingError, ShapeError, TopologyError, UnknownNameError, UnstableError
from problems.models import LinearModel, Sensor
from problems.networks import Network, band, complete, observability_rank
from problems.runtime import Message

METHOD_NAMES = list(METHODS)


def states_of(steps):
    return np.array([step.states for step in steps])


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_what_was_not_detected_changes_nothing(scene, run, method):
    rng = np.random.default_rng(1)
    values = scene.readings(40, rng)
    flags = ~np.isnan(values).any(axis=3)
    rubbish = np.where(flags[..., None], values, 1e6 * rng.normal(size=values.shape))
    rubbish[3][~flags[3]] = np.inf
    plain = states_of(run(scene.build(method), values))
    assert np.array_equal(plain, states_of(run(scene.build(method), values, flags)))
    assert np.array_equal(plain, states_of(run(scene.build(method), rubbish, flags)))
    flags[18:24] = False
    assert not np.array_equal(plain, states_of(run(scene.build(method), values, flags)))


def test_flags_that_make_no_sense_are_refused(scene):
    estimator = scene.build("dmhe_w_pre")
    values, flags = np.full((5, 2, 2), np.nan), np.zeros((5, 2))
    flags[1, 0] = 1
    with pytest.raises(DataError, match="'c1 v0' has flag 1 and a reading with NaN"):
        estimator.step(values, flags)
    flags[1, 0] = 0.5
    with pytest.raises(DataError, match="1 or 0"):
        estimator.step(values, flags)
    with pytest.raises(DataError, match="infinite"):
        scene.build("dmhe_w_pre").step(np.full((5, 2, 2), np.inf))
    with pytest.raises(ShapeError, match="expected one entry for each of 5 nodes"):
        estimator.step(np.zeros((4, 2, 2)))


def test_readings_come_in_several_shapes(scene, run):
    values = scene.readings(12, np.random.default_rng(2))
    flags = (~np.isnan(values).any(axis=3)).astype(float)
    wanted = states_of(run(scene.build("dmhe_w_pre"), values))
    flat = scene.build("dmhe_w_pre")
    assert np.array_equal(
        wanted, states_of([flat.step(y.ravel(), a.ravel()) for y, a in zip(values, flags, strict=True)])
    )
    single = scene.build("dmhe_w_pre")
    entries = [[Reading(*pair) for pair in zip(y, a, strict=True)] for y, a in zip(values, flags, strict=True)]
    assert np.array_equal(wanted, states_of([single.step(entry) for entry in entries]))


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_a_reading_travels_one_hop_per_step(make_scene, run, method):
    scene, step = make_scene(nodes=6, vehicles=2), 9
    values = np.zeros((16, 6, 2, 2)) + 0.1 * np.random.default_rng(3).normal(size=(16, 6, 2, 2))
    disturbed = values.copy()
    disturbed[step, 0, 0] += 0.05
    options = {"fields": [scene.fields()[0]] * 6}
    difference = np.abs(
        states_of(run(scene.build(method, **options), values))
        - states_of(run(scene.build(method, **options), disturbed))
    )
    assert difference[:, :, 2:].max() == 0.0
    first = (difference[:, :, :2].max(axis=2) > 0).argmax(axis=0)
    assert first.tolist() == [step + max(distance - 1, 0) for distance in range(6)]


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_vehicles_together_equal_vehicles_one_by_one(scene, run, method):
    """The ranks of (4.12) are joint, so the comparison is with weights that do not depend on them."""
    values = scene.readings(40, np.random.default_rng(4))
    together = states_of(run(scene.build(method, weights="uniform"), values))
    for v in range(2):
        alone = states_of(run(scene.build(method, weights="uniform", vehicles=1), values[:, :, v : v + 1]))
        assert np.abs(together[:, :, 2 * v : 2 * v + 2] - alone).max() < 1e-9


@pytest.mark.parametrize(
    ("method", "observer", "agree"),
    [("dmhe_f", "local", True), ("dmhe_w_pre", "regional", True), ("dmhe_w_pre", "local", False)],
)
def test_who_agrees_on_a_complete_graph(scene, run, method, observer, agree):
    values = scene.readings(40, np.random.default_rng(5))
    estimator = scene.build(method, complete(5), observer=observer)
    spread = np.ptp(states_of(run(estimator, values)), axis=1).max()
    assert spread < 1e-9 if agree else spread > 0.1


def test_ranks_follow_the_detections_of_the_neighborhood(scene, run):
    values = scene.readings(40, np.random.default_rng(6))
    seen, N = ~np.isnan(values).any(axis=3), 3
    for t, step in enumerate(run(scene.build("dmhe_w_pre"), values)):
        recent = seen[max(0, t - N + 1) : t + 1].any(axis=0)
        ranks = np.array([2 * recent[max(0, i - 1) : i + 2].any(axis=0).sum() for i in range(5)])
        assert [node.rank for node in step.nodes] == ranks.tolist()
        if t <= N:
            continue
        scores = np.maximum(ranks, 0.5)
        for i, node in enumerate(step.nodes):
            members = scores[max(0, i - 1) : i + 2]
            assert node.weights == pytest.approx(members / members.sum(), abs=1e-15)


def test_weights_are_uniform_where_nobody_sees_anything(scene):
    estimator = scene.build("dmhe_w_pre")
    for _ in range(8):
        step = estimator.step(None)
    assert [node.weights.tolist() for node in step.nodes][:2] == [[0.5, 0.5], [1 / 3] * 3]
    assert np.isfinite(step.states).all()
    assert [node.unseen.tolist() for node in step.nodes] == [[8, 8]] * 5


def test_window_rank_equals_the_rank_of_the_stacked_matrix():
    rng, N = np.random.default_rng(7), 3
    A = np.array([[[1.0, 0.5], [0, 1]], [[0.9, 0.2], [-0.2, 0.9]]])
    parts = np.array([0, 0, 1, 1, 0])
    outputs = [np.array([[1.0, 0]]), np.array([[0, 1.0]]), np.eye(2), np.array([[1.0, 1]]), np.array([[1.0, 0]])]
    rank = WindowRank(A, parts, outputs)
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[2:, 2:] = A
    for _ in range(200):
        flags = (rng.random((N, 5)) < 0.25).astype(float)
        rows = [np.zeros((1, 4))]
        for k in range(N):
            for s in np.flatnonzero(flags[k]):
                C = np.zeros((len(outputs[s]), 4))
                C[:, 2 * parts[s] : 2 * parts[s] + 2] = outputs[s]
                rows.append(C @ np.linalg.matrix_power(whole, k))
        assert rank(flags) == np.linalg.matrix_rank(np.vstack(rows))
    assert int(observability_rank(A[0], outputs[0], 2)) == 2


def test_a_node_hears_its_neighbors_only(scene):
    design = scene.build("dmhe_w_pre").design
    nodes = [SporadicNode(plan, design.pool) for plan in design.plans]
    (said,) = nodes[4].measure(0.0, None)
    nodes[0].measure(0.0, None)
    with pytest.raises(DataError, match="node 0 heard node 4, which is no in-neighbour"):
        nodes[0].exchange(1, [Message(said.schema, 4, 0, 0.0, 0, said.payload)])
    with pytest.raises(DataError, match="same definition"):
        nodes[0].exchange(1, [Message(12345, 1, 0, 0.0, 0, said.payload)])


@pytest.mark.serial
def test_nodes_in_processes_give_the_same_estimates(scene, run):
    values = scene.readings(8, np.random.default_rng(8))
    here = states_of(run(scene.build("dmhe_w_pre_s"), values))
    with scene.build("dmhe_w_pre_s", processes=True) as estimator:
        assert np.array_equal(here, states_of(run(estimator, values)))


def test_names_stand_for_options(scene):
    assert {"dmhe_w_pre", "dmhe_w_pre_s", "dmhe_f", "dmhe_f_s"} <= set(registry.names("estimators"))
    found = registry.load("estimators", "dmhe_f_s")(scene.model(), band(5, 1), fields=scene.fields())
    assert found.options == METHODS["dmhe_f_s"]
    found = registry.load("estimators", "dmhe_w_pre")(scene.model(), band(5, 1), detections=True, gains=0.3)
    assert found.options == METHODS["dmhe_w_pre"]
    with pytest.raises(UnknownNameError, match="dmhe_w_pre"):
        scene.build("dmhe_w_per")
    with pytest.raises(UnknownNameError, match="rows"):
        scene.build("dmhe_f", rows="some")


def test_what_does_not_fit_is_refused(scene):
    with pytest.raises(SettingError, match="need fields="):
        scene.build("dmhe_f_s", fields=None)
    with pytest.raises(SettingError, match="belong to disturbance='observer'"):
        scene.build("dmhe_f", gains=0.3)
    with pytest.raises(SettingError, match="pi_update='onestep'"):
        scene.build("dmhe_f", prior="filter")
    with pytest.raises(SettingError, match="projected"):
        scene.build("dmhe_f", rows="projected")
    with pytest.raises(UnstableError, match="spectral radius"):
        scene.build("dmhe_w_pre", gains=2.5)
    with pytest.raises(TopologyError):
        scene.build("dmhe_w_pre", Network(5, [(0, 1), (1, 2), (2, 3), (3, 4)]))
    with pytest.raises(ShapeError, match="shared out evenly"):
        model = LinearModel(np.eye(2), np.eye(2), sensors=[Sensor("one", np.eye(2), sigma=1.0)], covariance=np.eye(2))
        SporadicEstimator(model, band(2, 1), "dmhe_f")
