"""A plan: which scenarios, methods, solvers and settings are compared, over which trials."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

import pydantic

from problems import registry
from problems.bench.rows import Job
from problems.bench.scenario import NO_SOLVER, Scenario, takes_method, takes_solver
from problems.bench.settings import complete, convert
from problems.errors import ReadError, SettingError, UnknownNameError

AUTO = "auto"


class Study(pydantic.BaseModel):
    """One scenario with everything that is varied in it.

    Attributes:
        scenario: registered name.
        methods: the scenario's methods to run; none given means all.
        solvers: solver names; each method that takes a solver runs with each of them.
        settings: value by name; a list of values is a sweep, so a value that is a list stands in a list.
        trials: at most this many of the plan's trials, for a scenario that takes long.
    """

    model_config = pydantic.ConfigDict(extra="forbid")

    scenario: str
    methods: tuple[str, ...] = ()
    solvers: tuple[str, ...] = (AUTO,)
    settings: dict[str, Any] = {}
    trials: int | None = pydantic.Field(default=None, ge=1)

    def combinations(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Each (method, solver, complete settings) of the study.

        Raises:
            UnknownNameError: a scenario, method, solver or setting that does not exist.
            SettingError: a setting that cannot take its value.
            MissingExtraError: a solver whose package is not installed.
        """
        scenario: Scenario = registry.load("scenarios", self.scenario)
        for method in self.methods:
            if not takes_method(scenario, method):
                raise UnknownNameError(f"method of {self.scenario}", method, scenario.methods)
        for solver in self.solvers:
            check_solver(solver)
        sweeps = {key: values if isinstance(values, list) else [values] for key, values in self.settings.items()}
        for values in product(*sweeps.values()):
            settings = complete(scenario, dict(zip(sweeps, values, strict=True)))
            for method in self.methods or scenario.methods:
                for solver in self.solvers if takes_solver(scenario, method) else (NO_SOLVER,):
                    yield method, solver, settings


class Plan(pydantic.BaseModel):
    """Studies and the trials they are run over.

    Attributes:
        name: heading of the report.
        text: how to read the results, printed by the report; paragraphs are separated by empty lines.
        seed: one number from which the noise of every trial follows.
        trials: repetitions with fresh noise; trial k is the same in every plan with the same seed.
        time_limit: seconds for one trial of one method; a longer one is stopped and counts as failed.
        study: what is compared.
    """

    model_config = pydantic.ConfigDict(extra="forbid")

    name: str = "benchmark"
    text: str = ""
    seed: int = pydantic.Field(default=0, ge=0)
    trials: int = pydantic.Field(default=10, ge=1)
    time_limit: float = pydantic.Field(default=3600.0, gt=0)
    study: tuple[Study, ...] = pydantic.Field(min_length=1)

    def jobs(self) -> list[Job]:
        """Everything to run, once each, trial by trial: an interrupted campaign has whole trials to compare."""
        found: dict[str, Job] = {}
        combinations = [(study, *found) for study in self.study for found in study.combinations()]
        for trial in range(self.trials):
            for study, method, solver, settings in combinations:
                if study.trials is not None and trial >= study.trials:
                    continue
                job = Job(study.scenario, method, solver, settings, self.seed, trial)
                found.setdefault(job.key, job)
        return list(found.values())


def check_solver(name: str) -> None:
    """Raise unless the solver exists and its package is installed.

    Raises:
        UnknownNameError: no such solver.
        MissingExtraError: its package is not installed.
        SettingError: it takes a further name after a colon, and none is given.
    """
    from problems.solvers.compile import ALIASES, load_solver

    if name == AUTO:
        return
    registered = ALIASES.get(name, name)
    if registered.partition(":")[0] not in registry.names("solvers"):
        raise UnknownNameError("solver", name, [AUTO, *ALIASES, *registry.names("solvers")])
    load_solver(registered).version()


def plan_of_names(
    scenarios: Sequence[str],
    methods: Sequence[str],
    solvers: Sequence[str],
    settings: Mapping[str, Sequence[Any]],
    **options: Any,
) -> Plan:
    """The plan of a command line that names several scenarios at once.

    A method or setting goes to the scenarios that have it and must be known to at least one of them.

    Args:
        scenarios: registered names.
        methods: methods to run; none means all of each scenario.
        solvers: solver names; none means `auto`.
        settings: values to sweep by setting name.
        options: fields of `Plan`.

    Raises:
        UnknownNameError: a name that none of the scenarios knows, or a scenario without any of the methods.
    """
    loaded: list[Scenario] = [registry.load("scenarios", name) for name in scenarios]
    where = " or ".join(scenarios)
    for method in methods:
        if not any(takes_method(scenario, method) for scenario in loaded):
            raise UnknownNameError(f"method of {where}", method, {name for one in loaded for name in one.methods})
    for key in settings:
        if not any(key in scenario.settings.model_fields for scenario in loaded):
            known = {name for scenario in loaded for name in scenario.settings.model_fields}
            raise UnknownNameError(f"setting of {where}", key, known)
    studies = []
    for scenario in loaded:
        chosen = tuple(method for method in methods if takes_method(scenario, method))
        if methods and not chosen:
            raise UnknownNameError(f"method of {scenario.name}", methods[0], scenario.methods)
        known = {key: list(values) for key, values in settings.items() if key in scenario.settings.model_fields}
        studies.append(Study(scenario=scenario.name, methods=chosen, solvers=tuple(solvers) or (AUTO,), settings=known))
    return Plan(study=tuple(studies), **options)


def built_in_plans() -> list[str]:
    """Names of the plans that come with the package."""
    folder = resources.files("problems.bench") / "plans"
    return sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))


def built_in_plan(name: str) -> Plan:
    """A plan that comes with the package, by name."""
    if name not in built_in_plans():
        raise UnknownNameError("plan", name, built_in_plans())
    return parse_plan((resources.files("problems.bench") / "plans" / f"{name}.toml").read_text(), f"{name}.toml")


def read_plan(path: str | Path) -> Plan:
    """A plan from a TOML file.

    Raises:
        ReadError: file and line of what is wrong, with the nearest valid names.
        MissingExtraError: a solver whose package is not installed.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(path, None, "a plan in TOML", str(error)) from error
    return parse_plan(text, path)


def parse_plan(text: str, path: str | Path) -> Plan:
    """As `read_plan`, from the text itself; `path` only names it in messages."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"line (\d+)", str(error))
        raise ReadError(path, int(place[1]) if place else None, "TOML", str(error)) from error
    try:
        plan = Plan.model_validate(content)
    except pydantic.ValidationError as error:
        raise _misstated(error, text, path) from error
    for number, study in enumerate(plan.study):
        try:
            scenario: Scenario = registry.load("scenarios", study.scenario)
            for key, values in study.settings.items():
                for value in values if isinstance(values, list) else [values]:
                    try:
                        convert(scenario, key, value)
                    except SettingError as error:
                        raise ReadError(path, line_of(text, key, number), "a valid setting", str(error)) from error
            for _ in study.combinations():
                pass
        except UnknownNameError as error:
            hint = str(error).partition("; ")[2]
            line = line_of(text, error.name, number)
            raise ReadError(path, line, f"a {error.kind} ({hint})", repr(error.name)) from error
        except SettingError as error:
            raise ReadError(
                path, line_of(text, "settings", number), "settings that fit together", str(error)
            ) from error
    return plan


def _misstated(error: pydantic.ValidationError, text: str, path: str | Path) -> ReadError:
    first = error.errors()[0]
    names = [str(part) for part in first["loc"] if isinstance(part, str)]
    number = next((part for part in first["loc"] if isinstance(part, int)), None)
    name = names[-1] if names else ""
    line = line_of(text, name, number)
    if first["type"] == "extra_forbidden":
        fields = list(Study.model_fields if number is not None else Plan.model_fields)
        near = difflib.get_close_matches(name, fields, n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"valid: {', '.join(fields)}"
        return ReadError(path, line, f"a key of {'[[study]]' if number is not None else 'a plan'} ({hint})", repr(name))
    return ReadError(path, line, f"a valid {'.'.join(names)}", f"{first['msg']} (given {first['input']!r:.80})")


def line_of(text: str, token: str, study: int | None) -> int | None:
    """The line of a TOML plan where `token` stands as key, table or quoted value.

    Args:
        text: the file.
        token: what to look for.
        study: only inside the study of this number, or None for what stands outside of studies.

    Returns:
        Line number from 1; None when the token is not written out.
    """
    word = re.escape(token)
    wanted = re.compile(rf"""(^|[\s{{,.\["'])["']?{word}["']?\s*(=|\.)|["']{word}["']|^\s*\[+[^\]]*\b{word}\]""")
    current, fallback = None, None
    for number, line in enumerate(text.splitlines(), start=1):
        if re.match(r"\s*\[\[\s*study\s*\]\]", line):
            current = 0 if current is None else current + 1
        if wanted.search(line.partition("#")[0]):
            if current == study:
                return number
            fallback = fallback or number
    return fallback
