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
from apc.suffixes import check_suffix

FORMATS = {".txt": "text", ".json": "json", ".dot": "dot", ".gv": "dot", ".mmd": "mermaid", ".svg": "svg"}
FORMATS |= {".png": "picture", ".pdf": "picture"}
PICTURES = (".svg", ".png", ".pdf")


@command
def show_command(
    *,
    file: str | None,
    format_: str | None = option(
        "text: graph, equations, schedule. json: the same as one document. dot, mermaid: the graph for "
        "Graphviz and Mermaid. svg: the graph as a picture. Taken from --out if not given, else text.",
        name="--format",
        type=click.Choice(["text", "json", "dot", "mermaid", "svg"]),
    ),
    parameters: bool = option("List what may be set instead: names, values, units, limits; as text or json."),
    out: Path | None = option("Write to this file: .txt .json .dot .mmd, or as a picture .svg .png .pdf."),
) -> None:
    """Show what a topology is made of: its graph, equations and schedule.

    The graph has the parts of one peer and how they are joined, and the
    peers and the links between them. The schedule says what ticks when, how
    long what it computes is held, and which packets are on their way.
    """
    from apc.api import show as shown
    from apc.inputs import check_topology_outputs, find_input

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
        from apc.compiler.view.listing import diagram_of
        from apc.output.graph import graph_picture
        from apc.output.pictures import check_picture, write_figure

        check_picture(out, "--out")
        write_figure(graph_picture(diagram_of(path)), out)
        echo(f"{out} is written", err=prints_to_stderr(out))
        return
    _print_or_write(shown(path, format=requested), out)  # type: ignore[arg-type] # click checked the word


def _show_parameters(file: str | None, requested: str, out: Path | None) -> None:
    """List what may be set of a topology."""
    from apc.frame.parameter_listing import parameters
    from apc.inputs import open_topology

    if requested not in ("text", "json"):
        raise click.UsageError("--parameters is a table: --format text or json")
    result = parameters(open_topology(file, (), {"--out": out}))
    _print_or_write(json_text(result.to_dict()) if requested == "json" else str(result), out)


@command
def schema_command(
    *,
    out: Path | None = option("Write to this file instead of the terminal."),
) -> None:
    """Print the JSON Schema of topologies, for editors.

    An editor that knows YAML schemas completes and checks a topology whose
    first line is, with the schema beside it as topology.schema.json,

    \b
        # yaml-language-server: $schema=topology.schema.json

    `apc new` writes that line where the schema is.
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
