"""The optimum with active rows, from the answer without any: its projection onto the rows in the metric of the Hessian.

With ``H = L L'`` a step ``L'^-1 s`` away from that answer costs ``1/2 |s|^2`` whatever the data are. So new data change
nothing but how far the rows are exceeded: no cost vector, no factors, and what daqp is asked is a least distance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from problems.solvers.base import Options

IMMOBILE = 1e-12  # share of the largest row below which a row does not move
WRONG_SIGN = 1e-10  # a multiplier further below zero is no certificate


class Projected(NamedTuple):
    """Outputs at the optimum, and what was found of it.

    Attributes:
        multipliers: (rows,) >= 0, of the excesses.
        violation: the largest excess.
        gap: what multipliers and excesses differ from complementarity by.
    """

    outputs: np.ndarray
    multipliers: np.ndarray
    violation: float
    gap: float
    iterations: int


class Projection:
    """Moves affine answers onto the rows; keeps daqp's working set from call to call.

    Args:
        lift: (outputs, k), how the outputs of an affine answer move with a whitened step.
        excess: those of the outputs that are excesses over bounds, at most zero where the bounds hold.
        options: tolerance and limits.
        warm: start from the working set of the last call.
    """

    def __init__(self, lift: np.ndarray, excess: slice, options: Options, warm: bool = True) -> None:
        self._lift, self._excess, self._options, self._warm = lift, excess, options, warm
        self._half = np.ascontiguousarray(lift[excess])
        self._pull = np.ascontiguousarray(self._half.T)
        sizes = np.linalg.norm(self._half, axis=1)
        # a row that nothing moves has no place among those that are moved
        self._usable = bool((sizes > IMMOBILE * sizes.max(initial=0.0)).all())
        self._cold = np.zeros(len(sizes), dtype=np.intc)
        self._model: Any = None

    def restart(self) -> None:
        """Forget the working set."""
        self._model = None

    def _set_up(self) -> Any:
        import daqp

        rows, size = self._half.shape
        self._model = model = daqp.Model()
        tolerance = min(max(0.01 * self._options.tolerance, 1e-12), 1e-6)
        limits = {"time_limit": self._options.time_limit, "iter_limit": self._options.iteration_limit}
        model.settings = {"primal_tol": tolerance, **{k: v for k, v in limits.items() if v is not None}}
        free = np.full(rows, np.inf)
        model.setup(np.eye(size), np.zeros(size), self._half, free, -free, self._cold)
        return model

    def __call__(self, outputs: np.ndarray) -> Projected | None:
        """The outputs moved; None where daqp finds nothing, or nothing that stands the check.

        Excesses, signs and complementarity are checked; the gradient is that of the multipliers by construction.
        """
        if not self._usable:
            return None
        model = self._set_up() if self._model is None else self._model
        bound = np.negative(outputs[self._excess])
        if model.update(None, None, None, bound, None, None if self._warm else self._cold) >= 0:
            _, _, flag, info = model.solve()
            if flag == 1:
                multipliers = info["lam"]
                moved = outputs - self._lift.dot(self._pull.dot(multipliers))
                excess, tolerance = moved[self._excess], self._options.tolerance
                violation, gap = excess.item(excess.argmax()), abs(float(multipliers.dot(excess)))
                if (
                    violation <= tolerance
                    and gap <= tolerance
                    and multipliers.item(multipliers.argmin()) >= -WRONG_SIGN
                ):
                    return Projected(moved, multipliers, violation, gap, info["iterations"])
        self._model = None  # after a refusal the library can go on claiming success
        return None
