"""The clocks of a topology: their periods and phases.

Takes: the section `clocks`. Gives: `ClockDeclaration`, `read_clocks`.
Guarantees: a period is positive, a phase is less than its period; both are exact.
Does not: assign variables to clocks (see `equations.clocks`).
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

from apc.compiler.components.component import RESERVED
from apc.compiler.errors import ApcError
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.values import AlreadyReportedError, ScalarValue, is_quantity
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import MappingReader, brief, fault, name_of
from apc.compiler.topology.topology_parameters import NamedNumbers

CLOCK = ("period", "phase")
_NUMBER = re.compile(r"[0-9.]+")
LIKE_A_RATE = 30  # a larger number without a unit is probably a rate in Hz, a smaller one a period in ms


@dataclass(frozen=True, slots=True)
class ClockDeclaration:
    """A clock with ticks at `phase + k*period` for k = 0, 1, 2, …; both times in seconds."""

    name: str
    period: ScalarValue
    phase: ScalarValue


def read_clocks(
    root: MappingReader, numbers: NamedNumbers, used: dict[str, str]
) -> dict[str, ClockDeclaration]:
    """Return the clocks of a topology by name.

    The section is `clocks: {haptic: 1 ms, network: {period: 8 ms, phase: 2 ms}}`.

    Parameters
    ----------
    root
        The topology.
    numbers
        The named numbers that the times may depend on.
    used
        The names that are already used in the topology, with their `use`; a clock has none of them.
    """
    result: dict[str, ClockDeclaration] = {}
    for key, value in root.section("clocks", "{haptic: 1 ms}"):
        with root.mistakes:
            name = name_of(key, "a clock", used, RESERVED)
            result[name] = _read_clock(name, value, numbers, root)
    return result


def _read_clock(name: str, node: Node, numbers: NamedNumbers, root: MappingReader) -> ClockDeclaration:
    """Return the clock of one entry: a period or a rate, or a mapping with the keys period and phase.

    `numbers` reads times; `root` has the collector of errors. Raises ApcError for an invalid period or phase.
    """
    phase = ScalarValue(Fraction(0), SECOND, None, node.location)
    if isinstance(node, Mapping):
        body = MappingReader(node, CLOCK, f"clock {name}", root.mistakes)
        if "period" not in body.nodes:
            raise fault("E201", node.location, f"clock {name} has no period", fix="period: 1 ms")
        given_period = body.read("period", partial(_period, numbers=numbers), None)
        given_phase = body.read("phase", numbers.read_time, None if "phase" in body.nodes else phase)
        if given_period is None or given_phase is None:
            raise AlreadyReportedError
        period, phase = given_period, given_phase
    elif isinstance(node, Scalar) and type(node.value) in (int, float) and node.plain:
        fix, expected, got = "", "a time or a rate, such as 1 ms or 1 kHz", brief(node.text)
        with contextlib.suppress(ValueError):  # YAML's other number formats are not valid for a rate
            if (size := plain_float(node.text)) > 0:
                rates = f"{name}: {node.text} Hz", f"{name}: {node.text} ms"
                fix = ", or ".join(rates if size > LIKE_A_RATE else reversed(rates))
                expected, got = "a time or a rate", f"{got} (no unit)"
        raise fault("E204", node.location, name, expected, got, fix)
    else:
        period = _period(node, name, numbers)
    if period.number <= 0:
        key = "period" if isinstance(node, Mapping) else name
        fix = f"{key}: {str(period).removeprefix('-')}" if period.number and not period.expression else ""
        raise fault("E207", period.location, f"period of {name}", "more than 0 s", str(period), fix)
    if not 0 <= phase.number < period.number:
        expected = "from 0 s to less than the period"
        phase_ms = f"{1000 * float(phase.number % period.number):.6g}"
        fix = f"phase: {phase_ms} ms" if float(phase_ms) < 1000 * float(period.number) else ""
        raise fault("E207", phase.location, f"phase of {name}", expected, str(phase), fix)
    return ClockDeclaration(name, period, phase)


def _period(node: Node, subject: str, numbers: NamedNumbers) -> ScalarValue:
    """Return the period of a clock in seconds, from a time or a rate. Raises ApcError for other values."""
    try:
        return numbers.read_time(node, subject)
    except AlreadyReportedError:
        raise
    except ApcError as error:
        number = _NUMBER.match(node.text) if isinstance(node, Scalar) and is_quantity(node.text) else None
        fix = f"{subject}: {number[0]} ms" if number else ""
        raise ApcError(
            replace(mistake, expected="a time or a rate", fix=mistake.fix or fix)
            if mistake.code == "E204" and mistake.expected == "ms"
            else mistake
            for mistake in error.mistakes
        ) from None
