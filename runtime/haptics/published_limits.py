"""Published sufficient conditions for a wall behind a quantized position, for models of their form.

Takes: a `Model`.
Gives: `published_limits`.
Guarantees: a condition is evaluated only for single devices against one wall whose parts all declare their
symbols, and within its assumptions.
Does not: decide a verdict.
"""

from __future__ import annotations

from collections.abc import Iterator

from apc.compiler.compiled import Model, PeerType
from apc.haptics.wall_conditions import CONDITIONS, UNITS
from apc.parameter_values.parameters import ResolvedNumbers, resolve

MOVING = 2  # states of a device of one degree of freedom

_SCALES = {"ms": 1e3}  # factors from SI to the units of symbols


def published_limits(model: Model) -> tuple[str, ...]:
    """Return one sentence for each published condition that applies to a wall and a quantized position.

    Parameters
    ----------
    model
        The compiled model.
    """
    if model.links or not any(peer_type.symbols for peer_type in model.peer_types):
        return ()
    numbers = resolve(model)
    lines = [
        line
        for index, group in enumerate(model.groups)
        for line in _conditions_of_group(model.peer_types[group.peer_type], numbers, index)
    ]
    return tuple(dict.fromkeys(lines))


def _conditions_of_group(peer_type: PeerType, numbers: ResolvedNumbers, index: int) -> Iterator[str]:
    """Yield one sentence for each published condition that applies to the peers of a group."""
    names: dict[str, list[str]] = {symbol: [] for symbol in UNITS}
    for symbol, name in peer_type.symbols:
        names[symbol].append(name)
    single = all(len(names[symbol]) == 1 for symbol in ("K", "T", "D"))
    if not single or len(peer_type.states) != MOVING:
        return
    value_of = dict(zip(peer_type.parameters, numbers.parameters[index][0].tolist(), strict=True))
    value_of |= {name: float(value) for name, value in numbers.timings.items()}
    values = {
        symbol: sum(value_of.get(name, 0.0) for name in parameter_names)
        for symbol, parameter_names in names.items()
    }
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
