"""What objects show of themselves in Jupyter and in a terminal, and the picture of a problem's structure."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from localization import measurements as meas
from mhe import mhe
from problems import SE2, Gaussian, Huber, LinearModel, Problem, Sensor, Vector
from problems.bench.scenario import Outcome
from problems.display import LONGEST, Table
from problems.errors import DefinitionError
from problems.forms.factor_graph import FactorGraph
from problems.forms.nonlinear import NonlinearProgram
from problems.forms.quadratic import QuadraticProgram
from problems.networks import Network


class _Cells(HTMLParser):
    """Texts of the cells of a table; fails on tags that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def small() -> Problem:
    problem = Problem("a <small> one")
    x = problem.variables("x", Vector(2), 3)
    z = problem.data("z", 2, 3, value=np.ones((3, 2)))
    problem.cost("near", lambda x, z: x - z, on=x, data=z, noise=Gaussian(sigma=0.5))
    problem.cost("step", lambda a, b: b - a, on=(x[:-1], x[1:]))
    return problem


def test_table_escapes_and_shortens() -> None:
    table = Table("a & b", ("name", "value"), [("<x>", k / 3) for k in range(LONGEST + 5)])
    cells = _Cells(table._repr_html_()).texts
    assert cells[0] == "a & b" and "<x>" in cells and "and 5 more" in cells
    lines = str(table).splitlines()
    assert lines[0] == "a & b" and len(lines) == 2 + LONGEST + 1
    assert lines[3].split() == ["<x>", "0.333333"]


def test_problem_and_its_forms() -> None:
    problem = small()
    cells = _Cells(problem._repr_html_()).texts
    assert "Problem 'a <small> one'" in cells
    assert {"near", "step", "variables", "x", "z", "cost"} <= set(cells)
    quadratic = _Cells(QuadraticProgram(problem)._repr_html_()).texts
    assert "vector" in quadratic and "q" in quadratic
    problem.inequality("fence", lambda x: x[0], on=problem.unknowns["x"])
    assert {"fence", "3"} <= set(_Cells(NonlinearProgram(problem)._repr_html_()).texts)
    graph = Problem("graph")
    fix = graph.data("fix", 2, 2)
    graph.cost("odd", meas.position, on=graph.variables("T", SE2, 2), data=fix, loss=Huber(1.0))
    assert {"odd", "2"} <= set(_Cells(FactorGraph(graph)._repr_html_()).texts)


def test_solution_network_estimate() -> None:
    solution = small().compile().solve()
    cells = _Cells(solution._repr_html_()).texts
    assert cells[0].startswith("Solution: solved by linear") and "x" in cells
    ring = Network.from_edges([("a", "b"), ("b", "c"), ("c", "a")], ["a", "b", "c"])
    cells = _Cells(ring._repr_html_()).texts
    assert cells[cells.index("b") + 1] in ("a, b", "b, a")
    model = LinearModel([[1.0]], [[0.1]], sensors=[Sensor("s", [[1.0]], sigma=1.0)], covariance=[[1.0]])
    estimator = mhe(model, 3)
    estimator.step([1.0])
    estimate = estimator.step([np.nan])
    text = repr(estimate)
    assert text.startswith("WindowEstimate at ") and "1 missing" in text
    sigma = float(text.splitlines()[-1].split()[-1])
    assert sigma == pytest.approx(np.sqrt(estimate.covariance[0, 0]), rel=1e-5)
    assert model.state_names[0] in _Cells(estimate._repr_html_()).texts


@pytest.mark.parametrize("count", [4, 100])
def test_structure(count: int) -> None:
    problem = Problem("chain")
    pose = problem.variables("pose", SE2, count)
    mark = problem.variables("mark", Vector(2), 2)
    problem.cost("odometry", lambda a, b: b.translation - a.translation, on=(pose[:-1], pose[1:]))
    problem.cost("sight", lambda a, m: a.translation - m, on=(pose[[0, -1]], mark))
    problem.equality("fixed", lambda a: a.angle, on=pose[0])
    figure = problem.plot_structure()
    graph, sparsity = figure.axes
    texts = {text.get_text() for text in graph.texts}
    assert ("pose[0]" in texts) == (count == 4) and (f"pose\n×{count}" in texts) == (count == 100)
    shown = re.match(r"(\d+) unknowns, ([\d.]+)%", sparsity.get_xlabel())
    assert shown
    # 3x3 blocks of the chain, 3x2 of the sights twice, 2x2 of the marks
    entries = 9 * (count + 2 * (count - 1)) + 2 * 2 * 6 + 2 * 4
    size = 3 * count + 4
    assert int(shown[1]) == size and float(shown[2]) == pytest.approx(100 * entries / size**2, abs=0.051)
    assert sparsity.lines[0].get_xdata().size == entries


def test_nothing_to_draw() -> None:
    with pytest.raises(DefinitionError, match="nothing to draw"):
        Problem("empty").plot_structure()


def test_outcome() -> None:
    outcome = Outcome({"rmse": 0.25, "never": None}, times={"solve": 0.5}, step_seconds=np.array([1.0, 3.0, 2.0]))
    outcome.status.update(solved=3, failed=0)
    cells = _Cells(outcome._repr_html_()).texts
    assert cells[cells.index("rmse") + 1] == "0.25" and cells[cells.index("steps solved") + 1] == "3"
    assert "steps failed" not in cells and cells[cells.index("median step (s)") + 1] == "2"
    assert repr(outcome).splitlines()[0] == "Outcome of one trial"
