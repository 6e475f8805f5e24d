"""Compiled windows of an estimator with detections, one for each shape: all nodes of a network share them."""

from __future__ import annotations

from typing import Any

import numpy as np

from mhe.sporadic.options import SporadicOptions
from mhe.sporadic.window import DetectionWindow, WindowShape
from problems.solvers.session import Session


class DetectionPool:
    """Sessions of windows by their content. What it returns is compiled and never solved; take a fork of it."""

    def __init__(self) -> None:
        self._compiled: dict[tuple[Any, ...], Session] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_compiled": {}}  # compiled code does not travel between processes

    def get(
        self,
        shape: WindowShape,
        noise_gain: np.ndarray,
        noise: np.ndarray,
        options: SporadicOptions,
        *,
        soft: bool = False,
    ) -> Session:
        """The session of a window.

        Args:
            shape: of the window; without disturbances the noise does not count.
            noise_gain, noise: G (parts, m, q) and Q (parts, q, q).
            options: the solver and its settings count here.
            soft: rows relaxed by slacks with ``options.penalty``.

        Raises:
            FormError, SettingError, UnknownNameError: about the solver.
        """
        given = (noise_gain, noise) if shape.disturbances else (None, None)
        penalty = options.penalty if soft else None
        settings = {"tolerance": options.tolerance, **options.settings}
        content = tuple(None if part is None else part.tobytes() for part in given)
        key = (shape, content, penalty, options.solver, repr(sorted(settings.items())))
        found = self._compiled.get(key)
        if found is None:
            window = DetectionWindow(shape, *given, penalty=penalty)
            found = self._compiled[key] = window.compile(options.solver, **settings)
        return found
