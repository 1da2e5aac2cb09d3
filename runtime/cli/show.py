"""The commands `apc show` and `apc schema`.

Takes: words of a command line. Gives: text on stdout, or a file of it or of its picture.
Guarantees: the format of a file is that of its suffix.
Does not: compute.
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from apc.cli.options import command, echo, option, prints_to_stderr
from apc.compiler.files import write_text
from apc.output.formatting import json_text
from apc.support.suffixes import check_suffix

FORMATS = {".txt": "text", ".json": "json", ".dot": "dot", ".gv": "dot", ".mmd": "mermaid", ".svg": "svg"}
FORMATS |= {".png": "picture", ".pdf": "picture"}
PICTURES = (".svg", ".png", ".pdf")


@command
def show_command(
    *,
    file: str | None,
    format_: str | None = option(
        "text, json, dot, mermaid or svg.",
        "FORMAT",
        name="--format",
        type=click.Choice(["text", "json", "dot", "mermaid", "svg"]),
        show_default="from --out",
    ),
    parameters: bool = option("List the parameters: names, values, units, limits."),
    out: Path | None = option("Output file (.txt .json .dot .mmd .svg .png .pdf)."),
) -> None:
    """Show the graph, equations and schedule of a topology.

    The graph has the parts and connections of one peer, the peers, and the
    links between them. The schedule has the clocks, hold times, and packets in
    transit. The equations in order of computation: apc compile --until sorted.
    """
    from apc.api import show as shown
    from apc.inputs.open_model import check_topology_outputs, find_input

    requested = format_ or "text"
    formats = {name: of for name, of in FORMATS.items() if not parameters or of in ("text", "json")}
    if out is not None and (out.suffix or not format_):
        known = [suffix for suffix in formats if format_ in (None, formats[suffix])]
        requested = formats[check_suffix(out, known, "--out")]
    if parameters:
        _show_parameters(file, requested, out)
        return
    path = find_input(file, compiled_too=False)
    check_topology_outputs(path, {"--out": out})
    if out is not None and out.suffix.lower() in PICTURES:
        from apc.compiler.view.diagram import diagram_of
        from apc.output.graph import graph_picture
        from apc.output.pictures import check_picture, write_figure

        check_picture(out, "--out")
        write_figure(graph_picture(diagram_of(path)), out)
        echo(f"{out} is written", err=prints_to_stderr(out))
        return
    _print_or_write(shown(path, format=requested), out)  # type: ignore[arg-type] # click checked the word


def _show_parameters(file: str | None, requested: str, out: Path | None) -> None:
    """List the parameters of a topology."""
    from apc.inputs.open_model import open_topology
    from apc.parameter_values.parameter_listing import parameters

    if requested not in ("text", "json"):
        raise click.UsageError("--parameters requires --format text or json")
    result = parameters(open_topology(file, (), {"--out": out}))
    _print_or_write(json_text(result.to_dict()) if requested == "json" else str(result), out)


@command
def schema_command(
    *,
    out: Path | None = option("Output file.", show_default="stdout"),
) -> None:
    """Print the JSON Schema of topologies.

    For completion in an editor, store the schema in the folder of a topology as
    topology.schema.json. The first line of the topology is then

    \b
        # yaml-language-server: $schema=topology.schema.json

    `apc new` writes this line if the schema exists.
    """
    from apc.api import schema as generated

    if out is not None:
        check_suffix(out, (".json",), "--out")
    _print_or_write(json.dumps(generated(), ensure_ascii=False, indent=1), out)


def _print_or_write(text: str, out: Path | None) -> None:
    if out is None:
        echo(text)
        return

    write_text(out, text)
    echo(f"{out} is written", err=prints_to_stderr(out))
