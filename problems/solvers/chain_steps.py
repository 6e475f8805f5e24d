"""Undamped Gauss-Newton steps of chains without constraints, each by one call of machine code.

In windows of some dozens of unknowns, what surrounds the arithmetic takes three times as long as the arithmetic
(measured). So one call evaluates the costs, puts the Hessian into its band, calls LAPACK's banded Cholesky and moves the
point. What does not go straight down to the optimum is left to the general search.
"""

from __future__ import annotations

import ctypes
import math
import time
from functools import cache
from importlib import import_module

import numpy as np

from problems.forms.costs import Bound, CostCode
from problems.forms.loops import address, unpacked
from problems.forms.machine_code import Code, caller, compiled
from problems.solvers.factorizations import BandedCholesky

SHORT = 1e-6  # squared length of a step that is taken without a look at the cost where its decrease shows convergence

_TASK = (
    "sums", "sums_bytes", "costs", "costs_task", "band", "band_bytes", "places", "nonzeros", "size", "step", "point",
    "trial", "found", "dpbtrf", "dpbtrs", "uplo", "n", "kd", "nrhs", "ldab", "info",
)  # fmt: skip
_INTEGERS = ("sums_bytes", "band_bytes", "nonzeros", "size")


class ChainSteps:
    """Steps of the costs `code` in the band of `linear`; see the module."""

    def __init__(self, code: CostCode, linear: BandedCholesky) -> None:
        self._code = code
        size, width = code.size, linear.width
        self._step, self._trial, self._found = np.zeros(size), np.zeros(size), np.zeros(2)
        band, places = np.zeros((width + 1) * size), linear.places.astype(np.int64)
        uplo, integers = np.frombuffer(b"U", np.uint8), np.array([size, width, 1, width + 1, 0], np.intc)
        self._info = integers[4:]
        program = code.linearization
        fields = {
            "sums": address(code.sums),
            "sums_bytes": code.sums.nbytes,
            "costs": program.code,
            "costs_task": program.task,
            "band": address(band),
            "band_bytes": band.nbytes,
            "places": address(places),
            "nonzeros": code.nonzeros,
            "size": size,
            "step": address(self._step),
            "point": address(code.point),
            "trial": address(self._trial),
            "found": address(self._found),
            "dpbtrf": _lapack("dpbtrf"),
            "dpbtrs": _lapack("dpbtrs"),
            "uplo": address(uplo),
            **{name: address(integers[k:]) for k, name in enumerate(("n", "kd", "nrhs", "ldab", "info"))},
        }
        self._task = np.array([fields[name] for name in _TASK], np.int64)
        self._alive = program, band, places, uplo, integers
        self._call, self._where = caller(_code().address), address(self._task)

    def run(self, bound: Bound, start: np.ndarray, tolerance: float, limit: int, deadline: float) -> tuple[bool, int]:
        """Step from `start` while the cost falls.

        Args:
            tolerance: relative decrease of the cost that the last step may still promise.
            limit: steps at most.
            deadline: on `time.perf_counter`, s.

        Returns:
            Whether it converged, and the steps taken. `point` is where they led.
        """
        code = self._code
        code.enter(bound)
        point, sums = code.point, code.sums
        point[:] = start
        self.point, best = start, math.inf
        for steps in range(limit):
            self._call(self._where)
            cost = sums[0]
            slope, length = self._found.tolist()
            if self._info[0] or not length < math.inf or not cost <= best:
                return False, steps
            if steps:
                self.point = point.copy()
            if slope >= -2 * tolerance * max(1.0, cost):
                if length > SHORT:
                    return False, steps
                self.point = self._trial.copy()
                return True, steps + 1
            if time.perf_counter() > deadline:
                return False, steps
            best = cost
            point[:] = self._trial
        return False, limit

    @property
    def hessian(self) -> np.ndarray:
        """Entries at the last linearization, in the order of the pattern."""
        return self._code.sums[1 + self._code.size : -1].copy()


@cache
def _code() -> Code:
    zero = "call void @llvm.memset.p0.i64"
    return compiled(
        "\n".join(
            [
                "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)",
                "define void @run(ptr %task) nounwind {",
                "entry:",
                *unpacked(_TASK, _INTEGERS),
                f"{zero}(ptr %sums, i8 0, i64 %sums_bytes, i1 false)",
                f"{zero}(ptr %band, i8 0, i64 %band_bytes, i1 false)",
                "call void %costs(ptr %costs_task)",
                "%gradient = getelementptr double, ptr %sums, i64 1",
                "%hessian = getelementptr double, ptr %gradient, i64 %size",
                "br label %fill",
                # the Hessian into its band
                "fill:",
                "%i = phi i64 [0, %entry], [%i1, %fill]",
                "%from = getelementptr double, ptr %hessian, i64 %i",
                "%entry.value = load double, ptr %from",
                "%where = getelementptr i64, ptr %places, i64 %i",
                "%place = load i64, ptr %where",
                "%to = getelementptr double, ptr %band, i64 %place",
                "store double %entry.value, ptr %to",
                "%i1 = add i64 %i, 1",
                "%filled = icmp eq i64 %i1, %nonzeros",
                "br i1 %filled, label %negate, label %fill",
                # the right side
                "negate:",
                "%j = phi i64 [0, %fill], [%j1, %negate]",
                "%g.at = getelementptr double, ptr %gradient, i64 %j",
                "%g = load double, ptr %g.at",
                "%minus = fneg double %g",
                "%s.at = getelementptr double, ptr %step, i64 %j",
                "store double %minus, ptr %s.at",
                "%j1 = add i64 %j, 1",
                "%negated = icmp eq i64 %j1, %size",
                "br i1 %negated, label %factor, label %negate",
                "factor:",
                "call void %dpbtrf(ptr %uplo, ptr %n, ptr %kd, ptr %band, ptr %ldab, ptr %info)",
                "%flag = load i32, ptr %info",
                "%failed = icmp ne i32 %flag, 0",
                "br i1 %failed, label %end, label %solve",
                "solve:",
                "call void %dpbtrs(ptr %uplo, ptr %n, ptr %kd, ptr %nrhs, ptr %band, ptr %ldab, ptr %step, ptr %n, "
                "ptr %info)",
                "br label %move",
                # the trial point, slope and squared length of the step
                "move:",
                "%k = phi i64 [0, %solve], [%k1, %move]",
                "%slope = phi double [0.0, %solve], [%slope1, %move]",
                "%length = phi double [0.0, %solve], [%length1, %move]",
                "%d.at = getelementptr double, ptr %step, i64 %k",
                "%d = load double, ptr %d.at",
                "%h.at = getelementptr double, ptr %gradient, i64 %k",
                "%h = load double, ptr %h.at",
                "%x.at = getelementptr double, ptr %point, i64 %k",
                "%x = load double, ptr %x.at",
                "%moved = fadd double %x, %d",
                "%t.at = getelementptr double, ptr %trial, i64 %k",
                "store double %moved, ptr %t.at",
                "%hd = fmul double %h, %d",
                "%slope1 = fadd double %slope, %hd",
                "%dd = fmul double %d, %d",
                "%length1 = fadd double %length, %dd",
                "%k1 = add i64 %k, 1",
                "%all = icmp eq i64 %k1, %size",
                "br i1 %all, label %tell, label %move",
                "tell:",
                "store double %slope1, ptr %found",
                "%second = getelementptr double, ptr %found, i64 1",
                "store double %length1, ptr %second",
                "br label %end",
                "end:",
                "ret void",
                "}",
            ]
        )
    )


@cache
def _lapack(name: str) -> int:
    """Address of a LAPACK routine, as SciPy offers it to compiled code."""
    capsule = import_module("scipy.linalg.cython_lapack").__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    return api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
