"""Dual active-set method on stacked arrays: the point nearest to zero in many polyhedra at once.

Goldfarb and Idnani's method, all problems one step at a time: the most violated row enters with the largest step that
keeps the multipliers nonnegative; a row whose multiplier reaches zero on the way leaves. What has ended drops out of
the arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DEPENDENT = 1e-12  # share of a row left after the active ones, below which it is a combination of them
STEPS = 60


@dataclass(eq=False)
class Nearest:
    """Points found.

    Attributes:
        point: (problems, k).
        solved: (problems,) whether the optimality conditions hold there; others need another solver.
        iterations: (problems,) steps taken.
    """

    point: np.ndarray
    solved: np.ndarray
    iterations: np.ndarray


def nearest_points(A: np.ndarray, b: np.ndarray, tolerance: float) -> Nearest:
    """minimize ``|r|^2`` subject to ``A r <= b``.

    Args:
        A: (problems, rows, k).
        b: (problems, rows), infinite where there is no bound.
        tolerance: violation of a row allowed.
    """
    count, _, k = A.shape
    found = Nearest(np.zeros((count, k)), np.full(count, False), np.zeros(count, int))
    length = np.sqrt(np.einsum("prk,prk->pr", A, A))
    scale = np.where(length > 0, length, 1.0)
    at = np.arange(count)  # which problem each row of the arrays below is
    r = np.zeros((count, k))
    active, size = np.zeros((count, k + 1), np.intp), np.zeros(count, np.intp)
    multipliers = np.zeros((count, k + 1))  # column `size` is that of the row about to enter
    entering = np.full(count, -1)
    for step in range(STEPS):
        violation = (A[at] @ r[..., None])[..., 0] - b[at]
        free = entering < 0
        ended = free & (violation.max(axis=1) <= tolerance)
        if ended.any():
            _finish(found, A, b, at[ended], active[ended], size[ended], tolerance)
            found.iterations[at[ended]] = step
            if ended.all():
                break
            go = ~ended
            at, r, active, size, multipliers = at[go], r[go], active[go], size[go], multipliers[go]
            entering, violation, free = entering[go], violation[go], free[go]
        entering = np.where(free, (violation / scale[at]).argmax(axis=1), entering)
        lane, wide = np.arange(at.size), int(size.max())
        used = np.arange(wide) < size[:, None]
        row = A[at, entering]
        normals, S = _active(A, at, active[:, :wide], used)
        change = np.linalg.solve(S, normals @ row[..., None])[..., 0]
        direction = row - (change[:, None] @ normals)[:, 0]
        squared = np.einsum("pk,pk->p", direction, direction)
        apart = squared > DEPENDENT * length[at, entering] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            full = np.where(apart, violation[lane, entering] / squared, np.inf)
            ratios = np.where(used & (change > 0), multipliers[:, :wide] / change, np.inf)
        leaves = ratios.argmin(axis=1) if wide else np.zeros(at.size, np.intp)
        partial = ratios[lane, leaves] if wide else np.full(at.size, np.inf)
        length_of_step = np.minimum(full, partial)
        possible = np.isfinite(length_of_step)  # otherwise no point satisfies all rows
        length_of_step = np.where(possible, length_of_step, 0.0)
        r -= np.where(apart, length_of_step, 0.0)[:, None] * direction
        multipliers[:, :wide] -= length_of_step[:, None] * np.where(used, change, 0.0)
        multipliers[lane, size] += length_of_step
        enters = possible & (full <= partial)
        active[lane[enters], size[enters]] = entering[enters]
        size = size + enters
        multipliers[lane[enters], size[enters]] = 0.0
        entering = np.where(enters, -1, entering)
        drops = possible & ~enters
        if drops.any():
            _drop(active, multipliers, size, lane[drops], leaves[drops])
        possible &= size <= k
        if not possible.all():
            at, r, active, size = at[possible], r[possible], active[possible], size[possible]
            multipliers, entering = multipliers[possible], entering[possible]
            if not at.size:
                break
    return found


def _drop(active: np.ndarray, multipliers: np.ndarray, size: np.ndarray, lane: np.ndarray, place: np.ndarray) -> None:
    """Take a row out: the last active one moves to its place, the entering one's multiplier to the last place."""
    last = size[lane] - 1
    active[lane, place] = active[lane, last]
    multipliers[lane, place] = multipliers[lane, last]
    multipliers[lane, last] = multipliers[lane, last + 1]
    multipliers[lane, last + 1] = 0.0
    size[lane] = last


def _active(A: np.ndarray, at: np.ndarray, active: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Active rows (problems, wide, k), zero where unused, and their products, identity where unused."""
    normals = np.where(used[..., None], A[at[:, None], active], 0.0)
    S = normals @ np.swapaxes(normals, -1, -2)
    place = np.arange(active.shape[1])
    S[:, place, place] += ~used
    return normals, S


def _finish(
    found: Nearest,
    A: np.ndarray,
    b: np.ndarray,
    at: np.ndarray,
    active: np.ndarray,
    size: np.ndarray,
    tolerance: float,
) -> None:
    """The point of an active set, worked out afresh, and whether it is optimal."""
    wide = int(size.max())
    used = np.arange(wide) < size[:, None]
    active = active[:, :wide]
    normals, S = _active(A, at, active, used)
    bounds = np.where(used, np.take_along_axis(b[at], active, axis=1), 0.0)
    with np.errstate(all="ignore"):
        multipliers = -np.linalg.solve(S, bounds[..., None])[..., 0]
    point = -(multipliers[:, None] @ normals)[:, 0]
    # once more on what the first solution left
    left = bounds - (normals @ point[..., None])[..., 0]
    more = -np.linalg.solve(S, left[..., None])[..., 0]
    multipliers += more
    point -= (more[:, None] @ normals)[:, 0]
    primal = ((A[at] @ point[..., None])[..., 0] - b[at]).max(axis=1) <= tolerance
    largest = np.abs(multipliers).max(axis=1, initial=1.0)
    dual = (multipliers >= -tolerance * largest[:, None]).all(axis=1)
    found.point[at], found.solved[at] = point, primal & dual & np.isfinite(point).all(axis=1)
