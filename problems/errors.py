"""Every exception and warning of the project.

Each exception derives from `HorizonetError` and from the builtin it specializes, so callers can catch
either. Messages name what was given, what was expected and what to do.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class HorizonetError(Exception):
    """Base of all exceptions raised on purpose by this project."""


class DefinitionError(HorizonetError, ValueError):
    """A problem, model or network was stated in a way that has no meaning."""


class ShapeError(DefinitionError):
    """An array or expression has the wrong shape."""


class NoiseError(DefinitionError):
    """A noise model is not positive definite, not finite or not symmetric."""


class DataError(HorizonetError, ValueError):
    """A value given for data of a compiled problem cannot be used."""


class UnobservableError(HorizonetError, ValueError):
    """The costs do not determine the variables."""


class EmptyConstraintError(HorizonetError, ValueError):
    """A constraint set has no point at all."""


class UnstableError(HorizonetError, ValueError):
    """A gain leaves an error system that does not decay."""


class TopologyError(HorizonetError, ValueError):
    """A graph or a weight matrix on it does not meet what an algorithm needs."""


class FormError(HorizonetError, ValueError):
    """A problem cannot be lowered to the form, or the form cannot go to the solver, that was asked for."""


class NotAffineError(FormError):
    """A term of a quadratic program is not affine in the variables."""


class BackendError(HorizonetError, RuntimeError):
    """A solver backend broke its own promises in a way that leaves no result to report."""


class SettingError(HorizonetError, ValueError):
    """A setting has a value outside its range or of the wrong type."""


class UnknownNameError(HorizonetError, LookupError):
    """A name that nothing is registered under; the message offers the nearest ones."""

    def __init__(self, kind: str, name: str, valid: Iterable[str]) -> None:
        self.kind, self.name, self.valid = kind, name, sorted(valid)
        # what begins the same is meant even where the rest was left out
        near = [one for one in self.valid if one.startswith(name)] or difflib.get_close_matches(
            name, self.valid, n=3, cutoff=0.5
        )
        hint = f"did you mean {' or '.join(near)}?" if near else f"valid: {', '.join(self.valid) or 'none'}"
        super().__init__(f"unknown {kind} {name!r}; {hint}")


class MissingExtraError(HorizonetError, ImportError):
    """A package that only one backend or command needs is not installed."""

    def __init__(self, what: str, package: str, extra: str | None = None) -> None:
        self.what, self.package, self.extra = what, package, extra
        command = f'pip install "horizonet[{extra}]"' if extra else f"pip install {package}"
        super().__init__(f"{what} needs the package {package}, which is not installed; run: {command}")


class ReadError(HorizonetError, ValueError):
    """An input file or folder cannot be read; names file, line and what was expected."""

    def __init__(self, path: str | Path, line: int | None, expected: str, found: str | None = None) -> None:
        self.path, self.line, self.expected, self.found = Path(path), line, expected, found
        where = f"{path}:{line}" if line is not None else f"{path}"
        got = f"; found {found}" if found is not None else ""
        super().__init__(f"{where}: expected {expected}{got}")


class WriteError(HorizonetError, OSError):
    """An output file or folder cannot be written."""

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path, self.reason = Path(path), reason
        super().__init__(f"cannot write to {path}: {reason}")


class HorizonetWarning(UserWarning):
    """Base of all warnings of this project."""


class AccuracyWarning(HorizonetWarning):
    """A result may be less accurate than was asked for."""


class SlowPathWarning(HorizonetWarning):
    """A much slower way was taken because no fast one exists for what was stated."""


class ModelWarning(HorizonetWarning):
    """A model or network meets its requirements only in part."""
