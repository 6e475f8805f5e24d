"""Recorded pose graphs: our Gauss-Newton beside gtsam as its Python examples write it, in one process.

Both start at the same values (the file's, else the chained odometry), use the same chart and hold the first pose. Costs
are compared before times. gtsam: build graph and values, Levenberg-Marquardt with default tolerances, which end within
1e-6 of these optima, and with tight ones. Ours: definition, compilation and solve, all made anew each time. Processor
time, median of repetitions, the two sides in turn; reading the file and first imports are nobody's.
"""

from __future__ import annotations

import os
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.record import compared
from localization.io import PoseGraph, open_recording
from localization.pose_graph import graph_problem, starting_values
from problems.forms.residual_code import residual_code
from problems.forms.template import template_of
from problems.spatial import GTSAM_ORDER

gtsam = pytest.importorskip("gtsam")

# optimum, repetitions, and by linear solver gtsam's time over ours, at least: with default and with tight tolerances
CASES: dict[str, tuple[float, int, dict[str, tuple[float, float]]]] = {
    "intel": (22.502117, 15, {"auto": (4.2, 4.8)}),
    "kitti_05": (78.551925, 15, {"auto": (5.5, 5.5)}),
    "manhattan": (1774.520535, 9, {"auto": (6.0, 7.0)}),
    "tinyGrid3D": (9.313909, 15, {"auto": (0.28, 0.28)}),  # 9 poses: what is timed is how Python starts
    "sphere2500": (
        675.700963,
        5,
        {"block": (2.2, 3.0), "superlu": (0.4, 0.5), "qdldl": (0.3, 0.4), "pardiso": (2.0, 2.4), "cholmod": (1.5, 1.9)},
    ),
}
GOALS = {
    ("intel", "auto"): 4.0,
    ("kitti_05", "auto"): 4.0,
    ("manhattan", "auto"): 4.0,
    ("tinyGrid3D", "auto"): 0.25,
    ("sphere2500", "pardiso"): 2.0,
    ("sphere2500", "block"): 0.5,  # what there is without extras
}
PACKAGES = {"pardiso": "pypardiso", "cholmod": "cvxopt"}


def recording(name: str) -> PoseGraph:
    beside = Path(__file__).resolve().parents[1].parent / "shared" / "data"
    path = Path(os.environ.get("HORIZONET_DATA") or beside) / "g2o" / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"needs the recording {path}")
    return open_recording(path)


def by_gtsam(graph: PoseGraph, start: np.ndarray, tight: bool) -> float:
    """Cost of the optimum, with gtsam alone."""
    edges, planar = graph.relative_poses, graph.dimension == 2
    information = edges.information
    if planar:
        between, equal = gtsam.BetweenFactorPose2, gtsam.NonlinearEqualityPose2
    else:
        between, equal = gtsam.BetweenFactorPose3, gtsam.NonlinearEqualityPose3
        information = information[:, GTSAM_ORDER][:, :, GTSAM_ORDER]

    def pose(z: list[float]) -> Any:
        if planar:
            return gtsam.Pose2(*z)
        return gtsam.Pose3(gtsam.Rot3.Quaternion(z[6], z[3], z[4], z[5]), np.array(z[:3]))

    factors, values, model = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Gaussian.Information
    rows = zip(edges.first.tolist(), edges.second.tolist(), edges.value.tolist(), information, strict=True)
    for i, j, z, weight in rows:
        factors.add(between(i, j, pose(z), model(weight)))
    for k, x in enumerate(start.tolist()):
        values.insert(k, pose(x))
    factors.add(equal(0, pose(start[0].tolist())))
    parameters = gtsam.LevenbergMarquardtParams()
    if tight:
        parameters.setRelativeErrorTol(1e-10)
        parameters.setAbsoluteErrorTol(1e-9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)
    return factors.error(optimizer.optimize())


@pytest.mark.parametrize("name", CASES)
def test_pose_graphs_beside_gtsam(name: str) -> None:
    optimum, repetitions, wanted = CASES[name]
    graph = recording(name)
    start = starting_values(graph)["pose"]
    for chosen, (default_wanted, tight_wanted) in wanted.items():
        if chosen in PACKAGES and find_spec(PACKAGES[chosen]) is None:
            print(f"\n{name} with {chosen}: {PACKAGES[chosen]} is not installed")
            continue
        seconds: dict[str, list[float]] = {key: [] for key in ("define", "compile", "solve", "gtsam", "tight")}
        for repetition in range(repetitions + 1):
            marks = [time.process_time()]
            problem, initial = graph_problem(graph)
            marks.append(time.process_time())
            session = problem.compile("gauss-newton", linear_solver=chosen)
            marks.append(time.process_time())
            solution = session.solve(initial=initial)
            marks.append(time.process_time())
            cost = by_gtsam(graph, start, tight=False)
            marks.append(time.process_time())
            exact = by_gtsam(graph, start, tight=True)
            marks.append(time.process_time())
            if repetition:  # the first one loads libraries
                for key, duration in zip(seconds, np.diff(marks), strict=True):
                    seconds[key].append(float(duration))
        assert solution.status == "solved"
        assert solution.objective == pytest.approx(optimum, abs=2e-6)
        assert exact == pytest.approx(solution.objective, rel=1e-8)
        assert cost == pytest.approx(solution.objective, rel=1e-6)
        t = {key: 1e3 * float(np.median(values)) for key, values in seconds.items()}
        ours = t["define"] + t["compile"] + t["solve"]
        print(
            f"\n{name}, {len(graph.keys)} poses, {len(graph.relative_poses)} edges, {chosen}: cost {optimum:.6f}, "
            f"gtsam {cost - solution.objective:+.1e}, tight {exact - solution.objective:+.1e}\n"
            f"  ours: define {t['define']:.1f}, compile {t['compile']:.1f}, solve {t['solve']:.1f} ms in "
            f"{solution.iterations} iterations\n"
            f"  gtsam: build and optimize {t['gtsam']:.1f} ms, with tight tolerances {t['tight']:.1f} ms\n"
            f"  gtsam / ours: {t['gtsam'] / ours:.2f}, tight {t['tight'] / ours:.2f}; solve alone "
            f"{t['gtsam'] / t['solve']:.2f}"
        )
        total = np.sum([seconds[key] for key in ("define", "compile", "solve")], axis=0)
        goal = GOALS.get((name, chosen))
        measure = f"pose graph {name}, linear solver {chosen}, build and solve"
        compared(measure, "gtsam LM", total, seconds["gtsam"], wanted=goal)
        compared(measure, "gtsam LM, tight tolerances", total, seconds["tight"])
        assert t["gtsam"] / ours >= default_wanted
        assert t["tight"] / ours >= tight_wanted


def test_derivatives_in_space() -> None:
    """Array code of relative poses on SE(3), on as many instances as sphere2500 has."""
    problem, initial = graph_problem(recording("sphere2500"))
    term = problem.terms["relative_poses"]
    edges = template_of(term)
    code, point = residual_code(term), initial["pose"]
    ends = [slot.indices for slot in term.slots]
    values = [np.ascontiguousarray(v) for end in ends for v in point[end].T]
    data = problem.inputs["relative_poses_measured"].value
    assert data is not None
    values += [np.ascontiguousarray(v) for v in data.T]
    seconds = []
    for _ in range(15):
        begin = time.process_time()
        code.residual_and_jacobian(values, term.count)
        seconds.append(time.process_time() - begin)
    print(f"\nSE(3), {term.count} residuals (6,) and Jacobians (6, {edges.width}): {1e3 * np.median(seconds):.2f} ms")
