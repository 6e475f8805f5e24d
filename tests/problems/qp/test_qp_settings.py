"""Settings, limits and tolerances of the QP backends."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from qp_problems import CLASSES, QP, backend_class, boxed, random_qp, window_qp

from problems.errors import FormError, SettingError, UnknownNameError
from problems.solvers.base import Options, QPBackend, Status
from problems.solvers.presets import PRESETS, preset
from problems.solvers.qp_qpsolvers import qpsolvers_backend


def test_contract(cls: type[Any]) -> None:
    assert isinstance(boxed().backend(cls), QPBackend)
    assert cls.version()[0].isdigit()
    assert cls.extra in (None, "solvers", "gpl")


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("daqp", "primal_tol"),
        ("osqp", "alpha"),
        ("proxqp", "eps_abs"),
        ("piqp", "tau"),
        ("clarabel", "tol_feas"),
        ("highs", "presolve"),
        ("qpoases", "nWSR"),
        ("qrqp", "max_iter"),
    ],
)
def test_settings_are_checked(name: str, near: str) -> None:
    cls = backend_class(name)
    with pytest.raises(SettingError, match=near):
        boxed().backend(cls, extra={near + "x": 1})
    with pytest.raises(SettingError, match=f"{near}.*expected"):
        boxed().backend(cls, extra={near: [1, 2]})


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("osqp", {"max_iter": 1}),
        ("proxqp", {"max_iter": 1}),
        ("piqp", {"max_iter": 1}),
        ("clarabel", {"max_iter": 1}),
        ("daqp", {"iter_limit": 1}),
        ("qpoases", {"nWSR": 1}),
        ("qrqp", {"max_iter": 1}),
    ],
)
def test_iteration_limits_reach_the_library(name: str, setting: dict[str, int]) -> None:
    cls = backend_class(name)
    qp = window_qp(np.random.default_rng(1))
    qp.P += np.eye(len(qp.q))
    for options in ({"iteration_limit": 1}, {"extra": setting}):
        result = qp.backend(cls, **options).solve(qp.q, qp.l, qp.u)
        assert result.status is Status.ITERATION_LIMIT, (result.status, result.message)


@pytest.mark.parametrize("name", ["osqp", "clarabel", "highs", "daqp"])
def test_time_limits_hold_for_one_solve(name: str) -> None:
    cls = backend_class(name)
    qp = random_qp(np.random.default_rng(14), 60, 120, 10, pull=30.0)
    short = qp.backend(cls, time_limit=1e-7).solve(qp.q, qp.l, qp.u)
    assert short.status is Status.TIME_LIMIT, (short.status, short.message)
    # The clock of some libraries runs on from solve to solve.
    small = boxed()
    backend = small.backend(cls, time_limit=0.02)
    statuses = {small.judged(backend)[0] for _ in range(150)}
    assert statuses == {Status.SOLVED}


def test_tolerance_is_translated() -> None:
    for name in ("osqp", "proxqp", "piqp", "clarabel"):
        cls = backend_class(name)
        qp = random_qp(np.random.default_rng(15), 10, 15, 2, pull=10.0)
        loose, tight = (qp.backend(cls, tolerance=t).solve(qp.q, qp.l, qp.u) for t in (1e-2, 1e-10))
        assert qp.violation(tight.x, tight.y) < 1e-5
        assert loose.iterations < tight.iterations


def test_quadprog_needs_a_definite_hessian() -> None:
    cls = backend_class("quadprog")
    with pytest.raises(FormError, match="positive definite"):
        QP(np.diag([1.0, 0.0]), [0, 0], np.eye(2), [-1, -1], [1, 1]).backend(cls)


def test_piqp_and_proxqp_have_a_dense_and_a_sparse_side() -> None:
    qp = random_qp(np.random.default_rng(16), 8, 12, 3)
    for name in ("piqp", "proxqp"):
        cls = backend_class(name)
        found = []
        for side in ("dense", "sparse", "auto"):
            backend = qp.backend(cls, extra={"backend": side})
            other = QP(1.5 * qp.P, qp.q, 0.9 * qp.A, 0.9 * qp.l, 0.9 * qp.u)
            qp.judged(backend)
            backend.update(*other.matrices(cls))
            status, result = other.judged(backend)
            assert status is Status.SOLVED
            found.append(result.x)
        np.testing.assert_allclose(found[0], found[1], atol=1e-5)
        np.testing.assert_allclose(found[0], found[2], atol=1e-5)


def test_unknown_solver_of_qpsolvers() -> None:
    with pytest.raises(UnknownNameError, match="daqp"):
        qpsolvers_backend("daqpp")


def test_settings_go_to_the_solver_behind_qpsolvers() -> None:
    cls = backend_class("qpsolvers:daqp")
    qp = boxed()
    assert qp.judged(qp.backend(cls, extra={"primal_tol": 1e-9}))[0] is Status.SOLVED
    result = qp.backend(cls, extra={"no_such_setting": 1}).solve(qp.q, qp.l, qp.u)
    assert result.status is Status.FAILED and "no_such_setting" in result.message


def test_presets() -> None:
    assert preset("default") == Options()
    assert preset("high-accuracy").tolerance < Options().tolerance < preset("fast").tolerance
    assert set(PRESETS) == {"default", "high-accuracy", "fast"}
    with pytest.raises(UnknownNameError, match="high-accuracy"):
        preset("high_accuracy")


def test_nothing_is_printed() -> None:
    """In a fresh process, since some libraries announce themselves once."""
    names = [name for name in CLASSES if not name.startswith("qpsolvers:")]
    code = f"""
        import importlib, numpy as np, scipy.sparse as sp
        from problems.errors import MissingExtraError
        from problems.solvers.base import Options
        P, A = np.eye(3), np.vstack([np.eye(3), np.ones((1, 3))])
        for target in {[CLASSES[name] for name in names]}:
            module, _, name = target.partition(":")
            cls = getattr(importlib.import_module("problems.solvers." + module), name)
            c = np.ascontiguousarray if cls.dense else sp.csc_array
            l, u = np.full(4, -1.0), np.full(4, 1.0)
            try:
                backend = cls(c(P), np.ones(3), c(A), l, u, Options())
            except MissingExtraError:
                continue
            impossible = l.copy(), u.copy()
            impossible[0][3], impossible[1][3] = 8.0, 9.0
            free = np.full(4, np.inf)
            for bounds in ((l, u), impossible, (l, u), (-free, free), (u, l), (l, l)):
                backend.solve(np.arange(3.0), *bounds)
    """
    root = Path(__file__).parents[3]
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=root, capture_output=True, text=True, check=True
    )
    assert run.stdout == ""
    assert run.stderr == ""
