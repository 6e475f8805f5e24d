"""SO(3) and SE(3): group axioms, charts, logarithms against scipy, displaced elements against differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.linalg as la
from scipy.spatial.transform import Rotation

from problems import SE3, SO3, Gaussian, Pose3, Problem, Rotation3, Vector
from problems.errors import DataError
from problems.forms.residual_code import residual_code
from problems.forms.template import template_of
from problems.spaces import Space, points
from problems.spatial import (
    GTSAM_ORDER,
    cross,
    quaternion_exp,
    quaternion_log,
    quaternion_product,
    rotate_array,
    skew,
)

ANGLES = [0.0, 1e-12, 1e-7, 1e-4, 2e-3, 6.3e-3, 6.4e-3, 0.1, 1.0, 3.0, 3.14159]
SPACES = [SO3, SE3]


def numeric(function: Callable[..., Any], *arguments: np.ndarray) -> np.ndarray:
    """`function` of symbols evaluated at numbers."""
    symbols = [ca.SX.sym(f"s{k}", len(a)) for k, a in enumerate(arguments)]
    return np.asarray(ca.Function("f", symbols, [ca.densify(ca.SX(function(*symbols)))])(*arguments)).squeeze()


def draw(space: Any, rng: np.random.Generator, count: int) -> np.ndarray:
    x = rng.normal(scale=2.0, size=(count, space.ambient))
    return space.normalize_array(x)


def steps(space: Any, rng: np.random.Generator, count: int) -> np.ndarray:
    """Tangents whose rotation is below pi."""
    axis = rng.normal(size=(count, 3))
    turn = axis / np.linalg.norm(axis, axis=1)[:, None] * rng.uniform(0, 3.1, (count, 1))
    return turn if space is SO3 else np.hstack([rng.normal(scale=3.0, size=(count, 3)), turn])


def matrix(x: np.ndarray) -> np.ndarray:
    """Rotation or homogeneous matrix of a stored point."""
    turn = Rotation.from_quat(x[-4:]).as_matrix()
    if x.size == 4:
        return turn
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, x[:3]
    return out


def hat(xi: np.ndarray) -> np.ndarray:
    """Matrix of a twist, translation first."""
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = np.cross(np.eye(3), xi[3:]), xi[:3]
    return out


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_they_are_spaces_with_a_unit_identity(space: Any) -> None:
    assert isinstance(space, Space)
    np.testing.assert_array_equal(matrix(space.identity()), np.eye(space.ambient - 3 if space is SE3 else 3))
    assert space.local_array(space.identity()[None], space.identity()[None]).tolist() == [[0.0] * space.dim]


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_group_axioms(space: Any) -> None:
    a, b, c = draw(space, np.random.default_rng(0), 3)

    def same(x: np.ndarray, y: np.ndarray) -> None:
        np.testing.assert_allclose(matrix(x), matrix(y), atol=1e-13)

    def product(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return numeric(lambda p, q: (space(p) @ space(q)).coordinates, x, y)

    one = space.identity()
    back = numeric(lambda p: space(p).inverse().coordinates, a)
    same(product(product(a, b), c), product(a, product(b, c)))
    same(product(a, one), a)
    same(product(one, a), a)
    same(product(a, back), one)
    same(product(back, a), one)
    same(numeric(lambda p, q: space(p).between(space(q)).coordinates, a, b), product(back, b))
    np.testing.assert_allclose(matrix(product(a, b)), matrix(a) @ matrix(b), atol=1e-13)


def test_actions_on_vectors_and_points_equal_matrices() -> None:
    rng = np.random.default_rng(1)
    x, p = draw(SE3, rng, 1)[0], rng.normal(size=3)
    T = matrix(x)
    R = T[:3, :3]
    np.testing.assert_allclose(numeric(lambda s: SO3(s).matrix, x[3:]), R, atol=1e-14)
    np.testing.assert_allclose(numeric(lambda s, v: SO3(s).rotate(v), x[3:], p), R @ p, atol=1e-14)
    np.testing.assert_allclose(numeric(lambda s, v: SO3(s).unrotate(v), x[3:], p), R.T @ p, atol=1e-14)
    np.testing.assert_allclose(numeric(lambda s, v: SE3(s).transform_from(v), x, p), (T @ [*p, 1])[:3], atol=1e-14)
    np.testing.assert_allclose(numeric(lambda s, v: SE3(s).transform_to(v), x, T[:3, :3] @ p + T[:3, 3]), p, atol=1e-13)
    np.testing.assert_allclose(numeric(lambda s: SO3(s).yaw, x[3:]), np.arctan2(R[1, 0], R[0, 0]), atol=1e-14)
    np.testing.assert_allclose(numeric(cross, x[:3], p), np.cross(x[:3], p))
    np.testing.assert_allclose(numeric(lambda s, v: skew(s) @ v, x[:3], p), np.cross(x[:3], p))
    np.testing.assert_allclose(rotate_array(x[None, 3:], p[None])[0], R @ p, atol=1e-14)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_local_inverts_retract_in_arrays_and_symbols(space: Any) -> None:
    rng = np.random.default_rng(2)
    x, d = draw(space, rng, 50), steps(space, rng, 50)
    y = space.retract_array(x, d)
    np.testing.assert_allclose(np.linalg.norm(y[:, -4:], axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(space.local_array(x, y), d, atol=1e-11)
    for k in range(5):
        np.testing.assert_allclose(numeric(space.retract, x[k], d[k]), y[k], atol=1e-14)
        np.testing.assert_allclose(numeric(space.local, x[k], y[k]), d[k], atol=1e-11)


def test_retract_is_the_plain_chart() -> None:
    rng = np.random.default_rng(3)
    x, d = draw(SE3, rng, 1), steps(SE3, rng, 1)
    T = matrix(x[0])
    T[:3, 3] += T[:3, :3] @ d[0, :3]
    T[:3, :3] = T[:3, :3] @ la.expm(np.cross(np.eye(3), d[0, 3:]))
    np.testing.assert_allclose(matrix(SE3.retract_array(x, d)[0]), T, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("sign", [1, -1])
def test_exponentials_and_logarithms_equal_scipys(angle: float, sign: int) -> None:
    axis = np.random.default_rng(4).normal(size=3)
    phi = angle * axis / np.linalg.norm(axis)
    q = Rotation.from_rotvec(phi).as_quat()
    np.testing.assert_allclose(quaternion_exp(phi[None])[0], q, atol=1e-15)
    np.testing.assert_allclose(numeric(lambda v: Rotation3.exp(v).coordinates, phi), q, atol=2e-16)
    np.testing.assert_allclose(quaternion_log(sign * q[None])[0], phi, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(numeric(lambda s: SO3(s).log(), sign * q), phi, rtol=1e-9, atol=1e-15)
    xi = np.concatenate([[0.7, -2.0, 1.3], phi])
    T = la.expm(hat(xi))
    x = np.concatenate([T[:3, 3], sign * q])
    np.testing.assert_allclose(numeric(lambda s: SE3(s).log(), x), xi, atol=1e-10)
    np.testing.assert_allclose(numeric(lambda s: SE3(s).local(), x), [*T[:3, 3], *phi], atol=1e-10)


def test_half_a_turn_has_a_finite_logarithm_and_derivative() -> None:
    x = np.array([0.5, 1.0, -1.0, 0.6, 0.0, 0.8, 0.0])
    np.testing.assert_allclose(numeric(lambda s: SO3(s).log(), x[3:]), np.pi * x[3:6], atol=1e-15)

    def slope(s: Any) -> Any:
        d = ca.SX.sym("d", 6)
        return ca.substitute(ca.jacobian(SE3.displaced(s, d).log(), d), d, 0)

    assert np.isfinite(numeric(slope, x)).all()


@pytest.mark.parametrize("angle", ANGLES[:-1])
@pytest.mark.parametrize("chart", ["log", "local"])
def test_derivatives_of_charts_are_exact_at_every_angle(angle: float, chart: str) -> None:
    axis = np.array([2.0, -1.0, 0.5])
    xi = np.concatenate([[0.3, 4.0, -2.0], angle * axis / np.linalg.norm(axis)])
    x = SE3.retract_array(SE3.identity()[None], xi[None])[0]

    def slope(s: Any) -> Any:
        d = ca.SX.sym("d", 6)
        return ca.substitute(ca.jacobian(getattr(SE3.displaced(s, d), chart)(), d), d, 0)

    def value(d: np.ndarray) -> np.ndarray:
        return numeric(lambda s: getattr(SE3(s), chart)(), SE3.retract_array(x[None], d[None])[0])

    h = 1e-4 if angle < 3 else 1e-5
    expected = np.empty((6, 6))
    for k, e in enumerate(np.eye(6)):
        expected[:, k] = (8 * (value(h * e) - value(-h * e)) - (value(2 * h * e) - value(-2 * h * e))) / (12 * h)
    np.testing.assert_allclose(numeric(slope, x), expected, atol=3e-9)
    if angle == 0:
        np.testing.assert_allclose(numeric(slope, np.concatenate([np.zeros(3), x[3:]])), np.eye(6), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES[:7])
def test_automatic_derivatives_of_the_logarithm_agree_with_the_structured_ones_near_zero(angle: float) -> None:
    axis = np.array([2.0, -1.0, 0.5])
    x = np.concatenate([[0.3, 4.0, -2.0], Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_quat()])

    def slope(of: Callable[[Any, Any], Any]) -> Any:
        def function(s: Any) -> Any:
            d = ca.SX.sym("d", 6)
            return ca.substitute(ca.jacobian(of(s, d).log(), d), d, 0)

        return function

    structured = numeric(slope(SE3.displaced), x)
    automatic = numeric(slope(lambda s, d: SE3(SE3.retract(s, d))), x)
    np.testing.assert_allclose(structured, automatic, atol=1e-11)


def test_gtsam_has_the_other_order_and_the_same_logarithm() -> None:
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(5)
    a, d = draw(SE3, rng, 2), steps(SE3, rng, 1)[0]
    poses = [gtsam.Pose3(matrix(x)) for x in a]
    ours = numeric(lambda x, y: SE3(x).between(SE3(y)).log(), *a)
    np.testing.assert_allclose(gtsam.Pose3.Logmap(poses[0].between(poses[1])), ours[GTSAM_ORDER], atol=1e-12)
    np.testing.assert_array_equal(d[GTSAM_ORDER][GTSAM_ORDER], d)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "log": lambda a, b, p: a.log(),
    "local": lambda a, b, p: a.local(),
    "between": lambda a, b, p: a.between(b).log(),
    "product": lambda a, b, p: (a @ b @ a).log(),
    "inverse": lambda a, b, p: (a.inverse() @ b.inverse()).local(),
    "chain": lambda a, b, p: b.between(a.inverse() @ b).inverse().coordinates,
    "transform_to": lambda a, b, p: a.transform_to(b.transform_from(p)),
    "transform_from": lambda a, b, p: a.transform_from(b.inverse().transform_to(p)),
    "translation": lambda a, b, p: a.translation + a.between(b).translation,
    "turns": lambda a, b, p: a.rotation.rotate(b.rotation.unrotate(p)),
    "rotation_log": lambda a, b, p: (a.rotation @ b.rotation.inverse()).log(),
    "rotation_between": lambda a, b, p: a.rotation.between(b.rotation).inverse().log(),
    "matrix": lambda a, b, p: a.rotation.matrix @ b.between(a).rotation.matrix @ p,
    "yaw": lambda a, b, p: a.between(b).rotation.yaw,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_displaced_elements_are_exact_to_first_order(name: str) -> None:
    rng = np.random.default_rng(6)
    problem = Problem()
    pose, point = problem.variables("pose", SE3, 2), problem.variables("point", Vector(3))
    term = problem.cost("term", FUNCTIONS[name], on=(pose[0], pose[1], point))
    code = residual_code(term)
    x, p = draw(SE3, rng, 2), rng.normal(size=(1, 3))

    def residual(d: np.ndarray) -> np.ndarray:
        moved = SE3.retract_array(x, d[:12].reshape(2, 6))
        return code.residual(np.concatenate([moved.ravel(), p[0] + d[12:]]).tolist(), 1)[0]

    r, J = code.residual_and_jacobian(np.concatenate([x.ravel(), p[0]]).tolist(), 1)
    h = 1e-5
    expected = np.array([(residual(h * e) - residual(-h * e)) / (2 * h) for e in np.eye(15)]).T
    np.testing.assert_allclose(J[0], expected, atol=2e-8)
    direct = numeric(lambda a, b, v: FUNCTIONS[name](SE3(a), SE3(b), v), x[0], x[1], p[0])
    np.testing.assert_allclose(r[0], np.atleast_1d(direct), atol=1e-14)


def test_jacobians_of_relative_poses_keep_the_structure_of_the_group() -> None:
    problem = Problem()
    pose = problem.variables("pose", SE3, 2)
    z = problem.data("z", 7)

    def relative(a: Pose3, b: Pose3, z: Any) -> Any:
        return SE3(z).between(a.between(b)).log()

    term = problem.cost("term", relative, on=(pose[0], pose[1]), data=z, noise=Gaussian(sigma=np.ones(6)))
    template = template_of(term)
    assert template.jacobian.nnz() == 54  # rotations do not depend on positions
    both = ca.cse(ca.vertcat(template.residual, ca.vec(ca.densify(template.jacobian))))
    count = ca.Function("f", [template.point, template.numbers], [both]).n_instructions()
    assert count < 900  # 2300 when everything is differentiated automatically


def test_points_are_normalized_and_zero_quaternions_named() -> None:
    np.testing.assert_allclose(points(SO3, [0, 0, 0, 2.0], 2, "x"), [[0, 0, 0, 1.0]] * 2)
    with pytest.raises(DataError, match="instance 1.*zero"):
        points(SE3, [[0, 0, 0, 0, 0, 0, 1.0], [1, 2, 3, 0, 0, 0, 0]], 2, "x")


def test_products_of_quaternions_compose_rotations() -> None:
    rng = np.random.default_rng(7)
    a, b = draw(SO3, rng, 20), draw(SO3, rng, 20)
    expected = (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(quaternion_product(a, b)).as_matrix(), expected, atol=1e-14)


@pytest.mark.parametrize("solver", ["gauss-newton", "ipopt"])
def test_a_mean_of_rotations_is_found(solver: str) -> None:
    rng = np.random.default_rng(8)
    true = draw(SO3, rng, 1)
    noise = rng.normal(scale=0.1, size=(40, 3))
    noise -= noise.mean(axis=0)
    z = SO3.retract_array(np.repeat(true, 40, axis=0), noise)
    problem = Problem()
    turn = problem.variables("turn", SO3)
    data = problem.data("z", 4, 40)
    problem.cost("fit", lambda R, z: SO3(z).between(R).log(), on=turn, data=data, noise=Gaussian(0.1))
    solution = problem.compile(solver).solve({"z": z})
    assert solution.status == "solved"
    assert np.linalg.norm(SO3.local_array(true, solution["turn"])) < 1e-3
