"""Loops of machine code over instances: outputs in columns, or added up where an index says.

A loop is a function of one pointer to its task, a row of 64-bit integers: counts and addresses. Whoever makes a task
keeps what its addresses point to.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import casadi as ca
import numpy as np

from problems.forms.machine_code import Code, caller, compiled, straight_line

SUM_TASK = ("count", "flags", "index", "targets", "width", "point", "values", "sums")
"""Fields of a task of `summing_loop`.

``index`` (count, inputs) and ``targets`` (count, width) of 32-bit integers: where inputs are read, outputs added;
``flags`` (count,) of bytes, or 0: instances to leave out; ``point``, ``values``, ``sums``: doubles.
"""


def summing_loop(function: ca.Function, stored: int, outputs: Sequence[int]) -> Code:
    """Code of ``sums[targets[i, k]] += f(point[index[i, :stored]], values[index[i, stored:]])[outputs[k]]`` for all i.

    Args:
        function: SX function of one column.
        stored: how many of its inputs, the first ones, are read from ``point``, the others from ``values``.
        outputs: of the function, in the order of the columns of ``targets``; one may come twice.
    """
    lines, needed, results = straight_line(function)
    body = [
        f"%ip = mul i64 %i, {function.size1_in(0)}",
        "%op = mul i64 %i, %width",
    ]
    for j in needed:
        body += [
            f"%ia{j} = add i64 %ip, {j}",
            f"%ib{j} = getelementptr i32, ptr %index, i64 %ia{j}",
            f"%ic{j} = load i32, ptr %ib{j}",
            f"%id{j} = zext i32 %ic{j} to i64",
            f"%ie{j} = getelementptr double, ptr {'%point' if j < stored else '%values'}, i64 %id{j}",
            f"%in{j} = load double, ptr %ie{j}",
        ]
    body += lines
    for k, output in enumerate(outputs):
        body += [
            f"%oa{k} = add i64 %op, {k}",
            f"%ob{k} = getelementptr i32, ptr %targets, i64 %oa{k}",
            f"%oc{k} = load i32, ptr %ob{k}",
            f"%od{k} = zext i32 %oc{k} to i64",
            f"%oe{k} = getelementptr double, ptr %sums, i64 %od{k}",
            f"%of{k} = load double, ptr %oe{k}",
            f"%og{k} = fadd double %of{k}, {results[output]}",
            f"store double %og{k}, ptr %oe{k}",
        ]
    return compiled("\n".join(_loop(SUM_TASK, ("count", "width"), body, switched=True)))


def column_loop(function: ca.Function) -> Code:
    """Code of ``out[k, i] = f(inputs of i)[k]``; its task is count, out, then address and stride in bytes per input."""
    lines, needed, results = straight_line(function)
    names = ["count", "out", *(f"{kind}{j}" for j in range(function.size1_in(0)) for kind in ("at", "stride"))]
    body: list[str] = []
    for j in needed:
        body += [
            f"%ia{j} = mul i64 %i, %stride{j}",
            f"%ib{j} = getelementptr i8, ptr %at{j}, i64 %ia{j}",
            f"%in{j} = load double, ptr %ib{j}",
        ]
    body += lines
    for k, result in enumerate(results):
        body += [
            f"%oa{k} = mul i64 %count, {k}",
            f"%ob{k} = add i64 %oa{k}, %i",
            f"%oc{k} = getelementptr double, ptr %out, i64 %ob{k}",
            f"store double {result}, ptr %oc{k}",
        ]
    integers = ("count", *(f"stride{j}" for j in range(function.size1_in(0))))
    return compiled("\n".join(_loop(names, integers, body)))


def _loop(names: Sequence[str], integers: Sequence[str], body: Sequence[str], switched: bool = False) -> list[str]:
    """A function that unpacks its task and runs `body` for ``%i`` from 0; where `switched`, if its flag is not 0."""
    head = [
        "define void @run(ptr %task) nounwind {",
        "entry:",
        *unpacked(names, integers),
        "%none = icmp eq i64 %count, 0",
        "br i1 %none, label %end, label %next",
        "next:",
        "%i = phi i64 [0, %entry], [%more, %after]",
    ]
    if switched:
        head += [
            "%unflagged = icmp eq ptr %flags, null",
            "br i1 %unflagged, label %on, label %look",
            "look:",
            "%fa = getelementptr i8, ptr %flags, i64 %i",
            "%fb = load i8, ptr %fa",
            "%off = icmp eq i8 %fb, 0",
            "br i1 %off, label %after, label %on",
        ]
    else:
        head += ["br label %on"]
    tail = [
        "br label %after",
        "after:",
        "%more = add i64 %i, 1",
        "%done = icmp eq i64 %more, %count",
        "br i1 %done, label %end, label %next",
        "end:",
        "ret void",
        "}",
    ]
    return [*head, "on:", *body, *tail]


def unpacked(names: Sequence[str], integers: Sequence[str]) -> list[str]:
    """Lines that read the fields of ``%task``: `integers`, the others are addresses."""
    lines = []
    for k, name in enumerate(names):
        lines += [
            f"%task.{name} = getelementptr i64, ptr %task, i64 {k}",
            f"%{name} = load {'i64' if name in integers else 'ptr'}, ptr %task.{name}",
        ]
    return lines


def address(array: np.ndarray) -> int:
    """Where the numbers of an array are."""
    return array.__array_interface__["data"][0]


class Program:
    """Loops and their tasks, run by one call.

    Attributes:
        code, task: addresses of a function and of what it is given.
    """

    def __init__(self, codes: Sequence[Code], tasks: np.ndarray) -> None:
        steps = [len(codes)]
        for code, task in zip(codes, tasks, strict=True):
            steps += [code.address, address(task)]
        given = np.array(steps)
        self.code, self.task = _sequence().address, address(given)
        self._call, self._alive = caller(self.code), (given, codes, tasks)

    def __call__(self) -> None:
        self._call(self.task)


@cache
def _sequence() -> Code:
    """Code that runs several loops; its task is a count and, for each, the addresses of its code and of its task."""
    return compiled(
        "\n".join(
            [
                "define void @run(ptr %task) nounwind {",
                "entry:",
                "%count = load i64, ptr %task",
                "%none = icmp eq i64 %count, 0",
                "br i1 %none, label %end, label %next",
                "next:",
                "%i = phi i64 [0, %entry], [%more, %next]",
                "%a = mul i64 %i, 2",
                "%b = add i64 %a, 1",
                "%c = add i64 %a, 2",
                "%d = getelementptr i64, ptr %task, i64 %b",
                "%e = getelementptr i64, ptr %task, i64 %c",
                "%code = load ptr, ptr %d",
                "%given = load ptr, ptr %e",
                "call void %code(ptr %given)",
                "%more = add i64 %i, 1",
                "%done = icmp eq i64 %more, %count",
                "br i1 %done, label %end, label %next",
                "end:",
                "ret void",
                "}",
            ]
        )
    )
