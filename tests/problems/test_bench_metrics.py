"""Statistics against definitions written out, and against scipy where it has them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from problems.bench.metrics import (
    chi_square_interval,
    mean_and_error,
    paired_difference,
    performance_profile,
    shifted_geometric_mean,
    solved_share,
)
from problems.errors import ShapeError


def test_mean_and_error_leave_out_missing_values() -> None:
    mean, error = mean_and_error([1.0, None, 2.0, 6.0])
    assert mean == pytest.approx(3.0)
    assert error == pytest.approx(stats.sem([1.0, 2.0, 6.0]))
    assert mean_and_error([4.0]) == (4.0, None)
    assert mean_and_error([None]) == (None, None)


def test_shifted_geometric_mean_counts_failures_at_the_limit() -> None:
    assert shifted_geometric_mean([1.0, 4.0], shift=0.0, limit=100.0) == pytest.approx(2.0)
    assert shifted_geometric_mean([1.0, None], shift=0.0, limit=100.0) == pytest.approx(10.0)
    assert shifted_geometric_mean([1.0, 1e9], shift=0.0, limit=100.0) == pytest.approx(10.0)
    assert shifted_geometric_mean([0.0, 3.0], shift=1.0, limit=9.0) == pytest.approx(math.sqrt(1.0 * 4.0) - 1.0)


def test_shift_damps_differences_of_tiny_times() -> None:
    assert shifted_geometric_mean([1e-9, 1e-9], 1e-3, 1.0) == pytest.approx(1e-9)
    assert shifted_geometric_mean([1e-9, 1e-3], 1e-3, 1.0) > 1e-4


def test_performance_profile_by_hand() -> None:
    profile = performance_profile({"a": [1.0, 2.0, None, None], "b": [2.0, 1.0, 5.0, None]})
    factors, shares = profile["a"]
    np.testing.assert_allclose(factors, [1.0, 2.0])
    np.testing.assert_allclose(shares, [0.25, 0.5])  # of four instances, although nobody solved the last
    factors, shares = profile["b"]
    np.testing.assert_allclose(factors, [1.0, 1.0, 2.0])
    np.testing.assert_allclose(shares, [0.25, 0.5, 0.75])


def test_performance_profile_refuses_different_instances() -> None:
    with pytest.raises(ShapeError, match="same instances"):
        performance_profile({"a": [1.0], "b": [1.0, 2.0]})


def test_paired_difference_equals_the_t_interval_of_scipy() -> None:
    rng = np.random.default_rng(4)
    baseline = rng.normal(size=12)
    values = baseline + 0.3 + 0.2 * rng.normal(size=12)
    found = paired_difference([*values, None, 1.0], [*baseline, 1.0, None])
    expected = stats.ttest_rel(values, baseline).confidence_interval(0.95)
    assert found is not None
    assert found.pairs == 12
    assert (found.lower, found.upper) == pytest.approx((expected.low, expected.high))
    assert found.significant
    assert not paired_difference([1.0, -1.0], [0.0, 0.0]).significant  # type: ignore[union-attr]
    assert paired_difference([1.0], [0.0]) is None


def test_paired_interval_is_narrower_than_the_noise_it_shares() -> None:
    rng = np.random.default_rng(5)
    shared = 10 * rng.normal(size=30)
    found = paired_difference(list(shared + 0.1 * rng.normal(size=30)), list(shared))
    assert found is not None
    assert found.upper - found.lower < 0.2


def test_solved_share() -> None:
    assert solved_share({"solved": 3, "inaccurate": 1}) == pytest.approx(0.75)
    assert solved_share({"solved": 0}) is None


@pytest.mark.parametrize("degrees", [1, 3, 240])
def test_chi_square_interval_equals_scipy(degrees: int) -> None:
    expected = stats.chi2.ppf([0.025, 0.975], degrees)
    assert chi_square_interval(degrees) == pytest.approx(tuple(expected), rel=1e-9)
