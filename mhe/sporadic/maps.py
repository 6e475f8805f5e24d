"""What readings amount to at all nodes of a network at once: sparse products of all flags and readings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mhe.sporadic.numbers import RegionNumbers
from mhe.sporadic.plan import SporadicPlan


class NetworkMaps:
    """`RegionNumbers` of all nodes; leading axes are free, then come nodes and parts.

    Args:
        plans: of all nodes.
        sensors: names of all sensors of the network, in the order of flags and readings.
    """

    def __init__(self, plans: Sequence[SporadicPlan], sensors: Sequence[str]) -> None:
        from scipy.sparse import csr_array, vstack

        first = plans[0]
        V, m, width, S = first.blocks.count, first.blocks.size, first.width, len(sensors)
        self._shape = len(plans), V, m
        self._transition = first.transition
        place = {name: number for number, name in enumerate(sensors)}
        blocks: dict[str, list[Any]] = {"information": [], "linear": [], "corrections": [], "moved": []}
        for plan in plans:
            numbers, known = RegionNumbers(plan), np.array([place[name] for name in plan.names], dtype=np.intp)
            each = np.eye(known.size)
            components = np.eye(known.size * width).reshape(-1, known.size, width)
            places = (known[:, None] * width + np.arange(width)).ravel()
            corrections = plan.transition - numbers.transitions(each)
            for name, values, columns, count in (
                ("information", numbers.information(each), known, S),
                ("corrections", corrections, known, S),
                ("linear", numbers.linear(components), places, S * width),
                ("moved", numbers.moved(components), places, S * width),
            ):
                table = csr_array(values.reshape(len(values), -1).T)
                table = csr_array(
                    (table.data, columns[table.indices], table.indptr), shape=(np.prod(values.shape[1:]), count)
                )
                blocks[name].append(table)
        self._maps = {name: csr_array(vstack(tables)) for name, tables in blocks.items()}

    def information(self, flags: np.ndarray) -> np.ndarray:
        """M_k (..., nodes, parts, m, m) of flags (..., sensors)."""
        return self._apply("information", flags, square=True)

    def linear(self, values: np.ndarray) -> np.ndarray:
        """Sum of -C'R^-1 y (..., nodes, parts, m) of readings (..., sensors, width)."""
        return self._apply("linear", values.reshape(*values.shape[:-2], -1))

    def transitions(self, flags: np.ndarray) -> np.ndarray:
        """F_k = A - L D_k C (..., nodes, parts, m, m); A with process noise."""
        return self._transition - self._apply("corrections", flags, square=True)

    def moved(self, fed: np.ndarray) -> np.ndarray:
        """b_k = L D_k y_k (..., nodes, parts, m) of what observers are fed (..., sensors, width)."""
        return self._apply("moved", fed.reshape(*fed.shape[:-2], -1))

    def _apply(self, name: str, numbers: np.ndarray, *, square: bool = False) -> np.ndarray:
        lead = numbers.shape[:-1]
        product = (self._maps[name] @ numbers.reshape(-1, numbers.shape[-1]).T).T
        return product.reshape(*lead, *self._shape, *((self._shape[-1],) if square else ()))
