"""The clocks of a topology: their periods and phases.

Takes: the section `clocks`. Gives: `ClockDeclaration`, `read_clocks`.
Guarantees: a period is more than nothing, a phase less than its period; both are exact.
Does not: know what ticks with a clock (see `clocks`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Container
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.components.component import RESERVED
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import MappingReader, brief, fault, name_of
from apc.compiler.topology.topology_parameters import NamedNumbers

CLOCK = ("period", "phase")
LIKE_A_RATE = 30  # a larger number without a unit is rather a rate in Hz than a period in ms


@dataclass(frozen=True, slots=True)
class ClockDeclaration:
    """Ticks at `phase + k*period`, in seconds."""

    name: str
    period: ScalarValue
    phase: ScalarValue


def read_clocks(
    root: MappingReader, numbers: NamedNumbers, used: Container[str]
) -> dict[str, ClockDeclaration]:
    """Read `clocks: {haptic: 1 ms, network: {period: 8 ms, phase: 2 ms}}`.

    Parameters
    ----------
    root
        The topology.
    numbers
        Reads the times.
    used
        The names that are used already.
    """
    result: dict[str, ClockDeclaration] = {}
    for key, value in root.section("clocks", "{haptic: 1 ms}"):
        with root.mistakes:
            name = name_of(key, "a clock", used, "this topology", RESERVED)
            result[name] = _read_clock(name, value, numbers, root)
    return result


def _read_clock(name: str, node: Node, numbers: NamedNumbers, root: MappingReader) -> ClockDeclaration:
    """Read a period, or a mapping of a period and a phase."""
    phase = ScalarValue(Fraction(0), SECOND, None, node.location)
    if isinstance(node, Mapping):
        body = MappingReader(node, CLOCK, f"clock {name}", root.mistakes)
        if "period" not in body.nodes:
            raise fault("E201", node.location, f"clock {name} has no period", hint="period: 1 ms")
        given = body.read("period", numbers.read_time, None)
        shift = body.read("phase", numbers.read_time, None if "phase" in body.nodes else phase)
        if given is None or shift is None:
            raise AlreadyReportedError
        period, phase = given, shift
    elif isinstance(node, Scalar) and type(node.value) in (int, float) and node.plain:
        hint = f"{name}: 1 ms"
        with contextlib.suppress(ValueError):  # YAML's other number formats are not valid for a rate
            if (size := plain_float(node.text)) > 0:
                rates = f"{name}: {node.text} Hz", f"{name}: {node.text} ms"
                hint = ", or ".join(rates if size > LIKE_A_RATE else reversed(rates))
        raise fault("E204", node.location, name, "a time or a rate", f"{brief(node.text)} (no unit)", hint)
    else:
        period = numbers.read_time(node, name)
    if period.number <= 0:
        message, hint = f"the period of clock {name}", f"{name}: 1 ms"
        raise fault("E207", period.location, message, "more than 0 s", str(period), hint)
    if not 0 <= phase.number < period.number:
        expected = "0 s or more and less than its period"
        rest = f"{1000 * float(phase.number % period.number):.6g}"
        hint = f"phase: {rest} ms" if float(rest) < 1000 * float(period.number) else ""
        raise fault("E207", phase.location, f"the phase of clock {name}", expected, str(phase), hint)
    return ClockDeclaration(name, period, phase)
