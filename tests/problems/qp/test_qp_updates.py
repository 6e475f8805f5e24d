"""Backends set up once and solved many times: updates, warm starts, rows that change their kind."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
from qp_problems import QP, UNRELIABLE, Counter, backend_class, random_qp, window_qp

from problems.solvers.base import Status

# What a backend would have to make anew at every solve if it were not set up once.
CONSTRUCTORS = {
    "daqp": ["daqp:Model"],
    "osqp": ["osqp.ext_builtin:OSQPSolver"],
    "proxqp": ["proxsuite.proxqp.dense:QP", "proxsuite.proxqp.sparse:QP"],
    "piqp": ["piqp:DenseSolver", "piqp:SparseSolver"],
    "clarabel": ["clarabel:DefaultSolver"],
    "highs": ["highspy:Highs"],
    "qpoases": ["casadi:conic"],
    "qrqp": ["casadi:conic"],
}


def attribute_owner(path: str) -> tuple[Any, str]:
    module, _, attribute = path.partition(":")
    owner: Any = importlib.import_module(module.split(".")[0])
    for part in module.split(".")[1:]:
        if not hasattr(owner, part):
            importlib.import_module(module)
        owner = getattr(owner, part)
    return owner, attribute


@pytest.mark.parametrize("name", [name for name in CONSTRUCTORS if name != "highs"])
def test_solving_and_updating_make_no_new_object(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cls = backend_class(name)
    counters = []
    for path in CONSTRUCTORS[name]:
        owner, attribute = attribute_owner(path)
        counters.append(Counter(getattr(owner, attribute)))
        monkeypatch.setattr(owner, attribute, counters[-1])
    rng = np.random.default_rng(7)
    qp = random_qp(rng, 6, 9, 2)
    backend = qp.backend(cls)
    assert sum(c.calls for c in counters) == 1
    warm = None
    for k in range(6):
        shift = 0.05 * rng.normal(size=9)
        moved = QP(qp.P * (1 + 0.1 * k), qp.q + rng.normal(size=6), qp.A * (1 + 0.05 * k), qp.l + shift, qp.u + shift)
        if k >= 3:
            backend.update(*moved.matrices(cls))
        else:
            moved.P, moved.A = qp.P, qp.A
        status, result = moved.judged(backend, warm=warm)
        if name not in UNRELIABLE:
            assert status is Status.SOLVED, (k, result.message)
        warm = (result.x, result.y) if status is Status.SOLVED else None
    if name not in UNRELIABLE:
        assert sum(c.calls for c in counters) == 1


def test_highs_makes_no_new_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """HiGHS is derived from for silence, so its builds are counted where they happen."""
    cls = backend_class("highs")
    built = Counter(cls._build)
    monkeypatch.setattr(cls, "_build", lambda self, *args: built(self, *args))
    qp = random_qp(np.random.default_rng(7), 6, 9, 2)
    backend = qp.backend(cls)
    for scale in (1.0, 2.0, 3.0):
        moved = QP(scale * qp.P, qp.q, qp.A, qp.l, qp.u)
        backend.update(*moved.matrices(cls))
        assert moved.judged(backend)[0] is Status.SOLVED
    assert built.calls == 1


def test_update_takes_new_numbers(cls: type[Any]) -> None:
    rng = np.random.default_rng(8)
    qp = random_qp(rng, 5, 7, 1)
    backend = qp.backend(cls)
    qp.judged(backend)
    for _ in range(3):
        other = random_qp(rng, 5, 7, 1)
        backend.update(*other.matrices(cls))
        status, result = other.judged(backend)
        fresh = other.judged(other.backend(cls))
        assert status is Status.SOLVED, result.message
        np.testing.assert_allclose(result.x, fresh[1].x, atol=1e-5)


def test_update_with_another_pattern(cls: type[Any]) -> None:
    qp = random_qp(np.random.default_rng(9), 5, 7, 1)
    sparser = QP(np.diag(np.diagonal(qp.P)), qp.q, np.vstack([np.eye(5), qp.A[5:]]), np.full(7, -0.2), np.full(7, 0.2))
    qp.l, qp.u = sparser.l, sparser.u
    backend = sparser.backend(cls)
    if cls.name in UNRELIABLE and sparser.judged(backend)[0] is not Status.SOLVED:
        pytest.skip("cycles on this problem, and says so")
    assert sparser.judged(backend)[0] is Status.SOLVED
    backend.update(*qp.matrices(cls))
    expected = qp.judged(qp.backend(cls))[1].x
    np.testing.assert_allclose(qp.judged(backend)[1].x, expected, atol=1e-5)
    backend.update(*sparser.matrices(cls))
    assert sparser.judged(backend)[0] is Status.SOLVED


def test_warm_starts_do_not_change_the_answer(cls: type[Any]) -> None:
    rng = np.random.default_rng(10)
    qp = random_qp(rng, 6, 10, 2, pull=8.0)
    used, old = qp.backend(cls), None
    warm = None
    for k in range(12):
        moved = QP(qp.P, qp.q + rng.normal(size=6), qp.A, qp.l, qp.u)
        status, result = moved.judged(used, warm=warm)
        cold_status, cold = moved.judged(moved.backend(cls))
        if status is Status.SOLVED and cold_status is Status.SOLVED:
            np.testing.assert_allclose(result.x, cold.x, atol=1e-4)
            # Sometimes the last point, a copy of it, or one of an earlier problem as another node would give it.
            last = (result.x, result.y)
            assert result.x is not None and result.y is not None
            warm = [last, (result.x.copy(), result.y.copy()), old or last][k % 3]
            old = last
        else:
            assert cls.name in UNRELIABLE, result.message
            warm = None


@pytest.mark.parametrize("name", ["daqp", "osqp", "proxqp", "qrqp"])
def test_a_warm_start_saves_iterations_and_a_cold_one_forgets(name: str) -> None:
    cls = backend_class(name)
    qp = window_qp(np.random.default_rng(0)) if name != "qrqp" else random_qp(np.random.default_rng(0), 6, 6, 0)
    backend = qp.backend(cls)
    cold = backend.solve(qp.q, qp.l, qp.u)
    assert backend.solve(qp.q, qp.l, qp.u).iterations == cold.iterations
    # Another node's problem in between: the point given counts, not what the library still has.
    backend.solve(-qp.q, qp.l, qp.u)
    assert 2 * backend.solve(qp.q, qp.l, qp.u, (cold.x, cold.y)).iterations < cold.iterations
    last = backend.solve(qp.q, qp.l, qp.u)
    assert backend.solve(qp.q, qp.l, qp.u, (last.x, last.y)).iterations < cold.iterations


def test_daqp_survives_a_warm_start_with_too_many_active_rows() -> None:
    qp = random_qp(np.random.default_rng(12), 3, 9, 1)
    backend = qp.backend(backend_class("daqp"))
    status, result = qp.judged(backend, warm=(np.zeros(3), np.ones(9)))
    assert status is Status.SOLVED, result.message
    np.testing.assert_allclose(result.x, qp.enumerated(), atol=1e-8)


def test_rows_may_change_their_kind(cls: type[Any]) -> None:
    rng = np.random.default_rng(11)
    qp = random_qp(rng, 6, 6, 0)
    r = qp.A @ rng.normal(size=6)
    backend = None
    for kinds in ("eetttt", "ttttte", "fltuee", "tttttt", "ffffff", "lluuee"):
        l, u = r - 0.1, r + 0.1
        for i, kind in enumerate(kinds):
            if kind == "e":
                l[i] = u[i] = r[i]
            if kind in "fu":
                l[i] = -np.inf
            if kind in "fl":
                u[i] = np.inf
        changed = QP(qp.P, qp.q, qp.A, l, u)
        backend = backend or changed.backend(cls)
        status, result = changed.judged(backend)
        assert status is Status.SOLVED or cls.name in UNRELIABLE, (kinds, result.message)
        if status is Status.SOLVED:
            np.testing.assert_allclose(result.x, changed.enumerated(), atol=1e-4)


def test_daqp_takes_leading_identity_rows_as_bounds() -> None:
    cls = backend_class("daqp")
    rng = np.random.default_rng(12)
    qp = random_qp(rng, 4, 6, 0)
    for leading in (0, 2, 4):
        qp.A[:leading] = np.eye(4)[:leading]
        qp.l, qp.u = np.full(6, -0.1), np.full(6, 0.1)
        backend = qp.backend(cls)
        np.testing.assert_allclose(qp.judged(backend)[1].x, qp.enumerated(), atol=1e-8)
        # The same object when these rows are no longer those of the identity.
        other = QP(qp.P, qp.q, rng.normal(size=(6, 4)), qp.l, qp.u)
        backend.update(*other.matrices(cls))
        np.testing.assert_allclose(other.judged(backend)[1].x, other.enumerated(), atol=1e-8)
