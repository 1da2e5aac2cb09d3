"""The compiler stages in sequence: a topology file to a compiled model, or to any earlier stage.

Takes: a path. Gives: `compile_topology`, the model; `compile_again`, from stored texts; `run_stages`,
`each_stage`, `stages_of`, the results of single stages; `check_definition`.
Guarantees: each stage uses only the result of the previous stage.
Does not: save files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from apc.compiler.cache import Origin, origin_of, stored_contents
from apc.compiler.compiled import Model
from apc.compiler.components.component_library import Library, definition_of
from apc.compiler.equations.causalization import SortedSystem, sort
from apc.compiler.equations.clocks import ClockedSystem, check_single, partition
from apc.compiler.equations.flatten import FlatSystem, flatten
from apc.compiler.errors import ApcError, Mistakes, SourceLocation
from apc.compiler.files import FileReader
from apc.compiler.functions.functions import build_functions
from apc.compiler.source.source import Source, read_source
from apc.compiler.timings import part
from apc.compiler.topology.topology import Topology, read_topology

Stage = Literal["source", "topology", "flat", "clocked", "sorted", "compiled"]
StageValue = Source | Topology | FlatSystem | ClockedSystem | SortedSystem | Model


def compile_topology(path: Path, reader: FileReader | None = None) -> Model:
    """Return the compiled model of a topology file. Raises ApcError with all mistakes of the topology."""
    value = run_stages(path, until="compiled", reader=reader)
    assert isinstance(value, Model)
    return value


def compile_again(origin: Origin, folder: Path) -> Model:
    """Return the model compiled from the texts of a model's origin; no file is read.

    Parameters
    ----------
    origin
        The texts.
    folder
        The folder of the texts in messages.

    Raises
    ------
    ApcError
        The texts have errors.
    """
    reader = FileReader(stored=stored_contents(origin, folder))
    return compile_topology(folder / origin.topology, reader)


def check_definition(path: Path) -> str:
    """Check the definition of a component or connector in a file, and return its name and kind.

    Returns
    -------
    The name and the kind; an empty text for a topology.

    Raises
    ------
    ApcError
        The definition, or another file in its folder, has errors.
    """
    source = read_source(path)
    peer_type, name = definition_of(source)
    if not peer_type:
        return ""
    other_errors: list[ApcError] = []
    library = Library((path.parent,), other_errors)
    mistakes = Mistakes()
    with mistakes:
        if peer_type == "connector":
            library.connector(name)
        elif component := library.component(name):
            check_single(component, SourceLocation(str(path)), mistakes)
    # The mistakes of the definition come before those of the other files.
    result = [*mistakes.result, *(mistake for error in other_errors for mistake in error.mistakes)]
    if result:
        raise ApcError(result)
    return f"{name}, a {peer_type}"


def linear_system(topology: Topology) -> SortedSystem | None:
    """Return the equations of linear analyses, None if no component has separate ones."""
    if all(part.component.linearized is None for part in topology.parts):
        return None
    return sort(partition(flatten(topology, linear=True)))


def run_stages(path: Path, *, until: Stage, reader: FileReader | None = None) -> StageValue:
    """Return the result of the stage `until`. Raises ApcError with the mistakes of the stage that fails."""
    return next(value for stage, value in each_stage(path, reader) if stage == until)


def each_stage(path: Path, reader: FileReader | None = None) -> Iterator[tuple[Stage, StageValue]]:
    """Run the stages in sequence; yield the name and the result of each stage."""
    with part("source"):
        source = read_source(path, reader)
    yield from stages_of(source)


def stages_of(source: Source) -> Iterator[tuple[Stage, StageValue]]:
    """Run the stages in sequence on a source with a path; yield the name and the result of each stage.

    Parameters
    ----------
    source
        The topology.
    """
    assert source.path is not None
    path, reader = source.path, source.reader
    steps: dict[Stage, Callable[[Any], StageValue]] = {
        "topology": read_topology,
        "flat": flatten,
        "clocked": partition,
        "sorted": sort,
        "compiled": lambda ordered: build_functions(
            ordered, origin_of(path, reader.contents), linear=linear_system(ordered.topology)
        ),
    }
    value: StageValue = source
    yield "source", value
    for stage, step in steps.items():
        with part(stage):
            value = step(value)
        yield stage, value
