"""The clocks of a topology: what ticks, how often and from when on.

Takes: the section `clocks`. Gives: `SceneClock`, `read_clocks`.
Guarantees: a period is more than nothing, a phase less than its period; both are exact.
Does not: know what ticks with a clock (see `clocks`).
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.errors import Mistakes
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.values import Value
from apc.compiler.scene.named_numbers import NamedNumbers, read_new_name
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import brief, check_keys, entries, read_mapping

LIKE_A_RATE = 30  # a larger number without a unit is rather a rate in Hz than a period in ms


@dataclass(frozen=True, slots=True)
class SceneClock:
    """Ticks at `phase + k*period`, in seconds."""

    name: str
    period: Value
    phase: Value


def read_clocks(
    node: Node | None, numbers: NamedNumbers, taken: Container[str], mistakes: Mistakes
) -> dict[str, SceneClock]:
    """Read `clocks: {haptic: 1 ms, network: {period: 8 ms, phase: 2 ms}}`.

    Parameters
    ----------
    node
        The section.
    numbers
        Reads the times.
    taken
        The names that are used already.
    mistakes
        Takes what is at fault; a clock at fault is left out.
    """
    found: dict[str, SceneClock] = {}
    for key, value in entries(read_mapping(node, "clocks", mistakes, hint="clocks: {haptic: 1 ms}")):
        name = read_new_name(key, "a clock", taken, mistakes)
        if name is None:
            continue
        clock = _read_clock(name, value, numbers, mistakes)
        if clock is not None and _is_clock(clock, mistakes):
            found[name] = clock
    return found


def _read_clock(name: str, node: Node, numbers: NamedNumbers, mistakes: Mistakes) -> SceneClock | None:
    """Read a period, or a mapping of a period and a phase."""
    phase: Value | None = Value(Fraction(0), SECOND, None, node.place)
    if isinstance(node, Mapping):
        body = check_keys(node, ("period", "phase"), f"clock {name}", mistakes)
        period = numbers.read_time(body.get("period"), "period")
        if body.get("period") is None:
            mistakes.add("E201", node.place, f"clock {name} has no period", hint="period: 1 ms")
        if body.get("phase") is not None:
            phase = numbers.read_time(body.get("phase"), "phase")
    elif isinstance(node, Scalar) and type(node.value) in (int, float) and node.plain:
        rates = f"{name}: {node.text} Hz", f"{name}: {node.text} ms"
        hint = ", or ".join(rates if abs(float(node.text)) > LIKE_A_RATE else reversed(rates))
        got = f"{brief(node.text)} (no unit)"
        mistakes.add("E204", node.place, name, expected="a time or a rate", got=got, hint=hint)
        return None
    else:
        period = numbers.read_time(node, name)
    return None if period is None or phase is None else SceneClock(name, period, phase)


def _is_clock(clock: SceneClock, mistakes: Mistakes) -> bool:
    """Return whether a clock's times are such that it ticks."""
    period, phase = clock.period, clock.phase
    if period.number <= 0:
        what, hint = f"the period of clock {clock.name}", f"{clock.name}: 1 ms"
        mistakes.add("E207", period.place, what, expected="more than 0 s", got=str(period), hint=hint)
        return False
    if not 0 <= phase.number < period.number:
        what, expected = f"the phase of clock {clock.name}", "0 s or more and less than its period"
        mistakes.add("E207", phase.place, what, expected=expected, got=str(phase))
        return False
    return True
