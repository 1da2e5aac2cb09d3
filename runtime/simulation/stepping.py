"""Methods of a fixed step: what a state goes through between two events, as one compiled function.

Takes: the rate of change of a state, a method, a duration. Gives: `stepped`.
Guarantees: whole steps, then one shorter one to the end; as many steps as there are cost no more code.
Does not: know how large its error is (see `accuracy`), or where an equation is not smooth.

    rk4             k₁ = f(t, x), k₂ = f(t + h/2, x + h k₁/2), k₃ = f(t + h/2, x + h k₂/2),
                    k₄ = f(t + h, x + h k₃);  x(t + h) = x + h (k₁ + 2 k₂ + 2 k₃ + k₄)/6
    semi-implicit   v(t + h) = v + h f_v(t, x, v), then x(t + h) = x + h f_x(v(t + h))

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, table II.1.2; Hairer, Lubich and
Wanner, Geometric Numerical Integration, section I.1.2.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.simulation.methods import RK4, Method

Rate = Callable[[Any, Any], Any]  # (x, t) -> dx/dt


def stepped(function: Any, method: Method, duration: Fraction, integrals: Sequence[tuple[int, int]]) -> Any:
    """Return (x, u, p, t) -> x after `duration`.

    Parameters
    ----------
    function
        The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
    method
        One with a step.
    duration
        In seconds.
    integrals
        Which states are integrals of which, as of `scales.integrals`: of these the new value is used.
    """
    assert method.step is not None
    whole = int(duration / method.step)  # rounds down
    rest = duration - whole * method.step
    advance = _rk4 if method.name == RK4 else lambda rate, x, t, h: _semi_implicit(rate, x, t, h, integrals)
    x, u, p = (casadi.MX.sym(name, function.numel_in(i)) for i, name in enumerate(("x", "u", "p")))
    t = casadi.MX.sym("t")
    now, count = x, casadi.MX(0)
    if whole:
        carry = casadi.vertcat(x, u, p, t, 0)
        step = _step(function, advance, float(method.step))
        carry = step.fold(whole)(carry) if whole > 1 else step(carry)
        now, count = carry[: x.numel()], casadi.MX(whole)
    if rest:
        begin = t + count * float(method.step)
        now = advance(lambda x, t: function(x, u, p, t), now, begin, float(rest))
    return casadi.Function("move", [x, u, p, t], [now])


def _step(function: Any, advance: Callable[..., Any], h: float) -> Any:
    """Return one whole step; what stays the same travels with what changes, so that steps can be repeated."""
    type_: Any = casadi.SX if function.is_a("SXFunction") else casadi.MX
    sizes = [function.numel_in(i) for i in range(3)]
    carry = type_.sym("carry", sum(sizes) + 2)
    ends = np.cumsum([0, *sizes, 1, 1]).tolist()
    x, u, p, t, number = casadi.vertsplit(carry, ends)
    after = advance(lambda x, t: function(x, u, p, t), x, t + number * h, h)
    return casadi.Function("step", [carry], [casadi.vertcat(after, u, p, t, number + 1)])


def _rk4(rate: Rate, x: Any, t: Any, h: float) -> Any:
    k1 = rate(x, t)
    k2 = rate(x + h / 2 * k1, t + h / 2)
    k3 = rate(x + h / 2 * k2, t + h / 2)
    k4 = rate(x + h * k3, t + h)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _semi_implicit(rate: Rate, x: Any, t: Any, h: float, integrals: Sequence[tuple[int, int]]) -> Any:
    after = x + h * rate(x, t)
    for i, _ in integrals:  # of new values from here on
        after = casadi.vertcat(after[:i], x[i] + h * rate(after, t)[i], after[i + 1 :])
    return after
