"""What `four-state-ring` and `nine-node` share: the model, what is drawn, the settings, and how methods are set up.

Source: dmhe-pre-estimation section 6.
"""

from __future__ import annotations

import inspect
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pydantic

from mhe.centralized import MovingHorizonEstimator
from mhe.distributed import DistributedEstimator
from mhe.filters import KalmanFilter
from mhe.observers import ObserverGain, place_gain
from mhe.polyhedron import Polyhedron
from problems import registry
from problems.models import LinearModel, Sensor
from problems.networks import Network

METHODS = ("kf", "mhe", "mhe_pre", "dmhe_f", "dmhe_pre", "dmhe_w_pre")
A = np.array([[0.9962, 0.1949, 0.0, 0.0], [-0.1949, 0.3819, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.21, 1.98]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
X1, X3 = np.eye(4)[[0]], np.eye(4)[[2]]  # the two outputs there are
EIGENVALUES = {(True, True): (0.9, 0.6, 0.7, 0.8), (True, False): (0.45, 0.58), (False, True): (0.7, 0.8)}

AnyEstimator = KalmanFilter | MovingHorizonEstimator | DistributedEstimator


class NetworkSettings(pydantic.BaseModel):
    """Settings that both scenarios have."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    horizon: int = pydantic.Field(5, ge=1, le=100, description="N, transitions in the window")
    weights: Literal["uniform", "metropolis", "rank", "none"] = pydantic.Field(
        "uniform", description="consensus weights of dmhe_f and dmhe_pre; none: K = I. dmhe_w_pre has rank weights"
    )
    bounds: Literal["none", "tight", "soft"] = pydantic.Field(
        "none",
        description="tight: a box that the states of the trial touch; soft: relaxed where infeasible",
    )
    prior: Literal["seed", "filter", "smoothing"] = pydantic.Field("seed", description="arrival cost of mhe")
    growth_prior: Literal["consensus", "own", "mean"] = pydantic.Field(
        "consensus",
        description="reference while the window fills; centralized, consensus is own; filter and smoothing take mean",
    )
    pi_update: Literal["seed", "exact"] = pydantic.Field("seed", description="arrival covariance of the nodes, E2")
    fusion: Literal["out_degree", "in_degree", "convex"] = pydantic.Field(
        "out_degree", description="of the neighbours' covariances, E1; in_degree is (2.23) as printed"
    )
    covariances: Literal["offline", "online"] = pydantic.Field(
        "offline", description="arrival covariances worked out before the run, or exchanged in every step"
    )
    form: Literal["auto", "F1", "F2", "F3", "P1", "P2"] = pydantic.Field(
        "auto", description="of the windows: F with process noise, P with pre-estimation; the others take their default"
    )
    tolerance: float = pydantic.Field(1e-8, gt=0, description="of the solver")
    warm: bool = pydantic.Field(True, description="start solvers from the solution before")


@dataclass(frozen=True, eq=False)
class World:
    """A network and what it observes.

    Attributes:
        model: with the sensors of all nodes, in the order of `placement`.
        network: who hears whom.
        placement: label of the node that each sensor belongs to.
        central: the model with the sensors that the centralized methods are given.
        rows: their rows of the measurement.
    """

    model: LinearModel
    network: Network
    placement: tuple[Hashable, ...]
    central: LinearModel
    rows: np.ndarray

    @staticmethod
    def of(network: Network, outputs: Mapping[Any, np.ndarray], central: Sequence[Hashable], variance: float) -> World:
        """The world of nodes with one output each, or none.

        Args:
            network: who hears whom.
            outputs: C^i (1, 4) by label; nodes that measure nothing are left out.
            central: nodes whose measurements the centralized methods are given.
            variance: Pi_0 is this times the identity.
        """
        sensors = {label: Sensor(f"node {label}", output, covariance=1.0) for label, output in outputs.items()}
        model = LinearModel(A, Q, sensors=sensors.values(), mean=np.zeros(4), covariance=variance * np.eye(4), dt=1.0)
        labels = tuple(sensors)
        rows = np.array([labels.index(label) for label in central])
        return World(model, network, labels, model.with_sensors([sensors[label] for label in central]), rows)

    @property
    def regional(self) -> list[np.ndarray]:
        """C_bar^i of every node."""
        heard = [[self.network.labels[j] for j in self.network.in_neighborhood(i)] for i in range(self.network.count)]
        return [
            self.model.C[[self.placement.index(label) for label in near if label in self.placement]] for near in heard
        ]

    def placed_gain(self, output: np.ndarray) -> ObserverGain:
        """Gain with the eigenvalues of spec 6, which depend on whether x1, x3 or both are seen."""
        seen = bool(output[:, 0].any()), bool(output[:, 2].any())
        return place_gain(A, output, EIGENVALUES.get(seen, ()))


@dataclass(frozen=True, eq=False)
class Drawn:
    """Truth and measurements of one trial.

    Attributes:
        states: (duration + 1, 4).
        measurements: (duration + 1, p) of the sensors of all nodes.
        box: bounds that the truth keeps and touches, so that noisy estimates are held by them.
        references: what `reference` of a scenario found, kept for the other solvers of the trial.
    """

    states: np.ndarray
    measurements: np.ndarray
    box: Polyhedron
    references: dict[Any, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Gains:
    """Pre-estimation gains of the centralized observer and of every node; None lets the estimators choose."""

    central: Any
    nodes: Sequence[Any] | None


def make_estimator(
    world: World,
    settings: NetworkSettings,
    method: str,
    solver: str,
    gains: Gains,
    weights: Mapping[str, Any],
    box: Polyhedron | None,
) -> AnyEstimator:
    """One method as the settings say.

    Args:
        gains: of methods with pre-estimation.
        weights: options of `DistributedEstimator` about consensus weights.
        box: bounds of the states, or None.
    """
    if method not in METHODS:
        return registered_estimator(world, settings, method, solver, box)
    if method == "kf":
        return KalmanFilter(world.central, initial_update=False)
    observes = method.endswith("_pre")
    forms = ("P1", "P2") if observes else ("F1", "F2", "F3")
    common: dict[str, Any] = {
        "form": settings.form if settings.form in forms else None,
        "solver": solver,
        "tolerance": settings.tolerance,
        "state_bounds": box,
        "infeasible": "soft" if settings.bounds == "soft" else "predict",
    }
    extra: dict[str, Any] = {} if settings.warm else {"warm": False}
    if method in ("mhe", "mhe_pre"):
        prior = "seed" if observes else settings.prior
        return MovingHorizonEstimator(
            world.central,
            settings.horizon,
            gain=gains.central if observes else None,
            prior=prior,
            growth_prior="own" if prior == "seed" and settings.growth_prior != "mean" else "mean",
            initial_update=False,
            **common,
            **extra,
        )
    return DistributedEstimator(
        world.model,
        world.network,
        method,
        placement=world.placement,
        gains=gains.nodes if observes else None,
        horizon=settings.horizon,
        pi_update=settings.pi_update,
        growth_prior=settings.growth_prior,
        weight_fusion=settings.fusion,
        covariances=settings.covariances,
        settings=extra,
        **weights,
        **common,
    )


def registered_estimator(world: World, settings: Any, method: str, solver: str, box: Polyhedron | None = None) -> Any:
    """An estimator registered under the name of a method, with those of the settings it has arguments for."""
    make = registry.load("estimators", method)
    takes = inspect.signature(make).parameters
    everything = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in takes.values())
    given: dict[str, Any] = {"horizon": settings.horizon, "solver": solver, "tolerance": settings.tolerance}
    if box is not None:
        given["state_bounds"] = box
    model = world.central
    if "network" in takes:
        model = world.model
        given |= {"network": world.network, "placement": world.placement}
    return make(model, **{name: value for name, value in given.items() if everything or name in takes})


def consensus_weights(network: Network, rule: str) -> dict[str, Any]:
    """Options of `DistributedEstimator` for a setting `weights`."""
    if rule == "none":
        return {"weights": "given", "weight_matrix": np.eye(network.count)}
    return {"weights": rule}
