"""Peers by the thousand, all different: the matrices of every one, without an object for each.

Takes: a `CompiledSystem`, its numbers, Jacobians and schedules.
Gives: `Population`, `populations`, `some_rows`, `site_one`; `hear_themselves`, `hear_roughly`, `lines_of`;
`state_names`, `turned_by`, `mode_of`.
Guarantees: a population costs what its different peers cost in one array operation each, not in one Python
call each; equal peers of a population are counted.
Does not: merge equal peers of different groups (see `peers`), or take sites that are not affine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import Closed, Feedback, StateLayout, close, lay_out
from apc.eigen.peers import states_of
from apc.eigen.spectrum import Mode, Motion, oscillation
from apc.frame.course import turns
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import FrameMap, LiftedSite, lift
from apc.frame.linearize import linearize, linearize_rows, site_of
from apc.frame.parameters import Numbers
from apc.frame.radius import RADII, rounded
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSite, every_matrix
from apc.memory import refuse_beyond

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


# Sites composed together: their matrices then stay in the cache of a processor.
CHUNK = 2048

# Peers of all groups where some differ: a number is kept of each, some hundred megabytes of so many.
MOST_DIFFERENT = 2 * 10**7
ENTRY = 100  # bytes of an entry of a different peer's matrix: with its radius, what it is made of and becomes


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """The peers of one group of the scene, k different ones.

    `group` is its place in the scene; `parameters` (k, n_p) and `lifted` are the different peers', `rows`
    (count,) says which each peer is, `counts` (k,) how many are.
    """

    name: str
    group: int
    jacobians: SiteJacobians
    schedule: Schedule
    parameters: Floats
    lifted: LiftedSite
    rows: Integers
    counts: Floats

    def sends(self, link: str) -> bool:
        """Say whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.kind.sends)


def populations(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
    numbers: Numbers,
) -> tuple[Population, ...]:
    """Linearize and lift all different peers of a system.

    Parameters
    ----------
    system
        The compiled scene, every kind of it affine and without edge functions.
    jacobians
        One a kind.
    schedules
        One a group of the scene.
    numbers
        The parameters and timings.
    """
    if sum(map(len, numbers.rows)) > MOST_DIFFERENT:
        what = f"{system.peers:,} peers, some of whom differ, and {MOST_DIFFERENT:,} are the most of these"
        raise ApcError(Mistake("E804", Place(system.origin.topology), what, hint="smaller counts"))
    states = [
        states_of(schedule, jacobians[group.kind])
        for group, schedule in zip(system.groups, schedules, strict=True)
    ]
    needed = ENTRY * sum(len(rows) * n**2 for rows, n in zip(numbers.parameters, states, strict=True))
    what = f"{sum(map(len, numbers.parameters)):,} different peers of up to {max(states)} states"
    refuse_beyond(needed, "E804", Place(system.origin.topology), what, "fewer peers that differ")
    found = []
    for place, (group, schedule) in enumerate(zip(system.groups, schedules, strict=True)):
        site, parameters = jacobians[group.kind], numbers.parameters[place]
        lifted = _lifted(site, schedule, linearize_rows(site, parameters))
        rows = numbers.rows[place]
        counts = np.bincount(rows, minlength=len(parameters)).astype(np.float64)
        found.append(Population(group.name, place, site, schedule, parameters, lifted, rows, counts))
    return tuple(found)


def _lifted(site: SiteJacobians, schedule: Schedule, rows: Floats) -> LiftedSite:
    """Return the maps of many sites of one kind from their matrices (k, …)."""
    parts = [
        lift(site_of(site, rows[start : start + CHUNK]), schedule) for start in range(0, len(rows), CHUNK)
    ]
    return _joined(parts)


def _joined(parts: Sequence[LiftedSite]) -> LiftedSite:
    """Return the maps of several chunks of sites as those of all."""

    def whole(first: FrameMap, *others: FrameMap) -> FrameMap:
        return first.mapped(lambda *blocks: np.concatenate(blocks), *others)

    p, q, s, d = whole(*parts).blocks
    return replace(parts[0], p=p, q=q, s=s, d=d, error=whole(*(one.error for one in parts)))


def some_rows(lifted: LiftedSite, places: slice | Integers) -> LiftedSite:
    """Return some of the sites."""
    return _every_block(lifted, lambda block: block[places])


def rows_of(lifted: LiftedSite, count: int) -> LiftedSite:
    """Return `count` copies of one lifted site."""
    return _every_block(lifted, lambda block: np.broadcast_to(block, (count, *block.shape)))


def _every_block(lifted: LiftedSite, change: Callable[[Floats], Floats]) -> LiftedSite:
    p, q, s, d = lifted.mapped(change).blocks
    return replace(lifted, p=p, q=q, s=s, d=d, error=lifted.error.mapped(change))


def site_one(population: Population, row: int) -> LinearSite:
    """Return the matrices of one of the different peers by itself."""
    return linearize(population.jacobians, population.parameters[row])


def hear_themselves(lifted: LiftedSite, schedule: Schedule, own: Floats, others: Floats) -> FrameMap:
    """Let every site hear its own packets, weighed, the rest of what it hears left open: with radii.

    Parameters
    ----------
    lifted
        k sites.
    schedule
        Theirs.
    own
        What each line of r weighs the site's own packets by (k, n_r).
    others
        What each line weighs what still comes from outside by (k, n_r).

    Notes
    -----
    The state is z, then the packets on their way, row by row of s, the youngest first. With A₀ and B_p
    picking what each line hears of this frame's packets and of those on their way,
    r = others·τ + own·(A₀ s + B_p q) and s = S z + D r: as in `closing.close`, D A₀ is nilpotent.
    """
    parts = []
    for start in range(0, len(own), CHUNK):
        chunk = slice(start, start + CHUNK)
        layout, feedback = _open_loop(some_rows(lifted, chunk), schedule, own[chunk], others[chunk])
        heard = Feedback(rounded(feedback.now), rounded(feedback.before))
        parts.append(_cut(close([some_rows(lifted, chunk).bounded], [heard], layout, numbers=RADII)))
    return parts[0].mapped(lambda *blocks: np.concatenate(blocks), *parts[1:])


def hear_roughly(lifted: LiftedSite, schedule: Schedule, own: Floats, others: Floats) -> FrameMap:
    """Return the map that `hear_themselves` gives, without its errors."""
    layout, feedback = _open_loop(lifted, schedule, own, others)
    return _cut(close([lifted], [feedback], layout))


def _open_loop(
    lifted: LiftedSite, schedule: Schedule, own: Floats, others: Floats
) -> tuple[StateLayout, Feedback]:
    """Return the state of each site by itself, and what it hears of it and, behind it, of the others."""
    now, before, _ = lines_of(schedule)
    nothing = np.zeros((*own.shape, lifted.p.shape[-1]))
    outside = others[:, :, None] * np.eye(own.shape[1])
    heard = np.concatenate([nothing, own[:, :, None] * before, outside], axis=-1)
    return lay_out([lifted.z_names], [schedule]), Feedback(own[:, :, None] * now, heard)


def _cut(closed: Closed) -> FrameMap:
    """Return the map of closed loops over their states and what comes from outside."""
    n = closed.matrix.shape[-2]
    return FrameMap(
        closed.matrix[..., :n], closed.matrix[..., n:], closed.sent[..., :n], closed.sent[..., n:]
    )


def lines_of(schedule: Schedule) -> tuple[Floats, Floats, int]:
    """Return A₀ (n_r, n_s), B_p (n_r, n_q) and the number n_q of packets on their way."""
    place = {one: row for row, one in enumerate(schedule.sent)}
    starts = np.cumsum([0, *schedule.depths])
    now = np.zeros((len(schedule.heard), len(schedule.sent)))
    before = np.zeros((len(schedule.heard), int(starts[-1])))
    for line, one in enumerate(schedule.heard):
        if one.sent not in place:  # this kind does not send it
            continue
        if one.lag == 0:
            now[line, place[one.sent]] = 1.0
        else:
            before[line, starts[place[one.sent]] + one.lag - 1] = 1.0
    return now, before, int(starts[-1])


def state_names(population: Population) -> list[str]:
    """Return the names of a peer's state, z and then the packets on their way."""
    waiting = zip(population.schedule.sent_names, population.schedule.depths, strict=True)
    return [*population.lifted.z_names, *(name for name, depth in waiting for _ in range(depth))]


def turned_by(
    site: LinearSite, schedule: Schedule, value: complex, z: Complexes, heard: Complexes, covector: Complexes
) -> tuple[float, float]:
    """Return the frequency and damping of a mode, whole turns counted on the state that takes most part.

    Parameters
    ----------
    site, schedule
        Of the peer that moves most.
    value
        The eigenvalue.
    z, heard, covector
        The peer's state (n,), what it hears (n_r,) and what weighs its state (n,).
    """
    count = len(site.kind.states)
    if not count:
        return 0.0, 1.0
    state = np.array([int(np.argmax(np.abs(covector[:count] * z[:count])))])
    start, received = (
        block[None].astype(np.complex128) for block in (z[: count + len(schedule.carried)], heard)
    )
    site = every_matrix(site, lambda matrix: matrix[None])
    angle = turns(site, schedule, start, received, state, np.array([value]))
    return oscillation(abs(value), float(angle[0]), float(schedule.frame_s))


def mode_of(
    value: complex,
    error: float,
    turned: tuple[float, float],
    shares: Mapping[str, float],
    shape: str,
    multiplicity: int,
) -> Mode:
    """Put a mode together.

    Parameters
    ----------
    value, error
        The eigenvalue and what it may be off by.
    turned
        From `turned_by`.
    shares
        How much each state takes part, in any unit.
    shape, multiplicity
        As in `Mode`.
    """
    frequency, damping = turned
    total = sum(shares.values()) or 1.0
    return Mode(
        eigenvalue=value,
        magnitude=abs(value),
        multiplicity=multiplicity,
        shape=shape,
        error=error,
        motion=(Motion(frequency, damping, tuple((name, share / total) for name, share in shares.items())),),
    )
