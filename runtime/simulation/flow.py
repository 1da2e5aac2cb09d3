"""The continuous states of a kind that are moved by a numerical method, and the function that moves them.

Takes: a `Kind`, a `Method`, the scales of its states. Gives: `Flow`, `Tolerance`, `flow_of`.
Guarantees: only the states that no chain of equations ties to what is not linear keep their exact transition,
unless the method is for all.
Does not: move anything by exact transitions (see `propagate`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Kind
from apc.simulation.integrate import integrated
from apc.simulation.methods import EXACT, WHERE_NEEDED, Method
from apc.simulation.propagate import nonlinear_rows
from apc.simulation.scales import integrals
from apc.simulation.stepping import stepped

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tolerance:
    """What CVODES keeps the error of a step of a state below: relative · |x| + absolute, in its unit."""

    state: str
    unit: str
    relative: float
    absolute: float


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """States moved by `method`: `rows` of the kind's; `rate` (x, u, p, t) -> dx/dt is of these states alone.

    `scale` (rows,) is how large each is, in SI.
    """

    method: Method
    rows: tuple[int, ...]
    rate: Any  # casadi.Function
    scale: Floats

    def over(self, duration: Fraction) -> Any:
        """Return the function (x, u, p, t) -> x after `duration` seconds, of these states."""
        if self.method.step is not None:
            return stepped(self.rate, self.method, duration, integrals(self.rate))
        assert self.method.tolerance is not None
        return integrated(self.rate, self.scale, self.method.tolerance, duration)

    def tolerances(self, kind: Kind) -> tuple[Tolerance, ...]:
        """Return the tolerances of its states, none if the step is fixed."""
        if self.method.tolerance is None:
            return ()
        return tuple(
            Tolerance(state.name, state.unit, self.method.tolerance, self.method.tolerance * float(size))
            for state, size in zip((kind.states[row] for row in self.rows), self.scale, strict=True)
        )


def rows_to_move(kind: Kind, method: Method) -> tuple[int, ...]:
    """Return the states of a kind that a method moves itself."""
    if method.name == EXACT:
        return ()
    return nonlinear_rows(kind) if method.name == WHERE_NEEDED else tuple(range(len(kind.states)))


def flow_of(kind: Kind, method: Method, rows: Sequence[int], scale: Floats) -> Flow | None:
    """Return what a method moves of a kind, None if that is nothing.

    Parameters
    ----------
    kind
        The kind.
    method
        The method.
    rows
        The states it moves.
    scale
        How large every state of the kind is (n_x,), in SI.
    """
    if not rows:
        return None
    type_: Any = casadi.SX if kind.derivative.is_a("SXFunction") else casadi.MX
    x, u = type_.sym("x", len(rows)), type_.sym("u", len(kind.holds))
    p, t = type_.sym("p", len(kind.parameters)), type_.sym("t")
    place = {row: i for i, row in enumerate(rows)}
    whole = casadi.vertcat(*(x[place[row]] if row in place else 0 for row in range(len(kind.states))))
    speed = casadi.densify(kind.derivative(whole, u, p, t)[list(rows)])
    rate = casadi.Function("rate", [x, u, p, t], [speed])
    return Flow(method, tuple(rows), rate, np.asarray(scale)[list(rows)])
