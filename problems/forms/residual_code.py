"""Symbols to array code: residuals and Jacobians of all instances of a term, one array per scalar.

Many instances go through machine code, few through CasADi's own loop, which has nothing to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DefinitionError
from problems.forms.loops import address, column_loop
from problems.forms.machine_code import OPERATIONS, Code, caller
from problems.forms.template import Template, template_of
from problems.problem import Term

LOOP_COUNT = (
    200  # instances up to which CasADi's own loop is taken: compilation takes as long as a hundred of its calls
)
LOOPS = 16  # counts of instances for which such loops are kept


class ArrayCode:
    """An SX function of scalars, evaluated on arrays of instances.

    Args:
        inputs: SX column of the scalar inputs.
        outputs: SX column of the scalar outputs.

    Calling it with one entry per input, an array (count,) or a number shared by all instances, returns (outputs,
    count).
    """

    def __init__(self, inputs: ca.SX, outputs: ca.SX) -> None:
        outputs = ca.densify(outputs)
        self.inputs, self.outputs = inputs.shape[0], outputs.shape[0]
        self.function = ca.Function("code", [inputs], [ca.cse(outputs)])
        self._loops: dict[int, list[_Loop]] = {}

    def __call__(self, values: Sequence[Any], count: int) -> np.ndarray:
        if count <= LOOP_COUNT:
            return self._looped(values, count)
        rows = [np.broadcast_to(np.asarray(value, dtype=float), count) for value in values]
        out = np.empty((self.outputs, count))
        task = [count, address(out)]
        for row in rows:
            task += [address(row), row.strides[0]]
        given = np.array(task)
        caller(self._compiled.address)(address(given))
        return out

    @cached_property
    def _compiled(self) -> Code:
        return column_loop(self.function)

    def _looped(self, values: Sequence[Any], count: int) -> np.ndarray:
        # taken out while in use, so that threads that call at once make their own
        spare = self._loops.get(count)
        if spare is None:
            if len(self._loops) >= LOOPS:
                self._loops.clear()
            spare = self._loops[count] = []
        loop = spare.pop() if spare else _Loop(self.function, count)
        given = loop.given
        for k, value in enumerate(values):
            given[:, k] = value
        loop.run()
        out = loop.found.T.copy()
        if not spare:
            spare.append(loop)
        return out


class _Loop:
    """CasADi's loop over `count` instances and its buffers."""

    def __init__(self, function: ca.Function, count: int) -> None:
        self.given, self.found = (np.empty((count, n)) for n in (function.size1_in(0), function.size1_out(0)))
        self.run = buffered(function.map(count), [self.given], self.found)


def buffered(function: ca.Function, inputs: Sequence[np.ndarray], result: np.ndarray) -> Callable[[], None]:
    """A call without arguments: the function reads `inputs` and writes `result` in place."""
    buffer, run = function.buffer()
    access: Any = buffer  # its stubs know only calls with a size
    for k, values in enumerate(inputs):
        access.set_arg(k, values.data)
    access.set_res(0, result.data)

    def call(_alive: Any = (buffer, function, inputs, result)) -> None:  # the buffer knows them by address only
        run()

    return call


class ResidualCode:
    """Residuals and tangent Jacobians of all instances of a term (design section 3.1).

    `residual(values)` is (count, dim); `jacobian(values)` is (count, dim, width). `values` lists one entry per scalar
    input, the stored coordinates of all slots and then all data: an array (count,) or a number.
    """

    def __init__(self, template: Template) -> None:
        self.template = template
        inputs = ca.vertcat(template.point, template.numbers)
        self._residual = ArrayCode(inputs, template.residual)
        both = ca.vertcat(template.residual, ca.vec(ca.densify(template.jacobian)))
        self._both = ArrayCode(inputs, both)

    def residual(self, values: Sequence[Any], count: int) -> np.ndarray:
        return self._residual(values, count).T

    def residual_and_jacobian(self, values: Sequence[Any], count: int) -> tuple[np.ndarray, np.ndarray]:
        out = self._both(values, count)
        dim, width = self.template.dim, self.template.width
        return out[:dim].T, out[dim:].reshape(width, dim, count).transpose(2, 1, 0)


def require_known_operations(term: Term) -> None:
    """Raises DefinitionError naming the term and the operations that have no array code."""
    unknown = _unknown_operations(template_of(term))
    if unknown:
        raise DefinitionError(f"{term.what}: the residual uses {', '.join(unknown)}, which machine code does not know")


@lru_cache(maxsize=1024)
def _unknown_operations(template: Template) -> tuple[str, ...]:
    function = ca.Function("r", [template.point, template.numbers], [template.residual])
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    names = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
    return tuple(names[op] for op in sorted(used - OPERATIONS))


@lru_cache(maxsize=1024)
def _code_of(template: Template) -> ResidualCode:
    return ResidualCode(template)


def residual_code(term: Term) -> ResidualCode:
    """The array code of a term's template, generated once per process."""
    return _code_of(template_of(term))
