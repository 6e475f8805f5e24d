"""The part of a report about one scenario: pictures and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, TypeVar

from problems.bench import compare, plots
from problems.bench.curves import OUTER, band, claims, representatives
from problems.bench.export import columns, command, number, percent, seconds
from problems.bench.html import Cell, Group, command_cell, marks, number_cell, picture, table, text_cell
from problems.bench.metrics import Difference, solved_share
from problems.bench.rows import Row
from problems.bench.scenario import DISTANCE, NO_SOLVER
from problems.bench.settings import as_text
from problems.bench.store import Results
from problems.bench.summary import TRADE_OFFS, Configuration, Summary
from problems.solvers.base import Status

RESULTS_SHOWN = 1000  # lines of all tables of results; every configuration is in the CSV and Markdown files
POINTS_SHOWN = 3000  # of all pictures
BANDS_SHOWN = 8  # in one picture
COMPARISONS_SHOWN = 200
EFFECTS_OPEN = 60  # lines

T = TypeVar("T")


class ScenarioSection:
    """The part of a report about one scenario.

    Args:
        prefix: of the names inside the page.
        name: of the scenario.
        summaries: its configurations.
        rows: of all configurations.
        results: everything.
        share: number of scenarios in the page, which share the space for points and lines.
    """

    def __init__(
        self,
        prefix: str,
        name: str,
        summaries: Sequence[Summary],
        rows: Mapping[Configuration, list[Row]],
        results: Results,
        share: int,
    ) -> None:
        self.prefix, self.name, self.summaries, self.results, self.share = prefix, name, summaries, results, share
        self.rows = {summary.configuration: rows[summary.configuration] for summary in summaries}
        self.facts = results.scenarios[name]
        self.settings, metrics = columns(summaries)
        main = [metric for metric in self.facts["metrics"] if metric in metrics]
        self.main = main[0] if main else None
        self.metrics = [*main, *(metric for metric in metrics if metric not in main)]

    def html(self) -> str:
        """Pictures and tables, the main ones first."""
        flat = [row for rows in self.rows.values() for row in rows]
        parts = [
            f'<h2 id="{self.prefix}">{escape(self.name)}</h2>',
            f'<p class="muted">{escape(self.facts["source"])}</p>',
            self._accuracies(),
            self._curves(),
            self._results(),
            self._consistency(),
            self._robustness(flat),
            *self._solvers(flat),
            self._differences(flat),
            self._effects(flat),
        ]
        return "\n".join(part for part in parts if part)

    def _accuracies(self) -> str:
        # where tolerances are swept, what they buy is the distance to the optimum: that curve comes first
        swept = DISTANCE in self.metrics and "tolerance" in self.settings
        drawn = [DISTANCE, *(m for m in self.metrics if m != DISTANCE)] if swept else self.metrics
        drawn = [metric for metric in drawn if any(s.metrics.get(metric) is not None for s in self.summaries)]
        most = max(1, POINTS_SHOWN // (self.share * (len(drawn) + 1)))
        time = plots.time_of(self.summaries)
        pictures = [self._accuracy(f"{self.prefix}m{k}", metric, time, most) for k, metric in enumerate(drawn)]
        if swept:
            pictures.insert(1, self._accuracy(f"{self.prefix}i", DISTANCE, plots.ITERATIONS, most))
        pictures = [each for each in pictures if each]
        open_ones = 3 if swept else 1
        shown = f"<h3>Accuracy</h3>{_pictures(pictures[:open_ones])}" if pictures else ""
        if pictures[open_ones:]:
            shown += f"<details><summary>The other metrics</summary>{_pictures(pictures[open_ones:])}</details>"
        return shown

    def _accuracy(self, prefix: str, metric: str, cost: plots.Cost, most: int) -> str:
        chosen = _sample(self.summaries, most)
        marked = plots.accuracy_against(chosen, metric, prefix, cost)
        if not marked.groups:
            return ""
        groups = [Group(marks(own[0]), [self._hover(each, metric, cost) for each in own]) for own in marked.groups]
        caption = (
            f"{metric} against {cost.name}. Bars are standard errors; lines join tolerances and iteration limits of one"
            f" method.{_of(len(chosen), len(self.summaries))}"
        )
        return picture(marked.figure, caption, prefix, groups)

    def _hover(self, summary: Summary, metric: str, cost: plots.Cost) -> str:
        value = number(summary.metrics.get(metric), summary.metrics_se.get(metric))
        lines = [summary.label, self._varied(summary), f"{metric} {value}"]
        lines += [f"{cost.name} {seconds(cost.of(summary))}"] if cost.unit else []
        lines.append(f"{number(summary.iterations)} iterations; {percent(solved_share(summary.status))} solved")
        return "\n".join(line for line in lines if line)

    def _varied(self, summary: Summary, without: Sequence[str] = ()) -> str:
        shown = [key for key in self.settings if key not in without]
        return ", ".join(f"{key}={as_text(summary.settings[key])}" for key in shown)

    def _curves(self) -> str:
        names = list(dict.fromkeys(name for rows in self.rows.values() for row in rows for name in row.curves))
        chosen = representatives(self.summaries)
        parts = []
        for place, name in enumerate(names):
            found = [(each, band(name, self.rows[each.configuration], each)) for each in chosen]
            drawn = [(each, curve) for each, curve in found if curve is not None]
            if not drawn:
                continue
            few = _sample(drawn, BANDS_SHOWN)
            squares = [
                next((c for c in claims(self.rows[each.configuration], each) if c.name == name), None)
                for each, _ in few
            ]
            claim = [item for item in squares if item is not None]
            several = len({each.solver for each, _ in few} - {NO_SOLVER}) > 1
            labels = [self._curve_label(each, several) for each, _ in few]
            prefix = f"{self.prefix}c{place}"
            marked = plots.bands(
                list(zip(labels, [curve for _, curve in few], strict=True)),
                name,
                prefix,
                claim if len(claim) == len(few) else (),
            )
            caption = f"{name}, mean over {few[0][1].trials} trials"
            if claim:
                caption += ", per degree of freedom; in the grey interval with 95 % where the covariance is right"
            else:
                caption += f" with the {OUTER[0]:.0f} to {OUTER[1]:.0f} % percentiles"
            caption += ". Each method by its first solver"
            caption += " at the tightest tolerance" if "tolerance" in self.settings else ""
            caption += f".{_of(len(few), len(drawn), '')}"
            parts.append(picture(marked.figure, caption, prefix, [Group(marks(each)) for each, _ in few]))
        return f"<h3>Through a trial</h3>{_pictures(parts)}" if parts else ""

    def _curve_label(self, summary: Summary, solver: bool) -> str:
        varied_here = self._varied(summary, TRADE_OFFS)
        return " ".join(part for part in (summary.label if solver else summary.method, varied_here) if part)

    def _results(self) -> str:
        head = ["method", "solver", *self.settings, *self.metrics]
        head += ["step (median)", "step (p95)", "step (max)", "update", "solve", "setup", "compile", "wall", "cpu"]
        head += ["memory", "solved", "iterations", "residual", "failed", "reproduce"]
        chosen = _sample(self.summaries, max(1, RESULTS_SHOWN // self.share))
        body = [({"class": "result"} | marks(summary), self._cells(summary)) for summary in chosen]
        caption = f"Results of {self.name}"
        note = _of(len(chosen), len(self.summaries))
        return "<h3>Results</h3>" + table(caption, head, body, f"{note} A click on a head sorts.".strip())

    def _cells(self, summary: Summary) -> list[Cell]:
        cells = [text_cell(summary.method), text_cell(summary.solver)]
        cells += [_setting(summary.settings.get(key)) for key in self.settings]
        for metric in self.metrics:
            value = summary.metrics.get(metric)
            cells.append(number_cell(number(value, summary.metrics_se.get(metric)), value))
        times = [summary.time["step_median"], summary.time["step_p95"], summary.step_max]
        times += [summary.time[key] for key in ("update", "solve", "setup", "compile")] + [summary.wall, summary.cpu]
        cells += [number_cell(seconds(value), value) for value in times]
        share, memory = solved_share(summary.status), summary.memory
        failed = f"{summary.failed}/{summary.trials}" if not summary.impossible else "impossible"
        return [
            *cells,
            number_cell("–" if memory is None else f"{memory / 2**20:.1f} MiB", memory),
            number_cell(percent(share), share),
            number_cell(number(summary.iterations), summary.iterations),
            number_cell("–" if summary.residual is None else f"{summary.residual:.1e}", summary.residual),
            number_cell(failed, summary.failed / summary.trials),
            command_cell(command(summary, self.results.scenarios)),
        ]

    def _consistency(self) -> str:
        body = []
        for summary in _sample(representatives(self.summaries), COMPARISONS_SHOWN):
            for claim in claims(self.rows[summary.configuration], summary):
                cells = [text_cell(summary.method), text_cell(summary.solver), text_cell(claim.name)]
                cells += [_setting(summary.settings.get(key)) for key in self.settings]
                cells += [
                    number_cell(number(claim.mean, claim.error), claim.mean),
                    number_cell(percent(claim.inside), claim.inside),
                    text_cell(f"[{number(claim.lower)}, {number(claim.upper)}]"),
                    number_cell(percent(claim.steps_inside), claim.steps_inside),
                    number_cell(str(claim.degrees), claim.degrees),
                    number_cell(str(claim.trials), claim.trials),
                ]
                body.append((marks(summary), cells))
        if not body:
            return ""
        caption = f"Consistency in {self.name}"
        note = (
            "Squared errors in units of the covariance that was claimed for them. Where it is right, their mean per"
            " degree of freedom is 1 (larger: the estimator believes itself too much), 95 % of them lie in the"
            " chi-square interval of one error, and the mean of the trials lies in the interval given here at 95 %"
            " of the steps. Each method by its first solver at the tightest tolerance."
        )
        head = ["method", "solver", "error", *self.settings, "mean", "inside", "interval of the mean", "steps inside"]
        return "<h3>Consistency</h3>" + table(caption, [*head, "degrees", "trials"], body, note)

    def _robustness(self, rows: Sequence[Row]) -> str:
        body = []
        for item in compare.robustness(rows):
            steps = sum(item.status.values())
            cells = [text_cell(item.method), text_cell(item.solver)]
            cells += [number_cell(str(n), n) for n in (item.trials, item.failed, item.impossible, steps)]
            share = solved_share(item.status)
            cells.append(number_cell(percent(share), share))
            counts = [item.status.get(status.value, 0) for status in Status if status is not Status.SOLVED]
            cells += [number_cell(str(count), count) for count in counts]
            cells.append(number_cell(percent(item.infeasible_handled), item.infeasible_handled))
            body.append(({"data-method": item.method, "data-solver": item.solver}, cells))
        head = ["method", "solver", "trials", "failed trials", "impossible", "steps", "solved"]
        head += [status.value.replace("_", " ") for status in Status if status not in (Status.SOLVED, Status.FAILED)]
        head.append("failed steps")
        note = (
            "Steps by status over all settings. An infeasible step is handled when the estimator went on after it and"
            " the trial finished."
        )
        caption = f"Robustness in {self.name}"
        return "<h3>Robustness</h3>" + table(caption, [*head, "infeasible handled"], body, note)

    def _solvers(self, rows: Sequence[Row]) -> list[str]:
        limit, parts = self.results.plan["time_limit"], []
        for place, contest in enumerate(compare.contests(rows)):
            times = contest.means(limit)
            body = [
                (
                    {"data-solver": item.solver},
                    [
                        text_cell(item.solver),
                        number_cell(seconds(item.geometric_mean), item.geometric_mean),
                        number_cell(f"{item.geometric_mean / times[0].geometric_mean:.3g}", item.geometric_mean),
                        number_cell(f"{item.failed}/{item.trials}", item.failed / item.trials),
                    ],
                )
                for item in times
            ]
            note = (
                f"Shifted geometric mean (shift {seconds(compare.SHIFT)}) of the solve time of a trial, over the same"
                " trials for all. A trial without result, or with more than"
                f" {percent(compare.UNSOLVED_SHARE)} of its steps neither solved nor found infeasible, failed and"
                f" counts as {seconds(limit)}."
            )
            head = ["solver", "geometric mean", "ratio to the fastest", "failed"]
            parts.append(f"<h3>Solvers on {escape(contest.label)}</h3>")
            parts.append(table(f"Solvers of {self.name} on {contest.label}", head, body, note))
            profiles, prefix = contest.profile(), f"{self.prefix}p{place}"
            caption = (
                f"Performance profile on {contest.label}: share of the trials each solver finished within a factor of"
                " the fastest one (failed trials never)."
            )
            groups = [Group({"data-solver": solver}) for solver in profiles]
            parts.append(picture(plots.profile(profiles, prefix), caption, prefix, groups))
        return parts

    def _differences(self, rows: Sequence[Row]) -> str:
        if self.main is None:
            return ""
        pairs = [
            *compare.method_differences(rows, self.main, self.facts["methods"]),
            *compare.solver_differences(rows, self.main),
        ]
        if not pairs:
            return ""
        body = []
        for pair in _sample(pairs, COMPARISONS_SHOWN):
            difference = pair.difference
            cells = [text_cell(pair.what), text_cell(pair.baseline), text_cell(pair.fixed.replace(NO_SOLVER, "–"))]
            cells += [_setting(pair.settings.get(key)) for key in self.settings]
            cells += [
                number_cell(number(difference.mean), difference.mean),
                text_cell(f"[{number(difference.lower)}, {number(difference.upper)}]"),
                text_cell("yes" if difference.significant else "no"),
                number_cell(str(difference.pairs), difference.pairs),
            ]
            body.append(({}, cells))
        note = (
            f"How much larger {self.main} is, trial by trial, with 95 % confidence intervals (Student's t)."
            f"{_of(min(len(pairs), COMPARISONS_SHOWN), len(pairs), '')}"
        )
        head = ["compared", "with", "both with", *self.settings, "mean difference", "interval", "differs", "pairs"]
        inner = table(f"Differences of {self.main} in {self.name}", head, body, note)
        return f"<details><summary>Paired differences of {escape(self.main)}</summary>{inner}</details>"

    def _effects(self, rows: Sequence[Row]) -> str:
        looked_at = [key for key in self.settings if key not in TRADE_OFFS]
        effects = compare.setting_differences(rows, self.main, looked_at) if self.main and looked_at else []
        if not effects:
            return ""
        body = []
        for effect in _sample(effects, COMPARISONS_SHOWN):
            cells = [text_cell(f"{effect.setting} = {as_text(effect.value)}"), text_cell(as_text(effect.baseline))]
            cells += [text_cell(effect.method), text_cell(effect.solver)]
            own = {effect.setting: "–"}
            cells += [_setting((effect.settings | own).get(key)) for key in self.settings]
            cells += [
                _difference(effect.metric, number),
                _difference(effect.time, seconds),
                _difference(effect.iterations, number),
            ]
            body.append(({"data-method": effect.method, "data-solver": effect.solver}, cells))
        note = (
            "How much larger the error, the solve time and the iterations of a trial are with one value of a setting"
            " than with another, everything else equal; 95 % confidence intervals (Student's t). An interval"
            f" that leaves out zero is marked with *.{_of(min(len(effects), COMPARISONS_SHOWN), len(effects), '')}"
        )
        head = ["compared", "with", "method", "solver", *self.settings, self.main or "", "solve time", "iterations"]
        inner = table(f"Effects of settings in {self.name}", head, body, note)
        opened = " open" if len(body) <= EFFECTS_OPEN else ""
        return f"<details{opened}><summary>Paired differences by setting</summary>{inner}</details>"


def _difference(difference: Difference | None, shown: Callable[[float], str]) -> Cell:
    if difference is None:
        return number_cell("–", None)
    ends = f"[{shown(difference.lower)}, {shown(difference.upper)}]"
    return number_cell(f"{shown(difference.mean)} {ends}{' *' if difference.significant else ''}", difference.mean)


def _setting(value: Any) -> Cell:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number_cell(as_text(value), float(value)) if is_number else text_cell(as_text(value))


def _sample(items: Sequence[T], most: int) -> list[T]:
    """At most this many, evenly from all."""
    if len(items) <= most:
        return list(items)
    return [items[number * len(items) // most] for number in range(most)]


def _of(shown: int, total: int, rest: str = "; the CSV has all") -> str:
    return f" {shown} of {total} are shown, evenly chosen{rest}." if shown < total else ""


def _pictures(pictures: Sequence[str]) -> str:
    return f'<div class="pictures">{"".join(pictures)}</div>'
