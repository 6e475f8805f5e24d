"""Windows of two sensors whose weights differ by up to 1e12, by every QP backend, against rational arithmetic."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from problems import Gaussian, Problem, Vector
from problems.errors import MissingExtraError, UnknownNameError
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.compile import load_solver
from problems.solvers.qp_check import judge, residuals
from problems.solvers.qp_osqp import OSQP
from problems.solvers.qp_scaling import Scaling, uneven

STEPS = 3
MODEL = np.array([[1.0, 1.0], [0.0, 1.0]])
BOUND = 6.9
BACKENDS = "daqp osqp proxqp piqp quadprog clarabel highs qpoases qrqp hpipm qpsolvers:daqp qpsolvers:cvxopt".split()
RATIOS = [1e6, 1e9, 1e12]


class TwoSensors:
    """A body that moves along a line, far from the origin; a fine and a coarse sensor.

    Args:
        ratio: weight of the fine sensor; the coarse one has the weight 1, whatever unit `coarse` gives it.
        apart: the sensors see position and speed; otherwise their sum and their difference, so that P holds both
            weights in the same entries.
        bound: upper bound of all speeds.
    """

    def __init__(self, ratio: float, apart: bool, bound: float | None, coarse: float = 1.0) -> None:
        rng = np.random.default_rng(0)
        sensors = np.eye(2) if apart else np.array([[1.0, 1.0], [1.0, -1.0]])
        states = [np.array([300.0, 7.0])]
        for _ in range(STEPS):
            states.append(MODEL @ states[-1] + 0.3 * rng.normal(size=2))
        measured = np.array(states) @ sensors.T + rng.normal(size=(STEPS + 1, 2)) / np.sqrt([ratio, 1.0])
        self.data = {"fine": measured[:, :1], "coarse": measured[:, 1:], "guess": states[0] + rng.normal(size=2)}
        self.weights = {"fine": ratio * coarse, "coarse": coarse, "process": 10.0 * coarse, "prior": coarse}
        self.sensors, self.bound = sensors, bound

    def problem(self, noise: bool) -> Problem:
        """With process noise as a cost on two states, or as unknowns that equalities define."""
        problem, weights = Problem("two sensors"), self.weights
        x = problem.variables("x", Vector(2), count=STEPS + 1)
        data = [problem.data(name, 1, count=STEPS + 1) for name in ("fine", "coarse")]
        for name, row, read in zip(("fine", "coarse"), self.sensors, data, strict=True):

            def sensor(x: Any, y: Any, row: np.ndarray = row) -> Any:
                return row[None] @ x - y

            problem.cost(name, sensor, on=x, data=read, noise=Gaussian(information=weights[name] * np.eye(1)))
        process = Gaussian(information=weights["process"] * np.eye(2))
        if noise:
            w = problem.variables("w", Vector(2), count=STEPS)
            problem.cost("process", lambda w: w, on=w, noise=process)
            problem.equality("model", lambda x, w, y: y - MODEL @ x - w, on=(x[:-1], w, x[1:]))
        else:
            problem.cost("process", lambda x, y: y - MODEL @ x, on=(x[:-1], x[1:]), noise=process)
        guess = problem.data("guess", 2)
        prior = Gaussian(information=weights["prior"] * np.eye(2))
        problem.cost("prior", lambda x, z: x - z, on=x[0], data=guess, noise=prior)
        if self.bound is not None:
            problem.inequality("speed", lambda x: x[1:2], on=x, upper=self.bound)
        return problem

    def exact(self) -> np.ndarray:
        """States of the minimiser, by the active rows of the bound, in rational arithmetic."""
        n = 2 * (STEPS + 1)
        H, g = [[Fraction(0)] * n for _ in range(n)], [Fraction(0)] * n

        def add(row: dict[int, float], value: float, weight: float) -> None:
            for i, a in row.items():
                g[i] += Fraction(weight) * Fraction(a) * Fraction(value)
                for j, b in row.items():
                    H[i][j] += Fraction(weight) * Fraction(a) * Fraction(b)

        for k in range(STEPS + 1):
            for name, row in zip(("fine", "coarse"), self.sensors, strict=True):
                add({2 * k: row[0], 2 * k + 1: row[1]}, self.data[name][k, 0], self.weights[name])
        for k in range(STEPS):
            for i in range(2):
                add({2 * k + 2 + i: 1.0, 2 * k: -MODEL[i, 0], 2 * k + 1: -MODEL[i, 1]}, 0.0, self.weights["process"])
        for i in range(2):
            add({i: 1.0}, self.data["guess"][i], self.weights["prior"])
        active: list[int] = []
        while True:
            size = n + len(active)
            M = [H[i] + [Fraction(i == a) for a in active] for i in range(n)]
            M += [[Fraction(j == a) for j in range(n)] + [Fraction(0)] * len(active) for a in active]
            b = g + [Fraction(self.bound or 0)] * len(active)
            found = eliminated(M, b, size)
            if self.bound is None:
                break
            above = [i for i in range(1, n, 2) if i not in active and found[i] > Fraction(self.bound)]
            pulled = [a for a, multiplier in zip(active, found[n:], strict=True) if multiplier < 0]
            if not above and not pulled:
                assert active and len(active) < STEPS + 1
                break
            active = [a for a in active if a not in pulled] + above
        return np.array([float(v) for v in found[:n]]).reshape(STEPS + 1, 2)


def eliminated(M: list[list[Fraction]], b: list[Fraction], n: int) -> list[Fraction]:
    """Solution of M x = b by Gauss elimination."""
    rows = [[*row, value] for row, value in zip(M, b, strict=True)]
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for k in range(n):
            if k != i and rows[k][i]:
                factor = rows[k][i] / rows[i][i]
                rows[k] = [a - factor * c for a, c in zip(rows[k], rows[i], strict=True)]
    return [rows[i][n] / rows[i][i] for i in range(n)]


@pytest.fixture(params=BACKENDS)
def solver(request: pytest.FixtureRequest) -> str:
    try:
        load_solver(request.param).version()
    except (MissingExtraError, UnknownNameError) as error:
        pytest.skip(str(error))
    return request.param


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("bound", [None, BOUND])
@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("coarse", [1.0, 1e-6])
def test_sensors_of_two_states(solver: str, ratio: float, bound: float | None, noise: bool, coarse: float) -> None:
    window = TwoSensors(ratio, apart=True, bound=bound, coarse=coarse)
    session = window.problem(noise).compile(solver=solver)
    for _ in range(2):  # cold and warm
        solution = session.solve(window.data)
        if solver == "hpipm" and noise and bound is not None and solution.status is not Status.SOLVED:
            return  # it stops on the way from centres beyond bounds, and says so
        error = np.abs(solution["x"] - window.exact()).max()
        assert error < 1e-4
        assert solution.status is Status.SOLVED or (noise and solution.status is Status.INACCURATE)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("bound", [None, BOUND])
@pytest.mark.parametrize("coarse", [1.0, 1e-6])
def test_sensors_of_the_same_states(solver: str, ratio: float, bound: float | None, coarse: float) -> None:
    """P has lost digits of the coarse sensor: nobody finds all of it at 1e12, and nobody says so while metres off."""
    window = TwoSensors(ratio, apart=False, bound=bound, coarse=coarse)
    solution = window.problem(noise=False).compile(solver=solver).solve(window.data)
    deviations = np.sqrt(coarse) * np.abs(solution["x"] - window.exact()).max()
    if solution.status is Status.SOLVED:
        assert deviations < (1e-3 if ratio < 1e12 else 0.1)
    else:
        assert ratio > 1e6 or solver == "osqp"
        assert solution.status in (Status.INACCURATE, Status.ITERATION_LIMIT, Status.FAILED)


def far_apart() -> tuple[np.ndarray, ...]:
    """P, q, A, l, u with weights 1e12 and 1, whose second unknown is best at 7."""
    P = np.diag([1e12, 1.0])
    return P, -P @ np.array([300.0, 7.0]), np.array([[1.0, 2.0]]), np.array([-np.inf]), np.array([1000.0])


@pytest.mark.parametrize("storage", [np.array, sp.csc_array, sp.csr_array])
def test_a_point_that_is_metres_off_is_inaccurate(storage: Any) -> None:
    P, q, A, l, u = far_apart()
    for off, wanted in ((1.0, Status.INACCURATE), (1e-3, Status.INACCURATE), (1e-5, Status.SOLVED)):
        x, y = np.array([300.0, 7.0 + off]), np.zeros(1)
        assert residuals(P, q, A, l, u, x, y).within(1e-8)
        status, result = judge(QPResult(x, y, Status.SOLVED), storage(P), q, storage(A), l, u, 1e-8)
        assert status is wanted
        if wanted is Status.INACCURATE:
            assert f"{off**2 / 2:.1e} too high" in result.message
    # even weights are judged by relative residuals alone
    x = np.array([300.0, 7.0 + 1e-6])
    P = np.eye(2)
    status, _ = judge(QPResult(x, np.zeros(1), Status.SOLVED), P, -np.array([300.0, 7.0]), A, l, u, 1e-8)
    assert status is Status.SOLVED


def test_a_multiplier_beside_its_bound_is_seen_too() -> None:
    """The gap is small beside x'Px only."""
    P, q, A, l, u = far_apart()
    A, u = np.array([[0.0, 1.0]]), np.array([5.0])
    for slack, wanted in ((0.1, Status.INACCURATE), (1e-8, Status.SOLVED)):
        x, y = np.array([300.0, 5.0 - slack]), np.array([2.0 + slack])
        assert residuals(P, q, A, l, u, x, y).within(1e-8)
        assert judge(QPResult(x, y, Status.SOLVED), P, q, A, l, u, 1e-8)[0] is wanted


def test_rows_that_are_held_hide_no_error() -> None:
    """The weak direction is fixed by an active row, so what rounding leaves of its gradient means nothing."""
    turn = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    P = turn @ np.diag([1e12, 1.0]) @ turn
    best = turn @ np.array([300.0, 0.0])
    A, l, u = turn[1:], np.array([-np.inf]), np.array([-1.0])
    x, y = turn @ np.array([300.0, -1.0]), np.array([1.0])
    q = -P @ best + 1e-4 * turn[1]
    assert judge(QPResult(x, y, Status.SOLVED), P, q, A, l, u, 1e-8)[0] is Status.SOLVED
    assert judge(QPResult(best + turn[1], 0 * y, Status.SOLVED), P, q, 0 * A, l, -u, 1e-8)[0] is Status.INACCURATE


@pytest.mark.parametrize("storage", [np.array, sp.csc_array])
def test_scaling_rounds_nothing(storage: Any) -> None:
    rng = np.random.default_rng(1)
    M = rng.normal(size=(8, 6)) * np.array([1e-2, 1e3, 1e4, 1.0, 0.1, 30.0])
    P, A, x = M.T @ M, rng.normal(size=(4, 6)), rng.normal(size=6)
    P, A = np.diag(np.diagonal(P)) + np.triu(P, 1) + np.triu(P, 1).T, A * (rng.random(A.shape) < 0.7)
    scaling = Scaling(storage(P), storage(A), np.zeros(4, bool))
    dense = [m if isinstance(m, np.ndarray) else m.toarray() for m in (scaling.P, scaling.A)]
    for scaled, matrix in zip(dense, (P, A), strict=True):
        kept = matrix != 0
        assert (np.frexp(scaled[kept])[0] == np.frexp(matrix[kept])[0]).all()
    assert (np.abs(np.log2(np.diagonal(dense[0]) / dense[0].diagonal().max())) <= 2).all()
    assert (np.log2(np.linalg.norm(dense[1], axis=1)) >= -0.51).all()  # and violations are seen as before, or sharper
    assert (scaling.given(np.zeros(6), np.ones(4), np.full(4, 2.0), None)[1] >= 1.0).all()
    # a result goes back to where the scaled problem has it
    q, l, u = rng.normal(size=6), -np.ones(4), np.ones(4)
    *_, inner = scaling.given(q, l, u, (x, l))
    assert inner is not None
    result = scaling.taken(QPResult(*inner, Status.SOLVED))
    assert result.x is not None and result.y is not None
    np.testing.assert_allclose(result.x, x, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(result.y, l, rtol=1e-14)


def test_what_is_uneven() -> None:
    even = np.array([[2.0, 1.0], [1.0, 3.0]])
    assert not uneven(even, 1e-2) and not uneven(sp.csc_array(even), 1e-2) and not uneven(np.zeros((0, 0)), 1e-2)
    apart, alike = np.diag([1.0, 1e4]), np.array([[1.0, 1.0], [1.0, 1.0 + 1e-4]])
    for matrix in (apart, alike):
        assert uneven(matrix, 1e-2) and not uneven(matrix, 1e-5)
    assert uneven(apart, 1e-2, by_diagonal=True) is False and uneven(np.diag([1.0, 1e6]), 1e-2, by_diagonal=True)
    # states without costs, as in windows with equalities, are no small weights; rounding is none either
    assert not uneven(np.diag([1.0, 0.0, 10.0]), 1e-2) and not uneven(np.diag([1.0, 1e-18]), 1e-2)
    assert uneven(np.diag([1.0, 0.0, 1e6]), 1e-2) and not uneven(np.diag([1.0, 0.0, 1e4]), 1e-2)


def test_a_backend_goes_from_even_weights_to_uneven_ones_and_back(solver: str) -> None:
    A, l, u = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([-1000.0, -1000.0]), np.array([1000.0, 6.5])
    cls = load_solver(solver)
    stored = np.ascontiguousarray if cls.dense else sp.csc_array
    weights = [1.0, 1e9, 1e7, 2.0]
    full = np.array([[0.0, 1e-3], [1e-3, 0.0]])
    backend, warm = None, None
    for weight in weights:
        P = np.diag([weight, 1.0]) + full
        q = -P @ np.array([300.0, 7.0])
        if backend is None:
            backend = cls(stored(P), q, stored(A), l, u, Options())
        else:
            backend.update(stored(P), stored(A))
        for _ in range(2):
            status, result = judge(backend.solve(q, l, u, warm), P, q, A, l, u, 1e-8)
            assert status is Status.SOLVED, result.message
            assert result.x is not None and result.y is not None
            # the second at its bound, the first moved by the coupling
            expected = np.array([300.0 + 1e-3 * 0.5 / weight, 6.5])
            np.testing.assert_allclose(result.x, expected, atol=1e-4)
            warm = result.x, result.y


def test_osqp_far_from_the_origin_without_rows() -> None:
    """Its own scaling by a large q left P small beside its regularization: thousands of steps, then the limit."""
    P = np.array([[26.0, 3.0], [3.0, 60.0]])
    none = np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    backend = OSQP(sp.csc_array(P), np.zeros(2), sp.csc_array(none[0]), *none[1:], Options())
    for size in (1.0, 1e3, 1e5, 1e3):
        q = -P @ np.array([size, -0.3 * size])
        backend.update(sp.csc_array(P * (1 + 1e-3 * size / 1e5)), sp.csc_array(none[0]))
        result = backend.solve(q, *none[1:])
        assert result.status is Status.SOLVED and result.iterations <= 50
