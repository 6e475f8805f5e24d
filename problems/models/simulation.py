"""`simulate`: a model's motion and measurements, drawn from its own noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import DataError, SettingError, ShapeError
from problems.models.base import Model
from problems.models.linear import LinearModel
from problems.spaces import wrap


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One trial, or several with a leading axis.

    Attributes:
        times: (steps + 1,) s, or instants where the model has no sampling time.
        states: (..., steps + 1, n).
        measurements: (..., steps + 1, p); NaN where a sensor does not report.
        disturbances: w, (..., steps, q).
        inputs: (steps, m), or (..., steps, m) if they were given per trial.
    """

    times: np.ndarray
    states: np.ndarray
    measurements: np.ndarray
    disturbances: np.ndarray
    inputs: np.ndarray


def simulate(
    model: Model,
    steps: int,
    rng: np.random.Generator,
    *,
    inputs: Any = None,
    initial: Any = None,
    parameters: Any = None,
    trials: int | None = None,
) -> Trajectory:
    """Draw initial states, disturbances and measurement noise and let the model run.

    Args:
        model: any model; a `LinearModel` advances all trials at once.
        steps: transitions; there is one measurement more.
        rng: the only source of randomness; the same state of it gives the same bytes.
        inputs: (steps, m), or (trials, steps, m).
        initial: x_0 (n,), or (trials, n); drawn from the model's prior if None.
        parameters: (r,) where the model has them.
        trials: number of trials along a leading axis; None simulates one without that axis.

    Raises:
        SettingError: fewer than one step or trial, or something else than a Generator.
        ShapeError, DataError: inputs, initial state or parameters missing or of the wrong shape, or a state that
            ceases to be finite.
        DefinitionError: no initial state was given and the model has no prior.
    """
    for value, name in ((steps, "steps"), (1 if trials is None else trials, "trials")):
        if int(value) != value or value < 1:
            raise SettingError(f"{name}: expected a whole number of at least 1, got {value!r}")
    if not isinstance(rng, np.random.Generator):
        raise SettingError(f"rng: expected a numpy.random.Generator, got {type(rng).__name__}; use default_rng(seed)")
    batch = () if trials is None else (int(trials),)
    given = _inputs(model, inputs, batch, steps)
    if initial is None:
        mean, covariance = model.prior()
        start = mean + rng.standard_normal((*batch, model.state_size)) @ np.linalg.cholesky(covariance).T
    else:
        start = _given(initial, batch, (model.state_size,), "initial")
    disturbances = rng.standard_normal((*batch, steps, model.disturbance_size)) @ np.linalg.cholesky(model.Q).T
    noise = rng.standard_normal((*batch, steps + 1, model.measurement_size)) @ np.linalg.cholesky(model.R).T

    advance = _linear_advance(model) if isinstance(model, LinearModel) else _rowwise(model.step, parameters)
    states = np.empty((*batch, steps + 1, model.state_size))
    states[..., 0, :] = start
    pushes = disturbances @ model.G.T
    for k in range(steps):
        states[..., k + 1, :] = advance(states[..., k, :], given[..., k, :]) + pushes[..., k, :]
        if not np.isfinite(states[..., k + 1, :]).all():
            raise DataError(f"the state ceases to be finite at instant {k + 1}; check the model or its sampling time")
    return Trajectory(
        times=np.arange(steps + 1) * (model.dt or 1.0),
        states=states,
        measurements=_measured(model, states, given, parameters, noise),
        disturbances=disturbances,
        inputs=given,
    )


def _measured(model: Model, states: np.ndarray, inputs: np.ndarray, parameters: Any, noise: np.ndarray) -> np.ndarray:
    if isinstance(model, LinearModel):
        measurements = states @ model.C.T + noise
    else:
        acting = inputs[..., np.maximum(np.arange(states.shape[-2]) - 1, 0), :]
        measurements = _rowwise(model.output, parameters)(states, acting) + noise
    measurements[..., model.angles] = wrap(measurements[..., model.angles])
    for sensor in model.sensors:
        silent = np.arange(states.shape[-2]) % sensor.period != 0
        measurements[..., silent, model.rows(sensor.name)] = np.nan
    return measurements


def _linear_advance(model: LinearModel) -> Any:
    A, B = model.A.T, model.B.T
    return lambda x, u: x @ A + u @ B


def _rowwise(function: Any, parameters: Any) -> Any:
    """A function of one state and input applied along all leading axes."""

    def apply(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        u = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1]))
        rows = [function(x[index], u[index], parameters) for index in np.ndindex(x.shape[:-1])]
        return np.array(rows).reshape(*x.shape[:-1], -1)

    return apply


def _inputs(model: Model, inputs: Any, batch: tuple[int, ...], steps: int) -> np.ndarray:
    if inputs is None:
        if model.input_size:
            raise DataError(
                f"inputs: the model has {model.input_size} input(s); give an array ({steps}, {model.input_size})"
            )
        return np.zeros((steps, 0))
    return _given(inputs, batch, (steps, model.input_size), "inputs")


def _given(value: Any, batch: tuple[int, ...], shape: tuple[int, ...], what: str) -> np.ndarray:
    array = np.array(value, dtype=float)
    if array.shape not in (shape, (*batch, *shape)):
        raise ShapeError(f"{what}: expected shape {shape} or {(*batch, *shape)}, got {array.shape}")
    if not np.isfinite(array).all():
        raise DataError(f"{what}: every number must be finite")
    return array
