"""NAME.apc: the compiled model on disk.

Takes: `CompiledSystem`. Gives: a file, and the same system back.
Guarantees: written whole or not at all; a damaged file, or one of another format version, is refused by name;
every name, row and peer that one part of a model names is there in the other; nothing is unpickled, and no
library or topology is needed to load.
Does not: compile, or ask whether the topology has changed since (see `cache`).

The file is a ZIP archive: `model.json` holds the structure, the numbers and the SHA-256 of every other
member; each CasADi function is a member in CasADi's own serialization, each array one in NumPy's.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import tempfile
import types
import typing
import zipfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from apc.compiler.cache import DAMAGE, FORMAT, LARGEST, MEMBER
from apc.compiler.compiled import CompiledSystem, Graph, Kind
from apc.compiler.errors import ApcError, Mistake, Place

# CasADi's reader can crash on text that isn't its own, so every member is checked against its digest first.
FOREIGN = "it is not what apc compile writes"


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it. Raises ApcError if it can't."""
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        reason = error.strerror or str(error)
        raise ApcError(Mistake("E601", Place(str(path)), f"can't be written: {reason}")) from error
    except BaseException:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise


def save(system: CompiledSystem, path: Path) -> None:
    """Write a compiled model. Raises ApcError if the file can't be written."""
    members: dict[str, bytes] = {}
    document = _plain(system, members)
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in members.items()}
    text = json.dumps({"format": FORMAT, "system": document, "members": digests}, indent=1, sort_keys=True)

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in {MEMBER: text.encode(), **members}.items():
                # A fixed date: the same model gives the same bytes.
                archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)

    write_atomically(path, write)


def load(path: Path) -> CompiledSystem:
    """Read a compiled model. Raises ApcError if the file is missing, damaged or of another version."""
    try:
        if path.exists() and not path.is_file():  # a named pipe that nobody writes to would block for ever
            kind = "a folder" if path.is_dir() else "no ordinary file"
            raise ApcError(Mistake("E602", Place(str(path)), f"is {kind}, not a compiled model"))
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > LARGEST:
                raise _damaged(path, f"it unpacks to more than {LARGEST >> 20} MiB")
            document = json.loads(archive.read(MEMBER))
            if document["format"] != FORMAT:
                what = f"has format version {document['format']}, this program reads version {FORMAT}"
                raise ApcError(Mistake("E603", Place(str(path)), what, hint=f"apc compile {path.stem}.yaml"))
            members = {}
            for name, digest in document["members"].items():
                content = archive.read(name)
                if hashlib.sha256(content).hexdigest() != digest:
                    raise _damaged(path, f"its member {name} was changed")
                members[name] = _member(name, content)
        system = _typed(CompiledSystem, document["system"], members)
    except FileNotFoundError as error:
        raise ApcError(Mistake("E602", Place(str(path)), "does not exist", hint="apc compile")) from error
    except OSError as error:
        if error.strerror is None:  # a decompressor's
            raise _damaged(path, FOREIGN) from error
        raise ApcError(Mistake("E602", Place(str(path)), f"can't be read: {error.strerror}")) from error
    except DAMAGE as error:
        raise _damaged(path, FOREIGN) from error
    assert isinstance(system, CompiledSystem)
    if not _is_consistent(system):
        raise _damaged(path, FOREIGN)
    return system


def _is_consistent(system: CompiledSystem) -> bool:
    """Return whether every name and row that one part of a model gives exists in the other."""
    timings = {timing.name for timing in system.timings}
    clocks = {clock.name for clock in system.clocks}
    links = {link.name for link in system.links}
    parameters = {parameter.name for parameter in system.parameters}
    groups = {group.name for group in system.groups}
    named = [timing for clock in system.clocks for timing in (clock.period, clock.phase)]
    named += [link.delay for link in system.links]
    named += [pair.delay for link in system.links for pair in link.delays]
    channels = [link.channel for link in system.links if link.channel is not None]
    named += [channel.jitter for channel in channels if channel.jitter is not None]
    losses = [dataclasses.astuple(channel.loss) for channel in channels if channel.loss is not None]
    numbers = [*system.parameters, *(value for group in system.groups for value in group.values)]
    return (
        bool(system.groups)
        and timings.issuperset(named)
        and all(parameters.issuperset(loss) for loss in losses)
        and all(channel.trace is None or channel.trace.size > 0 for channel in channels)
        and all(link.clock in clocks for link in system.links)
        and all({pair.sender, pair.receiver} <= groups for link in system.links for pair in link.delays)
        and all(0 <= group.kind < len(system.kinds) and group.count > 0 for group in system.groups)
        and all(len(column.values) == group.count for group in system.groups for column in group.columns)
        and parameters.issuperset(column.name for group in system.groups for column in group.columns)
        and parameters.issuperset(value.name for group in system.groups for value in group.values)
        and all(one.exact is None or float(one.exact) == one.value for one in numbers)
        and all(_is_graph_consistent(link.graph, system.peers) for link in system.links)
        and all(_is_kind_consistent(kind, timings, clocks, parameters) for kind in system.kinds)
        and links.issuperset(sending.link for kind in system.kinds for sending in kind.sends)
        and all(_is_heard(kind, system) for kind in system.kinds)
    )


def _is_graph_consistent(graph: Graph, peers: int) -> bool:
    """Return whether the arcs of a graph, if it has any, are between peers that there are, each weighted."""
    count = len(graph.weights)
    pairs = graph.arcs.reshape(-1, 2) if graph.arcs.size else np.empty((0, 2))
    return (
        graph.shape in ("complete", "ring", "star", "arcs")
        and (graph.shape == "arcs" or not count)
        and len(pairs) == count
        and bool(((pairs >= 0) & (pairs < peers)).all())
    )


def _is_heard(kind: Kind, system: CompiledSystem) -> bool:
    """Return whether all that a kind hears is sent, row by row; an edge takes all of the sender's rows.

    Of a complete graph those are heard that send over the link, one at least; of another graph all send.
    """
    rows = {
        link.name: [
            len(sending.channels)
            for group in system.groups
            for sending in system.kinds[group.kind].sends
            if sending.link == link.name
        ]
        for link in system.links
    }
    n_x, n_u, n_p = len(kind.states), len(kind.holds), len(kind.parameters)
    return all(
        bool(rows.get(receive.link))
        and 0 <= receive.channel < min(rows[receive.link])
        and (
            receive.edge is None
            or _sizes(receive.edge)
            == ([n_x, n_u, len(partition.memories), max(rows[receive.link]), n_p, 1], [1])
        )
        for partition in kind.clocks
        for receive in partition.receives
    )


def _is_kind_consistent(kind: Kind, timings: set[str], clocks: set[str], parameters: set[str]) -> bool:
    """Return the same for one kind; its functions must have the sizes its names ask for."""
    partitions = {partition.clock: partition for partition in kind.clocks}
    n_x, n_u, n_p = len(kind.states), len(kind.holds), len(kind.parameters)
    parameters_of = set(kind.parameters)  # what starts is looked up among them
    return (
        parameters.issuperset(kind.parameters)
        and parameters_of.issuperset(state.start for state in kind.states)
        and partitions.keys() <= clocks
        and all(len(partition.units) == len(partition.outputs) for partition in kind.clocks)
        and all(len(partition.starts) == len(partition.memories) for partition in kind.clocks)
        and all(parameters_of.issuperset(partition.starts) for partition in kind.clocks)
        and all(
            0 <= memory < len(partition.outputs) for partition in kind.clocks for memory in partition.memories
        )
        and (
            kind.ports is None or _sizes(kind.ports.port) == ([n_x, n_u, n_p, 1], [2 * len(kind.ports.parts)])
        )
        and all(hold.delay in timings and hold.clock in partitions for hold in kind.holds)
        and all(0 <= hold.output < len(partitions[hold.clock].outputs) for hold in kind.holds)
        and _sizes(kind.derivative) == ([n_x, n_u, n_p, 1], [n_x])
        and all(
            _sizes(partition.tick)
            == (
                [n_x, n_u, len(partition.memories), len(partition.receives), n_p, 1],
                [len(partition.outputs)],
            )
            for partition in kind.clocks
        )
        and all(
            _sizes(sending.send) == ([n_x, n_u, n_p, 1], [len(sending.channels)]) for sending in kind.sends
        )
    )


def _sizes(function: Any) -> tuple[list[int], list[int]]:
    inputs = [int(function.numel_in(i)) for i in range(function.n_in())]
    return inputs, [int(function.numel_out(i)) for i in range(function.n_out())]


def _damaged(path: Path, why: str) -> ApcError:
    mistake = Mistake("E604", Place(str(path)), f"is damaged: {why}", hint=f"apc compile {path.stem}.yaml")
    return ApcError(mistake)


def _member(name: str, content: bytes) -> Any:
    """Return the CasADi function or the array that a member holds."""
    if name.endswith(".npy"):
        return np.load(io.BytesIO(content), allow_pickle=False)
    return casadi.Function.deserialize(content.decode())


def _plain(value: Any, members: dict[str, bytes]) -> Any:
    """Return dataclasses as dictionaries, fractions as texts, functions and arrays as names of members."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name), members) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(item, members) for item in value]
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, casadi.Function):
        name = f"function{len(members)}.casadi"
        members[name] = value.serialize().encode()
        return name
    if isinstance(value, np.ndarray):
        name = f"array{len(members)}.npy"
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=False)
        members[name] = buffer.getvalue()
        return name
    return value


def _typed(wanted: Any, value: Any, members: dict[str, Any]) -> Any:
    """Build a value of the wanted type from its plain form."""
    origin = typing.get_origin(wanted)
    if dataclasses.is_dataclass(wanted) and isinstance(wanted, type):
        hints = typing.get_type_hints(wanted)
        return wanted(
            **{f.name: _typed(hints[f.name], value[f.name], members) for f in dataclasses.fields(wanted)}
        )
    if origin is tuple:
        if not isinstance(value, list):
            raise TypeError(f"expected a list, got {value!r}")
        arguments = typing.get_args(wanted)
        if arguments[-1] is Ellipsis:
            return tuple(_typed(arguments[0], item, members) for item in value)
        return tuple(_typed(a, item, members) for a, item in zip(arguments, value, strict=True))
    if origin in (typing.Union, types.UnionType):
        inner = [a for a in typing.get_args(wanted) if a is not type(None)]
        return None if value is None else _typed(inner[0], value, members)
    if wanted is Fraction:
        return Fraction(value)
    if wanted is Any or origin is np.ndarray:
        return members[value]
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, wanted):
        raise TypeError(f"expected {wanted}, got {value!r}")
    return value
