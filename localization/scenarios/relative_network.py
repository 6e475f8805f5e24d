"""Scenario ``relative-network``: coordinates from noisy differences on a random geometric graph (E2.30, E2.32)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic

from localization.consensus.campaign import LOSSY, Campaign, run_campaign
from localization.consensus.relative import RelativeVectors, measure_differences, optimum
from problems.bench.scenario import Outcome
from problems.display import new_figure
from problems.networks import random_geometric

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAIN = 6.0  # packets_per_e6 counts the packets until the error has fallen by exp(-GAIN)
RECORDS = 120
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")  # told apart without colour vision
STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))


class Settings(pydantic.BaseModel):
    """Settings of the scenario."""

    model_config = pydantic.ConfigDict(extra="forbid")

    nodes: int = pydantic.Field(100, ge=3, le=2000, description="uniform in the unit square")
    radius: float = pydantic.Field(0.15, gt=0, description="of communication; graphs are redrawn until connected")
    variance: float = pydantic.Field(1e-4, gt=0, description="of each difference; pairs measure both ways")
    iterations: int = pydantic.Field(60_000, ge=1, description="in which one node acts; s_cl makes iterations/nodes")
    loss: float = pydantic.Field(0.0, ge=0, lt=1, description="probability that a link loses a packet")


@dataclass(frozen=True, eq=False)
class Drawn:
    """One trial: measurements, first coordinates, their optimum, and the seed of who acts when and what is lost."""

    vectors: RelativeVectors
    places: np.ndarray
    start: np.ndarray
    best: np.ndarray
    seed: int


class RelativeNetworkScenario:
    """See the module. Only ``a_cl`` and ``gossip`` run with losses. No method calls a solver."""

    name = "relative-network"
    source = "spec gps-range-bearing-localization 6 (E2.30, E2.32) and Table 2.1"
    methods = ("a_cl", "s_cl", "gossip", "bc", "rek")
    without_solver = methods
    metrics = ("log_error", "packets_per_e6")
    settings = Settings

    def draw(self, settings: Settings, rng: np.random.Generator) -> Drawn:
        network, places = random_geometric(settings.nodes, settings.radius, rng)
        vectors = measure_differences(network, places[:, :1], settings.variance, rng)
        start = rng.random((settings.nodes, 1))
        return Drawn(vectors, places, start, optimum(vectors), int(rng.integers(2**63)))

    def run(self, settings: Settings, method: Any, solver: str, drawn: Drawn) -> Outcome:
        del solver
        synchronous = method == "s_cl"
        count = max(1, settings.iterations // settings.nodes) if synchronous else settings.iterations
        begin = time.perf_counter()
        run = run_campaign(
            method,
            [drawn.vectors],
            [drawn.start],
            count,
            np.random.default_rng(drawn.seed),
            loss=settings.loss,
            every=max(1, count // RECORDS),
            best=[drawn.best],
        )
        seconds = time.perf_counter() - begin
        packets = float(run.packets_per(GAIN)[0])
        return Outcome(
            metrics={
                "log_error": float(run.log_error[-1, 0]),
                "packets_per_e6": None if np.isnan(packets) else packets,
            },
            options={"iterations": count, "loss": settings.loss if method in LOSSY else 0.0},
            times={"solve": seconds},
            step_seconds=np.full(count, seconds / count),
            trace=run,
        )

    def plot(self, settings: Settings, drawn: Drawn, outcomes: Mapping[str, Outcome]) -> Figure:
        from matplotlib.collections import LineCollection

        figure = new_figure(figsize=(14, 4.8), layout="constrained")
        graph, over, per = figure.subplots(1, 3, width_ratios=[1, 1.3, 1.3])
        graph.add_collection(LineCollection(list(drawn.places[drawn.vectors.network.edges]), colors="0.75", lw=0.8))
        graph.plot(*drawn.places.T, "o", ms=4, color="black")
        graph.set_aspect("equal")
        graph.set_xlabel("x (m)")
        graph.set_ylabel("y (m)")
        graph.set_title(f"{settings.nodes} nodes, {len(drawn.vectors.tail)} differences")
        for k, (label, outcome) in enumerate(outcomes.items()):
            run: Campaign = outcome.trace
            style: dict[str, Any] = {"color": COLORS[k % len(COLORS)], "ls": STYLES[k % len(STYLES)], "lw": 1.8}
            acts = run.iterations * settings.iterations / run.iterations[-1]
            over.plot(acts, run.log_error[:, 0], label=label, **style)
            per.plot(run.packets[1:, 0], run.log_error[1:, 0], label=label, **style)
            if label.split()[0] == "gossip":
                over.plot(acts[1:], run.average_log_error[1:, 0], lw=1, color=style["color"], label=f"{label}, average")
        over.set_xlabel("nodes that have acted (a round of s_cl: all of them)")
        over.set_ylabel(r"$\ln\,\|A(x - x^*)\|$")
        per.set_xscale("log")
        per.set_xlabel("packets sent")
        for axes in (over, per):
            axes.grid(alpha=0.3)
        over.legend(loc="best", frameon=False)
        return figure


scenario = RelativeNetworkScenario()
