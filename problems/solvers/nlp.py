"""Nonlinear programming solvers: IPOPT and FATROP through CasADi, and SQP over any QP backend.

What the plugins claim is not believed: `problems.solvers.optimality` tests the point they give.
"""

from __future__ import annotations

import contextlib
import io
import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import metadata
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np

from problems.errors import SettingError
from problems.forms.least_squares import Constraints, Flags, LeastSquares
from problems.forms.nonlinear import NonlinearProgram
from problems.forms.pins import Pins
from problems.problem import Problem
from problems.solvers.base import Options, Status
from problems.solvers.gauss_newton import GaussNewton
from problems.solvers.least_squares_solution import LeastSquaresCheck
from problems.solvers.nlp_stages import StagedProgram
from problems.solvers.optimality import optimality
from problems.solvers.qp_step import qp_backend
from problems.solvers.qp_support import checked_settings, native
from problems.solvers.session import Session, Solution
from problems.solvers.settings import own_version

FATROP_RELAXES = 1e-8  # of max(1, |bound|), measured


@dataclass(frozen=True)
class IPOPTSettings:
    """Settings of ``ipopt``; None keeps the library's default or what follows from `Options`.

    Attributes:
        warm: start from the last multipliers where the problem has constraints.
        tol: scaled error at which it stops; by default a hundredth of the tolerance, which takes one or two
            iterations more and lets the complementarity of many rows stay within our decrement.
        max_iter: iterations of one solve.
        linear_solver: of the search directions.
        hessian_approximation: second derivatives, or limited-memory updates.
        nlp_scaling_method: scaling of cost and rows.
        mu_strategy: update of the barrier parameter.
        mu_init: its first value.
    """

    warm: bool = True
    tol: float | None = None
    max_iter: int | None = None
    linear_solver: str | None = None
    hessian_approximation: Literal["exact", "limited-memory"] | None = None
    nlp_scaling_method: Literal["none", "gradient-based", "equilibration-based"] | None = None
    mu_strategy: Literal["monotone", "adaptive"] | None = None
    mu_init: float | None = None


@dataclass(frozen=True)
class FATROPSettings:
    """Settings of ``fatrop``; None keeps the library's default or what follows from `Options`.

    Attributes:
        tol: scaled error at which it stops; by default a tenth of the tolerance (it rarely gets further).
        max_iter: iterations of one solve (the library has no time limit).
        mu_init: first value of the barrier parameter.
    """

    tol: float | None = None
    max_iter: int | None = None
    mu_init: float | None = None


class NLPSession(Session):
    """Session on the nonlinear form: one `casadi.nlpsol` made at compile, called with new parameters.

    A solve starts at v = 0 around the last solution (or `initial`).
    """

    form = "nonlinear"
    forms: ClassVar[tuple[str, ...]] = ("nonlinear",)
    extra: ClassVar[str | None] = None
    warm_starts: ClassVar[bool] = True
    plugin: ClassVar[str]
    claims: ClassVar[Mapping[str, Status]]

    def __init__(self, problem: Problem, options: Options) -> None:
        self.program = NonlinearProgram(problem)
        super().__init__(problem, self.program.layout, self.plugin, options)
        self.least_squares = LeastSquares(problem, self.layout)
        self.pins = Pins(self.layout)
        self.constraints = Constraints(self.layout, self.pins.names)
        kept = [self.program.rows[e.term.name] for e in self.constraints.terms]
        self._kept = np.concatenate([np.zeros(0, np.intp), *(np.arange(s.start, s.stop) for s in kept)]).astype(np.intp)
        self._multipliers: np.ndarray | None = None
        self._make()

    @classmethod
    def compile(cls, problem: Problem, form: str, options: Options) -> NLPSession:
        return cls(problem, options)

    @classmethod
    def version(cls) -> str:
        return metadata.version("casadi")

    def reset(self) -> None:
        super().reset()
        self._multipliers = None

    @abstractmethod
    def _make(self) -> None:
        """Make the plugin's function."""

    @abstractmethod
    def _call(self, arguments: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Results and statistics of the plugin."""

    def _nlpsol(self, options: Mapping[str, Any], derivatives: bool, stated: Any = None) -> ca.Function:
        """`stated` in place of the program."""
        common = {"print_time": False, "error_on_fail": False, "calc_lam_p": False}
        given = self.program.derivatives if derivatives else {}
        return ca.nlpsol("solver", self.plugin, stated or self.program.casadi, {**common, **given, **options})

    def _solve(self) -> Solution:
        bound = self.least_squares.bind(self.store)
        reference = self.layout.identity() if self._point is None else self._point
        lower, upper = self.program.bounds(self.store, bound.flags)
        point, claim, message, iterations, y = reference, Status.INFEASIBLE, "bounds cross", 0, None
        if (lower <= upper).all():
            point, claim, message, iterations, y = self._run(reference, bound.flags, lower, upper)
        self._multipliers = y
        if y is None:
            status = claim
        else:
            point = self.pins.apply(point, bound.numbers)
            y = y[self._kept]
            found = optimality(self.least_squares, self.constraints, self.pins, bound, point, y)
            status, message = found.judge(claim, message, self.options)
        check = LeastSquaresCheck(self.least_squares, self.constraints, self.pins, bound, point, y)
        return Solution(self.layout, point, status, self.solver, check, iterations, message)

    def _run(
        self, reference: np.ndarray, flags: Flags, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, Status, str, int, np.ndarray | None]:
        """Point, claim, message, iterations, multipliers; multipliers None where the point is none."""
        parameters = self.program.parameters(self.store, reference, flags)
        arguments = {"x0": np.zeros(self.layout.size), "p": parameters, "lbg": lower, "ubg": upper}
        start = time.perf_counter()
        try:
            results, stats = self._call(arguments)
        except SettingError:
            raise
        except Exception as error:  # a plugin that breaks is a status, and the next solve starts afresh
            self._make()
            reason = str(error).strip().splitlines()[-1:] or [""]
            message = f"{self.solver} raised {type(error).__name__}: {reason[0]}"
            return reference, Status.FAILED, message, 0, None
        said, iterations = str(stats["return_status"]), int(stats["iter_count"])
        claim = self.claims.get(said, Status.FAILED)
        if claim is Status.SOLVED:
            said = ""
        if time.perf_counter() - start > self.options.time_limit and claim is not Status.SOLVED:
            claim = Status.TIME_LIMIT
        v, y = (np.array(results[name]).ravel() for name in ("x", "lam_g"))
        if not (np.isfinite(v).all() and np.isfinite(y).all()):
            return reference, Status.FAILED, f"the point is not finite ({said})", iterations, None
        return self.layout.retract(reference, v), claim, said, iterations, y


class IPOPT(NLPSession):
    """Session of the solver ``ipopt``: interior point, for any problem (Waechter and Biegler 2006)."""

    plugin = "ipopt"
    claims = {
        "Solve_Succeeded": Status.SOLVED,
        "Solved_To_Acceptable_Level": Status.SOLVED,
        "Feasible_Point_Found": Status.SOLVED,
        "Search_Direction_Becomes_Too_Small": Status.INACCURATE,
        "Infeasible_Problem_Detected": Status.INFEASIBLE,
        "Diverging_Iterates": Status.UNBOUNDED,
        "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
        "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
        "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
    }

    def _make(self) -> None:
        settings = checked_settings(IPOPTSettings, self.options.extra, "ipopt")
        common = self.options
        ipopt = native(
            settings,
            tol=0.01 * common.tolerance,
            constr_viol_tol=common.tolerance,
            max_iter=common.iteration_limit,
            max_wall_time=common.time_limit,
            bound_relax_factor=0.0,
            print_level=0,
            sb="yes",
        )
        self._warm = bool(ipopt.pop("warm")) and self.program.constraints.shape[0] > 0
        self._cold_solver = self._nlpsol({"ipopt": ipopt}, True)
        if self._warm:
            start = {"warm_start_init_point": "yes", "mu_init": 1e-6, "warm_start_bound_push": 1e-9}
            start |= {"warm_start_mult_bound_push": 1e-9, "warm_start_slack_bound_push": 1e-9}
            self._warm_solver = self._nlpsol({"ipopt": {**ipopt, **start}}, True)

    def _call(self, arguments: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        solver = self._cold_solver
        if self._warm and self._multipliers is not None:
            solver = self._warm_solver
            arguments["lam_g0"] = self._multipliers
        return solver(**arguments), solver.stats()


class FATROP(NLPSession):
    """Session of the solver ``fatrop`` (Vanroye et al. 2023).

    Where equalities define unknowns one stage after the other, as the transitions of a window in form F1 do, their
    stages are handed over. Else its matrices are dense: for problems of up to some hundred unknowns. It has no time
    limit; the iteration limit is what bounds a solve.
    """

    plugin = "fatrop"
    warm_starts = False
    claims = {
        "0": Status.SOLVED,
        "1": Status.ITERATION_LIMIT,
        "2": Status.INACCURATE,
        "3": Status.INACCURATE,
        "4": Status.INFEASIBLE,
    }

    def _make(self) -> None:
        settings = checked_settings(FATROPSettings, self.options.extra, "fatrop")
        common = self.options
        fatrop = native(settings, tol=0.1 * common.tolerance, max_iter=common.iteration_limit, print_level=0)
        staged, options = self._staged, {"fatrop": fatrop}
        if staged is None:
            self._solver = self._nlpsol(options, False)
        else:
            self._solver = self._nlpsol({**options, **staged.options}, False, staged.casadi)

    @cached_property
    def _staged(self) -> StagedProgram | None:
        return StagedProgram.of(self.program)

    def _call(self, arguments: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        staged = self._staged
        arguments["lbg"], arguments["ubg"] = _tightened(arguments["lbg"], arguments["ubg"])
        if staged is not None:
            arguments = staged.ordered(arguments)
        with contextlib.redirect_stdout(io.StringIO()):
            results = self._solver(**arguments)
        if staged is not None:
            results = staged.restored(results)
        stats = self._solver.stats()
        return results, {"return_status": stats["fatrop"]["return_flag"], "iter_count": stats["iter_count"]}


def _tightened(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds that are the given ones after FATROP has relaxed them, which nothing switches off; not of equalities."""
    with np.errstate(invalid="ignore"):
        inner = lower + FATROP_RELAXES * np.maximum(1.0, np.abs(lower))
        outer = upper - FATROP_RELAXES * np.maximum(1.0, np.abs(upper))
    inner, outer = np.where(np.isfinite(lower), inner, lower), np.where(np.isfinite(upper), outer, upper)
    between = inner < outer
    return np.where(between, inner, lower), np.where(between, outer, upper)


class SQP:
    """Solver ``sqp:NAME``: Gauss-Newton SQP whose every step is a QP solved by the backend NAME.

    The machinery of ``gauss-newton`` (linearization, damping, merit function) without its screening, so the backend is
    called in every iteration, also where no constraint binds.

    Args:
        backend: name of a registered QP backend.

    Raises:
        FormError: NAME is no QP backend.
        UnknownNameError, MissingExtraError: it is nothing; its package is not installed.
    """

    named: ClassVar[bool] = True
    forms: ClassVar[tuple[str, ...]] = ("graph",)
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None

    def __init__(self, backend: str) -> None:
        if not backend:
            raise SettingError("solver 'sqp' needs the name of a QP backend, for example 'sqp:osqp'")
        qp_backend(backend)
        self.backend = backend

    def compile(self, problem: Problem, form: str, options: Options) -> Session:
        extra = {**options.extra, "qp_solver": self.backend, "screen": False}
        session = GaussNewton(problem, replace(options, extra=extra))
        session.solver = f"sqp:{self.backend}"
        return session

    @classmethod
    def version(cls) -> str:
        return own_version()
