"""Small problems for the tests of what can be stated."""

from __future__ import annotations

from typing import Any

from problems import Gaussian, Problem, Vector

SOLVERS = ["auto", "daqp", "gauss-newton"]


def difference(x: Any, z: Any) -> Any:
    return x - z


def same(x: Any) -> Any:
    return x


def pair() -> tuple[Problem, Any, Any]:
    """Three 2-vectors with a prior on each and data for them."""
    p = Problem("pair")
    x = p.variables("x", Vector(2), 3)
    z = p.data("z", 2, 3)
    p.cost("prior", same, on=x, noise=Gaussian(10.0))
    p.cost("fit", difference, on=x, data=z)
    return p, x, z
