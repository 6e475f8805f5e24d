"""Our own solver for nonlinear least squares on manifolds: damped Gauss-Newton, inequalities by SQP.

Steps are computed from ``(H + lambda D) dx = -g`` with D the diagonal of H; lambda is zero until a step fails to reduce
the cost (Levenberg-Marquardt, Marquardt 1963; Nocedal and Wright, ch. 10). Near the end the last factorization is tried
again: it shows convergence, and of large problems its steps are good enough, so that gradients alone are evaluated.
Constraints are linearized in the tangent of the iterate and the step becomes a QP; steps are accepted on an l1 merit
function (Nocedal and Wright, ch. 18).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import DataError, SettingError, UnobservableError
from problems.forms.costs import Bound, Flags
from problems.forms.graduated import ladder
from problems.forms.layout import Layout
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.pins import Pins
from problems.problem import Problem
from problems.solvers.base import Options, Status
from problems.solvers.chain_steps import SHORT, ChainSteps
from problems.solvers.factorizations import (
    DENSE_SIZE,
    BandedCholesky,
    LinearSolver,
    SingularError,
    factorization,
)
from problems.solvers.least_squares_solution import LeastSquaresCheck
from problems.solvers.optimality import gauge_freedom, optimality
from problems.solvers.qp_step import QPStep
from problems.solvers.qp_support import checked_settings
from problems.solvers.session import Session, Solution
from problems.solvers.settings import own_version

DAMPING_START = 1e-6
DAMPING_LIMIT = 1e12
NEAR = 1e-4  # share of the cost below which a decrease says that the matrix hardly changes, in weak directions neither
CONTRACTION = 0.1  # share of the last decrease below which a step with the kept matrix is taken
DEFAULT_LIMIT = 100  # iterations
RUNG_ITERATIONS = 10  # of each wider loss in graduated non-convexity


@dataclass(frozen=True)
class Settings:
    """Own settings of ``gauss-newton``.

    Attributes:
        qp_solver: QP backend for inequalities; by default daqp for small problems and proxqp for large ones.
        iterations: exact number of steps without convergence test (real-time iteration); None iterates to convergence.
        screen: answer steps that satisfy the linearized constraints by the linear solve; else the QP backend is always
            called.
        linear_solver: factorization of the normal equations: ``dense``, ``banded`` (chains in order), ``qdldl``,
            ``block`` (variables of one dimension up to 6), ``superlu``, ``pardiso`` (extra ``pardiso``), ``cholmod``
            (extra ``gpl``), ``schur`` (few poses, many landmarks), or ``auto``: by size, band, work and what is
            installed.
        graduated: graduated non-convexity: come to the robust losses from wider ones, past local minima of outliers.
    """

    qp_solver: str | None = None
    iterations: int | None = None
    screen: bool = True
    linear_solver: LinearSolver = "auto"
    graduated: bool = False


class GaussNewton(Session):
    """Session of the solver ``gauss-newton``."""

    form = "graph"
    forms = ("graph",)
    warm_starts = True
    extra = None

    def __init__(self, problem: Problem, options: Options) -> None:
        self.settings = checked_settings(Settings, options.extra, "gauss-newton")
        if self.settings.iterations is not None and self.settings.iterations < 1:
            raise SettingError(f"solver gauss-newton: iterations must be positive, got {self.settings.iterations}")
        layout = Layout(problem)
        super().__init__(problem, layout, "gauss-newton", options)
        self.form_ = LeastSquares(problem, layout)
        self.pins = Pins(layout)
        self.constraints = Constraints(layout, self.pins.names)
        pattern = self.form_.pattern
        self._linear = factorization(pattern, self.settings.linear_solver)
        self.sparse = pattern.size > DENSE_SIZE and self._linear.name != "banded"
        self._chain = self._chain_steps()
        rungs = ladder(problem) if self.settings.graduated else []
        self._known_gauge: tuple[Flags, str] | None = None
        self._rungs = [LeastSquares(rung, Layout(rung)) for rung in rungs]
        self._renew()

    @classmethod
    def compile(cls, problem: Problem, form: str, options: Options) -> GaussNewton:
        return cls(problem, options)

    @classmethod
    def version(cls) -> str:
        return own_version()

    def _chain_steps(self) -> ChainSteps | None:
        """Steps by one call each, where the problem is a chain that nothing constrains."""
        plain = not self.constraints.size and not self.pins.columns.size and self.layout.flat
        usual = self.settings.screen and self.settings.iterations is None
        if plain and usual and isinstance(self._linear, BandedCholesky):
            return ChainSteps(self.form_.code, self._linear)
        return None

    def _forked(self) -> None:
        self._linear = factorization(self.form_.pattern, self.settings.linear_solver)
        self._chain = self._chain_steps()
        self._renew()

    def reset(self) -> None:
        super().reset()
        self._renew()

    def _renew(self) -> None:
        self._made_step: QPStep | None = None
        self._prepared: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def qp_step(self) -> QPStep:
        """The QP of a step, made where constraints or settings ask for it."""
        if self._made_step is None:
            settings = self.settings
            self._made_step = QPStep(self.form_.pattern, self.constraints, self.pins, self.options, settings.qp_solver)
        return self._made_step

    def prepare(self, initial: Mapping[str, Any] | None = None) -> None:
        """Linearize and factorize at `initial` with the data given so far; the next solve is one feedback step.

        Raises:
            DataError, NoiseError: data never given or that cannot be used.
            UnobservableError: the matrix is singular with these data.
        """
        if initial is not None:
            self._point = self.layout.point(initial, self._point)
        self.store.require_all()
        start = self.layout.identity() if self._point is None else self._point
        bound = self.form_.bind(self.store)
        point = self.pins.apply(start, bound.numbers)
        _, gradient, hessian = bound.linearize(point)
        self.pins.reduce(gradient, hessian, self.form_.pattern)
        try:
            self._linear.factor(hessian)
        except SingularError as error:
            raise UnobservableError(f"prepare: the costs leave a direction free at this point ({error})") from error
        self._prepared = (point, hessian)

    def solve(self, data: Mapping[str, Any] | None = None, initial: Mapping[str, Any] | None = None) -> Solution:
        """See `Session.solve`. After `prepare` it is one feedback step from the prepared point.

        Raises:
            DataError: `initial` together with a prepared point.
        """
        if initial is not None and self._prepared is not None:
            raise DataError(
                "the session is prepared at a point, from which the next solve is one step; give initial to prepare, "
                "or forget the preparation by reset"
            )
        return super().solve(data, initial)

    def _solve(self) -> Solution:
        bound = self.form_.bind(self.store)
        start = self.layout.identity() if self._point is None else self._point
        prepared, self._prepared = self._prepared, None
        if prepared is None:
            start = self.pins.apply(start, bound.numbers)
            iterations = 0
            for rung in self._rungs:
                wider = _Search(self, rung.bind(self.store), start)
                wider.run(RUNG_ITERATIONS)
                start, iterations = wider.point, iterations + wider.iterations
            search = _Search(self, bound, start)
            search.iterations = iterations
            violation = self.pins.violation(search.point, bound.numbers)
            if violation <= 10 * self.options.tolerance:
                chained = self._chain is not None and search.follow(self._chain)
                status, message = (Status.SOLVED, "") if chained else search.run()
            else:
                names = ", ".join(sorted(self.pins.names))
                status, message = Status.INFEASIBLE, f"no point found that satisfies {names}: {violation:.3g} remains"
        else:
            search = _Search(self, bound, prepared[0])
            status, message = search.feedback(prepared[1])
        if search.doubtful and status is Status.SOLVED:
            found = optimality(self.form_, self.constraints, self.pins, bound, search.point, search.multipliers)
            status, message = found.judge(status, message, self.options)
        elif status is Status.SOLVED and not message:
            message = self._gauge(search)
        check = LeastSquaresCheck(self.form_, self.constraints, self.pins, bound, search.point, search.multipliers)
        return Solution(self.layout, search.point, status, self.solver, check, search.iterations, message)

    def _gauge(self, search: _Search) -> str:
        """What to say of a direction that the costs do not see; looked for when the active instances change."""
        if self.constraints.size or (search.hessian is None and not search.chained):
            return ""
        flags = search.bound.flags  # one object for each pattern
        if self._known_gauge is None or self._known_gauge[0] is not flags:
            hessian, damped = search.hessian, search.factored != 0
            if search.chained and self._chain is not None:  # which has a factor of its own
                hessian = self._chain.hessian
                self._linear.factor(hessian)
            assert hessian is not None
            if not self.settings.screen:  # nothing was factorized yet
                shifted, damped = hessian.copy(), True
                shifted[self.form_.pattern.diagonal] *= 1 + 1e-10
                self._linear.factor(shifted)
            self._known_gauge = flags, gauge_freedom(self.form_.pattern, hessian, self._linear, self.layout, damped)
        return self._known_gauge[1]


class _Search:
    """One solve: the iterate, its cost and the damping."""

    def __init__(self, session: GaussNewton, bound: Bound, point: np.ndarray) -> None:
        self.session, self.bound, self.point = session, bound, point
        self.options, self.layout = session.options, session.layout
        self.diagonal = session.form_.pattern.diagonal
        self.damping = 0.0
        self.factored = 0.0  # damping of the matrix that was factorized last
        self.iterations = 0
        self.chained = False  # converged by steps of a chain
        self.multipliers: np.ndarray | None = None
        self.hessian: np.ndarray | None = None  # at the last linearization
        self.penalty = 0.0
        self.doubtful = False  # the last step was no exact one, so its decrease is no test of convergence
        self.gained: float | None = None  # decrease of the last step, where its factorization may serve again
        # linearization where the last step led; without Hessian where the last factorization is expected to do
        self.ahead: tuple[float, np.ndarray, np.ndarray | None] | None = None
        self.numbers = bound.numbers
        if session.constraints.size or not session.settings.screen:
            self.lower, self.upper = session.constraints.bounds(bound.numbers, bound.flags)

    def run(self, at_most: int | None = None) -> tuple[Status, str]:
        deadline = time.perf_counter() + self.options.time_limit
        fixed = self.session.settings.iterations
        limit = fixed or at_most or self.options.iteration_limit or DEFAULT_LIMIT
        tolerance = 0.1 * self.options.tolerance
        while self.iterations < limit:
            if time.perf_counter() > deadline:
                return Status.TIME_LIMIT, f"stopped after {self.options.time_limit:g} s"
            cost, gradient, hessian = self.ahead or self.bound.linearize(self.point)
            self.ahead = None
            if not math.isfinite(cost):
                return Status.FAILED, "the cost is not finite at the iterate"
            self.iterations += 1
            outcome = self._advance(cost, gradient, hessian, tolerance, fixed is not None)
            if outcome is not None:
                return outcome
        if fixed is not None:
            return Status.SOLVED, f"{fixed} iteration(s) as asked, convergence not tested"
        return Status.ITERATION_LIMIT, f"not converged after {limit} iterations"

    def follow(self, chain: ChainSteps) -> bool:
        """Undamped steps as long as they lead down; whether they converged."""
        limit = (self.options.iteration_limit or DEFAULT_LIMIT) - self.iterations
        deadline = time.perf_counter() + self.options.time_limit
        self.chained, steps = chain.run(self.bound, self.point, 0.1 * self.options.tolerance, limit, deadline)
        self.point, self.iterations = chain.point, self.iterations + steps
        return self.chained

    def feedback(self, hessian: np.ndarray) -> tuple[Status, str]:
        """One full step with the matrix factorized by `GaussNewton.prepare`."""
        session = self.session
        _, gradient, _ = self.bound.linearize(self.point)
        gradient[session.pins.columns] = 0.0
        step = -session._linear.solve(gradient)
        if session.constraints.size:
            failed, step = self._constrained(step, gradient, hessian)
            if failed is not None:
                return failed
        if not np.isfinite(step).all():
            return Status.FAILED, "no finite feedback step"
        self.point = self.layout.retract(self.point, step)
        self.iterations = 1
        return Status.SOLVED, "one feedback step as prepared, convergence not tested"

    def _advance(
        self, cost: float, gradient: np.ndarray, hessian: np.ndarray | None, tolerance: float, forced: bool
    ) -> tuple[Status, str] | None:
        """One accepted step, or the reason to stop."""
        session = self.session
        free = session.settings.screen and not session.constraints.size
        if session.pins.columns.size:
            gradient[session.pins.columns] = 0.0
        violation, largest = self._violation(self.point)
        kept = None
        if session.sparse and not forced:
            kept = self._kept_step(cost, gradient, tolerance)
        while True:
            if hessian is None and kept is None:
                hessian = self.bound.linearize(self.point)[2]
            if hessian is not None and hessian is not self.hessian:
                session.pins.reduce(gradient, hessian, session.form_.pattern)
                self.hessian = hessian
            damped = hessian
            if self.damping > 0 and hessian is not None:
                damped = hessian.copy()
                pull = self.damping * np.maximum(hessian[self.diagonal], 1e-12)
                damped[self.diagonal] += pull
            try:
                if kept is not None:
                    step = kept
                elif session.settings.screen and damped is not None:
                    session._linear.factor(damped)
                    self.factored = self.damping
                    step = -session._linear.solve(gradient)
                    if not step.dot(step) < np.inf:
                        raise SingularError("no finite step")
                else:
                    step = np.full(gradient.size, np.nan)
            except SingularError as error:
                if self.damping == 0 and not session.constraints.size and hessian is not None:
                    unseen = self.layout.names_of((hessian[self.diagonal] <= 0).astype(float))
                    if unseen:
                        return Status.UNBOUNDED, f"the costs leave {unseen} free ({error})"
                if not self._harder():
                    return Status.FAILED, f"no step found: {error}"
                continue
            if not free and hessian is not None and damped is not None:
                failed, step = self._constrained(step, gradient, damped)
                if failed is not None:
                    return failed
                decrease = self._decrease(gradient, hessian, step)
            else:  # as the step solves the damped system, or one with a matrix that hardly changed
                decrease = (float(pull @ step**2 if self.damping > 0 else 0.0) - float(gradient @ step)) / 2
            # what a kept matrix leaves shrinks by a factor only
            enough = tolerance * max(1.0, cost) * (1.0 if kept is None else CONTRACTION)
            small = abs(decrease) <= enough and self.damping <= DAMPING_START
            trial = self.layout.retract(self.point, step)
            if forced:
                self.point = trial
                return None
            if small and free and self.damping == 0 and step.dot(step) <= SHORT:
                self.point = trial
                return Status.SOLVED, ""
            # an undamped step is nearly always taken, and its linearization gives the cost as well
            ahead = None
            if not small and self.damping == 0:
                last = free and session.sparse and decrease <= NEAR * max(1.0, cost)
                ahead = (*self.bound.gradient(trial), None) if last else self.bound.linearize(trial)
            new = self.bound.cost(trial) if ahead is None else ahead[0]
            new_violation, new_largest = self._violation(trial)
            if session.constraints.size:
                self.penalty = max(self.penalty, 2 * float(np.abs(self.multipliers).max(initial=0.0)))
            merit = cost + self.penalty * violation
            new_merit = new + self.penalty * new_violation
            if new_merit <= merit + 1e-14 * abs(merit) and new_merit > -np.inf:
                self.point, self.ahead = trial, ahead
                near = cost - new <= NEAR * max(1.0, cost) and self.damping == 0 and not session.constraints.size
                self.gained = cost - new if near else None
                self.damping = self.damping / 10 if self.damping > 1e-9 else 0.0
                if small and new_largest <= self.options.tolerance * 10:
                    return Status.SOLVED, ""
                return None
            if small and largest <= self.options.tolerance * 10:
                return Status.SOLVED, ""  # no descent left above rounding
            if kept is not None:
                kept = None
                continue
            if not self._harder():
                return Status.INACCURATE, f"no descent found; predicted decrease {decrease:.3g}"

    def _kept_step(self, cost: float, gradient: np.ndarray, tolerance: float) -> np.ndarray | None:
        """The step of the last factorization, if it shows convergence or contracts well; else None."""
        if self.gained is None or not self.session.settings.screen:
            return None
        step = -self.session._linear.solve(gradient)
        enough = max(tolerance * max(1.0, cost), CONTRACTION * self.gained)
        return step if abs(float(gradient @ step)) / 2 <= enough else None

    def _decrease(self, gradient: np.ndarray, hessian: np.ndarray, step: np.ndarray) -> float:
        return -float(gradient @ step) - self._curvature(hessian, step) / 2

    def _harder(self) -> bool:
        self.damping = max(DAMPING_START, self.damping * 10)
        return self.damping <= DAMPING_LIMIT

    def _constrained(
        self, step: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
    ) -> tuple[tuple[Status, str] | None, np.ndarray]:
        """The step that satisfies the linearized constraints; the free one where it does already and is asked for."""
        constraints = self.session.constraints
        values, entries = constraints.evaluate(self.point, self.numbers, self.bound.flags)
        rows = values + np.bincount(constraints.rows, entries * step[constraints.columns], constraints.size)
        inside = (rows <= self.upper + self.options.tolerance) & (rows >= self.lower - self.options.tolerance)
        if self.session.settings.screen and inside.all():
            self.multipliers = np.zeros(constraints.size)
            self.doubtful = False
            return None, step
        result, status = self.session.qp_step.solve(
            hessian, gradient, entries, self.lower - values, self.upper - values
        )
        # a backend that stops at its limit is mostly close: the step is taken, and our own test decides at the end
        usable = status in (Status.SOLVED, Status.INACCURATE, Status.ITERATION_LIMIT)
        if result.x is None or result.y is None or not usable:
            return (status, f"QP step: {result.message or status}"), step
        self.multipliers = result.y
        self.doubtful = status is not Status.SOLVED
        return None, result.x

    def _curvature(self, hessian: np.ndarray, step: np.ndarray) -> float:
        pattern = self.session.form_.pattern
        products = hessian * step[pattern.columns] * step[pattern.indices]
        return float(2 * products.sum() - products[self.diagonal].sum())

    def _violation(self, point: np.ndarray) -> tuple[float, float]:
        """Sum and largest of what the rows of the constraints miss."""
        constraints = self.session.constraints
        if not constraints.size:
            return 0.0, 0.0
        values = constraints.residual(point, self.numbers, self.bound.flags)
        missed = np.maximum(np.maximum(values - self.upper, self.lower - values), 0.0)
        return float(missed.sum()), float(missed.max())
