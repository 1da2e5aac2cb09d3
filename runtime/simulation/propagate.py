"""The motion of a subsystem's continuous states between events: exact transitions of linear partitions.

Takes: a `PeerType` and parameter vectors.
Gives: `Rates`, `rates`, `transition_rows`, `perturbed`; `exact_rates`; `nonlinear_rows`.
Guarantees: no step size; every entry of a transition is right to the last digit but one.
Does not: integrate nonlinear equations (see `flow`), or time-varying forces (see `forcing`).

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
from apc.lifting.discretize import discretize
from apc.lifting.interval_arithmetic import value_of
from apc.linearization.jacobians import guards_of, structural_pattern
from apc.parameter_values.exact_arithmetic import evaluate_exact
from apc.parameter_values.parameters import rationals

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Pattern = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """The linear continuous equations of a peer type, dx/dt = A x + B u + g(t).

    `matrices(p)` is [A B g] (n_x, n_x + n_u + 1), column-major, with the constant part of g. `timed` states
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
        """The indices of the states on which g can have an effect."""
        return np.flatnonzero(self.pattern[:, -1])


def nonlinear_rows(peer_type: PeerType) -> tuple[int, ...]:
    """Return the indices of the states with nonlinear equations, and of all states coupled to them."""
    variables, _, t, derivative = _symbols(peer_type)
    nonlinear = _nonlinear_states(derivative, variables, t)
    if not nonlinear:
        return ()
    coupling = structural_pattern(peer_type.derivative.jac_sparsity(0, 0))
    coupled = _closure(coupling | coupling.T)
    return tuple(np.flatnonzero(coupled[:, nonlinear].any(axis=1)).tolist())


def rates(peer_type: PeerType, moved: Sequence[int] = ()) -> Rates:
    """Return the linear continuous equations of a peer type.

    Parameters
    ----------
    peer_type
        The peer type.
    moved
        Indices of the states integrated by another method.

    Raises
    ------
    ApcError
        E870 a nonlinear equation of another state.
    """
    variables, p, t, derivative = _symbols(peer_type)
    n_x, type_ = len(peer_type.states), type(variables)
    own: Pattern = ~np.isin(np.arange(n_x), list(moved))
    nonlinear = [row for row in _nonlinear_states(derivative, variables, t) if own[row]]
    if nonlinear:
        raise _nonlinear_error(peer_type, nonlinear, derivative, variables, p)
    selection = casadi.sparsify(casadi.diag(casadi.DM(own.astype(float))))
    slopes = selection @ jacobian(derivative, variables)
    offset = selection @ peer_type.derivative(type_.zeros(n_x), type_.zeros(len(peer_type.holds)), p, t)
    if type_ is casadi.MX:  # constant slopes, but a loop's solution must be evaluated at some point
        slopes_at = casadi.Function("slopes", [variables, p, t], [slopes])
        slopes = slopes_at(type_.zeros(variables.numel()), p, 0)
    timed = bool(offset.numel() and casadi.depends_on(offset, t))
    constant = type_.zeros(n_x, 1) if timed else casadi.densify(offset)
    structure = structural_pattern(slopes)
    forced_rows: Pattern = np.ones(n_x, dtype=bool)
    if type_ is casadi.SX:
        forced_rows = structural_pattern(casadi.sparsify(offset))[:, 0]
    entries = casadi.vec(casadi.horzcat(casadi.densify(slopes), constant))
    if type_ is casadi.MX:  # which includes the symbols of the other rows, even if unused
        entries = casadi.substitute([entries], [variables, t], [type_.zeros(*variables.shape), type_(0)])[0]
    reach = _closure(structure[:, :n_x])
    inputs = np.hstack([structure[:, n_x:], forced_rows[:, None]])
    return Rates(
        peer_type=peer_type,
        matrices=casadi.Function("matrices", [p], [entries]),
        rate=casadi.Function("rate", [p, t], [casadi.densify(offset)]),
        timed=timed,
        pattern=np.hstack([reach, (reach.astype(int) @ inputs.astype(int)) > 0]) & own[:, None],
    )


def perturbed(transitions: Sequence[Floats], seed: int) -> tuple[Floats, ...]:
    """Return transitions with every coefficient changed by one rounding, up or down at random.

    Parameters
    ----------
    transitions
        The exact transitions.
    seed
        The seed of the random directions.
    """
    generator = np.random.default_rng(seed)
    directions = (np.where(generator.random(matrix.shape) < 0.5, -np.inf, np.inf) for matrix in transitions)
    return tuple(
        np.where(matrix == 0, 0.0, np.nextafter(matrix, direction))
        for matrix, direction in zip(transitions, directions, strict=True)
    )


def exact_rates(rates_of: Rates, parameters: Floats) -> NDArray[Any]:
    """Return [A B g] (n_x, n_x + n_u + 1) of a subsystem, as exact rationals."""
    peer_type = rates_of.peer_type
    n_x, n_u = len(peer_type.states), len(peer_type.holds)
    if rates_of.matrices.is_a("SXFunction"):
        exact = evaluate_exact(rates_of.matrices, [rationals(np.asarray(parameters, dtype=np.float64))])[0]
    else:
        exact = [Fraction(float(values)) for values in np.asarray(rates_of.matrices(parameters)).ravel()]
    return np.array(exact, dtype=object).reshape((n_x, n_x + n_u + 1), order="F")


def transition_rows(rates_of: Rates, vectors: Floats, durations: Sequence[Fraction]) -> tuple[Floats, ...]:
    """Return the transitions [E F c] of subsystems, (subsystems, n_x, n_x + n_u + 1) for every duration.

    Subsystems with equal continuous equations share a transition: each takes half a millisecond to compute.

    Parameters
    ----------
    rates_of
        The peer type's equations.
    vectors
        The subsystems' parameters (subsystems, n_p).
    durations
        The durations in seconds.

    Raises
    ------
    ApcError
        E806 a transition that overflows within a duration.
    """
    n_x, width = rates_of.pattern.shape
    entries = np.asarray(rates_of.matrices.map(len(vectors))(vectors.T), np.float64).T
    at_least_single_column = np.hstack([entries, np.zeros((len(entries), 1))])
    _, first, index_of = np.unique(at_least_single_column, axis=0, return_index=True, return_inverse=True)
    result = [np.empty((len(first), n_x, width)) for _ in durations]
    for index, row in enumerate(first.tolist()):
        exact = exact_rates(rates_of, vectors[row])
        for matrix, step in zip(result, discretize(exact[:, :n_x], exact[:, n_x:], durations), strict=True):
            matrix[index] = value_of(step)
    return tuple(matrix[index_of.reshape(-1)] for matrix in result)


def _symbols(peer_type: PeerType) -> tuple[Any, Any, Any, Any]:
    """Return the symbols of (x, u), p and t, and dx/dt in these symbols."""
    type_: Any = casadi.SX if peer_type.derivative.is_a("SXFunction") else casadi.MX
    n_x, n_u = len(peer_type.states), len(peer_type.holds)
    variables, p, t = (
        type_.sym("moving", n_x + n_u),
        type_.sym("p", len(peer_type.parameters)),
        type_.sym("t"),
    )
    x, u = casadi.vertsplit(variables, [0, n_x, n_x + n_u])
    return variables, p, t, peer_type.derivative(x, u, p, t)


def _nonlinear_states(derivative: Any, variables: Any, t: Any) -> list[int]:
    """Return the indices of the rates that are not linear in the states: varying slopes, or jumps."""
    slopes = jacobian(derivative, variables)
    arguments = casadi.vertcat(variables, t)
    return [
        row
        for row in range(derivative.numel())
        if (slopes[row, :].nnz() and casadi.depends_on(slopes[row, :], arguments))
        or (isinstance(derivative, casadi.SX) and guards_of(derivative[row], variables))
    ]


def _closure(a: Pattern) -> Pattern:
    """Return the sparsity pattern of exp(A T): the transitive closure of that of A."""
    reach = a | np.eye(len(a), dtype=bool)
    for _ in range(max(len(a) - 1, 0).bit_length()):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def _nonlinear_error(
    peer_type: PeerType, rows: Sequence[int], derivative: Any, variables: Any, p: Any
) -> ApcError:
    """Return the error E870 with the states and the parts whose equations are not linear."""
    involved = []
    for row in rows:
        guards = guards_of(derivative[row], variables) if isinstance(derivative, casadi.SX) else []
        second_derivatives = casadi.jacobian(casadi.jacobian(derivative[row], variables).T, variables)
        nonlinear_terms = casadi.vertcat(casadi.vec(second_derivatives), *guards)
        reads = casadi.which_depends(nonlinear_terms, p, 1, False) if p.numel() else ()
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
        f"the motion of {names} is not linear between the ticks{through}: exact simulation needs "
        "a linear motion there"
    )
    advice = "omit --method, or compute the force at ticks of a clock"
    return ApcError(Diagnostic("E870", SourceLocation(peer_type.name), message, advice=advice))
