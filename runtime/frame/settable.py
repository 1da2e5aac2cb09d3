"""What may be set of a compiled scene: every number by its name, with its value, unit and limits.

Takes: a `Model`. Gives: `Settable`, `Parameters`, `parameters`.
Guarantees: what is listed is what `--set` takes, or says why it does not; a number of which a group has its
own has a row for each group, though without the group it is set for all.
Does not: change a value (see `overrides`), or list words such as a part's type, which are decided as the
scene is compiled.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from apc.compiler.compiled import (
    LARGEST_COUNT,
    Group,
    Model,
    Parameter,
    Timing,
    counts_peers,
    group_count,
)
from apc.frame.display_units import DisplayUnit
from apc.frame.names import ParameterRef, is_named, named_times, parameter_of, times_of, values_by_group
from apc.frame.parameters import columns_of
from apc.result import Result


@dataclass(frozen=True, slots=True)
class Settable:
    """A number that may be set: `low` to `high` are what it has, in SI, the same but where peers differ.

    Between `minimum` and `maximum` it may lie, None where there is no limit; `open_minimum` says that the
    least value itself is excluded. `follows` is the expression that gives it as long as it isn't set; `fixed`
    says why it can't be set, if it can't.
    """

    name: str
    low: float
    high: float
    unit: str
    minimum: float | None
    open_minimum: bool
    maximum: float | None
    follows: str
    fixed: str
    about: str


@dataclass(frozen=True, slots=True)
class Parameters(Result):
    """Everything that may be set of a scene."""

    topology: str
    rows: tuple[Settable, ...]

    shown_by: ClassVar[str] = "vary_output:parameters"


def parameters(system: Model) -> Parameters:
    """List what may be set of a scene, with its value, unit and limits."""
    return Parameters(system.name, tuple(_rows(system)))


def _rows(system: Model) -> Iterator[Settable]:
    times = {timing.name for timing in system.timings}
    for parameter in system.parameters:
        if not is_named(parameter.name) or parameter.name in times:
            continue
        if not values_by_group(system, ParameterRef(parameter.name)):
            yield _number(parameter, parameter.name, parameter.value, parameter.value)
            continue
        for group in system.groups:
            own = parameter_of(system, ParameterRef(parameter.name, group.name))
            yield _number(own, f"{group.name}.{parameter.name}", *_span(system, group, own))
    for timing in named_times(system):
        yield _time(system, timing)
    for group in system.groups:
        yield _count(system, group)


def _count(system: Model, group: Group) -> Settable:
    """Return how many peers a group has: to be set where they are alike and no graph names them."""
    parameter = next(
        parameter for parameter in system.parameters if parameter.name == group_count(group.name)
    )
    named = [link.name for link in system.links if link.graph.shape == "arcs"]
    own = [column.name for column in group.columns if not counts_peers(column.name)]
    fixed = f"the graph of {named[0]} names the peers" if named else ""
    fixed = f"{own[0]} has a value for each peer" if own else fixed
    most = float(LARGEST_COUNT)
    return Settable(
        parameter.name,
        parameter.value,
        parameter.value,
        "1",
        1.0,
        False,
        most,
        _text(parameter),
        fixed,
        parameter.about,
    )


def _span(system: Model, group: Group, parameter: Parameter) -> tuple[float, float]:
    values = columns_of(system, group).get(parameter.name)
    return (parameter.value, parameter.value) if values is None else (float(min(values)), float(max(values)))


def _number(parameter: Parameter, name: str, low: float, high: float) -> Settable:
    about = parameter.about
    return Settable(
        name,
        low,
        high,
        DisplayUnit.of(parameter),
        parameter.minimum,
        parameter.open_minimum,
        parameter.maximum,
        _text(parameter),
        "",
        about,
    )


def _time(system: Model, timing: Timing) -> Settable:
    """Return a period, which is above 0 s, a phase, which is below its period, or a delay."""
    values = [item.value for item in system.timings if item.name in times_of(system, timing.name)]
    about = ""
    for clock in system.clocks:
        if timing.name == clock.period:
            about = f"from one tick of {clock.name} to the next"
        if timing.name == clock.phase:
            about = f"first tick of {clock.name}, below its period"
    if any(timing.name == link.delay for link in system.links):
        about = "from a packet's sending to where it can be heard"
    text = next((parameter.about for parameter in system.parameters if parameter.name == timing.name), about)
    low, high = float(min(values)), float(max(values))
    is_period = timing.name in {clock.period for clock in system.clocks}
    return Settable(timing.name, low, high, "s", 0.0, is_period, None, _text(timing), "", text)


def _text(item: Parameter | Timing) -> str:
    return "" if item.formula is None else item.formula.text
