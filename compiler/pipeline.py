"""The stages one after another: a topology file to a compiled model, or to any stage before it.

Takes: a path. Gives: the value of the last stage asked for.
Guarantees: each stage sees only the value of the one before.
Does not: save anything.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from apc.compiler.clocks import ClockedSystem, partition
from apc.compiler.compiled import CompiledSystem, Origin
from apc.compiler.flatten import FlatSystem, flatten
from apc.compiler.functions import build_functions
from apc.compiler.library import Library
from apc.compiler.scene import Scene, build_scene
from apc.compiler.source import Source, read_source
from apc.compiler.structure import SortedSystem, sort

Stage = Literal["source", "scene", "flat", "clocked", "sorted", "compiled"]
STAGES: tuple[Stage, ...] = ("source", "scene", "flat", "clocked", "sorted", "compiled")
StageValue = Source | Scene | FlatSystem | ClockedSystem | SortedSystem | CompiledSystem


def compile_topology(path: Path) -> CompiledSystem:
    """Compile a topology file. Raises ApcError with its mistakes."""
    value = run_stages(path, until="compiled")
    assert isinstance(value, CompiledSystem)
    return value


def run_stages(path: Path, *, until: Stage) -> StageValue:
    """Run the stages up to and including `until`. Raises ApcError with the mistakes of one that fails."""
    source = read_source(path)
    if until == "source":
        return source
    library = Library()
    scene = build_scene(source, library)
    if until == "scene":
        return scene
    flat = flatten(scene)
    if until == "flat":
        return flat
    clocked = partition(flat)
    if until == "clocked":
        return clocked
    sorted_system = sort(clocked)
    if until == "sorted":
        return sorted_system
    return build_functions(sorted_system, Origin(path.name, ((path.name, source.digest), *library.texts)))
