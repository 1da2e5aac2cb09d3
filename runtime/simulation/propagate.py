"""The motion of a subsystem's continuous states between events: exact transitions of linear partitions.

Takes: a `PeerType` and parameter vectors.
Gives: `Rates`, `rates`, `transition_rows`, `perturbed`; `exact_rates`; `nonlinear_rows`.
Guarantees: no step size; every entry of a transition is right to the last digit but one.
Does not: integrate what is not linear (see `flow`), or know what changes with time alone (see `forcing`).

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

from apc.compiler.compiled import PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.interpolation import jacobian
from apc.frame.discretize import discretize
from apc.frame.exact_arithmetic import evaluate_exact
from apc.frame.interval_arithmetic import value_of
from apc.frame.jacobians import guards_of, structural_pattern
from apc.frame.parameters import exact_numbers

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Pattern = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """The continuous equations of a peer type, linear in x and u.

    `matrices(p)` is [A B g] (n_x, n_x + n_u + 1), column-major, with the constant part of g. `timed` is
    whether g is time-varying: then g is zero there and given by `rate(p, t)`. `pattern` is the sparsity
    pattern of a transition [E F c] for all parameter values. States integrated by another method have no
    entries.
    """

    peer_type: PeerType
    matrices: Any  # casadi.Function
    rate: Any  # casadi.Function
    timed: bool
    pattern: Pattern  # (n_x, n_x + n_u + 1)

    @property
    def forced(self) -> Integers:
        """The states that g can move."""
        return np.flatnonzero(self.pattern[:, -1])


def nonlinear_rows(peer_type: PeerType) -> tuple[int, ...]:
    """Return the states whose equations are not linear, and all that equations tie to them."""
    moving, _, t, speed = _symbols(peer_type)
    curved = _curved(speed, moving, t)
    if not curved:
        return ()
    tied = structural_pattern(peer_type.derivative.jac_sparsity(0, 0))
    together = _closure(tied | tied.T)
    return tuple(np.flatnonzero(together[:, curved].any(axis=1)).tolist())


def rates(peer_type: PeerType, moved: Sequence[int] = ()) -> Rates:
    """Extract the linear continuous equations of a peer type.

    Parameters
    ----------
    peer_type
        The peer type.
    moved
        States integrated by another method, with all states coupled to them.

    Raises
    ------
    ApcError
        E870 the others' equations are not linear.
    """
    moving, p, t, speed = _symbols(peer_type)
    n_x, type_ = len(peer_type.states), type(moving)
    local: Pattern = ~np.isin(np.arange(n_x), list(moved))
    curved = [row for row in _curved(speed, moving, t) if local[row]]
    if curved:
        raise _nonlinear(peer_type, curved, speed, moving, p)
    dm = casadi.sparsify(casadi.diag(casadi.DM(local.astype(float))))
    slopes = dm @ jacobian(speed, moving)
    still = dm @ peer_type.derivative(type_.zeros(n_x), type_.zeros(len(peer_type.holds)), p, t)
    if type_ is casadi.MX:  # the same wherever they are taken, but a loop's solution is of somewhere
        at = casadi.Function("slopes", [moving, p, t], [slopes])
        slopes = at(type_.zeros(moving.numel()), p, 0)
    timed = bool(still.numel() and casadi.depends_on(still, t))
    constant = type_.zeros(n_x, 1) if timed else casadi.densify(still)
    structure = structural_pattern(slopes)
    pushed: Pattern = np.ones(n_x, dtype=bool)
    if type_ is casadi.SX:
        pushed = structural_pattern(casadi.sparsify(still))[:, 0]
    flat = casadi.vec(casadi.horzcat(casadi.densify(slopes), constant))
    if type_ is casadi.MX:  # which includes the symbols of the other rows, even if unused
        flat = casadi.substitute([flat], [moving, t], [type_.zeros(*moving.shape), type_(0)])[0]
    reach = _closure(structure[:, :n_x])
    inputs = np.hstack([structure[:, n_x:], pushed[:, None]])
    return Rates(
        peer_type=peer_type,
        matrices=casadi.Function("matrices", [p], [flat]),
        rate=casadi.Function("rate", [p, t], [casadi.densify(still)]),
        timed=timed,
        pattern=np.hstack([reach, (reach.astype(int) @ inputs.astype(int)) > 0]) & local[:, None],
    )


def perturbed(exact: Sequence[Floats], seed: int) -> tuple[Floats, ...]:
    """Return the same transitions with every number off by one rounding, up or down by chance.

    Parameters
    ----------
    exact
        The transitions.
    seed
        Of the chance.
    """
    chance = np.random.default_rng(seed)
    directions = (np.where(chance.random(matrix.shape) < 0.5, -np.inf, np.inf) for matrix in exact)
    return tuple(
        np.where(matrix == 0, 0.0, np.nextafter(matrix, towards))
        for matrix, towards in zip(exact, directions, strict=True)
    )


def exact_rates(rates_of: Rates, parameters: Floats) -> NDArray[Any]:
    """Return [A B g] (n_x, n_x + n_u + 1) of a subsystem, exact."""
    peer_type = rates_of.peer_type
    n_x, n_u = len(peer_type.states), len(peer_type.holds)
    if rates_of.matrices.is_a("SXFunction"):
        exact = evaluate_exact(
            rates_of.matrices, [exact_numbers(peer_type, np.asarray(parameters, dtype=np.float64))]
        )[0]
    else:
        exact = [Fraction(float(values)) for values in np.asarray(rates_of.matrices(parameters)).ravel()]
    return np.array(exact, dtype=object).reshape((n_x, n_x + n_u + 1), order="F")


def transition_rows(rates_of: Rates, vectors: Floats, durations: Sequence[Fraction]) -> tuple[Floats, ...]:
    """Return the transitions [E F c] of subsystems, (subsystems, n_x, n_x + n_u + 1) for every duration.

    Subsystems that differ in nothing the continuous equations read share a transition: each takes half a
    millisecond.

    Parameters
    ----------
    rates_of
        The peer type's equations.
    vectors
        The subsystems' parameters (subsystems, n_p).
    durations
        In seconds.

    Raises
    ------
    ApcError
        E806 something grows beyond the range of floats within a duration.
    """
    n_x, width = rates_of.pattern.shape
    flat = np.asarray(rates_of.matrices.map(len(vectors))(vectors.T), np.float64).T
    at_least_single_column = np.hstack([flat, np.zeros((len(flat), 1))])
    _, first, which = np.unique(at_least_single_column, axis=0, return_index=True, return_inverse=True)
    result = [np.empty((len(first), n_x, width)) for _ in durations]
    for index, row in enumerate(first.tolist()):
        whole = exact_rates(rates_of, vectors[row])
        for matrix, step in zip(result, discretize(whole[:, :n_x], whole[:, n_x:], durations), strict=True):
            matrix[index] = value_of(step)
    return tuple(matrix[which.reshape(-1)] for matrix in result)


def _symbols(peer_type: PeerType) -> tuple[Any, Any, Any, Any]:
    """Return (x, u), p and t as symbols, and the rates of change."""
    type_: Any = casadi.SX if peer_type.derivative.is_a("SXFunction") else casadi.MX
    n_x, n_u = len(peer_type.states), len(peer_type.holds)
    moving, p, t = type_.sym("moving", n_x + n_u), type_.sym("p", len(peer_type.parameters)), type_.sym("t")
    x, u = casadi.vertsplit(moving, [0, n_x, n_x + n_u])
    return moving, p, t, peer_type.derivative(x, u, p, t)


def _curved(speed: Any, moving: Any, t: Any) -> list[int]:
    """Return the rates that are not linear in the states: their slopes change, or they jump."""
    slopes = jacobian(speed, moving)
    varies = casadi.vertcat(moving, t)
    return [
        row
        for row in range(speed.numel())
        if (slopes[row, :].nnz() and casadi.depends_on(slopes[row, :], varies))
        or (isinstance(speed, casadi.SX) and guards_of(speed[row], moving))
    ]


def _closure(a: Pattern) -> Pattern:
    """Return the sparsity pattern of exp(A T): the transitive closure of that of A."""
    reach = a | np.eye(len(a), dtype=bool)
    for _ in range(max(len(a) - 1, 0).bit_length()):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def _nonlinear(peer_type: PeerType, rows: Sequence[int], speed: Any, moving: Any, p: Any) -> ApcError:
    """Return the mistake that names the states and the parts whose equations are not linear."""
    involved = []
    for row in rows:
        guards = guards_of(speed[row], moving) if isinstance(speed, casadi.SX) else []
        bends = casadi.jacobian(casadi.jacobian(speed[row], moving).T, moving)
        varies = casadi.vertcat(casadi.vec(bends), *guards)
        reads = casadi.which_depends(varies, p, 1, False) if p.numel() else ()
        parts = {
            name.rpartition(".")[0] for name, read in zip(peer_type.parameters, reads, strict=True) if read
        }
        involved.append(parts - {""})
    shared = set.intersection(*involved) or set.union(*involved)
    # The moving variable is already named; its force belongs to another part, if any.
    shared = shared - {state.name.rpartition(".")[0] for state in peer_type.states} or shared
    through = f" through {' and '.join(sorted(shared))}" if shared else ""
    names = ", ".join(peer_type.states[row].name for row in rows)
    message = (
        f"the motion of {names} is not linear between the ticks{through}: only what is linear "
        "there can be simulated exactly"
    )
    hint = "no --method (what is linear stays exact), or a part that computes its force at ticks of a clock"
    return ApcError(Diagnostic("E870", SourceLocation(peer_type.name), message, hint=hint))
