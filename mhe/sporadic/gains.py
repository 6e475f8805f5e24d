"""Observer gains of all nodes, sensor by sensor, checked for every detection that stands alone and all together.

Source: dmhe-sporadic-fov 3.6, section 5 and E7 (gains are block-diagonal by vehicle).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from mhe.observers import kalman_gain
from mhe.sporadic.blocks import Blocks
from problems.errors import ModelWarning, ShapeError, UnstableError
from problems.models import LinearModel
from problems.networks.observability import observability_rank

BySensor = dict[int, np.ndarray]


def sensor_size(model: LinearModel, sensor: int) -> int:
    """Components of a sensor, by its number."""
    return len(range(model.measurement_size)[model.rows(model.sensors[sensor].name)])


def sensor_output(model: LinearModel, sensor: int) -> tuple[np.ndarray, np.ndarray]:
    """C (p, n) and R (p, p) of a sensor, by its number."""
    rows = model.rows(model.sensors[sensor].name)
    return model.C[rows], model.R[rows, rows]


def part_seen(model: LinearModel, blocks: Blocks, sensor: int) -> int:
    """Part of the model that a sensor sees."""
    column = int(np.flatnonzero((sensor_output(model, sensor)[0] != 0).any(axis=0))[0])
    return int(np.flatnonzero((blocks.states == column).any(axis=1))[0])


def given_gains(model: LinearModel, sensors: np.ndarray, gain: Any, node: str) -> BySensor:
    """One matrix L (n, components of the sensors), cut sensor by sensor.

    Raises:
        ShapeError: another shape, or numbers that are not finite.
    """
    sizes = [sensor_size(model, s) for s in sensors]
    array = np.asarray(gain, dtype=float)
    if array.shape != (model.state_size, sum(sizes)) or not np.isfinite(array).all():
        raise ShapeError(
            f"node {node}: expected a finite gain of shape {(model.state_size, sum(sizes))}, got {array.shape}"
        )
    ends = np.cumsum([0, *sizes])
    return {int(s): array[:, a:b] for s, a, b in zip(sensors, ends, ends[1:], strict=False)}


def blended_gains(model: LinearModel, blocks: Blocks, sensors: np.ndarray, share: float) -> BySensor:
    """``l A C^+`` of each sensor, l shared among the sensors of a part."""
    parts = [part_seen(model, blocks, s) for s in sensors]
    return {
        int(s): share / parts.count(part) * model.A @ np.linalg.pinv(sensor_output(model, s)[0])
        for s, part in zip(sensors, parts, strict=True)
    }


def kalman_gains(model: LinearModel, blocks: Blocks, sensors: np.ndarray) -> BySensor:
    """Stationary Kalman gains for all of the sensors, part by part, so that rounding couples none.

    Raises:
        NoiseError: see `mhe.observers.kalman_gain`.
    """
    found: BySensor = {}
    parts = np.array([part_seen(model, blocks, s) for s in sensors], dtype=np.intp)
    for part in np.unique(parts):
        own, states = [int(s) for s in sensors[parts == part]], blocks.states[part]
        A, Q = (matrix[np.ix_(states, states)] for matrix in (model.A, model.process_covariance))
        outputs = [sensor_output(model, s) for s in own]
        ends = np.cumsum([0, *(len(r) for _, r in outputs)]).tolist()
        R = np.zeros((ends[-1], ends[-1]))
        for (_, r), a, b in zip(outputs, ends, ends[1:], strict=False):
            R[a:b, a:b] = r
        gain = np.zeros((model.state_size, ends[-1]))
        gain[states] = kalman_gain(A, np.vstack([C[:, states] for C, _ in outputs]), Q, R).gain
        found |= {s: gain[:, a:b] for s, a, b in zip(own, ends, ends[1:], strict=False)}
    return found


def check_observer(model: LinearModel, blocks: Blocks, gains: BySensor, node: str, *, require_sound: bool) -> None:
    """Section 5: A - L C with all detections, and with any single one, lets no observed error grow.

    Raises:
        UnstableError: a spectral radius of 1 or more although the detections observe everything.

    Warns:
        ModelWarning: the same without `require_sound`.
    """
    alone: Sequence[list[int]] = [[sensor] for sensor in gains]
    for sensors in (list(gains), *(alone if len(alone) > 1 else ())):
        parts = [part_seen(model, blocks, s) for s in sensors]
        for part in sorted(set(parts)):
            seeing, states = [s for s, p in zip(sensors, parts, strict=True) if p == part], blocks.states[part]
            A = model.A[np.ix_(states, states)]
            C = np.vstack([sensor_output(model, s)[0][:, states] for s in seeing])
            L = np.hstack([gains[s][states] for s in seeing])
            radius = float(np.abs(np.linalg.eigvals(A - L @ C)).max())
            if radius < 1 or observability_rank(A, C, len(A)) < len(A):
                continue
            names = ", ".join(model.sensors[s].name for s in seeing[:3])
            text = (
                f"the observer of node {node} has spectral radius {radius:.6g} when {names} detect, although these "
                "observe everything; choose smaller or Kalman gains"
            )
            if require_sound:
                raise UnstableError(text)
            warnings.warn(text, ModelWarning, stacklevel=5)
