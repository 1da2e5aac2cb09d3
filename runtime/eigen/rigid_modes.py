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
from operator import mul
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import ANGLES, LENGTH
from apc.eigen.ball_arithmetic import BALLS, closed_frame, frame_steps
from apc.eigen.enclosure import misses_an_eigenvalue
from apc.eigen.interconnection import ClosedLoop, ModalSystem
from apc.eigen.null_space import null_space, null_space_modulo, residue
from apc.eigen.peer_classes import PeerClass, states_of
from apc.frame.linear_subsystem import LinearSubsystem, entrywise

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


def rigid_modes_of(system: ClosedLoop) -> RigidModes:
    """Return the rigid modes of a system, without drifts, from the matrices of its subsystems.

    Where the matrix proves that 1 is not an eigenvalue, the exact search is skipped.
    """
    if misses_an_eigenvalue(system.matrix, system.error):
        return RigidModes(np.zeros((len(system.names), 0)), (), ())
    return find_rigid_modes(system, with_drifts=False)


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
    """Return the rigid modes of a system as neutral modes: those that move a position and the others.

    A mode moves something if it shifts a length or an angle that changes between the ticks. The sum in a
    memory that nothing reads grows, too, while peers differ, and is not a drift.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to search for drifts, which is most of the work.
    """
    vectors = [state for _, state in _neutral_solutions(system)]
    turning = _indices(system.subsystems, ANGLES)
    moving = [*turning, *_indices(system.subsystems, (LENGTH,))]  # a mode that shifts an angle is a rotation
    ramps = []
    for weights, state in _drifts(system, vectors) if with_drifts else []:
        rate = [sum(map(mul, weights, column), Fraction(0)) for column in zip(*vectors, strict=True)]
        ramps.append([*rate, *state])  # drifts with a rate behind those columns, identified by the rate alone
    drifting = _echelon(ramps, moving)
    drifts = sum(pivot in moving for pivot, _ in drifting)
    neutral = [*vectors, *(row[len(row) // 2 :] for _, row in drifting[drifts:])]
    pairs = _echelon(neutral, moving)
    pivots = [pivot for pivot, _ in pairs if pivot in moving]
    unobservable = [row for _, row in pairs[len(pivots) :]]
    return NeutralModes(
        translations=sum(pivot not in turning for pivot in pivots),
        rotations=sum(pivot in turning for pivot in pivots),
        drifts=drifts,
        unobservable=len(unobservable),
        names=tuple(dict.fromkeys(_shifted(system.names, vector) for vector in unobservable)),
    )


def _echelon(rows: Sequence[Sequence[Fraction]], first: Sequence[int]) -> list[tuple[int, list[Fraction]]]:
    """Return a reduced basis of the row space, each with its pivot, with given columns first."""
    if not rows:
        return []
    order = [*first, *sorted(set(range(len(rows[0]))) - set(first))]
    across = null_space(np.array(rows, dtype=object)[:, order])
    # The orthogonal complement of their orthogonal complement.
    spanned = null_space(np.array(across, dtype=object).reshape(len(across), len(order)))
    back = np.argsort(order).tolist()
    pivots = [order[next(column for column, entry in enumerate(row) if entry)] for row in spanned]
    return [(pivot, [row[index] for index in back]) for pivot, row in zip(pivots, spanned, strict=True)]


def _shifted(names: Sequence[str], vector: Sequence[Fraction]) -> str:
    """Return the names of the states that a direction shifts."""
    listed = list(
        dict.fromkeys(name.partition("(")[0] for name, entry in zip(names, vector, strict=True) if entry)
    )
    if len(listed) == 1:
        return listed[0]
    more = ["…"] if len(listed) > MOST_NAMED else []
    return f"the common shift of {', '.join([*listed[:MOST_NAMED], *more])}"


def _indices(subsystems: Sequence[PeerClass], units: Sequence[str]) -> list[int]:
    """Return the indices of continuous states with one of the given units."""
    numbers, start = [], 0
    ends = [states_of(group.schedule, group.jacobians) for group in subsystems]
    for group, size in zip(subsystems, ends, strict=True):
        states = group.jacobians.peer_type.states
        numbers += [start + index for index, state in enumerate(states) if state.unit in units]
        start += size
    return numbers


def stays_rigid(system: ClosedLoop | ModalSystem, others: Sequence[LinearSubsystem]) -> bool:
    """Return whether the rigid directions of a system are rigid with other matrices of its subsystems, too.

    Parameters
    ----------
    system
        The closed system.
    others
        Matrices of each subsystem, over rationals or quotients of polynomials: then for all values of these.
    """
    solutions = _neutral_solutions(system)
    if not solutions:
        return True
    equations, states = _neutral(system, others)
    for solution, state in solutions:
        moving = [(index, value) for index, value in enumerate(solution) if value]
        left, reached = (
            sum((matrix[:, index] * value for index, value in moving), np.zeros(len(matrix), dtype=object))
            for matrix in (equations, states)
        )
        if any(left) or any(item - other for item, other in zip(reached, state, strict=True)):
            return False
    return True


def _neutral_solutions(system: ClosedLoop | ModalSystem) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the constant solutions with independent states, each with its state.

    An unused output may be free without being part of the state.
    """
    equations, states = _neutral(system, [group.exact for group in system.subsystems])
    pairs: list[tuple[list[Fraction], list[Fraction]]] = []
    for solution in null_space(equations):
        state = _times(states, solution)
        before = [numbers for _, numbers in pairs]
        if not null_space(np.array([*before, state], dtype=object).T) if before else any(state):
            pairs.append((solution, state))
    return pairs


def _times(matrix: Matrix, vector: Sequence[Fraction]) -> list[Fraction]:
    """Return the product of a matrix with a vector that is mostly zeros."""
    moving = [index for index, value in enumerate(vector) if value]
    return [
        sum((row[index] * vector[index] for index in moving if row[index]), Fraction(0)) for row in matrix
    ]


def _neutral(
    system: ClosedLoop | ModalSystem, subsystems: Sequence[LinearSubsystem]
) -> tuple[Matrix, Matrix]:
    """Return the equations of a constant solution, and the closed state that belongs to it.

    Both are matrices over the unknowns: every subsystem's states, then the outputs of its clocks.
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
    indices = []  # of x and u, by subsystem
    sent: list[dict[tuple[str, str], Matrix]] = []
    for subsystem, start, output in zip(subsystems, starts, outputs, strict=True):
        clock = {partition.clock: index for index, partition in enumerate(subsystem.peer_type.clocks)}
        x = [*range(start, start + len(subsystem.peer_type.states))]
        u = [output[clock[hold.clock]][hold.output] for hold in subsystem.peer_type.holds]
        indices.append((x, u))
        sent.append({})
        for send, sending in zip(subsystem.sends, subsystem.peer_type.sends, strict=True):
            rows = _placed(size, len(sending.channels), (x, send.x), (u, send.u))
            sent[-1] |= {
                (sending.link, channel): row for channel, row in zip(sending.channels, rows, strict=True)
            }
    equations, states = [np.zeros((0, size), dtype=object)], [np.zeros((0, size), dtype=object)]
    unit = np.eye(size, dtype=np.int64).astype(object)
    for g, (group, subsystem, output, (x, u)) in enumerate(
        zip(system.subsystems, subsystems, outputs, indices, strict=True)
    ):
        equations.append(_placed(size, len(x), (x, subsystem.a), (u, subsystem.b)))
        for p, (tick, partition) in enumerate(zip(subsystem.ticks, subsystem.peer_type.clocks, strict=True)):
            y = output[p]
            blocks = ((x, tick.x), (u, tick.u), ([y[o] for o in partition.memories], tick.m))
            rows = _placed(size, len(tick.x), *blocks)
            for index in range(len(partition.receives)):
                for coupling_term, channel in group.schedule.coupling_terms(p, index):
                    for h, weight in enumerate(system.coupling[coupling_term][g]):
                        if weight and (coupling_term.link, channel) in sent[h]:
                            received = sent[h][coupling_term.link, channel]
                            columns = np.flatnonzero(received != 0)
                            rows[:, columns] += np.outer(tick.r[:, index], weight * received[columns])
            for row in range(len(rows)):  # of all variants
                rows[row, y[row % len(y)]] -= 1
            equations.append(rows)
        discrete_states = [output[value.partition][value.output] for value in group.schedule.discrete_states]
        states.append(unit[[*x, *discrete_states]])
        for packet in system.packets:
            if packet.subsystem == g:
                named = group.schedule.sent[packet.row]
                states.append(sent[g][named.link, named.channel][None])
    return np.concatenate(equations), np.concatenate(states)


def _placed(size: int, rows: int, *blocks: tuple[Sequence[int], Matrix]) -> Matrix:
    """Return rows over all unknowns, with the columns of some blocks at their indices."""
    values = np.zeros((rows, size), dtype=object)
    for columns, block in blocks:
        for index, column in enumerate(columns):
            values[:, column] += block[:, index]
    return values


def _drifts(
    system: ClosedLoop | ModalSystem, neutral: Sequence[Sequence[Fraction]]
) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the ramps on constant states: for each the weights of these in its rate, and its state.

    Notes
    -----
    The frame's map by Euler's steps has fractions that grow without end. So the equations are solved modulo a
    prime, where constant states without a rate are solutions, too; the other solutions are verified in
    rationals.
    """
    count = len(neutral)
    if not count:
        return []
    unit = np.eye(count + len(neutral[0]), dtype=np.int64).astype(object)
    try:
        result = null_space_modulo(_ramp_equations(system, neutral, unit, residue))
        ramps = [vector for vector in result if any(vector[:count])]
        if len(result) == count:
            return []
        tried = np.array([[_rational(entry) for entry in vector] for vector in result], dtype=object).T
        sound = not _ramp_equations(system, neutral, tried, _rational).any()
    except ValueError:  # the prime divides a denominator, or a residue has no simple fraction
        sound = False
    if not sound:
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

    Notes
    -----
    M z = z + T V w, M by Euler's steps and V the constant states; A x + B u = V_x w at the beginning of each
    step; and A V_x w = 0, so that it holds at its end, too.
    """
    states = np.array([[number(entry) for entry in state] for state in neutral], dtype=object).T
    rates, z = BALLS.multiply(states, unknowns[: len(neutral)]), unknowns[len(neutral) :]
    subsystems = [entrywise(group.exact, number) for group in system.subsystems]
    local = [
        rates[offset : offset + len(subsystem.a)]
        for subsystem, offset in zip(subsystems, system.layout.offsets, strict=True)
    ]
    equations: list[Matrix] = []

    def euler(a: Matrix, b: Matrix, duration: Fraction) -> Matrix:
        return np.hstack([np.eye(len(a), dtype=np.int64) + a * number(duration), b * number(duration)])

    def watch(g: int, _: int, moving: Matrix, __: object) -> None:
        moved = np.hstack([subsystems[g].a, subsystems[g].b])
        equations.append(BALLS.multiply(moved, moving) - local[g])

    weights = {
        coupling_term: [[(h, number(weight)) for h, weight in enumerate(row) if weight] for row in rows]
        for coupling_term, rows in system.coupling.items()
    }
    steps = [
        frame_steps(subsystem, group.schedule, euler)
        for subsystem, group in zip(subsystems, system.subsystems, strict=True)
    ]
    after = closed_frame(system, subsystems, steps, weights=weights, state=z, watch=watch)
    equations.append(after - z - rates * number(system.subsystems[0].schedule.frame_s))
    equations += [
        BALLS.multiply(subsystem.a, values) for subsystem, values in zip(subsystems, local, strict=True)
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
