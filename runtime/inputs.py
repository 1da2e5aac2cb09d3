"""Which file a command means, and whether a compiled model still matches what it was made from.

Takes: paths. Gives: the topology or compiled model to work on; `check_outputs`.
Guarantees: a compiled model is used only while its topology, every text the topology names and the program
are those it was made from, by their content; a model that has no topology beside it speaks for itself; what a
topology says is never taken from a model that somebody else wrote; nothing is written where a command reads.
Does not: compile.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.cache import LARGEST, SUFFIX, Archive, changed, program_digest, read_archive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import (
    RefusedError,
    check_file,
    check_target,
    is_special,
    partial_name,
    read_file,
    same_file,
)
from apc.compiler.timings import part
from apc.opening import opened
from apc.suffixes import written

if TYPE_CHECKING:
    from apc.compiler.compiled import Model

YAML_SUFFIXES = (".yaml", ".yml")
_TOPOLOGY = re.compile(rb"^\xef?\xbb?\xbf?topology\s*:", re.MULTILINE)


def find_input(file: str | None = None, *, compiled_too: bool) -> Path:
    """Return the file that is named, or the only topology of the working folder, or its only compiled model.

    Parameters
    ----------
    file
        What is named, if anything is.
    compiled_too
        Whether a compiled model serves.

    Raises
    ------
    ApcError
        There is none, or there are several.
    """
    if file:
        return Path(file)
    path = Path()
    topologies = sorted(path for path in path.glob("*.yaml") if _is_topology(path))
    models = sorted(path.glob("*.apc")) if compiled_too else []
    orphans = [path for path in models if path.with_suffix(".yaml") not in topologies]
    candidates = [*topologies, *orphans]
    if len(candidates) == 1:
        return candidates[0]
    place = SourceLocation("this folder")
    if not candidates:
        what = "holds no topology" + (" and no compiled model" if compiled_too else "")
        raise ApcError(
            Diagnostic("E610", place, what, hint="apc new  (it writes a topology.yaml to start from)")
        )
    listed = ", ".join(str(path) for path in candidates[:10]) + (", …" if len(candidates) > 10 else "")
    raise ApcError(
        Diagnostic(
            "E611",
            place,
            f"holds {len(candidates)} scenes: {listed}",
            hint=f"apc … {_as_word(candidates[0])}",
        )
    )


def _is_topology(path: Path) -> bool:
    from apc.compiler.source.nodes import MAX_BYTES

    try:
        return _TOPOLOGY.search(read_file(path, MAX_BYTES)) is not None
    except RefusedError as refused:
        return refused.why == "large"  # which is told of when it is read


def load_fresh(path: Path) -> Model:
    """Read a compiled model. Raises ApcError if it is damaged, or if what it was made from has changed."""
    archive = read_archive(path)
    topology = path.with_name(archive.origin.topology)
    # `Path.is_file` raises for a name that is too long, which no file has.
    now = changed(archive, path.parent) if os.path.isfile(topology) else ""  # noqa: PTH113 -- see above
    if now:
        what = f"is stale: {now} has changed since it was compiled"
        raise ApcError(Diagnostic("E605", SourceLocation(str(path)), what, hint=f"apc compile {topology}"))
    return opened(archive, path.parent)


def load_or_compile(path: Path) -> Model:
    """Return the compiled model of a file.

    A compiled model is read. A topology is compiled in memory and checks itself, unless the model beside it
    is what compiling it now would give.

    Raises
    ------
    ApcError
        The file is at fault.
    """
    if path.suffix == ".apc":
        return load_fresh(path)
    if (archive := compiled_already(path)) is not None:
        return opened(archive, path.parent)
    from apc.compiler.pipeline import compile_topology
    from apc.frame.start_checks import check_values

    system = compile_topology(path)
    check_values(system)
    return system


@part("read")
def open_scene(
    file: str | None,
    settings: Sequence[str],
    outputs: Mapping[str, Path | None] | None = None,
    *,
    hands: str = "free",
    varied: Iterable[str] = (),
    notify: Callable[[str], None] | None = None,
) -> Model:
    """Return the compiled model that a command means.

    Parameters
    ----------
    file
        A topology or compiled model; the only one of the working folder if not given.
    settings
        Parameters to change, each `NAME=QUANTITY`.
    outputs
        What the command will write, by the option that says so: see `check_outputs`.
    hands
        How hands are to be taken, see `devices.with_hands`.
    varied
        The parameters that the command varies, each a text that begins with a name.
    notify
        Is told what a setting for all groups takes the place of.

    Raises
    ------
    ApcError
        As `find_input`, `load_or_compile`, `check_outputs`, `devices.with_hands`,
        `devices.refuse_numberless`, `overrides.parse_override` and `overrides.apply`.
    """
    path = find_input(file, compiled_too=True)
    system = load_or_compile(path)
    check_outputs(path, (name for name, _ in system.origin.texts), outputs or {})
    if hands != "free":
        from apc.frame.devices import refuse_numberless, with_hands

        system = with_hands(system, hands)
        refuse_numberless(hands, (*settings, *varied))
    if not settings:
        return system
    from apc.frame.names import OVERRIDE, notes_for_all_groups
    from apc.frame.overrides import apply, parse_override

    overrides = [parse_override(system, text) for text in settings]
    for place, override in enumerate(overrides):
        if any(override.free == other.free for other in overrides[:place]):
            what, hint = f"{override.free.label} is set twice", f'--set "{settings[place]}"'
            raise ApcError(Diagnostic("E621", OVERRIDE, what, hint=hint))
    if notify is not None:
        for note in notes_for_all_groups(system, [override.free for override in overrides]):
            notify(note)
    return apply(system, overrides)


def refuse_model(path: Path, command: str) -> None:
    """Refuse a compiled model (E615) where a command tells of equations and texts as they were written."""
    if path.suffix == ".apc":
        what = "is a compiled model, and this reads the topology that it was made from"
        hint = f"apc {command} {path.with_suffix('.yaml')}"
        raise ApcError(Diagnostic("E615", SourceLocation(str(path)), what, hint=hint))


def check_model_name(topology: Path) -> None:
    """Refuse a topology whose compiled model would take the place of something else.

    Raises
    ------
    ApcError
        E617 another topology's model has the same name; E601 of that name is a device or pipe, which whoever
        packed the folder put there, or a link to what is no compiled model.
    """
    if not topology.name:
        return  # "." or "/": a folder, which whoever reads it says
    model = topology.with_suffix(".apc")
    try:
        check_file(model, LARGEST)
    except RefusedError as refused:
        if refused.why == "special":
            raise _not_written(model, f"it {refused.words}") from None
    # `Path.is_symlink` raises for a name that is too long, which whoever reads the topology says.
    if os.path.islink(model) and Path(os.path.realpath(model)).suffix != model.suffix:  # noqa: PTH114 -- see above
        raise _not_written(model, "it is a link to what is no compiled model")
    for suffix in YAML_SUFFIXES:
        other = topology.parent / f"{topology.stem}{suffix}"
        if other.name != topology.name and not same_file(other, topology) and _is_topology(other):
            what = f"and {other.name} would both be compiled to {topology.stem}.apc"
            raise ApcError(Diagnostic("E617", SourceLocation(str(topology)), what, hint=_renaming(topology)))


def _not_written(model: Path, why: str) -> ApcError:
    return ApcError(
        Diagnostic("E601", SourceLocation(str(model)), f"can't be written: {why}", hint=f"rm {model}")
    )


def _as_word(path: Path) -> str:
    """Return a path as a word of a command line, which is no option."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))


def _renaming(topology: Path) -> str:
    return f"mv {topology} {topology.with_name(f'{topology.stem}-2{topology.suffix}')}"


def check_topology_outputs(path: Path, outputs: Mapping[str, Path | None]) -> None:
    """As `check_outputs`, for a command that reads a topology and not its model."""
    given = [output for output in outputs.values() if output is not None]
    for output in given:
        check_target(output)
    if any(output.exists() for output in given):
        from apc.compiler.pipeline import run_stages
        from apc.compiler.scene.scene import Topology, library_folders
        from apc.compiler.source.source import read_source

        scene = run_stages(path, until="scene")
        assert isinstance(scene, Topology)
        folders = (str(folder.resolve()) for folder in library_folders(read_source(path)))
        check_outputs(path, (*scene.texts, *folders), outputs)


def check_outputs(path: Path, texts: Iterable[str], outputs: Mapping[str, Path | None]) -> None:
    """Refuse to write to a file that the command reads, or to one file twice.

    Parameters
    ----------
    path
        The topology or compiled model.
    texts
        What it names, from its folder: files, and folders of components.
    outputs
        What will be written, by the option that says so (see `check_suffix`); None is nothing.

    Raises
    ------
    ApcError
        E601 one of them can't be written; E616 one is read, or given twice.
    """
    own = (path, path.parent / f"{path.stem}.yaml", path.parent / f"{path.stem}.apc")
    named = [*own, *(path.parent / text for text in texts)]

    def read(file: Path) -> bool:
        # `Path.is_file` raises for a name that is too long, which whoever writes it says.
        is_file = os.path.isfile(file)  # noqa: PTH113 -- see above
        return is_file and any(same_file(file, path) or _is_below(file, path) for path in named)

    given = [(option, output) for option, output in outputs.items() if output is not None]
    for place, (option, output) in enumerate(given):
        check_target(output)
        hint = written(option, output.with_name(f"{output.stem}-result{output.suffix}"))
        for other, before in given[:place]:
            if is_special(output):
                continue  # a device or pipe takes what both write
            if output.absolute() == before.absolute() or same_file(output, before):
                what = f"is given to {other} and to {option}: the second would replace the first"
                raise ApcError(Diagnostic("E616", SourceLocation(str(output)), what, hint=hint))
        # Beside rows stands what made them, see `present.recording`; beside C its header, see `exports.code`.
        beside = (f"{output.name}.json", f"{output.stem}.h", f"{output.stem}_test.c")
        for file in (output, partial_name(output), *(output.with_name(name) for name in beside)):
            if read(file):
                what = f"is read by this command: {option.removesuffix('=')} would replace it"
                raise ApcError(Diagnostic("E616", SourceLocation(str(file)), what, hint=hint))


def _is_below(file: Path, folder: Path) -> bool:
    """Return whether a file is one that a folder of components is read for."""
    return file.suffix == SUFFIX and folder.is_dir() and file.resolve().is_relative_to(folder.resolve())


def compiled_already(topology: Path) -> Archive | None:
    """Return the compiled model beside a topology if it is what compiling it now would give.

    That it is, only this user's own seal says: anybody can write what a file says of itself.
    """
    try:
        archive = read_archive(topology.with_suffix(".apc"))
    except (ApcError, ValueError):  # ValueError: "." and "/" have no suffix
        return None
    fresh = (
        archive.sealed
        and archive.compiled
        and archive.origin.topology == topology.name
        and archive.origin.program == program_digest()
        and not changed(archive, topology.parent)
    )
    return archive if fresh else None
