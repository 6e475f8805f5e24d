"""`Window`: the local estimation problem of every moving horizon estimator, stated once for any model.

N + 1 slots of states, of which the first `filled` hold instants; what is absent (measurements of future slots of a
filling window, sensors that did not report) is data, so one compiled problem serves all steps. Centralized and
distributed estimators differ in the data they feed: regional measurements, and the arrival cost
``1/2 d'Md + linear'd`` with ``d = (x_0, parameters) - reference``.

Source: dmhe-pre-estimation 3.1-3.4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np

from mhe.polyhedron import Polyhedron
from problems import registry
from problems.errors import FormError, SettingError, ShapeError, UnknownNameError
from problems.models import Model
from problems.noise import L2, Gaussian, Loss
from problems.problem import Data, Problem, Slot, Variable
from problems.soft import Soft
from problems.solvers.compile import ALIASES, is_affine
from problems.solvers.session import Session, Solution
from problems.spaces import Vector

WindowForm = Literal["F1", "F2", "F3", "P1", "P2"]
SLACK_CURVATURE = 1.0  # makes the Hessian of slacks definite; an exact penalty stays exact with it
VIOLATED = 1e-6  # slack beyond which a soft bound counts as not met


class Window:
    """The window of a model as a `Problem`.

    Process noise (`gain` None): the disturbances are estimated. F1 has states and disturbances as unknowns, F2 states
    only, F3 the first state and the disturbances. Pre-estimation (`gain` given): the disturbance is L (y_k - h(x_k)),
    a missing component adding nothing. P1 has all states as unknowns, P2 the first one. F3 and P2 condense and exist
    for quadratic programs only; F2 needs a square, nonsingular disturbance gain G.

    Data of the problem, by name: ``y`` ((N + 1) p, NaN where missing, time first), ``u`` (N + 1, m; row k acted up to
    slot k), ``parameters`` (r, where they are not estimated), ``filled`` (N + 1 flags, where states or disturbances
    have bounds), ``gain`` (N, n, p; row k of the transition from slot k, where it is data), ``reference`` (k,),
    ``information`` (k, k) and ``linear`` (k,) of the arrival cost, k = n or n + r. Variables: ``x``, in F1 and F3
    ``w``, ``parameters`` where they are estimated, slacks where bounds are soft.

    Args:
        model: any model; its sensors are those of a node, of a region or of the whole network.
        horizon: N >= 1 transitions.
        form: one of `WindowForm`; by default F2 where G allows it, else F3 or F1, and P2 or P1, whichever the solver
            takes.
        gain: L (n, p) of the pre-estimation observer, or ``"data"`` for one per transition that is data of the
            problem; None estimates the disturbances.
        losses: robust losses by sensor name.
        state_bounds: of the states in all filled slots.
        disturbance_bounds: of the disturbances between filled slots (of L (y - h) with pre-estimation).
        residual_bounds: of the residuals y_k - h(x_k) of sensors by name, in the slots in which all components of the
            sensor are there.
        estimate_parameters: the parameters are unknowns, constant over the window.
        penalty: weight of the slacks of soft bounds, per unit of violation; None keeps the bounds hard. It is exact
            while it exceeds every multiplier of the hard problem.

    Raises:
        SettingError, UnknownNameError, ShapeError: about the arguments.
        FormError: a form the model does not have.

    Attributes:
        problem: the problem.
        x, w, parameters: its variables; None where the form or the model has none.
        bounds: names of the bounds it has.
    """

    def __init__(
        self,
        model: Model,
        horizon: int,
        *,
        form: WindowForm | None = None,
        gain: Any = None,
        losses: Mapping[str, Loss] | None = None,
        state_bounds: Polyhedron | None = None,
        disturbance_bounds: Polyhedron | None = None,
        residual_bounds: Mapping[str, Polyhedron] | None = None,
        estimate_parameters: bool = False,
        penalty: float | None = None,
    ) -> None:
        if isinstance(horizon, bool) or int(horizon) != horizon or horizon < 1:
            raise SettingError(f"horizon: expected a whole number of transitions of at least 1, got {horizon!r}")
        if penalty is not None and not (np.isfinite(penalty) and penalty > 0):
            raise SettingError(f"penalty: expected a positive number, got {penalty!r}")
        for name, bounds in (("state_bounds", state_bounds), ("disturbance_bounds", disturbance_bounds)):
            if not (bounds is None or isinstance(bounds, Polyhedron)):
                raise SettingError(
                    f"{name}: expected a Polyhedron such as Polyhedron.box(lower, upper), got {bounds!r}"
                )
        if estimate_parameters and not model.parameter_size:
            raise SettingError("the model has no parameters to estimate")
        self.model, self.horizon = model, int(horizon)
        self.gain: Any = gain if gain is None or isinstance(gain, str) else _gain(gain, model)
        if isinstance(gain, str) and gain != "data":
            raise UnknownNameError("gain", gain, ["data"])
        self.form: WindowForm | None = self._statement(form)
        self.penalty = penalty
        self.problem = Problem(f"window of {self.horizon} transitions")
        N, n, m, r = self.horizon, model.state_size, model.input_size, model.parameter_size
        self.x: Variable = self.problem.variables("x", Vector(n), N + 1)
        self.w: Variable | None = None
        self.parameters: Variable | None = None
        if estimate_parameters:
            self.parameters = self.problem.variables("parameters", Vector(r))
        absent = np.full((N + 1) * model.measurement_size, np.nan)
        self._y: Data | None = None
        if model.measurement_size:
            self._y = self.problem.data("y", (), absent.size, value=absent)
        self._u: Data | None = self.problem.data("u", m, N + 1, value=np.zeros((N + 1, m))) if m else None
        self._p: Data | None = self.problem.data("parameters", r) if r and not estimate_parameters else None
        self._gain: Data | None = None
        if isinstance(gain, str) and model.measurement_size:
            self._gain = self.problem.data("gain", (n, model.measurement_size), N)
        self._arrival()
        for name in losses or {}:
            model.rows(name)
        self._whole: list[slice] = []
        for sensor in model.sensors:
            self._output(sensor.name, (losses or {}).get(sensor.name))
        self._transitions()
        self.bounds: tuple[str, ...] = ()
        if state_bounds is not None or disturbance_bounds is not None:
            self._filled = self.problem.data("filled", (), N + 1, value=np.ones(N + 1))
        if state_bounds is not None:
            self._bound("state", state_bounds, n)
        if disturbance_bounds is not None:
            disturbance_bounds.warn_without_origin("disturbance bounds")
            self._bound("disturbance", disturbance_bounds, n if gain is not None else model.disturbance_size)
        for name, polyhedron in (residual_bounds or {}).items():
            polyhedron.warn_without_origin(f"bounds of the residuals of sensor {name!r}")
            self._bound_residuals(name, polyhedron)

    def compile(self, solver: str = "auto", **settings: Any) -> Session:
        """A session for the window; arguments and errors as for `Problem.compile`.

        Raises:
            FormError: also where F3 or P2 was asked for and the solver or the problem is not quadratic.
        """
        if self.form in ("F3", "P2"):
            if not self.quadratic(solver):
                raise FormError(
                    f"form {self.form} condenses a quadratic program; {self._reason(solver)}, use "
                    f"{'F1 or F2' if self.gain is None else 'P1'}"
                )
            return self.problem.compile(solver, eliminate=[self.x[1:]], **settings)
        if self.form is None and self.quadratic(solver):
            return self.problem.compile(solver, eliminate=[self.x[1:]], **settings)
        return self.problem.compile(solver, **settings)

    def form_for(self, solver: str) -> WindowForm:
        """The form that `compile` gives to a solver."""
        if self.form is not None:
            return self.form
        condensed = self.quadratic(solver)
        if self.gain is None:
            return "F3" if condensed else "F1"
        return "P2" if condensed else "P1"

    @property
    def first(self) -> tuple[Slot, ...]:
        """Slots that leave with the oldest instant: its state and the disturbance after it."""
        return (self.x[0],) if self.w is None else (self.x[0], self.w[0])

    @property
    def kept(self) -> tuple[Slot, ...]:
        """Slots that the arrival cost is about after the oldest instant left."""
        return (self.x[1],) if self.parameters is None else (self.x[1], self.parameters[0])

    def unmet(self, solution: Solution, filled: int) -> tuple[str, ...]:
        """Names of the soft bounds that a solution relaxes in the first `filled` slots."""
        slots = {"state": filled, "disturbance": filled - 1}
        return tuple(
            f"{name} bounds"
            for name in self.bounds
            if solution[f"{name} bounds slack"][: slots.get(name, filled)].max(initial=0.0) > VIOLATED
        )

    def used(self, measurements: np.ndarray) -> np.ndarray:
        """Which components (..., p) of measurements the costs use.

        A sensor with correlated components or a robust loss is used as a whole or not at all.
        """
        there = ~np.isnan(measurements)
        for rows in self._whole:
            there[..., rows] = there[..., rows].all(axis=-1, keepdims=True)
        return there

    def _statement(self, form: WindowForm | None) -> WindowForm | None:
        """The form, or None where it waits for the solver."""
        if form is not None and form not in get_args(WindowForm):
            raise UnknownNameError("form", form, get_args(WindowForm))
        square = self.model.disturbance_size == self.model.state_size and np.linalg.cond(self.model.G) < 1e12
        if self.gain is None:
            if form in ("P1", "P2"):
                raise FormError(f"form {form} is one of the pre-estimation window, which needs a gain")
            if form == "F2" and not square:
                raise FormError("form F2 needs a square, nonsingular disturbance gain G; use F1 or F3")
            return form or ("F2" if square else None)
        if form in ("F1", "F2", "F3"):
            raise FormError(f"form {form} estimates disturbances; a window with a pre-estimation gain is P1 or P2")
        return form

    def quadratic(self, solver: str) -> bool:
        """Whether a solver is given a quadratic program."""
        return is_affine(self.problem) and prefers_quadratic(solver)

    def _reason(self, solver: str) -> str:
        return f"solver {solver} takes another form" if is_affine(self.problem) else "this window is nonlinear"

    def _term(
        self, function: Callable[..., Any], slots: dict[str, Any], data: dict[str, Any], measured: Any = ()
    ) -> tuple[Callable[..., Any], tuple[Any, ...], tuple[Any, ...]]:
        """Residual, slots and data of a term from a function of keywords; `measured` data arrive as one column y."""
        names = [*slots, *data]

        def residual(*given: Any) -> Any:
            known = dict(zip(names, given, strict=False))
            if measured:
                known["y"] = ca.vertcat(*given[len(names) :])
            return function(**known)

        return residual, tuple(slots.values()), (*data.values(), *measured)

    def _model_term(
        self, function: Callable[..., Any], slots: dict[str, Any], data: dict[str, Any], measured: Any = ()
    ) -> tuple[Callable[..., Any], tuple[Any, ...], tuple[Any, ...]]:
        """`_term` of a function that also takes the parameters p, where the model has them."""
        if self.parameters is not None:
            slots = slots | {"p": self.parameters[0]}
        if self._p is not None:
            data = data | {"p": self._p}
        return self._term(function, slots, data, measured)

    def _arrival(self) -> None:
        size = self.model.state_size + (self.parameters.space.dim if self.parameters is not None else 0)
        reference = self.problem.data("reference", size)
        information = self.problem.data("information", (size, size))
        linear = self.problem.data("linear", size, value=np.zeros(size))
        slots = [self.x[0]] if self.parameters is None else [self.x[0], self.parameters[0]]
        self.problem.cost(
            "arrival",
            lambda *given: ca.vertcat(*given[:-1]) - given[-1],
            on=tuple(slots),
            data=reference,
            noise=Gaussian(information=information),
            linear=linear,
        )

    def _measured(self, rows: Any, slots: Any) -> list[Any]:
        """Data slots of components `rows` of y at `slots`, one per component."""
        assert self._y is not None
        p = self.model.measurement_size
        return [self._y[np.arange(self.horizon + 1)[slots] * p + row] for row in rows]

    def _output(self, name: str, loss: Loss | None) -> None:
        """Costs of one sensor. Independent components are costs of their own, so each may be missing by itself."""
        model = self.model.with_sensors([s for s in self.model.sensors if s.name == name])
        rows = range(self.model.measurement_size)[self.model.rows(name)]
        diagonal = not (model.R - np.diag(np.diagonal(model.R))).any()
        parts = [[k] for k in range(len(rows))] if diagonal and loss in (None, L2()) else [list(range(len(rows)))]
        if len(parts) < len(rows):
            self._whole.append(self.model.rows(name))
        for part in parts:

            def function(
                x: Any, y: Any, u: Any = None, p: Any = None, part: list[int] = part, model: Model = model
            ) -> Any:
                predicted = _predicted(model, x, u, p)
                measured = ca.SX(predicted.shape[0], 1)
                for place, k in enumerate(part):
                    measured[k] = y[place]
                return model.residual(measured, predicted)[part]

            data = {"u": self._u} if self._u is not None and model.feedthrough else {}
            residual, on, read = self._model_term(
                function, {"x": self.x}, data, self._measured([rows[k] for k in part], slice(None))
            )
            self.problem.cost(
                f"sensor {name}" if len(parts) == 1 else f"sensor {name}[{part[0]}]",
                residual,
                on=on,
                data=read,
                noise=Gaussian(covariance=model.R[np.ix_(part, part)]),
                loss=loss,
            )

    def _moved(self, x: Any, u: Any = None, p: Any = None) -> Any:
        return self.model.step(x, u, p)

    def _observed(self, gain: Any, x: Any, y: Any, u: Any = None, p: Any = None) -> Any:
        """L (y - h(x)) with the components that are there; `y` holds measurements, then presence flags."""
        size = self.model.measurement_size
        innovation = self.model.residual(y[:size], _predicted(self.model, x, u, p))
        return gain @ (y[size:] * innovation)

    def _transitions(self) -> None:
        inputs = {"u": self._u[1:]} if self._u is not None else {}
        if self.gain is not None:
            self._observer(inputs)
            return
        noise, G = Gaussian(covariance=self.model.Q), ca.DM(self.model.G)
        if self.form == "F2":
            back = ca.DM(np.linalg.inv(self.model.G))
            residual, on, data = self._model_term(
                lambda x, ahead, **rest: back @ (ahead - self._moved(x, **rest)),
                {"x": self.x[:-1], "ahead": self.x[1:]},
                inputs,
            )
            self.problem.cost("disturbance cost", residual, on=on, data=data, noise=noise)
            return
        self.w = self.problem.variables("w", Vector(self.model.disturbance_size), self.horizon)
        residual, on, data = self._model_term(
            lambda x, w, ahead, **rest: ahead - self._moved(x, **rest) - G @ w,
            {"x": self.x[:-1], "w": self.w, "ahead": self.x[1:]},
            inputs,
        )
        self.problem.equality("transition", residual, on=on, data=data)
        self.problem.cost("disturbance cost", lambda w: w, on=self.w, noise=noise)

    def _innovation_data(self, inputs: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Data of a term that reads measurements at the start of each transition."""
        if self._y is None:
            return inputs, []
        flags = self.problem.presence(self._y)
        p = self.model.measurement_size
        at = np.arange(self.horizon) * p
        measured = [self._y[at + k] for k in range(p)] + [flags[at + k] for k in range(p)]
        before = {"before": self._u[:-1]} if self._u is not None and self.model.feedthrough else {}
        return inputs | before, measured

    def _observer(self, inputs: dict[str, Any]) -> None:
        data, measured = self._innovation_data(inputs)
        fixed = None if isinstance(self.gain, str) else ca.DM(self.gain)
        if self._gain is not None:
            data = data | {"gain": self._gain}

        def function(
            x: Any, ahead: Any, y: Any = None, u: Any = None, before: Any = None, gain: Any = fixed, p: Any = None
        ) -> Any:
            moved = self._moved(x, u, p)
            if y is not None:
                moved = moved + self._observed(gain, x, y, u if before is None else before, p)
            return ahead - moved

        residual, on, read = self._model_term(function, {"x": self.x[:-1], "ahead": self.x[1:]}, data, measured)
        self.problem.equality("transition", residual, on=on, data=read)

    def _bound(self, name: str, polyhedron: Polyhedron, size: int) -> None:
        if polyhedron.size != size:
            raise ShapeError(f"{name} bounds: expected a polyhedron on {size} component(s), got {polyhedron!r}")
        if not polyhedron.matrix.shape[0]:
            return
        self.bounds = (*self.bounds, name)
        residual, on, data = self._bounded(name, polyhedron)
        self._inequality(name, residual, on, data, polyhedron, self._filled if name == "state" else self._filled[1:])

    def _bound_residuals(self, name: str, polyhedron: Polyhedron) -> None:
        """Bounds of a sensor's residuals; a slot in which it is missing switches its rows off."""
        model = self.model.with_sensors([s for s in self.model.sensors if s.name == name])
        rows = range(self.model.measurement_size)[self.model.rows(name)]
        if polyhedron.size != len(rows):
            raise ShapeError(
                f"residual bounds of sensor {name!r}: expected a polyhedron on {len(rows)} component(s), got "
                f"{polyhedron!r}"
            )
        if not polyhedron.matrix.shape[0]:
            return
        self.bounds = (*self.bounds, f"residual {name}")
        residual, on, data = self._model_term(
            lambda x, y, u=None, p=None: _rows_of(polyhedron, model.residual(y, _predicted(model, x, u, p))),
            {"x": self.x},
            {"u": self._u} if self._u is not None and model.feedthrough else {},
            self._measured(rows, slice(None)),
        )
        self._inequality(f"residual {name}", residual, on, data, polyhedron, None)

    def _inequality(
        self, name: str, residual: Callable[..., Any], on: Any, data: Any, polyhedron: Polyhedron, active: Any
    ) -> None:
        self.problem.inequality(
            f"{name} bounds",
            residual,
            on=on,
            data=data,
            lower=polyhedron.lower,
            upper=polyhedron.upper,
            active=active,
            soft=None if self.penalty is None else Soft(self.penalty, SLACK_CURVATURE),
        )

    def _bounded(
        self, name: str, polyhedron: Polyhedron
    ) -> tuple[Callable[..., Any], tuple[Any, ...], tuple[Any, ...]]:
        """Rows of a bound: residual, slots and data."""

        def rows(v: Any) -> Any:
            return _rows_of(polyhedron, v)

        if name == "state" or self.w is not None:
            return self._term(rows, {"v": self.x if name == "state" else self.w}, {})
        # what an observer adds is what it moves beyond the model, so its rows need no measurements
        back = ca.DM(np.eye(self.model.state_size) if self.gain is not None else np.linalg.inv(self.model.G))
        return self._model_term(
            lambda x, ahead, **rest: rows(back @ (ahead - self._moved(x, **rest))),
            {"x": self.x[:-1], "ahead": self.x[1:]},
            {"u": self._u[1:]} if self._u is not None else {},
        )


def prefers_quadratic(solver: str) -> bool:
    """Whether a registered solver is given a quadratic program where the problem is one."""
    if solver == "auto":
        return True
    entry = registry.load("solvers", ALIASES.get(solver, solver).partition(":")[0])
    return getattr(entry, "forms", ("quadratic",))[0] == "quadratic"


def _rows_of(polyhedron: Polyhedron, point: Any) -> Any:
    """Rows of a polyhedron at a CasADi column."""
    chosen = polyhedron.components
    return ca.DM(polyhedron.matrix) @ point if chosen is None else point[chosen.tolist()]


def _predicted(model: Model, x: Any, u: Any, p: Any) -> Any:
    return model.output(x, ca.DM.zeros(model.input_size) if u is None and model.input_size else u, p)


def _gain(gain: Any, model: Model) -> np.ndarray:
    array = np.asarray(gain, dtype=float)
    if array.shape != (model.state_size, model.measurement_size):
        raise ShapeError(
            f"pre-estimation gain: expected shape {(model.state_size, model.measurement_size)}, got {array.shape}"
        )
    if not np.isfinite(array).all():
        raise SettingError("pre-estimation gain: every number must be finite")
    return array
