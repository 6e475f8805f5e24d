"""Solves one after the other, each of whose data are those of the one before, moved on, and a function of its answer.

A moving horizon is one: a record of measurements comes in, the oldest goes, and the arrival cost follows from answer and
data. While weights and pattern stay, what is reported, all excesses over bounds and the arrival cost of the next window
are one product with the window's numbers. All unknowns, residuals and multipliers are worked out when they are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from problems.lazy import lazy
from problems.solvers.base import Status
from problems.solvers.qp_maps import DenseMap
from problems.solvers.qp_projection import Projection
from problems.solvers.qp_solution import QPCheck
from problems.solvers.session import Solution

if TYPE_CHECKING:
    from problems.forms.layout import Layout
    from problems.solvers.qp_rows import StackedRows
    from problems.solvers.qp_session import QPSession


@dataclass(eq=False)
class Following:
    """Data of the next solve, ``Z z + D d + c``, from all unknowns z and all data d of this one.

    Attributes:
        numbers: (k,) positions of these data.
        Z, D, c: (k, n), (k, data) and (k,).
    """

    numbers: np.ndarray
    Z: np.ndarray
    D: np.ndarray
    c: np.ndarray


class Recursion:
    """See the module.

    Args:
        session: screened, with all data given, nothing missing.
        records: (count, size) positions of the records in the data, oldest first.
        reported: (r,) positions of the unknowns that every step reports.
        following: how the other data that change follow.
    """

    def __init__(self, session: QPSession, records: np.ndarray, reported: np.ndarray, following: Following) -> None:
        map_ = session.current_map()
        self.session, self.map, self._following = session, map_, following
        self._columns = np.concatenate([records.ravel(), following.numbers])
        self._fixed = session.store.numbers.copy()
        self._fixed[self._columns] = 0.0
        wanted = np.vstack([np.eye(session.layout.size)[reported], following.Z])
        T, t = map_.affine(wanted)
        T[len(reported) :] += following.D
        t[len(reported) :] += following.c
        excess, bound = map_.excesses
        # after the excesses a row that is -1 or, where a number is not finite, NaN; at the end a one for the constants
        k, data = excess.shape
        T = np.vstack([excess, np.zeros((1, data)), T, np.zeros((1, data))])
        t = np.concatenate([bound, [-1.0], t, [1.0]])
        self._matrix = np.ascontiguousarray(np.column_stack([T[:, self._columns], T @ self._fixed + t]))
        r, last = k + 1 + len(reported), records.size
        self._rows, self._excess = slice(0, k + 1), slice(0, k)
        self._reported, self._next = slice(k + 1, r), slice(r, None)
        self._shape, self._later = records.shape, slice(records.shape[1], last)
        self._tolerance = session.options.tolerance
        self._projection: Projection | None = None
        if k and session.projects and isinstance(map_, DenseMap):
            lift = map_.lift
            lifts = [lift[map_.size :], np.zeros((1, lift.shape[1])), wanted @ lift[: map_.size]]
            lift = np.vstack([*lifts, np.zeros((1, lift.shape[1]))])
            self._projection = session.projection(lift, self._excess)

    @staticmethod
    def suits(session: QPSession) -> bool:
        """Whether the answers of a session, as its data are now, are one product while no bound is active."""
        if not session.screens:
            return False
        map_ = session.current_map()
        return map_.linear and (isinstance(map_, DenseMap) or not map_.reduced.bounded)

    def start(self) -> None:
        """Go on from the session's data and last point."""
        store, point = self.session.store, self.session._point
        self.data = np.append(store.numbers[self._columns], 1.0)
        if self._projection is not None:
            self._projection.restart()
        following = self._following
        self._now = np.append(following.Z @ point + following.D @ store.numbers + following.c, 1.0)

    def step(self, record: np.ndarray) -> RecursionSolution | None:
        """The solution after one more record; None, and nothing changed, where a number is not finite or no point that
        meets the bounds was found.
        """
        data = np.concatenate((self.data[self._later], record, self._now))
        out = self._matrix.dot(data)
        rows = out[self._rows]
        violation = rows.item(rows.argmax())  # a third of the time of `max`
        multipliers, iterations = None, 0
        if not violation <= self._tolerance:
            found = None if violation != violation or self._projection is None else self._projection(out)
            if found is None:
                return None
            out, multipliers, iterations = found
        self.data, self._now = data, out[self._next]
        return RecursionSolution(self, data, out[self._reported], violation, multipliers, iterations)

    @property
    def records(self) -> np.ndarray:
        """(count, size) records of the last step."""
        return self.data[: self._shape[0] * self._shape[1]].reshape(self._shape)

    def hand_back(self, point: np.ndarray) -> None:
        """Give the session the data and the point of the last step."""
        self.session.adopt(self.numbers(self.data), same_map=True)
        self.session._point = point

    def numbers(self, data: np.ndarray) -> np.ndarray:
        """All data of the session's problem from those of a step."""
        out = self._fixed.copy()
        out[self._columns] = data[:-1]
        return out

    def point(self, numbers: np.ndarray, multipliers: np.ndarray | None) -> np.ndarray:
        """All unknowns."""
        z = self.map(numbers)[0]
        if multipliers is None:
            return z
        assert isinstance(self.map, DenseMap)
        lift, n = self.map.lift, self.map.size
        return z - lift[:n] @ (lift[n:].T @ multipliers)

    @lazy
    def no_multipliers(self) -> dict[str, np.ndarray] | None:
        """Those of a step without active rows, read-only; None where they depend on the step."""
        rows = self.stacked
        if rows.equalities:
            return None
        zeros = {name: np.zeros(shape) for name, _, shape in rows.inequalities}
        for array in zeros.values():
            array.flags.writeable = False
        return zeros

    @lazy
    def stacked(self) -> StackedRows:
        """The uncondensed rows."""
        numbers = self.numbers(self.data)
        return QPCheck(self.session.program, self.session.store, numbers, self.map, numbers, None).rows

    @lazy
    def certificate(self) -> np.ndarray | None:
        """Bounds (2, data) of dual and primal residuals of answers without active rows, see `StackedRows.certificate`;
        None where there are none.
        """
        if not isinstance(self.map, DenseMap):
            return None
        fixed = np.abs(self._fixed)
        parts = self.stacked.certificate(self.map)
        return np.array([np.append(by[self._columns], by @ fixed + constant) for by, constant in parts])


class RecursionSolution(Solution):
    """Solution of one step of a `Recursion`, which works out on access what was not reported.

    Attributes:
        reported: (r,) unknowns that were asked for.
    """

    status, message = Status.SOLVED, ""

    def __init__(
        self,
        recursion: Recursion,
        data: np.ndarray,
        reported: np.ndarray,
        violation: float,
        multipliers: np.ndarray | None,
        iterations: int,
    ) -> None:
        # everything else of a solution is below, for whoever reads it
        self._recursion, self._data, self.reported = recursion, data, reported
        self._violation, self._held, self.iterations = violation, multipliers, iterations

    @lazy
    def _layout(self) -> Layout:
        return self._recursion.session.layout

    @lazy
    def method(self) -> str:
        return "linear" if self._held is None else self._recursion.session.solver

    @lazy
    def seconds(self) -> dict[str, float]:
        return {"update": 0.0}

    @lazy
    def _numbers(self) -> np.ndarray:
        return self._recursion.numbers(self._data)

    @lazy
    def point(self) -> np.ndarray:
        return self._recursion.point(self._numbers, self._held)

    @lazy
    def _check(self) -> QPCheck:
        recursion, mu = self._recursion, None
        if self._held is not None:
            assert isinstance(recursion.map, DenseMap)
            mu = recursion.map.by_row(self._held)
        session = recursion.session
        return QPCheck(session.program, session.store, self._numbers, recursion.map, self.point, mu)

    @lazy
    def residuals(self) -> dict[str, float]:
        """As those of every solution; without active rows by a bound that holds for all data (`certificate`)."""
        certificate = self._recursion.certificate
        if self._held is not None or certificate is None:
            return self._check.residuals()
        dual, primal = certificate.dot(np.abs(self._data)).tolist()
        return {"primal": max(primal, self._violation, 0.0), "dual": dual, "gap": 0.0}

    @lazy
    def multipliers(self) -> dict[str, np.ndarray]:
        none = self._recursion.no_multipliers if self._held is None else None
        return self._check.multipliers() if none is None else none.copy()
