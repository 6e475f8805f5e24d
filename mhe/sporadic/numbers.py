"""What the readings of a region amount to, slot by slot: information, linear costs and the observer's maps.

Each is one product of all flags or readings with a matrix worked out once, so a reading that comes late or never costs
what one on time costs.

Source: dmhe-sporadic-fov 3.6-3.8.
"""

from __future__ import annotations

import numpy as np

from mhe.sporadic.plan import SporadicPlan


class RegionNumbers:
    """Numbers of the slots of one node; leading axes are slots, then parts."""

    def __init__(self, plan: SporadicPlan) -> None:
        V, m, width, sensors = plan.blocks.count, plan.blocks.size, plan.width, len(plan.names)
        self._shape = V, m
        self._transition = plan.transition
        information = np.zeros((sensors, V, m, m))
        weighted = np.zeros((sensors, width, V, m))
        corrections = np.zeros((sensors, V, m, m))
        fed = np.zeros((sensors, width, V, m))
        for s, (v, C, W) in enumerate(zip(plan.parts, plan.outputs, plan.precisions, strict=True)):
            information[s, v] = C.T @ W @ C
            weighted[s, : len(C), v] = -(W @ C)
            L = None if plan.gains is None else plan.gains[s]
            if L is not None:
                corrections[s, v] = L @ C
                fed[s, : len(C), v] = L.T
        self._information = information.reshape(sensors, -1)
        self._weighted = weighted.reshape(sensors * width, -1)
        self._corrections = corrections.reshape(sensors, -1) if plan.gains is not None else None
        self._fed = fed.reshape(sensors * width, -1)

    def information(self, flags: np.ndarray) -> np.ndarray:
        """M_k (slots, parts, m, m), sum of C'R^-1 C over what was detected."""
        V, m = self._shape
        return (flags @ self._information).reshape(-1, V, m, m)

    def linear(self, values: np.ndarray) -> np.ndarray:
        """Sum of -C'R^-1 y (slots, parts, m)."""
        return (values.reshape(len(values), -1) @ self._weighted).reshape(len(values), *self._shape)

    def transitions(self, flags: np.ndarray) -> np.ndarray:
        """F_k = A - L D_k C (slots, parts, m, m); A with process noise."""
        V, m = self._shape
        if self._corrections is None:
            return np.broadcast_to(self._transition, (len(flags), V, m, m))
        return self._transition - (flags @ self._corrections).reshape(-1, V, m, m)

    def moved(self, fed: np.ndarray) -> np.ndarray:
        """b_k = L D_k y_k (slots, parts, m)."""
        return (fed.reshape(len(fed), -1) @ self._fed).reshape(len(fed), *self._shape)
