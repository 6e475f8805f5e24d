"""Centralized moving horizon estimation: `mhe` estimates disturbances, `mhe_pre` replaces them by an observer.

Both are `MovingHorizonEstimator` with different options. Source: dmhe-pre-estimation 3.1, 3.2 and 4.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any, Literal, get_args

import numpy as np

from mhe.arrival import CovarianceRule, GrowthPrior, Prior, WindowState, arrival_cost
from mhe.estimate import WindowEstimate
from mhe.observers import check_gain, given_gain, kalman_gain
from mhe.polyhedron import Polyhedron
from mhe.settled import SettledWindow
from mhe.slots import Late, Slots, finite
from mhe.window import Window, WindowForm
from problems.errors import DataError, SettingError, ShapeError, UnknownNameError
from problems.models import LinearModel, Model, observability, require_observable
from problems.noise import Loss
from problems.solvers.base import Status
from problems.solvers.qp_recursion import Recursion, RecursionSolution
from problems.solvers.session import Session, Solution

Infeasible = Literal["predict", "soft"]

_SOLVED = (Status.SOLVED, Status.INACCURATE)
_STOPPED = (Status.ITERATION_LIMIT, Status.TIME_LIMIT)


class MovingHorizonEstimator:
    """Moving horizon estimator of one model with all its measurements.

    A window keeps the newest N + 1 instants; it is compiled once and filled step by step. Missing components are NaN.

    Args:
        model: with a prior; linear or nonlinear.
        horizon: N >= 1 transitions.
        gain: L (n, p) of the pre-estimation observer (`mhe_pre`); None estimates the disturbances (`mhe`).
        prior: arrival cost, see `mhe.arrival`; by default ``filter``, with pre-estimation ``seed``.
        arrival_covariance: ``riccati`` (2.15) or ``constant`` Pi_0, for ``prior="seed"``.
        growth_prior: reference while the window fills, ``mean`` (full information) or ``own``.
        form: of the window, see `mhe.window.Window`.
        solver: name of a registered solver.
        losses: robust losses by sensor name.
        state_bounds, disturbance_bounds: hard bounds in the window.
        parameters: (r,) known parameters of the model.
        parameter_prior: mean (r,) and covariance (r, r) of parameters to be estimated, instead of `parameters`.
        iterations: exact number of Gauss-Newton steps per measurement (1: real-time iteration); None converges. A
            quadratic window is solved in one step anyway.
        infeasible: where no sequence meets the bounds, ``predict`` gives the prediction, ``soft`` relaxes the bounds by
            slacks with an exact penalty; the step's status says infeasible in both cases.
        penalty: weight of these slacks, per unit of violation.
        initial_update: report x_{0|0} updated with y_0; if False the first step reports mu_0 and nothing is solved, as
            in dmhe-pre-estimation 4.2.
        require_sound: refuse a linear model that is not observable and a gain that does not stabilize; if False, warn.
        settings: of the solver: `tolerance`, `time_limit`, `iteration_limit` and its own.

    Raises:
        DefinitionError, ShapeError, SettingError, UnknownNameError, FormError: about the arguments.
        UnobservableError, UnstableError: see `require_sound`.

    Attributes:
        window: the problem that is solved.
        options: all options by name, defaults included.
    """

    def __init__(
        self,
        model: Model,
        horizon: int,
        *,
        gain: Any = None,
        prior: Prior | None = None,
        arrival_covariance: CovarianceRule = "riccati",
        growth_prior: GrowthPrior = "mean",
        form: WindowForm | None = None,
        solver: str = "auto",
        losses: Mapping[str, Loss] | None = None,
        state_bounds: Polyhedron | None = None,
        disturbance_bounds: Polyhedron | None = None,
        parameters: Any = None,
        parameter_prior: tuple[Any, Any] | None = None,
        iterations: int | None = None,
        infeasible: Infeasible = "predict",
        penalty: float = 1e4,
        initial_update: bool = True,
        require_sound: bool = True,
        **settings: Any,
    ) -> None:
        if infeasible not in get_args(Infeasible):
            raise UnknownNameError("answer to infeasible windows", infeasible, get_args(Infeasible))
        self.model, self.initial_update = model, initial_update
        _check_model(model, gain, require_sound)
        mean, covariance = _prior(model, parameter_prior)
        self._given = None if parameters is None else finite(parameters, model.parameter_size, "parameters")
        if model.parameter_size and (parameters is None) == (parameter_prior is None):
            raise SettingError(
                f"the model has {model.parameter_size} parameter(s); give their values as parameters= or a mean and "
                "covariance as parameter_prior="
            )
        stated: dict[str, Any] = {
            "form": form,
            "gain": gain,
            "losses": losses,
            "state_bounds": state_bounds,
            "disturbance_bounds": disturbance_bounds,
            "estimate_parameters": parameter_prior is not None,
        }
        self.window = Window(model, horizon, **stated)
        self._quadratic = self.window.quadratic(solver)
        if iterations is not None and not self._quadratic:
            settings["iterations"] = iterations
        self._compile = {"solver": solver, **settings}
        self._session: Session = self.window.compile(**self._compile)
        self._soft_window: Window | None = None
        if infeasible == "soft" and self.window.bounds:
            self._soft_window = Window(model, horizon, penalty=penalty, **stated)
        self._soft_session: Session | None = None
        chosen: Prior = prior or ("filter" if gain is None else "seed")
        self._arrival = arrival_cost(chosen, model, self.window, mean, covariance, growth_prior, arrival_covariance)
        self._mean = mean
        self._feedback = iterations == 1 and not self._quadratic
        self._states = [self.window.x[k] for k in range(self.window.horizon + 1)]
        self._slots = Slots(model, self.window.horizon)
        self._settled = SettledWindow(self.window, self._arrival)
        self._shape = (model.measurement_size,)
        # what all estimates of settled steps have in common
        self._common: dict[str, Any] = {
            "status": Status.SOLVED,
            "infeasible": (),
            "missing": (),
            "late": (),
            "too_late": (),
            "state_names": model.state_names,
            "parameters": self._given,
            "_slot": self._states[-1] if gain is None else None,
        }
        self.options: dict[str, Any] = {
            "disturbance": "process_noise" if gain is None else "pre_estimation",
            "horizon": self.window.horizon,
            "prior": chosen,
            "arrival_covariance": arrival_covariance,
            "growth_prior": growth_prior,
            "form": self.window.form_for(solver),
            "solver": solver,
            "iterations": iterations,
            "infeasible": infeasible,
            "bounds": self.window.bounds,
            "losses": {name: repr(loss) for name, loss in (losses or {}).items()},
            **settings,
        }
        self.reset()

    @property
    def session(self) -> Session:
        """The window's session, with the data of the last step."""
        self._pause()
        return self._session

    def reset(self) -> None:
        """Forget everything but the prior: the next step is the first one. Everything compiled stays."""
        self._recursion: Recursion | None = None
        self._followed: RecursionSolution | None = None
        self._regular = False
        n, slots = self.model.state_size, self._slots
        self._session.reset()
        slots.clear()
        parameters = self._given if self.window.parameters is None else self._mean[n:].copy()
        states = np.tile(self._mean[:n], (self.window.horizon + 1, 1))
        self._now = WindowState(states, parameters, slots.measurements, slots.inputs, self._session)
        self._before = states
        self._ready: tuple[np.ndarray, np.ndarray | None] | None = None
        self._data: dict[str, Any] = {"y": slots.column, **self._arrival.start()}
        if self._given is not None:
            self._data["parameters"] = self._given

    def prepare(self, inputs: Any = None) -> None:
        """Do ahead of the next measurement what does not need it: shift, arrival cost, linearization.

        Args:
            inputs: the input (m,) that acts until that measurement.

        Raises:
            DataError: no step was taken yet, or the preparation was already made; an input that is missing or NaN.
        """
        slots = self._slots
        if not slots.filled or self._ready is not None:
            raise DataError("prepare comes once between two steps")
        self._pause()
        self._regular = False
        u = slots.input(inputs)
        self._advance(u)
        guess = None if self._quadratic else self._guess()
        self._ready = u, guess
        # what is prepared depends on which components are expected, here all of them, and hardly on their values
        expected = 0.0 if guess is None else self.model.output(guess[slots.newest], u, self._now.parameters)
        slots.measurements[slots.newest] = expected
        if self._feedback and guess is not None:
            self._linearize(guess)
        else:
            self._session.update(**self._data)
            self._data = {"y": slots.column}

    def step(self, measurements: Any, inputs: Any = None, time: float | None = None, late: Late = ()) -> WindowEstimate:
        """Take the measurement of the next instant and estimate the window.

        Args:
            measurements: y_t (p,), NaN where a component is missing; None where all are.
            inputs: u_{t-1} (m,), which acted since the previous instant; not needed again after `prepare`.
            time: of the measurement (s); the model's sampling time is counted on from the last one if None.
            late: measurements of earlier instants that arrive now, pairs (time, (p,) with NaN for what it does not
                tell). They complete or replace what the instant nearest in time has.

        Returns:
            The estimate. What a solver does wrong is in its status; the state is then the prediction.

        Raises:
            DataError: infinite numbers, an input that is missing or NaN, a time that does not advance, a late
                measurement that fits no instant.
            ShapeError: wrong shapes.
        """
        started = perf_counter()
        if self._regular and not late:
            estimate = self._follow(measurements, inputs, time, started)
            if estimate is not None:
                return estimate
        self._pause()
        slots, ready = self._slots, self._ready
        y, missing = slots.measurement(measurements)
        u = ready[0] if ready is not None and inputs is None else slots.input(inputs)
        if ready is not None and inputs is not None and not np.array_equal(u, ready[0]):
            raise DataError("inputs: they differ from those the step was prepared with")
        instant = slots.instant(time)
        amendments = slots.late(late, instant) if late else []
        used: list[float] = []
        first = not slots.filled
        if ready is None:
            if amendments and not first and self._arrival.takes_leaving:
                amendments = slots.amend(amendments, used)
                # the arrival cost is made from what the session knows
                self._session.update(y=slots.column)
            self._advance(u)
        slots.enter(y, instant)
        if amendments:
            amendments = slots.amend(amendments, used)
        covariance, solution = None, None
        if first and not self.initial_update:
            status, infeasible, covariance = Status.SOLVED, (), self.model.prior()[1].copy()
        else:
            status, solution = self._solve(bool(missing) or bool(used))
            infeasible = () if status in _SOLVED or status in _STOPPED else self._fall_back(status)
        self._regular = slots.slid and status is Status.SOLVED and self._quadratic
        states, newest = self._now.states, slots.newest
        noisy = status in _SOLVED and solution is not None and self.window.gain is None
        return WindowEstimate(
            {
                "state": states[newest].copy(),
                "window": states[: newest + 1].copy(),
                "status": status,
                "seconds": perf_counter() - started,
                "infeasible": infeasible,
                "missing": missing,
                "late": tuple(used),
                "too_late": tuple([when for when, _ in amendments]),
                "time": instant,
                "state_names": self.model.state_names,
                "solution": solution,
                "parameters": self._now.parameters,
                "_slot": self._states[newest] if noisy else None,
                "_covariance": covariance,
            }
        )

    def _follow(self, measurements: Any, inputs: Any, time: float | None, started: float) -> WindowEstimate | None:
        """A step of a settled window; None where it takes the long way, with nothing changed."""
        recursion, slots = self._recursion, self._slots
        if recursion is None:
            recursion = self._recursion = self._settled.recursion(self._now)
            if recursion is None:
                self._regular = False
                return None
        record = np.asarray(measurements, dtype=float)
        if record.shape != self._shape or not record.dot(record) < np.inf:
            return None
        if inputs is not None or self.model.input_size:
            record = np.concatenate((record, slots.input(inputs)))
        instant = slots.instant(time)
        solution = recursion.step(record)
        if solution is None:
            return None
        self._followed = solution
        slots.times.append(instant)
        reported = solution.reported
        seconds = solution.spent = perf_counter() - started
        fields = self._common | {"state": reported, "seconds": seconds, "time": instant, "solution": solution}
        if self.window.parameters is not None:
            fields["state"], fields["parameters"] = np.split(reported, [self.model.state_size])
        return WindowEstimate(fields)

    def _pause(self) -> None:
        """Bring slots, window and session up to date with the settled steps since the last ordinary one."""
        recursion, self._recursion = self._recursion, None
        solution, self._followed = self._followed, None
        if recursion is None or solution is None:
            return
        recursion.hand_back(solution.point)
        self._slots.restore(recursion.records)
        self._take(solution)
        self._now.solution = solution

    def _advance(self, u: np.ndarray) -> None:
        """Make room for the next instant and bring the arrival cost up to date."""
        slots = self._slots
        self._before = self._now.states
        if slots.full:
            self._data.update(self._arrival.slide(self._now))
        elif slots.filled:
            self._data.update(self._arrival.grow(self._now))
        slots.advance(u)
        if u.size:
            self._data["u"] = slots.inputs
        if self.window.bounds and not slots.slid:
            self._data["filled"] = slots.flags()

    def _solve(self, irregular: bool) -> tuple[Status, Solution]:
        """Solve the window for the data gathered and take over its estimate."""
        data, ready, before = self._data, self._ready, self._now.solution
        self._data, self._ready = {"y": self._slots.column}, None
        if self._quadratic:
            solution = self._session.solve(data)
        else:
            guess = self._guess() if ready is None or ready[1] is None else ready[1]
            if ready is not None and self._feedback:
                if irregular:  # the preparation counted on all components, and on earlier ones as they were
                    self._linearize(guess)
                solution = self._session.solve(data)
            else:
                solution = self._session.solve(data, self._values(guess))
        status = solution.status
        stale = solution.iterations == 0 or (before is not None and solution.point is before.point)
        if status in _STOPPED and stale:
            status = Status.FAILED
        if status in _SOLVED or status in _STOPPED:
            self._take(solution)
            self._now.located = True
        self._now.solution = solution
        return status, solution

    def _take(self, solution: Solution) -> None:
        self._now.states = solution["x"]
        if self.window.parameters is not None:
            self._now.parameters = solution["parameters"][0]

    def _fall_back(self, status: Status) -> tuple[str, ...]:
        """Estimate without a solution of the hard window; names of the bounds that could not be met."""
        self._now.states = self._guess()
        if status is not Status.INFEASIBLE:
            return ()
        everything = tuple(f"{name} bounds" for name in self.window.bounds)
        if self._soft_window is None:
            return everything
        if self._soft_session is None:
            self._soft_session = self._soft_window.compile(**self._compile)
        store = self._session.store
        inputs = self._session.problem.inputs.items()
        data = {name: store[name] for name, entry in inputs if entry.of is None}
        solution = self._soft_session.solve(data, None if self._quadratic else {"x": self._now.states})
        if solution.status not in _SOLVED:
            return everything
        self._take(solution)
        return self._soft_window.unmet(solution, self._slots.filled)

    def _linearize(self, guess: np.ndarray) -> None:
        self._session.update(**self._data)
        self._data = {"y": self._slots.column}
        self._session.prepare(self._values(guess))

    def _values(self, guess: np.ndarray) -> dict[str, Any]:
        """Values to start from; everything else enters linearly."""
        values: dict[str, Any] = {"x": guess}
        if self.window.parameters is not None:
            values["parameters"] = self._now.parameters
        return values

    def _guess(self) -> np.ndarray:
        """The window before, moved on by the model without disturbance."""
        slots, before = self._slots, self._before
        guess = before.copy()
        if slots.slid:
            guess[:-1] = before[1:]
        for k in range(max(slots.newest, 1), len(guess)):
            moved = self.model.step(guess[k - 1], slots.inputs[k], self._now.parameters)
            # a prediction that leaves the model's domain is no start; standing still is
            guess[k] = moved if moved.dot(moved) < np.inf else guess[k - 1]
        return guess


def mhe(model: Model, horizon: int = 5, **options: Any) -> MovingHorizonEstimator:
    """Moving horizon estimator that estimates the disturbances (`MHE` of the source).

    Args:
        options: see `MovingHorizonEstimator`; a gain belongs to `mhe_pre`.

    Raises:
        SettingError: a gain; else as for `MovingHorizonEstimator`.
    """
    if options.get("gain") is not None:
        raise SettingError("mhe estimates the disturbances and takes no gain; use mhe_pre")
    return MovingHorizonEstimator(model, horizon, **options)


def mhe_pre(model: Model, horizon: int = 5, *, gain: Any = None, **options: Any) -> MovingHorizonEstimator:
    """Moving horizon estimator with pre-estimation (`MHE_pre` of the source).

    Args:
        gain: L (n, p); by default the stationary Kalman gain of a `LinearModel`.
        options: see `MovingHorizonEstimator`.

    Raises:
        SettingError: no gain for a nonlinear model; else as for `MovingHorizonEstimator`.
    """
    if gain is None:
        if not isinstance(model, LinearModel):
            raise SettingError("mhe_pre on a nonlinear model needs a gain L (n, p); pass gain=")
        gain = kalman_gain(model.A, model.C, model.process_covariance, model.R).gain
    return MovingHorizonEstimator(model, horizon, gain=gain, **options)


def _check_model(model: Model, gain: Any, require_sound: bool) -> None:
    """Conditions 3 and 4 of dmhe-pre-estimation section 5, for linear models."""
    if not isinstance(model, LinearModel):
        return
    report = observability(model)
    if require_sound:
        require_observable(report)
    if gain is not None:
        check_gain(given_gain(model.A, model.C, gain), allow_unstable=not require_sound)


def _prior(model: Model, parameter_prior: tuple[Any, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of what the arrival cost is about: the state, with the parameters that are estimated."""
    mean, covariance = model.prior()
    if parameter_prior is None:
        return mean.copy(), covariance.copy()
    n, r = model.state_size, model.parameter_size
    first = finite(parameter_prior[0], r, "parameter_prior: mean")
    second = np.asarray(parameter_prior[1], dtype=float)
    if second.shape != (r, r):
        raise ShapeError(f"parameter_prior: expected a covariance ({r}, {r}), got shape {second.shape}")
    joint = np.zeros((n + r, n + r))
    joint[:n, :n], joint[n:, n:] = covariance, second
    return np.concatenate([mean, first]), joint
