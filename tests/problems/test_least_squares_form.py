"""Costs and constraints on manifolds: cost code, patterns, pins and factorizations against plain NumPy."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp

from problems import SE2, SO2, Cauchy, Gaussian, GemanMcClure, Huber, Problem, Tukey, Vector, wrap
from problems.errors import DataError, UnobservableError
from problems.forms.layout import DataStore, Layout
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.pins import Pins
from problems.solvers.factorizations import CLASSES, SingularError
from problems.solvers.linear import covariance_blocks, factorized_kkt

ROBOTS, POINTS = 5, 4


def see(pose: Any, point: Any, bias: Any, z: Any) -> Any:
    local = pose.transform_to(point)
    return ca.vertcat(ca.norm_2(local) - z[0] - bias, wrap(ca.atan2(local[1], local[0]) - z[1]))


def see_numpy(pose: np.ndarray, point: np.ndarray, bias: np.ndarray, z: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    d = point - pose[:2]
    local = np.array([c * d[0] + s * d[1], c * d[1] - s * d[0]])
    return np.array([np.linalg.norm(local) - z[0] - bias[0], wrap(np.arctan2(local[1], local[0]) - z[1])])


def odometry(a: Any, b: Any, z: Any) -> Any:
    return SE2(z).between(a.between(b)).local()


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def inverse(a: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def odometry_numpy(a: np.ndarray, b: np.ndarray, z: np.ndarray) -> np.ndarray:
    out = compose(inverse(z), compose(inverse(a), b))
    return np.array([out[0], out[1], wrap(out[2])])


def align(angle: Any, pose: Any) -> Any:
    return wrap(angle.angle - pose.angle)


def align_numpy(angle: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return wrap(angle - pose[2:])


def tie(point: Any, other: Any) -> Any:
    return point + ca.sin(other)


def tie_numpy(point: np.ndarray, other: np.ndarray) -> np.ndarray:
    return point + np.sin(other)


class World:
    """A problem with every space, and its cost written once more in NumPy."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.p = p = Problem("world")
        self.robot = p.variables("robot", SE2, ROBOTS)
        self.point = p.variables("point", Vector(2), POINTS)
        self.bias = p.variables("bias", Vector(1))
        self.angle = p.variables("angle", SO2, ROBOTS)
        m = 9
        self.i, self.j = rng.integers(0, ROBOTS, m), rng.integers(0, POINTS, m)
        self.a, self.b = rng.integers(0, ROBOTS, 6), rng.integers(0, ROBOTS, 6)  # also one robot twice
        z, move = p.data("z", 2, m), p.data("move", 3, 6)
        root = rng.normal(size=(6, 3, 3))
        self.covariance = root @ root.swapaxes(1, 2) + np.eye(3)
        self.losses = {"see": rng.choice([Huber(1.0), Cauchy(2.0), Tukey(9.0)]), "move": GemanMcClure(3.0)}
        spread, self.linear = p.data("spread", 2, m), rng.normal(size=(POINTS, 2))
        self.on = rng.random(ROBOTS) < 0.7
        p.cost(
            "see", see, on=(self.robot[self.i], self.point[self.j], self.bias), data=z, noise=Gaussian(spread),
            loss=self.losses["see"],
        )  # fmt: skip
        p.cost(
            "move", odometry, on=(self.robot[self.a], self.robot[self.b]), data=move,
            noise=Gaussian(covariance=self.covariance), loss=self.losses["move"],
        )  # fmt: skip
        p.cost("align", align, on=(self.angle, self.robot), active=self.on, noise=Gaussian(0.3))
        p.cost("tie", tie, on=(self.point, self.point[[1, 1, 3, 3]]), linear=self.linear)
        p.cost("lone", lambda b: b - 1, on=self.bias, noise=Gaussian(0.2))
        self.values = {
            "z": rng.normal(size=(m, 2)),
            "move": rng.normal(size=(6, 3)),
            "spread": np.exp(rng.normal(size=(m, 2))),
        }
        self.values["z"][2, 1] = np.nan
        self.layout = Layout(p)
        self.store = DataStore(self.layout)
        for name, value in self.values.items():
            self.store.set(name, value)
        self.at = 2 * rng.normal(size=self.layout.stored_size)

    def cost(self, point: np.ndarray) -> tuple[float, list[tuple[np.ndarray, float, np.ndarray | None]]]:
        """The cost; per instance the whitened residual, its robust weight, and a linear part."""
        v = self.layout.values(point)
        terms: list[tuple[np.ndarray, Any, np.ndarray | None, np.ndarray]] = []
        for k in range(len(self.i)):
            if np.isfinite(self.values["z"][k]).all():
                r = see_numpy(v["robot"][self.i[k]], v["point"][self.j[k]], v["bias"][0], self.values["z"][k])
                terms.append((r / self.values["spread"][k], self.losses["see"], None, r))
        for k in range(6):
            r = odometry_numpy(v["robot"][self.a[k]], v["robot"][self.b[k]], self.values["move"][k])
            L = np.linalg.cholesky(np.linalg.inv(self.covariance[k]))
            terms.append((L.T @ r, self.losses["move"], None, r))
        for k in np.flatnonzero(self.on):
            r = align_numpy(v["angle"][k], v["robot"][k])
            terms.append((r / 0.3, None, None, r))
        for k in range(POINTS):
            r = tie_numpy(v["point"][k], v["point"][[1, 1, 3, 3][k]])
            terms.append((r, None, self.linear[k], r))
        r = v["bias"][0] - 1
        terms.append((r / 0.2, None, None, r))
        total, out = 0.0, []
        for e, loss, linear, r in terms:
            s = float(e @ e)
            total += s / 2 if loss is None else float(loss.rho(s))
            total += 0.0 if linear is None else float(linear @ r)
            out.append((e, 1.0 if loss is None else float(loss.weight(s)), linear))
        return total, out

    def reference(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, gradient and Gauss-Newton Hessian by differences of whitened residuals."""
        n, h = self.layout.size, 1e-6
        value, here = self.cost(self.at)
        slopes = [np.zeros((e.size, n)) for e, _, _ in here]
        gradient = np.zeros(n)
        for k in range(n):
            step = np.zeros(n)
            step[k] = h
            (up, ahead), (down, behind) = (self.cost(self.layout.retract(self.at, s)) for s in (step, -step))
            gradient[k] = (up - down) / (2 * h)
            for J, a, b in zip(slopes, ahead, behind, strict=True):
                J[:, k] = (a[0] - b[0]) / (2 * h)
        return value, gradient, sum(w * J.T @ J for (_, w, _), J in zip(here, slopes, strict=True))


def full(form: LeastSquares, entries: np.ndarray) -> np.ndarray:
    n = form.pattern.size
    H = np.zeros((n, n))
    H[form.pattern.indices, np.repeat(np.arange(n), np.diff(form.pattern.indptr))] = entries
    return H + np.triu(H, 1).T


@pytest.mark.parametrize("seed", range(10))
def test_costs_equal_the_reference(seed: int) -> None:
    world = World(seed)
    value, gradient, H = world.reference()
    form = LeastSquares(world.p, world.layout)
    bound = form.bind(world.store)
    cost, g, entries = bound.linearize(world.at)
    assert cost == pytest.approx(value, rel=1e-12)
    assert bound.cost(world.at) == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(g, gradient, atol=2e-7 * max(1.0, np.abs(gradient).max()))
    np.testing.assert_allclose(full(form, entries), H, atol=2e-7 * max(1.0, np.abs(H).max()))
    alone, slope = bound.gradient(world.at)
    assert alone == pytest.approx(cost, rel=1e-14)
    np.testing.assert_allclose(slope, g, rtol=1e-12, atol=1e-12)


def test_what_was_bound_does_not_follow_later_data() -> None:
    world = World(1)
    form = LeastSquares(world.p, world.layout)
    bound = form.bind(world.store)
    before = [np.array(part) for part in bound.linearize(world.at)]
    world.store.set("z", np.zeros((9, 2)))
    world.store.set("spread", np.ones((9, 2)))
    other = form.bind(world.store)
    assert abs(other.cost(world.at) - bound.cost(world.at)) > 1e-3
    for a, b in zip(before, bound.linearize(world.at), strict=True):
        np.testing.assert_array_equal(a, b)


def test_results_are_new_arrays() -> None:
    world = World(2)
    bound = LeastSquares(world.p, world.layout).bind(world.store)
    _, g, h = bound.linearize(world.at)
    kept = g.copy(), h.copy()
    bound.linearize(world.at + 0.1)
    np.testing.assert_array_equal(g, kept[0])
    np.testing.assert_array_equal(h, kept[1])


def test_instances_that_are_off_count_nothing_even_where_they_are_not_finite() -> None:
    p = Problem()
    x, z, on = p.variables("x", Vector(1), 3), p.data("z", (), 3), p.data("on", (), 3)
    p.cost("c", lambda x, z: ca.log(x) - ca.sqrt(z), on=x, data=z, active=on)
    form = LeastSquares(p, Layout(p))
    store = DataStore(form.layout)
    store.set("z", [4.0, np.nan, -1.0])
    store.set("on", [1, 1, 0])
    cost, g, h = form.bind(store).linearize(np.array([1.0, -1.0, -1.0]))
    assert cost == pytest.approx(2.0)
    np.testing.assert_allclose(g, [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(h, [1.0, 0.0, 0.0])


def test_a_problem_without_costs_costs_nothing() -> None:
    p = Problem()
    p.inequality("box", lambda x: x, on=p.variables("x", Vector(2)), lower=0.0)
    layout = Layout(p)
    bound = LeastSquares(p, layout).bind(DataStore(layout))
    cost, g, h = bound.linearize(np.ones(2))
    assert cost == bound.cost(np.ones(2)) == 0.0
    assert not g.any() and not h.any() and g.size == 2


def test_instances_of_inequalities_that_are_off_read_zero() -> None:
    p = Problem()
    x, z = p.variables("x", Vector(2), 3), p.data("z", 2, 3)
    p.cost("c", lambda x: x, on=x)
    p.inequality("keep_off", lambda x, z: 1 / ca.norm_2(x - z), on=x, data=z)
    layout = Layout(p)
    form, rows = LeastSquares(p, layout), Constraints(layout)
    store = DataStore(layout)
    store.set("z", [[3.0, 4.0], [np.nan, 0.0], [0.0, 2.0]])
    bound, at = form.bind(store), np.zeros(6)
    values, entries = rows.evaluate(at, bound.numbers, bound.flags)
    np.testing.assert_allclose(values, [0.2, 0.0, 0.5])
    assert np.isfinite(entries).all()
    np.testing.assert_allclose(rows.residual(at, bound.numbers, bound.flags), values)
    low, high = rows.bounds(bound.numbers, bound.flags)
    np.testing.assert_array_equal(high, [0.0, np.inf, 0.0])
    np.testing.assert_array_equal(low, -np.inf)


def test_infinite_data_are_named() -> None:
    world = World(3)
    world.store.set("move", np.full((6, 3), np.inf))
    with pytest.raises(DataError, match="data 'move' have an infinite value"):
        LeastSquares(world.p, world.layout).bind(world.store)


# --- pins ------------------------------------------------------------------------------------------------------------


def pinned() -> tuple[Problem, Any, Any, Pins]:
    p = Problem()
    robot, x = p.variables("robot", SE2, 3), p.variables("x", Vector(2), 3)
    z, target = p.data("z", 3), p.data("target", (), 2)
    p.cost("c", lambda T, x: T.transform_to(x), on=(robot, x))
    p.equality("start", lambda T, z: SE2(z).between(T).local(), on=robot[1], data=z)
    p.equality("bent", lambda x, t: ca.vertcat(x[0] ** 3 - t, x[1] + x[0]), on=x[[2, 0]], data=target)
    p.equality("part", lambda x: x[0], on=x[1])
    p.equality("again", lambda T: T.coordinates, on=robot[1])
    p.equality("blind", lambda x: ca.vertcat(x[0], 2 * x[0]), on=x[1])
    p.equality("joint", lambda a, b: a - b, on=(x[0], x[1]))
    return p, robot, x, Pins(Layout(p))


def test_equalities_that_fix_an_instance_are_found_once() -> None:
    p, robot, x, pins = pinned()
    assert pins.names == {"start", "bent"}
    layout = Layout(p)
    expected = np.concatenate([layout.columns(s).ravel() for s in (robot[1], x[0], x[2])])
    np.testing.assert_array_equal(pins.columns, np.sort(expected))


def test_pins_move_their_instances_and_nothing_else() -> None:
    p, robot, x, pins = pinned()
    layout = Layout(p)
    store = DataStore(layout)
    store.set("z", [1.0, -2.0, 3.0])
    store.set("target", [8.0, 27.0])
    start = np.random.default_rng(0).uniform(1.0, 2.0, layout.stored_size)
    assert pins.violation(start, store.numbers) > 0.1
    at = pins.apply(start, store.numbers)
    assert pins.violation(at, store.numbers) < 1e-13
    v, before = layout.values(at), layout.values(start)
    np.testing.assert_allclose(v["robot"][1], [1.0, -2.0, 3.0])
    np.testing.assert_allclose(v["x"][[2, 0]], [[2.0, -2.0], [3.0, -3.0]])
    np.testing.assert_array_equal(v["robot"][[0, 2]], before["robot"][[0, 2]])
    np.testing.assert_array_equal(v["x"][1], before["x"][1])


def test_pins_that_cannot_hold_say_how_far_they_are() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.equality("none", lambda x: x**2 + 1, on=x)
    pins = Pins(Layout(p))
    at = pins.apply(np.array([0.5]), np.zeros(0))
    assert pins.violation(at, np.zeros(0)) >= 1.0


def test_pins_take_rows_and_columns_out_of_the_hessian() -> None:
    p, robot, x, pins = pinned()
    form = LeastSquares(p, Layout(p))
    n = form.pattern.size
    gradient, entries = np.ones(n), np.arange(1.0, form.pattern.nonzeros + 1)
    before = full(form, entries)
    pins.reduce(gradient, entries, form.pattern)
    H, free = full(form, entries), np.setdiff1d(np.arange(n), pins.columns)
    np.testing.assert_array_equal(H[np.ix_(pins.columns, pins.columns)], np.eye(pins.columns.size))
    np.testing.assert_array_equal(H[np.ix_(free, pins.columns)], 0.0)
    np.testing.assert_array_equal(H[np.ix_(free, free)], before[np.ix_(free, free)])
    np.testing.assert_array_equal(gradient, np.where(np.isin(np.arange(n), pins.columns), 0.0, 1.0))


# --- factorizations --------------------------------------------------------------------------------------------------


def pattern_and_matrix(seed: int, shift: float) -> tuple[Any, np.ndarray, np.ndarray]:
    world = World(seed)
    form = LeastSquares(world.p, world.layout)
    rng = np.random.default_rng(seed)
    n = form.pattern.size
    rows, columns = form.pattern.indices, np.repeat(np.arange(n), np.diff(form.pattern.indptr))
    entries = 0.1 * rng.normal(size=form.pattern.nonzeros)
    entries[rows == columns] = shift + rng.random(n)
    return form.pattern, entries, full(form, entries)


def installed() -> list[Any]:
    packages = {"pardiso": "pypardiso", "cholmod": "cvxopt"}
    return [cls for name, cls in CLASSES.items() if find_spec(packages.get(name, "numpy"))]


@pytest.mark.parametrize("kind", installed())
def test_factorizations_solve_again_and_again(kind: Any) -> None:
    for seed in range(3):
        pattern, entries, H = pattern_and_matrix(seed, 3.0)
        solver = kind(pattern)
        b = np.random.default_rng(seed).normal(size=(pattern.size, 3))
        for scale in (1.0, 2.5):
            solver.factor(scale * entries)
            np.testing.assert_allclose(solver.solve(b[:, 0]), np.linalg.solve(scale * H, b[:, 0]), atol=1e-10)
            np.testing.assert_allclose(solver.solve(b), np.linalg.solve(scale * H, b), atol=1e-10)


@pytest.mark.parametrize("kind", installed())
def test_matrices_that_are_not_finite_or_empty_are_refused_and_the_next_one_is_taken(kind: Any) -> None:
    pattern, entries, H = pattern_and_matrix(0, 3.0)
    solver = kind(pattern)
    for bad in (np.full_like(entries, np.nan), np.zeros_like(entries)):
        with pytest.raises(SingularError):
            solver.factor(bad.copy())
        solver.factor(entries.copy())
        np.testing.assert_allclose(H @ solver.solve(np.ones(pattern.size)), 1.0)


@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e8])
def test_kkt_systems_are_solved_or_show_what_is_free(scale: float) -> None:
    rng = np.random.default_rng(4)
    n, m = 30, 6
    J, F = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    units = 10.0 ** rng.uniform(-3, 3, n)
    P = scale * (J * units).T @ (J * units)
    F = F * units
    solve, free, _ = factorized_kkt(sp.csr_array(P), sp.csr_array(F))
    assert free is None and solve is not None
    K = np.block([[P, F.T], [F, np.zeros((m, m))]])
    right = K @ np.repeat(np.array([1.0] * n + [scale] * m)[:, None], 2, axis=1)
    x = solve(right)
    np.testing.assert_allclose(x[:n], 1.0, rtol=1e-5)
    np.testing.assert_allclose(solve(right[:, 0]), x[:, 0], rtol=1e-7)
    # a direction in the null space of the rows that no cost sees
    d = np.linalg.svd(F / np.linalg.norm(F, axis=1)[:, None])[2][-1]
    J = J * units
    J = J - np.outer(J @ d, d) / (d @ d)
    solve, free, _ = factorized_kkt(sp.csr_array(scale * J.T @ J), sp.csr_array(F))
    assert solve is None and free is not None
    assert abs(free @ d) / (np.linalg.norm(free) * np.linalg.norm(d)) > 1 - 1e-6


def test_rows_that_repeat_or_are_empty_do_not_make_a_kkt_system_singular() -> None:
    rng = np.random.default_rng(5)
    J, F = rng.normal(size=(8, 8)), rng.normal(size=(2, 8))
    P, more = J.T @ J, np.vstack([F, F[0], np.zeros(8)])
    solve, free, _ = factorized_kkt(sp.csr_array(P), sp.csr_array(more))
    assert solve is not None and free is None
    right = np.zeros((12, 8))
    right[:8] = np.eye(8)
    Z = np.linalg.svd(F)[2][2:].T
    np.testing.assert_allclose(solve(right)[:8], Z @ np.linalg.inv(Z.T @ P @ Z) @ Z.T, atol=1e-9)


def test_covariance_names_what_is_free() -> None:
    p = Problem()
    p.variables("x", Vector(2), 2), p.variables("y", Vector(1), 3)
    layout = Layout(p)
    H = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 7.0])
    none = sp.csr_array((0, 7))
    with pytest.raises(UnobservableError, match=r"the costs leave y\[1\] free"):
        covariance_blocks(layout, sp.csr_array(H), none, np.array([0]))
    row = sp.csr_array(np.array([[0, 0, 0, 0, 1.0, -1.0, 0]]))
    got = covariance_blocks(layout, sp.csr_array(H), row, np.array([4, 5]))
    np.testing.assert_allclose(got, np.full((2, 2), 0.2), atol=1e-10)
