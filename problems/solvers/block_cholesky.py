"""Cholesky factorization by blocks, in machine code, where all variable instances have the same dimension.

Up-looking, row after row of blocks (Davis, Direct Methods for Sparse Linear Systems, 2006, ch. 4), in an approximate
minimum degree order of the instances. A block of the factor is kept transposed, its rows as vectors: every update is
``X -= V' W`` of two small matrices, W in registers.
"""

from __future__ import annotations

from functools import cache
from typing import ClassVar

import numpy as np
import scipy.sparse as sp

from problems.errors import SettingError
from problems.forms.loops import address, unpacked
from problems.forms.machine_code import Code, caller, compiled
from problems.forms.sparsity import HessianPattern
from problems.solvers.factorizations import BLOCK_DIM, SingularError

_SHARED = ("count", "column_starts", "column_rows", "order", "factor", "diagonal", "work")
_FACTOR = (
    *_SHARED, "row_starts", "row_columns", "row_places", "given_starts", "given_rows", "given_corners", "given_above",
    "given_strides", "failed", "values",
)  # fmt: skip
_SOLVE = (*_SHARED, "rights", "right", "out")
_INTEGERS = ("count", "rights")


class BlockCholesky:
    """Blocks of the dimension of the instances; see the module and `problems.solvers.factorizations`."""

    name: ClassVar[str] = "block"

    def __init__(self, pattern: HessianPattern) -> None:
        dim = pattern.common_dim
        if dim is None or dim > BLOCK_DIM:
            raise SettingError(
                f"linear solver block takes variables of one dimension, at most {BLOCK_DIM}; these have "
                f"{', '.join(map(str, pattern.dims))}: use qdldl, or auto, which knows"
            )
        n, size = pattern.blocks, dim * _width(dim)
        columns, rows, order = pattern.elimination
        # the same entries by rows, ascending
        entries = sp.csc_matrix((n, n))
        entries.indptr, entries.indices, entries.data = columns, rows, np.arange(rows.size, dtype=np.int32)
        entries = entries.tocsr()
        self._order = order
        self._factor = np.empty(rows.size * size)
        self._diagonal, self._work = np.empty(n * size), np.zeros(n * size)
        self._failed = np.zeros(1, np.int64)
        shared = (columns, rows, order, self._factor, self._diagonal, self._work)
        by_rows = (entries.indptr, entries.indices, entries.data)
        own = (*by_rows, *_given(pattern), self._failed)
        self._factoring = np.array([n, *map(address, (*shared, *own)), 0])
        self._solving = np.array([n, *map(address, shared), 1, 0, 0])
        self._alive = shared, own  # behind the addresses
        self._run, self._resolve = caller(_factor_code(dim).address), caller(_solve_code(dim).address)

    def factor(self, values: np.ndarray) -> None:
        values = np.ascontiguousarray(values, float)
        self._factoring[-1] = address(values)
        self._failed[0] = -1
        self._run(address(self._factoring))
        failed = int(self._failed[0])
        if failed >= 0:
            self._work[:] = 0.0
            if not np.isfinite(values).all():
                raise SingularError("the matrix is not finite")
            raise SingularError(f"the pivot of variable instance {self._order[failed]} is not positive definite")

    def solve(self, right: np.ndarray) -> np.ndarray:
        right = np.ascontiguousarray(right, float)
        out = np.empty_like(right)
        if right.size:
            self._solving[-3:] = right.size // right.shape[0], address(right), address(out)
            self._resolve(address(self._solving))
        return out


def _width(dim: int) -> int:
    """Length of the vector that holds a row of a block: a power of two."""
    return 1 << (dim - 1).bit_length()


def _given(pattern: HessianPattern) -> tuple[np.ndarray, ...]:
    """Blocks of the matrix by the later of their ends: where those of an end begin; the other ends; how they stand."""
    row, col, corners, above = pattern.block_places
    place = np.empty(pattern.blocks, np.int32)
    place[pattern.elimination[2]] = np.arange(pattern.blocks, dtype=np.int32)
    first, second = place[row], place[col]
    later = np.maximum(first, second)
    by = np.argsort(later)
    starts = np.zeros(pattern.blocks + 1, np.int32)
    np.cumsum(np.bincount(later), out=starts[1:])
    # a block above the diagonal that comes below it is transposed
    strides = np.where(first <= second, _width(pattern.common_dim or 0), 1)
    parts = (np.minimum(first, second), corners, above, strides)
    return starts, *(part[by].astype(np.int32) for part in parts)


class _Text:
    """LLVM code that grows line by line; every value gets a name of its own."""

    def __init__(self, dim: int) -> None:
        self.dim, self.width = dim, _width(dim)
        self.vector, self._all_first = f"<{self.width} x double>", f"<{self.width} x i32> zeroinitializer"
        self.lines: list[str] = []
        self._names = 0
        self._places: dict[tuple[str, int], str] = {}

    def add(self, *lines: str) -> None:
        self.lines += lines

    def let(self, expression: str, name: str = "") -> str:
        self._names += 1
        name = name or f"%t{self._names}"
        self.lines.append(f"{name} = {expression}")
        return name

    def at(self, base: str, index: str, kind: str = "double") -> str:
        return self.let(f"getelementptr {kind}, ptr {base}, i64 {index}")

    def integer(self, base: str, index: str) -> str:
        loaded = self.let(f"load i32, ptr {self.at(base, index, 'i32')}")
        return self.let(f"zext i32 {loaded} to i64")

    def plus(self, a: str, b: str | int) -> str:
        return self.let(f"add i64 {a}, {b}")

    def times(self, a: str, b: str | int) -> str:
        return self.let(f"mul i64 {a}, {b}")

    def block(self, base: str, index: str) -> str:
        """Address of a block of (dim, width)."""
        return self.at(base, self.times(index, self.dim * self.width))

    def rows(self, block: str) -> list[str]:
        return [self.load(block, k) for k in range(self.dim)]

    def place(self, block: str, row: int, column: int = 0) -> str:
        """Address of a number of a block, which is used in one stretch of code only."""
        if not (row or column):
            return block
        key = (block, row * self.width + column)
        if key not in self._places:
            self._places[key] = self.at(block, str(key[1]))
        return self._places[key]

    def load(self, block: str, row: int = 0) -> str:
        return self.let(f"load {self.vector}, ptr {self.place(block, row)}, align 8")

    def store(self, value: str, block: str, row: int = 0) -> None:
        self.add(f"store {self.vector} {value}, ptr {self.place(block, row)}, align 8")

    def number(self, block: str, row: int, column: int) -> str:
        return self.let(f"load double, ptr {self.place(block, row, column)}")

    def spread_at(self, block: str, row: int, column: int) -> str:
        """One number of a block in every place of a vector."""
        one = self.let(f"load <1 x double>, ptr {self.place(block, row, column)}, align 8")
        return self.let(f"shufflevector <1 x double> {one}, <1 x double> poison, {self._all_first}")

    def entry(self, vector: str, k: int) -> str:
        return self.let(f"extractelement {self.vector} {vector}, i32 {k}")

    def spread(self, number: str) -> str:
        one = self.let(f"insertelement {self.vector} poison, double {number}, i32 0")
        return self.let(f"shufflevector {self.vector} {one}, {self.vector} poison, {self._all_first}")

    def plus_product(self, value: str, a: str, b: str, name: str = "") -> str:
        """``value + a b``."""
        v = self.vector
        return self.let(f"call {v} @llvm.fmuladd.v{self.width}f64({v} {a}, {v} {b}, {v} {value})", name)

    def negated(self, a: str) -> str:
        return self.let(f"fneg {self.vector} {a}")

    def product(self, a: str, b: str) -> str:
        return self.let(f"fmul {self.vector} {a}, {b}")

    def code(self, names: tuple[str, ...]) -> Code:
        v, size = self.vector, self.width
        head = [
            f"declare {v} @llvm.fmuladd.v{size}f64({v}, {v}, {v})",
            f"declare double @llvm.vector.reduce.fadd.v{size}f64(double, {v})",
            "define void @run(ptr %task) nounwind {",
            "entry:",
            *unpacked(names, _INTEGERS),
        ]
        return compiled("\n".join([*head, *self.lines, "}"]))


@cache
def _factor_code(dim: int) -> Code:
    t = _Text(dim)
    d, w = dim, t.width
    t.add("br label %row", "row:", "%k = phi i64 [0, %entry], [%k1, %passed]")
    t.add("%k1 = add i64 %k, 1")
    first, end = t.integer("%given_starts", "%k"), t.integer("%given_starts", "%k1")
    # blocks of the matrix in this row
    t.add("br label %given", "given:", f"%g = phi i64 [{first}, %row], [%g1, %block.end]")
    j, corner = t.integer("%given_rows", "%g"), t.integer("%given_corners", "%g")
    above, down = t.integer("%given_above", "%g"), t.integer("%given_strides", "%g")
    across = t.let(f"sub i64 {w + 1}, {down}")
    target = t.block("%work", j)
    own = t.let(f"icmp eq i64 {j}, %k")
    t.add("br label %column", "column:", "%b = phi i64 [0, %given], [%b1, %column.end]")
    t.add(f"%from = phi i64 [{corner}, %given], [%from1, %column.end]", "%b1 = add i64 %b, 1")
    height = t.let(f"select i1 {own}, i64 %b1, i64 {d}")
    source, into = t.at("%values", "%from"), t.at(target, t.times("%b", across))
    t.add("br label %copy", "copy:", "%a = phi i64 [0, %column], [%a1, %copy]")
    value = t.let(f"load double, ptr {t.at(source, '%a')}")
    t.add(f"store double {value}, ptr {t.at(into, t.times('%a', down))}", "%a1 = add i64 %a, 1")
    t.add(f"%copied = icmp eq i64 %a1, {height}", "br i1 %copied, label %column.end, label %copy", "column.end:")
    t.add(f"%from1 = add i64 {t.plus('%from', above)}, %b1", f"%filled = icmp eq i64 %b1, {d}")
    t.add("br i1 %filled, label %block.end, label %column", "block.end:", "%g1 = add i64 %g, 1")
    t.add(f"%taken = icmp eq i64 %g1, {end}", "br i1 %taken, label %rows, label %given", "rows:")
    # the blocks of the factor left of the diagonal
    first, end = t.integer("%row_starts", "%k"), t.integer("%row_starts", "%k1")
    t.add(f"%empty = icmp eq i64 {first}, {end}", "br i1 %empty, label %pivot, label %left", "left:")
    t.add(f"%q = phi i64 [{first}, %rows], [%q1, %updated]")
    i, place = t.integer("%row_columns", "%q"), t.integer("%row_places", "%q")
    x, u, kept = t.block("%work", i), t.block("%diagonal", i), t.block("%factor", place)
    solved: list[str] = []
    for row, value in enumerate(t.rows(x)):
        t.store("zeroinitializer", x, row)
        for e, other in enumerate(solved):
            value = t.plus_product(value, other, t.spread_at(u, e, row))
        value = t.product(value, t.spread_at(u, row, row))
        t.store(value, kept, row)
        solved.append(t.negated(value))
    begin = t.integer("%column_starts", i)
    t.add("br label %update", "update:", f"%p = phi i64 [{begin}, %left], [%p1, %update]")
    other, x = t.block("%factor", "%p"), t.block("%work", t.integer("%column_rows", "%p"))
    for row in range(d):
        value = t.load(x, row)
        for e in range(d):
            value = t.plus_product(value, solved[e], t.spread_at(other, e, row))
        t.store(value, x, row)
    t.add("%p1 = add i64 %p, 1", f"%last = icmp eq i64 %p, {place}")
    t.add("br i1 %last, label %updated, label %update", "updated:", "%q1 = add i64 %q, 1")
    t.add(f"%left.done = icmp eq i64 %q1, {end}", "br i1 %left.done, label %pivot, label %left", "pivot:")
    # Cholesky of the diagonal block, its diagonal kept inverted
    x, u = t.block("%work", "%k"), t.block("%diagonal", "%k")
    rows = t.rows(x)
    good = "true"
    for row in range(d):
        t.store("zeroinitializer", x, row)
        pivot = t.entry(rows[row], row)
        inverse = t.let(f"fdiv double 1.0, {t.let(f'call double @llvm.sqrt.f64(double {pivot})')}")
        own = t.product(rows[row], t.spread(inverse))
        # not a number where the pivot is negative, zero or infinite
        positive = t.let(f"fcmp ogt double {t.entry(own, row)}, 0.0")
        good = t.let(f"and i1 {good}, {positive}")
        t.store(t.let(f"insertelement {t.vector} {own}, double {inverse}, i32 {row}"), u, row)
        opposite = t.negated(own)
        for below in range(row + 1, d):
            rows[below] = t.plus_product(rows[below], opposite, t.spread(t.entry(own, below)))
    t.add(f"br i1 {good}, label %passed, label %bad", "bad:", "store i64 %k, ptr %failed", "ret void", "passed:")
    t.add("%all = icmp eq i64 %k1, %count", "br i1 %all, label %end, label %row", "end:", "ret void")
    return t.code(_FACTOR)


@cache
def _solve_code(dim: int) -> Code:
    t = _Text(dim)
    d, w = dim, t.width

    def outside(base: str, k: str) -> list[str]:
        """Addresses of the numbers of a block in a right side or in the result."""
        start = t.times(t.integer("%order", k), d)
        return [t.at(base, t.plus(t.times(t.plus(start, a), "%rights"), "%side")) for a in range(d)]

    def vector_at(k: str) -> str:
        return t.at("%work", t.times(k, w))

    t.add("br label %one", "one:", "%side = phi i64 [0, %entry], [%side1, %one.end]", "br label %take", "take:")
    t.add("%k = phi i64 [0, %one], [%k1, %take]")
    value = "zeroinitializer"
    for a, where in enumerate(outside("%right", "%k")):
        number = t.let(f"load double, ptr {where}")
        value = t.let(f"insertelement {t.vector} {value}, double {number}, i32 {a}")
    t.store(value, vector_at("%k"))
    t.add("%k1 = add i64 %k, 1", "%taken = icmp eq i64 %k1, %count", "br i1 %taken, label %forward, label %take")
    # forward
    t.add("forward:", "%i = phi i64 [0, %take], [%i1, %down.end]", "%i1 = add i64 %i, 1")
    x, u = vector_at("%i"), t.block("%diagonal", "%i")
    rest, known, spreads = t.load(x), "zeroinitializer", []
    for row in range(d):
        number = t.let(f"fmul double {t.entry(rest, row)}, {t.number(u, row, row)}")
        known = t.let(f"insertelement {t.vector} {known}, double {number}, i32 {row}")
        spreads.append(t.negated(t.spread(number)))
        if row + 1 < d:
            rest = t.plus_product(rest, spreads[row], t.load(u, row))
    t.store(known, x)
    first, end = t.integer("%column_starts", "%i"), t.integer("%column_starts", "%i1")
    t.add(f"%none = icmp eq i64 {first}, {end}", "br i1 %none, label %down.end, label %down", "down:")
    t.add(f"%p = phi i64 [{first}, %forward], [%p1, %down]")
    block, below = t.block("%factor", "%p"), vector_at(t.integer("%column_rows", "%p"))
    value = t.load(below)
    for row in range(d):
        value = t.plus_product(value, spreads[row], t.load(block, row))
    t.store(value, below)
    t.add(
        "%p1 = add i64 %p, 1", f"%down.done = icmp eq i64 %p1, {end}", "br i1 %down.done, label %down.end, label %down"
    )
    t.add("down.end:", "%through = icmp eq i64 %i1, %count", "br i1 %through, label %backward, label %forward")
    # backward
    t.add("backward:", "%j1 = phi i64 [%count, %down.end], [%j, %up.end]", "%j = sub i64 %j1, 1")
    first, end = t.integer("%column_starts", "%j"), t.integer("%column_starts", "%j1")
    t.add(f"%top = icmp eq i64 {first}, {end}", "br i1 %top, label %up.end, label %up", "up:")
    t.add(f"%s = phi i64 [{first}, %backward], [%s1, %up]")
    t.add(*(f"%sum{row} = phi {t.vector} [zeroinitializer, %backward], [%more{row}, %up]" for row in range(d)))
    block, value = t.block("%factor", "%s"), t.load(vector_at(t.integer("%column_rows", "%s")))
    for row in range(d):
        t.plus_product(f"%sum{row}", value, t.load(block, row), f"%more{row}")
    t.add("%s1 = add i64 %s, 1", f"%up.done = icmp eq i64 %s1, {end}", "br i1 %up.done, label %up.end, label %up")
    t.add("up.end:")
    t.add(*(f"%all{row} = phi {t.vector} [zeroinitializer, %backward], [%more{row}, %up]" for row in range(d)))
    x, u = vector_at("%j"), t.block("%diagonal", "%j")
    own, found, known = t.load(x), {}, "zeroinitializer"
    targets = outside("%out", "%j")
    for row in reversed(range(d)):
        total = t.let(f"call reassoc double @llvm.vector.reduce.fadd.v{w}f64(double 0.0, {t.vector} %all{row})")
        number = t.let(f"fsub double {t.entry(own, row)}, {total}")
        for e, other in found.items():
            number = t.let(f"fsub double {number}, {t.let(f'fmul double {other}, {t.number(u, row, e)}')}")
        found[row] = number = t.let(f"fmul double {number}, {t.number(u, row, row)}")
        known = t.let(f"insertelement {t.vector} {known}, double {number}, i32 {row}")
        t.add(f"store double {number}, ptr {targets[row]}")
    t.store(known, x)
    t.add("%done = icmp eq i64 %j, 0", "br i1 %done, label %one.end, label %backward", "one.end:")
    t.add("%side1 = add i64 %side, 1", "%sides = icmp eq i64 %side1, %rights", "br i1 %sides, label %clean, label %one")
    # the workspace as `factor` expects it
    t.add("clean:", "%z = phi i64 [0, %one.end], [%z1, %clean]")
    t.store("zeroinitializer", vector_at("%z"))
    t.add("%z1 = add i64 %z, 1", "%cleaned = icmp eq i64 %z1, %count", "br i1 %cleaned, label %end, label %clean")
    t.add("end:", "ret void")
    return t.code(_SOLVE)
