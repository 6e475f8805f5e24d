"""Parts of a model that nothing couples: the vehicles of a team, each with its own states.

Where all parts have one size, everything of the estimator works on arrays with a leading axis over them; otherwise the
model is one part. Results are the same, only the time is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from problems.models import LinearModel


@dataclass(frozen=True, eq=False)
class Blocks:
    """States and disturbances by part.

    Attributes:
        states: (parts, m) indices into the state.
        disturbances: (parts, q) indices into the disturbance.
    """

    states: np.ndarray
    disturbances: np.ndarray

    @property
    def count(self) -> int:
        return len(self.states)

    @property
    def size(self) -> int:
        """States of a part."""
        return self.states.shape[1]

    def of(self, matrix: np.ndarray) -> np.ndarray:
        """(parts, m, m) diagonal blocks of a matrix (n, n) over the states."""
        return np.ascontiguousarray(matrix[self.states[:, :, None], self.states[:, None, :]])

    def apart(self, vector: np.ndarray) -> np.ndarray:
        """(..., parts, m) from (..., n)."""
        return vector[..., self.states]

    def together(self, parts: np.ndarray) -> np.ndarray:
        """(..., n) from (..., parts, m)."""
        out = np.empty((*parts.shape[:-2], self.states.size))
        out[..., self.states] = parts
        return out


def blocks_of(model: LinearModel, gains: Sequence[tuple[int, np.ndarray]] = ()) -> Blocks:
    """The parts of a model that neither dynamics, noise, prior, sensors nor observer gains couple.

    Args:
        model: with a prior and all sensors.
        gains: pairs of a sensor of the model and an observer gain (n, p) on its output.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    n, q = model.state_size, model.disturbance_size
    coupled = np.zeros((n + q, n + q), dtype=bool)
    coupled[:n, :n] = (model.A != 0) | (model.prior()[1] != 0)
    coupled[:n, n:] = model.G != 0
    coupled[n:, n:] = model.Q != 0
    seen = [(model.C[model.rows(sensor.name)] != 0).any(axis=0) for sensor in model.sensors]
    for states in [*seen, *(seen[sensor] | (gain != 0).any(axis=1) for sensor, gain in gains)]:
        coupled[:n, :n] |= np.outer(states, states)
    count, labels = connected_components(csr_array(coupled), directed=False)
    states = [np.flatnonzero(labels[:n] == part) for part in range(count)]
    disturbances = [np.flatnonzero(labels[n:] == part) for part in range(count)]
    if len({(a.size, b.size) for a, b in zip(states, disturbances, strict=True)}) > 1:
        return Blocks(np.arange(n)[None], np.arange(q)[None])
    order = np.argsort([part[0] for part in states])
    return Blocks(np.array(states)[order], np.array(disturbances)[order])
