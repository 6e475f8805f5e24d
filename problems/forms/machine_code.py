"""Machine code of CasADi SX functions, made by LLVM while the program runs.

The instructions of a function become straight-line LLVM code in double precision, as they stand: nothing is reordered
or fused, so sums, products and roots round as in CasADi's own virtual machine. What surrounds them (loops over
instances, reads, writes) is text of the caller. One text is compiled once per process, and the code stays.
"""

from __future__ import annotations

import ctypes
import struct
import sys
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any

import casadi as ca

LONG = (
    600  # lines beyond which LLVM's quick instruction selection takes over: a sixth of the time, code 1.4 times slower
)

_ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
_COMPARED = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
_INTRINSICS = {
    ca.OP_SQRT: "llvm.sqrt.f64",
    ca.OP_FABS: "llvm.fabs.f64",
    ca.OP_FLOOR: "llvm.floor.f64",
    ca.OP_CEIL: "llvm.ceil.f64",
}
_LIBRARY_1 = {
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
    ca.OP_ERF: "erf",
}
_LIBRARY_2 = {
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_FMOD: "fmod",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_ATAN2: "atan2",
    ca.OP_HYPOT: "hypot",
}
_OTHER = (
    ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_ASSIGN, ca.OP_TWICE, ca.OP_SQ, ca.OP_INV, ca.OP_NEG, ca.OP_NOT,
    ca.OP_AND, ca.OP_OR, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO,
)  # fmt: skip
OPERATIONS = frozenset([*_ARITHMETIC, *_COMPARED, *_INTRINSICS, *_LIBRARY_1, *_LIBRARY_2, *_OTHER])


def number(value: float) -> str:
    """A double as LLVM reads it without rounding."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def straight_line(function: ca.Function) -> tuple[list[str], list[int], list[str]]:
    """The instructions of an SX function of one column.

    Returns:
        Lines of LLVM code that read ``%in<j>`` for input j; the inputs they need; the value of each output.
    """
    lines: list[str] = []
    needed: set[int] = set()
    outputs = [number(0.0)] * function.size1_out(0)
    place: dict[int, str] = {}
    for k in range(function.n_instructions()):
        op, reads = function.instruction_id(k), function.instruction_input(k)
        writes = function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs[writes[1]] = place[reads[0]]
        elif op == ca.OP_CONST:
            place[writes[0]] = number(function.instruction_constant(k))
        elif op == ca.OP_INPUT:
            needed.add(reads[1])
            place[writes[0]] = f"%in{reads[1]}"
        elif op == ca.OP_ASSIGN:
            place[writes[0]] = place[reads[0]]
        else:
            name = f"%v{k}"
            lines += _operation(op, name, [place[r] for r in reads])
            place[writes[0]] = name
    return lines, sorted(needed), outputs


def _operation(op: int, out: str, a: Sequence[str]) -> list[str]:
    """Lines that leave the result of an operation in `out`."""

    def test(name: str, kind: str, left: str, right: str = number(0.0)) -> str:
        return f"{name} = fcmp {kind} double {left}, {right}"

    def as_number(name: str, flag: str) -> str:
        return f"{name} = uitofp i1 {flag} to double"

    if op in _ARITHMETIC:
        return [f"{out} = {_ARITHMETIC[op]} double {a[0]}, {a[1]}"]
    if op == ca.OP_SQ:
        return [f"{out} = fmul double {a[0]}, {a[0]}"]
    if op == ca.OP_TWICE:
        return [f"{out} = fadd double {a[0]}, {a[0]}"]
    if op == ca.OP_NEG:
        return [f"{out} = fneg double {a[0]}"]
    if op == ca.OP_INV:
        return [f"{out} = fdiv double {number(1.0)}, {a[0]}"]
    if op in _INTRINSICS or op in _LIBRARY_1:
        return [f"{out} = call double @{_INTRINSICS.get(op) or _LIBRARY_1[op]}(double {a[0]})"]
    if op in _LIBRARY_2:
        return [f"{out} = call double @{_LIBRARY_2[op]}(double {a[0]}, double {a[1]})"]
    if op in _COMPARED:
        return [test(f"{out}.c", _COMPARED[op], a[0], a[1]), as_number(out, f"{out}.c")]
    if op == ca.OP_NOT:
        return [test(f"{out}.c", "oeq", a[0]), as_number(out, f"{out}.c")]
    if op in (ca.OP_AND, ca.OP_OR):
        word = "and" if op == ca.OP_AND else "or"
        return [
            test(f"{out}.a", "une", a[0]),
            test(f"{out}.b", "une", a[1]),
            f"{out}.c = {word} i1 {out}.a, {out}.b",
            as_number(out, f"{out}.c"),
        ]
    if op == ca.OP_SIGN:
        return [
            test(f"{out}.p", "ogt", a[0]),
            test(f"{out}.n", "olt", a[0]),
            f"{out}.s = select i1 {out}.n, double {number(-1.0)}, double {a[0]}",  # zeros and NaN as they are
            f"{out} = select i1 {out}.p, double {number(1.0)}, double {out}.s",
        ]
    assert op == ca.OP_IF_ELSE_ZERO, op
    return [test(f"{out}.c", "une", a[0]), f"{out} = select i1 {out}.c, double {a[1]}, double {number(0.0)}"]


class Code:
    """Compiled code: a function of one pointer.

    Attributes:
        address: of the function.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        llvm, target = _llvm()
        module = llvm.parse_assembly("\n".join([*_declarations(), *lines]))
        level = 0 if len(lines) > LONG else 1
        machine = target.create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=level
        )
        self._engine = llvm.create_mcjit_compiler(module, machine)  # owns the module and the code
        self._engine.finalize_object()
        self.address: int = self._engine.get_function_address("run")


@lru_cache(maxsize=1024)
def compiled(text: str) -> Code:
    """Code of ``define void @run(ptr %task)`` with its lines."""
    return Code(text.split("\n"))


@cache
def caller(address: int) -> Callable[[int], None]:
    """A Python function of one address that runs the code at `address`."""
    return ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(address)


@cache
def _declarations() -> tuple[str, ...]:
    """The functions of the mathematics library, told to have no effect but their result."""
    pure = "nounwind willreturn memory(none)"
    return (
        *(f"declare double @{name}(double) {pure}" for name in [*_INTRINSICS.values(), *_LIBRARY_1.values()]),
        *(f"declare double @{name}(double, double) {pure}" for name in sorted(set(_LIBRARY_2.values()))),
    )


@cache
def _llvm() -> tuple[Any, Any]:
    """llvmlite's binding, ready to compile for this machine, and its target."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)
    for name in {*_LIBRARY_1.values(), *_LIBRARY_2.values()}:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
    return llvm, llvm.Target.from_default_triple()
