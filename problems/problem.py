"""`Problem`: an estimation problem stated once, in symbols.

A problem holds variables (instances on a space), data (numbers that change from solve to solve) and terms. A term is a
template, a residual written once, together with arrays that say which instances fill it, so a hundred thousand
measurements are one term and no Python object each. Nothing is computed here; `problems.forms` lowers a problem and
`Problem.compile` gives a session that solves it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from problems.errors import DefinitionError, NoiseError, ShapeError
from problems.noise import L2, Gaussian, Loss
from problems.spaces import Space

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from problems.soft import Soft
    from problems.solvers.session import Session

Index = int | slice | Sequence[int] | np.ndarray


def _indices(index: Index, count: int, what: str) -> np.ndarray:
    if isinstance(index, slice):
        chosen = np.arange(count)[index]
    else:
        chosen = np.atleast_1d(np.asarray(index))
        if chosen.dtype == bool and chosen.shape == (count,):
            chosen = np.flatnonzero(chosen)
        if chosen.ndim != 1 or not (chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)):
            raise ShapeError(f"{what}: an index is a whole number, a slice or a 1-D array of them, got {index!r}")
        chosen = chosen.astype(np.intp)
        if chosen.size and (chosen.min() < -count or chosen.max() >= count):
            wrong = int(chosen[(chosen < -count) | (chosen >= count)][0])
            raise ShapeError(f"{what}: index {wrong} is outside its {count} instance(s)")
        chosen = np.where(chosen < 0, chosen + count, chosen)
    if chosen.size == 0:
        raise ShapeError(f"{what}: the index {index!r} selects no instance")
    return chosen


@dataclass(frozen=True, eq=False)
class Variable:
    """`count` unknowns on one space. Index it to say which instances fill a slot of a term."""

    problem: Problem
    name: str
    space: Space
    count: int

    def __getitem__(self, index: Index) -> Slot:
        return Slot(self, _indices(index, self.count, f"variables {self.name!r}"))

    def __repr__(self) -> str:
        return f"<variables {self.name!r}: {self.count} on {self.space.name}>"


@dataclass(frozen=True, eq=False)
class Slot:
    """Chosen instances of a variable: one (repeated) or one per instance of the term."""

    source: Variable
    indices: np.ndarray


@dataclass(frozen=True, eq=False)
class Data:
    """Numbers given at solve time: one row of `shape` per instance, or shared by all where `count` is None."""

    problem: Problem
    name: str
    shape: tuple[int, ...]
    count: int | None
    value: np.ndarray | None = None
    of: Data | None = None  # presence flags of another datum

    @property
    def rows(self) -> int:
        return 1 if self.count is None else self.count

    @property
    def size(self) -> int:
        """Numbers per row."""
        return math.prod(self.shape)

    def __getitem__(self, index: Index) -> DataSlot:
        if self.count is None:
            raise ShapeError(f"data {self.name!r} is shared by all instances (count=None) and has no rows to choose")
        return DataSlot(self, _indices(index, self.count, f"data {self.name!r}"))

    def __repr__(self) -> str:
        rows = "shared" if self.count is None else f"{self.count} rows"
        return f"<data {self.name!r}: {rows} of shape {self.shape}>"


@dataclass(frozen=True, eq=False)
class DataSlot:
    """Chosen rows of data."""

    source: Data
    indices: np.ndarray


Numbers = Any  # a number, an array, Data or DataSlot


@dataclass(frozen=True, eq=False)
class Term:
    """A template over index arrays. `kind` is ``cost``, ``equality`` or ``inequality``.

    Attributes:
        count: number of instances.
        slots, data: what is handed to `residual`, in this order.
        noise, loss, linear: of costs; `lower`, `upper`: of inequalities; `active`: of both.
    """

    kind: str
    name: str
    residual: Callable[..., Any]
    slots: tuple[Slot, ...]
    data: tuple[DataSlot, ...]
    count: int
    noise: Gaussian | None = None
    loss: Loss = L2()
    linear: Numbers = None
    lower: Numbers = None
    upper: Numbers = None
    active: Numbers = None

    def __repr__(self) -> str:
        on = ", ".join(s.source.name for s in self.slots)
        return f"<{self.kind} {self.name!r}: {self.count} instance(s) on {on}>"

    @property
    def what(self) -> str:
        return f"{self.kind} {self.name!r}"


class Problem:
    """An estimation problem: minimize costs over variables subject to equalities and inequalities.

    Costs are ``1/2 r'Wr + linear'r`` (with a loss: ``rho(r'Wr)``). Names are unique among variables and data, and among
    terms. Design: section 3.1.
    """

    def __init__(self, name: str = "problem") -> None:
        self.name = name
        self.unknowns: dict[str, Variable] = {}
        self.inputs: dict[str, Data] = {}
        self.terms: dict[str, Term] = {}

    def __repr__(self) -> str:
        lines = [f"Problem {self.name!r}"]
        lines += [f"  {entry!r}" for part in (self.unknowns, self.inputs, self.terms) for entry in part.values()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from problems.display import Table

        rows: list[tuple[Any, ...]] = [
            ("variables", v.name, v.count, f"on {v.space.name}") for v in self.unknowns.values()
        ]
        for d in self.inputs.values():
            rows.append(("data", d.name, "shared" if d.count is None else d.count, f"shape {d.shape}"))
        for t in self.terms.values():
            parts = ["on " + ", ".join(s.source.name for s in t.slots)]
            parts += ["reads " + ", ".join(s.source.name for s in t.data)] if t.data else []
            parts += [repr(t.loss)] if not isinstance(t.loss, L2) else []
            rows.append((t.kind, t.name, t.count, "; ".join(parts)))
        return Table(f"Problem {self.name!r}", ("kind", "name", "count", ""), rows)._repr_html_()

    def plot_structure(self) -> Figure:
        """Picture of the factor graph and of the sparsity of the normal equations; see `problems.structure`.

        Raises:
            DefinitionError: nothing was stated yet.
        """
        from problems.structure import plot_structure

        return plot_structure(self)

    def variables(self, name: str, space: Space, count: int = 1) -> Variable:
        """Add `count` unknowns on `space`.

        Raises:
            DefinitionError: the name is taken, `space` is no space, or `count` is not a positive whole number.
        """
        self._free(name, self.unknowns, self.inputs)
        if not isinstance(space, Space) or isinstance(space, type):
            raise DefinitionError(f"variables {name!r}: expected a space such as Vector(3), SO2 or SE2, got {space!r}")
        self.unknowns[name] = Variable(self, name, space, _count(count, f"variables {name!r}"))
        return self.unknowns[name]

    def data(
        self,
        name: str,
        shape: int | tuple[int, ...] = (),
        count: int | None = None,
        value: Any = None,
    ) -> Data:
        """Add numbers that are given at solve time.

        Args:
            name: the keyword under which `Session.solve` and `Session.update` take the numbers.
            shape: of one row; a whole number n means ``(n,)``.
            count: rows (one per instance); None for one array shared by all instances.
            value: default.

        Raises:
            DefinitionError, ShapeError: the name is taken; the default does not fit.
        """
        self._free(name, self.unknowns, self.inputs)
        shape = (int(shape),) if isinstance(shape, (int, np.integer)) else tuple(int(k) for k in shape)
        if len(shape) > 2 or any(k < 1 for k in shape):
            raise ShapeError(f"data {name!r}: rows are numbers, vectors or matrices of positive size, got {shape}")
        rows = None if count is None else _count(count, f"data {name!r}")
        entry = Data(self, name, shape, rows)
        if value is not None:
            from problems.forms.layout import data_rows

            entry = Data(self, name, shape, rows, data_rows(entry, value))
        self.inputs[name] = entry
        return entry

    def presence(self, data: Data) -> Data:
        """Flags of `data`: 1 where a row is given, 0 where it is missing (has a NaN), one number per row.

        A term that reads the flags together with the data is not switched off by missing rows, which read as 0 there.
        """
        self._own(data, "presence")
        name = f"presence({data.name})"
        if name not in self.inputs:
            self.inputs[name] = Data(self, name, (), data.count, of=data)
        return self.inputs[name]

    def cost(
        self,
        name: str,
        residual: Callable[..., Any],
        on: Any,
        data: Any = (),
        noise: Gaussian | None = None,
        loss: Loss | None = None,
        active: Numbers = None,
        linear: Numbers = None,
    ) -> Term:
        """Add a cost ``1/2 r'Wr + linear'r`` (or ``rho(r'Wr)``) per instance.

        Args:
            name: of the term.
            residual: function of the elements in the slots `on`, then of the `data`, in symbols; returns r (dim,).
            on: slots: variables (all instances), indexed variables, or a tuple of them.
            data: data handles, indexed or not, or a tuple of them.
            noise: W; unit covariance by default. Its numbers may be data.
            loss: robust loss on the whitened norm of the instance.
            active: flags (count,), numbers or data; 0 switches an instance off.
            linear: (dim,) or (count, dim), numbers or data; not together with a loss.

        Raises:
            DefinitionError, ShapeError, NoiseError: with the name of the term.
        """
        noise = Gaussian(1.0) if noise is None else noise
        if not isinstance(noise, Gaussian):
            raise NoiseError(f"cost {name!r}: noise must be a Gaussian, got {noise!r}")
        loss = L2() if loss is None else loss
        if not isinstance(loss, Loss):
            raise DefinitionError(f"cost {name!r}: loss must be one of problems.noise, got {loss!r}")
        if linear is not None and not isinstance(loss, L2):
            raise DefinitionError(f"cost {name!r}: a linear part has no meaning under the loss {loss!r}")
        term = self._term("cost", name, residual, on, data, noise=noise, loss=loss, linear=linear, active=active)
        return self._add(term)

    def equality(self, name: str, residual: Callable[..., Any], on: Any, data: Any = ()) -> Term:
        """Require ``r = 0`` of every instance. Arguments and errors as for `cost`."""
        term = self._term("equality", name, residual, on, data)
        return self._add(term)

    def inequality(
        self,
        name: str,
        residual: Callable[..., Any],
        on: Any,
        data: Any = (),
        lower: Numbers = -np.inf,
        upper: Numbers = 0.0,
        active: Numbers = None,
        soft: Soft | None = None,
    ) -> Term:
        """Require ``lower <= r <= upper`` of every instance.

        Args:
            lower, upper: a number, (dim,), (count, dim), or data; infinite where there is no bound.
            soft: price at which the bounds may be violated; they are hard without. The violations are the variables
                ``"<name> slack"`` (dim each), and the problem gets terms whose names begin with `name`.

        Other arguments and errors as for `cost`.

        Returns:
            The term; of soft bounds, the one of the first side that has a bound.

        Raises:
            EmptyConstraintError: constant bounds that cross.
        """
        term = self._term("inequality", name, residual, on, data, lower=lower, upper=upper, active=active)
        if soft is None:
            return self._add(term)
        from problems.soft import relaxed

        return relaxed(self, term, soft)

    def compile(
        self, solver: str = "auto", form: str | None = None, eliminate: Sequence[Any] = (), **settings: Any
    ) -> Session:
        """Lower the problem and set up a solver for it; does everything that does not depend on data.

        Args:
            solver: a registered name (``horizonet solvers`` lists them), or ``auto``.
            form: ``quadratic``, ``nonlinear`` or ``graph``; by default the solver's first that fits.
            eliminate: variables (or indexed variables) that the equalities define and that are condensed away.
            settings: `tolerance`, `time_limit`, `iteration_limit` and the solver's own, by name.

        Raises:
            UnknownNameError, MissingExtraError, SettingError: about the solver and its settings.
            FormError, NotAffineError: the problem cannot go to this solver; says why.
            UnobservableError, EmptyConstraintError: what can be seen without data.
        """
        from problems.solvers.compile import compile_problem

        return compile_problem(self, solver, form, eliminate, settings)

    def _term(self, kind: str, name: str, residual: Any, on: Any, data: Any, **parts: Any) -> Term:
        self._free(name, self.terms)
        what = f"{kind} {name!r}"
        if not callable(residual):
            raise DefinitionError(f"{what}: the residual must be a function of symbols, got {residual!r}")
        slots = tuple(self._slot(entry, what) for entry in (on if isinstance(on, (tuple, list)) else (on,)))
        rows = tuple(self._data_slot(entry, what) for entry in (data if isinstance(data, (tuple, list)) else (data,)))
        if not slots:
            raise DefinitionError(f"{what} has no variables")
        counts = {len(s.indices) for s in slots + rows if isinstance(s, Slot) or s.source.count is not None}
        counts.discard(1)
        if len(counts) > 1:
            sizes = ", ".join(f"{s.source.name}: {len(s.indices)}" for s in slots + rows)
            raise ShapeError(f"{what}: slots and data must have one instance (repeated) or a common count; got {sizes}")
        for key in ("linear", "lower", "upper", "active"):
            if isinstance(parts.get(key), (Data, DataSlot)):
                parts[key] = self._data_slot(parts[key], what)
        noise = parts.get("noise")
        if noise is not None and isinstance(noise.value, (Data, DataSlot)):
            parts["noise"] = Gaussian(**{noise.kind: self._data_slot(noise.value, what)})
        return Term(kind, name, residual, slots, rows, counts.pop() if counts else 1, **parts)

    def _add(self, term: Term) -> Term:
        from problems.forms.layout import check_numbers
        from problems.forms.residual_code import require_known_operations
        from problems.forms.template import template_of

        check_numbers(term, template_of(term).dim)
        require_known_operations(term)
        self.terms[term.name] = term
        return term

    def _slot(self, entry: Any, what: str) -> Slot:
        slot = entry[:] if isinstance(entry, Variable) else entry
        if not isinstance(slot, Slot):
            raise DefinitionError(f"{what}: expected variables of this problem in `on`, got {entry!r}")
        self._own(slot.source, what)
        return slot

    def _data_slot(self, entry: Any, what: str) -> DataSlot:
        slot = DataSlot(entry, np.arange(entry.rows)) if isinstance(entry, Data) else entry
        if not isinstance(slot, DataSlot):
            raise DefinitionError(f"{what}: expected data of this problem, got {entry!r}")
        self._own(slot.source, what)
        return slot

    def _own(self, entry: Variable | Data, what: str) -> None:
        if entry.problem is not self:
            other = "another problem of that name" if entry.problem.name == self.name else repr(entry.problem.name)
            raise DefinitionError(f"{what}: {entry!r} is of {other}, not of this problem {self.name!r}")

    def _free(self, name: str, *taken: Mapping[str, Any]) -> None:
        if not isinstance(name, str) or not name:
            raise DefinitionError(f"a name must be a non-empty string, got {name!r}")
        if any(name in names for names in taken):
            raise DefinitionError(f"the name {name!r} is already used in problem {self.name!r}")


def _count(count: Any, what: str) -> int:
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise DefinitionError(f"{what}: count must be a positive whole number, got {count!r}")
    return int(count)
