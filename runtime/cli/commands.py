"""The command group `apc`: names and sections of all commands.

Takes: words of a command line. Gives: `apc`, the group of all commands.
Guarantees: a command's module is loaded when the command is used or listed.
Does not: compute, or decide exit codes (see `__main__`).
"""

from __future__ import annotations

import click

from apc import cli
from apc.cli.options import echo
from apc.compiler.errors import nearest
from apc.support.renamed import FORMER_COMMANDS

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 80}
SUFFIX = "_command"  # of the functions that `apc.cli` names

# The commands in the order of work, by section of the help.
SECTIONS = {
    "Start": ("new", "library", "check", "compile", "show", "schema"),
    "Analyze": ("analyze", "critical", "region", "sweep", "transparency", "compare"),
    "Design": ("tune", "explore"),
    "Simulate": ("simulate", "run", "fit"),
    "Network": ("network",),
    "Export": ("export", "report"),
    "Benchmark": ("bench",),
}


def _print_version(context: click.Context, _: click.Parameter, requested: bool) -> None:
    if requested:
        from apc.support.distribution import program_version

        echo(f"apc {program_version()}")
        context.exit()


class CommandGroup(click.Group):
    """The group of all commands, listed in the order of work."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return [name for names in SECTIONS.values() for name in names]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands with their short help, one section for each step of the work."""
        width = max(map(len, self.list_commands(ctx)))
        limit = formatter.width - 6 - width  # indentation, and the space between the columns
        for section, names in SECTIONS.items():
            commands = [(name, self.get_command(ctx, name)) for name in names]
            with formatter.section(section):
                formatter.write_dl(
                    [
                        (f"{name:<{width}}", command.get_short_help_str(limit))
                        for name, command in commands
                        if command is not None
                    ]
                )

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a name, whose module is loaded now; None if there is none.

        Raises click.UsageError for a former name.
        """
        if cmd_name in FORMER_COMMANDS:
            raise click.UsageError(
                f"unknown command {cmd_name}; its present name is {FORMER_COMMANDS[cmd_name]}.", ctx
            )
        command: click.Command | None = getattr(cli, f"{cmd_name}{SUFFIX}", None)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the name, the command and the other words of a command line.

        Raises click.UsageError with the nearest name for an unknown command.
        """
        near = "" if self.get_command(ctx, args[0]) else nearest(args[0], self.list_commands(ctx))
        if near:
            raise click.UsageError(f"No such command {args[0]!r}. Did you mean {near!r}?", ctx)
        return super().resolve_command(ctx, args)


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
    """Stability analysis and simulation of networked haptic cooperation.

    A topology is a YAML file of users, masses, couplers and network links;
    `apc new` creates one. Without FILE, a command uses the only topology of the
    folder.
    """
