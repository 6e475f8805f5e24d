"""What all tests share: recorded data, reproducible hypothesis runs, and a scenario package installed for the tests."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from problems import registry

ROOT = Path(__file__).resolve().parent.parent

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.load_profile("ci")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Recordings and published data sets; tests that need them are skipped where there are none."""
    folder = Path(os.environ.get("HORIZONET_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}; set HORIZONET_DATA")
    return folder


TOY_MODULE = '''
import os
import time
import warnings
from collections import Counter
from typing import Literal

import numpy as np
import pydantic

from problems.bench.scenario import Consistency, Curve, Outcome
from problems.errors import FormError, ReadError


class ToySettings(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")
    steps: int = pydantic.Field(default=4, ge=1, description="number of steps")
    tolerance: float = pydantic.Field(default=1e-6, gt=0)
    mode: Literal[
        "calm", "raise", "exit", "crash", "hang", "print", "warn", "unpicklable", "unreadable", "unfit"
    ] = "calm"
    offset: float = 0.0
    label: str = "1"


class Toy:
    name = "toy"
    source = "made for the tests"
    methods = ("mean", "first", "kalman")
    metrics = ("error", "never")
    settings = ToySettings
    without_solver = ("kalman",)

    def draw(self, settings, rng):
        if settings.mode == "unreadable":
            raise ReadError("some/file.csv", 3, "a number", "'x'")
        return rng.normal(size=settings.steps)

    def run(self, settings, method, solver, drawn):
        if settings.mode == "unfit" and solver == "slow":
            raise FormError("solver 'slow' takes factor graphs only")
        if settings.mode == "raise" and method == "first":
            raise ArithmeticError("the estimate diverged")
        if settings.mode == "exit" and method == "first":
            raise SystemExit(3)
        if settings.mode == "crash" and method == "first":
            os.kill(os.getpid(), 11)
        if settings.mode == "hang" and method == "first":
            time.sleep(60)
        if settings.mode == "print":
            print("chatter")
            os.write(1, b"chatter from C\\n")
        if settings.mode == "warn":
            warnings.warn("half of the data is missing")
        estimate = {"mean": drawn.mean(), "first": drawn[0], "kalman": 0.9 * drawn.mean()}[method]
        error = abs(float(estimate) + settings.offset) + settings.tolerance
        return Outcome(
            metrics={"error": error, "never": None},
            options={"weights": "uniform"},
            times={"compile": 0.5, "solve": 1e-3 * settings.steps},
            step_seconds=np.full(settings.steps, 1e-3),
            status=Counter(solved=settings.steps - 1, inaccurate=1),
            iterations=3,
            residual=settings.tolerance / 2,
            curves={"size": Curve(np.abs(drawn))},
            consistency={"nees": Consistency(drawn**2, 1)},
            estimate=None if method == "kalman" else np.array([estimate, settings.tolerance]),
            trace=(lambda: drawn) if (settings.mode, method) == ("unpicklable", "first") else drawn,
        )

    def reference(self, settings, method, drawn):
        return np.array([{"mean": drawn.mean(), "first": drawn[0]}[method], 0.0])

    def plot(self, settings, drawn, outcomes):
        from matplotlib.figure import Figure

        figure = Figure()
        axes = figure.add_subplot()
        for label, outcome in outcomes.items():
            assert np.array_equal(outcome.trace, drawn)
            axes.plot(outcome.trace, label=label)
        return figure


class Other(Toy):
    name = "other"
    methods = ("mean",)

    class settings(pydantic.BaseModel):
        model_config = pydantic.ConfigDict(extra="forbid")
        steps: int = 3
        tolerance: float = 1e-6
        mode: Literal["calm"] = "calm"
        offset: float = 0.0
        fence: bool = False


class Swift:
    forms = ("quadratic",)
    warm_starts = True
    extra = None

    @classmethod
    def version(cls):
        return "1.2"


class Slow(Swift):
    forms = ("nonlinear", "graph")
    warm_starts = False


class Absent(Swift):
    extra = "magic"

    @classmethod
    def version(cls):
        from problems.errors import MissingExtraError

        raise MissingExtraError("solver absent", "magicsolver", "magic")


def hello(times: int = 1) -> None:
    """Say hello."""
    print("hello " * times)


toy, other = Toy(), Other()
'''

TOY_ENTRIES = """
[horizonet.scenarios]
toy = toy_scenarios:toy
other = toy_scenarios:other
[horizonet.solvers]
swift = toy_scenarios:Swift
slow = toy_scenarios:Slow
absent = toy_scenarios:Absent
[horizonet.commands]
hello = toy_scenarios:hello
broken = toy_scenarios_that_do_not_exist:nothing
"""


@pytest.fixture(scope="module")
def toy_package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A package of somebody else that registers scenarios, solvers and commands; worker processes see it too."""
    folder = tmp_path_factory.mktemp("toy_package")
    (folder / "toy_scenarios.py").write_text(TOY_MODULE)
    info = folder / "toy_scenarios-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-scenarios\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(TOY_ENTRIES)
    sys.path.append(str(folder))
    registry._entries.cache_clear()
    yield folder
    sys.path.remove(str(folder))
    sys.modules.pop("toy_scenarios", None)
    registry._entries.cache_clear()
