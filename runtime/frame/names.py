"""What a person calls a parameter or a timing, and what stands behind the name.

Takes: a `CompiledSystem` and a name such as `contact.stiffness`, `right.hand.force` or `links.lan.delay`.
Gives: `Free`, `Range`, `find`, `is_named`, `named_times`, `parameter_of`, `value_now`, `unit_of`.
Guarantees: a name that means nothing raises, with the nearest real one.
Does not: read or change values.
"""

from __future__ import annotations

from fractions import Fraction

from apc.compiler.compiled import PEERS, CompiledSystem, Parameter, Timing, counts_peers
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.compiler.frozen import dataclass

# The sections of a topology, which a name may start with.
SECTIONS = ("clocks", "couplers", "hands", "links", "masses", "parameters")

# Where a mistake in an override stands, when it came from no line of a file.
OVERRIDE = Place("override")


@dataclass(frozen=True, slots=True)
class Free:
    """A parameter or timing that a value is wanted of: of one group, or of all (`group` None)."""

    name: str
    group: str | None = None

    @property
    def label(self) -> str:
        """The name as a person writes it, its group before it."""
        return self.name if self.group is None else f"{self.group}.{self.name}"

    def meets(self, other: Free) -> bool:
        """Say whether both are one number of some group: without a group it is that of all."""
        return self.name == other.name and (self.group == other.group or None in (self.group, other.group))


@dataclass(frozen=True, slots=True)
class Range:
    """What a box leaves open, or an axis of a region runs over: from `low` to `high`, exact, in SI."""

    free: Free
    unit: str
    low: Fraction
    high: Fraction


def find(system: CompiledSystem, name: str, place: Place = OVERRIDE) -> Free:
    """Return the parameter or timing a person's name means, of the group it names, if any.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers, or of those that are heard.
    """
    times = {timing.name for timing in named_times(system)}
    known = {parameter.name for parameter in system.parameters if is_named(parameter.name)} | times
    groups = {group.name for group in system.groups}
    written = name[:80].strip() or "an empty name"
    first, _, rest = name.partition(".")
    if first in SECTIONS and name not in known:
        name = rest
    first, _, rest = name.partition(".")
    group = None
    if name not in known and first in groups and rest in {parameter.name for parameter in system.parameters}:
        name, group = rest, first
    if group is not None and name in times:
        what = f"{written} is no parameter of {system.name}: {name} is one time for all groups"
        raise ApcError(Mistake("E622", place, what, hint=name))
    if counts_peers(name):
        what = "the number of peers: change a count"
        if name != PEERS:
            what = "how many peers are heard, by their weights: change a count or the link's graph"
        message = f"{written} is {what} and compile again"
        raise ApcError(Mistake("E623", place, message))
    if name not in known:
        near = nearest(name, sorted(known))
        raise ApcError(Mistake("E622", place, f"{written} is no parameter of {system.name}", hint=near))
    return Free(name, group)


def is_named(name: str) -> bool:
    """Say whether a parameter or timing stands in the scene under a name of its own.

    What the compiler counts, as `peers` and `count(lan)`, and the delay of a hold without one or by an
    expression, are not the user's to vary: their names hold what no name in a scene can.
    """
    return not counts_peers(name) and " " not in name


def named_times(system: CompiledSystem) -> list[Timing]:
    """Return the timings that stand in the scene under a name of their own."""
    return [timing for timing in system.timings if is_named(timing.name)]


def parameter_of(system: CompiledSystem, free: Free) -> Parameter:
    """Return a free parameter as its group has it, or everybody."""
    for group in system.groups:
        for parameter in group.values:
            if group.name == free.group and parameter.name == free.name:
                return parameter
    return next(parameter for parameter in system.parameters if parameter.name == free.name)


def value_now(system: CompiledSystem, free: Free) -> float:
    """Return the present value of a parameter or timing, in SI."""
    times = {timing.name: timing.value for timing in system.timings}
    return float(times[free.name]) if free.name in times else parameter_of(system, free).value


def unit_of(system: CompiledSystem, name: str) -> str:
    """Return the unit a parameter or timing wants."""
    for parameter in system.parameters:
        if parameter.name == name:
            return parameter.unit
    return "s"
