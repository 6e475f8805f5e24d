"""Compiled windows of l-step neighbourhoods, one for each different regional model.

Gains, arrival weights and what is held are data, so that nodes which see equally many equal sensors share a window.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mhe.compiled import CompiledOnce, content
from mhe.distributed.fallback import SOLVED
from mhe.relay.plan import RelayPlan
from mhe.window import Window
from problems.solvers.session import Session


class RelayWindows(CompiledOnce[tuple[Window, Session]]):
    """Sessions of windows by the content of their problem."""

    def get(self, plan: RelayPlan, *, soft: bool = False) -> tuple[Window, Session]:
        """The window of a node and its session.

        Args:
            plan: its model, bounds and options count here.
            soft: bounds relaxed by slacks.

        Raises:
            FormError, SettingError: the form or the solver does not fit.
        """
        model, options = plan.model, plan.options
        settings = {"tolerance": options.tolerance, **options.settings}
        penalty = options.penalty if soft else None
        bounds = [plan.residual_bounds.get(sensor.name) for sensor in model.sensors]
        key = content(model), tuple(content(bound) for bound in (plan.state_bounds, *bounds))
        chosen = options.disturbance, options.horizon, options.form, penalty, options.solver

        def make() -> tuple[Window, Session]:
            window = Window(
                model,
                options.horizon,
                form=options.form,
                gain="data" if options.disturbance == "observer" else None,
                state_bounds=plan.state_bounds,
                residual_bounds=plan.residual_bounds,
                penalty=penalty,
            )
            return window, window.compile(options.solver, **settings)

        return self._once((*key, *chosen, content(settings)), make)


class Relaxation:
    """What a node's window answers where its bounds cannot be met: bounds relaxed by slacks."""

    def __init__(self, windows: RelayWindows, plan: RelayPlan) -> None:
        self._windows, self._plan = windows, plan
        self._session: Session | None = None

    def __call__(self, data: dict[str, Any], newest: int) -> tuple[np.ndarray, tuple[str, ...]] | None:
        """States (slots, n) and the names of the bounds not met; None where the solver found nothing.

        Args:
            data: all data of the window that is infeasible.
            newest: slot of the newest instant.
        """
        if self._session is None:
            self._window, compiled = self._windows.get(self._plan, soft=True)
            self._session = compiled.fork()
        solution = self._session.solve(data)
        if solution.status not in SOLVED:
            return None
        return solution["x"], self._window.unmet(solution, newest + 1)
