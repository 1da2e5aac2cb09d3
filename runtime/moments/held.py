"""A loop whose receivers go on with what they heard last: what a frame does where packets get lost.

Takes: a scene whose links lose packets, and a loop of its peers.
Gives: `Ear`, `ears_of`, `HeldLoop`, `held_loop`; `lossy_rows`; `HeldScene`, `held_scene`; `Chance`,
`every_channel`.
Guarantees: every matrix comes with the radius of its rounding, those of the sites' frames included.
Does not: say which packets get lost (see `worst`, `almost_sure`, `patterns`, `bursts`); serve delays that
vary, or receivers that take no difference for a lost packet.

One packet a frame is sent on each way. What a receiver goes on with once packet k is sent, is either its
number q or what it went on with before,

    η_k = θ_k q_k + (1 − θ_k) η_{k−1}        x⁺ = F x + G η        q = S x        η_{k−1} = E x

and every tick hears the η of the packet that it would hear if none got lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem, Link
from apc.eigen.closing import Feedback, Loop, bounded_weight, close, feedback_of, lay_out_loop
from apc.eigen.modes import dense_loop
from apc.eigen.peers import MOST_STATES, PeerGroup
from apc.eigen.relative import Relative, relative_coordinates, relative_rows, with_doubt
from apc.frame.instance import Prepared, prepared_at
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, value_of
from apc.frame.schedule import Heard, Schedule
from apc.moments.crowd import Hearing, standing_motions
from apc.moments.mean_loops import standing_state
from apc.moments.unserved import UnservedError
from apc.network.channel import ChannelLaw, channel_law

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
    """F (2, n, n), G (2, n, ears), S and E (2, ears that have a sender, n).

    The ears that come from outside are the last. `at` are coordinates relative to motions that nothing holds
    back, `offsets` (sites + 1,) say where each site's states start, `places` which ones each ear's are.
    """

    f: Matrix
    g: Matrix
    s: Matrix
    e: Matrix
    at: Relative
    offsets: tuple[int, ...]
    places: tuple[range, ...]

    @property
    def step(self) -> Matrix:
        """What each ear would hear next over what it hears: S − E."""
        return RADII.subtract(self.s, self.e)

    def frame(self, *, lost: bool) -> Matrix:
        """Return the matrix (2, n, n) of a frame whose packets are all lost or all heard."""
        heard = self.e if lost else self.s
        return RADII.add(self.f, RADII.multiply(self.g[..., : heard.shape[-2]], heard))

    def relative(self) -> HeldLoop:
        """Return the loop over its relative coordinates."""
        f, g = (relative_rows(matrix, with_doubt(self.at), RADII) for matrix in (self.f, self.g))
        rest = self.at.rest
        return replace(self, f=f[..., rest], g=g, s=self.s[..., rest], e=self.e[..., rest])


@dataclass(frozen=True, slots=True)
class HeldScene:
    """A scene whose receivers hold what they heard last; `lossy` are the links that lose packets."""

    hearing: Hearing
    lossy: frozenset[str]


def held_scene(system: CompiledSystem, prepared: Prepared) -> HeldScene:
    """Return a scene whose receivers hold what they heard last.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    """
    numbers = resolve(system)
    at = prepared_at(system, prepared, numbers.timings)
    lossy = [link for link in system.links if link.channel is not None]
    if not lossy:
        raise UnservedError("every link is reliable")
    for link in lossy:
        period = at.timings[next(clock.period for clock in system.clocks if clock.name == link.clock)]
        if why := _unheld(link, period, at.schedules):
            raise UnservedError(why)
    different = {
        (group.kind, vector.tobytes())
        for group, vectors in zip(system.groups, numbers.parameters, strict=True)
        for vector in vectors
    }
    states = sum(len(system.kinds[kind].states) for kind, _ in different)
    if states > MOST_STATES:
        what = f"{len(different):,} different peers have {states:,} states"
        raise UnservedError(f"{what}, and {MOST_STATES:,} are the most")
    groups, exchange = lifted_groups(system, prepared=at)
    schedule = at.schedules[0]
    hearing = Hearing(groups, exchange, {}, at.timings, schedule.frame_s, schedule.quantum, strictly=False)
    return HeldScene(hearing, frozenset(link.name for link in lossy))


def _unheld(link: Link, period: Fraction, schedules: Sequence[Schedule]) -> str:
    """Say why receivers of a link, of a period in s, don't just hold what they heard last, "" if they do."""
    channel = link.channel
    assert channel is not None, f"{link.name} is reliable"
    if channel.trace is not None:
        return f"{link.name} plays a trace"
    if channel.jitter is not None:
        return f"{link.name} has jitter"
    if channel.on_loss != "hold":
        return f"{link.name} takes no difference where a packet is missed (on_loss: {channel.on_loss})"
    for schedule in schedules:
        # A schedule leaves out packets that others supersede, which are heard where those are lost.
        if period < schedule.frame_s:
            return f"{link.name} sends more than one packet in a frame of {float(schedule.frame_s):g} s"
        used = {heard.way.operator for heard in schedule.heard if heard.way.link == link.name}
        if not used <= {"mean", "sum"}:
            return f"more than means and sums are taken over {link.name}"
    return ""


def lossy_rows(group: PeerGroup, lossy: frozenset[str]) -> list[tuple[int, Heard]]:
    """Return the rows of r of a site that hear a link of some and that something follows from."""
    q, d = value_of(group.lifted.q), value_of(group.lifted.d)
    counts = np.abs(q).sum(axis=0) + np.abs(d).sum(axis=0)
    return [
        (line, heard)
        for line, heard in enumerate(group.schedule.heard)
        if heard.way.link in lossy and counts[line] != 0
    ]


def ears_of(loop: Loop, lossy: frozenset[str], receivers: Iterable[int]) -> list[Ear]:
    """Return what some sites of a loop hear over some links, sender by sender.

    Parameters
    ----------
    loop, lossy
        The loop and the links.
    receivers
        The sites that hear.
    """
    rows = [(g, line, heard) for g in receivers for line, heard in lossy_rows(loop.sites[g], lossy)]
    ears = []
    for h, sender in enumerate(loop.sites):
        for row, sent in enumerate(sender.schedule.sent):
            weights = {
                (g, line): loop.coupling[heard.way][g][h]
                for g, line, heard in rows
                if heard.sent == sent and (loop.coupling[heard.way][g][h] or loop.doubts.get(heard.way))
            }
            if weights:
                ears.append(Ear(weights, h, row))
    return ears


def held_loop(loop: Loop, ears: Sequence[Ear], lossy: frozenset[str]) -> HeldLoop:
    """Close a loop with what its ears hold.

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
    deaf = _deaf(loop, lossy)
    layout = lay_out_loop(deaf)
    depths = [
        max(
            int(ear.sender is not None),
            *(loop.sites[site].schedule.heard[line].lag for site, line in ear.weights),
        )
        for ear in ears
    ]
    starts = np.cumsum([len(layout.names), *depths]).tolist()
    states, n = starts[-1], starts[0]
    feedback = []
    for g, heard_there in enumerate(feedback_of(deaf, layout)):
        before = np.zeros((2, heard_there.before.shape[-2], states + len(ears)))
        before[..., :n] = heard_there.before
        for place, ear in enumerate(ears):
            for (site, line), weight in ear.weights.items():
                if site == g:
                    heard = loop.sites[g].schedule.heard[line]
                    at = states + place if heard.lag == 0 else starts[place] + heard.lag - 1
                    doubt = 0.0 if ear.sender is None else loop.doubts.get(heard.way, 0.0)
                    before[:, line, at] = bounded_weight(weight, doubt)
        feedback.append(Feedback(heard_there.now, before))
    closed = close([group.lifted for group in deaf.sites], feedback, layout, numbers=RADII)
    firsts = np.cumsum([0] + [len(group.schedule.sent) for group in deaf.sites]).tolist()
    senders = [(ear.sender, ear.row) for ear in ears if ear.sender is not None]
    sent = closed.sent[:, [firsts[sender] + row for sender, row in senders]]
    if sent[..., states:].any():
        raise UnservedError("a packet follows from another one of its frame")
    f, anew = np.zeros((2, states, states)), np.zeros((2, states, len(ears)))
    f[:, :n], anew[:, :n] = closed.matrix[..., :states], closed.matrix[..., states:]
    for place, (start, depth) in enumerate(zip(starts, depths, strict=False)):
        anew[0, start : start + min(depth, 1), place] = 1.0
        for lag in range(1, depth):
            f[0, start + lag, start + lag - 1] = 1.0
    before = np.zeros((2, len(senders), states))
    before[0, np.arange(len(senders)), starts[: len(senders)]] = 1.0
    held = HeldLoop(
        *(f, anew, sent[..., :states], before, relative_coordinates(np.zeros((states, 0)))),
        offsets=(*layout.offsets, n),
        places=tuple(map(range, starts, starts[1:])),
    )
    basis = standing_state(held.frame(lost=False), standing_motions(loop), loop, [*layout.offsets, states])
    return replace(held, at=relative_coordinates(basis))


def _deaf(loop: Loop, lossy: frozenset[str]) -> Loop:
    """Return a loop in which nothing is heard of some links, and no packets of theirs are states."""
    nothing = Fraction(0)

    def without(schedule: Schedule) -> Schedule:
        depths = zip(schedule.sent, schedule.depths, strict=True)
        return replace(schedule, depths=tuple(0 if sent.link in lossy else depth for sent, depth in depths))

    return replace(
        loop,
        sites=tuple(replace(site, schedule=without(site.schedule)) for site in loop.sites),
        coupling={
            way: tuple((nothing,) * len(row) for row in rows) if way.link in lossy else rows
            for way, rows in loop.coupling.items()
        },
        doubts={way: doubt for way, doubt in loop.doubts.items() if way.link not in lossy},
    )


@dataclass(frozen=True, slots=True)
class Chance:
    """By which `law` the ears `ears` of the way to `receiver` from `sender` lose packets, all together."""

    law: ChannelLaw
    receiver: int
    sender: int
    ears: tuple[int, ...]


def every_channel(
    system: CompiledSystem, scene: HeldScene, most: int | None = None
) -> tuple[HeldLoop, list[Chance]]:
    """Put a whole scene in one loop, every peer and every channel by itself.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    scene
        Its peers.
    most
        How many states are the most.
    """
    peers = scene.hearing.exchange.peers
    if most is not None and peers > most:
        raise UnservedError(f"{peers:,} peers don't fit in one matrix of {most} states")
    loop = dense_loop(scene.hearing.groups, scene.hearing.exchange)
    ears: list[Ear] = []
    of_way: dict[tuple[str, int, int], list[int]] = {}
    for g in range(len(loop.sites)):
        for ear in ears_of(loop, scene.lossy, [g]):
            assert ear.sender is not None
            link = loop.sites[ear.sender].schedule.sent[ear.row].link
            of_way.setdefault((link, g, ear.sender), []).append(len(ears))
            ears.append(ear)
    states = sum(len(site.z_names) for site in loop.sites) + len(ears)
    if most is not None and states > most:
        what = f"{peers:,} peers and their channels have {states:,} states"
        raise UnservedError(f"{what}, and {most} are the most")
    held = held_loop(loop, ears, scene.lossy)
    timings = resolve(system).timings
    laws = {
        link.name: channel_law(system, link, timings[link.delay]) for link in system.links if link.channel
    }
    return held, [Chance(laws[link], g, h, tuple(places)) for (link, g, h), places in of_way.items()]
