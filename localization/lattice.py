"""A team of robots on a square lattice, and the problem of localizing any team from GPS, compass, range and bearing.

One `Measurements` object goes to two problems: `team_problem`, nonlinear (maximum likelihood, spec (3.1)-(3.2)), for
solvers of graphs and nonlinear programs; and `linear_problem` (least squares, (3.9)-(3.11)), which is a quadratic
program as well. Source: spec ``gps-range-bearing-localization`` 3.4 to 3.6 and 6.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from localization import measurements as meas
from problems.errors import DataError, ModelWarning, SettingError, UnobservableError
from problems.noise import Gaussian, Loss
from problems.problem import Problem, Variable
from problems.solvers.session import Solution
from problems.spaces import SE2, Vector, wrap

SPACING = 4.0  # m, spec 6
CURVATURE_LIMIT = 0.4  # of `curvature_ratio`, spec 3.6
ANGLE_LIMIT = 0.3  # rad, beyond which the angular noise model is no longer valid, spec 5

Pairs = Literal["one", "both"]
Angles = Literal["geodesic", "chordal"]
Fence = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations: `position` (GPS, m per axis), `heading` (compass, rad), `range` (m), `bearing` (rad).

    That of GPS may be one per robot and axis, (n, 2).
    """

    position: float | np.ndarray = 2.0
    heading: float = 0.05
    range: float = 0.1
    bearing: float = 0.03


@dataclass(frozen=True, eq=False)
class Measurements:
    """What a team measured at one instant. NaN is missing.

    Attributes:
        gps: (n, 2) fixes, m.
        compass: (n,) headings, rad.
        observer, target: (m,) robots; the bearing is taken in the frame of `observer`.
        bearing_range: (m, 2) bearing (rad) and range (m) of `target`.
        sigmas: noise assumed by the estimators.
        truth: (n, 3) x (m), y (m), heading (rad), where it is known.
    """

    gps: np.ndarray
    compass: np.ndarray
    observer: np.ndarray
    target: np.ndarray
    bearing_range: np.ndarray
    sigmas: Sigmas = Sigmas()
    truth: np.ndarray | None = None

    @property
    def robots(self) -> int:
        return len(self.gps)


def lattice(robots: int, spacing: float = SPACING) -> tuple[np.ndarray, np.ndarray]:
    """Positions of robots on a square lattice and the pairs of nearest neighbours.

    The lattice is a rectangle with sides of ratio 2 at most; where `robots` fills none, its last row is shorter.

    Args:
        robots: how many, at least 2.
        spacing: m.

    Returns:
        Positions (robots, 2), row by row from the origin, and pairs (m, 2) with the smaller index first.

    Raises:
        SettingError: fewer than two robots, or a spacing that is not positive.
    """
    if robots < 2 or not spacing > 0:
        raise SettingError(f"a lattice needs at least 2 robots and a positive spacing, got {robots} and {spacing}")
    narrow = math.isqrt(robots - 1) + 1
    width = next((w for w in range(narrow, math.isqrt(2 * robots) + 1) if robots % w == 0), narrow)
    index = np.arange(robots)
    right = index[(index % width < width - 1) & (index + 1 < robots)]
    up = index[index + width < robots]
    pairs = np.vstack([np.column_stack([right, right + 1]), np.column_stack([up, up + width])])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return spacing * np.column_stack([index % width, index // width]).astype(float), pairs


def angular_gaussian(angle: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Angles (m,) drawn around `angle`: direction of the unit vector plus isotropic noise of `sigma` (spec 3.4).

    Their standard deviation is `sigma` (rad) while that is small.
    """
    disturbed = np.column_stack([np.cos(angle), np.sin(angle)]) + sigma * rng.normal(size=(len(angle), 2))
    return np.arctan2(disturbed[:, 1], disturbed[:, 0])


def draw_lattice(
    robots: int,
    rng: np.random.Generator,
    *,
    pairs: Pairs = "one",
    spacing: float = SPACING,
    sigmas: Sigmas = Sigmas(),
) -> Measurements:
    """A lattice team with headings uniform in [0, 2 pi) and one draw of everything it measures.

    Args:
        pairs: ``one`` measurement per pair of neighbours, by the robot with the smaller index, or one from ``both``.

    Other arguments and errors as for `lattice`.
    """
    positions, edges = lattice(robots, spacing)
    truth = np.column_stack([positions, wrap(rng.uniform(0, 2 * np.pi, robots))])
    if pairs == "both":
        edges = np.vstack([edges, edges[:, ::-1]])
    return measure(truth, edges[:, 0], edges[:, 1], rng, sigmas)


def measure(
    truth: np.ndarray, observer: np.ndarray, target: np.ndarray, rng: np.random.Generator, sigmas: Sigmas = Sigmas()
) -> Measurements:
    """Draw GPS, compass, range and bearing of a team at the poses `truth` (n, 3); sampling rule of spec 3.4."""
    robots, away = len(truth), truth[target, :2] - truth[observer, :2]
    direction = np.arctan2(away[:, 1], away[:, 0]) - truth[observer, 2]
    gps = truth[:, :2] + sigmas.position * rng.normal(size=(robots, 2))
    compass = angular_gaussian(truth[:, 2], sigmas.heading, rng)
    ranges = np.hypot(*away.T) + sigmas.range * rng.normal(size=len(away))
    bearings = angular_gaussian(direction, sigmas.bearing, rng)
    seen = np.column_stack([bearings, ranges])
    return Measurements(gps, compass, observer, target, seen, sigmas, truth)


def team_problem(
    team: Measurements, *, loss: Loss | None = None, angles: Angles = "geodesic", fence: Fence | None = None
) -> Problem:
    """Maximum likelihood of poses: variables ``robot`` on SE2 (spec (3.1)-(3.2)).

    Only robots, pairs and sigmas of `team` enter; `team_data` gives the numbers to solve for.

    Args:
        loss: on GPS fixes, whose outliers are gross.
        angles: residual of compass and bearings. ``chordal`` is the seed's likelihood, ``geodesic`` the wrapped angle
            that factor graphs use; they agree to third order.
        fence: lowest and highest position (2,) of every robot, m; infinite where there is no bound.
    """
    sigmas, chordal = team.sigmas, angles == "chordal"
    problem = Problem("team")
    robot = problem.variables("robot", SE2, team.robots)
    fixes = problem.data("fixes", 2, team.robots)
    headings = problem.data("headings", (), team.robots)
    seen = problem.data("seen", 2, len(team.observer))
    problem.cost("gps", meas.position, on=robot, data=fixes, noise=Gaussian(sigmas.position), loss=loss)
    problem.cost(
        "compass", meas.heading_chordal if chordal else meas.heading, on=robot, data=headings,
        noise=Gaussian(sigmas.heading),
    )  # fmt: skip
    problem.cost(
        "bearing_range", meas.bearing_range_chordal if chordal else meas.bearing_range,
        on=(robot[team.observer], robot[team.target]), data=seen, noise=Gaussian([sigmas.bearing, sigmas.range]),
    )  # fmt: skip
    return _fenced(problem, robot, fence)


def team_data(team: Measurements) -> dict[str, np.ndarray]:
    """Data of `team_problem`."""
    return {"fixes": team.gps, "headings": team.compass, "seen": team.bearing_range}


def linear_problem(team: Measurements, *, loss: Loss | None = None, fence: Fence | None = None) -> Problem:
    """Linear least squares of positions: variables ``robot`` on Vector(2) (spec (3.6)-(3.11)); no headings.

    Arguments as for `team_problem`; `linear_data` gives the numbers. With a loss it is no quadratic program.
    """
    count = len(team.observer)
    problem = Problem("team, linear")
    robot = problem.variables("robot", Vector(2), team.robots)
    fixes = problem.data("fixes", 2, team.robots)
    displacements = problem.data("displacements", 2, count)
    covariances = problem.data("covariances", (2, 2), count)
    problem.cost("gps", meas.position, on=robot, data=fixes, noise=Gaussian(team.sigmas.position), loss=loss)
    problem.cost(
        "displacement", meas.relative_position, on=(robot[team.observer], robot[team.target]), data=displacements,
        noise=Gaussian(covariance=covariances),
    )  # fmt: skip
    return _fenced(problem, robot, fence)


def linear_data(team: Measurements) -> dict[str, np.ndarray]:
    """Data of `linear_problem`: displacements (m, 2) and their covariances (m, 2, 2) at the measured values, (3.8).

    Warns (`ModelWarning`) where the noise is too large for the linearization, and where ranges that are not positive
    are left out.

    Raises:
        DataError: an observer has no compass reading, so its bearings have no direction.
    """
    sigmas, blind = team.sigmas, np.unique(team.observer[np.isnan(team.compass[team.observer])])
    if blind.size:
        raise DataError(
            f"robot(s) {_listed(blind)} measure bearings without a compass reading; the linear problem needs the "
            "heading of every observer, the nonlinear one does not"
        )
    ranges = team.bearing_range[:, 1]
    phi = team.bearing_range[:, 0] + team.compass[team.observer]
    c, s = np.cos(phi), np.sin(phi)
    displacement = ranges[:, None] * np.column_stack([c, s])
    along, across = sigmas.range**2, ranges**2 * (sigmas.bearing**2 + sigmas.heading**2)
    covariance = np.empty((len(ranges), 2, 2))
    covariance[:, 0, 0] = along * c**2 + across * s**2
    covariance[:, 1, 1] = along * s**2 + across * c**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = (along - across) * s * c
    unusable = ~(ranges > 0)
    displacement[unusable], covariance[unusable] = np.nan, np.eye(2)
    _warn_of_noise(team, unusable & ~np.isnan(ranges))
    return {"fixes": team.gps, "displacements": displacement, "covariances": covariance}


def curvature_ratio(team: Measurements) -> np.ndarray:
    """How far the linear model bends each measurement (m,): r (sigma_bearing^2 + sigma_heading^2) / (2 sigma_range)."""
    sigmas = team.sigmas
    return np.abs(team.bearing_range[:, 1]) * (sigmas.bearing**2 + sigmas.heading**2) / (2 * sigmas.range)


def require_anchored(team: Measurements) -> None:
    """Check that every group of robots connected by measurements has a GPS fix.

    Raises:
        UnobservableError: names the groups without.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    used = ~np.isnan(team.bearing_range).any(axis=1)
    ends = (team.observer[used], team.target[used])
    graph = coo_array((np.ones(int(used.sum())), ends), shape=(team.robots, team.robots))
    groups, label = connected_components(graph, directed=False)
    fixed = np.bincount(label, ~np.isnan(team.gps).any(axis=1), groups) > 0
    if not fixed.all():
        names = "; ".join(_listed(np.flatnonzero(label == k)) for k in np.flatnonzero(~fixed))
        raise UnobservableError(
            f"no GPS fix in {int((~fixed).sum())} group(s) of robots connected by measurements: {names}; "
            "give one robot of each group a fix, or leave the group out"
        )


def linear_start(team: Measurements) -> tuple[np.ndarray, Solution]:
    """Starting poses (n, 3) of the nonlinear problem: positions by least squares, headings by compass (0 without one).

    Raw GPS is no start: large teams then end in local minima (spec 7.3).

    Raises:
        UnobservableError, DataError: as `require_anchored` and `linear_data`.
    """
    require_anchored(team)
    solution = linear_problem(team).compile().solve(linear_data(team))
    return np.column_stack([solution["robot"], np.nan_to_num(team.compass)]), solution


def position_covariances(solution: Solution, robot: Variable) -> np.ndarray:
    """World-frame covariances (n, 2, 2) of the positions in a solution of either problem, m^2.

    Raises:
        UnobservableError: the measurements leave a direction free.
    """
    joint = solution.covariance(robot)
    dim = robot.space.dim
    index = dim * np.arange(robot.count)
    block = joint[index[:, None, None] + np.arange(2)[:, None], index[:, None, None] + np.arange(2)]
    if dim == 2:
        return block
    heading = solution[robot.name][:, 2]  # the tangent of SE2 is in the body frame
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=1)
    return turn @ block @ turn.swapaxes(1, 2)


def split_squared_error(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Squared position error per robot (m^2), as a part of the centroid and a part relative to it ((3.15)-(3.17)).

    Args:
        estimate, truth: (n, 2) or wider; the first two columns count.
    """
    error = estimate[:, :2] - truth[:, :2]
    center = error.mean(axis=0)
    return float(center @ center), float(np.mean(np.sum((error - center) ** 2, axis=1)))


def _fenced(problem: Problem, robot: Variable, fence: Fence | None) -> Problem:
    if fence is not None:
        problem.inequality("fence", _place, on=robot, lower=fence[0], upper=fence[1])
    return problem


def _place(element: Any) -> Any:
    return element.translation if hasattr(element, "translation") else element


def _warn_of_noise(team: Measurements, negative: np.ndarray) -> None:
    sigmas = team.sigmas
    worst = float(np.nanmax(curvature_ratio(team), initial=0.0))
    told = []
    if negative.any():
        told.append(f"{int(negative.sum())} range(s) that are not positive are left out")
    if worst > CURVATURE_LIMIT:
        told.append(f"the curvature ratio reaches {worst:.2g}, above {CURVATURE_LIMIT}: directions bend the model")
    if max(sigmas.heading, sigmas.bearing) > ANGLE_LIMIT:
        told.append(f"angles with a sigma above {ANGLE_LIMIT} rad are not Gaussian")
    if told:
        warnings.warn("linear localization: " + "; ".join(told), ModelWarning, stacklevel=3)


def _listed(robots: np.ndarray, most: int = 8) -> str:
    text = ", ".join(str(k) for k in robots[:most])
    return text + (f" and {len(robots) - most} more" if len(robots) > most else "")
