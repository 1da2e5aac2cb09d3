"""The input file of a command, and whether a compiled model is up to date.

Takes: paths. Gives: `find_input`, the topology or compiled model for a path; `open_topology`,
`load_or_compile`, `load_fresh`, `compiled_already`; `refuse_model`, `check_model_name`, `check_outputs`,
`check_topology_outputs`.
Guarantees: a compiled model is used only if its topology, all referenced files and the program are unchanged
in content. A model without a topology in its folder is used alone. A topology is never replaced by a model
written by another user. No output overwrites an input.
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
from apc.inputs.model_loading import loaded_model
from apc.support.suffixes import written

if TYPE_CHECKING:
    from apc.compiler.compiled import Model

YAML_SUFFIXES = (".yaml", ".yml")
_TOPOLOGY = re.compile(rb"^\xef?\xbb?\xbf?topology\s*:", re.MULTILINE)


def find_input(file: str | None = None, *, compiled_too: bool) -> Path:
    """Return the named file, or the only topology of the working folder, or its only compiled model.

    Parameters
    ----------
    file
        The path as given, None for the working folder.
    compiled_too
        Whether a compiled model is accepted.

    Raises
    ------
    ApcError
        E610 there is no topology, E611 there are several.
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
    location = SourceLocation("current folder")
    if not candidates:
        message = "no topology" + (" or compiled model" if compiled_too else "")
        raise ApcError(Diagnostic("E610", location, message, fix="apc new"))
    fix = ", or ".join(map(_as_word, candidates[:10]))
    raise ApcError(Diagnostic("E611", location, "topologies", "one", str(len(candidates)), fix))


def _is_topology(path: Path) -> bool:
    """Return whether a file has a top-level key `topology`."""
    from apc.compiler.source.nodes import MAX_BYTES

    try:
        return _TOPOLOGY.search(read_file(path, MAX_BYTES)) is not None
    except RefusedError as refused:
        return refused.why == "large"  # the reader reports the error


def load_fresh(path: Path) -> Model:
    """Return the compiled model in a file.

    Raises ApcError if it is damaged, or if its sources have changed.
    """
    archive = read_archive(path)
    topology = path.with_name(archive.origin.topology)
    # `Path.is_file` raises for a name that is too long, which no file has.
    now = changed(archive, path.parent) if os.path.isfile(topology) else ""  # noqa: PTH113 -- see above
    if now:
        message = f"model is out of date: {now} has changed"
        raise ApcError(Diagnostic("E605", SourceLocation(str(path)), message, fix=f"apc compile {topology}"))
    return loaded_model(archive, path.parent)


def load_or_compile(path: Path) -> Model:
    """Return the compiled model of a file.

    A compiled model is read. A topology is compiled in memory and checked, unless there is an up-to-date
    model in its folder.

    Raises
    ------
    ApcError
        The file is invalid.
    """
    if path.suffix == ".apc":
        return load_fresh(path)
    if (archive := compiled_already(path)) is not None:
        return loaded_model(archive, path.parent)
    from apc.compiler.pipeline import compile_topology
    from apc.lifting.start_checks import check_values

    model = compile_topology(path)
    check_values(model)
    return model


@part("read")
def open_topology(
    file: str | None,
    settings: Sequence[str],
    outputs: Mapping[str, Path | None] | None = None,
    *,
    hands: str = "free",
    operating_point: str = "start",
    varied: Iterable[str] = (),
    notify: Callable[[str], None] | None = None,
) -> Model:
    """Return the compiled model for a command.

    Parameters
    ----------
    file
        A topology or compiled model; by default the only one of the working folder.
    settings
        Parameters to change, each `NAME=QUANTITY`.
    outputs
        The output files of the command, by option: see `check_outputs`.
    hands
        The treatment of hands, see `devices.with_hands`.
    operating_point
        The point of linearization, see `rest_position.linearized_at`.
    varied
        The varied parameters of the command, each a text that begins with a name.
    notify
        The function called with a note if a setting for all groups replaces group values.

    Raises
    ------
    ApcError
        As `find_input`, `load_or_compile`, `check_outputs`, `devices.with_hands`,
        `devices.refuse_numberless`, `overrides.parse_override`, `overrides.apply` and
        `rest_position.linearized_at`.
    """
    path = find_input(file, compiled_too=True)
    model = load_or_compile(path)
    check_outputs(path, (name for name, _ in model.origin.texts), outputs or {})
    if hands != "free":
        from apc.lifting.devices import refuse_numberless, with_hands

        model = with_hands(model, hands)
        refuse_numberless(hands, (*settings, *varied))
    if settings:
        model = _with_settings(model, settings, notify)
    if operating_point != "start":
        from apc.lifting.rest_position import linearized_at

        model = linearized_at(model, operating_point)
    return model


def _with_settings(model: Model, settings: Sequence[str], notify: Callable[[str], None] | None) -> Model:
    """Return a model with the settings of a command; arguments and errors as in `open_topology`."""
    from apc.parameter_values.overrides import apply, parse_override
    from apc.parameter_values.parameter_names import OVERRIDE, notes_for_all_groups

    overrides = [parse_override(model, text) for text in settings]
    for index, override in enumerate(overrides):
        if any(override.free == other.free for other in overrides[:index]):
            message, fix = f"two values of {override.free.label}", f'--set "{settings[index]}"'
            raise ApcError(Diagnostic("E621", OVERRIDE, message, fix=fix))
    if notify is not None:
        for note in notes_for_all_groups(model, [override.free for override in overrides]):
            notify(note)
    return apply(model, overrides)


def refuse_model(path: Path, command: str) -> None:
    """Raise ApcError (E615) for a compiled model if a command requires the topology."""
    if path.suffix == ".apc":
        message = f"file is a compiled model; {command} requires the topology"
        fix = f"apc {command} {path.with_suffix('.yaml')}"
        raise ApcError(Diagnostic("E615", SourceLocation(str(path)), message, fix=fix))


def check_model_name(topology: Path) -> None:
    """Raise ApcError for a topology whose compiled model would replace another file.

    Raises
    ------
    ApcError
        E617 another topology's model has the same name; E601 the name belongs to a device, a pipe, or a link
        to a file that is no compiled model.
    """
    if not topology.name:
        return  # "." or "/": a folder; its reader reports the error
    model = topology.with_suffix(".apc")
    try:
        check_file(model, LARGEST)
    except RefusedError as refused:
        if refused.why == "special":
            raise _not_written(model, f"it {refused.words}") from None
    # `Path.is_symlink` raises for an overlong name; the reader of the topology reports it.
    if os.path.islink(model) and Path(os.path.realpath(model)).suffix != model.suffix:  # noqa: PTH114 -- see above
        raise _not_written(model, "it is a link to a file of another kind")
    for suffix in YAML_SUFFIXES:
        other = topology.parent / f"{topology.stem}{suffix}"
        if other.name != topology.name and not same_file(other, topology) and _is_topology(other):
            message = f"same model file, {topology.stem}.apc, as {other.name}"
            raise ApcError(
                Diagnostic("E617", SourceLocation(str(topology)), message, fix=_renaming(topology))
            )


def _not_written(model: Path, why: str) -> ApcError:
    """Return the error E601 for a compiled model that can't be written."""
    return ApcError(
        Diagnostic("E601", SourceLocation(str(model)), f"can't be written: {why}", fix=f"rm {model}")
    )


def _as_word(path: Path) -> str:
    """Return a path as a quoted argument of a command line, which is no option."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))


def _renaming(topology: Path) -> str:
    """Return the command that renames a topology."""
    return f"mv {topology} {topology.with_name(f'{topology.stem}-2{topology.suffix}')}"


def check_topology_outputs(path: Path, outputs: Mapping[str, Path | None]) -> None:
    """Check outputs as `check_outputs` does, for a command that reads a topology instead of its model."""
    given = [output for output in outputs.values() if output is not None]
    for output in given:
        check_target(output)
    if any(output.exists() for output in given):
        from apc.compiler.source.source import read_source
        from apc.compiler.topology.topology import library_folders, read_topology

        source = read_source(path)
        folders = (str(folder.resolve()) for folder in library_folders(source))
        check_outputs(path, (*read_topology(source).texts, *folders), outputs)


def check_outputs(path: Path, texts: Iterable[str], outputs: Mapping[str, Path | None]) -> None:
    """Raise ApcError for an output that is an input file of the command, or another output.

    Parameters
    ----------
    path
        The topology or compiled model.
    texts
        The references of the topology, relative to its folder: files, and folders of components.
    outputs
        The output files by option (see `suffixes.check_suffix`); None for no output.

    Raises
    ------
    ApcError
        E601 an output can't be written; E616 an output is an input file, or is given twice.
    """
    own_files = (path, path.parent / f"{path.stem}.yaml", path.parent / f"{path.stem}.apc")
    input_files = [*own_files, *(path.parent / text for text in texts)]

    def read(file: Path) -> bool:
        """Return whether a file is an input file of the command."""
        # `Path.is_file` raises for an overlong name; the writer reports it.
        is_file = os.path.isfile(file)  # noqa: PTH113 -- see above
        return is_file and any(same_file(file, path) or _is_below(file, path) for path in input_files)

    given = [(option, output) for option, output in outputs.items() if output is not None]
    for index, (option, output) in enumerate(given):
        check_target(output)
        fix = written(option, output.with_name(f"{output.stem}-result{output.suffix}"))
        for other, before in given[:index]:
            if is_special(output):
                continue  # a device or pipe receives both outputs
            if output.absolute() == before.absolute() or same_file(output, before):
                message = f"same file for {other} and {option}"
                raise ApcError(Diagnostic("E616", SourceLocation(str(output)), message, fix=fix))
        # Rows have a provenance file, see `output.recording`; C code has a header, see `exports.code`.
        companions = (f"{output.name}.json", f"{output.stem}.h", f"{output.stem}_test.c")
        for file in (output, partial_name(output), *(output.with_name(name) for name in companions)):
            if read(file):
                message = f"{option.removesuffix('=')} would replace an input file"
                raise ApcError(Diagnostic("E616", SourceLocation(str(file)), message, fix=fix))


def _is_below(file: Path, folder: Path) -> bool:
    """Return whether a file is a component file in a folder of components."""
    return file.suffix == SUFFIX and folder.is_dir() and file.resolve().is_relative_to(folder.resolve())


def compiled_already(topology: Path) -> Archive | None:
    """Return the compiled model in a topology's folder if it is up to date, else None.

    Only a model with this user's signature is used: other files could be forged.
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
