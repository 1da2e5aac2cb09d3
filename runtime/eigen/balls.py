"""The frame of a closed system in ball arithmetic: every entry an interval that holds the true number.

Takes: a `ClosedLoop`; its sites' matrices as exact rationals.
Gives: `precision`, `unprovable`, `rational_ball`, `site_balls`, `frame_steps`, `closed_frame`, `frame_balls`,
`reduced_balls`, `square`; `weight_balls`.
Guarantees: the true matrix, of the numbers the sites hold, lies in the balls, whatever the number of bits;
more bits make them smaller.
Does not: decide anything (see `certify`).

The frame is followed event by event over the state of the closed system itself (`lift.follow`), all sites
side by side, so that a frame of a thousand ticks needs no more columns than there are states.
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

from apc.eigen.closing import ClosedLoop, DelayedSample, ModalSystem
from apc.eigen.graph_modes import Surd
from apc.eigen.relative import Relative, relative
from apc.frame.discretize import step_balls
from apc.frame.exact import is_rational
from apc.frame.lift import follow
from apc.frame.radius import Arithmetic
from apc.frame.schedule import CouplingTerm, Propagate, Schedule
from apc.frame.site import LinearSubsystem, entrywise

Balls = NDArray[Any]  # of flint.arb, and the integers 0 and 1 where these are exact

# [F G] by duration in quanta, for one site.
Steps = Mapping[int, Balls]

# Whom each site hears with what weight, way by way and site by site.
Weights = Mapping[CouplingTerm, Sequence[Sequence[tuple[int, Any]]]]


@contextmanager
def precision(bits: int) -> Iterator[None]:
    """Set python-flint's working precision for a while."""
    before, flint.ctx.prec = flint.ctx.prec, bits
    try:
        yield
    finally:
        flint.ctx.prec = before


def unprovable(system: ClosedLoop | ModalSystem) -> str:
    """Return why a system's coefficients can't be had exactly, or "" when they can."""
    if not system.sites:
        return "its matrix was not composed from sites"
    for group in {id(group.jacobians): group for group in system.sites}.values():
        functions = [group.jacobians.function, *(edge.function for edge in group.jacobians.edges.values())]
        if not all(function.is_a("SXFunction") for function in functions):
            return f"the equations of {group.name} hold a nonlinear loop, whose solution is rounded"
        if not all(is_rational(function) for function in functions):
            return f"the equations of {group.name} hold functions whose values are rounded"
    return ""


def rational_ball(value: Fraction | int) -> Any:
    """Return a rational as a ball at the present precision; 0 and 1 stay what they are."""
    if value == 0 or value == 1:
        return int(value)
    exact = Fraction(value)
    return flint.arb(flint.fmpq(exact.numerator, exact.denominator))


def site_balls(system: ClosedLoop | ModalSystem) -> list[LinearSubsystem]:
    """Return the sites' matrices as balls at the present precision; equal sites are worked out once."""
    known: dict[int, LinearSubsystem] = {}
    linear_sites = []
    for group in system.sites:
        if id(group.site) not in known:
            known[id(group.site)] = entrywise(group.exact, rational_ball)
        linear_sites.append(known[id(group.site)])
    return linear_sites


def frame_steps(
    site: LinearSubsystem,
    schedule: Schedule,
    step: Callable[[Balls, Balls, Fraction], Balls] = step_balls,
) -> Steps:
    """Return a site's exponentials by duration, at the present precision."""
    durations = {event.duration for event in schedule.events if isinstance(event, Propagate)}
    return {duration: step(site.a, site.b, duration * schedule.quantum) for duration in sorted(durations)}


def frame_balls(system: ClosedLoop | ModalSystem) -> Balls:
    """Return the closed matrix (n, n) of a system as balls at the present precision."""
    sites = site_balls(system)
    known: dict[tuple[int, int], Steps] = {}
    steps = []
    for site, group in zip(sites, system.sites, strict=True):
        key = (id(site), id(group.schedule))
        if key not in known:
            known[key] = frame_steps(site, group.schedule)
        steps.append(known[key])
    return closed_frame(system, sites, steps)


def closed_frame(
    system: ClosedLoop | ModalSystem,
    sites: Sequence[LinearSubsystem],
    steps: Sequence[Steps],
    *,
    weights: Weights | None = None,
    state: Balls | None = None,
    watch: Callable[[int, int, Balls, Any], None] | None = None,
) -> Balls:
    """Follow all sites of a closed system through one frame, over its state.

    Parameters
    ----------
    system
        The closed system: who hears whom.
    sites, steps
        Every site's matrices and exponentials, over numbers that can be added and multiplied with each other,
        with integers and with the weights.
    weights
        Whom each site hears with what weight; without it, those of `weight_balls`.
    state
        The states (n, columns) at the start of the frame; without it, the unit matrix.
    watch
        Is shown each site's steps before they are made, its number first (see `lift.follow`).

    Returns
    -------
    The states at its end (n, columns), without `state` the closed matrix (n, n).
    """
    layout = system.layout
    n = len(layout.names)
    start = np.eye(n, dtype=np.int64).astype(object) if state is None else state
    place_of = layout.places
    rows_of = [{sent: row for row, sent in enumerate(group.schedule.sent)} for group in system.sites]
    weights = weight_balls(system) if weights is None else weights
    sent: dict[tuple[int, int], Balls] = {}

    def hearing(g: int) -> Callable[[int], Balls | None]:
        def hear(line: int) -> Balls | None:
            heard = system.sites[g].schedule.heard[line]
            total = np.zeros(start.shape[1], dtype=object)
            for h, weight in weights[heard.way][g]:
                row = rows_of[h][heard.sent]
                if heard.lag:
                    total = total + start[place_of[DelayedSample(h, row, heard.lag)]] * weight
                elif (h, row) in sent:
                    total = total + sent[h, row] * weight
                else:
                    return None
            return total

        return hear

    matrix = np.zeros(start.shape, dtype=object)
    courses = {
        g: follow(
            *(site, group.schedule, step, start[offset : offset + len(group.z_names)], hearing(g)),
            numbers=BALLS,
            watch=watch and functools.partial(watch, g),
        )
        for g, (group, site, step, offset) in enumerate(
            zip(system.sites, sites, steps, layout.offsets, strict=True)
        )
    }
    while courses:
        pair = len(courses), len(sent)
        for g, course in tuple(courses.items()):
            try:
                # On until it has to wait, so that everybody is sooner or later heard.
                while (spoken := next(course))[0] >= 0:
                    sent[g, spoken[0]] = spoken[1]
            except StopIteration as end_of_frame:
                moved = end_of_frame.value
                matrix[layout.offsets[g] : layout.offsets[g] + len(moved)] = moved
                del courses[g]
        assert (len(courses), len(sent)) != pair, "a packet is heard before it is sent"
    for packet, place in place_of.items():
        older = DelayedSample(packet.site, packet.row, packet.lag - 1)
        matrix[place] = sent[packet.site, packet.row] if packet.lag == 1 else start[place_of[older]]
    return matrix


def weight_balls(system: ClosedLoop | ModalSystem) -> Weights:
    """Return, way by way and site by site, whom it hears with what weight, the doubts included."""
    result = {}
    for way, rows in system.coupling.items():
        if way in system.surds:
            result[way] = [[(0, _surd_ball(system.surds[way]))]]
            continue
        doubt = system.doubts.get(way, 0.0)
        spread = flint.arb(0, doubt) if doubt else 0
        result[way] = [
            [(h, rational_ball(weight) + spread) for h, weight in enumerate(row) if weight or doubt]
            for row in rows
        ]
    return result


def _surd_ball(surd: Surd) -> Any:
    """Return a number in closed form as a ball at the present precision."""
    cosine = flint.arb.cos_pi_fmpq(flint.fmpq(2 * surd.turn.numerator, surd.turn.denominator))
    return rational_ball(surd.scale) * cosine * flint.arb(surd.square).sqrt()


def _multiply(matrix: Balls, rows: Balls) -> Balls:
    """Return the product with a matrix that is mostly zeros, as rows may be; an exact zero is the integer."""
    product = np.zeros((len(matrix), rows.shape[1]), dtype=object)
    columns = [
        [(row, other) for row, other in enumerate(column) if not isinstance(other, int) or other]
        for column in rows.T.tolist()
    ]
    for line, entries in zip(product, matrix.tolist(), strict=True):
        used = {row: entry for row, entry in enumerate(entries) if not isinstance(entry, int) or entry}
        for place, column in enumerate(columns):
            line[place] = sum((other * used[row] for row, other in column if row in used), 0)
    return product


def square(block: Balls) -> Any:
    """Return an array (n, m) of balls as a matrix of python-flint."""
    height, width = block.shape
    return flint.arb_mat(height, width, block.ravel().tolist())


def _exact(value: NDArray[Any]) -> Balls:
    """Return exact numbers as balls; 0 and 1 as the integers, what is written in balls as it is."""
    if value.dtype != np.float64:
        return value.astype(object)
    values = np.empty(value.size, dtype=object)
    values[:] = [int(item) if item in (0.0, 1.0) else flint.arb(item) for item in value.ravel().tolist()]
    return values.reshape(value.shape)


def _solve(matrix: Balls, right: Balls) -> Balls | None:
    try:
        values = np.array(square(matrix).solve(square(right)).entries(), dtype=object)
    except ZeroDivisionError:
        return None
    return values.reshape(right.shape)


BALLS = Arithmetic(
    _multiply, np.add, np.subtract, _exact, _solve, bounded=np.vectorize(flint.arb, otypes=[object])
)


def reduced_balls(matrix: Balls, vectors: Sequence[Sequence[Fraction]], held: NDArray[np.intp]) -> Balls:
    """Return the matrix without its rigid motions, in relative coordinates (see `relative`), W exact.

    Parameters
    ----------
    matrix
        The closed matrix (n, n).
    vectors
        V: the rigid motions, exact, each (n,).
    held
        The places p, as many as there are motions, whose coordinates go.
    """
    rest = np.delete(np.arange(len(matrix)), held)
    count = len(held)

    def rows(places: NDArray[np.intp]) -> Any:
        entries = [flint.fmpq(v[place].numerator, v[place].denominator) for place in places for v in vectors]
        return flint.fmpq_mat(len(places), count, entries)

    quotient = rows(rest) * rows(held).inv()
    weights: Balls = np.empty(len(rest) * count, dtype=object)
    weights[:] = [rational_ball(Fraction(int(e.p), int(e.q))) for e in quotient.entries()]
    weights = weights.reshape(len(rest), count)
    return relative(matrix, Relative(held, rest, weights, np.zeros(weights.shape)), BALLS)
