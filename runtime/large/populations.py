"""Peers by the thousand, all different: the matrices of every one, without an object for each.

Takes: a `Model`, its numbers, Jacobians and schedules.
Gives: `HeterogeneousGroup`, `populations`, `joined`; `hear_themselves`, `lines_of`; `turned_by`.
Guarantees: a population costs what its different peers cost in one array operation each, not in one Python
call each; equal peers of a population are counted.
Does not: merge equal peers of different groups (see `peers`), or take sites that are not affine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import InterconnectionMatrices, close, lay_out
from apc.eigen.peers import states_of
from apc.eigen.spectrum import LEAST_SHARE, oscillation
from apc.frame.course import turns
from apc.frame.instance import Instance
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.lift import FrameMap, lift
from apc.frame.linearize import linearize, linearize_rows, site_of
from apc.frame.radius import RADII, rounded
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSubsystem, every_matrix
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
class HeterogeneousGroup:
    """The peers of one group of the scene, k different ones.

    `group` is its place in the scene; `parameters` (k, n_p) and `maps` (k, …), with their radii, are the
    different peers', `rows` (count,) says which each peer is, `counts` (k,) how many are.
    """

    name: str
    group: int
    jacobians: SubsystemJacobians
    schedule: Schedule
    parameters: Floats
    maps: FrameMap
    rows: Integers
    counts: Floats

    def site(self, row: int) -> LinearSubsystem:
        """Return the matrices of one of the different peers by itself."""
        return linearize(self.jacobians, self.parameters[row])

    def sends(self, link: str) -> bool:
        """Say whether these peers send over a link."""
        return any(sending.link == link for sending in self.jacobians.kind.sends)


def populations(instance: Instance) -> tuple[HeterogeneousGroup, ...]:
    """Linearize and lift all different peers of a system, every kind of it affine and without edge functions.

    Raises
    ------
    ApcError
        E804 more different peers than the memory holds.
    """
    system, schedules, numbers = instance.system, instance.schedules, instance.numbers
    if sum(map(len, numbers.rows)) > MOST_DIFFERENT:
        what = f"{system.peers:,} peers, some of whom differ, and {MOST_DIFFERENT:,} are the most of these"
        raise ApcError(
            Diagnostic("E804", SourceLocation(system.origin.topology), what, hint="smaller counts")
        )
    states = list(map(states_of, schedules, instance.sites))
    needed = ENTRY * sum(len(rows) * n**2 for rows, n in zip(numbers.parameters, states, strict=True))
    what = f"{sum(map(len, numbers.parameters)):,} different peers of up to {max(states)} states"
    refuse_beyond(needed, "E804", SourceLocation(system.origin.topology), what, "fewer peers that differ")
    result = []
    for place, (site, schedule) in enumerate(zip(instance.sites, schedules, strict=True)):
        group, parameters = system.groups[place], numbers.parameters[place]
        matrices = linearize_rows(site, parameters)
        parts = [
            lift(site_of(site, matrices[start : start + CHUNK]), schedule)
            for start in range(0, len(matrices), CHUNK)
        ]
        rows = numbers.rows[place]
        counts = np.bincount(rows, minlength=len(parameters)).astype(np.float64)
        result.append(
            HeterogeneousGroup(group.name, place, site, schedule, parameters, joined(parts), rows, counts)
        )
    return tuple(result)


def joined(parts: Sequence[FrameMap]) -> FrameMap:
    """Return the maps of several chunks of sites as those of all."""
    return parts[0].mapped(lambda *blocks: np.concatenate(blocks), *parts[1:])


def hear_themselves(maps: FrameMap, schedule: Schedule, values: Floats, others: Floats) -> FrameMap:
    """Let every site hear its own packets, weighed, the rest of what it hears left open: with radii.

    Parameters
    ----------
    maps, schedule
        Of k sites, with their radii.
    values
        What each line of r weighs the site's own packets by (n_r,).
    others
        What each line weighs what still comes from outside by (n_r,).

    Notes
    -----
    The state is z, then the packets on their way, row by row of s, the youngest first. With A_l picking what
    each line hears of the packets of l frames ago, r = others·τ + own·Σ_l A_l s(−l) and s = S z + D r: as in
    `closing.close`, D A₀ is nilpotent.
    """
    layout, picked = lay_out([[""] * maps.p.shape[-1]], [schedule]), lines_of(schedule)
    n, n_r = len(layout.names), len(schedule.heard)
    now, before = np.zeros((n_r, len(schedule.sent))), np.zeros((n_r, n + n_r))
    now += picked.get(0, 0.0)
    for packet, place in layout.places.items():
        if packet.lag in picked:
            before[:, place] = picked[packet.lag][:, packet.row]
    before = values[:, None] * before
    before[:, n:] = np.diag(others)
    heard = InterconnectionMatrices(rounded(values[:, None] * now), rounded(before))
    parts = []
    for start in range(0, len(maps.p), CHUNK):
        frame_map = maps.mapped(lambda block, start=start: block[start : start + CHUNK])
        closed = close([frame_map], [heard], layout, numbers=RADII)
        matrix, sent = closed.matrix, closed.sent
        parts.append(FrameMap(matrix[..., :n], matrix[..., n:], sent[..., :n], sent[..., n:]))
    return joined(parts)


def lines_of(schedule: Schedule) -> dict[int, Floats]:
    """Return which of its own packets each line of r hears if a site hears itself: by lag, (n_r, n_s)."""
    result: dict[int, Floats] = {}
    for line, heard in enumerate(schedule.heard):
        if heard.sent in schedule.sent:
            picked = result.setdefault(heard.lag, np.zeros((len(schedule.heard), len(schedule.sent))))
            picked[line, schedule.sent.index(heard.sent)] = 1.0
    return result


def turned_by(
    site: LinearSubsystem,
    schedule: Schedule,
    value: complex,
    z: Complexes,
    heard: Complexes,
    covector: Complexes,
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
    if not len(z):
        return 0.0, 1.0
    taking, count = np.abs(covector * z), len(site.kind.states)
    moves = taking[:count].max(initial=0.0) > LEAST_SHARE * taking.sum()
    state = np.array([int(np.argmax(taking[:count] if moves else taking))])
    site = every_matrix(site, lambda matrix: matrix[None])
    angle = turns(site, schedule, z[None], heard[None], state, np.array([value]))
    return oscillation(abs(value), float(angle[0]), float(schedule.frame_s))
