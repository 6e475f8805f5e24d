"""What data mean: shapes, sticky values, missing rows, presence, flags, numbers that cannot be used."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stated_problems import SOLVERS, pair, same

from problems import Gaussian, Problem, Vector
from problems.errors import (
    DataError,
    NoiseError,
    ShapeError,
    UnknownNameError,
)
from problems.forms.layout import DataStore, Layout


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
