"""`Estimate`, what every estimator returns from a step, `WindowEstimate`, its moving horizon form, and `Estimator`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from problems.display import Table
from problems.errors import UnobservableError
from problems.lazy import lazy
from problems.solvers.base import Status

if TYPE_CHECKING:
    import pandas as pd

    from problems.solvers.session import Solution


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """What an estimator knows after one step.

    Attributes:
        state: estimate (n,) of the newest state.
        covariance: its covariance (n, n), or None where the estimator has none.
        window: estimates (length, n) of the states of the window, the newest last; None for filters.
        status: outcome of the step; unless it is ``solved`` or ``inaccurate``, `state` is the best value left, usually
            the prediction.
        seconds: wall time of the step.
        infeasible: names of the constraints that could not be met.
        missing: components of the measurement that were not there.
        late: times (s) of the measurements that came after their own instant and were used in this step.
        time: time (s) of `state`.
        state_names: n names.
    """

    state: np.ndarray
    covariance: np.ndarray | None
    window: np.ndarray | None
    status: Status
    seconds: float
    infeasible: tuple[str, ...]
    missing: tuple[int, ...]
    late: tuple[float, ...]
    time: float
    state_names: tuple[str, ...]

    def table(self) -> Table:
        """States with their standard deviations."""
        deviations: list[Any] = [None] * len(self.state_names)
        with suppress(UnobservableError):  # there may be none yet, which is no reason not to show the rest
            if self.covariance is not None:
                deviations = np.sqrt(np.diag(self.covariance)).tolist()
        notes = [f"{self.seconds * 1e6:.0f} us"]
        notes += [f"not met: {', '.join(self.infeasible)}"] if self.infeasible else []
        notes += [f"{len(self.missing)} missing"] if self.missing else []
        notes += [f"{len(self.late)} late"] if self.late else []
        caption = f"{type(self).__name__} at {self.time:g} s: {self.status}, {', '.join(notes)}"
        rows = list(zip(self.state_names, self.state.tolist(), deviations, strict=True))
        return Table(caption, ("state", "estimate", "sigma"), rows)

    def __repr__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()

    def to_pandas(self) -> pd.DataFrame:
        """One row, to be concatenated over steps: `time` (index), states by name, ``sigma_<name>``, status, seconds."""
        import pandas as pd

        row: dict[str, Any] = dict(zip(self.state_names, self.state.tolist(), strict=True))
        if self.covariance is not None:
            sigmas = np.sqrt(np.diag(self.covariance)).tolist()
            row |= {f"sigma_{name}": sigma for name, sigma in zip(self.state_names, sigmas, strict=True)}
        row |= {"status": str(self.status), "seconds": self.seconds}
        return pd.DataFrame([row], index=pd.Index([self.time], name="time"))


class WindowEstimate(Estimate):
    """An `Estimate` of a moving horizon estimator.

    Attributes:
        solution: of the window's problem: residuals, multipliers, objective, active set; None where nothing was solved,
            and in an estimate that comes from another process: what it is worked out from stays there.
        parameters: (r,) estimated or given, or None.
        too_late: times (s) of late measurements whose instant had already left the window; they were not used.
    """

    solution: Solution | None
    too_late: tuple[float, ...]
    parameters: np.ndarray | None = None

    def __init__(self, fields: dict[str, Any]) -> None:
        # window and covariance are worked out on access, so the fields go in directly
        self.__dict__.update(fields)

    @property
    def covariance(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(n, n) of `state` by the window's own costs, bounds left out; None with pre-estimation, whose observer has no
        noise model, for nodes of a network, whose neighbours' estimates are correlated with their own, and where the
        step found no solution.

        Raises:
            UnobservableError: the costs leave a direction free.
        """
        known, slot = self.__dict__.get("_covariance"), self.__dict__.get("_slot")
        if known is None and slot is not None:
            assert self.solution is not None
            known = self.__dict__["_covariance"] = self.solution.covariance(slot)
        return known

    @lazy
    def window(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(length, n) states of the window, the newest last."""
        assert self.solution is not None
        return self.solution["x"].copy()

    def __getstate__(self) -> dict[str, Any]:
        # a solution holds on to compiled code, which does not travel between processes
        return self.__dict__ | {
            "window": self.window,
            "_covariance": self.covariance,
            "_slot": None,
            "solution": None,
        }


@runtime_checkable
class Estimator(Protocol):
    """Estimates the state of one model from one measurement per instant."""

    def step(self, measurements: Any, inputs: Any = None, time: float | None = None) -> Estimate:
        """Take the measurement of the next instant.

        Args:
            measurements: y_t (p,), NaN where a component is missing; None where all are.
            inputs: u_{t-1} (m,), which acted since the previous instant.
            time: of the measurement (s); the model's sampling time is counted on from the last one if None.
        """
        ...

    def reset(self) -> None:
        """Forget everything but the prior: the next step is the first one."""
        ...
