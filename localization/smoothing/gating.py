"""Chi-square gates: which readings agree with a prediction."""

from __future__ import annotations

import numpy as np

from localization.smoothing.kinds import BEFORE, OTHER, POSE, Places
from localization.smoothing.window import TeamWindow
from problems.errors import UnobservableError
from problems.forms.residual_code import residual_code
from problems.forms.template import template_of
from problems.noise import whitening
from problems.solvers.session import Solution


class Gate:
    """The gate of one kind. ``chi2 = w'(I + J P J')^-1 w`` with the whitened residual w and its Jacobian J at the
    prediction, P the covariance of what the kind reads (Bar-Shalom, Li and Kirubarajan 2001, 2.3)."""

    def __init__(self, window: TeamWindow, places: Places) -> None:
        from scipy.stats import chi2

        assert places.kind.gate is not None
        self._window, self._places = window, places
        term = window.problem.terms[places.name]
        self._code, self._dim = residual_code(term), template_of(term).dim
        self._limit = float(chi2.ppf(places.kind.gate, self._dim))

    def passes(
        self, solution: Solution, slot: int, number: np.ndarray, values: np.ndarray, sigma: np.ndarray | None
    ) -> np.ndarray:
        """(m,) whether readings at a keyframe agree with a solution that does not contain them.

        Where that solution leaves free what they would measure, they pass.
        """
        window, kind = self._window, self._places.kind
        at = self._places.owners(number)
        try:
            P = solution.covariance(window.keyframe(slot), *(v[:] for v in window.lasting.values()))
        except UnobservableError:
            return np.ones(len(number), bool)
        stored, columns = [], []
        starts = self._starts()
        for role in kind.on:
            index = at[role]
            if role in (POSE, OTHER):
                space, row = window.space, slot * window.robots + index
            else:
                space, row = window.lasting[role].space, index
            name = POSE if role in (POSE, OTHER) else role
            stored += [np.ascontiguousarray(column) for column in solution[name][row].T]
            columns.append(starts[name] + index[:, None] * space.dim + np.arange(space.dim))
        assert BEFORE not in kind.on
        inputs = [*stored, *(np.ascontiguousarray(column) for column in values.T)]
        r, J = self._code.residual_and_jacobian(inputs, len(number))
        root = self._root(sigma, len(number))
        r, J = np.einsum("nij,nj->ni", root, r), root @ J
        column = np.hstack(columns)
        spread = np.eye(self._dim) + J @ P[column[:, :, None], column[:, None, :]] @ J.swapaxes(1, 2)
        return ~(np.einsum("ni,ni->n", r, np.linalg.solve(spread, r[..., None])[..., 0]) > self._limit)

    def _root(self, sigma: np.ndarray | None, count: int) -> np.ndarray:
        noise = self._places.kind.noise
        if noise is None:
            assert sigma is not None
            diagonal = 1 / sigma
        else:
            diagonal = whitening(noise.kind, noise.value, self._dim, count, f"kind {self._places.name!r}")
            if diagonal.ndim == 3:
                return diagonal
        return diagonal[:, :, None] * np.eye(self._dim)

    def _starts(self) -> dict[str, int]:
        starts, end = {POSE: 0}, self._window.robots * self._window.space.dim
        for name, variable in self._window.lasting.items():
            starts[name] = end
            end += variable.count * variable.space.dim
        return starts
