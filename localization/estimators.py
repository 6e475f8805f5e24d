"""GLS: the linear localization problem that keeps what bearings of one robot share, the error of its compass.

Plain least squares takes relative positions as independent, although all of one robot turn with its compass. Here that
error is a variable, the problem stays linear, and headings come with it. It over-trusts ranges where the curvature
ratio (`lattice.curvature_ratio`) is large. Source: spec ``gps-range-bearing-localization`` section 10.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from localization import measurements as meas
from localization.lattice import Fence, Measurements, linear_data
from problems.noise import Gaussian
from problems.problem import Problem
from problems.solvers.session import Solution
from problems.spaces import Vector, wrap


def sighting(observer: Any, turn: Any, target: Any, z: Any) -> Any:
    """Error of bearing (rad) and range (m), linear about the measured direction.

    Args:
        observer, target: positions; `turn` (1,): true minus measured heading of the observer, rad.
        z: measured direction in the world (2,) and range.
    """
    away = target - observer
    along = ca.vertcat(z[0], z[1])
    across = ca.vertcat(-z[1], z[0])
    return ca.vertcat(ca.dot(across, away) / z[2] - turn, ca.dot(along, away) - z[2])


def compass_state_problem(team: Measurements, *, fence: Fence | None = None) -> Problem:
    """Linear least squares of positions ``robot`` on Vector(2) and compass errors ``turn`` on Vector(1).

    Only robots, pairs and sigmas of `team` enter; `compass_state_data` gives the numbers.

    Args:
        fence: lowest and highest position (2,) of every robot, m.
    """
    sigmas = team.sigmas
    problem = Problem("team, linear with compass states")
    robot = problem.variables("robot", Vector(2), team.robots)
    turn = problem.variables("turn", Vector(1), team.robots)
    fixes = problem.data("fixes", 2, team.robots)
    sightings = problem.data("sightings", 3, len(team.observer))
    problem.cost("gps", meas.position, on=robot, data=fixes, noise=Gaussian(sigmas.position))
    problem.cost("compass", lambda element: element, on=turn, noise=Gaussian(sigmas.heading))
    problem.cost(
        "sighting",
        sighting,
        on=(robot[team.observer], turn[team.observer], robot[team.target]),
        data=sightings,
        noise=Gaussian([sigmas.bearing, sigmas.range]),
    )
    if fence is not None:
        problem.inequality("fence", lambda element: element, on=robot, lower=fence[0], upper=fence[1])
    return problem


def compass_state_data(team: Measurements) -> dict[str, np.ndarray]:
    """Data of `compass_state_problem`; errors and warnings as for `lattice.linear_data`."""
    displacement = linear_data(team)["displacements"]
    distance = np.linalg.norm(displacement, axis=1)
    return {"fixes": team.gps, "sightings": np.column_stack([displacement / distance[:, None], distance])}


def compass_state_poses(team: Measurements, solution: Solution) -> np.ndarray:
    """Poses (n, 3) from a solution of `compass_state_problem`; heading NaN where there is no compass reading."""
    return np.column_stack([solution["robot"], wrap(team.compass + solution["turn"][:, 0])])
