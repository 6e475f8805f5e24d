"""Random affine models lowered to every form against the dense reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from random_models import SEEDS, Model, draw

from problems.forms.layout import DataStore, Layout
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.nonlinear import NonlinearProgram
from problems.forms.quadratic import QuadraticProgram


def to_dense(matrix: Any) -> np.ndarray:
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def infinite(bounds: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(bounds), bounds, np.sign(bounds) * 1e9)


def stored(model: Model) -> DataStore:
    store = DataStore(Layout(model.problem))
    for name, value in model.values.items():
        store.set(name, value)
    return store


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dense", [True, False])
def test_quadratic_program_equals_the_reference(seed: int, dense: bool) -> None:
    m = draw(seed)
    program = QuadraticProgram(m.problem, dense=dense)
    for _ in range(2):
        want, got = m.dense(), program.matrices(m.values)
        assert isinstance(got.P, np.ndarray) is dense
        np.testing.assert_allclose(to_dense(got.P), want.P, atol=1e-11)
        np.testing.assert_allclose(got.q, want.q, atol=1e-11)
        np.testing.assert_allclose(to_dense(got.A), want.A, atol=1e-12)
        np.testing.assert_allclose(infinite(got.l), infinite(want.l), atol=1e-11)
        np.testing.assert_allclose(infinite(got.u), infinite(want.u), atol=1e-11)
        m.redraw()


@pytest.mark.parametrize("seed", SEEDS)
def test_claimed_changes_cover_what_changes(seed: int) -> None:
    m = draw(seed)
    w = m.problem.unknowns["w"]
    for program in (QuadraticProgram(m.problem), condensable(m, [w])):
        if program is None:
            continue
        before = program.matrices(m.values)
        for name, value in list(m.values.items()):
            number = np.asarray(value)
            moved = np.where(np.isfinite(number), 1.7 * number + 0.3 * (number == 0), number)
            after = program.matrices(m.values | {name: moved})
            pairs = {k: [to_dense(getattr(part, k)) for part in (before, after)] for k in "PqAlu"}
            changed = {k for k, (old, new) in pairs.items() if not np.array_equal(old, new)}
            assert changed <= set(program.changes[name])


def condensable(m: Model, eliminated: list[Any]) -> QuadraticProgram | None:
    return QuadraticProgram(m.problem, eliminated) if any(s.kind == "equality" for s in m.specs) else None


@pytest.mark.parametrize("seed", SEEDS)
def test_least_squares_equals_the_reference(seed: int) -> None:
    m = draw(seed)
    layout = Layout(m.problem)
    form = LeastSquares(m.problem, layout)
    for _ in range(2):
        want, z = m.dense(), m.normal(layout.size)
        bound = form.bind(stored(m))
        cost, gradient, entries = bound.linearize(z)
        assert cost == pytest.approx(want.objective(z), rel=1e-10, abs=1e-10)
        assert bound.cost(z) == pytest.approx(cost, rel=1e-12, abs=1e-12)
        np.testing.assert_allclose(gradient, want.P @ z + want.q, atol=1e-9)
        H = np.zeros_like(want.P)
        columns = np.repeat(np.arange(layout.size), np.diff(form.pattern.indptr))
        assert (form.pattern.indices <= columns).all()
        H[form.pattern.indices, columns] = entries
        np.testing.assert_allclose(H + np.triu(H, 1).T, want.P, atol=1e-9)
        rows = Constraints(layout)
        values, entries = rows.evaluate(z, bound.numbers, bound.flags)
        J = np.zeros((rows.size, layout.size))
        np.add.at(J, (rows.rows, rows.columns), entries)
        low, high = rows.bounds(bound.numbers, bound.flags)
        on = np.isfinite(want.l) | np.isfinite(want.u)
        np.testing.assert_allclose(J[on], want.A[on], atol=1e-12)
        np.testing.assert_allclose(infinite(low - values)[on], infinite(want.l - want.A @ z)[on], atol=1e-9)
        np.testing.assert_allclose(infinite(high - values)[on], infinite(want.u - want.A @ z)[on], atol=1e-9)
        m.redraw()


@pytest.mark.parametrize("seed", SEEDS[::2])
def test_nonlinear_program_equals_the_reference(seed: int) -> None:
    m = draw(seed)
    program, want = NonlinearProgram(m.problem), m.dense()
    store = program.store(m.values)
    reference, v = m.normal(program.layout.size), m.normal(program.layout.size)
    p, z = program.parameters(store, reference), reference + v
    f, gradient = program.derivatives["grad_f"](v, p)
    g, J = program.derivatives["jac_g"](v, p)
    H = np.asarray(program.derivatives["hess_lag"](v, p, 1.0, np.ones(want.l.size)))
    assert float(f) == pytest.approx(want.objective(z), rel=1e-10, abs=1e-10)
    np.testing.assert_allclose(np.asarray(gradient).ravel(), want.P @ z + want.q, atol=1e-9)
    np.testing.assert_allclose(H + np.triu(H, 1).T, want.P, atol=1e-9)
    low, high = program.bounds(store)
    g = np.asarray(g).ravel()
    on = np.isfinite(want.l) | np.isfinite(want.u)
    np.testing.assert_allclose(np.asarray(J)[on], want.A[on], atol=1e-12)
    np.testing.assert_allclose(infinite(low - g)[on], infinite(want.l - want.A @ z)[on], atol=1e-9)
    np.testing.assert_allclose(infinite(high - g)[on], infinite(want.u - want.A @ z)[on], atol=1e-9)


def test_the_models_have_what_they_are_drawn_for() -> None:
    seen: dict[str, int] = dict.fromkeys(("missing", "off", "active", "twice", "weights", "linear", "presence"), 0)
    for seed in SEEDS[:12]:
        m = draw(seed)
        active = m.problem.compile("daqp").solve(m.values).active_set
        seen["active"] += sum(int(np.abs(a).sum()) for a in active.values())
        for s in m.specs:
            seen["off"] += sum(not m.is_on(s, i) for i in range(s.count))
            pairs = [(a, b) for k, (a, i) in enumerate(s.slots) for b, j in s.slots[:k] if a == b and (i == j).any()]
            seen["twice"] += len(pairs)
            seen["weights"] += isinstance(s.noise[1], str)
            seen["linear"] += s.linear is not None
            seen["presence"] += any(part.role == "presence" for part in s.parts)
        seen["missing"] += sum(bool(np.isnan(v).any()) for v in m.values.values())
    assert min(seen.values()) >= 3, seen
