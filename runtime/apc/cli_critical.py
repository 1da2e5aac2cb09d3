"""The command `apc critical`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command("critical")
@click.argument("path")
@click.argument("file", required=False)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar='PATH="VALUE UNIT"',
    help='Change a parameter first, e.g. --set contact.stiffness="800 N/m". May be repeated.',
)
@click.option("--upper", metavar='"VALUE UNIT"', help="Look no further up than this.")
@click.option("--lower", metavar='"VALUE UNIT"', help="Look no further down than this.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
def critical_command(
    path: str,
    file: str | None,
    settings: tuple[str, ...],
    upper: str | None,
    lower: str | None,
    as_json: bool,
) -> None:
    """Find the largest stable value of a parameter, with its error.

    PATH names a stiffness, damping, mass or delay, of one group or of all:
    coordination.stiffness, left.device.mass, lan.delay. Every value at which
    the scene becomes stable or unstable is found, down to a cell size that
    is printed, and on which side of it the scene is stable. FILE is a
    topology or a compiled model.
    """
    from apc.inputs import find_input, load_or_compile
    from apc.runtime.critical import critical

    system = load_or_compile(Path(file) if file else find_input(compiled_too=True))
    if settings:
        from apc.runtime.parameters import apply, parse_override

        system = apply(system, [parse_override(system, text) for text in settings])
    result = critical(system, path, lower=lower, upper=upper)
    if as_json:
        click.echo(json.dumps(result.to_dict(), ensure_ascii=False, allow_nan=False, indent=2))
    else:
        click.echo(str(result))
