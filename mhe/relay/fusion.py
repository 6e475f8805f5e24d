"""`Fusion`: the arrival cost of a node, fused from the predictions of its in-neighbours.

Source: dmhe-l-step (3.10)-(3.16), start-up option; missing neighbours by the rule of design 3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mhe.covariance import symmetrized
from mhe.relay.plan import RelayPlan
from mhe.relay.schedule import SETTLED, arrival_weight
from problems.errors import DataError
from problems.runtime import NeighborMemory


class Fusion:
    """Predictions and weights heard, and the cost ``1/2 d'Xi d + linear'd``, d = x - reference, made of them.

    The cost equals ``1/2 sum pi^ij ||x - xtilde^j||^2_{P^j}`` up to a constant, (3.10) and (3.14). The reference is the
    node's own prediction, so that the linear part is made of differences and no matrix is inverted.

    Args:
        plan: of the node.
        propagate: ``(prediction, age)``, a neighbour's prediction of `age` steps ago brought to the present.

    Attributes:
        forget_after: steps after which a neighbour not heard is left out.
    """

    def __init__(self, plan: RelayPlan, propagate: Callable[[np.ndarray, int], np.ndarray]) -> None:
        self._plan, options = plan, plan.options
        self.forget_after = options.horizon if options.forget_after is None else options.forget_after
        Q = plan.model.process_covariance
        self._memory = NeighborMemory(
            plan.members, plan.weights, propagate, Q, period=plan.period, forget_after=self.forget_after
        )
        self._own = plan.members.index(plan.index)
        self._place = {member: place for place, member in enumerate(plan.members)}
        self._heard: dict[int, np.ndarray] = {}
        self._weights: list[Any] = [None] * len(plan.members)  # P^j as exchanged
        self._now = 0.0
        self._entry = -1
        self._scaled = plan.weights[:, None, None] * plan.prior
        self._fused = plan.prior
        self._made_from: np.ndarray | None = None  # the Xi that the own weight was computed from
        self._sent: np.ndarray | None = None

    def receive(self, member: int, time: float, prediction: np.ndarray, weight: np.ndarray | None = None) -> None:
        """Take a prediction that a member made for the step at `time`."""
        self._memory.receive(member, time, prediction)
        if weight is not None:
            self._weights[self._place[member]] = weight
        if time != self._now:
            if time < self._now:
                return
            self._now, self._heard = time, {}
        self._heard[member] = prediction

    def repeat(self) -> None:
        """Send the own weight again in the next step."""
        self._sent = None

    def own_weight(self, instant: int) -> np.ndarray | None:
        """P^i for the step at `instant` if the neighbours have to be told, else None."""
        plan, options = self._plan, self._plan.options
        if plan.local is not None:
            return None
        before = self._weights[self._own]
        if instant == 1 or (instant <= options.horizon and options.startup == "literal"):
            weight = plan.prior
        elif before is not None and instant > options.horizon + 1 and self._fused is self._made_from:
            weight = before
        else:
            factor = options.alpha / options.arrival_divisor
            if instant <= options.horizon:
                weight = arrival_weight(self._fused + plan.data[instant - 1], None, plan.inverse_S, factor)
            else:
                weight = arrival_weight(self._fused + plan.omega, plan.prediction, plan.inverse_S, factor)
        self._made_from = self._fused
        if before is not None and _settled(before, weight):
            weight = before
        self._weights[self._own] = weight
        if weight is self._sent:
            return None
        self._sent = weight
        return weight

    def arrival(self, instant: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reference (n,), Xi (n, n) and linear part (n,); Xi stays the same object while it does not change."""
        plan = self._plan
        unknown = plan.local is None and any(weight is None for weight in self._weights)
        if unknown or len(self._heard) < len(plan.members):
            return self._incomplete(instant)
        predictions = np.array([self._heard[member] for member in plan.members])
        own = predictions[self._own]
        if plan.local is not None and plan.fused is not None:
            entry = min(instant, len(plan.fused) - 1)
            if entry != self._entry:
                self._entry, self._fused = entry, plan.fused[entry]
                self._scaled = plan.weights[:, None, None] * plan.local[entry]
        else:
            self._combine(plan.weights, np.array(self._weights))
        return own, self._fused, -np.einsum("jab,jb->a", self._scaled, predictions - own)

    def _combine(self, weights: np.ndarray, informations: np.ndarray) -> None:
        self._scaled = weights[:, None, None] * informations
        fused = symmetrized(self._scaled.sum(axis=0))
        if not _settled(self._fused, fused):
            self._fused = fused

    def _incomplete(self, instant: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where neighbours are missing: their last predictions, inflated, with weights renormalised."""
        plan, model = self._plan, self._plan.model
        time = instant * plan.period
        try:
            recall = self._memory.recall(time)
        except DataError:
            return self._alone(instant)
        informations, keep = [], []
        for k, (member, age) in enumerate(zip(recall.members, recall.ages.tolist(), strict=True)):
            place = self._place[member]
            known = self._weights[place]
            if plan.local is not None:
                known = plan.local[min(max(0, instant - age), len(plan.local) - 1)][place]
            if known is None:
                continue
            moved = max(0, instant - plan.options.horizon) - max(0, instant - age - plan.options.horizon)
            if moved:
                known = np.linalg.inv(np.linalg.inv(known) + moved * model.process_covariance)
            keep.append(k)
            informations.append(known)
        if not keep:
            return self._alone(instant)
        weights = recall.weights[keep]
        self._entry = -1
        self._combine(weights / weights.sum(), np.array(informations))
        states = recall.states[keep]
        return states[0], self._fused, -np.einsum("jab,jb->a", self._scaled, states - states[0])

    def _alone(self, instant: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The prior of instant 0 propagated to the first instant of the window, where nothing was ever heard."""
        model, mean, covariance = self._plan.model, self._plan.mean, np.linalg.inv(self._plan.prior)
        for _ in range(instant - self._plan.options.horizon):
            mean = model.A @ mean
            covariance = model.A @ covariance @ model.A.T + model.process_covariance
        self._entry, self._fused = -1, symmetrized(np.linalg.inv(covariance))
        return mean, self._fused, np.zeros_like(mean)


def _settled(before: np.ndarray, after: np.ndarray) -> bool:
    return bool(np.abs(after - before).max() <= SETTLED * np.abs(after).max())
