"""Which gtsam factor a residual function has, by identity of the function and the spaces of its slots.

Never by matching symbols: whoever writes a residual says what it is in gtsam. Packages register theirs in a module
under the entry-point group ``horizonet.native_factors``, which is imported when the first graph is made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from problems import registry
from problems.errors import DefinitionError
from problems.spaces import Space


@dataclass(frozen=True)
class NativeFactor:
    """A gtsam factor that is a residual function.

    Attributes:
        build: called with the keys of the slots, the rows of the data (flat arrays) and a gtsam noise model.
        order: row of our residual for each row of gtsam's error; None where they are the same.
    """

    build: Callable[..., Any]
    order: tuple[int, ...] | None = None


_REGISTERED: dict[tuple[Callable[..., Any], tuple[Space, ...]], NativeFactor] = {}


def register_native(
    residual: Callable[..., Any],
    spaces: tuple[Space, ...],
    build: Callable[..., Any],
    order: tuple[int, ...] | None = None,
) -> None:
    """Say which gtsam factor `residual` is on slots of these `spaces`.

    The factor is compared with the residual, error and Jacobian at random points, before its first use.

    Args:
        residual: the function that terms are stated with.
        spaces: of its slots, in order.
        build: ``build(*keys, *data, noise)`` returns the factor.
        order: see `NativeFactor`.

    Raises:
        DefinitionError: another factor is registered for them.
    """
    known = _REGISTERED.setdefault((residual, spaces), NativeFactor(build, order))
    if known != NativeFactor(build, order):
        name = getattr(residual, "__name__", repr(residual))
        raise DefinitionError(f"residual {name} on {spaces} has a native factor already")


def native_factor(residual: Callable[..., Any], spaces: tuple[Space, ...]) -> NativeFactor | None:
    """What is registered, if anything."""
    _load_entry_points()
    return _REGISTERED.get((residual, spaces))


def native_factors() -> list[tuple[Callable[..., Any], tuple[Space, ...], NativeFactor]]:
    """All that are registered: residual, spaces of its slots, and the factor."""
    _load_entry_points()
    return [(residual, spaces, native) for (residual, spaces), native in _REGISTERED.items()]


@lru_cache(maxsize=1)
def _load_entry_points() -> None:
    for name in registry.names("native_factors"):
        registry.load("native_factors", name)
