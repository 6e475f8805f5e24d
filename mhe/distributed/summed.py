"""Windows of unequal nodes as one problem: what a node measures enters through sums of fixed size.

The measurements of slot k, however many, act on a window through ``M_k = sum C' R^-1 C``, ``m_k = sum C' R^-1 y`` and,
with pre-estimation, ``Phi_k = A - sum L C`` and ``e_k = sum L y``. These are data of one template; `Region` works them
out for all nodes by sparse products. Nothing is padded and memory per node does not depend on what it hears.

Source: dmhe-l-step, condensed form; dmhe-pre-estimation 3.4.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from mhe.covariance import symmetrized
from mhe.polyhedron import Polyhedron
from mhe.window import Window, WindowForm
from problems.models import LinearModel
from problems.noise import Gaussian
from problems.problem import Problem
from problems.spaces import Vector


class SummedWindow(Window):
    """The window of any node of a network, see `Window` for forms and bounds.

    Data besides ``u``, ``filled``, ``reference``, ``information`` and ``linear``: ``seen`` (N + 1, n, n) the M_k,
    ``heard`` (N + 1, n) the negative m_k; with an observer ``transition`` (N, n, n) the Phi_k and ``push`` (N, n) the
    e_k; with bounded residuals ``looks`` (rows, n), the bounded rows of the outputs, and their bounds ``below`` and
    ``above`` ((N + 1) rows, slot after slot).

    Args:
        model: its dynamics; sensors are data.
        horizon, form, state_bounds, disturbance_bounds: as for `Window`.
        observer: pre-estimation.
        residual_rows: most bounded rows of outputs that a node has.
    """

    def __init__(
        self,
        model: LinearModel,
        horizon: int,
        *,
        form: WindowForm | None = None,
        observer: bool = False,
        state_bounds: Polyhedron | None = None,
        disturbance_bounds: Polyhedron | None = None,
        residual_rows: int = 0,
    ) -> None:
        self.model, self.horizon, self.penalty, self.parameters = model, horizon, None, None
        self.gain = "data" if observer else None
        self.form = self._statement(form)
        N, n, m = horizon, model.state_size, model.input_size
        self.problem = Problem(f"window of {N} transitions")
        self.x, self.w = self.problem.variables("x", Vector(n), N + 1), None
        self._u = self.problem.data("u", m, N + 1, value=np.zeros((N + 1, m))) if m else None
        self._p, self._whole = None, []
        self._arrival()
        heard, seen = self.problem.data("heard", n, N + 1), self.problem.data("seen", (n, n), N + 1)
        self.problem.cost("outputs", lambda x: x, on=self.x, noise=Gaussian(information=seen), linear=heard)
        self._transitions()
        self.bounds: tuple[str, ...] = ()
        if state_bounds is not None or disturbance_bounds is not None:
            self._filled = self.problem.data("filled", (), N + 1, value=np.ones(N + 1))
        if state_bounds is not None:
            self._bound("state", state_bounds, n)
        if disturbance_bounds is not None:
            self._bound("disturbance", disturbance_bounds, n if observer else model.disturbance_size)
        if residual_rows:
            size = (N + 1) * residual_rows
            looks = self.problem.data("looks", n, residual_rows)
            below, above = self.problem.data("below", (), size), self.problem.data("above", (), size)
            slots = np.repeat(np.arange(N + 1), residual_rows)
            self.problem.inequality(
                "residual bounds",
                lambda x, look: look.T @ x,
                on=self.x[slots],
                data=looks[np.tile(np.arange(residual_rows), N + 1)],
                lower=below,
                upper=above,
            )

    def _observer(self, inputs: dict[str, Any]) -> None:
        n = self.model.state_size
        names = list(inputs)
        transition = self.problem.data("transition", (n, n), self.horizon)
        push = self.problem.data("push", n, self.horizon)

        def function(x: Any, ahead: Any, transition: Any, push: Any, *given: Any) -> Any:
            driven = self._moved(ca.DM.zeros(n), **dict(zip(names, given, strict=True)))
            return ahead - transition @ x - push - driven

        on, data = (self.x[:-1], self.x[1:]), (transition, push, *inputs.values())
        self.problem.equality("transition", function, on=on, data=data)


class Outputs:
    """The sensors of a model on the collective measurement.

    Attributes:
        C: (p, n).
        weighted: (p, n) ``R^-1 C``.
    """

    def __init__(self, model: LinearModel) -> None:
        from scipy.sparse import block_diag, csr_array

        self.C = model.C
        blocks, self._whole = [], []
        for sensor in model.sensors:
            rows = model.rows(sensor.name)
            R = model.R[rows, rows]
            blocks.append(np.linalg.inv(R))
            if (R - np.diag(np.diagonal(R))).any():
                self._whole.append(rows)
        size = model.measurement_size
        self._information = csr_array(block_diag(blocks, format="csr")) if size else csr_array((0, 0))
        self.weighted = np.asarray(self._information @ self.C)

    def used(self, there: np.ndarray) -> np.ndarray:
        """Which components (..., p) the costs use: a sensor with correlated components as a whole or not at all."""
        if not self._whole:
            return there
        used = there.copy()
        for rows in self._whole:
            used[..., rows] = used[..., rows].all(axis=-1, keepdims=True)
        return used

    def summands(self, y: np.ndarray) -> np.ndarray:
        """``R^-1 y`` and y (2 p, trials) of measurements (trials, p), NaN where missing, zero where not used."""
        there = ~np.isnan(y)
        known = np.where(there, y, 0.0)
        used = known if not self._whole else np.where(self.used(there), y, 0.0)
        return np.concatenate([np.asarray(self._information @ used.T), known.T])


class Region:
    """The components that the nodes use of one instant, as sparse operators.

    Args:
        model: of the network.
        outputs: of the model.
        count: nodes.
        nodes, rows: (pairs,) node and row of the collective measurement that it uses.
        gains: (pairs, n) columns of the gains L^i, or None without an observer.

    Attributes:
        A: of the model.
        count: nodes.
    """

    def __init__(
        self,
        model: LinearModel,
        outputs: Outputs,
        count: int,
        nodes: np.ndarray,
        rows: np.ndarray,
        gains: np.ndarray | None,
    ) -> None:
        from scipy.sparse import block_diag, csr_array

        n, p = model.state_size, model.measurement_size
        self.A, self._outputs, self.count = model.A, outputs, count
        self._member = csr_array((np.ones(nodes.size), (nodes, rows)), shape=(count, p))
        at = (nodes[:, None] * n + np.arange(n)).ravel(), np.repeat(rows, n)
        C = csr_array((outputs.C[rows].ravel(), at), shape=(count * n, p))
        self._L = None if gains is None else csr_array((gains.ravel(), at), shape=(count * n, p))
        # one product for both sums
        self._both: Any = C if self._L is None else csr_array(block_diag([C, self._L], format="csr"))
        self._squares = (outputs.C[:, :, None] * outputs.weighted[:, None]).reshape(p, n * n)

    def sums(self, summands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """m and, where there are gains, e (count, trials, n) from `Outputs.summands`."""
        found = np.asarray(self._both @ summands[: self._both.shape[1]])
        ends = self.count * len(self.A)
        return self._by_node(found[:ends]), self._by_node(found[ends:])

    def push(self, y: np.ndarray) -> np.ndarray:
        """e (count, trials, n) from measurements (p, trials), zero where missing."""
        assert self._L is not None
        return self._by_node(self._L @ y)

    def seen(self, there: np.ndarray) -> np.ndarray:
        """M (count, n, n) of the components (p,) that are there."""
        n = len(self.A)
        used = self._outputs.used(there)
        return symmetrized(np.asarray(self._member @ (used[:, None] * self._squares)).reshape(self.count, n, n))

    def transition(self, there: np.ndarray) -> np.ndarray:
        """Phi (count, n, n) of the components (p,) that are there."""
        assert self._L is not None
        n = len(self.A)
        return self.A - np.asarray(self._L @ (there[:, None] * self._outputs.C)).reshape(self.count, n, n)

    @property
    def nbytes(self) -> int:
        parts = [self._member, self._both, *([] if self._L is None else [self._L])]
        return sum(part.data.nbytes + part.indices.nbytes + part.indptr.nbytes for part in parts)

    def _by_node(self, stacked: Any) -> np.ndarray:
        array = np.asarray(stacked)
        return array.reshape(self.count, -1, array.shape[1]).swapaxes(1, 2)


class Sums:
    """The sums of a window of all nodes in some trials, moved on from step to step.

    Args:
        regions: what the nodes use of an instant, by how far its measurements had time to travel.
        reach: (N + 1,) region of every age t - k.
        outputs: of the model.
        trials: how many.
        observer: keep Phi and e.
    """

    def __init__(
        self, regions: list[Region], reach: np.ndarray, outputs: Outputs, trials: int, *, observer: bool
    ) -> None:
        self._regions, self._outputs, self._observer = regions, outputs, observer
        self._reach = reach
        count, slots, (p, n) = regions[0].count, len(reach), outputs.C.shape
        self.y = np.full((slots, trials, p), np.nan)
        self.heard = np.zeros((count, trials, slots, n))
        self._push = np.zeros((count, trials, slots, n)) if observer else None
        self._summands = np.zeros((slots, 2 * p, trials))
        self._known = np.full(slots, -1)  # region that every slot was summed over
        self._complete: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}
        self._pattern: tuple[bytes, bytes] | None = None

    def advance(self, y: np.ndarray, newest: int, slid: bool) -> None:
        """Take the measurements (trials, p) of the instant in slot `newest`; `slid`: the oldest instant left."""
        if slid:
            for array in (self.y, self._summands, self._known):
                array[:-1] = array[1:]
            for array in (self.heard, *([] if self._push is None else [self._push])):
                array[:, :, :-1] = array[:, :, 1:]
        self.y[newest], self._summands[newest], self._known[newest] = y, self._outputs.summands(y), -1
        for slot in range(newest + 1):
            reach = int(self._reach[newest - slot])
            if reach == self._known[slot]:
                continue
            self._known[slot] = reach
            heard, push = self._regions[reach].sums(self._summands[slot])
            np.negative(heard, out=self.heard[:, :, slot])
            if self._push is not None:
                self._push[:, :, slot] = push

    @property
    def push(self) -> np.ndarray | None:
        """e of the transitions (count, trials, N, n)."""
        return None if self._push is None else self._push[:, :, :-1]

    def matrices(self) -> dict[str, np.ndarray]:
        """``seen`` and ``transition``, by node or by node and trial, if they changed since the last call."""
        there = ~np.isnan(self.y)
        pattern = there.tobytes(), self._known.tobytes()
        if pattern == self._pattern:
            return {}
        self._pattern = pattern
        distinct = there[:, :1] if (there == there[:, :1]).all() else there
        trials = distinct.shape[1]
        count, n = self._regions[0].count, self.heard.shape[-1]
        seen = np.zeros((count, trials, len(there), n, n))
        moved = np.empty((count, trials, len(there) - 1, n, n))
        moved[...] = self._regions[0].A
        for slot, reach in enumerate(self._known.tolist()):
            if reach < 0:
                continue
            for trial in range(trials):
                M, Phi = self._of(reach, distinct[slot, trial])
                seen[:, trial, slot] = M
                if Phi is not None and slot < len(there) - 1:
                    moved[:, trial, slot] = Phi
        found = {"seen": seen.reshape(-1, *seen.shape[2:])}
        if self._observer:
            found["transition"] = moved.reshape(-1, *moved.shape[2:])
        return found

    def _of(self, reach: int, there: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        region, complete = self._regions[reach], bool(there.all())
        if complete and reach in self._complete:
            return self._complete[reach]
        found = region.seen(there), region.transition(there) if self._observer else None
        if complete:
            self._complete[reach] = found
        return found

    @property
    def nbytes(self) -> int:
        kept = [part for pair in self._complete.values() for part in pair if part is not None]
        arrays = [self.y, self._summands, self.heard, *([] if self._push is None else [self._push]), *kept]
        return sum(array.nbytes for array in arrays) + sum(region.nbytes for region in self._regions)
