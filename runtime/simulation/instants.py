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

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.exact import ROWS, evaluate_exact

Floats = NDArray[np.float64]

# Instants of one walk: the arrays it holds then stay in the cache of a processor.
MOST = 8192


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
                evaluate_exact(function, [listed, [flat[some]]], number=np.float64, rules=ROWS)[0]
            ):
                values[row, some] = found
    return values.reshape(len(values), *instants.shape)
