"""`QuadraticProgram`: speeds of data, what changes with what, weights in every shape, caching."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from problems import SO2, Cauchy, Gaussian, Problem, Vector
from problems.errors import DataError, DefinitionError, FormError, NotAffineError
from problems.forms.affine import data_speeds, require_affine
from problems.forms.layout import INFINITE, DataStore, Layout
from problems.forms.least_squares import LeastSquares
from problems.forms.quadratic import DENSE_LIMIT, QuadraticProgram


def same(x: Any) -> Any:
    return x


def dense(matrix: Any) -> np.ndarray:
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def window() -> tuple[Problem, Any, Any]:
    """A window with data of every speed."""
    p, n, N = Problem("window"), 2, 3
    x, w = p.variables("x", Vector(n), N + 1), p.variables("w", Vector(n), N)
    y, C, R = p.data("y", 1, N + 1), p.data("C", (1, n), value=[[1.0, 0.5]]), p.data("R", (1, 1), value=[[0.5]])
    prior, M, g = p.data("prior", n), p.data("M", (n, n), value=np.eye(n)), p.data("g", n, value=[0.0, 0.0])
    L, here = p.data("L", (n, 1), value=[[0.1], [0.2]]), p.data("here", (), N + 1, value=np.ones(N + 1))
    top = p.data("top", n, value=[1.0, 2.0])
    p.cost("arrival", lambda x, m: x - m, on=x[0], data=prior, noise=Gaussian(information=M), linear=g)
    p.cost("output", lambda x, y, C: y - C @ x, on=x, data=(y, C), noise=Gaussian(covariance=R), active=here)
    p.cost("effort", same, on=w)
    p.equality(
        "dynamics", lambda x, w, xn, y, f, L: xn - 0.9 * x - w - f * (L @ y),
        on=(x[:-1], w, x[1:]), data=(y[:-1], p.presence(y)[:-1], L),
    )  # fmt: skip
    p.inequality("box", same, on=x, lower=-1.0, upper=top)
    return p, x, w


DATA: dict[str, Any] = {"y": [[0.1], [0.2], [-0.3], [0.4]], "prior": [0.2, 0.3]}


def test_speeds_are_found_from_the_symbols() -> None:
    speeds = data_speeds(window()[0])
    assert speeds == {
        "y": "vector",
        "C": "matrix",
        "R": "weight",
        "prior": "vector",
        "M": "weight",
        "g": "vector",
        "L": "matrix",
        "here": "weight",
        "top": "vector",
        "presence(y)": "matrix",
    }


def test_of_data_that_multiply_each_other_one_is_a_matrix() -> None:
    p = Problem()
    x = p.variables("x", Vector(2))
    A, b, c, s, t = p.data("A", (2, 2)), p.data("b", 2), p.data("c", 2), p.data("s"), p.data("t", 2)
    p.cost("c1", lambda x, A, b: x - A @ b, on=x, data=(A, b))
    p.cost("c2", lambda x, b, s: x - b * s, on=x, data=(c, s))
    p.cost("c3", lambda x, a, b: x - a * b, on=x, data=(t, t))
    speeds = data_speeds(p)
    assert (speeds["A"], speeds["b"]) == ("matrix", "vector")
    assert sorted((speeds["c"], speeds["s"])) == ["matrix", "vector"]
    assert speeds["t"] == "matrix"


def test_a_datum_that_is_read_and_weighs_is_matrix_data() -> None:
    p = Problem()
    x, s = p.variables("x", Vector(1)), p.data("s", value=2.0)
    p.cost("c", lambda x, s: x - s, on=x, data=s, noise=Gaussian(s))
    assert data_speeds(p)["s"] == "matrix"
    got = QuadraticProgram(p).matrices({"s": 4.0})
    np.testing.assert_allclose([got.P.item(), got.q.item()], [1 / 16, -1 / 4])


def test_what_changes_with_what() -> None:
    p, x, w = window()
    changes = QuadraticProgram(p).changes
    assert changes == {
        "y": ("q", "l", "u"),
        "C": ("P", "q"),
        "R": ("P", "q"),
        "prior": ("q",),
        "M": ("P", "q"),
        "g": ("q",),
        "L": ("A", "l", "u"),
        "here": ("P", "q"),
        "top": ("l", "u"),
        "presence(y)": ("A", "l", "u"),
    }
    assert set(QuadraticProgram(p, [w]).changes["y"]) == {"q", "l", "u"}
    assert "P" in QuadraticProgram(p, [w]).changes["L"]


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("condensed", [False, True])
def test_vectors_are_affine_in_vector_data(sparse: bool, condensed: bool) -> None:
    p, x, w = window()
    program = QuadraticProgram(p, [w] if condensed else [], dense=not sparse)
    rng = np.random.default_rng(0)
    a = {"y": rng.normal(size=(4, 1)), "prior": rng.normal(size=2), "g": rng.normal(size=2), "top": rng.normal(size=2)}
    b = {k: rng.normal(size=np.shape(v)) for k, v in a.items()}
    middle = {k: 0.25 * np.asarray(a[k]) + 0.75 * b[k] for k in a}
    at_a, at_b, at_middle = (program.matrices(d) for d in (a, b, middle))
    for k in "qlu":
        np.testing.assert_allclose(getattr(at_middle, k), 0.25 * getattr(at_a, k) + 0.75 * getattr(at_b, k), atol=1e-12)
    for k in "PA":
        np.testing.assert_array_equal(dense(getattr(at_a, k)), dense(getattr(at_b, k)))


def test_the_hessian_is_linear_in_the_information() -> None:
    p, *_ = window()
    program = QuadraticProgram(p)
    P = [program.matrices(DATA | {"M": M}).P for M in (np.eye(2), 3 * np.eye(2), 2 * np.eye(2))]
    np.testing.assert_allclose(P[0] + P[1], 2 * P[2], atol=1e-13)
    np.testing.assert_allclose(P[1] - P[0], np.diag([2.0, 2.0] + [0.0] * 12), atol=1e-13)


@pytest.mark.parametrize(
    ("kind", "shape", "count"),
    [
        ("sigma", (), None), ("sigma", (), 4), ("sigma", 1, 4), ("sigma", 2, None), ("sigma", 2, 4),
        ("covariance", (2, 2), None), ("covariance", (2, 2), 4),
        ("information", (2, 2), None), ("information", (2, 2), 4),
    ],
)  # fmt: skip
@pytest.mark.parametrize("instances", [2, 4])
def test_weights_given_as_data_equal_constant_ones_in_every_shape(
    kind: str, shape: Any, count: int | None, instances: int
) -> None:
    rng = np.random.default_rng(1)
    count = None if count is None else instances
    rows = () if count is None else (count,)
    size = () if shape == () else (shape,) if isinstance(shape, int) else shape
    if kind == "sigma":
        value = np.exp(rng.normal(size=(*rows, *size)))
    else:
        root = rng.normal(size=(*rows, *size))
        value = root @ root.swapaxes(-1, -2) + np.eye(2)
    if kind == "sigma" and count is not None and size in ((), (1,)):
        constant = np.repeat(value.reshape(-1, 1), 2, axis=1)
    else:
        constant = value

    def state(noise: Any, extra: bool) -> Problem:
        p = Problem()
        x = p.variables("x", Vector(2), instances)
        datum = p.data("weight", shape, count) if extra else None
        p.cost("c", lambda x: x - 1, on=x, noise=Gaussian(**{kind: datum if extra else noise}))
        return p

    given, fixed = state(None, True), state(constant, False)
    want = QuadraticProgram(fixed).matrices()
    for is_dense in (True, False):
        got = QuadraticProgram(given, dense=is_dense).matrices({"weight": value})
        np.testing.assert_allclose(dense(got.P), want.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(got.q, want.q, rtol=1e-9, atol=1e-12)
    z = rng.normal(size=2 * instances)
    results = []
    for p in (given, fixed):
        layout = Layout(p)
        form = LeastSquares(p, layout)
        store = DataStore(layout)
        if p is given:
            store.set("weight", value)
        results.append(form.bind(store).linearize(z))
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(results[0][1], want.P @ z + want.q, rtol=1e-8, atol=1e-10)


def test_one_instance_in_two_slots_counts_twice() -> None:
    p = Problem()
    x = p.variables("x", Vector(1), 2)
    p.cost("c", lambda a, b: a + b, on=(x[[0, 0]], x[[0, 1]]))
    np.testing.assert_allclose(QuadraticProgram(p).matrices().P, [[5.0, 1.0], [1.0, 1.0]])


def test_missing_data_and_flags_take_their_rows_out() -> None:
    p, x, w = window()
    program = QuadraticProgram(p)
    full = program.matrices(DATA)
    part = program.matrices(DATA | {"y": [[0.1], [np.nan], [-0.3], [0.4]]})
    off = program.matrices(DATA | {"here": [1, 0, 1, 1]})
    np.testing.assert_allclose(part.P, off.P, atol=1e-14)
    np.testing.assert_allclose((full.P - part.P)[2:4, 2:4], np.outer([1, 0.5], [1, 0.5]) / 0.5, atol=1e-13)
    rows = slice(2, 4)  # of the equality that reads y[1]
    np.testing.assert_allclose(part.l[rows], 0.0)
    np.testing.assert_allclose(full.l[rows], 0.2 * np.array([0.1, 0.2]))


def test_infinite_bounds_stay_infinite() -> None:
    p, x, w = window()
    got = QuadraticProgram(p).matrices(DATA | {"top": [np.inf, 3.0]})
    np.testing.assert_array_equal(got.u[6:].reshape(4, 2), [[np.inf, 3.0]] * 4)
    np.testing.assert_array_equal(got.l[6:], -1.0)
    got = QuadraticProgram(p).matrices(DATA | {"top": [2 * INFINITE, 3.0]})
    np.testing.assert_array_equal(got.u[6::2], np.inf)


def test_data_that_were_not_given_are_named() -> None:
    with pytest.raises(DataError, match="y, prior"):
        QuadraticProgram(window()[0]).matrices()


def test_what_does_not_change_is_computed_once() -> None:
    p = Problem()
    x, z = p.variables("x", Vector(2), 3), p.data("z", 2, 3)
    p.cost("c", lambda x, z: x - z, on=x, data=z)
    program = QuadraticProgram(p)
    numbers = np.zeros(6)
    assert program.reduced(numbers) is program.reduced(numbers + 1.0)
    rows = program.rows.evaluate(numbers)
    assert program.rows.evaluate(numbers + 1.0)[0] is rows[0]


def test_large_problems_are_sparse() -> None:
    p = Problem()
    count = int(DENSE_LIMIT**0.5)
    x = p.variables("x", Vector(2), count)
    p.cost("c", same, on=x)
    got = QuadraticProgram(p).matrices().P
    assert not isinstance(got, np.ndarray) and got.nnz == 2 * count


def test_what_elimination_leaves_decides_whether_matrices_are_dense() -> None:
    p, count = Problem(), int(0.7 * DENSE_LIMIT**0.5)
    x, w, z = p.variables("x", Vector(1), count), p.variables("w", Vector(1), count), p.data("z", 1)
    p.cost("c", same, on=w)
    p.equality("e", lambda x, w, z: x - w - z, on=(x, w), data=z)
    assert not QuadraticProgram(p).dense
    assert QuadraticProgram(p, [x]).dense and QuadraticProgram(p, [x]).remaining == count
    assert not QuadraticProgram(p, [x], dense=False).dense
    bounds = p.data("bounds", 1, count)
    p.inequality("b", same, on=x, upper=bounds)
    assert not QuadraticProgram(p, [x]).dense


def test_repr_says_how_large_it_is() -> None:
    p = Problem("small")
    p.cost("c", same, on=p.variables("x", Vector(2), 3))
    assert repr(QuadraticProgram(p)) == "<QuadraticProgram of 'small', 6 unknowns, 0 rows, dense>"
    assert repr(QuadraticProgram(window()[0])) == "<QuadraticProgram of 'window', dense>"


def test_condense_adds_to_what_is_eliminated() -> None:
    p, x, w = window()
    small = QuadraticProgram(p).condense([w])
    assert small.matrices(DATA).P.shape == (8, 8)
    assert small.condense([]).matrices(DATA).P.shape == (8, 8)
    with pytest.raises(DefinitionError, match="eliminate takes variables of problem 'window'"):
        small.condense(["w"])


def test_what_no_quadratic_program_holds() -> None:
    p = Problem()
    x = p.variables("x", Vector(1))
    p.cost("fine", same, on=x)
    require_affine(p)
    p.cost("bent", lambda x: x**3, on=x)
    with pytest.raises(NotAffineError, match="cost 'bent'"):
        require_affine(p)
    p = Problem()
    p.cost("robust", same, on=p.variables("x", Vector(1)), loss=Cauchy())
    with pytest.raises(FormError, match="loss Cauchy"):
        require_affine(p)
    p = Problem()
    p.variables("heading", SO2)
    with pytest.raises(FormError, match="'heading' is on SO2. Use a solver for graphs"):
        require_affine(p)
