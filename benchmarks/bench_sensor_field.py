"""Time of the hundred-node field over the horizon, and of the whole comparison (dmhe-l-step item 15, E2).

With pre-estimation a local problem has four unknowns whatever N is, with estimated disturbances 4 (N + 1): item 15 is
about solving the condensed problems of all nodes, factorizations included. The engine beside it knows its maps and
returns all states of all windows. Medians over settled steps, the two horizons in turn in one process.
"""

from __future__ import annotations

import json
import time
import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

from mhe.relay import RelayDesign, RelayNetwork
from mhe.scenarios.sensor_field_world import draw_trial, sensor_field
from problems.cli.main import app

SETTLED, STEPS = 45, 150
HORIZONS = (2, 10)


def problems_of(network: RelayNetwork) -> tuple[np.ndarray, np.ndarray]:
    """Hessians (nodes, k, k) and linear costs (nodes, k) of all local problems, condensed."""
    fork = network._batch.session.fork()
    hessians, linear = [], []
    for numbers in network._batch.numbers:
        fork.adopt(numbers)
        map_ = fork.current_map()
        hessians.append(np.asarray(map_.P))
        linear.append(map_.vectors(numbers)[0])
    return np.array(hessians), np.array(linear)


def test_solve_time_over_the_horizon() -> None:
    quadprog = pytest.importorskip("quadprog")
    field = sensor_field()
    y = draw_trial(field, STEPS, np.random.default_rng(9)).measurements
    columns = ("unknowns", "batched LAPACK", "quadprog calls", "engine, maps known", "whole step")
    print("\n100 nodes, ms, N = 2 / 10 (ratio):", " | ".join(columns))
    growth = {}
    for method in ("dmhe_1_pre", "dmhe_l_pre", "dmhe_b"):
        networks = []
        for N in HORIZONS:
            options = {"placement": field.placement, "horizon": N}
            if method == "dmhe_b":
                options["form"] = "F3"  # the first state and the disturbances are the unknowns
            networks.append(RelayNetwork(RelayDesign(field.model, field.network, method, **options), 1))
        for row in y[:SETTLED]:
            for network in networks:
                network.step(row[None])
        local = [problems_of(network) for network in networks]
        taken = []
        for row in y[SETTLED:]:
            for network, (P, q) in zip(networks, local, strict=True):
                begin = time.perf_counter()
                np.linalg.solve(P, -q[..., None])
                middle = time.perf_counter()
                for one, linear in zip(P, q, strict=True):
                    quadprog.solve_qp(one, -linear)
                end = time.perf_counter()
                network.step(row[None])
                step = network.step(row[None])  # once more: what runs between them takes the caches
                taken.append((middle - begin, end - middle, step.phases["solve"], step.seconds))
        both = 1e3 * np.median(np.array(taken).reshape(-1, 2, 4), axis=0)
        growth[method] = both[1] / both[0]
        shown = (f"{a:7.3f} /{b:7.3f} ({b / a:4.1f})" for a, b in both.T)
        print(f"  {method:29} {local[0][1].shape[1]:3d} /{local[1][1].shape[1]:3d} ", *shown)
        assert both[0, 3] < 1.0
    assert max(growth["dmhe_1_pre"][:2]) < 2 and max(growth["dmhe_l_pre"][:2]) < 2
    assert growth["dmhe_b"][0] > 5


@pytest.mark.parametrize("startup", ["fuse", "literal"])
def test_twenty_trials_of_six_methods(startup: str) -> None:
    methods = ("dmhe_l_pre", "dmhe_1_pre", "dmhe_b", "dmhe_f", "dmhe_pre", "mhe")
    words = ["run", "sensor-field", "--trials", "20", "--seed", "3", "--json", "--set", f"startup={startup}"]
    for method in methods:
        words += ["--method", method]
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = CliRunner().invoke(app, words)
    seconds = time.perf_counter() - start
    print(f"\n{startup}: {seconds:.1f} s for 20 trials, 40 s each, of six methods")
    for row in json.loads(result.stdout)["rows"]:
        found = {name: "-" if value is None else f"{value:6.2f}" for name, value in row["metrics"].items()}
        print(f"  {row['method']:11}", ", ".join(f"{name} {value}" for name, value in found.items()))
    assert seconds < 120
