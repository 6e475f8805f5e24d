"""Fixed-lag smoothing: equal to all data at once, constant in memory, late and gated readings, fences, landmarks."""

from __future__ import annotations

import gc
import tracemalloc
from typing import Any

import casadi as ca
import numpy as np
import pytest

from localization import measurements as meas
from localization import measurements_3d as meas_3d
from localization.smoothing import Fence, FixedLagSmoother, Kind, Lasting, Readings
from problems.errors import DataError, DefinitionError, SettingError, ShapeError, UnknownNameError
from problems.noise import Cauchy, Gaussian, Huber
from problems.problem import Problem
from problems.spaces import SE2, Vector
from problems.spatial import SE3

ODOMETRY = Kind(meas.relative_pose, ("before", "pose"), (3,), Gaussian(sigma=[0.05, 0.05, 0.02]))
LANDMARKS = np.array([[5.0, 5.0], [-5.0, 5.0], [0.0, -6.0]])


def moved(states: np.ndarray, measurements: Any) -> np.ndarray:
    return SE2.retract_array(states, measurements["odometry"].values) if "odometry" in measurements else states


def shift(a: Any, b: Any, z: Any) -> Any:
    return b - a - z


def place(x: Any, z: Any) -> Any:
    return x - z


def team_of_points(rng: np.random.Generator, steps: int) -> list[dict[str, Readings]]:
    """Two robots in the plane: odometry with its own sigmas, GPS of one of them only, one seeing the other."""
    out = []
    for k in range(steps):
        given = {"gps": Readings(rng.normal(size=(1, 2)) + 0.3 * k, np.array([0]))}
        given["seen"] = Readings(rng.normal(size=(1, 2)), np.array([[0, 1]]))
        if k:
            given["odometry"] = Readings(rng.normal(size=(2, 2)), np.array([0, 1]), rng.uniform(0.5, 2, (2, 2)))
        out.append(given)
    return out


POINT_KINDS = {
    "odometry": Kind(shift, ("before", "pose"), (2,)),
    "gps": Kind(place, ("pose",), (2,), Gaussian(0.7)),
    "seen": Kind(shift, ("pose", "other"), (2,), Gaussian(covariance=[[0.5, 0.1], [0.1, 0.3]])),
}


def all_at_once(given: list[dict[str, Readings]]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate (steps, 2, 2) and covariance of the newest points, by dense least squares written out here."""
    steps = len(given)
    A, b = [], []

    def row(entries: dict[tuple[int, int], float], z: np.ndarray, root: np.ndarray) -> None:
        block = np.zeros((2, steps * 4))
        for (k, robot), sign in entries.items():
            block[:, 4 * k + 2 * robot : 4 * k + 2 * robot + 2] += sign * np.eye(2)
        A.append(root @ block)
        b.append(root @ z)

    for robot in (0, 1):
        row({(0, robot): 1.0}, np.zeros(2), np.eye(2) / 3)
    seen = np.linalg.inv(np.linalg.cholesky([[0.5, 0.1], [0.1, 0.3]]))
    for k, readings in enumerate(given):
        row({(k, 0): 1.0}, readings["gps"].values[0], np.eye(2) / 0.7)
        if "seen" in readings:
            row({(k, 1): 1.0, (k, 0): -1.0}, readings["seen"].values[0], seen)
        if k:
            odometry = readings["odometry"]
            assert odometry.sigma is not None
            for robot in (0, 1):
                root = np.diag(1 / odometry.sigma[robot])
                row({(k, robot): 1.0, (k - 1, robot): -1.0}, odometry.values[robot], root)
    J, z = np.vstack(A), np.concatenate(b)
    return np.linalg.lstsq(J, z, rcond=None)[0].reshape(steps, 2, 2), np.linalg.inv(J.T @ J)[-4:, -4:]


def points_smoother(lag: int, **options: Any) -> FixedLagSmoother:
    return FixedLagSmoother(Vector(2), lag, POINT_KINDS, start=[0, 0], start_sigma=3.0, robots=2, **options)


@pytest.mark.parametrize("solver", ["auto", "gauss-newton", "daqp"])
def test_linear_equals_all_data_at_once(rng: np.random.Generator, solver: str) -> None:
    given = team_of_points(rng, 25)
    smoother = points_smoother(4, solver=solver)
    for k, readings in enumerate(given):
        estimate = smoother.step(readings)
        states, covariance = all_at_once(given[: k + 1])
        np.testing.assert_allclose(estimate.window, states[-5:], atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, covariance, atol=1e-9)
        assert estimate.status == "solved"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def drive(rng: np.random.Generator, steps: int, wild: float = 0.0) -> tuple[np.ndarray, list[dict[str, Readings]]]:
    """One robot on a circle among three landmarks: odometry, coarse fixes, ranges and bearings to the landmarks."""
    truth, given = [np.array([[0.0, 0.0, 0.3]])], []
    turn = np.array([[0.3, 0.0, 0.06]])
    for k in range(steps):
        readings = {}
        if k:
            truth.append(SE2.retract_array(truth[-1], turn))
            readings["odometry"] = Readings(turn + rng.normal(size=(1, 3)) * [0.05, 0.05, 0.02], np.array([0]))
        x = truth[-1][0]
        away = LANDMARKS - x[:2]
        at = np.column_stack([np.zeros(3, int), np.arange(3)])
        ranges = np.linalg.norm(away, axis=1) + 0.1 * rng.normal(size=3) + 4 * (rng.random(3) < wild)
        readings["gps"] = Readings(x[None, :2] + rng.normal(size=(1, 2)), np.array([0]))
        readings["range"] = Readings(ranges[:, None], at)
        angle = np.arctan2(away[:1, 1], away[:1, 0]) - x[2] + 0.05 * rng.normal()
        readings["bearing"] = Readings(angle[:, None], at[:1])
        given.append(readings)
    return np.vstack(truth), given


DRIVE_KINDS = {
    "odometry": ODOMETRY,
    "gps": Kind(meas.position, ("pose",), (2,), Gaussian(1.0), Huber()),
    "range": Kind(meas.distance, ("pose", "landmark"), (1,), Gaussian(0.1)),
    "bearing": Kind(meas.bearing, ("pose", "landmark"), (1,), Gaussian(0.05)),
}
MARKS = {"landmark": Lasting(Vector(2), 3, LANDMARKS + 0.5, 1.0)}


def driver(lag: int, kinds: Any = None, **options: Any) -> FixedLagSmoother:
    options = {"predict": moved, "lasting": MARKS} | options
    return FixedLagSmoother(SE2, lag, kinds or DRIVE_KINDS, start=[0, 0, 0.3], start_sigma=[1, 1, 0.1], **options)


def whole_drive(given: list[dict[str, Readings]]) -> Any:
    """Every reading at once, stated as a problem of its own."""
    n = len(given)
    problem = Problem("batch")
    pose, mark = problem.variables("pose", SE2, n), problem.variables("landmark", Vector(2), 3)
    start = problem.data("start", 3, 1, [0.0, 0.0, 0.3])
    problem.cost("start", meas.pose, on=pose[0], data=start, noise=Gaussian(sigma=[1, 1, 0.1]))
    problem.cost("marks", meas.position, on=mark, data=problem.data("m", 2, 3, LANDMARKS + 0.5))
    moves = problem.data("u", 3, n - 1, np.vstack([g["odometry"].values for g in given[1:]]))
    problem.cost("odometry", meas.relative_pose, on=(pose[:-1], pose[1:]), data=moves, noise=ODOMETRY.noise)
    fixes = problem.data("gps", 2, n, np.vstack([g["gps"].values for g in given]))
    problem.cost("gps", meas.position, on=pose, data=fixes, noise=Gaussian(1.0), loss=Huber())
    z = problem.data("r", 1, 3 * n, np.vstack([g["range"].values for g in given]))
    on = (pose[np.repeat(np.arange(n), 3)], mark[np.tile(np.arange(3), n)])
    problem.cost("range", meas.distance, on=on, data=z, noise=Gaussian(0.1))
    angles = problem.data("b", 1, n, np.vstack([g["bearing"].values for g in given]))
    problem.cost("bearing", meas.bearing, on=(pose, mark[0]), data=angles, noise=Gaussian(0.05))
    return problem


def test_a_lag_as_long_as_the_run_is_the_optimum_of_all_data(rng: np.random.Generator) -> None:
    truth, given = drive(rng, 15)
    smoother = driver(20, tolerance=1e-12)
    for readings in given:
        estimate = smoother.step(readings)
    batch = whole_drive(given).compile("gauss-newton", tolerance=1e-12).solve(
        initial={"pose": truth, "landmark": LANDMARKS}
    )  # fmt: skip
    assert estimate.solution.objective == pytest.approx(batch.objective, rel=1e-10)
    np.testing.assert_allclose(estimate.window[:, 0], batch["pose"], atol=1e-7)
    np.testing.assert_allclose(estimate.lasting["landmark"], batch["landmark"], atol=1e-7)
    last = batch._layout.problem.unknowns["pose"][14]
    np.testing.assert_allclose(estimate.covariance, batch.covariance(last), rtol=1e-5)


def test_a_short_lag_stays_near_the_optimum_of_all_data(rng: np.random.Generator) -> None:
    truth, given = drive(rng, 60)
    smoother = driver(15)
    for readings in given:
        estimate = smoother.step(readings)
    problem = whole_drive(given)
    batch = problem.compile("gauss-newton").solve(initial={"pose": truth, "landmark": LANDMARKS})
    sigma = np.sqrt(np.diag(batch.covariance(problem.unknowns["pose"][59])))
    error = SE2.local_array(batch["pose"][59:], estimate.state)[0]
    assert (np.abs(error) < 0.35 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), sigma, rtol=0.1)
    smooth = batch.covariance(problem.unknowns["landmark"])
    np.testing.assert_allclose(
        estimate.marginal_covariance(lasting="landmark"), smooth, atol=0.25 * np.abs(smooth).max()
    )


def test_one_compilation_and_no_new_problem_serve_all_steps(rng: np.random.Generator) -> None:
    _, given = drive(rng, 20)
    smoother = driver(4)
    session, problem = smoother.session, smoother.session.problem
    terms = dict(problem.terms)
    for readings in given:
        smoother.step(readings)
    assert smoother.session is session and problem.terms == terms
    assert len(session._plans) == 1  # one plan of what leaves, whatever is missing


def endless(space: Any) -> tuple[FixedLagSmoother, Any]:
    """A smoother of one robot with fixes, and a function that runs it for some keyframes."""
    planar = space is SE2
    odometry = ODOMETRY if planar else Kind(shift, ("before", "pose"), (2,), Gaussian(0.1))
    kinds = {"odometry": odometry, "gps": Kind(meas.position, ("pose",), (2,), Gaussian(1.0))}
    smoother = FixedLagSmoother(
        space, 4, kinds, start=space.identity(), start_sigma=1.0, predict=moved if planar else None,
        iterations=1 if planar else None,
    )  # fmt: skip
    rng, where, turn = np.random.default_rng(5), np.array([0]), np.array([[0.3, 0.0, 0.06]])[:, : space.dim]

    def advance(steps: int) -> None:
        for _ in range(steps):
            given = {"gps": Readings(rng.normal(size=(1, 2)), where)}
            if smoother.times:
                given["odometry"] = Readings(turn + 0.02 * rng.normal(size=turn.shape), where)
            assert smoother.step(given).status == "solved"

    return smoother, advance


@pytest.mark.parametrize(("space", "half", "traced"), [(Vector(2), 5000, 4000), (SE2, 500, 0)])
def test_memory_stays_constant(space: Any, half: int, traced: int) -> None:
    """Over the second half. When tracing begins late, objects freed and made again count as new for a while."""
    smoother, advance = endless(space)
    advance(traced)
    tracemalloc.start()
    try:
        advance(half - traced)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        advance(half)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert len(smoother.times) == 5
    assert grown < 20 * half  # bytes; an array kept from every step would be more than 112 each


def test_late_readings_enter_their_own_keyframe(rng: np.random.Generator) -> None:
    given = team_of_points(rng, 12)
    punctual, late = points_smoother(4), points_smoother(4)
    for k, readings in enumerate(given):
        on_time = punctual.step(readings, time=0.1 * k)
        first = dict(readings)
        if k in (5, 9):
            del first["seen"]
        # the reading of keyframe 5 comes when that keyframe is about to leave, that of 9 two steps later
        older = {10: 5, 11: 9}.get(k)
        amended = [] if older is None else [(0.1 * older, {"seen": given[older]["seen"]})]
        estimate = late.step(first, time=0.1 * k, late=amended)
        assert estimate.late == tuple(when for when, _ in amended)
    np.testing.assert_allclose(estimate.window, on_time.window, atol=1e-9)
    again = late.step({}, time=1.2, late=[(0.3, {"seen": given[3]["seen"]})])
    assert again.too_late == (0.3,) and again.late == ()


def test_the_gate_leaves_out_outliers_and_keeps_good_readings(rng: np.random.Generator) -> None:
    gated = DRIVE_KINDS | {"range": Kind(meas.distance, ("pose", "landmark"), (1,), Gaussian(0.1), gate=0.99)}
    truth, given = drive(rng, 150)
    smoother = driver(4, gated, iterations=3)
    out = sum(len(smoother.step(readings).gated) for readings in given)
    assert out < 0.01 * 450 + 4 * np.sqrt(450 * 0.01)
    truth, given = drive(rng, 150, wild=0.1)
    smoother, unguarded = driver(4, gated, iterations=3), driver(4, iterations=3)
    found, errors = 0, []
    for x, readings in zip(truth, given, strict=True):
        estimate, other = smoother.step(readings), unguarded.step(readings)
        assert all(name == "range" for name, _ in estimate.gated)
        found += len(estimate.gated)
        errors.append([np.linalg.norm(e.state[0, :2] - x[:2]) for e in (estimate, other)])
    assert found > 0.05 * 450
    mean = np.mean(errors, axis=0)
    assert mean[0] < 0.3 and mean[0] < mean[1] / 2


def test_a_robust_loss_bears_what_no_gate_keeps_out(rng: np.random.Generator) -> None:
    truth, given = drive(rng, 100, wild=0.1)
    robust = DRIVE_KINDS | {"range": Kind(meas.distance, ("pose", "landmark"), (1,), Gaussian(0.1), Cauchy())}
    errors = []
    for kinds in (robust, DRIVE_KINDS):
        smoother = driver(6, kinds)
        states = np.vstack([smoother.step(readings).state for readings in given])
        errors.append(np.mean(np.linalg.norm((states - truth)[20:, :2], axis=1)))
    assert errors[0] < 0.3 and errors[0] < errors[1] / 2


def test_fences_hold_on_the_whole_window(rng: np.random.Generator) -> None:
    """x <= 1 while the fixes pull to 3: the points on the fence are those of the problem with the fence as equality."""
    kinds = {"odometry": POINT_KINDS["odometry"], "gps": POINT_KINDS["gps"]}
    fence = {"fence": Fence(lambda x: x[0], upper=1.0)}
    sigma = np.ones((1, 2))
    smoother = FixedLagSmoother(Vector(2), 3, kinds, start=[0, 0], start_sigma=3.0, fences=fence, solver="daqp")
    free = FixedLagSmoother(Vector(2), 3, kinds, start=[0, 0], start_sigma=3.0)
    for k in range(8):
        given = {"gps": Readings(np.array([[3.0, 1.0 * k]]), np.array([0]))}
        if k:
            given["odometry"] = Readings(np.array([[0.0, 1.0]]), np.array([0]), sigma)
        estimate, loose = smoother.step(given), free.step(given)
        assert estimate.status == "solved"
        assert estimate.window[:, 0, 0].max() <= 1 + 1e-7
        np.testing.assert_allclose(estimate.window[..., 1], loose.window[..., 1], atol=1e-7)
    np.testing.assert_allclose(estimate.window[:, 0, 0], 1.0, atol=1e-7)
    assert loose.window[:, 0, 0].min() > 1.5
    shut = {"fence": Fence(lambda x: ca.vertcat(x[0], -x[0]), upper=np.array([1.0, -2.0]))}
    nowhere = FixedLagSmoother(Vector(2), 3, kinds, start=[0, 0], start_sigma=3.0, fences=shut, solver="daqp")
    stuck = nowhere.step({"gps": Readings(np.array([[3.0, 0.0]]), np.array([0]))})
    assert stuck.status == "infeasible" and stuck.infeasible == ("fence",)


def test_poses_stay_inside_a_fence(rng: np.random.Generator) -> None:
    """Poses in the plane, where the window is nonlinear; the fence cuts off the outermost part of the drive."""
    truth, given = drive(rng, 40)
    edge = truth[:, 0].max() - 0.1
    fence = {"fence": Fence(lambda pose: pose.translation[0], upper=edge)}
    smoother, free = driver(4, fences=fence, iterations=5), driver(4, iterations=5)
    outside = 0
    for readings in given:
        estimate = smoother.step(readings)
        assert estimate.status == "solved"
        assert estimate.window[:, 0, 0].max() <= edge + 1e-6
        outside += free.step(readings).state[0, 0] > edge
    assert outside > 3


def test_poses_in_space(rng: np.random.Generator) -> None:
    kinds = {
        "odometry": Kind(meas_3d.relative_pose, ("before", "pose"), (7,), Gaussian(sigma=[0.1] * 3 + [0.02] * 3)),
        "fix": Kind(meas.position, ("pose",), (3,), Gaussian(0.5)),
    }
    step = np.array([[0.5, 0.0, 0.1, 0.1, -0.05, 0.2]])
    one = SE3.retract_array(SE3.identity()[None], step)
    truth = [SE3.identity()[None]]
    for _ in range(9):
        truth.append(SE3.retract_array(truth[-1], step))
    noise = rng.normal(size=(9, 6)) * ([0.1] * 3 + [0.02] * 3)
    moves, fixes = (
        SE3.retract_array(np.tile(one, (9, 1)), noise),
        np.vstack(truth)[:, :3] + rng.normal(size=(10, 3)) / 2,
    )
    ends = []
    for lag in (12, 3):
        smoother = FixedLagSmoother(SE3, lag, kinds, start=SE3.identity(), start_sigma=[0.5] * 3 + [0.2] * 3)
        for k in range(10):
            given = {"fix": Readings(fixes[k : k + 1], np.array([0]))}
            if k:
                given["odometry"] = Readings(moves[k - 1 : k], np.array([0]))
            estimate = smoother.step(given)
        ends.append(estimate)
    problem = Problem("batch")
    pose = problem.variables("pose", SE3, 10)
    prior, sigma = problem.data("prior", 7, 1, SE3.identity()), [0.5] * 3 + [0.2] * 3
    problem.cost("prior", meas_3d.pose, on=pose[0], data=prior, noise=Gaussian(sigma=sigma))
    u, z = problem.data("u", 7, 9, moves), problem.data("z", 3, 10, fixes)
    problem.cost("odometry", meas_3d.relative_pose, on=(pose[:-1], pose[1:]), data=u, noise=kinds["odometry"].noise)
    problem.cost("fix", meas.position, on=pose, data=z, noise=Gaussian(0.5))
    batch = problem.compile("gauss-newton").solve(initial={"pose": np.vstack(truth)})
    assert ends[0].solution.objective == pytest.approx(batch.objective, rel=1e-9)
    np.testing.assert_allclose(ends[0].window[:, 0], batch["pose"], atol=1e-5)
    assert np.abs(SE3.local_array(batch["pose"][9:], ends[1].state)).max() < 0.05
    assert ends[1].covariance.shape == (6, 6)


def test_an_unknown_landmark_is_found_where_it_is_placed() -> None:
    kinds = {"odometry": ODOMETRY, "seen": Kind(meas.landmark, ("pose", "landmark"), (2,), Gaussian(0.1))}
    unknown = {"landmark": Lasting(Vector(2), 1, [0.0, 0.0], 1e3)}
    smoother = FixedLagSmoother(
        SE2, 3, kinds, start=[0, 0, 0], start_sigma=[0.01, 0.01, 0.01], lasting=unknown, predict=moved
    )
    x, mark, turn = np.zeros((1, 3)), np.array([3.0, 2.0]), np.array([[0.2, 0.0, 0.1]])
    for k in range(12):
        given = {}
        if k:
            x = SE2.retract_array(x, turn)
            given["odometry"] = Readings(turn, np.array([0]))
        if k >= 2:
            body = SE2.local_array(x, np.array([[*mark, 0.0]]))[:, :2]
            if k == 2:
                smoother.place("landmark", 0, mark + 0.5)
            given["seen"] = Readings(body, np.array([[0, 0]]))
        estimate = smoother.step(given)
    np.testing.assert_allclose(estimate.lasting["landmark"][0], mark, atol=1e-3)
    assert np.sqrt(np.diag(estimate.marginal_covariance(lasting="landmark"))).max() < 0.15


def test_steps_start_anew_after_reset(rng: np.random.Generator) -> None:
    _, given = drive(rng, 8)
    smoother = driver(3)
    once = [smoother.step(readings).state for readings in given]
    smoother.reset()
    np.testing.assert_array_equal(once, [smoother.step(readings).state for readings in given])


def test_a_crowded_keyframe_says_what_it_drops() -> None:
    smoother = points_smoother(2)
    twice = Readings(np.array([[1.0, 1.0], [2.0, 2.0], [np.nan, 0.0]]), np.array([0, 0, 0]))
    estimate = smoother.step({"gps": twice})
    assert estimate.dropped == 1
    frame = estimate.to_pandas()
    assert list(frame["robot"]) == [0, 1] and frame["status"].iloc[0] == "solved"


def test_wrong_use_is_refused(rng: np.random.Generator) -> None:
    smoother = points_smoother(2)
    one = np.array([0])
    with pytest.raises(UnknownNameError, match="gsp"):
        smoother.step({"gsp": Readings(np.zeros((1, 2)), one)})
    with pytest.raises(ShapeError, match="gps"):
        smoother.step({"gps": Readings(np.zeros((1, 3)), one)})
    with pytest.raises(DataError, match="names"):
        smoother.step({"gps": Readings(np.zeros((1, 2)), np.array([2]))})
    with pytest.raises(DataError, match="names"):
        smoother.step({"seen": Readings(np.zeros((1, 2)), np.array([[1, 1]]))})
    with pytest.raises(DataError, match="first keyframe"):
        smoother.step({"odometry": Readings(np.zeros((1, 2)), one, np.ones((1, 2)))})
    with pytest.raises(DataError, match="finite"):
        smoother.step({"gps": Readings(np.full((1, 2), np.inf), one)})
    assert smoother.times == []
    smoother.step({"gps": Readings(np.zeros((1, 2)), one), "seen": Readings(np.zeros((1, 2)), np.array([[0, 1]]))}, 1.0)
    with pytest.raises(DataError, match="sigma"):
        smoother.step({"odometry": Readings(np.zeros((1, 2)), one)})
    with pytest.raises(DataError, match="advance"):
        smoother.step({}, time=1.0)
    with pytest.raises(DefinitionError, match="anchor"):
        FixedLagSmoother(SE2, 2, {"r": Kind(meas.distance, ("pose", "anchor"), (1,))}, start=[0, 0, 0], start_sigma=1)
    with pytest.raises(DefinitionError, match="gated"):
        Kind(meas.relative_pose, ("before", "pose"), (3,), gate=0.9)
    with pytest.raises(SettingError, match="lag"):
        points_smoother(0)
    with pytest.raises(DataError, match="keyframe 3"):
        points_smoother(2).step({"gps": Readings(np.zeros((1, 2)), one)}).marginal_covariance(3)


def test_it_is_registered() -> None:
    from mhe.estimate import Estimator
    from problems import registry

    assert registry.load("estimators", "fixed_lag") is FixedLagSmoother
    assert isinstance(points_smoother(2), Estimator)
