"""The rule for neighbours that were not heard: propagate, inflate, renormalise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from problems.errors import DataError, ShapeError


@dataclass(frozen=True)
class Recall:
    """What a node knows of its in-neighbourhood at one instant.

    Attributes:
        members: indices of the neighbours that take part, ascending as given.
        weights: (m,) consensus weights over them, summing to 1.
        states: (m, n) their estimates, brought to the present.
        covariances: (m, n, n) their covariances, inflated; None if none were ever received.
        ages: (m,) steps since each was heard, 0 for those heard now.
        absent: neighbours left out: never heard or forgotten.
    """

    members: tuple[int, ...]
    weights: np.ndarray
    states: np.ndarray
    covariances: np.ndarray | None
    ages: np.ndarray
    absent: tuple[int, ...]


class NeighborMemory:
    """Newest estimate of every neighbour, and what to use for those that are missing.

    The last estimate of a missing neighbour is propagated by `propagate`, its covariance grows by `disturbance` per
    step of age, and weights are renormalised over the neighbours that are known. Messages that arrive late, twice or
    out of order do no harm: the newest time wins.

    Source: design 3.4; dmhe-sporadic-fov section 10 (late neighbour messages).

    Args:
        members: the in-neighbourhood, the node itself included.
        weights: consensus weights aligned with `members`.
        propagate: ``(state, steps) -> state``, the estimate `steps` steps later.
        disturbance: (n, n) covariance Q added per step of age.
        period: time between steps.
        forget_after: neighbours not heard for more steps than this are left out; never if None.

    Raises:
        ShapeError: weights and members differ in number.
        DataError: a negative weight or a period that is not positive.
    """

    def __init__(
        self,
        members: Sequence[int],
        weights: ArrayLike,
        propagate: Callable[[np.ndarray, int], np.ndarray],
        disturbance: ArrayLike,
        *,
        period: float = 1.0,
        forget_after: int | None = None,
    ) -> None:
        self.members = tuple(int(member) for member in members)
        values = np.asarray(weights, dtype=float)
        if values.shape != (len(self.members),):
            raise ShapeError(f"expected one weight for each of {len(self.members)} neighbours, got {values.shape}")
        if not (values >= 0).all() or not period > 0:
            raise DataError("weights must be nonnegative and the period positive")
        self._weights = dict(zip(self.members, values.tolist(), strict=True))
        self._propagate, self._disturbance = propagate, np.asarray(disturbance, dtype=float)
        self._period, self._forget_after = period, forget_after
        self._known: dict[int, tuple[float, np.ndarray, np.ndarray | None]] = {}

    def receive(self, sender: int, time: float, state: np.ndarray, covariance: np.ndarray | None = None) -> bool:
        """Keep an estimate that `sender` made at `time`, unless a newer one is known.

        Returns:
            Whether it was kept.

        Raises:
            DataError: the sender is not in the neighbourhood.
        """
        if sender not in self._weights:
            raise DataError(f"node {sender} is not among the neighbours {self.members}")
        known = self._known.get(sender)
        if known is not None and known[0] >= time:
            return False
        self._known[sender] = time, state, covariance
        return True

    def recall(self, time: float) -> Recall:
        """Estimates of all known neighbours at `time`, with renormalised weights.

        Where the known neighbours have weight 0 together, they count equally.

        Raises:
            DataError: no neighbour is known, or one has a covariance and another has not.
        """
        present: list[int] = []
        ages: list[int] = []
        for member in self.members:
            if member in self._known:
                age = max(0, round((time - self._known[member][0]) / self._period))
                if self._forget_after is None or age <= self._forget_after:
                    present.append(member)
                    ages.append(age)
        if not present:
            raise DataError(f"nothing was heard from any of the neighbours {self.members}; receive at least one's own")
        states = [
            self._known[m][1] if not age else self._propagate(self._known[m][1], age)
            for m, age in zip(present, ages, strict=True)
        ]
        weights = np.array([self._weights[member] for member in present])
        total = weights.sum()
        return Recall(
            members=tuple(present),
            weights=weights / total if total > 0 else np.full(len(present), 1.0 / len(present)),
            states=np.array(states),
            covariances=self._inflated(present, ages),
            ages=np.array(ages),
            absent=tuple(member for member in self.members if member not in present),
        )

    def _inflated(self, present: list[int], ages: list[int]) -> np.ndarray | None:
        covariances = [self._known[member][2] for member in present]
        if all(covariance is None for covariance in covariances):
            return None
        inflated = []
        for member, covariance, age in zip(present, covariances, ages, strict=True):
            if covariance is None:
                raise DataError(f"node {member} sent no covariance while other neighbours did")
            inflated.append(covariance + age * self._disturbance if age else covariance)
        return np.array(inflated)
