"""gtsam's batch optimizers on the graph form: Levenberg-Marquardt, Gauss-Newton, dogleg.

gtsam's factors do not change, so those of a term are made anew when its data change, and kept otherwise; the time this
takes is reported as ``setup``. We iterate ourselves, with a clock and a tight test on the decrease, and
`problems.solvers.optimality` tests the result.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from problems.errors import FormError
from problems.forms.costs import Bound
from problems.forms.factor_graph import FactorGraph, GraphTerm
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.template import template_of
from problems.noise import L2, GemanMcClure
from problems.problem import DataSlot, Problem
from problems.solvers.base import Options, Status
from problems.solvers.least_squares_solution import LeastSquaresCheck
from problems.solvers.optimality import optimality
from problems.solvers.qp_support import checked_settings, native
from problems.solvers.session import Session, Solution

ITERATIONS = 100
STALL = 1e-3  # of the tolerance: relative change of the cost at which the iteration ends
LinearSolver = Literal["MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_QR", "SEQUENTIAL_CHOLESKY", "SEQUENTIAL_QR"]
Ordering = Literal["COLAMD", "METIS", "NATURAL"]


@dataclass(frozen=True)
class Settings:
    """Settings of ``gtsam-gn``; None keeps gtsam's default.

    Attributes:
        linearSolverType: elimination; QR where Cholesky loses too many digits.
        orderingType: order of elimination.
    """

    linearSolverType: LinearSolver | None = None
    orderingType: Ordering | None = None


@dataclass(frozen=True)
class LevenbergMarquardtSettings(Settings):
    """Settings of ``gtsam-lm``; None keeps gtsam's default.

    Attributes:
        lambdaInitial: first damping.
        lambdaFactor: by which damping grows after a failed step and falls after a good one.
        lambdaUpperBound: damping at which it gives up.
        diagonalDamping: damp by the diagonal of the Hessian instead of the identity.
    """

    lambdaInitial: float | None = None
    lambdaFactor: float | None = None
    lambdaUpperBound: float | None = None
    diagonalDamping: bool | None = None


@dataclass(frozen=True)
class DoglegSettings(Settings):
    """Settings of ``gtsam-dogleg``; None keeps gtsam's default.

    Attributes:
        deltaInitial: first radius of the trust region.
    """

    deltaInitial: float | None = None


class GtsamSession(Session):
    """Session of a gtsam optimizer on the graph form."""

    form = "graph"
    forms: ClassVar[tuple[str, ...]] = ("graph",)
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None
    name: ClassVar[str]
    optimizer: ClassVar[str]
    settings_type: ClassVar[type]
    nonlinear_equalities: bool = False
    damped: ClassVar[bool] = False

    def __init__(self, problem: Problem, options: Options) -> None:
        settings = checked_settings(self.settings_type, options.extra, self.name)
        self.graph = FactorGraph(problem)
        super().__init__(problem, self.graph.layout, self.name, options)
        self._require_affine_equalities()
        self.least_squares = LeastSquares(problem, self.layout)
        self.constraints = Constraints(self.layout, self.graph.pins.names)
        self._reads = {term.name: self._positions(term.name) for term in self.graph.terms}
        self._factors: dict[str, tuple[bytes, list[Any]]] = {}
        self._setup_seconds = 0.0
        self._parameters = self._translated(settings)

    @classmethod
    def compile(cls, problem: Problem, form: str, options: Options) -> GtsamSession:
        return cls(problem, options)

    @classmethod
    def version(cls) -> str:
        from importlib.metadata import version

        return version("gtsam")

    def _require_affine_equalities(self) -> None:
        """Measured: with a fixed penalty on violations as their merit, damped steps stall far from the constraint."""
        if self.nonlinear_equalities:
            return
        for term in self.graph.terms:
            if term.kind == "constraint" and not template_of(self.problem.terms[term.name]).affine:
                raise FormError(
                    f"equality {term.name!r} is not affine; solver {self.name!r} accepts steps by a fixed penalty on "
                    "violations and stalls there; use solver='gauss-newton', 'gtsam-gn' or 'ipopt'"
                )

    def _translated(self, settings: Any) -> Any:
        import gtsam

        parameters = getattr(gtsam, f"{self.optimizer}Params")()
        # Levenberg-Marquardt gives up a search for damping below the relative one
        parameters.setRelativeErrorTol(STALL * self.options.tolerance)
        parameters.setAbsoluteErrorTol(STALL * self.options.tolerance)
        for name, value in native(settings).items():
            setter = getattr(parameters, f"set{name}", None) or getattr(parameters, f"set{name[0].upper()}{name[1:]}")
            setter(value)
        return parameters

    def _forked(self) -> None:
        self._factors = dict(self._factors)

    def _update(self) -> None:
        bound = self.least_squares.bind(self.store)
        self._refresh(bound, self.graph.pins.apply(self._start(), bound.numbers))

    def _start(self) -> np.ndarray:
        return self.layout.identity() if self._point is None else self._point

    def _positions(self, name: str) -> np.ndarray:
        """Data that the factors of a term depend on, its flags aside."""
        term = self.problem.terms[name]
        noise = None if term.noise is None else term.noise.value
        slots = [*term.data, *(v for v in (noise, term.linear) if isinstance(v, DataSlot))]
        found = [self.layout.numbers(slot).ravel() for slot in slots]
        return np.unique(np.concatenate([np.zeros(0, np.intp), *found]))

    def _refresh(self, bound: Bound, point: np.ndarray) -> list[Any]:
        """All factors; those of terms whose data and flags are the same are kept."""
        start = time.perf_counter()
        out: list[Any] = []
        for term in self.graph.terms:
            on = bound.flags[term.name]
            key = self._key(term, on, point)
            known = self._factors.get(term.name)
            if known is None or known[0] != key:
                known = self._factors[term.name] = (key, self.graph.factors(term, self.store, on, point))
            out += known[1]
        self._setup_seconds += time.perf_counter() - start
        return out

    def _key(self, term: GraphTerm, on: np.ndarray | None, point: np.ndarray) -> bytes:
        numbers = self.store.numbers[self._reads[term.name]].tobytes()
        flags = b"" if on is None else on.tobytes()
        return numbers + b"|" + flags + (point.tobytes() if term.kind == "pinned" else b"")

    def _solve(self) -> Solution:
        import gtsam

        bound = self.least_squares.bind(self.store)
        point = self.graph.pins.apply(self._start(), bound.numbers)
        self._setup_seconds = 0.0
        factors = self._refresh(bound, point)
        start = time.perf_counter()
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        values = self.graph.gtsam_values(point)
        self._setup_seconds += time.perf_counter() - start
        claim, message, iterations, found = self._run(graph, values)
        if found is not None:
            point = self.graph.pins.apply(self.graph.point(found), bound.numbers)
        result = optimality(self.least_squares, self.constraints, self.graph.pins, bound, point)
        status, message = result.judge(claim, message, self.options)
        check = LeastSquaresCheck(self.least_squares, self.constraints, self.graph.pins, bound, point, None)
        solution = Solution(self.layout, point, status, self.solver, check, iterations, message)
        solution.seconds = {"setup": self._setup_seconds}
        return solution

    def _run(self, graph: Any, values: Any) -> tuple[Status, str, int, Any]:
        """Claim, message, iterations and the best values, None where there are none."""
        import gtsam

        deadline = time.perf_counter() + self.options.time_limit
        try:
            optimizer = getattr(gtsam, f"{self.optimizer}Optimizer")(graph, values, self._parameters)
        except Exception as error:  # a library that breaks is a status
            return self._broken(error, 0, None)
        claim, message, iterations, found = self._iterated(optimizer, 0, deadline)
        if not self.damped or claim is not Status.SOLVED:
            return claim, message, iterations, found
        # damping holds weakly weighted unknowns back where the cost is flat, so undamped steps come last
        parameters = gtsam.GaussNewtonParams()
        parameters.setLinearSolverType(self._parameters.getLinearSolverType())
        free = gtsam.GaussNewtonOptimizer(graph, found, parameters)
        undamped, _, total, polished = self._iterated(free, iterations, deadline)
        if polished is None or undamped is Status.FAILED or graph.error(polished) > optimizer.error() * (1 + 1e-14):
            return claim, message, iterations, found
        return claim, message, total, polished

    def _iterated(self, optimizer: Any, iterations: int, deadline: float) -> tuple[Status, str, int, Any]:
        """Iterate until the cost stays, counting on from `iterations`."""
        limit, found = self.options.iteration_limit or ITERATIONS, None
        try:
            cost = optimizer.error()
            while iterations < limit:
                optimizer.iterate()
                iterations += 1
                new, found = optimizer.error(), optimizer.values()
                if not np.isfinite(new):
                    return Status.FAILED, "the cost became infinite", iterations, None
                if abs(cost - new) <= STALL * self.options.tolerance * max(1.0, new):
                    return Status.SOLVED, "", iterations, found
                cost = new
                if time.perf_counter() > deadline:
                    message = f"stopped after {self.options.time_limit:g} s"
                    return Status.TIME_LIMIT, message, iterations, found
        except Exception as error:  # a library that breaks is a status
            return self._broken(error, iterations, found)
        return Status.ITERATION_LIMIT, f"not converged after {limit} iterations", iterations, found

    def _broken(self, error: Exception, iterations: int, found: Any) -> tuple[Status, str, int, Any]:
        self._factors = {}
        reason = " ".join(str(error).split())
        return Status.FAILED, f"gtsam raised {type(error).__name__}: {reason[:300]}", iterations, found


class LevenbergMarquardt(GtsamSession):
    """Session of the solver ``gtsam-lm``: damped steps, and undamped ones at the end."""

    name = "gtsam-lm"
    damped = True
    optimizer = "LevenbergMarquardt"
    settings_type = LevenbergMarquardtSettings


class GaussNewton(GtsamSession):
    """Session of the solver ``gtsam-gn``: undamped, may cycle or diverge on strongly nonlinear problems."""

    name = "gtsam-gn"
    optimizer = "GaussNewton"
    settings_type = Settings
    nonlinear_equalities = True


class Dogleg(GtsamSession):
    """Session of the solver ``gtsam-dogleg``."""

    name = "gtsam-dogleg"
    optimizer = "Dogleg"
    settings_type = DoglegSettings


@dataclass(frozen=True)
class GNCSettings(LevenbergMarquardtSettings):
    """Settings of ``gtsam-gnc``; None keeps gtsam's default. Those of ``gtsam-lm`` are for its inner solves.

    Attributes:
        lambdaStep: factor by which the loss is sharpened from one inner problem to the next.
    """

    lambdaStep: float | None = None


class GraduatedNonConvexity(GtsamSession):
    """Session of the solver ``gtsam-gnc``: for costs with the Geman-McClure loss, from starts with gross outliers.

    The loss is made convex first and sharpened step by step (Yang et al., Graduated Non-Convexity for Robust Spatial
    Perception, 2020); Levenberg-Marquardt then goes to the optimum of the loss itself. The first part cannot be
    stopped by the clock, and its iterations are not counted.

    Raises:
        FormError: no cost has that loss, or several scales or another loss occur; a term is no factor of gtsam's own.
    """

    name = "gtsam-gnc"
    damped = True
    optimizer = "LevenbergMarquardt"
    settings_type = GNCSettings

    def __init__(self, problem: Problem, options: Options) -> None:
        super().__init__(problem, options)
        scales = set()
        for term in problem.terms.values():
            if isinstance(term.loss, GemanMcClure):
                scales.add(term.loss.scale)
            elif not isinstance(term.loss, L2):
                raise FormError(f"{term.what}: solver 'gtsam-gnc' knows the loss GemanMcClure only, got {term.loss!r}")
        if len(scales) != 1:
            raise FormError(
                "solver 'gtsam-gnc' needs costs with the loss GemanMcClure, all of one scale; got "
                f"{sorted(scales) or 'none'}. Without outliers use 'gtsam-lm'"
            )
        for term in self.graph.terms:
            if term.kind not in ("native", "pinned"):
                raise FormError(
                    f"{self.problem.terms[term.name].what}: solver 'gtsam-gnc' takes gtsam's own factors only, and "
                    f"this is a {term.kind} one: {term.reason or 'an equality'}"
                )
        # gtsam compares errors, which are half the squared norm
        self._threshold = scales.pop() ** 2 / 2

    def _translated(self, settings: GNCSettings) -> Any:
        import gtsam

        inner = super()._translated(replace(settings, lambdaStep=None))
        self._graduated = gtsam.GncLMParams(inner)
        self._graduated.setLossType(gtsam.GncLossType.GM)
        if settings.lambdaStep is not None:
            self._graduated.setLambdaStep(settings.lambdaStep)
        return inner

    def _run(self, graph: Any, values: Any) -> tuple[Status, str, int, Any]:
        import gtsam

        certain, position = [], 0
        for term in self.graph.terms:
            count = len(self._factors[term.name][1])
            if isinstance(self.problem.terms[term.name].loss, L2):
                certain += range(position, position + count)
            position += count
        self._graduated.setKnownInliers(certain)
        try:
            optimizer = gtsam.GncLMOptimizer(graph, values, self._graduated)
            optimizer.setInlierCostThresholds(self._threshold)
            values = optimizer.optimize()
        except Exception as error:  # a library that breaks is a status
            return Status.FAILED, f"gtsam raised {type(error).__name__}: {' '.join(str(error).split())[:300]}", 0, None
        return super()._run(graph, values)
