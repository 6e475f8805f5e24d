"""`SporadicNode`: one node of DMHE, DMHE^S, DMHE_F or DMHE_F^S with detections, behind its inbox.

Source: dmhe-sporadic-fov 4 (Algorithm 3, repaired) and section 10; missing neighbours by the rule of design 3.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from mhe.arrival import inverse
from mhe.covariance import capped, conditioned, detection_update, symmetrized
from mhe.sporadic.estimate import DetectionEstimate
from mhe.sporadic.local import LocalProblem
from mhe.sporadic.numbers import RegionNumbers
from mhe.sporadic.plan import SporadicPlan
from mhe.sporadic.pool import DetectionPool
from mhe.sporadic.ranks import WindowRank
from mhe.sporadic.readings import Reading, Sensors, Slots
from mhe.sporadic.rows import Projection
from problems.errors import DataError
from problems.networks.weights import normalize_rows
from problems.runtime import Message, NeighborMemory, Outgoing, Schema
from problems.runtime.message import Field
from problems.solvers.base import Status

RANK = Schema("observability rank", {"rank": ()})


class SporadicNode:
    """Estimates the states of all vehicles from the detections of its neighbourhood and its neighbours' estimates.

    A step has one message with readings, flags, the state of instant max(0, t - N) and its arrival covariance, and with
    rank weights a second round with the rank. `finish` returns a `DetectionEstimate`. A node that (re)starts later than
    instant 0 has nothing but its plan: earlier readings count as not detected, the prior comes from the neighbours.

    Args:
        plan: what the node is told before the run.
        pool: where its window is compiled.

    Attributes:
        rounds: 1 with rank weights, else 0.
    """

    def __init__(self, plan: SporadicPlan, pool: DetectionPool | None = None) -> None:
        self._plan, options = plan, plan.options
        self.rounds = 1 if options.weights == "rank" else 0
        self._horizon = options.horizon
        own = plan.member_sensors[plan.own]
        self._own = own
        self._place = {member: k for k, member in enumerate(plan.members)}
        self._sensors = {
            member: Sensors(plan.names[part], plan.sizes[part], plan.width)
            for member, part in zip(plan.members, plan.member_sensors, strict=True)
        }
        self._numbers = RegionNumbers(plan)
        self._local = LocalProblem(plan, DetectionPool() if pool is None else pool, self._numbers)
        self._projections = _projections(plan)
        V, m = plan.blocks.count, plan.blocks.size
        rows, columns = np.triu_indices(m)
        self._triangle = (np.arange(V)[:, None] * m + rows) * m + columns
        self._square = np.zeros((m, m), dtype=np.intp)
        self._square[rows, columns] = self._square[columns, rows] = np.arange(len(rows))
        self._schemas = {member: schemas(sensors, V * m, V * len(rows)) for member, sensors in self._sensors.items()}
        self._memory = NeighborMemory(
            plan.members,
            np.ones(len(plan.members)),
            self._propagate,
            plan.disturbance,
            period=plan.period,
            forget_after=options.forget_after,
        )
        self._rank = WindowRank(plan.transition, plan.parts, plan.outputs) if self.rounds else None
        self._ranks: dict[int, tuple[float, float]] = {}
        self._slots = Slots(self._horizon, len(plan.names), plan.width)
        self._states = np.tile(plan.mean, (self._horizon + 1, 1, 1))
        self._reference, self._fused = plan.mean, plan.start
        self._published: np.ndarray | None = None
        self._unseen = np.zeros(V, dtype=int)

    # What a step consists of

    def measure(self, time: float, measurement: Any) -> tuple[Outgoing, ...]:
        """Take what the node's sensors deliver and speak.

        Args:
            time: t times the period.
            measurement: a `Reading`, or its values alone; None where nothing was detected.

        Raises:
            ShapeError, DataError: see `Sensors.read`.
        """
        plan = self._plan
        given = measurement if isinstance(measurement, Reading) else Reading(measurement)
        instant = round(time / plan.period)
        what = f"node {plan.label}, time step {instant}"
        values, flags = self._sensors[plan.index].read(given.values, given.flags, what)
        late = [
            (round(then / plan.period), *self._sensors[plan.index].read(y, mask, f"{what}, late reading"))
            for then, y, mask in given.late
        ]
        self._slots.advance(instant)
        self._time, self._too_late, self._late = float(time), 0, []
        self._fresh: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._detected, self._outside = flags, self._distance(values, flags)
        self._enter(plan.index, instant, values, flags)
        said = []
        state, covariance = self._to_publish()
        reading, full = self._schemas[plan.index]
        y, alpha = self._sensors[plan.index].flat(values), flags.astype(np.uint8)
        if state is None or covariance is None:
            said.append(reading.message(instant=instant, flags=alpha, y=y))
        else:
            self._take(plan.index, self._time, state, covariance)
            packed = covariance.ravel()[self._triangle].ravel()
            said.append(full.message(instant=instant, flags=alpha, y=y, state=state.ravel(), covariance=packed))
        for then, y_then, mask in late:
            self._enter(plan.index, then, y_then, mask)
            numbers = self._sensors[plan.index].flat(y_then)
            said.append(reading.message(instant=then, flags=mask.astype(np.uint8), y=numbers))
        return tuple(said)

    def exchange(self, index: int, inbox: list[Message]) -> tuple[Outgoing, ...]:
        """Hear the readings and tell the rank of what the neighbourhood detected."""
        self._hear(inbox)
        assert self._rank is not None
        # the N instants t-N+1..t; while the window fills there are fewer, and instant 0 is one of them
        start = 1 if self._slots.newest < self._horizon else 2
        rank = self._rank(self._slots.flags[start:])
        self._ranks[self._plan.index] = self._time, float(rank)
        return (RANK.message(rank=rank),)

    def finish(self, inbox: list[Message]) -> DetectionEstimate:
        """Hear the rest, solve the local problem and report.

        Raises:
            DataError: a message from a stranger or of another definition.
        """
        started = perf_counter()
        self._hear(inbox)
        slots, plan = self._slots, self._plan
        newest, status, unmet, weights = slots.newest, Status.SOLVED, (), None
        if slots.instant == 0:
            self._published = plan.mean
        else:
            weights = self._arrival()
            information = inverse(self._fused)
            self._states, status, unmet = self._local.solve(slots, self._reference, information, self._predicted)
            self._published = self._states[1 if newest == self._horizon else 0].copy()
        self._count_unseen()
        rank = self._ranks.get(plan.index)
        together = plan.blocks.together
        return DetectionEstimate(
            state=together(self._states[newest]),
            covariance=None,
            window=together(self._states[: newest + 1]),
            status=status,
            seconds=perf_counter() - started,
            infeasible=unmet,
            missing=tuple(np.flatnonzero(self._detected == 0).tolist()),
            late=tuple(self._late),
            time=self._time,
            state_names=plan.state_names,
            detected=self._detected,
            rank=None if rank is None else int(rank[1]),
            weights=weights,
            arrival_covariance=self._fused,
            unseen=self._unseen.copy(),
            outside=self._outside,
            too_late=self._too_late,
        )

    # Readings and messages

    def _enter(self, member: int, instant: int, values: np.ndarray, flags: np.ndarray) -> None:
        sensors = self._plan.member_sensors[self._place[member]]
        fed = values if self._projections is None else self._projected(sensors, values, flags)
        if not self._slots.enter(instant, sensors, values, fed, flags):
            self._too_late += int(flags.sum())
        elif instant < self._slots.instant:
            self._late.append(instant * self._plan.period)

    def _projected(self, sensors: slice, values: np.ndarray, flags: np.ndarray) -> np.ndarray:
        assert self._projections is not None
        fed = values.copy()
        for place in np.flatnonzero(flags):
            sensor = sensors.start + int(place)
            project = self._projections[sensor]
            if project is not None:
                size = self._plan.sizes[sensor]
                fed[place, :size] = project(values[place, :size])
        return fed

    def _distance(self, values: np.ndarray, flags: np.ndarray) -> np.ndarray:
        out, plan = np.zeros(len(flags)), self._plan
        for place in flags.nonzero()[0]:
            sensor = self._own.start + int(place)
            polyhedron = plan.sets[sensor]
            if polyhedron is not None:
                out[place] = polyhedron.violation(values[place, : plan.sizes[sensor]])
        return out

    def _hear(self, inbox: Sequence[Message]) -> None:
        for message in inbox:
            sender = message.sender
            if sender not in self._place:
                raise DataError(f"node {self._plan.label} heard node {sender}, which is no in-neighbour")
            if message.schema == RANK.id:
                known = self._ranks.get(sender)
                if known is None or known[0] < message.time:
                    self._ranks[sender] = message.time, float(RANK.unpack(message)["rank"])
                continue
            reading, full = self._schemas[sender]
            complete = message.schema == full.id
            values = (full if complete else reading).unpack(message)
            flags = values["flags"].astype(float)
            self._enter(sender, int(values["instant"]), self._sensors[sender].filled(values["y"]), flags)
            if complete:
                shape = self._plan.transition.shape
                state = values["state"].reshape(shape[:2])
                covariance = values["covariance"].reshape(shape[0], -1)[:, self._square]
                self._take(sender, message.time, state, covariance)

    def _take(self, member: int, time: float, state: np.ndarray, covariance: np.ndarray) -> None:
        """Keep what a member published."""
        self._memory.receive(member, time, state, covariance)
        if time == self._time:
            self._fresh[member] = state, covariance

    def _propagate(self, state: np.ndarray, age: int) -> np.ndarray:
        """A neighbour's published state of `age` steps ago, brought to the first instant of the present window."""
        now, N = self._slots.instant, self._horizon
        for _ in range(max(0, now - N) - max(0, now - age - N)):
            state = self._moved_on(state)
        return state

    def _moved_on(self, state: np.ndarray) -> np.ndarray:
        return _applied(self._plan.transition, state)

    # Arrival cost

    def _to_publish(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """State of the first instant of the window and Pi^i, as found before the readings of this step."""
        plan = self._plan
        if self._published is None:
            return None, None
        if self._slots.instant <= self._horizon:
            return (plan.mean if plan.options.prior == "filter" else self._published), plan.start
        informations = self._numbers.information(self._slots.flags[:-1])
        rule = plan.options.pi_update
        covariance = detection_update(self._fused, plan.transition, plan.disturbance, informations, rule)
        if plan.options.prior == "seed":
            return self._published, covariance
        # the filter's update of the arrival mean by the readings of the instant that left
        left = informations[0]
        innovation = -self._numbers.linear(self._slots.values[:1])[0] - _applied(left, self._reference)
        correction = _applied(conditioned(self._fused, left), innovation)
        return self._moved_on(self._reference + correction), covariance

    def _arrival(self) -> np.ndarray | None:
        """Set reference and covariance of the arrival cost; the weights used, where neighbours count."""
        plan, growing = self._plan, self._slots.instant <= self._horizon
        rule = plan.options.growth_prior
        if growing and rule != "consensus":
            own = plan.mean if self._published is None else self._published
            self._reference, self._fused = (own if rule == "own" else plan.mean), plan.start
            return None
        if len(self._fresh) == len(plan.members):
            states = np.array([self._fresh[member][0] for member in plan.members])
            covariances = np.array([self._fresh[member][1] for member in plan.members])
            weights = used = self._weights()
            factors = weights if plan.listeners is None else plan.listeners * weights**2
        else:
            try:
                recall = self._memory.recall(self._time)
            except DataError:
                self._alone()
                return None
            assert recall.covariances is not None
            states, covariances = recall.states, recall.covariances
            places = [self._place[member] for member in recall.members]
            # by neighbours left out, the others' weights grow (section 10)
            weights = normalize_rows(self._weights()[places], [0, len(places)])
            factors = weights if plan.listeners is None else plan.listeners[places] * weights**2
            used = np.zeros(len(plan.members))
            used[places] = weights
        shape = plan.transition.shape
        self._reference = (weights @ states.reshape(len(weights), -1)).reshape(shape[:2])
        if growing:
            self._fused = plan.start
            return used
        fused = symmetrized((factors @ covariances.reshape(len(factors), -1)).reshape(shape))
        self._fused = capped(fused, plan.options.covariance_cap)
        return used

    def _weights(self) -> np.ndarray:
        """Weights of all members, summing to 1 (4.13)."""
        plan = self._plan
        if plan.weights is not None:
            return plan.weights
        floor, ranks = plan.options.rank_floor, self._ranks
        scores = np.array([max(ranks[member][1], floor) if member in ranks else floor for member in plan.members])
        return scores / scores.sum()

    def _alone(self) -> None:
        """The prior of instant 0 propagated to the first instant of the window, where nothing was ever heard."""
        plan = self._plan
        reference, covariance, A = plan.mean, plan.start, plan.transition
        for _ in range(self._slots.first):
            reference = self._moved_on(reference)
            covariance = symmetrized(A @ covariance @ A.transpose(0, 2, 1) + plan.disturbance)
            covariance = capped(covariance, plan.options.covariance_cap)
        self._reference, self._fused = reference, covariance

    # Reports

    def _predicted(self) -> np.ndarray:
        """The window of the step before, moved on by the model."""
        states, newest = self._states, self._slots.newest
        if self._slots.first > 0:
            states = np.concatenate([states[1:], states[-1:]])
        else:
            states = states.copy()
        for k in range(newest, len(states)):
            states[k] = self._moved_on(states[k - 1])
        return states

    def _count_unseen(self) -> None:
        position = self._slots.newest + 1
        flags = self._slots.flags[position]
        self._unseen += 1
        self._unseen[self._plan.parts[flags > 0]] = 0


def _applied(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Matrices (parts, m, m) times vectors (parts, m)."""
    return (matrices @ vectors[..., None])[..., 0]


def _projections(plan: SporadicPlan) -> list[Projection | None] | None:
    """For every sensor that feeds the observer, what its readings are projected with."""
    if plan.options.rows != "projected" or plan.gains is None:
        return None
    return [
        None if polyhedron is None or gain is None else Projection(polyhedron)
        for polyhedron, gain in zip(plan.sets, plan.gains, strict=True)
    ]


def schemas(sensors: Sensors, states: int, covariances: int) -> tuple[Schema, Schema]:
    """A reading with its time stamp, alone and with the estimate of the sender.

    Args:
        sensors: of the sender.
        states: n.
        covariances: numbers of the upper triangles of the parts of Pi.
    """
    reading: dict[str, Any] = {
        "instant": Field((), "i8"),
        "flags": Field((sensors.count,), "u1"),
        "y": (sensors.size,),
    }
    full = reading | {"state": (states,), "covariance": (covariances,)}
    return Schema("sporadic reading", reading), Schema("sporadic reading and estimate", full)
