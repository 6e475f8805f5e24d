"""What scenarios of agreement share: one problem solved with several data, compared with a certified optimum."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.bench.scenario import Outcome
from problems.errors import AccuracyWarning, BackendError
from problems.forms.least_squares import LeastSquares
from problems.solvers.base import Status
from problems.solvers.compile import is_affine
from problems.solvers.session import Session

CERTIFIED = 1e-9  # of the residuals of a reference, relative to the size of its gradient and rows
METRICS = ("distance_to_reference", "objective_error", "residual", "active_rows")
NO_POINT = (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED)


@dataclass(frozen=True, eq=False)
class Case:
    """One solve.

    Attributes:
        data: by name.
        initial: by variable name, or None.
        scale: size of the numbers in the gradient, at least 1; certificates are relative to it.
    """

    data: Mapping[str, Any]
    initial: Mapping[str, Any] | None = None
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Optimum:
    """A certified optimum.

    Attributes:
        values: by variable name.
        objective: cost.
        size: what errors of the cost are relative to: 1, the cost, or in a quadratic program its constant part, which
            no solver sees and which is mostly far larger than the cost that is left at the optimum.
        active: number of rows that hold the optimum.
    """

    values: Mapping[str, np.ndarray]
    objective: float
    size: float
    active: int


def certified_optima(session: Session, cases: Sequence[Case]) -> list[Optimum]:
    """Solve tightly, and accept what our own residuals certify.

    Args:
        session: of a solver and tolerance that serve as reference.

    Raises:
        BackendError: the reference is not certified: a residual exceeds `CERTIFIED` times the scale of its case.
    """
    optima = []
    for number, case in enumerate(cases):
        solution = session.solve(case.data, initial=case.initial)
        worst = max(solution.residuals.values())
        if not worst <= CERTIFIED * case.scale:
            raise BackendError(
                f"the reference of case {number} by {session.solver} is not certified: {solution.status}, largest "
                f"residual {worst:.1e}, expected at most {CERTIFIED * case.scale:.1e}"
            )
        active = sum(int(np.count_nonzero(rows)) for rows in solution.active_set.values())
        values = {name: value.copy() for name, value in solution.values.items()}
        size = max(1.0, abs(solution.objective), _constant(session))
        optima.append(Optimum(values, solution.objective, size, active))
    return optima


def _constant(session: Session) -> float:
    """Cost of a quadratic program at zero for the data of the session; 0 for other problems."""
    if not is_affine(session.problem):
        return 0.0
    bound = LeastSquares(session.problem, session.layout).bind(session.store)
    return bound.cost(session.layout.identity())


def compared(session: Session, cases: Sequence[Case], optima: Sequence[Optimum], variable: str) -> Outcome:
    """Solve all cases and measure how far the answers are from the optima.

    Args:
        session: fresh from compiling.
        variable: the one whose values are compared; others follow from it.

    Returns:
        ``distance_to_reference``: norm of the difference of `variable` in tangent coordinates, relative to the norm of
        the optimum or 1. ``objective_error``: difference of the costs, relative to `Optimum.size`. Both are the worst
        of all cases, None where a case has no point. ``residual``: the largest, recomputed by us. ``active_rows``: of
        all optima together. The trace is the last value of `variable`, None where no case has one.
    """
    space = session.problem.unknowns[variable].space
    distances, errors, residuals = [], [], []
    times: Counter[str] = Counter({"compile": session.compile_seconds})
    status: Counter[str] = Counter()
    steps, iterations, last = [], 0, None
    for case, optimum in zip(cases, optima, strict=True):
        solution = session.solve(case.data, initial=case.initial)
        status[str(solution.status)] += 1
        iterations += solution.iterations
        times.update(solution.seconds)
        steps.append(sum(solution.seconds.values()))
        if not solution.solved:
            warnings.warn(f"{session.solver}: {solution.status}: {solution.message}", AccuracyWarning, stacklevel=3)
        if solution.status in NO_POINT:
            continue
        residuals.append(max(solution.residuals.values()))
        exact, last = optimum.values[variable], solution[variable].copy()
        away = np.linalg.norm(space.local_array(exact, solution[variable]))
        distances.append(float(away) / max(1.0, float(np.linalg.norm(exact))))
        errors.append(abs(solution.objective - optimum.objective) / optimum.size)
    whole = len(distances) == len(cases)
    return Outcome(
        metrics={
            "distance_to_reference": max(distances) if whole else None,
            "objective_error": max(errors) if whole else None,
            "residual": max(residuals, default=None),
            "active_rows": float(sum(optimum.active for optimum in optima)),
        },
        options={"form": session.form},
        times=dict(times),
        step_seconds=np.array(steps),
        status=status,
        iterations=iterations,
        residual=max(residuals, default=None),
        trace=last,
    )
