"""Fixed-lag smoothing of moving teams: the newest keyframes and all lasting unknowns, everything older marginalized.

When a keyframe leaves, `Session.marginal` integrates its poses out of the window with every cost that touches them;
what remains is the arrival cost of the next window, as in moving horizon estimation with ``prior=filter`` (design
section 3.3). In linear problems the estimate equals that of all data. In nonlinear ones what left stays linearized
where it was estimated last. Fences and robust losses count in full while their keyframe is in the window; a keyframe
that leaves takes its fences along, and its readings keep the weight that their loss gave them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.smoothing.gating import Gate
from localization.smoothing.kinds import POSE, Fence, Kind, Lasting, Measurements
from localization.smoothing.window import TeamWindow
from mhe.covariance import SETTLED_TOLERANCE
from problems.errors import DataError, SettingError, UnknownNameError
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution
from problems.spaces import Space, points

if TYPE_CHECKING:
    import pandas as pd

Late = Iterable[tuple[float, Measurements]]
Predict = Callable[[np.ndarray, Measurements], np.ndarray]
_TAKEN = (Status.SOLVED, Status.INACCURATE, Status.ITERATION_LIMIT, Status.TIME_LIMIT)


class TeamEstimate:
    """What a `FixedLagSmoother` knows after one step.

    Attributes:
        time: of the newest keyframe, s.
        state: (robots, ambient) newest poses.
        times: (k,) of the keyframes in the window, oldest first, s.
        window: (k, robots, ambient) their poses.
        lasting: (count, ambient) by name.
        status: of the solve; unless it is one of those that give values, everything is the prediction.
        seconds: wall time of the step.
        late: times of late measurements that were used, s.
        too_late: times of late measurements whose keyframe had left, s.
        gated: (kind, row) of readings left out by their gate.
        dropped: readings left out as their keyframe held enough of the same places.
        infeasible: names of the fences, where no point satisfies all of them.
        solution: of the window's problem.
    """

    def __init__(self, fields: dict[str, Any]) -> None:
        self.time: float = fields["time"]
        self.state: np.ndarray = fields["state"]
        self.times: np.ndarray = fields["times"]
        self.window: np.ndarray = fields["window"]
        self.lasting: dict[str, np.ndarray] = fields["lasting"]
        self.status: Status = fields["status"]
        self.seconds: float = fields["seconds"]
        self.late: tuple[float, ...] = fields["late"]
        self.too_late: tuple[float, ...] = fields["too_late"]
        self.gated: tuple[tuple[str, int], ...] = fields["gated"]
        self.dropped: int = fields["dropped"]
        self.infeasible: tuple[str, ...] = fields["infeasible"]
        self.solution: Solution = fields["solution"]
        self._window: TeamWindow = fields["problem"]

    @cached_property
    def covariance(self) -> np.ndarray:
        """(robots dim, robots dim) joint covariance of `state` in tangent coordinates (body frame).

        Raises:
            UnobservableError: the costs leave a direction free.
        """
        return self.marginal_covariance()

    def marginal_covariance(
        self, keyframe: int = -1, robot: int | None = None, lasting: str | None = None
    ) -> np.ndarray:
        """Covariance of a part of the window, in tangent coordinates.

        Args:
            keyframe: of the window, counted from the oldest, or from the newest if negative.
            robot: only this one; all of them if None.
            lasting: these unknowns instead of poses.

        Raises:
            DataError: no such keyframe or robot.
            UnknownNameError: no such lasting unknown.
            UnobservableError: the costs leave a direction free.
        """
        if lasting is not None:
            if lasting not in self._window.lasting:
                raise UnknownNameError("lasting unknown", lasting, self._window.lasting)
            return self.solution.covariance(self._window.lasting[lasting])
        count, robots = len(self.times), self._window.robots
        if not -count <= keyframe < count or not (robot is None or 0 <= robot < robots):
            raise DataError(f"the window has {count} keyframes of {robots} robots, not keyframe {keyframe}, {robot}")
        slot = self._window.keyframe(keyframe % count)
        return self.solution.covariance(slot if robot is None else slot.source[int(slot.indices[robot])])

    def to_pandas(self) -> pd.DataFrame:
        """One row per robot: time (index), robot, stored coordinates ``x0`` ..., status, seconds."""
        import pandas as pd

        frame = pd.DataFrame(self.state, columns=[f"x{k}" for k in range(self.state.shape[1])])
        frame.insert(0, "robot", range(len(self.state)))
        frame["status"], frame["seconds"] = str(self.status), self.seconds
        return frame.set_index(pd.Index([self.time] * len(frame), name="time"))


class FixedLagSmoother:
    """See the module. Add keyframes one by one with `step`.

    Args:
        space: of every robot's state: SE2, SE3, a Vector.
        lag: keyframes before the newest one that stay in the window.
        kinds: measurements by name; what moves robots on (odometry, a motion model) reads ``before`` and ``pose``.
        start: (robots, ambient) or (ambient,) poses at the first keyframe.
        start_sigma: their standard deviations in tangent coordinates; broadcasts to (robots, dim).
        robots: how many move.
        lasting: unknowns that do not change (landmarks, biases) by name.
        fences: bounds on all poses by name.
        predict: first guess of the newest poses from the last ones and the new measurements; they stay by default.
        iterations: Gauss-Newton steps for each keyframe; None iterates to convergence. Not used by solvers of QPs.
        solver: registered name; ``auto`` takes a QP where everything is linear.
        settings: of the solver.

    Raises:
        DefinitionError, SettingError, DataError: about the arguments.
        FormError: fences and a solver that takes none, or a nonlinear kind and a QP solver.

    Attributes:
        window: the problem that is solved. session: its session, compiled once. options: by name, for reports.
    """

    def __init__(
        self,
        space: Space,
        lag: int,
        kinds: Mapping[str, Kind],
        *,
        start: Any,
        start_sigma: Any,
        robots: int = 1,
        lasting: Mapping[str, Lasting] | None = None,
        fences: Mapping[str, Fence] | None = None,
        predict: Predict | None = None,
        iterations: int | None = None,
        solver: str = "auto",
        **settings: Any,
    ) -> None:
        from problems.solvers.compile import is_affine

        if isinstance(lag, bool) or int(lag) != lag or lag < 1:
            raise SettingError(f"lag: expected a whole number of keyframes of at least 1, got {lag!r}")
        self._lasting = dict(lasting or {})
        self.window = TeamWindow(space, robots, int(lag) + 1, kinds, self._lasting, fences or {})
        if iterations is not None and solver in ("auto", "gauss-newton") and not is_affine(self.window.problem):
            settings["iterations"] = iterations
        self.session: Session = self.window.problem.compile(solver, **settings)
        self._quadratic = self.session.form == "quadratic"
        self._start, self._start_sigma, self._predict = start, start_sigma, predict
        self._gates = {
            name: Gate(self.window, places) for name, places in self.window.places.items() if places.kind.gate
        }
        self._fences = tuple(fences or {})
        self.options: dict[str, Any] = {
            "lag": int(lag),
            "robots": robots,
            "prior": "filter",
            "kinds": tuple(kinds),
            "lasting": tuple(self._lasting),
            "fences": self._fences,
            "solver": solver,
            "iterations": iterations,
            **settings,
        }
        self.reset()

    def reset(self) -> None:
        """Forget everything but the prior; what is compiled stays."""
        window = self.window
        self._values, reference, information = window.prior(self._start, self._start_sigma, self._lasting)
        self._passed = information
        for places in window.places.values():
            places.clear()
        self.times: list[float] = []
        self.session.reset()
        self.session.update(reference=reference, information=information, linear=np.zeros(window.size))
        self._solution: Solution | None = None
        self._located = False

    def place(self, lasting: str, index: int, value: Any) -> None:
        """Say where to start looking for a lasting unknown, for example when a landmark is seen first.

        It moves the point to linearize at, not the prior.

        Raises:
            UnknownNameError, DataError: no such unknown; a value that does not fit.
        """
        if lasting not in self._lasting:
            raise UnknownNameError("lasting unknown", lasting, self._lasting)
        if not 0 <= index < self._lasting[lasting].count:
            raise DataError(f"{lasting!r} has {self._lasting[lasting].count} instances, not {index}")
        self._values[lasting][index] = points(self._lasting[lasting].space, value, 1, f"{lasting!r} {index}")[0]

    def step(self, measurements: Measurements, time: float | None = None, late: Late = ()) -> TeamEstimate:
        """Add a keyframe and estimate the window.

        Args:
            measurements: readings by kind: those of the keyframe, and of what happened since the one before.
            time: of the keyframe, s; one second after the last one if None.
            late: pairs (time, readings by kind) that belong to earlier keyframes. They enter the keyframe nearest in
                time where it is still in the window.

        Raises:
            DataError, ShapeError, UnknownNameError: readings that do not fit; a time that does not advance.
        """
        began = perf_counter()
        window = self.window
        now = self._time(time)
        given = self._checked(measurements)
        gated: list[tuple[str, int]] = []
        dropped, used, too_late = self._amend(late, gated)
        if len(self.times) == window.slots:
            self._slide()
        newest = len(self.times)
        self.times.append(now)
        self._guess(newest, measurements)
        for name, (number, values, sigma) in given.items():
            if name not in self._gates:
                dropped += window.places[name].enter(newest, number, values, sigma)
        if any(name in self._gates and len(entry[0]) for name, entry in given.items()):
            prediction = self._solve()
            for name in self._gates.keys() & given.keys():
                dropped += self._gate(name, prediction, newest, given[name], gated)
        solution = self._solve()
        taken = solution.status in _TAKEN
        filled = newest + 1
        poses = self._values[POSE].reshape(window.slots, window.robots, -1)[:filled]
        return TeamEstimate(
            {
                "time": now,
                "state": poses[-1].copy(),
                "times": np.array(self.times),
                "window": poses.copy(),
                "lasting": {name: self._values[name].copy() for name in self._lasting},
                "status": solution.status,
                "seconds": perf_counter() - began,
                "late": tuple(used),
                "too_late": tuple(too_late),
                "gated": tuple(gated),
                "dropped": dropped,
                "infeasible": self._fences if not taken and solution.status is Status.INFEASIBLE else (),
                "solution": solution,
                "problem": window,
            }
        )

    def _time(self, time: float | None) -> float:
        last = self.times[-1] if self.times else None
        now = float(time) if time is not None else (0.0 if last is None else last + 1.0)
        if not np.isfinite(now) or (last is not None and now <= last):
            raise DataError(f"keyframes must advance in time; the last one was at {last} s, this one at {time!r}")
        return now

    def _checked(self, measurements: Measurements) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        places = self.window.places
        for name in measurements:
            if name not in places:
                raise UnknownNameError("kind of measurement", name, places)
        given = {name: places[name].combination(readings) for name, readings in measurements.items()}
        if not self.times and any(places[name].first and len(entry[0]) for name, entry in given.items()):
            raise DataError("the first keyframe has none before it; give what moves robots on from the second one on")
        return given

    def _amend(self, late: Late, gated: list[tuple[str, int]]) -> tuple[int, list[float], list[float]]:
        """Enter late readings: how many had no place, and times that were used and that were too late."""
        dropped, used, too_late = 0, [], []
        for when, given in [(float(when), self._checked(measurements)) for when, measurements in late]:
            slot = self._slot(when)
            for name, entry in given.items():
                places = self.window.places[name]
                if slot is None or (places.first and slot == 0):  # the keyframe, or the one it comes from, has left
                    too_late.append(when)
                    continue
                used.append(when)
                if name in self._gates and self._solution is not None:
                    dropped += self._gate(name, self._solution, slot, entry, gated)
                else:
                    dropped += places.enter(slot, *entry)
        if used and len(self.times) == self.window.slots:
            self.session.update(**self._data())  # the arrival cost is made from what the session knows
        return dropped, list(dict.fromkeys(used)), list(dict.fromkeys(too_late))

    def _slot(self, when: float) -> int | None:
        """Slot of the keyframe nearest in time; None where it left the window."""
        if not self.times:
            return None
        times = np.array(self.times)
        slot = int(np.argmin(np.abs(times - when)))
        reach = (times[1] - times[0]) / 2 if len(times) > 1 else np.inf
        return None if when < times[0] - reach * (1 + 1e-9) else slot

    def _gate(self, name: str, solution: Solution, slot: int, entry: Any, gated: list[tuple[str, int]]) -> int:
        number, values, sigma = entry
        if solution.status not in _TAKEN or not len(number):
            return self.window.places[name].enter(slot, number, values, sigma)
        good = self._gates[name].passes(solution, slot, number, values, sigma)
        gated += [(name, int(row)) for row in np.flatnonzero(~good)]
        return self.window.places[name].enter(slot, number[good], values[good], None if sigma is None else sigma[good])

    def _slide(self) -> None:
        """Integrate the oldest keyframe out and move everything one slot on."""
        window, robots = self.window, self.window.robots
        at = None if self._quadratic and self._located else self._values
        marginal = self.session.marginal(window.dropped, window.kept, at)
        data = {
            "reference": np.concatenate([part.ravel() for part in marginal.reference]),
            "linear": -marginal.vector,
        }
        M = marginal.information
        # weights that did not change keep what a solver made of them
        if np.abs(M - self._passed).max() > SETTLED_TOLERANCE * np.abs(M).max():
            data["information"] = self._passed = M
        self.session.update(**data)
        for places in window.places.values():
            places.slide()
        poses = self._values[POSE]
        poses[:-robots] = poses[robots:]
        self.times.pop(0)

    def _guess(self, newest: int, measurements: Measurements) -> None:
        robots = self.window.robots
        poses = self._values[POSE]
        if newest == 0:
            return
        last = poses[(newest - 1) * robots : newest * robots]
        moved = last if self._predict is None else np.asarray(self._predict(last.copy(), measurements), dtype=float)
        moved = points(self.window.space, moved, robots, "predict")
        poses[newest * robots :] = np.tile(moved, (self.window.slots - newest, 1))

    def _data(self) -> dict[str, np.ndarray]:
        window = self.window
        data: dict[str, np.ndarray] = {}
        for places in window.places.values():
            data |= places.data()
        filled = np.repeat((np.arange(window.slots) < len(self.times)).astype(float), window.robots)
        data["absent"] = 1.0 - filled[window.robots :]
        if window.fenced:
            data["filled"] = filled
        return data

    def _solve(self) -> Solution:
        solution = self.session.solve(self._data(), self._values)
        self._solution = solution
        if solution.status in _TAKEN:
            self._values = {name: value.copy() for name, value in solution.values.items()}
            self._located = True
        return solution
