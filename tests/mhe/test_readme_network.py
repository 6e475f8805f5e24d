"""A user's own model on an own network: every method and two solvers in one loop, as the README shows it."""

from __future__ import annotations

import pytest

SNIPPET = """
import networkx as nx
import numpy as np

from mhe import KalmanFilter, Polyhedron, mhe, mhe_pre
from mhe.distributed import METHODS, DistributedEstimator
from problems import LinearModel, Sensor, simulate
from problems.networks import Network

# A cart on a rail: position, velocity, and a force that changes. Nodes a and b see the position, c only the velocity.
outputs = {"a": [[1.0, 0, 0]], "b": [[1.0, 0, 0]], "c": [[0, 1.0, 0]]}
sensors = [Sensor(node, output, sigma=0.5) for node, output in outputs.items()]
A = [[1, 0.1, 0.005], [0, 1, 0.1], [0, -0.2, 0.9]]
model = LinearModel(A, np.diag([1e-6, 1e-4, 1e-2]), sensors=sensors, covariance=np.eye(3), dt=0.1)
network = Network.from_networkx(nx.Graph(["ab", "ad", "bd", "de", "ec", "cf", "fe"]))
run = simulate(model, 60, np.random.default_rng(10))
limit = np.abs(run.states).max(axis=0)  # known of the cart; it bites where noise carries estimates beyond

estimators = {"kf": KalmanFilter(model)}
for solver in ("daqp", "osqp"):
    common = {"horizon": 5, "solver": solver, "state_bounds": Polyhedron.box(-limit, limit), "infeasible": "soft"}
    estimators |= {f"mhe, {solver}": mhe(model, **common), f"mhe_pre, {solver}": mhe_pre(model, **common)}
    for method in METHODS:  # dmhe_f, dmhe_pre, dmhe_w_pre
        estimators[f"{method}, {solver}"] = DistributedEstimator(model, network, method, placement="abc", **common)
for name, estimator in estimators.items():
    steps = [estimator.step(y) for y in run.measurements]
    states = np.array([step.state if hasattr(step, "state") else step.states for step in steps]).reshape(61, -1, 3)
    error = np.linalg.norm(states - run.states[:, None], axis=2)
    print(f"{name:18} mean error {error.mean():.3f}, worst node {error.mean(axis=0).max():.3f}")
"""


def test_all_methods_and_two_solvers_in_thirty_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert sum(bool(line.strip()) for line in SNIPPET.splitlines()) <= 30
    exec(compile(SNIPPET, "README.md", "exec"), {})
    printed = dict(line.split(" mean error ") for line in capsys.readouterr().out.splitlines())
    found = {name.strip(): values for name, values in printed.items()}
    methods = ("mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre")
    assert set(found) == {"kf", *(f"{method}, {solver}" for method in methods for solver in ("daqp", "osqp"))}
    for method in methods:
        assert found[f"{method}, daqp"] == found[f"{method}, osqp"]
    mean = {name: float(values.split(",")[0]) for name, values in found.items()}
    # without bounds mhe is the Kalman filter, so it is the bounds that make it better
    assert mean["mhe, daqp"] < mean["kf"] < mean["dmhe_f, daqp"] < 1
