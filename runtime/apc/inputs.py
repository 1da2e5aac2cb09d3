"""Which file a command means, and whether a compiled model still matches what it was made from.

Takes: paths. Gives: the topology or compiled model to work on.
Guarantees: a compiled model is used only while its topology, every text the topology names and the program
are those it was made from, by their content; a model that has no topology beside it speaks for itself. What a
topology says is never taken from a model that somebody else wrote.
Does not: compile.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.cache import DAMAGE, Archive, changed, read_archive, record_of
from apc.compiler.errors import ApcError, Mistake, Place

if TYPE_CHECKING:
    from apc.compiler.compiled import CompiledSystem

_TOPOLOGY = re.compile(rb"^\xef?\xbb?\xbf?topology\s*:", re.MULTILINE)


def find_input(*, compiled_too: bool) -> Path:
    """Return the only topology of the working folder, or failing that, its only compiled model.

    Parameters
    ----------
    compiled_too
        Whether a compiled model serves.

    Raises
    ------
    ApcError
        There is none, or there are several.
    """
    here = Path()
    topologies = sorted(path for path in here.glob("*.yaml") if _is_topology(path))
    models = sorted(here.glob("*.apc")) if compiled_too else []
    orphans = [path for path in models if path.with_suffix(".yaml") not in topologies]
    candidates = [*topologies, *orphans]
    if len(candidates) == 1:
        return candidates[0]
    place = Place("this folder")
    if not candidates:
        what = "holds no topology" + (" and no compiled model" if compiled_too else "")
        raise ApcError(
            Mistake("E610", place, what, hint="apc new  (it writes a topology.yaml to start from)")
        )
    listed = ", ".join(str(path) for path in candidates[:10]) + (", …" if len(candidates) > 10 else "")
    raise ApcError(
        Mistake("E611", place, f"holds {len(candidates)} scenes: {listed}", hint=f"apc … {candidates[0]}")
    )


def _is_topology(path: Path) -> bool:
    from apc.compiler.source.source import (
        MAX_BYTES,  # with a YAML parser, which a compiled model does without
    )

    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return _TOPOLOGY.search(file.read(MAX_BYTES)) is not None
    except OSError:
        return False


def load_fresh(path: Path) -> CompiledSystem:
    """Read a compiled model. Raises ApcError if it is damaged, or if what it was made from has changed."""
    from apc.compiler.store import load_with_record

    system, record = load_with_record(path)
    now = changed(record, path.parent) if path.with_name(record.topology).is_file() else ""
    if now:
        what = f"is stale: {now} has changed since it was compiled"
        hint = f"apc compile {path.with_name(record.topology)}"
        raise ApcError(Mistake("E605", Place(str(path)), what, hint=hint))
    return system


def load_or_compile(path: Path) -> CompiledSystem:
    """Return the compiled model of a file.

    A compiled model is read. A topology is compiled in memory and checks itself, unless the model beside it
    is what compiling it now would give.

    Raises
    ------
    ApcError
        The file is at fault.
    """
    from apc.compiler.store import unpacked

    if path.suffix == ".apc":
        return load_fresh(path)
    if path.is_file() and (archive := compiled_already(path)) is not None:
        try:
            return unpacked(archive, path.with_suffix(".apc"))
        except (ApcError, *DAMAGE):
            pass  # it is only a saving of time; the topology itself decides
    from apc.compiler.pipeline import compile_topology
    from apc.runtime.analysis.selfcheck import check_frame

    system = compile_topology(path)
    check_frame(system)
    return system


def open_scene(file: str | None, settings: Sequence[str]) -> CompiledSystem:
    """Return the compiled model that a command means.

    Parameters
    ----------
    file
        A topology or compiled model; the only one of the working folder if not given.
    settings
        Parameters to change, each `NAME=QUANTITY`.

    Raises
    ------
    ApcError
        As `find_input`, `load_or_compile`, `overrides.parse_override` and `overrides.apply`.
    """
    system = load_or_compile(Path(file) if file else find_input(compiled_too=True))
    if not settings:
        return system
    from apc.runtime.frame.overrides import apply, parse_override

    return apply(system, [parse_override(system, text) for text in settings])


def compiled_already(topology: Path) -> Archive | None:
    """Return the compiled model beside a topology if it is what compiling it now would give.

    That it is, only this user's own seal says: anybody can write what a file says of itself.
    """
    path = topology.with_suffix(".apc")
    try:
        archive = read_archive(path) if path.is_file() else None
        if archive is None or not archive.sealed:
            return None
        record = record_of(archive)
        fresh = record.topology == topology.name and not changed(record, topology.parent)
    except (OSError, *DAMAGE):
        return None
    return archive if fresh else None
