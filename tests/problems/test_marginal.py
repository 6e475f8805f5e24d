"""Marginals: Schur complements of a dense Hessian, and arrival costs that make a window a Kalman filter."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import SE2, Cauchy, Gaussian, Huber, Problem, Vector, wrap
from problems.errors import DataError, DefinitionError, UnobservableError

SOLVERS = ["auto", "gauss-newton"]
A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1.0], [0, 0, -1.21, 1.98]])
C = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])


def schur(H: np.ndarray, g: np.ndarray, drop: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    K = H[np.ix_(keep, drop)] @ np.linalg.inv(H[np.ix_(drop, drop)])
    return H[np.ix_(keep, keep)] - K @ H[np.ix_(drop, keep)], g[keep] - K @ g[drop]


def chain() -> tuple[Problem, Any, Any]:
    """Four states in a row and a bias that all measurements share; one cost has a linear part and one is off."""
    p = Problem("chain")
    x, bias = p.variables("x", Vector(2), 4), p.variables("bias", Vector(1))
    z, on = p.data("z", (), 4), p.data("on", (), 4, value=np.ones(4))
    p.cost("prior", lambda x: x - 1, on=x[0], noise=Gaussian([0.5, 2.0]), linear=[0.3, -0.2])
    p.cost("step", lambda a, b: b - ca.vertcat(a[0] + 0.1 * a[1], 0.8 * a[1]), on=(x[:-1], x[1:]), noise=Gaussian(0.3))
    p.cost("see", lambda x, b, z: x[0] + b - z, on=(x, bias), data=z, active=on, noise=Gaussian(0.1))
    p.cost("bias", lambda b: b, on=bias)
    return p, x, bias


def chain_reference(z: np.ndarray, on: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hessian and gradient at `at` of what touches x[0], in (x, bias)."""
    F = np.array([[1.0, 0.1], [0.0, 0.8]])
    H, g = np.zeros((9, 9)), np.zeros(9)
    rows: list[tuple[np.ndarray, float, float]] = []
    for k, sigma in enumerate((0.5, 2.0)):
        rows.append((np.eye(9)[k], -1.0, sigma))
        g[k] += (0.3, -0.2)[k]
    for k in range(2):
        J = np.zeros(9)
        J[2 + k] = 1.0
        J[:2] = -F[k]
        rows.append((J, 0.0, 0.3))
    if on[0] and np.isfinite(z[0]):
        J = np.zeros(9)
        J[0] = J[8] = 1.0
        rows.append((J, -z[0], 0.1))
    for J, r0, sigma in rows:
        H += np.outer(J, J) / sigma**2
        g += J * (J @ at + r0) / sigma**2
    return H, g


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("z", "on"), [([1.0, 2, 3, 4], [1, 1, 1, 1]), ([np.nan, 2, 3, 4], [1, 1, 1, 1]), ([1.0, 2, 3, 4], [0, 1, 1, 1])]
)
def test_a_marginal_is_the_schur_complement_of_what_touches_the_dropped(solver: str, z: Any, on: Any) -> None:
    p, x, bias = chain()
    session = p.compile(solver)
    solution = session.solve({"z": z, "on": on})
    at = np.concatenate([solution["x"].ravel(), solution["bias"].ravel()])
    H, g = chain_reference(np.array(z), np.array(on), at)
    for keep, columns in ((None, [2, 3, 8]), ([bias, x[1]], [8, 2, 3]), ([x[[2, 1]], bias], [4, 5, 2, 3, 8])):
        got = session.marginal(x[0], keep=keep)
        M, linear = schur(H, g, np.arange(2), np.array(columns))
        np.testing.assert_allclose(got.information, M, atol=1e-10)
        np.testing.assert_allclose(got.vector, -linear, atol=1e-8)
        np.testing.assert_array_equal(np.concatenate([r.ravel() for r in got.reference]), at[columns])
        assert [s.source.name for s in got.on] == (["x", "bias"] if keep is None else [
            k.source.name if hasattr(k, "source") else k.name for k in keep
        ])  # fmt: skip


@pytest.mark.parametrize("solver", SOLVERS)
def test_several_dropped_at_a_given_point(solver: str) -> None:
    p, x, bias = chain()
    session = p.compile(solver)
    session.update(z=[1.0, 2.0, 3.0, 4.0])
    rng = np.random.default_rng(0)
    values = {"x": rng.normal(size=(4, 2)), "bias": rng.normal(size=(1, 1))}
    got = session.marginal([x[0], x[1]], at=values)
    # twice one: drop x[0], put the result on (x[1], bias), drop x[1]
    one = session.marginal(x[0], keep=[x[1], bias], at=values)
    H, g = np.zeros((5, 5)), np.zeros(5)  # x[1], bias, x[2]
    H[:3, :3] += one.information
    g[:3] -= one.vector
    F = np.array([[1.0, 0.1], [0.0, 0.8]])
    J = np.hstack([-F, np.zeros((2, 1)), np.eye(2)]) / 0.3
    r = (values["x"][2] - F @ values["x"][1]) / 0.3
    S = np.array([[1.0, 0, 1.0, 0, 0]]) / 0.1
    s = (values["x"][1, :1] + values["bias"][0] - 2.0) / 0.1
    H, g = H + J.T @ J + S.T @ S, g + J.T @ r + S.T @ s
    M, linear = schur(H, g, np.arange(2), np.array([3, 4, 2]))
    np.testing.assert_allclose(got.information, M, atol=1e-9)
    np.testing.assert_allclose(got.vector, -linear, atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_equalities_that_touch_the_dropped_count(solver: str) -> None:
    p = Problem()
    x, w = p.variables("x", Vector(4), 3), p.variables("w", Vector(4), 2)
    first = p.data("first", 4)
    P0 = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.3
    p.cost("prior", lambda x, m: x - m, on=x[0], data=first, noise=Gaussian(covariance=P0))
    p.cost("effort", lambda w: w, on=w, noise=Gaussian(covariance=Q))
    p.cost("see", lambda x: C @ x, on=x)
    p.equality("moves", lambda x, w, n: n - A @ x - w, on=(x[:-1], w, x[1:]))
    session = p.compile(solver)
    solution = session.solve({"first": [1.0, -1.0, 0.5, 2.0]})
    got = session.marginal([x[0], w[0]], keep=x[1])
    S = C @ P0 @ C.T + np.eye(2)
    mean = np.array([1.0, -1.0, 0.5, 2.0])
    K = P0 @ C.T @ np.linalg.inv(S)
    mean, P = A @ (mean - K @ C @ mean), A @ (P0 - K @ C @ P0) @ A.T + Q
    np.testing.assert_allclose(got.information, np.linalg.inv(P), rtol=1e-8, atol=1e-7)
    at = solution["x"][1]
    np.testing.assert_allclose(got.vector, np.linalg.solve(P, mean - at), rtol=1e-6, atol=1e-6)


def poses(loss: Any) -> tuple[Problem, Any, Any]:
    p = Problem("poses")
    robot, mark = p.variables("robot", SE2, 3), p.variables("mark", Vector(2), 2)
    start, z, move = p.data("start", 3), p.data("z", 2, 4), p.data("move", 3, 2)
    p.cost("start", lambda T, z: SE2(z).between(T).local(), on=robot[0], data=start, noise=Gaussian([0.1, 0.1, 0.05]))
    p.cost(
        "move", lambda a, b, z: SE2(z).between(a.between(b)).local(), on=(robot[:-1], robot[1:]), data=move,
        noise=Gaussian(covariance=np.diag([0.04, 0.02, 0.01]) + 0.005),
    )  # fmt: skip

    def see(T: Any, m: Any, z: Any) -> Any:
        local = T.transform_to(m)
        return ca.vertcat(ca.norm_2(local) - z[0], wrap(ca.atan2(local[1], local[0]) - z[1]))

    on = (robot[[0, 0, 1, 2]], mark[[0, 1, 0, 1]])
    p.cost("see", see, on=on, data=z, noise=Gaussian([0.2, 0.1]), loss=loss)
    p.cost("marks", lambda m: m, on=mark, noise=Gaussian(50.0), active=[0, 1])
    return p, robot, mark


def pose_residuals(v: dict[str, np.ndarray], d: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Whitened residuals of what touches robot[0]."""

    def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        c, s = np.cos(a[2]), np.sin(a[2])
        u = b[:2] - a[:2]
        return np.array([c * u[0] + s * u[1], c * u[1] - s * u[0], wrap(b[2] - a[2])])

    robot, mark = v["robot"], v["mark"]
    out = [between(d["start"], robot[0]) / [0.1, 0.1, 0.05]]
    U = np.linalg.cholesky(np.linalg.inv(np.diag([0.04, 0.02, 0.01]) + 0.005)).T
    out.append(U @ between(d["move"][0], between(robot[0], robot[1])))
    for k, j in ((0, 0), (1, 1)):
        if np.isfinite(d["z"][k]).all():
            local = between(robot[0], np.array([*mark[j], 0.0]))[:2]
            r = np.array([np.linalg.norm(local) - d["z"][k, 0], wrap(np.arctan2(local[1], local[0]) - d["z"][k, 1])])
            out.append(r / [0.2, 0.1])
    return out


POSES: dict[str, Any] = {
    "start": np.array([0.3, -0.2, 3.0]),
    "move": np.array([[1.0, 0.1, 0.4], [0.9, 0.0, -0.3]]),
    "z": np.array([[2.0, 0.4], [3.5, -1.0], [1.5, 0.2], [2.5, 2.0]]),
}


@pytest.mark.parametrize("loss", [None, Huber(0.5), Cauchy(1.0)], ids=repr)
@pytest.mark.parametrize("missing", [False, True])
def test_marginals_on_manifolds_with_robust_weights(loss: Any, missing: bool) -> None:
    p, robot, mark = poses(loss)
    session = p.compile("gauss-newton")
    data = POSES | {"z": POSES["z"].copy()}
    if missing:
        data["z"][0, 1] = np.nan
    session.update(**data)
    at = {"robot": [[0.4, -0.1, -3.1], [-0.6, 0.2, -2.8], [-1.4, 0.1, -3.0]], "mark": [[-1.5, -0.8], [0.2, 3.0]]}
    layout, h = session.layout, 1e-6
    point = layout.point(at)

    def whitened(step: np.ndarray) -> list[np.ndarray]:
        return pose_residuals(layout.values(layout.retract(point, step)), data)

    n = layout.size
    up = [whitened(h * e) for e in np.eye(n)]
    down = [whitened(-h * e) for e in np.eye(n)]
    H, g = np.zeros((n, n)), np.zeros(n)
    for k, e in enumerate(whitened(np.zeros(n))):
        J = np.column_stack([(a[k] - b[k]) / (2 * h) for a, b in zip(up, down, strict=True)])
        w = float(loss.weight(e @ e)) if loss is not None and k >= 2 else 1.0
        H, g = H + w * J.T @ J, g + w * J.T @ e
    keep = [robot[1], mark[1]] if missing else [robot[1], mark]
    columns = np.concatenate([layout.columns(s if hasattr(s, "indices") else s[:]).ravel() for s in keep])
    # a mark whose measurement is missing stays with no information
    got = session.marginal(robot[0], keep=[robot[1], mark], at=at)
    M, linear = schur(H, g, np.arange(3), columns)
    if missing:
        np.testing.assert_allclose(got.information[3:5], 0.0, atol=1e-12)
        pick = np.array([0, 1, 2, 5, 6])
        information, vector = got.information[np.ix_(pick, pick)], got.vector[pick]
    else:
        information, vector = got.information, got.vector
    np.testing.assert_allclose(information, M, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(vector, -linear, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(got.reference[0], layout.value(point, "robot")[[1]])


def test_a_marginal_replaces_what_was_dropped() -> None:
    p, robot, mark = poses(None)
    whole = p.compile("gauss-newton", tolerance=1e-15)
    solution = whole.solve(POSES, initial={"robot": [[0.3, -0.2, 3.0]] * 3, "mark": [[-1.5, -0.8], [0.2, 3.0]]})
    got = whole.marginal(robot[0], keep=[robot[1], mark])
    rest = Problem("rest")
    robot, mark = rest.variables("robot", SE2, 2), rest.variables("mark", Vector(2), 2)
    M = rest.data("M", (7, 7), value=got.information)
    m = rest.data("m", 7, value=-got.vector)
    ref, ref_mark = rest.data("ref", 3, value=got.reference[0]), rest.data("ref_mark", (2, 2), value=got.reference[1])

    def away(T: Any, a: Any, b: Any, r: Any, s: Any) -> Any:
        return ca.vertcat(SE2(r).between(T).local(), a - s[0, :].T, b - s[1, :].T)

    rest.cost(
        "arrival", away, on=(robot[0], mark[0], mark[1]), data=(ref, ref_mark), noise=Gaussian(information=M), linear=m
    )
    rest.cost(
        "move", lambda a, b: SE2(ca.DM(POSES["move"][1])).between(a.between(b)).local(), on=(robot[0], robot[1]),
        noise=Gaussian(covariance=np.diag([0.04, 0.02, 0.01]) + 0.005),
    )  # fmt: skip
    for k, (i, j) in ((2, (0, 0)), (3, (1, 1))):

        def see(T: Any, q: Any, z: Any = tuple(POSES["z"][k])) -> Any:
            local = T.transform_to(q)
            return ca.vertcat(ca.norm_2(local) - z[0], wrap(ca.atan2(local[1], local[0]) - z[1]))

        rest.cost(f"see{k}", see, on=(robot[i], mark[j]), noise=Gaussian([0.2, 0.1]))
    rest.cost("marks", lambda m: m, on=mark[1], noise=Gaussian(50.0))
    small = rest.compile("gauss-newton", tolerance=1e-15).solve(
        initial={"robot": solution["robot"][1:], "mark": solution["mark"]}
    )
    np.testing.assert_allclose(small["robot"], solution["robot"][1:], atol=1e-6)
    np.testing.assert_allclose(small["mark"], solution["mark"], atol=1e-6)
    big, tiny = solution.covariance(p.unknowns["robot"][1:]), small.covariance(robot)
    np.testing.assert_allclose(tiny, big, rtol=1e-4, atol=1e-7)


# --- arrival costs ---------------------------------------------------------------------------------------------------


def window(N: int, noise: str) -> tuple[Problem, Any, Any]:
    p = Problem("window")
    x = p.variables("x", Vector(4), N + 1)
    y = p.data("y", 2, N + 1, value=np.full((N + 1, 2), np.nan))
    ref, M, m = (
        p.data("ref", 4, value=np.zeros(4)),
        p.data("M", (4, 4), value=np.eye(4)),
        p.data("m", 4, value=np.zeros(4)),
    )
    p.cost("arrival", lambda x, r: x - r, on=x[0], data=ref, noise=Gaussian(information=M), linear=m)
    p.cost("output", lambda x, y: y - C @ x, on=x, data=y)
    if noise == "variable":
        w = p.variables("w", Vector(4), N)
        p.cost("effort", lambda w: w, on=w, noise=Gaussian(covariance=Q))
        p.equality("moves", lambda x, w, n: n - A @ x - w, on=(x[:-1], w, x[1:]))
        return p, x, [x[0], w[0]]
    p.cost("moves", lambda x, n: n - A @ x, on=(x[:-1], x[1:]), noise=Gaussian(covariance=Q))
    return p, x, x[0]


@pytest.mark.parametrize("N", [1, 3, 10])
@pytest.mark.parametrize("noise", ["residual", "variable"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_window_is_a_kalman_filter_for_every_horizon(N: int, noise: str, solver: str) -> None:
    p, x, drop = window(N, noise)
    session = p.compile(solver, tolerance=1e-12 if solver == "gauss-newton" else 1e-8)
    rng = np.random.default_rng(N)
    truth, mean, P = rng.normal(size=4), np.zeros(4), np.eye(4)
    Y = np.full((N + 1, 2), np.nan)
    for t in range(40):
        y = C @ truth + rng.normal(size=2)
        if t in (7, 8, 20):
            y[:] = np.nan
        if t:
            mean, P = A @ mean, A @ P @ A.T + Q
        if np.isfinite(y).all():
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(2))
            mean, P = mean + K @ (y - C @ mean), P - K @ C @ P
        if t > N:
            arrival = session.marginal(drop, keep=x[1])
            Y[:-1] = Y[1:]
            session.update(ref=arrival.reference[0], M=arrival.information, m=-arrival.vector)
        Y[min(t, N)] = y
        newest = session.solve({"y": Y})["x"][min(t, N)]
        np.testing.assert_allclose(newest, mean, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(mean).max()))
        truth = A @ truth + np.sqrt(np.diag(Q)) * rng.normal(size=4)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_cannot_be_marginalized_is_named(solver: str) -> None:
    p, x, bias = chain()
    session = p.compile(solver)
    session.update(z=np.ones(4))
    with pytest.raises(DataError, match="marginal needs a point"):
        session.marginal(x[0])
    session.solve()
    for keep, text in (
        ([x[1]], "leaves out variables"),
        ([x[1], bias, x[1]], "names an instance twice"),
        ([x, bias], "or one that is dropped"),
        ([x[[1, 1]], bias], "names an instance twice"),
        (["x"], "expected variables of problem 'chain'"),
    ):
        with pytest.raises(DefinitionError, match=f"marginal: .*{text}"):
            session.marginal(x[0], keep=keep)
    with pytest.raises(DefinitionError, match="marginal: expected variables"):
        session.marginal("x")


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_dropped_variable_that_nothing_determines_is_named(solver: str) -> None:
    p = Problem()
    x, s = p.variables("x", Vector(2), 2), p.data("s", (), 2)
    p.cost("see", lambda a, b, s: a[0] - b[0] + s, on=(x[0], x[1]), data=s[0])
    p.cost("prior", lambda x, s: x - s, on=x, data=s)
    session = p.compile(solver)
    session.solve({"s": [1.0, 2.0]})
    session.marginal(x[0])
    session.update(s=[np.nan, 2.0])
    with pytest.raises(UnobservableError, match="marginal: the costs leave a dropped variable free"):
        session.marginal(x[0], at={"x": np.zeros((2, 2))})


@pytest.mark.parametrize("solver", SOLVERS)
def test_rounding_does_not_make_a_dropped_variable_determined(solver: str) -> None:
    p = Problem()
    x = p.variables("x", Vector(2), 2)
    p.cost("see", lambda a, b: ca.vertcat(0.1 * a[0] + 0.3 * a[1], 0.7 * a[0] + 2.1 * a[1]) - b, on=(x[0], x[1]))
    p.cost("more", lambda a: 1.1 * a[0] + 3.3 * a[1], on=x[0])
    p.cost("hold", lambda a: a, on=x[1])
    p.inequality("box", lambda x: x, on=x[0], lower=-1.0, upper=1.0)
    p.cost("linear", lambda x: x[0], on=x[0], noise=Gaussian(information=0.0), linear=1.0)
    with pytest.raises(UnobservableError, match="marginal: the costs leave a dropped variable free"):
        p.compile(solver).marginal(x[0], at={"x": np.zeros((2, 2))})


@pytest.mark.parametrize("solver", SOLVERS)
def test_marginals_follow_weights_and_data(solver: str) -> None:
    p = Problem()
    x, z, W = p.variables("x", Vector(1), 2), p.data("z"), p.data("W", (1, 1), value=[[1.0]])
    p.cost("prior", lambda x, z: x - z, on=x[0], data=z, noise=Gaussian(information=W))
    p.cost("step", lambda a, b: b - a, on=(x[0], x[1]))
    session = p.compile(solver)
    for z_, W_ in ((1.0, 1.0), (1.0, 3.0), (-2.0, 3.0), (5.0, 1.0)):
        session.solve({"z": z_, "W": W_ * np.eye(1)})
        got = session.marginal(x[0])
        M = W_ / (1 + W_)
        assert got.information.item() == pytest.approx(M)
        assert got.vector.item() == pytest.approx(M * (z_ - got.reference[0].item()), abs=1e-9)
