"""Sets that are not convex, as unions of convex pieces: exact road in view, and road that nobody sees.

At an instant with such a set the position lies in one of the pieces. The best choice over all instants is found by
branch and bound: the convex hull is the relaxation, instants whose estimate lies in a piece already need no choice, and
what costs more than the best choice known is left out. Parts of the model are independent, so each has its own search.

A detection says that the position is in the piece; not being seen says so only where detection in view is certain.
Neither brings a point estimate closer to the truth for sure (dmhe-sporadic-fov section 10: about 1 % at best).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mhe.polyhedron import Polyhedron
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.rows import padded_rows
from problems.solvers.base import Status
from problems.solvers.session import Solution

INSIDE = 1e-7  # violation (unit of the rows) up to which an estimate counts as inside a piece
SOLVES = 2000  # problems solved for one part in one step before the best choice known is taken

Cell = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Choice:
    """A set of rows that has to be one of several.

    Attributes:
        instance: of the rows of the window.
        part, slot: whose state they are on.
        cells: H (rows, m) and h (rows,) of each piece.
        name: for reports.
    """

    instance: int
    part: int
    slot: int
    cells: list[Cell]
    name: str


class PieceSearch:
    """Chooses pieces for the windows of one node.

    Args:
        plan: of the node.
        session: of its window, hard rows.
        rows: ``row matrix`` and ``row bound`` of the convex hulls.
    """

    def __init__(self, plan: SporadicPlan, session: Any, rows: dict[str, np.ndarray]) -> None:
        self._plan, self._session, self._rows = plan, session, rows
        self._detected: dict[int, list[Cell]] = {}
        self._unseen: dict[int, list[Cell]] = {}
        for sensor in plan.row_sensors[plan.row_sensors >= 0].tolist():
            pieces = plan.pieces[sensor]
            if pieces:
                self._detected[sensor] = [self._cell(piece, sensor) for piece in pieces]
        for part, sensors in enumerate(plan.row_sensors):
            sensor = int(sensors[0])
            if plan.unseen_pieces and sensor >= 0:
                self._unseen[part] = [self._cell(piece, sensor) for piece in plan.unseen_pieces]

    def refine(
        self, solution: Solution, flags: np.ndarray, active: np.ndarray, newest: int
    ) -> tuple[Solution, tuple[str, ...]]:
        """The best solution with pieces, and names of sets of which no piece can hold.

        Args:
            solution: with the hulls, whose data the session holds.
            flags: (N + 1, sensors) of the window.
            active: (N + 1, instances per slot) flags of the rows.
            newest: slot of the newest instant.
        """
        decided: dict[int, Cell] = {}
        unmet: list[str] = []
        choices = self._choices(flags, newest)
        for part in sorted({choice.part for choice in choices}):
            mine = [choice for choice in choices if choice.part == part]
            found = self._search(mine, solution, active)
            if found is None:
                unmet += [choice.name for choice in mine]
            else:
                decided |= found
        if decided:
            solution = self._solve(decided, active)
        self._session.update(**self._rows)
        return solution, tuple(dict.fromkeys(unmet))

    def _choices(self, flags: np.ndarray, newest: int) -> list[Choice]:
        plan, found = self._plan, []
        per_slot = plan.row_sensors.size
        for place, sensor in enumerate(plan.row_sensors.ravel().tolist()):
            part = place // plan.row_sensors.shape[1]
            cells = self._detected.get(sensor)
            if cells:
                for slot in np.flatnonzero(flags[: newest + 1, sensor]).tolist():
                    found.append(Choice(slot * per_slot + place, part, slot, cells, plan.names[sensor]))
        for part, cells in self._unseen.items():
            if not flags[newest, plan.parts == part].any():
                place = newest * per_slot + part * plan.row_sensors.shape[1]
                found.append(Choice(place, part, newest, cells, f"unseen {plan.names[plan.row_sensors[part, 0]]}"))
        return found

    def _search(self, choices: list[Choice], root: Solution, active: np.ndarray) -> dict[int, Cell] | None:
        """The cheapest pieces by instance, none where the hulls do; None where no combination can hold."""
        best: dict[int, Cell] | None = None
        cheapest, solves = np.inf, 0
        open_: list[dict[int, Cell]] = [{}]
        while open_ and solves < SOLVES:
            decided = open_.pop()
            solution = self._solve(decided, active) if decided or solves else root
            solves += 1
            if solution.status is not Status.SOLVED:
                continue
            # the root was solved by the session last, or nothing was tried before it
            value = self._session.value if decided else -np.inf
            if value >= cheapest:
                continue
            choice = self._outside(choices, decided, solution)
            if choice is None:
                best, cheapest = decided, value
                if not decided:
                    break
                continue
            position = self._state(solution, choice)
            nearest = sorted(choice.cells, key=lambda cell: -(cell[0] @ position - cell[1]).max())
            open_ += [decided | {choice.instance: cell} for cell in nearest]
        return best

    def _outside(self, choices: list[Choice], decided: dict[int, Cell], solution: Solution) -> Choice | None:
        """The undecided choice whose estimate is farthest from all its pieces, if any is outside."""
        worst, farthest = None, INSIDE
        for choice in choices:
            if choice.instance in decided:
                continue
            position = self._state(solution, choice)
            distance = min(float((H @ position - h).max()) for H, h in choice.cells)
            if distance > farthest:
                worst, farthest = choice, distance
        return worst

    def _state(self, solution: Solution, choice: Choice) -> np.ndarray:
        return solution["x"][choice.slot * self._plan.blocks.count + choice.part]

    def _solve(self, decided: dict[int, Cell], active: np.ndarray) -> Solution:
        H, h, on = self._rows["row matrix"].copy(), self._rows["row bound"].copy(), active.ravel().copy()
        for instance, (matrix, bound) in decided.items():
            H[instance], h[instance], on[instance] = matrix, bound, 1.0
        return self._session.solve({"row matrix": H, "row bound": h, "row active": on})

    def _cell(self, piece: Polyhedron, sensor: int) -> Cell:
        return padded_rows(piece, self._plan.outputs[sensor], self._plan.shape.rows)
