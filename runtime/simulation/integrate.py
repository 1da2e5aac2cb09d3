"""Integration of nonlinear equations between two events, by CVODES, restarted at nonsmooth points.

Takes: the rate of change of a state, tolerances, a duration. Gives: `Integrated`.
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

MOST_EVALUATIONS = 8  # at what decides, between two events: CVODES' own interpolation gives the states there
HALVINGS = 34  # of the distance of two looks: 6e-11 of it is left
MOST_CROSSINGS = 4  # between two events that are located; those after are left to the control of the step
MOST_STEPS = 20_000  # of CVODES from look to look: what takes more jumps to and fro without end


class Integrated(casadi.Callback):
    """The function (x, u, p, t) -> x after some time, by CVODES.

    CasADi calls it by its address: whoever uses a function made of it keeps it, too.
    """

    def __init__(self, function: Any, scale: Floats, tolerance: float, duration: Fraction) -> None:
        """Build the integrators.

        Parameters
        ----------
        function
            The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
        scale
            The scale of each state (n_x,): the error of a step is below `tolerance` times |x| + scale.
        tolerance
            Relative to |x| + scale.
        duration
            In seconds.
        """
        casadi.Callback.__init__(self)
        self.scale, self.duration = scale, float(duration)
        self.sizes = [function.numel_in(i) for i in range(4)]
        # In y = x/scale and a time s scaled to 1, from `begin` seconds after t over `length` seconds.
        type_: Any = casadi.SX if function.is_a("SXFunction") else casadi.MX
        y, u, p, t = (type_.sym(name, size) for name, size in zip("yupt", self.sizes, strict=True))
        begin, length, s = type_.sym("begin"), type_.sym("length"), type_.sym("s")
        rate = function(y * scale, u, p, t + begin + s * length) / scale
        fixed = casadi.vertcat(u, p, t, begin, length)
        problem = {"x": y, "p": fixed, "t": s, "ode": casadi.densify(length * rate)}
        options = {
            "reltol": tolerance,
            "abstol": tolerance,
            "max_num_steps": MOST_STEPS,
            "disable_internal_warnings": True,
            "show_eval_warnings": False,
        }
        looks = [k / MOST_EVALUATIONS for k in range(1, MOST_EVALUATIONS + 1)]
        self.once = casadi.integrator("once", "cvodes", problem, 0.0, [1.0], options)
        guards = guards_of(rate, casadi.vertcat(y, begin, t, s)) if type_ is casadi.SX else []
        self.looks: Any = None
        self.signs: Any = None
        if guards:
            decides = casadi.substitute(casadi.vertcat(*guards), s, 0) >= 0
            self.signs = casadi.Function("signs", [y, fixed], [casadi.densify(decides)])
            start, held = casadi.MX.sym("y", self.sizes[0]), casadi.MX.sym("fixed", fixed.numel() - 2)
            first, last = casadi.MX.sym("first"), casadi.MX.sym("last")
            evaluations = casadi.integrator("looks", "cvodes", problem, 0.0, looks, options)
            ends = evaluations(x0=start, p=casadi.vertcat(held, first, last - first))["xf"]
            every = casadi.horzcat(start, ends)
            at = first + (last - first) * casadi.DM([0.0, *looks]).T
            indices = casadi.vertcat(
                casadi.repmat(held, 1, MOST_EVALUATIONS + 1), at, casadi.MX.zeros(1, MOST_EVALUATIONS + 1)
            )
            signs = self.signs.map(MOST_EVALUATIONS + 1)(every, indices)
            crossed = casadi.norm_inf(casadi.vec(signs[:, 1:] - signs[:, :-1]))
            result = [every[:, -1] * scale, crossed, every, at, signs]
            self.looks = casadi.Function("looks", [start, held, first, last], result)
        self.construct("move", {})

    def get_n_in(self) -> int:
        """Return the number of arguments, for CasADi."""
        return 4

    def get_n_out(self) -> int:
        """Return the number of results, for CasADi."""
        return 1

    def get_sparsity_in(self, index: int) -> Any:
        """Return an argument's shape, for CasADi."""
        return casadi.Sparsity.dense(self.sizes[index], 1)

    def get_sparsity_out(self, _: int) -> Any:
        """Return the result's shape, for CasADi."""
        return casadi.Sparsity.dense(self.sizes[0], 1)

    def eval(self, arguments: Sequence[Any]) -> list[Any]:
        """Return x at the end, with location of the switching events, for CasADi."""
        y, held, begin = arguments[0] / casadi.DM(self.scale), casadi.vertcat(*arguments[1:]), 0.0
        for _ in range(MOST_CROSSINGS if self.looks is not None else 0):
            end, crossed, *evaluations = self.looks(y, held, begin, self.duration)
            if not float(crossed):
                return [end]
            every, at, signs = map(np.asarray, evaluations)
            changed = (signs[:, 1:] != signs[:, :-1]).any(axis=0)
            first = int(changed.argmax())
            ends = every[:, [first]], every[:, [first + 1]]
            y, begin = self._located(*ends, held, at[0, first], at[0, first + 1])
        return [self._moved(y, held, begin, self.duration)[:, 0] * self.scale]

    def _moved(self, y: Floats, held: Floats, begin: float, end: float) -> Floats:
        fixed = np.vstack([np.asarray(held), [[begin], [end - begin]]])
        return np.asarray(self.once(x0=y, p=fixed)["xf"])

    def _signs(self, y: Floats, held: Floats, at: float) -> Floats:
        return np.asarray(self.signs(y, np.vstack([np.asarray(held), [[at], [0.0]]])))

    def _located(
        self, low: Floats, high: Floats, held: Floats, begin: float, end: float
    ) -> tuple[Floats, float]:
        """Return the state just after the first change between two looks, and when that is."""
        before = self._signs(low, held, begin)
        for _ in range(HALVINGS):
            middle = (begin + end) / 2
            y = self._moved(low, held, begin, middle)
            if (self._signs(y, held, middle) != before).any():
                high, end = y, middle
            else:
                low, begin = y, middle
        return high, end
