"""Where an equation is not smooth: what changes sign there.

Takes: CasADi expressions. Gives: `guards_of`.
Guarantees: every comparison, max, min, abs, sign, floor and ceil that hangs on what moves is
found, each once.
Does not: find when (see `forcing`, `integrate`).
"""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np

_BINARY = (casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE, casadi.OP_FMIN, casadi.OP_FMAX)
_UNARY = (casadi.OP_FABS, casadi.OP_SIGN)
_STEPS = (casadi.OP_FLOOR, casadi.OP_CEIL)


def guards_of(expression: Any, moving: Any) -> list[Any]:
    """Return what changes sign where an expression is not smooth.

    Parameters
    ----------
    expression
        A column, `casadi.SX`.
    moving
        The symbols that change; what hangs on none of them is left out.
    """
    found, seen = [], set()
    work = [expression[i] for i in range(expression.numel())]
    while work:
        node = work.pop()
        if node.element_hash() in seen:
            continue
        seen.add(node.element_hash())
        parts = [node.dep(i) for i in range(node.n_dep())]
        work += parts
        if any(node.is_op(code) for code in _BINARY):
            found.append(parts[0] - parts[1])
        elif any(node.is_op(code) for code in _UNARY):
            found.append(parts[0])
        elif any(node.is_op(code) for code in _STEPS):
            # Changes sign at each whole number, and again half-way, where nothing is split in vain.
            found.append(casadi.sin(np.pi * parts[0]))
    return [one for one in found if casadi.depends_on(one, moving)]
