"""The design of l-step neighbourhoods: data rule, gains, weights, and what it refuses and reports."""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest

from mhe.observers import given_gain, kalman_gain
from mhe.polyhedron import Polyhedron
from mhe.relay import RelayDesign, RelayOptions, held, reach, relay_options_of
from mhe.scenarios.sensor_field_world import POSITION, PRIOR_INFORMATION, A, field_model, sensor_field
from mhe.window import Window
from problems.errors import (
    DefinitionError,
    ModelWarning,
    NoiseError,
    SettingError,
    ShapeError,
    TopologyError,
    UnknownNameError,
    UnobservableError,
    UnstableError,
)
from problems.models import LinearModel, NonlinearModel, Sensor
from problems.networks import Network, complete, line, ring

FIELD = sensor_field()
RING = ring(4, directed=True)


def design(method: Any = "dmhe_l_pre", **options: Any) -> RelayDesign:
    return RelayDesign(FIELD.model, FIELD.network, method, placement=FIELD.placement, **options)


def priorless(**given: Any) -> LinearModel:
    model = field_model([0])
    return LinearModel(A, model.Q, sensors=model.sensors, state_names=model.state_names, dt=1.0, **given)


# Data rule


def test_rule_is_the_inequality() -> None:
    hops = np.arange(6)
    for latency in (0, 1):
        for l in (1, 2, 4):
            for t in range(10):
                m = min(t, 4)
                expected = [[d == 0 or d <= min(l, t - k + 1 - latency) for k in range(t - m, t + 1)] for d in hops]
                assert np.array_equal(held(hops, t, horizon=4, steps=l, latency=latency), expected)
    assert reach(np.arange(5), 3).tolist() == [1, 2, 3, 3, 3]
    assert reach(np.arange(5), 3, 1).tolist() == [0, 1, 2, 3, 3]


@pytest.mark.parametrize(("l", "latency", "first", "second"), [(1, 0, 66, 66), (2, 0, 94, 94), (4, 0, 94, 100)])
def test_nodes_with_data_on_the_reference_network(l: int, latency: int, first: int, second: int) -> None:
    found = design(l=l, latency=latency)
    counts = [sum(bool(found.held(i, t).any()) for i in range(100)) for t in (1, 2)]
    assert counts == [first, second]


def test_late_by_one_nobody_beyond_the_direct_neighbours_has_data_at_first() -> None:
    for l in (1, 2, 4):
        found = design(l=l, latency=1)
        assert sum(bool(found.held(i, 1).any()) for i in range(100)) == 66


# Reference network


def test_reference_network_has_its_fingerprint() -> None:
    assert np.allclose(FIELD.positions[:2], [[11.8216247, 450.46369633], [-355.84038728, 448.64944714]], atol=1e-8)
    assert len(FIELD.network.edges) == 2 * 352 and FIELD.network.diameter == 12
    degree = FIELD.network.in_degree - 1
    assert (degree.min(), round(degree.mean(), 2), degree.max()) == (2, 7.04, 13)
    nearest = FIELD.network.distances(FIELD.active).min(axis=0)
    assert np.bincount(nearest).tolist() == [10, 56, 28, 6]
    assert round(design().weights.matrix()[0, 0], 6) == 0.265873
    others = [sensor_field(seed) for seed in (20, 30)]
    assert [(f.seed, len(f.network.edges) // 2) for f in others] == [(20, 328), (35, 347)]


def test_large_fields_keep_their_largest_component() -> None:
    field = sensor_field(1, 2000, largest=True)
    assert field.drawn == 2000 and 1900 < field.network.count < 2000 and field.network.is_strongly_connected
    assert len(field.placement) == len(field.model.sensors) == len(field.active)
    with pytest.raises(TopologyError, match="largest=True"):
        sensor_field(1, 400, radius=60.0)


# Neighbourhoods and gains


def test_neighbourhoods_regions_and_problems() -> None:
    found = design(l=3)
    distance = FIELD.network.distances()
    for i in range(0, 100, 7):
        near = np.flatnonzero((distance[:, i] <= 3) & (distance[:, i] >= 0))
        assert np.array_equal(found.members[i], near)
        assert np.array_equal(found.hops[i], distance[near, i])
        sources = [j for j in near if j in FIELD.active]
        assert sorted(found.sources[i].tolist()) == sources
        assert np.array_equal(found.source_hops[i], distance[found.sources[i], i])
        assert (np.diff(found.source_hops[i]) >= 0).all()
        rows = found.regional_rows[i]
        assert np.array_equal(found.regional[i].C, FIELD.model.C[rows])
        assert np.array_equal(found.local(i).C, FIELD.model.C[rows])
    same = [np.bincount(found.source_hops[i], minlength=4).tolist() for i in range(100)]
    assert len(found.problems) == len({tuple(s) for s in same})


def test_gains_are_those_of_the_source() -> None:
    found, late = design(l=2), design(l=2, latency=1)
    position = {1: 0.31701187, 2: 0.37702, 3: 0.41717}
    velocity = {1: 0.04259045, 2: 0.05837, 3: 0.06997}
    for m in position:
        node = next(i for i in range(100) if len(found.sources[i]) == m and (found.source_hops[i] == 2).any())
        two_hops = found.gains(node, 4)[3]  # age 1
        assert np.allclose(two_hops[:2], np.tile(position[m] / m * np.eye(2), m), atol=1e-5)
        assert np.allclose(two_hops[2:], np.tile(velocity[m] / m * np.eye(2), m), atol=1e-5)
        far = found.local(node).row_hops > 1
        assert not late.gains(node, 4)[3][:, far].any()  # one hop only by then
        assert np.allclose(late.gains(node, 4)[2], two_hops)
        mean, summed = (design(l=2, gains=rule, require_sound=False).gains(node, 4)[0] for rule in ("mean", "sum"))
        own = found.own(0).gain
        assert np.allclose(mean, np.tile(own, m) / m) and np.allclose(summed, np.tile(own, m))


def test_joint_gains_of_different_sensors_are_designed_together() -> None:
    sensors = [
        Sensor("x", [[1.0, 0, 0, 0]], sigma=1.0),
        Sensor("xy", POSITION, sigma=2.0),
        Sensor("y", [[0.0, 1, 0, 0]], sigma=3.0),
    ]
    model = LinearModel(A, 0.1 * np.eye(4), sensors=sensors, covariance=np.eye(4))
    found = RelayDesign(model, line(3), weights="uniform", l=1)
    rows = found.regional_rows[1]
    expected = kalman_gain(A, model.C[rows], model.Q, model.R[np.ix_(rows, rows)]).gain
    assert np.allclose(found.gains(1, 4)[0], expected, rtol=1e-6)
    assert not found.gains(1, 2)[2:].any()  # beyond the transitions of a filling window


def test_ages_decide_the_gains() -> None:
    found = design(l=4)
    full = found.gains(7, 4)
    for phase in (1, 2, 3):
        assert np.array_equal(found.gains(7, phase)[:phase], full[4 - phase :])


# Weights


@pytest.mark.parametrize("method", ["dmhe_l_pre", "dmhe_b"])
@pytest.mark.parametrize("omega", ["seed", "hessian"])
def test_weights_settle_and_stay_definite(method: str, omega: str) -> None:
    schedule = design(method, omega=omega).schedule()
    assert schedule.settled is not None and schedule.settled <= 25
    assert np.linalg.eigvalsh(schedule.local).min() > 0
    change = np.abs(schedule.local[-1] - schedule.local[-2]).max(axis=(1, 2))
    assert (change <= 1e-10 * np.abs(schedule.local[-1]).max(axis=(1, 2))).all()
    assert schedule.at(10**6) == len(schedule.local) - 1


def test_literal_start_keeps_the_prior_until_the_windows_are_full() -> None:
    schedule = design(startup="literal").schedule()
    assert all(np.allclose(P, PRIOR_INFORMATION) for P in schedule.local[:5])
    assert not np.allclose(schedule.local[5], PRIOR_INFORMATION)
    assert np.allclose(design(startup="fuse").schedule().local[1], PRIOR_INFORMATION)
    assert not np.allclose(design(startup="fuse").schedule().local[2], PRIOR_INFORMATION)


def test_schedule_of_a_short_run_is_the_beginning_of_the_long_one() -> None:
    short, long = design().schedule(3), design().schedule()
    assert short.settled is None
    assert np.array_equal(short.fused, long.fused[: len(short.fused)])


def test_noise_free_errors_contract() -> None:
    """V_{t+1}^i <= (alpha / f) sum pi^ij V_t^j, V^i = ||x - xtilde^i||^2 weighted by P^i (8)."""
    field = sensor_field(nodes=30, share=0.2)
    x0 = np.array([300.0, -250.0, 1.0, -1.0])
    for omega, divisor in (("seed", 8.0), ("hessian", 1.0), ("hessian", 2.0), ("hessian", 8.0)):
        options: dict[str, Any] = {"omega": omega, "arrival_divisor": divisor, "startup": "literal"}
        found = RelayDesign(field.model, field.network, placement=field.placement, **options, l=1)
        schedule, pi = found.schedule(), found.weights.matrix()
        error = np.tile(x0, (30, 1))
        for t in range(1, 31):
            entry = schedule.at(t)
            V = np.einsum("ia,iab,ib->i", error, schedule.local[entry], error)
            xi = np.einsum("ij,jab,jb->ia", pi, schedule.local[entry], error)
            m = min(t, 4)
            data = np.array([found.local(i).data_information[m] for i in range(30)])
            first = np.linalg.solve(schedule.fused[entry] + data, xi[..., None])[..., 0]
            last = np.array([rolled(found, i, m, first[i]) for i in range(30)])
            if t < 4:
                error = np.tile(x0, (30, 1))
                continue
            error = np.einsum("iab,ib->ia", found.prediction_maps, first)
            after = np.einsum("ia,iab,ib->i", error, schedule.local[schedule.at(t + 1)], error)
            limit = (found.options.alpha if omega == "seed" else 1.0) / divisor * pi @ V
            assert (after <= limit * (1 + 1e-9) + 1e-25).all(), t
        if divisor == 8.0:
            assert np.abs(last).max() < 1e-9  # from 390 m


def rolled(found: RelayDesign, node: int, phase: int, error: np.ndarray) -> np.ndarray:
    for age in range(phase, 0, -1):
        error = found.local(node).transition(age) @ error
    return error


# What it reports


def test_report_on_the_reference_network() -> None:
    report = design(l=2).report
    assert report.inactive.sum() == 90
    assert np.array_equal(report.inactive, report.locally_undetectable)
    assert report.regionally_undetectable.sum() == 34  # no sensor within one hop
    assert np.bincount(report.rank).tolist() == [6, 0, 0, 0, 94]
    assert np.allclose(report.own_radius[:10], np.hypot(0.84149, 0.13216), atol=1e-4) and report.own_radius[10] == 1
    assert report.radius.shape == (100, 2)
    assert np.allclose(report.prior_deviations, [316.2278, 316.2278, 1, 1], atol=1e-3)  # m, m, m/s, m/s
    assert (np.linalg.eigvalsh(design(l=2).own_information)[10:] == 0).all()


def test_summed_gains_warn_of_growth_with_the_condition_of_the_hessian() -> None:
    model = field_model(list(range(10)))
    with pytest.warns(ModelWarning, match=r"spectral radius of Phi up to 2\.0[0-9].*condition of H"):
        found = RelayDesign(model, complete(10), gains="sum", l=1, weights="uniform")
    assert found.report.radius.max() == pytest.approx(2.03, abs=0.01)
    poles = [given_gain(A, POSITION, np.vstack([(2 - 1.1) * np.eye(2), (1 - 1.1 + 0.3) * np.eye(2)])).gain] * 10
    with pytest.warns(ModelWarning):
        found = RelayDesign(model, complete(10), gains="sum", l=1, horizon=4, own_gains=poles)
    assert found.report.radius.max() == pytest.approx(7.8, abs=0.1) and found.condition().max() > 1e7
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for rule in ("joint", "mean"):
            RelayDesign(model, complete(10), gains=rule, l=1, weights="uniform")  # nothing to warn of


# What it refuses


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"l": 5}, SettingError, "between 1 and the horizon N=4"),
        ({"l": 0}, SettingError, "between 1"),
        ({"latency": 2}, SettingError, "latency"),
        ({"alpha": 1.0}, SettingError, "alpha"),
        ({"alpha": 0.0}, SettingError, "alpha"),
        ({"arrival_divisor": 0.5}, SettingError, "arrival_divisor"),
        ({"horizon": 0}, SettingError, "horizon"),
        ({"gains": "median"}, UnknownNameError, "gains"),
        ({"hops": 3}, UnknownNameError, "option of an l-step method"),
        ({"S": np.diag([1.0, 1, 1, -1])}, NoiseError, "S is not positive definite"),
        ({"S": np.eye(3)}, ShapeError, "S: expected"),
        ({"weights": "given"}, SettingError, "weight_matrix"),
        ({"weight_matrix": np.eye(100)}, SettingError, "weights='given'"),
        ({"own_gains": [None]}, ShapeError, "one per node"),
        ({"residual_bounds": {"nobody": Polyhedron.box([-1, -1], [1, 1])}}, UnknownNameError, "nobody"),
        ({"residual_bounds": Polyhedron.box([-1], [1])}, ShapeError, "expected a polyhedron on 2"),
    ],
)
def test_options_outside_their_range(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        design(**options)


def test_process_noise_takes_no_gains_and_methods_have_names() -> None:
    with pytest.raises(SettingError, match="estimates disturbances"):
        design("dmhe_b", own_gains=[np.zeros((4, 2))] * 100)
    with pytest.raises(UnknownNameError, match="dmhe_1_pre"):
        relay_options_of("dmhe_2_pre")
    assert relay_options_of(RelayOptions(horizon=7)).steps == 7


def test_disconnected_graphs_are_refused() -> None:
    with pytest.raises(TopologyError, match="no path from node"):
        RelayDesign(field_model([0]), Network(4, [(0, 1), (1, 0), (2, 3), (3, 2)]), placement=[0])


def test_metropolis_weights_need_an_undirected_graph() -> None:
    with pytest.raises(TopologyError, match="undirected"):
        RelayDesign(field_model([0]), RING, placement=[0])
    RelayDesign(field_model([0]), RING, placement=[0], weights="uniform")


def test_weights_sum_to_one_and_are_positive() -> None:
    good = np.array([[0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]])
    make = {"placement": [0], "weights": "given"}
    assert RelayDesign(field_model([0]), RING, weight_matrix=good, **make).weights.row(0).tolist() == [0.5, 0.5]  # type: ignore[arg-type]
    for change, message in ((1e-11, "sum to 1"), (0.1, "sum to"), (None, "positive on every link")):
        bad = good.copy()
        bad[1] = [0, 1, 0, 0] if change is None else bad[1]
        bad[1, 1] += change or 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with pytest.raises(TopologyError, match=message):
                RelayDesign(field_model([0]), RING, weight_matrix=bad, **make)  # type: ignore[arg-type]


def test_unobservable_collective_pairs_are_refused_and_detectable_ones_warned_of() -> None:
    blind = [Sensor("x", [[1.0, 0, 0, 0]], sigma=1.0)]
    with pytest.raises(UnobservableError, match="all sensors together"):
        RelayDesign(LinearModel(A, np.eye(4), sensors=blind, covariance=np.eye(4)), line(3), placement=[0])
    decaying = LinearModel(
        np.diag([0.9, 0.8]), np.eye(2), sensors=[Sensor("x", [[1.0, 0]], sigma=1)], covariance=np.eye(2)
    )
    with pytest.warns(ModelWarning, match="unobserved"):
        RelayDesign(decaying, line(3), placement=[0])


def test_unstable_own_gains_are_refused() -> None:
    with pytest.raises(UnstableError, match="spectral radius"):
        RelayDesign(field_model([0]), line(3), placement=[0], own_gains=[np.zeros((4, 2)), None, None])
    with pytest.warns(ModelWarning, match="spectral radius"):
        RelayDesign(
            field_model([0]), line(3), placement=[0], own_gains=[np.zeros((4, 2)), None, None], require_sound=False
        )
    with pytest.raises(ShapeError, match="node 0"):
        RelayDesign(field_model([0]), line(3), placement=[0], own_gains=[np.zeros((4, 3)), None, None])


def test_covariance_and_information_cannot_be_mixed_up() -> None:
    covariance = np.diag([1e5, 1e5, 1.0, 1.0])
    wanted = RelayDesign(priorless(), line(3), placement=[0], cov=covariance)
    assert np.allclose(wanted.information, PRIOR_INFORMATION)
    assert np.allclose(
        RelayDesign(priorless(), line(3), placement=[0], info=PRIOR_INFORMATION).information, wanted.information
    )
    with pytest.raises(DefinitionError, match=r"px 0\.003162.*As cov= the same matrix says px 316\.2"):
        RelayDesign(priorless(), line(3), placement=[0], info=covariance)
    with pytest.raises(DefinitionError, match=r"px 0\.003162.*Pass it as info="):
        RelayDesign(priorless(), line(3), placement=[0], cov=PRIOR_INFORMATION)
    with pytest.raises(DefinitionError, match=r"info= says .*px 0\.003162.*the model's covariance says px 316\.2"):
        RelayDesign(field_model([0]), line(3), placement=[0], info=covariance)
    with pytest.raises(DefinitionError, match="the prior once"):
        RelayDesign(priorless(), line(3), placement=[0], cov=covariance, info=PRIOR_INFORMATION)
    with pytest.raises(DefinitionError, match="prior of x_0 is missing"):
        RelayDesign(priorless(), line(3), placement=[0])
    with pytest.raises(NoiseError, match="cov= is not positive definite"):
        RelayDesign(priorless(), line(3), placement=[0], cov=-covariance)
    with pytest.raises(TypeError):
        RelayDesign(priorless(), line(3), "dmhe_l_pre", covariance)  # type: ignore[misc]
    sure = np.diag([1e-5, 1e-5, 1e-5, 1e-5])  # meant so: said twice
    assert RelayDesign(priorless(covariance=sure), line(3), placement=[0], cov=sure).information[0, 0] == pytest.approx(
        1e5
    )


def test_models_and_placements_that_do_not_fit() -> None:
    with pytest.raises(ShapeError, match="pass placement="):
        RelayDesign(FIELD.model, FIELD.network)
    nonlinear = NonlinearModel(lambda x: x, np.eye(1), 1)
    with pytest.raises(DefinitionError, match="LinearModel"):
        RelayDesign(nonlinear, line(2))


# Windows with gains as data and bounded residuals


def window_data(model: LinearModel, N: int, rng: np.random.Generator) -> dict[str, Any]:
    y = rng.normal(size=((N + 1), model.measurement_size))
    y[1, 0] = y[3, 2] = np.nan
    root = rng.normal(size=(4, 4))
    return {
        "y": y.ravel(),
        "gain": 0.3 * rng.normal(size=(N, 4, model.measurement_size)),
        "reference": rng.normal(size=4),
        "information": root @ root.T + 0.1 * np.eye(4),
        "linear": rng.normal(size=4),
    }


def condensed(model: LinearModel, N: int, data: dict[str, Any]) -> np.ndarray:
    """States of the closed form of the source, a missing component adding nothing."""
    y = data["y"].reshape(N + 1, -1)
    W = np.linalg.inv(model.R)
    H, g = data["information"].copy(), data["information"] @ data["reference"] - data["linear"]
    T, b, maps = np.eye(4), np.zeros(4), []
    for s in range(N + 1):
        there = ~np.isnan(y[s])
        C, z, w = model.C[there], y[s, there], W[np.ix_(there, there)]
        maps.append((T, b))
        H += T.T @ C.T @ w @ C @ T
        g += T.T @ C.T @ w @ (z - C @ b)
        if s < N:
            L = data["gain"][s][:, there]
            T, b = (model.A - L @ C) @ T, (model.A - L @ C) @ b + L @ z
    first = np.linalg.solve(H, g)
    return np.array([T @ first + b for T, b in maps])


def two_sensors() -> LinearModel:
    sensors = [Sensor("a", POSITION, sigma=[0.5, 0.8]), Sensor("b", [[0, 0, 1.0, 0], [0, 0, 0, 1]], sigma=0.3)]
    return LinearModel(A, 0.1 * np.eye(4), sensors=sensors, covariance=np.eye(4))


@pytest.mark.parametrize(("form", "solver"), [("P2", "auto"), ("P1", "auto"), ("P1", "piqp"), ("P1", "ipopt")])
def test_condensed_sparse_and_symbolic_windows_agree(form: Any, solver: str) -> None:
    model, N = two_sensors(), 4
    session = Window(model, N, form=form, gain="data").compile(solver)
    rng = np.random.default_rng(3)
    for _ in range(3):  # gains change from solve to solve
        data = window_data(model, N, rng)
        found = session.solve(data)["x"]
        assert np.abs(found - condensed(model, N, data)).max() < (1e-8 if solver == "auto" else 1e-6)


def test_constant_gains_as_data_are_a_constant_gain() -> None:
    model, N = two_sensors(), 3
    data = window_data(model, N, np.random.default_rng(0))
    gain = data["gain"][0]
    fixed = Window(model, N, gain=gain).compile()
    free = Window(model, N, gain="data").compile()
    data["gain"] = np.tile(gain, (N, 1, 1))
    expected = free.solve(data)["x"]
    del data["gain"]
    assert np.allclose(fixed.solve(data)["x"], expected, atol=1e-10)
    with pytest.raises(UnknownNameError, match="gain"):
        Window(model, N, gain="date")


@pytest.mark.parametrize("form", ["P1", "P2"])
def test_residual_bounds_hold_and_soft_ones_give_way(form: Any) -> None:
    model, N = two_sensors(), 3
    data = window_data(model, N, np.random.default_rng(1))
    y = data["y"].reshape(N + 1, -1)
    free = Window(model, N, form=form, gain="data").compile().solve(data)["x"]
    there = ~np.isnan(y[:, :2]).any(axis=1)
    size = 0.9 * np.abs(y[there, :2] - free[there, :2]).max()
    bounds = {"a": Polyhedron.box([-size] * 2, [size] * 2)}
    window = Window(model, N, form=form, gain="data", residual_bounds=bounds)
    assert window.bounds == ("residual a",)
    found = window.compile().solve(data)
    assert found.solved
    residual = np.abs(y[:, :2] - found["x"][:, :2])
    assert residual[there].max() == pytest.approx(size, abs=1e-6)
    soft = Window(model, N, form=form, gain="data", residual_bounds=bounds, penalty=1e5)
    relaxed = soft.compile().solve(data)
    assert np.abs(relaxed["x"] - found["x"]).max() < 1e-5 and soft.unmet(relaxed, N + 1) == ()
    impossible = {"a": Polyhedron.box([3, 3], [4, 4]), "b": Polyhedron.box([-5, -5], [-4, -4])}
    with pytest.warns(ModelWarning, match="residuals of sensor"):
        soft = Window(model, N, form=form, gain="data", residual_bounds=impossible, penalty=1e3)
    broken = soft.compile().solve(data)
    assert broken.solved and "residual a bounds" in soft.unmet(broken, N + 1)
    with pytest.raises(ShapeError, match="sensor 'a'"):
        Window(model, N, gain="data", residual_bounds={"a": Polyhedron.box([-1], [1])})


def test_residual_bounds_of_a_nonlinear_process_noise_window() -> None:
    model = NonlinearModel(
        lambda x: x,
        0.1 * np.eye(2),
        2,
        sensors=[Sensor("range", lambda x: ca.norm_2(x), sigma=0.1)],
        covariance=np.eye(2),
        mean=[1.0, 1.0],
    )
    y = np.array([3.0, 2.0, np.nan])
    data = {"y": y, "reference": [1.0, 1.0], "information": np.eye(2)}
    bounds = {"range": Polyhedron.box([-0.02], [0.02])}
    solution = Window(model, 2, residual_bounds=bounds).compile("ipopt").solve(data, initial={"x": np.ones((3, 2))})
    residual = y - np.linalg.norm(solution["x"], axis=1)
    assert np.nanmax(np.abs(residual)) <= 0.02 + 1e-6
    assert np.nanmax(np.abs(residual)) > 0.02 - 1e-4


def test_ten_thousand_nodes_need_nothing_dense() -> None:
    network = ring(10_000)
    model = field_model(list(range(0, 10_000, 10)))
    found = RelayDesign(model, network, "dmhe_l_pre", l=2, placement=list(range(0, 10_000, 10)))
    assert len(found.problems) <= 4
    assert found.schedule().fused.shape[1:] == (10_000, 4, 4)
