"""Problems without a solution, unusable numbers, and libraries that break."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from qp_problems import QP, Counter, backend_class, boxed

from problems.errors import DataError
from problems.solvers.base import Options, QPResult, Status


def test_infeasible_then_solved(cls: type[Any]) -> None:
    qp = boxed()
    backend = qp.backend(cls)
    expected = qp.judged(backend)[1].x
    impossible = QP(qp.P, qp.q, qp.A, [*qp.l[:4], 10.0], [*qp.u[:4], 12.0])
    for _ in range(2):
        status, result = impossible.judged(backend)
        assert status is Status.INFEASIBLE, (status, result.message)
        assert result.x is None and result.y is None
        status, result = qp.judged(backend)
        assert status is Status.SOLVED, result.message
        np.testing.assert_allclose(result.x, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["daqp", "osqp", "proxqp", "piqp", "clarabel", "highs", "qpoases"])
def test_unbounded_then_solved(name: str) -> None:
    cls = backend_class(name)
    qp = boxed()
    qp.P = np.diag([1.0, 2.0, 1.0, 0.0])
    qp.q = np.ones(4)
    backend = qp.backend(cls)
    expected = qp.judged(backend)[1].x
    falling = QP(qp.P, qp.q, qp.A, [-1, -1, -1, -np.inf, -np.inf], qp.u)
    status, result = falling.judged(backend)
    assert status is Status.UNBOUNDED, (status, result.message)
    status, result = qp.judged(backend)
    assert status is Status.SOLVED, result.message
    np.testing.assert_allclose(result.x, expected, atol=1e-4)


def test_crossed_bounds_and_nan_are_statuses(cls: type[Any]) -> None:
    qp = boxed()
    backend = qp.backend(cls)
    expected = qp.judged(backend)[1].x
    nan = np.array([np.nan, 0, 0, 0])
    cases = [
        (qp.q + nan, qp.l, qp.u, Status.FAILED),
        (np.array([np.inf, 0, 0, 0]), qp.l, qp.u, Status.FAILED),
        (qp.q, np.append(nan, 0) + qp.l, qp.u, Status.FAILED),
        (qp.q, qp.l, np.append(nan, 0) + qp.u, Status.FAILED),
        (qp.q, qp.u + 1, qp.u, Status.INFEASIBLE),
    ]
    for q, l, u, wanted in cases:
        result = backend.solve(q, l, u)
        assert result.status is wanted
        assert result.x is None and result.message
        status, result = qp.judged(backend)
        assert status is Status.SOLVED, result.message
        np.testing.assert_allclose(result.x, expected, atol=1e-5)


def test_bounds_that_cross_by_rounding_are_an_equality(cls: type[Any]) -> None:
    qp = boxed()
    qp.l[4] = qp.u[4] = 0.3
    backend = qp.backend(cls)
    expected = qp.judged(backend)[1].x
    qp.l[4] = np.nextafter(np.nextafter(0.3, 1), 1)
    np.testing.assert_allclose(qp.judged(backend)[1].x, expected, atol=1e-6)


def test_unusable_vectors_at_construction(cls: type[Any]) -> None:
    qp = boxed()
    P, A = qp.matrices(cls)
    backend = cls(P, np.full(4, np.nan), A, qp.u, qp.l, Options())
    assert backend.solve(qp.q, qp.u, qp.l).status is Status.INFEASIBLE
    assert qp.judged(backend)[0] is Status.SOLVED


class Panic(BaseException):
    """As raised from Rust."""


@pytest.mark.parametrize("kind", ["exception", "panic", "nan", "none"])
def test_a_library_that_breaks_is_a_status_and_the_next_solve_works(
    cls: type[Any], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    qp = boxed()
    backend = qp.backend(cls)
    expected = qp.judged(backend)[1].x

    def broken(*_: Any) -> Any:
        if kind == "exception":
            raise RuntimeError("segment 7 is on fire")
        if kind == "panic":
            raise Panic("unwrap on None")
        return QPResult(np.full(4, np.nan), np.zeros(5), Status.SOLVED) if kind == "nan" else None

    built = Counter(backend._build)
    with monkeypatch.context() as patch:
        patch.setattr(backend, "_run", broken)
        if kind == "nan":
            patch.setattr(backend, "_value", np.nan, raising=False)
        result = backend.solve(qp.q, qp.l, qp.u)
    assert result.status is Status.FAILED and result.x is None and result.message
    if kind == "exception":
        assert "segment 7" in result.message
    patch = monkeypatch
    patch.setattr(backend, "_build", built)
    status, result = qp.judged(backend)
    assert status is Status.SOLVED, result.message
    assert built.calls == 1
    np.testing.assert_allclose(result.x, expected, atol=1e-5)


def test_interrupts_are_not_swallowed(monkeypatch: pytest.MonkeyPatch) -> None:
    qp = boxed()
    backend = qp.backend(backend_class("daqp"))

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(backend, "_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        backend.solve(qp.q, qp.l, qp.u)


def test_a_row_of_zeros(cls: type[Any]) -> None:
    """The update of DAQP refuses the impossible one; with older versions later answers were wrong unless rebuilt."""
    qp = boxed()
    expected = qp.judged(qp.backend(cls))[1].x
    padded = QP(qp.P, qp.q, np.vstack([qp.A, np.zeros((1, 4))]), [*qp.l, -1.0], [*qp.u, 1.0])
    impossible = QP(qp.P, qp.q, padded.A, [*qp.l, 1.0], [*qp.u, 2.0])
    backend = padded.backend(cls)
    for _ in range(2):
        status, result = impossible.judged(backend)
        assert status is Status.INFEASIBLE, (status, result.message)
        status, result = padded.judged(backend)
        assert status is Status.SOLVED, result.message
        np.testing.assert_allclose(result.x, expected, atol=1e-5)


class RefusingModel:
    """A DAQP model whose update is refused, and that answers all the same, as older versions of the library do."""

    def __init__(self, model: Any, flags: list[int]) -> None:
        self.model, self.flags = model, flags

    def update(self, *args: Any) -> int:
        flag = self.model.update(*args)
        return self.flags.pop(0) if self.flags else flag

    def solve(self) -> tuple[Any, ...]:
        x, value, flag, info = self.model.solve()
        return (x, value, flag, info) if not self.flags else (x + 1.0, value, 1, info)


def test_daqp_does_not_solve_after_a_refused_update() -> None:
    cls = backend_class("daqp")
    qp = boxed()
    for flag, wanted in ((-1, Status.INFEASIBLE), (-5, Status.FAILED)):
        backend = qp.backend(cls)
        backend._model = RefusingModel(backend._model, [flag, flag])
        assert backend.solve(qp.q, qp.l, qp.u).status is wanted
        # Built anew, without the refusing model.
        assert qp.judged(backend)[0] is Status.SOLVED
    # A working set that is refused is no reason to give up.
    backend = qp.backend(cls)
    last = backend.solve(qp.q, qp.l, qp.u)
    backend._model = RefusingModel(backend._model, [-6])
    status, _ = qp.judged(backend, warm=(last.x.copy(), last.y.copy()))
    assert status is Status.SOLVED


def test_matrices_that_are_not_finite(cls: type[Any]) -> None:
    qp = boxed()
    backend = qp.backend(cls)
    bad = QP(qp.P, qp.q, qp.A, qp.l, qp.u)
    bad.A[0, 0] = np.nan
    with pytest.raises(DataError, match="A must be a finite"):
        bad.backend(cls)
    with pytest.raises(DataError):
        backend.update(*bad.matrices(cls))
    assert qp.judged(backend)[0] is Status.SOLVED
