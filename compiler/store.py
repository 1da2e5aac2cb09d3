"""NAME.apc: the compiled model on disk.

Takes: `CompiledSystem`. Gives: a file, and the same system back; `typed`.
Guarantees: written whole or not at all; a damaged file, or one of another format version, is refused by name;
every name is one that a topology can give, and each that one part of a model names, as every row and peer, is
there in the other. A file from anywhere is only data: nothing in it is run or unpickled, no library of its is
loaded; it is checked in full before anything is made of it, and what is made is no larger than what it holds.
No topology is needed to load.
Does not: compile, or ask whether the topology has changed since (see `cache`), or whether a model is true to
its topology.

The file is a ZIP archive: `model.json` holds the structure, the numbers, the functions as plain data (see
`plain`) and the SHA-256 of every other member; each array is a member, its numbers in little-endian order.
What `apc compile` wrote has a `seal` of the user's (see `seal`) on `model.json`: only then it stands for what
the topology beside it compiles to.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import math
import re
import types
import typing
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from apc.compiler.cache import (
    DAMAGE,
    FORMAT,
    MEMBER,
    SEAL,
    Archive,
    DamageError,
    Record,
    read_archive,
    record_of,
)
from apc.compiler.compiled import (
    LARGEST_COUNT,
    MOST_GROUPS,
    CompiledSystem,
    Formula,
    Graph,
    Kind,
    Parameter,
    Receive,
    Timing,
    counts_peers,
)
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import RefusedError, write_file
from apc.compiler.formula import EXACT
from apc.compiler.language.si_forms import is_si
from apc.compiler.plain import PlainFunction, plain, read_function
from apc.compiler.seal import seal
from apc.compiler.timings import part

FOREIGN = "it is not what apc compile writes"
# What names are made of: words, with places in arrays; of a link's loss two numbers have netem's names.
_WORD = r"[A-Za-z][A-Za-z0-9_]{0,62}"
_PLACED = rf"{_WORD}(\[[0-9]+\])*"
_PATH = rf"{_PLACED}(\.{_PLACED})*(\.1-[hk])?"
_KIND = rf"{_WORD}( and {_WORD})*"
_PARAMETER = rf"{_PATH}|count\({_WORD}\)"
_TIMING = rf"{_PATH}|no delay|delay of {_PATH}( at {_KIND})?"
_HEARD = r"(mean|sum|max|min|count)\((?!.*(\*/|/[/*]|\.\.))[A-Za-z0-9_.()\[\]{}<>=!,+*/^ -]+\)"
_RATIONAL = re.compile(r"-?[0-9]{1,4000}(/[0-9]{1,4000})?\Z")


@part("save")
def save(system: CompiledSystem, path: Path, *, sealed: bool = False) -> None:
    """Write a compiled model, `sealed` if it was compiled now. Raises ApcError if it can't be written."""
    members: dict[str, bytes] = {}
    document = _plain(system, members)
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in members.items()}
    whole = {"format": FORMAT, "system": document, "members": digests}
    text = json.dumps(whole, separators=(",", ":"), sort_keys=True).encode()
    mark = {SEAL: seal(text).encode()} if sealed else {}

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w") as archive:
            for name, content in {MEMBER: text, **members, **mark}.items():
                # A fixed date: the same model gives the same bytes.
                archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)

    write_file(path, write)


def load(path: Path) -> CompiledSystem:
    """Read a compiled model. Raises ApcError if the file is missing, damaged or of another version."""
    return load_with_record(path)[0]


def load_with_record(path: Path) -> tuple[CompiledSystem, Record]:
    """Read a compiled model, and what it was made from as far as it may be looked up. Raises as `load`."""
    try:
        archive = read_archive(path)
        return unpacked(archive, path), record_of(archive)
    except RefusedError as refused:
        hint = "apc compile" if refused.why == "missing" else ""
        other = ", not a compiled model" if refused.why in ("folder", "special") else ""
        raise ApcError(Mistake("E602", Place(str(path)), f"{refused.words}{other}", hint=hint)) from None
    except DamageError as error:
        raise _damaged(path, str(error)) from error
    except DAMAGE as error:
        raise _damaged(path, FOREIGN) from error


def unpacked(archive: Archive, path: Path) -> CompiledSystem:
    """Return the system that an unpacked file holds. Raises ApcError, or one of DAMAGE, if it holds none."""
    document = archive.document
    if document["format"] != FORMAT:
        what = f"has format version {_shown(document['format'])}, this program reads version {FORMAT}"
        raise ApcError(
            Mistake("E603", Place(str(path)), what, hint=f"apc compile {path.with_suffix('.yaml')}")
        )
    system = typed(CompiledSystem, document["system"], archive.members)
    assert isinstance(system, CompiledSystem)
    if not _is_consistent(system):
        raise _damaged(path, FOREIGN)
    # Only now, when its sizes are known to be those of the model, is a function built.
    return dataclasses.replace(system, kinds=_built(system.kinds))


def _shown(number: Any) -> str:
    return str(number) if isinstance(number, int) and 0 <= number < 10**6 else "unknown"


def _is_consistent(system: CompiledSystem) -> bool:
    """Return whether every name and row that one part of a model gives exists in the other."""
    timings = {timing.name: timing.value for timing in system.timings}
    clocks = {clock.name for clock in system.clocks}
    links = {link.name for link in system.links}
    parameters = {parameter.name for parameter in system.parameters}
    groups = {group.name for group in system.groups}
    periods = [clock.period for clock in system.clocks]
    delays = [clock.phase for clock in system.clocks]
    delays += [link.delay for link in system.links]
    delays += [pair.delay for link in system.links for pair in link.delays]
    delays += [hold.delay for kind in system.kinds for hold in kind.holds]
    channels = [link.channel for link in system.links if link.channel is not None]
    delays += [channel.jitter for channel in channels if channel.jitter is not None]
    losses = [dataclasses.astuple(channel.loss) for channel in channels if channel.loss is not None]
    numbers = [*system.parameters, *(value for group in system.groups for value in group.values)]
    named = (system.clocks, system.links, system.timings, system.parameters, system.groups)
    duration = system.experiment.duration
    return (
        bool(system.groups)
        and _are_names(system)
        and all(_are_different(one.name for one in listed) for listed in named)
        and timings.keys() >= {*periods, *delays}
        and all(timings[name] > 0 for name in periods)
        and all(timings[name] >= 0 for name in delays)
        and all(parameters.issuperset(loss) for loss in losses)
        and all(channel.trace is None or _is_trace(channel.trace) for channel in channels)
        and all(channel.distribution in ("uniform", "normal", "pareto") for channel in channels)
        and all(channel.reorder in ("newest", "all") for channel in channels)
        and all(channel.on_loss in ("hold", "zero") for channel in channels)
        and all(link.clock in clocks for link in system.links)
        and all({pair.sender, pair.receiver} <= groups for link in system.links for pair in link.delays)
        and all(0 <= group.kind < len(system.kinds) for group in system.groups)
        and len(system.groups) <= MOST_GROUPS
        and all(1 <= group.count <= LARGEST_COUNT for group in system.groups)
        and all(column.values.shape == (group.count,) for group in system.groups for column in group.columns)
        and all(np.isfinite(column.values).all() for group in system.groups for column in group.columns)
        and parameters.issuperset(column.name for group in system.groups for column in group.columns)
        and parameters.issuperset(value.name for group in system.groups for value in group.values)
        and all(one.exact is None or float(one.exact) == one.value for one in numbers)
        and _are_formulas(system)
        and all(_is_graph_consistent(link.graph, system.peers) for link in system.links)
        and all(_is_kind_consistent(kind, set(timings), clocks, parameters) for kind in system.kinds)
        and links.issuperset(sending.link for kind in system.kinds for sending in kind.sends)
        and all(_is_heard(kind, system) for kind in system.kinds)
        and _are_units_consistent(system)
        and (duration is None or duration > 0)
        and 0 <= system.experiment.seed < 2**63
        and len(system.region) <= 2
        and all(axis.low < axis.high for axis in system.region)
    )


def _are_names(system: CompiledSystem) -> bool:
    """Return whether every name is one that a topology can give; its own title alone is any text."""
    kinds = system.kinds
    clocks = [partition for kind in kinds for partition in kind.clocks]
    paths = [state.name for kind in kinds for state in kind.states]
    paths += [hold.name for kind in kinds for hold in kind.holds]
    paths += [limit.name for kind in kinds for limit in kind.limits]
    paths += [part for kind in kinds for part in (*kind.hands, *kind.held)]
    paths += [part for kind in kinds if kind.ports is not None for part in kind.ports.parts]
    paths += [channel for kind in kinds for sending in kind.sends for channel in sending.channels]
    paths += [output for partition in clocks for output in partition.outputs]
    paths += [axis.parameter for axis in system.region]
    paths += [name for name, _ in system.dropped]
    grammar = {
        _WORD: [one.name for listed in (system.clocks, system.links, system.groups) for one in listed],
        _PATH: paths,
        _KIND: [kind.name for kind in kinds],
        _PARAMETER: [one.name for one in system.parameters],
        _TIMING: [one.name for one in system.timings],
        _HEARD: [receive.name for partition in clocks for receive in partition.receives],
    }
    return all(re.fullmatch(form, name) for form, names in grammar.items() for name in names)


def _are_units_consistent(system: CompiledSystem) -> bool:
    """Return whether every unit is of SI, as every number is, and no number has two.

    A unit that is another, but of SI, is a false word of the file's, as a false stiffness is.
    """
    units = {parameter.name: parameter.unit for parameter in system.parameters}
    values = [value for group in system.groups for value in group.values]
    states = [state for kind in system.kinds for state in kind.states]
    clocks = [partition for kind in system.kinds for partition in kind.clocks]
    sent = (unit for kind in system.kinds for sending in kind.sends for unit in sending.units)
    ticked = (unit for partition in clocks for unit in partition.units)
    return (
        all(map(is_si, {*units.values(), *sent, *ticked}))
        and all(units[value.name] == value.unit for value in values)
        and all(units[state.start] == state.unit for state in states)
        and all(
            units[start] == partition.units[memory]
            for partition in clocks
            for memory, start in zip(partition.memories, partition.starts, strict=True)
        )
    )


def _are_formulas(system: CompiledSystem) -> bool:
    """Return whether each number that follows from others does so in the order of the followers."""
    numbers: list[Parameter | Timing] = [*system.parameters, *system.timings]
    names = {one.name for one in numbers}
    numbers += [value for group in system.groups for value in group.values]
    formulas = [(one.name, one.formula) for one in numbers if one.formula is not None]
    place = {name: k for k, name in enumerate(system.followers)}
    return (
        len(place) == len(system.followers)
        and place.keys() >= {name for name, _ in formulas}
        and all(names.issuperset(formula.names) for _, formula in formulas)
        and all(_is_formula(formula) for _, formula in formulas)
        and all(place.get(one, -1) < place[name] for name, formula in formulas for one in formula.names)
    )


def _is_formula(formula: Formula) -> bool:
    """Return whether a formula is made of what expressions are made of."""
    function, given = formula.function, [len(formula.names), len(formula.numbers)]
    return (
        function.loops is None
        and function.sizes == (given, [1])
        and not function.constants
        and not function.tables
        and all(word in EXACT for word, *_ in function.operations)
        and len(formula.spans) == sum(given) + len(function.operations)
        and all(0 <= start <= end <= len(formula.text) for start, end in formula.spans)
        and all(math.isfinite(float(one)) for one in formula.numbers)
    )


def _are_different(names: Iterable[str]) -> bool:
    listed = list(names)
    return len(set(listed)) == len(listed)


def _is_trace(trace: Any) -> bool:
    return trace.ndim == 1 and trace.size > 0 and bool((trace >= 0).all())


def _is_graph_consistent(graph: Graph, peers: int) -> bool:
    """Return whether the arcs of a graph, if it has any, are between peers that there are, each weighted."""
    count = len(graph.weights)
    pairs = graph.arcs.reshape(-1, 2) if graph.arcs.size else np.empty((0, 2))
    return (
        graph.shape in ("complete", "ring", "star", "arcs")
        and (graph.shape == "arcs" or not count)
        and graph.weights.ndim == 1
        and bool(np.isfinite(graph.weights).all())
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
            receive.age in ("", "factor", "alone")
            if receive.edge is None
            else receive.age in ("", "edge")
            and not receive.before
            and receive.edge.sizes
            == ([n_x, n_u, len(partition.memories), _heard_rows(receive, rows), n_p, 1], [1])
        )
        for partition in kind.clocks
        for receive in partition.receives
    )


def _heard_rows(receive: Receive, rows: Mapping[str, Sequence[int]]) -> int:
    """Return how many numbers of a sender an edge takes: its rows, and their age."""
    return max(rows[receive.link]) + (receive.age == "edge")


def _is_kind_consistent(kind: Kind, timings: set[str], clocks: set[str], parameters: set[str]) -> bool:
    """Return the same for one kind; its functions must have the sizes its names ask for."""
    partitions = {partition.clock: partition for partition in kind.clocks}
    n_x, n_u, n_p = len(kind.states), len(kind.holds), len(kind.parameters)
    parameters_of = set(kind.parameters)  # what starts is looked up among them
    states = {state.name for state in kind.states}
    return (
        parameters.issuperset(kind.parameters)
        and _are_different(kind.parameters)
        and _are_different(state.name for state in kind.states)
        and _are_different(partition.clock for partition in kind.clocks)
        and _are_different(sending.link for sending in kind.sends)
        and all(len(sending.units) == len(sending.channels) for sending in kind.sends)
        and all(
            receive.operator in ("mean", "sum", "max", "min", "count")
            for partition in kind.clocks
            for receive in partition.receives
        )
        and all(_is_rounding(kind, place, exact) for place, exact in kind.rounded)
        and parameters_of.issuperset(state.start for state in kind.states)
        and partitions.keys() <= clocks
        and all(len(partition.units) == len(partition.outputs) for partition in kind.clocks)
        and not any(partition.variants for partition in kind.clocks)
        and all(len(partition.starts) == len(partition.memories) for partition in kind.clocks)
        and all(parameters_of.issuperset(partition.starts) for partition in kind.clocks)
        and all(
            0 <= memory < len(partition.outputs) for partition in kind.clocks for memory in partition.memories
        )
        and (kind.ports is None or kind.ports.port.sizes == ([n_x, n_u, n_p, 1], [2 * len(kind.ports.parts)]))
        and parameters.issuperset(one.limit for one in kind.limits)
        and all(one.value is None or one.value.sizes == ([n_x, n_u, n_p, 1], [1]) for one in kind.limits)
        and states.issuperset(one.name for one in kind.limits if one.value is None)
        and all(hold.delay in timings and hold.clock in partitions for hold in kind.holds)
        and all(0 <= hold.output < len(partitions[hold.clock].outputs) for hold in kind.holds)
        and kind.derivative.sizes == ([n_x, n_u, n_p, 1], [n_x])
        and all(
            partition.tick.sizes
            == (
                [n_x, n_u, len(partition.memories), len(partition.receives), n_p, 1],
                [len(partition.outputs)],
            )
            for partition in kind.clocks
        )
        and all(sending.send.sizes == ([n_x, n_u, n_p, 1], [len(sending.channels)]) for sending in kind.sends)
    )


def _is_rounding(kind: Kind, place: int, exact: Sequence[Fraction]) -> bool:
    """Return whether a count of a kind may be these rationals, in order, each float one of them at most."""
    try:
        floats = [float(one) for one in exact]
    except OverflowError:
        return False
    known = 0 <= place < len(kind.parameters) and counts_peers(kind.parameters[place])
    return known and all(a < b for a, b in itertools.pairwise(floats))


def _damaged(path: Path, why: str) -> ApcError:
    mistake = Mistake(
        "E604", Place(str(path)), f"is damaged: {why}", hint=f"apc compile {path.with_suffix('.yaml')}"
    )
    return ApcError(mistake)


def _plain(value: Any, members: dict[str, bytes]) -> Any:
    """Return dataclasses as dictionaries, fractions as texts, functions as data, arrays by their members."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name), members) for f in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(item, members) for item in value]
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, casadi.Function):
        return plain(value).document()
    if isinstance(value, np.ndarray):
        name = f"array{len(members)}"
        members[name] = value.astype(value.dtype.newbyteorder("<")).tobytes()
        return {"member": name, "shape": list(value.shape)}
    return value


def _built(value: Any) -> Any:
    """Return a value with its functions built."""
    if isinstance(value, PlainFunction):
        return value.build()
    if isinstance(value, tuple):
        return tuple(_built(item) for item in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(
            value, **{f.name: _built(getattr(value, f.name)) for f in dataclasses.fields(value)}
        )
    return value


@functools.cache
def _hints(wanted: type) -> dict[str, Any]:
    return typing.get_type_hints(wanted)


def typed(wanted: Any, value: Any, members: dict[str, bytes]) -> Any:
    """Build a value of the wanted type from its plain form; functions stay data. Raises one of DAMAGE."""
    origin = typing.get_origin(wanted)
    if dataclasses.is_dataclass(wanted) and isinstance(wanted, type):
        if not isinstance(value, dict) or value.keys() != _hints(wanted).keys():
            raise TypeError(f"expected the fields of {wanted}")
        return wanted(**{name: typed(hint, value[name], members) for name, hint in _hints(wanted).items()})
    if origin is tuple:
        if not isinstance(value, list):
            raise TypeError(f"expected a list, got {value!r}")
        arguments = typing.get_args(wanted)
        if arguments[-1] is Ellipsis:
            return tuple(typed(arguments[0], item, members) for item in value)
        return tuple(typed(a, item, members) for a, item in zip(arguments, value, strict=True))
    if origin in (typing.Union, types.UnionType):
        inner = [a for a in typing.get_args(wanted) if a is not type(None)]
        return None if value is None else typed(inner[0], value, members)
    if origin is np.ndarray:
        return _array(typing.get_args(typing.get_args(wanted)[1])[0], value, members)
    if wanted is Any:
        return read_function(value)
    if wanted is float and type(value) in (int, float):
        return _finite(float(value))
    if type(value) is not (str if wanted is Fraction else wanted):  # True is no whole number
        raise TypeError(f"expected {wanted}, got {value!r}")
    if wanted is Fraction:
        return _rational(value)
    if wanted is str and not value.isprintable():  # it is shown in a terminal
        raise ValueError("expected a line of text")
    return value


def _finite(number: float) -> float:
    if not math.isfinite(number):
        raise ValueError("expected a finite number")
    return number


def _rational(text: str) -> Fraction:
    if not _RATIONAL.match(text) or text.partition("/")[2].strip("0") == "" != text.partition("/")[2]:
        raise ValueError("expected a rational number")
    return Fraction(text)


def _array(number: type, value: Any, members: dict[str, bytes]) -> Any:
    """Return the array of a member, of the shape said."""
    shape = value["shape"]
    if not (0 < len(shape) <= 2 and all(type(one) is int and 0 <= one < 2**31 for one in shape)):
        raise ValueError("expected the shape of an array")
    kind = np.dtype(number)
    return np.frombuffer(members[value["member"]], kind.newbyteorder("<")).astype(kind).reshape(shape)
