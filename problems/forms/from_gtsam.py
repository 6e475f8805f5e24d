"""`from_gtsam`: a gtsam graph as a `Problem`, so that every solver can take it.

Factors are read by the templates that are registered as native (`problems.forms.native_factors`): a factor is the
template whose native factor, built anew from what was read, equals it. At the end the costs of graph and problem are
compared, so an import is either the same problem or an error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from problems.errors import FormError
from problems.forms.graph_factors import gtsam_module, reader
from problems.forms.layout import DataStore, Layout
from problems.forms.least_squares import LeastSquares
from problems.forms.native_factors import NativeFactor, native_factors
from problems.noise import Cauchy, Gaussian, GemanMcClure, Huber, Loss, Tukey
from problems.problem import Problem, Variable
from problems.spaces import SE2, SO2, Space, Vector
from problems.spatial import SE3, SO3

# vectors of fixed size are factors of their own in gtsam, and the same residual
SAME = {f"{kind}FactorPoint{size}": f"{kind}FactorVector" for kind in ("Prior", "Between") for size in (2, 3)} | {
    "PriorFactorDouble": "PriorFactorVector"
}
LOSSES: dict[str, Any] = {"Huber": Huber, "Cauchy": Cauchy, "GemanMcClure": GemanMcClure, "Tukey": Tukey}
NAMES: dict[Space, str] = {SE2: "pose", SE3: "pose", SO2: "angle", SO3: "rotation"}  # of keys without a letter
AGREE = 1e-7  # relative difference of the costs of graph and problem that counts as none


@dataclass(frozen=True)
class Imported:
    """What `from_gtsam` returns.

    Attributes:
        problem: one term for each kind of factor, with the measurements as default data.
        data: the same measurements by name.
        initial: values by variable name.
        keys: variable name and instance of each gtsam key.
    """

    problem: Problem
    data: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    keys: dict[int, tuple[str, int]]


class _Kind(NamedTuple):
    """What factors have in common that become one term."""

    residual: Callable[..., Any]
    spaces: tuple[Space, ...]
    variables: tuple[str, ...]
    loss: Loss | None
    exact: bool


@dataclass
class _Instances:
    keys: list[list[int]] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)
    information: list[np.ndarray] = field(default_factory=list)


def from_gtsam(graph: Any, values: Any, name: str = "graph") -> Imported:
    """A gtsam graph of factors that have templates here, as a problem.

    Keys become instances of one variable for each space and letter of their `gtsam.Symbol`, in ascending order; keys
    that are no symbols, as in g2o files, become ``pose``, ``point``, ``angle`` or ``rotation``.
    Constrained noise becomes equalities.

    Args:
        graph: ``gtsam.NonlinearFactorGraph``.
        values: ``gtsam.Values`` with a value for each key of the graph.
        name: of the problem.

    Raises:
        FormError: a factor without template, a noise model or value that cannot be stated here, a key without value,
            or a problem that would cost something else than the graph; names factor and reason.
    """
    names, spaces, initial = _variables(graph, values)
    kinds: dict[_Kind, _Instances] = {}
    for number in range(graph.size()):
        factor = graph.at(number)
        if factor is None:
            continue
        keys = list(factor.keys())
        what = f"factor {number} ({type(factor).__name__})"
        residual, native, row = _template(factor, tuple(spaces[key] for key in keys), what)
        information, loss, exact = _noise(factor.noiseModel(), native, what)
        kind = _Kind(residual, tuple(spaces[k] for k in keys), tuple(names[k][0] for k in keys), loss, exact)
        found = kinds.setdefault(kind, _Instances())
        found.keys.append(keys)
        found.rows.append(row)
        found.information.append(information)
    problem = Problem(name)
    variables = {key: problem.variables(key, spaces[first], len(initial[key])) for key, first in _firsts(names).items()}
    data: dict[str, np.ndarray] = {}
    for kind, found in kinds.items():
        _state(problem, variables, names, kind, found, data)
    imported = Imported(problem, data, initial, names)
    _require_same(graph, values, imported)
    return imported


def _firsts(names: dict[int, tuple[str, int]]) -> dict[str, int]:
    first: dict[str, int] = {}
    for key, (variable, _) in names.items():
        first.setdefault(variable, key)
    return first


def _variables(graph: Any, values: Any) -> tuple[dict[int, tuple[str, int]], dict[int, Space], dict[str, np.ndarray]]:
    """Variable and instance of each key, spaces, and values by variable name."""
    gtsam = gtsam_module()
    keys = sorted(set(graph.keyVector()))
    spaces: dict[int, Space] = {}
    groups: dict[tuple[str, Space], list[int]] = {}
    for key in keys:
        symbol = gtsam.Symbol(key)
        shown = f"{chr(symbol.chr())}{symbol.index()}" if symbol.chr() else str(key)
        if not values.exists(key):
            raise FormError(f"key {shown} of the graph has no value; give values for all keys")
        spaces[key] = _space(values, key, shown)
        letter = chr(symbol.chr()) if symbol.chr() else NAMES.get(spaces[key], "point")
        groups.setdefault((letter, spaces[key]), []).append(key)
    letters = [letter for letter, _ in groups]
    names: dict[int, tuple[str, int]] = {}
    initial: dict[str, np.ndarray] = {}
    for (letter, space), members in groups.items():
        variable = letter if letters.count(letter) == 1 else f"{letter} {space.name}"
        names |= {key: (variable, index) for index, key in enumerate(members)}
        rows = np.array([np.atleast_1d(reader(space)(values, key)) for key in members], dtype=float)
        initial[variable] = space.normalize_array(rows)
    return names, spaces, initial


def _space(values: Any, key: int, shown: str) -> Space:
    for read, space in (("atPose2", SE2), ("atPose3", SE3), ("atRot2", SO2), ("atRot3", SO3)):
        if _has(values, read, key):
            return space
    if _has(values, "atVector", key):
        return Vector(len(values.atVector(key)))
    raise FormError(
        f"the value of key {shown} is on a space that does not exist here; known: Pose2, Pose3, Rot2, Rot3, vectors "
        "and points"
    )


def _has(values: Any, read: str, key: int) -> bool:
    try:
        getattr(values, read)(key)
    except (RuntimeError, TypeError):  # what gtsam raises for a value of another type
        return False
    return True


@lru_cache(maxsize=1)
def _by_class() -> dict[str, list[tuple[Callable[..., Any], tuple[Space, ...], NativeFactor]]]:
    """Registered templates by the class of their factor, found by building one."""
    found: dict[str, list[tuple[Callable[..., Any], tuple[Space, ...], NativeFactor]]] = {}
    for residual, spaces, native in native_factors():
        found.setdefault(_class_of(native, len(spaces)), []).append((residual, spaces, native))
    return found


def _class_of(native: NativeFactor, slots: int) -> str:
    unit = gtsam_module().noiseModel.Unit
    # those that take a vector as it is want it of one size, and all want noise of theirs
    for size, dim in product((7, 4, 3, 2, 1), range(1, 7)):
        try:
            return type(native.build(*range(slots), np.arange(1.0, 1.0 + size), unit.Create(dim))).__name__
        except (TypeError, ValueError, RuntimeError, IndexError):
            continue
    return ""  # of something that is no measurement of one array, and that is not read


def _template(factor: Any, spaces: tuple[Space, ...], what: str) -> tuple[Callable[..., Any], NativeFactor, np.ndarray]:
    """Residual, native factor and measurement of a factor."""
    kind = type(factor).__name__
    known = _by_class()
    candidates = known.get(SAME.get(kind, kind), [])
    if not candidates:
        raise FormError(f"{what}: no template for it; templates exist for {', '.join(sorted(known))}")
    row = _measurement(factor)
    for residual, wanted, native in candidates:
        if wanted != spaces:
            continue
        again = native.build(*factor.keys(), row, factor.noiseModel())
        if kind in SAME or again.equals(factor, 1e-9):
            return residual, native, row
    shown = " x ".join(space.name for space in spaces)
    raise FormError(f"{what} on {shown}: the factor built from what was read is another one")


def _measurement(factor: Any) -> np.ndarray:
    read = next(getattr(factor, name) for name in ("measured", "prior", "measurementIn") if hasattr(factor, name))
    measured = read()
    if type(measured).__name__.startswith("BearingRange"):
        return np.array([*_numbers(measured.bearing()), measured.range()])
    return _numbers(measured)


def _numbers(element: Any) -> np.ndarray:
    """Stored coordinates of a gtsam object."""
    gtsam = gtsam_module()
    values = gtsam.Values()
    for kind, space in ((gtsam.Pose2, SE2), (gtsam.Pose3, SE3), (gtsam.Rot2, SO2), (gtsam.Rot3, SO3)):
        if isinstance(element, kind):
            values.insert(0, element)
            return np.array(reader(space)(values, 0), dtype=float)
    return np.atleast_1d(np.asarray(element, dtype=float))


def _noise(model: Any, native: NativeFactor, what: str) -> tuple[np.ndarray, Loss | None, bool]:
    """Information matrix in our order of rows, loss, and whether the factor is an equality."""
    noise = gtsam_module().noiseModel
    loss = None
    if isinstance(model, noise.Robust):
        loss = _loss(model.robust(), what)
        model = model.noise()
    if model.isConstrained():
        if np.asarray(model.sigmas()).any():
            raise FormError(f"{what}: constrained noise on some rows only; state these rows as a factor of their own")
        if loss is not None:
            raise FormError(f"{what}: a robust loss on constrained noise has no meaning")
        return np.eye(model.dim()), None, True
    information = np.asarray(model.information(), dtype=float)
    if native.order is not None:
        back = np.argsort(native.order)
        information = information[np.ix_(back, back)]
    return information, loss, False


def _loss(estimator: Any, what: str) -> Loss:
    """Our loss of a gtsam estimator; its scale is found from its weights, for gtsam does not tell."""
    kind = LOSSES.get(type(estimator).__name__)
    if kind is None:
        raise FormError(f"{what}: no loss {type(estimator).__name__} here; losses: {', '.join(LOSSES)}")
    at = 1.0
    while estimator.weight(at) > 0.5 and at < 1e12:
        at *= 2
    while estimator.weight(at) < 0.05 and at > 1e-12:
        at /= 1.5
    weight = estimator.weight(at)
    squares = {
        Huber: weight**2 * at**2,
        Cauchy: at**2 * weight / (1 - weight),
        GemanMcClure: at**2 * np.sqrt(weight) / (1 - np.sqrt(weight)),
        Tukey: at**2 / (1 - np.sqrt(weight)),
    }
    return kind(float(f"{np.sqrt(squares[kind]):.12g}"))  # a round scale stays round


def _state(
    problem: Problem,
    variables: dict[str, Variable],
    names: dict[int, tuple[str, int]],
    kind: _Kind,
    found: _Instances,
    data: dict[str, np.ndarray],
) -> None:
    """One term for all factors of a kind."""
    base = getattr(kind.residual, "__name__", "factor")
    term = base
    number = 1
    while term in problem.terms:
        number += 1
        term = f"{base} {number}"
    rows = np.array(found.rows)
    index = np.array([[names[key][1] for key in keys] for keys in found.keys])
    on = tuple(variables[name][column] for name, column in zip(kind.variables, index.T, strict=True))
    measured = problem.data(f"{term} measured", rows.shape[1], len(rows), rows)
    data[measured.name] = rows
    if kind.exact:
        problem.equality(term, kind.residual, on, measured)
    else:
        problem.cost(term, kind.residual, on, measured, _gaussian(np.array(found.information)), kind.loss)


def _gaussian(information: np.ndarray) -> Gaussian:
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    if (information == information[0]).all():
        information, diagonal = information[:1], diagonal[:1]
    if np.count_nonzero(information) == np.count_nonzero(diagonal) and (diagonal > 0).all():
        sigma = 1 / np.sqrt(diagonal)
        return Gaussian(sigma=sigma if len(sigma) > 1 else sigma[0])
    return Gaussian(information=information if len(information) > 1 else information[0])


def _require_same(graph: Any, values: Any, imported: Imported) -> None:
    """Compare costs where the graph's own constraints, which cost infinitely much in gtsam, are left out."""
    own = gtsam_module().NonlinearFactorGraph()
    for number in range(graph.size()):
        factor = graph.at(number)
        if factor is not None and not factor.noiseModel().isConstrained():
            own.add(factor)
    layout = Layout(imported.problem)
    bound = LeastSquares(imported.problem, layout).bind(DataStore(layout))
    ours, theirs = bound.cost(layout.point(imported.initial)), own.error(values)
    if not abs(ours - theirs) <= AGREE * max(1.0, abs(theirs)):
        raise FormError(
            f"the graph costs {theirs:.9g} at the values given, the problem read from it {ours:.9g}: a noise model "
            "or loss of it means something else here (a loss reweighted by components, for instance)"
        )
