"""What working means for spec ``dmhe-pre-estimation`` (its section 9): the network of nine nodes and other graphs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from pre_estimation_worlds import EDGES, A, graph_of, model_of, nine_design, nine_gains, nine_outputs, nine_trials

from mhe.distributed import NetworkDesign, run_trials
from problems.errors import ModelWarning
from problems.networks import (
    Network,
    observability_report,
    regional_ranks,
)
from problems.solvers.base import Status

CYCLE = "1-2 2-3 3-4 4-9 9-8 8-7 7-5 5-6 6-1"


def mean_errors(design: NetworkDesign, drawn: Any) -> np.ndarray:
    """RMSE_t of (2.37), mean over trials: (51,)."""
    run = run_trials(design, drawn.measurements)
    assert set(run.status) == {Status.SOLVED}
    return np.linalg.norm(run.states - drawn.states[:, :, None], axis=-1).mean(axis=(0, 2))


# 9.9 Case 1
@cache
def case_1(variance: float) -> dict[tuple[str, str], np.ndarray]:
    drawn, network = nine_trials(100, 9), graph_of(EDGES)
    return {
        (method, weights): mean_errors(nine_design(network, method, variance, weights=weights), drawn)
        for method in ("dmhe_f", "dmhe_pre")
        for weights in ("uniform", "metropolis", "rank")
    }


def test_default_graph_shows_all_four_classes() -> None:
    network = graph_of(EDGES)
    classes = observability_report(network, A, nine_outputs()).classes
    expected = (
        dict.fromkeys((2, 3, 4, 6), "green") | dict.fromkeys((8, 9), "yellow") | {1: "orange", 5: "orange", 7: "red"}
    )
    assert dict(zip(network.labels, classes, strict=True)) == expected
    assert regional_ranks(network, A, nine_outputs(), 4).tolist() == [2, 4, 4, 4, 2, 4, 0, 2, 2]


@pytest.mark.parametrize("variance", [1.0, 1e4 / 3])
def test_case_1_ratios(variance: float) -> None:
    errors = case_1(variance)
    for method in ("dmhe_f", "dmhe_pre"):
        first = [errors[method, weights][1] for weights in ("uniform", "metropolis", "rank")]
        assert np.ptp(first) < 1e-9 * first[0]
    transient = {key: values[1:10].sum() for key, values in errors.items()}
    steady = {key: values[10:].sum() for key, values in errors.items()}
    for method in ("dmhe_f", "dmhe_pre"):
        ranked, uniform, metropolis = (transient[method, weights] for weights in ("rank", "uniform", "metropolis"))
        if variance == 1.0:
            assert ranked / uniform == pytest.approx(0.69, abs=0.03)
            assert uniform / metropolis == pytest.approx(0.92, abs=0.02)
        assert ranked < uniform < metropolis
        assert steady[method, "rank"] < steady[method, "uniform"] < steady[method, "metropolis"]
    for weights in ("uniform", "metropolis", "rank"):
        assert transient["dmhe_pre", weights] == pytest.approx(transient["dmhe_f", weights], rel=0.05)


def test_late_error_levels() -> None:
    errors = case_1(1.0)
    # 30 to 50 of 100 trials: standard error about 1.5 %
    assert errors["dmhe_f", "rank"][30:].mean() == pytest.approx(0.975, rel=0.05)
    assert errors["dmhe_pre", "rank"][30:].mean() == pytest.approx(1.105, rel=0.05)


# 9.10 Case 2
def totals(network: Network, drawn: Any, horizons: Any, shares: Any, **options: Any) -> np.ndarray:
    """(horizons, shares) sums over t = 1..50 of DMHE_pre with the mixed weights (2.38)."""
    return np.array(
        [
            [
                mean_errors(
                    nine_design(network, "dmhe_pre", horizon=N, weights="mixed", share=share, **options), drawn
                )[1:].sum()
                for share in shares
            ]
            for N in horizons
        ]
    )


def check_case_2(found: np.ndarray, horizons: Any) -> None:
    for column in found.T:
        assert column.max() < 1.15 * column.min()
        assert horizons[int(column.argmin())] in (3, 4)
    assert (np.diff(found, axis=1) < 0).all()


def test_case_2_is_flat_in_the_horizon_and_falls_with_the_share_of_rank_weights() -> None:
    network, drawn, horizons = graph_of(EDGES), nine_trials(100, 10), (2, 3, 4, 6, 10)
    found = totals(network, drawn, horizons, (0.0, 1.0))
    check_case_2(found, horizons)
    between = totals(network, drawn, (4,), (0.5,))[0, 0]
    assert found[2, 0] > between > found[2, 1]


def test_growth_without_consensus_makes_long_horizons_bad() -> None:
    network, drawn = graph_of(EDGES), nine_trials(50, 10)
    for growth in ("own", "mean"):
        short, long = totals(network, drawn, (2, 10), (1.0,), growth_prior=growth)[:, 0]
        assert long > 3 * short


@pytest.mark.slow
def test_case_2_on_the_whole_grid() -> None:
    horizons = range(2, 11)
    found = totals(graph_of(EDGES), nine_trials(100, 11), horizons, np.linspace(0, 1, 11))
    check_case_2(found, horizons)


def four_class_graphs(count: int, seed: int) -> list[Network]:
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        upper = np.triu(rng.random((9, 9)) < 0.35, 1)
        network = Network.from_adjacency(upper | upper.T)
        if network.is_strongly_connected:
            classes = observability_report(network, A, nine_outputs()).classes
            if len(set(classes)) == 4:
                found.append(network)
    return found


def rank_beats_uniform(network: Network, drawn: Any) -> bool:
    ranked, uniform = (mean_errors(nine_design(network, "dmhe_pre", weights=w), drawn) for w in ("rank", "uniform"))
    return bool(ranked[1:10].sum() < uniform[1:10].sum() and ranked[10:].sum() < uniform[10:].sum())


def test_rank_weights_on_a_few_random_graphs() -> None:
    drawn = nine_trials(40, 12)
    assert all(rank_beats_uniform(network, drawn) for network in four_class_graphs(2, 12))


@pytest.mark.slow
def test_rank_weights_on_unselected_random_graphs() -> None:
    drawn = nine_trials(100, 13)
    better = [rank_beats_uniform(network, drawn) for network in four_class_graphs(25, 13)]
    assert np.mean(better) >= 0.9


@pytest.mark.filterwarnings("ignore:.*have weight zero:problems.errors.ModelWarning")
def test_rank_weights_are_worse_on_the_cycle() -> None:
    network, drawn, phi, gamma, steady = graph_of(CYCLE), nine_trials(50, 14), [], [], []
    for weights in ("uniform", "rank"):
        with pytest.warns(ModelWarning, match="gamma"):
            design = NetworkDesign(
                model_of(nine_outputs()), network, "dmhe_pre", horizon=4, weights=weights, gains=nine_gains(network)
            )
        phi.append(design.reach)
        gamma.append(design.growth)
        steady.append(mean_errors(design, drawn)[10:].sum())
    assert phi == pytest.approx([0.960, 0.979], abs=1e-3)
    assert gamma == pytest.approx([1.056, 1.337], abs=1e-3)
    assert steady[1] > steady[0]
