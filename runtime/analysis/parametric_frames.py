"""Boxes: parameters with ranges, such as `contact.stiffness=±1%`, and a model over them.

Takes: a `Model` and ranges as text.
Gives: `parse_range`; `parametric_models`; `ParametricSubsystems`, `parametric_subsystems`.
Guarantees: a subsystem's matrices are exact quotients of polynomials in the parameters of the box, with
dependents by expressions included.
Does not: prove anything (see `robust_stability`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Formula, Group, Model, Parameter
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.expression_data import RULES
from apc.compiler.language.evaluation import EvaluationError, exactly
from apc.compiler.number_parsing import plain_float
from apc.compiler.wording import with_unit
from apc.eigen.interconnection import ClosedLoop
from apc.eigen.modes import split
from apc.eigen.peer_classes import PeerClass
from apc.eigen.rational_functions import NotRational, Ratio, Ratios, parametric_subsystem
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.display_units import DisplayUnit
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.numeric_model import Prepared
from apc.frame.overrides import Override, apply, check_bounds
from apc.frame.parameter_names import ParameterRef, Range, find, overlap, times_of
from apc.frame.parameters import exact_numbers, scope_of
from apc.network.nominal_criterion import refuse_channel_number
from apc.option_value import option_values

_LOCATION = SourceLocation("box")

# The point of the box at which peers are sorted into groups: a position that no two given values share, so
# that peers equal there are equal over the complete box: for each range another power of it, as two groups
# may have the same ranges.
GENERIC = Fraction(6180339887, 10**10)


def parse_range(system: Model, text: str) -> Range:
    """Return the range of a text `NAME=±P%` or `NAME=LOW UNIT_ROUNDOFF:HIGH UNIT_ROUNDOFF`.

    Parameters
    ----------
    system
        The compiled model.
    text
        The text; the name as in `parameter_names.find`.

    Raises
    ------
    ApcError
        E830 not of that form, E831 a parameter that cannot vary in a box, E833 invalid limits; those of
        `parameter_names.find` and `units.quantity`.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (equals and name and value):
        raise _malformed(text)
    free = find(system, name, _LOCATION)
    parameter = _parameter(system, free)
    if value.startswith(("±", "+-")):
        share = _percentage(value.removeprefix("±").removeprefix("+-"), text)
        middle = parameter.number
        spread = abs(middle) * share
        if not spread:
            message = f"{name} is 0, and any share of it is 0 as well"
            raise ApcError(Diagnostic("E833", _LOCATION, message, hint=f"{name}=LOW:HIGH"))
        low, high = middle - spread, middle + spread
    else:
        first, colon, last = (part.strip() for part in value.partition(":"))
        if not (colon and first and last):
            raise _malformed(text)
        low, high = option_values(name, parameter.unit, (first, last), _LOCATION)
    _check_limits(parameter, low, high, name)
    return Range(free, DisplayUnit.of(parameter), low, high)


def _malformed(text: str) -> ApcError:
    form = "NAME=±PERCENT% or NAME=LOW:HIGH"
    return ApcError(Diagnostic("E830", _LOCATION, "a box", form, text[:80], "contact.stiffness=±1%"))


def _percentage(text: str, whole: str) -> Fraction:
    number = text.strip()
    if not number.endswith("%"):
        raise _malformed(whole)
    try:
        plain_float(number[:-1])  # Fraction accepts more than plain numbers
        share = Fraction(number[:-1].strip()) / 100
    except (ValueError, ZeroDivisionError):
        raise _malformed(whole) from None
    if share <= 0:
        raise ApcError(Diagnostic("E833", _LOCATION, "a box", "more than 0 %", number[:80]))
    return share


def _parameter(system: Model, free: ParameterRef) -> Parameter:
    """Return the parameter of a box; raise an error for times and values that differ from peer to peer."""
    name, group = free.name, free.group
    common = {parameter.name: parameter for parameter in system.parameters}
    times = {timing.name: timing.value for timing in system.timings}
    delays = {text for link in system.links for text in (link.delay, *(pair.delay for pair in link.delays))}
    if name in delays:  # analysed segment by segment
        return Parameter(name, "s", float(times[name]), minimum=0.0, exact=times[name])
    if times_of(system, name) or name in scope_of(system).needed([*times]) or name not in common:
        message = f"{name} is a time, or sets one: what happens in a frame changes with it by jumps"
        rhythm = any(name in (clock.period, clock.phase) for clock in system.clocks)
        raise ApcError(Diagnostic("E831", _LOCATION, message, hint="" if rhythm else f"apc critical {name}"))
    for item in system.groups:
        local = {value.name: value for value in item.values}
        columns = {column.name for column in item.columns}
        if group == item.name:
            if name in columns:
                raise ApcError(Diagnostic("E831", _LOCATION, f"{name} differs from peer to peer of {group}"))
            return local.get(name, common[name])
        if group is None and (name in local or name in columns):
            message = f"{name} is not the same for all: {item.name} has its own"
            raise ApcError(Diagnostic("E831", _LOCATION, message, hint=f"{item.name}.{name}=±1%"))
    return common[name]


def _check_limits(parameter: Parameter, low: Fraction, high: Fraction, name: str) -> None:
    """Raise an error for an empty range, and one beyond the parameter's bounds."""
    message, mistakes = f"the box of {name}", Mistakes()

    def shown(*ends: Fraction | float) -> list[str]:
        return [with_unit(f"{float(end):.9g}", parameter.unit).removesuffix(" 1") for end in ends]

    if not low < high:
        mistakes.add(
            "E833", _LOCATION, message, expected="a low below the high", got=" to ".join(shown(low, high))
        )
    for side, end in (("lower", low), ("upper", high)):
        text = f"the {side} end of {message}"
        check_bounds(replace(parameter, value=float(end), exact=None), text, mistakes, "E833", _LOCATION)
    if mistakes and low < high:
        # A value within the bounds; next to an excluded bound, a hundredth of the way.
        least, most = float(parameter.minimum or 0.0), parameter.maximum
        top = float(high) if most is None else min(float(high), most)
        if parameter.minimum is not None and float(low) <= least:
            low = Fraction(least + (top - least) / 100 if parameter.exclusive_minimum else least)
        hint = f"{name}={':'.join(shown(low, top))}" if low < top else ""
        raise ApcError(replace(mistake, hint=hint) for mistake in mistakes.result)
    mistakes.raise_if_any()


def parametric_models(
    system: Model, ranges: Sequence[Range], prepared: Prepared
) -> list[tuple[ClosedLoop, tuple[LinearSubsystem, ...]]]:
    """Return the closed systems of a model over a box, at some point of it.

    Each has the matrices of its subsystems, over `Fraction` and `Ratio` in the order of `ranges`.

    Parameters
    ----------
    system, ranges
        The compiled model and its ranges.
    prepared
        From `numeric_model.prepare`.

    Raises
    ------
    ApcError
        E896 a parameter of an unreliable link; those of `parametric_subsystems`.
    """
    if not ranges:
        raise ApcError(
            Diagnostic("E830", _LOCATION, "no parameter is left open", hint="contact.stiffness=±1%")
        )
    for interval in ranges:
        refuse_channel_number(system, interval.free, _LOCATION)
    subsystems = parametric_subsystems(
        system, ranges, prepared, lambda changed: lifted_groups(changed, prepared=prepared)
    )
    by_subsystem = {id(group.subsystem): subsystems.subsystems[group.name] for group in subsystems.groups}
    return [
        (closed_system, tuple(by_subsystem[id(group.subsystem)] for group in closed_system.subsystems))
        for closed_system in split(subsystems.groups, subsystems.exchange)
    ]


@dataclass(frozen=True, slots=True)
class ParametricSubsystems:
    """A model's peers, grouped by equality over a complete box.

    `at` is the model at a point of the box, `subsystems` the matrices of each group by its name, over
    `Fraction` and `Ratio`.
    """

    at: Model
    groups: tuple[PeerClass, ...]
    exchange: CommunicationGraph
    subsystems: Mapping[str, LinearSubsystem]


def parametric_subsystems(
    system: Model,
    ranges: Sequence[Range],
    prepared: Prepared,
    lifted: Callable[[Model], tuple[tuple[PeerClass, ...], CommunicationGraph]],
) -> ParametricSubsystems:
    """Return the peers of a model with symbolic parameters.

    Parameters
    ----------
    system, ranges
        The compiled model and its ranges.
    prepared
        From `numeric_model.prepare`.
    lifted
        Gives the peers of a model in groups, lifted.

    Raises
    ------
    ApcError
        E831 a parameter given twice, E832 a model that is no rational function of the parameters.
    """
    for index, interval in enumerate(ranges):
        if any(overlap(system, other.free, interval.free) for other in ranges[:index]):
            raise ApcError(Diagnostic("E831", _LOCATION, f"{interval.free.label} has two ranges in one box"))
    if not all(subsystem.parameters_suffice for subsystem in prepared.jacobians):
        message = f"{system.name} is not linear: where it is linearized may move with the parameters"
        raise ApcError(Diagnostic("E832", SourceLocation(system.origin.topology), message))
    field = Ratios.of(len(ranges))
    opened = [_dependent_parameters(system, group, ranges, field) for group in system.groups]
    point = [
        Override(interval.free, interval.low + GENERIC**index * (interval.high - interval.low))
        for index, interval in enumerate(ranges, 1)
    ]
    at = apply(system, point)
    groups, exchange = lifted(at)
    subsystems = {
        group.name: _parametric_subsystem(group, opened[exchange.group_of(group.peers.first)], system)
        for group in groups
    }
    return ParametricSubsystems(at, groups, exchange, subsystems)


def _dependent_parameters(
    system: Model, group: Group, ranges: Sequence[Range], field: Ratios
) -> dict[str, Ratio]:
    """Return the parameters of a group's peer type that depend on those of the box."""
    columns = {column.name for column in group.columns}
    scope = scope_of(system, group.values, fixed=columns)
    varying = scope.follow(dict.fromkeys(columns, True), lambda *_: True, lambda _: False)
    given = {
        interval.free.name: field.parameter(index)
        for index, interval in enumerate(ranges)
        if interval.free.group in (None, group.name)
    }

    def compute(name: str, formula: Formula, values: list[Any]) -> Any:
        local = [name for name in formula.names if name in varying]
        if local:
            message = f"{name} depends on {local[0]}, which differs from peer to peer of {group.name}"
            raise ApcError(Diagnostic("E832", _LOCATION, message))
        try:
            return exactly(formula, values, _quotients)
        except EvaluationError as fault:
            reason = fault.cause if isinstance(fault.cause, NotRational) else fault.words
            message = f"{name} = {formula.text[:60]} {reason}"
            raise ApcError(Diagnostic("E832", _LOCATION, message)) from None

    requested = system.peer_types[group.peer_type].parameters
    result = scope.follow(given, compute, lambda name: Fraction(scope.holder[name].value), requested)
    return {name: result[name] for name in requested if isinstance(result.get(name), Ratio)}


def _power(base: Any, exponent: Any) -> Any:
    whole = int(exponent)
    if whole != exponent:
        raise NotRational("takes a power that is not whole")
    return base**whole


def _quotients(word: str) -> Callable[..., Any]:
    """Return an operation over rationals, and over quotients of polynomials in the parameters."""

    def refuse(*_: Any) -> Any:
        raise NotRational(f"takes {word}() of a parameter that is left open")

    return _RULES.get(word, refuse)


_RULES: dict[str, Callable[..., Any]] = {
    **{word: rule for word, rule in RULES.items() if word not in ("sign", "floor")},
    "pow": _power,
}


def _parametric_subsystem(group: PeerClass, opened: Mapping[str, Ratio], system: Model) -> LinearSubsystem:
    """Return a subsystem's matrices, with some of its parameters symbolic."""
    peer_type = group.jacobians.peer_type
    numbers = exact_numbers(peer_type, group.parameters)
    vector = [opened.get(name, value) for name, value in zip(peer_type.parameters, numbers, strict=True)]
    try:
        return parametric_subsystem(group.jacobians, vector)
    except NotRational as reason:
        message = f"the equations of {group.name} {reason}"
        raise ApcError(Diagnostic("E832", SourceLocation(system.origin.topology), message)) from None
