"""Options as named combinations, and what is settled and refused before a run (dmhe-pre-estimation 3.3, 3.6, 5)."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from mhe.distributed import LITERAL, METHODS, DistributedOptions, NetworkDesign, WindowPool, options_of
from mhe.observers import place_gain
from mhe.polyhedron import Polyhedron
from problems.errors import (
    DefinitionError,
    ModelWarning,
    NoiseError,
    SettingError,
    ShapeError,
    TopologyError,
    UnknownNameError,
    UnobservableError,
    UnstableError,
)
from problems.models import LinearModel, NonlinearModel, Sensor
from problems.networks import Network, complete, ring

A = np.array([[0.9962, 0.1949, 0, 0], [-0.1949, 0.3819, 0, 0], [0, 0, 0, 1], [0, 0, -1.21, 1.98]])
Q = np.diag([0.0012, 0.038, 0.0012, 0.038])
FIRST, THIRD = [[1.0, 0, 0, 0]], [[0, 0, 1.0, 0]]
K = np.array([[0.5, 0, 0, 0.5], [0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]])
RING = ring(4, directed=True)
CYCLE = [(1, 2), (2, 3), (3, 4), (4, 9), (9, 8), (8, 7), (7, 5), (5, 6), (6, 1)]

# every test that is about warnings asks for its own
pytestmark = pytest.mark.filterwarnings("ignore::problems.errors.ModelWarning")


def four_states(outputs: list[list[list[float]]] | None = None) -> LinearModel:
    rows = [FIRST, FIRST, THIRD, THIRD] if outputs is None else outputs
    sensors = [Sensor(f"s{k + 1}", row, covariance=1.0) for k, row in enumerate(rows)]
    return LinearModel(A, Q, sensors=sensors, covariance=np.eye(4))


def nine_states() -> LinearModel:
    seen = {**dict.fromkeys((1, 2, 6), FIRST), **dict.fromkeys((3, 4, 9), THIRD)}
    return four_states([seen.get(node, [[0.0] * 4]) for node in range(1, 10)])


def quiet(*arguments: object, **options: object) -> NetworkDesign:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return NetworkDesign(*arguments, **options)  # type: ignore[arg-type]


def test_a_method_is_one_set_of_options_and_each_can_be_replaced() -> None:
    assert set(METHODS) == {"dmhe_f", "dmhe_pre", "dmhe_w_pre"}
    assert (options_of("dmhe_f").disturbance, options_of("dmhe_f").weights) == ("process_noise", "uniform")
    assert (options_of("dmhe_pre").disturbance, options_of("dmhe_pre").weights) == ("observer", "uniform")
    assert (options_of("dmhe_w_pre").disturbance, options_of("dmhe_w_pre").weights) == ("observer", "rank")
    literal = options_of("dmhe_pre", **LITERAL)
    assert (literal.weight_fusion, literal.growth_prior, literal.pi_update) == ("in_degree", "own", "seed")
    assert options_of(literal, horizon=3).as_dict() == literal.as_dict() | {"horizon": 3}
    assert literal.as_dict() == DistributedOptions(**literal.as_dict()).as_dict()


@pytest.mark.parametrize(
    ("error", "options", "words"),
    [
        (UnknownNameError, {"weights": "ranks"}, "did you mean rank"),
        (UnknownNameError, {"horizons": 3}, "did you mean horizon"),
        (UnknownNameError, {"weight_fusion": "lmi"}, "out_degree"),
        (SettingError, {"share": 1.5}, "share"),
        (SettingError, {"horizon": 0}, "horizon"),
        (SettingError, {"forget_after": -1}, "forget_after"),
    ],
)
def test_options_out_of_range_are_named(error: type[Exception], options: dict[str, object], words: str) -> None:
    with pytest.raises(error, match=words):
        options_of("dmhe_pre", **options)


def test_an_unknown_method_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="dmhe_w_pre"):
        options_of("dmhe_w_pr")


def test_covariances_weights_and_reports_of_the_ring() -> None:
    design = NetworkDesign(four_states(), RING, "dmhe_f", weights="given", weight_matrix=K)
    known = design.covariances()
    first = [
        [0.5954, 0.2073, 0.1520, 0.2743],
        [0.1235, 0.1856, 0.5948, 2.8735],
        [0.1235, 0.1856, 0.5948, 2.8735],
        [0.5954, 0.2073, 0.1520, 0.2743],
    ]
    np.testing.assert_allclose(np.diagonal(known.fused[1], axis1=1, axis2=2), first, atol=5.1e-5)
    np.testing.assert_allclose(
        np.trace(known.fused[-1], axis1=1, axis2=2), [0.3618, 0.8739, 0.9351, 0.4231], atol=5.1e-5
    )
    assert known.settled is not None
    assert design.reach == pytest.approx(0.55)
    assert design.convergence_rate() == pytest.approx(0.8094, abs=1e-4)
    ranked = NetworkDesign(four_states(), RING, "dmhe_f", weights="rank")
    np.testing.assert_allclose(ranked.weights.row(0), [2 / 3, 1 / 3])
    assert ranked.reach == pytest.approx(0.3667, abs=1e-4)
    assert ranked.convergence_rate() == pytest.approx(0.7687, abs=1e-4)


def test_rates_with_observers_and_without_communication() -> None:
    gains = [place_gain(A, [*FIRST, *THIRD], [0.9, 0.6, 0.7, 0.8])] * 4
    gains[1] = place_gain(A, [*FIRST, *FIRST], [0.45, 0.58])
    gains[3] = place_gain(A, [*THIRD, *THIRD], [0.7, 0.8])
    assert NetworkDesign(four_states(), RING, "dmhe_pre", gains=gains).convergence_rate() == pytest.approx(
        0.6766, abs=1e-3
    )
    alone = quiet(four_states(), RING, weights="given", weight_matrix=np.eye(4))
    assert alone.convergence_rate() == pytest.approx(1.1, abs=1e-3)
    assert alone.reach >= 1


def test_mixed_weights_lie_between_rank_and_reference() -> None:
    net = ring(4)
    by_rank, metropolis, mixed = (
        quiet(four_states(), net, weights=rule, reference="metropolis", share=0.3).weights.matrix()
        for rule in ("rank", "metropolis", "mixed")
    )
    np.testing.assert_allclose(mixed, 0.3 * by_rank + 0.7 * metropolis, atol=1e-15)
    given = quiet(four_states(), RING, weights="mixed", reference="given", share=0.3, weight_matrix=K)
    np.testing.assert_allclose(
        given.weights.matrix(), 0.3 * quiet(four_states(), RING, weights="rank").weights.matrix() + 0.7 * K
    )


def test_fusion_follows_out_degree_unless_the_printed_rule_is_asked_for() -> None:
    net = Network(3, [(0, 1), (0, 2), (1, 0)])  # node 0 is heard by three, hears two
    model = four_states([FIRST, THIRD, FIRST])
    out, printed, convex = (
        quiet(model, net, weight_fusion=rule).coefficients.row(1) for rule in ("out_degree", "in_degree", "convex")
    )
    np.testing.assert_allclose(out, [3 / 4, 2 / 4])
    np.testing.assert_allclose(printed, [2 / 4, 2 / 4])
    np.testing.assert_allclose(convex, [1 / 2, 1 / 2])


def test_sensors_are_placed_by_label_and_stack_by_neighbourhood() -> None:
    sensors = [
        Sensor("a", FIRST, covariance=1.0),
        Sensor("b", [*THIRD, *FIRST], sigma=2.0),
        Sensor("c", THIRD, sigma=3.0),
    ]
    model = LinearModel(A, Q, sensors=sensors, covariance=np.eye(4))
    net = Network.from_edges([("p", "q"), ("q", "p"), ("q", "r"), ("r", "q")], ["p", "q", "r"])
    design = quiet(model, net, placement=["r", "p", "r"])
    assert [rows.tolist() for rows in design.own_rows] == [[1, 2], [], [0, 3]]
    assert [rows.tolist() for rows in design.regional_rows] == [[1, 2], [1, 2, 0, 3], [0, 3]]
    np.testing.assert_array_equal(design.regional[1].C, model.C[[1, 2, 0, 3]])
    np.testing.assert_array_equal(np.diag(design.regional[1].R), [4, 4, 1, 9])
    with pytest.raises(TopologyError, match="no node is called 's'"):
        NetworkDesign(model, net, placement=["r", "p", "s"])
    with pytest.raises(ShapeError, match="placement"):
        NetworkDesign(model, ring(4))


def test_default_gains_reach_what_can_be_reached() -> None:
    gains = NetworkDesign(four_states(), RING, "dmhe_pre").gains
    assert gains is not None
    assert gains[0].spectral_radius < 1 and gains[2].spectral_radius < 1
    assert gains[1].spectral_radius == pytest.approx(1.1, abs=1e-4) and gains[1].method == "minimal_radius"
    assert gains[3].spectral_radius == pytest.approx(0.9264, abs=1e-4) and gains[3].method == "kalman"


@pytest.mark.parametrize(
    ("error", "options", "words"),
    [
        (TopologyError, {"weights": "given", "weight_matrix": K * 1.01}, "node 0 sum to 1.01"),
        (TopologyError, {"weights": "given", "weight_matrix": K.T}, "does not hear it"),
        (TopologyError, {"weights": "metropolis"}, "undirected"),
        (SettingError, {"weights": "given"}, "weight_matrix="),
        (SettingError, {"weight_matrix": K}, "weights='given'"),
        (SettingError, {"gains": [np.zeros((4, 2))] * 4}, "disturbance='observer'"),
        (ShapeError, {"disturbance": "observer", "gains": [np.zeros((4, 2))] * 3}, "one gain per node"),
        (ShapeError, {"disturbance": "observer", "gains": [np.zeros((4, 3))] * 4}, "node 0"),
        (UnstableError, {"disturbance": "observer", "gains": [np.zeros((4, 2))] * 4}, "node 0"),
    ],
)
def test_designs_that_cannot_work_are_refused(error: type[Exception], options: dict[str, object], words: str) -> None:
    with pytest.raises(error, match=words):
        quiet(four_states(), RING, **options)


def test_unobserved_networks_are_refused_or_warned_of() -> None:
    blind = four_states([FIRST] * 4)
    with pytest.raises(UnobservableError, match="4 sensors together observe 2 of 4"):
        NetworkDesign(blind, RING)
    with pytest.warns(ModelWarning, match="together observe 2 of 4"):
        assert NetworkDesign(blind, RING, require_sound=False).observability is None


def test_models_that_are_not_linear_or_not_definite_are_refused() -> None:
    with pytest.raises(NoiseError, match="sensor 's'"):
        Sensor("s", FIRST, covariance=-1.0)
    with pytest.raises(NoiseError, match="Q"):
        LinearModel(A, np.zeros((4, 4)))
    with pytest.raises(NoiseError, match="Pi_0"):
        LinearModel(A, Q, covariance=-np.eye(4))
    curved = NonlinearModel(
        lambda x: x**2, [[1.0]], 1, covariance=[[1.0]], sensors=[Sensor("s", lambda x: x, sigma=1.0)]
    )
    with pytest.raises(DefinitionError, match="LinearModel"):
        NetworkDesign(curved, complete(1))
    with pytest.raises(DefinitionError, match="prior"):
        NetworkDesign(LinearModel(A, Q, sensors=four_states().sensors), RING)


def test_conditions_that_only_warn() -> None:
    with pytest.warns(ModelWarning, match="N=1 is below the observability index 2 of nodes"):
        NetworkDesign(four_states(), RING, horizon=1)
    fast = [place_gain(A, [*FIRST, *THIRD], [0.1, 0.2, 0.15, 0.25])] * 4
    fast[1], fast[3] = place_gain(A, [*FIRST] * 2, [0.45, 0.58]), place_gain(A, [*THIRD] * 2, [0.7, 0.8])
    with pytest.warns(ModelWarning, match="long for the observers of nodes 0, 2: "):
        NetworkDesign(four_states(), RING, "dmhe_pre", gains=fast)
    slow = list(fast)
    slow[1] = np.zeros((4, 2))  # the unobservable pair stays at 1.1 anyway
    slow[3] = np.array([[0.0, 0], [0, 0], [-0.5, -0.5], [0, 0]])  # spoils what could reach 0.9264
    with pytest.warns(ModelWarning, match="node 3 .* 0.9264"):
        NetworkDesign(four_states(), RING, "dmhe_pre", gains=slow)
    with pytest.warns(ModelWarning, match="phi = 1.1"):
        NetworkDesign(four_states(), RING, weights="given", weight_matrix=np.eye(4))
    with pytest.warns(ModelWarning, match="disturbance bounds do not contain 0"):
        NetworkDesign(four_states(), RING, disturbance_bounds=Polyhedron.box([0.1] * 4, [1.0] * 4))


def test_growing_covariances_warn_and_are_capped() -> None:
    net = Network.from_edges(CYCLE, range(1, 10), undirected=True)
    with pytest.warns(ModelWarning, match=r"gamma = 1.337 >= 1"):
        design = NetworkDesign(nine_states(), net, horizon=4, weights="rank")
    assert design.reach == pytest.approx(0.979, abs=1e-3)
    fused = design.covariances().fused
    assert np.linalg.eigvalsh(fused[-1]).max() == pytest.approx(4e8, rel=1e-6)
    assert quiet(nine_states(), net, horizon=4).reach == pytest.approx(0.960, abs=1e-3)


def test_equal_local_problems_are_compiled_once() -> None:
    pool = WindowPool()
    design = NetworkDesign(four_states(), RING, pool=pool)
    windows = [pool.get(region, None, design.options, None, None)[0] for region in design.regional]
    assert windows[0] is windows[2] and len({id(window) for window in windows}) == 3
    again = quiet(four_states(), RING, weights="rank", pool=pool)
    assert pool.get(again.regional[2], None, again.options, None, None)[0] is windows[2]
    assert pool.get(again.regional[2], None, options_of("dmhe_f", horizon=3), None, None)[0] is not windows[2]
    box = Polyhedron.box([-1.0] * 4, [1.0] * 4)
    assert pool.get(again.regional[2], None, again.options, box, None)[0] is not windows[2]


def test_growing_covariances_choose_the_form_that_keeps_their_digits() -> None:
    net = Network.from_edges(CYCLE, range(1, 10), undirected=True)
    assert quiet(nine_states(), net, horizon=4).options.form == "F3"
    assert quiet(nine_states(), net, horizon=4, form="F2").options.form == "F2"
    assert quiet(nine_states(), net, horizon=4, solver="ipopt").options.form is None
    assert quiet(nine_states(), net, "dmhe_pre", horizon=4).options.form is None
