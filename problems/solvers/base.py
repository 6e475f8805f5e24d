"""What a solver backend is given and what it gives back.

A backend translates, runs and reports; it judges nothing. Sessions recompute residuals and decide on the status.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np


class Status(StrEnum):
    """Outcome of one solve, as decided by the session from its own residuals.

    ``solved`` bounds errors of the cost, not distances. Quadratic programs: violation, dual residual and gap are within
    tolerance of their sizes (`Options.tolerance`), and with them the cost, relative to the numbers it is the difference
    of; where weights differ by more than 1e5, what relative residuals hide counts too (`problems.solvers.qp_scaling`).
    Graphs and nonlinear programs: the Newton decrement is at most 0.1 tolerance max(1, cost). Near an optimum a
    cost is flat, so in units of standard deviations unknowns may be off by the root of it: at 1e-8 by some 1e-4.
    Active-set methods and full Newton steps end far nearer; interior-point backends are asked for a hundredth of the
    tolerance, after which distances are mostly below ten tolerances.
    """

    SOLVED = "solved"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    FAILED = "failed"


@dataclass(frozen=True)
class Options:
    """Settings that mean the same for every backend.

    Attributes:
        tolerance: residuals at most ``tolerance * max(1, |Px|, |A'y|, |q|)`` and the relative gap (QPs), the Newton
            decrement (graphs and NLPs); each backend translates it to its own terms.
        time_limit: seconds for one solve.
        iteration_limit: None leaves the backend's own default.
        extra: backend-specific settings, passed through by the names the backend documents.
    """

    tolerance: float = 1e-8
    time_limit: float = 30.0
    iteration_limit: int | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class QPResult:
    """What a QP backend found.

    Attributes:
        x: primal point (n,), or None.
        y: multipliers (m,) of ``l <= Ax <= u`` with ``Px + q + A'y = 0``: positive at the upper, negative at the lower
            bound; or None.
        status: the backend's own claim; a session checks it.
        iterations: the backend's count, 0 when it gives none.
        message: what the backend said, for people.
    """

    x: np.ndarray | None
    y: np.ndarray | None
    status: Status
    iterations: int = 0
    message: str = ""


@runtime_checkable
class QPBackend(Protocol):
    """One QP solver: minimize ``1/2 x'Px + q'x`` subject to ``l <= Ax <= u``.

    Construction does everything that does not depend on `q`, `l`, `u`; rows with ``l == u`` are equalities; infinite
    bounds are ``+-numpy.inf``. Matrices are C-contiguous float64 arrays where `dense`, else scipy ``csc_array`` (both
    triangles of P stored). One object is used by one thread.
    """

    name: ClassVar[str]
    dense: ClassVar[bool]
    warm_starts: ClassVar[bool]
    extra: ClassVar[str | None]

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None: ...

    def solve(
        self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: tuple[np.ndarray, np.ndarray] | None = None
    ) -> QPResult:
        """Solve for new vectors, from the point `warm` = (x, y) where the backend can use it."""
        ...

    def update(self, P: Any, A: Any) -> None:
        """Take new numbers in matrices of the same shape (and, if sparse, the same pattern)."""
        ...

    @classmethod
    def version(cls) -> str:
        """Version of the package behind the backend; raises `MissingExtraError` when it is not installed."""
        ...
