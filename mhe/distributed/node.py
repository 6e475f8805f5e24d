"""`DistributedNode`: one node of DMHE, DMHE_pre or DMHE_w-pre behind its inbox.

Source: dmhe-pre-estimation 4.2 (Algorithm 1) with errata E1-E3; missing neighbours by the rule of design 3.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from mhe.arrival import inverse
from mhe.covariance import (
    SETTLED_TOLERANCE,
    arrival_update,
    capped,
    output_information,
    symmetrized,
    window_information,
)
from mhe.distributed.fallback import STOPPED, Fallback, data_of, predicted, usable
from mhe.distributed.plan import NodePlan
from mhe.distributed.pool import WindowPool
from mhe.estimate import WindowEstimate
from mhe.node import OneMessageNode, own_reading
from problems.errors import DataError
from problems.runtime import Message, NeighborMemory, Outgoing, Schema
from problems.runtime.message import Field
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution


class DistributedNode(OneMessageNode):
    """Estimates the state from the measurements of its in-neighbourhood and the estimates of its in-neighbours.

    One message per step goes to all out-neighbours: the measurement y_t, the state of instant s_t = max(0, t - N) as
    estimated in the step before, and its covariance unless that was worked out off-line. `finish` returns a
    `WindowEstimate` without covariance. A node that (re)starts later than instant 0 has nothing but its plan: it treats
    earlier measurements as missing, earlier inputs as zero, and takes its prior from the neighbours it hears.

    Args:
        plan: what the node is told before the run.
        pool: where its window is compiled.
    """

    def __init__(self, plan: NodePlan, pool: WindowPool | None = None) -> None:
        self._plan, self._pool = plan, WindowPool() if pool is None else pool
        model, options = plan.model, plan.options
        self._model, self._horizon = model, options.horizon
        self._window, base = self._pool.get(model, plan.gain, options, plan.state_bounds, plan.disturbance_bounds)
        self._session: Session = base.fork()
        self._fallback = Fallback(
            self._pool, model, plan.gain, options, plan.state_bounds, plan.disturbance_bounds, self._window.bounds
        )
        n = model.state_size
        own = plan.member_rows[plan.own]
        self._own_size = own.stop - own.start
        self._place = {member: k for k, member in enumerate(plan.members)}
        self._schemas = {
            member: schemas(rows.stop - rows.start, n, options.covariances == "online")
            for member, rows in zip(plan.members, plan.member_rows, strict=True)
        }
        self._speaks = self._schemas[plan.index]
        forget = options.horizon if options.forget_after is None else options.forget_after
        self._memory = NeighborMemory(
            plan.members,
            plan.weights,
            self._propagate,
            model.process_covariance,
            period=plan.period,
            forget_after=forget,
        )
        self._mean, self._start = model.prior()
        self._fused = self._start
        self._own_covariance = self._start
        self._updated: np.ndarray | None = None  # the Pi_bar that Pi^i was computed from
        self._covariances: list[Any] = []
        self._considered: np.ndarray | None = None  # the newest Pi_bar; `_fused` stays until it differs noticeably
        self._heard = b""
        self._entry = -1
        if plan.schedule is None:
            self._information = output_information(model.C, model.R)
            windows = [self._information] * options.horizon
            self._windowed = window_information(windows, model.A, model.process_covariance)
        self._passed: np.ndarray | None = None
        slots = options.horizon + 1
        self._y = np.full((slots, model.measurement_size), np.nan)
        self._flat = self._y.reshape(-1, 1)
        self._u = np.zeros((slots, model.input_size))
        self._older = np.zeros((forget, model.input_size))  # inputs before the window, to propagate old estimates
        self._states = np.tile(self._mean, (slots, 1))
        self._now = -1
        self._published: np.ndarray | None = None
        self._data: dict[str, Any] = {"y": self._flat} if model.measurement_size else {}

    # What a step consists of

    def measure(self, time: float, measurement: Any) -> tuple[Outgoing, ...]:
        """Take y_t, or (y_t, u_{t-1}) where the model has inputs, and speak.

        Args:
            time: t times the period.
            measurement: y_t (p_i,), NaN where a component is missing, None where all are.

        Raises:
            ShapeError: wrong shapes.
            DataError: infinite numbers, or no input where the model has inputs.
        """
        instant = round(time / self._plan.period)
        y, u = own_reading(measurement, self._own_size, self._model.input_size, instant, self._plan.label)
        self._advance(instant, u)
        self._y[self._newest, self._plan.member_rows[self._plan.own]] = y
        self._time = float(time)
        reading, full = self._speaks
        if self._published is None:
            return (reading.message(y=y),)
        if self._plan.schedule is not None:
            self._memory.receive(self._plan.index, self._time, self._published)
            return (full.message(y=y, state=self._published),)
        covariance = self._local()
        self._memory.receive(self._plan.index, self._time, self._published, covariance)
        return (full.message(y=y, state=self._published, covariance=covariance),)

    def finish(self, inbox: list[Message]) -> WindowEstimate:
        """Hear the neighbours, solve the local problem and publish.

        Raises:
            DataError: a message from a stranger or of another definition.
        """
        started = perf_counter()
        current, late, too_late = self._hear(inbox)
        newest = self._newest
        missing = ()
        if np.isnan(self._y[newest]).any():
            missing = tuple(np.flatnonzero(np.isnan(self._y[newest])).tolist())
        status, infeasible, solution = Status.SOLVED, (), None
        if self._now == 0:
            self._published = self._mean
        else:
            self._arrival(current)
            status, infeasible, solution = self._solve()
            # s_{t+1} = s_t while the window grows, then the next instant
            self._published = self._states[1 if newest == self._horizon else 0].copy()
        return WindowEstimate(
            {
                "state": self._states[newest].copy(),
                "window": self._states[: newest + 1].copy(),
                "status": status,
                "seconds": perf_counter() - started,
                "infeasible": infeasible,
                "missing": missing,
                "late": late,
                "too_late": too_late,
                "time": self._time,
                "state_names": self._model.state_names,
                "solution": solution,
            }
        )

    # Measurements and messages

    def _advance(self, instant: int, u: np.ndarray | None) -> None:
        """Move the window on to `instant`."""
        N, driven = self._horizon, self._model.input_size > 0
        first = self._now < 0
        before = instant if first else self._now
        for step in range(before + 1, instant + 1):
            if step > N:
                self._y[:-1] = self._y[1:]
                if driven:
                    self._older[:-1] = self._older[1:]
                    self._older[-1:] = self._u[:1]
                    self._u[:-1] = self._u[1:]
            self._y[min(step, N)] = np.nan
            self._u[min(step, N)] = 0.0
        self._slid = instant > N
        self._now, self._newest = instant, min(instant, N)
        if driven:
            self._u[self._newest] = 0.0 if u is None else u
            self._data["u"] = self._u
        if self._window.bounds and (first or not self._slid or before < N):
            self._data["filled"] = (np.arange(N + 1) <= self._newest).astype(float)

    def _hear(self, inbox: Sequence[Message]) -> tuple[list[np.ndarray] | None, tuple[float, ...], tuple[float, ...]]:
        """Take over what was received.

        Returns:
            The states of all members in their order if all spoke in this step, else None; times of late measurements,
            and of those whose instant has left the window.
        """
        heard: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        late: list[float] = []
        too_late: list[float] = []
        for message in inbox:
            place = self._place.get(message.sender)
            if place is None:
                raise DataError(f"node {self._plan.label} heard node {message.sender}, which is no in-neighbour")
            reading, full = self._schemas[message.sender]
            complete = message.schema == full.id
            values = (full if complete else reading).unpack(message)
            slot = round(message.time / self._plan.period) - self._now + self._newest
            if 0 <= slot <= self._newest:
                self._y[slot, self._plan.member_rows[place]] = values["y"]
                if slot < self._newest:
                    late.append(message.time)
            elif slot < 0:
                too_late.append(message.time)
            if not complete:
                continue
            covariance = values.get("covariance")
            self._memory.receive(message.sender, message.time, values["state"], covariance)
            if message.time == self._time:
                heard[message.sender] = values["state"], covariance
        if self._published is None or len(heard) < len(self._place) - 1:
            return None, tuple(late), tuple(too_late)
        heard[self._plan.index] = self._published, self._own_covariance
        self._covariances = [heard[member][1] for member in self._plan.members]
        return [heard[member][0] for member in self._plan.members], tuple(late), tuple(too_late)

    def _propagate(self, state: np.ndarray, age: int) -> np.ndarray:
        """A neighbour's published state of `age` steps ago, brought to the first instant of the present window."""
        now, N = self._now, self._horizon
        steps = max(0, now - N) - max(0, now - age - N)
        for k in range(steps, 0, -1):
            state = self._model.A @ state
            if self._model.input_size:
                # the input of the transition that ends k - 1 instants before the window's first one
                u = self._u[0] if k == 1 else self._older[1 - k]
                state = state + self._model.B @ u
        return state

    # Arrival cost

    def _local(self) -> np.ndarray:
        """Pi^i of the state that is published now (3.3 steps 4 and 5); Pi_0 while the window grows."""
        if self._now <= self._horizon:
            self._own_covariance = self._start
        elif self._fused is not self._updated:
            model, rule = self._model, self._plan.options.pi_update
            self._updated = self._fused
            self._own_covariance = arrival_update(
                self._fused, model.A, model.process_covariance, self._information, self._windowed, rule
            )
        return self._own_covariance

    def _arrival(self, current: list[np.ndarray] | None) -> None:
        """Reference and information of the arrival cost."""
        plan, growing = self._plan, self._now <= self._horizon
        if current is not None:
            reference = plan.weights @ np.array(current)
            fused = self._nominal(growing)
        else:
            reference, fused = self._incomplete(growing)
        if growing and plan.options.growth_prior != "consensus":
            own = self._published if plan.options.growth_prior == "own" else None
            reference = self._mean if own is None else own
        self._data["reference"] = np.reshape(reference, (1, -1))
        if fused is self._considered:
            return
        self._considered = fused
        if self._passed is not None and _settled(self._fused, fused):
            return
        self._fused = fused
        information = inverse(fused)
        if self._passed is None or not _settled(self._passed, information):
            self._data["information"] = self._passed = information

    def _nominal(self, growing: bool) -> np.ndarray:
        """Pi_bar with all neighbours heard."""
        schedule = self._plan.schedule
        if schedule is not None:
            entry = schedule.entry(self._now)
            if entry != self._entry:
                self._entry, self._scheduled = entry, schedule.fused[entry]
            return self._scheduled
        if growing:
            return self._start
        heard = b"".join([covariance.tobytes() for covariance in self._covariances])
        if heard != self._heard:
            self._heard = heard
            self._latest = self._combined(self._plan.coefficients, np.array(self._covariances))
        return self._latest

    def _combined(self, coefficients: np.ndarray, covariances: np.ndarray) -> np.ndarray:
        fused = symmetrized(np.tensordot(coefficients, covariances, 1))
        return fused if self._plan.cap is None else capped(fused, self._plan.cap)

    def _incomplete(self, growing: bool) -> tuple[np.ndarray, np.ndarray]:
        """Reference and Pi_bar where neighbours are missing."""
        plan = self._plan
        try:
            recall = self._memory.recall(self._time)
        except DataError:
            return self._alone()
        reference = recall.weights @ recall.states
        if growing:
            return reference, self._start
        covariances = recall.covariances
        places = [self._place[member] for member in recall.members]
        if plan.schedule is not None:
            aged = recall.ages[:, None, None] * self._model.process_covariance
            covariances = plan.schedule.local_at(self._now)[places] + aged
        assert covariances is not None
        share = plan.weights[places].sum()
        coefficients = plan.coefficients[places] / share**plan.power if share > 0 else recall.weights
        return reference, self._combined(coefficients, covariances)

    def _alone(self) -> tuple[np.ndarray, np.ndarray]:
        """The prior of instant 0 propagated to the first instant of the window, where nothing was ever heard."""
        model = self._model
        reference, covariance = model.prior()
        for _ in range(self._now - self._horizon):
            reference = model.A @ reference
            covariance = model.A @ covariance @ model.A.T + model.process_covariance
            if self._plan.cap is not None:
                covariance = capped(covariance, self._plan.cap)
        return reference, symmetrized(covariance)

    # Local problem

    def _solve(self) -> tuple[Status, tuple[str, ...], Solution]:
        before = self._states
        data, self._data = self._data, {"y": self._flat} if self._model.measurement_size else {}
        solution = self._session.solve(data)
        status = solution.status
        if usable(solution):
            self._states = solution["x"]
            return status, (), solution
        self._states = predicted(self._model, before, self._u, self._newest, self._slid)
        if status is not Status.INFEASIBLE:
            return Status.FAILED if status in STOPPED else status, (), solution
        self._states, unmet = self._fallback(data_of(self._session), self._states, self._newest)
        return status, tuple(unmet), solution


def _settled(before: np.ndarray, after: np.ndarray) -> bool:
    return bool(np.abs(after - before).max() <= SETTLED_TOLERANCE * np.abs(after).max())


def schemas(measurements: int, states: int, online: bool) -> tuple[Schema, Schema]:
    """What a node says before it has an estimate, and afterwards."""
    reading: dict[str, Any] = {"y": (measurements,)}
    full = reading | {"state": (states,)}
    if online:
        full["covariance"] = Field((states, states), symmetric=True)
    return Schema("reading", reading), Schema("reading and estimate", full)
