"""A model with its sensitivity equations: each state, output and packet with its derivatives over parameters.

Takes: a `Model`, its free parameters.
Gives: `with_sensitivities`, `with_values`, `name_of`.
Guarantees: derivatives are exact: CasADi differentiates the equations, a complex step the formulas of
parameters. The sensitivity equations of a linear model are linear, so that its simulation is exact.
Does not: differentiate over times, or differentiate maxima and minima over other peers.

    x' = f(x, u, p)        s' = f_x s + f_u w + f_p q        s = dx/dθ, w = du/dθ, q = dp/dθ

and likewise for ticks, edge functions and packets. The derivative of a mean or sum of received values is the
mean or sum of the received derivatives. An extended vector is the vector, then its derivatives over the first
free parameter, and so on.
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

STEP = 1e-100  # of the complex step, which cancels no digits


def name_of(index: int, name: str) -> str:
    """Return the name of the derivative of a signal or parameter over a free parameter, counted from 1."""
    return f"d{index} {name}" if index else name


def with_values(model: Model, free: Sequence[Range], values: Floats) -> Model:
    """Return a model with values (k,) of its free parameters in SI, and the derivatives at these values."""
    pairs = zip(free, values.tolist(), strict=True)
    return _with_derivatives(
        apply(model, [Override(one.free, Fraction(value)) for one, value in pairs]), free
    )


def with_sensitivities(model: Model, free: Sequence[Range]) -> Model:
    """Return a model with the derivatives of its signals over free parameters, each times its range's width.

    The signal `d1 device.x` is the derivative of `device.x` over the first free parameter.

    Raises
    ------
    ApcError
        E713 a maximum or minimum over other peers.
    """
    orders = range(len(free) + 1)
    channels = {send.link: len(send.channels) for peer_type in model.peer_types for send in peer_type.sends}
    used = {name for peer_type in model.peer_types for name in peer_type.parameters}
    parameters = (
        Parameter(name_of(k, parameter.name), parameter.unit, 0.0)
        for k in orders[1:]
        for parameter in model.parameters
        if parameter.name in used
    )
    extended = replace(
        model,
        peer_types=tuple(_Extension(one, orders, channels).peer_type for one in model.peer_types),
        parameters=(*model.parameters, *parameters),
    )
    return _with_derivatives(extended, free)


def _with_derivatives(model: Model, free: Sequence[Range]) -> Model:
    """Return a model with sensitivities, with the derivatives of its parameters at their present values."""
    return replace(model, groups=tuple(_group_with_derivatives(model, group, free) for group in model.groups))


def _group_with_derivatives(model: Model, group: Group, free: Sequence[Range]) -> Group:
    """Return a group of a model with sensitivities, with the derivatives of its parameters."""
    names, parameters = (
        model.peer_types[group.peer_type].parameters,
        {one.name: one for one in model.parameters},
    )
    count = len(names) // (len(free) + 1)
    values, columns = {one.name: one for one in group.values}, {one.name: one for one in group.columns}
    for k, item in enumerate(free, 1):
        step = {item.free: np.array([value_now(model, item.free) + 1j * STEP])}
        peers = range(group.count if group.columns else 1)
        rows = np.concatenate([free_rows(model, group, peer, step) for peer in peers])[:, :count]
        numbers = np.imag(rows) / STEP * float(item.high - item.low)
        for name, column in zip(names[:count], numbers.T, strict=True):
            values[name_of(k, name)] = replace(parameters[name_of(k, name)], value=float(column[0]))
            if group.columns:
                columns[name_of(k, name)] = PeerColumn(name_of(k, name), column)
    return replace(group, values=tuple(values.values()), columns=tuple(columns.values()))


@dataclass(frozen=True, slots=True)
class _Extension:
    """A peer type to be extended by derivatives; `orders` are 0 for the values, then the free parameters.

    `channels` is the number of channels of each link.
    """

    original: PeerType
    orders: range
    channels: dict[str, int]

    @property
    def peer_type(self) -> PeerType:
        """The peer type with its sensitivity equations."""
        original, outputs = self.original, {one.clock: len(one.outputs) for one in self.original.clocks}
        return replace(
            original,
            states=tuple(
                replace(state, name=name_of(k, state.name), start=name_of(k, state.start))
                for k in self.orders
                for state in original.states
            ),
            holds=tuple(
                replace(
                    hold,
                    name=name_of(k, hold.name),
                    output=hold.output + k * outputs[hold.clock],
                    start=hold.start and name_of(k, hold.start),
                )
                for k in self.orders
                for hold in original.holds
            ),
            parameters=self._all(original.parameters),
            derivative=self._function(original.derivative),
            clocks=tuple(map(self._clock, original.clocks)),
            sends=tuple(
                replace(
                    send,
                    channels=self._all(send.channels),
                    units=send.units * len(self.orders),
                    send=self._function(send.send),
                )
                for send in original.sends
            ),
            limits=tuple(
                replace(limit, name=name_of(k, limit.name), value=self._function(limit.value, k=k))
                for k in self.orders
                for limit in original.limits
                if limit.value is not None
            ),
            ports=None,
            linear=None,
        )

    def _all(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names followed by the names of their derivatives."""
        return tuple(name_of(k, name) for k in self.orders for name in names)

    def _clock(self, clock: ClockPartition) -> ClockPartition:
        """Return a clock partition with derivatives of its outputs, memories and received values."""
        constant = tuple(index for index, one in enumerate(clock.receives) if one.age == "alone")
        return replace(
            clock,
            outputs=self._all(clock.outputs),
            units=clock.units * len(self.orders),
            memories=tuple(row + k * len(clock.outputs) for k in self.orders for row in clock.memories),
            starts=self._all(clock.starts),
            receives=tuple(self._receive(one, k) for k in self.orders for one in clock.receives),
            tick=self._function(clock.tick, constant=constant),
        )

    def _receive(self, receive: Receive, k: int) -> Receive:
        """Return a receive of the values, or of their derivatives over free parameter k."""
        if receive.operator not in ("mean", "sum"):
            message = f"{receive.name}: a fit has no derivative of a maximum or minimum over other peers"
            raise ApcError(Diagnostic("E713", SourceLocation(self.original.name), message))
        channels = self.channels[receive.link]
        return replace(
            receive,
            name=name_of(k, receive.name),
            channel=receive.channel + k * channels,
            edge=None if receive.edge is None else self._function(receive.edge, channels=channels, k=k),
        )

    def _function(
        self,
        function: Any,
        *,
        constant: Sequence[int] = (),
        channels: int | None = None,
        k: int | None = None,
    ) -> Any:
        """Return a function (x, u, …, p, t) of extended arguments, with extended values.

        Parameters
        ----------
        function
            The function.
        constant
            For a tick: the indices of the received values without derivatives.
        channels
            For an edge function: the number of channels, which the age of a packet may follow.
        k
            The order to return alone.
        """
        kind: Any = casadi.SX if function.is_a("SXFunction") else casadi.MX
        *arguments, t = (kind.sym("a", function.numel_in(index)) for index in range(function.n_in()))
        directions = [kind.sym("d", item.numel()) for item in arguments]
        slopes = jacobian(casadi.densify(function(*arguments, t)), casadi.vertcat(*arguments))
        product = casadi.densify(slopes @ casadi.vertcat(*directions))
        derivative = casadi.Function("derivative", [*arguments, t, *directions], [product])
        symbols, blocks = [], []
        for index, item in enumerate(arguments):
            size = channels if channels is not None and index == len(arguments) - 2 else item.numel()
            symbol = kind.sym("a", size * len(self.orders) + item.numel() - size)
            own = [symbol[order * size : (order + 1) * size] for order in self.orders]
            age = symbol[size * len(self.orders) :]
            symbols.append(symbol)
            blocks.append(
                [casadi.vertcat(one, age if order == 0 else 0 * age) for order, one in enumerate(own)]
            )
        for order in self.orders[1:]:
            for row in constant:
                blocks[-2][order][row] = 0
        present, *changes = zip(*blocks, strict=True)
        values = [function(*present, t), *(derivative(*present, t, *change) for change in changes)]
        result = casadi.densify(casadi.vertcat(*values) if k is None else values[k])
        return casadi.Function(
            function.name(), [*symbols, t], [result], function.name_in(), function.name_out()
        )
