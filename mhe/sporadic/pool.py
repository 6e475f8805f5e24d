"""Compiled windows of an estimator with detections, one for each shape: all nodes of a network share them."""

from __future__ import annotations

import numpy as np

from mhe.compiled import CompiledOnce, content
from mhe.sporadic.options import SporadicOptions
from mhe.sporadic.window import DetectionWindow, WindowShape
from problems.solvers.session import Session


class DetectionPool(CompiledOnce[Session]):
    """Sessions of windows by their content."""

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
        key = shape, *(content(part) for part in given), penalty, options.solver, content(settings)
        return self._once(
            key, lambda: DetectionWindow(shape, *given, penalty=penalty).compile(options.solver, **settings)
        )
