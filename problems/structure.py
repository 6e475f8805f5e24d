"""Picture of a problem's structure: its factor graph and the sparsity of the normal equations.

Problems with few instances are drawn instance by instance; larger ones by variables and terms, with counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from problems.display import new_figure
from problems.forms.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from problems.problem import Problem

INSTANCES = 60  # nodes drawn one by one; beyond, one node stands for all instances of a variable or term
MARKS = {"cost": ("s", "#0072b2"), "equality": ("D", "#d55e00"), "inequality": ("^", "#009e73")}


def plot_structure(problem: Problem) -> Figure:
    """The factor graph and the sparsity of H + A'A, where H is the Hessian of the costs and A has the constraint rows.

    Args:
        problem: with at least one variable and one term.

    Returns:
        A figure with two panels.

    Raises:
        DefinitionError: nothing was stated yet.
    """
    from problems.errors import DefinitionError

    if not problem.unknowns or not problem.terms:
        raise DefinitionError(f"problem {problem.name!r} has no variables or no terms yet; there is nothing to draw")
    layout = Layout(problem)
    drawing = new_figure(figsize=(11, 5), layout="constrained")
    left, right = drawing.subplots(1, 2)
    _draw_graph(left, problem, layout)
    _draw_sparsity(right, problem, layout)
    drawing.suptitle(f"structure of {problem.name!r}")
    return drawing


def _edges(problem: Problem, layout: Layout) -> tuple[dict[Any, str], dict[Any, tuple[str, str]], set[Any]]:
    """Variable nodes with labels, term nodes with label and kind, and edges, at the level that can be drawn."""
    count = layout.block_dims.size + sum(entry.term.count for entry in layout.terms)
    names = list(problem.unknowns)
    owner = np.repeat(np.arange(len(names)), [problem.unknowns[name].count for name in names])
    if count <= INSTANCES:
        first = np.searchsorted(owner, owner)
        single = {name for name in names if problem.unknowns[name].count == 1}
        variables = {
            ("v", b): names[k] if names[k] in single else f"{names[k]}[{b - first[b]}]" for b, k in enumerate(owner)
        }
        terms = {
            ("t", e.term.name, k): (e.term.name if k == 0 else "", e.term.kind)
            for e in layout.terms
            for k in range(e.term.count)
        }
        edges = {
            (("t", entry.term.name, k), ("v", int(block)))
            for entry in layout.terms
            for k, blocks in enumerate(entry.blocks)
            for block in blocks
        }
        return variables, terms, edges
    variables = {("v", k): f"{name}\n×{problem.unknowns[name].count}" for k, name in enumerate(names)}
    terms = {("t", e.term.name): (f"{e.term.name} ×{e.term.count}", e.term.kind) for e in layout.terms}
    edges = {(("t", e.term.name), ("v", int(k))) for e in layout.terms for k in np.unique(owner[e.blocks])}
    return variables, terms, edges


def _draw_graph(axes: Axes, problem: Problem, layout: Layout) -> None:
    import networkx as nx

    variables, terms, edges = _edges(problem, layout)
    graph = nx.Graph()
    graph.add_nodes_from([*variables, *terms])
    graph.add_edges_from(sorted(edges, key=str))
    place = {node: (float(at[0]), float(at[1])) for node, at in nx.kamada_kawai_layout(graph).items()}
    for term, variable in edges:
        (x, y), (xx, yy) = place[term], place[variable]
        axes.plot([x, xx], [y, yy], color="#999999", linewidth=0.8, zorder=1)
    frame = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": "black", "linewidth": 0.8}
    for node, label in variables.items():
        axes.annotate(label, place[node], ha="center", va="center", fontsize=7, zorder=4, bbox=frame)
    for kind, (marker, colour) in MARKS.items():
        chosen = [node for node, (_, its) in terms.items() if its == kind]
        if chosen:
            at = np.array([place[node] for node in chosen])
            axes.scatter(*at.T, s=36, marker=marker, color=colour, zorder=3, label=kind)
        for node in chosen:
            if terms[node][0]:
                offset = {"xytext": (5, 5), "textcoords": "offset points"}
                axes.annotate(terms[node][0], place[node], **offset, fontsize=6.5, color=colour, zorder=4)
    axes.legend(loc="best", fontsize=8, framealpha=0.8)
    axes.margins(0.12)
    axes.set_axis_off()
    axes.set_title("factor graph: framed names are variables", fontsize=10)


def _draw_sparsity(axes: Axes, problem: Problem, layout: Layout) -> None:
    from matplotlib.ticker import MaxNLocator

    dims, start = layout.block_dims, layout.block_columns
    rows, cols = [], []
    for entry in layout.terms:
        for a in range(entry.blocks.shape[1]):
            for b in range(entry.blocks.shape[1]):
                rows.append(entry.blocks[:, a])
                cols.append(entry.blocks[:, b])
    pairs = np.unique(np.stack([np.concatenate(rows), np.concatenate(cols)]), axis=1)
    i, j = pairs
    # every pair of instances is a full block of tangent coordinates
    size = dims[i] * dims[j]
    inside = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
    width = np.repeat(dims[j], size)
    at = np.repeat(start[i], size) + inside // width, np.repeat(start[j], size) + inside % width
    unknowns = int(dims.sum())
    axes.plot(at[1], at[0], "s", markersize=max(0.3, min(6.0, 220 / unknowns)), color="#0072b2", markeredgewidth=0)
    edge = 0
    for name, variable in problem.unknowns.items():
        width_here = variable.count * variable.space.dim
        if edge:
            axes.axhline(edge - 0.5, color="#cccccc", linewidth=0.8)
            axes.axvline(edge - 0.5, color="#cccccc", linewidth=0.8)
        axes.annotate(
            name, (edge + width_here / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 4),
            textcoords="offset points", ha="center", fontsize=8,
        )  # fmt: skip
        edge += width_here
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlim=(-0.5, unknowns - 0.5), ylim=(unknowns - 0.5, -0.5), aspect="equal")
    nonzeros = at[0].size / unknowns**2
    axes.set_xlabel(f"{unknowns} unknowns, {nonzeros:.1%} of the entries of the normal equations", fontsize=9)
