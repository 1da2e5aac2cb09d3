"""The commands: their names, and the page that lists them.

Takes: words of a command line. Gives: `apc`, which finds the command they name.
Guarantees: a command's module is loaded when that command is named, or all are listed.
Does not: compute, or decide exit codes (see `__main__`).
"""

from __future__ import annotations

import click

from apc import cli
from apc.cli.options import echo
from apc.renamed import COMMANDS

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 80}
SUFFIX = "_command"  # of the functions that `apc.cli` names

# The commands as they are listed: in the order of work.
LISTED = [
    "new",
    "check",
    "compile",
    "analyze",
    "critical",
    "region",
    "tune",
    "sweep",
    "compare",
    "transparency",
    "simulate",
    "explore",
    "network",
    "run",
    "report",
    "export",
    "show",
    "library",
    "schema",
    "bench",
]


def _print_version(context: click.Context, _: click.Parameter, requested: bool) -> None:
    if requested:
        from apc.distribution import program_version

        echo(f"apc {program_version()}")
        context.exit()


class CommandGroup(click.Group):
    """The group of all commands, listed in the order of work."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return LISTED

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a name, whose module is loaded now; None if there is none.

        Raises click.UsageError for a former name.
        """
        if cmd_name in COMMANDS:
            raise click.UsageError(f"apc {cmd_name} is named apc {COMMANDS[cmd_name]} now.", ctx)
        command: click.Command | None = getattr(cli, f"{cmd_name}{SUFFIX}", None)
        return command


@click.group(cls=CommandGroup, context_settings=CONTEXT)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the version.",
)
def apc() -> None:
    """Is a shared virtual object stable in the hands of all its users?

    Describe users, masses, couplers and network links in a YAML file, a
    topology; `apc new` writes one to start from.

    Without FILE a command takes the only topology of the folder.
    """
