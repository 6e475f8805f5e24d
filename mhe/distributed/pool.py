"""Compiled windows of local problems, one for each different problem."""

from __future__ import annotations

import numpy as np

from mhe.compiled import CompiledOnce, content
from mhe.distributed.options import DistributedOptions
from mhe.polyhedron import Polyhedron
from mhe.window import Window
from problems.models import LinearModel
from problems.solvers.session import Session


class WindowPool(CompiledOnce[tuple[Window, Session]]):
    """Sessions of windows by the content of their problem: nodes, and networks, with equal problems share them."""

    def get(
        self,
        model: LinearModel,
        gain: np.ndarray | None,
        options: DistributedOptions,
        state_bounds: Polyhedron | None,
        disturbance_bounds: Polyhedron | None,
        *,
        soft: bool = False,
    ) -> tuple[Window, Session]:
        """The window of one local problem and its session.

        Args:
            model: with the sensors of the region.
            gain: L of the region, or None.
            options: `horizon`, `form`, the solver and its settings count here.
            soft: bounds relaxed by slacks with ``options.penalty``.

        Raises:
            FormError, SettingError: the form or the solver does not fit.
        """
        penalty = options.penalty if soft else None
        settings = {"tolerance": options.tolerance, **options.settings}
        bounds = content(state_bounds), content(disturbance_bounds)
        key = content(model), content(gain), bounds, options.horizon, options.form, penalty, options.solver

        def make() -> tuple[Window, Session]:
            window = Window(
                model,
                options.horizon,
                form=options.form,
                gain=gain,
                state_bounds=state_bounds,
                disturbance_bounds=disturbance_bounds,
                penalty=penalty,
            )
            return window, window.compile(options.solver, **settings)

        return self._once((*key, content(settings)), make)
