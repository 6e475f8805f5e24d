"""a-GL: every robot of a team descends the linear least-squares cost on its own, with what neighbours told it last.

Source: spec ``gps-range-bearing-localization`` section 4, B3, with errata B3 and B4.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from localization.consensus.slots import NeighborSlots
from localization.lattice import Measurements, linear_data, require_anchored
from problems.errors import ModelWarning, SettingError
from problems.networks import Network
from problems.runtime import Links, Message, Outgoing, Schema

SAFE_STEP = 0.5  # of 1/diag(H_i); with delays the full step can diverge (erratum B4)


@dataclass(frozen=True, eq=False)
class LocalCosts:
    """The least-squares cost of a team, split into what each robot knows of it.

    Gradient of robot i: ``hessian[i] p_i - constant[i] - sum_k coupling[i, k] m_i[k]``, with m_i[k] the position that
    the neighbour in slot k told last.

    Attributes:
        network: who measures whom, in both directions.
        start: (n, 2) first positions: GPS, or the mean of all fixes where a robot has none.
        hessian: (n + 1, 2, 2) H_i; `constant` (n + 1, 2); `coupling` (n + 1, width, 2, 2).
    """

    network: Network
    start: np.ndarray
    hessian: np.ndarray
    constant: np.ndarray
    coupling: np.ndarray

    @classmethod
    def of(cls, team: Measurements) -> LocalCosts:
        """Split the cost of a team.

        Raises:
            UnobservableError, DataError: as `require_anchored` and `linear_data`.
        """
        require_anchored(team)
        data, n = linear_data(team), team.robots
        used = ~np.isnan(data["displacements"]).any(axis=1)
        i, j, u = team.observer[used], team.target[used], data["displacements"][used]
        weight = np.linalg.inv(data["covariances"][used])
        network = Network(n, np.column_stack([i, j]), undirected=True)
        slots = NeighborSlots.of(network)
        there = slots.locate(i, j)
        back = slots.back[i, there]
        fixed = np.asarray(np.isfinite(team.gps).all(axis=1))
        sigma = np.broadcast_to(np.asarray(team.sigmas.position, dtype=float), team.gps.shape)
        information = np.where(fixed[:, None], 1 / sigma**2, 0.0)
        fixes = np.where(fixed[:, None], team.gps, 0.0)
        coupling = np.zeros((*slots.neighbor.shape, 2, 2))
        np.add.at(coupling, (i, there), weight)
        np.add.at(coupling, (j, back), weight)
        hessian, constant = coupling.sum(axis=1), np.zeros((n + 1, 2))
        hessian[:n, [0, 1], [0, 1]] += information
        constant[:n] = information * fixes
        moved = np.einsum("eab,eb->ea", weight, u)
        np.add.at(constant, i, -moved)
        np.add.at(constant, j, moved)
        start = np.where(fixed[:, None], team.gps, team.gps[fixed].mean(axis=0))
        return cls(network, start, hessian, constant, coupling)

    @cached_property
    def slots(self) -> NeighborSlots:
        """Neighbours in tables."""
        return NeighborSlots.of(self.network)

    def steps(self, step: float) -> np.ndarray:
        """(n + 1, 2) step per axis: `step` over the diagonal of H_i.

        Raises:
            SettingError: not in (0, 1].
        """
        if not 0 < step <= 1:
            raise SettingError(f"the step of agl lies in (0, 1] of 1/diag(H_i), got {step:g}; {SAFE_STEP} is safe")
        diagonal = np.diagonal(self.hessian, axis1=1, axis2=2)
        return step / np.where(diagonal > 0, diagonal, 1.0)


class GradientArrays:
    """a-GL on arrays: robots that are no neighbours of one another act in one call.

    Args:
        costs: of the team.
        step: fraction of 1/diag(H_i).
    """

    def __init__(self, costs: LocalCosts, step: float = SAFE_STEP) -> None:
        self._costs, self._slots = costs, costs.slots
        self._alpha = costs.steps(step)
        self.x = np.vstack([costs.start, np.zeros((1, 2))])
        self.memory = self.x[self._slots.neighbor]

    def step(self, robots: np.ndarray, heard: np.ndarray | None = None) -> None:
        """Wake `robots` (w,); `heard` (w, width) says which neighbours receive them, by default all."""
        costs, p = self._costs, self.x[robots]
        gradient = np.einsum("wab,wb->wa", costs.hessian[robots], p) - costs.constant[robots]
        gradient -= np.einsum("wkab,wkb->wa", costs.coupling[robots], self.memory[robots])
        self.x[robots] = p = p - self._alpha[robots] * gradient
        receivers = self._slots.neighbor[robots]
        if heard is not None:
            receivers = np.where(heard, receivers, self._slots.count)
        self.memory[receivers, self._slots.back[robots]] = p[:, None]


def wake(arrays: GradientArrays, costs: LocalCosts, robots: np.ndarray, heard: np.ndarray | None = None) -> None:
    """Wake robots one after the other, (w,) with `heard` (w, width) as for `GradientArrays.step`.

    Wake-ups that do not see each other are made at once; the outcome is that of the order given.
    """
    order, sizes = independent_groups(costs.slots, robots)
    ends = np.cumsum(sizes)
    for begin, end in zip(ends - sizes, ends, strict=True):
        chosen = order[begin:end]
        arrays.step(robots[chosen], None if heard is None else heard[chosen])


def independent_groups(slots: NeighborSlots, robots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order a sequence of wake-ups into groups without neighbours that give what the sequence gives.

    Args:
        robots: (w,) in the order of waking.

    Returns:
        Places in the sequence (w,), group by group, and the sizes of the groups.
    """
    around = [
        [i, *row[:degree]]
        for i, (row, degree) in enumerate(zip(slots.neighbor.tolist(), slots.degree.tolist(), strict=True))
    ]
    last = [0] * len(around)
    level = []
    for robot in robots.tolist():
        depth = 1 + max([last[j] for j in around[robot]])
        last[robot] = depth
        level.append(depth)
    levels = np.array(level, dtype=np.int64)
    return np.argsort(levels, kind="stable"), np.bincount(levels)[1:]


class GradientNode:
    """One robot: wakes, takes a gradient step and broadcasts; hears neighbours and remembers.

    Args:
        start: (2,) its first position.
        memory: (2,) first position of every neighbour.
        coupling: (2, 2) weight of every neighbour.
        hessian, constant: (2, 2) and (2,), see `LocalCosts`.
        alpha: (2,) step.
    """

    def __init__(
        self,
        start: np.ndarray,
        memory: dict[int, np.ndarray],
        coupling: dict[int, np.ndarray],
        hessian: np.ndarray,
        constant: np.ndarray,
        alpha: np.ndarray,
    ) -> None:
        self.p = start.copy()
        self._memory, self._coupling = dict(memory), coupling
        self._hessian, self._constant, self._alpha = hessian, constant, alpha
        self._age: dict[int, tuple[float, int, int]] = {}

    def on_wake(self, time: float, measurement: Any) -> list[Outgoing]:
        """Step and broadcast."""
        del time, measurement
        gradient = self._hessian @ self.p - self._constant
        for j, weight in self._coupling.items():
            gradient = gradient - weight @ self._memory[j]
        self.p = self.p - self._alpha * gradient
        return [POSITION.message(p=self.p)]

    def on_message(self, time: float, message: Message) -> list[Outgoing]:
        """Remember, unless something newer is known."""
        del time
        if message.age_key >= self._age.get(message.sender, message.age_key):
            self._age[message.sender] = message.age_key
            self._memory[message.sender] = POSITION.unpack(message)["p"]
        return []

    def output(self) -> np.ndarray:
        """Position (2,)."""
        return self.p


POSITION = Schema("position", {"p": (2,)})


class GradientNodes:
    """Node factory of a-GL for `EventSimulation`.

    Args:
        costs: of the team; each node gets its own part.
        step: fraction of 1/diag(H_i).
        links: those the nodes will run on; with delays a step above `SAFE_STEP` brings a `ModelWarning`.
    """

    def __init__(self, costs: LocalCosts, step: float = SAFE_STEP, links: Links | None = None) -> None:
        self._costs, self._alpha = costs, costs.steps(step)
        if links is not None and step > SAFE_STEP and (callable(links.delay) or np.any(np.asarray(links.delay) != 0)):
            warnings.warn(
                f"agl with step {step:g} on links with delays can diverge; {SAFE_STEP} is the safe step",
                ModelWarning,
                stacklevel=2,
            )

    def __call__(self, node: int) -> GradientNode:
        costs = self._costs
        neighbors = costs.slots.neighbor[node, : costs.slots.degree[node]].tolist()
        memory = {j: costs.start[j] for j in neighbors}
        coupling = dict(zip(neighbors, costs.coupling[node], strict=False))
        return GradientNode(
            costs.start[node], memory, coupling, costs.hessian[node], costs.constant[node], self._alpha[node]
        )


def unite(parts: list[LocalCosts]) -> LocalCosts:
    """Several teams side by side as one, robots in the order of the parts."""
    first = np.cumsum([0, *(part.network.count for part in parts)])
    edges = np.concatenate([part.network.edges + k for part, k in zip(parts, first, strict=False)])
    width = max(part.slots.width for part in parts)
    coupling = [np.pad(part.coupling[:-1], ((0, 0), (0, width - part.slots.width), (0, 0), (0, 0))) for part in parts]
    return LocalCosts(
        Network(int(first[-1]), edges),
        np.concatenate([part.start for part in parts]),
        np.concatenate([*(part.hessian[:-1] for part in parts), np.zeros((1, 2, 2))]),
        np.concatenate([*(part.constant[:-1] for part in parts), np.zeros((1, 2))]),
        np.concatenate([*coupling, np.zeros((1, width, 2, 2))]),
    )
