"""Whether a scene is stable for every delay of its links in a range: all of them at once.

Takes: a `CompiledSystem` and a parameter or timing that reaches nothing but how late packets are.
Gives: `LateStretch`, `late_stretches`; `Response`, `response_of`.
Guarantees: stretches join on without a gap; within one, nothing depends on the delay.
Does not: vary what is held late, or what a force depends on (see `delays`); prove what it says of a stretch,
a count in floats as in `plane`.

A site's frame doesn't know which packet each of its ticks hears: with a row of r for each tick, one lifting
serves for all delays. What they tell is which packet stands in which row, how many frames of age (ζ to the
minus that); packets a whole frame later are the same ones, a frame older.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.multiples import common_divisor
from apc.eigen.bordered import TOGETHER, Bordered, Logarithm, bordered, logarithm, side_by_side
from apc.eigen.closing import Loop, without_packets
from apc.eigen.modes import arrange
from apc.eigen.rigid import find_rigid_modes
from apc.frame.ages import aged
from apc.frame.hyperperiod import ClockGrid, Times
from apc.frame.names import Free
from apc.frame.parameters import resolve
from apc.frame.schedule import Schedule, Selected, tick_by_tick
from apc.frame.scheduling import build_schedules, newest
from apc.vary.delays import INSIDE, reaches_parameters, system_with_delay, timing_slopes
from apc.vary.encirclements import count_beyond
from apc.vary.evaluator import Asked

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]

# What a row of r hears at one delay: the slot it was sent at, and how many frames ago.
_Packet = tuple[int, int]

# Delays that are looked at together: the oldest packet of any at most so many times as old as that of each.
OCTAVE = 2

# What a determinant is at least, relative to its largest value at other ages, to be taken from the polynomial
# of these: half its digits are right then.
CLEAR = 1e-8

# The matrix of so many states is taken apart once and not inverted at each point; half the digits are right
# where its vectors are no worse a basis than this.
LARGE, WORST = 64, 1e8

# Ranges of delays whose loops are kept for the next question: each may be tens of megabytes.
KEPT = 4


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A matrix taken apart: its eigenvalues (n,), their vectors, and the inverse of these."""

    values: Complexes
    right: Complexes
    inverse: Complexes


def response_of(matrix: Floats) -> Response | None:
    """Take a loop's matrix (n, n) apart, None where its vectors are no basis."""
    values, right = np.linalg.eig(matrix)
    try:
        inverse = np.linalg.inv(right)
    except np.linalg.LinAlgError:
        return None
    return Response(values.astype(np.complex128), right.astype(np.complex128), inverse.astype(np.complex128))


@dataclass(frozen=True, slots=True)
class LateStretch:
    """Delays between `low` and `high` seconds; `stable` is None where an eigenvalue is on the circle."""

    low: Fraction
    high: Fraction
    stable: bool | None


@dataclass(frozen=True, slots=True, eq=False)
class _LateSheet:
    """A loop at some delays, whose numbers are the values: a `plane.Sheet`.

    `loops` are those of all delays that are alike but for the age of packets; `alike` (k,) says which of them
    a delay's is, and `lags` (k, l) the ages there.
    """

    loops: Bordered
    apart: Response | None  # of what nobody hears, where it is large
    alike: Integers
    lags: Integers
    rigid: int
    longest: int

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""
        return self.loops.states

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return the logarithm of F at points (z,), each at the delay with the number of its row."""
        number = values.astype(np.intp)[rows]
        if self.apart is None:
            return logarithm(self.loops, self.lags[number], self.alike[number], points, self.rigid)
        parts = [self._at(number[some], points[some]) for some in self._chunks(len(points))]
        return _joined(parts, axis=0)

    def _at(self, number: Integers, points: Complexes) -> Logarithm:
        """Return `at` of a few points at delays with numbers (z,): det A det(1 + G), see `_over`."""
        value, slope, sent, turned = self._alone(points)
        for kind in np.unique(self.alike[number]):
            some = np.flatnonzero(self.alike[number] == kind)
            gains, moved = self._gains(kind, self.lags[number[some]], points[some], sent[some], turned[some])
            whole = np.eye(gains.shape[-1]) + gains
            sign, size = np.linalg.slogdet(whole)
            good = np.isfinite(size)
            whole[~good] = np.eye(gains.shape[-1])
            value[some] += np.where(good, size + 1j * np.angle(sign), np.nan)
            slope[some] += np.trace(np.linalg.solve(whole, moved), axis1=1, axis2=2)
        return Logarithm(value, slope)

    def over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return the logarithm of F (k, z) at all values (k,) and points (z,), some points after others."""
        return _joined([self._over(values, points[some]) for some in self._chunks(len(points))], axis=1)

    def _chunks(self, count: int) -> list[slice]:
        """Return so many points in parts that are looked at together."""
        wide, sent = self.loops.fixed.shape[-1], self.loops.heard.shape[-1]
        chunk = max(1, TOGETHER // (wide * (wide if self.apart is None else sent)))
        return [slice(start, start + chunk) for start in range(0, count, chunk)]

    def _alone(self, points: Complexes) -> tuple[Complexes, Complexes, Complexes, Complexes]:
        """Return log det A (z,) at points (z,), its derivative along the circle, and what is sent then.

        That is A⁻¹'s rows (z, s, n) over what is sent, and the derivatives (z, s, n_z) of its columns over z;
        of a loop that was taken apart, over its modes.
        """
        n_z, turn = self.loops.states, 1j * points
        if self.apart is None:
            matrix = np.repeat(self.loops.fixed[None].astype(np.complex128), len(points), axis=0)
            place = np.arange(n_z)
            matrix[:, place, place] += points[:, None]
            sign, size = np.linalg.slogdet(matrix)
            inverse = np.asarray(np.linalg.inv(matrix), np.complex128)
            value, slope = size + 1j * np.angle(sign), turn * inverse[:, place, place].sum(axis=1)
            sent = inverse[:, n_z:]
            turned = -turn[:, None, None] * (sent[:, :, :n_z] @ inverse[:, :n_z, :n_z])
        else:
            near = 1 / (points[:, None] - self.apart.values)
            value, slope = -np.log(near).sum(axis=1), turn * near.sum(axis=1)
            out = -self.loops.fixed[n_z:, :n_z] @ self.apart.right * near[:, None]
            unit = np.eye(out.shape[1], dtype=np.complex128)
            sent = np.concatenate([out, np.broadcast_to(unit, (len(points), *unit.shape))], axis=2)
            turned = -turn[:, None, None] * out * near[:, None]
        rigid = self.rigid * np.log(1 - 1 / points), self.rigid * 1j / (points - 1)
        return value - rigid[0], slope - rigid[1], sent, turned

    def _gains(
        self, kind: int, lags: Integers, points: Complexes, sent: Complexes, turned: Complexes
    ) -> tuple[Complexes, Complexes]:
        """Return what is sent for what is heard (z, s, s) at points, and its derivatives along the circle.

        Packets are of `lags` (l,), or those (z, l) of each point; `sent` and `turned` are from `_alone`.
        """
        n_z, back = self.loops.states, self.loops.heard[:, kind]
        if self.apart is not None:
            back = np.concatenate([self.apart.inverse @ back[:, :n_z], back[:, n_z:]], axis=1)
        power = points[:, None] ** -lags
        gain, moved = np.zeros((2, len(points), *sent.shape[1:2] * 2), np.complex128)
        for layer, one in enumerate(back):
            by, late = power[:, layer, None, None], (-1j * lags * power)[:, layer, None, None]
            once = sent @ one
            gain += by * once
            moved += by * (turned @ one[:n_z]) + late * once
        return gain, moved

    def _over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return `over` of a few points.

        Notes
        -----
        M = A + Σ_l ζ^(−m−l) [0 B_l], m the age of the youngest packets and A the matrix while nobody hears
        anything: det M is det A det(1 + ζ^(−m) G), G the rows of A⁻¹ Σ_l ζ^(−l) B_l over what is sent, which
        is a polynomial of p = ζ^(−m), the same for all delays that are alike but for m.
        """
        base, slope, sent, turned = self._alone(points)
        number = values.astype(np.intp)
        ages = self.lags[number]
        older = np.maximum(ages - ages[:, :1], 0)  # a layer that a delay does not have is empty, of age 0
        alike, which = np.unique(np.column_stack([self.alike[number], older]), axis=0, return_inverse=True)
        value, turning = np.zeros((2, len(values), len(points)), np.complex128)
        for group, (kind, *lags) in enumerate(alike.tolist()):
            rows = np.flatnonzero(which.ravel() == group)
            gains = self._gains(kind, np.array(lags), points, sent, turned)
            with np.errstate(divide="ignore", invalid="ignore"):  # a zero on the circle
                found = _of_powers(*gains, points, ages[rows, :1])
            value[rows], turning[rows] = base + found[0], slope + found[1]
        vague = np.nonzero(np.isnan(value))
        if len(vague[0]):
            again = self.at(values, vague[0], points[vague[1]])
            value[vague], turning[vague] = again.value, again.turning
        return Logarithm(value, turning)


def _joined(parts: Sequence[Logarithm], axis: int) -> Logarithm:
    """Return the logarithms at all points, from those at some after others."""
    listed = ([getattr(part, name) for part in parts] for name in Logarithm.__slots__)
    return Logarithm(*(np.concatenate(one, axis=axis) for one in listed))


def _of_powers(
    matrices: Complexes, turned: Complexes, points: Complexes, ages: Integers
) -> tuple[Complexes, Complexes]:
    """Return the logarithm (k, z) of det(1 + ζ^(−m) G), and its derivative along the circle.

    Both are NaN where that is far smaller than at some other p of the circle, and its digits are lost.

    Parameters
    ----------
    matrices, turned
        G (z, s, s), and its derivative over ζ's angle.
    points, ages
        ζ (z,) on the unit circle, and m (k, 1).

    Notes
    -----
    A polynomial of degree s of p = ζ^(−m), known by its values at s + 1 roots of unity: as |p| = 1, its
    coefficients and their sum are off by some roundings of its largest value.
    """
    size = matrices.shape[-1]
    # Turned, so that real eigenvalues of G of size 1 make no matrix singular.
    turn = np.exp(1j / (size + 1))
    nodes = turn * np.exp(2j * np.pi * np.arange(size + 1) / (size + 1))
    sizes, values, slopes = np.zeros((3, size + 1, len(points)), np.complex128)
    for place, node in enumerate(nodes):
        whole = np.eye(size) + node * matrices
        values[place], sizes[place] = np.linalg.slogdet(whole)
        slopes[place] = np.trace(np.linalg.solve(whole, node * turned), axis1=1, axis2=2)
    largest = sizes.real.max(axis=0)
    values *= np.exp(sizes.real - largest)
    back = turn ** -np.arange(size + 1)[:, None] / (size + 1)
    terms, turning = (back * np.fft.fft(one, axis=0) for one in (values, values * slopes))
    power = points**-ages
    total, along, moved = np.zeros((3, *power.shape), np.complex128)
    for degree in range(size, -1, -1):
        total = total * power + terms[degree]
        along = along * power + degree * terms[degree]
        moved = moved * power + turning[degree]
    total[~(np.abs(total) > CLEAR)] = np.nan
    return largest + np.log(total), (moved - 1j * ages * along) / total


def late_stretches(
    system: CompiledSystem,
    free: Free,
    low: Fraction,
    high: Fraction,
    prepared: Prepared,
    following: Callable[[Fraction], Fraction],
) -> list[LateStretch] | None:
    """Return the stretches of a range and whether each is stable, None where more than lags may change.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values.
    prepared
        From `analysis.prepare`; all sites as their parameters say.
    following
        From `delays.borders`.
    """
    moving = {name for name, slope in timing_slopes(system, free).items() if slope}
    if not _only_late(system, free, prepared, moving):
        return None
    borders = [low]
    while borders[-1] < high:
        borders.append(following(borders[-1]))
    pieces = tuple(itertools.pairwise(borders))
    found = np.zeros(len(pieces))
    for sheet in _sheets(Asked.of(system, [free], prepared), pieces):
        found += _beyond(sheet)
    if np.isnan(found).all():  # a drift, say, which keeps two eigenvalues at 1
        return None
    stable = [None if np.isnan(count) else count == 0 for count in found.tolist()]
    return [LateStretch(*piece, one) for piece, one in zip(pieces, stable, strict=True)]


@lru_cache(maxsize=KEPT)
def _sheets(of: Asked, pieces: tuple[tuple[Fraction, Fraction], ...]) -> tuple[_LateSheet, ...]:
    """Return each loop of a scene at a delay within each piece, and keep them for the next question."""
    system, prepared, (free,) = of.system, of.prepared, of.free
    slopes = timing_slopes(system, free)
    values = [start + INSIDE * (end - start) for start, end in pieces]
    inside = system_with_delay(system, free, values[0])
    timings = resolve(inside).timings
    patterns = [site.pattern for site in prepared.jacobians]
    kept = {link.name: 0 for link in system.links}
    schedules = build_schedules(inside, timings, patterns, order=prepared.order, kept=kept)
    delays = {
        name: [timings[name] + slopes[name] * (value - values[0]) for value in values]
        for name in {row.way.delay for one in schedules for row in one.selected}
    }
    packets = _packets(inside, schedules, delays, prepared.order)
    apart = {id(one): tick_by_tick(one) for one in schedules}
    by_tick = replace(prepared, schedules=tuple(apart[id(one)] for one in schedules), timings=timings)
    selected = {id(apart[id(one)]): one.selected for one in schedules}
    found = []
    for loop in arrange(*lifted_groups(inside, prepared=by_tick)).loops:
        rows = [
            [None if row.gap else packets[row] for row in selected[id(group.schedule)]]
            for group in loop.sites
        ]
        found.append(_sheet(loop, rows, len(pieces)))
    return tuple(found)


def _only_late(system: CompiledSystem, free: Free, prepared: Prepared, moving: set[str]) -> bool:
    """Say whether a value makes packets late, and nothing else that matters: no age of theirs."""
    if aged(system):
        return False
    held = {
        hold.delay
        for group, schedule in zip(system.groups, prepared.schedules, strict=True)
        for hold, acting in zip(system.kinds[group.kind].holds, schedule.acting, strict=True)
        if acting is not None
    }
    return not moving & held and not reaches_parameters(system, free)


def _packets(
    system: CompiledSystem,
    schedules: Sequence[Schedule],
    delays: dict[str, list[Fraction]],
    order: Sequence[str],
) -> dict[Selected, list[_Packet]]:
    """Return what each row of r hears at each of some delays, these by their name."""
    timings = resolve(system).timings
    clocks = {one.name: (timings[one.phase], timings[one.period]) for one in system.clocks}
    frame = schedules[0].frame_s
    apart = [value for late in delays.values() for value in late]
    quantum = common_divisor([frame, *(time for one in clocks.values() for time in one), *apart])
    times = Times(
        quantum=quantum,
        frame=int(frame / quantum),
        clocks={
            name: ClockGrid(int(phase % period / quantum), int(period / quantum))
            for name, (phase, period) in clocks.items()
        },
        delays={},
    )
    rank = {name: place for place, name in enumerate(order)}
    links = {link.name: link for link in system.links}
    rows = dict.fromkeys(row for one in schedules for row in one.selected)
    found: dict[Selected, list[_Packet]] = {row: [] for row in rows}
    for place in range(len(apart) // max(len(delays), 1)):
        here = replace(times, delays={name: int(late[place] / quantum) for name, late in delays.items()})
        for row, listed in found.items():
            at = here.clocks[row.clock].at(row.tick - row.way.before)
            one = newest(row.way, row.channel, links[row.way.link], at, here, rank)
            listed.append((one.sent.slot, one.lag))
    return found


def _sheet(loop: Loop, rows: Sequence[Sequence[Sequence[_Packet] | None]], count: int) -> _LateSheet:
    """Return a loop at all delays.

    Parameters
    ----------
    loop
        The loop, its sites hearing each tick by itself.
    rows
        What each row of r of each site hears at each delay; None for nothing.
    count
        How many delays there are.
    """
    heard = [(g, row, packets) for g, listed in enumerate(rows) for row, packets in enumerate(listed)]
    lags = [
        sorted({packets[place][1] for *_, packets in heard if packets is not None} or {0})
        for place in range(count)
    ]
    most = max(map(len, lags))
    kinds: dict[tuple[tuple[int, int], ...], int] = {}
    alike = [
        kinds.setdefault(
            tuple(
                (-1, 0) if packets is None else (packets[place][0], own.index(packets[place][1]))
                for *_, packets in heard
            ),
            len(kinds),
        )
        for place, own in enumerate(lags)
    ]
    sent = [group.schedule.sent for group in loop.sites]
    starts = np.cumsum([0, *map(len, sent)])
    weights = np.zeros((most, len(kinds), len(heard), int(starts[-1])))
    for kind, packets in enumerate(kinds):
        for line, ((g, row, _), (slot, layer)) in enumerate(zip(heard, packets, strict=True)):
            one = loop.sites[g].schedule.heard[row]
            packet = replace(one.sent, slot=slot)
            for h, weight in enumerate(loop.coupling[one.way][g]):
                if weight and slot >= 0:
                    weights[layer, kind, line, starts[h] + sent[h].index(packet)] = float(weight)
    loops = bordered(side_by_side([group.lifted for group in loop.sites]), weights)
    rigid = find_rigid_modes(without_packets(loop), with_drifts=False).directions.shape[1]
    ages = np.array([one + [0] * (most - len(one)) for one in lags])
    return _LateSheet(loops, _taken_apart(loops), np.array(alike), ages, rigid, int(ages.max()))


def _taken_apart(loops: Bordered) -> Response | None:
    """Return the eigenvalues and vectors of loops that nobody hears; None of small ones or a poor basis."""
    if loops.states <= LARGE:
        return None
    found = response_of(-loops.fixed[: loops.states, : loops.states])
    if found is None or not np.linalg.norm(found.right, 2) * np.linalg.norm(found.inverse, 2) < WORST:
        return None
    return found


def _beyond(sheet: _LateSheet) -> Floats:
    """Return how many eigenvalues of a loop are beyond the circle at each of its delays (k,)."""
    oldest = sheet.lags.max(axis=1)
    found, left = np.zeros(len(oldest)), np.ones(len(oldest), dtype=bool)
    while left.any():
        longest = int(oldest[left].max())
        some = left & (oldest * OCTAVE >= longest)
        within = replace(sheet, longest=longest)
        found[some] = count_beyond(within, np.flatnonzero(some).astype(np.float64))
        left &= ~some
    return found
