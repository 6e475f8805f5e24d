"""Models: what they compute, linear, sampled and nonlinear."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from example_models import NOTHING, RING_A, RING_Q, X1, X3, ring, unicycle

from problems.errors import (
    DefinitionError,
    UnknownNameError,
)
from problems.models import (
    LinearModel,
    NonlinearModel,
    Sensor,
)


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


def test_import_stays_light():
    code = "import sys, problems.models; print(sorted({'scipy', 'pandas', 'gtsam'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
