"""Solves one after the other, each of whose data are those of the one before, moved on, and a function of its answer.

A moving horizon is one: a record of measurements comes in, the oldest goes, and the arrival cost follows from answer
and data. While weights and pattern stay, what is reported, all excesses over bounds and the arrival cost of the next
window are one product with the window's numbers. All unknowns, residuals and multipliers are worked out when read.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from problems.lazy import lazy
from problems.solvers.base import Status
from problems.solvers.qp_maps import DenseMap
from problems.solvers.qp_projection import Projected, Projection
from problems.solvers.qp_solution import NEGLIGIBLE, QPCheck
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
        held = None
        if not violation <= self._tolerance:
            held = None if violation != violation or self._projection is None else self._projection(out)
            if held is None:
                return None
            out, violation = held.outputs, held.violation
        self.data, self._now = data, out[self._next]
        return RecursionSolution(self, data, out[self._reported], violation, held)

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
    def certificate(self) -> tuple[float, float, float, float] | None:
        """Bounds of the residuals of all answers: the dual one per length of a step's data and of its multipliers, the
        primal one per length of the same. See `StackedRows.certificate`. None where there are none.
        """
        if not isinstance(self.map, DenseMap):
            return None
        rows, fixed = self.stacked, np.abs(self._fixed)
        by_data = [np.append(by[self._columns], by @ fixed + constant) for by, constant in rows.certificate(self.map)]
        by_multiplier = rows.certificate_held(self.map)
        dual, dual_held, primal, primal_held = (
            float(np.linalg.norm(by)) for kind in zip(by_data, by_multiplier, strict=True) for by in kind
        )
        return dual, dual_held, primal, primal_held


class RecursionSolution(Solution):
    """Solution of one step of a `Recursion`, which works out on access what was not reported.

    Attributes:
        reported: (r,) unknowns that were asked for.
        spent: seconds of the step, by who took it.
    """

    spent = 0.0
    status, message = Status.SOLVED, ""

    def __init__(
        self,
        recursion: Recursion,
        data: np.ndarray,
        reported: np.ndarray,
        violation: float,
        held: Projected | None,
    ) -> None:
        # everything else of a solution is below, for whoever reads it
        self._recursion, self._data, self.reported = recursion, data, reported
        self._violation, self._held = violation, held

    @lazy
    def _layout(self) -> Layout:
        return self._recursion.session.layout

    @lazy
    def method(self) -> str:
        return "linear" if self._held is None else self._recursion.session.solver

    @lazy
    def iterations(self) -> int:
        return 0 if self._held is None else self._held.iterations

    @lazy
    def seconds(self) -> dict[str, float]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {"update": 0.0, "solve": self.spent}

    @lazy
    def _numbers(self) -> np.ndarray:
        return self._recursion.numbers(self._data)

    @lazy
    def point(self) -> np.ndarray:
        map_ = self._recursion.map
        z = map_(self._numbers)[0]
        if self._held is not None:
            assert isinstance(map_, DenseMap)
            z = z + map_.pull.dot(self._held.multipliers)
        return z

    @lazy
    def _by_row(self) -> np.ndarray | None:
        """Multipliers of the inequality rows."""
        if self._held is None:
            return None
        assert isinstance(self._recursion.map, DenseMap)
        return self._recursion.map.signs.dot(self._held.multipliers)

    @lazy
    def _check(self) -> QPCheck:
        recursion, session = self._recursion, self._recursion.session
        return QPCheck(session.program, session.store, self._numbers, recursion.map, self.point, self._by_row)

    @property
    def residuals(self) -> dict[str, float]:
        """As those of every solution, but by bounds that hold whatever the data are (`Recursion.certificate`)."""
        certificate = self._recursion.certificate
        if certificate is None:
            return self._check.residuals()
        dual, dual_held, primal, primal_held = certificate
        data, held = self._data, self._held
        size = sqrt(data.dot(data))
        if held is None:
            return {"primal": max(primal * size, self._violation, 0.0), "dual": dual * size, "gap": 0.0}
        pull = sqrt(held.multipliers.dot(held.multipliers))
        gap = held.gap if held.gap <= NEGLIGIBLE else held.gap / max(1.0, abs(self.objective))
        primal = max(primal * size + primal_held * pull, self._violation, 0.0)
        return {"primal": primal, "dual": dual * size + dual_held * pull, "gap": gap}

    @property
    def multipliers(self) -> dict[str, np.ndarray]:
        none = self._recursion.no_multipliers
        if none is None:
            return self._check.multipliers()
        if self._held is None:
            return none.copy()
        mu = self._by_row
        assert mu is not None
        return {name: mu[part].reshape(shape) for name, part, shape in self._recursion.stacked.inequalities}
