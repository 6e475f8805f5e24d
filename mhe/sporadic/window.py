"""`DetectionWindow`: the local problem of an estimator with detections, (4.14)-(4.17), stated once for all nodes.

What differs between nodes and from step to step is data: the information of the readings of each instant, the observer
``x_{k+1} = F_k x_k + b_k`` with F_k = A - L D_k C, the arrival cost, the rows. So one compiled problem serves all nodes
of a network whatever they detect, and its size does not depend on how many neighbours a node has.

Source: dmhe-sporadic-fov 3.6-3.10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mhe.sporadic.rows import state_rows
from problems.noise import Gaussian
from problems.problem import Problem, Slot, Variable
from problems.solvers.session import Session
from problems.spaces import Vector


@dataclass(frozen=True)
class WindowShape:
    """Sizes of a window.

    Attributes:
        horizon: N.
        parts, size: parts of the model and states of a part.
        disturbances: of a part where they are estimated, 0 with an observer.
        sets: most sets of rows on a part at one instant, 0 without rows.
        rows: most rows of a set.
    """

    horizon: int
    parts: int
    size: int
    disturbances: int
    sets: int
    rows: int


class DetectionWindow:
    """The window as a `Problem`. State k of part v is instance ``k * parts + v`` of its variable ``x``.

    Data of the problem, by name, instances first: ``reference`` and ``arrival information`` of the arrival cost
    (parts); ``reading information`` C'R^-1 C and ``reading linear`` -C'R^-1 y, summed over what was detected
    ((N + 1) parts); ``transition`` F_k and ``moved`` b_k (N parts); with rows ``row matrix``, ``row bound`` and ``row
    active`` ((N + 1) parts sets). Slots of a window still filling have no readings.

    Args:
        shape: sizes.
        noise_gain: (parts, m, q) G where disturbances are estimated.
        noise: (parts, q, q) Q of the disturbances.
        penalty: price of slacks of the rows; None keeps them hard.

    Attributes:
        problem: the problem.
    """

    def __init__(
        self,
        shape: WindowShape,
        noise_gain: np.ndarray | None = None,
        noise: np.ndarray | None = None,
        penalty: float | None = None,
    ) -> None:
        self.shape = shape
        N, V, m = shape.horizon, shape.parts, shape.size
        self.problem = problem = Problem(f"window of {N} transitions with detections")
        self.x: Variable = problem.variables("x", Vector(m), (N + 1) * V)
        problem.cost(
            "arrival",
            lambda x, reference: x - reference,
            on=self.x[:V],
            data=problem.data("reference", m, V),
            noise=Gaussian(information=problem.data("arrival information", (m, m), V)),
        )
        problem.cost(
            "readings",
            lambda x: x,
            on=self.x,
            noise=Gaussian(information=problem.data("reading information", (m, m), (N + 1) * V)),
            linear=problem.data("reading linear", m, (N + 1) * V),
        )
        F = problem.data("transition", (m, m), N * V)
        b = problem.data("moved", m, N * V)
        before, ahead = self.x[:-V], self.x[V:]
        if noise_gain is None or noise is None:
            problem.equality("transition", lambda x, y, F, b: y - F @ x - b, on=(before, ahead), data=(F, b))
        else:
            q = shape.disturbances
            w = problem.variables("w", Vector(q), N * V)
            G = problem.data("noise gain", (m, q), N * V, value=np.tile(noise_gain, (N, 1, 1)))
            problem.equality(
                "transition", lambda x, w, y, F, b, G: y - F @ x - b - G @ w, on=(before, w, ahead), data=(F, b, G)
            )
            problem.cost("disturbance", lambda w: w, on=w, noise=Gaussian(covariance=np.tile(noise, (N, 1, 1))))
        if shape.sets:
            state_rows(problem, self.x, shape.sets, shape.rows, penalty)

    @property
    def later(self) -> Slot:
        """States that the transitions define."""
        return self.x[self.shape.parts :]

    def compile(self, solver: str, **settings: Any) -> Session:
        """A session whose matrices are assembled anew in every solve; errors as for `Problem.compile`."""
        return self.problem.compile(solver, eliminate=[self.later], assembly="code", **settings)
