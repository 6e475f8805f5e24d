"""Compiled windows of local problems, one for each different problem."""

from __future__ import annotations

from typing import Any

import numpy as np

from mhe.distributed.options import DistributedOptions
from mhe.polyhedron import Polyhedron
from mhe.window import Window
from problems.models import LinearModel
from problems.solvers.session import Session


class WindowPool:
    """Sessions of windows by the content of their problem: nodes, and networks, with equal problems share them.

    What it returns is compiled and never solved; take a fork or a batch of it.
    """

    def __init__(self) -> None:
        self._compiled: dict[tuple[Any, ...], tuple[Window, Session]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_compiled": {}}  # compiled code does not travel between processes

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
        key = (
            *(matrix.tobytes() for matrix in (model.A, model.B, model.G, model.Q, model.C, model.R)),
            tuple(model.rows(sensor.name).stop for sensor in model.sensors),
            None if gain is None else gain.tobytes(),
            _content(state_bounds),
            _content(disturbance_bounds),
            (options.horizon, options.form, penalty, options.solver, repr(sorted(settings.items()))),
        )
        found = self._compiled.get(key)
        if found is None:
            window = Window(
                model,
                options.horizon,
                form=options.form,
                gain=gain,
                state_bounds=state_bounds,
                disturbance_bounds=disturbance_bounds,
                penalty=penalty,
            )
            found = self._compiled[key] = window, window.compile(options.solver, **settings)
        return found


def _content(bounds: Polyhedron | None) -> tuple[bytes, ...] | None:
    return None if bounds is None else tuple(part.tobytes() for part in (bounds.matrix, bounds.lower, bounds.upper))
