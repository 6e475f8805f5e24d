"""Fields of constant density: largest component, or a radius that grows with the number of nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from problems.errors import TopologyError
from problems.networks import random_field, within_radius

DENSITY, RADIUS = 1e-4, 160.0


@pytest.mark.parametrize("count", [100, 1000, 10_000])
def test_the_largest_component_is_kept_at_constant_density(count: int) -> None:
    network, positions, kept = random_field(count, RADIUS, np.random.default_rng(1), density=DENSITY, strict=True)
    assert network.is_strongly_connected and network.count == len(positions) == len(kept) > 0.95 * count
    assert np.abs(positions).max() <= np.sqrt(count / DENSITY) / 2
    assert 0.8 < np.ptp(positions, axis=0).prod() * DENSITY / count <= 1.0
    whole = np.random.default_rng(1).uniform(-1, 1, (count, 2)) * np.sqrt(count / DENSITY) / 2
    np.testing.assert_allclose(whole[kept], positions)
    drawn = within_radius(whole, RADIUS, strict=True)
    inside = np.isin(drawn.edges, kept)
    assert (inside.all(axis=1) | ~inside.any(axis=1)).all(), "no link leaves the component"
    assert inside.all(axis=1).sum() == len(network.edges)
    if count == 10_000:
        assert not drawn.is_strongly_connected and network.count < count
    assert 5 < len(network.edges) / network.count < 9


def test_a_growing_radius_keeps_all_nodes() -> None:
    degrees = []
    for count in (100, 1000):
        network, _, kept = random_field(count, RADIUS, np.random.default_rng(2), density=DENSITY, connect="radius")
        assert network.is_strongly_connected and np.array_equal(kept, np.arange(count))
        degrees.append(len(network.edges) / count)
    # neighbours grow with the logarithm, apart from the border
    assert 1.3 < degrees[1] / degrees[0] < 2.0


@pytest.mark.parametrize("given", [{"count": 0}, {"density": 0.0}, {"density": np.nan}, {"connect": "both"}])
def test_fields_that_do_not_exist_are_named(given: dict[str, Any]) -> None:
    chosen = {"count": 10, "density": DENSITY, **given}
    with pytest.raises(TopologyError, match="positive density and connect="):
        random_field(chosen.pop("count"), RADIUS, np.random.default_rng(1), **chosen)
