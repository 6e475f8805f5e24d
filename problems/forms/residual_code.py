"""Symbols to array code: the instructions of a CasADi SX function replayed as NumPy operations on many instances.

One Python function is generated per template. It walks over chunks of instances that fit the cache and keeps all
intermediate values in reused buffers, so the cost per instance is a few array passes and no Python (design section 7).
Few instances go through CasADi's own loop instead, where a NumPy call per instruction would cost more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from problems.errors import DefinitionError
from problems.forms.template import Template, template_of
from problems.problem import Term

CHUNK = 2048
LOOP_COUNT = 200  # instances up to which CasADi's own loop over them is faster (measured)
LOOPS = 16  # counts of instances for which such loops are kept

_BINARY = {
    ca.OP_ADD: "np.add",
    ca.OP_SUB: "np.subtract",
    ca.OP_MUL: "np.multiply",
    ca.OP_DIV: "np.divide",
    ca.OP_POW: "np.power",
    ca.OP_CONSTPOW: "np.power",
    ca.OP_LT: "np.less",
    ca.OP_LE: "np.less_equal",
    ca.OP_EQ: "np.equal",
    ca.OP_NE: "np.not_equal",
    ca.OP_AND: "np.logical_and",
    ca.OP_OR: "np.logical_or",
    ca.OP_FMOD: "np.fmod",
    ca.OP_COPYSIGN: "np.copysign",
    ca.OP_FMIN: "np.fmin",
    ca.OP_FMAX: "np.fmax",
    ca.OP_ATAN2: "np.arctan2",
    ca.OP_HYPOT: "np.hypot",
}
_UNARY = {
    ca.OP_NEG: "np.negative",
    ca.OP_EXP: "np.exp",
    ca.OP_LOG: "np.log",
    ca.OP_SQRT: "np.sqrt",
    ca.OP_SQ: "np.square",
    ca.OP_SIN: "np.sin",
    ca.OP_COS: "np.cos",
    ca.OP_TAN: "np.tan",
    ca.OP_ASIN: "np.arcsin",
    ca.OP_ACOS: "np.arccos",
    ca.OP_ATAN: "np.arctan",
    ca.OP_SINH: "np.sinh",
    ca.OP_COSH: "np.cosh",
    ca.OP_TANH: "np.tanh",
    ca.OP_ASINH: "np.arcsinh",
    ca.OP_ACOSH: "np.arccosh",
    ca.OP_ATANH: "np.arctanh",
    ca.OP_NOT: "np.logical_not",
    ca.OP_FLOOR: "np.floor",
    ca.OP_CEIL: "np.ceil",
    ca.OP_FABS: "np.abs",
    ca.OP_SIGN: "np.sign",
    ca.OP_INV: "np.reciprocal",
    ca.OP_LOG1P: "np.log1p",
    ca.OP_EXPM1: "np.expm1",
    ca.OP_ERF: "special.erf",
}
_OTHER = (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_ASSIGN, ca.OP_TWICE, ca.OP_IF_ELSE_ZERO)


class ArrayCode:
    """An SX function of scalars, evaluated on arrays of instances.

    Args:
        inputs: SX column of the scalar inputs.
        outputs: SX column of the scalar outputs.

    Calling it with one entry per input, an array (count,) or a number shared by all instances, returns (outputs,
    count). Constant outputs cost nothing but their fill.
    """

    def __init__(self, inputs: ca.SX, outputs: ca.SX) -> None:
        outputs = ca.densify(outputs)
        self.inputs, self.outputs = inputs.shape[0], outputs.shape[0]
        self.function = ca.Function("code", [inputs], [ca.cse(outputs)])
        self._variants: dict[tuple[bool, ...], Callable[..., None]] = {}
        self._loops: dict[int, list[_Loop]] = {}

    def __call__(self, values: Sequence[Any], count: int, out: np.ndarray | None = None) -> np.ndarray:
        if count <= LOOP_COUNT:
            return self._looped(values, count, out)
        arrays = tuple(isinstance(v, np.ndarray) and v.ndim == 1 for v in values)
        code = self._variants.get(arrays)
        if code is None:
            code = self._variants[arrays] = _generate(self.function, arrays)
        if out is None:
            out = np.empty((self.outputs, count))
        with np.errstate(all="ignore"):
            code(values, out, count)
        return out

    def _looped(self, values: Sequence[Any], count: int, out: np.ndarray | None) -> np.ndarray:
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
        if out is None:
            out = loop.found.T.copy()
        else:
            out[:] = loop.found.T
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


def _generate(function: ca.Function, arrays: tuple[bool, ...]) -> Callable[..., None]:
    """Python source of one chunk loop, with scalar inputs folded into scalar arithmetic."""
    place: dict[int, tuple[str, bool]] = {}  # work register -> (name, is an array)
    buffers: set[int] = set()
    before: list[str] = []
    body: list[str] = []
    scalars = 0

    def scalar(expression: str) -> tuple[str, bool]:
        nonlocal scalars
        scalars += 1
        before.append(f"s{scalars} = {expression}")
        return f"s{scalars}", False

    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        if op == ca.OP_OUTPUT:
            row = function.instruction_output(k)[1]
            body.append(f"out[{row}, lo:hi] = {place[function.instruction_input(k)[0]][0]}")
            continue
        register = function.instruction_output(k)[0]
        if op == ca.OP_CONST:
            place[register] = (repr(float(function.instruction_constant(k))), False)
            if not math.isfinite(function.instruction_constant(k)):
                place[register] = (f"float('{function.instruction_constant(k)}')", False)
            continue
        if op == ca.OP_INPUT:
            index = function.instruction_input(k)[1]
            if arrays[index]:
                body.append(f"a{index} = values[{index}][lo:hi]")
                place[register] = (f"a{index}", True)
            else:
                place[register] = scalar(f"np.float64(values[{index}])")
            continue
        operands = [place[r] for r in function.instruction_input(k)]
        names = [name for name, _ in operands]
        if op == ca.OP_ASSIGN:
            names, op = [names[0], "1.0"], ca.OP_MUL
        if op == ca.OP_TWICE:
            names, op = [names[0], "2.0"], ca.OP_MUL
        if op == ca.OP_IF_ELSE_ZERO:
            expression = f"np.where({names[0]}, {names[1]}, 0.0)"
        elif op in _BINARY:
            expression = f"{_BINARY[op]}({names[0]}, {names[1]}"
        else:
            expression = f"{_UNARY[op]}({names[0]}"
        if any(is_array for _, is_array in operands):
            buffers.add(register)
            target = f"b{register}"
            body.append(f"{target}[:] = {expression}" if op == ca.OP_IF_ELSE_ZERO else f"{expression}, out={target})")
            place[register] = (target, True)
        else:
            place[register] = scalar(expression if op == ca.OP_IF_ELSE_ZERO else f"{expression}) * 1.0")
    views = [f"b{r} = work[{i}, :hi - lo]" for i, r in enumerate(sorted(buffers))]
    lines = [
        "def run(values, out, count):",
        "    work = spare.pop() if spare else None",
        f"    if work is None or work.shape[1] < min(count, {CHUNK}):",
        f"        work = np.empty(({max(len(buffers), 1)}, min(count, {CHUNK})))",
        *(f"    {line}" for line in before),
        f"    for lo in range(0, count, {CHUNK}):",
        f"        hi = min(lo + {CHUNK}, count)",
        *(f"        {line}" for line in views + body),
        "    if not spare:",
        "        spare.append(work)",
    ]
    spare: list[np.ndarray] = []  # work of the last call, for the next one; threads that call at once make their own
    scope: dict[str, Any] = {"np": np, "spare": spare}
    if any("special." in line for line in lines):
        from scipy import special

        scope["special"] = special
    exec(compile("\n".join(lines), "<residual code>", "exec"), scope)  # noqa: S102
    return scope["run"]


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
        raise DefinitionError(f"{term.what}: the residual uses {', '.join(unknown)}, which array code does not know")


@lru_cache(maxsize=1024)
def _unknown_operations(template: Template) -> tuple[str, ...]:
    function = ca.Function("r", [template.point, template.numbers], [template.residual])
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    names = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
    return tuple(names[op] for op in sorted(used.difference(_BINARY, _UNARY, _OTHER)))


@lru_cache(maxsize=1024)
def _code_of(template: Template) -> ResidualCode:
    return ResidualCode(template)


def residual_code(term: Term) -> ResidualCode:
    """The array code of a term's template, generated once per process."""
    return _code_of(template_of(term))
