"""The stages one after another: a topology file to a compiled model, or to any stage before it.

Takes: a path. Gives: the value of the last stage asked for, or every one on the way; `check_definition`.
Guarantees: each stage sees only the value of the one before.
Does not: save anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args

from apc.compiler.cache import Origin, origin_of, replayable
from apc.compiler.compiled import Model
from apc.compiler.components.component_library import Library, definition_of
from apc.compiler.equations.clocks import ClockedSystem, check_alone, partition
from apc.compiler.equations.flatten import FlatSystem, flatten
from apc.compiler.equations.structure import SortedSystem, sort
from apc.compiler.errors import ApcError, Mistakes, SourceLocation
from apc.compiler.files import recorded, replayed
from apc.compiler.functions.functions import build_functions
from apc.compiler.scene.scene import Topology, build_scene, library_folders
from apc.compiler.source.source import Source, read_source
from apc.compiler.timings import part

Stage = Literal["source", "scene", "flat", "clocked", "sorted", "compiled"]
STAGES: tuple[Stage, ...] = get_args(Stage)
StageValue = Source | Topology | FlatSystem | ClockedSystem | SortedSystem | Model


def compile_topology(path: Path) -> Model:
    """Compile a topology file. Raises ApcError with its mistakes."""
    value = run_stages(path, until="compiled")
    assert isinstance(value, Model)
    return value


def compile_again(origin: Origin, folder: Path) -> Model:
    """Compile the texts that a model was made from; no file of theirs is read.

    Parameters
    ----------
    origin
        The texts.
    folder
        Where they are said to stand in messages.

    Raises
    ------
    ApcError
        Their mistakes.
    """
    with replayed(replayable(origin, folder)):
        return compile_topology(folder / origin.topology)


def check_definition(path: Path) -> str:
    """Read a file that defines a component or connector, with what stands beside it; say what it is.

    Returns
    -------
    Its name and kind; an empty text of a topology.

    Raises
    ------
    ApcError
        The mistakes of the definition.
    """
    source = read_source(path)
    kind, name = definition_of(source)
    if not kind:
        return ""
    beside: list[ApcError] = []
    library = Library((path.parent,), beside)
    mistakes = Mistakes()
    with mistakes:
        if kind == "connector":
            library.connector(name)
        elif component := library.component(name):
            check_alone(component, SourceLocation(str(path)), mistakes)
    # Its own mistakes first.
    result = [*mistakes.found, *(mistake for error in beside for mistake in error.mistakes)]
    if result:
        raise ApcError(result)
    return f"{name}, a {kind}"


def linear_system(scene: Topology) -> SortedSystem | None:
    """Return the equations of linear analyses, None where no component has equations of its own for them."""
    if all(part.component.linearized is None for part in scene.parts):
        return None
    return sort(partition(flatten(scene, linear=True)))


def run_stages(path: Path, *, until: Stage) -> StageValue:
    """Run the stages up to and including `until`. Raises ApcError with the mistakes of one that fails."""
    return next(value for stage, value in each_stage(path) if stage == until)


def each_stage(path: Path) -> Iterator[tuple[Stage, StageValue]]:
    """Run the stages one by one, yielding each one's name and value as soon as it is done."""
    texts: dict[str, bytes] = {}
    with part("source"), recorded(texts):
        source = read_source(path)
    yield from stages_of(source, texts)


def stages_of(source: Source, texts: dict[str, bytes] | None = None) -> Iterator[tuple[Stage, StageValue]]:
    """Run the stages one by one on a source that has a path.

    Parameters
    ----------
    source
        The topology.
    texts
        What was read for it by path, if that is what stands there; gets what else is read.
    """
    assert source.path is not None
    path, texts = source.path, {} if texts is None else texts
    steps: dict[Stage, Callable[[Any], StageValue]] = {
        "scene": lambda source: build_scene(source, Library(library_folders(source))),
        "flat": flatten,
        "clocked": partition,
        "sorted": sort,
        "compiled": lambda ordered: build_functions(
            ordered, origin_of(path, texts), linear=linear_system(ordered.scene)
        ),
    }
    value: StageValue = source
    yield "source", value
    for stage, step in steps.items():
        with part(stage), recorded(texts):
            value = step(value)
        yield stage, value
