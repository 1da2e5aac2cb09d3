"""The command `apc region`.

Takes: words of a command line. Gives: the click command `region_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed.
Does not: compute.
"""

from __future__ import annotations

import itertools
from pathlib import Path

from apc.cli.options import (
    WholeNumber,
    command,
    criterion_with,
    note_aside,
    note_typical_hand,
    option,
    print_result,
    result_option,
)
from apc.cli.progress import status_line
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation


@command
def region_command(
    *,
    file: str | None,
    x: str | None = option("Horizontal axis.", "PATH=LO:HI", show_default="studies: region"),
    y: str | None = option("Vertical axis.", "PATH=LO:HI", show_default="studies: region"),
    compare: tuple[str, ...] = option("Topology to compare with (repeatable).", "FILE"),
    vary: str | None = option("One panel per value, e.g. lan.delay=0,8 ms.", "PATH=V1,V2,…"),
    panels: tuple[str, ...] = option(
        "One panel with several values (repeatable).", '"PATH=V, …"', name="--panel"
    ),
    normalize: bool = option("Scale y by the number of other peers."),
    overlays: tuple[str, ...] = option(
        "Draw a published condition (repeatable).",
        "NAME:SYMBOL=PATH,…",
        name="--overlay",
    ),
    settings: tuple[str, ...],
    cells: int = option("Initial cells along each side.", "N", type=WholeNumber(2, 256), default=12),
    criterion: str | None,
    hands: str,
    operating_point: str,
    out: Path | None = result_option(),
    as_json: bool,
) -> None:
    """Compute the stability region of two parameters.

    Each boundary curve is exact: it has a mode, a frequency and an error bound.
    FILE is a topology or a compiled model.

    \b
        apc region --x "contact.stiffness=10 N/m:3000 N/m" \\
                   --y "coordination.stiffness=10 N/m:3000 N/m" \\
                   --compare mesh.yaml --vary "lan.delay=0,8 ms" \\
                   --out regions.svg
    """
    from apc.inputs.open_model import open_topology
    from apc.output.pictures import write_result
    from apc.regions.panels import compare_regions, parse_panel, parse_vary

    if vary and panels:
        message = "--vary can't be combined with --panel"
        raise ApcError(Diagnostic("E907", SourceLocation("region"), message))
    listed = parse_vary(vary) if vary else tuple(parse_panel(text) for text in panels) or ((),)
    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    varied = [text for text in (x, y, *itertools.chain(*listed)) if text]
    systems = [
        open_topology(
            text,
            settings,
            {"--out": out},
            hands=hands,
            operating_point=operating_point,
            varied=varied,
            notify=note_aside,
        )
        for text in (file, *compare)
    ]
    with status_line() as progress:
        result = compare_regions(
            systems,
            x=x,
            y=y,
            panels=listed,
            overlays=overlays,
            normalize=normalize,
            cells=cells,
            criterion=requested,
            progress=progress,
        )
    if out is not None:
        write_result(out, result, result.plot)
    print_result(result, as_json=as_json, written=[out])
