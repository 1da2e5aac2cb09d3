"""Changing the numbers of a compiled system without compiling again.

Takes: a `Model` and overrides such as `contact.stiffness=800 N/m`.
Gives: `Override`, `parse_override`, `apply`; `check_bounds`.
Guarantees: a parameter that depends on a changed one by a formula changes with it, in exact rationals; the
others keep their compiled values. All values outside the bounds of their component are reported together; for
a parameter that differs from peer to peer, the first peer's.
Does not: change the compiled structure (which parts there are).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TypeVar

import numpy as np

from apc.compiler.compiled import Group, Model, Parameter, Timing, group_count
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.language.evaluation import exact_value
from apc.compiler.peer_counts import peers_of, recounted
from apc.compiler.wording import with_unit
from apc.frame.display_units import DisplayUnit, as_shown
from apc.frame.parameter_names import OVERRIDE, ParameterRef, find, unit_of
from apc.frame.parameters import ParameterScope, columns_of, scope_of, with_times_of_groups

N = TypeVar("N", Parameter, Timing)


@dataclass(frozen=True, slots=True)
class Override:
    """A new SI value for a parameter or timing."""

    free: ParameterRef
    value: Fraction


def parse_override(system: Model, text: str) -> Override:
    """Read `NAME=QUANTITY`; the name may start with a group, or with its section of the topology.

    Raises
    ------
    ApcError
        E621 not of that form, E622 no such parameter, E623 the number of all peers, which follows from those
        of groups; and those of `units.quantity`: the unit has to fit.
    """
    # Imported here: the language of quantities, which an analysis without overrides never needs.
    from apc.compiler.language.units import quantity

    name, equals, value = text.partition("=")
    name, value = name.strip(), value.strip()
    if not (equals and name and value):
        form = "contact.stiffness=800 N/m"
        raise ApcError(Diagnostic("E621", OVERRIDE, "an override", "NAME=VALUE", text[:80], form))
    free = find(system, name, OVERRIDE, counts=True, value=value)
    unit = unit_of(system, free.name)
    result = quantity(value, OVERRIDE, subject=name, unit=unit, before=f"{name}=")
    return Override(free, result.value)


def apply(system: Model, overrides: Sequence[Override]) -> Model:
    """Return the model with new values; a parameter set loses its formula, and its dependents follow.

    Raises
    ------
    ApcError
        E622 a group's own value for a number on which a time of all groups or a count depends, E624 a value
        beyond the parameter's bounds, E625 an invalid time, E626 an invalid number of peers.
    """
    if not overrides:
        return system
    everywhere = with_times_of_groups(
        system, {override.free.name: override.value for override in overrides if override.free.group is None}
    )
    counts = _counts(system, everywhere)
    if counts:
        everywhere |= peers_of(counts)
    timings = {timing.name for timing in system.timings}
    parameters = {parameter.name: parameter for parameter in system.parameters}
    common = _changed(scope_of(system), everywhere)
    groups = []
    for group in system.groups:
        local = {
            override.free.name: override.value for override in overrides if override.free.group == group.name
        }
        # Set for everybody means for this group as well: its own old value goes. One that follows its own
        # timing stays, and has the timing's new value.
        shared = {name: value for name, value in everywhere.items() if f"{group.name}.{name}" not in timings}
        values = {value.name: value for value in group.values if value.name not in shared}
        values |= {name: parameters[name] for name in local if name not in values}
        if local:
            _check_times(system, group.name, list(values.values()), local)
        given = {**shared, **local}
        changed = _changed(scope_of(system, list(values.values())), given)
        if local:
            # A value shared by all groups becomes the group's own once it depends on a value of its own.
            values |= {
                name: parameter
                for name, parameter in parameters.items()
                if name not in values
                and _renewed(parameter, changed, given) != _renewed(parameter, common, everywhere)
            }
        groups.append(
            replace(
                group,
                values=tuple(_renewed(value, changed, given) for value in values.values()),
                # One value for the group, or for everybody, is one for each of its peers.
                columns=tuple(
                    column for column in group.columns if column.name not in everywhere.keys() | local.keys()
                ),
            )
        )
    compiled_system = replace(
        system,
        origin=system.origin.after(*((override.free.label, str(override.value)) for override in overrides)),
        parameters=tuple(_renewed(parameter, common, everywhere) for parameter in system.parameters),
        timings=tuple(_renewed(timing, common, everywhere) for timing in system.timings),
        groups=tuple(groups),
        within=tuple(axis for axis in system.within if axis.parameter not in everywhere),
    )
    if counts:
        compiled_system = recounted(compiled_system, counts, OVERRIDE)
    _check_bounds(compiled_system)
    return compiled_system


def _counts(system: Model, everywhere: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the number of peers of each group after an override; empty if no number changes.

    `everywhere` are the overridden values that hold for all groups, by parameter name.
    """
    counts = {group.name: Fraction(group.count) for group in system.groups}
    count_names = {group_count(name) for name in counts}
    scope = scope_of(system)
    if scope.needed(count_names).isdisjoint(everywhere):
        return {}
    values = scope.follow(everywhere, exact_value, lambda name: scope.holder[name].number, count_names)
    result = {name: values.get(group_count(name), count) for name, count in counts.items()}
    return result if result != counts else {}


def _changed(scope: ParameterScope, given: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the given values and their dependents, exactly."""
    return scope.follow(given, exact_value, lambda name: scope.holder[name].number)


def _renewed(item: N, changed: Mapping[str, Fraction], given: Collection[str]) -> N:
    """Return a number with its value; one that is given loses its formula."""
    if item.name not in changed:
        return item
    value, formula = changed[item.name], None if item.name in given else item.formula
    if isinstance(item, Timing):
        return replace(item, value=value, formula=formula)
    return replace(item, value=float(value), exact=value, formula=formula)


def _check_times(
    system: Model, group: str, values: Sequence[Parameter], local: Mapping[str, Fraction]
) -> None:
    """Raise an error for a group's own value on which a time for all groups depends.

    Parameters
    ----------
    system
        The model before any override.
    group, values, local
        The group, its own parameters, and the values set for it.
    """
    changed = _changed(scope_of(system, [*values, *system.timings]), local)
    shared = {timing.name: "one time for all groups" for timing in system.timings}
    shared |= {group_count(group.name): "one number of the topology" for group in system.groups}
    for name, meant in shared.items():
        if name in changed:
            message = f"{name} is {meant}, and depends on what is set for {group}"
            hint = "the same without the group, or a group with a set of its own"
            raise ApcError(Diagnostic("E622", OVERRIDE, message, hint=hint))


def _check_bounds(system: Model) -> None:
    """Raise the mistakes of every value that is out of its bounds."""
    mistakes = Mistakes()
    for parameter in system.parameters:
        check_bounds(parameter, parameter.name, mistakes)
    for group in system.groups:
        for parameter in group.values:
            check_bounds(parameter, f"{group.name}.{parameter.name}", mistakes)
        _check_columns(system, group, mistakes)
    periods = {clock.period for clock in system.clocks}
    for timing in system.timings:
        got = _in_ms(timing.value)
        if timing.name in periods and timing.value <= 0:
            expected = "a time above 0 s"
            mistakes.add("E625", OVERRIDE, timing.name, expected=expected, got=got, subject=timing.name)
        elif timing.value < 0:
            expected = "a time of 0 s or more"
            mistakes.add("E625", OVERRIDE, timing.name, expected=expected, got=got, subject=timing.name)
    seconds = {timing.name: timing.value for timing in system.timings}
    for clock in system.clocks:
        if not seconds[clock.phase] < seconds[clock.period] and seconds[clock.period] > 0:
            got = _in_ms(seconds[clock.phase])
            mistakes.add("E625", OVERRIDE, clock.phase, expected="less than the clock's period", got=got)
    mistakes.raise_if_any()


def check_bounds(
    parameter: Parameter,
    name: str,
    mistakes: Mistakes,
    code: str = "E624",
    location: SourceLocation = OVERRIDE,
) -> None:
    """Record a value below the minimum or above the maximum of a parameter.

    Parameters
    ----------
    parameter
        The parameter, with its value.
    name
        The name in the message.
    mistakes
        Where a mistake is recorded.
    code, location
        Those of the mistake.
    """
    low, high, value = parameter.minimum, parameter.maximum, parameter.value

    def shown(number: float) -> str:
        by, unit = as_shown(number, DisplayUnit.of(parameter))
        return with_unit(f"{number * by:g}", unit)

    def out(expected: str, number: float) -> None:
        mistakes.add(
            code, location, name, expected=f"{expected} {shown(number)}", got=shown(value), subject=name
        )

    if low is not None and parameter.exclusive_minimum and value <= low:
        out("more than", low)
    elif low is not None and value < low:
        out("at least", low)
    if high is not None and value > high:
        out("at most", high)


def _in_ms(seconds: Fraction) -> str:
    return f"{1000 * float(seconds):.9g} ms"


def _check_columns(system: Model, group: Group, mistakes: Mistakes) -> None:
    """Record the first peer's value that is out of its bounds, of each parameter that differs."""
    columns = columns_of(system, group)
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    for name, parameter in holder.items():
        if name not in columns:
            continue
        values = columns[name]
        low = -np.inf if parameter.minimum is None else parameter.minimum
        high = np.inf if parameter.maximum is None else parameter.maximum
        below = values <= low if parameter.exclusive_minimum else values < low
        wrong = np.flatnonzero(below | (values > high))
        if len(wrong):
            peer, value = f"{group.name}[{int(wrong[0]) + 1}]", float(values[wrong[0]])
            check_bounds(replace(parameter, value=value, exact=None), f"{peer}.{name}", mistakes)
