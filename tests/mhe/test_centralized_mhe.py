"""The centralized estimators: bounds, infeasible windows, late and missing data, nonlinear models, real time."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from mhe import Estimator, ExtendedKalmanFilter, KalmanFilter, MovingHorizonEstimator, Polyhedron, mhe, mhe_pre
from problems import Huber, LinearModel, NonlinearModel, Sensor, simulate
from problems.errors import DataError, SettingError, ShapeError, UnobservableError, UnstableError
from problems.solvers.base import Status

RING_A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
RING_Q = np.diag([0.0012, 0.038, 0.0012, 0.038])


def ring(**settings):
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=1.0), Sensor("third", [[0, 0, 1.0, 0]], sigma=0.5)]
    return LinearModel(RING_A, RING_Q, sensors=sensors, **({"covariance": np.eye(4)} | settings))


def deadbeat():
    return LinearModel([[1.0]], [[1.0]], sensors=[Sensor("s", [[1.0]], sigma=1.0)], covariance=[[1.0]])


BEACONS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def unicycle(**settings):
    def rate(x, u):
        return [u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]]

    ranges = [Sensor(f"range{k}", lambda x, c=c: ca.norm_2(x[:2] - c), sigma=0.1) for k, c in enumerate(BEACONS)]
    given = {
        "sensors": [*ranges, Sensor("compass", lambda x: x[2], sigma=0.05, angles=[0], period=5)],
        "mean": [2.0, 1.0, 0.2],
        "covariance": np.diag([0.5, 0.5, 0.3]),
        "dt": 0.1,
    }
    return NonlinearModel(rate, np.diag([1e-4, 1e-4, 1e-5]), 3, inputs=2, continuous=True, **(given | settings))


def drive(model, steps, seed):
    u = np.column_stack([np.full(steps, 1.0), 0.5 * np.sin(np.arange(steps) / 8)])
    return simulate(model, steps, np.random.default_rng(seed), inputs=u)


def replay(estimator, run):
    inputs = [None, *run.inputs] if run.inputs.shape[1] else [None] * len(run.measurements)
    return [estimator.step(y, u) for y, u in zip(run.measurements, inputs, strict=True)]


def states(estimates):
    return np.array([estimate.state for estimate in estimates])


def rms(error):
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


class TestProtocol:
    def test_it_is_an_estimator_and_tells_its_options(self):
        estimator = mhe(ring(dt=0.5), 3, losses={"first": Huber(2.0)}, tolerance=1e-7)
        assert isinstance(estimator, Estimator)
        expected = {"disturbance": "process_noise", "prior": "filter", "form": "F2", "horizon": 3, "tolerance": 1e-7}
        assert expected.items() <= estimator.options.items()
        assert {"disturbance": "pre_estimation", "prior": "seed", "form": "P2"}.items() <= mhe_pre(
            ring()
        ).options.items()
        estimator.step([0.0, np.nan])
        estimate = estimator.step(None)
        assert estimate.missing == (0, 1) and estimate.time == 0.5 and estimate.seconds > 0
        row = estimate.to_pandas()
        assert row["sigma_x1"].iloc[0] == pytest.approx(np.sqrt(estimate.covariance[0, 0]))
        assert repr(estimate).startswith("WindowEstimate at 0.5 s: solved")

    def test_windows_grow_and_then_slide(self):
        model = ring()
        run = simulate(model, 8, np.random.default_rng(0))
        found = replay(mhe(model, 3), run)
        assert [len(estimate.window) for estimate in found] == [1, 2, 3, 4, 4, 4, 4, 4, 4]
        for estimate in found:
            np.testing.assert_array_equal(estimate.window[-1], estimate.state)

    def test_reset_repeats_to_the_bit(self):
        model = unicycle()
        run = drive(model, 25, 0)
        estimator = mhe(model, 4)
        first, again, other = (
            replay(estimator, run),
            (estimator.reset(), replay(estimator, run))[1],
            replay(mhe(model, 4), run),
        )
        assert states(first).tobytes() == states(again).tobytes() == states(other).tobytes()

    def test_reset_forgets_the_start_of_a_solver(self):
        model = ring()
        run = simulate(model, 25, np.random.default_rng(3))
        options = {"solver": "osqp", "state_bounds": Polyhedron.box([-1.0] * 4, [1.0] * 4), "tolerance": 1e-4}
        estimator = mhe(model, 4, **options)
        first, again = replay(estimator, run), (estimator.reset(), replay(estimator, run))[1]
        assert states(first).tobytes() == states(again).tobytes()

    @pytest.mark.parametrize("horizon", [1, 3])
    def test_results_do_not_share_memory_with_the_estimator(self, horizon):
        model = ring()
        run = simulate(model, 12, np.random.default_rng(0))
        expected = states(replay(mhe(model, horizon, prior="seed"), run))
        estimator, found = mhe(model, horizon, prior="seed"), []
        for y in run.measurements:
            given = y.copy()
            estimate = estimator.step(given)
            found.append(estimate.state.copy())
            given[:] = estimate.window[:] = estimate.state[:] = 1e3
        np.testing.assert_array_equal(found, expected)

    def test_without_the_first_update_the_prior_is_reported(self):
        model = ring(mean=[1.0, 2.0, 3.0, 4.0])
        run = simulate(model, 6, np.random.default_rng(1))
        reported = replay(mhe(model, 2, initial_update=False), run)
        updated = replay(mhe(model, 2), run)
        np.testing.assert_array_equal(reported[0].state, model.mean)
        np.testing.assert_array_equal(reported[0].covariance, model.covariance)
        np.testing.assert_allclose(states(reported)[1:], states(updated)[1:], atol=1e-10)

    def test_bad_arguments_name_themselves(self):
        estimator = mhe(ring(), 2)
        with pytest.raises(ShapeError, match=r"\(2,\)"):
            estimator.step([1.0])
        with pytest.raises(DataError, match="component 1 is infinite"):
            estimator.step([0.0, np.inf])
        estimator.step([0.0, 0.0], time=3.0)
        with pytest.raises(DataError, match="later than"):
            estimator.step([0.0, 0.0], time=3.0)
        with pytest.raises(DataError, match="needs 2"):
            moving = mhe(unicycle(), 2)
            moving.step(np.zeros(4))
            moving.step(np.zeros(4))
        with pytest.raises(SettingError, match="mhe_pre"):
            mhe(ring(), 2, gain=np.zeros((4, 2)))
        with pytest.raises(SettingError, match="pass gain="):
            mhe_pre(unicycle(), 2)

    def test_models_and_gains_without_hope_are_refused(self):
        blind = ring().with_sensors([Sensor("first", [[1.0, 0, 0, 0]], sigma=1.0)])
        with pytest.raises(UnobservableError, match="x3"):
            mhe(blind, 3)
        assert isinstance(mhe(blind, 3, require_sound=False), MovingHorizonEstimator)
        with pytest.raises(UnstableError, match="spectral radius 1.1"):
            mhe_pre(ring(), 3, gain=np.zeros((4, 2)))
        with pytest.warns(match="spectral radius 1.1"):
            mhe_pre(ring(), 3, gain=np.zeros((4, 2)), require_sound=False)


class TestPreEstimation:
    def test_forms_agree_and_the_observer_is_approached(self):
        model = ring()
        run = simulate(model, 60, np.random.default_rng(2))
        P1, P2 = (states(replay(mhe_pre(model, 5, form=form), run)) for form in ("P1", "P2"))
        np.testing.assert_allclose(P1, P2, atol=1e-8)
        estimator = mhe_pre(model, 40)
        gain, x, observer = estimator.window.gain, np.zeros(4), []
        for y in run.measurements:
            observer.append(x)
            x = RING_A @ x + gain @ (y - model.C @ x)
        difference = [np.abs(states(replay(mhe_pre(model, N), run))[50:] - observer[50:]).max() for N in (5, 40)]
        assert difference[1] < 0.01 < difference[0]

    def test_missing_components_add_nothing_to_the_observer(self):
        model = ring()
        run = simulate(model, 30, np.random.default_rng(3))
        run.measurements[10:14, 1] = np.nan
        for estimate in replay(mhe_pre(model, 3), run)[3:]:
            assert estimate.solution.solved and np.isfinite(estimate.state).all()
            assert estimate.covariance is None


class TestBounds:
    def test_active_bounds_hold_and_help(self):
        model = ring()
        rng = np.random.default_rng(5)
        gained, active, steps = 0.0, 0, 0
        for _ in range(5):
            run = simulate(model, 25, rng)
            reach = np.abs(run.states).max(axis=0)
            box = Polyhedron.box(-reach, reach)
            free = replay(mhe(model, 5), run)
            bounded = replay(mhe(model, 5, state_bounds=box), run)
            for estimate in bounded:
                assert estimate.status == "solved"
                assert box.violation(estimate.window) < 1e-8
                active += bool(estimate.solution.active_set["state bounds"].any())
            steps += len(bounded)
            gained += rms(states(free) - run.states) - rms(states(bounded) - run.states)
        assert active > 0.05 * steps
        assert gained > 0

    def test_every_solver_gives_the_same_run(self):
        model = ring()
        run = simulate(model, 20, np.random.default_rng(7))
        box = Polyhedron.box([-1.5] * 4, [1.5] * 4)
        expected = states(replay(mhe(model, 4, state_bounds=box, infeasible="soft"), run))
        for solver in ("daqp", "quadprog", "clarabel", "gauss-newton", "ipopt"):
            found = states(replay(mhe(model, 4, state_bounds=box, solver=solver, infeasible="soft"), run))
            np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=solver)

    def test_a_deadbeat_observer_can_leave_no_sequence_and_soft_bounds_answer(self):
        # A = C = L = 1 and x <= 0: any y_k > 0 puts x_{k+1} = y_k outside, whatever x_s is
        at_most_zero = {"state_bounds": Polyhedron.box([-np.inf], [0.0])}
        run = [-1.0, 2.0, -1.0, -1.0, -1.0]
        hard = mhe_pre(deadbeat(), 2, gain=[[1.0]], **at_most_zero)
        soft = mhe_pre(deadbeat(), 2, gain=[[1.0]], infeasible="soft", **at_most_zero)
        noise = mhe(deadbeat(), 2, **at_most_zero)
        statuses = []
        for y in run:
            estimates = [estimator.step([y]) for estimator in (hard, soft, noise)]
            statuses.append([str(estimate.status) for estimate in estimates])
            assert all(np.isfinite(estimate.state).all() for estimate in estimates)
            assert estimates[2].window.max() <= 1e-8
            if estimates[0].status == "infeasible":
                assert estimates[0].infeasible == estimates[1].infeasible == ("state bounds",)
        assert [row[0] for row in statuses] == ["solved", "solved", "infeasible", "infeasible", "solved"]
        assert [row[1] for row in statuses] == [row[0] for row in statuses]
        assert all(row[2] == "solved" for row in statuses)

    @pytest.mark.parametrize("prior", ["filter", "smoothing", "seed"])
    def test_without_any_solution_the_model_predicts(self, prior):
        # x2 cannot stay above 1 while |w| is small
        model = ring(mean=[1.5, 1.5, 0, 0])
        bounds = {
            "state_bounds": Polyhedron.box([1, 1, -np.inf, -np.inf], [2, 2, np.inf, np.inf]),
            "disturbance_bounds": Polyhedron.box([-1e-2] * 4, [1e-2] * 4),
        }
        found = replay(mhe(model, 3, prior=prior, **bounds), simulate(model, 8, np.random.default_rng(8)))
        assert [str(estimate.status) for estimate in found] == ["solved"] + 8 * ["infeasible"]
        for before, estimate in zip(found, found[1:], strict=False):
            assert estimate.infeasible == ("state bounds", "disturbance bounds") and estimate.covariance is None
            np.testing.assert_allclose(estimate.state, RING_A @ before.state, atol=1e-12)
            np.testing.assert_allclose(estimate.window[:-1], before.window[-3:], atol=1e-12)

    def test_the_soft_answer_is_the_one_of_a_window_with_slacks(self):
        estimator = mhe_pre(
            deadbeat(), 2, gain=[[1.0]], state_bounds=Polyhedron.box([-np.inf], [0.0]), infeasible="soft", penalty=1e3
        )
        for y in (-1.0, 2.0, -1.0):
            estimate = estimator.step([y])
        # x_1 = -1 and x_2 = 2 follow from the data whatever x_0 is
        np.testing.assert_allclose(estimate.window[1:, 0], [-1.0, 2.0], atol=1e-8)


class TestLateMeasurements:
    @pytest.mark.parametrize(("prior", "delay"), [("filter", 1), ("filter", 4), ("seed", 1), ("smoothing", 3)])
    def test_within_the_window_they_count_as_if_they_had_been_on_time(self, prior, delay):
        model, N = ring(), 3
        run = simulate(model, 30, np.random.default_rng(9))
        on_time = replay(mhe(model, N, prior=prior), run)
        estimator, found = mhe(model, N, prior=prior), []
        for t, y in enumerate(run.measurements):
            given, late = y.copy(), []
            if t == 12:
                given[0] = np.nan
            if t == 12 + delay:
                late = [(12.0, [run.measurements[12, 0], np.nan])]
            found.append(estimator.step(given, late=late))
        assert found[12].missing == (0,) and found[12 + delay].late == (12.0,)
        assert np.abs(found[12].state - on_time[12].state).max() > 1e-4
        later = np.abs(states(found) - states(on_time))[12 + delay :].max(axis=1)
        if prior == "seed":  # its reference came from a window without the measurement, an error that dies out
            assert later[-1] < 0.3 * np.abs(found[12].state - on_time[12].state).max()
        else:
            assert later.max() < 1e-9

    def test_too_late_ones_are_reported_and_change_nothing(self):
        model = ring()
        run = simulate(model, 20, np.random.default_rng(0))
        expected = states(replay(mhe(model, 3), run))
        estimator, found = mhe(model, 3), []
        for t, y in enumerate(run.measurements):
            found.append(estimator.step(y, late=[(7.0, [50.0, 50.0])] if t == 12 else ()))
        assert found[12].too_late == (7.0,) and found[12].late == ()
        np.testing.assert_array_equal(states(found), expected)

    def test_times_between_instants_and_ahead_of_them_are_refused(self):
        estimator = mhe(ring(dt=0.5), 3)
        for time in (0.0, 0.5, 4.0):
            estimator.step([0.0, 0.0], time=time)
        for wrong in (2.0, 9.0):
            with pytest.raises(DataError, match="none of the instants"):
                estimator.step([0.0, 0.0], time=4.5, late=[(wrong, [0.0, 0.0])])
        estimate = estimator.step([0.0, 0.0], time=4.5, late=[(0.6, [1.0, 1.0])])
        assert estimate.late == (0.6,)


class TestNonlinear:
    def test_it_does_no_worse_than_the_extended_filter_and_converges_to_the_batch_solution(self):
        model = unicycle()
        errors = {"ekf": [], "mhe": []}
        for seed in range(4):
            run = drive(model, 60, seed)
            found = replay(mhe(model, 10), run)
            assert all(estimate.status == "solved" for estimate in found)
            errors["mhe"].append(rms(states(found) - run.states))
            extended = states(replay(ExtendedKalmanFilter(model), run))
            errors["ekf"].append(rms(extended - run.states))
            whole = replay(mhe(model, 60), run)[-1].state
            assert np.abs(found[-1].state - whole).max() < 1e-4
            assert np.abs(found[-1].state - whole).max() < np.abs(extended[-1] - whole).max()
        assert np.mean(errors["mhe"]) <= 1.01 * np.mean(errors["ekf"])

    def test_forms_and_solvers_agree(self):
        model = unicycle()
        run = drive(model, 15, 1)
        expected = states(replay(mhe(model, 4), run))
        np.testing.assert_allclose(states(replay(mhe(model, 4, form="F1"), run)), expected, atol=1e-6)
        np.testing.assert_allclose(states(replay(mhe(model, 4, solver="ipopt"), run)), expected, atol=1e-6)

    def test_one_iteration_stays_close_to_the_converged_solution(self):
        model = unicycle(covariance=np.diag([0.1, 0.1, 0.05]))
        run = drive(model, 60, 2)
        converged, one = (states(replay(mhe(model, 8, iterations=k), run)) for k in (None, 1))
        assert rms((one - converged)[10:]) < 1e-3
        assert np.abs(one - converged).max() > 1e-9

    def test_preparation_and_feedback_are_the_step_of_one_iteration(self):
        model = unicycle()
        run = drive(model, 40, 3)
        run.measurements[20:24, 1] = np.nan
        expected = replay(mhe(model, 6, iterations=1), run)
        estimator = mhe(model, 6, iterations=1)
        found = [estimator.step(run.measurements[0])]
        for y, u in zip(run.measurements[1:], run.inputs, strict=True):
            estimator.prepare(u)
            found.append(estimator.step(y))
        np.testing.assert_allclose(states(found), states(expected), atol=1e-10)
        with pytest.raises(DataError, match="once between"):
            estimator.prepare(u), estimator.prepare(u)
        with pytest.raises(DataError, match="prepared with"):
            estimator.step(y, u + 1)

    def test_preparation_changes_nothing_of_a_linear_step(self):
        model = ring()
        run = simulate(model, 20, np.random.default_rng(4))
        run.measurements[5:8, 0] = np.nan
        expected = states(replay(mhe(model, 3), run))
        estimator, found = mhe(model, 3), []
        for t, y in enumerate(run.measurements):
            if t:
                estimator.prepare()
            found.append(estimator.step(y).state)
        np.testing.assert_allclose(found, expected, atol=1e-10)

    def test_bounds_on_a_nonlinear_window(self):
        model = unicycle()
        run = drive(model, 25, 0)
        wall = Polyhedron([[0.0, 1.0, 0.0]], upper=[run.states[:, 1].max() - 0.05])
        found = replay(mhe(model, 5, state_bounds=wall), run)
        assert all(estimate.status == "solved" for estimate in found)
        assert max(wall.violation(estimate.window) for estimate in found) < 1e-6
        assert any(estimate.solution.active_set["state bounds"].any() for estimate in found)

    def test_a_robust_loss_resists_outliers(self):
        model = unicycle()
        run = drive(model, 60, 5)
        rng = np.random.default_rng(0)
        run.measurements[rng.random(61) < 0.15, 0] += 3.0
        plain = rms(states(replay(mhe(model, 8), run)) - run.states)
        robust = rms(states(replay(mhe(model, 8, losses={f"range{k}": Huber() for k in range(3)}), run)) - run.states)
        assert robust < 0.5 * plain


class TestParameters:
    def model(self):
        # a mass on a spring of unknown stiffness and an unknown bias of the position sensor
        def rate(x, u, p):
            return [x[1], -p[0] * x[0] + u[0]]

        return NonlinearModel(
            rate,
            np.diag([1e-6, 1e-5]),
            2,
            inputs=1,
            parameters=2,
            sensors=[
                Sensor("position", lambda x, u, p: x[0] + p[1], sigma=0.02),
                Sensor("speed", lambda x: x[1], sigma=0.05),
            ],
            mean=[1.0, 0.0],
            covariance=0.01 * np.eye(2),
            dt=0.1,
            continuous=True,
        )

    def run(self, model):
        u = np.sin(np.arange(150) / 5)[:, None]
        return simulate(model, 150, np.random.default_rng(2), inputs=u, parameters=[2.0, 0.3])

    def test_parameters_are_estimated_with_the_state(self):
        model = self.model()
        run = self.run(model)
        estimator = mhe(model, 10, parameter_prior=([1.2, 0.0], np.diag([1.0, 0.25])))
        found = replay(estimator, run)
        last = found[-1]
        spread = np.sqrt(np.diag(last.solution.covariance(estimator.window.parameters)))
        assert (np.abs(last.parameters - [2.0, 0.3]) < 4 * spread).all() and (spread < [0.1, 0.05]).all()
        known = states(replay(mhe(model, 10, parameters=[2.0, 0.3]), run))
        wrong = states(replay(mhe(model, 10, parameters=[1.2, 0.0]), run))
        errors = [rms((x - run.states)[50:]) for x in (known, states(found), wrong)]
        assert errors[0] < 1.05 * errors[1] and errors[1] < 0.5 * errors[2]

    def test_the_horizon_forgets_nothing_about_them(self):
        model = self.model()
        run = self.run(model)
        prior = ([1.8, 0.2], np.diag([0.1, 0.05]))
        short, whole = (replay(mhe(model, N, parameter_prior=prior), run)[-1] for N in (8, 150))
        np.testing.assert_allclose(short.parameters, whole.parameters, atol=2e-3)

    def test_one_of_both_must_be_given(self):
        for options in ({}, {"parameters": [1.0, 0.0], "parameter_prior": ([1.0, 0.0], np.eye(2))}):
            with pytest.raises(SettingError, match="parameter_prior="):
                mhe(self.model(), 3, **options)
        with pytest.raises(SettingError, match="prior='filter' only"):
            mhe(self.model(), 3, prior="seed", parameter_prior=([1.0, 0.0], np.eye(2)))


class TestMultiRate:
    def test_slow_sensors_are_missing_in_between(self):
        sensors = [Sensor("fast", [[1.0, 0, 0, 0]], sigma=1.0), Sensor("slow", [[0, 0, 1.0, 0]], sigma=0.5, period=4)]
        model = ring().with_sensors(sensors)
        run = simulate(model, 40, np.random.default_rng(0))
        found = replay(mhe(model, 5), run)
        assert found[4].missing == () and found[5].missing == (1,)
        np.testing.assert_allclose(states(found), states(replay(KalmanFilter(model), run)), atol=1e-9)

    def test_a_solver_that_stops_early_is_a_status_and_not_an_error(self):
        model = ring()
        run = simulate(model, 10, np.random.default_rng(0))
        box = Polyhedron.box([-0.3] * 4, [0.3] * 4)
        found = replay(mhe(model, 3, solver="osqp", state_bounds=box, iteration_limit=2), run)
        assert {estimate.status for estimate in found} <= {Status.ITERATION_LIMIT, Status.INACCURATE, Status.FAILED}
        assert np.isfinite(states(found)).all()
