"""User functions of CasADi symbols turned into CasADi Functions, and Functions into fast array code."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DefinitionError, ShapeError

SYMBOLIC = (ca.SX, ca.MX, ca.DM)


def _arguments(function: Callable[..., Any], available: int, what: str) -> int:
    """How many of x, u, p `function` takes; defaults are left alone, they are how a loop variable is captured."""
    if isinstance(function, ca.Function):
        needed = function.n_in()
    else:
        try:
            parameters = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):
            return available
        if any(q.kind is q.VAR_POSITIONAL for q in parameters):
            return available
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        needed = sum(q.kind in positional and q.default is q.empty for q in parameters)
    if not 1 <= needed <= available:
        raise DefinitionError(
            f"{what}: the function takes {needed} argument(s), the model declares {available} (the state, then inputs "
            "and parameters where it has them); change the function or declare inputs= and parameters="
        )
    return needed


def column(value: Any, what: str) -> Any:
    """A CasADi column from what a user function returned: an expression, or a sequence of scalar expressions."""
    if isinstance(value, SYMBOLIC):
        result = value
    else:
        try:
            result = ca.vertcat(*np.ravel(value)) if isinstance(value, np.ndarray) else ca.vertcat(*value)
        except (TypeError, NotImplementedError):
            try:
                result = ca.DM(value)
            except (TypeError, NotImplementedError):
                raise DefinitionError(
                    f"{what}: expected a CasADi expression or a sequence of them, got {type(value).__name__}"
                ) from None
    if result.shape[1] != 1:
        raise ShapeError(f"{what}: expected a column, got shape {result.shape}")
    return result


def evaluate(function: Any, symbols: tuple[Any, Any, Any], size: int | None, what: str) -> Any:
    """The column `function` describes over `symbols` = (x, u, p).

    Args:
        function: a function of x, then u and p where they are declared (trailing ones may be left out), a CasADi
            Function, or an expression over exactly these symbols.
        symbols: CasADi columns; u and p may be empty.
        size: expected number of rows; None accepts any.
        what: the owner, for messages.

    Raises:
        DefinitionError: the function fails, takes other arguments or uses symbols of its own.
        ShapeError: wrong number of rows.
    """
    if isinstance(function, SYMBOLIC):
        result = column(function, what)
    elif callable(function):
        given = [symbols[0], *(s for s in symbols[1:] if s.numel())]
        needed = _arguments(function, len(given), what)
        try:
            value = function(*given[:needed])
        except Exception as error:
            raise DefinitionError(f"{what}: the function failed on CasADi symbols: {error}") from error
        result = column(value, what)
    else:
        raise DefinitionError(f"{what}: expected a function or a CasADi expression, got {type(function).__name__}")
    if size is not None and result.shape[0] != size:
        raise ShapeError(f"{what}: expected {size} components, got {result.shape[0]}")
    try:
        unknown = ca.Function("check", list(symbols), [result], {"allow_free": True}).get_free()
    except NotImplementedError as error:
        raise DefinitionError(f"{what}: the expression mixes CasADi's SX and MX symbols") from error
    if unknown:
        raise DefinitionError(
            f"{what}: the symbols {', '.join(map(str, unknown))} belong neither to the state nor to the inputs or "
            "parameters of the model"
        )
    return result


class ArrayFunction:
    """The last output of a CasADi Function of vectors, called with arrays; not for several threads.

    A column becomes an array (rows,), anything else (rows, columns).
    """

    def __init__(self, function: ca.Function) -> None:
        self._sizes = [function.size1_in(k) for k in range(function.n_in())]
        self._arguments = [np.zeros(size) for size in self._sizes]
        shapes = [function.size_out(k) for k in range(function.n_out())]
        flat = [np.zeros(rows * columns) for rows, columns in shapes]
        rows, columns = shapes[-1]
        # CasADi writes column by column
        self._result = flat[-1] if function.n_out() == 1 else flat[-1].reshape(columns, rows).T
        buffer: Any
        buffer, self._run = function.buffer()
        self._alive = buffer, flat  # `_run` knows them by address only
        for k, array in enumerate(self._arguments):
            buffer.set_arg(k, array.data)
        for k, array in enumerate(flat):
            buffer.set_res(k, array.data)

    def __call__(self, *values: Any) -> np.ndarray:
        for target, value in zip(self._arguments, values, strict=True):
            target[:] = value
        self._run()
        return self._result.copy()
