"""How much time pre-estimation saves, by form and solver, set-up and solve apart (spec dmhe-pre-estimation 7.5, 9.13).

CPU time of one step of the window of the four-state ring with all four measurements (n = p = 4): new measurements and a
new reference in every solve, and either constant matrices (steady state) or a new weight of the arrival cost as well
(what happens until the covariances settle). Pre-estimation replaces the window with estimated disturbances: F1 by P1,
F2 by P1, F3 by P2. ``auto`` answers by the affine map, as estimators do where no bound is violated; a solver that is
named is always called. The box on the states is never active.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import pytest

from mhe.polyhedron import Polyhedron
from mhe.scenarios.four_state_ring import CENTRAL_GAIN, scenario
from mhe.window import Window, WindowForm
from problems.bench.settings import validated
from problems.models import simulate
from problems.solvers.base import Status

FORMS: tuple[WindowForm, ...] = ("F1", "F2", "F3", "P1", "P2")
SOLVERS = ("auto", "daqp", "quadprog", "piqp", "clarabel", "proxqp", "osqp")
PAIRS: tuple[tuple[WindowForm, WindowForm], ...] = (("F1", "P1"), ("F2", "P1"), ("F3", "P2"))
WEIGHTS = ("constant weights", "new weights")
SEQUENCE = 64  # different windows
WARM, FEWEST, MOST, BUDGET = 10, 32, 400, 1.0  # steps, and seconds after which the fewest are enough


class Timed:
    """CPU time of one form with one solver.

    Attributes:
        unknowns: of the quadratic program.
        setup: ms of definition, compilation and first solve.
        solve: us of a step, median.
    """

    def __init__(self, form: WindowForm, solver: str, horizon: int, box: bool, weights: str) -> None:
        model = scenario.world(validated(scenario, {})).central
        bounds = Polyhedron.box([-1e3] * 4, [1e3] * 4) if box else None
        gain = CENTRAL_GAIN if form.startswith("P") else None
        steps = _steps(horizon, weights)
        begin = time.process_time()
        session = Window(model, horizon, form=form, gain=gain, state_bounds=bounds).compile(solver)
        session.update(information=steps[0].get("information", _information(0.0)))
        solved = session.solve(steps[0]).status is Status.SOLVED
        self.setup = 1e3 * (time.process_time() - begin)
        self.unknowns = session.current_map().reduced.size  # type: ignore[attr-defined]
        taken: list[int] = []
        while len(taken) < WARM + MOST and (len(taken) < WARM + FEWEST or sum(taken) < 1e9 * BUDGET):
            data = steps[len(taken) % SEQUENCE]
            begin = time.thread_time_ns()
            solution = session.solve(data)
            taken.append(time.thread_time_ns() - begin)
            solved &= solution.status is Status.SOLVED
        assert solved, f"{form} with {solver}, N={horizon}: not every step was solved"
        self.solve = float(np.median(taken[WARM:])) / 1e3


def _information(shift: float) -> np.ndarray:
    """About the stationary Pi^-1 of the ring."""
    return np.linalg.inv(np.diag([0.03, 0.05, 0.54, 0.98]) + shift * np.eye(4))


@cache
def _steps(horizon: int, weights: str) -> list[dict[str, np.ndarray]]:
    """Data of windows of different trials."""
    model = scenario.world(validated(scenario, {})).central
    run = simulate(model, horizon, np.random.default_rng(0), trials=SEQUENCE)
    references = run.states[:, 0] + 0.3 * np.random.default_rng(1).normal(size=(SEQUENCE, 4))
    steps = [{"y": y.ravel(), "reference": start} for y, start in zip(run.measurements, references, strict=True)]
    if weights == "new weights":
        steps = [step | {"information": _information(0.01 * k / SEQUENCE)} for k, step in enumerate(steps)]
    return steps


@cache
def timed(form: WindowForm, solver: str, horizon: int, weights: str = WEIGHTS[0], box: bool = True) -> Timed:
    return Timed(form, solver, horizon, box, weights)


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("horizon", [5, 20])
def test_time_saved_by_form_and_solver(horizon: int, weights: str) -> None:
    head = f"{'form':9}{'unknowns':>9}" + "".join(f"{solver:>10}" for solver in SOLVERS)
    for kind, name in (("solve", "us of CPU per step, median"), ("setup", "ms of CPU for set-up and first solve")):
        print(f"\nN = {horizon}, {weights}: {name}\n{head}")
        for form in FORMS:
            found = [timed(form, solver, horizon, weights) for solver in SOLVERS]
            print(f"{form:9}{found[-1].unknowns:9}" + "".join(f"{getattr(entry, kind):10.1f}" for entry in found))
    print(f"N = {horizon}, {weights}: time of a step with disturbances / with pre-estimation\n{head}")
    saved: dict[Any, float] = {}
    for pair in PAIRS:
        for solver in SOLVERS:
            first, second = (timed(form, solver, horizon, weights).solve for form in pair)
            saved[pair, solver] = first / second
        print(f"{pair[0]} -> {pair[1]} {'':9}" + "".join(f"{saved[pair, solver]:10.2f}" for solver in SOLVERS))
    # without a solver both are constant linear maps; what differs is the width of a product
    assert weights != "constant weights" or all(0.5 < saved[pair, "auto"] < 2.0 for pair in PAIRS)
    # fewer unknowns save time where the solver's own work counts, which for these is the case at N = 20
    assert horizon < 20 or all(saved[PAIRS[2], solver] > 1.1 for solver in ("piqp", "clarabel", "proxqp", "osqp"))
    # sparse states against sparse states save nothing: they have as many unknowns, and the observer's have equalities
    assert all(saved[PAIRS[1], solver] < 1.5 for solver in SOLVERS)


@pytest.mark.parametrize("weights", WEIGHTS)
def test_condensed_pre_estimation_is_flat_in_the_horizon(weights: str) -> None:
    grown: dict[Any, float] = {}
    print(f"\nwithout rows, {weights}: us of CPU per step at N = 5 and N = 20")
    for form in FORMS:
        line = f"{form:4}"
        for solver in ("daqp", "quadprog", "piqp", "osqp"):
            short, long = (timed(form, solver, horizon, weights, box=False).solve for horizon in (5, 20))
            grown[form, solver] = long / short
            line += f"{solver:>12} {short:7.1f} {long:8.1f} x{long / short:6.2f}"
        print(line)
    assert all(grown["P2", solver] < 1.5 for solver in ("daqp", "quadprog", "piqp", "osqp"))
    # kept factors make F3 flat too, until the weights change and it has to be factorized again
    assert grown["F3", "daqp"] > (3.0 if weights == "new weights" else grown["P2", "daqp"])
