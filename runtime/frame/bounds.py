"""Whether the values of a compiled system are within what its components allow.

Takes: a `CompiledSystem`, its new values in it.
Gives: `check_bounds`.
Guarantees: every value out of bounds is told, all together; of a parameter that differs from peer to peer,
the first peer's.
Does not: change a value.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from apc.compiler.compiled import CompiledSystem, Group, Parameter
from apc.compiler.errors import Mistakes
from apc.compiler.words import with_unit
from apc.frame.names import OVERRIDE
from apc.frame.rows import Columns


def check_bounds(system: CompiledSystem) -> None:
    """Raise the mistakes of every value that is out of its bounds."""
    mistakes = Mistakes()
    for parameter in system.parameters:
        _check_parameter(parameter, parameter.name, mistakes)
    for group in system.groups:
        for parameter in group.values:
            _check_parameter(parameter, f"{group.name}.{parameter.name}", mistakes)
        _check_columns(system, group, mistakes)
    periods = {clock.period for clock in system.clocks}
    for timing in system.timings:
        got = f"{float(timing.value)} s"
        if timing.name in periods and timing.value <= 0:
            mistakes.add("E625", OVERRIDE, timing.name, expected="a time above 0 s", got=got)
        elif timing.value < 0:
            mistakes.add("E625", OVERRIDE, timing.name, expected="a time of 0 s or more", got=got)
    seconds = {timing.name: timing.value for timing in system.timings}
    for clock in system.clocks:
        if not seconds[clock.phase] < seconds[clock.period] and seconds[clock.period] > 0:
            got = f"{float(seconds[clock.phase])} s"
            mistakes.add("E625", OVERRIDE, clock.phase, expected="less than the clock's period", got=got)
    mistakes.raise_if_any()


def _check_parameter(parameter: Parameter, name: str, mistakes: Mistakes) -> None:
    """Record a value below the minimum or above the maximum."""
    low, high, value = parameter.minimum, parameter.maximum, parameter.value

    def told(number: float) -> str:
        return with_unit(f"{number:g}", parameter.unit)

    def out(expected: str, number: float) -> None:
        mistakes.add("E624", OVERRIDE, name, expected=f"{expected} {told(number)}", got=told(value))

    if low is not None and parameter.open_minimum and value <= low:
        out("more than", low)
    elif low is not None and value < low:
        out("at least", low)
    if high is not None and value > high:
        out("at most", high)


def _check_columns(system: CompiledSystem, group: Group, mistakes: Mistakes) -> None:
    """Record the first peer's value that is out of its bounds, of each parameter that differs."""
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    columns = Columns(system, group, holder)
    for name, parameter in holder.items() if group.columns else ():
        values = columns.of(name)
        if values is None:
            continue
        low = -np.inf if parameter.minimum is None else parameter.minimum
        high = np.inf if parameter.maximum is None else parameter.maximum
        below = values <= low if parameter.open_minimum else values < low
        wrong = np.flatnonzero(below | (values > high))
        if len(wrong):
            peer, value = f"{group.name}[{int(wrong[0]) + 1}]", float(values[wrong[0]])
            _check_parameter(replace(parameter, value=value, exact=None), f"{peer}.{name}", mistakes)
