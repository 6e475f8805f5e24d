"""The window against dense least squares written out here, its forms against each other, its bounds."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.window import Window
from problems import Huber, LinearModel, NonlinearModel, Sensor
from problems.errors import (
    DataError,
    EmptyConstraintError,
    FormError,
    ModelWarning,
    SettingError,
    ShapeError,
    UnknownNameError,
)

RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
GAIN = np.array([[0.3, 0.0], [0.1, 0.0], [0.0, 0.4], [0.0, 0.2]])


def ring():
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=1.0), Sensor("third", [[0, 0, 1.0, 0]], sigma=0.5)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, covariance=np.eye(4))


def pushed(rng):
    """Inputs, correlated disturbance through a square gain, a sensor with correlated noise and one without."""
    root = rng.normal(size=(3, 3))
    return LinearModel(
        rng.normal(size=(3, 3)) / 2,
        root @ root.T + np.eye(3),
        B=rng.normal(size=(3, 2)),
        G=rng.normal(size=(3, 3)) + 2 * np.eye(3),
        sensors=[
            Sensor("pair", rng.normal(size=(2, 3)), covariance=[[0.5, 0.2], [0.2, 0.4]]),
            Sensor("plain", rng.normal(size=(2, 3)), sigma=[0.3, 0.7]),
        ],
        covariance=np.eye(3),
    )


def given(model, N, rng, missing=0.0):
    n, p = model.state_size, model.measurement_size
    root = rng.normal(size=(n, n))
    data = {
        "y": rng.normal(size=(N + 1) * p),
        "reference": rng.normal(size=n),
        "information": root @ root.T + 0.1 * np.eye(n),
        "linear": rng.normal(size=n),
    }
    data["y"][rng.random(data["y"].size) < missing] = np.nan
    if model.input_size:
        data["u"] = rng.normal(size=(N + 1, model.input_size))
    return data


def dense_states(model, N, data):
    """States of the process-noise window from the normal equations in all x_k, row by row."""
    n = model.state_size
    H, g = np.zeros(((N + 1) * n,) * 2), np.zeros((N + 1) * n)

    def add(J, residual, weight):
        H[:] += J.T @ weight @ J
        g[:] += J.T @ weight @ residual

    def block(k):
        return np.eye((N + 1) * n)[k * n : (k + 1) * n]

    add(block(0), -data["reference"], data["information"])
    g[:n] += data["linear"]
    W = np.linalg.inv(model.G @ model.Q @ model.G.T)
    for k in range(N):
        push = model.B @ data["u"][k + 1] if model.input_size else np.zeros(n)
        add(block(k + 1) - model.A @ block(k), -push, W)
    for k, y in enumerate(data["y"].reshape(N + 1, -1)):
        for sensor in model.sensors:
            rows = model.rows(sensor.name)
            noise, part = model.R[rows, rows], y[rows]
            there = ~np.isnan(part)
            if (noise != np.diag(np.diag(noise))).any() and not there.all():
                continue
            C = model.C[rows][there]
            add(C @ block(k), -part[there], np.linalg.inv(noise[np.ix_(there, there)]))
    return np.linalg.solve(H, -g).reshape(N + 1, n)


@pytest.mark.parametrize("form", ["F1", "F2", "F3"])
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_every_form_gives_the_states_of_the_normal_equations(form, missing):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        model, N = pushed(rng), int(rng.integers(1, 6))
        session = Window(model, N, form=form).compile()
        data = given(model, N, rng, missing)
        solution = session.solve(data)
        np.testing.assert_allclose(solution["x"], dense_states(model, N, data), atol=1e-9)
        assert solution.solved and solution.residuals["dual"] < 1e-8


def test_the_observer_window_follows_the_observer():
    rng = np.random.default_rng(3)
    model, N = pushed(rng), 4
    gain = rng.normal(size=(3, 4)) / 4
    data = given(model, N, rng, 0.3)
    for form in ("P1", "P2"):
        x = Window(model, N, form=form, gain=gain).compile().solve(data)["x"]
        y = data["y"].reshape(N + 1, -1)
        for k in range(N):
            innovation = np.nan_to_num(y[k] - model.C @ x[k])
            expected = model.A @ x[k] + model.B @ data["u"][k + 1] + gain @ innovation
            np.testing.assert_allclose(x[k + 1], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("form", "unknowns", "equalities"),
    [("F1", 44, 20), ("F2", 24, 0), ("F3", 24, 0), ("P1", 24, 20), ("P2", 4, 0)],
)
def test_sizes_are_those_of_the_spec(form, unknowns, equalities):
    gain = GAIN if form.startswith("P") else None
    session = Window(ring(), 5, form=form, gain=gain).compile("daqp")
    reduced = session.program.reduced(np.nan_to_num(session.store.numbers))
    assert (reduced.size, reduced.equalities) == (unknowns, equalities)
    assert reduced.A.shape[0] == equalities


BOX = Polyhedron.box([-0.3, -np.inf, -0.4, -0.6], [0.3, np.inf, np.inf, 0.6])


@pytest.mark.parametrize(
    ("solver", "tolerance", "agreement"),
    [
        ("daqp", 1e-9, 1e-8),
        ("piqp", 1e-10, 1e-8),
        ("clarabel", 1e-10, 1e-8),
        ("osqp", 1e-8, 1e-6),
        ("proxqp", 1e-9, 1e-6),
    ],
)
@pytest.mark.parametrize("gain", [None, GAIN], ids=["noise", "observer"])
def test_forms_and_solvers_agree_with_active_rows(solver, tolerance, agreement, gain):
    model, N = ring(), 5
    forms = ("F1", "F2", "F3") if gain is None else ("P1", "P2")
    reference = Window(model, N, form=forms[-1], gain=gain, state_bounds=BOX).compile("quadprog")
    sessions = [
        Window(model, N, form=form, gain=gain, state_bounds=BOX).compile(solver, tolerance=tolerance) for form in forms
    ]
    active = 0
    for seed in range(16):
        rng = np.random.default_rng(seed)
        data = given(model, N, rng) | {"y": 0.5 * rng.normal(size=12), "reference": rng.normal(size=4)}
        data |= {"information": np.eye(4), "linear": np.zeros(4)}
        expected = reference.solve(data)
        active += expected.solved and bool(expected.active_set["state bounds"].any())
        for session in sessions:
            solution = session.solve(data)
            # a first-order solver may miss its own tolerance, but must say so and still agree
            assert solution.status == expected.status or (solver == "osqp" and solution.status == "inaccurate")
            if expected.solved:
                np.testing.assert_allclose(solution["x"], expected["x"], atol=agreement)
    assert active >= 4


def test_bounds_hold_in_filled_slots_only():
    limit = np.array([0.1, np.inf, np.inf, np.inf])
    session = Window(ring(), 3, state_bounds=Polyhedron.box(-limit, limit)).compile()
    data = {"y": np.ones(8), "reference": [1.0, 3.0, 0, 0], "information": np.eye(4), "linear": np.zeros(4)}
    data["y"][4:] = np.nan
    x = session.solve(data | {"filled": [1, 1, 0, 0]})["x"]
    np.testing.assert_allclose(np.abs(x[:2, 0]), 0.1, atol=1e-9)
    np.testing.assert_allclose(x[2:], [RING_A @ x[1], RING_A @ RING_A @ x[1]], atol=1e-9)
    assert np.abs(x[2:, 0]).max() > 0.2
    full = session.solve({"filled": [1, 1, 1, 1]})["x"]
    assert np.abs(full[:, 0]).max() <= 0.1 + 1e-9


@pytest.mark.parametrize("form", ["F1", "F2", "F3"])
def test_disturbance_bounds_act_on_the_disturbance(form):
    rng = np.random.default_rng(5)
    model = pushed(rng)
    rows = Polyhedron([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]], upper=[0.1, 0.2], lower=[-0.1, -np.inf])
    session = Window(model, 3, form=form, disturbance_bounds=rows).compile()
    data = given(model, 3, rng)
    solution = session.solve(data)
    x = solution["x"]
    moved = x[:-1] @ model.A.T + data["u"][1:] @ model.B.T
    w = np.linalg.solve(model.G, (x[1:] - moved).T).T
    assert rows.violation(w) < 1e-8
    assert np.abs(solution.multipliers["disturbance bounds"]).max() > 1e-3
    free = Window(model, 3, form=form).compile().solve(data)
    assert free.objective < solution.objective - 1e-6


@pytest.mark.filterwarnings("ignore:disturbance bounds do not contain 0")
def test_disturbance_bounds_act_between_filled_slots_only():
    pushed_up = Polyhedron.box([0.1, -1, -1, -1], [1.0] * 4)
    data = given(ring(), 3, np.random.default_rng(0)) | {"filled": [1, 1, 0, 0]}
    data["y"][4:] = np.nan
    for form in ("F1", "F2", "F3"):
        x = Window(ring(), 3, form=form, disturbance_bounds=pushed_up).compile().solve(data)["x"]
        w = x[1:] - x[:-1] @ RING_A.T
        assert w[0, 0] == pytest.approx(0.1, abs=1e-9)
        np.testing.assert_allclose(w[1:], 0, atol=1e-9)


def test_a_row_that_loses_its_bound_does_not_stay_active():
    rng = np.random.default_rng(1)
    model = ring()
    bounds = {
        "state_bounds": Polyhedron(rng.normal(size=(3, 4)), np.full(3, 0.3), np.full(3, -0.1)),
        "disturbance_bounds": Polyhedron.box([-0.02, -np.inf, -0.1, -1], [0.02, 0.1, np.inf, 1]),
    }
    window = Window(model, 4, form="F3", **bounds)
    session = window.compile()
    active = 0
    for k in range(12):
        data = given(model, 4, rng) | {"filled": [1, 1, 1, k % 3 > 0, k % 3 > 0]}
        solution, fresh = session.solve(data), window.compile("clarabel").solve(data)
        assert solution.solved
        np.testing.assert_allclose(solution["x"], fresh["x"], atol=1e-6)
        active += solution.method != "linear"
    assert active > 6


def test_observer_disturbances_can_be_bounded():
    model = ring()
    limits = Polyhedron.box([-0.1] * 4, [0.1] * 4)
    window = Window(model, 3, gain=GAIN, disturbance_bounds=limits)
    rng = np.random.default_rng(1)
    data = given(model, 3, rng) | {"y": 0.5 * rng.normal(size=8)}
    solution = window.compile().solve(data)
    assert solution.solved and solution.active_set["disturbance bounds"].any()
    x, y = solution["x"], data["y"].reshape(4, 2)
    assert limits.violation((y[:-1] - x[:-1] @ model.C.T) @ GAIN.T) < 1e-8


def test_an_exact_penalty_changes_nothing_where_the_bounds_can_be_met_and_relaxes_them_where_not():
    model = ring()
    rng = np.random.default_rng(2)
    data = given(model, 4, rng) | {"reference": np.zeros(4), "linear": np.zeros(4)}
    data["y"] = 0.6 * rng.normal(size=10)
    bounds = {"state_bounds": Polyhedron.box([-0.2] * 4, [0.2] * 4)}
    hard = Window(model, 4, **bounds).compile().solve(data)
    largest = np.abs(hard.multipliers["state bounds"]).max()
    assert largest > 1e-3
    soft_window = Window(model, 4, penalty=1.5 * largest, **bounds)
    soft = soft_window.compile().solve(data)
    np.testing.assert_allclose(soft["x"], hard["x"], atol=1e-7)
    assert soft_window.unmet(soft, 5) == ()
    weak_window = Window(model, 4, penalty=largest / 2, **bounds)
    weak = weak_window.compile().solve(data)
    assert np.abs(weak["x"]).max() > 0.2 + 1e-4
    assert weak_window.unmet(weak, 5) == ("state bounds",)


def test_a_node_without_sensors_has_a_window():
    blind = ring().with_sensors([])
    data = {"reference": np.ones(4), "information": np.eye(4), "linear": np.zeros(4)}
    for gain in (None, np.zeros((4, 0))):
        x = Window(blind, 2, gain=gain).compile().solve(data)["x"]
        np.testing.assert_allclose(x, [np.ones(4), RING_A @ np.ones(4), RING_A @ RING_A @ np.ones(4)], atol=1e-9)


def test_sensors_use_components_as_their_noise_allows():
    model = pushed(np.random.default_rng(0))
    y = np.array([[1.0, np.nan, 2.0, np.nan], [1.0, 2.0, np.nan, 3.0]])
    expected = [[False, False, True, False], [True, True, False, True]]
    np.testing.assert_array_equal(Window(model, 2).used(y), expected)
    robust = Window(model, 2, losses={"plain": Huber()})
    np.testing.assert_array_equal(robust.used(y), [[False] * 4, [True, True, False, False]])


def test_a_robust_loss_bounds_the_pull_of_an_outlier():
    data = {"y": np.zeros(6), "reference": np.zeros(4), "information": np.eye(4), "linear": np.zeros(4)}
    data["y"][4] = 50.0
    plain = Window(ring(), 2).compile().solve(data)["x"][-1]
    robust = Window(ring(), 2, losses={"first": Huber()}).compile().solve(data)
    assert robust.solved and robust.method == "gauss-newton"
    assert abs(robust["x"][-1][0]) < abs(plain[0]) / 10


def unicycle():
    def rate(x, u):
        return [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]]

    sensors = [Sensor("range", lambda x: ca.norm_2(x[:2]), sigma=0.1)]
    return NonlinearModel(rate, np.eye(3) * 1e-3, 3, inputs=2, sensors=sensors, dt=0.1, continuous=True)


class TestArguments:
    def test_forms_that_do_not_fit_say_why(self):
        lower_rank = LinearModel(np.eye(2), [[1.0]], G=[[1.0], [0.0]], sensors=[Sensor("s", [[1.0, 0]], sigma=1.0)])
        with pytest.raises(FormError, match="F1 or F3"):
            Window(lower_rank, 2, form="F2")
        assert Window(lower_rank, 2).form_for("auto") == "F3"
        with pytest.raises(FormError, match="needs a gain"):
            Window(ring(), 2, form="P2")
        with pytest.raises(FormError, match="P1 or P2"):
            Window(ring(), 2, form="F2", gain=GAIN)
        with pytest.raises(FormError, match="nonlinear, use F1 or F2"):
            Window(unicycle(), 2, form="F3").compile()
        with pytest.raises(FormError, match="takes another form"):
            Window(ring(), 2, form="P2", gain=GAIN).compile("gauss-newton")
        with pytest.raises(UnknownNameError, match="F4"):
            Window(ring(), 2, form="F4")  # pyright: ignore[reportArgumentType]

    def test_other_arguments(self):
        with pytest.raises(SettingError, match="horizon"):
            Window(ring(), 0)
        with pytest.raises(SettingError, match="penalty"):
            Window(ring(), 2, penalty=-1.0)
        with pytest.raises(SettingError, match="no parameters"):
            Window(ring(), 2, estimate_parameters=True)
        with pytest.raises(UnknownNameError, match="frist"):
            Window(ring(), 2, losses={"frist": Huber()})
        with pytest.raises(ShapeError, match=r"\(4, 2\)"):
            Window(ring(), 2, gain=np.zeros((4, 4)))
        with pytest.raises(ShapeError, match="4 component"):
            Window(ring(), 2, state_bounds=Polyhedron.box([0.0], [1.0]))


class TestPolyhedron:
    def test_rows_without_bounds_are_left_out(self):
        assert BOX.matrix.shape == (3, 4)
        np.testing.assert_array_equal(BOX.components, [0, 2, 3])
        assert Polyhedron([[1.0, 1.0]], upper=1.0).components is None

    def test_empty_sets_are_refused(self):
        with pytest.raises(EmptyConstraintError, match="row 1"):
            Polyhedron.box([0.0, 2.0], [1.0, 1.0])
        with pytest.raises(EmptyConstraintError, match="all 2 rows"):
            Polyhedron([[1.0, 1.0], [-1.0, -1.0]], upper=[-1.0, 0.5])

    def test_bad_numbers_are_refused(self):
        with pytest.raises(DataError, match="NaN"):
            Polyhedron.box([np.nan], [1.0])
        with pytest.raises(ShapeError, match="2 rows"):
            Polyhedron(np.eye(2), upper=[1.0, 2.0, 3.0])

    def test_a_disturbance_set_without_zero_is_warned_of(self):
        with pytest.warns(ModelWarning, match="do not contain 0"):
            Window(ring(), 2, disturbance_bounds=Polyhedron.box([0.1] * 4, [1.0] * 4))
