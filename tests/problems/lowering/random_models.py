"""Random affine models with a dense reference assembled by NumPy alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from problems import Gaussian, Problem, Vector

SEEDS = range(24)


@dataclass
class Part:
    """A share of a residual that reads data: `role` says how (see `Part.add`)."""

    role: str
    names: tuple[str, ...]
    D: np.ndarray

    def add(self, x: Any, d: list[Any]) -> Any:
        if self.role == "vector":
            return self.D @ d[0]
        if self.role == "square":
            return self.D @ d[0] ** 2
        if self.role == "matrix":
            return d[0] @ x
        if self.role == "gain":
            return d[0] * (self.D @ d[1])
        return d[1] * (self.D @ d[0] - 1)  # the flag of presence


@dataclass
class Spec:
    """A term as this test knows it."""

    kind: str
    name: str
    slots: list[tuple[str, np.ndarray]]
    A: list[np.ndarray]
    c: np.ndarray
    parts: list[Part]
    count: int
    noise: tuple[str, Any] = ("sigma", 1.0)
    linear: Any = None
    lower: Any = None
    upper: Any = None
    active: Any = None

    @property
    def dim(self) -> int:
        return self.c.size

    def residual(self, *arguments: Any) -> Any:
        xs, ds = arguments[: len(self.slots)], list(arguments[len(self.slots) :])
        out = self.c + sum(A @ x for A, x in zip(self.A, xs, strict=True))
        for part in self.parts:
            out = out + part.add(xs[0], [ds.pop(0) for _ in part.names])
        return out


@dataclass
class Model:
    """A random problem, the numbers of its data, and their dense reference."""

    rng: np.random.Generator
    problem: Problem = field(default_factory=lambda: Problem("random"))
    specs: list[Spec] = field(default_factory=list)
    values: dict[str, np.ndarray] = field(default_factory=dict)
    handles: dict[str, Any] = field(default_factory=dict)
    optional: set[str] = field(default_factory=set)  # data that may be missing

    def datum(self, shape: Any, count: int | None, draw: Any, optional: bool = False) -> str:
        name = f"d{len(self.handles)}"
        self.handles[name] = self.problem.data(name, shape, count)
        rows = () if count is None else (count,)
        shape = (shape,) if isinstance(shape, int) else shape
        self.values[name] = np.asarray(draw((*rows, *shape)), float)
        if optional:
            self.optional.add(name)
        return name

    def normal(self, shape: Any) -> np.ndarray:
        return self.rng.normal(size=shape)

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def spd(self, shape: tuple[int, ...]) -> np.ndarray:
        root = self.normal(shape)
        return root @ root.swapaxes(-1, -2) + 0.3 * np.eye(shape[-1])

    # --- drawing --------------------------------------------------------------------------------------------------

    def parts_of(self, dim: int, width: int, count: int, optional: bool) -> list[Part]:
        out = []
        for role in self.rng.choice(["vector", "square", "matrix", "gain", "presence"], self.rng.integers(0, 3)):
            each = count if self.chance(0.6) else None
            size = int(self.rng.integers(1, 4))
            if role in ("vector", "square"):
                names = (self.datum(size, each, self.normal, optional),)
            elif role == "matrix":
                names = (self.datum((dim, width), each, self.normal, optional),)
            elif role == "gain":
                names = (self.datum((), each, self.normal), self.datum(size, count, self.normal, optional))
            else:
                names = (self.datum(size, count, self.normal, True),)
                flag = self.problem.presence(self.handles[names[0]])
                self.handles[flag.name] = flag
                names = (names[0], flag.name)
            out.append(Part(role, names, self.normal((dim, size))))
        return out

    def inputs_of(self, n: int, steps: int) -> list[Part]:
        """Known inputs and a gain on one of them, never a matrix on w."""
        out = []
        if self.chance(0.5):
            out.append(Part("vector", (self.datum(2, steps, self.normal),), self.normal((n, 2))))
        if self.chance(0.3):
            names = (self.datum((), None, self.normal), self.datum(1, steps, self.normal))
            out.append(Part("gain", names, self.normal((n, 1))))
        return out

    def noise_of(self, dim: int, count: int) -> tuple[str, Any]:
        kind = str(self.rng.choice(["sigma", "covariance", "information"]))
        many = self.chance(0.5)
        shape: tuple[int, ...] = (dim,) if kind == "sigma" else (dim, dim)
        if kind == "sigma" and self.chance(0.3):
            shape = ()

        def draw(full: tuple[int, ...]) -> np.ndarray:
            return np.exp(0.5 * self.normal(full)) if kind == "sigma" else self.spd(full)

        if self.chance(0.5):
            return kind, self.datum(shape, count if many else None, draw)
        if kind == "sigma" and shape == ():
            return kind, float(np.exp(self.rng.normal()))
        return kind, draw((count, *shape) if many else shape)

    def flags_of(self, count: int) -> Any:
        def draw(shape: Any) -> np.ndarray:
            return (self.rng.random(shape) < 0.7).astype(float)

        if self.chance(0.5):
            return None
        if self.chance(0.5):
            return self.datum((), count if self.chance(0.7) else None, draw)
        return draw(count)

    def slots_of(self, count: int, slots: int) -> list[tuple[str, np.ndarray]]:
        out = []
        for _ in range(slots):
            name = str(self.rng.choice(list(self.problem.unknowns)))
            size = self.problem.unknowns[name].count
            index = self.rng.integers(0, size, count if self.chance(0.7) else 1)
            out.append((name, index))
        if all(len(i) == 1 for _, i in out):
            name, _ = out[0]
            out[0] = (name, self.rng.integers(0, self.problem.unknowns[name].count, count))
        return out

    def term(self, kind: str, slots: list[tuple[str, np.ndarray]], dim: int, **given: Any) -> Spec:
        count = max(len(i) for _, i in slots)
        widths = [self.problem.unknowns[n].space.dim for n, _ in slots]
        A = given.pop("A", [self.normal((dim, w)) for w in widths])
        parts = given.pop("parts", None)
        parts = self.parts_of(dim, widths[0], count, kind != "equality") if parts is None else parts
        spec = Spec(kind, f"{kind}{len(self.specs)}", slots, A, self.normal(dim), parts, count, **given)
        self.specs.append(spec)
        return spec

    def state(self, spec: Spec) -> None:
        """Hand the term to the problem."""

        def handle(value: Any) -> Any:
            return self.handles[value] if isinstance(value, str) else value

        on = tuple(self.problem.unknowns[n][i] for n, i in spec.slots)
        data = tuple(self.handles[n] for part in spec.parts for n in part.names)
        if spec.kind == "cost":
            kind, value = spec.noise
            self.problem.cost(
                spec.name, spec.residual, on, data, Gaussian(**{kind: handle(value)}),
                active=handle(spec.active), linear=handle(spec.linear),
            )  # fmt: skip
        elif spec.kind == "equality":
            self.problem.equality(spec.name, spec.residual, on, data)
        else:
            self.problem.inequality(
                spec.name, spec.residual, on, data, handle(spec.lower), handle(spec.upper), handle(spec.active)
            )

    # --- the reference ---------------------------------------------------------------------------------------------

    def read(self, name: str, row: int) -> np.ndarray:
        """Numbers of one row of a datum, flags of presence included."""
        handle = self.handles[name]
        if handle.of is not None:
            return np.array(float(np.isfinite(self.row(handle.of.name, row)).all()))
        return self.row(name, row)

    def row(self, name: str, row: int) -> np.ndarray:
        value = self.values[name]
        if self.handles[name].count is None:
            return value
        return value[row if value.shape[0] > 1 else 0]

    def number(self, value: Any, i: int, dim: int, count: int) -> np.ndarray:
        """A bound, linear part or flag of instance i as (dim,)."""
        if isinstance(value, str):
            return np.broadcast_to(self.row(value, i), (dim,)).astype(float)
        value = np.asarray(value, float)
        if value.shape == (count,) and dim == 1:
            return value[i : i + 1]
        return np.broadcast_to(value, (count, dim))[i]

    def is_on(self, spec: Spec, i: int) -> bool:
        if spec.kind == "equality":
            return True
        flagged = {p.names[0] for p in spec.parts if p.role == "presence"}
        read = [n for p in spec.parts for n in p.names if n not in flagged and self.handles[n].of is None]
        read += [v for v in (spec.linear, spec.lower, spec.upper) if isinstance(v, str)]
        if any(np.isnan(self.row(n, i)).any() for n in read):
            return False
        return spec.active is None or self.number(spec.active, i, 1, spec.count)[0] != 0

    def affine(self, spec: Spec, i: int) -> tuple[np.ndarray, np.ndarray]:
        """J, r0 of instance i with ``r = J z + r0``; missing data read as zero."""
        starts, size = self.starts()
        numbers = [np.nan_to_num(self.read(n, i), posinf=0, neginf=0) for p in spec.parts for n in p.names]
        zeros = [np.zeros(A.shape[1]) for A in spec.A]
        r0 = spec.residual(*zeros, *numbers)
        J = np.zeros((spec.dim, size))
        for s, (name, index) in enumerate(spec.slots):
            width = zeros[s].size
            at = starts[name] + width * int(index[i if len(index) > 1 else 0])
            for k in range(width):
                unit = [z.copy() for z in zeros]
                unit[s][k] = 1.0
                J[:, at + k] += spec.residual(*unit, *numbers) - r0
        return J, r0

    def starts(self) -> tuple[dict[str, int], int]:
        out, size = {}, 0
        for name, variable in self.problem.unknowns.items():
            out[name] = size
            size += variable.count * variable.space.dim
        return out, size

    def information(self, spec: Spec, i: int) -> np.ndarray:
        kind, value = spec.noise
        if isinstance(value, str):
            value = self.row(value, i)
        else:
            value = np.asarray(value, float)
            if value.ndim == (2 if kind == "sigma" else 3):
                value = value[i if value.shape[0] > 1 else 0]
        if kind == "sigma":
            return np.diag(np.broadcast_to(value, (spec.dim,)) ** -2.0)
        return np.linalg.inv(value) if kind == "covariance" else value

    def dense(self) -> Dense:
        _, n = self.starts()
        P, q, constant = np.zeros((n, n)), np.zeros(n), 0.0
        A, l, u = [np.zeros((0, n))], [np.zeros(0)], [np.zeros(0)]
        for kind in ("cost", "equality", "inequality"):
            for spec in (s for s in self.specs if s.kind == kind):
                for i in range(spec.count):
                    J, r0 = self.affine(spec, i)
                    on = self.is_on(spec, i)
                    if kind != "cost":
                        A.append(J)
                        low = high = np.zeros(spec.dim)
                        if kind == "inequality":
                            low = self.number(spec.lower, i, spec.dim, spec.count) if on else -np.inf
                            high = self.number(spec.upper, i, spec.dim, spec.count) if on else np.inf
                        l.append(low - r0)
                        u.append(high - r0)
                    elif on:
                        W = self.information(spec, i)
                        lam = np.zeros(spec.dim)
                        if spec.linear is not None:
                            lam = self.number(spec.linear, i, spec.dim, spec.count)
                        P += J.T @ W @ J
                        q += J.T @ (W @ r0 + lam)
                        constant += 0.5 * r0 @ W @ r0 + lam @ r0
        return Dense(P, q, constant, np.vstack(A), np.concatenate(l), np.concatenate(u))

    def redraw(self) -> None:
        """New numbers for all data that are no bounds, other rows missing."""
        bounds = {v for s in self.specs for v in (s.lower, s.upper) if isinstance(v, str)}
        weights = {s.noise[1]: s for s in self.specs if isinstance(s.noise[1], str)}
        flags = {s.active for s in self.specs if isinstance(s.active, str)}
        for name, value in self.values.items():
            if name in bounds:
                continue
            if name in weights:
                self.values[name] = np.array(value * 1.3)
            elif name in flags:
                self.values[name] = (self.rng.random(value.shape) < 0.7).astype(float)
            else:
                self.values[name] = self.normal(value.shape)
                if name in self.optional and value.ndim:
                    self.values[name][self.rng.random(value.shape) < 0.12] = np.nan

    def fit_bounds(self) -> None:
        """Bounds that are data hold at one common point, some tightly, some not at all."""
        d = self.dense()
        equal = d.l == d.u
        E, e = d.A[equal], d.l[equal]
        z = self.normal(d.q.size) * 0.5
        z = z - np.linalg.pinv(E) @ (E @ z - e) if equal.any() else z
        for spec in (s for s in self.specs if s.kind == "inequality"):
            rows = np.array([J @ z + r0 for J, r0 in (self.affine(spec, i) for i in range(spec.count))])
            for name, sign in ((spec.lower, -1.0), (spec.upper, 1.0)):
                if not isinstance(name, str):
                    continue
                value = rows + sign * self.rng.uniform(0.01, 1.0, rows.shape)
                if self.handles[name].count is None:
                    value = value.min(axis=0) if sign < 0 else value.max(axis=0)
                value[self.rng.random(value.shape) < 0.15] = sign * np.inf
                if self.handles[name].count is not None and self.chance(0.3):
                    value[self.rng.integers(len(value))] = np.nan
                self.values[name] = value


@dataclass
class Dense:
    """``1/2 z'Pz + q'z + constant`` subject to ``l <= A z <= u``."""

    P: np.ndarray
    q: np.ndarray
    constant: float
    A: np.ndarray
    l: np.ndarray
    u: np.ndarray

    def objective(self, z: np.ndarray) -> float:
        return 0.5 * z @ self.P @ z + self.q @ z + self.constant

    def solve(self, active: np.ndarray) -> np.ndarray:
        """Optimum with the rows `active` (1 upper, -1 lower, 0 free) held at their bounds, by the KKT system."""
        hold = active != 0
        F = self.A[hold]
        b = np.where(active > 0, self.u, self.l)[hold]
        m = F.shape[0]
        K = np.block([[self.P, F.T], [F, np.zeros((m, m))]])
        return np.linalg.lstsq(K, np.concatenate([-self.q, b]), rcond=1e-13)[0][: self.q.size]

    def violation(self, z: np.ndarray) -> float:
        rows = self.A @ z
        return float(np.maximum(rows - self.u, self.l - rows).max(initial=0.0))

    def check(self, z: np.ndarray, y: np.ndarray, tolerance: float) -> None:
        """The optimality conditions, which are sufficient: P is positive semidefinite."""
        rows = self.A @ z
        size = max(1.0, np.abs(self.P @ z).max(), np.abs(self.q).max())
        assert self.violation(z) <= tolerance
        assert np.abs(self.P @ z + self.q + self.A.T @ y).max() <= tolerance * size
        free = self.l < self.u
        assert (np.where(y > tolerance * size, self.u - rows, 0.0)[free] <= 10 * tolerance).all()
        assert (np.where(y < -tolerance * size, rows - self.l, 0.0)[free] <= 10 * tolerance).all()


def draw(seed: int, inequalities: bool = True) -> Model:
    """A random model; w is defined by the dynamics, so it can be eliminated."""
    m = Model(np.random.default_rng(seed))
    p, n, N = m.problem, int(m.rng.integers(1, 4)), int(m.rng.integers(1, 6))
    p.variables("x", Vector(n), N + 1)
    p.variables("b", Vector(int(m.rng.integers(1, 3))))
    p.variables("w", Vector(n), N)
    for name, variable in p.unknowns.items():
        prior = m.term("cost", [(name, np.arange(variable.count))], variable.space.dim, parts=[])
        prior.A = [np.eye(variable.space.dim)]
    for _ in range(int(m.rng.integers(1, 4))):
        dim, count = int(m.rng.integers(1, 4)), int(m.rng.integers(1, 5))
        spec = m.term("cost", m.slots_of(count, int(m.rng.integers(1, 4))), dim)
        spec.noise, spec.active = m.noise_of(dim, spec.count), m.flags_of(spec.count)
        if m.chance(0.5):
            one = m.normal(dim) if m.chance(0.5) else m.normal((spec.count, dim))
            spec.linear = m.datum(dim, spec.count, m.normal, True) if m.chance(0.5) else one
    if m.chance(0.8):
        k = np.arange(N)
        A = [np.eye(n), -0.5 * m.normal((n, n)), np.eye(n)]
        m.term("equality", [("w", k), ("x", k), ("x", k + 1)], n, A=A, parts=m.inputs_of(n, N))
        if m.chance(0.5):
            m.term("equality", [("b", np.zeros(1, int)), ("x", np.zeros(1, int))], 1)
    if inequalities and m.chance(0.8):
        for _ in range(int(m.rng.integers(1, 3))):
            dim, count = int(m.rng.integers(1, 3)), int(m.rng.integers(1, 5))
            spec = m.term("inequality", m.slots_of(count, int(m.rng.integers(1, 3))), dim)
            spec.active = m.flags_of(spec.count)
            shared = None if m.chance(0.3) else spec.count
            spec.lower = m.datum(dim, shared, m.normal) if m.chance(0.7) else -100.0
            spec.upper = m.datum(dim, shared, m.normal) if m.chance(0.7) else np.full(dim, 100.0)
            if m.chance(0.3):
                spec.lower = -np.inf
    m.redraw()
    m.fit_bounds()
    for spec in m.specs:
        m.state(spec)
    return m
