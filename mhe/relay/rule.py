"""The data rule of relayed measurements: who holds which measurement when.

A measurement travels one hop per sampling instant and at most l hops; at time t node i holds y_k^j, t - N <= k <= t,
exactly when j = i or d(j->i) <= min(l, t - k + 1 - latency).

Source: dmhe-l-step 3.2.1, Table 3.1 (latency 0); (3.2)-(3.7) as printed (latency 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def reach(age: Any, steps: int, latency: int = 0) -> Any:
    """How many hops away a measurement of some age may have been made for a node to hold it.

    Args:
        age: t - k >= 0, a number or an array.
        steps: l, the path length.
        latency: 0: what neighbours measure arrives within the step; 1: with the next one.

    Returns:
        Hop counts like `age`, at least 0 (the node's own measurement).
    """
    return np.minimum(steps, np.maximum(0, np.asarray(age) + 1 - latency))


def held(hops: ArrayLike, instant: int, *, horizon: int, steps: int, latency: int = 0) -> np.ndarray:
    """Which measurements a node holds at an instant.

    Args:
        hops: (members,) hop counts d(j->i) of the members j, 0 for the node itself, any number above `steps` where
            there is no path.
        instant: t >= 0.
        horizon: N.
        steps: l.
        latency: 0 or 1.

    Returns:
        (members, m + 1) bool with m = min(t, N): column s is instant t - m + s.
    """
    phase = min(instant, horizon)
    allowed = reach(np.arange(phase, -1, -1), steps, latency)
    return np.asarray(hops)[..., None] <= allowed
