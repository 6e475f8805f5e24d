"""Any solver of the `qpsolvers` package, under the name ``qpsolvers:NAME``."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from problems.errors import MissingExtraError, SettingError, UnknownNameError
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.qp_support import Backend, RowBlock, Rows, Warm

# What qpsolvers passes on is named by each solver; where a name is missing here, the solver keeps its own tolerance.
_TOLERANCES: Mapping[str, tuple[str, ...]] = {
    "clarabel": ("tol_feas", "tol_gap_abs", "tol_gap_rel"),
    "copt": ("FeasTol", "DualTol"),
    "cvxopt": ("feastol", "abstol", "reltol"),
    "daqp": ("primal_tol",),
    "ecos": ("feastol", "abstol", "reltol"),
    "gurobi": ("FeasibilityTol", "OptimalityTol"),
    "highs": ("primal_feasibility_tolerance", "dual_feasibility_tolerance"),
    "jaxopt_osqp": ("tol",),
    "kvxopt": ("feastol", "abstol", "reltol"),
    "osqp": ("eps_abs", "eps_rel"),
    "piqp": ("eps_abs", "eps_rel"),
    "proxqp": ("eps_abs", "eps_rel"),
    "qpalm": ("eps_abs", "eps_rel"),
    "qpax": ("solver_tol",),
    "scs": ("eps_abs", "eps_rel"),
}
_LEAST = {"gurobi": 1e-9, "highs": 1e-10}


@dataclass(frozen=True)
class QPSolversSettings:
    """No settings of our own: `Options.extra` goes to the solver by the names `qpsolvers` documents for it."""


class QPSolvers(Backend):
    """Base of the backends ``qpsolvers:NAME``; see `Named`.

    The package takes a problem whole at every call, so what is kept between calls are its matrices only. Settings are
    passed on as they are, by the names `qpsolvers` documents for the solver. It has no common time limit, iteration
    limit or status: a solve without a solution counts as failed.
    """

    dense: ClassVar[bool] = False
    warm_starts: ClassVar[bool] = True
    extra: ClassVar[str | None] = None
    package: ClassVar[str] = "qpsolvers"
    module: ClassVar[str] = "qpsolvers"
    settings_type: ClassVar[type[QPSolversSettings]] = QPSolversSettings
    solver: ClassVar[str]

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None:
        # Nothing is known of the names, so they are not checked here.
        self._keywords = dict(options.extra)
        super().__init__(P, q, A, l, u, replace(options, extra={}))

    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        rows = self._rows = Rows.of(l, u)
        self._blocks = (
            RowBlock(self._A, [(rows.equal, 1.0)]),
            RowBlock(self._A, [(rows.upper, 1.0), (rows.lower, -1.0)]),
        )
        self._fill()

    def _fill(self) -> None:
        from scipy.sparse import csc_matrix

        matrices = (self._P, *(block.matrix for block in self._blocks))
        if self.solver in self._library.sparse_solvers:
            self._matrices = tuple(csc_matrix(matrix) for matrix in matrices)
        else:
            # Fortran order gave wrong answers with daqp.
            self._matrices = tuple(np.ascontiguousarray(matrix.toarray()) for matrix in matrices)

    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        if Rows.key_of(l, u) != self._rows.key:
            self._build(q, l, u)
        rows = self._rows
        P, A, G = self._matrices
        h = np.concatenate([u[rows.upper], -l[rows.lower]])
        equal = (A, l[rows.equal]) if len(rows.equal) else (None, None)
        unequal = (G, h) if len(h) else (None, None)
        tolerance = max(0.1 * self._options.tolerance, _LEAST.get(self.solver, 0.0))
        keywords = dict.fromkeys(_TOLERANCES.get(self.solver, ()), tolerance) | self._keywords
        problem = self._library.Problem(P, q, *unequal, *equal)
        # What the package has to say about a failure comes as warnings.
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            initial = None if warm is None else warm[0]
            found = self._library.solve_problem(problem, solver=self.solver, initvals=initial, **keywords)
        if found is not None and found.x is not None and found.found:
            return QPResult(np.asarray(found.x, dtype=float), self._multipliers(found), Status.SOLVED)
        message = str(said[-1].message) if said else "no solution was found"
        if found is None or found.x is None:
            return QPResult(None, None, Status.FAILED, message=message)
        return QPResult(np.asarray(found.x, dtype=float), self._multipliers(found), Status.FAILED, message=message)

    def _multipliers(self, found: Any) -> np.ndarray | None:
        rows = self._rows
        y = np.zeros(self._m)
        if len(rows.equal):
            if found.y is None or not len(found.y):
                return None
            y[rows.equal] = found.y
        if len(rows.upper) + len(rows.lower):
            if found.z is None or not len(found.z):
                return None
            y[rows.upper] = found.z[: len(rows.upper)]
            y[rows.lower] -= found.z[len(rows.upper) :]
        return y

    def _renew(self) -> None:
        for block in self._blocks:
            block.refill(self._A)
        self._fill()


class Named:
    """What ``qpsolvers:NAME`` names: called with NAME, it gives the backend."""

    named: ClassVar[bool] = True
    forms: ClassVar[tuple[str, ...]] = ("quadratic",)
    warm_starts: ClassVar[bool] = QPSolvers.warm_starts
    extra: ClassVar[str | None] = QPSolvers.extra

    def __call__(self, name: str) -> type[QPSolvers]:
        """The backend for solver `name` of `qpsolvers`.

        Args:
            name: one of ``qpsolvers.available_solvers``.

        Raises:
            MissingExtraError: qpsolvers is not installed.
            UnknownNameError: the solver is not known to qpsolvers, or its package is not installed.
            SettingError: no name is given.
        """
        if not name:
            raise SettingError("solver 'qpsolvers' needs the name of one of its solvers, for example 'qpsolvers:ecos'")
        try:
            import qpsolvers
        except ImportError as error:
            raise MissingExtraError(f"solver qpsolvers:{name}", "qpsolvers") from error
        if name not in qpsolvers.available_solvers:
            raise UnknownNameError("solver of qpsolvers", name, qpsolvers.available_solvers)
        return type(f"QPSolvers_{name}", (QPSolvers,), {"name": f"qpsolvers:{name}", "solver": name})

    def version(self) -> str:
        """Of the package `qpsolvers`; raises MissingExtraError when it is not installed."""
        return QPSolvers.version()


qpsolvers_backend = Named()
