"""All crossings of the stability boundary along one parameter or delay, each proved where it can be.

Takes: a `CompiledSystem` and what varies in it.
Gives: `Crossing`, `Search`, `search`, `search_delay`, `delay_reach`; `Line`, `courses_of`, `reach`, `spread`,
`proved_crossing` to search along a line through several parameters.
Guarantees: every crossing has a bound on its error, proved by ball arithmetic wherever the equations can be
had exactly, and said to be an estimate where not.
Does not: choose which crossing matters (see `critical`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, Prepared, analyze, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import Place
from apc.compiler.words import counted
from apc.eigen.closing import ClosedSystem, Loop, close_loop
from apc.eigen.dominant import all_within
from apc.eigen.eigenpairs import eigenvalues
from apc.eigen.modes import arrange, split
from apc.eigen.peer_group import PeerGroup
from apc.eigen.pseudospectrum import balance
from apc.eigen.relative import relative_bounded, relative_coordinates
from apc.eigen.rigid import RigidModes, find_rigid_modes, rigid_modes_here
from apc.eigen.spectrum import DRIFTS, solve_spectrum
from apc.frame.exchange import Exchange
from apc.frame.names import Free, parameter_of
from apc.vary.batch import BatchEvaluator, lifted_here
from apc.vary.bends import bends
from apc.vary.bracket import Bracket, ExactLoop, bracket, bracket_in_floats
from apc.vary.crossings import Course, Courses, Root, Scan, scan
from apc.vary.delays import (
    INSIDE,
    Piece,
    borders,
    delay_now,
    delay_pieces,
    pace,
    system_with_delay,
)
from apc.vary.evaluator import PointEvaluator, evaluator_of_many, long_loops, mostly_packets
from apc.vary.lags import LateStretch, late_stretches
from apc.vary.marginal import marginal_motion, with_rigid

if TYPE_CHECKING:  # only scenes with long delays load it
    from apc.vary.loops import LoopEvaluator

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Is told, in words, how far a search is.
Told = Callable[[str], None]

# Without limits given, values from SPAN times smaller to SPAN times larger than the scale are scanned: the
# present value or, where that is 0, the change that would move an eigenvalue by 1 if it went on as it starts.
SPAN = 1e3
# The kind of a crossing between two numbers of peers.
COUNT = "count"

# Samples in each factor of 10 to begin with: neighbours differ by half.
SAMPLES = 6

# How far the float search of a system without exact equations is trusted, relative to the value: the
# rounding of an eigenvalue, UNIT times some hundreds, over how fast it moves.
FLOAT_ROUNDINGS = 1e-12

# Without a limit given, a delay is scanned over so many pieces at least, each from one coincidence of events
# to the next, and up to so many times its present value.
PIECES, FURTHER = 64, 2

# Samples in a piece of a delay to begin with.
PIECE_SAMPLES = 3

# How far inside a piece, relative to its length, its matrices are those of its end, but for the order of
# events that coincide there.
BESIDE = Fraction(1, 10**6)

# What is said of a crossing that no bound holds, of one between two pieces that events part, and of one in
# pieces that were left open.
ESTIMATE = "estimated in floats"
EVENTS = "events coincide there"
BETWEEN = "analysed on either side; the verdict between them is left open"

_PLACE = Place("critical value")


@dataclass(frozen=True, slots=True)
class Crossing:
    """A value at which the spectral radius crosses 1, right to `error`, both in SI.

    `stable_side` is "below" or "above"; `frequency_hz` is that of the motion that neither grows nor dies out
    there; `kind` is "crossing", or "jump" where a packet comes a tick later or events change places, or
    "count" where it is the number of peers on the stable side of a change from one number to the next;
    `proof` says how the value is known.
    """

    value: float
    error: float
    stable_side: str
    frequency_hz: float
    kind: str
    proof: str

    @property
    def boundary(self) -> float:
        """Where the verdict changes: of a number of peers, between it and the next."""
        if self.kind != COUNT:
            return self.value
        return self.value + (0.5 if self.stable_side == "below" else -0.5)


@dataclass(frozen=True, slots=True)
class Search:
    """All crossings of one parameter in an interval, with what lies between them.

    `edges` are the crossings in order, and `stable` says of each stretch, one more than there are crossings,
    whether it is stable; it is empty when no sample told. `known` says whether the equations are enclosed
    between the `looked` values that were looked at, `enters` whether any matrix was seen to change along the
    way. Where a delay moves packets only, `stretches` is in how many stretches nothing depends on it; what
    grows in each was counted in floats, and those beside a change, or that the count left open, were
    analysed. `left_open` are the parts of a delay's range that no analysis decides. `sided` says whether each
    value that the search began with, but the least, lies on a side: on none lies what frees a motion.
    """

    edges: tuple[Crossing, ...]
    stable: tuple[bool, ...]
    scanned: tuple[float, float]
    whole: bool
    known: bool
    looked: int
    enters: bool
    stretches: int = 0
    left_open: tuple[tuple[float, float], ...] = ()
    sided: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """The points at which one of an evaluator's free parameters varies and the others stay at `base` (m,)."""

    family: BatchEvaluator | PointEvaluator | LoopEvaluator
    base: Floats
    column: int

    def points(self, values: Floats) -> Floats:
        """Return the points (k, m) of values (k,)."""
        found = np.repeat(self.base[None], len(values), axis=0)
        found[:, self.column] = values
        return found

    def course(self, values: Floats) -> Sequence[tuple[Floats, Floats]]:
        """Return each system's matrices and their derivatives at values (k,), of loops without delays."""
        along = np.zeros((len(values), len(self.base)))
        along[:, self.column] = 1.0
        return self.family.slopes(self.points(values), along)

    def scan(self, course: Course, points: Floats, least: float) -> Scan:
        """Find the crossings between the first and the last of some points, see `crossings.scan`.

        `course` gives the matrices; of loops with long delays it is only asked whether these change.
        """
        if isinstance(self.family, BatchEvaluator | PointEvaluator):
            return scan(course, points, least=least)
        course(points)
        return self.family.scan(points, least, self.base, self.column)

    def samples(self, bottom: float, top: float, scale: float) -> tuple[Floats, bool]:
        """Return values from bottom to top to begin a scan with, and whether the equations between are known.

        As `spread`, and as many more as the equations' coefficients ask for, see `bends`.
        """
        return self.with_bends(spread(bottom, top, scale), scale / SPAN)

    def with_bends(self, points: Floats, least: float) -> tuple[Floats, bool]:
        """Return points with those that the equations' coefficients ask for, and whether these are known."""
        family = self.family
        if isinstance(family, PointEvaluator):
            return points, False
        maps = family if isinstance(family, BatchEvaluator) else family.family
        found = bends(maps, tuple(self.base.tolist()), self.column)
        return (points, False) if found is None else found.between(points, least)

    def scale(self) -> float:
        """Return the present value or, where it is 0, the change that would move some eigenvalue by 1."""
        present = abs(float(self.base[self.column]))
        return present or reach(self.course(np.zeros(1)))


def reach(pairs: Sequence[tuple[Floats, Floats]]) -> float:
    """Return the change that would move some eigenvalue by 1, of the matrices and derivatives at a point."""
    rates = [np.abs(eigenvalues(*pair)[1]) for pair in pairs if pair[0].size]
    fastest = max((float(one.max(initial=0.0)) for one in rates), default=0.0)
    return 1 / fastest if fastest > 0 else 1.0


def courses_of(lines: Sequence[Line]) -> Courses:
    """Return the matrices and their derivatives on several lines of one evaluator, all in one call."""
    base, columns = np.array([one.base for one in lines]), np.array([one.column for one in lines])

    def courses(which: Integers, values: Floats) -> Sequence[tuple[Floats, Floats]]:
        points, along = base[which], np.zeros((len(values), base.shape[1]))
        rows = np.arange(len(values))
        points[rows, columns[which]] = values
        along[rows, columns[which]] = 1.0
        return lines[0].family.slopes(points, along)

    return courses


def search(
    system: CompiledSystem,
    free: Free,
    low: float | None,
    high: float | None,
    prepared: Prepared,
    *,
    told: Told | None = None,
) -> Search:
    """Find the crossings of a parameter that reaches no time.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The parameter.
    low, high
        Between which values, None for those of `critical`.
    prepared
        From `analysis.prepare`.
    told
        Is told how far the search is.
    """
    parameter = parameter_of(system, free)
    family = long_loops(system, [free], prepared) or evaluator_of_many(
        system, [free], _PLACE, prepared=prepared
    )
    line = Line(family, np.array([parameter.value]), 0)
    scale = line.scale()
    bottom = low
    if bottom is None:
        bottom = parameter.minimum
    if bottom is None:
        bottom = -SPAN * scale if parameter.value < 0 else 0.0
    top = high if high is not None else max(SPAN * scale, bottom + scale)
    if parameter.maximum is not None:
        top = min(top, parameter.maximum)
    looked, enters = 0, False
    present = line.course(line.base[[line.column]])

    def course(values: Floats) -> Sequence[tuple[Floats, Floats]]:
        nonlocal looked, enters
        looked += len(values)
        if told:
            told(f"looking at {counted(looked, 'value')} of {free.label}")
        pairs = line.course(values)
        enters = enters or any(
            bool(slope.any()) or len(one[0]) != len(matrix[0]) or not np.all(matrix == one)
            for (matrix, slope), (one, _) in zip(pairs, present, strict=True)
        )
        return pairs

    points, known = line.samples(bottom, top, scale)
    found = line.scan(course, points, scale / SPAN)
    edges = []
    for number, root in enumerate(found.roots):
        if told:
            told(f"proving crossing {number + 1} of {len(found.roots)}")
        crossing = proved_crossing(root, line, found)
        edges += [crossing] if crossing else []
    lost = {*points[1:-1].tolist()} - {*found.points.tolist()}
    sided = all(abs(value) <= scale / SPAN for value in lost)
    return _search(edges, found, (bottom, top), known=known, enters=enters, sided=sided)


def spread(bottom: float, top: float, scale: float) -> Floats:
    """Return values from bottom to top, in even ratios on either side of 0."""

    def ratios(low: float, high: float) -> Floats:
        least = max(low, min(scale, high) / SPAN)
        count = max(2, int(np.ceil(SAMPLES * np.log10(high / least))) + 1) if high > least else 1
        return np.geomspace(least, high, count)

    parts = [np.array([bottom])]
    if bottom < 0:
        parts.append(-ratios(max(-top, 0.0), -bottom)[::-1])
    if bottom < 0 < top:
        parts.append(np.zeros(1))
    if top > 0:
        parts.append(ratios(max(bottom, 0.0), top))
    found = np.sort(np.concatenate([*parts, [top]]))
    return np.asarray(found[np.append(True, np.diff(found) > 0)])


def _search(
    edges: Sequence[Crossing],
    found: Scan,
    asked: tuple[float, float],
    *,
    known: bool,
    enters: bool,
    sided: bool = True,
) -> Search:
    """Put the crossings together with the stretches between them."""
    points = found.points
    if not len(points):
        return Search((), (), asked, whole=False, known=known, looked=0, enters=enters, sided=sided)
    ends = [-np.inf, *(one.value for one in edges), np.inf]
    stable = tuple(
        bool(found.stable[(points > low) & (points < high)][0]) for low, high in itertools.pairwise(ends)
    )
    scanned = (float(points[0]), float(points[-1]))
    return Search(tuple(edges), stable, scanned, found.whole, known, len(points), enters, sided=sided)


def proved_crossing(root: Root, line: Line, found: Scan, *, in_balls: bool = True) -> Crossing | None:
    """Prove a crossing, if it can be proved, and describe it; None where both sides are proved alike.

    Parameters
    ----------
    root, line, found
        The crossing, the line it is on, and the scan that found it.
    in_balls
        Whether balls are worth their time; else bounds of floats are.
    """
    beside = low, high = _beside(root, found)
    if not root.slope:  # a defective cluster: its samples are scattered as well
        low, high = root.value - abs(root.value) / 2, root.value + abs(root.value) / 2
    family = line.family

    def point(value: float) -> list[float]:
        listed: list[float] = line.points(np.array([value]))[0].tolist()
        return listed

    if not isinstance(family, BatchEvaluator | PointEvaluator):
        return _told(root, *family.proved(root, point, low=low, high=high))
    if not isinstance(family, BatchEvaluator):

        def all_of_them(value: float) -> tuple[ClosedSystem, ...]:
            return family.closed_at(point(value))

        held = bracket_in_floats(root, all_of_them, low=low, high=high)
        if held is None and _alike(*(all_of_them(one) for one in beside)):
            return None
        return _described(root, held, list(with_rigid(all_of_them(root.value))))

    wiring = family.wirings[root.system]

    @functools.cache
    def loop(value: float) -> tuple[ClosedSystem, RigidModes]:
        (one,) = family.with_sites([wiring.system], point(value))
        return one, find_rigid_modes(one, with_drifts=False) if wiring.moving else wiring.rigid

    def at(value: float) -> ClosedSystem:
        return close_loop(lifted_here([loop(value)[0]])[0])

    return _bracketed(
        *(root, found, (low, high), loop, at, lambda value: family.closed_at(point(value))), in_balls=in_balls
    )


def _bracketed(
    root: Root,
    found: Scan,
    ends: tuple[float, float],
    loop: ExactLoop,
    at: Callable[[float], ClosedSystem],
    every: Callable[[float], Sequence[ClosedSystem]],
    *,
    in_balls: bool,
) -> Crossing | None:
    """Prove a crossing between two ends by balls or, where these don't tell, by the bounds of floats.

    `loop` gives what crosses at a value for balls, `at` as an analysis has it, and `every` all systems.
    """
    low, high = ends
    held = bracket(root, loop, low=low, high=high) if in_balls else None
    if held is None:
        held = bracket_in_floats(root, lambda value: [at(value)], low=low, high=high, in_balls=in_balls)
    if held is None and _alike(*map(every, _beside(root, found))):
        return None
    return _described(root, held, [(at(root.value), loop(root.value)[1])])


def _beside(root: Root, found: Scan) -> tuple[float, float]:
    """Return the samples on either side of a root."""
    place = int(np.searchsorted(found.points, root.value))
    return float(found.points[max(place - 1, 0)]), float(found.points[min(place, len(found.points) - 1)])


def _alike(one: Sequence[ClosedSystem], other: Sequence[ClosedSystem]) -> bool:
    """Say whether the analyses on both sides of a root have one verdict: floats alone took it for one."""
    sides = [solve_spectrum(systems).stable for systems in (one, other)]
    return sides[0] is not None and sides[0] == sides[1]


def _described(
    root: Root, held: Bracket | None, systems: Sequence[tuple[ClosedSystem, RigidModes]]
) -> Crossing:
    """Return the crossing of a root, and how fast it swings."""
    return _told(root, held, marginal_motion(systems, root.eigenvalue).frequency_hz)


def _told(root: Root, held: Bracket | None, frequency_hz: float) -> Crossing:
    """Return the crossing of a root; if no bracket holds it, with the error that floats are trusted with."""
    if held is None:
        error = FLOAT_ROUNDINGS / abs(root.slope) if root.slope else root.high - root.low
        held = Bracket(root.value, max(error, abs(root.value) * FLOAT_ROUNDINGS), ESTIMATE)
    return Crossing(
        value=held.value,
        error=held.error,
        stable_side="below" if root.rising else "above",
        frequency_hz=frequency_hz,
        kind="crossing",
        proof=held.proof,
    )


def search_delay(
    system: CompiledSystem,
    free: Free,
    low: Fraction,
    high: Fraction | None,
    prepared: Prepared,
    *,
    from_stable: bool = False,
    in_balls: bool = True,
    told: Told | None = None,
) -> Search:
    """Find the crossings of a delay: within pieces as of any parameter, and jumps between them.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The timing, or a parameter that reaches timings.
    low, high
        From which value to which; without `high` as far as `delay_reach` says.
    prepared
        From `analysis.prepare`.
    from_stable
        The scene is stable at `low`: where nothing above it is, that is a jump. The first crossing is enough.
    in_balls
        As for `proved_crossing`.
    told
        Is told how far the search is.

    Notes
    -----
    Where events coincide, their order makes the value one with the piece before it or with the one after.
    """
    end = high or delay_reach(system, free, low, pieces=PIECES, further=FURTHER)[0]
    edges: list[Crossing] = []
    stable = [True] if from_stable else []
    left_open: list[tuple[float, float]] = []
    before: Piece | None = None
    at, whole, known, looked = low, True, True, 0
    tell = pace(system, free, low, end, place=_PLACE, told=told)
    late = late_stretches(system, free, low, end, prepared, borders(system, free, place=_PLACE))
    if late is None:
        pieces = delay_pieces(system, free, low, prepared, place=_PLACE, high=end)
    else:
        pieces = (Piece(one.low, one.high, None, _inside(system, free, one)) for one in late)
    counted = _counted(late or ())
    if not from_stable:  # where events coincide at `low`, its verdict is not that of the delays above it
        before = Piece(low, low, None, system_with_delay(system, free, low))
        begins = analyze(before.inside, prepared=prepared)
        stable = [] if begins.stable is None or begins.verdict == DRIFTS else [begins.stable]
    for piece in pieces:
        at = min(piece.high, end)
        tell(at)
        found, enclosed = _piece_scan(
            piece, float(piece.low), float(at), prepared, counted=counted.get(piece.low)
        )
        whole, known, looked = whole and found.whole, known and enclosed, looked + len(found.points)
        if not len(found.points):
            left_open += [] if found.whole else [(float(piece.low), float(at))]
            continue
        first = bool(found.stable[0])
        if stable and stable[-1] != first:
            start = before.high if before else low
            edge = _jump(system, free, before, start, piece, prepared, stable_below=stable[-1])
            whole &= edge.proof != ESTIMATE
            edges.append(edge)
        if not stable or stable[-1] != first:
            stable.append(first)
        for root in found.roots:
            crossing = _delay_crossing(system, free, root, found, prepared, piece, in_balls=in_balls)
            if crossing:
                edges.append(crossing)
                stable.append(not stable[-1])
        before = piece
        if from_stable and edges:
            break
    scanned = float(low), float(at)
    stretches, parts = len(late or ()), tuple(left_open)
    return Search(tuple(edges), tuple(stable), scanned, whole, known, looked, True, stretches, parts)


def _inside(system: CompiledSystem, free: Free, stretch: LateStretch) -> CompiledSystem:
    """Return the scene at a delay within a stretch."""
    return system_with_delay(system, free, stretch.low + INSIDE * (stretch.high - stretch.low))


def _counted(late: Sequence[LateStretch]) -> dict[Fraction, bool]:
    """Return which stretches are stable, by their low ends, where a count in floats may say so.

    Those that it left open and those beside a change are not among them: an analysis judges them.
    """
    sides = [one.stable for one in late]
    return {
        one.low: one.stable
        for place, one in enumerate(late)
        if one.stable is not None and set(sides[max(place - 1, 0) : place + 2]) == {one.stable}
    }


def delay_reach(
    system: CompiledSystem, free: Free, low: Fraction, *, pieces: int, further: float
) -> tuple[Fraction, int]:
    """Return how far a delay is looked at where nobody says, and over how many pieces that is.

    Parameters
    ----------
    system, free
        The compiled scene, and what varies.
    low
        From which value.
    pieces, further
        Over so many pieces at least, and up to so many times the present value.
    """
    following = borders(system, free, place=_PLACE)
    most = Fraction(further) * delay_now(system, free)
    at, count = low, 0
    while count < pieces or at < most:
        at, count = following(at), count + 1
    return at, count


def _piece_scan(
    piece: Piece, low: float, high: float, prepared: Prepared, *, counted: bool | None = None
) -> tuple[Scan, bool]:
    """Scan one piece, its ends as limits from within; say whether the equations are known all over it.

    Where nothing depends on the delay within it, `counted` says whether it is stable, None if nobody did yet.
    """
    family = piece.evaluator
    if counted is not None:
        return Scan(np.array([low]), np.array([counted]), (), whole=True), True
    if family is None:
        if _settles(piece.inside, prepared):
            return Scan(np.array([low]), np.array([True]), (), whole=True), True
        found = analyze(piece.inside, prepared=prepared)
        if found.stable is None or found.verdict == DRIFTS:
            return Scan(np.empty(0), np.empty(0, dtype=bool), (), whole=found.verdict == DRIFTS), True
        return Scan(np.array([low]), np.array([found.spectral_radius < 1]), (), whole=True), True

    def course(points: Floats) -> Sequence[tuple[Floats, Floats]]:
        return family.slopes(points[:, None], np.ones((len(points), 1)))

    points, known = np.linspace(low, high, PIECE_SAMPLES), True
    if family.tangents:
        points, known = Line(family, np.array([low]), 0).with_bends(points, high - low)
    return scan(course, points, least=high - low), known


def _settles(system: CompiledSystem, prepared: Prepared) -> bool:
    """Say whether a scene is proved stable: by bounds of all eigenvalues at once, else by an analysis."""
    for one in split(*lifted_groups(system, prepared=prepared)).systems:
        at = relative_coordinates(rigid_modes_here(one).basis)
        matrix, error = relative_bounded(one.matrix, one.error, at)
        scale = balance(np.abs(matrix) + error)
        alike = scale / scale[:, None]
        if not all_within((matrix * alike)[None], (error * alike)[None], np.ones(1))[0]:
            return bool(analyze(system, prepared=prepared).stable)
    return True


def _jump(
    system: CompiledSystem,
    free: Free,
    before: Piece | None,
    start: Fraction,
    after: Piece,
    prepared: Prepared,
    *,
    stable_below: bool,
) -> Crossing:
    """Describe a change of side between two pieces, exactly where analyses just inside both hold it there.

    `start` is where the piece before ends; where pieces from there on were left open, the change lies
    anywhere in these. Without a piece `before`, the scene is known to be stable at `start`.
    """

    def analysis_at(value: Fraction) -> Analysis:
        return analyze(system_with_delay(system, free, value), prepared=prepared)

    value, error = (start + after.low) / 2, (after.low - start) / 2
    proof = EVENTS if not error else BETWEEN
    above = analysis_at(after.low + BESIDE * (after.high - after.low))
    below = above if before is None else analysis_at(start - BESIDE * (start - before.low))
    held = above.stable is (not stable_below) and (before is None or below.stable is stable_below)
    if not held:
        error, proof = max(error, after.high - after.low), ESTIMATE
    grows = above if stable_below or before is None else below
    return Crossing(
        value=float(value),
        error=float(error),
        stable_side="below" if stable_below else "above",
        frequency_hz=grows.modes[0].frequency_hz if grows.modes else float("nan"),
        kind="jump",
        proof=proof,
    )


def _delay_crossing(
    system: CompiledSystem,
    free: Free,
    root: Root,
    found: Scan,
    prepared: Prepared,
    piece: Piece,
    *,
    in_balls: bool,
) -> Crossing | None:
    """Prove a crossing within a piece, whose systems are built anew for every value, as `proved_crossing`."""

    assert piece.evaluator is not None, "nothing crosses where nothing depends on the delay"
    wiring = piece.evaluator.wirings[root.system]

    @functools.cache
    def here(value: float) -> tuple[tuple[PeerGroup, ...], Exchange]:
        return lifted_groups(system_with_delay(system, free, Fraction(value)), prepared=prepared)

    @functools.cache
    def loop(value: float) -> tuple[Loop, RigidModes]:
        one = arrange(*here(value)).loops[root.system]
        if wiring.moving or one.names != wiring.system.names:  # as at the end of a piece
            return one, find_rigid_modes(one, with_drifts=False)
        return one, wiring.rigid

    ends = float(piece.low), float(piece.high)
    here_loop, rigid = loop(root.value)
    if mostly_packets(here_loop):
        from apc.vary.loops import proved_in_loop  # few scenes have packets so late

        count = rigid.directions.shape[1]
        return _told(root, *proved_in_loop(root, lambda v: loop(v)[0], count, low=ends[0], high=ends[1]))
    return _bracketed(
        *(root, found, ends, loop),
        lambda value: close_loop(loop(value)[0]),
        lambda value: split(*here(value)).systems,
        in_balls=in_balls,
    )
