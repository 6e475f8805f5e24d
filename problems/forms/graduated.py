"""Graduated non-convexity: the same costs under a ladder of wider losses, the widest nearly quadratic.

Solving from the widest down leads past the local minima that outliers make (Blake and Zisserman 1987; Yang et al. 2020:
for Geman-McClure their surrogate with parameter mu is the loss with its scale times ``sqrt(mu)``).
"""

from __future__ import annotations

from dataclasses import replace

from problems.noise import L2
from problems.problem import Problem

WIDEST = 4096.0  # times the scale: also an outlier of thousands of sigmas starts inside the quadratic part
RATIO = 2.0


def ladder(problem: Problem) -> list[Problem]:
    """Copies of a problem whose losses are wider, widest first; none where no cost has a robust loss."""
    if all(isinstance(term.loss, L2) for term in problem.terms.values()):
        return []
    rungs, factor = [], WIDEST
    while factor > 1:
        rungs.append(_widened(problem, factor))
        factor /= RATIO
    return rungs


def _widened(problem: Problem, factor: float) -> Problem:
    copy = Problem(f"{problem.name}, losses times {factor:g}")
    copy.unknowns, copy.inputs = problem.unknowns, problem.inputs
    for name, term in problem.terms.items():
        if isinstance(term.loss, L2):
            copy.terms[name] = term
        else:
            copy.terms[name] = replace(term, loss=type(term.loss)(factor * term.loss.scale))
    return copy
