"""The states of a peer type that a numerical method integrates, and the function of a step.

Takes: a `PeerType`, a `Method`; for scales, the parameter values.
Gives: `Flow`, `Tolerance`, `flow_of`, `rows_to_move`; `stepped`, methods of a fixed step; `state_scales`,
`integrals`.
Guarantees: states that are coupled to a nonlinear equation are integrated, the others keep their exact
transition, unless the method applies to all states. Complete steps, then one shorter step to the end; the
size of the code is independent of their number. Scales are positive numbers in SI, equal for all peers of a
type.
Does not: apply exact transitions (see `propagate`), or estimate its error (see `accuracy`).

    rk4             k₁ = f(t, x), k₂ = f(t + h/2, x + h k₁/2), k₃ = f(t + h/2, x + h k₂/2),
                    k₄ = f(t + h, x + h k₃);  x(t + h) = x + h (k₁ + 2 k₂ + 2 k₃ + k₄)/6
    semi-implicit   v(t + h) = v + h f_v(t, x, v), then x(t + h) = x + h f_x(v(t + h))

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, table II.1.2; Hairer, Lubich and
Wanner, Geometric Numerical Integration, section I.1.2.)

A state's scale, which multiplies its relative tolerance, is the largest magnitude of the parameter values in
its unit (start values, widths, positions). The scale of a velocity is moreover at least √(2 a L), the speed
reached over the position's scale L at the initial acceleration a, and at least L per second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerType
from apc.compiler.interpolation import jacobian
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import start_values
from apc.simulation.integrate import Integrated
from apc.simulation.propagate import nonlinear_rows
from apc.simulation.settings import EXACT, RK4, WHERE_NEEDED, Method

Floats = NDArray[np.float64]
Rate = Callable[[Any, Any], Any]  # (x, t) -> dx/dt

# The default scale, in SI, of a state without a parameter in its unit: for lengths a millimeter.
UNKNOWN = 1e-3
MOST_UNROLLED = 64  # steps between two events that are unrolled, so that they can be compiled


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The error bound of one CVODES step of a state: relative · |x| + absolute, in the state's unit."""

    state: str
    unit: str
    relative: float
    absolute: float


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """The states of a peer type that a method integrates, and their equations.

    `rows` are their indices in the peer type; `rate` is the function (x, u, p, t) -> dx/dt of these states
    alone; `scale` (rows,) is the magnitude of each in SI.
    """

    method: Method
    rows: tuple[int, ...]
    rate: Any  # casadi.Function
    scale: Floats

    def over(self, duration: Fraction) -> Any:
        """Return the function (x, u, p, t) -> x after `duration` seconds, for the integrated states."""
        if self.method.step is not None:
            move = stepped(self.rate, self.method, duration, integrals(self.rate))
            short = self.rate.is_a("SXFunction") and duration <= MOST_UNROLLED * self.method.step
            return move.expand() if short else move
        assert self.method.tolerance is not None
        return Integrated(self.rate, self.scale, self.method.tolerance, duration)

    def tolerances(self, peer_type: PeerType) -> tuple[Tolerance, ...]:
        """Return the error tolerances of the integrated states; empty for a fixed step."""
        if self.method.tolerance is None:
            return ()
        return tuple(
            Tolerance(state.name, state.unit, self.method.tolerance, self.method.tolerance * float(size))
            for state, size in zip((peer_type.states[row] for row in self.rows), self.scale, strict=True)
        )


def rows_to_move(peer_type: PeerType, method: Method) -> tuple[int, ...]:
    """Return the indices of the states of a peer type that a method integrates numerically."""
    if method.name == EXACT:
        return ()
    return nonlinear_rows(peer_type) if method.name == WHERE_NEEDED else tuple(range(len(peer_type.states)))


def flow_of(peer_type: PeerType, method: Method, rows: Sequence[int], scale: Floats) -> Flow | None:
    """Return the equations of a peer type that a method integrates, None if it integrates no state.

    Parameters
    ----------
    peer_type
        The peer type.
    method
        The method.
    rows
        The indices of the integrated states.
    scale
        The scale of every state of the type (n_x,), in SI.
    """
    if not rows:
        return None
    type_: Any = casadi.SX if peer_type.derivative.is_a("SXFunction") else casadi.MX
    x, u = type_.sym("x", len(rows)), type_.sym("u", len(peer_type.holds))
    p, t = type_.sym("p", len(peer_type.parameters)), type_.sym("t")
    position = {row: i for i, row in enumerate(rows)}
    all_states = casadi.vertcat(
        *(x[position[row]] if row in position else 0 for row in range(len(peer_type.states)))
    )
    speed = casadi.densify(peer_type.derivative(all_states, u, p, t)[list(rows)])
    rate = casadi.Function("rate", [x, u, p, t], [speed])
    return Flow(method, tuple(rows), rate, np.asarray(scale)[list(rows)])


def stepped(function: Any, method: Method, duration: Fraction, pairs: Sequence[tuple[int, int]]) -> Any:
    """Return the function (x, u, p, t) -> x after a duration, by a method of fixed step.

    Parameters
    ----------
    function
        The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
    method
        A method with a step.
    duration
        The duration in seconds.
    pairs
        The states that are integrals of others, from `integrals`; semi-implicit steps use their new rates.
    """
    assert method.step is not None
    complete_steps = int(duration / method.step)  # rounds down
    remainder = duration - complete_steps * method.step
    advance = _rk4 if method.name == RK4 else lambda rate, x, t, h: _semi_implicit(rate, x, t, h, pairs)
    x, u, p = (casadi.MX.sym(name, function.numel_in(i)) for i, name in enumerate(("x", "u", "p")))
    t = casadi.MX.sym("t")
    state, count = x, casadi.MX(0)
    if complete_steps:
        carry = casadi.vertcat(x, u, p, t, 0)
        step = _step(function, advance, float(method.step))
        carry = step.fold(complete_steps)(carry) if complete_steps > 1 else step(carry)
        state, count = carry[: x.numel()], casadi.MX(complete_steps)
    if remainder:
        begin = t + count * float(method.step)
        state = advance(lambda x, t: function(x, u, p, t), state, begin, float(remainder))
    return casadi.Function("move", [x, u, p, t], [state])


def _step(function: Any, advance: Callable[..., Any], h: float) -> Any:
    """Return the function of one complete step over a carry (x, u, p, t, step number), so that it can be
    repeated.
    """
    type_: Any = casadi.SX if function.is_a("SXFunction") else casadi.MX
    sizes = [function.numel_in(i) for i in range(3)]
    carry = type_.sym("carry", sum(sizes) + 2)
    ends = np.cumsum([0, *sizes, 1, 1]).tolist()
    x, u, p, t, number = casadi.vertsplit(carry, ends)
    after = advance(lambda x, t: function(x, u, p, t), x, t + number * h, h)
    return casadi.Function("step", [carry], [casadi.vertcat(after, u, p, t, number + 1)])


def _rk4(rate: Rate, x: Any, t: Any, h: float) -> Any:
    """Return the state after one step h of the classical Runge-Kutta method of order 4."""
    k1 = rate(x, t)
    k2 = rate(x + h / 2 * k1, t + h / 2)
    k3 = rate(x + h / 2 * k2, t + h / 2)
    k4 = rate(x + h * k3, t + h)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _semi_implicit(rate: Rate, x: Any, t: Any, h: float, pairs: Sequence[tuple[int, int]]) -> Any:
    """Return the state after one step h: first the velocities, then the positions with the new velocities."""
    after = x + h * rate(x, t)
    for i, _ in pairs:  # with the new velocities
        after = casadi.vertcat(after[:i], x[i] + h * rate(after, t)[i], after[i + 1 :])
    return after


def integrals(rate: Any) -> tuple[tuple[int, int], ...]:
    """Return pairs (i, j) of states with dx_i/dt = x_j, in an order in which j precedes its own integrals.

    Parameters
    ----------
    rate
        The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
    """
    type_: Any = casadi.SX if rate.is_a("SXFunction") else casadi.MX
    arguments = [type_.sym(f"a{i}", rate.numel_in(i)) for i in range(4)]
    speed = rate(*arguments)
    slopes = casadi.horzcat(*(jacobian(speed, argument) for argument in arguments))
    result: dict[int, int] = {}
    for i in range(speed.numel()):
        columns = slopes[i, :].sparsity().get_triplet()[1]
        if len(columns) == 1 and columns[0] < speed.numel():
            slope = slopes[i, columns[0]]
            if slope.is_constant() and float(slope) == 1:
                result[i] = columns[0]
    ordered: list[tuple[int, int]] = []
    while result:
        ready = [i for i, j in result.items() if j not in result]
        if not ready:  # states that are rates of one another have no order
            break
        ordered += [(i, result.pop(i)) for i in ready]
    return tuple(ordered)


def state_scales(
    model: Model, peer_type: PeerType, subsystem: SubsystemJacobians, vectors: Sequence[Floats]
) -> Floats:
    """Return the scale, the typical magnitude, of every state (n_x,), in SI.

    Parameters
    ----------
    model
        The model.
    peer_type
        One of its peer types.
    subsystem
        Its Jacobians, with its start values.
    vectors
        The parameter vectors (n_p,) of its different peers.
    """
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    units |= {value.name: value.unit for group in model.groups for value in group.values}
    largest: dict[str, float] = {}
    for index, name in enumerate(peer_type.parameters):
        size = max((abs(float(vector[index])) for vector in vectors), default=0.0)
        unit = units.get(name, "1")
        largest[unit] = max(largest.get(unit, 0.0), size)
    scale = np.array([largest.get(state.unit, 0.0) for state in peer_type.states])
    initial_rates = np.zeros(len(scale))
    for vector in vectors:
        x, u, _ = start_values(subsystem, [float(value_of_parameter) for value_of_parameter in vector])
        speed = np.abs(np.asarray(peer_type.derivative(x, u, vector, 0.0), dtype=np.float64).ravel())
        initial_rates = np.maximum(initial_rates, np.nan_to_num(speed, posinf=0.0))
    rates = integrals(peer_type.derivative)
    velocities = {j for _, j in rates}
    scale = np.where((scale == 0) & ~np.isin(np.arange(len(scale)), list(velocities)), UNKNOWN, scale)
    for i, j in reversed(rates):  # from positions to velocities
        scale[i] = scale[i] or UNKNOWN
        scale[j] = max(scale[j], np.sqrt(2 * initial_rates[j] * scale[i]), scale[i])
    return scale
