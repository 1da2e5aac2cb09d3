"""Changing the numbers of a compiled system without compiling again.

Takes: a `CompiledSystem` and overrides such as `contact.stiffness=800 N/m`.
Gives: `Override`, `parse_override`, `apply`.
Guarantees: what depends on a changed parameter by an expression changes with it, in exact rationals; bounds
are kept; the rest keeps the very numbers it was compiled with.
Does not: change what was compiled as structure (which parts there are, how many peers).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import CompiledSystem, Parameter, Timing
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.bounds import check_bounds
from apc.frame.names import OVERRIDE, find, unit_of


@dataclass(frozen=True, slots=True)
class Override:
    """A new SI value for a parameter or timing: of one group, or of all (`group` None)."""

    name: str
    group: str | None
    value: Fraction


def parse_override(system: CompiledSystem, text: str, place: Place = OVERRIDE) -> Override:
    """Read `NAME=QUANTITY`; the name may start with a group, or with the section it stands in.

    Raises
    ------
    ApcError
        E621 not of that form, E622 no such parameter, E623 the number of peers is not a parameter to set;
        and those of `units.quantity`: the unit has to fit.
    """
    # Imported here: the language of quantities, which an analysis without overrides never needs.
    from apc.compiler.language.units import quantity

    name, equals, value = text.partition("=")
    name, value = name.strip(), value.strip()
    if not (equals and name and value):
        form = "contact.stiffness=800 N/m"
        raise ApcError(Mistake("E621", place, "an override", "NAME=VALUE", text[:80], form))
    known, group = find(system, name, place)
    unit = unit_of(system, known)
    found = quantity(
        value, place.shifted(len(text) - len(value)) if place.line else place, what=name, unit=unit
    )
    return Override(known, group, found.value)


def apply(system: CompiledSystem, overrides: Sequence[Override]) -> CompiledSystem:
    """Return the system with new values; a parameter set loses its expression, what depends on it follows.

    Raises
    ------
    ApcError
        E622 a group's own value for what a time of all groups depends on, E624 a value beyond the
        parameter's bounds, E625 a time that can't be.
    """
    if not overrides:
        return system
    everywhere = {one.name: one.value for one in overrides if one.group is None}
    parameters = {parameter.name: parameter for parameter in system.parameters}
    timings = {timing.name: timing for timing in system.timings}
    common = _Scope(parameters, timings, everywhere)
    groups = []
    for group in system.groups:
        own = {one.name: one.value for one in overrides if one.group == group.name}
        # Set for everybody means for this group as well: its own old value goes. A time of its own stays.
        shared = {name: value for name, value in everywhere.items() if f"{group.name}.{name}" not in timings}
        values = {value.name: value for value in group.values if value.name not in shared}
        values |= {name: parameters[name] for name in own if name not in values}
        if own:
            _check_times(group.name, _Scope({**parameters, **values}, timings, own), system.timings)
        scope = _Scope({**parameters, **values}, timings, {**shared, **own})
        # What a group leaves to everybody is its own as soon as it depends on a value of its own.
        values |= {
            name: parameter
            for name, parameter in parameters.items()
            if name not in values and own and scope.parameter(name) != common.parameter(name)
        }
        groups.append(
            replace(
                group,
                values=tuple(scope.parameter(name) for name in values),
                # One value for the group, or for everybody, is one for each of its peers.
                columns=tuple(
                    column for column in group.columns if column.name not in everywhere.keys() | own.keys()
                ),
            )
        )
    changed = replace(
        system,
        parameters=tuple(common.parameter(name) for name in parameters),
        timings=tuple(common.timing(name) for name in timings),
        groups=tuple(groups),
    )
    check_bounds(changed)
    return changed


def _check_times(group: str, scope: _Scope, timings: Sequence[Timing]) -> None:
    """Refuse what a group sets for itself where a time for all groups depends on it.

    Parameters
    ----------
    group, scope
        The group, and a scope that only its own overrides reach.
    timings
        The times before any override.
    """
    for timing in timings:
        if scope.timing(timing.name) is not timing:
            what = f"{timing.name} is one time for all groups, and depends on what is set for {group}"
            hint = "the same without the group, or a group with a set of its own"
            raise ApcError(Mistake("E622", OVERRIDE, what, hint=hint))


class _Scope:
    """Parameters and timings as one group sees them, with the overrides that reach it."""

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        timings: Mapping[str, Timing],
        overridden: Mapping[str, Fraction],
    ) -> None:
        self._parameters = parameters
        self._timings = timings
        self._overridden = overridden
        self._changed: dict[str, Fraction | None] = {}
        self._open: set[str] = set()

    def parameter(self, name: str) -> Parameter:
        """Return a parameter with its value in this scope."""
        parameter = self._parameters[name]
        value = self._new(name, parameter.expression)
        if value is None:
            return parameter
        kept = None if name in self._overridden else parameter.expression
        return replace(parameter, value=float(value), exact=value, expression=kept)

    def timing(self, name: str) -> Timing:
        """Return a timing with its value in this scope."""
        timing = self._timings[name]
        value = self._new(name, timing.expression)
        if value is None:
            return timing
        kept = None if name in self._overridden else timing.expression
        return replace(timing, value=value, expression=kept)

    def _new(self, name: str, expression: str | None) -> Fraction | None:
        """Return the changed value, or None when no override reaches it."""
        if name in self._overridden:
            return self._overridden[name]
        if expression is None:
            return None
        if name not in self._changed:
            assert name not in self._open, f"{name} depends on itself"
            self._open.add(name)
            self._changed[name] = self._evaluate(name, expression)
            self._open.discard(name)
        return self._changed[name]

    def _evaluate(self, name: str, text: str) -> Fraction | None:
        """Evaluate an expression if an override reaches one of its names."""
        from apc.compiler.language.evaluation import evaluate
        from apc.compiler.language.expression import names
        from apc.compiler.language.grammar import parse_expression

        place = Place(name, 1, 1, text)
        tree = parse_expression(text, place)
        reached = [self._expression_value(".".join(node.parts)) for node in names(tree)]
        if all(value is None for value in reached):
            return None
        return Fraction(evaluate(tree, self._look_up, place))

    def _expression_value(self, name: str) -> Fraction | None:
        holder: Parameter | Timing | None = self._parameters.get(name) or self._timings.get(name)
        return self._new(name, holder.expression) if holder else None

    def _look_up(self, parts: tuple[str, ...]) -> Fraction:
        name = ".".join(parts)
        changed = self._expression_value(name)
        if changed is not None:
            return changed
        if name in self._timings:
            return self._timings[name].value
        return self._parameters[name].number
