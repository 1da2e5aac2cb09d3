"""The library for the user: a list of components and topologies, and the details of a component.

Takes: a `LoadedLibrary`, a name.
Gives: `library_lines` and `library_document`; `component_text` and `component_document` of a component or
connector; `topologies`, `topology_lines`, `topology_named`, `tables_of` of the topologies that come with the
program.
Guarantees: a component is shown with inherited items; its definition is shown as written.
Does not: search the folders of a topology.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apc.compiler.cache import SUFFIX, builtin_files
from apc.compiler.components.component import Component, Connector, NumberParameter, Option, Parameter
from apc.compiler.components.component_library import Library
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.language.vectors import by_vector
from apc.compiler.pipeline import run_stages
from apc.compiler.source.nodes import Mapping, Scalar
from apc.compiler.source.source import Source, read_source
from apc.compiler.topology.topology import Topology
from apc.compiler.view.schema import in_unit, is_required, limits_of
from apc.compiler.wording import side_by_side, wrapped

TEMPLATE = "template"  # the topology that `apc new` writes where no other is asked for


def library_lines(library: Library) -> Iterator[str]:
    """Yield the components and connectors of a library, a line each, by folder."""
    for room, rows in library_document(library).items():
        yield room
        yield from _lines({row["name"]: row["description"] for row in rows})
    yield "apc library NAME shows one: its parameters with units and limits, its equations."


def _lines(abouts: dict[str, str]) -> Iterator[str]:
    """Yield names with the first sentence of their descriptions, and an empty line."""
    width = max(map(len, abouts))
    for name, description in abouts.items():
        yield from side_by_side(f"  {name:<{width}}", description.partition(". ")[0].rstrip("."))
    yield ""


def library_document(library: Library) -> dict[str, Any]:
    """Return the same as plain data, with complete descriptions."""
    rooms: dict[str, list[dict[str, str]]] = {}
    for name, path in library.files.items():
        row = {"name": name, "description": _entry(library, name).description}
        rooms.setdefault(path.resolve().parent.name, []).append(row)
    return rooms


def _entry(library: Library, name: str) -> Component | Connector:
    """Return a component or connector. Raises ApcError (E206) where the library has none of that name."""
    if (result := library.component(name) or library.connector(name)) is None:
        names = {name.lower(): name for name in library.names}
        near = names.get(nearest(name.lower(), names), "")
        message = f"the library has no {name[:80] or 'nameless component'}"
        raise ApcError(
            Diagnostic("E206", SourceLocation("apc library"), message, hint=f"apc library {near}".rstrip())
        )
    return result


def component_text(library: Library, name: str) -> str:
    """Return a component of a library, or a connector, for a person to read.

    Raises
    ------
    ApcError
        E206 there is none of that name.
    """
    facts = component_document(library, name)
    lines = [name, *wrapped(facts["description"], "  ", "  ")]
    lines += wrapped(f"Source: {facts['source']}", "  ", "    ") if facts["source"] else []
    lines += [f"  File: {facts['file']}", ""]
    if parameters := facts["parameters"]:
        titles = {"name": "parameter", "unit": "unit", "value": "if not given", "limits": "limits"}
        rows = [titles | {"description": ""}, *parameters]
        widths = {key: max(len(row[key]) for row in rows) for key in titles}
        for row in rows:
            cells = "  ".join(f"{row[key]:<{width}}" for key, width in widths.items())
            lines += side_by_side(f"  {cells}", row["description"])
        lines.append("")
    for title, text in facts["definitions"].items():
        lines += [f"{title} as it is written:", "", *(f"  {line}" for line in text.splitlines()), ""]
    return "\n".join(lines).rstrip()


def component_document(library: Library, name: str) -> dict[str, Any]:
    """Return a component of a library, or a connector, as plain data: see `component_text`."""
    result = _entry(library, name)
    peer_type, whole = "component", result
    if isinstance(whole, Connector):  # it has no listed parts
        peer_type, whole = "connector", Component(name, result.description, "", SourceLocation(""))
    vectors = by_vector(whole.parameters)
    return {
        "name": name,
        "kind": peer_type,
        "description": whole.description,
        "source": whole.source,
        "file": str(library.files[name]),
        "connectors": {local: related.name for local, related in whole.connectors},
        "parameters": [_parameter(local, entries) for local, entries in vectors.items()],
        "equations": [*dict.fromkeys(equation.text for equation in whole.equations)],
        "definitions": _definitions(library, name),
    }


def _parameter(name: str, entries: list[Parameter]) -> dict[str, str]:
    """Return the text of a parameter, or of the entries of a vector."""
    entry, unit, value, limits = entries[0], "", "needed" if is_required(entries[0]) else "", ""
    if isinstance(entry, Option):
        value, limits = entry.default or "needed", ", ".join(entry.words)
    elif not isinstance(entry, NumberParameter):
        limits = f"a {entry.role}"
    else:
        unit, limits = entry.unit.text, ", ".join([*limits_of(entry), *(word for word, _ in entry.words)])
        if not value:
            first, *more = (in_unit(entry, getattr(each, "default", None)) for each in entries)
            value = f"[{', '.join((first, *more))}]" if more else first
    return {"name": name, "unit": unit, "value": value, "limits": limits, "description": entry.description}


def _definitions(library: Library, name: str) -> dict[str, str]:
    """Return the texts of a definition and of those it extends, by name."""
    texts: dict[str, str] = {}
    while name:
        source = read_source(library.files[name])
        texts[name], name = source.text.rstrip(), _text(source, "extends")
    return texts


def _text(source: Source, key: str) -> str:
    """Return the text of a key of a file, empty without one."""
    node = source.root.get(key) if isinstance(source.root, Mapping) else None
    return node.text if isinstance(node, Scalar) else ""


# ---- topologies ----


def topologies() -> dict[str, Path]:
    """Return the topologies that come with the program, by name; the template is one of them."""
    folder = next(iter(builtin_files().values())).parent.parent / "topologies"
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def topology_lines() -> Iterator[str]:
    """Yield the topologies that come with the program, a line each."""
    yield from _lines({name: _text(read_source(path), "description") for name, path in topologies().items()})
    yield "apc new --like NAME copies one to NAME.yaml."


def topology_named(name: str) -> Path:
    """Return the file of a topology of the library. Raises ApcError (E206) where there is none of that
    name.
    """
    known = topologies()
    if name not in known:
        near = nearest(name, known)
        message = f"the library has no topology {name[:80]}"
        hint = f"apc new --like {near}" if near else "apc new --list"
        raise ApcError(Diagnostic("E206", SourceLocation("--like"), message, hint=hint))
    return known[name]


def tables_of(topology: Path) -> tuple[Path, ...]:
    """Return the files that a topology names from its folder."""
    built = run_stages(topology, until="topology")
    assert isinstance(built, Topology)
    return tuple(topology.parent / name for name in built.texts)
