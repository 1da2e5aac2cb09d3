"""A published condition in the plane of two parameters: the parameter of each symbol, and the curve.

Takes: a `Model` and texts such as
`colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period`.
Gives: `Overlay`, `parse_overlay`, `symbol_values`, `overlay_points`.
Guarantees: the user states the parameter of each symbol, with matching units; parameters that depend on an
axis by an expression vary with it.
Does not: find a boundary that a line of the plane crosses twice; draw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Group, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.haptics.wall_conditions import (
    CONDITIONS,
    MEANINGS,
    UNITS,
    PublishedCondition,
)
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, Range, find, unit_of, value_now

Floats = NDArray[np.float64]

_LOCATION = SourceLocation("overlay")
_FORM = "colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period"

# Grid lines along each axis at which the boundary is evaluated: enough points for a smooth curve.
LINES = 65


@dataclass(frozen=True, slots=True)
class Overlay:
    """A published condition, and a parameter or SI number for each of its symbols, in their order."""

    condition: PublishedCondition
    roles: tuple[ParameterRef | float, ...]

    @property
    def label(self) -> str:
        """The text of a legend: authors and formula."""
        return f"{self.condition.title}: {self.condition.formula}"


def parse_overlay(model: Model, text: str) -> Overlay:
    """Return the overlay of a text `CONDITION:SYMBOL=PARAMETER,SYMBOL=QUANTITY,…` with every symbol.

    Raises
    ------
    ApcError
        E886 another form of text, an unknown condition or symbol, a symbol missing or given twice; E622 an
        unknown parameter; E204 a unit that does not match.
    """
    name, colon, roles_text = (part.strip() for part in text.partition(":"))
    if not colon or not roles_text:
        raise ApcError(Diagnostic("E886", _LOCATION, "overlay", "CONDITION:SYMBOL=NAME,…", text[:80], _FORM))
    condition = CONDITIONS.get(name)
    if condition is None:
        message = f"{name[:80]} is not a known condition ({', '.join(CONDITIONS)})"
        raise ApcError(Diagnostic("E886", _LOCATION, message, fix=nearest(name, CONDITIONS) or _FORM))
    result: dict[str, ParameterRef | float] = {}
    for part in roles_text.split(","):
        symbol, equals, player = (piece.strip() for piece in part.partition("="))
        if not (equals and symbol and player):
            raise ApcError(Diagnostic("E886", _LOCATION, "symbol", "SYMBOL=NAME", part[:80], _FORM))
        if symbol not in condition.symbols:
            message = f"{condition.formula} has no {symbol[:80]}; it has {', '.join(condition.symbols)}"
            raise ApcError(Diagnostic("E886", _LOCATION, message, fix=nearest(symbol, condition.symbols)))
        if symbol in result:
            raise ApcError(Diagnostic("E886", _LOCATION, f"{symbol} is given twice"))
        result[symbol] = _role(model, symbol, player)
    missing = [symbol for symbol in condition.symbols if symbol not in result]
    if missing:
        requested = ", ".join(f"{symbol}, the {MEANINGS[symbol]}" for symbol in missing)
        message = f"{condition.formula} requires {requested}"
        advice = f"append ,{missing[0]}=NAME with a parameter or a quantity in {UNITS[missing[0]]}"
        raise ApcError(Diagnostic("E886", _LOCATION, message, advice=advice))
    return Overlay(condition, tuple(result[symbol] for symbol in condition.symbols))


def _role(model: Model, symbol: str, player: str) -> ParameterRef | float:
    """Return the value or parameter of a symbol; a quantity begins with a digit, sign or point."""
    from apc.compiler.language.units import parse_unit, quantity

    if player[0] in "+-.0123456789":
        return float(quantity(player, _LOCATION, subject=symbol, unit=UNITS[symbol]).value)
    parameter_ref = find(model, player, _LOCATION)
    name, unit = parameter_ref.name, unit_of(model, parameter_ref.name)
    if parse_unit(unit, _LOCATION).dimension != parse_unit(UNITS[symbol], _LOCATION).dimension:
        message = f"{symbol}, the {MEANINGS[symbol]}"
        raise ApcError(Diagnostic("E204", _LOCATION, message, UNITS[symbol], f"{name} in {unit}"))
    if parameter_ref.group is None:
        groups = [group for group in model.groups if name in _local_names(group)]
        if groups:
            message = f"{name} differs between peers, but {symbol} is a single number"
            raise ApcError(Diagnostic("E886", _LOCATION, message, fix=f"{symbol}={groups[0].name}.{name}"))
    return parameter_ref


def _local_names(group: Group) -> set[str]:
    """Return the names of the parameters with separate values in a group."""
    return {value.name for value in group.values} | {column.name for column in group.columns}


def symbol_values(model: Model, overlay: Overlay) -> tuple[float, ...]:
    """Return the present value of each symbol in SI, in the order of the condition's symbols."""
    return tuple(role if isinstance(role, float) else value_now(model, role) for role in overlay.roles)


def overlay_points(model: Model, overlay: Overlay, x: Range, y: Range) -> Floats:
    """Return the boundary of an overlay's condition in the plane of two parameters, as one polyline.

    Parameters
    ----------
    model
        The model; its values hold for other parameters, except those that depend on an axis.
    overlay
        The condition and the parameters of its symbols.
    x, y
        The parameters of the plane.

    Returns
    -------
    Floats
        Points (n, 2) in SI, from end to end of the curve; (0, 2) if the condition holds everywhere or
        nowhere in the window.

    Raises
    ------
    ApcError
        E624 or E625 an invalid value at an end of an axis.

    Notes
    -----
    The margin of each condition is monotone along each axis. A grid line crosses the boundary at most once,
    and the boundary is monotone: the crossings of the grid lines of both directions, sorted by x, are on it
    in order.
    """
    from scipy.optimize import brentq

    def margin(at_x: float, at_y: float) -> float:
        """Return the margin of the condition at a point of the plane."""
        overrides = [Override(x.free, Fraction(at_x)), Override(y.free, Fraction(at_y))]
        return float(overlay.condition.margin(*symbol_values(apply(model, overrides), overlay)))

    def crossings(margin_along: Callable[[float], float], low: float, high: float) -> list[float]:
        """Return the crossing of a grid line with the boundary: one value, or an empty list."""
        first, last = margin_along(low), margin_along(high)
        if first == 0 or last == 0:
            return [low if first == 0 else high]
        if (first > 0) == (last > 0):
            return []
        return [float(brentq(margin_along, low, high, xtol=abs(high - low) * 1e-15, rtol=1e-14))]

    ends_x, ends_y = ((float(interval.low), float(interval.high)) for interval in (x, y))
    x_lines, y_lines = (np.linspace(*ends, LINES).tolist() for ends in (ends_x, ends_y))
    rows = [
        (crossing, line) for line in y_lines for crossing in crossings(partial(margin, at_y=line), *ends_x)
    ]
    columns = [(line, crossing) for line in x_lines for crossing in crossings(partial(margin, line), *ends_y)]
    points = sorted({*rows, *columns})
    falling = bool(points) and points[-1][1] < points[0][1]
    points.sort(key=lambda point: (point[0], -point[1] if falling else point[1]))
    return np.array(points, np.float64).reshape(-1, 2)
