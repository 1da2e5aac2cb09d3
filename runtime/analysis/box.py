"""Which parameters a box leaves open, and how far: `contact.stiffness=±1%`.

Takes: a `Model` and ranges as text.
Gives: `parse_range`; `open_systems`; `ParametricSubsystems`, `open_sites`.
Guarantees: a site's matrices are exact quotients of polynomials in the open parameters, and what depends on
these by an expression follows.
Does not: prove anything (see `box_proof`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Formula, Group, Model, Parameter
from apc.compiler.digits import plain_float
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.language.evaluation import EvaluationError, exactly
from apc.compiler.plain import RULES
from apc.compiler.words import with_unit
from apc.eigen.closing import ClosedLoop
from apc.eigen.modes import split
from apc.eigen.peers import PeerClass
from apc.eigen.ratios import NotRational, Ratio, Ratios, open_site
from apc.frame.display_units import DisplayUnit
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import Prepared
from apc.frame.names import ParameterRef, Range, find, overlap, times_of
from apc.frame.overrides import Override, apply, check_bounds
from apc.frame.parameters import exact_numbers, scope_of
from apc.frame.site import LinearSubsystem
from apc.network.nominal import refuse_channel_number
from apc.option_value import option_values

_PLACE = SourceLocation("box")

# Where in the box the peers are sorted into groups: a place that no two given values share, so that peers are
# alike there only if they are alike all over the box: of each range another power of it, as two groups may
# have the same ranges.
GENERIC = Fraction(6180339887, 10**10)


def parse_range(system: Model, text: str) -> Range:
    """Read `NAME=±P%` or `NAME=LOW UNIT:HIGH UNIT`.

    Parameters
    ----------
    system
        The compiled scene.
    text
        As written; the name as in `names.find`.

    Raises
    ------
    ApcError
        E830 not of that form, E831 a parameter that a box can't leave open, E833 limits that can't be; those
        of `names.find` and `units.quantity`.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (equals and name and value):
        raise _malformed(text)
    free = find(system, name, _PLACE)
    parameter = _parameter(system, free)
    if value.startswith(("±", "+-")):
        share = _percentage(value.removeprefix("±").removeprefix("+-"), text)
        middle = parameter.number
        spread = abs(middle) * share
        if not spread:
            what = f"{name} is 0, and any share of it is 0 as well"
            raise ApcError(Diagnostic("E833", _PLACE, what, hint=f"{name}=LOW:HIGH"))
        low, high = middle - spread, middle + spread
    else:
        first, colon, last = (part.strip() for part in value.partition(":"))
        if not (colon and first and last):
            raise _malformed(text)
        low, high = option_values(name, parameter.unit, (first, last), _PLACE)
    _check_limits(parameter, low, high, name)
    return Range(free, DisplayUnit.of(parameter), low, high)


def _malformed(text: str) -> ApcError:
    form = "NAME=±PERCENT% or NAME=LOW:HIGH"
    return ApcError(Diagnostic("E830", _PLACE, "a box", form, text[:80], "contact.stiffness=±1%"))


def _percentage(text: str, whole: str) -> Fraction:
    number = text.strip()
    if not number.endswith("%"):
        raise _malformed(whole)
    try:
        plain_float(number[:-1])  # Fraction reads more than a plain number
        share = Fraction(number[:-1].strip()) / 100
    except (ValueError, ZeroDivisionError):
        raise _malformed(whole) from None
    if share <= 0:
        raise ApcError(Diagnostic("E833", _PLACE, "a box", "more than 0 %", number[:80]))
    return share


def _parameter(system: Model, free: ParameterRef) -> Parameter:
    """Return the parameter a box is about; refuse times and values that differ from peer to peer."""
    name, group = free.name, free.group
    common = {parameter.name: parameter for parameter in system.parameters}
    times = {timing.name: timing.value for timing in system.timings}
    delays = {text for link in system.links for text in (link.delay, *(pair.delay for pair in link.delays))}
    if name in delays:  # judged piece by piece
        return Parameter(name, "s", float(times[name]), minimum=0.0, exact=times[name])
    if times_of(system, name) or name in scope_of(system).needed([*times]) or name not in common:
        what = f"{name} is a time, or sets one: what happens in a frame changes with it by jumps"
        rhythm = any(name in (clock.period, clock.phase) for clock in system.clocks)
        raise ApcError(Diagnostic("E831", _PLACE, what, hint="" if rhythm else f"apc critical {name}"))
    for item in system.groups:
        own = {value.name: value for value in item.values}
        columns = {column.name for column in item.columns}
        if group == item.name:
            if name in columns:
                raise ApcError(Diagnostic("E831", _PLACE, f"{name} differs from peer to peer of {group}"))
            return own.get(name, common[name])
        if group is None and (name in own or name in columns):
            what = f"{name} is not the same for all: {item.name} has its own"
            raise ApcError(Diagnostic("E831", _PLACE, what, hint=f"{item.name}.{name}=±1%"))
    return common[name]


def _check_limits(parameter: Parameter, low: Fraction, high: Fraction, name: str) -> None:
    """Refuse an empty range, and one beyond the parameter's bounds."""
    what, mistakes = f"the box of {name}", Mistakes()

    def shown(*ends: Fraction | float) -> list[str]:
        return [with_unit(f"{float(end):.9g}", parameter.unit).removesuffix(" 1") for end in ends]

    if not low < high:
        mistakes.add("E833", _PLACE, what, expected="a low below the high", got=" to ".join(shown(low, high)))
    for side, end in (("lower", low), ("upper", high)):
        text = f"the {side} end of {what}"
        check_bounds(replace(parameter, value=float(end), exact=None), text, mistakes, "E833", _PLACE)
    if mistakes and low < high:
        # What lies within the bounds; next to one that must not be met, a hundredth of the way.
        least, most = float(parameter.minimum or 0.0), parameter.maximum
        top = float(high) if most is None else min(float(high), most)
        if parameter.minimum is not None and float(low) <= least:
            low = Fraction(least + (top - least) / 100 if parameter.open_minimum else least)
        hint = f"{name}={':'.join(shown(low, top))}" if low < top else ""
        raise ApcError(replace(mistake, hint=hint) for mistake in mistakes.found)
    mistakes.raise_if_any()


def open_systems(
    system: Model, ranges: Sequence[Range], prepared: Prepared
) -> list[tuple[ClosedLoop, tuple[LinearSubsystem, ...]]]:
    """Return the closed systems of a scene with parameters left open, at some point of the box.

    With each come the matrices of its sites, over `Fraction` and `Ratio` in the order of `ranges`.

    Parameters
    ----------
    system, ranges
        The compiled scene and what is left open.
    prepared
        From `instance.prepare`.

    Raises
    ------
    ApcError
        E896 a number of an unreliable link; those of `open_sites`.
    """
    if not ranges:
        raise ApcError(Diagnostic("E830", _PLACE, "no parameter is left open", hint="contact.stiffness=±1%"))
    for interval in ranges:
        refuse_channel_number(system, interval.free, _PLACE)
    sites = open_sites(system, ranges, prepared, lambda changed: lifted_groups(changed, prepared=prepared))
    by_site = {id(group.site): sites.sites[group.name] for group in sites.groups}
    return [
        (closed_system, tuple(by_site[id(group.site)] for group in closed_system.sites))
        for closed_system in split(sites.groups, sites.exchange)
    ]


@dataclass(frozen=True, slots=True)
class ParametricSubsystems:
    """A scene's peers where they are alike only if they are alike all over a box.

    `at` is the scene there, `sites` the matrices of each group by its name, over `Fraction` and `Ratio`.
    """

    at: Model
    groups: tuple[PeerClass, ...]
    exchange: CommunicationGraph
    sites: Mapping[str, LinearSubsystem]


def open_sites(
    system: Model,
    ranges: Sequence[Range],
    prepared: Prepared,
    lifted: Callable[[Model], tuple[tuple[PeerClass, ...], CommunicationGraph]],
) -> ParametricSubsystems:
    """Leave parameters of a scene's peers open.

    Parameters
    ----------
    system, ranges
        The compiled scene and what is left open.
    prepared
        From `instance.prepare`.
    lifted
        Gives the peers of a scene in groups, lifted.

    Raises
    ------
    ApcError
        E831 a parameter left open twice, E832 a scene that is no rational function of the parameters.
    """
    for place, interval in enumerate(ranges):
        if any(overlap(system, other.free, interval.free) for other in ranges[:place]):
            raise ApcError(Diagnostic("E831", _PLACE, f"{interval.free.label} has two ranges in one box"))
    if not all(site.parameters_suffice for site in prepared.jacobians):
        what = f"{system.name} is not linear: where it is linearized may move with the parameters"
        raise ApcError(Diagnostic("E832", SourceLocation(system.origin.topology), what))
    field = Ratios.of(len(ranges))
    opened = [_opened(system, group, ranges, field) for group in system.groups]
    point = [
        Override(interval.free, interval.low + GENERIC**place * (interval.high - interval.low))
        for place, interval in enumerate(ranges, 1)
    ]
    at = apply(system, point)
    groups, exchange = lifted(at)
    sites = {
        group.name: _open_site(group, opened[exchange.group_of(group.peers.first)], system)
        for group in groups
    }
    return ParametricSubsystems(at, groups, exchange, sites)


def _opened(system: Model, group: Group, ranges: Sequence[Range], field: Ratios) -> dict[str, Ratio]:
    """Return those parameters of a group's kind that the open ones reach."""
    columns = {column.name for column in group.columns}
    scope = scope_of(system, group.values, fixed=columns)
    varying = scope.follow(dict.fromkeys(columns, True), lambda *_: True, lambda _: False)
    given = {
        interval.free.name: field.parameter(place)
        for place, interval in enumerate(ranges)
        if interval.free.group in (None, group.name)
    }

    def compute(name: str, formula: Formula, values: list[Any]) -> Any:
        own = [name for name in formula.names if name in varying]
        if own:
            what = f"{name} depends on {own[0]}, which differs from peer to peer of {group.name}"
            raise ApcError(Diagnostic("E832", _PLACE, what))
        try:
            return exactly(formula, values, _quotients)
        except EvaluationError as fault:
            reason = fault.cause if isinstance(fault.cause, NotRational) else fault.words
            what = f"{name} = {formula.text[:60]} {reason}"
            raise ApcError(Diagnostic("E832", _PLACE, what)) from None

    wanted = system.kinds[group.kind].parameters
    result = scope.follow(given, compute, lambda name: Fraction(scope.holder[name].value), wanted)
    return {name: result[name] for name in wanted if isinstance(result.get(name), Ratio)}


def _power(base: Any, exponent: Any) -> Any:
    whole = int(exponent)
    if whole != exponent:
        raise NotRational("takes a power that is not whole")
    return base**whole


def _quotients(word: str) -> Callable[..., Any]:
    """Return what an operation is of rationals, and of quotients of polynomials in the open parameters."""

    def refuse(*_: Any) -> Any:
        raise NotRational(f"takes {word}() of a parameter that is left open")

    return _RULES.get(word, refuse)


_RULES: dict[str, Callable[..., Any]] = {
    **{word: rule for word, rule in RULES.items() if word not in ("sign", "floor")},
    "pow": _power,
}


def _open_site(group: PeerClass, opened: Mapping[str, Ratio], system: Model) -> LinearSubsystem:
    """Return a site's matrices, some of its parameters open."""
    kind = group.jacobians.kind
    numbers = exact_numbers(kind, group.parameters)
    vector = [opened.get(name, value) for name, value in zip(kind.parameters, numbers, strict=True)]
    try:
        return open_site(group.jacobians, vector)
    except NotRational as reason:
        what = f"the equations of {group.name} {reason}"
        raise ApcError(Diagnostic("E832", SourceLocation(system.origin.topology), what)) from None
