"""The command `apc critical`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; how far the search is goes to a
terminal only.
Does not: compute.
"""

from __future__ import annotations

import click

from apc.options import json_option, print_result, set_option
from apc.progress import status_line
from apc.runtime.threads import start_single_threaded


@click.command("critical")
@click.argument("path")
@click.argument("file", required=False)
@set_option
@click.option("--upper", metavar='"VALUE UNIT"', help="Look no further up than this.")
@click.option("--lower", metavar='"VALUE UNIT"', help="Look no further down than this.")
@json_option
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
    start_single_threaded()
    from apc.inputs import open_scene
    from apc.runtime.vary.critical import critical

    system = open_scene(file, settings)
    with status_line() as told:
        found = critical(system, path, lower=lower, upper=upper, told=told)
    print_result(found, as_json=as_json)
