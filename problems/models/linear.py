"""`LinearModel`: linear time-invariant dynamics and sensors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np

from problems.errors import DefinitionError
from problems.models import _checks
from problems.models.base import Model
from problems.models.observability import determined_subspace
from problems.models.sensor import Sensor


class LinearModel(Model):
    """x_{k+1} = A x_k + B u_k + G w_k, y_k = C x_k + v_k (`dmhe-pre-estimation` (2.1)-(2.3)).

    Args:
        A: (n, n).
        Q: covariance of w, (q, q), symmetric positive definite.
        B: gain (n, m) of a known input, or None.
        G: gain (n, q) of the disturbance, the identity if None; a disturbance of lower rank than n is stated with it.
        sensors: sensors whose outputs are matrices.
        mean, covariance: of x_0 (mu_0, Pi_0); the mean is zero where only the covariance is given.
        state_names: n names for reports; x1, x2, ... if None.
        dt: sampling time (s), used for time stamps.

    Raises:
        ShapeError: an array has the wrong shape.
        NoiseError: a covariance is not finite, symmetric or positive definite.
        DefinitionError: numbers that are not finite, repeated names, or a sensor that is not linear.

    Attributes:
        A, B, C: (n, n), (n, m) with m = 0 without inputs, and the collective (p, n).
    """

    def __init__(
        self,
        A: Any,
        Q: Any,
        B: Any = None,
        G: Any = None,
        *,
        sensors: Iterable[Sensor] = (),
        mean: Any = None,
        covariance: Any = None,
        state_names: Sequence[str] | None = None,
        dt: float | None = None,
    ) -> None:
        self.A = _checks.matrix(A, None, None, "state matrix A")
        n = self.A.shape[0]
        _checks.matrix(self.A, n, n, "state matrix A")
        self.B = _checks.matrix(np.zeros((n, 0)) if B is None else B, n, None, "input matrix B")
        super().__init__(
            (n, self.B.shape[1], 0),
            Q,
            G=G,
            sensors=sensors,
            mean=mean,
            covariance=covariance,
            state_names=state_names,
            dt=dt,
        )

    @classmethod
    def continuous(cls, A: Any, B: Any, Qc: Any, dt: float, *, G: Any = None, **common: Any) -> Self:
        """The model sampled from dx/dt = A x + B u + G w, exact for inputs held over each interval (Van Loan 1978).

        Args:
            A, B: (n, n) and (n, m) or None.
            Qc: intensity (q, q) of the white noise w, in squared state units per second.
            dt: sampling time (s).
            G: (n, q), the identity if None.
            common: `sensors`, `mean`, `covariance`, `state_names` as for the class.

        Returns:
            A model whose G spans the states that the noise reaches within one interval, and whose Q is the covariance
            on them: the identity and (n, n) where it reaches all.

        Raises:
            ShapeError, NoiseError, DefinitionError: as for the class.
        """
        A = _checks.matrix(A, None, None, "state matrix A")
        n = A.shape[0]
        A = _checks.matrix(A, n, n, "state matrix A")
        B = _checks.matrix(np.zeros((n, 0)) if B is None else B, n, None, "input matrix B")
        G = _checks.matrix(np.eye(n) if G is None else G, n, None, "disturbance gain G")
        intensity = G @ _checks.covariance(Qc, G.shape[1], "disturbance intensity Qc") @ G.T
        if not (np.isfinite(dt) and dt > 0):
            raise DefinitionError(f"dt: expected a positive sampling time in seconds, got {dt!r}")
        transition, gain, noise = _discretized(A, B, intensity, float(dt))
        reached, _ = determined_subspace(A.T, G.T, 1e-9)
        if reached.shape[1] < n:
            return cls(transition, reached.T @ noise @ reached, gain, reached, dt=dt, **common)
        return cls(transition, noise, gain, dt=dt, **common)

    def _attach(self, sensors: Iterable[Sensor]) -> None:
        sensors = tuple(sensors)
        for sensor in sensors:
            if sensor.matrix is None:
                raise DefinitionError(
                    f"sensor {sensor.name!r}: a LinearModel needs an output matrix; use a NonlinearModel for functions"
                )
        super()._attach(sensors)
        C = np.vstack([np.zeros((0, self.state_size)), *(s.matrix for s in sensors if s.matrix is not None)])
        C.setflags(write=False)
        self.C = C

    @cached_property
    def _symbols(self) -> tuple[Any, Any, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return ca.SX.sym("x", self.state_size), ca.SX.sym("u", self.input_size), ca.SX.sym("p", 0)

    def _next_state(self) -> Any:
        x, u, _ = self._symbols
        return ca.mtimes(ca.DM(self.A), x) + ca.mtimes(ca.DM(self.B), u)


def _discretized(A: np.ndarray, B: np.ndarray, W: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """exp(A dt), the held input's gain and the accumulated noise covariance of intensity W."""
    from scipy.linalg import expm

    n, m = B.shape
    held = expm(dt * np.block([[A, B], [np.zeros((m, n + m))]]))
    # exp(-A h) of a stiff or fast model overflows; a short interval doubled does not
    doublings = max(0, math.ceil(math.log2(max(np.linalg.norm(A, 2) * dt, 1e-300))))
    h = dt / 2**doublings
    loan = expm(h * np.block([[-A, W], [np.zeros((n, n)), A.T]]))
    transition = loan[n:, n:].T
    noise = transition @ loan[:n, n:]
    for _ in range(doublings):
        noise = noise + transition @ noise @ transition.T
        transition = transition @ transition
    return held[:n, :n], held[:n, n:], (noise + noise.T) / 2
