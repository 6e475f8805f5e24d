"""Draws docs/picture.png, the picture of the README: a team before and after, and accuracy against time of solvers.

Run: ``OMP_NUM_THREADS=1 .venv/bin/python docs/picture.py``
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from matplotlib.patches import Ellipse

from localization import measurements as meas
from mhe import Polyhedron, mhe
from problems import SE2, Gaussian, LinearModel, Problem, Sensor, simulate
from problems.display import new_figure

COLOURS = {"osqp": "#d55e00", "proxqp": "#009e73", "piqp": "#cc79a7", "daqp": "#0072b2"}
MARKERS = {"osqp": "o", "proxqp": "s", "piqp": "^", "daqp": "D"}
LADDER = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)


def draw_team(axes) -> None:
    """Twenty-five robots with poor position fixes that see their neighbours."""
    rng = np.random.default_rng(7)
    place = 10.0 * np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(-1, 2)
    place = place + rng.normal(scale=1.2, size=place.shape)
    heading = rng.uniform(-np.pi, np.pi, 25)
    i, j = np.nonzero((np.linalg.norm(place[:, None] - place, axis=2) < 15) & ~np.eye(25, dtype=bool))
    offset = place[j] - place[i]
    seen = np.column_stack([np.arctan2(offset[:, 1], offset[:, 0]) - heading[i], np.hypot(*offset.T)])
    seen = seen + rng.normal(size=seen.shape) * [0.03, 0.3]
    fixes, compass = place + rng.normal(scale=2.0, size=place.shape), heading + rng.normal(scale=0.05, size=25)

    team = Problem("team")
    robot = team.variables("robot", SE2, 25)
    team.cost("gps", meas.position, on=robot, data=team.data("fixes", 2, 25), noise=Gaussian(sigma=2.0))
    team.cost("compass", meas.heading, on=robot, data=team.data("compass", (), 25), noise=Gaussian(sigma=0.05))
    z = team.data("seen", 2, len(i))
    team.cost("sight", meas.bearing_range, on=(robot[i], robot[j]), data=z, noise=Gaussian(sigma=[0.03, 0.3]))
    data = {"fixes": fixes, "compass": compass, "seen": seen}
    solution = team.compile("gauss-newton").solve(data, {"robot": np.column_stack([fixes, compass])})
    found = solution["robot"]

    for a, b in zip(i, j, strict=True):
        axes.plot(*place[[a, b]].T, color="#dddddd", linewidth=0.6, zorder=0)
    axes.plot(*place.T, "+", color="black", markersize=7, label="truth")
    axes.plot(*fixes.T, "x", color="#d55e00", markersize=5, label="position fixes, 2 m per axis")
    for k in range(25):
        turn = np.array([[np.cos(found[k, 2]), -np.sin(found[k, 2])], [np.sin(found[k, 2]), np.cos(found[k, 2])]])
        values, vectors = np.linalg.eigh(turn @ solution.covariance(robot[k])[:2, :2] @ turn.T)
        width, height = 2 * np.sqrt(5.991 * values)
        angle = np.degrees(np.arctan2(*vectors[::-1, 0]))
        axes.add_patch(Ellipse(found[k, :2], width, height, angle=angle, facecolor="#0072b230", edgecolor="#0072b2"))
    axes.quiver(*found[:, :2].T, np.cos(found[:, 2]), np.sin(found[:, 2]), color="#0072b2", scale=22, width=0.006)
    axes.plot([], [], "o", color="#0072b2", label="team estimate, 95 % regions")
    rms = np.sqrt(np.mean(np.sum((found[:, :2] - place) ** 2, axis=1)))
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"25 robots as one factor graph: {rms:.2f} m rms")
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False)


def draw_solvers(axes) -> None:
    """Distance to the optimum against time of a step of one moving horizon estimator, for a ladder of tolerances."""
    matrix = [[0.99, 0.2, 0, 0], [-0.1, 0.6, 0, 0], [0, 0, 0.95, 0.2], [0, 0, -0.2, 0.9]]
    sensors = [Sensor("first", [[1.0, 0, 0, 0]], sigma=0.5), Sensor("third", [[0, 0, 1.0, 0]], sigma=0.5)]
    model = LinearModel(matrix, np.diag([0.05, 0.1, 0.05, 0.1]), sensors=sensors, covariance=np.eye(4))
    run = simulate(model, 300, np.random.default_rng(0))
    edge = np.quantile(np.abs(run.states), 0.96, axis=0)
    common = {"state_bounds": Polyhedron.box(-edge, edge), "prior": "seed", "arrival_covariance": "constant"}

    def steps(solver: str, tolerance: float) -> tuple[np.ndarray, float]:
        estimator = mhe(model, 15, solver=solver, tolerance=tolerance, **common)
        states, seconds = [], []
        for y in run.measurements:
            start = time.perf_counter()
            states.append(estimator.step(y).state)
            seconds.append(time.perf_counter() - start)
        return np.array(states), float(np.median(seconds[30:]))

    best, _ = steps("daqp", 1e-11)
    for solver, colour in COLOURS.items():
        points = [steps(solver, tolerance) for tolerance in LADDER]
        away = [max(float(np.sqrt(np.mean((states - best) ** 2))), 1e-15) for states, _ in points]
        axes.loglog(
            [1e6 * s for _, s in points], away, marker=MARKERS[solver], color=colour, label=solver, markersize=5
        )
    axes.set(
        xlabel="median time of a step (µs)",
        ylabel="rms distance to the optimum",
        title="one window, four solvers, tolerances 1e-2 ... 1e-8",
    )
    axes.set_xticks([30, 50, 100, 200, 500], [30, 50, 100, 200, 500])
    axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.12))


if __name__ == "__main__":
    drawing = new_figure(figsize=(11, 5.2), layout="constrained")
    left, right = drawing.subplots(1, 2)
    draw_team(left)
    draw_solvers(right)
    drawing.savefig(Path(__file__).with_name("picture.png"), dpi=100)
