"""The commands `apc library` and `apc new`: listing and copying of components and topologies.

Takes: words of a command line. Gives: text on stdout, new topologies.
Guarantees: with --json, stdout holds one JSON document and nothing else; no file that exists is overwritten,
and of several either all are written or none.
Does not: compute.
"""

from __future__ import annotations

import re
from pathlib import Path

import click

from apc.cli.options import argument, command, echo, option
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import unwritable
from apc.output.formatting import json_text

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}\Z")
SCHEMA_FILE = "topology.schema.json"
_FIRST_LINE = re.compile(r"\A# yaml-language-server:.*\n")
_TOPOLOGY = re.compile(r"^topology:\s*[^\s#]+", re.MULTILINE)


@command
def library_command(
    *,
    name: str | None = argument(required=False),
    folder: Path | None = option("Folder of additional components.", "DIR"),
    as_json: bool,
) -> None:
    """List the components of the library, or show one.

    NAME is a component or connector. Printed are its description, parameters
    with units, defaults and limits, its source, and its definition.
    """
    from apc.compiler.components.component_library import Library
    from apc.compiler.files import FileReader
    from apc.compiler.topology.topology import readable_library
    from apc.compiler.view import catalogue

    reader, option = FileReader(), SourceLocation("--folder")
    local = () if folder is None else (folder,)
    for path in local:
        readable_library(path, reader, str(path), option, key="--folder", example="parts")
    library = Library(local, reader=reader)
    if name is None:
        document, lines = catalogue.library_document(library), catalogue.library_lines(library)
        echo(json_text(document) if as_json else "\n".join(lines))
    elif as_json:
        echo(json_text(catalogue.component_document(library, name)))
    else:
        echo(catalogue.component_text(library, name))


@command
def new_command(
    *,
    name: str | None = argument(required=False),
    like: str | None = option("Copy a topology of the library, with its tables.", "TOPOLOGY"),
    listing: bool = option("List the topologies of the library.", name="--list"),
    out: Path | None = option("With --list: page with pictures (.html)."),
) -> None:
    """Create a commented topology, NAME.yaml.

    NAME is "topology" by default, or the name of the copied topology. Existing
    files are never overwritten.
    """
    from apc.compiler.view import catalogue

    if listing:
        if name is not None or like is not None:
            raise click.UsageError("--list can't be combined with NAME or --like")
        echo("\n".join(catalogue.topology_lines()) if out is None else _gallery(out))
        return
    if out is not None:
        raise click.UsageError("--out requires --list")
    source = catalogue.topology_named(catalogue.TEMPLATE if like is None else like)
    name = name if name is not None else like or "topology"
    if not NAME.match(name):
        message = "name of a topology"
        expected = "letters, digits, - and _ (at most 63 characters, first a letter or digit)"
        raise ApcError(
            Diagnostic(
                "E612", SourceLocation("apc new"), message, expected, repr(name[:80]), "apc new my-topology"
            )
        )
    path = Path(f"{name}.yaml")
    # The first line names the schema of the library; it is replaced by a schema in the working folder.
    text = _FIRST_LINE.sub("", source.read_text(encoding="utf-8"))
    text = _TOPOLOGY.sub(f"topology: {name}", text, count=1)
    if Path(SCHEMA_FILE).is_file():
        text = f"# yaml-language-server: $schema={SCHEMA_FILE}\n{text}"
    tables = [path for path in catalogue.tables_of(source) if not _is_there(path)] if like is not None else []
    _write({path: text, **{Path(table.name): table.read_text(encoding="utf-8") for table in tables}})
    written = (
        f"{' and '.join([str(path), *(table.name for table in tables)])} {'are' if tables else 'is'} written"
    )
    echo(f"{written}. Next: apc analyze {path}")


def _gallery(out: Path) -> str:
    """Write the page of the library's topologies; return the message."""
    from apc.compiler.files import check_target, write_text
    from apc.compiler.view.catalogue import topologies
    from apc.output.pages import gallery_page
    from apc.support.optional import need
    from apc.support.suffixes import check_suffix

    check_suffix(out, (".html",), "--out")
    check_target(out)
    need("matplotlib", "plot")
    paths = list(topologies().values())
    with at_work(f"analyzing {len(paths)} topologies"):
        write_text(out, gallery_page(paths))
    return f"{out} is written"


def _is_there(table: Path) -> bool:
    """Return whether the working folder has an identical table."""
    path = Path(table.name)
    return path.is_file() and path.read_bytes() == table.read_bytes()


def _write(texts: dict[Path, str]) -> None:
    """Write new files, all or none. Raises ApcError: E613 a file exists, E601 a file can't be written."""
    written: list[Path] = []
    try:
        for path, text in texts.items():
            with path.open("x", encoding="utf-8") as file:
                written.append(path)
                file.write(text)
    except OSError as error:
        for item in written:
            item.unlink(missing_ok=True)
        if not isinstance(error, FileExistsError):
            raise unwritable(path, error) from None
        fix = "apc new another-name" if path == next(iter(texts)) else f"mv {path} another-name{path.suffix}"
        message = "file exists and was not changed"
        raise ApcError(Diagnostic("E613", SourceLocation(str(path)), message, fix=fix)) from None
