"""The frame map of a closed system in ball arithmetic: every entry encloses the true number.

Takes: a `ClosedLoop`; its subsystems' matrices as exact rationals.
Gives: `precision`, `unprovable`, `rational_ball`, `subsystem_balls`, `frame_steps`, `closed_frame`,
`frame_balls`, `reduced_balls`, `flint_matrix`; `weight_balls`.
Guarantees: the true matrix, of the parameters of the subsystems, lies in the balls, for any number of bits;
more bits make them smaller.
Does not: decide stability (see `certification`).

The frame is propagated event by event over the state of the closed system itself (`lift.follow`), all
subsystems in parallel, so that a frame of a thousand ticks needs no more columns than there are states.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.lifting.discretize import step_balls
from apc.lifting.interval_arithmetic import Arithmetic
from apc.lifting.lift import follow
from apc.linearization.linear_subsystem import LinearSubsystem, entrywise
from apc.parameter_values.exact_arithmetic import is_rational
from apc.spectrum.graph_modes import Surd
from apc.spectrum.interconnection import ClosedLoop, DelayedSample, ModalSystem
from apc.spectrum.relative_coordinates import Relative, relative
from apc.timing.schedule import CouplingTerm, Propagate, Schedule

Balls = NDArray[Any]  # of flint.arb, and the integers 0 and 1 where these are exact

# [F G] by duration in quanta, for one subsystem.
Steps = Mapping[int, Balls]

# The senders of each subsystem with their weights, by coupling term and subsystem.
Weights = Mapping[CouplingTerm, Sequence[Sequence[tuple[int, Any]]]]


@contextmanager
def precision(bits: int) -> Iterator[None]:
    """Set python-flint's working precision within a `with` block."""
    before, flint.ctx.prec = flint.ctx.prec, bits
    try:
        yield
    finally:
        flint.ctx.prec = before


def unprovable(system: ClosedLoop | ModalSystem) -> str:
    """Return the reason why a system has no exact coefficients, "" if its coefficients are exact."""
    if not system.peer_classes:
        return "its matrix was not composed from those of peers"
    for peer_class in {peer_class.index: peer_class for peer_class in system.peer_classes}.values():
        functions = [
            peer_class.jacobians.function,
            *(edge.function for edge in peer_class.jacobians.edges.values()),
        ]
        if not all(function.is_a("SXFunction") for function in functions):
            return f"the equations of {peer_class.name} contain a nonlinear loop, whose solution is rounded"
        if not all(is_rational(function) for function in functions):
            return f"the equations of {peer_class.name} contain functions whose values are rounded"
    return ""


def rational_ball(value: Fraction | int) -> Any:
    """Return a rational as a ball at the current precision; 0 and 1 stay integers."""
    if value == 0 or value == 1:
        return int(value)
    exact = Fraction(value)
    return flint.arb(flint.fmpq(exact.numerator, exact.denominator))


def subsystem_balls(system: ClosedLoop | ModalSystem) -> list[LinearSubsystem]:
    """Return the subsystems' matrices as balls at the current precision.

    Equal subsystems are converted once.
    """
    converted: dict[int, LinearSubsystem] = {}
    linear_subsystems = []
    for peer_class in system.peer_classes:
        if peer_class.index not in converted:
            converted[peer_class.index] = entrywise(peer_class.exact, rational_ball)
        linear_subsystems.append(converted[peer_class.index])
    return linear_subsystems


def frame_steps(
    subsystem: LinearSubsystem,
    schedule: Schedule,
    step: Callable[[Balls, Balls, Fraction], Balls] = step_balls,
) -> Steps:
    """Return the matrix [F G] of each duration in quanta by `step`: by default its exponential in balls, at
    the current precision.
    """
    durations = {event.duration for event in schedule.events if isinstance(event, Propagate)}
    return {
        duration: step(subsystem.a, subsystem.b, duration * schedule.quantum)
        for duration in sorted(durations)
    }


def frame_balls(system: ClosedLoop | ModalSystem) -> Balls:
    """Return the closed matrix (n, n) of a system as balls at the current precision."""
    subsystems = subsystem_balls(system)
    computed: dict[int, Steps] = {}
    steps = []
    for subsystem, peer_class in zip(subsystems, system.peer_classes, strict=True):
        if peer_class.index not in computed:
            computed[peer_class.index] = frame_steps(subsystem, peer_class.schedule)
        steps.append(computed[peer_class.index])
    return closed_frame(system, subsystems, steps)


def closed_frame(
    system: ClosedLoop | ModalSystem,
    subsystems: Sequence[LinearSubsystem],
    steps: Sequence[Steps],
    *,
    weights: Weights | None = None,
    state: Balls | None = None,
    watch: Callable[[int, int, Balls, Any], None] | None = None,
) -> Balls:
    """Return the states of a closed system after one frame, with all subsystems propagated in parallel.

    Parameters
    ----------
    system
        The closed system: its layout and coupling.
    subsystems, steps
        Every subsystem's matrices and exponentials, in a number type that can be added and multiplied, also
        with integers and the weights.
    weights
        The senders of each subsystem with their weights; by default those of `weight_balls`.
    state
        The states (n, columns) at the start of the frame; by default the unit matrix.
    watch
        Is called before each step, with the number of the subsystem first (see `lift.follow`).

    Returns
    -------
    The states at the end (n, columns), without `state` the closed matrix (n, n).
    """
    layout = system.layout
    n = len(layout.names)
    start = np.eye(n, dtype=np.int64).astype(object) if state is None else state
    index_of = layout.indices
    rows_of = [
        {sent: row for row, sent in enumerate(peer_class.schedule.sent)} for peer_class in system.peer_classes
    ]
    weights = weight_balls(system) if weights is None else weights
    sent: dict[tuple[int, int], Balls] = {}

    def receiving(g: int) -> Callable[[int], Balls | None]:
        """Return the function that computes the received values of subsystem g."""

        def receive(input_row: int) -> Balls | None:
            """Return a received value over the columns, None if a packet is not sent yet."""
            received = system.peer_classes[g].schedule.received[input_row]
            total = np.zeros(start.shape[1], dtype=object)
            for h, weight in weights[received.coupling_term][g]:
                row = rows_of[h][received.sent]
                if received.lag:
                    total = total + start[index_of[DelayedSample(h, row, received.lag)]] * weight
                elif (h, row) in sent:
                    total = total + sent[h, row] * weight
                else:
                    return None
            return total

        return receive

    matrix = np.zeros(start.shape, dtype=object)
    mode_paths = {
        g: follow(
            *(
                subsystem,
                peer_class.schedule,
                step,
                start[offset : offset + len(peer_class.z_names)],
                receiving(g),
            ),
            numbers=BALLS,
            watch=watch and functools.partial(watch, g),
        )
        for g, (peer_class, subsystem, step, offset) in enumerate(
            zip(system.peer_classes, subsystems, steps, layout.offsets, strict=True)
        )
    }
    while mode_paths:
        progress = len(mode_paths), len(sent)
        for g, mode_path in tuple(mode_paths.items()):
            try:
                # Each subsystem runs until a value is missing, so that every value is eventually received.
                while (sent_row := next(mode_path))[0] >= 0:
                    sent[g, sent_row[0]] = sent_row[1]
            except StopIteration as end_of_frame:
                end_state = end_of_frame.value
                matrix[layout.offsets[g] : layout.offsets[g] + len(end_state)] = end_state
                del mode_paths[g]
        assert (len(mode_paths), len(sent)) != progress, "a packet is received before it is sent"
    for packet, row_of_packet in index_of.items():
        older = DelayedSample(packet.subsystem, packet.row, packet.lag - 1)
        matrix[row_of_packet] = (
            sent[packet.subsystem, packet.row] if packet.lag == 1 else start[index_of[older]]
        )
    return matrix


def weight_balls(system: ClosedLoop | ModalSystem) -> Weights:
    """Return the senders of each subsystem with their weights as balls, errors included, by coupling term."""
    result = {}
    for coupling_term, rows in system.coupling.items():
        if coupling_term in system.surds:
            result[coupling_term] = [[(0, _surd_ball(system.surds[coupling_term]))]]
            continue
        weight_error = system.weight_errors.get(coupling_term, 0.0)
        spread = flint.arb(0, weight_error) if weight_error else 0
        result[coupling_term] = [
            [(h, rational_ball(weight) + spread) for h, weight in enumerate(row) if weight or weight_error]
            for row in rows
        ]
    return result


def _surd_ball(surd: Surd) -> Any:
    """Return a number known in closed form as a ball at the current precision."""
    cosine = flint.arb.cos_pi_fmpq(flint.fmpq(2 * surd.turn.numerator, surd.turn.denominator))
    return rational_ball(surd.scale) * cosine * flint.arb(surd.square).sqrt()


def _multiply(matrix: Balls, rows: Balls) -> Balls:
    """Return the product with a sparse matrix, whose rows may be sparse; an exact zero is the integer 0."""
    product = np.zeros((len(matrix), rows.shape[1]), dtype=object)
    columns = [
        [
            (row, entry_of_rows)
            for row, entry_of_rows in enumerate(column)
            if not isinstance(entry_of_rows, int) or entry_of_rows
        ]
        for column in rows.T.tolist()
    ]
    for line, entries in zip(product, matrix.tolist(), strict=True):
        nonzero_entries = {
            row: entry for row, entry in enumerate(entries) if not isinstance(entry, int) or entry
        }
        for index, column in enumerate(columns):
            line[index] = sum(
                (
                    entry_of_rows * nonzero_entries[row]
                    for row, entry_of_rows in column
                    if row in nonzero_entries
                ),
                0,
            )
    return product


def flint_matrix(block: Balls) -> Any:
    """Return an array (n, m) of balls as a matrix of python-flint."""
    height, width = block.shape
    return flint.arb_mat(height, width, block.ravel().tolist())


def _exact(value: NDArray[Any]) -> Balls:
    """Return exact numbers as balls; 0 and 1 as integers, balls unchanged."""
    if value.dtype != np.float64:
        return value.astype(object)
    values = np.empty(value.size, dtype=object)
    values[:] = [int(item) if item in (0.0, 1.0) else flint.arb(item) for item in value.ravel().tolist()]
    return values.reshape(value.shape)


def _solve(matrix: Balls, right: Balls) -> Balls | None:
    """Return X of M X = R in balls, None for a singular M."""
    try:
        values = np.array(flint_matrix(matrix).solve(flint_matrix(right)).entries(), dtype=object)
    except ZeroDivisionError:
        return None
    return values.reshape(right.shape)


BALLS = Arithmetic(
    _multiply, np.add, np.subtract, _exact, _solve, bounded=np.vectorize(flint.arb, otypes=[object])
)


def reduced_balls(
    matrix: Balls, vectors: Sequence[Sequence[Fraction]], eliminated: NDArray[np.intp]
) -> Balls:
    """Return the matrix in relative coordinates, without rigid modes (see `relative_coordinates`), W exact.

    Parameters
    ----------
    matrix
        The closed matrix (n, n).
    vectors
        V: the rigid modes, exact, each (n,).
    eliminated
        The indices p of eliminated coordinates, one for each rigid mode.
    """
    remaining = np.delete(np.arange(len(matrix)), eliminated)
    count = len(eliminated)

    def rows(indices: NDArray[np.intp]) -> Any:
        """Return the entries of the rigid modes at some indices, as an exact matrix."""
        entries = [flint.fmpq(v[index].numerator, v[index].denominator) for index in indices for v in vectors]
        return flint.fmpq_mat(len(indices), count, entries)

    quotient = rows(remaining) * rows(eliminated).inv()
    weights: Balls = np.empty(len(remaining) * count, dtype=object)
    weights[:] = [rational_ball(Fraction(int(e.p), int(e.q))) for e in quotient.entries()]
    weights = weights.reshape(len(remaining), count)
    return relative(matrix, Relative(eliminated, remaining, weights, np.zeros(weights.shape)), BALLS)
