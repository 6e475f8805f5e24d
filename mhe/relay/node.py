"""`RelayNode`: one node of DMHE_pre^l, DMHE_pre^1 or DMHE_B behind its inbox.

Source: dmhe-l-step, Algorithm 2, errata 1, 5, 7, 8; missing neighbours by the rule of design 3.4.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from mhe.distributed.fallback import STOPPED, data_of, predicted, usable
from mhe.estimate import WindowEstimate
from mhe.node import OneMessageNode, own_reading
from mhe.relay.buffer import RELAYED, RelayBuffer
from mhe.relay.fusion import Fusion
from mhe.relay.plan import RelayPlan
from mhe.relay.windows import Relaxation, RelayWindows
from problems.errors import TopologyError
from problems.runtime import Field, Message, Outgoing, Schema
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution


class RelayEstimate(WindowEstimate):
    """A `WindowEstimate` of a node with relayed measurements; it has no covariance.

    Attributes:
        held: (length, p) bool, components of the regional measurement that were used, slot by slot.
        factorized: the matrices of the local problem changed in this step, so it was factorized anew.
    """

    held: np.ndarray
    factorized: bool


class RelayNode(OneMessageNode):
    """Estimates the state from measurements relayed over l hops and the fused arrival costs of its in-neighbours.

    One message per step goes to all out-neighbours: the measurement y_t, the entries sent on (source, instant, hops,
    numbers), the prediction xtilde, and the arrival weight P until it has settled, unless weights were worked out
    before the run. `finish` returns a `RelayEstimate`. A node that (re)starts later than instant 0 has nothing but its
    plan: it treats earlier measurements as missing, earlier inputs as zero, and takes its prior from the neighbours it
    hears.

    Args:
        plan: what the node is told before the run.
        windows: where its window is compiled.
    """

    def __init__(self, plan: RelayPlan, windows: RelayWindows | None = None) -> None:
        self._plan, model = plan, plan.model
        self._windows = RelayWindows() if windows is None else windows
        self._window, compiled = self._windows.get(plan)
        self._session: Session = compiled.fork()
        self._relax = Relaxation(self._windows, plan)
        names = zip(self._window.model.sensors, model.sensors, strict=True)
        self._names = {f"residual {a.name} bounds": f"residual {b.name} bounds" for a, b in names}
        self._horizon = plan.options.horizon
        self._buffer = RelayBuffer(plan)
        self._flat = self._buffer.values.reshape(-1, 1)
        self._fusion = Fusion(plan, self._propagate)
        self._own = plan.members.index(plan.index)
        self._schemas = {
            member: schemas(size, model.state_size)
            for member, size in zip(plan.members, plan.member_sizes, strict=True)
        }
        self._inputs: dict[int, np.ndarray] = {}
        self._states = np.tile(plan.mean, (self._horizon + 1, 1))
        self._now = -1
        self._published: np.ndarray | None = None
        self._passed: dict[str, Any] = {}
        self._pattern = b""

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
        y, u = own_reading(
            measurement, len(self._plan.own_output), self._plan.model.input_size, instant, self._plan.label
        )
        self._slid = instant > self._horizon and self._now >= 0
        self._now, self._time = instant, float(time)
        if u is not None:
            self._inputs[instant] = u
            self._inputs.pop(instant - self._horizon - self._fusion.forget_after - 1, None)
        self._buffer.advance(instant)
        self._buffer.measure(y)
        reading, full, weighted = self._schemas[self._plan.index]
        if self._published is None:
            return (reading.message(y=y),)
        self._fusion.receive(self._plan.index, self._time, self._published)
        said = {"y": y, "prediction": self._published, **self._buffer.outgoing()}
        weight = self._fusion.own_weight(instant)
        return (full.message(**said) if weight is None else weighted.message(**said, weight=weight),)

    def finish(self, inbox: list[Message]) -> RelayEstimate:
        """Hear the neighbours, solve the local problem and predict.

        Raises:
            TopologyError: a message from a node that is no in-neighbour, or of a source further away than l.
            DataError: a message of another definition.
        """
        started = perf_counter()
        late, too_late = self._hear(inbox)
        newest, held = self._buffer.newest, self._buffer.held
        status, infeasible, factorized, solution = Status.SOLVED, (), False, None
        if self._now:
            status, infeasible, factorized, solution = self._solve()
        self._published = self._predict()
        return RelayEstimate(
            {
                "state": self._states[newest].copy(),
                "window": self._states[: newest + 1].copy(),
                "status": status,
                "seconds": perf_counter() - started,
                "infeasible": infeasible,
                "missing": tuple(np.flatnonzero(self._plan.held[-1] & ~held[-1]).tolist()),
                "late": late,
                "too_late": too_late,
                "time": self._time,
                "state_names": self._plan.model.state_names,
                "solution": solution,
                "held": held,
                "factorized": factorized,
            }
        )

    # Measurements and messages

    def _hear(self, inbox: Sequence[Message]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Take over what was received; times of the neighbours' measurements that came late, and too late."""
        late: list[float] = []
        too_late: list[float] = []
        for message in inbox:
            if message.sender not in self._schemas:
                raise TopologyError(
                    f"node {self._plan.label} heard node {message.sender}, which is no in-neighbour; the graph is "
                    "fixed for a run, make a new design for another one"
                )
            values = self._unpacked(message)
            instant = round(message.time / self._plan.period)
            full = "prediction" in values
            if self._buffer.receive(message.sender, instant, values["y"], values if full else None):
                late += [message.time] if instant < self._now else []
            elif instant < self._now - self._horizon and not np.isnan(values["y"]).all():
                too_late.append(message.time)
            if full:
                self._fusion.receive(message.sender, message.time, values["prediction"], values.get("weight"))
            elif instant:
                self._fusion.repeat()  # it has just started and knows no weights
        return tuple(late), tuple(too_late)

    def _unpacked(self, message: Message) -> dict[str, np.ndarray]:
        known = self._schemas[message.sender]
        return next((s for s in known if s.id == message.schema), known[0]).unpack(message)

    # The local problem

    def _input(self, instant: int) -> np.ndarray:
        return self._inputs.get(instant, np.zeros(self._plan.model.input_size))

    def _propagate(self, state: np.ndarray, age: int) -> np.ndarray:
        """A neighbour's prediction of `age` steps ago, brought to the first instant of the present window."""
        model, first = self._plan.model, max(0, self._now - self._horizon)
        for instant in range(max(0, self._now - age - self._horizon) + 1, first + 1):
            state = model.A @ state + model.B @ self._input(instant)
        return state

    def _predict(self) -> np.ndarray:
        """xtilde for the next step (3.9), or what the start-up and Omega options make of it."""
        plan, options = self._plan, self._plan.options
        if self._now < self._horizon:
            return plan.mean if options.startup == "literal" or not self._now else self._states[0].copy()
        if options.omega == "hessian":
            return self._states[1].copy()
        first, model = self._states[0], plan.model
        predicted = model.A @ first + model.B @ self._input(self._now - self._horizon + 1)
        if plan.index in plan.sources:
            y = self._buffer.values[0, plan.source_rows[plan.sources.index(plan.index)]]
            predicted = predicted + plan.own_gain @ np.nan_to_num(y - plan.own_output @ first)
        return predicted

    def _solve(self) -> tuple[Status, tuple[str, ...], bool, Solution]:
        plan, newest = self._plan, self._buffer.newest
        reference, information, linear = self._fusion.arrival(self._now)
        data: dict[str, Any] = {"reference": reference[None], "linear": linear[None]}
        if plan.model.measurement_size:
            data["y"] = self._flat
        if plan.model.input_size:
            data["u"] = np.array([self._input(self._now - newest + slot) for slot in range(self._horizon + 1)])
        changed = {"information": information}
        if self._passed.get("phase") != newest:
            self._passed["phase"] = newest
            if plan.options.disturbance == "observer" and plan.model.measurement_size:
                changed["gain"] = plan.gain_at(newest)
            if plan.state_bounds is not None:
                changed["filled"] = (np.arange(self._horizon + 1) <= newest).astype(float)
        elif information is self._passed["information"]:
            changed = {}
        self._passed["information"] = information
        pattern = np.isnan(self._flat).tobytes()
        factorized, self._pattern = bool(changed) or pattern != self._pattern, pattern
        before = self._states
        solution = self._session.solve(data | changed)
        status = solution.status
        if usable(solution):
            self._states = solution["x"]
            return status, (), factorized, solution
        inputs = np.array([self._input(self._now - newest + slot) for slot in range(self._horizon + 1)])
        self._states = predicted(plan.model, before, inputs, newest, self._slid)
        if status is not Status.INFEASIBLE:
            return Status.FAILED if status in STOPPED else status, (), factorized, solution
        if plan.options.bounds == "soft":
            relaxed = self._relax(data_of(self._session), newest)
            if relaxed is not None:
                self._states, unmet = relaxed
                return Status.SOLVED, self._named(unmet), factorized, solution
        return status, self._named(f"{name} bounds" for name in self._window.bounds), factorized, solution

    def _named(self, bounds: Iterable[str]) -> tuple[str, ...]:
        """Names of bounds with this node's sensors; its window may have been compiled for another one."""
        return tuple(self._names.get(name, name) for name in bounds)


def schemas(measurements: int, states: int) -> tuple[Schema, Schema, Schema]:
    """What a node says: before it has an estimate, afterwards, and with its arrival weight."""
    reading: dict[str, Any] = {"y": (measurements,)}
    full = {**reading, **RELAYED, "prediction": (states,)}
    weighted = {**full, "weight": Field((states, states), symmetric=True)}
    return Schema("reading", reading), Schema("reading and prediction", full), Schema("with weight", weighted)
