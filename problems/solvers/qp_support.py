"""What all QP backends share: settings, refusal of unusable numbers, survival of a crashing library.

A backend derives from `Backend` and writes three methods: `_build` makes the library's object, `_run` solves with new
vectors, `_renew` takes new matrices. `Backend` keeps exceptions, NaN and None of the library inside: they become a
`QPResult` with status failed, and the next solve starts from a freshly built object.
"""

from __future__ import annotations

import importlib
import types
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import metadata
from typing import Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from problems.errors import BackendError, DataError, HorizonetError, MissingExtraError, SettingError
from problems.solvers.base import Options, QPResult, Status
from problems.solvers.qp_scaling import EVEN, MISLEADING, Scaling, Warm, scaled_tolerance, uneven
from problems.solvers.settings import read_settings

S = TypeVar("S")


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _accepts(kind: Any, value: Any) -> bool:
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        return any(_accepts(part, value) for part in get_args(kind))
    if origin is Literal:
        return value in get_args(kind)
    if origin is tuple:
        inner = get_args(kind)[0]
        return isinstance(value, list | tuple) and all(_accepts(inner, part) for part in value)
    if kind is float:
        return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    return isinstance(value, kind)


def checked_settings(kind: type[S], given: Mapping[str, Any], backend: str) -> S:
    """The settings dataclass `kind` filled from `Options.extra`.

    Args:
        kind: dataclass whose fields are the settings a backend takes; values must fit the annotations.
        given: names and values the user gave.
        backend: name for messages.

    Raises:
        SettingError: an unknown name (the message offers the nearest ones) or a value of the wrong type.
    """
    settings = read_settings(kind, given, backend)
    hints = _hints(kind)
    for name, value in given.items():
        if not _accepts(hints[name], value):
            expected = str(getattr(hints[name], "__name__", hints[name])).replace("typing.", "")
            raise SettingError(f"solver {backend}: setting {name} is {value!r}, expected {expected}")
    return settings


def native(settings: Any, **translated: Any) -> dict[str, Any]:
    """Names and values for the library: `translated` from the common options, then what the user set himself.

    Fields that are None keep the library's default; None in `translated` is left out too.
    """
    values = {name: value for name, value in translated.items() if value is not None}
    for field in fields(settings):
        value = getattr(settings, field.name)
        if value is not None:
            values[field.name] = value
    return values


def interior_tolerance(tolerance: float) -> float:
    """What an interior-point library is asked for: a hundredth of our tolerance, as far as rounding allows.

    The library stops at the first point within its tolerance, whose distance from the optimum shrinks with the barrier
    only. Asked for half of ours, points of piqp were up to 1400 tolerances away on the problems of the plan
    ``agreement``, those of hpipm 210; asked for a hundredth, 30 and 7, for a tenth more iterations.
    """
    return max(0.01 * tolerance, min(0.1 * tolerance, 1e-12))


@dataclass(frozen=True)
class Rows:
    """Rows of ``l <= Ax <= u`` by kind, for libraries that want equalities and inequalities apart.

    Attributes:
        equal: indices of rows with ``l == u``.
        between: indices of the other rows with at least one finite bound.
        lower: those of `between` with a finite lower bound.
        upper: those of `between` with a finite upper bound.
        key: changes exactly when one of the above does.
    """

    equal: np.ndarray
    between: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    key: bytes

    @staticmethod
    def key_of(l: np.ndarray, u: np.ndarray) -> bytes:
        """Key of the kinds that the bounds `l`, `u` (m,) give the rows."""
        return (l == u).tobytes() + (l > -np.inf).tobytes() + (u < np.inf).tobytes()

    @classmethod
    def of(cls, l: np.ndarray, u: np.ndarray) -> Self:
        """Kinds of the rows with bounds `l`, `u` (m,)."""
        equal, low, up = l == u, l > -np.inf, u < np.inf
        return cls(
            np.flatnonzero(equal),
            np.flatnonzero(~equal & (low | up)),
            np.flatnonzero(~equal & low),
            np.flatnonzero(~equal & up),
            cls.key_of(l, u),
        )


class RowBlock:
    """Chosen rows of a ``csc_array``, each with a sign, stacked; refilled from a matrix of the same pattern.

    Args:
        A: matrix (m, n), ``csc_array``.
        parts: pairs of row indices and a sign (+1 or -1), stacked in this order.

    Attributes:
        matrix: the stacked rows, ``csc_array`` with sorted indices.
    """

    def __init__(self, A: Any, parts: Sequence[tuple[np.ndarray, float]]) -> None:
        from scipy.sparse import csc_array

        rows = np.concatenate([rows for rows, _ in parts]) if parts else np.empty(0, dtype=np.intp)
        signs = np.concatenate([np.full(len(rows), sign) for rows, sign in parts]) if parts else np.empty(0)
        # Entry numbers travel through the slicing, so that refill is one indexed copy.
        numbered = csc_array((np.arange(1.0, A.nnz + 1), A.indices, A.indptr), shape=A.shape)
        picked = csc_array(numbered.tocsr()[rows].tocsc())
        picked.sort_indices()
        self._source = picked.data.astype(np.intp) - 1
        self._sign = signs[picked.indices]
        self.matrix = picked
        self.refill(A)

    def refill(self, A: Any) -> None:
        """Take the numbers of `A`, which has the pattern of the matrix given first."""
        np.multiply(A.data[self._source], self._sign, out=self.matrix.data)


class UpperTriangle:
    """Upper triangle of a symmetric ``csc_array``; refilled from a matrix of the same pattern.

    Attributes:
        matrix: the upper triangle, ``csc_array`` with sorted indices.
    """

    def __init__(self, P: Any) -> None:
        from scipy.sparse import csc_array

        columns = np.repeat(np.arange(P.shape[1]), np.diff(P.indptr))
        self._keep = np.flatnonzero(P.indices <= columns)
        counts = np.bincount(columns[self._keep], minlength=P.shape[1])
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(P.indptr.dtype)
        self.matrix = csc_array((P.data[self._keep], P.indices[self._keep], indptr), shape=P.shape)

    def refill(self, P: Any) -> None:
        """Take the numbers of `P`, which has the pattern of the matrix given first."""
        np.take(P.data, self._keep, out=self.matrix.data)


def positive_definite(P: np.ndarray, A: np.ndarray, equal: np.ndarray) -> tuple[np.ndarray, float]:
    """A positive definite matrix with the minimiser of P on ``A[equal] x = b``.

    Adding ``w/2 |A[equal] x - b|^2`` changes neither the minimiser nor the multipliers, since it is flat where the
    equalities hold. With the linear term left at q, the multipliers of these rows come out short of ``w b``.

    Args:
        P: positive semidefinite (n, n).
        A: (m, n).
        equal: indices of equality rows.

    Returns:
        The matrix and w; ``(P, 0)`` when P is positive definite itself or when the equalities do not help.
    """
    n = P.shape[0]
    shift = 1e-10 * max(float(np.abs(np.diagonal(P)).max(initial=0.0)), np.finfo(float).tiny) * np.eye(n)
    if _factors(P - shift) or not len(equal):
        return P, 0.0
    rows = A[equal]
    gram = rows.T @ rows
    size = float(np.trace(gram))
    weight = float(np.trace(P)) / size if size > 0 and np.trace(P) > 0 else 1.0
    # A power of two adds no rounding of its own.
    weight = 2.0 ** round(np.log2(weight))
    augmented = np.ascontiguousarray(P + weight * gram)
    return (augmented, weight) if _factors(augmented - shift) else (P, 0.0)


def _factors(P: np.ndarray) -> bool:
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True


def _same_pattern(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.shape == other.shape
    return (
        one.shape == other.shape
        and np.array_equal(one.indptr, other.indptr)
        and np.array_equal(one.indices, other.indices)
    )


def sorted_csc(matrix: Any) -> Any:
    """A sparse matrix as float64 ``csc_array`` with sorted 32-bit indices and no duplicates; itself if it is one."""
    from scipy.sparse import csc_array

    if not isinstance(matrix, csc_array) or matrix.dtype != np.float64:
        matrix = csc_array(matrix, dtype=float)
    if not matrix.has_canonical_format:
        matrix = matrix.copy()
        matrix.sum_duplicates()
    if matrix.indices.dtype != np.int32 or matrix.indptr.dtype != np.int32:
        # libraries in C refuse others, and products of scipy's matrices sometimes have them
        small = (matrix.data, matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32))
        matrix = csc_array(small, shape=matrix.shape)
    return matrix


def full_pattern(matrix: np.ndarray) -> Any:
    """A dense matrix as ``csc_array`` that stores zeros too, so that its pattern does not depend on the numbers."""
    from scipy.sparse import csc_array

    rows, columns = matrix.shape
    indices = np.tile(np.arange(rows, dtype=np.int32), columns)
    indptr = np.arange(columns + 1, dtype=np.int32) * rows
    return csc_array((np.ravel(matrix, order="F").astype(float), indices, indptr), shape=matrix.shape)


class Backend(ABC):
    """Base of the QP backends; see `problems.solvers.base.QPBackend` for the contract.

    ``warm=None`` is a cold start: the answer does not depend on what the object solved before. ``warm=(x, y)`` starts
    there; when `y` is the very array the last solve returned, the library's own state is used as it stands.

    Raises:
        SettingError: ``options.extra`` has an unknown name or a value of the wrong type.
        MissingExtraError: the library is not installed.
        FormError: the library cannot take a problem of this form.
        DataError: P or A is not finite.
        BackendError: the library refused the problem at set-up.
    """

    name: ClassVar[str]
    dense: ClassVar[bool]
    warm_starts: ClassVar[bool]
    extra: ClassVar[str | None]
    package: ClassVar[str]
    module: ClassVar[str]
    settings_type: ClassVar[type[Any]]

    def __init__(self, P: Any, q: np.ndarray, A: Any, l: np.ndarray, u: np.ndarray, options: Options) -> None:
        self._options = self._asked = options
        self._settings = checked_settings(self.settings_type, options.extra, self.name)
        try:
            self._library: Any = importlib.import_module(self.module)
        except ImportError as error:
            raise MissingExtraError(f"solver {self.name}", self.package, self.extra) from error
        self._take(P, A, l == u)
        self._n, self._m = P.shape[0], A.shape[0]
        self._last_y: np.ndarray | None = None
        # Vectors that cannot be solved yet leave the building to the first solve.
        self._stale = not (np.isfinite(q).all() and (l <= u).all())
        if not self._stale:
            try:
                if self._scaling is not None:
                    q, l, u, _ = self._scaling.given(q, l, u, None)
                self._build(q, l, u)
            except HorizonetError:
                raise
            except Exception as error:
                raise BackendError(f"solver {self.name} refused the problem at set-up: {error}") from error

    def solve(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None = None) -> QPResult:
        """Solve for the vectors q (n,), l, u (m,), from the point ``warm = (x, y)`` if given; never raises."""
        if np.count_nonzero(np.isfinite(q)) != self._n:
            return QPResult(None, None, Status.FAILED, message="q has entries that are NaN or infinite")
        if np.count_nonzero(np.less_equal(l, u)) != self._m:
            ordered = self._ordered(l, u)
            if isinstance(ordered, QPResult):
                return ordered
            l, u = ordered
        scaling = self._scaling
        try:
            if scaling is not None:
                q, l, u, warm = scaling.given(q, l, u, warm)
            if self._stale:
                self._last_y = None
                self._build(q, l, u)
                self._stale = False
            result = self._run(q, l, u, warm)
            if result.x is not None and not self._is_finite(result.x, result.y):
                self._stale = True
                return QPResult(None, None, Status.FAILED, result.iterations, "the library returned NaN")
            self._last_y = result.y
            return result if scaling is None else scaling.taken(result)
        except (KeyboardInterrupt, SystemExit):
            raise
        # Panics of Rust libraries derive from BaseException.
        except BaseException as error:
            self._stale = True
            return QPResult(None, None, Status.FAILED, message=f"{type(error).__name__}: {error}")

    def update(self, P: Any, A: Any) -> None:
        """Take new numbers in P and A of the same shape; a new sparsity pattern costs a new object at the next solve.

        Raises:
            DataError: P or A is not finite.
        """
        before = self._P, self._A
        scaled = self._scaling is not None
        self._take(P, A, self._equal_rows)
        same = _same_pattern(self._P, before[0]) and _same_pattern(self._A, before[1])
        same = same and scaled == (self._scaling is not None)
        self._last_y = None
        if not same:
            self._stale = True
        elif not self._stale:
            try:
                self._renew()
            except Exception:
                # Rebuilding reports what is wrong, if it still is.
                self._stale = True

    @classmethod
    def version(cls) -> str:
        """Version of the package behind the backend.

        Raises:
            MissingExtraError: the package is not installed.
        """
        try:
            return metadata.version(cls.package)
        except metadata.PackageNotFoundError as error:
            raise MissingExtraError(f"solver {cls.name}", cls.package, cls.extra) from error

    @abstractmethod
    def _build(self, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> None:
        """Make the library's object for the present matrices."""

    @abstractmethod
    def _run(self, q: np.ndarray, l: np.ndarray, u: np.ndarray, warm: Warm | None) -> QPResult:
        """Solve with the library's object; exceptions are allowed."""

    def _is_finite(self, x: np.ndarray, y: np.ndarray | None) -> bool:
        return bool(np.isfinite(x).all()) and (y is None or bool(np.isfinite(y).all()))

    def _renew(self) -> None:
        """Bring the library's object to the present matrices; by default it is built again at the next solve."""
        self._stale = True

    def _take(self, P: Any, A: Any, equal: np.ndarray) -> None:
        """The matrices as the library is given them, scaled where weights differ much."""
        self._equal_rows = equal
        self._P, self._A = self._taken("P", P), self._taken("A", A)
        # a dense P tells more of its weights
        seen = P if isinstance(P, np.ndarray) else self._P
        if not uneven(seen, MISLEADING if self.dense else EVEN, by_diagonal=self.dense):
            self._scaling, self._options = None, self._asked
            return
        self._scaling = scaling = Scaling(seen, A if isinstance(A, np.ndarray) else self._A, equal)
        self._P, self._A = self._taken("P", scaling.P), self._taken("A", scaling.A)
        self._options = replace(self._asked, tolerance=scaled_tolerance(self._asked.tolerance))

    def _taken(self, name: str, matrix: Any) -> Any:
        """`matrix` as this backend stores it; whether it comes dense or sparse, no number may be NaN or infinite."""
        if isinstance(matrix, np.ndarray):
            numbers = matrix
        else:
            numbers = matrix.data
        if not np.isfinite(numbers).all():
            raise DataError(f"solver {self.name}: every entry of {name} must be a finite number")
        if self.dense:
            array = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
            return np.ascontiguousarray(array, dtype=float)
        return full_pattern(matrix) if isinstance(matrix, np.ndarray) else sorted_csc(matrix)

    def _ordered(self, l: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray] | QPResult:
        if np.isnan(l).any() or np.isnan(u).any():
            return QPResult(None, None, Status.FAILED, message="l or u has entries that are NaN")
        row = int(np.argmax(l - u))
        if l[row] - u[row] > self._asked.tolerance * max(1.0, abs(u[row])):
            message = f"bounds of row {row} cross: l = {l[row]:g}, u = {u[row]:g}"
            return QPResult(None, None, Status.INFEASIBLE, message=message)
        # Bounds that cross by rounding mean equality.
        return np.minimum(l, u), np.maximum(l, u)
