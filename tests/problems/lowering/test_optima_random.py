"""Random affine models solved in every way against the dense reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from random_models import SEEDS, Model, draw

import problems.forms.quadratic as quadratic
from problems.forms.factor_graph import FactorGraph


def multipliers(model: Model, solution: Any) -> np.ndarray:
    """(rows,) in the order of the reference."""
    y = solution.multipliers
    names = [s.name for kind in ("equality", "inequality") for s in model.specs if s.kind == kind]
    assert set(y) == set(names)
    return np.concatenate([np.zeros(0), *(y[n].ravel() for n in names)])


def active_rows(model: Model, solution: Any) -> np.ndarray:
    equal = np.concatenate([np.zeros(0), *(np.ones(s.count * s.dim) for s in model.specs if s.kind == "equality")])
    bounded = [solution.active_set[s.name].ravel() for s in model.specs if s.kind == "inequality"]
    return np.concatenate([equal, *bounded])


def flat(solution: Any) -> np.ndarray:
    return np.concatenate([solution[name].ravel() for name in ("x", "b", "w")])


WAYS: dict[str, dict[str, Any]] = {
    "auto": {"solver": "auto"},
    "daqp": {"solver": "daqp"},
    "proxqp": {"solver": "proxqp"},
    "osqp": {"solver": "osqp"},
    "w condensed": {"solver": "auto", "eliminate": ("w", slice(None))},
    "w condensed, named": {"solver": "daqp", "eliminate": ("w", slice(None))},
    "x condensed": {"solver": "auto", "eliminate": ("x", slice(1, None))},
    "part of w condensed": {"solver": "daqp", "eliminate": ("w", slice(0, 1))},
    "gauss-newton": {"solver": "gauss-newton"},
    "ipopt": {"solver": "ipopt", "tolerance": 1e-9},
    "sparse": {"solver": "auto", "sparse": True},
    "sparse, condensed": {"solver": "proxqp", "sparse": True, "eliminate": ("w", slice(None))},
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_finds_the_optimum(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = dict(WAYS[way])
    if settings.pop("sparse", False):
        monkeypatch.setattr(quadratic, "DENSE_LIMIT", 0)
    eliminate = settings.pop("eliminate", None)
    for seed in SEEDS[:12]:
        m = draw(seed)
        if eliminate is not None:
            if not any(s.kind == "equality" for s in m.specs):
                continue
            name, part = eliminate
            settings["eliminate"] = [m.problem.unknowns[name][part]]
        session = m.problem.compile(**settings)
        for _ in range(3):
            want = m.dense()
            solution = session.solve(m.values)
            z, y = flat(solution), multipliers(m, solution)
            assert solution.solved, (seed, solution)
            want.check(z, y, 1e-6)
            exact = want.solve(active_rows(m, solution))
            np.testing.assert_allclose(z, exact, atol=2e-6 * max(1.0, np.abs(exact).max()))
            assert solution.objective == pytest.approx(want.objective(z), rel=1e-9, abs=1e-9)
            if settings["solver"] == "auto":
                assert (solution.method == "linear") == (want.violation(want.solve(want.l == want.u)) <= 1e-8)
            size = max(1.0, abs(want.objective(z)), np.abs(y).max(initial=0.0))
            assert max(solution.residuals.values()) < 1e-6 * size
            m.redraw()
            m.fit_bounds()


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
@pytest.mark.parametrize("solver", ["gtsam-lm", "gtsam-gn", "gtsam-isam2"])
def test_graphs_find_the_optimum(solver: str) -> None:
    pytest.importorskip("gtsam")
    for seed in SEEDS[:8]:
        m = draw(seed, inequalities=False)
        session = m.problem.compile(solver)
        for _ in range(2):
            want = m.dense()
            exact = want.solve(np.ones(want.l.size))
            solution = session.solve(m.values)
            assert solution.solved, (seed, solution)
            np.testing.assert_allclose(flat(solution), exact, atol=1e-5 * max(1.0, np.abs(exact).max()))
            assert solution.objective == pytest.approx(want.objective(exact), rel=1e-8, abs=1e-8)
            m.redraw()


@pytest.mark.filterwarnings("ignore::problems.errors.SlowPathWarning")
@pytest.mark.parametrize("seed", SEEDS[:8])
def test_the_error_of_a_graph_is_the_cost_up_to_a_constant(seed: int) -> None:
    pytest.importorskip("gtsam")
    m = draw(seed, inequalities=False)
    graph, want = FactorGraph(m.problem), m.dense()
    equal = want.A, want.l
    free = np.linalg.svd(equal[0])[2][np.linalg.matrix_rank(equal[0]) :].T if want.l.size else np.eye(want.q.size)
    start = np.linalg.pinv(equal[0]) @ equal[1] if want.l.size else np.zeros(want.q.size)
    differences = []
    for _ in range(3):
        z = start + free @ m.normal(free.shape[1])  # where the equalities hold
        point = {n: z[a : a + v.size].reshape(v.shape) for (n, v), a in zip(shapes(m).items(), offsets(m), strict=True)}
        native, values, _ = graph.to_gtsam(m.values, point)
        differences.append(native.error(values) - want.objective(z))
    np.testing.assert_allclose(differences, differences[0], atol=1e-7 * max(1.0, abs(differences[0])))


def shapes(model: Model) -> dict[str, np.ndarray]:
    return {n: np.zeros((v.count, v.space.dim)) for n, v in model.problem.unknowns.items()}


def offsets(model: Model) -> list[int]:
    return list(model.starts()[0].values())
