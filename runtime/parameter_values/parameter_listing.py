"""The settable numbers of a compiled model by name, with value, unit and limits.

Takes: a `Model`. Gives: `Settable`, `Parameters`, `parameters`.
Guarantees: the list contains every number that `--set` accepts, or the reason why it is fixed; a number with
different values in groups has a row for each group, though a name without a group sets it for all.
Does not: change a value (see `overrides`), or list options such as a part's type, which are fixed at
compilation.
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
from apc.parameter_values.display_units import DisplayUnit
from apc.parameter_values.parameter_names import (
    ParameterRef,
    is_named,
    named_times,
    parameter_of,
    times_of,
    values_by_group,
)
from apc.parameter_values.parameters import columns_of
from apc.result import Result


@dataclass(frozen=True, slots=True)
class Settable:
    """A settable number: `low` and `high` are its values in SI, equal unless peers differ.

    The limits are `minimum` and `maximum`, None where there is no limit; `exclusive_minimum` excludes the
    minimum itself. `follows` is the expression that gives it until it is set; `fixed` is the reason why it
    cannot be set, if any.
    """

    name: str
    low: float
    high: float
    unit: str
    minimum: float | None
    exclusive_minimum: bool
    maximum: float | None
    follows: str
    fixed: str
    description: str


@dataclass(frozen=True, slots=True)
class Parameters(Result):
    """All settable numbers of a model."""

    topology: str
    rows: tuple[Settable, ...]

    shown_by: ClassVar[str] = "parameter_studies_output:parameters"


def parameters(model: Model) -> Parameters:
    """Return the settable numbers of a model, with value, unit and limits."""
    return Parameters(model.name, tuple(_rows(model)))


def _rows(model: Model) -> Iterator[Settable]:
    """Yield a row for each settable number; for each group where their values differ."""
    times = {timing.name for timing in model.timings}
    for parameter in model.parameters:
        if not is_named(parameter.name) or parameter.name in times:
            continue
        if not values_by_group(model, ParameterRef(parameter.name)):
            yield _parameter_row(parameter, parameter.name, parameter.value, parameter.value)
            continue
        for group in model.groups:
            group_parameter = parameter_of(model, ParameterRef(parameter.name, group.name))
            yield _parameter_row(
                group_parameter, f"{group.name}.{parameter.name}", *_span(model, group, group_parameter)
            )
    for timing in named_times(model):
        yield _time(model, timing)
    for group in model.groups:
        yield _count(model, group)


def _count(model: Model, group: Group) -> Settable:
    """Return the row of a group's number of peers: settable if its peers are equal and no graph
    names them.
    """
    parameter = next(parameter for parameter in model.parameters if parameter.name == group_count(group.name))
    named = [link.name for link in model.links if link.graph.shape == "arcs" and not link.graph.groups]
    local = [column.name for column in group.columns if not counts_peers(column.name)]
    fixed = f"the graph of {named[0]} lists the peers by name" if named else ""
    fixed = f"{local[0]} has a value for each peer" if local else fixed
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
        parameter.description,
    )


def _span(model: Model, group: Group, parameter: Parameter) -> tuple[float, float]:
    """Return the least and the largest value of a parameter within a group, in SI."""
    values = columns_of(model, group).get(parameter.name)
    return (parameter.value, parameter.value) if values is None else (float(min(values)), float(max(values)))


def _parameter_row(parameter: Parameter, name: str, low: float, high: float) -> Settable:
    """Return the row of a parameter, under a name, with its least and largest value in SI."""
    description = parameter.description
    return Settable(
        name,
        low,
        high,
        DisplayUnit.of(parameter),
        parameter.minimum,
        parameter.exclusive_minimum,
        parameter.maximum,
        _text(parameter),
        "",
        description,
    )


def _time(model: Model, timing: Timing) -> Settable:
    """Return the row of a timing: a period above 0 s, a phase below its period, or a delay."""
    values = [item.value for item in model.timings if item.name in times_of(model, timing.name)]
    description = ""
    for clock in model.clocks:
        if timing.name == clock.period:
            description = f"period of clock {clock.name}"
        if timing.name == clock.phase:
            description = f"first tick of clock {clock.name}, below its period"
    if any(timing.name in link.delays for link in model.links):
        description = "from sending a packet to its availability at the receiver"
    text = next(
        (parameter.description for parameter in model.parameters if parameter.name == timing.name),
        description,
    )
    low, high = float(min(values)), float(max(values))
    is_period = timing.name in {clock.period for clock in model.clocks}
    return Settable(timing.name, low, high, "s", 0.0, is_period, None, _text(timing), "", text)


def _text(item: Parameter | Timing) -> str:
    """Return the text of a number's formula, "" without a formula."""
    return "" if item.formula is None else item.formula.text
