"""A loop whose receivers go on with what they heard last: what a frame does where packets get lost.

Takes: a loop of `eigen.modes`, and what its receivers hear apart from the loop's own packets.
Gives: `Ear`, `HeldLoop`, `held_loop`; `lossy_rows`; `HeldScene`, `held_scene`.
Guarantees: every matrix comes with the radius of its rounding, those of the sites' frames included; rigid
motions are taken out, which no loss moves.
Does not: say which packets get lost (see `worst`, `almost_sure`); serve delays that vary, or receivers that
take no difference for a lost packet.

One packet a frame is sent on each way. What a receiver goes on with once packet k is sent, is either its
number q or what it went on with before,

    η_k = θ_k q_k + (1 − θ_k) η_{k−1}        x⁺ = F x + G η        q = S x        η_{k−1} = E x

and every tick hears the η of the packet that it would hear if none got lost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, timed
from apc.compiler.compiled import CompiledSystem, Link
from apc.eigen.closing import (
    Feedback,
    Loop,
    Packet,
    StateLayout,
    bounded_weight,
    close,
    feedback_of,
    lay_out_loop,
)
from apc.eigen.peer_group import MOST_STATES, PeerGroup
from apc.eigen.relative import relative_coordinates
from apc.eigen.rigid import find_rigid_modes
from apc.frame.exchange import Exchange
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, with_radius
from apc.frame.schedule import Heard, Schedule

Floats = NDArray[np.float64]
Matrix = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Ear:
    """A number that enters what sites hear, `weights` by site and row of r; sent as `row` of s by `sender`.

    With no sender it comes from outside, and nothing is held.
    """

    weights: Mapping[tuple[int, int], Fraction]
    sender: int | None = None
    row: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class HeldLoop:
    """F (2, n, n), G (2, n, ears), S and E (2, ears that have a sender, n) in relative coordinates.

    The ears that come from outside are the last. `step` is how far what is sent is from what was held, S − E.
    """

    f: Matrix
    g: Matrix
    s: Matrix
    e: Matrix

    @property
    def step(self) -> Matrix:
        """What each ear would hear next over what it hears: S − E."""
        return RADII.subtract(self.s, self.e)

    def frame(self, *, lost: bool) -> Matrix:
        """Return the matrix (2, n, n) of a frame whose packets are all lost or all heard."""
        heard = self.e if lost else self.s
        return RADII.add(self.f, RADII.multiply(self.g[..., : heard.shape[-2]], heard))


@dataclass(frozen=True, slots=True)
class HeldScene:
    """A scene whose receivers hold what they heard last; `lossy` are the links that lose packets."""

    groups: tuple[PeerGroup, ...]
    exchange: Exchange
    lossy: frozenset[str]


def held_scene(system: CompiledSystem, prepared: Prepared) -> HeldScene | str:
    """Return a scene whose receivers hold what they heard last, or say why they don't simply do so.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    """
    numbers = resolve(system)
    at = timed(system, prepared, numbers)
    lossy = [link for link in system.links if link.channel is not None]
    if not lossy:
        return "every link is reliable"
    for link in lossy:
        if why := _unheld(link, at.schedules):
            return why
    different = {
        (group.kind, vector.tobytes())
        for group, vectors in zip(system.groups, numbers.parameters, strict=True)
        for vector in vectors
    }
    states = sum(len(system.kinds[kind].states) for kind, _ in different)
    if states > MOST_STATES:
        return f"{len(different):,} different peers have {states:,} states, and {MOST_STATES:,} are the most"
    groups, exchange = lifted_groups(system, prepared=at)
    return HeldScene(groups, exchange, frozenset(link.name for link in lossy))


def _unheld(link: Link, schedules: Sequence[Schedule]) -> str:
    """Say why the receivers of a link don't simply hold what they heard last, "" where they do."""
    channel = link.channel
    assert channel is not None, f"{link.name} is reliable"
    if channel.trace is not None:
        return f"{link.name} plays a trace"
    if channel.jitter is not None:
        return f"{link.name} has jitter"
    if channel.on_loss != "hold":
        return f"{link.name} takes no difference where a packet is missed (on_loss: {channel.on_loss})"
    for schedule in schedules:
        if any(one.link == link.name and one.slot for one in schedule.sent):
            return f"{link.name} sends more than one packet in a frame of {float(schedule.frame_s):g} s"
        used = {one.way.operator for one in schedule.heard if one.way.link == link.name}
        if not used <= {"mean", "sum"}:
            return f"more than means and sums are taken over {link.name}"
    return ""


def lossy_rows(group: PeerGroup, lossy: frozenset[str]) -> list[tuple[int, Heard]]:
    """Return the rows of r of a site that hear a link of some and that something follows from."""
    counts = np.abs(group.lifted.q).sum(axis=0) + np.abs(group.lifted.d).sum(axis=0)
    return [
        (line, one)
        for line, one in enumerate(group.schedule.heard)
        if one.way.link in lossy and counts[line] != 0
    ]


def held_loop(loop: Loop, ears: Sequence[Ear], lossy: frozenset[str]) -> HeldLoop | None:
    """Close a loop with what its ears hold, None where a packet depends on another one of its frame.

    Parameters
    ----------
    loop
        A loop of `eigen.modes`.
    ears
        All that is heard on the links `lossy`; those without a sender last.
    lossy
        The links whose packets the ears hold.

    Notes
    -----
    The state holds the loop's own, without packets of lossy links, and then what each ear went on with, the
    packet before first, for as long as it is heard. Behind the state stand what the ears hear anew.
    """
    own = _deaf(loop, lossy)
    layout = lay_out_loop(own)
    depths = [
        max(1, *(loop.sites[site].schedule.heard[line].lag for site, line in ear.weights)) for ear in ears
    ]
    starts = np.cumsum([len(layout.names), *depths]).tolist()
    states, n = starts[-1], starts[0]
    feedback = []
    for g, one in enumerate(feedback_of(own, layout)):
        before = np.zeros((2, one.before.shape[-2], states + len(ears)))
        before[..., :n] = one.before
        for place, ear in enumerate(ears):
            for (site, line), weight in ear.weights.items():
                if site == g:
                    heard = loop.sites[g].schedule.heard[line]
                    at = states + place if heard.lag == 0 else starts[place] + heard.lag - 1
                    doubt = 0.0 if ear.sender is None else loop.doubts.get(heard.way, 0.0)
                    before[:, line, at] = bounded_weight(weight, doubt)
        feedback.append(Feedback(one.now, before))
    closed = close([group.lifted.bounded for group in own.sites], feedback, layout, numbers=RADII)
    firsts = np.cumsum([0] + [len(group.schedule.sent) for group in own.sites]).tolist()
    senders = [(ear.sender, ear.row) for ear in ears if ear.sender is not None]
    sent = closed.sent[:, [firsts[sender] + row for sender, row in senders]]
    if sent[..., states:].any():
        return None
    f, anew = np.zeros((2, states, states)), np.zeros((2, states, len(ears)))
    f[:, :n], anew[:, :n] = closed.matrix[..., :states], closed.matrix[..., states:]
    for place, (start, depth) in enumerate(zip(starts, depths, strict=False)):
        anew[0, start, place] = 1.0
        for lag in range(1, depth):
            f[0, start + lag, start + lag - 1] = 1.0
    before = np.zeros((2, len(senders), states))
    before[0, np.arange(len(senders)), starts[: len(senders)]] = 1.0
    at = relative_coordinates(_standing(loop, lossy, layout, senders, starts))
    weights = with_radius(at.weights, at.doubt)

    def apart(matrix: Matrix) -> Matrix:
        if not len(at.held):
            return matrix
        return RADII.subtract(matrix[:, at.rest], RADII.multiply(weights, matrix[:, at.held]))

    return HeldLoop(apart(f)[..., at.rest], apart(anew), sent[..., at.rest], before[..., at.rest])


def _deaf(loop: Loop, lossy: frozenset[str]) -> Loop:
    """Return a loop in which nothing is heard of some links, nor kept of what they carry."""
    nothing = Fraction(0)
    return replace(
        loop,
        sites=tuple(_kept(site, dict.fromkeys(lossy, (0, 0))) for site in loop.sites),
        coupling={
            way: tuple((nothing,) * len(row) for row in rows) if way.link in lossy else rows
            for way, rows in loop.coupling.items()
        },
        doubts={way: doubt for way, doubt in loop.doubts.items() if way.link not in lossy},
    )


def _kept(group: PeerGroup, most: Mapping[str, tuple[int, int]]) -> PeerGroup:
    """Return a site that keeps packets of some links for at least, and at most, so many frames."""
    schedule = group.schedule
    depths = tuple(
        max(least, min(depth, limit))
        for sent, depth in zip(schedule.sent, schedule.depths, strict=True)
        for least, limit in (most.get(sent.link, (0, depth)),)
    )
    return replace(group, schedule=replace(schedule, depths=depths))


def _standing(
    loop: Loop,
    lossy: frozenset[str],
    layout: StateLayout,
    senders: Sequence[tuple[int, int]],
    starts: Sequence[int],
) -> Floats:
    """Return the rigid motions over the state of a held loop: what stands still is held as it was sent."""
    sites = tuple(_kept(site, dict.fromkeys(lossy, (1, 1))) for site in loop.sites)
    whole = replace(loop, sites=sites)
    found, places = find_rigid_modes(whole, with_drifts=False).directions, lay_out_loop(whole)
    basis = np.zeros((starts[-1], found.shape[1]))
    for to, from_, group in zip(layout.offsets, places.offsets, sites, strict=True):
        size = len(group.lifted.z_names)
        basis[to : to + size] = found[from_ : from_ + size]
    for packet, place in layout.places.items():
        basis[place] = found[places.places[packet]]
    for (sender, row), start, end in zip(senders, starts, starts[1:], strict=False):
        basis[start:end] = found[places.places[Packet(sender, row, 1)]]
    return basis
