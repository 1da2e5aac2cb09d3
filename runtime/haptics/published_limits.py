"""Published sufficient conditions for a wall behind a quantized position, where a topology has their form.

Takes: a `Model`.
Gives: `published_limits`.
Guarantees: a condition is evaluated only for single devices against one wall, every part of which declares
its symbols, and within its assumptions.
Does not: decide a verdict.
"""

from __future__ import annotations

from collections.abc import Iterator

from apc.compiler.compiled import Model, PeerType
from apc.frame.parameters import ResolvedNumbers, resolve
from apc.haptics.wall_conditions import CONDITIONS, UNITS

MOVING = 2  # states of a device of one degree of freedom

_SCALES = {"ms": 1e3}  # of the units in which a symbol is shown


def published_limits(system: Model) -> tuple[str, ...]:
    """Return a line for each published condition that covers a wall and a quantized position.

    Parameters
    ----------
    system
        The compiled model.
    """
    if system.links or not any(peer_type.symbols for peer_type in system.peer_types):
        return ()
    numbers = resolve(system)
    lines = [
        line
        for index, group in enumerate(system.groups)
        for line in _of_group(system.peer_types[group.peer_type], numbers, index)
    ]
    return tuple(dict.fromkeys(lines))


def _of_group(peer_type: PeerType, numbers: ResolvedNumbers, index: int) -> Iterator[str]:
    names: dict[str, list[str]] = {symbol: [] for symbol in UNITS}
    for symbol, name in peer_type.symbols:
        names[symbol].append(name)
    single = all(len(names[symbol]) == 1 for symbol in ("K", "T", "D"))
    if not single or len(peer_type.states) != MOVING:
        return
    row = dict(zip(peer_type.parameters, numbers.parameters[index][0].tolist(), strict=True))
    row |= {name: float(value) for name, value in numbers.timings.items()}
    values = {symbol: sum(row.get(name, 0.0) for name in listed) for symbol, listed in names.items()}
    if values["B"] or values["t_d"]:  # the wall has neither damping nor delay of its own
        return
    for name in ("abbott", "diolaiti"):
        condition = CONDITIONS[name]
        holds = float(condition.margin(*(values[symbol] for symbol in condition.symbols))) >= 0
        shown = ", ".join(
            f"{symbol} = {values[symbol] * _SCALES.get(UNITS[symbol], 1.0):.6g} {UNITS[symbol]}"
            for symbol in condition.symbols
        )
        word = "holds" if holds else "does not hold"
        yield f"{condition.title}: {condition.formula} {word} ({shown}); {condition.source}"
