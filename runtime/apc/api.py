"""The public functions: plain, with frozen results.

Takes: paths, compiled models, settings. Gives: compiled models and analyses.
Guarantees: what a command does, the function of its name does.
Does not: print.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from apc.compiler import store
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place

if TYPE_CHECKING:
    from apc.runtime.analysis import Analysis

Method = Literal["modes", "dense"]
Format = Literal["text", "json", "dot", "svg"]


def compile(path: str | Path) -> CompiledSystem:
    """Compile a topology file and check the result: one frame event by event against the lifted map.

    Parameters
    ----------
    path
        The topology, a YAML file.

    Returns
    -------
    CompiledSystem
        The compiled model; nothing is written (see `save`).

    Raises
    ------
    ApcError
        The file is at fault; holds every mistake found.
    """
    from apc.compiler.pipeline import compile_topology
    from apc.runtime.selfcheck import check_frame

    system = compile_topology(Path(path))
    check_frame(system)
    return system


def save(model: CompiledSystem, path: str | Path) -> None:
    """Write a compiled model to a .apc file, whole or not at all. Raises ApcError if it can't be written."""
    store.save(model, Path(path))


def load(path: str | Path) -> CompiledSystem:
    """Read a compiled model from a .apc file. Raises ApcError if it is damaged or older than its topology."""
    from apc.inputs import load_fresh

    return load_fresh(Path(path))


def set_parameters(model: CompiledSystem, values: Mapping[str, str]) -> CompiledSystem:
    """Return the model with other parameter values, without compiling again.

    Parameters
    ----------
    model
        The compiled model; it stays as it is.
    values
        Quantities by name: `{"contact.stiffness": "800 N/m", "lan.delay": "16 ms"}`.

    Raises
    ------
    ApcError
        A name is unknown, a unit is wrong, or a value lies outside its bounds.
    """
    from apc.runtime.parameters import apply, parse_override

    overrides = [parse_override(model, f"{name}={value}") for name, value in values.items()]
    return apply(model, overrides)


def analyze(
    model: CompiledSystem | str | Path, *, set: Mapping[str, str] | None = None, method: Method = "modes"
) -> Analysis:
    """Say whether a scene is stable, by how much, and in which modes.

    Parameters
    ----------
    model
        A compiled model, or the path of a topology or compiled model.
    set
        Parameter values to change first, as in `set_parameters`.
    method
        "modes": a few systems of a site's size, at a cost that does not grow with the number of peers;
        "dense": every peer in one system, the check on the other.

    Returns
    -------
    Analysis
        Verdict, spectral radius per frame with its error bound, and the modes.

    Raises
    ------
    ApcError
        The input is at fault.
    """
    from apc.runtime.analysis import analyze_dense, analyze_modes

    if not isinstance(model, CompiledSystem):
        from apc.inputs import load_or_compile

        model = load_or_compile(Path(model))
    if set:
        model = set_parameters(model, set)
    return analyze_modes(model) if method == "modes" else analyze_dense(model)


def show(path: str | Path, *, format: Format = "text") -> str:
    """Tell what a scene is made of: its graph, its equations, and what happens in one frame.

    Parameters
    ----------
    path
        The topology, a YAML file.
    format
        "text" for a person; "json", the same as one document; "dot", the graph in Graphviz's language;
        "svg", the graph as a picture.

    Raises
    ------
    ApcError
        The file is at fault, or is a compiled model, which no longer has the equations as written.
    """
    from apc import contents

    path = Path(path)
    if path.suffix == ".apc":
        what = "is a compiled model, which no longer has the equations as they were written"
        raise ApcError(Mistake("E615", Place(str(path)), what, hint=f"apc show {path.with_suffix('.yaml')}"))
    match format:
        case "text":
            return contents.show_text(path)
        case "json":
            return json.dumps(contents.show_document(path), ensure_ascii=False, allow_nan=False, indent=2)
        case "dot":
            return contents.show_dot(path)
        case "svg":
            return contents.show_svg(path)


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of topologies, generated from the language and the library."""
    from apc.compiler.library import Library
    from apc.compiler.schema import topology_schema

    return topology_schema(Library())
