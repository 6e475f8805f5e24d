"""`Sensor`: what one sensor measures and how noisy it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DefinitionError, NoiseError, SettingError
from problems.models import _checks
from problems.models._symbols import evaluate


class Sensor:
    """An output with Gaussian noise, y = C x + v or y = h(x, u, p) + v (`dmhe-pre-estimation` (2.3)).

    Args:
        name: unique within a model.
        output: matrix C (p, n), or a function h of CasADi columns x, u, p (u and p only where the model declares them;
            trailing ones may be left out), or an expression over a model's own symbols. ``u`` is the input that acted
            up to the instant of the measurement.
        covariance: R (p, p), symmetric positive definite; a number where p = 1.
        sigma: instead of `covariance`, standard deviations of independent components: a number or (p,).
        angles: components that are angles (rad); their residuals and simulated values are wrapped to (-pi, pi].
        period: the sensor reports at every `period`-th instant (multi-rate); other instants are simulated as NaN.

    Raises:
        NoiseError: none or both of `covariance` and `sigma`, or not positive definite.
        ShapeError, DefinitionError: an array of the wrong shape or kind.
        SettingError: a period below 1.

    Attributes:
        matrix: C where the output was given as a matrix, else None.
    """

    def __init__(
        self,
        name: str,
        output: Any,
        *,
        covariance: Any = None,
        sigma: Any = None,
        angles: Sequence[int] = (),
        period: int = 1,
    ) -> None:
        self.name = name
        what = f"sensor {name!r}"
        if (covariance is None) == (sigma is None):
            given = "both" if covariance is not None else "none"
            raise NoiseError(f"{what}: give exactly one of covariance and sigma, got {given}")
        if int(period) != period or period < 1:
            raise SettingError(f"{what}: period counts instants and is at least 1, got {period!r}")
        self.period = int(period)
        self.angles = tuple(int(k) for k in angles)
        self.matrix: np.ndarray | None = None
        self._noise = ("covariance", covariance) if sigma is None else ("sigma", sigma)
        self._function = output if callable(output) or isinstance(output, (ca.SX, ca.MX)) else None
        if self._function is None:
            self.matrix = _checks.matrix(output, None, None, f"{what}: output matrix C")
            self.covariance(self.matrix.shape[0])

    def __repr__(self) -> str:
        return f"<sensor {self.name!r}>"

    def covariance(self, size: int) -> np.ndarray:
        """R (size, size) for an output of `size` components. Raises `ShapeError` or `NoiseError`."""
        what = f"sensor {self.name!r}: R"
        kind, value = self._noise
        if any(not 0 <= k < size for k in self.angles):
            raise DefinitionError(f"sensor {self.name!r}: angles {self.angles} must be components 0 to {size - 1}")
        return _checks.covariance(value, size, what) if kind == "covariance" else _checks.deviations(value, size, what)

    def expression(self, symbols: tuple[Any, Any, Any]) -> Any:
        """The output as a CasADi column over `symbols` = (x, u, p).

        Raises:
            ShapeError, DefinitionError: the output does not fit the symbols.
        """
        what = f"sensor {self.name!r}"
        if self.matrix is None:
            return evaluate(self._function, symbols, None, what)
        _checks.matrix(self.matrix, None, symbols[0].numel(), f"{what}: output matrix C")
        return ca.mtimes(ca.DM(self.matrix), symbols[0])
