"""The command `horizonet`: its own commands and those of the entry-point group ``horizonet.commands``.

A registered command is a plain function with typer annotations; it becomes the command of its registered name. Its
module is imported when the command is used or its help line is shown, so it should import what is heavy inside the
function. A `HorizonetError` ends any command with its message on standard error and exit code 2.
"""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from problems import registry
from problems.cli.bench import bench
from problems.cli.demo import demo
from problems.cli.report import report
from problems.cli.run import run as run_scenario
from problems.cli.scenarios import scenarios
from problems.cli.solvers import solvers
from problems.errors import HorizonetError


class Commands(TyperGroup):
    """Own commands in the order of the work, then the registered ones."""

    def list_commands(self, ctx: Any) -> list[str]:
        own = super().list_commands(ctx)
        return [*own, *(name for name in registry.names("commands") if name not in own)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        own = super().get_command(ctx, cmd_name)
        if own is not None or cmd_name not in registry.names("commands"):
            return own
        try:
            function = registry.load("commands", cmd_name)
        except Exception as error:  # somebody else's command must not break the help of ours
            function = _broken(cmd_name, error)
        single = typer.Typer(add_completion=False)
        single.command(cmd_name)(function)
        return typer.main.get_command(single)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().main(*args, **kwargs)
        except HorizonetError as error:
            typer.echo(f"horizonet: {error}", err=True)
            sys.exit(2)


def _broken(name: str, error: Exception) -> Any:
    def command() -> None:
        raise error

    command.__doc__ = f"Cannot be loaded: {error}"
    command.__name__ = name
    return command


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("horizonet"))
        raise typer.Exit


app = typer.Typer(
    cls=Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich"
)


@app.callback()
def _horizonet(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """State estimation by optimization: moving horizon estimation, team localization, and their solvers compared."""


for _name, _function in {
    "demo": demo,
    "scenarios": scenarios,
    "solvers": solvers,
    "run": run_scenario,
    "bench": bench,
    "report": report,
}.items():
    app.command(_name)(_function)


def run() -> None:
    """Entry point of the installed command."""
    app(prog_name="horizonet")
