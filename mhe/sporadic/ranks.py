"""Time-varying observability rank of a neighbourhood, (4.12): what its detections in the window determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from problems.networks.observability import RANK_TOLERANCE

KEPT = 4096  # patterns of detections whose rank is kept


class WindowRank:
    """Rank of ``[C_alpha(t-N+1); ...; C_alpha(t) A^(N-1)]``, part by part; patterns that come back are remembered.

    Source: dmhe-sporadic-fov 3.9 and E9.

    Args:
        transition: (parts, m, m) A.
        parts: part that each sensor sees.
        outputs: C (p, m) of each sensor on its part.
    """

    def __init__(self, transition: np.ndarray, parts: np.ndarray, outputs: Sequence[np.ndarray]) -> None:
        self._kinds: list[tuple[np.ndarray, list[np.ndarray], int]] = []
        columns: list[np.ndarray] = []
        known: dict[bytes, int] = {}
        for part, A in enumerate(transition):
            kinds: dict[bytes, list[int]] = {}
            for sensor in np.flatnonzero(parts == part).tolist():
                kinds.setdefault(outputs[sensor].tobytes(), []).append(sensor)
            for sensors in kinds.values():
                column = np.zeros(len(parts))
                column[sensors] = 1.0
                columns.append(column)
            # parts that look the same share what is remembered
            content = A.tobytes() + b"|".join(kinds)
            self._kinds.append((A, [outputs[s[0]] for s in kinds.values()], known.setdefault(content, part)))
        self._sums = np.array(columns).T if columns else np.zeros((len(parts), 0))
        self._ends = np.cumsum([0, *(len(found) for _, found, _ in self._kinds)]).tolist()
        self._ranks: dict[tuple[int, bytes], int] = {}

    def __call__(self, flags: np.ndarray) -> int:
        """Rank for flags (N, sensors) of the instants t-N+1..t."""
        seen = (flags @ self._sums) > 0
        total = 0
        for (A, outputs, alike), start, end in zip(self._kinds, self._ends, self._ends[1:], strict=False):
            own = seen[:, start:end]
            key = alike, own.tobytes()
            rank = self._ranks.get(key)
            if rank is None:
                if len(self._ranks) >= KEPT:
                    self._ranks.pop(next(iter(self._ranks)))
                rank = self._ranks[key] = _rank(A, outputs, own)
            total += rank
        return total


def _rank(A: np.ndarray, outputs: list[np.ndarray], seen: np.ndarray) -> int:
    rows, power = [np.zeros((0, len(A)))], np.eye(len(A))
    for there in seen:
        rows += [outputs[kind] @ power for kind in np.flatnonzero(there)]
        power = A @ power
    values = np.linalg.svd(np.vstack(rows), compute_uv=False)
    return int((values > RANK_TOLERANCE * values.max(initial=0.0)).sum())
