"""Undamped Gauss-Newton steps of chains without constraints, all in one call of machine code.

In windows of some dozens of unknowns, what surrounds the arithmetic takes three times as long as the arithmetic
(measured). So one call goes on evaluating the costs, putting the Hessian into its band, calling LAPACK's banded
Cholesky and moving the point. What does not go straight down to the optimum is left to the general search.
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
from problems.forms.machine_code import Code, caller, compiled, number
from problems.solvers.factorizations import BandedCholesky

SHORT = 1e-6  # squared length of a step that is taken without a look at the cost where its decrease shows convergence

_TASK = (
    "sums", "sums_bytes", "costs", "costs_task", "band", "band_bytes", "places", "nonzeros", "size", "point_bytes",
    "step", "point", "trial", "reached", "dpbtrf", "dpbtrs", "uplo", "n", "kd", "nrhs", "ldab", "info", "tolerance",
    "best", "steps", "limit", "outcome",
)  # fmt: skip
_INTEGERS = ("sums_bytes", "band_bytes", "nonzeros", "size", "point_bytes")
_STOPPED, _CONVERGED, _GOING = range(3)
AT_ONCE = 10  # steps between looks at the clock


class ChainSteps:
    """Steps of the costs `code` in the band of `linear`; see the module."""

    def __init__(self, code: CostCode, linear: BandedCholesky) -> None:
        self._code = code
        size, width = code.size, linear.width
        self._reached = np.zeros(size)
        self._tolerance, self._best = np.zeros(1), np.zeros(1)
        self._counts = np.zeros(3, np.int64)  # steps, their limit, outcome
        step, trial, band = np.zeros(size), np.zeros(size), np.zeros((width + 1) * size)
        places, uplo = linear.places.astype(np.int64), np.frombuffer(b"U", np.uint8)
        integers = np.array([size, width, 1, width + 1, 0], np.intc)
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
            "point_bytes": code.point.nbytes,
            "step": address(step),
            "point": address(code.point),
            "trial": address(trial),
            "reached": address(self._reached),
            "dpbtrf": _lapack("dpbtrf"),
            "dpbtrs": _lapack("dpbtrs"),
            "uplo": address(uplo),
            **{name: address(integers[k:]) for k, name in enumerate(("n", "kd", "nrhs", "ldab", "info"))},
            "tolerance": address(self._tolerance),
            "best": address(self._best),
            **{name: address(self._counts[k:]) for k, name in enumerate(("steps", "limit", "outcome"))},
        }
        self._task = np.array([fields[name] for name in _TASK], np.int64)
        self._alive = program, band, places, uplo, integers, step, trial
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
        code, counts = self._code, self._counts
        code.enter(bound)
        code.point[:] = self._reached[:] = start
        self._tolerance[0], self._best[0] = tolerance, math.inf
        steps, outcome = 0, _GOING
        while outcome == _GOING and steps < limit and time.perf_counter() < deadline:
            counts[0], counts[1] = steps, min(limit, steps + AT_ONCE)
            self._call(self._where)
            steps, _, outcome = counts.tolist()
        self.point = self._reached.copy()
        return outcome == _CONVERGED, steps

    @property
    def hessian(self) -> np.ndarray:
        """Entries at the last linearization, in the order of the pattern."""
        return self._code.sums[1 + self._code.size : -1].copy()


@cache
def _code() -> Code:
    zero, copy = "call void @llvm.memset.p0.i64", "call void @llvm.memcpy.p0.p0.i64"
    return compiled(
        "\n".join(
            [
                "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)",
                "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)",
                "define void @run(ptr %task) nounwind {",
                "entry:",
                *unpacked(_TASK, _INTEGERS),
                "%gradient = getelementptr double, ptr %sums, i64 1",
                "%hessian = getelementptr double, ptr %gradient, i64 %size",
                "br label %again",
                "again:",
                f"{zero}(ptr %sums, i8 0, i64 %sums_bytes, i1 false)",
                f"{zero}(ptr %band, i8 0, i64 %band_bytes, i1 false)",
                "call void %costs(ptr %costs_task)",
                "br label %fill",
                # the Hessian into its band
                "fill:",
                "%i = phi i64 [0, %again], [%i1, %fill]",
                "%from = getelementptr double, ptr %hessian, i64 %i",
                "%value = load double, ptr %from",
                "%where = getelementptr i64, ptr %places, i64 %i",
                "%place = load i64, ptr %where",
                "%to = getelementptr double, ptr %band, i64 %place",
                "store double %value, ptr %to",
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
                "%singular = icmp ne i32 %flag, 0",
                "br i1 %singular, label %stop, label %solve",
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
                "br i1 %all, label %judge, label %move",
                # the point is reached if its cost is no higher than before; comparisons with NaN fail
                "judge:",
                "%cost = load double, ptr %sums",
                "%last = load double, ptr %best",
                "%down = fcmp ole double %cost, %last",
                f"%bounded = fcmp olt double %length1, {number(math.inf)}",
                "%good = and i1 %down, %bounded",
                "br i1 %good, label %accept, label %stop",
                "accept:",
                f"{copy}(ptr %reached, ptr %point, i64 %point_bytes, i1 false)",
                "store double %cost, ptr %best",
                f"%above = fcmp ogt double %cost, {number(1.0)}",
                f"%scale = select i1 %above, double %cost, double {number(1.0)}",
                "%share = load double, ptr %tolerance",
                "%enough = fmul double %scale, %share",
                f"%promised = fmul double %slope1, {number(-0.5)}",
                "%small = fcmp ole double %promised, %enough",
                f"%short = fcmp ole double %length1, {number(SHORT)}",
                "br i1 %small, label %end.if.short, label %go",
                "end.if.short:",
                "br i1 %short, label %converged, label %stop",
                "go:",
                f"{copy}(ptr %point, ptr %trial, i64 %point_bytes, i1 false)",
                "%before = load i64, ptr %steps",
                "%now = add i64 %before, 1",
                "store i64 %now, ptr %steps",
                "%most = load i64, ptr %limit",
                "%full = icmp eq i64 %now, %most",
                "br i1 %full, label %pause, label %again",
                "converged:",
                f"{copy}(ptr %reached, ptr %trial, i64 %point_bytes, i1 false)",
                "%before.last = load i64, ptr %steps",
                "%now.last = add i64 %before.last, 1",
                "store i64 %now.last, ptr %steps",
                f"store i64 {_CONVERGED}, ptr %outcome",
                "ret void",
                "pause:",
                f"store i64 {_GOING}, ptr %outcome",
                "ret void",
                "stop:",
                f"store i64 {_STOPPED}, ptr %outcome",
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
