"""What a person calls a parameter or a timing, and what stands behind the name.

Takes: a `Model` and a name such as `contact.stiffness`, `right.hand.force` or `links.lan.delay`.
Gives: `ParameterRef`, `Range`, `proposed_range`, `find`, `overlap`, `is_named`, `named_times`, `times_of`,
`parameter_of`, `value_now`, `unit_of`, `values_by_group`, `notes_for_all_groups`.
Guarantees: a name that means nothing raises, with the nearest real one.
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
from apc.compiler.words import with_unit
from apc.frame.display_units import DisplayUnit

# The sections of a topology, which a name may start with.
SECTIONS = ("clocks", "couplers", "hands", "links", "masses", "parameters")

# A number of one peer, which is none that can be set: user[1].device.x.
_ONE_PEER = re.compile(r"(?P<group>\w+)\[(?P<peer>\d{1,9})\]\.(?P<rest>.+)")

GIVEN = "…"  # in the place of a value that is not known
MOST_LISTED = 20  # peers whose values are written out

# The numbers of the hand that `--hands held` puts on each device.
HELD = ("hand.mass", "hand.damping", "hand.stiffness")

# Where a mistake in an override stands, when it came from no line of a file.
OVERRIDE = SourceLocation("--set")


@dataclass(frozen=True, slots=True)
class ParameterRef:
    """A parameter or timing that a value is wanted of: of one group, or of all (`group` None)."""

    name: str
    group: str | None = None

    @property
    def label(self) -> str:
        """The name as a person writes it, its group before it."""
        return self.name if self.group is None else f"{self.group}.{self.name}"


@dataclass(frozen=True, slots=True)
class Range:
    """What a box leaves open, or an axis of a region runs over: from `low` to `high`, exact, in SI."""

    free: ParameterRef
    unit: str
    low: Fraction
    high: Fraction


def proposed_range(system: Model, wanted: str = "", *, without: str = "") -> str:
    """Return a range of a stiffness or damping to propose, `NAME=LOW:HIGH`: the wanted one, if it is one."""
    units = {"N/m": 1000, "N*s/m": 10}
    named = [
        parameter for parameter in system.parameters if is_named(parameter.name) and parameter.unit in units
    ]
    named = [parameter for parameter in named if parameter.name == wanted] or [
        parameter for parameter in named if parameter.name != without
    ]
    if not named:
        return "NAME=LOW:HIGH"
    first = named[0]
    return f"{first.name}=0 {first.unit}:{2 * first.value or units[first.unit]:g} {first.unit}"


def given_ranges(system: Model, others: Collection[Range] = ()) -> list[Range]:
    """Return the ranges that a topology gives in the place of a number, but those of `others`, and these."""
    taken = {other.free.name for other in others}
    axes = (axis for axis in system.within if axis.parameter not in taken)
    return [*(Range(ParameterRef(axis.parameter), "s", axis.low, axis.high) for axis in axes), *others]


# Numbers of a link that may be left out, and what they are then.
UNWRITTEN = {"loss": "0 %", "jitter": "0 ms"}


def find(
    system: Model,
    name: str,
    place: SourceLocation = OVERRIDE,
    *,
    counts: bool = False,
    value: str = GIVEN,
) -> ParameterRef:
    """Return the parameter or timing a person's name means, of the group it names, if any.

    Parameters
    ----------
    system, name, place
        The compiled scene, the name, and where it was given.
    counts
        Whether it may be the number of peers of a group, `user.count`.
    value
        The value to be set, for messages.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers, or of those that are heard.
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
        raise _not_of_the_group(system, name, group, written, place)
    if name == PEERS or (name in sizes and not counts):
        hint = f"apc critical {sizes[0]}"
        what = f"{written} is a number of peers, which doesn't vary here"
        if counts:
            what, hint = f"{written} is the number of all peers, which follows from the groups'", sizes[0]
        raise ApcError(Diagnostic("E623", place, what, hint=hint))
    if name.startswith(COUNT):
        what = f"{written} is how many peers are heard, by their weights: from {sizes[0]} and the graph"
        raise ApcError(Diagnostic("E623", place, what))
    if name in HELD and not any(text.startswith("hand.") for text in known):
        what = f"{written} is of the hand that --hands held puts on each device"
        raise ApcError(Diagnostic("E622", place, what, hint=f"--hands held --set {name}={value}"))
    one_peer = _ONE_PEER.fullmatch(name)
    if one_peer is not None and one_peer["group"] in groups and one_peer["rest"] in parameters:
        raise _of_one_peer(system, one_peer, place, value)
    if name not in known and rest in UNWRITTEN and any(link.name == first for link in system.links):
        what = f"{written} is not written in the topology, and only what is written can be varied"
        raise ApcError(
            Diagnostic("E622", place, what, hint=f"links: {{{first}: {{{rest}: {UNWRITTEN[rest]}}}}}")
        )
    if name not in known:
        near = nearest(name, sorted(known))
        raise ApcError(Diagnostic("E622", place, f"{written} is no parameter of {system.name}", hint=near))
    return ParameterRef(name, group)


def _not_of_the_group(system: Model, name: str, group: str, written: str, place: SourceLocation) -> ApcError:
    """Return the refusal of a group's time that the group does not set in the topology."""
    what = f"{written} is no parameter of {system.name}: {name} is one time for all groups"
    hint = name
    if len(system.groups) > 1:
        what += " that set none of their own"
        value, number = (
            value_now(system, ParameterRef(name)),
            next(g.count for g in system.groups if g.name == group),
        )
        setting = f"{{count: {number}, set: {{{name}: {1000 * value:.12g} ms}}}}"
        hint = f"{name}, or in the topology peers: {{{group}: {setting}}}"
    return ApcError(Diagnostic("E622", place, what, hint=hint))


def overlap(system: Model, free: ParameterRef, other: ParameterRef) -> bool:
    """Return whether two names set one number of some group: a name without a group is that of all."""
    if free.name == other.name:
        return free.group == other.group or None in (free.group, other.group)
    return free.name in times_of(system, other.name) or other.name in times_of(system, free.name)


def _of_one_peer(system: Model, result: re.Match[str], place: SourceLocation, given: str) -> ApcError:
    """Return what is told of a value for one peer of a group: `user[1].device.x`."""
    group, rest = next(group for group in system.groups if group.name == result["group"]), result["rest"]
    what = f"{result[0]} is of one peer, and a setting is of all or of one group: a list gives each its own"
    parameter = next(parameter for parameter in system.parameters if parameter.name == rest)
    own = next((value for value in group.values if value.name == rest), parameter)
    value = with_unit(f"{own.value:.12g}", own.unit)
    values = [given if k == int(result["peer"]) else value for k in range(1, group.count + 1)]
    hint = f"peers: {{{group.name}: {{count: {group.count}, set: {{{rest}: [{', '.join(values)}]}}}}}}"
    if group.count > MOST_LISTED:
        hint = f"peers: {{{group.name}: {{table: users.csv}}}}, a row a peer, and a column of {rest}"
    return ApcError(Diagnostic("E622", place, what, hint=hint))


def is_named(name: str) -> bool:
    """Say whether a parameter or timing stands in the scene under a name of its own.

    What the compiler counts, as `peers` and `count(lan)`, and the delay of a hold without one or by an
    expression, are not the user's to vary: their names hold what no name in a scene can.
    """
    return not counts_peers(name) and " " not in name


def named_times(system: Model) -> list[Timing]:
    """Return the timings that stand in the scene under a name of their own."""
    return [timing for timing in system.timings if is_named(timing.name)]


def times_of(system: Model, name: str) -> tuple[str, ...]:
    """Return the names of the timings that a name without a group sets.

    The timing of that name comes first, then those that groups set for themselves: of `contact.delay` also
    `left.contact.delay`. Empty where the name is of no timing.
    """
    timings = {timing.name for timing in system.timings}
    names = (name, *(f"{group.name}.{name}" for group in system.groups))
    return tuple(text for text in names if text in timings)


def parameter_of(system: Model, free: ParameterRef) -> Parameter:
    """Return a free parameter as its group has it, or everybody."""
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
    """Return the unit a parameter or timing wants."""
    return next(
        (DisplayUnit.of(parameter) for parameter in system.parameters if parameter.name == name),
        DisplayUnit("s"),
    )


def values_by_group(system: Model, free: ParameterRef) -> tuple[tuple[str, float | None], ...]:
    """Return what each group has of a parameter, None where its peers differ; nothing where all are alike."""
    name, only = free.name, free.group
    several = {group.name for group in system.groups if name in {column.name for column in group.columns}}
    if only is not None:
        return ((only, None),) if only in several else ()
    own = {group.name for group in system.groups if name in {value.name for value in group.values}}
    if not several | own:
        return ()
    return tuple(
        (
            group.name,
            None if group.name in several else parameter_of(system, ParameterRef(name, group.name)).value,
        )
        for group in system.groups
    )


def _beside_a_time(system: Model, free: ParameterRef) -> Iterator[str]:
    """Yield which groups and pairs of groups a link's or clock's time does not reach."""
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
            if any(part.clock == clock.name for part in system.kinds[group.kind].clocks)
        ]
        if 0 < len(ticking) < len(system.groups):
            yield f"{free.name} is of the clock {clock.name}, the clock of {', '.join(ticking)} only"


def notes_for_all_groups(system: Model, frees: Iterable[ParameterRef]) -> list[str]:
    """Return what a name without a group replaces, or leaves as it is, where the groups differ."""
    notes: list[str] = []
    for free in frees:
        notes += _beside_a_time(system, free)
        pairs = values_by_group(system, free)
        if free.group is not None or not pairs:
            continue
        unit = unit_of(system, free.name)
        own = [
            f"{'several values' if value is None else with_unit(f'{value:.6g}', unit)} at {group}"
            for group, value in pairs
        ]
        notes.append(f"{free.name} is one value for all groups here; the scene has {', '.join(own)}")
    return notes
