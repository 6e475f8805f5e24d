"""Sessions on the quadratic form: the affine map first, a QP backend where a row is violated.

`auto` screens: it answers by the affine map whenever no inequality is violated there, and only otherwise calls a
backend. A solver that was named is always called.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from problems.errors import MissingExtraError, SettingError
from problems.forms.affine_marginal import AffineMarginal, AffineMarginalPlan
from problems.forms.marginal import Marginal
from problems.forms.quadratic import QuadraticProgram, clean
from problems.problem import DataSlot
from problems.solvers.base import Options, QPBackend, QPResult, Status
from problems.solvers.batch import QPBatch
from problems.solvers.qp_check import judge
from problems.solvers.qp_daqp import DAQP
from problems.solvers.qp_maps import DenseMap, SparseMap, require_observable
from problems.solvers.qp_projection import Projection
from problems.solvers.qp_solution import QPCheck
from problems.solvers.session import Session, Solution, slot_key

SEEN = 4096  # sets of weights remembered as seen
MAPS = 64  # patterns of missing data kept between changes of weights
KEPT_NUMBERS = 4_000_000  # of affine maps kept for weights that come back, roughly


@dataclass(eq=False)
class _Works:
    """Maps and marginals by pattern, for one set of weights and matrices; shared by the forks of a session."""

    maps: dict[bytes, DenseMap | SparseMap] = field(default_factory=dict)
    marginals: dict[Any, AffineMarginal] = field(default_factory=dict)


class QPSession(Session):
    """See `Session`; made by `Problem.compile` for every QP backend and for ``auto`` on affine problems.

    Args:
        program: the lowered problem.
        backend: class of the QP solver.
        screen: answer by the affine map where no inequality is violated.
        warm: start a backend from the last QP solution.

    Attributes:
        slow: names of weight and matrix data, whose change makes new maps.
        projects: where the affine answer violates a row, its projection is tried before the backend.
        switching: names of data that are nothing but flags, which are part of the pattern.
    """

    form = "quadratic"

    def __init__(
        self,
        program: QuadraticProgram,
        solver: str,
        backend: type[QPBackend],
        options: Options,
        screen: bool,
        warm: bool = True,
    ) -> None:
        super().__init__(program.problem, program.layout, solver, options)
        self.program = program
        self.warm = warm
        self.screens = screen
        self._backend_type = backend
        self.switching = _switching(program)
        self.slow = frozenset(n for n, speed in program.speeds.items() if speed != "vector") - self.switching
        self._switches = program.activity.switches.size > 0
        self._watched = self.slow | self.switching
        self._complete_key: bytes | None = None if self._switches else b""
        self._weights = sorted(n for n in self.slow if program.problem.inputs[n].of is None)
        numbers = max(1, program.layout.size * program.layout.data_size)
        self._kept = max(4, min(128, KEPT_NUMBERS // numbers))
        self._works: dict[bytes, _Works] = {}
        self._now: _Works | None = None
        self._last_marginal: tuple[bytes, Any, Any, AffineMarginal] | None = None
        self._seen: set[bytes] = set()
        self._flags: dict[bytes, dict[str, Any]] = {}
        self._backend: QPBackend | None = None
        self._loaded: DenseMap | SparseMap | None = None
        self.last: tuple[np.ndarray, np.ndarray] | None = None
        # settings of the user's own are for the backend itself
        self.projects = screen and backend is DAQP and not options.extra
        self._projection: tuple[DenseMap, Projection] | None = None
        self._check_without_data()

    def _check_without_data(self) -> None:
        """What can be seen before any data: unknowns that no cost sees although nothing is missing or switched off."""
        if not all(self.store.given[name] for name in self.slow):
            return
        numbers = clean(self.store.numbers)
        numbers[self.program.activity.switches] = 1.0
        map_ = self._make(b"", numbers, self.store.copy(numbers))
        # weights and matrices that are data may yet see what their defaults do not
        if map_.free is not None and not self.slow:
            require_observable(self.program, map_.free)
        if not self._switches:
            self._works_now().maps[b""] = map_

    def _set(self, name: str, value: Any) -> None:
        if name not in self._watched:
            self.store.set(name, value)
            return
        before = self.store[name].tobytes()
        self.store.set(name, value)
        if self.store[name].tobytes() != before:
            self._changed(numbers=name in self.slow)

    def _changed(self, numbers: bool) -> None:
        """Leave what depended on the switches and, where `numbers` changed, on weights and matrices."""
        self._complete_key = None if self._switches else b""
        if numbers:
            self._now = self._last_marginal = None

    def _works_now(self) -> _Works:
        """What is worked out for the present weights and matrices; the sets used last are kept."""
        if self._now is None:
            # what is missing has a key of its own, so presence flags do not count here
            key = b"".join(self.store[name].tobytes() for name in self._weights)
            self._now = self._works.pop(key, None) or _Works()
            self._works[key] = self._now
            self._known = key in self._seen or not self.slow
            if len(self._seen) >= SEEN:
                self._seen.clear()
            self._seen.add(key)
            if len(self._works) > self._kept:
                self._works.pop(next(iter(self._works)))
        return self._now

    def _update(self) -> None:
        self._map(*self._pattern())
        self._known = True  # work done ahead is to make the solve short

    def _pattern(self) -> tuple[bytes, np.ndarray]:
        """Key of the pattern of missing data and switches; the numbers with missing ones read as zero."""
        d = self.store.numbers
        if d.dot(d) < np.inf:
            if self._complete_key is None:
                self._complete_key = self.program.activity.key(d)
            return self._complete_key, d
        self.store.require_finite()
        return self.program.activity.key(d), clean(d)

    def _map(self, pattern: bytes, numbers: np.ndarray) -> DenseMap | SparseMap:
        maps = (self._now or self._works_now()).maps
        map_ = maps.get(pattern)
        if map_ is None:
            if len(maps) >= MAPS:
                maps.pop(next(iter(maps)))
            map_ = maps[pattern] = self._make(pattern, numbers, self.store)
        return map_

    def _make(self, pattern: bytes, numbers: np.ndarray, store: Any) -> DenseMap | SparseMap:
        program = self.program
        flags = self._flags.get(pattern)
        if flags is None:
            if len(self._flags) >= MAPS:
                self._flags.pop(next(iter(self._flags)))
            flags = self._flags[pattern] = program.flags(store.numbers)
        reduced = program.reduced(numbers)
        if self.screens and program.dense and not program.eliminated:
            reduced = reduced.without_equalities
        return (DenseMap if program.dense else SparseMap)(program, reduced, store, flags, pattern)

    def _solve(self) -> Solution:
        pattern, numbers = self._pattern()
        map_ = self._map(pattern, numbers)
        if map_.free is not None:
            if not pattern:
                require_observable(self.program, map_.free)
            point = self.layout.identity() if self._point is None else self._point
            message = "with what is missing, the costs do not determine all unknowns"
            return Solution(
                self.layout, point, Status.UNBOUNDED, self.solver, _check(self, numbers, map_, point), 0, message
            )
        if self.screens and map_.definite:
            once, self._known = not self._known, True
            z, excess = map_.once(numbers) if once else map_(numbers)
            violation = float(np.maximum.reduce(excess)) if excess.size else 0.0
            if violation <= self.options.tolerance:
                by_map = None if once else violation
                check = QPCheck(self.program, self.store, numbers.copy(), map_, z, None, by_map)
                return Solution(self.layout, z, Status.SOLVED, "linear", check)
            if not once and self.projects and map_.exact:
                solution = self._projected(map_, numbers, z, excess)
                if solution is not None:
                    return solution
        return self._solve_qp(map_, numbers)

    def _projected(self, map_: Any, numbers: np.ndarray, z: np.ndarray, excess: np.ndarray) -> Solution | None:
        """The optimum from the affine answer, or None where the backend must say what is wrong."""
        if self._projection is None or self._projection[0] is not map_:
            self._projection = map_, self.projection(map_.lift, slice(map_.size, None))
        found = self._projection[1](np.concatenate((z, excess)))
        if found is None:
            return None
        z = found.outputs[: map_.size]
        check = _check(self, numbers, map_, z, map_.signs.dot(found.multipliers))
        return Solution(self.layout, z, Status.SOLVED, self.solver, check, found.iterations)

    def projection(self, lift: np.ndarray, excess: slice) -> Projection:
        """A `Projection` by the options of this session."""
        return Projection(lift, excess, self.options, self.warm)

    def _marginal(self, drop: Any, keep: Any, point: np.ndarray) -> Marginal:
        """Affine in the data, so the map is kept beside the solution's and costs one product."""
        pattern, numbers = self._pattern()
        return self._marginal_map(drop, keep, pattern, numbers)(numbers, point)

    def marginal_map(self, drop: Any, keep: Any) -> AffineMarginal:
        """The marginal as a function of the data, for weights, matrices and pattern as they are."""
        return self._marginal_map(drop, keep, *self._pattern())

    def _marginal_map(self, drop: Any, keep: Any, pattern: bytes, numbers: np.ndarray) -> AffineMarginal:
        last = self._last_marginal
        if last is not None and last[1] is drop and last[2] is keep and last[0] == pattern:
            return last[3]
        key = (pattern, slot_key(drop), slot_key(keep))
        marginals = self._works_now().marginals
        found = marginals.get(key)
        if found is None:
            if len(marginals) >= MAPS:
                marginals.pop(next(iter(marginals)))
            plan = self._plan(drop, keep, AffineMarginalPlan)
            found = marginals[key] = AffineMarginal(plan, self.store, numbers, pattern)
        self._last_marginal = (pattern, drop, keep, found)
        return found

    def batch(self, count: int) -> QPBatch:
        return QPBatch(self, count)

    def adopt(self, numbers: np.ndarray, same_map: bool = False) -> None:
        """Take all data at once, as laid out; `same_map` promises equal weights, matrices and pattern."""
        self.store.numbers[:] = numbers
        self.store.given = dict.fromkeys(self.store.given, True)
        if not same_map:
            self._changed(numbers=True)

    def current_map(self) -> DenseMap | SparseMap:
        """The affine map for the data given so far."""
        return self._map(*self._pattern())

    def solve_screened_out(self) -> Solution:
        """Solve by the backend, for data whose affine answer is known to violate a row."""
        pattern, numbers = self._pattern()
        map_ = self._map(pattern, numbers)
        return self._solve() if map_.free is not None else self._solve_qp(map_, numbers)

    def _solve_qp(self, map_: DenseMap | SparseMap, numbers: np.ndarray) -> Solution:
        reduced = map_.reduced
        q, l, u, offset = map_.vectors(numbers)
        again = self._loaded is map_
        result = self._call(map_, q, l, u)
        x, y = result.x, result.y
        if again and x is not None and y is not None:  # the rows of a map that comes back are worth stacking
            z = reduced.map.Z.dot(x)
            z += offset
            check = _check(self, numbers, map_, z, y[reduced.equalities :])
            if check.within(self.options.tolerance):
                self.last = (x, y)
                return Solution(self.layout, z, Status.SOLVED, self.solver, check, result.iterations, result.message)
        status, result = judge(result, map_.P, q, reduced.A, l, u, self.options.tolerance)
        if result.x is None or result.y is None or not np.isfinite(result.x).all():
            point = self.layout.identity() if self._point is None else self._point
            self.last = None
            return Solution(
                self.layout,
                point,
                status,
                self.solver,
                _check(self, numbers, map_, point),
                result.iterations,
                result.message,
            )
        z = reduced.map.Z.dot(result.x)
        z += offset
        self.last = (result.x, result.y)
        check = _check(self, numbers, map_, z, result.y[reduced.equalities :])
        return Solution(self.layout, z, status, self.solver, check, result.iterations, result.message)

    def _call(self, map_: DenseMap | SparseMap, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> QPResult:
        reduced = map_.reduced
        if not reduced.size:  # the equalities leave nothing to choose
            if (l <= self.options.tolerance).all() and (u >= -self.options.tolerance).all():
                return QPResult(np.zeros(0), np.zeros(l.size), Status.SOLVED)
            return QPResult(None, None, Status.INFEASIBLE, 0, "the only point of the equalities violates an inequality")
        try:
            if self._backend is None or (self._loaded and self._loaded.reduced.A.shape != reduced.A.shape):
                self.last = None
                self._backend = self._backend_type(map_.P, q, reduced.A, l, u, self.options)
            elif self._loaded is not map_:
                self._backend.update(map_.P, reduced.A)
            self._loaded = map_
            return self._backend.solve(q, l, u, self.last if self.warm else None)
        except (SettingError, MissingExtraError):
            raise
        except Exception as error:  # a backend that breaks is a status, and the next solve starts afresh
            self._backend, self._loaded, self.last = None, None, None
            return QPResult(None, None, Status.FAILED, 0, f"{self.solver} raised {type(error).__name__}: {error}")

    def reset(self) -> None:
        super().reset()
        self.last = self._backend = self._loaded = self._projection = None
        self._seen, self._now, self._last_marginal = set(), None, None

    def _forked(self) -> None:
        self._seen = set(self._seen)
        self._backend = self._loaded = self._projection = None


def _check(
    session: QPSession, numbers: np.ndarray, map_: Any, point: np.ndarray, mu: np.ndarray | None = None
) -> QPCheck:
    return QPCheck(session.program, session.store, numbers.copy(), map_, point, mu)


def _switching(program: QuadraticProgram) -> frozenset[str]:
    """Names of data that switch instances and are neither weights nor read by residuals."""
    terms = program.problem.terms.values()
    switches = {t.active.source.name for t in terms if isinstance(t.active, DataSlot)}
    weights = {t.noise.value.source.name for t in terms if t.noise and isinstance(t.noise.value, DataSlot)}
    return frozenset(name for name in switches - weights if program.speeds[name] == "weight")
