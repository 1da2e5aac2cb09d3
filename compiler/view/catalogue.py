"""The library for the user: a list of components and topologies, and the details of a component.

Takes: a `LoadedLibrary`, a name.
Gives: `library_lines` and `library_document`; `component_text` and `component_document` of a component or
connector; `topologies`, `topology_lines`, `topology_named`, `tables_of` of the topologies that come with the
program.
Guarantees: the details of a component have its inherited items, and its definition as written.
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

TEMPLATE = "template"  # the topology that `apc new` writes by default


def library_lines(library: Library) -> Iterator[str]:
    """Yield the components and connectors of a library, one per line, by folder."""
    for folder, rows in library_document(library).items():
        yield folder
        yield from _lines({row["name"]: row["description"] for row in rows})
    yield "apc library NAME shows one: its parameters with units and limits, its equations."


def _lines(descriptions: dict[str, str]) -> Iterator[str]:
    """Yield names with the first sentence of their descriptions, then an empty line."""
    width = max(map(len, descriptions))
    for name, description in descriptions.items():
        yield from side_by_side(f"  {name:<{width}}", description.partition(". ")[0].rstrip("."))
    yield ""


def library_document(library: Library) -> dict[str, Any]:
    """Return the components and connectors of a library by folder, as plain data with complete
    descriptions.
    """
    folders: dict[str, list[dict[str, str]]] = {}
    for name, path in library.files.items():
        row = {"name": name, "description": _definition(library, name).description}
        folders.setdefault(path.resolve().parent.name, []).append(row)
    return folders


def _definition(library: Library, name: str) -> Component | Connector:
    """Return a component or connector by name.

    Raises ApcError (E206) if the library has none of this name.
    """
    if (result := library.component(name) or library.connector(name)) is None:
        names = {known.lower(): known for known in library.names}
        near = names.get(nearest(name.lower(), names), "")
        message = f"unknown component {name[:80]!r}"
        raise ApcError(
            Diagnostic("E206", SourceLocation("apc library"), message, fix=f"apc library {near}".rstrip())
        )
    return result


def component_text(library: Library, name: str) -> str:
    """Return the text that describes a component or connector of a library.

    Raises
    ------
    ApcError
        E206 the library has no component or connector of this name.
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
        lines += [f"Source of {title}:", "", *(f"  {line}" for line in text.splitlines()), ""]
    return "\n".join(lines).rstrip()


def component_document(library: Library, name: str) -> dict[str, Any]:
    """Return the description of a component or connector as plain data, see `component_text`."""
    result = _definition(library, name)
    kind, definition = "component", result
    if isinstance(definition, Connector):  # a connector has no parameters or equations
        kind, definition = "connector", Component(name, result.description, "", SourceLocation(""))
    vectors = by_vector(definition.parameters)
    return {
        "name": name,
        "kind": kind,
        "description": definition.description,
        "source": definition.source,
        "file": str(library.files[name]),
        "connectors": {connector: type_.name for connector, type_ in definition.connectors},
        "parameters": [_parameter(parameter, entries) for parameter, entries in vectors.items()],
        "equations": [*dict.fromkeys(equation.text for equation in definition.equations)],
        "definitions": _definitions(library, name),
    }


def _parameter(name: str, entries: list[Parameter]) -> dict[str, str]:
    """Return the description of a parameter, or of a vector given by its entries, as texts by column name."""
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
    """Return the texts of a definition and of the definitions it extends, by name."""
    texts: dict[str, str] = {}
    while name:
        source = read_source(library.files[name])
        texts[name], name = source.text.rstrip(), _text(source, "extends")
    return texts


def _text(source: Source, key: str) -> str:
    """Return the text of a top-level key of a file, empty if there is none."""
    node = source.root.get(key) if isinstance(source.root, Mapping) else None
    return node.text if isinstance(node, Scalar) else ""


# ---- topologies ----


def topologies() -> dict[str, Path]:
    """Return the topologies that come with the program, by name; the template is one of them."""
    folder = next(iter(builtin_files().values())).parent.parent / "topologies"
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def topology_lines() -> Iterator[str]:
    """Yield the topologies that come with the program, one per line."""
    yield from _lines({name: _text(read_source(path), "description") for name, path in topologies().items()})
    yield "apc new --like NAME copies one to NAME.yaml."


def topology_named(name: str) -> Path:
    """Return the file of a topology of the library. Raises ApcError (E206) for an unknown name."""
    known = topologies()
    if name not in known:
        near = nearest(name, known)
        message = f"unknown topology {name[:80]}"
        fix = f"apc new --like {near}" if near else "apc new --list"
        raise ApcError(Diagnostic("E206", SourceLocation("--like"), message, fix=fix))
    return known[name]


def tables_of(topology: Path) -> tuple[Path, ...]:
    """Return the files that a topology refers to, relative to its folder."""
    built = run_stages(topology, until="topology")
    assert isinstance(built, Topology)
    return tuple(topology.parent / name for name in built.texts)
