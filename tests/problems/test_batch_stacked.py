"""Stacked arrays: unequal nodes of one template, their maps at once, and all violators by one active-set method."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from problems import Gaussian, Problem, Vector
from problems.errors import NoiseError
from problems.solvers.batch import QPBatch
from problems.solvers.qp_dual import nearest_points
from problems.solvers.qp_stacked import StackedProgram

SLOTS, STATES, OUTPUTS = 4, 3, 2
A = np.array([[1.0, 0.1, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.95]])


def template(observer: bool, bound: float = np.inf, linear: bool = False) -> Problem:
    """A window whose outputs, gains and weights are data, so that nodes with different ones are entries of a batch."""
    problem = Problem("node")
    x = problem.variables("x", Vector(STATES), SLOTS)
    y = problem.data("y", OUTPUTS, SLOTS)
    C = problem.data("C", (OUTPUTS, STATES))
    reference, information = problem.data("reference", STATES), problem.data("information", (STATES, STATES))
    weight = problem.data("weight", (OUTPUTS, OUTPUTS))
    pull = problem.data("pull", STATES, value=np.zeros(STATES))
    problem.cost(
        "arrival",
        lambda x, m: x - m,
        on=x[0],
        data=reference,
        noise=Gaussian(information=information),
        linear=pull if linear else None,
    )
    problem.cost("output", lambda x, y, C: y - C @ x, on=x, data=(y, C), noise=Gaussian(information=weight))
    if observer:
        L, there = problem.data("L", (STATES, OUTPUTS)), problem.presence(y)
        problem.equality(
            "moves",
            lambda x, n, y, there, C, L: n - ca.DM(A) @ x - there * (L @ (y - C @ x)),
            on=(x[:-1], x[1:]),
            data=(y[:-1], there[:-1], C, L),
        )
    else:
        problem.cost("moves", lambda x, n: n - ca.DM(A) @ x, on=(x[:-1], x[1:]), noise=Gaussian(0.3))
    if np.isfinite(bound):
        problem.inequality("box", lambda x: x, on=x, lower=-bound, upper=bound)
        problem.inequality("seen", lambda x, C: C @ x, on=x, data=C, upper=0.8 * bound)
    return problem


def compiled(observer: bool, bound: float = np.inf, linear: bool = False) -> Any:
    problem = template(observer, bound, linear)
    return problem.compile("auto", eliminate=[problem.unknowns["x"][1:]] if observer else ())


def drawn(count: int, observer: bool, rng: np.random.Generator) -> dict[str, np.ndarray]:
    def definite(size: int) -> np.ndarray:
        half = rng.normal(size=(count, size, size))
        return half @ half.swapaxes(1, 2) + 0.1 * np.eye(size)

    data = {
        "y": rng.normal(size=(count, SLOTS, OUTPUTS)),
        "C": rng.normal(size=(count, OUTPUTS, STATES)),
        "reference": rng.normal(size=(count, STATES)),
        "information": definite(STATES),
        "weight": definite(OUTPUTS),
        "pull": rng.normal(size=(count, STATES)),
    }
    data["C"][::3, 1] = 0.0  # a node with fewer outputs is padded by rows that see nothing
    return data | ({"L": 0.2 * rng.normal(size=(count, STATES, OUTPUTS))} if observer else {})


@pytest.mark.parametrize("observer", [False, True])
@pytest.mark.parametrize("bound", [np.inf, 0.7])
@pytest.mark.parametrize("missing", [False, True])
def test_unequal_nodes_are_entries_of_one_batch(observer: bool, bound: float, missing: bool) -> None:
    rng, count = np.random.default_rng(1), 60
    session = compiled(observer, bound, linear=True)
    batch = session.batch(count)
    assert isinstance(batch, QPBatch) and batch._program is not None
    data = drawn(count, observer, rng)
    if missing:
        data["y"][rng.random((count, SLOTS)) < 0.3] = np.nan
    found = batch.solve(data)
    assert batch.factorizations == count
    methods = set()
    for k in range(count):
        one = session.fork().solve({name: value[k] for name, value in data.items()})
        assert (found.status[k], found.method[k]) == (one.status, one.method)
        methods.add(one.method)
        np.testing.assert_allclose(found["x"][k], one["x"], rtol=0, atol=1e-9)
    assert methods == ({"linear"} if bound == np.inf else {"linear", "auto"})


def test_violators_need_no_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = compiled(True, 1.5).batch(60)
    data = drawn(60, True, np.random.default_rng(1))
    monkeypatch.setattr(batch, "_one", lambda *_, **__: pytest.fail("the backend was called"))
    found = batch.solve(data)
    assert 5 < (found.method == "auto").sum() < 60 and found.iterations.max() > 1


def test_nothing_is_factorized_while_only_vectors_change() -> None:
    rng = np.random.default_rng(2)
    batch = compiled(True, 0.7).batch(30)
    batch.update(**drawn(30, True, rng))
    assert batch.factorizations == 30
    for _ in range(3):
        batch.solve({"y": rng.normal(size=(30, SLOTS, OUTPUTS)), "reference": rng.normal(size=(30, STATES))})
    assert batch.factorizations == 30
    batch.solve({"weight": np.eye(OUTPUTS)})
    assert batch.factorizations == 60
    y = rng.normal(size=(30, SLOTS, OUTPUTS))
    y[4, 1, 0] = np.nan
    batch.solve({"y": y})
    assert batch.factorizations > 60
    assert batch.nbytes > 30 * SLOTS * STATES * (SLOTS * OUTPUTS + STATES) * 8


def test_equal_entries_share_a_map() -> None:
    rng = np.random.default_rng(3)
    batch = compiled(False).batch(40)
    data = drawn(40, False, rng)
    for name in ("C", "information", "weight"):
        data[name] = data[name][np.arange(40) % 20]
    found = batch.solve(data)
    assert batch.factorizations == 20
    fresh = compiled(False).fork().solve({name: value[33] for name, value in data.items()})
    np.testing.assert_allclose(found["x"][33], fresh["x"], atol=1e-10)


def test_entries_without_a_minimum_are_reported_and_the_others_answered() -> None:
    session = compiled(False)
    data = drawn(20, False, np.random.default_rng(4))
    data["information"][7] = 0.0
    data["C"][7] = 0.0
    found = session.batch(20).solve(data | {"y": np.where(np.arange(20)[:, None, None] == 7, np.nan, data["y"])})
    assert found.status[7] == "unbounded" and (np.delete(found.status, 7) == "solved").all()


@pytest.mark.parametrize("sigma", [1e-4, 1e-6])
def test_small_weights_keep_their_digits(sigma: float) -> None:
    """A chain of precise differences with one coarse fix for each of 20 places."""
    rng, count, entries = np.random.default_rng(8), 20, 30
    problem = Problem("chain")
    x = problem.variables("x", Vector(1), count)
    fix, step = problem.data("fix", 1, count), problem.data("step", 1, count - 1)
    weight = problem.data("weight", (1, 1))
    problem.cost("fix", lambda x, z: x - z, x, fix, Gaussian(information=weight))
    problem.cost("step", lambda a, b, z: b - a - z, (x[:-1], x[1:]), step, Gaussian(sigma))
    place = rng.uniform(0, 100, (entries, count, 1))
    data = {
        "fix": place + rng.normal(size=place.shape),
        "step": np.diff(place, axis=1) + sigma * rng.normal(size=(entries, count - 1, 1)),
        "weight": rng.uniform(0.5, 2.0, (entries, 1, 1)),
    }
    batch = problem.compile("auto").batch(entries)
    assert batch._program is not None  # type: ignore[attr-defined]
    found = batch.solve(data)
    assert (found.method == "linear").all()
    for k in range(entries):
        root = np.sqrt(data["weight"][k, 0, 0])
        A = np.vstack([root * np.eye(count), np.diff(np.eye(count), axis=0) / sigma])
        b = np.concatenate([root * data["fix"][k, :, 0], data["step"][k, :, 0] / sigma]).astype(np.longdouble)
        exact = np.zeros(count, np.longdouble)
        for _ in range(6):
            exact = exact + np.linalg.lstsq(A, (b - A.astype(np.longdouble) @ exact).astype(float), rcond=None)[0]
        np.testing.assert_allclose(found["x"][k, :, 0], exact.astype(float), rtol=0, atol=1e-8)


def test_a_weight_that_is_none_is_named() -> None:
    data = drawn(4, False, np.random.default_rng(5))
    data["information"][2] = -np.eye(STATES)
    with pytest.raises(NoiseError, match="arrival"):
        compiled(False).batch(4).solve(data)


def test_programs_with_equalities_left_are_not_stacked() -> None:
    problem = template(True)
    assert StackedProgram.of(problem.compile("auto").program) is None  # type: ignore[attr-defined]
    assert StackedProgram.of(compiled(True).program) is not None


def test_nearest_points_equal_a_qp_solver() -> None:
    import daqp

    rng = np.random.default_rng(6)
    count, rows, k = 200, 12, 5
    A = rng.normal(size=(count, rows, k))
    b = rng.uniform(-1.0, 1.0, (count, rows))
    b[:, ::5] = np.inf
    A[3, 1], b[3, 1] = A[3, 0 + 2], b[3, 2]  # twice the same row
    A[4, 1], b[4, 1], b[4, 2] = -A[4, 2], -1.0 - abs(b[4, 2]), abs(b[4, 2])  # no point
    found = nearest_points(A, b, 1e-11)
    feasible = 0
    for one in range(count):
        low = np.full(rows, -1e30)
        x, _, flag, _ = daqp.solve(np.eye(k), np.zeros(k), A[one], np.minimum(b[one], 1e30), low)
        if flag == 1:
            feasible += 1
            assert found.solved[one]
            np.testing.assert_allclose(found.point[one], x, atol=1e-6 if one == 3 else 1e-8)
        else:
            assert not found.solved[one]
    assert 50 < feasible < count and not found.solved[4] and found.iterations.max() >= 4
