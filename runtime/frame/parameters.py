"""The numbers of a compiled system, and changing them without compiling again.

Takes: a `CompiledSystem` and overrides such as `contact.stiffness=800 N/m`.
Gives: `Override`, `parse_override`, `find`, `unit_of`, `apply`; `Numbers`, `resolve`; `Free`, `free_rows`.
Guarantees: what depends on a changed parameter by an expression changes with it, in exact rationals; bounds
are kept; the rest keeps the very numbers it was compiled with. What depends on a parameter that differs from
peer to peer is worked out peer by peer, in floats, in a time that grows with the number of peers.
Does not: change what was compiled as structure (which parts there are, how many peers).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, CompiledSystem, Group, Parameter, Timing
from apc.compiler.errors import ApcError, Mistake, Mistakes, Place, nearest
from apc.compiler.words import with_unit

# The sections of a topology, which a name may start with.
SECTIONS = ("clocks", "couplers", "hands", "links", "masses", "parameters")

_PLACE = Place("override")

Floats = NDArray[np.float64]

# The language's operators and functions of a parameter, over the values of all peers at once.
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": np.true_divide,
    "^": lambda base, exponent: _power(base, exponent),
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_EXTREMES: dict[str, Callable[[Any, Any], Any]] = {"max": np.maximum, "min": np.minimum}
_FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    # Of a complex step, the imaginary part is a derivative and follows the real part.
    "abs": lambda value: np.where(np.real(value) < 0, -value, value),
    "sign": lambda value: np.sign(np.real(value)),
    "floor": lambda value: np.floor(np.real(value)),
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
}


def _power(base: Any, exponent: Any) -> Any:
    """Return base^exponent; of a complex step, with the derivative as imaginary part."""
    value = np.float_power(np.real(base), np.real(exponent))
    if not (np.iscomplexobj(base) or np.iscomplexobj(exponent)):
        return value
    b, e = np.real(base), np.real(exponent)
    slope = e * np.float_power(b, e - 1) * np.imag(base)
    growing = np.imag(exponent)
    if np.any(growing):
        slope = slope + value * np.log(b) * growing
    return value + 1j * slope


@dataclass(frozen=True, slots=True)
class Free:
    """A parameter or timing whose value is left open: of one group, or of all (`group` None)."""

    name: str
    group: str | None = None

    @property
    def label(self) -> str:
        """The name as a person writes it, its group before it."""
        return self.name if self.group is None else f"{self.group}.{self.name}"


@dataclass(frozen=True, slots=True)
class Override:
    """A new SI value for a parameter or timing: of one group, or of all (`group` None)."""

    name: str
    group: str | None
    value: Fraction


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """Everything a compiled system needs to become matrices.

    `parameters` holds one matrix (k, n_p) a group: its peers' different rows, in the order in which they come
    first, columns in the order of its kind's parameters; `rows` (count,) says which of them each peer has.
    `timings` are seconds by name.
    """

    parameters: tuple[Floats, ...]
    rows: tuple[NDArray[np.int64], ...]
    timings: Mapping[str, Fraction]


def parse_override(system: CompiledSystem, text: str, place: Place = _PLACE) -> Override:
    """Read `NAME=QUANTITY`; the name may start with a group, or with the section it stands in.

    Raises
    ------
    ApcError
        E621 not of that form, E622 no such parameter, E623 the number of peers is not a parameter to set;
        and those of `units.quantity`: the unit has to fit.
    """
    # Imported here: reading a unit brings in pint, which an analysis without overrides never needs.
    from apc.compiler.units import quantity

    name, equals, value = text.partition("=")
    name, value = name.strip(), value.strip()
    if not (equals and name and value):
        form = "contact.stiffness=800 N/m"
        raise ApcError(Mistake("E621", place, "an override", "NAME=VALUE", text[:80], form))
    known, group = find(system, name, place)
    unit = unit_of(system, known)
    found = quantity(
        value, place.shifted(len(text) - len(value)) if place.line else place, what=name, unit=unit
    )
    return Override(known, group, found.value)


def find(system: CompiledSystem, name: str, place: Place = _PLACE) -> tuple[str, str | None]:
    """Return the parameter or timing a person's name means, and the group it names, if any.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers.
    """
    known = {parameter.name for parameter in system.parameters} | {timing.name for timing in system.timings}
    groups = {group.name for group in system.groups}
    first, _, rest = name.partition(".")
    if first in SECTIONS and name not in known:
        name = rest
    first, _, rest = name.partition(".")
    group = None
    if name not in known and first in groups and rest in {parameter.name for parameter in system.parameters}:
        name, group = rest, first
    if name == PEERS:
        raise ApcError(
            Mistake("E623", place, "peers is the number of peers: change a count and compile again")
        )
    if name not in known:
        near = nearest(name, sorted(known - {PEERS}))
        raise ApcError(Mistake("E622", place, f"{name[:80]} is no parameter of {system.name}", hint=near))
    return name, group


def apply(system: CompiledSystem, overrides: Sequence[Override]) -> CompiledSystem:
    """Return the system with new values; a parameter set loses its expression, what depends on it follows.

    Raises
    ------
    ApcError
        E624 a value beyond the parameter's bounds, E625 a time that can't be.
    """
    if not overrides:
        return system
    everywhere = {one.name: one.value for one in overrides if one.group is None}
    parameters = {parameter.name: parameter for parameter in system.parameters}
    timings = {timing.name: timing for timing in system.timings}
    common = _Scope(parameters, timings, everywhere)
    groups = []
    for group in system.groups:
        own = {one.name: one.value for one in overrides if one.group == group.name}
        # Set for everybody means for this group as well: its own old value goes.
        values = {value.name: value for value in group.values if value.name not in everywhere}
        values |= {name: parameters[name] for name in own if name not in values}
        scope = _Scope({**parameters, **values}, timings, {**everywhere, **own})
        # What a group leaves to everybody is its own as soon as it depends on a value of its own.
        values |= {
            name: parameter
            for name, parameter in parameters.items()
            if name not in values and own and scope.parameter(name) != common.parameter(name)
        }
        groups.append(
            replace(
                group,
                values=tuple(scope.parameter(name) for name in values),
                # One value for the group, or for everybody, is one for each of its peers.
                columns=tuple(
                    column for column in group.columns if column.name not in everywhere.keys() | own.keys()
                ),
            )
        )
    changed = replace(
        system,
        parameters=tuple(common.parameter(name) for name in parameters),
        timings=tuple(common.timing(name) for name in timings),
        groups=tuple(groups),
    )
    _check(changed)
    return changed


def resolve(system: CompiledSystem, overrides: Sequence[Override] = ()) -> Numbers:
    """Return the numbers of a system, after the overrides.

    Raises
    ------
    ApcError
        As `apply`.
    """
    system = apply(system, overrides)
    found = [_different_rows(system, group) for group in system.groups]
    return Numbers(
        parameters=tuple(parameters for parameters, _ in found),
        rows=tuple(rows for _, rows in found),
        timings={timing.name: timing.value for timing in system.timings},
    )


def _different_rows(system: CompiledSystem, group: Group) -> tuple[Floats, NDArray[np.int64]]:
    """Return a group's different parameter rows (k, n_p) and which of them each peer has (count,)."""
    names = system.kinds[group.kind].parameters
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    common = np.array([[holder[name].value for name in names]], dtype=np.float64).reshape(1, -1)
    columns = _Columns(system, group, holder)
    varying = {place: column for place, name in enumerate(names) if (column := columns.of(name)) is not None}
    if not varying:
        # A view of one zero: a million equal peers take no memory.
        return common, np.broadcast_to(np.int64(0), (group.count,))
    table = np.stack(list(varying.values()), axis=1) + 0.0  # −0 and 0 are one number
    known: dict[bytes, int] = {}
    rows = np.array([known.setdefault(row.tobytes(), len(known)) for row in table], dtype=np.int64)
    first = np.zeros(len(known), dtype=np.int64)
    first[rows[::-1]] = np.arange(len(rows))[::-1]
    parameters = np.repeat(common, len(known), axis=0)
    parameters[:, list(varying)] = table[first]
    return parameters, rows


class _Columns:
    """The parameters of one group that differ from peer to peer, given or by an expression."""

    def __init__(self, system: CompiledSystem, group: Group, holder: Mapping[str, Parameter]) -> None:
        self._group = group.name
        self._holder = holder
        self._timings = {timing.name: float(timing.value) for timing in system.timings}
        self._given = bool(group.columns)
        self._found: dict[str, Floats | None] = {column.name: column.values for column in group.columns}

    def of(self, name: str) -> Floats | None:
        """Return a parameter's values (count,), or None when all peers share one."""
        if name not in self._found:
            expression = self._holder[name].expression if name in self._holder else None
            self._found[name] = self._evaluated(name, expression) if expression and self._given else None
        return self._found[name]

    def _evaluated(self, name: str, text: str) -> Floats | None:
        from apc.compiler.expression import names
        from apc.compiler.grammar import parse_expression

        tree = parse_expression(text, Place(name, 1, 1, text))
        if all(self.of(".".join(node.parts)) is None for node in names(tree)):
            return None
        with np.errstate(all="ignore"):
            values = np.asarray(_evaluate_rows(tree, self._look_up), dtype=np.float64)
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            peer = f"{self._group}[{int(wrong[0]) + 1}]"
            raise ApcError(Mistake("E331", _PLACE, f"{name} = {text[:80]} has no finite value for {peer}"))
        return values

    def _look_up(self, parts: tuple[str, ...]) -> Any:
        name = ".".join(parts)
        column = self.of(name)
        if column is not None:
            return column
        return self._holder[name].value if name in self._holder else self._timings[name]


def parameter_of(system: CompiledSystem, free: Free) -> Parameter:
    """Return a free parameter as its group has it, or everybody."""
    for group in system.groups:
        for parameter in group.values:
            if group.name == free.group and parameter.name == free.name:
                return parameter
    return next(parameter for parameter in system.parameters if parameter.name == free.name)


def free_rows(
    system: CompiledSystem, group: Group, peer: int, values: Mapping[Free, NDArray[Any]]
) -> NDArray[Any]:
    """Return a peer's parameter vector for many values of some parameters, what depends on them included.

    Parameters
    ----------
    system
        The compiled scene.
    group, peer
        The peer: its group, and its number in it, from 0.
    values
        Values (k,) of each free parameter, as `apply` would set them; complex ones are complex steps, whose
        imaginary part comes out as the derivative.

    Returns
    -------
    The vectors (k, n_p), or (1, n_p) when none of the values reaches this peer.
    """
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    columns = _Columns(system, group, holder)
    given = {column.name for column in group.columns}
    known: dict[str, Any] = {free.name: value for free, value in values.items() if free.group is None}
    known |= {free.name: value for free, value in values.items() if free.group == group.name}
    timings = {timing.name: float(timing.value) for timing in system.timings}

    def value_of(name: str) -> Any:
        if name not in known:
            known[name] = evaluated(name)
        return known[name]

    def evaluated(name: str) -> Any:
        parameter = holder.get(name)
        if parameter is None:
            return timings[name]
        if parameter.expression and name not in given:
            from apc.compiler.expression import names
            from apc.compiler.grammar import parse_expression

            tree = parse_expression(parameter.expression, Place(name, 1, 1, parameter.expression))
            reached = [value_of(".".join(node.parts)) for node in names(tree)]
            if any(np.ndim(one) for one in reached):
                with np.errstate(all="ignore"):
                    return _evaluate_rows(tree, lambda parts: value_of(".".join(parts)))
        column = columns.of(name)
        return parameter.value if column is None else float(column[peer])

    listed = [value_of(name) for name in system.kinds[group.kind].parameters]
    count = max((len(one) for one in listed if np.ndim(one)), default=1)
    dtype = np.result_type(np.float64, *(one.dtype for one in listed if np.ndim(one)))
    rows = np.empty((count, len(listed)), dtype=dtype)
    for place, one in enumerate(listed):
        rows[:, place] = one
    return rows


def _evaluate_rows(expr: Any, lookup: Callable[[tuple[str, ...]], Any]) -> Any:
    """Return an expression's value for all peers at once, in floats (or truth values)."""
    from apc.compiler.expression import Binary, Call, Compare, Conditional, Logic, Name, Negate, Not, Number

    def value(node: Any) -> Any:
        match node:
            case Number():
                return float(node.value)
            case Name():
                return lookup(node.parts)
            case Negate():
                return -value(node.operand)
            case Binary() | Compare():
                return _OPERATORS[node.operator](value(node.left), value(node.right))
            case Logic():
                join = np.logical_and if node.operator == "and" else np.logical_or
                return join(value(node.left), value(node.right))
            case Not():
                return np.logical_not(value(node.operand))
            case Conditional():
                return np.where(value(node.condition), value(node.then), value(node.otherwise))
            case Call():
                arguments = [value(argument) for argument in node.arguments]
                if node.function in _EXTREMES:
                    return functools.reduce(_EXTREMES[node.function], arguments)
                return _FUNCTIONS[node.function](*arguments)
        raise AssertionError(f"no such expression: {node!r}")

    return value(expr)


class _Scope:
    """Parameters and timings as one group sees them, with the overrides that reach it."""

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        timings: Mapping[str, Timing],
        overridden: Mapping[str, Fraction],
    ) -> None:
        self._parameters = parameters
        self._timings = timings
        self._overridden = overridden
        self._changed: dict[str, Fraction | None] = {}
        self._open: set[str] = set()

    def parameter(self, name: str) -> Parameter:
        """Return a parameter with its value in this scope."""
        parameter = self._parameters[name]
        value = self._new(name, parameter.expression)
        if value is None:
            return parameter
        kept = None if name in self._overridden else parameter.expression
        return replace(parameter, value=float(value), expression=kept)

    def timing(self, name: str) -> Timing:
        """Return a timing with its value in this scope."""
        timing = self._timings[name]
        value = self._new(name, timing.expression)
        if value is None:
            return timing
        kept = None if name in self._overridden else timing.expression
        return replace(timing, value=value, expression=kept)

    def _new(self, name: str, expression: str | None) -> Fraction | None:
        """Return the changed value, or None when no override reaches it."""
        if name in self._overridden:
            return self._overridden[name]
        if expression is None:
            return None
        if name not in self._changed:
            assert name not in self._open, f"{name} depends on itself"
            self._open.add(name)
            self._changed[name] = self._evaluate(name, expression)
            self._open.discard(name)
        return self._changed[name]

    def _evaluate(self, name: str, text: str) -> Fraction | None:
        """Evaluate an expression if an override reaches one of its names."""
        from apc.compiler.evaluation import evaluate
        from apc.compiler.expression import names
        from apc.compiler.grammar import parse_expression

        place = Place(name, 1, 1, text)
        tree = parse_expression(text, place)
        reached = [self._expression_value(".".join(node.parts)) for node in names(tree)]
        if all(value is None for value in reached):
            return None
        return Fraction(evaluate(tree, self._look_up, place))

    def _expression_value(self, name: str) -> Fraction | None:
        holder: Parameter | Timing | None = self._parameters.get(name) or self._timings.get(name)
        return self._new(name, holder.expression) if holder else None

    def _look_up(self, parts: tuple[str, ...]) -> Fraction:
        name = ".".join(parts)
        changed = self._expression_value(name)
        if changed is not None:
            return changed
        if name in self._timings:
            return self._timings[name].value
        # The shortest decimal of the float is what stood in the text, mostly: 0.008 is 1/125 again.
        return Fraction(repr(float(self._parameters[name].value)))


def unit_of(system: CompiledSystem, name: str) -> str:
    """Return the unit a parameter or timing wants."""
    for parameter in system.parameters:
        if parameter.name == name:
            return parameter.unit
    return "s"


def _check(system: CompiledSystem) -> None:
    """Raise the mistakes of every value that is out of its bounds."""
    mistakes = Mistakes()
    for parameter in system.parameters:
        _check_bounds(parameter, parameter.name, mistakes)
    for group in system.groups:
        for parameter in group.values:
            _check_bounds(parameter, f"{group.name}.{parameter.name}", mistakes)
        _check_columns(system, group, mistakes)
    periods = {clock.period for clock in system.clocks}
    for timing in system.timings:
        if timing.name in periods and timing.value <= 0:
            mistakes.add(
                "E625", _PLACE, timing.name, expected="a time above 0 s", got=f"{float(timing.value)} s"
            )
        elif timing.value < 0:
            mistakes.add(
                "E625", _PLACE, timing.name, expected="a time of 0 s or more", got=f"{float(timing.value)} s"
            )
    seconds = {timing.name: timing.value for timing in system.timings}
    for clock in system.clocks:
        if not seconds[clock.phase] < seconds[clock.period] and seconds[clock.period] > 0:
            got = f"{float(seconds[clock.phase])} s"
            mistakes.add("E625", _PLACE, clock.phase, expected="less than the clock's period", got=got)
    mistakes.raise_if_any()


def _check_bounds(parameter: Parameter, name: str, mistakes: Mistakes) -> None:
    """Record a value below the minimum or above the maximum."""
    low, high, value = parameter.minimum, parameter.maximum, parameter.value

    def told(number: float) -> str:
        return with_unit(f"{number:g}", parameter.unit)

    def out(expected: str, number: float) -> None:
        mistakes.add("E624", _PLACE, name, expected=f"{expected} {told(number)}", got=told(value))

    if low is not None and parameter.open_minimum and value <= low:
        out("more than", low)
    elif low is not None and value < low:
        out("at least", low)
    if high is not None and value > high:
        out("at most", high)


def _check_columns(system: CompiledSystem, group: Group, mistakes: Mistakes) -> None:
    """Record the first peer's value that is out of its bounds, of each parameter that differs."""
    holder = {parameter.name: parameter for parameter in (*system.parameters, *group.values)}
    columns = _Columns(system, group, holder)
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
            _check_bounds(replace(parameter, value=value), f"{peer}.{name}", mistakes)
