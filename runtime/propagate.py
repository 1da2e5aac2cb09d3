"""What a site's continuous states do from event to event: the exact transition of a linear partition.

Takes: a `Kind` and parameter vectors. Gives: `Rates`, `rates`, `Transitions`, `transitions`.
Guarantees: no step size; every entry of a transition is right to the last digit but one.
Does not: integrate a nonlinear partition: it is refused by name (whoever integrates it takes its place in
`program`, where an interval is passed); or know what changes with time alone (see `forcing`).

    dx/dt = A x + B u + g(t)        x(t + T) = E x(t) + F u + c,  u held
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
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.discretize import discretize
from apc.runtime.exact import evaluate_exact

Floats = NDArray[np.float64]
Pattern = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """The continuous equations of a kind, linear in x and u.

    `matrices(p)` is [A B g] (n_x, n_x + n_u + 1), column-major, with the part of g that does not change;
    `timed` says that g changes with time: then g is zero there, and `rate(p, t)` gives it. `e`, `f` and `g`
    are where E, F and c can differ from zero, whatever the numbers.
    """

    kind: Kind
    matrices: Any  # casadi.Function
    rate: Any  # casadi.Function
    timed: bool
    e: Pattern  # (n_x, n_x)
    f: Pattern  # (n_x, n_u)
    g: Pattern  # (n_x,)


@dataclass(frozen=True, slots=True, eq=False)
class Transitions:
    """[E F c] (n_x, n_x + n_u + 1) of one site for every duration, and A (n_x, n_x), exact."""

    matrices: tuple[Floats, ...]
    a: NDArray[Any]


def rates(kind: Kind) -> Rates:
    """Take the continuous equations of a kind apart.

    Raises
    ------
    ApcError
        E870 they are not linear.
    """
    type_: Any = casadi.SX if kind.derivative.is_a("SXFunction") else casadi.MX
    x, u = type_.sym("x", len(kind.states)), type_.sym("u", len(kind.holds))
    p, t = type_.sym("p", len(kind.parameters)), type_.sym("t")
    moving = casadi.vertcat(x, u)
    speed = kind.derivative(x, u, p, t)
    slopes = casadi.jacobian(speed, moving)
    if slopes.nnz() and casadi.depends_on(slopes, casadi.vertcat(moving, t)):
        raise _nonlinear(kind, slopes, moving, p, t)
    still = casadi.densify(kind.derivative(type_.zeros(*x.shape), type_.zeros(*u.shape), p, t))
    timed = bool(still.numel() and casadi.depends_on(still, t))
    constant = type_.zeros(*still.shape) if timed else still
    structure = _structure(slopes)
    n_x = len(kind.states)
    reach = _closure(structure[:, :n_x])
    pushed = np.ones(n_x, dtype=bool) if type_ is casadi.MX else _structure(casadi.sparsify(still))[:, 0]
    flat = casadi.vec(casadi.horzcat(casadi.densify(slopes), constant))
    return Rates(
        kind=kind,
        matrices=casadi.Function("matrices", [p], [flat]),
        rate=casadi.Function("rate", [p, t], [still]),
        timed=timed,
        e=reach,
        f=(reach.astype(int) @ structure[:, n_x:].astype(int)) > 0,
        g=(reach.astype(int) @ pushed.astype(int)) > 0,
    )


def transitions(rates_of: Rates, parameters: Floats, durations: Sequence[Fraction]) -> Transitions:
    """Return what a site does in every duration.

    Parameters
    ----------
    rates_of
        The kind's equations.
    parameters
        The site's vector (n_p,).
    durations
        In seconds.

    Raises
    ------
    ApcError
        E806 something grows beyond the range of floats within a duration.
    """
    kind = rates_of.kind
    n_x, n_u = len(kind.states), len(kind.holds)
    if rates_of.matrices.is_a("SXFunction"):
        exact = evaluate_exact(rates_of.matrices, [[Fraction(float(one)) for one in parameters]])[0]
    else:
        exact = [Fraction(float(one)) for one in np.asarray(rates_of.matrices(parameters)).ravel()]
    whole = np.array(exact, dtype=object).reshape((n_x, n_x + n_u + 1), order="F")
    steps = discretize(whole[:, :n_x], whole[:, n_x:], durations)
    return Transitions(tuple(step.matrix for step in steps), whole[:, :n_x])


def _structure(block: Any) -> Pattern:
    """Return the structural nonzeros of a CasADi matrix as truth values."""
    pattern = np.zeros((block.size1(), block.size2()), dtype=bool)
    rows, columns = block.sparsity().get_triplet()
    pattern[rows, columns] = True
    return pattern


def _closure(a: Pattern) -> Pattern:
    """Return where exp(A T) can differ from zero: what reaches what, however indirectly."""
    reach = a | np.eye(len(a), dtype=bool)
    for _ in range(max(len(a) - 1, 0).bit_length()):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def _nonlinear(kind: Kind, slopes: Any, moving: Any, p: Any, t: Any) -> ApcError:
    """Return the mistake that names the states and the parts whose equations are not linear."""
    varies = casadi.vertcat(moving, t)
    rows = [row for row in range(slopes.size1()) if casadi.depends_on(slopes[row, :], varies)]
    involved = []
    for row in rows:
        reads = casadi.which_depends(slopes[row, :].T, p, 1, False) if p.numel() else ()
        parts = {name.rpartition(".")[0] for name, read in zip(kind.parameters, reads, strict=True) if read}
        involved.append(parts - {""})
    shared = set.intersection(*involved) or set.union(*involved)
    through = f" through {' and '.join(sorted(shared))}" if shared else ""
    names = ", ".join(kind.states[row].name for row in rows)
    what = (
        f"the motion of {names} is not linear between the ticks{through}: only what is linear "
        "there can be simulated exactly"
    )
    return ApcError(
        Mistake("E870", Place(kind.name), what, hint="a part that computes its force at ticks of a clock")
    )
