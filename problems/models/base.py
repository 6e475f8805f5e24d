"""`Model`: what linear and nonlinear models have in common, so that an estimator is written once."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np

from problems.errors import DataError, DefinitionError, ShapeError, UnknownNameError
from problems.models import _checks
from problems.models._symbols import SYMBOLIC, ArrayFunction
from problems.models.sensor import Sensor
from problems.spaces import wrap

_NOTHING = np.zeros(0)


class Model(ABC):
    """Dynamics x_{k+1} = f(x_k, u_k, p) + G w_k and sensors y_k = h(x_k, u_{k-1}, p) + v_k, with Gaussian w, v, x_0.

    `step`, `output` and their Jacobians take CasADi columns (and return expressions, to be used in the terms of a
    problem) or arrays (and return arrays). Inputs and parameters may be left out where the model has none. An
    input acts from one instant to the next; a sensor whose output depends on the input sees the one that acted up to
    the measurement, and at instant 0 the first one. Symbols as in `dmhe-pre-estimation` section 2.

    Attributes:
        state_size, input_size, parameter_size, disturbance_size, measurement_size: numbers of components n, m, r, q, p.
        Q: covariance (q, q) of the disturbance w.
        G: gain (n, q) of the disturbance; the identity unless given.
        R: covariance (p, p) of all sensors together, block diagonal.
        sensors: the sensors, in the order of their rows.
        angles: (p,) bool, components of y whose residual wraps to (-pi, pi].
        mean, covariance: of x_0, (n,) and (n, n), or None.
        state_names: n names.
        dt: sampling time (s), or None.
    """

    _symbols: tuple[Any, Any, Any]

    def __init__(
        self,
        sizes: tuple[int, int, int],
        Q: Any,
        *,
        G: Any,
        sensors: Iterable[Sensor],
        mean: Any,
        covariance: Any,
        state_names: Sequence[str] | None,
        dt: float | None,
    ) -> None:
        self.state_size, self.input_size, self.parameter_size = sizes
        n = self.state_size
        self.G = _checks.matrix(np.eye(n) if G is None else G, n, None, "disturbance gain G")
        self.disturbance_size = self.G.shape[1]
        self.Q = _checks.covariance(Q, self.disturbance_size, "disturbance covariance Q")
        self.covariance = None if covariance is None else _checks.covariance(covariance, n, "initial covariance Pi_0")
        if mean is None and covariance is not None:
            mean = np.zeros(n)
        self.mean = None if mean is None else _checks.vector(mean, n, "initial mean mu_0")
        self.state_names = tuple(state_names) if state_names is not None else tuple(f"x{k + 1}" for k in range(n))
        if len(self.state_names) != n or len(set(self.state_names)) != n:
            raise DefinitionError(f"state_names: expected {n} different names, got {self.state_names}")
        if dt is not None and not (np.isfinite(dt) and dt > 0):
            raise DefinitionError(f"dt: expected a positive sampling time in seconds, got {dt!r}")
        self.dt = None if dt is None else float(dt)
        self._attach(sensors)

    def _attach(self, sensors: Iterable[Sensor]) -> None:
        self.sensors = tuple(sensors)
        names = [s.name for s in self.sensors]
        if len(set(names)) != len(names):
            raise DefinitionError(f"sensors: names must differ, got {names}")
        sizes = [self._output_size(s) for s in self.sensors]
        ends = np.cumsum([0, *sizes]).tolist()
        self.measurement_size = ends[-1]
        self._rows = {name: slice(a, b) for name, a, b in zip(names, ends[:-1], ends[1:], strict=True)}
        R = np.zeros((self.measurement_size, self.measurement_size))
        angles = np.zeros(self.measurement_size, dtype=bool)
        for sensor, size in zip(self.sensors, sizes, strict=True):
            rows = self._rows[sensor.name]
            R[rows, rows] = sensor.covariance(size)
            angles[rows][list(sensor.angles)] = True
        R.setflags(write=False)
        angles.setflags(write=False)
        self.R, self.angles = R, angles

    def _output_size(self, sensor: Sensor) -> int:
        if sensor.matrix is None:
            return sensor.expression(self._symbols).shape[0]
        return _checks.matrix(sensor.matrix, None, self.state_size, f"sensor {sensor.name!r}: C").shape[0]

    @abstractmethod
    def _next_state(self) -> Any:
        """f(x, u, p) as an expression in the symbols."""

    def with_sensors(self, sensors: Iterable[Sensor]) -> Self:
        """The same dynamics and prior observed by other sensors: a node's local or regional model."""
        other = copy.copy(self)
        other._attach(sensors)
        return other

    def __getstate__(self) -> dict[str, Any]:
        # what is derived depends on the sensors, and buffers can neither be shared nor pickled
        kept = self.__dict__.items()
        return {k: v for k, v in kept if not isinstance(getattr(type(self), k, None), cached_property)}

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__}: {self.state_size} states, {self.input_size} inputs, "
            f"{self.measurement_size} measurements from {len(self.sensors)} sensor(s)>"
        )

    # Expressions and array code

    @cached_property
    def transition_function(self) -> ca.Function:
        """CasADi Function (x, u, p) -> f(x, u, p)."""
        return ca.Function(
            "transition", list(self._symbols), [ca.densify(self._next_state())], ["x", "u", "p"], ["next"]
        )

    @cached_property
    def output_function(self) -> ca.Function:
        """CasADi Function (x, u, p) -> h(x, u, p), all sensors stacked."""
        y = ca.vertcat(*(sensor.expression(self._symbols) for sensor in self.sensors))
        return ca.Function("output", list(self._symbols), [ca.densify(y)], ["x", "u", "p"], ["y"])

    @cached_property
    def transition_jacobian_function(self) -> ca.Function:
        """CasADi Function (x, u, p) -> (f, df/dx)."""
        return self._with_jacobian(self.transition_function)

    @cached_property
    def output_jacobian_function(self) -> ca.Function:
        """CasADi Function (x, u, p) -> (h, dh/dx)."""
        return self._with_jacobian(self.output_function)

    def _with_jacobian(self, function: ca.Function) -> ca.Function:
        value = function(*self._symbols)
        jacobian = ca.densify(ca.jacobian(value, self._symbols[0]))
        return ca.Function(f"{function.name()}_jacobian", list(self._symbols), [value, jacobian])

    @cached_property
    def _transition(self) -> ArrayFunction:
        return ArrayFunction(self.transition_function)

    @cached_property
    def _output(self) -> ArrayFunction:
        return ArrayFunction(self.output_function)

    @cached_property
    def _transition_jacobian(self) -> ArrayFunction:
        return ArrayFunction(self.transition_jacobian_function)

    @cached_property
    def _output_jacobian(self) -> ArrayFunction:
        return ArrayFunction(self.output_jacobian_function)

    @cached_property
    def feedthrough(self) -> bool:
        """Whether a sensor's output depends on the input."""
        x, u, p = self._symbols
        return bool(ca.jacobian(self.output_function(x, u, p), u).nnz())

    def _arguments(self, *given: Any) -> list[Any]:
        checked = []
        sizes = (self.state_size, self.input_size, self.parameter_size)
        for value, size, name in zip(given, sizes, ("state", "input", "parameters"), strict=True):
            if type(value) is np.ndarray and value.shape == (size,):
                checked.append(value)
                continue
            if value is None:
                if size:
                    raise DataError(f"{name}: the model needs {size} component(s) and got none")
                value = _NOTHING
            elif not isinstance(value, SYMBOLIC):
                value = np.asarray(value, dtype=float)
            if value.shape not in ((size,), (size, 1)) and not (size == 1 and value.shape == ()):
                raise ShapeError(f"{name}: the model needs {size} component(s), got shape {value.shape}")
            checked.append(value)
        return checked

    def _evaluate(self, function: str, x: Any, u: Any, p: Any) -> Any:
        """The last output of a function: the value, or the Jacobian beside it."""
        x, u, p = arguments = self._arguments(x, u, p)
        if isinstance(x, SYMBOLIC) or isinstance(u, SYMBOLIC) or isinstance(p, SYMBOLIC):
            found = getattr(self, f"{function}_function")(*arguments)
            return found[-1] if isinstance(found, tuple) else found
        return getattr(self, f"_{function}")(x, u, p)

    def step(self, x: Any, u: Any = None, p: Any = None) -> Any:
        """Next state without disturbance, f(x, u, p).

        Args:
            x: state (n,), an array or a CasADi column.
            u: input (m,) acting until the next instant; p: parameters (r,). Needed where the model has them.

        Returns:
            (n,) array, or a CasADi column if any argument is one.

        Raises:
            ShapeError, DataError: an argument has the wrong size or is missing.
        """
        return self._evaluate("transition", x, u, p)

    def output(self, x: Any, u: Any = None, p: Any = None) -> Any:
        """Noise-free measurement h(x, u, p) of all sensors, (p,); `u` acted up to this instant. As `step` otherwise."""
        return self._evaluate("output", x, u, p)

    def transition_jacobian(self, x: Any, u: Any = None, p: Any = None) -> Any:
        """df/dx (n, n). Arguments and errors as for `step`."""
        return self._evaluate("transition_jacobian", x, u, p)

    def output_jacobian(self, x: Any, u: Any = None, p: Any = None) -> Any:
        """dh/dx (p, n). Arguments and errors as for `output`."""
        return self._evaluate("output_jacobian", x, u, p)

    def residual(self, measured: Any, predicted: Any) -> Any:
        """``measured - predicted``, angles wrapped to (-pi, pi]: arrays (..., p) or CasADi columns."""
        difference = measured - predicted
        if not self.angles.any():
            return difference
        if isinstance(difference, SYMBOLIC):
            rows: list[Any] = ca.vertsplit(difference)
            return ca.vertcat(*(wrap(d) if angle else d for d, angle in zip(rows, self.angles, strict=True)))
        difference[..., self.angles] = wrap(difference[..., self.angles])
        return difference

    def rows(self, sensor: str) -> slice:
        """Rows of y that belong to a sensor.

        Raises:
            UnknownNameError: no sensor of that name.
        """
        if sensor not in self._rows:
            raise UnknownNameError("sensor", sensor, self._rows)
        return self._rows[sensor]

    @cached_property
    def process_covariance(self) -> np.ndarray:
        """Covariance G Q G' (n, n) of the disturbance in state coordinates, possibly singular."""
        return self.G @ self.Q @ self.G.T

    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and covariance (n, n) of x_0.

        Raises:
            DefinitionError: the model was stated without them.
        """
        if self.mean is None or self.covariance is None:
            raise DefinitionError(
                "the model has no prior on its initial state; give mean= and covariance= (mu_0, Pi_0)"
            )
        return self.mean, self.covariance
