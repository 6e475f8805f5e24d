"""The window of a fixed-lag smoother as a `Problem`: keyframe slots that one compilation serves for ever.

Slots that hold no keyframe yet are tied to the slot before them, which costs nothing at the optimum and tells the
others nothing; a reading that is not there is NaN. So nothing is recompiled when keyframes come and go.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from localization.smoothing.kinds import BEFORE, OTHER, POSE, Fence, Kind, Lasting, Places
from problems.errors import DefinitionError, SettingError
from problems.forms.template import template_of
from problems.noise import Gaussian
from problems.problem import Problem, Slot, Variable
from problems.spaces import Space, Vector, points


def difference(space: Space, reference: Any, element: Any) -> Any:
    """Tangent vector ``local(reference, element)`` of stored coordinates and an element, in symbols."""
    if isinstance(space, Vector):
        return element - reference
    relative = space.element(reference).between(element)
    return relative.local() if hasattr(relative, "local") else relative.log()


@lru_cache(maxsize=64)
def _arrival(spaces: tuple[Space, ...]) -> Callable[..., Any]:
    edges = np.cumsum([0, *(space.ambient for space in spaces)]).tolist()

    def residual(*given: Any) -> Any:
        *elements, reference = given
        parts = zip(spaces, elements, edges[:-1], edges[1:], strict=True)
        return ca.vertcat(*(difference(space, reference[a:b], x) for space, x, a, b in parts))

    return residual


@lru_cache(maxsize=64)
def _stays(space: Space) -> Callable[..., Any]:
    def residual(before: Any, after: Any) -> Any:
        if isinstance(space, Vector):
            return after - before
        relative = before.between(after)
        return relative.local() if hasattr(relative, "local") else relative.log()

    return residual


class TeamWindow:
    """The problem of a team over `slots` keyframes.

    Args:
        space: of every robot's state.
        robots: how many there are.
        slots: keyframes of the window.
        kinds: measurements by name.
        lasting: unknowns that do not change, by name.
        fences: inequalities by name.

    Attributes:
        problem: variables ``pose`` (slots x robots, keyframe first) and the lasting ones; data of `Places`,
            ``reference``, ``information`` and ``linear`` of the arrival cost, and the flags ``absent``, ``filled``.
        places: readings by kind.
        kept: slots the arrival cost is about: all poses of the first keyframe, then all lasting unknowns.
    """

    def __init__(
        self,
        space: Space,
        robots: int,
        slots: int,
        kinds: Mapping[str, Kind],
        lasting: Mapping[str, Lasting],
        fences: Mapping[str, Fence],
    ) -> None:
        if slots < 2 or robots < 1:
            raise SettingError(f"a window needs a lag of at least 1 and a robot, got lag {slots - 1}, {robots} robots")
        if not kinds:
            raise DefinitionError("a smoother needs at least one kind of measurement")
        taken = {POSE, BEFORE, OTHER} & set(lasting)
        if taken:
            raise DefinitionError(f"lasting unknowns cannot be called {sorted(taken)}")
        for name, one in lasting.items():
            if one.own and one.count != robots:
                raise DefinitionError(f"lasting {name!r}: one for each of {robots} robots, got a count of {one.count}")
        self.space, self.robots, self.slots = space, robots, slots
        self.problem = problem = Problem(f"fixed lag of {slots} keyframes")
        self.pose: Variable = problem.variables(POSE, space, slots * robots)
        self.lasting: dict[str, Variable] = {
            name: problem.variables(name, one.space, one.count) for name, one in lasting.items()
        }
        first = [self.pose[robot] for robot in range(robots)]
        first += [variable[k] for variable in self.lasting.values() for k in range(variable.count)]
        spaces = tuple(slot.source.space for slot in first)
        self.size = sum(one.dim for one in spaces)
        reference = problem.data("reference", sum(one.ambient for one in spaces))
        information = problem.data("information", (self.size, self.size))
        linear = problem.data("linear", self.size, value=np.zeros(self.size))
        problem.cost(
            "arrival",
            _arrival(spaces),
            on=tuple(first),
            data=reference,
            noise=Gaussian(information=information),
            linear=linear,
        )
        absent = problem.data("absent", (), (slots - 1) * robots)
        problem.cost("absent", _stays(space), on=(self.pose[:-robots], self.pose[robots:]), active=absent)
        self.places = {name: Places(name, kind, robots, lasting, slots) for name, kind in kinds.items()}
        for name in self.places:
            self._measured(name)
        if fences:
            filled = problem.data("filled", (), slots * robots)
            for name, fence in fences.items():
                problem.inequality(
                    name, fence.residual, on=self.pose, lower=fence.lower, upper=fence.upper, active=filled
                )
        self.fenced = bool(fences)
        self.dropped = self.keyframe(0)
        self.kept: list[Slot] = [self.keyframe(1), *(variable[:] for variable in self.lasting.values())]

    def keyframe(self, slot: int) -> Slot:
        """All poses of a keyframe."""
        return self.pose[slot * self.robots + np.arange(self.robots)]

    def _measured(self, name: str) -> None:
        places = self.places[name]
        kind, count = places.kind, (self.slots - places.first) * places.per_slot
        frame = np.repeat(np.arange(places.first, self.slots), places.per_slot)
        one = np.repeat(np.arange(len(places.combinations)), kind.capacity)
        at = places.owners(np.tile(one, self.slots - places.first))
        on = []
        for role in kind.on:
            if role in (POSE, BEFORE, OTHER):
                on.append(self.pose[(frame - (role == BEFORE)) * self.robots + at[role]])
            else:
                on.append(self.lasting[role][at[role]])
        empty = np.full(count, np.nan)
        data = tuple(
            self.problem.data(f"{name} {k}", size, count, np.tile(empty[:, None], (1, size)))
            for k, size in enumerate(kind.parts)
        )
        noise = kind.noise
        if noise is None:
            dim = self._dimension(kind)
            places.sigma = np.ones((*places.values.shape[:3], dim))
            noise = Gaussian(sigma=self.problem.data(f"{name} sigma", dim, count, np.ones((count, dim))))
        self.problem.cost(name, kind.residual, on=tuple(on), data=data, noise=noise, loss=kind.loss)

    def _dimension(self, kind: Kind) -> int:
        """Rows of the residual, found before its noise is stated."""
        trial = Problem("dimension")
        lasting = {name: variable.space for name, variable in self.lasting.items()}
        on = tuple(trial.variables(role, lasting.get(role, self.space)) for role in kind.on)
        data = tuple(trial.data(f"part {k}", size) for k, size in enumerate(kind.parts))
        return template_of(trial.cost("kind", kind.residual, on, data)).dim

    def prior(
        self, mean: Any, sigma: Any, lasting: Mapping[str, Lasting]
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Starting values by variable, reference and information of the arrival cost at the first keyframe.

        Args:
            mean: (robots, ambient) or (ambient,) poses.
            sigma: standard deviations in tangent coordinates, anything that broadcasts to (robots, dim).

        Raises:
            DataError, SettingError: values that do not fit.
        """
        first = points(self.space, mean, self.robots, "start")
        values, weights = {POSE: np.tile(first, (self.slots, 1))}, [_weights(sigma, self.robots, self.space, "start")]
        reference = [first.ravel()]
        for name, one in lasting.items():
            values[name] = points(one.space, one.mean, one.count, f"mean of {name!r}")
            reference.append(values[name].ravel())
            weights.append(_weights(one.sigma, one.count, one.space, name))
        return values, np.concatenate(reference), np.diag(np.concatenate(weights))


def _weights(sigma: Any, count: int, space: Space, what: str) -> np.ndarray:
    array = np.asarray(sigma, dtype=float)
    if not (array > 0).all():
        raise SettingError(f"prior of {what!r}: standard deviations must be positive, got {sigma!r}")
    try:
        return np.broadcast_to(array, (count, space.dim)).ravel() ** -2.0
    except ValueError:
        raise SettingError(
            f"prior of {what!r}: expected a number, ({space.dim},) or ({count}, {space.dim}), got {array.shape}"
        ) from None
