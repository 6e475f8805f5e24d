"""Stating a problem: slots, names, spaces, terms, and bad definitions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stated_problems import difference, pair, same

from problems import SE2, Gaussian, Huber, Problem, Vector
from problems.errors import (
    DataError,
    DefinitionError,
    EmptyConstraintError,
    NoiseError,
    ShapeError,
)


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (0, [0]),
        (-1, [4]),
        (slice(1, None), [1, 2, 3, 4]),
        (slice(None, None, -2), [4, 2, 0]),
        ([0, 0, 3], [0, 0, 3]),
        (np.array([2, -2]), [2, 3]),
        (np.array([True, False, False, True, False]), [0, 3]),
    ],
)
def test_slots_choose_instances(index: Any, expected: list[int]) -> None:
    p = Problem()
    assert p.variables("x", Vector(2), 5)[index].indices.tolist() == expected
    assert p.data("z", 2, 5)[index].indices.tolist() == expected


@pytest.mark.parametrize(
    ("index", "text"),
    [
        (5, "index 5 is outside its 5"),
        ([0, -6], "index -6 is outside"),
        (slice(5, None), "selects no instance"),
        ([], "selects no instance"),
        (1.5, "an index is a whole number"),
        ([[0, 1]], "1-D array"),
        ("a", "an index is a whole number"),
    ],
)
def test_bad_indices_are_named(index: Any, text: str) -> None:
    p = Problem()
    with pytest.raises(ShapeError, match=f"variables 'x': .*{text}"):
        p.variables("x", Vector(2), 5)[index]


def test_names_are_unique_and_not_empty() -> None:
    p, x, z = pair()
    for name in ("x", "z"):
        with pytest.raises(DefinitionError, match=f"name '{name}' is already used in problem 'pair'"):
            p.variables(name, Vector(1))
        with pytest.raises(DefinitionError, match="already used"):
            p.data(name)
        p.cost(name, same, on=x)  # terms have names of their own
    with pytest.raises(DefinitionError, match="name 'fit' is already used"):
        p.equality("fit", same, on=x)
    for name in ("", 3):
        with pytest.raises(DefinitionError, match="non-empty string"):
            p.data(name)  # type: ignore[arg-type]


def test_a_refused_term_leaves_its_name_free() -> None:
    p, x, z = pair()
    with pytest.raises(NoiseError):
        p.cost("new", same, on=x, noise=Gaussian(-1.0))
    p.cost("new", same, on=x)


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "2"])
def test_counts_are_positive_whole_numbers(count: Any) -> None:
    with pytest.raises(DefinitionError, match="variables 'x': count must be a positive whole number"):
        Problem().variables("x", Vector(2), count)
    with pytest.raises(DefinitionError, match="data 'z': count"):
        Problem().data("z", 2, count)


@pytest.mark.parametrize("space", [3, Vector, "SE2", None])
def test_spaces_are_checked(space: Any) -> None:
    with pytest.raises(DefinitionError, match="expected a space such as Vector"):
        Problem().variables("x", space)


@pytest.mark.parametrize("shape", [(0,), (2, -1), (1, 2, 3)])
def test_data_shapes_are_checked(shape: Any) -> None:
    with pytest.raises(ShapeError, match="data 'z'"):
        Problem().data("z", shape)


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda p, x, z: p.cost("c", same, on=()), DefinitionError, "cost 'c' has no variables"),
        (lambda p, x, z: p.cost("c", same, on=z), DefinitionError, "cost 'c': expected variables"),
        (lambda p, x, z: p.cost("c", difference, on=x, data=x), DefinitionError, "cost 'c': expected data"),
        (lambda p, x, z: p.cost("c", difference, on=x, data=3.0), DefinitionError, "cost 'c': expected data"),
        (lambda p, x, z: p.cost("c", lambda a, b: a - b, on=(x[:2], x)), ShapeError, "cost 'c': .*x: 2, x: 3"),
        (lambda p, x, z: p.cost("c", difference, on=x[:2], data=z), ShapeError, "cost 'c': .*x: 2, z: 3"),
        (lambda p, x, z: p.cost("c", same, on=x, noise=2.0), NoiseError, "cost 'c': noise must be a Gaussian"),
        (lambda p, x, z: p.cost("c", same, on=x, noise=Gaussian([1, 2, 3])), NoiseError, "cost 'c': sigma must be"),
        (lambda p, x, z: p.cost("c", same, on=x, noise=Gaussian(np.nan)), NoiseError, "cost 'c': .*positive"),
        (
            lambda p, x, z: p.cost("c", same, on=x, noise=Gaussian(covariance=-np.eye(2))),
            NoiseError,
            "cost 'c': covariance of instance 0 is not positive definite",
        ),
        (lambda p, x, z: p.cost("c", same, on=x, loss="huber"), DefinitionError, "cost 'c': loss must be one of"),
        (lambda p, x, z: p.cost("c", same, on=x, loss=Huber(), linear=1.0), DefinitionError, "no meaning under"),
        (lambda p, x, z: p.cost("c", same, on=x, linear=[1.0, 2.0, 3.0]), ShapeError, "cost 'c': linear"),
        (lambda p, x, z: p.cost("c", same, on=x, linear=np.inf), DataError, "cost 'c': .*linear"),
        (lambda p, x, z: p.cost("c", same, on=x, active=[1, 0]), ShapeError, "cost 'c': active"),
        (lambda p, x, z: p.cost("c", same, on=x, active=[1, 0, np.nan]), DataError, "cost 'c': instance 2 of active"),
        (lambda p, x, z: p.cost("c", same, on=x, active="yes"), ShapeError, "cost 'c': active .*'yes'"),
        (lambda p, x, z: p.cost("c", same, on=x, active=z), ShapeError, r"active needs data with rows of shape \(\)"),
        (lambda p, x, z: p.cost("c", same, on=x, noise=Gaussian(z[:2])), ShapeError, r"1 or 3 row\(s\), got 2"),
        (lambda p, x, z: p.cost("c", same, on=x, noise=Gaussian(covariance=z)), ShapeError, "covariance needs data"),
        (lambda p, x, z: p.cost("c", same, on=x, linear=p.data("l", 3)), ShapeError, "linear needs data"),
        (lambda p, x, z: p.inequality("c", same, on=x, lower=p.data("l", (), 2)), ShapeError, "lower needs data"),
        (
            lambda p, x, z: p.inequality("c", same, on=x, lower=1.0, upper=0.5),
            EmptyConstraintError,
            "instance 0, row 0",
        ),
        (
            lambda p, x, z: p.inequality("c", same, on=x, lower=0.0, upper=[[1, 1], [1, -2], [1, 1]]),
            EmptyConstraintError,
            "inequality 'c': no point satisfies instance 1, row 1: lower 0 is above upper -2",
        ),
        (lambda p, x, z: p.inequality("c", same, on=x, lower=np.inf, upper=np.inf), EmptyConstraintError, "inf"),
        (lambda p, x, z: p.inequality("c", same, on=x, upper=np.nan), DataError, "leave a bound out with an infinity"),
        (lambda p, x, z: p.inequality("c", same, on=x, upper=np.ones(3)), ShapeError, r"upper .*\(2,\) or \(3, 2\)"),
        (lambda p, x, z: p.data("d", 2, value=[1, 2, 3]), ShapeError, r"data 'd': expected shape \(2,\), got \(3,\)"),
        (lambda p, x, z: p.data("d", 2, value="ab"), DataError, "data 'd': expected numbers"),
        (lambda p, x, z: p.data("d", 2)[0], ShapeError, "data 'd' is shared by all instances"),
    ],
)
def test_bad_definitions_are_named_at_once(
    build: Callable[[Problem, Any, Any], Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        build(*pair())


def test_objects_of_another_problem_are_refused() -> None:
    p, x, z = pair()
    q, y, w = pair()
    flag = q.data("flag", (), 3)
    for bad in (
        lambda: p.cost("c", same, on=y),
        lambda: p.cost("c", same, on=y[0]),
        lambda: p.cost("c", difference, on=x, data=w),
        lambda: p.cost("c", same, on=x, active=flag),
        lambda: p.cost("c", same, on=x, noise=Gaussian(flag)),
        lambda: p.cost("c", same, on=x, linear=w),
        lambda: p.inequality("c", same, on=x, lower=w),
        lambda: p.presence(w),
    ):
        with pytest.raises(DefinitionError, match="is of another problem"):
            bad()
    for bad in (
        lambda: p.compile(eliminate=[y]),
        lambda: p.compile().marginal(y[0], at={"x": np.zeros((3, 2))}),
        lambda: p.compile().solve({"z": np.zeros((3, 2))}).covariance(y),
    ):
        with pytest.raises(DefinitionError, match="'pair'"):
            bad()


def test_repr_lists_what_was_stated() -> None:
    text = repr(pair()[0])
    for part in (
        "Problem 'pair'",
        "<variables 'x': 3 on Vector(2)>",
        "<data 'z': 3 rows of shape (2,)>",
        "<cost 'fit'",
    ):
        assert part in text


def test_a_template_of_many_instances_makes_no_object_for_each() -> None:
    p = Problem()
    n = 100_000
    x, z = p.variables("x", SE2, n), p.data("z", 2, n)
    order = np.random.default_rng(0).permutation(n)
    term = p.cost("c", lambda a, b, z: b.translation - a.translation - z, on=(x, x[order]), data=z)
    assert term.count == n
    held = [value for value in (*term.slots, *term.data) for value in vars(value).values()]
    assert all(isinstance(value, np.ndarray) or not hasattr(value, "__len__") for value in held)
