"""Which part of the state the measurements determine (`dmhe-pre-estimation` sections 2, 3.6 and 5).

Ranks are those of the observability matrix with the given number of row blocks. They are found block by block, with
each block made orthonormal before the next one is added: powers of A would bury slow or small directions long before
the state is large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from problems.errors import DataError, DefinitionError, SettingError, ShapeError, UnobservableError
from problems.models import _checks

if TYPE_CHECKING:
    from problems.models.base import Model
    from problems.models.simulation import Trajectory

Classification = Literal["observable", "detectable", "partly", "blind"]


@dataclass(frozen=True, eq=False)
class ObservabilityReport:
    """What a pair or a window determines.

    Attributes:
        classification: ``observable`` (everything), ``detectable`` (the rest decays), ``partly`` (something, the rest
            does not decay or is not known to) or ``blind`` (nothing).
        rank: rank with `horizon` row blocks, 0 to n; the rank of the weights (2.36).
        horizon: row blocks counted in `rank`.
        index: observability index, the fewest row blocks that determine all that any number of them does; 0 if blind.
        detectable: every unobservable eigenvalue lies inside the unit circle; None for a window of a nonlinear model
            that does not determine the state.
        unobservable_eigenvalues: complex, largest modulus first; empty for a window of a nonlinear model.
        unobservable_basis: (n, d) orthonormal basis of the directions no row block determines.
        state_names: n names.
    """

    classification: Classification
    rank: int
    horizon: int
    index: int
    detectable: bool | None
    unobservable_eigenvalues: np.ndarray
    unobservable_basis: np.ndarray
    state_names: tuple[str, ...]

    @property
    def state_size(self) -> int:
        return self.unobservable_basis.shape[0]

    def directions(self) -> tuple[str, ...]:
        """The undetermined directions, each as a short combination of state names."""
        return tuple(_combination(row, self.state_names) for row in _echelon(self.unobservable_basis.T))

    def __str__(self) -> str:
        text = f"{self.classification}: rank {self.rank} of {self.state_size} with {self.horizon} row block(s)"
        return f"{text}; {self._undetermined()}" if self.unobservable_basis.size else text

    def _undetermined(self) -> str:
        text = f"no measurement determines {', '.join(self.directions())}"
        if not self.unobservable_eigenvalues.size:
            return text
        shown = ", ".join(f"{v:.4g}" if v.imag else f"{v.real:.4g}" for v in self.unobservable_eigenvalues)
        return f"{text} (unobservable eigenvalues {shown})"


def pair_observability(
    A: Any, C: Any, horizon: int | None = None, *, state_names: Sequence[str] | None = None, tolerance: float = 1e-9
) -> ObservabilityReport:
    """Observability of a pair (A, C): local, regional or collective (Definition 2.12).

    Args:
        A: (n, n).
        C: (p, n), p >= 0.
        horizon: row blocks counted in the rank; n if None.
        state_names: n names; x1, x2, ... if None.
        tolerance: on singular values, relative to those of A and C.

    Raises:
        ShapeError: A is not square or C has another number of columns.
        DefinitionError: numbers that are not finite.
        SettingError: a horizon below 1.
    """
    A = _checks.matrix(A, None, None, "A")
    n = A.shape[0]
    A, C = _checks.matrix(A, n, n, "A"), _checks.matrix(C, None, n, "C")
    names = tuple(state_names) if state_names is not None else tuple(f"x{k + 1}" for k in range(n))
    if len(names) != n:
        raise ShapeError(f"state_names: expected {n} names, got {len(names)}")
    horizon = _row_blocks(horizon, n)
    determined, ranks = determined_subspace(A, C, tolerance)
    hidden = _complement(determined)
    eigenvalues = np.linalg.eigvals(hidden.T @ A @ hidden).astype(complex)
    eigenvalues = eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")]
    # an integrator's eigenvalue is one up to rounding
    detectable = bool((np.abs(eigenvalues) < 1 - 1e-9).all())
    return ObservabilityReport(
        classification=_classify(determined.shape[1], n, detectable),
        rank=ranks[min(horizon, len(ranks)) - 1],
        horizon=horizon,
        index=len(ranks) if ranks[-1] else 0,
        detectable=detectable,
        unobservable_eigenvalues=eigenvalues,
        unobservable_basis=hidden,
        state_names=names,
    )


def observability(
    model: Model,
    horizon: int | None = None,
    *,
    trajectory: Trajectory | None = None,
    parameters: Any = None,
    tolerance: float = 1e-9,
) -> ObservabilityReport:
    """Observability of a model, as if every sensor reported at every instant.

    Args:
        model: a `LinearModel`, whose pair (A, C) is examined, or a `NonlinearModel`, whose linearization along a window
            is.
        horizon: row blocks counted in the rank, for a nonlinear model the length of the window; n if None.
        trajectory: the window of a nonlinear model (one trial, at least `horizon` instants), for instance from
            `simulate`; the noise-free motion from the prior mean if None.
        parameters: (r,) of a nonlinear model.
        tolerance: on singular values, relative to those of the Jacobians.

    Raises:
        DefinitionError: no trajectory was given and the model has inputs or no prior mean to start from.
        DataError: the trajectory is too short or not of this model.
        SettingError: a horizon below 1.
    """
    from problems.models.linear import LinearModel

    if isinstance(model, LinearModel):
        return pair_observability(model.A, model.C, horizon, state_names=model.state_names, tolerance=tolerance)
    n = model.state_size
    horizon = _row_blocks(horizon, n)
    states, inputs = _window(model, horizon, trajectory, parameters)
    transitions = [model.transition_jacobian(states[k], inputs[k], parameters) for k in range(horizon - 1)]
    outputs = [model.output_jacobian(states[k], inputs[max(k - 1, 0)], parameters) for k in range(horizon)]
    determined = [_window_subspace(transitions, outputs[:blocks], tolerance) for blocks in range(1, horizon + 1)]
    ranks = [subspace.shape[1] for subspace in determined]
    complete = ranks[-1] == n
    return ObservabilityReport(
        classification=_classify(ranks[-1], n, detectable=False),
        rank=ranks[-1],
        horizon=horizon,
        index=ranks.index(ranks[-1]) + 1 if ranks[-1] else 0,
        detectable=True if complete else None,
        unobservable_eigenvalues=np.zeros(0, dtype=complex),
        unobservable_basis=_complement(determined[-1]),
        state_names=model.state_names,
    )


def require_observable(report: ObservabilityReport, what: str = "the model") -> ObservabilityReport:
    """The report, if it says ``observable``.

    Raises:
        UnobservableError: names `what` and the directions of the state that no measurement determines.
    """
    if report.classification == "observable":
        return report
    raise UnobservableError(
        f"{what} is not observable, {report}; add a sensor that sees these directions or leave them out of the state"
    )


def determined_subspace(A: np.ndarray, C: np.ndarray, tolerance: float) -> tuple[np.ndarray, list[int]]:
    """Orthonormal basis (n, rank) of the row space of [C; CA; ...], and its rank after each block that adds to it."""
    basis = _orthonormal([_scaled(C).T], tolerance)
    ranks = [basis.shape[1]]
    while True:
        wider = _orthonormal([basis, _scaled(A).T @ basis], tolerance)
        if wider.shape[1] == ranks[-1]:
            return basis, ranks
        basis = wider
        ranks.append(basis.shape[1])


def _window_subspace(transitions: list[np.ndarray], outputs: list[np.ndarray], tolerance: float) -> np.ndarray:
    """Directions of the first state of a time-varying window that its outputs determine, found from its end."""
    basis = _orthonormal([_scaled(outputs[-1]).T], tolerance)
    for k in range(len(outputs) - 2, -1, -1):
        basis = _orthonormal([_scaled(outputs[k]).T, _scaled(transitions[k]).T @ basis], tolerance)
    return basis


def _scaled(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.linalg.norm(matrix, 2) if matrix.any() else matrix


def _orthonormal(columns: list[np.ndarray], tolerance: float) -> np.ndarray:
    vectors, values, _ = np.linalg.svd(np.hstack(columns), full_matrices=False)
    return vectors[:, values > tolerance]


def _complement(basis: np.ndarray) -> np.ndarray:
    return np.linalg.svd(basis, full_matrices=True)[0][:, basis.shape[1] :]


def _echelon(rows: np.ndarray) -> np.ndarray:
    """Row-reduced form, which shows single states where a direction is one."""
    reduced = rows.copy()
    for k in range(len(reduced)):
        pivot_row, pivot = np.unravel_index(np.argmax(np.abs(reduced[k:])), reduced[k:].shape)
        reduced[[k, k + pivot_row]] = reduced[[k + pivot_row, k]]
        reduced[k] /= reduced[k, pivot]
        others = np.arange(len(reduced)) != k
        reduced[others] -= np.outer(reduced[others, pivot], reduced[k])
    return reduced[np.argsort([np.argmax(np.abs(row) > 1e-6) for row in reduced], kind="stable")]


def _combination(coefficients: np.ndarray, names: tuple[str, ...]) -> str:
    """``x1 - 0.5 x3``, beginning with a positive term."""
    used = np.flatnonzero(np.abs(coefficients) > 1e-6)
    signed = coefficients * np.sign(coefficients[used[0]])
    terms = [f"{'-' if signed[k] < 0 else '+'} {_factor(abs(signed[k]))}{names[k]}" for k in used]
    return " ".join(terms).removeprefix("+ ")


def _factor(size: float) -> str:
    return "" if abs(size - 1) < 1e-6 else f"{size:.3g} "


def _classify(rank: int, size: int, detectable: bool) -> Classification:
    if rank == size:
        return "observable"
    if rank == 0:
        return "blind"
    return "detectable" if detectable else "partly"


def _row_blocks(horizon: int | None, size: int) -> int:
    if horizon is None:
        return size
    if int(horizon) != horizon or horizon < 1:
        raise SettingError(f"horizon: expected a whole number of row blocks of at least 1, got {horizon!r}")
    return int(horizon)


def _window(
    model: Model, horizon: int, trajectory: Trajectory | None, parameters: Any
) -> tuple[np.ndarray, np.ndarray]:
    """States (>= horizon, n) and inputs (>= horizon - 1, m) to linearize along."""
    if trajectory is not None:
        states, inputs = trajectory.states, trajectory.inputs
        if states.ndim != 2 or states.shape[1] != model.state_size or len(states) < horizon:
            raise DataError(
                f"trajectory: expected one trial of at least {horizon} instants with {model.state_size} states, "
                f"got shape {states.shape}"
            )
        return states, inputs
    if model.input_size or model.mean is None:
        missing = "has inputs" if model.input_size else "has no prior mean to start from"
        raise DefinitionError(f"the model {missing}; pass the trajectory to linearize along, e.g. simulate(...)")
    states = [model.mean]
    for _ in range(horizon - 1):
        states.append(model.step(states[-1], None, parameters))
    return np.array(states), np.zeros((horizon, 0))
