"""Methods of scenario ``recording`` for pose graphs and range-aided graphs (g2o, PyFG; spec ``recordings`` 3 and 5)."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from localization.edge_checks import EdgeCheck, check_edges
from localization.io.poses import Poses
from localization.io.recording import PoseGraph
from localization.io.scoring import ate
from localization.joining import moved
from localization.marginals import marginal_covariances
from localization.pose_graph import evaluate, graph_problem
from localization.starts import Initial, Start, choose_start
from problems.bench.rows import finite
from problems.bench.scenario import Outcome
from problems.errors import AccuracyWarning, DataError, SettingError, UnobservableError
from problems.forms.pins import Pins
from problems.forms.template import template_of
from problems.noise import Cauchy, GemanMcClure, Huber, Loss, Tukey
from problems.problem import Problem
from problems.solvers.base import Status
from problems.solvers.session import Session, Solution

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from localization.scenarios.recording import Settings

LOSSES: dict[str, type[Any]] = {"huber": Huber, "cauchy": Cauchy, "geman_mcclure": GemanMcClure, "tukey": Tukey}
SAME = 1e-6  # relative difference of costs of one and the same minimum
UNUSABLE = (Status.INFEASIBLE, Status.UNBOUNDED, Status.FAILED)


@dataclass(frozen=True, eq=False)
class GraphTrace:
    """What pictures and files need.

    Attributes:
        pose: (n, 3 | 7) estimated. landmark: (l, 2 | 3), or None.
        start: (n, 3 | 7) where the solve began.
        covariance: world frame, by variable (``pose`` (n, 3 | 6, ...), ``landmark``), or None.
        aligned: the same of what a rigid alignment leaves, where the gauge was held; else `covariance`.
        edges: the worst measurements as JSON types, worst first.
    """

    pose: np.ndarray
    landmark: np.ndarray | None
    start: np.ndarray
    covariance: dict[str, np.ndarray] | None
    aligned: dict[str, np.ndarray] | None
    edges: list[dict[str, Any]]


class GraphMethods:
    """See the module."""

    what = "a pose graph"
    methods = ("ml", "ls")
    settings = (
        "chart", "initial", "starts", "start", "robust", "robust_on", "robust_scale", "graduated", "odometry_scale",
        "fence", "edges", "tolerance", "iteration_limit", "time_limit", "covariance",
    )  # fmt: skip
    outputs = (".csv", ".g2o", ".tum")

    @classmethod
    def possible(cls, recording: PoseGraph) -> tuple[str, ...]:
        """Methods that fit: linear least squares takes no ranges."""
        return ("ml",) if len(recording.ranges) else cls.methods

    @staticmethod
    def prepare(settings: Settings, recording: PoseGraph, rng: np.random.Generator) -> None:
        """Raises SettingError for settings that this graph cannot have."""
        del rng
        if settings.start not in ("ranges", "truth"):
            raise SettingError(f"{settings.path}: start of a graph is 'ranges' or 'truth', got {settings.start!r}")
        if settings.start == "truth" and recording.truth is None:
            raise SettingError(f"{settings.path}: start=truth needs truth, which this recording does not have")
        if settings.fence is not None and recording.dimension == 3:
            raise SettingError(f"{settings.path}: fence is for graphs in the plane, and this one is in space")
        if settings.graduated and settings.robust == "none":
            raise SettingError("graduated non-convexity needs a robust loss; give --set robust=geman_mcclure")
        if settings.robust == "none" and (settings.robust_scale is not None or settings.robust_on != "all"):
            raise SettingError("robust_scale and robust_on belong to a robust loss; give --set robust=huber, say")

    @staticmethod
    def run(settings: Settings, method: str, solver: str, recording: PoseGraph, prepared: None) -> Outcome:
        del prepared
        own: dict[str, Any] = {"graduated": True} if settings.graduated else {}
        if own and solver not in ("auto", "gauss-newton"):
            raise SettingError(
                f"graduated is a setting of gauss-newton, not of {solver}; gtsam-gnc does the same with "
                "robust=geman_mcclure"
            )
        called = "gauss-newton" if solver == "auto" else solver
        if method == "ls":
            return _linear(settings, recording, called)
        begin = time.perf_counter()
        starts = _starts(settings, recording)
        problem = stated(settings, recording, next(iter(starts.values())))
        setup = time.perf_counter() - begin
        session = problem.compile(
            called, tolerance=settings.tolerance, iteration_limit=settings.iteration_limit,
            time_limit=settings.time_limit, **own,
        )  # fmt: skip
        return _solve(settings, recording, session, starts, setup)

    @staticmethod
    def plot(recording: PoseGraph, traces: dict[str, GraphTrace]) -> Figure:
        from localization.graph_plots import plot_graph

        return plot_graph(recording, traces)

    @staticmethod
    def tracks(recording: PoseGraph, poses: Poses) -> np.ndarray:
        """A trajectory per robot; landmarks come last and belong to none."""
        return recording.robots.astype(str)

    @staticmethod
    def poses(recording: PoseGraph, made: GraphTrace) -> Poses:
        """Poses and landmarks; without times of their own, poses are counted."""
        d, marks = recording.dimension, 0 if made.landmark is None else len(made.landmark)
        stamps = np.where(np.isnan(recording.time), np.arange(len(made.pose)), recording.time)
        position, orientation = made.pose[:, :d], made.pose[:, d:]
        if made.landmark is not None:
            position = np.vstack([position, made.landmark])
            orientation = np.vstack([orientation, np.full((marks, orientation.shape[1]), np.nan)])
        covariance = None
        if made.covariance is not None:
            size = made.covariance["pose"].shape[1]
            covariance = np.full((len(position), size, size), np.nan)
            covariance[: len(made.pose)] = made.covariance["pose"]
            if marks:
                covariance[len(made.pose) :, :d, :d] = made.covariance["landmark"]
        keys = np.concatenate([recording.keys.astype(str), recording.landmark_keys.astype(str)])
        return Poses(np.r_[stamps, np.full(marks, np.nan)], keys, position, orientation, covariance)

    @staticmethod
    def localized(recording: PoseGraph, made: GraphTrace) -> PoseGraph:
        """The graph with the estimate as its starting values."""
        return replace(recording, initial=made.pose, landmark_initial=made.landmark)


def stated(settings: Settings, graph: PoseGraph, start: Start) -> Problem:
    """The problem of a graph as the settings say."""
    losses: dict[str, Loss] = {}
    if settings.robust != "none":
        kind = LOSSES[settings.robust]
        loss = kind() if settings.robust_scale is None else kind(settings.robust_scale)
        names = ("relative_poses", "sightings", "ranges") if settings.robust_on == "all" else (settings.robust_on,)
        losses = dict.fromkeys(names, loss)
    chart = "log" if settings.chart == "gtsam" else "plain"
    problem, _ = graph_problem(graph, chart, losses, start=start.values, odometry_scale=settings.odometry_scale)
    if settings.fence is not None:
        pose = problem.unknowns["pose"]
        low, high = np.array(settings.fence[:2]), np.array(settings.fence[2:])
        problem.inequality("fence", lambda element: element.translation, on=pose, lower=low, upper=high)
    return problem


def _first(settings: Settings, graph: PoseGraph) -> dict[str, np.ndarray] | None:
    """Recorded first poses of all robots, where the settings ask for them."""
    if settings.start != "truth":
        return None
    assert graph.truth is not None
    heads = [int(np.argmax(graph.robots == robot)) for robot in np.unique(graph.robots)]
    return {str(graph.keys[k]): graph.truth[k] for k in heads}


def _starts(settings: Settings, graph: PoseGraph) -> dict[str, Start]:
    """The start that is asked for, and others by name as far as there are any."""
    first = _first(settings, graph)
    asked = choose_start(graph, settings.initial, first)
    out = {asked.poses: asked}
    if settings.starts == 1:
        return out
    for placement in asked.placed:
        for choice, (_, cost) in enumerate(placement.others):
            values = asked.values | {"pose": moved(asked.values["pose"], placement, choice)}
            name = f"{asked.poses}, {placement.robot or placement.key} at its minimum of {cost:.4g}"
            out[name] = replace(asked, values=values)
    others: tuple[Initial, ...] = ("file", "odometry", "chordal", "ls")
    for other in others:
        try:
            found = choose_start(graph, other, first)
        except (SettingError, DataError):  # this graph has no such start
            continue
        out.setdefault(found.poses, found)
    return dict(list(out.items())[: settings.starts])


def _linear(settings: Settings, graph: PoseGraph, solver: str) -> Outcome:
    """Method ``ls``: chordal orientations and linear positions as they are, under the cost of method ``ml``."""
    begin = time.perf_counter()
    start = choose_start(graph, "chordal", _first(settings, graph), solver)
    seconds = time.perf_counter() - begin
    problem = stated(settings, graph, start)
    cost, gradient = evaluate(problem, start.values)
    trace = GraphTrace(start.values["pose"], start.values.get("landmark"), start.values["pose"], None, None, [])
    metrics = {"objective": cost, "gradient_norm": gradient, "ls_objective": cost}
    return Outcome(
        metrics=metrics | _counts(graph, trace.pose),
        options={"chart": settings.chart, "orientations": "chordal", "landmarks": start.landmarks, "solver": solver},
        times={"solve": seconds},
        step_seconds=np.array([seconds]),
        status=Counter({str(Status.SOLVED): 1}),
        trace=trace,
    )


def _solve(
    settings: Settings, graph: PoseGraph, session: Session, starts: Mapping[str, Start], setup: float
) -> Outcome:
    """Method ``ml``: the cheapest optimum over the starts."""
    name, start = next(iter(starts.items()))
    costs: dict[str, float] = {}
    seconds: Counter[str] = Counter()
    status: Counter[str] = Counter()
    best, chosen, iterations = None, name, 0
    for label, one in starts.items():
        session.reset()
        found = session.solve(initial=one.values)
        costs[label] = float(found.objective)
        seconds.update(found.seconds)
        status[str(found.status)] += 1
        iterations += found.iterations
        if not found.solved:
            warnings.warn(f"from {label}: {found.status}: {found.message}", AccuracyWarning, stacklevel=2)
        if best is None or (found.status not in UNUSABLE and costs[label] < costs[chosen]):
            best, chosen = found, label
    assert best is not None
    first_cost = evaluate(session.problem, start.values)[0]
    linear = _linear_cost(settings, graph)
    _warn_of_basins(costs, name, chosen, first_cost, linear)
    usable = best.status not in UNUSABLE
    trace = GraphTrace(
        best["pose"].copy(),
        best["landmark"].copy() if len(graph.landmark_keys) else None,
        starts[chosen].values["pose"],
        *(_covariances(session, best) if settings.covariance and usable else (None, None)),
        _worst(settings, graph, session, best) if settings.edges and usable else [],
    )
    metrics: dict[str, float | None] = {
        "objective": costs[chosen], "start_objective": first_cost, "ls_objective": linear,
        "gradient_norm": best.residuals["dual"],
    }  # fmt: skip
    options: dict[str, Any] = {
        "initial": name, "landmarks": start.landmarks or None, "chart": settings.chart, "robust": settings.robust,
        "placed": {p.robot or p.key: p.by for p in start.placed} or None, **_fit(settings, session, costs[chosen]),
    }  # fmt: skip
    if len(costs) > 1:
        options |= {"costs_from": costs, "best_from": chosen}
    return Outcome(
        metrics=metrics | (_counts(graph, trace.pose) if usable else {}),
        options=options,
        times={"compile": session.compile_seconds, **seconds, "setup": setup + seconds.get("setup", 0.0)},
        step_seconds=np.array([seconds["solve"]]),
        status=status,
        iterations=iterations,
        residual=max(best.residuals.values()),
        trace=trace,
    )


def _linear_cost(settings: Settings, graph: PoseGraph) -> float | None:
    """Cost at the linear start, where the graph has one."""
    if len(graph.ranges):
        return None
    try:
        start = choose_start(graph, "chordal", _first(settings, graph))
    except (SettingError, DataError):
        return None
    return evaluate(stated(settings, graph, start), start.values)[0]


def _warn_of_basins(costs: Mapping[str, float], asked: str, chosen: str, first: float, linear: float | None) -> None:
    cost = costs[chosen]
    told = []
    if cost > first * (1 + SAME):
        told.append(f"the solve diverged: its cost {cost:.6g} is above that of its start, {first:.6g}")
    if linear is not None and linear < cost * (1 - SAME):
        told.append(
            f"wrong basin: the linear start alone costs {linear:.6g}, less than the optimum found, {cost:.6g}; give "
            "--set initial=chordal"
        )
    if costs[asked] > cost * (1 + SAME):
        told.append(
            f"wrong basin: from {asked} the optimum costs {costs[asked]:.6g}; kept is that from {chosen}, {cost:.6g}"
        )
    for text in told:
        warnings.warn(text, AccuracyWarning, stacklevel=3)


def _counts(graph: PoseGraph, pose: np.ndarray) -> dict[str, float | None]:
    measured = (
        graph.relative_poses, graph.sightings, graph.ranges, graph.pose_priors, graph.landmark_priors,
    )  # fmt: skip
    d = graph.dimension
    error = None if graph.truth is None else ate(pose[:, :d], graph.truth[:, :d])
    return {"ate": error, "keyframes": float(len(pose)), "measurements": float(sum(map(len, measured)))}


def _fit(settings: Settings, session: Session, cost: float) -> dict[str, Any]:
    """Whether the cost is what the noise models promise: twice it is chi-square distributed without a robust loss."""
    from scipy.stats import chi2

    rows = sum(
        template_of(entry.term).dim * entry.term.count for entry in session.layout.terms if entry.term.kind == "cost"
    )
    freedom = rows - (session.layout.size - Pins(session.layout).columns.size)
    if settings.robust != "none" or freedom <= 0:
        return {"degrees_of_freedom": freedom}
    return {"degrees_of_freedom": freedom, "p_value": float(chi2.sf(2 * cost, freedom))}


Covariances = dict[str, np.ndarray] | None


def _covariances(session: Session, solution: Solution) -> tuple[Covariances, Covariances]:
    """Of every pose and landmark, as they are and after alignment."""
    try:
        world = marginal_covariances(session, solution)
        held = "held" in session.problem.terms
        return world, marginal_covariances(session, solution, aligned=True) if held else world
    except UnobservableError as error:
        warnings.warn(str(error), AccuracyWarning, stacklevel=4)
        return None, None


def _worst(settings: Settings, graph: PoseGraph, session: Session, solution: Solution) -> list[dict[str, Any]]:
    try:
        checks = check_edges(session, solution, settings.edges)
    except UnobservableError as error:
        warnings.warn(f"measurements not checked: {error}", AccuracyWarning, stacklevel=3)
        return []
    return [_told(graph, check) for check in checks]


def _told(graph: PoseGraph, check: EdgeCheck) -> dict[str, Any]:
    """A check as JSON types, its unknowns by the names of the file."""
    names = {"pose": graph.keys, "landmark": graph.landmark_keys}
    numbers = {
        "squared": check.squared, "p_value": check.p_value, "weight": check.weight, "redundancy": check.redundancy,
        "statistic": check.statistic, "degrees_of_freedom": check.freedom, "p_against_others": check.p_against_others,
    }  # fmt: skip
    return {
        "term": check.term,
        "row": check.row,
        "between": [str(names[variable][k]) for variable, k in check.unknowns],
        "residual": check.residual.tolist(),
        **{key: finite(value) for key, value in numbers.items()},
    }
