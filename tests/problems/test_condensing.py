"""Eliminating unknowns: maps, windows in every form, what cannot be eliminated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

import problems.forms.quadratic as quadratic
from problems import Gaussian, Problem, Vector
from problems.errors import EmptyConstraintError, FormError
from problems.forms.condensing import AffineMap, BandedTriangle, SolvedMap, eliminate, null_space
from problems.forms.quadratic import QuadraticProgram

A = np.array([[0.9, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.0, 0.1, 0.7]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
GAIN = np.array([[0.3, 0.1], [0.1, 0.4], [0.0, 0.2]])
STEPS = 4
rng = np.random.default_rng(6)
DATA: dict[str, Any] = {"y": rng.normal(size=(STEPS + 1, 2)), "prior": rng.normal(size=3)}


def window(observer: bool = False, given: bool = False) -> tuple[Problem, Any, Any]:
    """A window with process noise, or with the observer's injection instead; A as constant or as data.

    The box is on all states, in the observer's window, where only x_0 is free, on that one.
    """
    p = Problem("window")
    x, w = p.variables("x", Vector(3), STEPS + 1), p.variables("w", Vector(3), STEPS)
    y, prior = p.data("y", 2, STEPS + 1), p.data("prior", 3)
    p.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(2.0))
    p.cost("output", lambda x, y: y - C @ x, on=x, data=y)
    if given:
        matrix = p.data("A", (3, 3), value=A)
        p.equality("dynamics", lambda x, w, n, A: n - A @ x - w, on=(x[:-1], w, x[1:]), data=matrix)
    else:
        p.equality("dynamics", lambda x, w, n: n - A @ x - w, on=(x[:-1], w, x[1:]))
    if observer:
        p.equality("injection", lambda w, x, y: w - GAIN @ (y - C @ x), on=(w, x[:-1]), data=y[:-1])
    else:
        p.cost("effort", lambda w: w, on=w, noise=Gaussian(0.5))
    p.inequality("box", lambda x: x, on=x[0] if observer else x, lower=-0.4, upper=0.5)
    return p, x, w


# --- maps ------------------------------------------------------------------------------------------------------------


def rows(seed: int, m: int, n: int, data: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    g = np.random.default_rng(seed)
    return g.normal(size=(m, n)), g.normal(size=(m, data)), g.normal(size=m)


def check_map(map_: AffineMap, R: np.ndarray, E: np.ndarray, c: np.ndarray) -> None:
    """All z of the map satisfy the rows."""
    Z, Y = (p if isinstance(p, np.ndarray) else p.toarray() for p in (map_.Z, map_.Y))
    np.testing.assert_allclose(R @ Z, 0.0, atol=1e-10)
    np.testing.assert_allclose(R @ Y + E, 0.0, atol=1e-10)
    np.testing.assert_allclose(R @ map_.z0 + c, 0.0, atol=1e-10)


def test_elimination_solves_the_rows_and_keeps_the_rest() -> None:
    R, E, c = rows(0, 3, 7, 4)
    columns = np.array([1, 4, 5])
    dense_map, used = eliminate(R, E, c, columns, "x")
    np.testing.assert_array_equal(used, [0, 1, 2])
    check_map(dense_map, R, E, c)
    np.testing.assert_array_equal(dense_map.Z[[0, 2, 3, 6]], np.eye(4))
    np.testing.assert_array_equal(dense_map.Y[[0, 2, 3, 6]], 0.0)
    sparse_map, used = eliminate(sp.csr_array(R), sp.csr_array(E), c, columns, "x")
    np.testing.assert_allclose(sparse_map.Z.toarray(), dense_map.Z, atol=1e-12)
    np.testing.assert_allclose(sparse_map.Y.toarray(), dense_map.Y, atol=1e-12)
    np.testing.assert_allclose(sparse_map.z0, dense_map.z0, atol=1e-12)


def test_only_rows_with_the_unknowns_are_used_up() -> None:
    R, E, c = rows(1, 4, 5, 2)
    R[[0, 2], 3] = 0.0
    R[[0, 2], 1] = 0.0
    map_, used = eliminate(R, E, c, np.array([1, 3]), "x")
    np.testing.assert_array_equal(used, [1, 3])
    check_map(map_, R[used], E[used], c[used])


@pytest.mark.parametrize("as_sparse", [False, True])
def test_what_cannot_be_eliminated_is_named(as_sparse: bool) -> None:
    R, E, c = rows(2, 3, 4, 1)
    make = sp.csr_array if as_sparse else np.array
    with pytest.raises(FormError, match="cannot eliminate slack: 4 unknowns appear in 3 equality rows, too few"):
        eliminate(make(R), make(E), c, np.arange(4), "slack")
    R[:, 2] = R[:, 1] = R[:, 0]
    with pytest.raises(FormError, match=r"cannot eliminate slack: .*\(singular\)"):
        eliminate(make(R), make(E), c, np.array([0, 1, 2]), "slack")
    R[:, 2] += 1e-14 * np.arange(3)
    with pytest.raises(FormError, match=r"cannot eliminate slack: .*\(singular\)"):
        eliminate(make(R), make(E), c, np.array([0, 1, 2]), "slack")


def test_units_do_not_make_equalities_singular() -> None:
    R, E, c = rows(2, 3, 4, 1)
    units = np.array([1e-9, 1.0, 1e9])
    map_, _ = eliminate(units[:, None] * R, units[:, None] * E, units * c, np.array([0, 1, 2]), "x")
    check_map(map_, R, E, c)


@pytest.mark.parametrize("as_sparse", [False, True])
def test_of_too_many_rows_a_determining_set_is_used(as_sparse: bool) -> None:
    make = sp.csr_array if as_sparse else np.array
    R, E, c = rows(8, 4, 6, 2)
    R[:, :2] = [[1.0, 0.0], [2.0, 0.0], [0.0, 0.0], [1.0, -3.0]]
    map_, used = eliminate(make(R), make(E), c, np.array([0, 1]), "x")
    assert used.size == 2 and 3 in used and 2 not in used
    check_map(map_, R[used], E[used], c[used])
    R[:, :2] = [[1.0, 2.0], [2.0, 4.0], [0.0, 0.0], [-3.0, -6.0]]
    with pytest.raises(FormError, match=r"cannot eliminate x: .*\(singular\)"):
        eliminate(make(R), make(E), c, np.array([0, 1]), "x")


@pytest.mark.parametrize("order", ["chain", "backwards", "shuffled"])
def test_long_chains_are_solved_instead_of_multiplied(order: str) -> None:
    steps, n = 30, 3
    R, E = np.zeros((steps * n, (steps + 1) * n)), np.zeros((steps * n, 2 * steps))
    for k in range(steps):
        place = slice(n * k, n * k + n)
        R[place, place], R[place, n * k + n : n * k + 2 * n] = -A, 2.0 * np.eye(n)
        E[place, 2 * k : 2 * k + 2] = GAIN
    c = np.random.default_rng(9).normal(size=steps * n)
    columns = np.arange(n, n * (steps + 1))
    if order == "backwards":
        R, columns = R[:, ::-1], columns - n
    if order == "shuffled":
        R = R[np.random.default_rng(1).permutation(len(R))]
    map_, _ = eliminate(sp.csr_array(R), sp.csr_array(E), c, columns, "x")
    assert isinstance(map_, SolvedMap) and isinstance(map_.block, BandedTriangle) == (order == "chain")
    check_map(map_, R, E, c)
    v, d = np.array([1.0, -2.0, 3.0]), np.random.default_rng(2).normal(size=2 * steps)
    np.testing.assert_allclose(map_.at(v, d), map_.Z @ v + map_.Y @ d + map_.z0, atol=1e-12)
    alone, _ = eliminate(sp.csr_array(R), sp.csr_array(0 * E), c, columns, "x")
    np.testing.assert_allclose(R @ alone.at(v, d) + c, 0.0, atol=1e-12)


def test_maps_compose() -> None:
    R, E, c = rows(3, 2, 6, 3)
    outer, _ = eliminate(R, E, c, np.array([0, 3]), "x")
    F, G, f = rows(4, 2, 4, 3)
    both = outer.then(null_space(F, G, f))
    check_map(both, R, E, c)
    inner = null_space(F, G, f)
    v, d = np.ones(2), np.arange(3.0)
    z = outer.Z @ (inner.Z @ v + inner.Y @ d + inner.z0) + outer.Y @ d + outer.z0
    np.testing.assert_allclose(both.Z @ v + both.Y @ d + both.z0, z, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_null_space_is_orthonormal_at_every_scale(scale: float) -> None:
    R, E, c = rows(5, 3, 7, 2)
    units = np.array([scale, 1.0, scale])
    map_ = null_space(units[:, None] * R, units[:, None] * E, units * c)
    assert map_.Z.shape == (7, 4)
    np.testing.assert_allclose(map_.Z.T @ map_.Z, np.eye(4), atol=1e-12)
    check_map(map_, R, E, c)
    np.testing.assert_allclose(map_.Z.T @ map_.z0, 0.0, atol=1e-12)


def test_null_space_of_nothing_and_of_rows_that_fix_everything() -> None:
    map_ = null_space(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))
    np.testing.assert_array_equal(map_.Z, np.eye(3))
    R, E, c = rows(6, 3, 3, 2)
    map_ = null_space(R, E, c)
    assert map_.Z.shape == (3, 0)
    check_map(map_, R, E, c)


def test_rows_that_repeat_are_harmless_unless_they_contradict() -> None:
    R, E, c = rows(7, 2, 5, 3)
    more = [np.vstack([a, a[0] + a[1], 0 * a[0]]) for a in (R, E, c[:, None])]
    map_ = null_space(more[0], more[1], more[2][:, 0])
    assert map_.Z.shape == (5, 3)
    check_map(map_, R, E, c)
    with pytest.raises(EmptyConstraintError, match="contradict"):
        null_space(np.vstack([R, R[0]]), np.vstack([E, E[0]]), np.array([*c, c[0] + 1.0]))
    with pytest.raises(FormError, match="restrict the data"):
        null_space(np.vstack([R, R[0]]), np.vstack([E, E[0] + 1.0]), np.array([*c, c[0]]))


# --- windows ---------------------------------------------------------------------------------------------------------


def reference(observer: bool, data: dict[str, Any], active: np.ndarray) -> np.ndarray:
    """Optimum of the window in its states x_0..x_N alone, box rows `active` held, from normal equations."""
    n, N = 3, STEPS
    I = np.eye(n * (N + 1))
    block = [I[n * k : n * k + n] for k in range(N + 1)]
    H = block[0].T @ block[0] / 4
    g = block[0].T @ data["prior"] / 4
    for k in range(N + 1):
        H = H + (C @ block[k]).T @ (C @ block[k])
        g = g + (C @ block[k]).T @ data["y"][k]
    F, f = [np.zeros((0, n * (N + 1)))], [np.zeros(0)]
    for k in range(N):
        if observer:
            F.append(block[k + 1] - (A - GAIN @ C) @ block[k])
            f.append(GAIN @ data["y"][k])
        else:
            J = block[k + 1] - A @ block[k]
            H = H + 4 * J.T @ J
    hold = np.flatnonzero(active)
    F.append(I[hold])
    f.append(np.where(active[hold] > 0, 0.5, -0.4))
    F_, f_ = np.vstack(F), np.concatenate(f)
    m = f_.size
    K = np.block([[H, F_.T], [F_, np.zeros((m, m))]])
    return np.linalg.lstsq(K, np.concatenate([g, f_]), rcond=1e-13)[0][: n * (N + 1)].reshape(N + 1, n)


FORMS = {
    "F1": (False, lambda x, w: [], 27, 12),
    "F2": (False, lambda x, w: [w], 15, 0),
    "F3": (False, lambda x, w: [x[1:]], 15, 0),
    "half": (False, lambda x, w: [w[:2]], 21, 6),
    "P0": (True, lambda x, w: [], 27, 24),
    "P1": (True, lambda x, w: [w], 15, 12),
    "P2": (True, lambda x, w: [w, x[1:]], 3, 0),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("as_sparse", [False, True])
@pytest.mark.parametrize("scale", [0.05, 1.5])
def test_one_definition_gives_every_form_of_the_window(
    form: str, given: bool, as_sparse: bool, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    observer, chosen, unknowns, equalities = FORMS[form]
    if as_sparse:
        monkeypatch.setattr(quadratic, "DENSE_LIMIT", 0)
    data = {k: scale * v for k, v in DATA.items()}
    p, x, w = window(observer, given)
    program = QuadraticProgram(p, chosen(x, w))
    m = program.matrices(data)
    assert program.dense is not as_sparse
    assert m.P.shape == (unknowns, unknowns) and m.A.shape[0] == equalities + (3 if observer else 15)
    for solver in ("auto", "proxqp" if as_sparse else "daqp"):
        session = p.compile(solver, eliminate=chosen(x, w))
        got = session.solve(data)
        assert got.solved
        active = got.active_set["box"].ravel()
        assert (scale < 1) == (not active.any())
        want = reference(observer, data, active)
        np.testing.assert_allclose(got["x"], want, atol=1e-7)
        np.testing.assert_allclose(got["w"], want[1:] - want[:-1] @ A.T, atol=1e-7)
        if observer:
            np.testing.assert_allclose(got["w"], (data["y"] - want @ C.T)[:-1] @ GAIN.T, atol=1e-7)


def test_the_two_windows_have_different_optima() -> None:
    solutions = [window(observer)[0].compile().solve(DATA)["x"] for observer in (False, True)]
    assert np.abs(solutions[0] - solutions[1]).max() > 1e-2


def test_condensed_windows_follow_matrix_data() -> None:
    p, x, w = window(given=True)
    full, small = p.compile("daqp"), p.compile("daqp", eliminate=[w])
    for k in range(3):
        data = DATA | {"A": A * (1 - 0.2 * k)}
        np.testing.assert_allclose(full.solve(data)["x"], small.solve(data)["x"], atol=1e-8)


def test_the_order_of_elimination_does_not_matter() -> None:
    p, x, w = window(True)
    a, b = QuadraticProgram(p, [w, x[1:]]).matrices(DATA), QuadraticProgram(p, [x[1:]]).condense([w]).matrices(DATA)
    np.testing.assert_allclose(a.P, b.P, atol=1e-10)
    np.testing.assert_allclose(a.q, b.q, atol=1e-10)


def test_states_that_no_equality_defines_stay() -> None:
    p, x, w = window()
    with pytest.raises(FormError, match="cannot eliminate x: 15 unknowns appear in 12 equality rows, too few"):
        p.compile(eliminate=[x])
