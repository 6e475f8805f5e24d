"""From a problem and a solver's name to a session.

What is registered in ``horizonet.solvers`` is either a QP backend (`QPBackend`) or a class with ``forms``, the forms it
takes, and ``compile(problem, form, options) -> Session``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from problems import registry
from problems.errors import DefinitionError, FormError, SettingError, UnknownNameError
from problems.forms.affine import require_affine
from problems.forms.quadratic import QuadraticProgram
from problems.problem import Problem
from problems.solvers.base import Options
from problems.solvers.qp_code import CodeSession
from problems.solvers.qp_empty import require_nonempty
from problems.solvers.qp_session import QPSession
from problems.solvers.qp_support import Backend, checked_settings
from problems.solvers.session import Session

FEW = 50  # unknowns that elimination leaves, up to which dual active sets answer sooner however many rows there are
ALIASES = {"gtsam": "gtsam-lm"}
FORMS = ("quadratic", "nonlinear", "graph")
ASSEMBLIES = {"maps": QPSession, "code": CodeSession}


def compile_problem(
    problem: Problem, solver: str, form: str | None, eliminate: Sequence[Any], settings: Mapping[str, Any]
) -> Session:
    """See `Problem.compile`."""
    start = time.perf_counter()
    if not problem.unknowns:
        raise DefinitionError(f"problem {problem.name!r} has no variables")
    if not any(term.kind == "cost" for term in problem.terms.values()):
        raise DefinitionError(f"problem {problem.name!r} has no cost; nothing would determine its variables")
    if form is not None and form not in FORMS:
        raise FormError(f"no form {form!r}; forms: {', '.join(FORMS)}")
    eliminate = tuple(eliminate) if isinstance(eliminate, (tuple, list)) else (eliminate,)
    session = _session(problem, ALIASES.get(solver, solver), form, eliminate, dict(settings))
    session.compile_seconds = time.perf_counter() - start
    return session


def load_solver(solver: str) -> Any:
    """What is registered under a solver's name, for the name after the colon where there is one.

    Raises:
        UnknownNameError: no such solver, or one that takes no further name.
        SettingError: a solver that takes one, without it.
    """
    name, _, inner = solver.partition(":")
    entry = registry.load("solvers", name)
    # what takes a name after the colon is a function, or a class that says so
    if getattr(entry, "named", not isinstance(entry, type)):
        return entry(inner)
    if inner:
        raise UnknownNameError("solver", solver, registry.names("solvers"))
    return entry


def _session(
    problem: Problem, solver: str, form: str | None, eliminate: Sequence[Any], settings: dict[str, Any]
) -> Session:
    auto = solver == "auto"
    if auto and (form == "quadratic" or (form is None and is_affine(problem))):
        return _quadratic(problem, solver, None, eliminate, settings)
    entry = load_solver("gauss-newton" if auto else solver)
    forms = getattr(entry, "forms", ("quadratic",))
    chosen = form or forms[0]
    if chosen not in forms:
        raise FormError(f"solver {solver!r} takes the form {' or '.join(forms)}, not {chosen!r}")
    if chosen == "quadratic":
        return _quadratic(problem, solver, entry, eliminate, settings)
    if eliminate:
        raise FormError(f"eliminate condenses quadratic programs; solver {solver!r} takes the {chosen} form as it is")
    return entry.compile(problem, chosen, options_of(settings))


def _quadratic(
    problem: Problem, solver: str, backend: Any, eliminate: Sequence[Any], settings: dict[str, Any]
) -> QPSession:
    try:
        require_affine(problem)
    except FormError as error:
        if solver == "auto":
            raise
        raise FormError(f"solver {solver!r} takes quadratic programs only: {error}") from error
    program = QuadraticProgram(problem, eliminate)
    require_nonempty(program)
    screen = bool(settings.pop("screen", backend is None))
    assembly = settings.pop("assembly", "maps")
    if assembly not in ASSEMBLIES:
        raise UnknownNameError("assembly", str(assembly), ASSEMBLIES)
    warm = bool(settings.pop("warm", True))
    if backend is None:
        few = program.dense or program.remaining <= FEW or assembly == "code"
        backend = registry.load("solvers", "daqp" if few else "proxqp")
    options = options_of(settings)
    if issubclass(backend, Backend):  # a screened session may need its backend late or never
        checked_settings(backend.settings_type, options.extra, backend.name)
    return ASSEMBLIES[assembly](program, solver, backend, options, screen, warm)


def is_affine(problem: Problem) -> bool:
    """Can the problem be a quadratic program?"""
    try:
        require_affine(problem)
    except FormError:
        return False
    return True


def options_of(settings: Mapping[str, Any]) -> Options:
    """Settings as `Options`; what is not common to all solvers is the solver's own. Raises SettingError."""
    common: dict[str, Any] = {k: settings[k] for k in ("tolerance", "time_limit", "iteration_limit") if k in settings}
    for name, value in common.items():
        if value is None and name == "iteration_limit":
            continue
        number: Any = value if isinstance(value, (int, float, np.number)) and not isinstance(value, bool) else 0
        if not number > 0:
            raise SettingError(f"{name} must be a positive number, got {value!r}")
    return Options(**common, extra={k: v for k, v in settings.items() if k not in common})
