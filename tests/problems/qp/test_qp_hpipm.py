"""HPIPM: stages given, found, and refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from qp_problems import QP, backend_class, random_qp

from problems.errors import FormError, SettingError
from problems.solvers.base import Status


def staged_qp(rng: np.random.Generator, steps: int = 4) -> tuple[QP, dict[str, Any]]:
    """A problem in stages ``x_0, u_0, x_1, ...`` with one bounded combination per stage."""
    nx = [3] * (steps + 1)
    nu = [2] * steps + [0]
    n, m = sum(nx) + sum(nu), 3 * steps + steps + 1
    P, A, l, u = np.zeros((n, n)), np.zeros((m, n)), np.zeros(m), np.zeros(m)
    row = column = 0
    for k in range(steps + 1):
        width = nx[k] + nu[k]
        stage = slice(column, column + width)
        M = rng.normal(size=(width + 2, width))
        P[stage, stage] = M.T @ M
        if k < steps:
            A[row : row + 3, stage] = 0.5 * rng.normal(size=(3, width))
            A[row : row + 3, column + width : column + width + 3] = -np.eye(3)
            l[row : row + 3] = u[row : row + 3] = 0.1 * rng.normal(size=3)
            row += 3
        A[row, stage] = rng.normal(size=width)
        l[row], u[row] = (-0.3, 0.3) if k else (-np.inf, 0.2)
        row += 1
        column += width
    return QP(P, 3 * rng.normal(size=n), A, l, u), {"N": steps, "nx": nx, "nu": nu, "ng": [1] * (steps + 1)}


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_hpipm_on_stages(tolerance: float) -> None:
    from problems.solvers.qp_casadi import HPIPM

    rng = np.random.default_rng(17)
    qp, stages = staged_qp(rng)
    backend = qp.backend(HPIPM, tolerance=tolerance, extra=stages)
    reference_class = backend_class("daqp")
    for k in range(6):
        # Results of an earlier solve must not stand in for those of this one.
        moved = QP((1 + 0.2 * k) * qp.P, rng.normal(size=len(qp.q)) * 3, qp.A, qp.l, qp.u)
        backend.update(*moved.matrices(HPIPM))
        status, result = moved.judged(backend, tolerance)
        assert status is Status.SOLVED, result.message
        assert result.iterations < 30
        reference = moved.judged(moved.backend(reference_class))[1]
        np.testing.assert_allclose(result.x, reference.x, atol=30 * tolerance**0.75)


def test_hpipm_finds_the_stages() -> None:
    """In any order of unknowns and rows, with zeros stored; new numbers and new kinds of rows included."""
    from problems.solvers.qp_casadi import HPIPM

    rng = np.random.default_rng(18)
    qp = staged_qp(rng)[0]
    columns, order = rng.permutation(len(qp.q)), rng.permutation(len(qp.l))
    A = (rng.choice([-2.0, 0.5, 1.0], len(qp.l))[:, None] * qp.A)[np.ix_(order, columns)]
    bound = np.sort(np.stack([-np.abs(qp.l), np.abs(qp.u)]), axis=0)[:, order]
    equal = (qp.l == qp.u)[order]
    l, u = np.where(equal, qp.l[order], bound[0]), np.where(equal, qp.l[order], bound[1])
    mixed = QP(qp.P[np.ix_(columns, columns)], qp.q[columns], A, l, u)
    joined = mixed.P.copy()  # the ends of the chain by a cost: no chain any more
    joined[columns.argsort()[[0, -1]], columns.argsort()[[-1, 0]]] += 0.01
    loose = mixed.u + np.where(equal, 0.1, 0.0)  # no row is an equality any more
    rescaled = QP(1.5 * mixed.P, mixed.q, 0.5 * A, l, u)
    for others, stages in (
        ((mixed, rescaled, mixed), (4, 4, 4)),
        (
            (rescaled, QP(joined, mixed.q, A, l, u), mixed),
            (4, 0, 4),
        ),
        ((mixed, QP(mixed.P, mixed.q, A, l, loose), mixed), (4, 0, 0)),  # bounds that meet are no reason to search
    ):
        backend = mixed.backend(HPIPM)
        for problem, expected in zip(others, stages, strict=True):
            backend.update(*problem.matrices(HPIPM))
            status, result = problem.judged(backend)
            assert status is Status.SOLVED, result.message
            reference = problem.judged(problem.backend(backend_class("daqp")))[1]
            np.testing.assert_allclose(result.x, reference.x, atol=1e-5)
            np.testing.assert_allclose(problem.A.T @ result.y, problem.A.T @ reference.y, atol=1e-4)
            assert backend.stages["N"] == expected


def test_hpipm_takes_any_program_as_one_stage() -> None:
    from problems.solvers.qp_casadi import HPIPM

    qp = random_qp(np.random.default_rng(2), 8, 12, 3)
    backend = qp.backend(HPIPM)
    status, result = qp.judged(backend)
    assert status is Status.SOLVED, result.message
    assert backend.stages["N"] == 0
    reference = qp.judged(qp.backend(backend_class("daqp")))[1]
    np.testing.assert_allclose(result.x, reference.x, atol=1e-5)


def test_hpipm_refuses_stages_that_are_not_there() -> None:
    from problems.solvers.qp_casadi import HPIPM

    qp, stages = staged_qp(np.random.default_rng(18))
    with pytest.raises(FormError, match="ng is missing"):
        qp.backend(HPIPM, extra={name: value for name, value in stages.items() if name != "ng"})
    with pytest.raises(FormError, match="N, nx, nu, ng"):
        qp.backend(HPIPM, extra={**stages, "N": 3})
    dense = random_qp(np.random.default_rng(0), len(qp.q), len(qp.l), 0)
    with pytest.raises(FormError):
        dense.backend(HPIPM, extra=stages)
    with pytest.raises(SettingError, match="nx"):
        qp.backend(HPIPM, extra={**stages, "nx": 3})


def test_hpipm_after_an_infeasible_problem() -> None:
    from problems.solvers.qp_casadi import HPIPM

    qp, stages = staged_qp(np.random.default_rng(19))
    # The last stage has states only: two of its rows can be made to contradict each other through the dynamics.
    qp.A[-1] = qp.A[0] * 2.0
    stages = {**stages, "ng": [1, 1, 1, 1, 1]}
    qp.A[-1] = 0.0
    backend = qp.backend(HPIPM, extra=stages)
    good_l, good_u = qp.l.copy(), qp.u.copy()
    qp.l[-1], qp.u[-1] = 1.0, 2.0
    status, result = qp.judged(backend)
    assert status is Status.INFEASIBLE, result.message
    qp.l, qp.u = good_l, good_u
    assert qp.judged(backend)[0] is Status.SOLVED
