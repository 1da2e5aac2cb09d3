"""Rigid modes and drifts, computed in exact arithmetic.

Takes: a `ClosedLoop`, or a `ModalSystem` whose matrix was never built.
Gives: `RigidModes`, `find_rigid_modes`, `rigid_modes_of`; `NeutralModes`, `classify_neutral_modes`;
`stays_rigid`.
Guarantees: computed from the equations with the parameters as exact rationals, never from an eigenvalue near
1; a stiffness of exactly zero yields the rigid mode of the parts that it connected.
Does not: find a motion of the frame's period that is not constant in between, or Jordan chains of more than
two (a motion growing with t²).

A rigid mode is a constant solution of the homogeneous equations,

    A x + B u = 0,   u = y,   y = X x + U u + M y + R r,   r = W s,   s = X x + U u,

which makes an eigenvector of the frame's map with eigenvalue 1. A drift is a solution x(t) = x₁ + t x₀ with
x₀ such a constant: between events A x + B u = x₀, so that Euler's step is exact and the frame's map by these
steps takes its state z to z + T z₀, T being a frame's length and z₀ the state of x₀. It makes a generalized
eigenvector, a Jordan pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from numbers import Rational
from operator import mul
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH
from apc.linearization.linear_subsystem import LinearSubsystem, entrywise
from apc.spectrum.ball_arithmetic import BALLS, closed_frame, frame_steps
from apc.spectrum.enclosure import excludes_unit_eigenvalue
from apc.spectrum.interconnection import ClosedLoop, ModalSystem
from apc.spectrum.null_space import null_space, null_space_modulo, residue
from apc.spectrum.peer_classes import PeerClass, states_of

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # of fractions, quotients of polynomials, or flint.fmpq; 0 and 1 may be whole numbers

# The number of names in a common shift.
MOST_NAMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class RigidModes:
    """The invariant subspace to remove before eigenvalues are computed.

    `basis` (n, k + drifts) holds eigenvectors with eigenvalue 1, then the second vectors of Jordan pairs,
    over the state of the closed system; `names` (k,) name the shifted states of each direction, and `exact`
    holds the same vectors as rationals.
    """

    basis: Floats
    names: tuple[str, ...]
    exact: tuple[tuple[Fraction, ...], ...]

    @property
    def drifts(self) -> int:
        """The number of undamped motions that grow with time."""
        return len(self.exact) - len(self.names)


def find_rigid_modes(system: ClosedLoop | ModalSystem, *, with_drifts: bool = True) -> RigidModes:
    """Return the rigid modes of a closed system and the drifts among them, in exact rationals.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to search for drifts, which is most of the work.
    """
    states = [state for _, state in _neutral_solutions(system)]
    pairs = [state for _, state in _drifts(system, states)] if with_drifts else []
    names = system.names
    vectors = tuple(map(tuple, (*states, *pairs)))
    return RigidModes(
        basis=np.array(vectors, dtype=np.float64).reshape(len(vectors), len(names)).T,
        names=tuple(
            ", ".join(name for name, entry in zip(names, state, strict=True) if entry) for state in states
        ),
        exact=vectors,
    )


def rigid_modes_of(closed_loop: ClosedLoop) -> RigidModes:
    """Return the rigid modes of a system, without drifts, from the matrices of its subsystems.

    Where the matrix proves that 1 is not an eigenvalue, the exact search is skipped.
    """
    if excludes_unit_eigenvalue(closed_loop.matrix, closed_loop.error):
        return RigidModes(np.zeros((len(closed_loop.names), 0)), (), ())
    return find_rigid_modes(closed_loop, with_drifts=False)


@dataclass(frozen=True, slots=True)
class NeutralModes:
    """Neutral modes: `translations` and `rotations`, `drifts` among them, and unobservable directions.

    `unobservable` are directions without motion: values of a memory that is not read, and sums of them.
    `names` are the names of the memories, or of several with a common shift.
    """

    translations: int
    rotations: int
    drifts: int
    unobservable: int
    names: tuple[str, ...]


def classify_neutral_modes(system: ClosedLoop | ModalSystem, *, with_drifts: bool = True) -> NeutralModes:
    """Return the numbers of translations, rotations, drifts and unobservable directions of a system.

    A mode moves something if it shifts a length or an angle that changes between the ticks. The sum in a
    memory that no value reads grows, too, if peers differ, and is not a drift.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to search for drifts, which is most of the work.
    """
    vectors = [state for _, state in _neutral_solutions(system)]
    angle_indices = _indices(system.peer_classes, ANGLES)
    position_indices = [
        *angle_indices,
        *_indices(system.peer_classes, (LENGTH,)),
    ]  # a mode that shifts an angle is a rotation
    ramps = []
    for weights, state in _drifts(system, vectors) if with_drifts else []:
        rate = [sum(map(mul, weights, column), Fraction(0)) for column in zip(*vectors, strict=True)]
        ramps.append([*rate, *state])  # drifts with a rate behind those columns, identified by the rate alone
    drifting = _echelon(ramps, position_indices)
    drifts = sum(pivot in position_indices for pivot, _ in drifting)
    neutral = [*vectors, *(row[len(row) // 2 :] for _, row in drifting[drifts:])]
    pairs = _echelon(neutral, position_indices)
    pivots = [pivot for pivot, _ in pairs if pivot in position_indices]
    unobservable = [row for _, row in pairs[len(pivots) :]]
    return NeutralModes(
        translations=sum(pivot not in angle_indices for pivot in pivots),
        rotations=sum(pivot in angle_indices for pivot in pivots),
        drifts=drifts,
        unobservable=len(unobservable),
        names=tuple(dict.fromkeys(_shifted_names(system.names, vector) for vector in unobservable)),
    )


def _echelon(rows: Sequence[Sequence[Fraction]], first: Sequence[int]) -> list[tuple[int, list[Fraction]]]:
    """Return a reduced basis of the row space, each vector with its pivot.

    Pivots are in the columns `first` if possible.
    """
    if not rows:
        return []
    order = [*first, *sorted(set(range(len(rows[0]))) - set(first))]
    complement = null_space(np.array(rows, dtype=object)[:, order])
    # The row space is the orthogonal complement of its orthogonal complement.
    basis = null_space(np.array(complement, dtype=object).reshape(len(complement), len(order)))
    original_order = np.argsort(order).tolist()
    pivots = [order[next(column for column, entry in enumerate(row) if entry)] for row in basis]
    return [
        (pivot, [row[index] for index in original_order]) for pivot, row in zip(pivots, basis, strict=True)
    ]


def _shifted_names(names: Sequence[str], vector: Sequence[Fraction]) -> str:
    """Return the names of the states that a direction shifts, as a text."""
    listed = list(
        dict.fromkeys(name.partition("(")[0] for name, entry in zip(names, vector, strict=True) if entry)
    )
    if len(listed) == 1:
        return listed[0]
    more = ["…"] if len(listed) > MOST_NAMED else []
    return f"the common shift of {', '.join([*listed[:MOST_NAMED], *more])}"


def _indices(peer_classes: Sequence[PeerClass], units: Sequence[str]) -> list[int]:
    """Return the indices of continuous states with one of the given units."""
    indices, start = [], 0
    sizes = [states_of(peer_class.schedule, peer_class.jacobians) for peer_class in peer_classes]
    for peer_class, size in zip(peer_classes, sizes, strict=True):
        states = peer_class.jacobians.peer_type.states
        indices += [start + index for index, state in enumerate(states) if state.unit in units]
        start += size
    return indices


def stays_rigid(system: ClosedLoop | ModalSystem, others: Sequence[LinearSubsystem]) -> bool:
    """Return whether the rigid directions of a system stay rigid with other matrices of its subsystems.

    Parameters
    ----------
    system
        The closed system.
    others
        The other matrices of each subsystem, over rationals, or over quotients of polynomials: then the
        result holds for all values of the parameters.
    """
    solutions = _neutral_solutions(system)
    if not solutions:
        return True
    equations, states = _constant_solution_equations(system, others)
    for solution, state in solutions:
        nonzero = [(index, value) for index, value in enumerate(solution) if value]
        residual, state_of_solution = (
            sum((matrix[:, index] * value for index, value in nonzero), np.zeros(len(matrix), dtype=object))
            for matrix in (equations, states)
        )
        if any(residual) or any(
            item - expected for item, expected in zip(state_of_solution, state, strict=True)
        ):
            return False
    return True


def _neutral_solutions(system: ClosedLoop | ModalSystem) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the constant solutions with independent states, each with its state.

    An output that is not used may be free without being part of the state.
    """
    equations, states = _constant_solution_equations(
        system, [peer_class.exact for peer_class in system.peer_classes]
    )
    pairs: list[tuple[list[Fraction], list[Fraction]]] = []
    for solution in null_space(equations):
        state = _sparse_product(states, solution)
        before = [numbers for _, numbers in pairs]
        if not null_space(np.array([*before, state], dtype=object).T) if before else any(state):
            pairs.append((solution, state))
    return pairs


def _sparse_product(matrix: Matrix, vector: Sequence[Fraction]) -> list[Fraction]:
    """Return the product of a matrix and a vector that is mostly zeros."""
    nonzero = [index for index, value in enumerate(vector) if value]
    return [
        sum((row[index] * vector[index] for index in nonzero if row[index]), Fraction(0)) for row in matrix
    ]


def _constant_solution_equations(
    system: ClosedLoop | ModalSystem, subsystems: Sequence[LinearSubsystem]
) -> tuple[Matrix, Matrix]:
    """Return the equations of a constant solution, over the states and clock outputs of every subsystem.

    Returns
    -------
    Matrix
        The equations, each a row over the unknowns.
    Matrix
        The state of the closed system, as rows over the unknowns.
    """
    starts: list[int] = []
    outputs: list[list[list[int]]] = []
    size = 0
    for subsystem in subsystems:
        starts.append(size)
        size += len(subsystem.peer_type.states)
        outputs.append([])
        for partition in subsystem.peer_type.clocks:
            outputs[-1].append([*range(size, size + len(partition.outputs))])
            size += len(partition.outputs)
    indices = []  # the unknowns of x and u, by subsystem
    # The sent values over the unknowns: the entries that are not zero, by link and channel.
    sent: list[dict[tuple[str, str], list[tuple[int, Any]]]] = []
    for subsystem, start, output in zip(subsystems, starts, outputs, strict=True):
        clock = {partition.clock: index for index, partition in enumerate(subsystem.peer_type.clocks)}
        x = [*range(start, start + len(subsystem.peer_type.states))]
        u = [output[clock[hold.clock]][hold.output] for hold in subsystem.peer_type.holds]
        indices.append((x, u))
        sent.append({})
        for send, sending in zip(subsystem.sends, subsystem.peer_type.sends, strict=True):
            rows = _over_unknowns(size, len(sending.channels), (x, send.x), (u, send.u))
            sent[-1] |= {
                (sending.link, channel): [
                    (column, row[column]) for column in np.flatnonzero(row != 0).tolist()
                ]
                for channel, row in zip(sending.channels, rows, strict=True)
            }
    equations, states = [np.zeros((0, size), dtype=object)], [np.zeros((0, size), dtype=object)]
    unit = np.eye(size, dtype=np.int64).astype(object)
    for g, (peer_class, subsystem, output, (x, u)) in enumerate(
        zip(system.peer_classes, subsystems, outputs, indices, strict=True)
    ):
        equations.append(_over_unknowns(size, len(x), (x, subsystem.a), (u, subsystem.b)))
        for p, (tick, partition) in enumerate(zip(subsystem.ticks, subsystem.peer_type.clocks, strict=True)):
            y = output[p]
            blocks = ((x, tick.x), (u, tick.u), ([y[o] for o in partition.memories], tick.m))
            rows = _over_unknowns(size, len(tick.x), *blocks)
            for index in range(len(partition.receives)):
                # A quotient of polynomials has no value to compare with zero.
                readers = [
                    row
                    for row, gain in enumerate(tick.r[:, index])
                    if not (isinstance(gain, Rational) and gain == 0)
                ]
                received: dict[int, Any] = {}  # the combined value, by unknown
                for coupling_term, channel in peer_class.schedule.coupling_terms(p, index):
                    for h, weight in enumerate(system.coupling[coupling_term][g]):
                        if weight:
                            for column, entry in sent[h].get((coupling_term.link, channel), ()):
                                # A sum of hundreds of senders consists of weights of single packets.
                                product = weight if entry == 1 else weight * entry
                                received[column] = (
                                    received[column] + product if column in received else product
                                )
                for reader in readers:
                    for column, entry in received.items():
                        rows[reader, column] += tick.r[reader, index] * entry
            for row in range(len(rows)):  # of all variants
                rows[row, y[row % len(y)]] -= 1
            equations.append(rows)
        discrete_states = [
            output[value.partition][value.output] for value in peer_class.schedule.discrete_states
        ]
        states.append(unit[[*x, *discrete_states]])
        for packet in system.packets:
            if packet.subsystem == g:
                sent_sample = peer_class.schedule.sent[packet.row]
                state = np.zeros((1, size), dtype=object)
                for column, entry in sent[g][sent_sample.link, sent_sample.channel]:
                    state[0, column] = entry
                states.append(state)
    return np.concatenate(equations), np.concatenate(states)


def _over_unknowns(unknowns: int, row_count: int, *blocks: tuple[Sequence[int], Matrix]) -> Matrix:
    """Return rows over all unknowns, from blocks over some of them.

    Parameters
    ----------
    unknowns, row_count
        The numbers of columns and of rows.
    blocks
        The indices of the unknowns of each block, and the block.
    """
    values = np.zeros((row_count, unknowns), dtype=object)
    for columns, block in blocks:
        for block_column, column in enumerate(columns):
            values[:, column] += block[:, block_column]
    return values


def _drifts(
    system: ClosedLoop | ModalSystem, neutral: Sequence[Sequence[Fraction]]
) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the ramps on constant states: motions that grow in proportion to time.

    `neutral` are the constant states. For each ramp: the weights of the constant states in its rate, and its
    state.

    Notes
    -----
    The frame's map by Euler's steps has fractions that grow without limit. So the equations are solved modulo
    a prime, where constant states without a rate are solutions, too; the other solutions are verified in
    rationals.
    """
    count = len(neutral)
    if not count:
        return []
    unit = np.eye(count + len(neutral[0]), dtype=np.int64).astype(object)
    try:
        solutions = null_space_modulo(_ramp_equations(system, neutral, unit, residue))
        ramps = [vector for vector in solutions if any(vector[:count])]
        if len(solutions) == count:
            return []
        candidates = np.array(
            [[_rational(entry) for entry in vector] for vector in solutions], dtype=object
        ).T
        verified = not _ramp_equations(system, neutral, candidates, _rational).any()
    except ValueError:  # the prime divides a denominator, or a residue has no simple fraction
        verified = False
    if not verified:
        exact = _ramp_equations(system, neutral, unit, _rational)
        ramps = [vector for vector in null_space(_fractions(exact)) if any(vector[:count])]
    return [(vector[:count], vector[count:]) for vector in ramps]


def _ramp_equations(
    system: ClosedLoop | ModalSystem,
    neutral: Sequence[Sequence[Fraction]],
    unknowns: Matrix,
    number: Callable[[Fraction], Any],
) -> Matrix:
    """Return the equations of ramps (rows, columns), over their weights w and then their states z.

    Parameters
    ----------
    system, neutral
        The closed system, and its constant states.
    unknowns
        The vectors (w, z) as columns.
    number
        Converts a rational to the number type.

    Notes
    -----
    M z = z + T V w, M by Euler's steps and V the constant states; A x + B u = V_x w at the beginning of each
    step; and A V_x w = 0, so that it holds at its end, too.
    """
    states = np.array([[number(entry) for entry in state] for state in neutral], dtype=object).T
    rates, z = BALLS.multiply(states, unknowns[: len(neutral)]), unknowns[len(neutral) :]
    subsystems = [entrywise(peer_class.exact, number) for peer_class in system.peer_classes]
    rates_of = [
        rates[offset : offset + len(subsystem.a)]
        for subsystem, offset in zip(subsystems, system.layout.offsets, strict=True)
    ]
    equations: list[Matrix] = []

    def euler(a: Matrix, b: Matrix, duration: Fraction) -> Matrix:
        """Return [I + A T, B T], Euler's step."""
        return np.hstack([np.eye(len(a), dtype=np.int64) + a * number(duration), b * number(duration)])

    def watch(g: int, _: int, moving: Matrix, __: object) -> None:
        """Add the equations A x + B u = x₀ at the beginning of a step."""
        generator = np.hstack([subsystems[g].a, subsystems[g].b])
        equations.append(BALLS.multiply(generator, moving) - rates_of[g])

    weights = {
        coupling_term: [[(h, number(weight)) for h, weight in enumerate(row) if weight] for row in rows]
        for coupling_term, rows in system.coupling.items()
    }
    steps = [
        frame_steps(subsystem, peer_class.schedule, euler)
        for subsystem, peer_class in zip(subsystems, system.peer_classes, strict=True)
    ]
    end_state = closed_frame(system, subsystems, steps, weights=weights, state=z, watch=watch)
    equations.append(end_state - z - rates * number(system.peer_classes[0].schedule.frame_s))
    equations += [
        BALLS.multiply(subsystem.a, values) for subsystem, values in zip(subsystems, rates_of, strict=True)
    ]
    return np.concatenate(equations)


def _rational(value: Fraction | float) -> Any:
    """Return a rational for python-flint; 0 and 1 as integers."""
    if value == 0 or value == 1:
        return int(value)
    exact = Fraction(value)
    return flint.fmpq(exact.numerator, exact.denominator)


def _fractions(matrix: Matrix) -> Matrix:
    """Return a matrix of python-flint's rationals as fractions."""
    values = np.zeros(matrix.shape, dtype=object)
    for index in np.argwhere(matrix != 0).tolist():
        entry = flint.fmpq(matrix[tuple(index)])
        values[tuple(index)] = Fraction(int(entry.p), int(entry.q))
    return values
