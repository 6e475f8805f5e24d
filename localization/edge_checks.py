"""Which measurements contradict the others: every instance of every cost, tested against all the rest.

An instance with whitened residual r, Jacobian J and weight w (of its robust loss) is compared with what the problem
predicts without it. With ``C = J S J'`` and S the joint covariance of its unknowns, the predicted residual is
``e = (I - wC)^-1 r`` with covariance ``I + C (I - wC)^-1``, and ``e' cov(e)^-1 e`` is chi-square distributed where all
noise models hold; with w = 1 it is ``r' (I - C)^-1 r``. Directions in which nothing else says anything have no
redundancy and cannot be tested (Baarda 1968; Cook and Weisberg 1982, section 2.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from problems.errors import DataError
from problems.forms.layout import TermLayout, noise_numbers
from problems.forms.residual_code import residual_code
from problems.forms.template import template_of
from problems.noise import whitening
from problems.solvers.session import Session, Solution

CANDIDATES = 5  # times as many instances are tested against the others as are reported
UNTESTED = 1e-6  # redundancy below which a direction is not tested


@dataclass(frozen=True, eq=False)
class EdgeCheck:
    """One instance of a cost.

    Attributes:
        term, row: name of the cost and instance in it.
        unknowns: name and instance of each slot.
        residual: (dim,) whitened.
        squared: sum of squares of `residual`; its expectation is at most the number of rows.
        p_value: of `squared` under chi-square with as many degrees of freedom as rows: too large a value, as redundancy
            below one makes residuals smaller.
        weight: of the robust loss at `squared`; 1 without a loss.
        redundancy: share (0 to 1) of the instance that other measurements control.
        statistic, freedom, p_against_others: test against all others; NaN, 0, NaN where nothing controls the instance.
    """

    term: str
    row: int
    unknowns: tuple[tuple[str, int], ...]
    residual: np.ndarray
    squared: float
    p_value: float
    weight: float
    redundancy: float
    statistic: float
    freedom: int
    p_against_others: float


def whitened_residuals(session: Session, solution: Solution) -> dict[str, np.ndarray]:
    """Whitened residuals (count, dim) of every cost by name; NaN rows where data are missing."""
    return {entry.term.name: _whitened(session, solution, entry)[0] for entry in _costs(session)}


def check_edges(session: Session, solution: Solution, worst: int = 10) -> list[EdgeCheck]:
    """The instances that contradict the others most, worst first.

    Redundancies are computed for the instances with the largest residuals only, some times as many as are reported.

    Args:
        session: that made `solution`, with the data of that solve.
        worst: how many.

    Raises:
        DataError: `worst` is not positive.
        UnobservableError: the costs leave a direction free.
    """
    if worst < 1:
        raise DataError(f"worst must be at least 1, got {worst}")
    entries = {entry.term.name: entry for entry in _costs(session)}
    squared = {
        name: np.nan_to_num(np.sum(_whitened(session, solution, entry)[0] ** 2, axis=1), nan=-1.0)
        for name, entry in entries.items()
    }
    # residuals with more rows are larger: compared by how far they lie above what is expected
    excess = [
        (values - dim) / np.sqrt(2 * dim)
        for values, dim in ((squared[name], template_of(entry.term).dim) for name, entry in entries.items())
    ]
    owner = np.repeat(np.arange(len(entries)), [len(part) for part in excess])
    row = np.concatenate([np.arange(len(part)) for part in excess])
    order = np.argsort(-np.concatenate(excess), kind="stable")[: CANDIDATES * worst]
    names = list(entries)
    chosen = {names[k]: row[order[owner[order] == k]] for k in np.unique(owner[order])}
    chosen = {name: rows[squared[name][rows] >= 0] for name, rows in chosen.items()}
    columns, covariance = _covariance(session, solution, [entries[n].columns[rows] for n, rows in chosen.items()])
    checks: list[EdgeCheck] = []
    for name, rows in chosen.items():
        entry = entries[name]
        residuals, jacobians = _whitened(session, solution, entry, rows)
        for k, instance in enumerate(rows):
            inside = np.searchsorted(columns, entry.columns[instance])
            checks.append(
                _checked(entry, int(instance), residuals[k], jacobians[k], covariance[np.ix_(inside, inside)])
            )
    checks.sort(key=lambda check: -_surprise(check))
    return checks[:worst]


def _surprise(check: EdgeCheck) -> float:
    return (check.statistic - check.freedom) / np.sqrt(2 * check.freedom) if check.freedom else -np.inf


def _costs(session: Session) -> list[TermLayout]:
    return [entry for entry in session.layout.terms if entry.term.kind == "cost"]


def _whitened(
    session: Session, solution: Solution, entry: TermLayout, rows: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (m, dim) and Jacobians (m, dim, width) of chosen instances, or of all."""
    term, template = entry.term, template_of(entry.term)
    assert term.noise is not None
    root = whitening(
        term.noise.kind, noise_numbers(term, template.dim, session.store), template.dim, term.count, term.what
    )
    stored, numbers = entry.stored, entry.numbers
    if rows is not None:
        stored, numbers = stored[rows], numbers[rows]
        root = root if len(root) == 1 else root[rows]
    inputs = [*solution.point[stored].T, *session.store.numbers[numbers].T]
    values = [np.ascontiguousarray(value) for value in inputs]
    r, J = residual_code(term).residual_and_jacobian(values, len(stored))
    if root.ndim == 2:
        return root * r, root[:, :, None] * J
    return (root @ r[:, :, None])[:, :, 0], root @ J


def _covariance(session: Session, solution: Solution, columns: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Tangent positions, ascending, and their joint covariance, of all instances that hold some of `columns`."""
    wanted = np.unique(np.concatenate([part.ravel() for part in columns]))
    slots, found = [], []
    for variable in session.problem.unknowns.values():
        own = session.layout.columns(variable[:])
        instances = np.flatnonzero(np.isin(own[:, 0], wanted))
        if instances.size:
            slots.append(variable[instances])
            found.append(own[instances].ravel())
    return np.concatenate(found), solution.covariance(*slots)


def _checked(entry: TermLayout, row: int, r: np.ndarray, J: np.ndarray, covariance: np.ndarray) -> EdgeCheck:
    from scipy.stats import chi2

    term, squared = entry.term, float(r @ r)
    weight = float(term.loss.weight(squared))
    c, axes = np.linalg.eigh(J @ covariance @ J.T)
    left = 1 - weight * c  # redundancy along each axis
    tested = left > UNTESTED
    along = (axes.T @ r)[tested] / left[tested]
    statistic = float(np.sum(along**2 / (1 + c[tested] / left[tested])))
    freedom = int(tested.sum())
    slots = tuple((slot.source.name, int(slot.indices[row if len(slot.indices) > 1 else 0])) for slot in term.slots)
    return EdgeCheck(
        term=term.name,
        row=row,
        unknowns=slots,
        residual=r,
        squared=squared,
        p_value=float(chi2.sf(squared, r.size)),
        weight=weight,
        redundancy=float(np.clip(left, 0, 1).mean()),
        statistic=statistic if freedom else np.nan,
        freedom=freedom,
        p_against_others=float(chi2.sf(statistic, freedom)) if freedom else np.nan,
    )
