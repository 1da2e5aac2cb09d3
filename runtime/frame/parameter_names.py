"""Names of parameters and timings, resolved to the entries of a model.

Takes: a `Model` and a name such as `contact.stiffness`, `right.hand.force` or `links.lan.delay`.
Gives: `ParameterRef`, `Range`, `proposed_range`, `find`, `overlap`, `is_named`, `named_times`, `times_of`,
`parameter_of`, `value_now`, `unit_of`, `values_by_group`, `notes_for_all_groups`; `given_ranges`.
Guarantees: an unknown name raises an error with the nearest known one.
Does not: read or change values.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.compiled import (
    COUNT,
    PEERS,
    Model,
    Parameter,
    Timing,
    counts_peers,
    group_count,
)
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.wording import with_unit
from apc.frame.display_units import DisplayUnit

# The sections of a topology, which a name may start with.
SECTIONS = ("clocks", "couplers", "hands", "links", "masses", "parameters")

# A value of one peer, which cannot be set: user[1].device.x.
_SINGLE_PEER = re.compile(r"(?P<group>\w+)\[(?P<peer>\d{1,9})\]\.(?P<rest>.+)")

GIVEN = "…"  # in the place of a value that is not known
MOST_LISTED = 20  # peers whose values are written out

# The parameters of the hand that `--hands held` adds to each device.
HELD = ("hand.mass", "hand.damping", "hand.stiffness")

# The location of an error in an override that came from no line of a file.
OVERRIDE = SourceLocation("--set")


@dataclass(frozen=True, slots=True)
class ParameterRef:
    """A reference to a parameter or timing: of one group, or of all (`group` None)."""

    name: str
    group: str | None = None

    @property
    def label(self) -> str:
        """The full name, with its group first."""
        return self.name if self.group is None else f"{self.group}.{self.name}"


@dataclass(frozen=True, slots=True)
class Range:
    """An interval of a parameter, from `low` to `high`, exact, in SI."""

    free: ParameterRef
    unit: str
    low: Fraction
    high: Fraction


def proposed_range(system: Model, requested: str = "", *, without: str = "") -> str:
    """Return a range `NAME=LOW:HIGH` to propose for a stiffness or damping: the given one if it is one."""
    units = {"N/m": 1000, "N*s/m": 10}
    named = [
        parameter for parameter in system.parameters if is_named(parameter.name) and parameter.unit in units
    ]
    named = [parameter for parameter in named if parameter.name == requested] or [
        parameter for parameter in named if parameter.name != without
    ]
    if not named:
        return "NAME=LOW:HIGH"
    first = named[0]
    return f"{first.name}=0 {first.unit}:{2 * first.value or units[first.unit]:g} {first.unit}"


def given_ranges(system: Model, others: Collection[Range] = ()) -> list[Range]:
    """Return the ranges that a topology gives instead of a number, without those of `others`, and these."""
    used = {other.free.name for other in others}
    axes = (axis for axis in system.within if axis.parameter not in used)
    return [*(Range(ParameterRef(axis.parameter), "s", axis.low, axis.high) for axis in axes), *others]


# Parameters of a link with defaults.
UNWRITTEN = {"loss": "0 %", "jitter": "0 ms"}


def find(
    system: Model,
    name: str,
    location: SourceLocation = OVERRIDE,
    *,
    counts: bool = False,
    value: str = GIVEN,
) -> ParameterRef:
    """Return the parameter or timing of a name, of the group in the name, if any.

    Parameters
    ----------
    system, name, location
        The compiled model, the name, and its location in the input.
    counts
        Whether the number of peers of a group, `user.count`, is allowed.
    value
        The value in a fix that names the parameter.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers, or of received peers.
    """
    times = {timing.name for timing in named_times(system)}
    known = {parameter.name for parameter in system.parameters if is_named(parameter.name)} | times
    sizes = [group_count(group.name) for group in system.groups]
    if counts:
        known |= set(sizes)
    groups = {group.name for group in system.groups}
    written = name[:80].strip() or "an empty name"
    first, _, rest = name.partition(".")
    if first in SECTIONS and name not in known:
        name = rest
    first, _, rest = name.partition(".")
    group, parameters = None, {parameter.name for parameter in system.parameters}
    if name not in known and first in groups and rest in parameters:
        name, group = rest, first
    if group is not None and name in times:
        raise _not_of_the_group(system, name, group, written, location)
    if name == PEERS or (name in sizes and not counts):
        hint = f"apc critical {sizes[0]}"
        message = f"{written} is a number of peers, which doesn't vary here"
        if counts:
            message, hint = f"{written} is the number of all peers, which follows from the groups'", sizes[0]
        raise ApcError(Diagnostic("E623", location, message, hint=hint))
    if name.startswith(COUNT):
        message = f"{written} is how many peers are heard, by their weights: from {sizes[0]} and the graph"
        raise ApcError(Diagnostic("E623", location, message))
    if name in HELD and not any(text.startswith("hand.") for text in known):
        message = f"{written} is of the hand that --hands held puts on each device"
        raise ApcError(Diagnostic("E622", location, message, hint=f"--hands held --set {name}={value}"))
    single_peer = _SINGLE_PEER.fullmatch(name)
    if single_peer is not None and single_peer["group"] in groups and single_peer["rest"] in parameters:
        raise _of_single_peer(system, single_peer, location, value)
    if name not in known and rest in UNWRITTEN and any(link.name == first for link in system.links):
        message = f"{written} is not written in the topology, and only what is written can be varied"
        raise ApcError(
            Diagnostic("E622", location, message, hint=f"links: {{{first}: {{{rest}: {UNWRITTEN[rest]}}}}}")
        )
    if name not in known:
        near = nearest(name, sorted(known))
        raise ApcError(Diagnostic("E622", location, f"{written} is no parameter of {system.name}", hint=near))
    return ParameterRef(name, group)


def _not_of_the_group(
    system: Model, name: str, group: str, written: str, location: SourceLocation
) -> ApcError:
    """Return the error for a group's time that the group does not set in the topology."""
    message = f"{written} is no parameter of {system.name}: {name} is one time for all groups"
    hint = name
    if len(system.groups) > 1:
        message += " that set none of their own"
        value, number = (
            value_now(system, ParameterRef(name)),
            next(g.count for g in system.groups if g.name == group),
        )
        setting = f"{{count: {number}, set: {{{name}: {1000 * value:.12g} ms}}}}"
        hint = f"{name}, or in the topology peers: {{{group}: {setting}}}"
    return ApcError(Diagnostic("E622", location, message, hint=hint))


def overlap(system: Model, free: ParameterRef, other: ParameterRef) -> bool:
    """Return whether two names set one number of some group; a name without a group is that of all."""
    if free.name == other.name:
        return free.group == other.group or None in (free.group, other.group)
    return free.name in times_of(system, other.name) or other.name in times_of(system, free.name)


def _of_single_peer(system: Model, result: re.Match[str], location: SourceLocation, given: str) -> ApcError:
    """Return the message for a value for one peer of a group: `user[1].device.x`."""
    group, rest = next(group for group in system.groups if group.name == result["group"]), result["rest"]
    message = (
        f"{result[0]} is of one peer, and a setting is of all or of one group: a list gives each its own"
    )
    parameter = next(parameter for parameter in system.parameters if parameter.name == rest)
    local = next((value for value in group.values if value.name == rest), parameter)
    value = with_unit(f"{local.value:.12g}", local.unit)
    values = [given if k == int(result["peer"]) else value for k in range(1, group.count + 1)]
    hint = f"peers: {{{group.name}: {{count: {group.count}, set: {{{rest}: [{', '.join(values)}]}}}}}}"
    if group.count > MOST_LISTED:
        hint = f"peers: {{{group.name}: {{table: users.csv}}}}, a row a peer, and a column of {rest}"
    return ApcError(Diagnostic("E622", location, message, hint=hint))


def is_named(name: str) -> bool:
    """Return whether a parameter or timing has a name in the topology.

    Counts of the compiler, such as `peers` and `count(lan)`, and the delay of a hold without one or by an
    expression, are not the user's to vary: their names contain characters that no name of a topology has.
    """
    return not counts_peers(name) and " " not in name


def named_times(system: Model) -> list[Timing]:
    """Return the timings that have a name in the topology."""
    return [timing for timing in system.timings if is_named(timing.name)]


def times_of(system: Model, name: str) -> tuple[str, ...]:
    """Return the timings that a name without a group sets.

    The timing of that name comes first, then those that groups set for themselves: for `contact.delay` also
    `left.contact.delay`. Empty for a name of no timing.
    """
    timings = {timing.name for timing in system.timings}
    names = (name, *(f"{group.name}.{name}" for group in system.groups))
    return tuple(text for text in names if text in timings)


def parameter_of(system: Model, free: ParameterRef) -> Parameter:
    """Return a parameter reference with the group's own parameter, or that of all groups."""
    for group in system.groups:
        for parameter in group.values:
            if group.name == free.group and parameter.name == free.name:
                return parameter
    return next(parameter for parameter in system.parameters if parameter.name == free.name)


def value_now(system: Model, free: ParameterRef) -> float:
    """Return the present value of a parameter or timing, in SI."""
    times = {timing.name: timing.value for timing in system.timings}
    return float(times[free.name]) if free.name in times else parameter_of(system, free).value


def unit_of(system: Model, name: str) -> DisplayUnit:
    """Return the unit of a parameter or timing."""
    return next(
        (DisplayUnit.of(parameter) for parameter in system.parameters if parameter.name == name),
        DisplayUnit("s"),
    )


def values_by_group(system: Model, free: ParameterRef) -> tuple[tuple[str, float | None], ...]:
    """Return each group's value of a parameter, None where its peers differ; empty where all are equal."""
    name, only = free.name, free.group
    several = {group.name for group in system.groups if name in {column.name for column in group.columns}}
    if only is not None:
        return ((only, None),) if only in several else ()
    local = {group.name for group in system.groups if name in {value.name for value in group.values}}
    if not several | local:
        return ()
    return tuple(
        (
            group.name,
            None if group.name in several else parameter_of(system, ParameterRef(name, group.name)).value,
        )
        for group in system.groups
    )


def _after_time(system: Model, free: ParameterRef) -> Iterator[str]:
    """Yield the groups and pairs of groups to which a link's or clock's time does not apply."""
    for link in system.links:
        others = [pair.delay for pair in link.delays]
        if free.name == link.delay and others:
            yield f"{free.name} is the delay of all pairs of groups but those of {', '.join(others)}"
    for clock in system.clocks:
        if free.name not in (clock.period, clock.phase):
            continue
        ticking = [
            group.name
            for group in system.groups
            if any(part.clock == clock.name for part in system.peer_types[group.peer_type].clocks)
        ]
        if 0 < len(ticking) < len(system.groups):
            yield f"{free.name} is of the clock {clock.name}, the clock of {', '.join(ticking)} only"


def notes_for_all_groups(system: Model, parameter_refs: Iterable[ParameterRef]) -> list[str]:
    """Return notes on the values that a name without a group replaces or leaves, where groups differ."""
    notes: list[str] = []
    for free in parameter_refs:
        notes += _after_time(system, free)
        pairs = values_by_group(system, free)
        if free.group is not None or not pairs:
            continue
        unit = unit_of(system, free.name)
        local = [
            f"{'several values' if value is None else with_unit(f'{value:.6g}', unit)} at {group}"
            for group, value in pairs
        ]
        notes.append(f"{free.name} is one value for all groups here; the topology has {', '.join(local)}")
    return notes
