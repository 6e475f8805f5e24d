"""`LocalProblem`: the numbers of one local problem, which all nodes with equal sensors at equal hops share.

Everything here depends on the age of measurements only (how far data had time to travel), never on data.

Source: dmhe-l-step, condensed form, (3.6), (3.15), errata 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from mhe.covariance import output_information, symmetrized, window_information
from mhe.observers import stationary_gain
from mhe.relay.options import RelayOptions
from mhe.relay.rule import reach
from problems.models import LinearModel
from problems.networks import observability_rank


class Output:
    """What one kind of node measures: C^i (p, n), R^i (p, p), the own gain L^i (n, p) and what follows from them."""

    def __init__(self, A: np.ndarray, C: np.ndarray, R: np.ndarray, gain: np.ndarray) -> None:
        self.C, self.R, self.gain = C, R, gain
        self.transition = A - gain @ C
        self.information = output_information(C, R)


class GainTable:
    """Gains of sets of sensors by the rule of the options; sets with equal content are designed once.

    Args:
        model: its A and G Q G'.
        outputs: what each kind of node measures.
        options: ``gains`` counts here.
    """

    def __init__(self, model: LinearModel, outputs: Sequence[Output], options: RelayOptions) -> None:
        self.model, self.outputs, self.options = model, outputs, options
        self._designed: dict[tuple[int, ...], list[np.ndarray]] = {}

    def of(self, kinds: Sequence[int]) -> list[np.ndarray]:
        """L_k^j (n, p_j) for every member of a set, given by the kinds of its members."""
        if self.options.gains != "joint":
            share = 1.0 / max(1, len(kinds)) if self.options.gains == "mean" else 1.0
            return [share * self.outputs[kind].gain for kind in kinds]
        order = np.argsort(kinds, kind="stable")
        content = tuple(int(kinds[k]) for k in order)
        if content not in self._designed:
            self._designed[content] = self._joint(content)
        designed = self._designed[content]
        places = np.argsort(order)
        return [designed[place] for place in places]

    def _joint(self, content: tuple[int, ...]) -> list[np.ndarray]:
        if not content:
            return []
        parts = [self.outputs[kind] for kind in content]
        gain = stationary_gain(
            self.model.A,
            np.vstack([part.C for part in parts]),
            self.model.process_covariance,
            block_diagonal([part.R for part in parts]),
        ).gain
        ends = np.cumsum([len(part.C) for part in parts])[:-1]
        return np.split(gain, ends, axis=1)


class LocalProblem:
    """One local problem (3.1)-(3.7), for all instants.

    Args:
        gains: of sets of sensors.
        kinds: kind of output of every source within l hops, sources sorted by hops, then kind.
        hops: (sources,) their hop counts.

    Attributes:
        kinds, hops: as given.
        C: (p, n) of all sources.
        R: (p, p).
        row_hops: (p,) hops of the source of every row.
    """

    def __init__(self, gains: GainTable, kinds: Sequence[int], hops: Sequence[int]) -> None:
        self._gains, self._options, model = gains, gains.options, gains.model
        self.A, self._Q = model.A, model.process_covariance
        self.kinds, self.hops = tuple(int(k) for k in kinds), tuple(int(h) for h in hops)
        outputs = [gains.outputs[kind] for kind in self.kinds]
        n = model.state_size
        self.C = np.vstack([np.zeros((0, n)), *(output.C for output in outputs)])
        self.R = block_diagonal([output.R for output in outputs])
        self.row_hops = np.repeat(np.asarray(self.hops, dtype=np.int64), [len(output.C) for output in outputs])
        self._information = [
            sum((o.information for o, hop in zip(outputs, self.hops, strict=True) if hop <= near), np.zeros((n, n)))
            for near in range(self._options.steps + 1)
        ]

    def gain(self, age: int) -> np.ndarray:
        """(n, p) of the transition that leaves an instant of this age; zero columns for what is not held by then."""
        return self._by_reach[self._reach(age)]

    def gains(self, phase: int) -> np.ndarray:
        """(N, n, p) gains of the transitions of a window of `phase` of them, zero for those beyond."""
        result = np.zeros((self._options.horizon, *self.C.shape[::-1]))
        for slot in range(phase):
            result[slot] = self.gain(phase - slot)
        return result

    def information(self, age: int) -> np.ndarray:
        """Sum of C^j' R^j C^j (n, n) over what is held of an instant of this age."""
        return self._information[self._reach(age)]

    def transition(self, age: int) -> np.ndarray:
        """Phi (n, n) of the transition that leaves an instant of this age; A where disturbances are estimated."""
        return self._transitions[self._reach(age)]

    def held(self, phase: int) -> np.ndarray:
        """(phase + 1, p) bool: components held of every slot of a window of `phase` transitions."""
        return self.row_hops <= self._reach(np.arange(phase, -1, -1))[:, None]

    @cached_property
    def data_information(self) -> np.ndarray:
        """(N + 1, n, n): what the data of a window of m transitions tell about its first state, entry m.

        With process noise the disturbances are integrated out.
        """
        horizon = self._options.horizon
        found = []
        for phase in range(horizon + 1):
            ages = range(phase, -1, -1)
            if self._options.disturbance == "process_noise":
                found.append(window_information([self.information(age) for age in ages], self.A, self._Q))
                continue
            moved = np.eye(len(self.A))
            total = np.zeros_like(moved)
            for age in ages:
                total += moved.T @ self.information(age) @ moved
                if age:
                    moved = self.transition(age) @ moved
            found.append(symmetrized(total))
        return np.array(found)

    @cached_property
    def rank(self) -> int:
        """Of the data of a full window: n if the window alone determines its first state (l-step detectability)."""
        if not len(self.C):
            return 0
        values = np.linalg.eigvalsh(self.data_information[-1])
        return int(np.count_nonzero(values > 1e-12 * max(values[-1], 1e-300)))

    @cached_property
    def radii(self) -> np.ndarray:
        """(l,) spectral radii of Phi for what is within 1..l hops."""
        return np.array([np.abs(np.linalg.eigvals(phi)).max() for phi in self._transitions[1:]])

    def observes(self, near: int) -> bool:
        """Whether the sources within some hops observe every state."""
        chosen = self.row_hops <= near
        return bool(chosen.any()) and int(observability_rank(self.A, self.C[chosen], len(self.A))) == len(self.A)

    def _reach(self, age: int | np.ndarray) -> np.ndarray:
        return reach(age, self._options.steps, self._options.latency)

    @cached_property
    def _by_reach(self) -> list[np.ndarray]:
        found = []
        for near in range(self._options.steps + 1):
            result = np.zeros(self.C.shape[::-1])
            chosen = [kind for kind, hop in zip(self.kinds, self.hops, strict=True) if hop <= near]
            columns = [np.zeros((len(self.A), 0)), *self._gains.of(chosen)]
            result[:, self.row_hops <= near] = np.hstack(columns)
            found.append(result)
        return found

    @cached_property
    def _transitions(self) -> list[np.ndarray]:
        if self._options.disturbance == "process_noise":
            return [self.A] * (self._options.steps + 1)
        return [self.A - gain @ self.C for gain in self._by_reach]


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Square blocks along the diagonal; (0, 0) for none."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(np.zeros((0, 0)), *blocks))
