"""Integration of nonlinear equations between two events, by CVODES, restarted at nonsmooth points.

Takes: the rate of change of a state, tolerances, a duration. Gives: `Integrated`.
Guarantees: each step's error is below the tolerance; if a guard (of a comparison, a max, an abs) changes sign
between two evaluations, the instant is located to 1e-10 of their distance, and the integration is restarted
there.
Does not: bound the error of many steps (see `accuracy`); a guard that changes sign twice between two
evaluations is left to the step-size control.

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

from apc.linearization.jacobians import guards_of

Floats = NDArray[np.float64]

MOST_EVALUATIONS = 8  # of the guards between two events, at states interpolated by CVODES
HALVINGS = 34  # of the distance of two evaluations: 6e-11 of the distance remains
MOST_CROSSINGS = 4  # located between two events; later ones are left to the step-size control
MOST_STEPS = 20_000  # of CVODES between two evaluations: a motion with more steps chatters


class Integrated(casadi.Callback):
    """The function (x, u, p, t) -> x after a duration, by CVODES, as a CasADi callback.

    CasADi calls it by its address: a reference to it must be kept as long as functions that contain it.
    """

    def __init__(self, function: Any, scale: Floats, tolerance: float, duration: Fraction) -> None:
        """Build the integrators over the duration.

        Parameters
        ----------
        function
            The rate of change (x, u, p, t) -> dx/dt, a CasADi function.
        scale
            The scale of each state (n_x,): the error of a step is below `tolerance` times |x| + scale.
        tolerance
            The error tolerance of a step, relative to |x| + scale.
        duration
            The duration in seconds.
        """
        casadi.Callback.__init__(self)
        self.scale, self.duration = scale, float(duration)
        self.sizes = [function.numel_in(i) for i in range(4)]
        # In y = x/scale and a time s from 0 to 1, from `begin` seconds after t over `length` seconds.
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
        fractions = [k / MOST_EVALUATIONS for k in range(1, MOST_EVALUATIONS + 1)]
        self.once = casadi.integrator("once", "cvodes", problem, 0.0, [1.0], options)
        guards = guards_of(rate, casadi.vertcat(y, begin, t, s)) if type_ is casadi.SX else []
        self.looks: Any = None
        self.signs: Any = None
        if guards:
            conditions = casadi.substitute(casadi.vertcat(*guards), s, 0) >= 0
            self.signs = casadi.Function("signs", [y, fixed], [casadi.densify(conditions)])
            start, constants = casadi.MX.sym("y", self.sizes[0]), casadi.MX.sym("fixed", fixed.numel() - 2)
            first, last = casadi.MX.sym("first"), casadi.MX.sym("last")
            evaluations = casadi.integrator("looks", "cvodes", problem, 0.0, fractions, options)
            ends = evaluations(x0=start, p=casadi.vertcat(constants, first, last - first))["xf"]
            states = casadi.horzcat(start, ends)
            times = first + (last - first) * casadi.DM([0.0, *fractions]).T
            parameters = casadi.vertcat(
                casadi.repmat(constants, 1, MOST_EVALUATIONS + 1),
                times,
                casadi.MX.zeros(1, MOST_EVALUATIONS + 1),
            )
            signs = self.signs.map(MOST_EVALUATIONS + 1)(states, parameters)
            crossed = casadi.norm_inf(casadi.vec(signs[:, 1:] - signs[:, :-1]))
            result = [states[:, -1] * scale, crossed, states, times, signs]
            self.looks = casadi.Function("looks", [start, constants, first, last], result)
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
        """Return x at the end of the duration, with the switching instants located, for CasADi."""
        y, constants, begin = arguments[0] / casadi.DM(self.scale), casadi.vertcat(*arguments[1:]), 0.0
        for _ in range(MOST_CROSSINGS if self.looks is not None else 0):
            end, crossed, *evaluations = self.looks(y, constants, begin, self.duration)
            if not float(crossed):
                return [end]
            states, times, signs = map(np.asarray, evaluations)
            changed = (signs[:, 1:] != signs[:, :-1]).any(axis=0)
            first = int(changed.argmax())
            ends = states[:, [first]], states[:, [first + 1]]
            y, begin = self._first_change(*ends, constants, times[0, first], times[0, first + 1])
        return [self._state_at(y, constants, begin, self.duration)[:, 0] * self.scale]

    def _state_at(self, y: Floats, constants: Floats, begin: float, end: float) -> Floats:
        """Return the scaled state at `end`, in seconds, from the scaled state y at `begin`."""
        parameters = np.vstack([np.asarray(constants), [[begin], [end - begin]]])
        return np.asarray(self.once(x0=y, p=parameters)["xf"])

    def _signs(self, y: Floats, constants: Floats, instant: float) -> Floats:
        """Return the signs of the guards at a scaled state and a time in seconds."""
        return np.asarray(self.signs(y, np.vstack([np.asarray(constants), [[instant], [0.0]]])))

    def _first_change(
        self, low: Floats, high: Floats, constants: Floats, begin: float, end: float
    ) -> tuple[Floats, float]:
        """Return the state just after the first sign change of a guard between two evaluations, and its
        instant.
        """
        first_signs = self._signs(low, constants, begin)
        for _ in range(HALVINGS):
            middle = (begin + end) / 2
            y = self._state_at(low, constants, begin, middle)
            if (self._signs(y, constants, middle) != first_signs).any():
                high, end = y, middle
            else:
                low, begin = y, middle
        return high, end
