"""Names of parameters and timings, resolved to the entries of a model.

Takes: a `Model` and a name such as `contact.stiffness`, `right.hand.force` or `links.lan.delay`.
Gives: `ParameterRef`, `Range`, `proposed_range`, `proposed_range_of`, `find`, `overlap`, `is_named`,
`named_times`, `times_of`, `parameter_of`, `choices_of`, `refuse_choices`, `value_now`, `unit_of`,
`values_by_group`, `notes_for_all_groups`, `given_ranges`.
Guarantees: an unknown name raises an error with the nearest known one.
Does not: read or change values.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice, repeat

from apc.compiler.compiled import (
    COUNT,
    PEERS,
    REST,
    Model,
    Parameter,
    Timing,
    counts_peers,
    group_count,
)
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.wording import choices_text, with_unit
from apc.parameter_values.display_units import DisplayUnit, as_shown

# The sections of a topology; the name of a parameter may start with its section.
SECTIONS = ("clocks", "couplers", "hands", "links", "masses", "parameters")

# A value of one peer, which cannot be set: user[1].device.x.
_SINGLE_PEER = re.compile(r"(?P<group>\w+)\[(?P<peer>\d{1,9})\]\.(?P<rest>.+)")

GIVEN = "…"  # instead of a value that is unknown
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


def proposed_range(model: Model, requested: str = "", *, without: str = "") -> str:
    """Return a text `NAME=LOW:HIGH` that proposes a range of a stiffness or damping.

    The parameter is `requested` if that is a stiffness or damping, else the first one except `without`.
    """
    units = {"N/m": 1000, "N*s/m": 10}
    candidates = [
        parameter for parameter in model.parameters if is_named(parameter.name) and parameter.unit in units
    ]
    candidates = [parameter for parameter in candidates if parameter.name == requested] or [
        parameter for parameter in candidates if parameter.name != without
    ]
    if not candidates:
        return "NAME=LOW:HIGH"
    first = candidates[0]
    return f"{first.name}=0 {first.unit}:{2 * first.value or units[first.unit]:g} {first.unit}"


def given_ranges(model: Model, others: Collection[Range] = ()) -> list[Range]:
    """Return the ranges that a topology gives instead of a number, except of parameters in `others`, then
    `others`.
    """
    names = {other.free.name for other in others}
    axes = (axis for axis in model.within if axis.parameter not in names)
    return [*(Range(ParameterRef(axis.parameter), "s", axis.low, axis.high) for axis in axes), *others]


# Parameters of a link with defaults.
UNWRITTEN = {"loss": "0 %", "jitter": "0 ms"}


def find(
    model: Model,
    name: str,
    location: SourceLocation = OVERRIDE,
    *,
    counts: bool = False,
    value: str = GIVEN,
) -> ParameterRef:
    """Return a reference to the parameter or timing of a name, and to the group in the name, if any.

    Parameters
    ----------
    model, name, location
        The compiled model, the name, and its location in the input.
    counts
        Whether the number of peers of a group, `user.count`, is allowed.
    value
        The value of the parameter in a proposed fix.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers, or of received peers.
    """
    times = {timing.name for timing in named_times(model)}
    known = {parameter.name for parameter in model.parameters if is_named(parameter.name)} | times
    sizes = [group_count(group.name) for group in model.groups]
    if counts:
        known |= set(sizes)
    groups = {group.name for group in model.groups}
    written = name[:80].strip() or "an empty name"
    first, _, rest = name.partition(".")
    if first in SECTIONS and name not in known:
        name = rest
    first, _, rest = name.partition(".")
    group, parameters = None, {parameter.name for parameter in model.parameters}
    if name not in known and first in groups and rest in parameters:
        name, group = rest, first
    if group is not None and name in times:
        raise _group_time_error(model, name, group, written, location)
    if name == PEERS or (name in sizes and not counts):
        fix = f"apc critical {sizes[0]}"
        message = f"{written} is a number of peers and can't be varied here"
        if counts:
            message, fix = f"{written} is the number of all peers, the sum of the group counts", sizes[0]
        raise ApcError(Diagnostic("E623", location, message, fix=fix))
    if name.startswith(COUNT):
        message = (
            f"{written} is the weighted number of received peers, which follows from {sizes[0]} and the graph"
        )
        raise ApcError(Diagnostic("E623", location, message))
    if name in HELD and not any(text.startswith("hand.") for text in known):
        message = f"{written} is a parameter of the hand added by --hands held"
        raise ApcError(Diagnostic("E622", location, message, fix=f"--hands held --set {name}={value}"))
    single_peer = _SINGLE_PEER.fullmatch(name)
    if single_peer is not None and single_peer["group"] in groups and single_peer["rest"] in parameters:
        raise _single_peer_error(model, single_peer, location, value)
    link = next((link for link in model.links if link.name == first), None)
    if name not in known and link is not None:
        *pair, key = rest.split(".")
        nested = [first, *pair, f"{key}: {UNWRITTEN.get(key)}"]
        is_pair = len(pair) == 3 and pair[0] == "pairs" and groups.issuperset(pair[1:])
        if is_pair and key == "delay":
            nested[-1] = f"delay: {1000 * value_now(model, ParameterRef(link.delay)):.12g} ms"
        if (key in UNWRITTEN and not pair) or (is_pair and key in (*UNWRITTEN, "delay")):
            fix = f"links: {{{': {'.join(nested)}{'}' * len(nested)}"
            raise ApcError(Diagnostic("E622", location, f"{written} is not in the topology", fix=fix))
    if name not in known:
        period = f"{name}.period"  # of a clock
        if rest in ("rate", "frequency"):
            period = f"{first}.period"
        if rest.startswith("delays."):
            period = f"{first}.pairs.{rest.partition('.')[2]}.delay"
        near = period if period in known else nearest(name, sorted(known))
        raise ApcError(
            Diagnostic("E622", location, f"{written} is not a parameter of {model.name}", fix=near)
        )
    return ParameterRef(name, group)


def _group_time_error(
    model: Model, name: str, group: str, written: str, location: SourceLocation
) -> ApcError:
    """Return the error E622 for a time of a group that the topology sets for all groups only.

    `name` and `group` are the time and the group, `written` is the name as given.
    """
    message = f"{written} is not a parameter of {model.name}: {name} is common to all groups"
    fix = name
    if len(model.groups) > 1:
        message += " without separate values"
        value, number = (
            value_now(model, ParameterRef(name)),
            next(g.count for g in model.groups if g.name == group),
        )
        setting = f"{{count: {number}, set: {{{name}: {1000 * value:.12g} ms}}}}"
        fix = f"{name}, or peers: {{{group}: {setting}}}"
    return ApcError(Diagnostic("E622", location, message, fix=fix))


def overlap(model: Model, parameter_ref: ParameterRef, other: ParameterRef) -> bool:
    """Return whether two references set the same number of some group.

    A reference without a group sets the number of all groups.
    """
    if parameter_ref.name == other.name:
        return parameter_ref.group == other.group or None in (parameter_ref.group, other.group)
    return parameter_ref.name in times_of(model, other.name) or other.name in times_of(
        model, parameter_ref.name
    )


def _single_peer_error(
    model: Model, match: re.Match[str], location: SourceLocation, new_value: str
) -> ApcError:
    """Return the error E622 for a value of one peer of a group: `user[1].device.x`.

    `match` is of `_SINGLE_PEER`; `new_value` is the value to be set, as text, for the fix.
    """
    group, rest = next(group for group in model.groups if group.name == match["group"]), match["rest"]
    message = (
        f"{match[0]} is a value of one peer; a setting applies to all peers or to one group, and a list to "
        "single peers"
    )
    parameter = next(parameter for parameter in model.parameters if parameter.name == rest)
    local = next((value for value in group.values if value.name == rest), parameter)
    present = next((column.values for column in group.columns if column.name == rest), repeat(local.value))
    values = [with_unit(f"{value:.12g}", local.unit) for value in islice(present, group.count)]
    values[int(match["peer"]) - 1 : int(match["peer"])] = [new_value] * (int(match["peer"]) <= group.count)
    fix = f"peers: {{{group.name}: {{count: {group.count}, set: {{{rest}: [{', '.join(values)}]}}}}}}"
    advice = ""
    if group.count > MOST_LISTED:
        fix = f"peers: {{{group.name}: {{table: users.csv}}}}"
        advice = f"use a table with one row for each peer and a column {rest}"
    return ApcError(Diagnostic("E622", location, message, fix=fix, advice=advice))


def is_named(name: str) -> bool:
    """Return whether a parameter or timing has a name in the topology.

    Counts of the compiler, such as `peers` and `count(lan)`, and the delay of a hold without one or by an
    expression, cannot be set by the user: their names contain characters that no name of a topology has. The
    same holds for the values of an equilibrium.
    """
    return not counts_peers(name) and not name.startswith(REST) and " " not in name


def named_times(model: Model) -> list[Timing]:
    """Return the timings that have a name in the topology."""
    return [timing for timing in model.timings if is_named(timing.name)]


def times_of(model: Model, name: str) -> tuple[str, ...]:
    """Return the names of the timings that a name without a group sets; empty for a name of no timing.

    The timing of that name comes first, then the timings of single groups: for `contact.delay` also
    `left.contact.delay`.
    """
    timings = {timing.name for timing in model.timings}
    names = (name, *(f"{group.name}.{name}" for group in model.groups))
    return tuple(text for text in names if text in timings)


def parameter_of(model: Model, parameter_ref: ParameterRef) -> Parameter:
    """Return the parameter of a reference: the group's own parameter, else the one common to all groups."""
    for group in model.groups:
        for parameter in group.values:
            if group.name == parameter_ref.group and parameter.name == parameter_ref.name:
                return parameter
    return next(parameter for parameter in model.parameters if parameter.name == parameter_ref.name)


def choices_of(model: Model, parameter_ref: ParameterRef) -> dict[str, float]:
    """Return the named values of a parameter, such as left: 1; empty for a parameter with other values."""
    return {
        word: value
        for parameter in model.parameters
        if parameter.name == parameter_ref.name
        for word, value in parameter.choices
    }


def refuse_choices(model: Model, parameter_ref: ParameterRef, location: SourceLocation) -> None:
    """Raise ApcError E831 for a parameter with named values, which has no range; `location` as of `find`."""
    if choices := choices_of(model, parameter_ref):
        message = f"{parameter_ref.label} has no range: its values are {choices_text(choices.items())}"
        raise ApcError(Diagnostic("E831", location, message))


def value_now(model: Model, parameter_ref: ParameterRef) -> float:
    """Return the present value of a parameter or timing, in SI."""
    times = {timing.name: timing.value for timing in model.timings}
    return (
        float(times[parameter_ref.name])
        if parameter_ref.name in times
        else parameter_of(model, parameter_ref).value
    )


def unit_of(model: Model, name: str) -> DisplayUnit:
    """Return the unit of a parameter or timing."""
    return next(
        (DisplayUnit.of(parameter) for parameter in model.parameters if parameter.name == name),
        DisplayUnit("s"),
    )


def proposed_range_of(model: Model, parameter_ref: ParameterRef) -> str:
    """Return a text `NAME=LOW:HIGH` that proposes a range from half the present value to its double.

    For a value of 0 or below, it is from the value to 1 unit above. The range is within the limits of the
    parameter.
    """
    value, unit = value_now(model, parameter_ref), unit_of(model, parameter_ref.name)
    low, high = (value / 2, 2 * value) if value > 0 else (value, value + 1)
    if parameter_ref.name not in {timing.name for timing in model.timings}:
        parameter = parameter_of(model, parameter_ref)
        if parameter.minimum is not None and low <= parameter.minimum:
            low = value if parameter.exclusive_minimum else parameter.minimum
        high = high if parameter.maximum is None else min(high, parameter.maximum)
    factor, shown = as_shown(high, unit)
    ends = (with_unit(f"{float(end * factor):.6g}", shown).removesuffix(" 1") for end in (low, high))
    return f"{parameter_ref.label}={':'.join(ends)}"


def values_by_group(model: Model, parameter_ref: ParameterRef) -> tuple[tuple[str, float | None], ...]:
    """Return each group's value of a parameter, None if its peers differ; empty if all values are equal."""
    name, referenced_group = parameter_ref.name, parameter_ref.group
    groups_with_columns = {
        group.name for group in model.groups if name in {column.name for column in group.columns}
    }
    if referenced_group is not None:
        return ((referenced_group, None),) if referenced_group in groups_with_columns else ()
    groups_with_value = {
        group.name for group in model.groups if name in {value.name for value in group.values}
    }
    if not groups_with_columns | groups_with_value:
        return ()
    return tuple(
        (
            group.name,
            None
            if group.name in groups_with_columns
            else parameter_of(model, ParameterRef(name, group.name)).value,
        )
        for group in model.groups
    )


def _time_notes(model: Model, parameter_ref: ParameterRef) -> Iterator[str]:
    """Yield a note for each link or clock whose time does not apply to all groups."""
    formulas = {timing.name: timing.formula for timing in model.timings}
    for link in model.links:
        pairs = [(pair.delay, formulas[pair.delay]) for pair in link.pairs]
        others = [name for name, formula in pairs if formula is None or link.delay not in formula.names]
        if parameter_ref.name == link.delay and others:
            yield f"{parameter_ref.name} applies to all pairs of groups except those of {', '.join(others)}"
    for clock in model.clocks:
        if parameter_ref.name not in (clock.period, clock.phase):
            continue
        ticking = [
            group.name
            for group in model.groups
            if any(part.clock == clock.name for part in model.peer_types[group.peer_type].clocks)
        ]
        if 0 < len(ticking) < len(model.groups):
            yield f"{parameter_ref.name} belongs to clock {clock.name}, which only {', '.join(ticking)} uses"


def notes_for_all_groups(model: Model, parameter_refs: Iterable[ParameterRef]) -> list[str]:
    """Return notes on parameters without a group that replace different values of groups, or times that do
    not apply to all.
    """
    notes: list[str] = []
    for parameter_ref in parameter_refs:
        notes += _time_notes(model, parameter_ref)
        pairs = values_by_group(model, parameter_ref)
        if parameter_ref.group is not None or not pairs:
            continue
        unit = unit_of(model, parameter_ref.name)
        local = [
            f"{'several values' if value is None else with_unit(f'{value:.6g}', unit)} at {group}"
            for group, value in pairs
        ]
        notes.append(
            f"{parameter_ref.name} has one value for all groups here; the topology has {', '.join(local)}"
        )
    return notes
