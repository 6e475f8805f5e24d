"""`CodeSession`: the quadratic form assembled anew in every solve, for weights and matrices that always change."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs  # type: ignore[attr-defined]

from problems.errors import DataError, MissingExtraError, SettingError
from problems.forms.marginal import Marginal
from problems.forms.quadratic import clean
from problems.forms.quadratic_code import Assembled, QuadraticCode
from problems.solvers.base import QPResult, Status
from problems.solvers.qp_check import judge
from problems.solvers.qp_maps import INDEPENDENT
from problems.solvers.qp_session import QPSession
from problems.solvers.qp_solution import Pattern, QPCheck
from problems.solvers.session import Solution


class CodeSession(QPSession):
    """See `Session`; made by ``Problem.compile(..., assembly="code")``. Dense, for small problems.

    Every solve starts cold: with all matrices new, the point before is no help.
    """

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.code = QuadraticCode(self.program)
        self._solved: tuple[Assembled, np.ndarray] | None = None

    @property
    def value(self) -> float:
        """Cost of the last solution, up to a constant of the data of the costs; cheap, to compare sets of rows.

        Raises:
            DataError: nothing was solved.
        """
        if self._solved is None:
            raise DataError("nothing was solved yet")
        program, v = self._solved
        return float(v @ (0.5 * (program.P @ v) + program.q))

    def _set(self, name: str, value: Any) -> None:
        self.store.set(name, value)

    def _update(self) -> None:
        return

    def _marginal(self, drop: Any, keep: Any, point: np.ndarray) -> Marginal:
        self._changed(numbers=True)  # new data are not compared with those before
        return super()._marginal(drop, keep, point)

    def _solve(self) -> Solution:
        numbers, flags = self.store.numbers, None
        if not numbers.dot(numbers) < np.inf:
            self.store.require_finite()
            if np.isnan(numbers).any():
                flags = self.program.flags(numbers)
            numbers = clean(numbers)
        program = self.code(numbers, flags)
        if self.screens and not self.code.equalities:
            found = self._unconstrained(program)
            if found is not None:
                return self._solution(program, numbers, flags, found, None, Status.SOLVED, "linear")
        return self._constrained(program, numbers, flags)

    def _unconstrained(self, program: Assembled) -> np.ndarray | None:
        """The minimiser without inequalities, where it is unique and meets them."""
        factor, info = dpotrf(program.P, lower=1)
        step = factor.shape[0] + 1
        pivots = factor.ravel()[::step]
        if info or not (pivots * pivots > INDEPENDENT * program.P.ravel()[::step]).all():
            return None
        v = dpotrs(factor, -program.q, lower=1)[0]
        if program.l.size:
            rows = program.A.dot(v)
            tolerance = self.options.tolerance
            if np.maximum.reduce(rows - program.u) > tolerance:
                return None
            if self.code.has_lower and np.maximum.reduce(program.l - rows) > tolerance:
                return None
        return v

    def _constrained(self, program: Assembled, numbers: np.ndarray, flags: Any) -> Solution:
        P, q, A, l, u, _, _ = program
        result = self._answer(P, q, A, l, u)
        status, result = judge(result, P, q, A, l, u, self.options.tolerance)
        iterations, message = result.iterations, result.message
        if result.x is None or result.y is None or not np.isfinite(result.x).all():
            point = self.layout.identity() if self._point is None else self._point
            check = self._check(numbers, flags, point, None)
            return Solution(self.layout, point, status, self.solver, check, iterations, message)
        self.last = result.x, result.y
        mu = result.y[self.code.equalities :]
        return self._solution(program, numbers, flags, result.x, mu, status, self.solver, iterations, message)

    def _solution(
        self,
        program: Assembled,
        numbers: np.ndarray,
        flags: Any,
        v: np.ndarray,
        mu: np.ndarray | None,
        status: Status,
        method: str,
        iterations: int = 0,
        message: str = "",
    ) -> Solution:
        self._solved = program, v
        z = program.Z.dot(v)
        z += program.offset
        return Solution(self.layout, z, status, method, self._check(numbers, flags, z, mu), iterations, message)

    def _check(self, numbers: np.ndarray, flags: Any, point: np.ndarray, mu: np.ndarray | None) -> QPCheck:
        kept = numbers.copy()
        return QPCheck(self.program, self.store, kept, Pattern(self.program, kept, flags), point, mu)

    def _answer(self, P: np.ndarray, q: np.ndarray, A: np.ndarray, l: np.ndarray, u: np.ndarray) -> QPResult:
        """What the backend says; rows that are off stay, without bounds, so that it keeps what it was built with."""
        self.last = None
        try:
            if self._backend is None:
                self._backend = self._backend_type(P, q, A, l, u, self.options)
            else:
                self._backend.update(P, A)
            return self._backend.solve(q, l, u)
        except (SettingError, MissingExtraError):
            raise
        except Exception as error:  # a backend that breaks is a status, and the next solve starts afresh
            self._backend = None
            return QPResult(None, None, Status.FAILED, 0, f"{self.solver} raised {type(error).__name__}: {error}")
