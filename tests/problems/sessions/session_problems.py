"""A window with bounds and a team on the plane, with data, for the tests of sessions."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from problems import SE2, Gaussian, Problem, Vector, wrap

A = np.array([[0.9, 0.2], [-0.1, 0.8]])


N = 4


QP = ["auto", "daqp", "proxqp", "osqp"]


ALL = [*QP, "gauss-newton"]


def window() -> Problem:
    """States in a box, weights and a matrix as data."""
    p = Problem("window")
    x, w = p.variables("x", Vector(2), N + 1), p.variables("w", Vector(2), N)
    y, C, R = p.data("y", 1, N + 1), p.data("C", (1, 2), value=[[1.0, 0.3]]), p.data("R", (), value=0.5)
    prior, P = p.data("prior", 2, value=[0.0, 0.0]), p.data("P", (2, 2), value=np.eye(2))
    on = p.data("on", (), N + 1, value=np.ones(N + 1))
    p.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(covariance=P))
    p.cost("output", lambda x, y, C: y - C @ x, on=x, data=(y, C), noise=Gaussian(R), active=on)
    p.cost("effort", lambda w: w, on=w, noise=Gaussian(0.4))
    p.equality("moves", lambda x, w, n: n - A @ x - w, on=(x[:-1], w, x[1:]))
    p.inequality("box", lambda x: x, on=x, lower=-0.5, upper=0.5)
    return p


def outputs(seed: int, scale: float = 4.0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(N + 1, 1))


def sequence(seed: int, steps: int = 6) -> list[dict[str, Any]]:
    """Data of several solves: measurements, some missing, now and then new weights."""
    rng = np.random.default_rng(seed)
    out: list[dict[str, Any]] = []
    for k in range(steps):
        y = 3.0 * rng.normal(size=(N + 1, 1))
        y[rng.random(N + 1) < 0.2] = np.nan
        out.append({"y": y})
        if k % 3 == 2:
            out[-1]["P"] = (1 + rng.random()) * np.eye(2)
            out[-1]["R"] = 0.3 + rng.random()
        if k % 3 == 1:
            out[-1]["C"] = np.array([[1.0, rng.random()]])
    return out


def team(count: int = 5, fence: float | None = None, loss: Any = None, gauge: bool = False) -> tuple[Problem, Any, Any]:
    """Robots on a line that see their neighbours' range and bearing."""
    p = Problem("team")
    robot = p.variables("robot", SE2, count)
    i = np.arange(count - 1)
    gps, heading = p.data("gps", 2, count), p.data("heading", (), count)
    z = p.data("z", 2, count - 1)

    def see(a: Any, b: Any, z: Any) -> Any:
        local = a.transform_to(b.translation)
        return ca.vertcat(ca.norm_2(local) - z[0], wrap(ca.atan2(local[1], local[0]) - z[1]))

    p.cost("see", see, on=(robot[i], robot[i + 1]), data=z, noise=Gaussian([0.1, 0.05]), loss=loss)
    p.cost("heading_", lambda T, z: wrap(T.angle - z), on=robot, data=heading, noise=Gaussian(0.1))
    if not gauge:
        p.cost("gps_", lambda T, z: T.translation - z, on=robot, data=gps, noise=Gaussian(1.0))
    if fence is not None:
        p.inequality("fence", lambda T: T.translation[0] + 0.02 * T.translation[1] ** 2, on=robot, upper=fence)
    return p, robot, z


def team_data(count: int = 5, seed: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    rng = np.random.default_rng(seed)
    truth = np.column_stack([2.0 * np.arange(count), rng.normal(size=count), rng.uniform(-3, 3, count)])
    d = truth[1:, :2] - truth[:-1, :2]
    bearing = wrap(np.arctan2(d[:, 1], d[:, 0]) - truth[:-1, 2])
    z = np.column_stack([np.linalg.norm(d, axis=1), bearing]) + [0.1, 0.05] * rng.normal(size=(count - 1, 2))
    data = {
        "gps": truth[:, :2] + rng.normal(size=(count, 2)),
        "heading": wrap(truth[:, 2] + 0.1 * rng.normal(size=count)),
        "z": z,
    }
    return data, {"robot": np.column_stack([data["gps"], data["heading"]])}


def team_residuals(point: np.ndarray, data: dict[str, Any]) -> np.ndarray:
    """Whitened residuals in NumPy, range-bearing pairs first."""
    T = point.reshape(-1, 3)
    d = T[1:, :2] - T[:-1, :2]
    c, s = np.cos(T[:-1, 2]), np.sin(T[:-1, 2])
    u, v = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    see = np.column_stack([np.hypot(u, v) - data["z"][:, 0], wrap(np.arctan2(v, u) - data["z"][:, 1])]) / [0.1, 0.05]
    return np.concatenate([see.ravel(), wrap(T[:, 2] - data["heading"]) / 0.1, (T[:, :2] - data["gps"]).ravel()])


def differences(function: Any, at: np.ndarray) -> np.ndarray:
    """Derivatives in tangent coordinates of the SE2 point `at` (n, 3) by central differences."""
    h, out = 1e-6, []
    for e in np.eye(at.size):
        up, down = (SE2.retract_array(at, s * h * e.reshape(at.shape)) for s in (1, -1))
        out.append((np.asarray(function(up)) - np.asarray(function(down))) / (2 * h))
    return np.stack(out, axis=-1)


def equal(got: np.ndarray, want: np.ndarray, solver: str) -> None:
    """To the bit; proxqp rounds by where its memory happens to lie, auto by whether it knows the weights."""
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 if solver in ("auto", "proxqp") else 0.0)
