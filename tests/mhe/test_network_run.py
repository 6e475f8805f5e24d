"""What all families of distributed estimators have in common."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import pytest

from mhe.distributed import DistributedEstimator
from mhe.network import NetworkRun
from mhe.options import MethodOptions
from mhe.polyhedron import Polyhedron
from mhe.relay import RelayEstimator
from mhe.sporadic import SporadicEstimator
from problems.errors import SettingError, TopologyError, UnknownNameError
from problems.models import LinearModel, Sensor
from problems.networks import Network, complete, line
from problems.runtime import Links, Outage

FAMILIES: list[type[NetworkRun[Any]]] = [DistributedEstimator, RelayEstimator, SporadicEstimator]
A = np.array([[1.0, 0.1], [0.0, 1.0]])


def made(family: type[NetworkRun[Any]], *method: str, network: Network | None = None, **options: Any) -> Any:
    sensors = [Sensor(f"s{k}", np.eye(2), sigma=0.1) for k in range(3)]
    model = LinearModel(A, 0.01 * np.eye(2), sensors=sensors, mean=np.zeros(2), covariance=np.eye(2))
    return family(model, network or complete(3), *method, **options)


@pytest.mark.parametrize("family", FAMILIES)
def test_families_are_siblings(family: type[NetworkRun[Any]]) -> None:
    assert not any(issubclass(family, other) for other in FAMILIES if other is not family)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_graph_is_fixed(family: type[NetworkRun[Any]]) -> None:
    estimator = made(family)
    with pytest.raises(TopologyError, match=f"make a new {family.__name__}"):
        estimator.network = complete(3)


@pytest.mark.parametrize(
    ("family", "usual", "method", "other"),
    [
        (DistributedEstimator, "process_noise", "dmhe_pre", "observer"),
        (RelayEstimator, "observer", "dmhe_b", "process_noise"),
        (SporadicEstimator, "observer", "dmhe_f", "process_noise"),
    ],
)
@pytest.mark.filterwarnings("ignore:horizon:problems.errors.ModelWarning")
def test_the_design_chooses_the_method_unless_given(family: Any, usual: str, method: str, other: str) -> None:
    assert made(family).options.disturbance == usual
    assert made(family, method, horizon=2).options.disturbance == other


@pytest.mark.parametrize("family", FAMILIES)
def test_estimates_of_a_network_show_every_node(family: type[NetworkRun[Any]]) -> None:
    estimator = made(family, outages=[Outage(2, 1, 3)])
    for k in range(2):
        estimate = estimator.step(np.full((3, 2), float(k)))
    head, columns, *nodes = repr(estimate).splitlines()
    assert head == "NetworkEstimate of time step 1, 1 s: 3 nodes"
    assert columns.split() == ["node", "status", "state", "time"]
    assert [line.split()[:2] for line in nodes] == [["0", "solved"], ["1", "solved"], ["2", "down"]]
    assert f"{estimate.states[0, 0]:.4f}".rstrip("0") in nodes[0]
    assert estimate._repr_html_().count("<tr>") == 4
    assert repr(estimate.nodes[0]).startswith(f"{type(estimate.nodes[0]).__name__} at 1 s: solved")


@pytest.mark.parametrize(("family", "method"), [(DistributedEstimator, "dmhe_f"), (RelayEstimator, "dmhe_b")])
def test_nodes_report_what_their_solver_found(family: type[NetworkRun[Any]], method: str) -> None:
    bounds = Polyhedron.box([-1.0, -1.0], [0.3, 0.3])
    estimator = made(family, method, state_bounds=bounds, solver="daqp")
    first, *rest = [estimator.step(np.full((3, 2), float(k))) for k in range(6)]
    assert all(node.solution is None for node in first.nodes)
    for estimate in rest:
        for node in estimate.nodes:
            length = len(node.window)
            # a solution belongs to its own step, also when later ones have overwritten the data
            assert np.array_equal(node.solution["x"][:length], node.window)
            assert node.solution.iterations > 0 and max(node.solution.residuals.values()) < 1e-8
            assert node.solution.active_set["state bounds"][:length].any()
    assert rest[0].nodes[0].solution.objective < rest[-1].nodes[0].solution.objective


@pytest.mark.parametrize("family", FAMILIES[:2])
def test_estimates_travel_without_their_solution(family: type[NetworkRun[Any]]) -> None:
    estimator = made(family)
    estimate = [estimator.step(np.ones((3, 2))) for _ in range(3)][-1].nodes[1]
    copy = pickle.loads(pickle.dumps(estimate))
    assert estimate.solution is not None and copy.solution is None
    assert type(copy) is type(estimate) and np.array_equal(copy.window, estimate.window)
    assert copy.covariance is None and copy.status is estimate.status


@pytest.mark.parametrize("family", FAMILIES[:2])
@pytest.mark.parametrize(("delay", "late", "too_late"), [(2, (4.0,), ()), (3, (), (3.0,))])
def test_what_comes_after_its_instant_has_left_is_told(
    family: Any, delay: int, late: tuple[float, ...], too_late: tuple[float, ...]
) -> None:
    options = {"l": 1} if family is RelayEstimator else {}
    estimator = made(family, network=line(3), horizon=2, links=Links(delay=delay), **options)
    node = [estimator.step(np.ones((3, 2))) for _ in range(7)][-1].nodes[0]
    assert (node.late, node.too_late) == (late, too_late)


@dataclass(frozen=True)
class Options(MethodOptions):
    kind: ClassVar[str] = "a test method"

    rule: Literal["one", "two"] = "one"
    horizon: int = 2
    forget_after: int | None = None


METHODS = {"plain": Options(), "other": Options(rule="two")}


def test_options_start_from_a_method_or_from_options() -> None:
    assert Options.of(METHODS, "other", {"horizon": 5}) == Options(rule="two", horizon=5)
    assert Options.of(METHODS, Options(horizon=7), {}).as_dict() == {"rule": "one", "horizon": 7, "forget_after": None}


@pytest.mark.parametrize(
    ("method", "overrides", "error", "message"),
    [
        ("othe", {}, UnknownNameError, "unknown test method 'othe'; did you mean other"),
        ("plain", {"horizn": 1}, UnknownNameError, "unknown option of a test method 'horizn'"),
        ("plain", {"rule": "three"}, UnknownNameError, "unknown rule 'three'; valid: one, two"),
        ("plain", {"horizon": 1.5}, SettingError, "horizon: expected a whole number"),
        ("plain", {"horizon": True}, SettingError, "horizon: expected a whole number"),
        ("plain", {"forget_after": -1}, SettingError, "forget_after"),
        (3, {}, UnknownNameError, "unknown test method '3'"),
    ],
)
def test_options_that_do_not_exist(method: Any, overrides: dict[str, Any], error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        Options.of(METHODS, method, overrides)
