"""`RelayNetwork`: DMHE_pre^l, DMHE_pre^1 and DMHE_B for all nodes and many trials in arrays, without messages.

The data rule decides by the age of a slot which sums a node holds, the fusion (3.10)-(3.14) is a sparse matrix product,
and arrival weights come from the off-line schedule.

Source: dmhe-l-step, condensed form and Algorithm 2.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from mhe.distributed.stacked import StackedNetwork, TrialRun, series
from mhe.distributed.summed import Outputs, Region, SummedWindow
from mhe.relay.design import RelayDesign
from mhe.relay.plan import plan_of
from mhe.relay.rule import reach
from mhe.relay.windows import Relaxation, RelayWindows
from problems.errors import DataError


class RelayNetwork(StackedNetwork):
    """A network of `RelayNode` in many trials at once, over ideal links.

    Args:
        design: of the network.
        trials: how many.
        updates: of the arrival weights; at least as many as there will be steps after the first N, or the default for a
            run of unknown length.

    Raises:
        DataError: fewer than one trial.

    Attributes:
        design: of the network.
    """

    def __init__(self, design: RelayDesign, trials: int, updates: int | None = None) -> None:
        if trials < 1:
            raise DataError(f"a batched network runs at least one trial, got {trials}")
        started = perf_counter()
        self.design = design
        options, model, network = design.options, design.model, design.network
        self._schedule = design.schedule() if updates is None else design.schedule(updates)
        self._limits = _ResidualRows(design) if design.residual_bounds else None
        observer = options.disturbance == "observer"
        window = SummedWindow(
            model,
            options.horizon,
            form=options.form,
            observer=observer,
            state_bounds=design.state_bounds,
            residual_rows=0 if self._limits is None else self._limits.most,
        )
        outputs = Outputs(model)
        ages = reach(np.arange(options.horizon + 1), options.steps, options.latency)
        settings = {"tolerance": options.tolerance, **options.settings}
        regions, mean = _regions(design, outputs, observer), design.mean
        super().__init__(
            model, network, mean, options.horizon, trials, window, regions, ages, outputs, options.solver, settings
        )
        self._owners = np.empty(model.measurement_size, dtype=np.int64)
        gains = np.zeros((model.measurement_size, model.state_size))
        for node, rows in enumerate(design.own_rows):
            self._owners[rows] = node
            gains[rows] = design.own(node).gain.T
        rows = np.arange(model.measurement_size)
        self._own = Region(model, outputs, network.count, self._owners, rows, gains)
        self._published = self._states[:, :, 0].copy()
        self._fused: np.ndarray | None = None
        self._looks_given = False
        self._windows = RelayWindows()
        self._relaxations: dict[int, tuple[Relaxation, Any]] = {}
        self.phases["precompute"] = perf_counter() - started

    def _arrival(self) -> dict[str, Any]:
        entry = self._schedule.at(self._instant)
        weights, fused = self._schedule.local[entry], self._schedule.fused[entry]
        own = self._published
        weighted = own @ weights  # P is symmetric
        linear = own @ fused - self.design.weights.combine(weighted)
        shape = self._batch.count, -1
        data = {"reference": own.reshape(shape), "linear": linear.reshape(shape)}
        if self._fused is None or not np.array_equal(fused, self._fused):
            self._fused = fused
            data["information"] = fused
        return data

    def _publish(self) -> None:
        """Predictions for the next step (3.9), or what the start-up and Omega options make of them."""
        options, model = self.design.options, self.model
        if self._instant < self._horizon:
            if self._instant and options.startup == "fuse":
                self._published = self._states[:, :, 0].copy()
            return
        if options.omega == "hessian":
            self._published = self._states[:, :, 1].copy()
            return
        first = self._states[:, :, 0]
        predicted = first @ model.A.T + self._u[:, 1] @ model.B.T
        if options.disturbance == "observer":
            seen = np.einsum("ptn,pn->pt", first[self._owners], model.C)
            innovation = self._sums.y[0].T - seen
            predicted += self._own.push(np.where(np.isnan(innovation), 0.0, innovation))
        self._published = predicted

    def _more(self) -> dict[str, Any]:
        limits = self._limits
        if limits is None:
            return {}
        data: dict[str, Any] = {} if self._looks_given else {"looks": limits.looks}
        self._looks_given = True
        reached = np.full(self._horizon + 1, -1)
        ages = np.arange(self._newest, -1, -1)
        reached[: self._newest + 1] = reach(ages, self.design.options.steps, self.design.options.latency)
        below, above = limits.bounds(self._sums.y, reached)
        return data | {"below": below, "above": above}

    def _relaxed(self, node: int, trial: int, data: dict[str, Any]) -> tuple[np.ndarray | None, tuple[str, ...], bool]:
        design = self.design
        bounded = [sensor.name for sensor in design.regional[node].sensors if sensor.name in design.residual_bounds]
        names = ["state bounds"] if "state" in self._window.bounds else []
        names += [f"residual {name} bounds" for name in bounded]
        if design.options.bounds != "soft":
            return None, tuple(names), False
        if node not in self._relaxations:
            plan = plan_of(design, node)
            self._relaxations[node] = Relaxation(self._windows, plan), plan
        relaxation, plan = self._relaxations[node]
        y = data["y"][:, design.regional_rows[node]].copy()
        y[: self._newest + 1][~design.held(node, self._newest)] = np.nan
        data = {**data, "y": y.reshape(-1, 1), "gain": plan.gain_at(self._newest)}
        if not y.size:
            del data["y"], data["gain"]
        if design.options.disturbance != "observer":
            data.pop("gain", None)
        found = relaxation(data, self._newest)
        if found is None:
            return None, tuple(names), False
        compiled = self._windows.get(plan, soft=True)[0].model.sensors
        here = zip(compiled, design.regional[node].sensors, strict=True)
        renamed = {f"residual {a.name} bounds": f"residual {b.name} bounds" for a, b in here}
        return found[0], tuple(renamed.get(name, name) for name in found[1]), True


class _ResidualRows:
    """Bounded rows ``V (y - C x)`` of all nodes as bounds of ``V C x``.

    Attributes:
        most: rows of the node that has most; others are padded by rows without bounds.
        looks: (count, most, n) rows V C.
    """

    def __init__(self, design: RelayDesign) -> None:
        model, count = design.model, design.network.count
        p = model.measurement_size
        weights, reads, lows, highs = [np.zeros((0, p))], [], [], []
        numbers: dict[int, list[int]] = {}  # bounded rows by the first row of their sensor
        for name, bound in design.residual_bounds.items():
            rows, size = np.arange(p)[model.rows(name)], len(bound.matrix)
            numbers[int(rows[0])] = list(range(len(lows), len(lows) + size))
            full = np.zeros((size, p))
            full[:, rows] = bound.matrix
            weights.append(full)
            reads += [np.isin(np.arange(p), rows)] * size
            lows += bound.lower.tolist()
            highs += bound.upper.tolist()
        self._weights, self._reads = np.vstack(weights), np.array(reads)
        self._low, self._high = np.array(lows), np.array(highs)
        looks = self._weights @ model.C
        found: list[tuple[list[int], list[int]]] = []
        for node in range(count):
            chosen, hops = [], []
            for row, hop in zip(design.regional_rows[node].tolist(), design.local(node).row_hops.tolist(), strict=True):
                here = numbers.get(row, [])
                chosen += here
                hops += [hop] * len(here)
            found.append((chosen, hops))
        self.most = max(len(chosen) for chosen, _ in found)
        self._place = np.full((count, self.most), -1)
        self._hops = np.full((count, self.most), np.iinfo(np.int64).max)
        self.looks = np.zeros((count, self.most, model.state_size))
        for node, (chosen, hops) in enumerate(found):
            self._place[node, : len(chosen)], self._hops[node, : len(chosen)] = chosen, hops
            self.looks[node, : len(chosen)] = looks[chosen]

    def bounds(self, y: np.ndarray, reached: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (count * trials, slots * most) for measurements (slots, trials, p) and the hops reached by slot."""
        there = ~(np.isnan(y) @ self._reads.T.astype(float)).astype(bool)  # (slots, trials, rows)
        values = np.nan_to_num(y) @ self._weights.T
        below = np.where(there, values - self._high, -np.inf)
        above = np.where(there, values - self._low, np.inf)
        held = self._hops[:, None, None] <= reached[:, None]  # (count, 1, slots, most)
        out = []
        for bound, nothing in ((below, -np.inf), (above, np.inf)):
            by_node = bound[:, :, self._place].transpose(2, 1, 0, 3)
            out.append(np.where(held, by_node, nothing).reshape(len(self._place) * y.shape[1], -1))
        return out[0], out[1]


def _regions(design: RelayDesign, outputs: Outputs, observer: bool) -> list[Region]:
    """What the nodes hold of an instant whose measurements had time to travel 0, 1 .. l hops."""
    model, count, steps = design.model, design.network.count, design.options.steps
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *design.regional_rows])
    hops = [design.problems[number].row_hops for number in design.problem]
    nodes, hops = np.repeat(np.arange(count), [part.size for part in hops]), np.concatenate(hops)
    found = []
    for near in range(steps + 1):
        gains = None
        if observer:
            columns = [problem.gain(_age(near, design)).T for problem in design.problems]
            gains = np.concatenate([columns[number] for number in design.problem])
        held = hops <= near
        found.append(Region(model, outputs, count, nodes[held], rows[held], None if gains is None else gains[held]))
    return found


def _age(near: int, design: RelayDesign) -> int:
    """An age at which measurements have travelled `near` hops."""
    return max(0, near - 1 + design.options.latency)


def run_relay_trials(design: RelayDesign, measurements: Any, inputs: Any = None) -> TrialRun:
    """Run an l-step network over recorded or simulated trials; see `StackedNetwork.run`.

    Args:
        design: of the network.
        measurements: (trials, steps, p) of all sensors in the order of the model, instant 0 first; NaN where missing.
        inputs: (steps - 1, m) or (trials, steps - 1, m); row k acts from instant k to k + 1.

    Raises:
        ShapeError, DataError: they do not fit.
    """
    y, u = series(design.model, measurements, inputs)
    updates = max(0, y.shape[1] - 1 - design.options.horizon)
    return RelayNetwork(design, y.shape[0], updates=updates).run(y, u)
