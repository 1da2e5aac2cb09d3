"""The motions that nothing holds back, found in exact arithmetic.

Takes: a `ClosedLoop`, or a `ModalSystem` whose matrix was never built.
Gives: `RigidModes`, `find_rigid_modes`, `rigid_modes_of`; `NeutralModes`, `what_stands`; `stays_rigid`.
Guarantees: found from the equations with the parameters as exact rationals, never from an eigenvalue near 1;
a stiffness of exactly zero frees what it held.
Does not: find a motion that only repeats from frame to frame without standing still in between, or chains of
more than two (a motion growing with t²).

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
from apc.eigen.balls import BALLS, closed_frame, frame_steps
from apc.eigen.closing import ClosedLoop, ModalSystem
from apc.eigen.enclosure import misses_an_eigenvalue
from apc.eigen.null_space import null_space, null_space_modulo, residue
from apc.eigen.peers import PeerClass, states_of
from apc.frame.site import LinearSubsystem, entrywise

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # of fractions, quotients of polynomials, or flint.fmpq; 0 and 1 may be whole numbers

# Of what shifts together, as many are named.
MOST_NAMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class RigidModes:
    """The invariant subspace to remove before eigenvalues are computed.

    `basis` (n, k + drifts) holds eigenvectors with eigenvalue 1, then the second vectors of Jordan pairs,
    over the state of the closed system; `names` (k,) say what moves in each direction, and `exact` holds the
    same vectors as rationals.
    """

    basis: Floats
    names: tuple[str, ...]
    exact: tuple[tuple[Fraction, ...], ...]

    @property
    def drifts(self) -> int:
        """The number of motions that grow with time for want of damping."""
        return len(self.exact) - len(self.names)


def find_rigid_modes(system: ClosedLoop | ModalSystem, *, with_drifts: bool = True) -> RigidModes:
    """Find the rigid modes of a closed system and the drifts among them, in exact rationals.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to look for drifts, which is most of the work.
    """
    states = [state for _, state in _standing_solutions(system)]
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
    """Return the rigid modes of a system whose matrix is that of its sites' numbers, without drifts.

    Where the matrix tells that 1 is none of its eigenvalues there are none, and none are looked for.
    """
    if misses_an_eigenvalue(system.matrix, system.error):
        return RigidModes(np.zeros((len(system.names), 0)), (), ())
    return find_rigid_modes(system, with_drifts=False)


@dataclass(frozen=True, slots=True)
class NeutralModes:
    """What neither grows nor dies out: `translations` and `rotations`, which turn something, `drifts` among
    them, and the rest.

    `unfelt` are directions in which nothing moves: what a memory keeps that nothing reads, and what it adds
    up. `names` says what these are of: a memory, or the common shift of several.
    """

    translations: int
    rotations: int
    drifts: int
    unfelt: int
    names: tuple[str, ...]


def what_stands(system: ClosedLoop | ModalSystem, *, with_drifts: bool = True) -> NeutralModes:
    """Tell the rigid modes that move something from those that do not.

    Something moves where a length or an angle does that changes between the ticks. What a memory that nothing
    reads adds up while peers stand aside grows, too, and is no drift.

    Parameters
    ----------
    system
        The closed system.
    with_drifts
        Whether to look for drifts, which is most of the work.
    """
    vectors = [state for _, state in _standing_solutions(system)]
    turning = _places(system.sites, ANGLES)
    moving = [*turning, *_places(system.sites, (LENGTH,))]  # what turns anything is a rotation
    ramps = []
    for weights, state in _drifts(system, vectors) if with_drifts else []:
        rate = [sum(map(mul, weights, column), Fraction(0)) for column in zip(*vectors, strict=True)]
        ramps.append([*rate, *state])  # what drifts at a rate behind that, to be told by the rate alone
    drifting = _echelon(ramps, moving)
    drifts = sum(pivot in moving for pivot, _ in drifting)
    standing = [*vectors, *(row[len(row) // 2 :] for _, row in drifting[drifts:])]
    pairs = _echelon(standing, moving)
    pivots = [pivot for pivot, _ in pairs if pivot in moving]
    unfelt = [row for _, row in pairs[len(pivots) :]]
    return NeutralModes(
        translations=sum(pivot not in turning for pivot in pivots),
        rotations=sum(pivot in turning for pivot in pivots),
        drifts=drifts,
        unfelt=len(unfelt),
        names=tuple(dict.fromkeys(_shifted(system.names, vector) for vector in unfelt)),
    )


def _echelon(rows: Sequence[Sequence[Fraction]], first: Sequence[int]) -> list[tuple[int, list[Fraction]]]:
    """Return a reduced basis of the space that rows span, each with its pivot, some places first."""
    if not rows:
        return []
    order = [*first, *sorted(set(range(len(rows[0]))) - set(first))]
    across = null_space(np.array(rows, dtype=object)[:, order])
    # What is at right angles to all that is at right angles to them.
    spanned = null_space(np.array(across, dtype=object).reshape(len(across), len(order)))
    back = np.argsort(order).tolist()
    pivots = [order[next(column for column, entry in enumerate(row) if entry)] for row in spanned]
    return [(pivot, [row[place] for place in back]) for pivot, row in zip(pivots, spanned, strict=True)]


def _shifted(names: Sequence[str], vector: Sequence[Fraction]) -> str:
    """Return what a direction shifts."""
    listed = list(
        dict.fromkeys(name.partition("(")[0] for name, entry in zip(names, vector, strict=True) if entry)
    )
    if len(listed) == 1:
        return listed[0]
    more = ["…"] if len(listed) > MOST_NAMED else []
    return f"the common shift of {', '.join([*listed[:MOST_NAMED], *more])}"


def _places(sites: Sequence[PeerClass], units: Sequence[str]) -> list[int]:
    """Return the places in the state of what changes between the ticks and has one of some units."""
    numbers, start = [], 0
    ends = [states_of(group.schedule, group.jacobians) for group in sites]
    for group, size in zip(sites, ends, strict=True):
        states = group.jacobians.kind.states
        numbers += [start + place for place, state in enumerate(states) if state.unit in units]
        start += size
    return numbers


def stays_rigid(system: ClosedLoop | ModalSystem, others: Sequence[LinearSubsystem]) -> bool:
    """Say whether the directions of a system's rigid modes are rigid with other matrices of its sites, too.

    Parameters
    ----------
    system
        The closed system.
    others
        Matrices of each site, over rationals or quotients of polynomials: then for all values of these.
    """
    solutions = _standing_solutions(system)
    if not solutions:
        return True
    equations, states = _standing(system, others)
    for solution, state in solutions:
        moving = [(place, value) for place, value in enumerate(solution) if value]
        left, reached = (
            sum((matrix[:, place] * value for place, value in moving), np.zeros(len(matrix), dtype=object))
            for matrix in (equations, states)
        )
        if any(left) or any(item - other for item, other in zip(reached, state, strict=True)):
            return False
    return True


def _standing_solutions(system: ClosedLoop | ModalSystem) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the standing solutions whose states are independent, each with its state.

    An output nobody reads may be free without being part of the state.
    """
    equations, states = _standing(system, [group.exact for group in system.sites])
    pairs: list[tuple[list[Fraction], list[Fraction]]] = []
    for solution in null_space(equations):
        state = _times(states, solution)
        before = [numbers for _, numbers in pairs]
        if not null_space(np.array([*before, state], dtype=object).T) if before else any(state):
            pairs.append((solution, state))
    return pairs


def _times(matrix: Matrix, vector: Sequence[Fraction]) -> list[Fraction]:
    """Return the product of a matrix with a vector that is mostly zeros."""
    moving = [place for place, value in enumerate(vector) if value]
    return [
        sum((row[place] * vector[place] for place in moving if row[place]), Fraction(0)) for row in matrix
    ]


def _standing(system: ClosedLoop | ModalSystem, sites: Sequence[LinearSubsystem]) -> tuple[Matrix, Matrix]:
    """Return what must vanish of a constant solution, and the closed state that belongs to it.

    Both are matrices over the unknowns: every site's states, then the outputs of its clocks.
    """
    starts: list[int] = []
    outputs: list[list[list[int]]] = []
    size = 0
    for site in sites:
        starts.append(size)
        size += len(site.kind.states)
        outputs.append([])
        for partition in site.kind.clocks:
            outputs[-1].append([*range(size, size + len(partition.outputs))])
            size += len(partition.outputs)
    places = []  # of x and u, site by site
    sent: list[dict[tuple[str, str], Matrix]] = []
    for site, start, output in zip(sites, starts, outputs, strict=True):
        clock = {partition.clock: place for place, partition in enumerate(site.kind.clocks)}
        x = [*range(start, start + len(site.kind.states))]
        u = [output[clock[hold.clock]][hold.output] for hold in site.kind.holds]
        places.append((x, u))
        sent.append({})
        for send, sending in zip(site.sends, site.kind.sends, strict=True):
            rows = _placed(size, len(sending.channels), (x, send.x), (u, send.u))
            sent[-1] |= {
                (sending.link, channel): row for channel, row in zip(sending.channels, rows, strict=True)
            }
    equations, states = [np.zeros((0, size), dtype=object)], [np.zeros((0, size), dtype=object)]
    unit = np.eye(size, dtype=np.int64).astype(object)
    for g, (group, site, output, (x, u)) in enumerate(zip(system.sites, sites, outputs, places, strict=True)):
        equations.append(_placed(size, len(x), (x, site.a), (u, site.b)))
        for p, (tick, partition) in enumerate(zip(site.ticks, site.kind.clocks, strict=True)):
            y = output[p]
            blocks = ((x, tick.x), (u, tick.u), ([y[o] for o in partition.memories], tick.m))
            rows = _placed(size, len(tick.x), *blocks)
            for place in range(len(partition.receives)):
                for way, channel in group.schedule.ways(p, place):
                    for h, weight in enumerate(system.coupling[way][g]):
                        if weight and (way.link, channel) in sent[h]:
                            heard = sent[h][way.link, channel]
                            columns = np.flatnonzero(heard != 0)
                            rows[:, columns] += np.outer(tick.r[:, place], weight * heard[columns])
            for row in range(len(rows)):  # of all variants
                rows[row, y[row % len(y)]] -= 1
            equations.append(rows)
        carried = [output[value.partition][value.output] for value in group.schedule.carried]
        states.append(unit[[*x, *carried]])
        for packet in system.packets:
            if packet.site == g:
                named = group.schedule.sent[packet.row]
                states.append(sent[g][named.link, named.channel][None])
    return np.concatenate(equations), np.concatenate(states)


def _placed(size: int, rows: int, *blocks: tuple[Sequence[int], Matrix]) -> Matrix:
    """Return rows over all unknowns, with the columns of some blocks at their places."""
    values = np.zeros((rows, size), dtype=object)
    for columns, block in blocks:
        for place, column in enumerate(columns):
            values[:, column] += block[:, place]
    return values


def _drifts(
    system: ClosedLoop | ModalSystem, standing: Sequence[Sequence[Fraction]]
) -> list[tuple[list[Fraction], list[Fraction]]]:
    """Return the ramps on top of standing states: of each the weights of these in its rate, and its state.

    Notes
    -----
    The frame's map by Euler's steps has fractions that grow without end. So the equations are solved modulo a
    prime, where standing states without a rate are solutions, too; what is more is tried in rationals.
    """
    count = len(standing)
    if not count:
        return []
    unit = np.eye(count + len(standing[0]), dtype=np.int64).astype(object)
    try:
        result = null_space_modulo(_ramp_equations(system, standing, unit, residue))
        ramps = [vector for vector in result if any(vector[:count])]
        if len(result) == count:
            return []
        tried = np.array([[_rational(entry) for entry in vector] for vector in result], dtype=object).T
        sound = not _ramp_equations(system, standing, tried, _rational).any()
    except ValueError:  # the prime divides a denominator, or a residue has no simple fraction
        sound = False
    if not sound:
        exact = _ramp_equations(system, standing, unit, _rational)
        ramps = [vector for vector in null_space(_fractions(exact)) if any(vector[:count])]
    return [(vector[:count], vector[count:]) for vector in ramps]


def _ramp_equations(
    system: ClosedLoop | ModalSystem,
    standing: Sequence[Sequence[Fraction]],
    unknowns: Matrix,
    number: Callable[[Fraction], Any],
) -> Matrix:
    """Return what must vanish of ramps (rows, columns), given their weights w above their states z.

    Notes
    -----
    M z = z + T V w, M by Euler's steps and V the standing states; A x + B u = V_x w at the beginning of each
    step; and A V_x w = 0, or it were not so at its end.
    """
    states = np.array([[number(entry) for entry in state] for state in standing], dtype=object).T
    rates, z = BALLS.multiply(states, unknowns[: len(standing)]), unknowns[len(standing) :]
    sites = [entrywise(group.exact, number) for group in system.sites]
    own = [
        rates[offset : offset + len(site.a)]
        for site, offset in zip(sites, system.layout.offsets, strict=True)
    ]
    equations: list[Matrix] = []

    def euler(a: Matrix, b: Matrix, duration: Fraction) -> Matrix:
        return np.hstack([np.eye(len(a), dtype=np.int64) + a * number(duration), b * number(duration)])

    def watch(g: int, _: int, moving: Matrix, __: object) -> None:
        moved = np.hstack([sites[g].a, sites[g].b])
        equations.append(BALLS.multiply(moved, moving) - own[g])

    weights = {
        way: [[(h, number(weight)) for h, weight in enumerate(row) if weight] for row in rows]
        for way, rows in system.coupling.items()
    }
    steps = [
        frame_steps(site, group.schedule, euler) for site, group in zip(sites, system.sites, strict=True)
    ]
    after = closed_frame(system, sites, steps, weights=weights, state=z, watch=watch)
    equations.append(after - z - rates * number(system.sites[0].schedule.frame_s))
    equations += [BALLS.multiply(site.a, values) for site, values in zip(sites, own, strict=True)]
    return np.concatenate(equations)


def _rational(value: Fraction | float) -> Any:
    """Return a rational for python-flint; 0 and 1 as whole numbers."""
    if value == 0 or value == 1:
        return int(value)
    exact = Fraction(value)
    return flint.fmpq(exact.numerator, exact.denominator)


def _fractions(matrix: Matrix) -> Matrix:
    """Return a matrix of python-flint's rationals as fractions."""
    values = np.zeros(matrix.shape, dtype=object)
    for place in np.argwhere(matrix != 0).tolist():
        entry = flint.fmpq(matrix[tuple(place)])
        values[tuple(place)] = Fraction(int(entry.p), int(entry.q))
    return values
