"""Stating a problem, and what data mean: sticky values, missing rows, presence, flags, bounds, bad input."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from problems import SE2, Cauchy, Gaussian, Huber, Problem, Vector
from problems.errors import (
    DataError,
    DefinitionError,
    EmptyConstraintError,
    FormError,
    NoiseError,
    NotAffineError,
    SettingError,
    ShapeError,
    UnknownNameError,
    UnobservableError,
)
from problems.forms.layout import DataStore, Layout

SOLVERS = ["auto", "daqp", "gauss-newton"]


def difference(x: Any, z: Any) -> Any:
    return x - z


def same(x: Any) -> Any:
    return x


def pair() -> tuple[Problem, Any, Any]:
    """Three 2-vectors with a prior on each and data for them."""
    p = Problem("pair")
    x = p.variables("x", Vector(2), 3)
    z = p.data("z", 2, 3)
    p.cost("prior", same, on=x, noise=Gaussian(10.0))
    p.cost("fit", difference, on=x, data=z)
    return p, x, z


# --- definition ----------------------------------------------------------------------------------------------------


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


# --- shapes of data --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "count", "value", "expected"),
    [
        ((), None, 3.0, [[3.0]]),
        ((), None, [3.0], [[3.0]]),
        ((), 3, 2, [[2], [2], [2]]),
        ((), 3, [1, 2, 3], [[1], [2], [3]]),
        ((), 3, [[1], [2], [3]], [[1], [2], [3]]),
        (2, None, [1, 2], [[1, 2]]),
        (2, 3, [1, 2], [[1, 2]] * 3),
        (2, 3, [[1, 2], [3, 4], [5, 6]], [[1, 2], [3, 4], [5, 6]]),
        (1, 3, [1, 2, 3], [[1], [2], [3]]),
        ((2, 3), None, [[1, 2, 3], [4, 5, 6]], [[1, 2, 3, 4, 5, 6]]),
        ((2, 2), 2, [[1, 2], [3, 4]], [[1, 2, 3, 4]] * 2),
        ((2, 2), 2, np.arange(8).reshape(2, 2, 2), [[0, 1, 2, 3], [4, 5, 6, 7]]),
        (2, 1, [1, 2], [[1, 2]]),
    ],
)
def test_shapes_that_are_accepted(shape: Any, count: Any, value: Any, expected: Any) -> None:
    p = Problem()
    p.data("d", shape, count)
    store = DataStore(Layout(p))
    store.set("d", value)
    np.testing.assert_array_equal(store["d"], expected)
    p = Problem()
    p.data("d", shape, count, value=value)
    np.testing.assert_array_equal(DataStore(Layout(p))["d"], expected)


@pytest.mark.parametrize(
    ("shape", "count", "value"),
    [
        ((), None, [1.0, 2.0]),
        ((), 3, [1.0, 2.0]),
        (2, None, [[1.0, 2.0], [3.0, 4.0]]),
        (2, 3, [1.0, 2.0, 3.0]),
        (2, 3, np.zeros((2, 3))),
        ((2, 3), None, np.zeros((3, 2))),
        ((2, 2), 3, np.zeros((2, 2, 3))),
    ],
)
def test_shapes_that_are_refused(shape: Any, count: Any, value: Any) -> None:
    p = Problem()
    p.data("d", shape, count)
    with pytest.raises(ShapeError, match="data 'd': expected shape"):
        DataStore(Layout(p)).set("d", value)


def test_what_is_no_number_is_refused() -> None:
    p, *_ = pair()
    session = p.compile()
    with pytest.raises(DataError, match="data 'z': expected numbers"):
        session.solve({"z": np.array([["a", "b"]] * 3)})
    with pytest.raises(DataError, match="data 'z': expected numbers"):
        session.solve({"z": [[1.0, 2.0], [3.0], [4.0, 5.0]]})


def test_given_arrays_are_copied() -> None:
    p, *_ = pair()
    session, z = p.compile(), np.ones((3, 2))
    session.update(z=z)
    z[:] = 99.0
    assert session.solve()["x"].max() < 1.0


# --- sticky data -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_data_are_sticky_and_never_given_ones_are_named(solver: str) -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    a, b = p.data("a"), p.data("b", value=1.0)
    p.cost("c", lambda x, a, b: x - a - b, on=x, data=(a, b))
    session = p.compile(solver)
    with pytest.raises(DataError, match="never given and without default: a"):
        session.solve()
    with pytest.raises(DataError, match="never given and without default: a"):
        session.solve({"b": 2.0})
    assert session.solve({"a": 10.0})["x"].item() == pytest.approx(12.0)
    assert session.solve({"b": 5.0})["x"].item() == pytest.approx(15.0)
    session.update(a=1.0)
    assert session.solve()["x"].item() == pytest.approx(6.0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_unknown_names_get_the_nearest(solver: str) -> None:
    p, *_ = pair()
    p.data("range_left", value=0.0)
    session = p.compile(solver)
    for call in (lambda: session.solve({"range_lefd": 1.0}), lambda: session.update(range_lefd=1.0)):
        with pytest.raises(UnknownNameError, match="unknown data 'range_lefd'; did you mean range_left"):
            call()
    with pytest.raises(UnknownNameError, match="unknown variable 'y'; valid: x"):
        session.solve({"z": np.zeros((3, 2))}, initial={"y": np.zeros((3, 2))})
    with pytest.raises(DataError, match=r"value of 'x': expected shape \(3, 2\)"):
        session.solve({"z": np.zeros((3, 2))}, initial={"x": np.zeros((2, 2))})


def test_presence_flags_cannot_be_given() -> None:
    p, x, z = pair()
    p.presence(z)
    with pytest.raises(UnknownNameError, match="unknown data .*did you mean|valid: z"):
        p.compile().solve({"presence(z)": 0.0})


# --- missing data ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_nan_switches_the_whole_instance_off(solver: str) -> None:
    p, *_ = pair()
    session = p.compile(solver)
    z = np.array([[1.0, 2.0], [np.nan, 4.0], [5.0, 6.0]])
    got = session.solve({"z": z})
    gain = 1 / (1 + 0.01)
    np.testing.assert_allclose(got["x"], [[gain, 2 * gain], [0.0, 0.0], [5 * gain, 6 * gain]], atol=1e-8)
    expected = sum(0.5 * v * v * (0.01 * gain**2 + (1 - gain) ** 2) for v in (1, 2, 5, 6))
    assert got.objective == pytest.approx(expected, rel=1e-7)
    z[1] = [3.0, 4.0]
    np.testing.assert_allclose(session.solve({"z": z})["x"], z * gain, atol=1e-8)
    np.testing.assert_allclose(session.solve({"z": np.full((3, 2), np.nan)})["x"], 0.0, atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_instances_of_an_inequality_are_switched_off_by_data_and_bounds(solver: str) -> None:
    p = Problem()
    x = p.variables("x", Vector(1), 3)
    c, top = p.data("c", (), 3), p.data("top", (), 3)
    p.cost("pull", lambda x: x - 5, on=x)
    p.inequality("box", lambda x, c: x - c, on=x, data=c, upper=top)
    session = p.compile(solver)
    got = session.solve({"c": [0.0, np.nan, 0.0], "top": [1.0, 1.0, np.nan]})
    np.testing.assert_allclose(got["x"].ravel(), [1.0, 5.0, 5.0], atol=1e-7)
    np.testing.assert_array_equal(got.active_set["box"].ravel(), [1, 0, 0])
    got = session.solve({"c": 1.0, "top": [1.0, np.inf, -1.0]})
    np.testing.assert_allclose(got["x"].ravel(), [2.0, 5.0, 0.0], atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_linear_part_that_is_missing_switches_its_instance_off(solver: str) -> None:
    p = Problem()
    x = p.variables("x", Vector(1), 2)
    g = p.data("g", (), 2)
    p.cost("prior", same, on=x)
    p.cost("pull", lambda x: x - 2, on=x, linear=g)
    got = p.compile(solver).solve({"g": [-1.0, np.nan]})
    np.testing.assert_allclose(got["x"].ravel(), [1.5, 0.0], atol=1e-8)


def observer(with_presence: bool, value: Any = None) -> Problem:
    """w = y - x where y is there, w = 0 where it is missing."""
    p = Problem()
    x, w = p.variables("x", Vector(1), 3), p.variables("w", Vector(1), 3)
    y = p.data("y", 1, 3, value=value)
    p.cost("level", lambda x: x - 1, on=x)
    p.cost("effort", same, on=w)
    if with_presence:
        p.equality("injection", lambda w, x, y, there: w - there * (y - x), on=(w, x), data=(y, p.presence(y)))
    else:
        p.equality("injection", lambda w, x, y: w - (y - x), on=(w, x), data=y)
    return p


@pytest.mark.parametrize("solver", SOLVERS)
def test_presence_lets_an_equality_say_what_holds_without_data(solver: str) -> None:
    session = observer(True).compile(solver)
    for y in ([3.0, np.nan, -1.0], [np.nan] * 3, [2.0, 2.0, 2.0], [np.nan, 1.0, 7.0]):
        got = session.solve({"y": y})
        y = np.array(y)
        there = ~np.isnan(y)
        x = np.where(there, (1 + np.nan_to_num(y)) / 2, 1.0)
        np.testing.assert_allclose(got["x"].ravel(), x, atol=1e-8)
        np.testing.assert_allclose(got["w"].ravel(), np.where(there, np.nan_to_num(y) - x, 0.0), atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_equality_that_fixes_a_variable_only_where_its_datum_is_there(solver: str) -> None:
    p = Problem()
    x, y = p.variables("x", Vector(1), 2), p.data("y", 1, 2)
    p.cost("level", lambda x: x - 1, on=x)
    p.equality("seen", lambda x, y, there: there * (x - y), on=x, data=(y, p.presence(y)))
    session = p.compile(solver)
    for y, want in (([3.0, np.nan], [3.0, 1.0]), ([np.nan, np.nan], [1.0, 1.0]), ([3.0, 4.0], [3.0, 4.0])):
        got = session.solve({"y": y})
        assert got.solved
        np.testing.assert_allclose(got["x"].ravel(), want, atol=1e-8)


def test_presence_of_a_default_with_missing_rows() -> None:
    got = observer(True, [[3.0], [np.nan], [1.0]]).compile().solve()
    np.testing.assert_allclose(got["x"].ravel(), [2.0, 1.0, 1.0])


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_equality_that_reads_missing_data_without_presence_is_an_error(solver: str) -> None:
    session = observer(False).compile(solver)
    session.solve({"y": [1.0, 2.0, 3.0]})
    with pytest.raises(DataError, match=r"equality 'injection': instance 1 reads missing data; .*presence\(data\)"):
        session.solve({"y": [1.0, np.nan, 3.0]})
    np.testing.assert_allclose(session.solve({"y": [1.0, 1.0, 1.0]})["x"], 1.0, atol=1e-8)


# --- flags -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_active_switches_costs_and_inequalities(solver: str) -> None:
    p = Problem()
    x = p.variables("x", Vector(1), 3)
    on, up = p.data("on", (), 3), p.data("up", (), 3, value=[1, 1, 1])
    p.cost("prior", same, on=x)
    p.cost("pull", lambda x: x - 4, on=x, active=on, linear=-2.0)
    p.cost("constant", lambda x: x - 100, on=x, active=[0, 0, 0])
    p.inequality("top", same, on=x, upper=1.0, active=up)
    session = p.compile(solver)
    np.testing.assert_allclose(session.solve({"on": [1, 0, 1], "up": [1, 1, 0]})["x"].ravel(), [1, 0, 3], atol=1e-7)
    np.testing.assert_allclose(session.solve({"up": [0, 0, 0]})["x"].ravel(), [3, 0, 3], atol=1e-7)
    np.testing.assert_allclose(session.solve({"on": [0, 1, 0]})["x"].ravel(), [0, 3, 0], atol=1e-7)
    with pytest.raises(DataError, match="cost 'pull': its active flags contain a NaN"):
        session.solve({"on": [0, np.nan, 0]})
    np.testing.assert_allclose(session.solve({"on": 1.0})["x"].ravel(), 3.0, atol=1e-7)


def test_flags_that_are_off_by_default_do_not_make_a_problem_unobservable() -> None:
    p = Problem()
    x = p.variables("x", Vector(1), 2)
    on = p.data("on", (), 2, value=[1, 0])
    p.cost("pull", lambda x: x - 4, on=x, active=on)
    assert p.compile().solve({"on": [1, 1]}).solved


# --- numbers that cannot be used --------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_infinities_are_for_bounds_only(solver: str) -> None:
    p, x, z = pair()
    top = p.data("top", 2, value=[np.inf, np.inf])
    p.inequality("top_", same, on=x, upper=top)
    session = p.compile(solver)
    assert session.solve({"z": np.ones((3, 2))}).solved
    with pytest.raises(DataError, match="infinite value"):
        session.solve({"z": [[1.0, np.inf]] * 3})
    np.testing.assert_allclose(
        session.solve({"z": 1.01 * np.ones((3, 2)), "top": [0.5, np.inf]})["x"], [[0.5, 1.0]] * 3
    )


def test_a_bound_that_is_also_measured_may_not_be_infinite() -> None:
    p, x, z = pair()
    p.inequality("top", same, on=x, upper=z)
    for solver in SOLVERS:
        with pytest.raises(DataError, match="infinite value"):
            p.compile(solver).solve({"z": [[1.0, np.inf]] * 3})


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("noise", "shape", "count", "bad", "text"),
    [
        ("sigma", (), None, 0.0, "sigma must be positive"),
        ("sigma", 2, 3, [[1, 1], [1, np.nan], [1, 1]], "instance 1"),
        ("covariance", (2, 2), None, [[1, 2], [2, 1]], "not positive definite"),
        ("covariance", (2, 2), 3, [np.eye(2), np.eye(2), [[1, 0], [1, 1]]], "instance 2 is not symmetric"),
        ("information", (2, 2), None, [[np.nan, 0], [0, 1]], "not finite"),
        ("information", (2, 2), None, [[1, 0], [0, -1]], "not positive semidefinite"),
    ],
)
def test_useless_weights_are_named_and_the_session_goes_on(
    solver: str, noise: str, shape: Any, count: Any, bad: Any, text: str
) -> None:
    p, x, z = pair()
    w = p.data("w", shape, count)
    p.cost("weighted", same, on=x, noise=Gaussian(**{noise: w}))
    session = p.compile(solver)
    good = np.ones(shape) if noise == "sigma" else np.eye(2)
    session.solve({"z": np.ones((3, 2)), "w": good})
    with pytest.raises(NoiseError, match=f"cost 'weighted': .*{text}"):
        session.solve({"w": bad})
    np.testing.assert_allclose(session.solve({"w": good})["x"], 1 / 2.01)


# --- pairings that are impossible -------------------------------------------------------------------------------------


def test_what_no_quadratic_program_holds_is_named() -> None:
    p, x, z = pair()
    p.cost("bent", lambda x: x**2, on=x)
    with pytest.raises(NotAffineError, match="cost 'bent' is not affine"):
        p.compile("auto", form="quadratic")
    with pytest.raises(FormError, match="solver 'daqp' takes quadratic programs only: cost 'bent' is not affine"):
        p.compile("daqp")
    p, x, z = pair()
    p.cost("robust", same, on=x, loss=Cauchy())
    with pytest.raises(FormError, match="cost 'robust' has the loss Cauchy.*which no quadratic program can hold"):
        p.compile("osqp")
    p, x, z = pair()
    p.equality("bent", lambda x: x[0] * x[1], on=x)
    with pytest.raises(FormError, match="equality 'bent' is not affine"):
        p.compile("daqp")
    p = Problem()
    p.cost("prior", lambda T: T.translation, on=p.variables("robot", SE2))
    with pytest.raises(FormError, match="'daqp' .*variables on Vector spaces only; 'robot' is on SE2"):
        p.compile("daqp")


def test_solvers_forms_and_settings_are_checked() -> None:
    p, x, z = pair()
    with pytest.raises(UnknownNameError, match="unknown solver 'gaus-newton'; did you mean gauss-newton"):
        p.compile("gaus-newton")
    with pytest.raises(FormError, match="no form 'qp'; forms: quadratic, nonlinear, graph"):
        p.compile(form="qp")
    with pytest.raises(FormError, match="solver 'daqp' takes the form quadratic, not 'graph'"):
        p.compile("daqp", form="graph")
    with pytest.raises(FormError, match="eliminate condenses quadratic programs"):
        p.compile("gauss-newton", eliminate=[x])
    with pytest.raises(DefinitionError, match="eliminate takes variables"):
        p.compile(eliminate=["x"])
    for solver in SOLVERS:
        for bad in (0.0, -1.0, "small", True, None):
            with pytest.raises(SettingError, match="tolerance must be a positive number"):
                p.compile(solver, tolerance=bad)
        with pytest.raises(SettingError, match="iteration_limitt"):
            p.compile(solver, iteration_limitt=3).solve({"z": np.full((3, 2), 1.0)})
    with pytest.raises(SettingError, match="iterations"):
        p.compile("gauss-newton", iterations=0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_problem_needs_variables_and_costs(solver: str) -> None:
    p = Problem("nothing")
    with pytest.raises(DefinitionError, match="problem 'nothing' has no variables"):
        p.compile(solver)
    p.variables("x", Vector(1))
    with pytest.raises(DefinitionError, match="problem 'nothing' has no cost"):
        p.compile(solver)


@pytest.mark.parametrize("solver", ["auto", "daqp", "osqp"])
def test_an_unobservable_problem_is_named_before_any_solve(solver: str) -> None:
    p, x, z = pair()
    p.variables("bias", Vector(2), 4)
    with pytest.raises(UnobservableError, match=r"problem 'pair' do not determine bias\[0\]"):
        p.compile(solver)
    p = Problem()
    x = p.variables("x", Vector(1), 4)
    p.cost("steps", lambda a, b: b - a, on=(x[:-1], x[1:]))
    with pytest.raises(UnobservableError, match=r"x\[0\] and 3 more"):
        p.compile(solver)


def test_an_inequality_does_not_make_a_problem_observable() -> None:
    p, x, z = pair()
    y = p.variables("y", Vector(1))
    p.inequality("box", same, on=y, lower=0.0, upper=1.0)
    with pytest.raises(UnobservableError, match=r"determine y\[0\]"):
        p.compile()


@pytest.mark.parametrize("solver", ["auto", "daqp", "proxqp", "clarabel"])
def test_a_linear_cost_and_an_inequality_hold_a_variable_together(solver: str) -> None:
    p = Problem()
    x, slack = p.variables("x", Vector(1)), p.variables("slack", Vector(1))
    target = p.data("target")
    p.cost("pull", difference, on=x, data=target)
    p.cost("penalty", same, on=slack, noise=Gaussian(information=0.0), linear=0.5)
    p.inequality("soft", lambda x, s: x - s, on=(x, slack), upper=1.0)
    p.inequality("positive", same, on=slack, lower=0.0, upper=np.inf)
    session = p.compile(solver)
    for target, x, slack in ((0.3, 0.3, 0.0), (1.2, 1.0, 0.0), (4.0, 3.5, 2.5)):
        got = session.solve({"target": target})
        assert got.solved
        np.testing.assert_allclose([got["x"].item(), got["slack"].item()], [x, slack], atol=1e-6)


def test_equalities_that_contradict_each_other_are_named() -> None:
    p, x, z = pair()
    p.equality("a", lambda x: x - 1, on=x[0])
    p.equality("b", lambda x: x - 2, on=x[0])
    for solver in ("auto", "daqp"):
        with pytest.raises(EmptyConstraintError, match="contradict each other"):
            p.compile(solver)


def test_coefficients_that_are_not_finite_are_named() -> None:
    p = Problem()
    x, y = p.variables("x", Vector(1), 2), p.data("y", 2, 2)
    p.cost("prior", same, on=x)
    p.cost("scaled", lambda x, y: (x - y[0]) / y[1], on=x, data=y)
    session = p.compile()
    np.testing.assert_allclose(session.solve({"y": [[1, 1], [np.nan, np.nan]]})["x"].ravel(), [0.5, 0.0])
    with pytest.raises(DataError, match="cost 'scaled': instance 1 has coefficients that are not finite"):
        session.solve({"y": [[1, 1], [1, 0]]})
    np.testing.assert_allclose(session.solve({"y": [[1, 1], [1, 1]]})["x"].ravel(), [0.5, 0.5])
