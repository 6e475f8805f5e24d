"""`Session`: a compiled problem with its sticky data; `Solution`: what one solve found.

Sessions of all solvers share this interface (design section 3.2); what differs is behind `_solve`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from problems.errors import DataError, FormError, UnknownNameError
from problems.forms.layout import DataStore, Layout
from problems.lazy import lazy
from problems.problem import Slot
from problems.solvers.base import Options, Status

if TYPE_CHECKING:
    from problems.forms.marginal import Marginal
    from problems.problem import Problem, Variable
    from problems.solvers.batch import BatchSession

T = TypeVar("T")


class Check(Protocol):
    """What a solution computes on access, from the problem, the data of that solve and the point."""

    def objective(self) -> float: ...
    def residuals(self) -> dict[str, float]: ...
    def multipliers(self) -> dict[str, np.ndarray]: ...
    def active_set(self) -> dict[str, np.ndarray]: ...
    def covariance(self, slots: tuple[Any, ...]) -> np.ndarray: ...


class Solution:
    """Result of one solve. Index it by variable name: (count, stored coordinates).

    Attributes:
        status: decided from our own residuals, never from the backend's claim alone.
        objective: cost at the point, losses included.
        iterations: of the solver; 0 where a linear solve answered.
        method: what answered: a solver's name, or ``linear``.
        seconds: ``{"update", "solve"}`` of this call, and ``setup`` where a solver built its own model of the data.
        message: for people; says why when the status is not ``solved``.
        point: all stored coordinates.
    """

    def __init__(
        self,
        layout: Layout,
        point: np.ndarray,
        status: Status,
        method: str,
        check: Check,
        iterations: int = 0,
        message: str = "",
    ) -> None:
        self._layout = layout
        self.point = point
        self.status = status
        self.method = method
        self._check = check
        self.iterations = iterations
        self.message = message
        self.seconds: dict[str, float] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        return self._layout.value(self.point, name)

    @property
    def values(self) -> dict[str, np.ndarray]:
        """(count, stored coordinates) of every variable by name."""
        return self._layout.values(self.point)

    @property
    def solved(self) -> bool:
        return self.status is Status.SOLVED

    @lazy
    def objective(self) -> float:
        return self._check.objective()

    @lazy
    def residuals(self) -> dict[str, float]:
        """``primal``, ``dual`` and ``gap``, recomputed here from the problem and the point."""
        return self._check.residuals()

    @lazy
    def multipliers(self) -> dict[str, np.ndarray]:
        """(count, dim) multipliers of every equality and inequality term; positive at an upper bound."""
        return self._check.multipliers()

    @lazy
    def active_set(self) -> dict[str, np.ndarray]:
        """(count, dim) of every inequality: 1 at the upper bound, -1 at the lower, 0 between."""
        return self._check.active_set()

    def covariance(self, *slots: Variable | Slot | str) -> np.ndarray:
        """Joint covariance of the slots at the solution, in tangent coordinates (body frame), slot after slot.

        Inequalities do not count.

        Args:
            slots: variables, indexed variables, or names of variables.

        Raises:
            UnobservableError: the costs leave a direction free.
            UnknownNameError: no variable has that name.
        """
        unknowns = self._layout.problem.unknowns
        for name in slots:
            if isinstance(name, str) and name not in unknowns:
                raise UnknownNameError("variable", name, unknowns)
        return self._check.covariance(tuple(unknowns[one] if isinstance(one, str) else one for one in slots))

    def __repr__(self) -> str:
        lines = [
            f"Solution: {self.status} by {self.method}, {self.iterations} iteration(s), objective {self.objective:.6g}"
        ]
        lines += [f"  {name}: {np.array2string(v, precision=4, threshold=8)}" for name, v in self.values.items()]
        return "\n".join(lines + ([f"  {self.message}"] if self.message else []))

    def _repr_html_(self) -> str:
        from problems.display import Table

        caption = f"{self.status} by {self.method}, {self.iterations} iteration(s), objective {self.objective:.6g}"
        rows = [(name, len(value), value) for name, value in self.values.items()]
        return Table(f"Solution: {caption}", ("variables", "count", "values"), rows)._repr_html_()


class Session(ABC):
    """A problem compiled for one solver: set up once, solve many times.

    Attributes:
        problem: what was compiled.
        solver: name of the solver.
        options: tolerance, limits and the solver's own settings.
        compile_seconds: time that `Problem.compile` took.
    """

    form: str = ""

    def __init__(self, problem: Problem, layout: Layout, solver: str, options: Options) -> None:
        self.problem, self.layout, self.solver, self.options = problem, layout, solver, options
        self.store = DataStore(layout)
        self.compile_seconds = 0.0
        self._point: np.ndarray | None = None
        self._update_seconds = 0.0
        self._complete = False
        self._plans: dict[Any, Any] = {}

    def update(self, **data: Any) -> None:
        """Take data ahead of a solve and do the work that their weights and matrices cause.

        Raises:
            UnknownNameError, ShapeError, NoiseError, DataError: nothing was changed but the data named so far.
        """
        start = time.perf_counter()
        for name, value in data.items():
            self._set(name, value)
        self._complete = False
        if all(self.store.given.values()):
            self._update()
        self._update_seconds += time.perf_counter() - start

    def solve(self, data: Mapping[str, Any] | None = None, initial: Mapping[str, Any] | None = None) -> Solution:
        """Solve for the data given so far and those in `data`.

        Args:
            data: new numbers by name; names not given keep their values.
            initial: values by variable name to start from; by default the session's last solution.

        Raises:
            DataError: data never given; values that cannot be used. What a solver does wrong is a status instead.
        """
        start = time.perf_counter()
        if data:
            for name, value in data.items():
                self._set(name, value)
        if not self._complete:
            self.store.require_all()
            self._complete = True
        if initial is not None:
            self._point = self.layout.point(initial, self._point)
        solution = self._solve()
        seconds = solution.seconds
        apart = sum(seconds.values()) if seconds else 0.0
        seconds["update"], self._update_seconds = self._update_seconds, 0.0
        seconds["solve"] = time.perf_counter() - start - apart
        if solution.status in _USABLE:
            self._point = solution.point
        return solution

    def prepare(self, initial: Mapping[str, Any] | None = None) -> None:
        """Linearize ahead of the newest measurement (real-time iteration); the next `solve` is the feedback."""
        raise FormError(f"solver {self.solver!r} on the {self.form} form has no preparation phase; call solve")

    def fork(self) -> Session:
        """A session with its own data and warm start that shares everything compiled."""
        other: Any = object.__new__(type(self))
        vars(other).update(vars(self))
        other.store = self.store.copy()
        other._point = None if self._point is None else self._point.copy()
        other._forked()
        return other

    def batch(self, count: int) -> BatchSession:
        """The same session on a leading axis of `count` entries, for networks and Monte Carlo trials."""
        from problems.solvers.batch import ForkBatch

        return ForkBatch(self, count)

    def reset(self) -> None:
        """Forget the warm start; data and everything compiled stay."""
        self._point = None

    def marginal(self, drop: Any, keep: Any = None, at: Mapping[str, Any] | None = None) -> Marginal:
        """Integrate out `drop` (variables or slots) with every cost and equality that touches it.

        Args:
            keep: slots of the result, in its order; by default all instances that share a term with a dropped one.
            at: values to linearize at; by default the last solution.

        Returns:
            The information on the kept instances: exactly the data of an arrival cost (design section 3.3).

        Raises:
            DataError: there is no point to linearize at.
            DefinitionError: `keep` misses an instance that shares a term with a dropped one, or names one twice.
            UnobservableError: the terms leave a dropped unknown free.
        """
        point = self._point if at is None else self.layout.point(at, self._point)
        if point is None:
            raise DataError("marginal needs a point: solve first or give values in `at`")
        return self._marginal(drop, keep, point)

    def _marginal(self, drop: Any, keep: Any, point: np.ndarray) -> Marginal:
        from problems.forms.marginal import NonlinearMarginal

        return self._plan(drop, keep, NonlinearMarginal)(self.store, point)

    def _plan(self, drop: Any, keep: Any, make: Callable[[Layout, Any, Any], T]) -> T:
        """What a marginal can keep from call to call, made once for each choice of slots."""
        key = (slot_key(drop), slot_key(keep))
        if key not in self._plans:
            self._plans[key] = make(self.layout, drop, keep)
        return self._plans[key]

    def _set(self, name: str, value: Any) -> None:
        self.store.set(name, value)

    def _update(self) -> None:
        return

    @abstractmethod
    def _solve(self) -> Solution: ...

    def _forked(self) -> None:
        return


def slot_key(chosen: Any) -> Any:
    """Identity of slots; index arrays count by their content."""
    if isinstance(chosen, (tuple, list)):
        return tuple(slot_key(entry) for entry in chosen)
    return (id(chosen.source), chosen.indices.tobytes()) if isinstance(chosen, Slot) else id(chosen)


_USABLE = (Status.SOLVED, Status.INACCURATE, Status.ITERATION_LIMIT, Status.TIME_LIMIT)
