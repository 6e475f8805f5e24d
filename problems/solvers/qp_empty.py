"""Constraints that no data can satisfy, found when a problem is compiled."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from problems.errors import EmptyConstraintError
from problems.forms.affine import Rows
from problems.forms.layout import constant_rows
from problems.forms.quadratic import QuadraticProgram
from problems.problem import DataSlot, Term
from problems.solvers.qp_check import is_infeasible


def require_nonempty(program: QuadraticProgram) -> None:
    """Raises EmptyConstraintError where the equalities and inequalities that read no data contradict each other."""
    if not any(_fixed(entry.term) for entry in program.layout.terms):
        return
    numbers = np.zeros(program.layout.data_size)
    rows = [r for r in program.rows.evaluate(numbers) if _fixed(r.layout.term)]
    constant = np.concatenate([r.c for r in rows])
    lower, upper = (np.concatenate([_bound(r, side) for r in rows]) - constant for side in ("lower", "upper"))
    if (lower <= 0).all() and (upper >= 0).all():
        return  # zero satisfies all of them, which is the usual case and spares the linear program
    R = sp.vstack([sp.csr_array(r.R) for r in rows], format="csr")
    if is_infeasible(R, lower, upper):
        names = ", ".join(r.layout.term.what for r in rows)
        raise EmptyConstraintError(f"{names} contradict each other: no point satisfies all, whatever the data are")


def _fixed(term: Term) -> bool:
    """A constraint that depends on no data."""
    values = (term.lower, term.upper, term.active)
    return (
        term.kind != "cost"
        and not term.data
        and term.active is None
        and not any(isinstance(v, DataSlot) for v in values)
    )


def _bound(rows: Rows, side: str) -> np.ndarray:
    term = rows.layout.term
    value = 0.0 if term.kind == "equality" else getattr(term, side)
    return constant_rows(value, rows.dim, rows.count, term.what).ravel()
