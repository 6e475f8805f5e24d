"""How models simulate and what they report as observable."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from example_models import NOTHING, RING_A, RING_Q, X1, X3, ring, unicycle

from problems.errors import (
    DataError,
    DefinitionError,
    SettingError,
    ShapeError,
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


def turning(steps):
    return np.column_stack([np.linspace(0.5, 1.5, steps), 0.5 * np.sin(np.arange(steps) / 7)])


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
