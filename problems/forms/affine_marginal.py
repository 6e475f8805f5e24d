"""Marginals of affine problems: the information matrix is fixed by the weights, the vector is affine in the data."""

from __future__ import annotations

from typing import Any

import numpy as np

from problems.forms.affine import Matrix, Rows, information_of
from problems.forms.layout import DataStore, constant_rows
from problems.forms.marginal import Marginal, schur, selection
from problems.forms.quadratic import QuadraticProgram
from problems.problem import DataSlot


class AffineMarginal:
    """``M`` and ``gradient = G d + g`` at zero for one pattern of active instances; calling it gives a `Marginal`."""

    def __init__(self, program: QuadraticProgram, store: DataStore, numbers: np.ndarray, drop: Any, keep: Any) -> None:
        layout = program.layout
        dropped, self._slots, kept = selection(layout, drop, keep)
        involved = np.concatenate([dropped, kept])
        size, data = involved.size, layout.data_size
        flags = program.flags(store.numbers)
        H, G = np.zeros((size, size)), np.zeros((size, data + 1))
        F, E = [np.zeros((0, size))], [np.zeros((0, data + 1))]
        for rows in program.rows.evaluate(numbers):
            term = rows.layout.term
            touching = np.isin(rows.layout.columns, dropped).any(axis=1)
            if term.kind == "inequality" or not touching.any():
                continue
            rows.require_finite(flags[term.name])
            pick = np.flatnonzero(np.repeat(touching, rows.dim))
            R, Ed = _dense(rows.R[pick][:, involved]), np.column_stack([_dense(rows.E[pick]), rows.c[pick]])
            if term.kind == "equality":
                F.append(R)
                E.append(Ed)
                continue
            on = flags[term.name]
            W = np.broadcast_to(information_of(rows, store, on), (rows.count, rows.dim, rows.dim))[touching]
            WR = (W @ R.reshape(len(W), rows.dim, size)).reshape(R.shape)
            H += WR.T @ R
            G += WR.T @ Ed
            if term.linear is not None:
                G += (R * np.repeat(np.ones(rows.count) if on is None else on, rows.dim)[pick][:, None]).T @ _linear(
                    rows, data
                )[pick]
        self.M, gradient = schur(H, G, np.vstack(F), np.vstack(E), dropped.size)
        self._G, self._g = np.ascontiguousarray(gradient[:, :data]), gradient[:, data].copy()
        self._kept, self._layout = kept, layout
        self._shapes = [(len(s.indices), s.source.space.ambient) for s in self._slots]

    def __call__(self, numbers: np.ndarray, point: np.ndarray) -> Marginal:
        x = point[self._kept]
        vector = -(self._G @ numbers + self._g + self.M @ x)
        reference, start = [], 0
        for count, ambient in self._shapes:
            reference.append(x[start : start + count * ambient].reshape(count, ambient))
            start += count * ambient
        return Marginal(tuple(self._slots), self.M, vector, tuple(reference))


def _dense(matrix: Matrix) -> np.ndarray:
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def _linear(rows: Rows, data: int) -> np.ndarray:
    """Linear part of every row as an affine function of the data: (rows, data + 1)."""
    out = np.zeros((rows.count * rows.dim, data + 1))
    linear = rows.layout.term.linear
    if isinstance(linear, DataSlot):
        index = np.broadcast_to(rows.layout.linear, (rows.count, rows.dim)).ravel()
        out[np.arange(out.shape[0]), index] = 1.0
    else:
        out[:, data] = constant_rows(linear, rows.dim, rows.count, rows.layout.term.what).ravel()
    return out
