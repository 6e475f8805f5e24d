"""Marginal covariances of poses in the world frame: of every pose by itself, and of several together.

Those of every pose need few entries of the inverse of a sparse information matrix: Takahashi's recursion computes them
from the factors ``L D L'`` alone, supernode by supernode from the last to the first, without any column of the inverse
as a whole (Takahashi, Fagan and Chin 1973; Kaess and Dellaert 2009 for marginals of pose graphs).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import FormError, UnobservableError
from problems.forms.least_squares import Constraints, LeastSquares
from problems.forms.pins import Pins
from problems.forms.sparsity import HessianPattern
from problems.problem import Slot, Variable
from problems.solvers.session import Session, Solution
from problems.spaces import SE2, Vector
from problems.spatial import SE3, rotate_array


def joint_covariance(solution: Solution, *slots: Variable | Slot) -> np.ndarray:
    """Covariance (k, k) of several poses and points together, in the world frame.

    Coordinates stand slot after slot, instance after instance; those of a pose are its position (m) and its rotation
    about the axes of the world (rad), so that blocks off the diagonal tell how the errors of two poses go together.

    Raises:
        UnobservableError: the costs leave a direction free.
    """
    joint = solution.covariance(*slots)
    turn = np.zeros_like(joint)
    at = 0
    for slot in slots:
        source = slot if isinstance(slot, Variable) else slot.source
        values = solution[source.name]
        for block in _frames(source.space, values if isinstance(slot, Variable) else values[slot.indices]):
            turn[at : at + len(block), at : at + len(block)] = block
            at += len(block)
    return turn @ joint @ turn.T


def marginal_covariances(session: Session, solution: Solution, aligned: bool = False) -> dict[str, np.ndarray]:
    """Covariance (count, dim, dim) of every instance of every variable by name, in the world frame.

    Where the gauge is fixed by holding one pose, all uncertainty counts from there and that of its heading hides
    everything far away. `aligned` gives the covariances of the errors that remain when the trajectory is moved onto the
    truth rigidly, as for the absolute trajectory error: with T the least-squares motion (linearized about the centre)
    of position errors and G the motions it stands for, those of ``(I - G T) error``.

    Inequalities do not count, as in `Solution.covariance`.

    Args:
        session: that made `solution`, with the data of that solve.
        solution: where costs are linearized; robust losses count with the weights they give there.
        aligned: see above.

    Raises:
        FormError: the problem has equalities beyond instances that are held; use `joint_covariance`.
        UnobservableError: the costs leave a direction free.
    """
    layout = session.layout
    pins = Pins(layout)
    if Constraints(layout, pins.names).equalities:
        raise FormError(f"marginals of {session.problem.name!r}: it has equalities; use joint_covariance")
    form = LeastSquares(session.problem, layout)
    _, gradient, hessian = form.bind(session.store).linearize(solution.point)
    pattern = form.pattern
    pins.reduce(gradient, hessian, pattern)
    columns = {name: layout.columns(variable[:]) for name, variable in session.problem.unknowns.items()}
    blocks = _Blocks.of(pattern, hessian, list(columns.values()))
    held = np.zeros(pattern.size, bool)
    held[pins.columns] = True
    turns = {name: _frames(v.space, solution[name]) for name, v in session.problem.unknowns.items()}
    out = {}
    for name, turn in turns.items():
        found, fixed = blocks.inverse(columns[name]), held[columns[name]]
        found[fixed[:, :, None] | fixed[:, None, :]] = 0.0
        out[name] = turn @ found @ turn.swapaxes(1, 2)
    if aligned:
        _align(out, session, solution, columns, turns, lambda right: _columns_of_inverse(blocks, right, held))
    return out


def _columns_of_inverse(blocks: _Blocks, right: np.ndarray, held: np.ndarray) -> np.ndarray:
    right = np.where(held[:, None], 0.0, right)
    return np.column_stack([blocks.solver.solve(np.ascontiguousarray(column)) for column in right.T])


def _align(
    out: dict[str, np.ndarray],
    session: Session,
    solution: Solution,
    columns: dict[str, np.ndarray],
    turns: dict[str, np.ndarray],
    solve: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Covariances of what a rigid alignment of all poses leaves, in place."""
    unknowns = session.problem.unknowns
    poses = [name for name, variable in unknowns.items() if variable.space in (SE2, SE3)]
    d = 2 if unknowns[poses[0]].space == SE2 else 3
    center = np.vstack([solution[name][:, :d] for name in poses]).mean(axis=0)
    motions = {name: _motions(solution[name][:, :d] - center, v.space.dim) for name, v in unknowns.items()}
    placed = np.vstack([motions[name][:, :d].reshape(-1, motions[name].shape[2]) for name in poses])
    weight = np.linalg.pinv(placed.T @ placed)
    right = np.zeros((session.layout.size, len(weight)))
    for name in poses:
        moved = np.zeros((*columns[name].shape, len(weight)))
        moved[:, :d] = motions[name][:, :d] @ weight
        right[columns[name]] = turns[name].swapaxes(1, 2) @ moved
    spread = solve(right)
    common = right.T @ spread
    for name, motion in motions.items():
        both = motion @ (turns[name] @ spread[columns[name]]).swapaxes(1, 2)
        out[name] += motion @ common @ motion.swapaxes(1, 2) - both - both.swapaxes(1, 2)


def _motions(away: np.ndarray, dim: int) -> np.ndarray:
    """What rigid motions (translations, then rotations about the centre) do to poses or points, world frame."""
    count, d = away.shape
    turns = 1 if d == 2 else 3
    out = np.zeros((count, dim, d + turns))
    out[:, :d, :d] = np.eye(d)
    if d == 2:
        out[:, 0, 2], out[:, 1, 2] = -away[:, 1], away[:, 0]
    else:
        out[:, :3, 3:] = np.cross(np.eye(3)[None], away[:, None, :]).swapaxes(1, 2)
    out[:, d:, d:] = np.eye(turns)[: dim - d]
    return out


def _frames(space: Any, values: np.ndarray) -> np.ndarray:
    """Tangent coordinates of the body in the world (count, dim, dim)."""
    turn = np.tile(np.eye(space.dim), (len(values), 1, 1))
    if space == SE2:
        c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
        turn[:, :2, :2] = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=1)
    elif space == SE3:
        axes = [rotate_array(values[:, 3:], np.tile(axis, (len(values), 1))) for axis in np.eye(3)]
        turn[:, :3, :3] = turn[:, 3:, 3:] = np.stack(axes, axis=2)
    elif not isinstance(space, Vector):
        raise FormError(f"no world frame for the tangent of {space!r}")
    return turn


FREE = 1e-12  # share of a diagonal entry that must be left when everything before it is eliminated


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Entries of an inverse on the pattern of the factors: for each supernode, the square of all it touches.

    Attributes:
        place: (n,) position of each unknown in the order of elimination.
        node: (n,) supernode of each position.
        rows: per supernode, the positions it touches, ascending; its own are first.
        squares: per supernode, entries of the inverse on its rows and columns `rows`.
        solver: of the whole system.
    """

    place: np.ndarray
    node: np.ndarray
    rows: list[np.ndarray]
    squares: list[np.ndarray]
    solver: Any

    @classmethod
    def of(cls, pattern: HessianPattern, upper: np.ndarray, instances: list[np.ndarray]) -> _Blocks:
        """From the upper triangle of a matrix; raises UnobservableError where it is not positive definite."""
        import qdldl
        from scipy.sparse import coo_matrix, csc_matrix

        size = pattern.size
        column = pattern.columns
        one = np.concatenate([np.repeat(block, block.shape[1], axis=1).ravel() for block in instances])
        other = np.concatenate([np.tile(block, block.shape[1]).ravel() for block in instances])
        kept = one > other
        # entries that are zero still belong to the pattern of the factors, which drop those that are exactly zero
        entries = np.concatenate([upper, np.zeros(int(kept.sum()))]) + 1e-300
        ends = (np.concatenate([pattern.indices, other[kept]]), np.concatenate([column, one[kept]]))
        matrix = csc_matrix(coo_matrix((entries, ends), shape=(size, size)))
        try:
            solver = qdldl.Solver(matrix, upper=True)
            L, D, order = solver.factors()
        except RuntimeError as error:
            raise UnobservableError(f"no covariance: the costs leave a direction free ({error})") from error
        if not (D > FREE * np.abs(upper[pattern.diagonal])[order]).all():
            raise UnobservableError("no covariance: the costs leave a direction free; add a prior or fix the gauge")
        L = csc_matrix(L)
        L.sort_indices()
        place = np.empty(size, np.intp)
        place[order] = np.arange(size)
        starts = _supernodes(L)
        node = np.searchsorted(starts, np.arange(size), side="right") - 1
        rows, squares = _takahashi(L, D, starts, node)
        return cls(place, node, rows, squares, solver)

    def inverse(self, columns: np.ndarray) -> np.ndarray:
        """Blocks (count, d, d) of the inverse on `columns` (count, d), each of which the factors hold together."""
        out = np.empty((*columns.shape, columns.shape[1]))
        for k, at in enumerate(self.place[columns]):
            node = self.node[at.min()]
            inside = np.searchsorted(self.rows[node], at)
            out[k] = self.squares[node][np.ix_(inside, inside)]
        return out


def _supernodes(L: Any) -> np.ndarray:
    """First columns of runs whose patterns are one dense triangle above common rows."""
    size, count = L.shape[0], np.diff(L.indptr)
    first = np.full(size, -1)
    first[count > 0] = L.indices[L.indptr[:-1][count > 0]]
    follows = (first[:-1] == np.arange(1, size)) & (count[:-1] == count[1:] + 1)
    return np.flatnonzero(np.r_[True, ~follows])


def _takahashi(
    L: Any, D: np.ndarray, starts: np.ndarray, node: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    from scipy.linalg import solve_triangular

    ends = np.r_[starts[1:], L.shape[0]]
    rows: list[Any] = [None] * len(starts)
    squares: list[Any] = [None] * len(starts)
    for k in range(len(starts) - 1, -1, -1):
        first, last = starts[k], ends[k]
        width = last - first
        below = L.indices[L.indptr[last - 1] : L.indptr[last]]
        count = width + below.size
        columns = np.zeros((count, width))
        for j in range(width):
            columns[j + 1 :, j] = L.data[L.indptr[first + j] : L.indptr[first + j + 1]]
        columns[np.arange(width), np.arange(width)] = 1.0
        corner = solve_triangular(columns[:width], np.eye(width), lower=True, unit_diagonal=True)
        square = np.empty((count, count))
        square[:width, :width] = (corner.T / D[first:last]) @ corner
        if below.size:
            above = node[below[0]]  # what a supernode touches, the next one it touches does as well
            inside = np.searchsorted(rows[above], below)
            known = squares[above][np.ix_(inside, inside)]
            ratio = columns[width:] @ corner
            off = -known @ ratio
            square[width:, width:] = known
            square[width:, :width], square[:width, width:] = off, off.T
            square[:width, :width] -= ratio.T @ off
        rows[k], squares[k] = np.r_[np.arange(first, last), below], square
    return rows, squares
