"""The library as a person looks through it: its components and scenes, a line each, and one component whole.

Takes: a name.
Gives: `library_lines` and `library_document`; `component_text` and `component_document` of a component or
connector; `scenes`, `scene_lines`, `scene_named`, `tables_of` of the topologies that come with the
program.
Guarantees: a component is told with what it takes over from those it extends; its definition is shown as it
is written; nothing outside the installed package is read.
Does not: read a topology's own folders of components.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apc.compiler.cache import SUFFIX, builtin_files
from apc.compiler.components.component import Component, Connector, Number, Option, Parameter
from apc.compiler.components.library import Library
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.compiler.language.vectors import by_vector
from apc.compiler.pipeline import run_stages
from apc.compiler.scene.scene import Scene
from apc.compiler.source.nodes import Mapping, Scalar
from apc.compiler.source.source import read_source
from apc.compiler.view.schema import in_unit, is_required, limits_of
from apc.compiler.words import WIDTH, beside, wrapped

TEMPLATE = "template"  # the scene that `apc new` writes where no other is asked for


def _line(name: str, width: int, about: str) -> str:
    """Return a name and what it is, cut to one line."""
    line = f"  {name:<{width}}  {about}"
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 1].rstrip()}…"


def library_lines() -> Iterator[str]:
    """Yield the components and connectors of the library, a line each, by folder."""
    for room, rows in library_document().items():
        yield room
        width = max(len(row["name"]) for row in rows)
        yield from (_line(row["name"], width, row["about"]) for row in rows)
        yield ""
    yield "apc library NAME shows one: its parameters with units and limits, its equations."


def library_document() -> dict[str, Any]:
    """Return the same as plain data, what each is about in full."""
    library = Library()
    rooms: dict[str, list[dict[str, str]]] = {}
    for name, path in builtin_files().items():
        row = {"name": name, "about": _found(library, name).about}
        rooms.setdefault(path.parent.name, []).append(row)
    return rooms


def _found(library: Library, name: str) -> Component | Connector:
    """Return a component or connector. Raises ApcError (E206) where the library has none of that name."""
    found = library.component(name) or library.connector(name)
    if found is None:
        near = nearest(name.lower(), {one.lower(): one for one in library.names})
        near = next((one for one in library.names if one.lower() == near), "")
        what = f"the library has no {name[:80] or 'nameless component'}"
        raise ApcError(Mistake("E206", Place("apc library"), what, hint=f"apc library {near}".rstrip()))
    return found


def component_text(name: str) -> str:
    """Return a component of the library, or a connector, for a person to read.

    Raises
    ------
    ApcError
        E206 there is none of that name.
    """
    facts = component_document(name)
    lines = [name, *wrapped(facts["about"], "  ", "  ")]
    lines += wrapped(f"Source: {facts['source']}", "  ", "    ") if facts["source"] else []
    lines += [f"  File: {facts['file']}", ""]
    rows = [tuple(one[key] for key in ("name", "unit", "value", "limits")) for one in facts["parameters"]]
    if rows:
        rows = [("parameter", "unit", "if not given", "limits"), *rows]
        widths = [max(len(row[column]) for row in rows) for column in range(4)]
        abouts = ["", *(one["about"] for one in facts["parameters"])]
        for row, about in zip(rows, abouts, strict=True):
            told = "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True))
            lines += beside(f"  {told}", about)
        lines.append("")
    for title, text in facts["definitions"].items():
        lines += [f"{title} as it is written:", "", *(f"  {line}" for line in text.splitlines()), ""]
    return "\n".join(lines).rstrip()


def component_document(name: str) -> dict[str, Any]:
    """Return a component of the library, or a connector, as plain data: see `component_text`."""
    found = _found(Library(), name)
    facts = {
        "name": found.name,
        "kind": "connector",
        "about": found.about,
        "source": "",
        "file": str(builtin_files()[name]),
        "connectors": {},
        "parameters": [],
        "equations": [],
        "definitions": _definitions(name),
    }
    if isinstance(found, Connector):
        return facts
    vectors = by_vector(found.parameters, lambda parameter: parameter.name)
    return {
        **facts,
        "kind": "component",
        "source": found.source,
        "connectors": {own: kind.name for own, kind in found.connectors},
        "parameters": [_parameter(own, entries) for own, entries in vectors.items()],
        "equations": list(dict.fromkeys(one.text for one in found.equations)),
    }


def _parameter(name: str, entries: list[Parameter]) -> dict[str, str]:
    """Return what a person reads of a parameter, or of the entries of a vector."""
    one = entries[0]
    facts = {"name": name, "unit": "", "value": "needed" if is_required(one) else "", "limits": ""}
    facts["about"] = one.about
    if isinstance(one, Option):
        return {**facts, "value": one.default or "needed", "limits": ", ".join(one.words)}
    if not isinstance(one, Number):
        return {**facts, "limits": f"a {one.role}"}
    shown = [
        in_unit(one, each.default) for each in entries if isinstance(each, Number) and not is_required(each)
    ]
    value = f"[{', '.join(shown)}]" if len(shown) > 1 else (shown or ["needed"])[0]
    limits = ", ".join([*limits_of(one), *(word for word, _ in one.words)])
    return {**facts, "unit": one.unit.text, "value": value, "limits": limits}


def _definitions(name: str) -> dict[str, str]:
    """Return the texts that define something: its own, then that of what it extends, by name."""
    texts: dict[str, str] = {}
    while name:
        source = read_source(builtin_files()[name])
        texts[name] = source.text.rstrip()
        base = source.root.get("extends") if isinstance(source.root, Mapping) else None
        name = base.text if isinstance(base, Scalar) else ""
    return texts


# ---- scenes ----


def scenes() -> dict[str, Path]:
    """Return the topologies that come with the program, by name; the template is one of them."""
    folder = next(iter(builtin_files().values())).parent.parent / "scenes"
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def scene_lines() -> Iterator[str]:
    """Yield the topologies that come with the program, a line each."""
    known = scenes()
    width = max(map(len, known))
    for name, path in known.items():
        root = read_source(path).root
        about = root.get("about") if isinstance(root, Mapping) else None
        yield _line(name, width, about.text if isinstance(about, Scalar) else "")
    yield ""
    yield "apc new --like NAME copies one to NAME.yaml."


def scene_named(name: str) -> Path:
    """Return the file of a scene of the library. Raises ApcError (E206) where there is none of that name."""
    known = scenes()
    if name not in known:
        near = nearest(name, known)
        what = f"the library has no scene {name[:80]}"
        hint = f"apc new --like {near}" if near else "apc new --list"
        raise ApcError(Mistake("E206", Place("--like"), what, hint=hint))
    return known[name]


def tables_of(scene: Path) -> tuple[Path, ...]:
    """Return the files that a topology names from its folder."""
    built = run_stages(scene, until="scene")
    assert isinstance(built, Scene)
    return tuple(scene.parent / name for name in built.texts)
