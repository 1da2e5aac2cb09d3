"""The command `region`: what it takes and what it prints.

Takes: words of a command line. Gives: the click command `region_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click

from apc.cli.options import (
    Command,
    WholeNumber,
    beside,
    criterion_with,
    file_argument,
    file_option,
    hands_option,
    in_option,
    json_option,
    note_aside,
    note_usual,
    print_result,
    set_option,
    tell,
)
from apc.cli.progress import status_line
from apc.compiler.errors import ApcError, Mistake, Place


@click.command("region", cls=Command)
@file_argument
@click.option("--x", metavar="PATH=LO:HI", help="Horizontal axis; the scene's studies: region: if not given.")
@click.option("--y", metavar="PATH=LO:HI", help="Vertical axis.")
@click.option(
    "--compare", multiple=True, metavar="FILE", help="Another scene in the same picture. May be repeated."
)
@click.option("--vary", metavar="PATH=V1,V2,…", help="A panel a value: lan.delay=0,8 ms.")
@click.option(
    "--panel",
    "panels",
    multiple=True,
    metavar='"PATH=V, …"',
    help="A panel with several values at once; repeat it for (a), (b), ….",
)
@click.option(
    "--normalize",
    is_flag=True,
    help="Compare at equal effective gain: where a scene sums over its others, y counts once an other.",
)
@click.option(
    "--overlay",
    "overlays",
    multiple=True,
    metavar="CONDITION:SYMBOL=PATH,…",
    help="Draw a published condition too; every symbol is given a parameter or a quantity.",
)
@set_option
@click.option(
    "--cells",
    type=WholeNumber(2, 256),
    default=12,
    show_default=True,
    help="Cells along each side of the rectangle to begin with.",
)
@in_option
@hands_option
@file_option("--out", "Write a picture (.png .svg .pdf), a table (.csv .parquet) or .json.")
@json_option
def region_command(
    file: str | None,
    x: str | None,
    y: str | None,
    compare: tuple[str, ...],
    vary: str | None,
    panels: tuple[str, ...],
    normalize: bool,
    overlays: tuple[str, ...],
    settings: tuple[str, ...],
    cells: int,
    criterion: str | None,
    hands: str,
    out: Path | None,
    as_json: bool,
) -> None:
    """Find the stable region of two parameters, as exact curves.

    FILE is a topology or a compiled model. Every curve comes with the mode
    that makes it, that mode's frequency, and an error.

    \b
        apc region --x "contact.stiffness=10 N/m:3000 N/m" \\
                   --y "coordination.stiffness=10 N/m:3000 N/m" \\
                   --compare mesh.yaml --vary "lan.delay=0,8 ms" \\
                   --out regions.svg
    """
    from apc.inputs import open_scene
    from apc.present.pictures import check_result_path
    from apc.present.region import write_panels
    from apc.regions.panels import compare_regions, parse_panel, parse_vary

    if out is not None:
        check_result_path(out)
    if vary and panels:
        what = "--vary and --panel both say what the panels are: one of them is enough"
        raise ApcError(Mistake("E907", Place("region"), what))
    listed = parse_vary(vary) if vary else tuple(parse_panel(text) for text in panels) or ((),)
    asked = criterion_with(hands, criterion)
    note_usual(hands)
    systems = [
        open_scene(one, settings, {"--out": out}, hands=hands, told=note_aside) for one in (file, *compare)
    ]
    with status_line() as told:
        found = compare_regions(
            systems,
            x=x,
            y=y,
            panels=listed,
            overlays=overlays,
            normalize=normalize,
            cells=cells,
            criterion=asked,
            told=told,
        )
    if out is not None:
        write_panels(out, found)
    print_result(found, as_json=as_json, err=beside(out))
    if out is not None and not as_json:
        tell(f"\n{out} is written", err=beside(out))
