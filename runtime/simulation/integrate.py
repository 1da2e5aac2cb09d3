"""What is not linear between two events, by CVODES, restarted where an equation is not smooth.

Takes: the rate of change of a state, tolerances, a duration. Gives: `integrated`.
Guarantees: each step's error is below the tolerance; where something that decides (a comparison, a max, an
abs) has changed sign between two looks, the instant is found to 1e-10 of the distance of the looks, and the
integration ends and begins there.
Does not: bound the error of many steps (see `accuracy`); what changes sign and back between two looks is left
to the control of the step.

CVODES: Hindmarsh et al., SUNDIALS, ACM Trans. Math. Software 31 (2005) 363; backward differences, which stay
stable however stiff a contact is.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.frame.jacobians import guards_of

Floats = NDArray[np.float64]

LOOKS = 8  # at what decides, between two events: CVODES' own interpolation gives the states there
HALVINGS = 34  # of the distance of two looks: 6e-11 of it is left
MOST_CROSSINGS = 4  # between two events that are located; those after are left to the control of the step
MOST_STEPS = 20_000  # of CVODES from look to look: what takes more jumps to and fro without end


def integrated(function: Any, scale: Floats, tolerance: float, duration: Fraction) -> Any:
    """Return (x, u, p, t) -> x after `duration`.

    Parameters
    ----------
    function
        The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
    scale
        How large each state is (n_x,): the error of a step is below `tolerance` times |x| + scale.
    tolerance
        Relative to |x| + scale.
    duration
        In seconds.
    """
    passes = _Passes(function, scale, tolerance, float(duration))
    x, u, p = (casadi.MX.sym(name, function.numel_in(i)) for i, name in enumerate(("x", "u", "p")))
    t = casadi.MX.sym("t")
    after = passes.sweep(MOST_CROSSINGS)(x / passes.scale, casadi.vertcat(u, p, t), 0.0)
    return casadi.Function("move", [x, u, p, t], [after * passes.scale])


class _Passes:
    """Functions of y = x/scale, of `fixed` = (u, p, t) and of seconds since t."""

    def __init__(self, function: Any, scale: Floats, tolerance: float, duration: float) -> None:
        self.function, self.scale, self.duration = function, casadi.DM(scale), duration
        self.sizes = [function.numel_in(i) for i in range(3)]
        self.n, self.fixed = self.sizes[0], self.sizes[1] + self.sizes[2] + 1
        self.tolerance = tolerance
        self.guards = self._guards()
        self.looks = self._integrator("looks", [k / LOOKS for k in range(1, LOOKS + 1)])
        self.once = self._integrator("once", [1.0])

    def _split(self, fixed: Any) -> tuple[Any, Any, Any]:
        n_u, n_p = self.sizes[1:]
        return fixed[:n_u], fixed[n_u : n_u + n_p], fixed[n_u + n_p]

    def _integrator(self, name: str, outputs: Sequence[float]) -> Any:
        """Return CVODES over a time scaled to 1, from `begin` over `length` seconds."""
        type_: Any = casadi.SX if self.function.is_a("SXFunction") else casadi.MX
        y, fixed, s = type_.sym("y", self.n), type_.sym("fixed", self.fixed), type_.sym("s")
        begin, length = type_.sym("begin"), type_.sym("length")
        u, p, t = self._split(fixed)
        rate = self.function(y * self.scale, u, p, t + begin + s * length) / self.scale
        problem = {
            "x": y,
            "p": casadi.vertcat(fixed, begin, length),
            "t": s,
            "ode": casadi.densify(length * rate),
        }
        options = {
            "reltol": self.tolerance,
            "abstol": self.tolerance,
            "max_num_steps": MOST_STEPS,
            "disable_internal_warnings": True,
            "show_eval_warnings": False,
        }
        return casadi.integrator(name, "cvodes", problem, 0.0, list(outputs), options)

    def _guards(self) -> Any:
        """Return what decides, (y, fixed, seconds since t) -> (n,); None if nothing does."""
        if not self.function.is_a("SXFunction"):
            return None
        y, fixed, at = casadi.SX.sym("y", self.n), casadi.SX.sym("fixed", self.fixed), casadi.SX.sym("at")
        u, p, t = self._split(fixed)
        rate = self.function(y * self.scale, u, p, t + at)
        found = guards_of(rate, casadi.vertcat(y, at, t))
        return casadi.Function("guards", [y, fixed, at], [casadi.vertcat(*found)]) if found else None

    def _run(self, integrator: Any, y: Any, fixed: Any, begin: Any, length: Any) -> Any:
        return integrator(x0=y, p=casadi.vertcat(fixed, begin, length))["xf"]

    def sweep(self, crossings: int) -> Any:
        """Return (y, fixed, begin) -> y at the end, locating so many crossings on the way."""
        y, fixed, begin = (casadi.MX.sym(n, size) for n, size in (("y", self.n), ("f", self.fixed), ("b", 1)))
        length = self.duration - begin
        if self.guards is None or not crossings:
            end = self._run(self.once, y, fixed, begin, length)
            return casadi.Function("sweep", [y, fixed, begin], [end])
        every = casadi.horzcat(y, self._run(self.looks, y, fixed, begin, length))
        at = begin + length * casadi.DM(np.linspace(0.0, 1.0, LOOKS + 1)).T
        signs = self.guards.map(LOOKS + 1)(every, casadi.repmat(fixed, 1, LOOKS + 1), at) >= 0
        changed = casadi.sum1(signs[:, 1:] != signs[:, :-1]) > 0  # (1, LOOKS)
        first, none_before = [], casadi.MX(1)
        for k in range(LOOKS):
            first.append(changed[k] * none_before)
            none_before = none_before * (1 - changed[k])
        one = casadi.vertcat(*first)  # 1 where the first change is
        branches = casadi.Function.if_else("crossed", self._located(crossings), self._smooth())
        ends = (every[:, :LOOKS] @ one, every[:, 1:] @ one, at[:LOOKS] @ one, at[1:] @ one)
        end = branches(1 - none_before, *ends, every[:, -1], fixed)
        return casadi.Function("sweep", [y, fixed, begin], [end])

    def _arguments(self) -> list[Any]:
        sizes = {"y_low": self.n, "y_high": self.n, "low": 1, "high": 1, "end": self.n, "fixed": self.fixed}
        return [casadi.MX.sym(name, size) for name, size in sizes.items()]

    def _smooth(self) -> Any:
        arguments = self._arguments()
        return casadi.Function("smooth", arguments, [arguments[4]])

    def _located(self, crossings: int) -> Any:
        """Return what halves the time of a change until it is known, and goes on from there."""
        arguments = self._arguments()
        y_low, y_high, low, high, _, fixed = arguments
        found = self._halving().fold(HALVINGS)(casadi.vertcat(y_low, y_high, low, high, fixed))
        rest = self.sweep(crossings - 1)
        end = rest(found[self.n : 2 * self.n], fixed, found[2 * self.n + 1])
        return casadi.Function("located", arguments, [end])

    def _halving(self) -> Any:
        n = self.n
        carry = casadi.MX.sym("carry", 2 * n + 2 + self.fixed)
        y_low, y_high, low, high, fixed = casadi.vertsplit(
            carry, [0, n, 2 * n, 2 * n + 1, 2 * n + 2, carry.numel()]
        )
        middle = (low + high) / 2
        y_middle = self._run(self.once, y_low, fixed, low, middle - low)
        before, after = self.guards(y_low, fixed, low) >= 0, self.guards(y_middle, fixed, middle) >= 0
        changed = casadi.sum1(before != after) > 0
        result = casadi.vertcat(
            casadi.if_else(changed, y_low, y_middle),
            casadi.if_else(changed, y_middle, y_high),
            casadi.if_else(changed, low, middle),
            casadi.if_else(changed, middle, high),
            fixed,
        )
        return casadi.Function("halving", [carry], [result])
