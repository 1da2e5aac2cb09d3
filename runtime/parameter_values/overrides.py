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

from apc.compiler.compiled import Experiment, Formula, Group, Model, Parameter, Timing, group_count
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.language.evaluation import exact_value
from apc.compiler.peer_counts import peers_of, recounted
from apc.compiler.wording import choice_fixes, choices_text, with_unit
from apc.parameter_values.display_units import DisplayUnit, as_shown
from apc.parameter_values.parameter_names import OVERRIDE, ParameterRef, choices_of, find, unit_of
from apc.parameter_values.parameters import ParameterScope, columns_of, scope_of, with_times_of_groups

N = TypeVar("N", Parameter, Timing)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Override:
    """A new SI value for a parameter or timing."""

    free: ParameterRef
    value: Fraction


def parse_override(model: Model, text: str) -> Override:
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
        raise ApcError(Diagnostic("E621", OVERRIDE, "override", "NAME=VALUE", text[:80], form))
    parameter_ref = find(model, name, OVERRIDE, counts=True, value=value)
    unit = unit_of(model, parameter_ref.name)
    choices = choices_of(model, parameter_ref)
    if value in choices:
        return Override(parameter_ref, Fraction(choices[value]))
    try:
        result = quantity(value, OVERRIDE, subject=name, unit=unit, before=f"{name}=")
    except ApcError:
        if not choices:
            raise
        expected, fix = choices_text(choices.items(), unit), choice_fixes(choices.items(), f"{name}=")
        raise ApcError(Diagnostic("E624", OVERRIDE, name, expected, value[:80], fix)) from None
    return Override(parameter_ref, result.value)


def apply(model: Model, overrides: Sequence[Override]) -> Model:
    """Return the model with new values.

    A parameter that is set loses its formula, and its dependents are computed.

    Raises
    ------
    ApcError
        E622 a group's own value for a number on which a time of all groups or a count depends, E624 a value
        beyond the parameter's bounds, E625 an invalid time, E626 an invalid number of peers.
    """
    if not overrides:
        return model
    common_values = with_times_of_groups(
        model, {override.free.name: override.value for override in overrides if override.free.group is None}
    )
    counts = _changed_counts(model, common_values)
    if counts:
        common_values |= peers_of(counts)
    timings = {timing.name for timing in model.timings}
    parameters = {parameter.name: parameter for parameter in model.parameters}
    common = _with_dependents(scope_of(model), common_values)
    groups = []
    for group in model.groups:
        own_values = {
            override.free.name: override.value for override in overrides if override.free.group == group.name
        }
        # A value for all groups replaces the group's own value, except the value of a timing of the group.
        shared = {
            name: value for name, value in common_values.items() if f"{group.name}.{name}" not in timings
        }
        values = {value.name: value for value in group.values if value.name not in shared}
        values |= {name: parameters[name] for name in own_values if name not in values}
        if own_values:
            _check_times(model, group.name, list(values.values()), own_values)
        given = {**shared, **own_values}
        changed = _with_dependents(scope_of(model, list(values.values())), given)
        if own_values:
            # A value shared by all groups becomes the group's own once it depends on a value of its own.
            values |= {
                name: parameter
                for name, parameter in parameters.items()
                if name not in values
                and _with_changed_value(parameter, changed, given)
                != _with_changed_value(parameter, common, common_values)
            }
        groups.append(
            replace(
                group,
                values=tuple(_with_changed_value(value, changed, given) for value in values.values()),
                # A value for the group, or for all groups, is the value of each of its peers.
                columns=tuple(
                    column
                    for column in group.columns
                    if column.name not in common_values.keys() | own_values.keys()
                ),
            )
        )
    compiled_model = replace(
        model,
        origin=model.origin.after(*((override.free.label, str(override.value)) for override in overrides)),
        parameters=tuple(
            _with_changed_value(parameter, common, common_values) for parameter in model.parameters
        ),
        timings=tuple(_with_changed_value(timing, common, common_values) for timing in model.timings),
        groups=tuple(groups),
        within=tuple(axis for axis in model.within if axis.parameter not in common_values),
        experiment=_changed_experiment(model, common),
    )
    if counts:
        compiled_model = recounted(compiled_model, counts, OVERRIDE)
    _check_bounds(compiled_model)
    return compiled_model


def _changed_counts(model: Model, common_values: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the number of peers of each group after an override; empty if no number changes.

    `common_values` are the overridden values that hold for all groups, by parameter name.
    """
    counts = {group.name: Fraction(group.count) for group in model.groups}
    count_names = {group_count(name) for name in counts}
    scope = scope_of(model)
    if scope.needed(count_names).isdisjoint(common_values):
        return {}
    values = scope.follow(common_values, exact_value, lambda name: scope.holder[name].number, count_names)
    result = {name: values.get(group_count(name), count) for name, count in counts.items()}
    return result if result != counts else {}


def _with_dependents(scope: ParameterScope, given: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the given values and the values of their dependents, exactly."""
    return scope.follow(given, exact_value, lambda name: scope.holder[name].number)


def _with_changed_value(item: N, changed: Mapping[str, Fraction], given: Collection[str]) -> N:
    """Return a parameter or timing with its changed value; a given value removes its formula."""
    if item.name not in changed:
        return item
    value, formula = changed[item.name], None if item.name in given else item.formula
    if isinstance(item, Timing):
        return replace(item, value=value, formula=formula)
    return replace(item, value=float(value), exact=value, formula=formula)


def _changed_experiment(model: Model, changed: Mapping[str, Fraction]) -> Experiment:
    """Return the experiment with the times that depend on changed values."""
    experiment, holder = model.experiment, scope_of(model).holder

    def time(formula: Formula | None, present: T) -> T | Fraction:
        """Return a time in seconds by its formula, the present one if nothing changes it."""
        if formula is None or changed.keys().isdisjoint(formula.names):
            return present
        values = [changed[name] if name in changed else holder[name].number for name in formula.names]
        return exact_value("experiment", formula, values)

    joins, leaves = (
        tuple(replace(item, at=time(item.formula, item.at)) for item in items)
        for items in (experiment.joins, experiment.leaves)
    )
    duration = time(experiment.formula, experiment.duration)
    return replace(experiment, duration=duration, joins=joins, leaves=leaves)


def _check_times(
    model: Model, group: str, values: Sequence[Parameter], own_values: Mapping[str, Fraction]
) -> None:
    """Raise ApcError E622 for a group's own value on which a time for all groups depends.

    Parameters
    ----------
    model
        The model before any override.
    group, values, own_values
        The group, its own parameters, and the values set for it.
    """
    changed = _with_dependents(scope_of(model, [*values, *model.timings]), own_values)
    shared = {timing.name: "a time common to all groups" for timing in model.timings}
    shared |= {group_count(group.name): "a number of the topology" for group in model.groups}
    shared |= {
        name: "a number of the topology" for formula in model.experiment.formulas for name in formula.names
    }
    for name, meant in shared.items():
        if name in changed:
            message = f"{name} is {meant}, but depends on a value of {group}"
            advice = "set it without the group, or set a separate value in the group"
            raise ApcError(Diagnostic("E622", OVERRIDE, message, advice=advice))


def _check_bounds(model: Model) -> None:
    """Raise an error with every value that is out of its bounds.

    Values that follow from others are checked once all other values are within their bounds.
    """
    mistakes = Mistakes()
    for follows in (False, True):
        for parameter in model.parameters:
            if (parameter.formula is not None) == follows:
                check_bounds(parameter, parameter.name, mistakes)
        for group in model.groups:
            for parameter in group.values:
                if (parameter.formula is not None) == follows:
                    check_bounds(parameter, f"{group.name}.{parameter.name}", mistakes)
        mistakes.raise_if_any()
    for group in model.groups:
        _check_columns(model, group, mistakes)
    periods = {clock.period for clock in model.clocks}
    for timing in model.timings:
        got = _in_ms(timing.value)
        if timing.name in periods and timing.value <= 0:
            expected = "a time above 0 s"
            mistakes.add("E625", OVERRIDE, timing.name, expected=expected, got=got, subject=timing.name)
        elif timing.value < 0:
            expected = "a time of 0 s or more"
            mistakes.add("E625", OVERRIDE, timing.name, expected=expected, got=got, subject=timing.name)
    duration = model.experiment.duration
    if duration is not None and duration <= 0:
        expected, got = "a time above 0 s", _in_ms(duration)
        mistakes.add("E625", OVERRIDE, "duration", expected=expected, got=got, subject="duration")
    seconds = {timing.name: timing.value for timing in model.timings}
    for clock in model.clocks:
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
    """Record a value below the minimum or above the maximum of a parameter, or none of its named values.

    Parameters
    ----------
    parameter
        The parameter, with its value.
    name
        The name in the message.
    mistakes
        The list to which a mistake is added.
    code, location
        The error code and the location of the mistake.
    """
    low, high, value = parameter.minimum, parameter.maximum, parameter.value

    def shown(number: float) -> str:
        """Return a number in the unit of the parameter for display."""
        factor, unit = as_shown(number, DisplayUnit.of(parameter))
        return with_unit(f"{number * factor:g}", unit)

    def out(expected: str, number: float) -> None:
        """Record a value beyond a bound."""
        mistakes.add(
            code, location, name, expected=f"{expected} {shown(number)}", got=shown(value), subject=name
        )

    if parameter.choices and value not in dict(parameter.choices).values():
        expected, fix = (
            choices_text(parameter.choices, parameter.unit),
            choice_fixes(parameter.choices, f"{name}="),
        )
        mistakes.add(code, location, name, expected=expected, got=f"{value:g}", fix=fix, subject=name)
    if low is not None and parameter.exclusive_minimum and value <= low:
        out("more than", low)
    elif low is not None and value < low:
        out("at least", low)
    if high is not None and value > high:
        out("at most", high)


def _in_ms(seconds: Fraction) -> str:
    """Return a time as a text in ms."""
    return f"{1000 * float(seconds):.9g} ms"


def _check_columns(model: Model, group: Group, mistakes: Mistakes) -> None:
    """Record, for each parameter that differs between peers, the first peer's value out of its bounds."""
    columns = columns_of(model, group)
    holder = {parameter.name: parameter for parameter in (*model.parameters, *group.values)}
    for name, parameter in holder.items():
        if name not in columns:
            continue
        values = columns[name]
        low = -np.inf if parameter.minimum is None else parameter.minimum
        high = np.inf if parameter.maximum is None else parameter.maximum
        is_below = values <= low if parameter.exclusive_minimum else values < low
        peers_out_of_bounds = np.flatnonzero(is_below | (values > high))
        if len(peers_out_of_bounds):
            peer, value = (
                f"{group.name}[{int(peers_out_of_bounds[0]) + 1}]",
                float(values[peers_out_of_bounds[0]]),
            )
            check_bounds(replace(parameter, value=value, exact=None), f"{peer}.{name}", mistakes)
