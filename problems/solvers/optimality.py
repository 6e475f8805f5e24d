"""Our own test of optimality for solutions of graphs and nonlinear programs, whatever backend they come from.

With g and H the gradient and the Gauss-Newton Hessian of the costs at the point (tangent coordinates), y the
multipliers of the inequalities with impossible signs cut off, and ``r = g + J'y``, the *decrement* is

    max over d with (Jacobian of the equalities) d = 0 of  -r'd - d'Hd/2   +   sum of |y| times distance to its bound,

where the sum is over inequalities and, with the multipliers of that maximum, equalities. For a convex problem it
bounds how far the cost is from its minimum; without constraints it is half the squared Newton decrement (Boyd and
Vandenberghe, Convex Optimization, 9.5.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from problems.forms.costs import Bound
from problems.forms.layout import Layout
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.pins import Pins
from problems.forms.sparsity import HessianPattern
from problems.solvers.base import Options, Status
from problems.solvers.factorizations import Factorization, SingularError, factorization

GROWTH = 1e9  # of a general direction by an inverse iteration, below which none is free
DAMPED_GROWTH = 1e2  # the same by a factorization of a damped matrix, which bounds it
LOOSE = 1e-13  # curvature along a direction, in the scale of the diagonal, that is none
RIDGE = 1e-12  # of the largest diagonal entry, added so that directions the costs leave free have finite steps


@dataclass(frozen=True)
class Optimality:
    """How far a point is from optimal.

    Attributes:
        cost: objective.
        decrement: see the module; NaN where it could not be computed.
        violation: largest violation of a constraint.
        free: unknowns that appear in no cost and no constraint, for people; empty where there are none.
        gauge: what to say where the costs do not see some direction, as in graphs of relative measurements alone; such
            a point is one of many optima. Empty where there is none; not looked for where there are constraints.
    """

    cost: float
    decrement: float
    violation: float
    free: str
    gauge: str = ""

    def within(self, options: Options) -> bool:
        """Decrement at most 0.1 tolerance max(1, cost), violation at most 10 tolerance; NaN is not."""
        tolerance = options.tolerance
        return self.decrement <= 0.1 * tolerance * max(1.0, self.cost) and self.violation <= 10 * tolerance

    def judge(self, claim: Status, message: str, options: Options) -> tuple[Status, str]:
        """The status of a point that a backend gave with `claim`.

        A point within tolerance is solved whatever the backend says; one beyond it that was claimed to be a solution is
        inaccurate. Claims of infeasibility are believed only where a constraint is violated.
        """
        if not np.isfinite(self.cost):
            return Status.FAILED, _joined("the cost is not finite at the point", message)
        if self.free:
            return Status.UNBOUNDED, _joined(f"the costs leave {self.free} free", message)
        if self.within(options):
            return Status.SOLVED, _joined(self.gauge, message) if self.gauge else message
        text = f"decrement {self.decrement:.1e}, violation {self.violation:.1e}, asked for {options.tolerance:.1e}"
        if claim is Status.SOLVED:
            return Status.INACCURATE, _joined(text, message)
        if claim is Status.INFEASIBLE and self.violation <= 10 * options.tolerance:
            return Status.FAILED, _joined("claimed infeasible, but the point satisfies the constraints", message)
        return claim, _joined(text, message)


def optimality(
    form: LeastSquares,
    constraints: Constraints,
    pins: Pins,
    bound: Bound,
    point: np.ndarray,
    multipliers: np.ndarray | None = None,
) -> Optimality:
    """Test a point.

    Args:
        constraints: all but the pinned ones.
        pins: fixed instances, onto which `point` was moved.
        multipliers: of the rows of `constraints`, positive at an upper bound; those of equalities are not used.
    """
    pattern = form.pattern
    cost, gradient, hessian = bound.linearize(point)
    pins.reduce(gradient, hessian, pattern)
    values, entries = constraints.evaluate(point, bound.numbers, bound.flags)
    touched = np.zeros(pattern.size, bool)
    touched[constraints.columns[entries != 0]] = True
    free = form.layout.names_of(((hessian[pattern.diagonal] <= 0) & ~touched).astype(float))
    if not (np.isfinite(cost) and np.isfinite(gradient).all() and np.isfinite(hessian).all()):
        return Optimality(float("nan"), float("nan"), float("nan"), free)
    violation = pins.violation(point, bound.numbers)
    if not constraints.size:
        decrement, solver = _decrement(pattern, hessian, gradient)
        gauge = "" if solver is None else gauge_freedom(pattern, hessian, solver, form.layout)
        return Optimality(cost, decrement, violation, free, gauge)
    lower, upper = constraints.bounds(bound.numbers, bound.flags)
    violation = float(np.max([violation, *np.maximum(np.maximum(values - upper, lower - values), 0.0)]))
    y = np.zeros(constraints.size) if multipliers is None else multipliers.copy()
    y[: constraints.equalities] = 0.0
    limit = np.where(y > 0, upper, lower)
    y = np.where(np.isfinite(limit), y, 0.0)
    gap = float(np.abs(y * (np.where(np.isfinite(limit), limit, values) - values)).sum())
    dual = gradient + np.bincount(constraints.columns, entries * y[constraints.rows], pattern.size)
    dual[pins.columns] = 0.0
    if not constraints.equalities:
        return Optimality(cost, _decrement(pattern, hessian, dual)[0] + gap, violation, free)
    share, multipliers = _constrained(pattern, hessian, dual, constraints, entries, pins)
    gap += float(np.abs(multipliers * values[: constraints.equalities]).sum())
    return Optimality(cost, share + gap, violation, free)


def gauge_freedom(
    pattern: HessianPattern, hessian: np.ndarray, solver: Factorization, layout: Layout, damped: bool = True
) -> str:
    """Says which unknowns move along a direction without curvature; empty where every direction has some.

    Args:
        solver: holds a factorization of `hessian`, or of a `damped` one; the direction comes by inverse iteration.
    """
    diagonal = hessian[pattern.diagonal]
    direction = np.cos(np.arange(pattern.size))
    before = float(np.sqrt(np.sum(diagonal * direction**2)))
    for attempt in range(3):
        direction = solver.solve(diagonal * direction)
        size = float(np.sqrt(np.sum(diagonal * direction**2)))
        if not (np.isfinite(size) and size > 0):
            return ""
        if attempt == 0 and size < (DAMPED_GROWTH if damped else GROWTH) * before:
            return ""
        direction /= size
    products = hessian * direction[pattern.columns] * direction[pattern.indices]
    if abs(float(2 * products.sum() - products[pattern.diagonal].sum())) > LOOSE:
        return ""
    return (
        f"one of many optima: the costs do not see {layout.names_of(direction)} move together; hold one of them by an "
        "equality or add a prior"
    )


def _decrement(pattern: HessianPattern, hessian: np.ndarray, dual: np.ndarray) -> tuple[float, Factorization | None]:
    hessian = hessian.copy()
    hessian[pattern.diagonal] += RIDGE * max(float(hessian[pattern.diagonal].max()), 1e-300)
    solver = factorization(pattern)
    try:
        solver.factor(hessian)
    except SingularError:
        return float("nan"), None
    return float(dual @ solver.solve(dual)) / 2, solver


def _constrained(
    pattern: HessianPattern,
    hessian: np.ndarray,
    dual: np.ndarray,
    constraints: Constraints,
    entries: np.ndarray,
    pins: Pins,
) -> tuple[float, np.ndarray]:
    """The maximum over the steps that keep the linearized equalities, and its multipliers, from their KKT system."""
    import scipy.sparse as sp
    import scipy.sparse.linalg as spla

    n, m = pattern.size, constraints.equalities
    half = sp.csc_array((hessian, pattern.indices, pattern.indptr), shape=(n, n))
    diagonal = hessian[pattern.diagonal]
    ridge = RIDGE * max(float(diagonal.max()), 1e-300)
    H = half + half.T - sp.diags_array(diagonal) + ridge * sp.eye_array(n)
    use = (constraints.rows < m) & ~np.isin(constraints.columns, pins.columns)
    J = sp.coo_array((entries[use], (constraints.rows[use], constraints.columns[use])), shape=(m, n)).tocsr()
    # rows that repeat or pinned away would make the system singular
    kkt = sp.csc_matrix(sp.block_array([[H, J.T], [J, -1e-14 * sp.eye_array(m)]]))
    try:
        factor = spla.splu(kkt)
    except RuntimeError:
        return float("nan"), np.zeros(m)
    multipliers = factor.solve(np.concatenate([-dual, np.zeros(m)]))[n:]
    # again from what the multipliers leave: large ones would drown a small decrement in rounding
    rest = dual + J.T @ multipliers
    found = factor.solve(np.concatenate([-rest, np.zeros(m)]))
    step = found[:n]
    return float(-rest @ step - step @ (H @ step) / 2), multipliers + found[n:]


def _joined(verdict: str, message: str) -> str:
    return f"{verdict} ({message})" if message else verdict
