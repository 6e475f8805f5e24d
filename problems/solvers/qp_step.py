"""The QP of one SQP step, on a backend that is set up once and then only updated."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from problems import registry
from problems.errors import FormError
from problems.forms.least_squares import Constraints
from problems.forms.pins import Pins
from problems.forms.sparsity import HessianPattern
from problems.solvers.base import Options, QPBackend, QPResult, Status
from problems.solvers.qp_check import judge

DENSE_SIZE = 150


def qp_backend(name: str) -> type[QPBackend]:
    """The QP backend registered as `name`, also ``qpsolvers:NAME``.

    Raises:
        FormError: what is registered under that name takes no quadratic programs.
        UnknownNameError, MissingExtraError: nothing is; its package is not installed.
    """
    outer, _, inner = name.partition(":")
    backend = registry.load("solvers", outer)
    if inner:
        backend = backend(inner)
    if hasattr(backend, "forms"):
        raise FormError(f"solver {name!r} is no QP backend; it takes the form {' or '.join(backend.forms)}")
    return backend


class QPStep:
    """minimize ``1/2 d'Hd + g'd`` subject to ``l <= J d <= u`` with H and J in fixed patterns."""

    def __init__(
        self, pattern: HessianPattern, constraints: Constraints, pins: Pins, options: Options, solver: str | None
    ) -> None:
        self._pattern, self._constraints, self._pins = pattern, constraints, pins
        self._options = Options(tolerance=min(options.tolerance, 1e-8), time_limit=options.time_limit)
        self._solver = solver or ("daqp" if pattern.size <= DENSE_SIZE else "proxqp")
        self._backend: QPBackend | None = None
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        shape = (constraints.size, pattern.size)
        rows, cols = constraints.rows.astype(np.int32), constraints.columns.astype(np.int32)
        keep = ~np.isin(cols, pins.columns)
        self._keep = None if keep.all() else keep
        self._shape, self._rows, self._cols = shape, rows, cols
        upper = pattern.columns
        self._upper = (pattern.indices, upper)
        # some backends take 32-bit indices only
        self._half = (pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32))

    def solve(
        self, hessian: np.ndarray, gradient: np.ndarray, entries: np.ndarray, l: np.ndarray, u: np.ndarray
    ) -> tuple[QPResult, Status]:
        """The step and its multipliers, judged by our own residuals."""
        if self._keep is not None:
            entries = np.where(self._keep, entries, 0.0)
        P, A = self._matrices(hessian, entries)
        try:
            if self._backend is None:
                backend = qp_backend(self._solver)
                self._dense = backend.dense
                P, A = self._matrices(hessian, entries)
                self._backend = backend(P, gradient, A, l, u, self._options)
            else:
                self._backend.update(P, A)
            result = self._backend.solve(gradient, l, u, self._last)
        except Exception as error:  # a backend that breaks is a status, and the next solve starts afresh
            self._backend = self._last = None
            result = QPResult(None, None, Status.FAILED, 0, f"{self._solver} raised {type(error).__name__}: {error}")
        status, result = judge(result, P, gradient, A, l, u, self._options.tolerance)
        self._last = None if result.x is None or result.y is None else (result.x, result.y)
        return result, status

    _dense = True

    def _matrices(self, hessian: np.ndarray, entries: np.ndarray) -> tuple[Any, Any]:
        n = self._pattern.size
        if self._dense:
            P = np.zeros((n, n))
            P[self._upper] = hessian
            P[self._upper[1], self._upper[0]] = hessian
            flat = np.bincount(self._rows * n + self._cols, entries, self._shape[0] * n)
            return P, flat.reshape(self._shape)
        half = sp.csc_array((hessian, *self._half), shape=(n, n))
        diagonal = sp.diags_array(hessian[self._pattern.diagonal])
        P = sp.csc_array(half + half.T - diagonal)
        A = sp.csc_array(sp.coo_array((entries, (self._rows, self._cols)), shape=self._shape))
        return P, A
