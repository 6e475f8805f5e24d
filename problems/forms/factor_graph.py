"""`FactorGraph`: a problem as a gtsam graph.

A residual that is registered as native (`problems.forms.native_factors`) becomes gtsam's own factor, an affine one on
Vector spaces a linear factor, any other a custom factor that calls our residual code. Equalities become factors with
constrained noise, which gtsam eliminates exactly. A linear part of a cost is completed to a square: ``1/2 r'Wr + l'r``
and ``1/2 (r+s)'W(r+s)`` with ``W s = l`` differ by a constant. Inequalities cannot be stated.
"""

from __future__ import annotations

import string
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from problems.errors import DefinitionError, FormError, SlowPathWarning, UnknownNameError
from problems.forms.graph_factors import (
    PointCode,
    at_zero,
    completing_shift,
    data_rows_of,
    gtsam_module,
    is_the_residual,
    linear_factors,
    noise_models,
    reader,
    roots,
    to_gtsam,
)
from problems.forms.layout import Activity, DataStore, Layout, TermLayout
from problems.forms.native_factors import NativeFactor, native_factor
from problems.forms.pins import Pins
from problems.forms.template import template_of
from problems.noise import L2
from problems.problem import Problem, Term
from problems.spaces import SE2, SO2
from problems.spatial import SE3, SO3

Kind = Literal["native", "linear", "custom", "constraint", "pinned"]
LINEAR_SLOTS = 3  # what gtsam's Python linear factors take


@dataclass(frozen=True)
class GraphTerm:
    """How a term stands in the graph.

    Attributes:
        kind: ``native``, ``linear`` or ``custom`` for costs; ``constraint`` or ``pinned`` for equalities.
        reason: why a cost is not native.
    """

    name: str
    kind: Kind
    count: int
    reason: str = ""


class FactorGraph:
    """A problem lowered to a factor graph.

    Attributes:
        terms: one `GraphTerm` per term of the problem.
        keys: gtsam keys of the instances of every variable; `gtsam.Symbol` shows them as letter and index.

    Raises:
        FormError: inequalities; a space that gtsam's values do not hold.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.layout = problem, Layout(problem)
        self.activity = Activity(self.layout)
        self.pins = Pins(self.layout)
        _require_graph(problem)
        self.keys = _keys(problem)
        # keys by block number, the order in which layouts name instances
        self._block_keys = [key for name in problem.unknowns for key in self.keys[name]]
        self._entries = {entry.term.name: entry for entry in self.layout.terms}
        self._native: dict[str, NativeFactor] = {}
        self.terms = tuple(self._lowered(entry) for entry in self.layout.terms)

    def __repr__(self) -> str:
        lines = [f"<FactorGraph of {self.problem.name!r}: {len(self._block_keys)} values>"]
        lines += [f"  {t.name!r}: {t.count} {t.kind} factor(s) {t.reason}".rstrip() for t in self.terms]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from problems.display import Table

        rows = [(t.name, t.count, t.kind, t.reason) for t in self.terms]
        caption = f"FactorGraph of {self.problem.name!r}: {len(self._block_keys)} values"
        return Table(caption, ("term", "factors", "kind", "reason"), rows)._repr_html_()

    def key(self, name: str, index: int = 0) -> int:
        """gtsam key of an instance. Raises UnknownNameError, DefinitionError."""
        if name not in self.keys:
            raise UnknownNameError("variable", name, self.keys)
        if not 0 <= index < len(self.keys[name]):
            raise DefinitionError(f"variables {name!r} have {len(self.keys[name])} instance(s), got index {index}")
        return self.keys[name][index]

    def to_gtsam(
        self, data: Mapping[str, Any] | None = None, values: Mapping[str, Any] | None = None
    ) -> tuple[Any, Any, Callable[..., int]]:
        """The graph for given data, as gtsam's objects.

        Args:
            data: by name; defaults where left out. Instances that read missing data are left out.
            values: by variable name; the identity where left out. Pinned instances are moved onto their value.

        Returns:
            ``gtsam.NonlinearFactorGraph``, ``gtsam.Values`` and `key`.

        Raises:
            DataError, NoiseError: numbers that cannot be used.
        """
        store = DataStore(self.layout)
        for name, value in (data or {}).items():
            store.set(name, value)
        store.require_all()
        point = self.pins.apply(self.layout.point(values or {}), np.nan_to_num(store.numbers, nan=0.0))
        graph = gtsam_module().NonlinearFactorGraph()
        for term, on in zip(self.terms, self.activity.flags(store.numbers), strict=True):
            for factor in self.factors(term, store, on, point):
                graph.add(factor)
        return graph, self.gtsam_values(point), self.key

    def factors(self, term: GraphTerm, store: DataStore, on: np.ndarray | None, point: np.ndarray) -> list[Any]:
        """Factors of the instances of a term that are on.

        Args:
            store: data.
            on: (count,) active instances, or None for all.
            point: stored coordinates, pinned instances on their values.
        """
        entry = self._entries[term.name]
        active = np.arange(term.count) if on is None else np.flatnonzero(on)
        if not active.size:
            return []
        numbers = np.nan_to_num(store.numbers, nan=0.0)
        if term.kind == "pinned":
            return [self._pinned(int(block), point) for block in np.unique(entry.blocks)]
        keys = [[self._block_keys[block] for block in row] for row in entry.blocks[active].tolist()]
        if term.kind == "constraint":
            return self._constraints(entry, keys, numbers[entry.numbers[active]])
        root = roots(entry, store)
        shift = completing_shift(entry, self.layout, root, numbers)
        shift = None if shift is None else shift[active]
        root = root if root.shape[0] == 1 else root[active]
        if term.kind == "linear":
            return self._linear(entry, keys, numbers[entry.numbers[active]], root, shift)
        noises = noise_models(root, self._native.get(term.name), entry.term.loss)
        noises = noises * len(keys) if len(noises) == 1 else noises
        if term.kind == "native":
            build = self._native[term.name].build
            rows = data_rows_of(entry, numbers, active)
            return [build(*k, *row, noise) for k, row, noise in zip(keys, rows, noises, strict=True)]
        return self._custom(entry, keys, numbers[entry.numbers[active]], noises, shift)

    def gtsam_values(self, point: np.ndarray) -> Any:
        """A point as ``gtsam.Values``."""
        values = gtsam_module().Values()
        for name, variable in self.problem.unknowns.items():
            make = to_gtsam(variable.space)
            for key, row in zip(self.keys[name], self.layout.value(point, name), strict=True):
                values.insert(key, make(row))
        return values

    def point(self, values: Any) -> np.ndarray:
        """``gtsam.Values`` as one array of stored coordinates."""
        parts = []
        for name, variable in self.problem.unknowns.items():
            read = reader(variable.space)
            rows = np.array([read(values, key) for key in self.keys[name]])
            parts.append(variable.space.normalize_array(rows).ravel())
        return np.concatenate(parts)

    def _lowered(self, entry: TermLayout) -> GraphTerm:
        term = entry.term
        if term.kind == "equality":
            return self._lowered_equality(term)
        spaces = tuple(slot.source.space for slot in term.slots)
        repeated = bool((np.diff(np.sort(entry.blocks, axis=1), axis=1) == 0).any())
        native = native_factor(term.residual, spaces)
        name = getattr(term.residual, "__name__", repr(term.residual))
        template = template_of(term)
        where = " x ".join(space.name for space in spaces)
        if native is None:
            reason = f"residual {name} on {where} has no native factor"
        elif term.linear is not None:
            reason = "native factors take no linear part"
        elif repeated:
            reason = "one instance is in two slots"
        elif not is_the_residual(native, template, spaces):
            reason = f"the factor registered for residual {name} on {where} is not that residual"
        else:
            self._native[term.name] = native
            return GraphTerm(term.name, "native", term.count)
        if _is_linear(term) and isinstance(term.loss, L2):
            return GraphTerm(term.name, "linear", term.count, reason)
        _warn_slow(term, f"{reason}; problems.forms.native_factors.register_native names one")
        return GraphTerm(term.name, "custom", term.count, reason)

    def _lowered_equality(self, term: Term) -> GraphTerm:
        if term.name in self.pins.names:
            return GraphTerm(term.name, "pinned", term.count)
        if not _is_linear(term):
            _warn_slow(term, f"it is not affine in at most {LINEAR_SLOTS} variables")
        return GraphTerm(term.name, "constraint", term.count)

    def _linear(
        self,
        entry: TermLayout,
        keys: Sequence[Sequence[int]],
        numbers: np.ndarray,
        root: np.ndarray,
        shift: np.ndarray | None,
    ) -> list[Any]:
        """Whitened linear factors."""
        residual, jacobian = at_zero(entry, numbers)
        residual = residual if shift is None else residual + shift
        if root.ndim == 2:
            jacobian, residual = root[:, :, None] * jacobian, root * residual
        else:
            jacobian, residual = root @ jacobian, (root @ residual[:, :, None])[:, :, 0]
        unit = gtsam_module().noiseModel.Unit.Create(residual.shape[1])
        return linear_factors(entry, keys, jacobian, residual, unit)

    def _constraints(self, entry: TermLayout, keys: Sequence[Sequence[int]], numbers: np.ndarray) -> list[Any]:
        template = template_of(entry.term)
        exact = gtsam_module().noiseModel.Constrained.All(template.dim)
        if _is_linear(entry.term):
            residual, jacobian = at_zero(entry, numbers)
            return linear_factors(entry, keys, jacobian, residual, exact)
        return self._custom(entry, keys, numbers, [exact] * len(keys), None)

    def _custom(
        self,
        entry: TermLayout,
        keys: Sequence[Sequence[int]],
        numbers: np.ndarray,
        noises: Sequence[Any],
        shift: np.ndarray | None,
    ) -> list[Any]:
        gtsam = gtsam_module()
        code = PointCode(template_of(entry.term))
        spaces = [slot.source.space for slot in entry.term.slots]
        shifts = np.zeros((len(keys), code.dim)) if shift is None else shift
        return [
            gtsam.CustomFactor(noise, list(dict.fromkeys(k)), code.error(spaces, k, row, s))
            for k, row, noise, s in zip(keys, numbers, noises, shifts, strict=True)
        ]

    def _pinned(self, block: int, point: np.ndarray) -> Any:
        gtsam = gtsam_module()
        starts = self.layout.block_start
        name = max((start, name) for name, start in starts.items() if start <= block)[1]
        space = self.problem.unknowns[name].space
        priors: dict[Any, Any] = {
            SE2: gtsam.PriorFactorPose2,
            SO2: gtsam.PriorFactorRot2,
            SO3: gtsam.PriorFactorRot3,
            SE3: gtsam.PriorFactorPose3,
        }
        prior = priors.get(space, gtsam.PriorFactorVector)
        value = to_gtsam(space)(self.layout.value(point, name)[block - starts[name]])
        return prior(self._block_keys[block], value, gtsam.noiseModel.Constrained.All(space.dim))


def _is_linear(term: Term) -> bool:
    return template_of(term).affine and len(term.slots) <= LINEAR_SLOTS


def _warn_slow(term: Term, reason: str) -> None:
    warnings.warn(
        f"{term.what}: its {term.count} instance(s) become Python factors, some 50 times slower: {reason}",
        SlowPathWarning,
        stacklevel=5,
    )


def _require_graph(problem: Problem) -> None:
    rows = [term.name for term in problem.terms.values() if term.kind == "inequality"]
    if rows:
        raise FormError(
            f"inequality {rows[0]!r}: a factor graph holds costs and equalities only, and gtsam's optimizers "
            "have no notion of a bound; use solver='gauss-newton' or 'ipopt'"
        )
    for variable in problem.unknowns.values():
        to_gtsam(variable.space)


def _keys(problem: Problem) -> dict[str, list[int]]:
    """Symbols: the first letter of the variable's name where it is free, else the next free one."""
    free = [*string.ascii_lowercase, *string.ascii_uppercase]
    keys: dict[str, list[int]] = {}
    for name, variable in problem.unknowns.items():
        if not free:
            raise FormError(f"a factor graph names variables by one letter; {problem.name!r} has more than 52")
        letter = name[0].lower() if name[0].lower() in free else free[0]
        free.remove(letter)
        first = ord(letter) << 56
        keys[name] = list(range(first, first + variable.count))
    return keys
