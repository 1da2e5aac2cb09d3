"""A model with its sensitivity equations: each state, output and packet with its derivatives over parameters.

Takes: a `Model`, its free parameters.
Gives: `with_sensitivities`, `with_values`, `name_of`.
Guarantees: derivatives are exact: CasADi differentiates the equations, a complex step the formulas of
parameters. The sensitivity equations of a linear model are linear, so that its simulation is exact.
Does not: differentiate over times, or differentiate maxima and minima over other peers.

    x' = f(x, u, p)        s' = f_x s + f_u w + f_p q        s = dx/dθ, w = du/dθ, q = dp/dθ

and likewise for ticks, edge functions and packets. The derivative of a mean or sum of received values is the
mean or sum of the received derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ClockPartition, Group, Model, Parameter, PeerColumn, PeerType, Receive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import Range, value_now
from apc.parameter_values.parameters import free_rows

Floats = NDArray[np.float64]

ZERO = "zero sensitivity"  # a parameter: no name of a topology has a space
STEP = 1e-100  # of the complex step, which cancels no digits
LINEAR = ("mean", "sum")  # reductions over other peers that are linear in the received values


def name_of(index: int, name: str) -> str:
    """Return the name of the derivative of a signal or parameter over a free parameter, counted from 1."""
    return f"d{index} {name}"


def with_values(system: Model, free: Sequence[Range], values: Floats) -> Model:
    """Return a model with values (k,) of its free parameters in SI, and the derivatives at these values."""
    overrides = [
        Override(item.free, Fraction(value)) for item, value in zip(free, values.tolist(), strict=True)
    ]
    return _with_derivatives(apply(system, overrides), free)


def with_sensitivities(system: Model, free: Sequence[Range]) -> Model:
    """Return a model with the derivatives of its signals over free parameters, each times its range's width.

    The signal `d1 device.x` is the derivative of `device.x` over the first free parameter.

    Raises
    ------
    ApcError
        E713 a maximum or minimum over other peers.
    """
    used = [set[int]() for _ in system.peer_types]
    for group in system.groups:
        used[group.peer_type] |= set(np.flatnonzero(_derivatives(system, group, free).any(axis=(0, 1))))
    channels = {send.link: len(send.channels) for peer_type in system.peer_types for send in peer_type.sends}
    peer_types, unit_of = (
        list[PeerType](),
        {parameter.name: parameter.unit for parameter in system.parameters},
    )
    added = {ZERO: "1"}
    for peer_type, rows in zip(system.peer_types, used, strict=True):
        _refuse_extrema(system, peer_type)
        names = tuple(peer_type.parameters[row] for row in sorted(rows))
        peer_types.append(_Extension(peer_type, len(free), names, channels).peer_type)
        added |= {name_of(k, name): unit_of[name] for k in range(1, len(free) + 1) for name in names}
    parameters = (*system.parameters, *(Parameter(name, unit, 0.0) for name, unit in added.items()))
    return _with_derivatives(replace(system, peer_types=tuple(peer_types), parameters=parameters), free)


def _refuse_extrema(system: Model, peer_type: PeerType) -> None:
    """Raise ApcError E713 for a maximum or minimum over other peers."""
    for receive in (receive for clock in peer_type.clocks for receive in clock.receives):
        if receive.operator not in LINEAR:
            message = f"{receive.name}: a fit has no derivative of a maximum or minimum over other peers"
            raise ApcError(
                Diagnostic(
                    "E713",
                    SourceLocation(system.origin.topology),
                    message,
                    advice="use a coupler with a mean or sum over other peers",
                )
            )


def _derivatives(system: Model, group: Group, free: Sequence[Range]) -> Floats:
    """Return the scaled derivatives of a group's parameters (peers, k, n_p), of one peer if all are equal."""
    peers = range(group.count if group.columns else 1)
    result = np.zeros((len(peers), len(free), len(system.peer_types[group.peer_type].parameters)))
    for k, item in enumerate(free):
        value = np.array([value_now(system, item.free) + 1j * STEP])
        for peer in peers:
            (row,) = free_rows(system, group, peer, {item.free: value})
            result[peer, k] = np.imag(row) / STEP * float(item.high - item.low)
    return result


def _with_derivatives(system: Model, free: Sequence[Range]) -> Model:
    """Return a model with sensitivities, with the derivatives of its parameters at their present values."""
    parameters = {parameter.name: parameter for parameter in system.parameters}
    groups = []
    for group in system.groups:
        names, rows = system.peer_types[group.peer_type].parameters, _derivatives(system, group, free)
        position = {name: index for index, name in enumerate(names)}
        of_group = {
            name_of(k + 1, name): rows[:, k, position[name]]
            for k in range(len(free))
            for name in names
            if name_of(k + 1, name) in position
        }
        values = {value.name: value for value in group.values}
        columns = {column.name: column for column in group.columns}
        for name, numbers in of_group.items():
            values[name] = replace(parameters[name], value=float(numbers[0]))
            if len(numbers) > 1:
                columns[name] = PeerColumn(name, numbers)
        groups.append(replace(group, values=tuple(values.values()), columns=tuple(columns.values())))
    return replace(system, groups=tuple(groups))


@dataclass(frozen=True, slots=True)
class _Extension:
    """A peer type to be extended by derivatives over `count` parameters.

    `names` are its parameters that depend on a free parameter; `channels` is the number of channels of each
    link.
    """

    original: PeerType
    count: int
    names: tuple[str, ...]
    channels: dict[str, int]

    @property
    def orders(self) -> range:
        """The numbers of the free parameters."""
        return range(1, self.count + 1)

    @property
    def peer_type(self) -> PeerType:
        """The peer type with its sensitivity equations."""
        original = self.original
        outputs = {clock.clock: len(clock.outputs) for clock in original.clocks}
        return PeerType(
            name=original.name,
            states=(
                *original.states,
                *(
                    replace(state, name=name_of(k, state.name), start=self._start(k, state.start))
                    for k in self.orders
                    for state in original.states
                ),
            ),
            holds=(
                *original.holds,
                *(
                    replace(hold, name=name_of(k, hold.name), output=hold.output + k * outputs[hold.clock])
                    for k in self.orders
                    for hold in original.holds
                ),
            ),
            parameters=(
                *original.parameters,
                *(name_of(k, name) for k in self.orders for name in self.names),
                ZERO,
            ),
            derivative=self._function(original.derivative),
            clocks=tuple(map(self._clock, original.clocks)),
            sends=tuple(
                replace(
                    send,
                    channels=self._all(send.channels),
                    units=send.units * (1 + self.count),
                    send=self._function(send.send),
                )
                for send in original.sends
            ),
            rounded=original.rounded,
            limits=tuple(
                replace(
                    limit, name=name_of(k, limit.name) if k else limit.name, value=self._row(limit.value, k)
                )
                for k in (0, *self.orders)
                for limit in original.limits
                if limit.value is not None
            ),
        )

    def _all(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names followed by the names of their derivatives."""
        return (*names, *(name_of(k, name) for k in self.orders for name in names))

    def _start(self, k: int, start: str) -> str:
        """Return the parameter for the derivative of a start value."""
        return name_of(k, start) if start in self.names else ZERO

    def _clock(self, clock: ClockPartition) -> ClockPartition:
        """Return a clock partition with derivatives of its outputs, memories and received values."""
        n = len(clock.outputs)
        moving = [receive for receive in clock.receives if receive.age != "alone"]
        rows = [clock.receives.index(receive) for receive in moving]
        return replace(
            clock,
            outputs=self._all(clock.outputs),
            units=clock.units * (1 + self.count),
            memories=tuple(row + k * n for k in (0, *self.orders) for row in clock.memories),
            starts=(*clock.starts, *(self._start(k, start) for k in self.orders for start in clock.starts)),
            receives=(
                *(self._receive(receive, 0) for receive in clock.receives),
                *(self._receive(receive, k) for k in self.orders for receive in moving),
            ),
            tick=self._function(clock.tick, received=rows),
        )

    def _receive(self, receive: Receive, k: int) -> Receive:
        """Return a receive of the values (k = 0), or of their derivatives over free parameter k."""
        if receive.edge is None:
            channel = receive.channel + k * self.channels[receive.link]
            return replace(receive, name=name_of(k, receive.name) if k else receive.name, channel=channel)
        edge = self._row(receive.edge, k, self.channels[receive.link])
        return replace(receive, name=name_of(k, receive.name) if k else receive.name, edge=edge)

    def _row(self, function: Any, k: int, channels: int | None = None) -> Any:
        """Return a function of one value (k = 0), or its derivative over free parameter k."""
        extended = self._function(function, channels=channels)
        symbols = _symbols(extended)
        return _like(extended, symbols, extended(*symbols)[k])

    def _function(
        self, function: Any, *, received: Sequence[int] | None = None, channels: int | None = None
    ) -> Any:
        """Return a function (x, u, …, p, t) of extended arguments: its values, then their derivatives.

        Parameters
        ----------
        function
            The function.
        received
            For a tick: the indices of the received values that have derivatives.
        channels
            For an edge function: the number of channels, which the age of a packet may follow.
        """
        *original, t = _symbols(function)
        arguments = [_Argument(item.numel(), tuple(range(item.numel()))) for item in original]
        indices = tuple(self.original.parameters.index(name) for name in self.names)
        arguments[-1] = replace(arguments[-1], moving=indices, unused=1)  # the parameter ZERO
        if received is not None:
            arguments[-2] = replace(arguments[-2], moving=tuple(received))
        if channels is not None:
            last = arguments[-2].size - channels
            arguments[-2] = replace(arguments[-2], moving=tuple(range(channels)), last=last)
        kind = type(t)
        directions = [kind.sym("direction", item.numel()) for item in original]
        slopes = jacobian(casadi.densify(function(*original, t)), casadi.vertcat(*original))
        product = casadi.densify(slopes @ casadi.vertcat(*directions))
        derivative = casadi.Function("derivative", [*original, t, *directions], [product])
        symbols = [kind.sym("extended", item.extended(self.count)) for item in arguments]
        pairs = list(zip(arguments, symbols, strict=True))
        present = [item.present(symbol) for item, symbol in pairs]
        changes = [[item.change(symbol, k) for item, symbol in pairs] for k in self.orders]
        values = [function(*present, t), *(derivative(*present, t, *change) for change in changes)]
        return _like(function, [*symbols, t], casadi.vertcat(*values))


@dataclass(frozen=True, slots=True)
class _Argument:
    """An argument of a function: `size` entries, of which those in `moving` have derivatives.

    Extended, it is its entries, then the derivatives over each free parameter, then its `last` entries and
    `unused` ones.
    """

    size: int
    moving: tuple[int, ...]
    last: int = 0
    unused: int = 0

    def extended(self, count: int) -> int:
        """Return the extended size for a number of free parameters."""
        return self.size + count * len(self.moving) + self.unused

    def present(self, symbol: Any) -> Any:
        """Return the original entries."""
        first = self.size - self.last
        return casadi.vertcat(symbol[:first], symbol[symbol.numel() - self.last :])

    def change(self, symbol: Any, k: int) -> Any:
        """Return the derivatives of the original entries over free parameter k."""
        start = self.size - self.last + (k - 1) * len(self.moving)
        entries = {row: symbol[start + index] for index, row in enumerate(self.moving)}
        zero = type(symbol)(0)
        return casadi.vertcat(*(entries.get(row, zero) for row in range(self.size)), type(symbol)(0, 1))


def _symbols(function: Any) -> list[Any]:
    """Return symbols for a function's arguments: SX, or MX for a function that contains a solver."""
    kind: Any = casadi.SX if function.is_a("SXFunction") else casadi.MX
    return [kind.sym(name, function.numel_in(index)) for index, name in enumerate(function.name_in())]


def _like(original: Any, symbols: Sequence[Any], value: Any) -> Any:
    """Return a function of given symbols and value, with the names of another function."""
    return casadi.Function(
        original.name(), list(symbols), [casadi.densify(value)], original.name_in(), original.name_out()
    )
