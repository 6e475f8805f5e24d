"""What the options of the distributed methods have in common: checks, and the named combinations of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, get_args, get_origin, get_type_hints

from problems.errors import SettingError, UnknownNameError


class MethodOptions:
    """Base of frozen dataclasses of options. An option annotated with names (a `Literal`) takes one of them.

    Raises:
        UnknownNameError: a name that is none of those of an option.
        SettingError: a number outside its range.

    Attributes:
        kind: what one of its methods is called, with its article.
        horizon: N >= 1 transitions.
        forget_after: a number of steps, or None.
    """

    kind: ClassVar[str]
    horizon: int
    forget_after: int | None

    def __post_init__(self) -> None:
        for name, choices in _choices(type(self)).items():
            value = getattr(self, name)
            if value not in choices:
                raise UnknownNameError(name, str(value), choices)
        if isinstance(self.horizon, bool) or int(self.horizon) != self.horizon or self.horizon < 1:
            raise SettingError(f"horizon: expected a whole number of transitions of at least 1, got {self.horizon!r}")
        if self.forget_after is not None and self.forget_after < 0:
            raise SettingError(f"forget_after: expected a number of steps or None, got {self.forget_after!r}")

    def as_dict(self) -> dict[str, Any]:
        """All options by name, as the scenarios print them."""
        assert is_dataclass(self)
        return asdict(self)

    @classmethod
    def of(cls, methods: Mapping[str, Self], method: str | Self, overrides: Mapping[str, Any]) -> Self:
        """The options a method stands for, with some of them replaced.

        Args:
            methods: options by name of the method.
            method: one of these names, or options to start from.
            overrides: options by name.

        Raises:
            UnknownNameError: no such method or option.
            SettingError: a value outside its range.
        """
        assert is_dataclass(cls)
        base: Any
        if isinstance(method, cls):
            base = method
        elif isinstance(method, str) and method in methods:
            base = methods[method]
        else:
            raise UnknownNameError(cls.kind.partition(" ")[2], str(method), methods)
        names = [entry.name for entry in fields(cls)]
        for name in overrides:
            if name not in names:
                raise UnknownNameError(f"option of {cls.kind}", name, names)
        return replace(base, **overrides)


@cache
def _choices(kind: type[MethodOptions]) -> Mapping[str, tuple[Any, ...]]:
    hints = get_type_hints(kind).items()
    return MappingProxyType({name: get_args(hint) for name, hint in hints if get_origin(hint) is Literal})
