"""Models: what they compute, what they refuse, how they simulate and what they report as observable."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from problems.errors import (
    DataError,
    DefinitionError,
    NoiseError,
    SettingError,
    ShapeError,
    UnknownNameError,
    UnobservableError,
)
from problems.models import (
    LinearModel,
    NonlinearModel,
    Sensor,
    observability,
    pair_observability,
    require_observable,
    simulate,
)

# the four-state example of dmhe-pre-estimation 6.1
RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
X1, X3, NOTHING = [1.0, 0, 0, 0], [0.0, 0, 1, 0], [0.0, 0, 0, 0]
BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def ring(**settings):
    sensors = [Sensor("first", [X1], sigma=1.0), Sensor("third", [X3], sigma=1.0)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, covariance=np.eye(4), **settings)


def unicycle_rate(x, u):
    return [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]]


def unicycle(**settings):
    ranges = [Sensor(f"range{k}", lambda x, c=c: ca.norm_2(x[:2] - c), sigma=0.1) for k, c in enumerate(BEACONS)]
    compass = Sensor("compass", lambda x: x[2], sigma=0.05, angles=[0], period=5)
    given = {
        "sensors": [*ranges, compass],
        "mean": [2.0, 1.0, 0.2],
        "covariance": np.diag([0.04, 0.04, 0.01]),
        "dt": 0.1,
        "continuous": True,
    } | settings
    return NonlinearModel(unicycle_rate, np.diag([1e-4, 1e-4, 1e-5]), 3, inputs=2, **given)


def turning(steps):
    return np.column_stack([np.linspace(0.5, 1.5, steps), 0.5 * np.sin(np.arange(steps) / 7)])


class TestLinear:
    def test_arrays_and_symbols_agree_with_the_matrices(self):
        B, G = np.array([[0.0], [1], [0], [2]]), np.eye(4)[:, :2]
        model = LinearModel(RING_A, np.eye(2), B, G, sensors=[Sensor("s", [X1, X3], sigma=[1, 2])])
        x, u = np.arange(4.0), np.array([3.0])
        np.testing.assert_allclose(model.step(x, u), RING_A @ x + B @ u, rtol=1e-15)
        np.testing.assert_array_equal(model.output(x, u), [0.0, 2.0])
        np.testing.assert_array_equal(model.transition_jacobian(x, u), RING_A)
        np.testing.assert_array_equal(model.output_jacobian(x, u), [X1, X3])
        np.testing.assert_array_equal(model.process_covariance, np.diag([1.0, 1, 0, 0]))
        np.testing.assert_array_equal(model.R, np.diag([1.0, 4.0]))
        xs, us = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
        both = ca.Function("both", [xs, us], [model.step(xs, us), model.output(xs, us), model.output_jacobian(xs, us)])
        step, output, jacobian = (np.asarray(value) for value in both(x, u))
        np.testing.assert_allclose(step[:, 0], model.step(x, u), rtol=1e-15)
        np.testing.assert_array_equal(output[:, 0], model.output(x, u))
        np.testing.assert_array_equal(jacobian, model.C)

    def test_symbolic_step_has_no_products_by_zero(self):
        model, x = ring(), ca.SX.sym("x", 4)
        assert ca.jacobian(model.step(x), x).nnz() == np.count_nonzero(RING_A)

    def test_results_are_independent_arrays(self):
        model = ring()
        first = model.step(np.ones(4))
        model.step(np.zeros(4))
        np.testing.assert_allclose(first, RING_A.sum(axis=1), rtol=1e-15)

    def test_sensors_stack_in_order_and_can_be_exchanged(self):
        model = ring()
        assert model.rows("third") == slice(1, 2)
        model.output(np.ones(4))
        blind = model.with_sensors([Sensor("none", [NOTHING], sigma=3.0)])
        np.testing.assert_array_equal(blind.C, [NOTHING])
        np.testing.assert_array_equal(blind.output(np.ones(4)), [0.0])
        np.testing.assert_array_equal(blind.R, [[9.0]])
        np.testing.assert_array_equal(model.output(np.ones(4)), [1.0, 1.0])
        assert model.with_sensors([]).measurement_size == 0
        with pytest.raises(UnknownNameError, match="did you mean third"):
            model.rows("thirt")

    def test_copies_and_pickles(self):
        model = ring()
        model.step(np.ones(4))
        for other in (copy.copy(model), pickle.loads(pickle.dumps(model))):
            np.testing.assert_array_equal(other.step(np.ones(4)), model.step(np.ones(4)))

    def test_arrays_cannot_be_changed_behind_the_derived_functions(self):
        model = ring()
        for array in (model.A, model.Q, model.C, model.R, model.G):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 5.0

    def test_prior(self):
        assert ring().prior()[0].tolist() == [0, 0, 0, 0]
        with pytest.raises(DefinitionError, match="mu_0, Pi_0"):
            LinearModel(RING_A, RING_Q, mean=np.ones(4)).prior()


class TestSampled:
    A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.3, 1.0], [0.0, 0.0, -2.0]])
    B = np.array([[0.0], [1.0], [0.5]])
    Qc = np.array([[0.5, 0.1], [0.1, 0.2]])
    G = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

    @pytest.mark.parametrize("dt", [0.05, 0.4, 6.0])
    def test_matches_numeric_integration(self, dt):
        from scipy.integrate import quad_vec, solve_ivp

        model = LinearModel.continuous(self.A, self.B, self.Qc, dt, G=self.G)
        transition = solve_ivp(
            lambda _, flat: (self.A @ flat.reshape(3, 3)).ravel(), (0, dt), np.eye(3).ravel(), rtol=1e-12, atol=1e-14,
            dense_output=True,
        )  # fmt: skip

        def at(t):
            return transition.sol(t).reshape(3, 3)

        noise = quad_vec(lambda t: at(t) @ self.G @ self.Qc @ self.G.T @ at(t).T, 0, dt, epsabs=1e-12)[0]
        held = quad_vec(lambda t: at(t) @ self.B, 0, dt, epsabs=1e-12)[0]
        np.testing.assert_allclose(model.A, at(dt), atol=1e-9)
        np.testing.assert_allclose(model.B, held, atol=1e-9)
        np.testing.assert_allclose(model.process_covariance, noise, atol=1e-9)

    def test_constant_velocity_has_its_known_covariance(self):
        h, q = 0.1, 0.5
        model = LinearModel.continuous([[0, 1], [0, 0]], None, q, h, G=[[0], [1]])
        np.testing.assert_allclose(model.Q, q * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]), rtol=1e-12)
        np.testing.assert_array_equal(model.G, np.eye(2))
        assert model.dt == h

    def test_constant_states_get_no_disturbance(self):
        A, G = np.zeros((3, 3)), np.array([[0.0], [1.0], [0.0]])
        A[0, 1] = 1.0
        model = LinearModel.continuous(A, None, 0.5, 0.1, G=G)
        assert model.disturbance_size == 2
        np.testing.assert_allclose(model.process_covariance[2], 0, atol=1e-18)
        np.testing.assert_allclose(model.process_covariance[1, 1], 0.05, rtol=1e-12)

    def test_fast_modes_do_not_overflow(self):
        model = LinearModel.continuous([[-1e4]], None, 1.0, 1.0)
        np.testing.assert_allclose(model.Q, 1 / 2e4, rtol=1e-10)


class TestNonlinear:
    def test_rk4_is_of_fourth_order_and_euler_of_first(self):
        from scipy.integrate import solve_ivp

        def rate(x, u):
            return [x[1], u[0] * ca.sin(x[0]) - 0.1 * x[1] ** 2]

        start, u = np.array([1.0, 0.3]), np.array([-2.0])
        exact = solve_ivp(
            lambda _, x: [x[1], u[0] * np.sin(x[0]) - 0.1 * x[1] ** 2], (0, 1), start, rtol=1e-13, atol=1e-13
        ).y[:, -1]

        def error(method, substeps):
            model = NonlinearModel(
                rate, np.eye(2), 2, inputs=1, dt=1.0, continuous=True, method=method, substeps=substeps
            )
            return np.linalg.norm(model.step(start, u) - exact)

        assert error("rk4", 8) / error("rk4", 16) == pytest.approx(16, rel=0.15)
        assert error("euler", 64) / error("euler", 128) == pytest.approx(2, rel=0.1)

    def test_jacobians_equal_finite_differences(self):
        model, rng = unicycle(), np.random.default_rng(3)
        x, u, h = rng.normal(size=3), np.array([1.2, 0.4]), 1e-6
        for function, jacobian in (
            (model.step, model.transition_jacobian),
            (model.output, model.output_jacobian),
        ):
            numeric = np.column_stack([(function(x + h * e, u) - function(x - h * e, u)) / (2 * h) for e in np.eye(3)])
            np.testing.assert_allclose(jacobian(x, u), numeric, atol=1e-8)

    def test_parameters_and_inputs_reach_functions_in_order(self):
        def dynamics(x, u, p):
            return x + p[0] * u + p[1]

        sensor = Sensor("y", lambda x, u, p: x[0] * p[1] + u[1], sigma=1.0)
        model = NonlinearModel(dynamics, np.eye(2), 2, inputs=2, parameters=2, sensors=[sensor])
        x, u, p = np.array([1.0, 2.0]), np.array([10.0, 20.0]), np.array([3.0, 5.0])
        np.testing.assert_array_equal(model.step(x, u, p), [36.0, 67.0])
        np.testing.assert_array_equal(model.output(x, u, p), [25.0])
        assert model.feedthrough and not unicycle().feedthrough
        xs = ca.SX.sym("x", 2)
        np.testing.assert_array_equal(np.asarray(ca.evalf(ca.substitute(model.step(xs, u, p), xs, x)))[:, 0], [36, 67])

    def test_parameters_without_inputs_are_the_second_argument(self):
        model = NonlinearModel(lambda x, p: x * p, np.eye(1), 1, parameters=1)
        assert model.step(np.array([3.0]), p=np.array([4.0])) == 12.0

    @pytest.mark.parametrize("symbol", [ca.SX, ca.MX])
    def test_expressions_over_own_symbols(self, symbol):
        position, speed, push = symbol.sym("position"), symbol.sym("speed"), symbol.sym("push", 2)
        state = ca.vertcat(position, speed)
        if symbol is ca.MX:
            state = ca.MX.sym("state", 2)
            position, speed = state[0], state[1]
        model = NonlinearModel(
            ca.vertcat(position + 0.1 * speed, speed - ca.sin(position) + push[1]),
            np.eye(2),
            state,
            inputs=push,
            sensors=[Sensor("both", position * speed, sigma=1.0), Sensor("second", [[0, 1.0]], sigma=1.0)],
        )
        x, u = np.array([0.3, 2.0]), np.array([7.0, 0.5])
        np.testing.assert_allclose(model.step(x, u), [0.5, 2.5 - np.sin(0.3)], rtol=1e-15)
        np.testing.assert_allclose(model.output(x, u), [0.6, 2.0], rtol=1e-15)
        sx = ca.SX.sym("x", 2)
        value = ca.Function("f", [sx], [model.step(sx, u)])(x)
        np.testing.assert_allclose(np.asarray(value)[:, 0], model.step(x, u), rtol=1e-15)

    def test_casadi_functions_serve_as_dynamics(self):
        x = ca.SX.sym("x", 2)
        model = NonlinearModel(ca.Function("f", [x], [x**2]), np.eye(2), 2)
        np.testing.assert_array_equal(model.step(np.array([2.0, 3.0])), [4.0, 9.0])

    def test_angles_wrap_in_numbers_and_symbols(self):
        model = unicycle()
        measured, predicted = np.array([1.0, 2, 3, 3.1]), np.array([1.5, 2, 3, -3.1])
        expected = [-0.5, 0, 0, 6.2 - 2 * np.pi]
        np.testing.assert_allclose(model.residual(measured, predicted), expected, atol=1e-15)
        np.testing.assert_allclose(model.residual(np.tile(measured, (5, 1)), predicted), np.tile(expected, (5, 1)))
        y = ca.SX.sym("y", 4)
        symbolic = ca.Function("r", [y], [model.residual(y, predicted)])
        np.testing.assert_allclose(np.asarray(symbolic(measured))[:, 0], expected, atol=1e-15)
        assert model.residual(np.array([0, 0, 0, np.pi]), np.zeros(4))[3] == np.pi
        assert np.isnan(model.residual(np.full(4, np.nan), predicted)).all()


class TestRefusals:
    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (ShapeError, "A", lambda: LinearModel(np.ones((2, 3)), np.eye(2))),
            (ShapeError, "A", lambda: LinearModel(np.ones(4), np.eye(2))),
            (DefinitionError, "A.*finite", lambda: LinearModel([[np.nan]], np.eye(1))),
            (DefinitionError, "A.*array of numbers", lambda: LinearModel("abc", np.eye(1))),
            (ShapeError, "B", lambda: LinearModel(np.eye(2), np.eye(2), B=np.ones((3, 1)))),
            (ShapeError, "G", lambda: LinearModel(np.eye(2), np.eye(1), G=np.ones((3, 1)))),
            (ShapeError, "Q", lambda: LinearModel(np.eye(2), np.eye(3))),
            (ShapeError, "Q.*numpy.diag", lambda: LinearModel(np.eye(2), [1.0, 1.0])),
            (NoiseError, "Q.*finite", lambda: LinearModel(np.eye(2), np.diag([1, np.nan]))),
            (NoiseError, "Q.*symmetric", lambda: LinearModel(np.eye(2), [[1, 0.1], [0, 1]])),
            (NoiseError, "Q.*positive definite", lambda: LinearModel(np.eye(2), np.diag([1.0, -1.0]))),
            (NoiseError, "Q.*positive definite", lambda: LinearModel(np.eye(2), [[1, 2], [2, 1]])),
            # target-tracking-dkns (3.23): rank two, but for rounding
            (NoiseError, "gain G", lambda: LinearModel(np.eye(2), [[0.07**2 / 4, 0.035], [0.035, 1.0]])),
            (NoiseError, "Pi_0", lambda: LinearModel(np.eye(2), np.eye(2), covariance=np.zeros((2, 2)))),
            (ShapeError, "mu_0", lambda: LinearModel(np.eye(2), np.eye(2), mean=[0, 0, 0])),
            (DefinitionError, "state_names", lambda: ring(state_names=["a", "b", "c", "a"])),
            (DefinitionError, "dt", lambda: ring(dt=-1.0)),
            (DefinitionError, "dt", lambda: LinearModel.continuous(np.eye(1), None, 1.0, 0.0)),
            (NoiseError, "Qc", lambda: LinearModel.continuous(np.eye(2), None, np.zeros((2, 2)), 1.0)),
            (ShapeError, "'s'.*C", lambda: LinearModel(np.eye(2), np.eye(2), sensors=[Sensor("s", [X1], sigma=1)])),
            (
                DefinitionError,
                "NonlinearModel",
                lambda: LinearModel(np.eye(2), np.eye(2), sensors=[Sensor("s", lambda x: x, sigma=1)]),
            ),
            (DefinitionError, "differ", lambda: ring().with_sensors([Sensor("s", [X1], sigma=1.0)] * 2)),
        ],
    )
    def test_linear(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (NoiseError, "exactly one", lambda: Sensor("s", [X1])),
            (NoiseError, "exactly one", lambda: Sensor("s", [X1], sigma=1.0, covariance=[[1.0]])),
            (NoiseError, "R.*definite", lambda: Sensor("s", [X1, X3], covariance=[[1, 1], [1, 1]])),
            (NoiseError, "sigma.*positive", lambda: Sensor("s", [X1], sigma=0.0)),
            (NoiseError, "sigma.*positive", lambda: Sensor("s", [X1], sigma=np.nan)),
            (ShapeError, "sigma", lambda: Sensor("s", [X1], sigma=[1.0, 2.0])),
            (ShapeError, "R", lambda: Sensor("s", [X1, X3], covariance=np.eye(3))),
            (ShapeError, "C", lambda: Sensor("s", X1, sigma=1.0)),
            (DefinitionError, "C.*finite", lambda: Sensor("s", [[np.inf]], sigma=1.0)),
            (DefinitionError, "angles", lambda: Sensor("s", [X1], sigma=1.0, angles=[1])),
            (SettingError, "period", lambda: Sensor("s", [X1], sigma=1.0, period=0)),
        ],
    )
    def test_sensor(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    @pytest.mark.parametrize(
        ("error", "message", "build"),
        [
            (ShapeError, "dynamics.*2 components", lambda: NonlinearModel(lambda x: x[0], np.eye(2), 2)),
            (ShapeError, "column", lambda: NonlinearModel(lambda x: x.T, np.eye(2), 2)),
            (DefinitionError, "takes 2 argument", lambda: NonlinearModel(lambda x, u: x, np.eye(2), 2)),
            (DefinitionError, "takes 0 argument", lambda: NonlinearModel(lambda: 1, np.eye(1), 1)),
            (DefinitionError, "failed on CasADi", lambda: NonlinearModel(lambda x: 1 / 0, np.eye(1), 1)),
            (DefinitionError, "got object", lambda: NonlinearModel(lambda x: object(), np.eye(1), 1)),
            (DefinitionError, "function or", lambda: NonlinearModel("x", np.eye(1), 1)),
            (DefinitionError, "stray", lambda: NonlinearModel(lambda x: x + ca.SX.sym("stray"), np.eye(1), 1)),
            (DefinitionError, "mixes", lambda: NonlinearModel(ca.MX.sym("m"), np.eye(1), 1)),
            (DefinitionError, "states", lambda: NonlinearModel(lambda x: x, np.eye(1), 0)),
            (DefinitionError, "inputs", lambda: NonlinearModel(lambda x: x, np.eye(1), 1, inputs=-1)),
            (DefinitionError, "states", lambda: NonlinearModel(lambda x: x, np.eye(1), ca.SX.sym("x") ** 2)),
            (
                DefinitionError,
                "all be",
                lambda: NonlinearModel(lambda x: x, np.eye(1), ca.SX.sym("x"), inputs=ca.MX.sym("u")),
            ),
            (DefinitionError, "dt", lambda: unicycle(dt=None)),
            (SettingError, "method", lambda: unicycle(method="rk5")),
            (SettingError, "substeps", lambda: unicycle(substeps=0)),
            (DefinitionError, "'s'.*failed", lambda: unicycle(sensors=[Sensor("s", lambda x: x[7], sigma=1.0)])),
            (ShapeError, "sigma", lambda: unicycle(sensors=[Sensor("s", lambda x: x[:2], sigma=[1, 2, 3])])),
        ],
    )
    def test_nonlinear(self, error, message, build):
        with pytest.raises(error, match=message):
            build()

    def test_calls(self):
        model = unicycle()
        with pytest.raises(DataError, match="input"):
            model.step(np.zeros(3))
        with pytest.raises(ShapeError, match="state"):
            model.step(np.zeros(4), np.zeros(2))
        with pytest.raises(ShapeError, match="state"):
            model.step(ca.SX.sym("x", 4), np.zeros(2))
        with pytest.raises(ShapeError, match="parameters"):
            model.step(np.zeros(3), np.zeros(2), np.zeros(1))


class TestSimulate:
    def test_same_seed_same_bytes(self):
        for model, inputs in ((ring(), None), (unicycle(), turning(20))):
            draws = [simulate(model, 20, np.random.default_rng(7), inputs=inputs, trials=3) for _ in range(2)]
            other = simulate(model, 20, np.random.default_rng(8), inputs=inputs, trials=3)
            for name in ("states", "measurements", "disturbances"):
                first, second = (getattr(draw, name).tobytes() for draw in draws)
                assert first == second != getattr(other, name).tobytes()

    def test_trajectories_obey_the_model(self):
        B = np.array([[0.0], [1], [0], [2]])
        linear = LinearModel(RING_A, np.eye(2), B, np.eye(4)[:, :2], sensors=ring().sensors, covariance=np.eye(4))
        for model, inputs in ((linear, np.arange(10.0)[:, None]), (unicycle(), turning(10))):
            run = simulate(model, 10, np.random.default_rng(0), inputs=inputs)
            expected = [model.step(run.states[k], inputs[k]) + model.G @ run.disturbances[k] for k in range(10)]
            np.testing.assert_allclose(run.states[1:], expected, rtol=1e-13, atol=1e-13)
            assert run.measurements.shape == (11, model.measurement_size)

    def test_statistics_are_those_of_the_model(self):
        trials, steps = 20_000, 3
        R = np.array([[0.5, 0.2], [0.2, 0.3]])
        Q = np.array([[0.4, -0.1], [-0.1, 0.2]])
        P0 = np.array([[2.0, 0.6], [0.6, 1.0]])
        A = np.array([[0.9, 0.2], [-0.1, 0.8]])
        model = LinearModel(A, Q, sensors=[Sensor("s", np.eye(2), covariance=R)], mean=[1.0, -2.0], covariance=P0)
        run = simulate(model, steps, np.random.default_rng(1), trials=trials)
        assert run.states.shape == (trials, steps + 1, 2)
        predicted = A @ P0 @ A.T + Q
        for sample, mean, covariance in (
            (run.states[:, 0], model.mean, P0),
            (run.states[:, 1], A @ model.mean, predicted),
            (run.disturbances[:, 2], np.zeros(2), Q),
            (run.measurements[:, 1] - run.states[:, 1], np.zeros(2), R),
        ):
            deviation = np.sqrt(np.diag(covariance) / trials)
            np.testing.assert_array_less(np.abs(sample.mean(axis=0) - mean), 5 * deviation)
            spread = np.sqrt((np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2) / trials)
            np.testing.assert_array_less(np.abs(np.cov(sample.T) - covariance), 5 * spread)
        white = run.disturbances.reshape(trials, -1)
        assert np.abs(np.corrcoef(white.T)[:2, 2:4]).max() < 5 / np.sqrt(trials)

    def test_periods_and_angles(self):
        model = unicycle(mean=[2.0, 1.0, 3.1])
        run = simulate(model, 40, np.random.default_rng(2), inputs=np.tile([1.0, 1.0], (40, 1)))
        heading = run.measurements[:, model.rows("compass")][:, 0]
        assert np.flatnonzero(np.isfinite(heading)).tolist() == list(range(0, 41, 5))
        assert np.isfinite(run.measurements[:, :3]).all()
        assert run.states[-1, 2] > np.pi >= np.nanmax(np.abs(heading))

    def test_outputs_see_the_input_that_acted_before(self):
        sensor = Sensor("speed", lambda x, u: u[0], sigma=1e-9)
        model = NonlinearModel(lambda x, u: x + u, np.eye(1), 1, inputs=1, sensors=[sensor], covariance=np.eye(1))
        run = simulate(model, 3, np.random.default_rng(0), inputs=[[5.0], [6.0], [7.0]])
        np.testing.assert_allclose(run.measurements[:, 0], [5, 5, 6, 7], atol=1e-7)

    def test_start_and_times(self):
        start = np.arange(8.0).reshape(2, 4)
        run = simulate(ring(dt=0.5), 2, np.random.default_rng(0), initial=start, trials=2)
        np.testing.assert_array_equal(run.states[:, 0], start)
        np.testing.assert_array_equal(run.times, [0, 0.5, 1.0])

    @pytest.mark.parametrize(
        ("error", "message", "call"),
        [
            (SettingError, "steps", lambda rng: simulate(ring(), 0, rng)),
            (SettingError, "trials", lambda rng: simulate(ring(), 1, rng, trials=0)),
            (SettingError, "rng.*default_rng", lambda rng: simulate(ring(), 1, np.random)),
            (DataError, "inputs", lambda rng: simulate(unicycle(), 1, rng)),
            (ShapeError, "inputs", lambda rng: simulate(unicycle(), 2, rng, inputs=np.zeros((1, 2)))),
            (DataError, "inputs", lambda rng: simulate(unicycle(), 1, rng, inputs=[[np.nan, 0]])),
            (ShapeError, "initial", lambda rng: simulate(ring(), 1, rng, initial=np.zeros(3))),
            (DefinitionError, "prior", lambda rng: simulate(LinearModel(RING_A, RING_Q), 1, rng)),
        ],
    )
    def test_refusals(self, error, message, call):
        with pytest.raises(error, match=message):
            call(np.random.default_rng(0))

    @pytest.mark.filterwarnings("ignore::RuntimeWarning")
    def test_divergence_is_not_a_missing_measurement(self):
        model = NonlinearModel(lambda x: x**3, np.eye(1), 1)
        with pytest.raises(DataError, match="finite at instant"):
            simulate(model, 50, np.random.default_rng(0), initial=[9.0])


class TestObservability:
    def test_ring_nodes(self):
        # dmhe-pre-estimation 6.1: regional outputs of nodes 1 to 4
        regional = {1: [X1, X3], 2: [X1, X1], 3: [X1, X3], 4: [X3, X3]}
        reports = {node: pair_observability(RING_A, C, horizon=5) for node, C in regional.items()}
        assert {node: report.rank for node, report in reports.items()} == {1: 4, 2: 2, 3: 4, 4: 2}
        assert [reports[n].classification for n in (1, 2, 3, 4)] == ["observable", "partly", "observable", "detectable"]
        np.testing.assert_allclose(reports[2].unobservable_eigenvalues, [0.99 + 0.4795j, 0.99 - 0.4795j], atol=5e-5)
        np.testing.assert_allclose(reports[4].unobservable_eigenvalues, [0.9264, 0.4517], atol=5e-5)
        assert reports[1].unobservable_eigenvalues.size == 0
        assert reports[2].detectable is False and reports[4].detectable is True
        assert reports[2].directions() == ("x3", "x4") and reports[4].directions() == ("x1", "x2")
        assert reports[1].index == reports[2].index == 2

    def test_blind_node(self):
        for C in ([NOTHING], np.zeros((0, 4))):
            report = pair_observability(RING_A, C)
            assert (report.classification, report.rank, report.index) == ("blind", 0, 0)
            assert len(report.unobservable_eigenvalues) == 4

    def test_short_horizon_counts_fewer_rows(self):
        report = pair_observability(RING_A, [X1, X3], horizon=1)
        assert report.rank == 2 and report.classification == "observable" and report.index == 2

    def test_integrator_that_nothing_sees_is_not_detectable(self):
        report = pair_observability(np.diag([0.5, 1.0]), [[1.0, 0.0]])
        assert report.classification == "partly" and report.detectable is False
        for seed in range(20):  # rounding may put the eigenvalue inside the unit circle
            T = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
            assert pair_observability(T @ np.diag([0.5, 0.7, 1.0]) @ T.T, T[:, :1].T).detectable is False

    @pytest.mark.parametrize("seed", range(20))
    def test_agrees_with_the_observability_matrix_in_any_coordinates(self, seed):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 7))
        seen = int(rng.integers(1, n + 1))
        A = np.zeros((n, n))
        A[:seen, :seen] = rng.normal(size=(seen, seen))
        A[seen:] = rng.normal(size=(n - seen, n))
        C = np.pad(rng.normal(size=(int(rng.integers(1, 3)), seen)), ((0, 0), (0, n - seen)))
        T = np.linalg.qr(rng.normal(size=(n, n)))[0]
        hidden = np.sort_complex(np.linalg.eigvals(A[seen:, seen:]))
        A, C = T @ A @ T.T, C @ T.T
        for horizon in range(1, n + 2):
            rows = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(horizon)])
            assert pair_observability(A, C, horizon).rank == np.linalg.matrix_rank(rows, rtol=1e-9)
        report = pair_observability(A, C)
        np.testing.assert_allclose(np.sort_complex(report.unobservable_eigenvalues), hidden, atol=1e-8)
        np.testing.assert_allclose(C @ A @ report.unobservable_basis, 0, atol=1e-9)

    def test_long_chain_of_slow_and_small_modes(self):
        # the observability matrix of thirty decaying modes is numerically singular, the pair is not
        n = 30
        A = np.diag(np.linspace(0.1, 0.5, n)) + np.diag(np.full(n - 1, 0.3), 1)
        C = np.eye(n)[:1]
        rows = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(n)])
        assert np.linalg.matrix_rank(rows, rtol=1e-9) < n
        assert pair_observability(A, C).classification == "observable"

    def test_nonlinear_window(self):
        model = unicycle()
        run = simulate(model, 10, np.random.default_rng(0), inputs=turning(10))
        assert observability(model, trajectory=run).classification == "observable"
        one = model.with_sensors([Sensor("heading", lambda x: x[2], sigma=0.1)])
        report = observability(one, trajectory=run)
        assert (report.classification, report.rank, report.detectable) == ("partly", 1, None)
        assert report.directions() == ("x1", "x2")
        # one range at one instant sees one direction, three instants of motion see position and heading
        single = model.with_sensors(model.sensors[:1])
        assert observability(single, 1, trajectory=run).rank == 1
        assert observability(single, 4, trajectory=run).rank == 3
        assert observability(single, 4, trajectory=run).index == 3

    def test_windows_see_the_input_that_acted_before(self):
        sensor = Sensor("s", lambda x, u: u * x, sigma=1.0)
        model = NonlinearModel(lambda x, u: x, np.eye(1), 1, inputs=1, sensors=[sensor], covariance=np.eye(1))
        run = simulate(model, 3, np.random.default_rng(0), inputs=[[0.0], [1.0], [1.0]])
        assert [observability(model, k, trajectory=run).rank for k in (1, 2, 3)] == [0, 0, 1]

    def test_nonlinear_window_of_a_linear_model_is_the_pair(self):
        for C in ([X1, X3], [X1], [NOTHING]):
            sensors = [Sensor("s", C, sigma=1.0)]
            model = NonlinearModel(lambda x: ca.mtimes(ca.DM(RING_A), x), RING_Q, 4, sensors=sensors, mean=np.ones(4))
            window, pair = observability(model), observability(LinearModel(RING_A, RING_Q, sensors=sensors))
            assert (window.rank, window.index, window.directions()) == (pair.rank, pair.index, pair.directions())

    def test_unobservable_error_names_the_directions(self):
        model = ring(state_names=["a", "b", "c", "d"])
        assert require_observable(observability(model)).rank == 4
        node = observability(model.with_sensors(model.sensors[:1]))
        with pytest.raises(UnobservableError, match=r"node 2 .*determines c, d .*0\.99\+0\.4795j"):
            require_observable(node, "node 2")
        difference = pair_observability(np.eye(2), [[1.0, 1.0]])
        with pytest.raises(UnobservableError, match="x1 - x2"):
            require_observable(difference)

    @pytest.mark.parametrize(
        ("error", "message", "call"),
        [
            (ShapeError, "A", lambda: pair_observability(np.ones((2, 3)), [[1, 0]])),
            (ShapeError, "C", lambda: pair_observability(np.eye(2), [[1, 0, 0]])),
            (DefinitionError, "finite", lambda: pair_observability([[np.nan]], [[1.0]])),
            (SettingError, "horizon", lambda: pair_observability(np.eye(1), [[1.0]], 0)),
            (ShapeError, "state_names", lambda: pair_observability(np.eye(1), [[1.0]], state_names=["a", "b"])),
            (DefinitionError, "trajectory", lambda: observability(unicycle())),
            (DefinitionError, "prior", lambda: observability(NonlinearModel(lambda x: x, np.eye(1), 1))),
            (
                DataError,
                "at least 20",
                lambda: observability(
                    unicycle(), 20, trajectory=simulate(unicycle(), 5, np.random.default_rng(0), inputs=turning(5))
                ),
            ),
        ],
    )
    def test_refusals(self, error, message, call):
        with pytest.raises(error, match=message):
            call()


def test_import_stays_light():
    code = "import sys, problems.models; print(sorted({'scipy', 'pandas', 'gtsam'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
