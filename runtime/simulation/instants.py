"""A function of time at many instants at once.

Takes: a CasADi function (p, t) of a column, a parameter vector, instants.
Gives: `at_instants`.
Guarantees: the values are CasADi's, to the rounding of an elementary function.
Does not: choose the instants (see `forcing`).

An expression is walked once, each operation over all instants in one call of NumPy; what does not hang on
time is computed once. CasADi's own map takes longer to build than to evaluate, and copies the parameters to
each instant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.frame.exact import evaluate_exact

Floats = NDArray[np.float64]

# Instants of one walk: the arrays it holds then stay in the cache of a processor.
MOST = 8192

# Where Python's operators won't do for arrays. A condition is 0 or 1, as in CasADi.
_RULES: dict[int, Callable[..., Any]] = {
    casadi.OP_CONST: np.float64,  # NaN too: what comes of it is no number, and is told as such
    casadi.OP_SIGN: np.sign,
    casadi.OP_NOT: lambda a: 1.0 * (a == 0),
    casadi.OP_FLOOR: np.floor,
    casadi.OP_CEIL: np.ceil,
    casadi.OP_FMIN: np.fmin,
    casadi.OP_FMAX: np.fmax,
    casadi.OP_LT: lambda a, b: 1.0 * (a < b),
    casadi.OP_LE: lambda a, b: 1.0 * (a <= b),
    casadi.OP_EQ: lambda a, b: 1.0 * (a == b),
    casadi.OP_NE: lambda a, b: 1.0 * (a != b),
    casadi.OP_AND: lambda a, b: 1.0 * np.logical_and(a, b),
    casadi.OP_OR: lambda a, b: 1.0 * np.logical_or(a, b),
    casadi.OP_IF_ELSE_ZERO: lambda a, b: np.where(a, b, 0.0),
    casadi.OP_POW: np.float_power,
    casadi.OP_CONSTPOW: np.float_power,
    casadi.OP_SQRT: np.sqrt,
    casadi.OP_EXP: np.exp,
    casadi.OP_LOG: np.log,
    casadi.OP_SIN: np.sin,
    casadi.OP_COS: np.cos,
    casadi.OP_TAN: np.tan,
    casadi.OP_TANH: np.tanh,
}


def at_instants(function: Any, parameters: Floats, instants: Floats) -> Floats:
    """Return a function's column at all instants (rows, *shape of the instants).

    Parameters
    ----------
    function
        A `casadi.Function` of (p, t), its only output a dense column.
    parameters
        p (n_p,).
    instants
        In seconds, of any shape.
    """
    flat = instants.reshape(-1)
    values = np.empty((function.numel_out(0), flat.size))
    if not function.is_a("SXFunction"):  # the solution of a nonlinear loop, which only CasADi knows
        if flat.size:
            many = function.map(flat.size)(parameters, flat.reshape(1, -1))
            values[:] = np.asarray(many).reshape(values.shape)
        return values.reshape(len(values), *instants.shape)
    listed = list(parameters)
    with np.errstate(all="ignore"):
        for start in range(0, flat.size, MOST):
            some = slice(start, start + MOST)
            for row, found in enumerate(
                evaluate_exact(function, [listed, [flat[some]]], number=np.float64, rules=_RULES)[0]
            ):
                values[row, some] = found
    return values.reshape(len(values), *instants.shape)
