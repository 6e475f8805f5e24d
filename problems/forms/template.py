"""The symbols of one term template: residual, its Jacobian in tangent coordinates, and how data enter.

A template is made once per process for each residual function, spaces and data shapes. Everything numeric (array code,
QP rows, NLPs, graphs) is generated from these symbols; no Jacobian is written by hand anywhere.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DefinitionError, ShapeError
from problems.problem import Term
from problems.spaces import Space, Vector


@dataclass(frozen=True, eq=False)
class Template:
    """Symbols of a residual.

    Attributes:
        x: stored coordinates of each slot, SX columns.
        data: each datum, SX columns in row-major order.
        residual: SX (dim, 1).
        jacobian: SX (dim, width): derivative in tangent coordinates of all slots, side by side.
        dims: tangent dimension of each slot; `width` is their sum.
        affine: the residual is affine in the variables (coefficients may depend on data).
    """

    x: tuple[ca.SX, ...]
    data: tuple[ca.SX, ...]
    residual: ca.SX
    jacobian: ca.SX
    dims: tuple[int, ...]
    affine: bool

    @property
    def dim(self) -> int:
        return self.residual.shape[0]

    @property
    def width(self) -> int:
        return sum(self.dims)

    @property
    def point(self) -> ca.SX:
        """All stored coordinates as one column."""
        return ca.vertcat(*self.x)

    @property
    def numbers(self) -> ca.SX:
        """All data as one column."""
        return ca.vertcat(*self.data) if self.data else ca.SX(0, 1)

    @property
    def nonlinear_data(self) -> tuple[bool, ...]:
        """For each datum: does it multiply a variable or enter nonlinearly on its own?"""
        return tuple(bool(ca.depends_on(self.jacobian, d) or not is_affine_in(self.residual, d)) for d in self.data)

    @property
    def products(self) -> tuple[tuple[int, int], ...]:
        """Pairs of data (by position) that multiply each other."""
        pairs = []
        for i, d in enumerate(self.data):
            partial = ca.jacobian(self.residual, d)
            pairs += [(i, j) for j in range(i + 1, len(self.data)) if ca.depends_on(partial, self.data[j])]
        return tuple(pairs)


def template_of(term: Term) -> Template:
    """The template of a term.

    Raises:
        DefinitionError: the residual raises, or returns something that is no expression; names the term.
        ShapeError: it returns a matrix.
    """
    spaces = tuple(slot.source.space for slot in term.slots)
    shapes = tuple(slot.source.shape for slot in term.data)
    try:
        hash(term.residual)
    except TypeError:
        raise DefinitionError(
            f"{term.what}: the residual {term.residual!r} must be hashable, as functions are"
        ) from None
    try:
        return _template(term.residual, spaces, shapes)
    except (DefinitionError, ShapeError) as error:
        raise type(error)(f"{term.what}: {error}") from error.__cause__


@lru_cache(maxsize=1024)
def _template(residual: Callable[..., Any], spaces: tuple[Space, ...], shapes: tuple[tuple[int, ...], ...]) -> Template:
    x = tuple(ca.SX.sym(f"x{i}", space.ambient) for i, space in enumerate(spaces))
    d = tuple(ca.SX.sym(f"d{i}", int(np.prod(shape, dtype=int))) for i, shape in enumerate(shapes))
    deltas = tuple(ca.SX.sym(f"delta{i}", space.dim) for i, space in enumerate(spaces))
    elements = [_displaced(space, xi, di) for space, xi, di in zip(spaces, x, deltas, strict=True)]
    rows = [_shaped(di, shape) for di, shape in zip(d, shapes, strict=True)]
    moved = as_column(_call(residual, elements, rows))
    allowed = [*x, *d, *deltas]
    free = [s.name() for s in ca.symvar(moved) if not any(ca.depends_on(a, s) for a in allowed)]
    if free:
        raise DefinitionError(f"the residual contains symbols that are neither slots nor data: {', '.join(free)}")
    if _holds_nan(moved):
        raise DefinitionError(
            "the residual holds a constant that is not a number, as functions of `math` make of symbols; use those of "
            "casadi or numpy"
        )
    r, jacobian = _differentiate(moved, x, deltas, spaces)
    affine = all(isinstance(space, Vector) for space in spaces) and is_affine_in(r, ca.vertcat(*x))
    return Template(x, d, r, jacobian, tuple(space.dim for space in spaces), affine)


def _holds_nan(expression: ca.SX) -> bool:
    function = ca.Function("walk", ca.symvar(expression), [expression])
    return any(
        function.instruction_id(k) == ca.OP_CONST and np.isnan(function.instruction_constant(k))
        for k in range(function.n_instructions())
    )


_STEPS = (
    ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR,
    ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN,
)  # fmt: skip


def is_affine_in(expression: ca.SX, symbols: ca.SX) -> bool:
    """Are the derivatives constant, with no step anywhere (a wrapped angle has derivative 1 and is not affine)?"""
    if ca.depends_on(ca.jacobian(expression, symbols), symbols):
        return False
    others = [s for s in ca.symvar(expression) if not ca.depends_on(symbols, s)]
    function = ca.Function("walk", [symbols, ca.vertcat(*others)], [expression])
    depends: dict[int, bool] = {}
    for k in range(function.n_instructions()):
        op, reads = function.instruction_id(k), function.instruction_input(k)
        if op == ca.OP_OUTPUT:
            continue
        touched = reads[0] == 0 if op == ca.OP_INPUT else op != ca.OP_CONST and any(depends[r] for r in reads)
        if touched and (op in _STEPS or (op == ca.OP_IF_ELSE_ZERO and depends[reads[0]])):
            return False
        depends[function.instruction_output(k)[0]] = touched
    return True


def _shaped(symbol: ca.SX, shape: tuple[int, ...]) -> ca.SX:
    return ca.reshape(symbol, shape[1], shape[0]).T if len(shape) == 2 else symbol


def _call(residual: Callable[..., Any], elements: list[Any], rows: list[ca.SX]) -> Any:
    name = getattr(residual, "__name__", repr(residual))
    given = ", ".join(
        [e.__class__.__name__ if not isinstance(e, ca.SX) else f"column of {e.shape[0]}" for e in elements]
        + [f"data {tuple(r.shape)}" for r in rows]
    )
    try:
        returned = residual(*elements, *rows)
    except Exception as error:
        first = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
        raise DefinitionError(
            f"the residual {name} failed when called with symbols ({given}): {type(error).__name__}: {first}. "
            + _advice(error, first, residual, elements, rows)
        ) from error
    return returned


def _advice(
    error: Exception, message: str, residual: Callable[..., Any], elements: list[Any], rows: list[ca.SX]
) -> str:
    """What to do about an error in a residual."""
    if isinstance(error, AttributeError) and any(error.obj is one for one in elements):
        parts = [part for part in dir(error.obj) if not part.startswith("_")]
        return f"A {type(error.obj).__name__} has {', '.join(parts)}"
    if "truth value" in message:
        return "Symbols have no value to decide on; write casadi.if_else(condition, a, b)"
    try:
        inspect.signature(residual).bind(*elements, *rows)
    except TypeError:
        return (
            f"It is given one element for each slot in `on` ({len(elements)} here), then one column for each entry of "
            f"`data` ({len(rows)} here)"
        )
    except ValueError:  # no signature to look at
        pass
    return "It must be a function of CasADi columns; write vectors as columns and use casadi or numpy functions"


def as_column(value: Any) -> ca.SX:
    if isinstance(value, (list, tuple)):
        try:
            value = ca.vertcat(*value)
        except Exception as error:
            raise DefinitionError(f"the residual returned a list that is no column: {error}") from error
    try:
        r = ca.SX(value)
    except Exception as error:
        raise DefinitionError(
            f"the residual must return a CasADi column, a list of expressions or numbers; got {type(value).__name__}"
        ) from error
    r = ca.densify(r)
    if r.shape[0] == 1 and r.shape[1] > 1:
        r = r.T
    if r.shape[1] != 1 or r.shape[0] == 0:
        raise ShapeError(f"the residual must be one column, got shape {r.shape}")
    return r


def _displaced(space: Space, x: ca.SX, delta: ca.SX) -> Any:
    """The element at x moved by delta; a space may offer one that is exact to first order and simplifies better."""
    if isinstance(space, Vector):
        return space.element(x)
    displaced = getattr(space, "displaced", None)
    return space.element(space.retract(x, delta)) if displaced is None else displaced(x, delta)


def _differentiate(
    moved: ca.SX, x: tuple[ca.SX, ...], deltas: tuple[ca.SX, ...], spaces: tuple[Space, ...]
) -> tuple[ca.SX, ca.SX]:
    """Residual and tangent Jacobian at the undisplaced elements."""
    by = [xi if isinstance(space, Vector) else di for xi, di, space in zip(x, deltas, spaces, strict=True)]
    every = ca.vertcat(*deltas)
    slopes = ca.horzcat(*(ca.jacobian(moved, symbols) for symbols in by))
    still = ca.SX.zeros(every.shape[0])
    r, jacobian = ca.substitute([moved, slopes], [every], [still])
    return ca.densify(r), ca.simplify(ca.sparsify(jacobian))
