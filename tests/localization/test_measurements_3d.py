"""Templates in space: equal to gtsam's factors at random values, exact derivatives, the spec's cube."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from localization import measurements_3d as meas
from problems import SE3, SO3, Gaussian, Problem, Vector
from problems.forms.residual_code import ResidualCode, residual_code
from problems.spatial import GTSAM_ORDER, rotate_array

POINT = Vector(3)
SIZES = {SE3: 7, SO3: 4, POINT: 3}


def gtsam() -> Any:
    return pytest.importorskip("gtsam")


def code_of(residual: Callable[..., Any], spaces: tuple[Any, ...], sizes: tuple[int, ...]) -> ResidualCode:
    problem = Problem()
    slots = tuple(problem.variables(f"x{k}", space) for k, space in enumerate(spaces))
    data = tuple(problem.data(f"z{k}", size) for k, size in enumerate(sizes))
    return residual_code(problem.cost("term", residual, on=slots, data=data))


def evaluate(residual: Callable[..., Any], spaces: tuple[Any, ...], values: list[Any], *data: Any) -> np.ndarray:
    rows = [np.atleast_1d(np.asarray(z, float)) for z in data]
    code = code_of(residual, spaces, tuple(z.size for z in rows))
    return code.residual(np.concatenate([*values, *rows]).tolist(), 1)[0]


def draw(space: Any, rng: np.random.Generator) -> np.ndarray:
    return space.normalize_array(rng.normal(scale=2.0, size=(1, space.ambient)))[0]


def native(x: np.ndarray) -> Any:
    g = gtsam()
    if x.size == 3:
        return x
    turn = g.Rot3(Rotation.from_quat(x[-4:]).as_matrix())
    return turn if x.size == 4 else g.Pose3(turn, x[:3])


Case = tuple[Callable[..., Any], tuple[Any, ...], tuple[Any, ...], Callable[..., Any], Any]
CASES: dict[str, Case] = {
    "position": (meas.position, (SE3,), (3,), lambda g, n, z: g.GPSFactor(0, z, n(3)), None),
    "orientation": (meas.orientation, (SE3,), (SO3,), lambda g, n, z: g.PoseRotationPrior3D(0, native(z), n(3)), None),
    "orientation_so3": (meas.orientation, (SO3,), (SO3,), lambda g, n, z: g.PriorFactorRot3(0, native(z), n(3)), None),
    "relative_orientation": (
        meas.relative_orientation,
        (SO3, SO3),
        (SO3,),
        lambda g, n, z: g.BetweenFactorRot3(0, 1, native(z), n(3)),
        None,
    ),
    "attitude": (
        meas.attitude,
        (SE3,),
        (3, 3),
        lambda g, n, r, b: g.AttitudeFactorPose3(0, g.Unit3(r), n(2), g.Unit3(b)),
        None,
    ),
    "attitude_so3": (
        meas.attitude,
        (SO3,),
        (3, 3),
        lambda g, n, r, b: g.AttitudeFactorRot3(0, g.Unit3(r), n(2), g.Unit3(b)),
        None,
    ),
    "distance": (meas.distance, (SE3, SE3), (1,), lambda g, n, z: g.RangeFactorPose3(0, 1, z[0], n(1)), None),
    "distance_point": (meas.distance, (SE3, POINT), (1,), lambda g, n, z: g.RangeFactor3D(0, 1, z[0], n(1)), None),
    "bearing_point": (
        meas.bearing,
        (SE3, POINT),
        (3,),
        lambda g, n, z: g.BearingFactor3D(0, 1, g.Unit3(z), n(2)),
        None,
    ),
    "bearing_range": (
        meas.bearing_range,
        (SE3, SE3),
        (4,),
        lambda g, n, z: g.BearingRangeFactorPose3(0, 1, g.Unit3(z[:3]), z[3], n(3)),
        None,
    ),
    "bearing_range_point": (
        meas.bearing_range,
        (SE3, POINT),
        (4,),
        lambda g, n, z: g.BearingRangeFactor3D(0, 1, g.Unit3(z[:3]), z[3], n(3)),
        None,
    ),
    "relative_pose_log": (
        meas.relative_pose_log,
        (SE3, SE3),
        (SE3,),
        lambda g, n, z: g.BetweenFactorPose3(0, 1, native(z), n(6)),
        GTSAM_ORDER,
    ),
    "pose_log": (
        meas.pose_log,
        (SE3,),
        (SE3,),
        lambda g, n, z: g.PriorFactorPose3(0, native(z), n(6)),
        GTSAM_ORDER,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_residuals_equal_gtsams_component_by_component(name: str) -> None:
    g = gtsam()
    residual, spaces, shapes, factor, order = CASES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    for _ in range(25):
        values = [draw(space, rng) for space in spaces]
        data = [draw(s, rng) if not isinstance(s, int) else rng.normal(size=s) * 2 for s in shapes]
        holder = g.Values()
        for key, x in enumerate(values):
            holder.insert(key, native(x))
        theirs = factor(g, g.noiseModel.Unit.Create, *data).unwhitenedError(holder)
        ours = evaluate(residual, spaces, values, *data)
        np.testing.assert_allclose(ours if order is None else ours[order], theirs, atol=1e-9)


DERIVATIVES = {
    **{name: (case[0], case[1], case[2]) for name, case in CASES.items()},
    "bearing": (meas.bearing, (SE3, SE3), (3,)),
    "heading": (meas.heading, (SE3,), (1,)),
    "heading_chordal": (meas.heading_chordal, (SO3,), (1,)),
    "landmark": (meas.landmark, (SE3, POINT), (3,)),
    "relative_position": (meas.relative_position, (SE3, SE3), (3,)),
    "relative_pose": (meas.relative_pose, (SE3, SE3), (SE3,)),
    "pose": (meas.pose, (SE3,), (SE3,)),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_jacobians_equal_differences(name: str) -> None:
    residual, spaces, shapes = DERIVATIVES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    values = [draw(space, rng) for space in spaces]
    data = np.concatenate([draw(s, rng) if not isinstance(s, int) else rng.normal(size=s) for s in shapes])
    code = code_of(residual, spaces, tuple(s if isinstance(s, int) else s.ambient for s in shapes))

    def at(d: np.ndarray) -> np.ndarray:
        moved, start = [], 0
        for x, space in zip(values, spaces, strict=True):
            moved.append(space.retract_array(x[None], d[None, start : start + space.dim])[0])
            start += space.dim
        return code.residual(np.concatenate([*moved, data]).tolist(), 1)[0]

    J = code.residual_and_jacobian(np.concatenate([*values, data]).tolist(), 1)[1][0]
    h = 1e-6
    expected = np.array([(at(h * e) - at(-h * e)) / (2 * h) for e in np.eye(J.shape[1])]).T
    np.testing.assert_allclose(J, expected, atol=1e-7)


@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-8, 1e-4, 3.1e-3, 3.2e-3, 0.1, 2.0, 3.14])
def test_bearing_errors_are_the_angle_with_finite_derivatives(gap: float) -> None:
    x = np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3, 0.9])
    x[3:] /= np.linalg.norm(x[3:])
    seen = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    across = np.cross(seen, [0, 0, 1.0])
    across /= np.linalg.norm(across)
    z = np.cos(gap) * seen + np.sin(gap) * across
    target = x[:3] + rotate_array(x[None, 3:], 4 * seen[None])[0]
    code = code_of(meas.bearing, (SE3, POINT), (3,))
    r, J = code.residual_and_jacobian([*x, *target, *z], 1)
    assert np.linalg.norm(r) == pytest.approx(gap, rel=1e-9, abs=1e-15)
    assert np.isfinite(J).all()
    if gap <= 1e-4:  # one radian per radian of each rotation across the direction
        np.testing.assert_allclose(np.linalg.svd(J[0, :, 3:6])[1], 1, atol=1e-4)


def test_the_opposite_direction_costs_half_a_turn() -> None:
    one = SE3.identity()
    r = evaluate(meas.bearing, (SE3, POINT), [one, np.array([3.0, 0, 0])], [-1.0, 0, 0])
    np.testing.assert_allclose(r, [-np.pi, 0])


def test_length_of_a_direction_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    x, p, z = draw(SE3, rng), rng.normal(size=3), rng.normal(size=3)
    one = evaluate(meas.bearing, (SE3, POINT), [x, p], z)
    np.testing.assert_allclose(one, evaluate(meas.bearing, (SE3, POINT), [x, p], 7 * z), atol=1e-14)
    one = evaluate(meas.attitude, (SE3,), [x], z, p)
    np.testing.assert_allclose(one, evaluate(meas.attitude, (SE3,), [x], 3 * z, 0.1 * p), atol=1e-14)


def test_attitude_sees_roll_and_pitch_but_no_yaw_and_heading_the_rest() -> None:
    up = np.array([0.0, 0, 1])
    turn = Rotation.from_euler("ZYX", [0.7, 0.2, -0.3])
    measured = turn.inv().apply(up)
    for yaw in (0.0, 1.0, -2.5):
        q = Rotation.from_euler("ZYX", [yaw, 0.2, -0.3]).as_quat()
        np.testing.assert_allclose(evaluate(meas.attitude, (SO3,), [q], up, measured), 0, atol=1e-15)
        np.testing.assert_allclose(evaluate(meas.heading, (SO3,), [q], yaw), 0, atol=1e-15)
        np.testing.assert_allclose(evaluate(meas.heading_chordal, (SO3,), [q], yaw - 0.2), 2 * np.sin(0.1))
    q = Rotation.from_euler("ZYX", [3.0, 0.2, -0.3]).as_quat()
    np.testing.assert_allclose(evaluate(meas.heading, (SO3,), [q], -3.0), 6.0 - 2 * np.pi)
    tilted = Rotation.from_euler("ZYX", [0.7, 0.2, 0.1]).as_quat()
    assert np.linalg.norm(evaluate(meas.attitude, (SO3,), [tilted], up, measured)) > 0.3


def test_charts_agree_to_second_order_and_no_further() -> None:
    rng = np.random.default_rng(1)
    a, z, d = draw(SE3, rng), draw(SE3, rng), rng.normal(size=6)
    gaps = []
    for scale in (1e-2, 1e-3):
        b = SE3.retract_array(a[None], plain_step(z)[None])
        b = SE3.retract_array(b, scale * d[None])[0]
        plain = evaluate(meas.relative_pose, (SE3, SE3), [a, b], z)
        log = evaluate(meas.relative_pose_log, (SE3, SE3), [a, b], z)
        np.testing.assert_allclose(plain[3:], log[3:], atol=1e-14)
        gaps.append(np.abs(plain - log).max())
    assert gaps[0] > 1e-6
    assert gaps[0] / gaps[1] == pytest.approx(100, rel=0.1)


def plain_step(z: np.ndarray) -> np.ndarray:
    """The step of the plain chart from the identity to z."""
    return SE3.local_array(SE3.identity()[None], z[None])[0]


def cube(rng: np.random.Generator) -> dict[str, Any]:
    """2 x 2 x 2 robots 4 m apart that all see each other along the edges (spec section 10, 3-D)."""
    p = 4.0 * np.array([[i, j, k] for i in range(2) for j in range(2) for k in range(2)], float)
    turn = Rotation.from_euler("ZYX", np.column_stack([rng.uniform(-3, 3, 8), rng.uniform(-0.3, 0.3, (8, 2))]))
    i, j = np.nonzero(np.isclose(np.linalg.norm(p[:, None] - p, axis=2), 4))
    local = turn[i].inv().apply(p[j] - p[i])
    seen = local / 4 + 0.03 * rng.normal(size=local.shape)
    yaw = turn.as_euler("ZYX")[:, 0] + 0.05 * rng.normal(size=8)
    up = turn.inv().apply([0, 0, 1]) + 0.05 * rng.normal(size=(8, 3))
    z = np.column_stack([seen / np.linalg.norm(seen, axis=1)[:, None], 4 + 0.1 * rng.normal(size=i.size)])
    return {
        "p": p, "turn": turn, "i": i, "j": j, "gps": p + 2 * rng.normal(size=p.shape), "yaw": yaw, "up": up, "z": z,
    }  # fmt: skip


def test_the_cube_is_localized_as_gtsam_does() -> None:
    g = gtsam()
    world = cube(np.random.default_rng(2))
    problem = Problem("cube")
    robot = problem.variables("robot", SE3, 8)
    gps, yaw, up = problem.data("gps", 3, 8), problem.data("yaw", (), 8), problem.data("up", 3, 8)
    vertical, z = problem.data("vertical", 3, value=[0, 0, 1.0]), problem.data("z", 4, len(world["i"]))
    problem.cost("gps", meas.position, on=robot, data=gps, noise=Gaussian(2.0))
    problem.cost("yaw", meas.heading, on=robot, data=yaw, noise=Gaussian(0.05))
    problem.cost("up", meas.attitude, on=robot, data=(vertical, up), noise=Gaussian(0.05))
    pair = (robot[world["i"]], robot[world["j"]])
    problem.cost("z", meas.bearing_range, on=pair, data=z, noise=Gaussian(sigma=[0.03, 0.03, 0.1]))
    start = np.column_stack([world["gps"], world["turn"].as_quat()])
    data = {name: world[name] for name in ("gps", "yaw", "up", "z")}
    solution = problem.compile("gauss-newton").solve(data, initial={"robot": start})
    assert solution.status == "solved"
    found = solution["robot"]
    # translation invariance: the centroid is that of the fixes (spec 3.5, lemma 3.2)
    np.testing.assert_allclose(found[:, :3].mean(axis=0), world["gps"].mean(axis=0), atol=1e-6)
    error = found[:, :3] - found[:, :3].mean(axis=0) - (world["p"] - world["p"].mean(axis=0))
    assert (error**2).sum(axis=1).mean() < 0.1
    values, graph = g.Values(), g.NonlinearFactorGraph()
    for k, x in enumerate(found):
        values.insert(k, native(x))
        graph.add(g.GPSFactor(k, world["gps"][k], g.noiseModel.Isotropic.Sigma(3, 2.0)))
        level, seen = g.Unit3(np.array([0, 0, 1.0])), g.Unit3(world["up"][k])
        graph.add(g.AttitudeFactorPose3(k, level, g.noiseModel.Isotropic.Sigma(2, 0.05), seen))
    sigmas = g.noiseModel.Diagonal.Sigmas(np.array([0.03, 0.03, 0.1]))
    for a, b, row in zip(world["i"], world["j"], world["z"], strict=True):
        graph.add(g.BearingRangeFactorPose3(int(a), int(b), g.Unit3(row[:3]), row[3], sigmas))
    yaws = Rotation.from_quat(found[:, 3:]).as_euler("ZYX")[:, 0]
    compass = (np.angle(np.exp(1j * (yaws - world["yaw"]))) ** 2).sum() / (2 * 0.05**2)
    assert graph.error(values) + compass == pytest.approx(solution.objective, rel=1e-10)
