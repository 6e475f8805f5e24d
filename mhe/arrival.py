"""Arrival costs: what is known about the first state of a window from everything before it.

A cost ``1/2 d'Md + linear'd`` on ``d = (x_s, parameters) - reference``, whose numbers are data of the window's problem.
The rules differ in where they come from once the window is full (dmhe-pre-estimation 3.1, 3.2 and (2.11)-(2.15)):

- ``filter``: the oldest instant is integrated out of the window (`Session.marginal`). Linear and unconstrained this is
  the Kalman filter; nonlinear it is its extended form, linearized at the window's estimate, with gradient correction.
- ``seed``: reference x_{t-N|t-1}, weight (2.15). Counts the data of the window twice.
- ``smoothing``: reference x_{t-N|t-1}, weight its covariance, less what the window's data told about it.

A matrix is passed on only when it changed, so nothing is factorized again in steady state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from mhe.covariance import SETTLED_TOLERANCE, disturbance_response, riccati_step, symmetrized, window_noise
from mhe.window import Window
from problems.errors import SettingError, UnknownNameError
from problems.forms.affine_marginal import AffineMarginal
from problems.models import LinearModel, Model
from problems.networks.observability import observability_matrix
from problems.solvers.qp_recursion import Following
from problems.solvers.qp_session import QPSession
from problems.solvers.session import Session, Solution

Prior = Literal["filter", "seed", "smoothing"]
CovarianceRule = Literal["riccati", "constant"]
GrowthPrior = Literal["mean", "own"]


@dataclass(eq=False)
class WindowState:
    """The window of an estimator as its last step left it.

    Attributes:
        states: estimates (N + 1, n); slots that hold no instant yet are predictions.
        parameters: (r,) estimated or given, or None.
        measurements: (N + 1, p), NaN where missing.
        inputs: (N + 1, m); row k acted up to slot k.
        session: of the window's problem.
        solution: of the last step; None before the first one.
        located: a step was solved, so the session has a point.
    """

    states: np.ndarray
    parameters: np.ndarray | None
    measurements: np.ndarray
    inputs: np.ndarray
    session: Session
    solution: Solution | None = None
    located: bool = False

    def values(self) -> dict[str, Any]:
        """Values of the window's variables to linearize at."""
        values: dict[str, Any] = {"x": self.states}
        if "parameters" in self.session.problem.unknowns:
            values["parameters"] = self.parameters
        return values


class ArrivalCost(ABC):
    """One rule; `start`, `grow` and `slide` return new data of the window's problem by name.

    Args:
        model: with a prior.
        window: whose arrival cost it is.
        mean, covariance: of the first state, or of state and parameters together.
        growth_prior: while the window fills, ``mean`` keeps mu_0 (full information), ``own`` moves the reference to
            x_{0|t-1} (dmhe-pre-estimation 4.2 item 4).

    Attributes:
        takes_leaving: a late measurement of the instant that leaves in a step still counts.
    """

    takes_leaving: ClassVar[bool] = False

    def __init__(
        self, model: Model, window: Window, mean: np.ndarray, covariance: np.ndarray, growth_prior: GrowthPrior
    ) -> None:
        if growth_prior not in get_args(GrowthPrior):
            raise UnknownNameError("growth prior", growth_prior, get_args(GrowthPrior))
        self.model, self.window, self.growth_prior = model, window, growth_prior
        self._mean, self._covariance = mean, covariance
        self._start_information = inverse(covariance)
        self._computed = self._passed = self._start_information

    def start(self) -> dict[str, Any]:
        """Data before the first step: mu_0 and Pi_0."""
        self._computed = self._passed = self._start_information
        return {
            "reference": self._mean,
            "information": self._start_information,
            "linear": np.zeros(self._mean.size),
        }

    def grow(self, now: WindowState) -> dict[str, Any]:
        """Data for a window that gains a slot and loses none."""
        if self.growth_prior == "mean":
            return {}
        if self.window.parameters is None:
            return {"reference": now.states[0]}
        assert now.parameters is not None
        return {"reference": np.concatenate([now.states[0], now.parameters])}

    @abstractmethod
    def slide(self, now: WindowState) -> dict[str, Any]:
        """Data for the window after its oldest instant left; `now` is the window before."""

    @abstractmethod
    def settled(self, now: WindowState) -> bool:
        """Whether the next windows differ in nothing but vectors while no measurement is missing.

        Args:
            now: a full window of a quadratic session with all its measurements.
        """

    def following(self, now: WindowState) -> Following:
        """How `slide` makes reference and linear part of the next window, once settled."""
        layout = now.session.layout
        kept = np.concatenate([layout.columns(slot).ravel() for slot in self.window.kept])
        on_reference, on_data, constant = self._linear(now)
        s, at = kept.size, np.arange(kept.size)
        Z, D = np.zeros((2 * s, layout.size)), np.zeros((2 * s, layout.data_size))
        Z[at, kept] = 1.0
        Z[s:, kept], D[s:] = on_reference, on_data
        numbers = np.concatenate([layout.data_start[name] + at for name in ("reference", "linear")])
        return Following(numbers, Z, D, np.concatenate([np.zeros(s), constant]))

    def _linear(self, now: WindowState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The next linear part by the next reference (s, s) and the data (s, data), and a constant (s,)."""
        s = self._mean.size
        return np.zeros((s, s)), np.zeros((s, now.session.layout.data_size)), np.zeros(s)

    def _information(self, matrix: np.ndarray) -> dict[str, Any]:
        """`matrix` as data, where it differs from what the session has."""
        if matrix is self._computed:
            return {}
        self._computed = matrix
        if np.abs(matrix - self._passed).max() <= SETTLED_TOLERANCE * np.abs(matrix).max():
            return {}
        self._passed = matrix
        return {"information": matrix.reshape(1, -1)}  # as the session stores it


class FilterArrival(ArrivalCost):
    """Integrates the oldest instant out of the window, by the session of the window itself."""

    takes_leaving = True

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._drop, self._keep = self.window.first, self.window.kept

    def slide(self, now: WindowState) -> dict[str, Any]:
        # an affine marginal does not depend on the point, so the session's own last one serves
        affine = now.session.form == "quadratic" and now.located
        marginal = now.session.marginal(self._drop, self._keep, None if affine else now.values())
        references = marginal.reference
        reference = references[0] if len(references) == 1 else np.hstack(references)
        return {
            "reference": reference,
            "linear": -marginal.vector[None],
            **self._information(marginal.information),
        }

    def settled(self, now: WindowState) -> bool:
        return self._map(now).M is self._computed

    def _map(self, now: WindowState) -> AffineMarginal:
        assert isinstance(now.session, QPSession)
        return now.session.marginal_map(self._drop, self._keep)

    def _linear(self, now: WindowState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        marginal = self._map(now)
        return marginal.M, marginal.G, marginal.g


class SeedArrival(ArrivalCost):
    """Second entry of the sequence found before, with the weight (2.15) or the constant Pi_0."""

    def __init__(self, *arguments: Any, rule: CovarianceRule) -> None:
        super().__init__(*arguments)
        if rule not in get_args(CovarianceRule):
            raise UnknownNameError("covariance rule", rule, get_args(CovarianceRule))
        self.rule = rule
        self._current, self._settled = self._covariance, False

    def start(self) -> dict[str, Any]:
        self._current, self._settled = self._covariance, False
        return super().start()

    def slide(self, now: WindowState) -> dict[str, Any]:
        data: dict[str, Any] = {"reference": now.states[1:2]}
        if self.rule == "constant":
            return data
        used = self.window.used(now.measurements[0])
        linear = isinstance(self.model, LinearModel)
        if self._settled and linear and used.all():
            return data
        if isinstance(self.model, LinearModel):
            A, C = self.model.A, self.model.C
        else:
            A = self.model.transition_jacobian(now.states[0], now.inputs[1], now.parameters)
            C = self.model.output_jacobian(now.states[0], now.inputs[0], now.parameters)
        noise = self.model.R[np.ix_(used, used)]
        following = riccati_step(self._current, A, C[used], self.model.process_covariance, noise)
        change = np.abs(following - self._current).max()
        self._settled = bool(used.all() and change <= SETTLED_TOLERANCE * np.abs(following).max())
        self._current = following
        return data | self._information(inverse(following))

    def settled(self, now: WindowState) -> bool:
        return self.rule == "constant" or self._settled


class SmoothingArrival(ArrivalCost):
    """x_{t-N|t-1} with its covariance, less the share of y_{t-N}..y_{t-1}, which the window will count again."""

    model: LinearModel

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        if not isinstance(self.model, LinearModel):
            raise SettingError("prior='smoothing' needs a LinearModel; use 'filter', its nonlinear equivalent")
        model, N = self.model, self.window.horizon
        self._free = observability_matrix(model.A, model.C, N)
        self._noise = window_noise(model.A, model.C, model.process_covariance, model.R, N)
        self._pushed = disturbance_response(model.A, model.C, N)
        self._shares: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        self._matrices: dict[bytes, np.ndarray] = {}

    def start(self) -> dict[str, Any]:
        self._matrices = {}
        return super().start()

    def slide(self, now: WindowState) -> dict[str, Any]:
        used = self.window.used(now.measurements)
        later = used[1:].ravel()
        key = later.tobytes()
        share = self._shares.get(key)
        if share is None:
            seen = self._free[later]
            weighted = np.linalg.solve(self._noise[np.ix_(later, later)], seen).T
            share = self._shares[key] = weighted, symmetrized(weighted @ seen)
        weighted, counted = share
        key = used.tobytes()
        matrix = self._matrices.get(key)
        if matrix is None:
            assert now.solution is not None
            smoothed = now.solution.covariance(self.window.x[1])
            matrix = self._matrices[key] = symmetrized(inverse(smoothed) - counted)
        reference = now.states[1]
        pushes = (now.inputs[2:] @ self.model.B.T).ravel()
        predicted = self._free @ reference + self._pushed @ pushes
        deviation = (now.measurements[1:].ravel() - predicted)[later]
        data = self._information(matrix)
        if data:
            self._matrices = {}
        return {"reference": reference[None], "linear": (weighted @ deviation)[None], **data}

    def settled(self, now: WindowState) -> bool:
        matrix = self._matrices.get(np.ones(now.measurements.shape, dtype=bool).tobytes())
        return matrix is not None and matrix is self._computed

    def _linear(self, now: WindowState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        _, on_data, constant = super()._linear(now)
        weighted = self._shares[np.ones(now.measurements[1:].size, dtype=bool).tobytes()][0]
        start = now.session.layout.data_start
        p, m = now.measurements.shape[1], now.inputs.shape[1]
        on_data[:, start["y"] + p : start["y"] + now.measurements.size] = weighted
        if m:
            pushes = np.kron(np.eye(len(now.inputs) - 2), self.model.B)
            on_data[:, start["u"] + 2 * m : start["u"] + now.inputs.size] = -weighted @ self._pushed @ pushes
        return -weighted @ self._free, on_data, constant


def arrival_cost(
    prior: Prior,
    model: Model,
    window: Window,
    mean: np.ndarray,
    covariance: np.ndarray,
    growth_prior: GrowthPrior,
    rule: CovarianceRule,
) -> ArrivalCost:
    """The arrival cost of that name.

    Raises:
        UnknownNameError: an unknown name.
        SettingError: a rule that does not go with the window or the model.
    """
    if prior not in get_args(Prior):
        raise UnknownNameError("prior", prior, get_args(Prior))
    if prior != "seed" and rule != "riccati":
        raise SettingError(f"a {rule} arrival covariance goes with prior='seed', not with {prior!r}")
    if prior != "seed" and window.gain is not None:
        raise SettingError(
            f"prior={prior!r} integrates out the disturbance that a pre-estimation window does not have; use 'seed'"
        )
    if prior != "filter" and window.parameters is not None:
        raise SettingError(f"parameters are estimated with prior='filter' only, not with {prior!r}")
    common = (model, window, mean, covariance, growth_prior)
    if prior == "filter":
        return FilterArrival(*common)
    return SeedArrival(*common, rule=rule) if prior == "seed" else SmoothingArrival(*common)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Symmetric inverse of a positive definite matrix."""
    return symmetrized(np.linalg.inv(matrix))
