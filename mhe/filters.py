"""Kalman filter, extended and unscented Kalman filter under the protocol of all estimators.

The prior (mu_0, Pi_0) belongs to instant 0 and the first step updates it with y_0. Every later step predicts with
u_{t-1} and updates with y_t. Missing components (NaN) are left out. References: Kalman 1960; Bucy and Joseph 1968
(the form of the update); Bell and Cathey 1993 (iterated update); Julier and Uhlmann 2004, Wan and van der Merwe 2000
(unscented transform).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from mhe.estimate import Estimate
from problems.errors import DataError, DefinitionError, SettingError, ShapeError
from problems.models import LinearModel, Model
from problems.solvers.base import Status

Moments = tuple[np.ndarray, np.ndarray]


def kalman_update(covariance: np.ndarray, output: np.ndarray, noise: np.ndarray) -> Moments:
    """Gain and updated covariance of one measurement y = H x + v (Joseph form, symmetrized).

    Args:
        covariance: P before the measurement (n, n).
        output: H (p, n).
        noise: R (p, p), positive definite.

    Returns:
        Gain (n, p) and covariance (n, n) after the measurement.
    """
    cross = output @ covariance
    gain = np.linalg.solve(cross @ output.T + noise, cross).T
    kept = np.eye(len(covariance)) - gain @ output
    updated = kept @ covariance @ kept.T + gain @ noise @ gain.T
    return gain, (updated + updated.T) / 2


class GaussianFilter:
    """What the filters share: the order of a step, missing components, failures, the estimate.

    A step whose numbers cease to be finite or definite reports ``failed`` and keeps what was known before the part
    that failed, so that later steps can recover.

    Args:
        model: with a prior.
        parameters: (r,) where the model has them.
        initial_update: report x_{0|0} updated with y_0. If False the first step reports the prior, as the distributed
            algorithms of `dmhe-pre-estimation` 4.2 do; y_0 is used all the same and later steps do not differ.

    Raises:
        DefinitionError: the model has no prior, or is not of the kind the filter needs.
        DataError, ShapeError: parameters missing or of the wrong size.

    Attributes:
        mean, covariance: current (n,) and (n, n).
    """

    def __init__(self, model: Model, *, parameters: Any = None, initial_update: bool = True) -> None:
        self.model = model
        self.initial_update = initial_update
        self.parameters = _vector(parameters, model.parameter_size, "parameters")
        model.prior()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the prior: the next step is the first one."""
        mean, covariance = self.model.prior()
        self.mean, self.covariance = mean.copy(), covariance.copy()
        self._time: float | None = None

    def step(self, measurements: Any, inputs: Any = None, time: float | None = None) -> Estimate:
        """Predict (but at instant 0) and update.

        Args:
            measurements: y_t (p,), NaN where a component is missing; None where all are.
            inputs: u_{t-1} (m,), which acted since the previous instant. At instant 0 it is used only by outputs that
                depend on the input.
            time: of the measurement (s), later than the one before; the model's sampling time (1 without one) is
                counted on from the last one if None. Steps are one sampling time long whatever `time` says.

        Raises:
            DataError: a measurement or input that is infinite, an input that is missing or NaN, a time that does not
                advance.
            ShapeError: wrong shapes.
        """
        started = perf_counter()
        first = self._time is None
        y, available = self._measurement(measurements)
        u = self._input(inputs, first)
        self._time = self._instant(time)
        prior = self.mean, self.covariance
        healthy = first or self._accept(self._predicted, u)
        if available.any():
            healthy &= self._accept(self._updated, y, available, u)
        mean, covariance = prior if first and not self.initial_update else (self.mean, self.covariance)
        return Estimate(
            state=mean.copy(),
            covariance=covariance.copy(),
            window=None,
            status=Status.SOLVED if healthy else Status.FAILED,
            seconds=perf_counter() - started,
            infeasible=(),
            missing=tuple(np.flatnonzero(~available).tolist()),
            late=(),
            time=self._time,
            state_names=self.model.state_names,
        )

    def _predicted(self, u: np.ndarray) -> Moments:
        raise NotImplementedError

    def _updated(self, y: np.ndarray, available: np.ndarray, u: np.ndarray) -> Moments:
        raise NotImplementedError

    def _accept(self, part: Callable[..., Moments], *arguments: np.ndarray) -> bool:
        try:
            mean, covariance = part(*arguments)
        except np.linalg.LinAlgError:
            return False
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            return False
        self.mean, self.covariance = mean, covariance
        return True

    def _measurement(self, measurements: Any) -> tuple[np.ndarray, np.ndarray]:
        size = self.model.measurement_size
        y = np.full(size, np.nan) if measurements is None else np.array(measurements, dtype=float)
        if y.shape != (size,):
            raise ShapeError(f"measurements: expected shape ({size},), got {y.shape}")
        if np.isinf(y).any():
            raise DataError(f"measurements: component {int(np.argmax(np.isinf(y)))} is infinite; a missing one is NaN")
        return y, ~np.isnan(y)

    def _input(self, inputs: Any, first: bool) -> np.ndarray:
        if inputs is None and first and not self.model.feedthrough:
            return np.zeros(self.model.input_size)
        return _vector(inputs, self.model.input_size, "inputs")

    def _instant(self, time: float | None) -> float:
        if time is None:
            return 0.0 if self._time is None else self._time + (self.model.dt or 1.0)
        if not np.isfinite(time) or (self._time is not None and time <= self._time):
            raise DataError(f"time: expected a number later than the last step's {self._time}, got {time!r}")
        return float(time)


class KalmanFilter(GaussianFilter):
    """The Kalman filter of a `LinearModel`; arguments as for `GaussianFilter`."""

    model: LinearModel

    def __init__(self, model: LinearModel, *, initial_update: bool = True) -> None:
        _require_linear(model)
        super().__init__(model, initial_update=initial_update)

    def _predicted(self, u: np.ndarray) -> Moments:
        A = self.model.A
        covariance = A @ self.covariance @ A.T + self.model.process_covariance
        return A @ self.mean + self.model.B @ u, (covariance + covariance.T) / 2

    def _updated(self, y: np.ndarray, available: np.ndarray, u: np.ndarray) -> Moments:
        gain, covariance = kalman_update(self.covariance, *_rows(self.model.C, self.model.R, available))
        innovation = self.model.residual(y, self.model.C @ self.mean)
        return self.mean + gain @ innovation[available], covariance


class ExtendedKalmanFilter(GaussianFilter):
    """First-order extended Kalman filter; the Kalman filter on a `LinearModel`.

    Args:
        model, parameters, initial_update: as for `GaussianFilter`.
        iterations: linearizations of the output per update; more than one gives the iterated filter, whose update is
            the Gauss-Newton method on the same least-squares problem.

    Raises:
        SettingError: fewer than one iteration.
    """

    def __init__(
        self, model: Model, *, parameters: Any = None, initial_update: bool = True, iterations: int = 1
    ) -> None:
        if int(iterations) != iterations or iterations < 1:
            raise SettingError(f"iterations: expected a whole number of at least 1, got {iterations!r}")
        self.iterations = int(iterations)
        super().__init__(model, parameters=parameters, initial_update=initial_update)

    def _predicted(self, u: np.ndarray) -> Moments:
        jacobian = self.model.transition_jacobian(self.mean, u, self.parameters)
        covariance = jacobian @ self.covariance @ jacobian.T + self.model.process_covariance
        return self.model.step(self.mean, u, self.parameters), (covariance + covariance.T) / 2

    def _updated(self, y: np.ndarray, available: np.ndarray, u: np.ndarray) -> Moments:
        mean, covariance = self.mean, self.covariance
        for _ in range(self.iterations):
            innovation = self.model.residual(y, self.model.output(mean, u, self.parameters))[available]
            output, noise = _rows(self.model.output_jacobian(mean, u, self.parameters), self.model.R, available)
            gain, covariance = kalman_update(self.covariance, output, noise)
            mean = self.mean + gain @ (innovation - output @ (self.mean - mean))
        return mean, covariance


class UnscentedKalmanFilter(GaussianFilter):
    """Unscented Kalman filter with additive noise; sigma points are drawn anew after the prediction.

    Args:
        model, parameters, initial_update: as for `GaussianFilter`.
        alpha, beta, kappa: spread of the scaled unscented transform. The defaults keep every weight nonnegative, so
            that covariances stay definite.

    Raises:
        SettingError: a spread that leaves no positive distance of the sigma points.
    """

    def __init__(
        self,
        model: Model,
        *,
        parameters: Any = None,
        initial_update: bool = True,
        alpha: float = 1.0,
        beta: float = 2.0,
        kappa: float = 0.0,
    ) -> None:
        n = model.state_size
        self._spread = alpha**2 * (n + kappa)
        if not (np.isfinite([alpha, beta, kappa]).all() and self._spread > 0):
            raise SettingError(
                f"alpha, beta, kappa: alpha^2 (n + kappa) must be positive, got {alpha}, {beta}, {kappa}"
            )
        self._weight = 1 / (2 * self._spread)
        self._central_weight = 1 - n / self._spread + 1 - alpha**2 + beta
        super().__init__(model, parameters=parameters, initial_update=initial_update)

    def _offsets(self) -> np.ndarray:
        root = np.sqrt(self._spread) * np.linalg.cholesky(self.covariance).T
        return np.vstack([np.zeros(len(root)), root, -root])

    def _moments(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean and covariance of values given relative to the central one, and their distances from the mean."""
        mean = self._weight * deviations.sum(axis=0)
        centred = deviations - mean
        weights = np.full(len(deviations), self._weight)
        weights[0] = self._central_weight
        return mean, (weights * centred.T) @ centred, centred

    def _predicted(self, u: np.ndarray) -> Moments:
        points = np.array([self.model.step(x, u, self.parameters) for x in self.mean + self._offsets()])
        shift, covariance, _ = self._moments(points - points[0])
        covariance = covariance + self.model.process_covariance
        return points[0] + shift, (covariance + covariance.T) / 2

    def _updated(self, y: np.ndarray, available: np.ndarray, u: np.ndarray) -> Moments:
        offsets = self._offsets()
        outputs = np.array([self.model.output(x, u, self.parameters) for x in self.mean + offsets])
        deviations = self.model.residual(outputs, outputs[0])[:, available]
        shift, spread, centred = self._moments(deviations)
        total = spread + self.model.R[np.ix_(available, available)]
        cross = self._weight * offsets.T @ centred
        gain = np.linalg.solve(total, cross.T).T
        innovation = self.model.residual(y, outputs[0])[available] - shift
        covariance = self.covariance - gain @ total @ gain.T
        return self.mean + gain @ innovation, (covariance + covariance.T) / 2


@dataclass(frozen=True, eq=False)
class KalmanGains:
    """The part of the Kalman filter that does not depend on the measurements, instants 0 to `steps`.

    Attributes:
        gains: (steps + 1, n, p), zero in the columns of components that are missing.
        predicted, updated: covariances (steps + 1, n, n) before and after the measurement; the first predicted one is
            Pi_0.
        available: (steps + 1, p) bool.
    """

    gains: np.ndarray
    predicted: np.ndarray
    updated: np.ndarray
    available: np.ndarray


def kalman_gains(model: LinearModel, steps: int, available: Any = None) -> KalmanGains:
    """Gains and covariances of the Kalman filter over `steps` transitions.

    Args:
        model: with a prior.
        steps: transitions, at least 0.
        available: (steps + 1, p) bool, which components are there; all if None.

    Raises:
        DefinitionError: not a `LinearModel`, or one without prior.
        SettingError: `steps` is not a whole number. ShapeError: `available` has the wrong shape.
    """
    _require_linear(model)
    if int(steps) != steps or steps < 0:
        raise SettingError(f"steps: expected a whole number of at least 0, got {steps!r}")
    n, p = model.state_size, model.measurement_size
    there = np.ones((steps + 1, p), dtype=bool) if available is None else np.array(available, dtype=bool)
    if there.shape != (steps + 1, p):
        raise ShapeError(f"available: expected shape {(steps + 1, p)}, got {there.shape}")
    gains, predicted, updated = np.zeros((steps + 1, n, p)), np.empty((steps + 1, n, n)), np.empty((steps + 1, n, n))
    _, covariance = model.prior()
    for k in range(steps + 1):
        if k:
            covariance = model.A @ covariance @ model.A.T + model.process_covariance
            covariance = (covariance + covariance.T) / 2
        predicted[k] = covariance
        if there[k].any():
            gain, covariance = kalman_update(covariance, *_rows(model.C, model.R, there[k]))
            gains[k][:, there[k]] = gain
        updated[k] = covariance
    return KalmanGains(gains, predicted, updated, there)


def kalman_trials(
    model: LinearModel, measurements: Any, inputs: Any = None, gains: KalmanGains | None = None
) -> np.ndarray:
    """Kalman filter estimates of many trials at once, with gains computed once.

    Args:
        model: with a prior.
        measurements: (..., steps + 1, p); NaN at the same places in all trials.
        inputs: (..., steps, m) or (steps, m); row k acts from instant k to k + 1.
        gains: of `kalman_gains` for these steps and missing components; computed if None.

    Returns:
        x_{t|t}, (..., steps + 1, n), equal to `KalmanFilter` trial by trial.

    Raises:
        DataError: trials (or `gains`) differ in what is missing, an infinite number, or inputs that are missing.
        ShapeError: wrong shapes. DefinitionError: as for `kalman_gains`.
    """
    _require_linear(model)
    y = np.array(measurements, dtype=float)
    if y.ndim < 2 or y.shape[-1] != model.measurement_size or not y.shape[-2]:
        raise ShapeError(f"measurements: expected shape (..., steps + 1, {model.measurement_size}), got {y.shape}")
    steps = y.shape[-2] - 1
    if inputs is None and model.input_size:
        raise DataError(f"inputs: the model has {model.input_size} input(s) and none were given")
    u = np.zeros((steps, 0)) if inputs is None else np.array(inputs, dtype=float)
    if u.shape[-2:] != (steps, model.input_size):
        raise ShapeError(f"inputs: expected shape (..., {steps}, {model.input_size}), got {u.shape}")
    if np.isinf(y).any() or not np.isfinite(u).all():
        raise DataError(
            "measurements and inputs must be finite; a missing measurement is NaN, an input cannot be missing"
        )
    there = ~np.isnan(y)
    pattern = there.reshape(-1, *y.shape[-2:])[0] if there.size else np.zeros(y.shape[-2:], dtype=bool)
    if gains is None:
        gains = kalman_gains(model, steps, pattern)
    if gains.available.shape != pattern.shape or not (there == gains.available).all():
        raise DataError(
            "measurements: what is missing must be the same in every trial and in the gains; use KalmanFilter"
        )
    states = np.empty((*y.shape[:-1], model.state_size))
    mean, _ = model.prior()
    for k in range(steps + 1):
        if k:
            mean = states[..., k - 1, :] @ model.A.T + u[..., k - 1, :] @ model.B.T
        innovation = model.residual(y[..., k, :], mean @ model.C.T)
        states[..., k, :] = mean + np.where(pattern[k], innovation, 0.0) @ gains.gains[k].T
    return states


def _rows(output: np.ndarray, noise: np.ndarray, available: np.ndarray) -> Moments:
    if available.all():
        return output, noise
    return output[available], noise[np.ix_(available, available)]


def _require_linear(model: Model) -> None:
    if not isinstance(model, LinearModel):
        raise DefinitionError(
            f"a Kalman filter needs a LinearModel, got {type(model).__name__}; "
            "use ExtendedKalmanFilter or UnscentedKalmanFilter"
        )


def _vector(value: Any, size: int, what: str) -> np.ndarray:
    if value is None:
        if size:
            raise DataError(f"{what}: the model needs {size} component(s) and got none")
        return np.zeros(0)
    array = np.atleast_1d(np.array(value, dtype=float))
    if array.shape != (size,):
        raise ShapeError(f"{what}: expected shape ({size},), got {array.shape}")
    if not np.isfinite(array).all():
        raise DataError(f"{what}: every number must be finite, got {array}")
    return array
