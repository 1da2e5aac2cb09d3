"""The command `region`: what it takes and what it prints.

Takes: words of a command line. Gives: the click command `region_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed.
Does not: compute.
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from apc.compiler.errors import ApcError, Mistake, Place


@click.command("region")
@click.argument("file", required=False)
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
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar='PATH="VALUE UNIT"',
    help="Change a parameter first, in every scene. May be repeated.",
)
@click.option(
    "--cells",
    type=click.IntRange(2, 256),
    default=12,
    show_default=True,
    help="Cells along each side of the rectangle to begin with.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a picture (.png .svg .pdf), a table (.csv .parquet) or .json.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of text.")
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
    from apc.inputs import find_input, load_or_compile
    from apc.runtime.parameters import apply, parse_override
    from apc.runtime.region_files import check_region_path, write_panels
    from apc.runtime.region_panels import compare_regions, parse_panel, parse_vary

    if out is not None:
        check_region_path(out)
    if vary and panels:
        what = "--vary and --panel both say what the panels are: one of them is enough"
        raise ApcError(Mistake("E907", Place("region"), what))
    listed = parse_vary(vary) if vary else tuple(parse_panel(text) for text in panels) or ((),)
    first = Path(file) if file else find_input(compiled_too=True)
    systems = [load_or_compile(path) for path in (first, *map(Path, compare))]
    changed = [apply(one, [parse_override(one, text) for text in settings]) for one in systems]
    found = compare_regions(
        changed, x=x, y=y, panels=listed, overlays=overlays, normalize=normalize, cells=cells
    )
    if out is not None:
        write_panels(out, found)
    if as_json:
        click.echo(json.dumps(found.to_dict(), ensure_ascii=False, allow_nan=False, indent=2))
    else:
        click.echo(str(found))
        if out is not None:
            click.echo(f"\n{out} is written")
