"""`NonlinearModel`: dynamics and outputs written in CasADi symbols."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import casadi as ca

from problems.errors import DefinitionError, SettingError
from problems.models._symbols import evaluate
from problems.models.base import Model
from problems.models.sensor import Sensor


class NonlinearModel(Model):
    """x_{k+1} = f(x_k, u_k, p) + G w_k, y_k = h(x_k, u_{k-1}, p) + v_k.

    Args:
        dynamics: f, a plain function of CasADi columns x, then u and p where they are declared (trailing ones may be
            left out; arguments with defaults are left alone), returning a column or a list of expressions; or a CasADi
            Function; or an expression over the symbols given as `states`, `inputs`, `parameters`.
        Q: covariance (q, q) of w per step, symmetric positive definite (also of a continuous model).
        states, inputs, parameters: numbers of components, or CasADi columns (SX or MX) of the user's own symbols.
        G: gain (n, q) of the disturbance, the identity if None.
        sensors: sensors with output matrices, functions, or expressions over the same symbols.
        mean, covariance: of x_0; the mean is zero where only the covariance is given.
        state_names: n names for reports; x1, x2, ... if None.
        dt: sampling time (s); needed where `continuous`.
        continuous: `dynamics` is the time derivative of x and is integrated over `dt` with the input held.
        method: ``"rk4"`` or ``"euler"``, in `substeps` equal parts.

    Raises:
        DefinitionError: dynamics or an output that does not fit the declared symbols, fails on them or uses others;
            repeated names; `continuous` without `dt`.
        ShapeError: wrong shapes. NoiseError: a covariance that is not finite, symmetric, positive definite.
        SettingError: an unknown method or fewer than one substep.
    """

    def __init__(
        self,
        dynamics: Any,
        Q: Any,
        states: int | ca.SX | ca.MX,
        *,
        inputs: int | ca.SX | ca.MX = 0,
        parameters: int | ca.SX | ca.MX = 0,
        G: Any = None,
        sensors: Iterable[Sensor] = (),
        mean: Any = None,
        covariance: Any = None,
        state_names: Sequence[str] | None = None,
        dt: float | None = None,
        continuous: bool = False,
        method: Literal["rk4", "euler"] = "rk4",
        substeps: int = 1,
    ) -> None:
        kind = ca.MX if any(isinstance(s, ca.MX) for s in (states, inputs, parameters)) else ca.SX
        self._symbols = (
            _declared(kind, "states", "x", states),
            _declared(kind, "inputs", "u", inputs),
            _declared(kind, "parameters", "p", parameters),
        )
        n, m, r = (int(s.numel()) for s in self._symbols)
        if n < 1:
            raise DefinitionError("states: a model has at least one state")
        self._next = evaluate(dynamics, self._symbols, n, "dynamics")
        if continuous:
            if dt is None or not dt > 0:
                raise DefinitionError(f"dt: a continuous model needs its sampling time in seconds, got {dt!r}")
            self._next = _integrated(self._next, self._symbols, float(dt), method, substeps)
        super().__init__(
            (n, m, r),
            Q,
            G=G,
            sensors=sensors,
            mean=mean,
            covariance=covariance,
            state_names=state_names,
            dt=dt,
        )

    def _next_state(self) -> Any:
        return self._next


def _declared(kind: Any, what: str, name: str, given: Any) -> Any:
    """The user's own column of symbols, or a new one of that many components."""
    if isinstance(given, (ca.SX, ca.MX)):
        if not (given.is_column() and given.is_valid_input()):
            raise DefinitionError(f"{what}: expected a column of CasADi symbols, got {given}")
        if not isinstance(given, kind):
            raise DefinitionError(f"{what}: states, inputs and parameters must all be SX or all be MX symbols")
        return given
    if not isinstance(given, int) or given < 0:
        raise DefinitionError(f"{what}: expected a number of components or a column of CasADi symbols, got {given!r}")
    return kind.sym(name, given)


def _integrated(rate: Any, symbols: tuple[Any, Any, Any], dt: float, method: str, substeps: int) -> Any:
    if method not in ("rk4", "euler"):
        raise SettingError(f"method: expected 'rk4' or 'euler', got {method!r}")
    if int(substeps) != substeps or substeps < 1:
        raise SettingError(f"substeps: expected a whole number of at least 1, got {substeps!r}")
    x, u, p = symbols
    derivative = ca.Function("derivative", [x, u, p], [rate])
    h = dt / substeps
    for _ in range(int(substeps)):
        k1 = derivative(x, u, p)
        if method == "euler":
            x = x + h * k1
            continue
        k2 = derivative(x + h / 2 * k1, u, p)
        k3 = derivative(x + h / 2 * k2, u, p)
        k4 = derivative(x + h * k3, u, p)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
