"""gtsam's iSAM2 on the graph form: updates of a Bayes tree until nothing is relinearized any more.

Kaess et al., iSAM2: Incremental Smoothing and Mapping Using the Bayes Tree, 2012. All factors are added at once: adding
them in the order of the unknowns was 13 times slower on the recording intel and ended in failure on manhattan, because
undamped steps of a part of the graph lead away from the start of the whole.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from problems.errors import SettingError
from problems.problem import Problem
from problems.solvers.base import Options, Status
from problems.solvers.gtsam_solvers import ITERATIONS, STALL, GtsamSession
from problems.solvers.qp_support import checked_settings

RELINEARIZE = 1e-3  # of the root of the tolerance: a step so small changes the cost by far less than the tolerance


@dataclass(frozen=True)
class Settings:
    """Settings of ``gtsam-isam2``.

    Attributes:
        relinearize_threshold: an unknown is relinearized when a component of its step reaches this (m, rad, ...);
            None: 1e-3 of the root of the tolerance. gtsam's own default of 0.1 stops far from an optimum.
        optimizer: steps by Gauss-Newton (``gn``) or Powell's dogleg (``dogleg``).
        factorization: elimination; QR where Cholesky loses too many digits.
    """

    relinearize_threshold: float | None = None
    optimizer: Literal["gn", "dogleg"] = "gn"
    factorization: Literal["CHOLESKY", "QR"] = "CHOLESKY"


class ISAM2(GtsamSession):
    """Session of the solver ``gtsam-isam2``."""

    name = "gtsam-isam2"
    settings_type = Settings

    def __init__(self, problem: Problem, options: Options) -> None:
        self.settings = checked_settings(Settings, options.extra, self.name)
        threshold = self.settings.relinearize_threshold
        if threshold is not None and not threshold > 0:
            raise SettingError(f"solver {self.name}: relinearize_threshold must be positive, got {threshold!r}")
        self.nonlinear_equalities = self.settings.optimizer == "gn"
        super().__init__(problem, options)

    def _translated(self, settings: Any) -> Any:
        import gtsam

        steps = gtsam.ISAM2GaussNewtonParams() if settings.optimizer == "gn" else gtsam.ISAM2DoglegParams()
        steps.setWildfireThreshold(0.0)  # steps are propagated to all unknowns, however small
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(steps)
        threshold = settings.relinearize_threshold or RELINEARIZE * float(np.sqrt(self.options.tolerance))
        parameters.setRelinearizeThreshold(threshold)
        parameters.setFactorization(settings.factorization)
        return parameters

    def _run(self, graph: Any, values: Any) -> tuple[Status, str, int, Any]:
        import gtsam

        deadline = time.perf_counter() + self.options.time_limit
        limit = self.options.iteration_limit or ITERATIONS
        iterations, found = 0, None
        try:
            tree = gtsam.ISAM2(self._parameters)
            tree.update(graph, values.extract(sorted(graph.keyVector())))
            cost = graph.error(values)
            while iterations < limit:
                found = gtsam.Values(values)  # holds what no factor touches too
                found.update(tree.calculateBestEstimate())
                iterations += 1
                new = graph.error(found)
                if not np.isfinite(new):
                    return Status.FAILED, "the cost became infinite", iterations, None
                if abs(cost - new) <= STALL * self.options.tolerance * max(1.0, new):
                    return Status.SOLVED, "", iterations, found
                cost = new
                if time.perf_counter() > deadline:
                    return Status.TIME_LIMIT, f"stopped after {self.options.time_limit:g} s", iterations, found
                if tree.update(force_relinearize=True).getVariablesRelinearized() == 0:
                    return Status.SOLVED, "", iterations, found
        except Exception as error:  # a library that breaks is a status
            return self._broken(error, iterations, found)
        return Status.ITERATION_LIMIT, f"not converged after {limit} iterations", iterations, found
