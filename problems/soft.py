"""Soft inequalities: bounds that may be violated at a price, by slack variables (exact and quadratic penalties).

A linear price is exact: as long as it exceeds every multiplier of the hard problem, the hard solution is found where
there is one (Nocedal and Wright, ch. 17). A quadratic price always gives way a little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from problems.errors import SettingError, ShapeError
from problems.forms.layout import check_numbers
from problems.forms.template import as_column, template_of
from problems.noise import Gaussian
from problems.problem import DataSlot, Problem, Term
from problems.spaces import Vector

CURVATURE = 1e-6


@dataclass(frozen=True)
class Soft:
    """Price ``linear * s + quadratic / 2 * s^2`` of a violation s, per component of the residual.

    A quadratic price of less than a millionth of the linear one is taken as that, which keeps slacks determined.

    Raises:
        SettingError: a negative or infinite price, or none at all.
    """

    linear: float
    quadratic: float = 1.0

    def __post_init__(self) -> None:
        prices = (self.linear, self.quadratic)
        if not all(np.isfinite(p) and p >= 0 for p in prices) or not any(prices):
            raise SettingError(f"Soft needs finite prices >= 0, one of them positive; got {prices}")


def relaxed(problem: Problem, term: Term, soft: Soft) -> Term:
    """Add a stated inequality as a soft one. See `Problem.inequality`."""
    dim = template_of(term).dim
    check_numbers(term, dim)
    sides = [side for side in ("upper", "lower") if _has_bound(getattr(term, side))]
    if not sides:
        raise ShapeError(f"{term.what}: no bound is finite, so there is nothing to soften")
    slack = problem.variables(f"{term.name} slack", Vector(dim), term.count)
    first: Term | None = None
    for side in sides:
        limits = {"lower": -np.inf, "upper": np.inf, side: getattr(term, side)}
        residual = _moved(term.residual, len(term.slots), -1.0 if side == "upper" else 1.0)
        row = replace(term, name=f"{term.name} {side}", residual=residual, slots=(*term.slots, slack[:]), **limits)
        added = problem.inequality(
            row.name, residual, on=row.slots, data=row.data, lower=row.lower, upper=row.upper, active=row.active
        )
        first = first or added
    problem.inequality(f"{term.name} slack sign", _itself, on=slack, lower=0.0, upper=np.inf)
    problem.cost(
        f"{term.name} slack price",
        _itself,
        on=slack,
        noise=Gaussian(information=max(soft.quadratic, CURVATURE * soft.linear) * np.eye(dim)),
        linear=np.full(dim, soft.linear),
    )
    assert first is not None
    return first


def _has_bound(value: Any) -> bool:
    return isinstance(value, DataSlot) or bool(np.isfinite(np.asarray(value, dtype=float)).any())


def _itself(s: Any) -> Any:
    return s


@lru_cache(maxsize=1024)
def _moved(residual: Callable[..., Any], slots: int, sign: float) -> Callable[..., Any]:
    """The residual moved by its slack, which is the slot after its own ones."""

    def moved(*given: Any) -> Any:
        return as_column(residual(*given[:slots], *given[slots + 1 :])) + sign * given[slots]

    return moved
