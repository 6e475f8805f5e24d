"""Stages are found whatever the order of unknowns and rows, and only where there are any."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from problems.forms.stages import Stages, find_stages

DOUBLE = np.kron([[1.0, 0.1], [0.0, 1.0]], np.eye(2)), np.kron([[0.005], [0.1]], np.eye(2))
MODELS = {
    "dense": (np.random.default_rng(1).normal(size=(4, 4)), np.random.default_rng(2).normal(size=(4, 2)), "full"),
    "noise on every state": (np.random.default_rng(3).normal(size=(3, 3)), np.eye(3), "full"),
    "random walks apart": (np.eye(2), np.eye(2), "diagonal"),
    "random walks joined": (np.eye(2), np.eye(2), "full"),
    "random walk": (np.eye(1), np.eye(1), "diagonal"),
    "double integrators": (*DOUBLE, "diagonal"),
    "no noise": (np.array([[0.9, 0.2], [-0.3, 0.8]]), np.zeros((2, 0)), "full"),
    "a bias that stays": (np.array([[0.9, 1.0], [0.0, 1.0]]), np.array([[1.0], [0.0]]), "diagonal"),
}
QP = tuple[np.ndarray, np.ndarray, np.ndarray]


def window(A: np.ndarray, B: np.ndarray, cost: str, horizon: int, rng: np.random.Generator) -> QP:
    """P, rows and which are equalities, states first, then controls, some of either bounded."""
    (nx, nu), N = B.shape, horizon
    Q = np.ones((nx, nx)) + np.eye(nx) if cost == "full" else np.eye(nx)
    P = np.kron(np.eye(N + 1), Q)
    P = np.block([[P, np.zeros((len(P), N * nu))], [np.zeros((N * nu, len(P))), np.eye(N * nu)]])
    ahead = np.kron(np.eye(N, N + 1, 1), np.eye(nx)) - np.kron(np.eye(N, N + 1), A)
    dynamics = np.hstack([ahead, -np.kron(np.eye(N), B)])
    box = np.eye(len(P))[rng.random(len(P)) < 0.5]
    return P, np.vstack([dynamics, box]), np.arange(len(dynamics) + len(box)) < len(dynamics)


def shuffled(P: np.ndarray, A: np.ndarray, equal: np.ndarray, rng: np.random.Generator) -> QP:
    columns, rows = rng.permutation(len(P)), rng.permutation(len(A))
    scale = rng.choice([-2.0, 0.5, 1.0], len(A))
    return P[np.ix_(columns, columns)], (scale[:, None] * A)[np.ix_(rows, columns)], equal[rows]


def require_structure(P: np.ndarray, A: np.ndarray, equal: np.ndarray, found: Stages) -> None:
    """P joins unknowns of one stage only; rows are ``A_k x_k + B_k u_k + e x_{k+1}`` or stay in their stage."""
    n, m = len(P), len(A)
    assert sorted(found.unknowns) == list(range(n))
    assert sorted(found.rows) == list(range(m))
    assert found.states[0] == found.controls[-1] == 0
    P, A, equal = P[np.ix_(found.unknowns, found.unknowns)], A[np.ix_(found.rows, found.unknowns)], equal[found.rows]
    allowed_P, allowed_A = np.zeros(P.shape, bool), np.zeros(A.shape, bool)
    row = column = 0
    for k, (nx, nu, ng) in enumerate(zip(found.states, found.controls, found.others, strict=True)):
        width, ahead = nx + nu, found.states[k + 1] if k + 1 < found.states.size else 0
        allowed_P[column : column + width, column : column + width] = True
        allowed_A[row : row + ahead + ng, column : column + width] = True
        defining = np.arange(row, row + ahead), np.arange(column + width, column + width + ahead)
        allowed_A[defining] = True
        assert A[defining].all()
        assert equal[row : row + ahead].all()
        row, column = row + ahead + ng, column + width
    assert (row, column) == (m, n)
    assert not P[~allowed_P].any()
    assert not A[~allowed_A].any()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("horizon", [1, 2, 9])
def test_a_shuffled_chain_is_found(model: str, horizon: int) -> None:
    A, B, cost = MODELS[model]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        P, rows, equal = shuffled(*window(A, B, cost, horizon, rng), rng)
        found = find_stages(sp.csc_array(P), sp.csc_array(rows), equal)
        assert found is not None
        require_structure(P, rows, equal, found)
        used = found.states + found.controls > 0
        assert np.count_nonzero(used) in (horizon + 1, horizon + 2)  # no stages joined; ends are a matter of taste
        dense = find_stages(P, rows, equal)
        assert dense is not None
        np.testing.assert_array_equal(dense.unknowns, found.unknowns)


def test_rows_that_stay_in_a_stage() -> None:
    """Fixed values, an observer that gives the noise (w = L (y - C x)), an empty row."""
    rng = np.random.default_rng(0)
    P, rows, equal = window(*MODELS["dense"], 4, rng)
    observer = np.zeros((8, len(P)))
    for k in range(4):
        observer[2 * k : 2 * k + 2, 4 * k : 4 * k + 4] = rng.normal(size=(2, 4))
        observer[2 * k : 2 * k + 2, 20 + 2 * k : 22 + 2 * k] = np.eye(2)
    rows = np.vstack([rows, observer, np.eye(len(P))[[0, 17]], np.zeros((1, len(P)))])
    equal = np.concatenate([equal, np.ones(11, bool)])
    P, rows, equal = shuffled(P, rows, equal, rng)
    found = find_stages(P, rows, equal)
    assert found is not None
    require_structure(P, rows, equal, found)
    assert found.states.size >= 5


def broken(kind: str) -> QP:
    rng = np.random.default_rng(5)
    P, rows, equal = window(*MODELS["dense"], 5, rng)
    if kind == "a cost joins the ends":
        P[0, 23] = P[23, 0] = 0.1
    elif kind == "an inequality joins the ends":
        rows, equal = np.vstack([rows, np.eye(len(P))[0] - np.eye(len(P))[23]]), np.append(equal, False)
    elif kind == "a parameter of all stages":
        rows[:20, 22] = 1.0
    elif kind == "no equalities":
        equal = np.zeros(len(rows), bool)
    elif kind == "a sum":
        rows, equal = np.ones((1, len(P))), np.ones(1, bool)
    return P, rows, equal


@pytest.mark.parametrize(
    "kind",
    [
        "a cost joins the ends",
        "an inequality joins the ends",
        "a parameter of all stages",
        "no equalities",
        "a sum",
    ],
)
def test_no_chain(kind: str) -> None:
    for seed in range(3):
        P, rows, equal = shuffled(*broken(kind), np.random.default_rng(seed))
        if kind == "a sum":
            P = P + 0.1
        assert find_stages(P, rows, equal) is None


def test_a_cost_between_neighbours_joins_their_stages() -> None:
    """The rate of the controls is penalized: all stages with controls are one."""
    P, rows, equal = window(*MODELS["dense"], 5, np.random.default_rng(0))
    P[24:, 24:] = 3 * np.eye(10) - np.eye(10, k=2) - np.eye(10, k=-2)
    found = find_stages(P, rows, equal)
    assert found is not None
    require_structure(P, rows, equal, found)
    np.testing.assert_array_equal(found.states, [0, 4])
