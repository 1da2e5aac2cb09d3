"""Proof that a scene is stable in mean square, over the network that it has, for all values in a box.

Takes: a `CompiledSystem` whose links lose or delay packets independently of each other, and ranges.
Gives: `prove_box`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named; what
can't be had is refused by name.
Does not: serve values that stand in, bursts or traces; leave a jitter open.

Of a cell of the box, each entry of a peer's matrices is a ball that holds its values all over the cell, and
so is each share that arrives. Frames composed of these, and loops closed of them, are matrices with radii
(`frame.radius`), of which G(1) comes with its own (`gains.stein`): where its largest eigenvalue is below 1,
the cell is proved. A cell where that fails is halved.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, prepare
from apc.analysis.box import OpenSites, open_sites
from apc.analysis.box_proof import (
    BITS,
    UNDECIDED,
    BoxProof,
    ball_radii,
    middle,
    one_by_one,
    range_ball,
    search_box,
    site_at,
)
from apc.analysis.cells import Cell
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.frozen import dataclass
from apc.compiler.timings import part
from apc.eigen.balls import frame_steps, precision
from apc.eigen.closing import without_packets
from apc.eigen.peer_group import PeerGroup
from apc.eigen.rigid import stays_rigid
from apc.frame.discretize import UNIT
from apc.frame.lift import compose, named
from apc.frame.names import Range
from apc.frame.overrides import Override, apply
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, radius_of, value_of
from apc.frame.site import LinearSite, every_matrix
from apc.moments.crowd import Hearing, crowd, hearing, peer_classes
from apc.moments.gains import TINY, Moments, below_1
from apc.moments.memory import is_memoryless
from apc.moments.network import STABLE, UNSTABLE, Growth, growth, unreliable
from apc.network.channel import channel_law
from apc.network.nominal import channel_numbers
from apc.threads import single_threaded

Floats = NDArray[np.float64]

PLACE = Place("box")


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A scene with ranges of what its peers are made of, `own`, and of what links lose."""

    system: CompiledSystem
    prepared: Prepared
    ranges: tuple[Range, ...]
    own: tuple[int, ...]  # places of the ranges that are no link's
    open: OpenSites
    told: Hearing
    weights: Floats  # how much each range matters


@part("box")
def prove_box(system: CompiledSystem, ranges: Sequence[Range]) -> BoxProof:
    """Prove a scene stable in mean square in a whole box, or find a point of it where it is not.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `analysis.box.parse_range`.

    Raises
    ------
    ApcError
        E898 the network can't be judged all over a box, by name; E831 and E832 as `box.open_sites`.
    """
    with single_threaded(), np.errstate(all="ignore"), precision(BITS):
        asked = _question(system, ranges)
        loops, _ = peer_classes(asked.told)
        for loop in loops:
            bare = without_packets(loop)
            if not stays_rigid(bare, [asked.open.sites[group.name] for group in bare.sites]):
                note = f"{loop.name} moves freely in a direction that changes with the parameters"
                return BoxProof(system.name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), (note,))
        is_unstable = partial(_is_unstable, asked)
        looks = partial(one_by_one, partial(_reach_out, asked), is_unstable)
        return search_box(system.name, ranges, looks, is_unstable, stable=STABLE, unstable=UNSTABLE)


def _question(system: CompiledSystem, ranges: Sequence[Range]) -> _Question:
    """Leave parameters open, and see how much each matters at the middle of the box."""
    numbers = channel_numbers(system)
    own = tuple(place for place, one in enumerate(ranges) if one.free.name not in numbers)
    prepared = prepare(system)

    def lifted(changed: CompiledSystem) -> Any:
        found = hearing(changed, prepared)
        return found.groups, found.exchange

    for one in ranges:  # inside the box, as a link may lose nothing at an end of it
        point = [each.low + (each.high - each.low) / 3 for each in ranges]
        _refuse(_changed(system, ranges, point), prepared, one)
    opened = open_sites(system, [ranges[place] for place in own], prepared, lifted)
    told = hearing(opened.at, prepared)
    asked = _Question(system, prepared, tuple(ranges), own, opened, told, np.ones(0))
    weights = []
    for place, varied in enumerate(ranges):
        point = [(one.low + one.high) / 2 for one in ranges]
        ends = [[*point[:place], end, *point[place + 1 :]] for end in (varied.low, varied.high)]
        low, high = (_growth_at(asked, one, bounded=False).radius for one in ends)
        weights.append(abs(high - low) / float(varied.high - varied.low))
    return replace(asked, weights=np.nan_to_num(weights, nan=1.0) + TINY)


def _refuse(system: CompiledSystem, prepared: Prepared, one: Range) -> None:
    """Refuse a network that a box is not proved over, and a range that is more than a share lost."""
    what = ""
    for link, law in unreliable(system):
        assert link.channel is not None
        if law.trace is not None:
            what = f"recorded delays of {link.name}"
        elif not is_memoryless(law):
            what = f"bursts of {link.name}"
        elif law.mean_loss and link.channel.on_loss == "zero":
            what = f"losses of {link.name} with on_loss: zero"
    losses = [link.channel.loss for link in system.links if link.channel and link.channel.loss]
    shares = {name for loss in losses for name in (loss.p, loss.r, loss.one_minus_h, loss.one_minus_k)}
    if one.free.name in channel_numbers(system) - shares:
        what = f"values of {one.free.label}, on which other numbers of a link depend"
    why = "" if what else growth(system, prepared, bounded=False).why
    if what or why:
        told = f"no box is proved in mean square over {what}" if what else f"no box is proved: {why}"
        hint = f"apc critical {one.free.label} --in mean-square"
        raise ApcError(Mistake("E898", PLACE, told, hint=hint))


def _changed(
    system: CompiledSystem, ranges: Sequence[Range], point: Sequence[Fraction], places: Sequence[int] = ()
) -> CompiledSystem:
    """Return the scene at a point of the box, or with some of its numbers."""
    chosen = places or range(len(ranges))
    return apply(system, [Override(ranges[place].free, point[place]) for place in chosen])


def _growth_at(asked: _Question, point: Sequence[Fraction], *, bounded: bool) -> Growth:
    return growth(_changed(asked.system, asked.ranges, point), asked.prepared, bounded=bounded)


def _is_unstable(asked: _Question, point: Sequence[Fraction]) -> bool:
    """Say whether it is proved that second moments grow at a point of the box."""
    if _growth_at(asked, point, bounded=False).radius < 1:
        return False
    found = _growth_at(asked, point, bounded=True)
    return found.proved and found.stable is False


def _reach_out(asked: _Question, cell: Cell) -> Floats | None:
    """Return None when a cell is proved, or else how much each range matters in it."""
    if below_1(_moments_of(asked, cell)):
        return None
    return asked.weights * [float(high - low) for low, high in cell]


def _moments_of(asked: _Question, cell: Cell) -> Moments:
    """Return the loops and the luck of all scenes in a cell."""
    balls = [range_ball(*cell[place]) for place in asked.own]
    groups = tuple(_lifted(group, asked.open.sites[group.name], balls) for group in asked.told.groups)
    system, doubts = asked.system, {}
    shares = [place for place in range(len(cell)) if place not in asked.own]
    if shares:
        system = _changed(system, asked.ranges, middle(cell), shares)
        # A share lost is multilinear in what it is made of, and so between its values at the corners.
        lost = [_lost(_changed(asked.system, asked.ranges, one, shares)) for one in itertools.product(*cell)]
        for name, share in _lost(system).items():
            doubts[name] = max(abs(one[name] - share) for one in lost) + 8 * UNIT
    return crowd(system, asked.prepared, told=replace(asked.told, groups=groups), doubts=doubts)


def _lost(system: CompiledSystem) -> dict[str, float]:
    """Return the share that each link loses."""
    timings = resolve(system).timings
    return {
        link.name: channel_law(system, link, timings[link.delay]).mean_loss
        for link in system.links
        if link.channel is not None
    }


def _lifted(group: PeerGroup, site: LinearSite, balls: Sequence[Any]) -> PeerGroup:
    """Return peers with the frame of all values that balls of their parameters hold."""
    inside = site_at(site, balls, None)
    steps = {duration: ball_radii(step) for duration, step in frame_steps(inside, group.schedule).items()}
    found = compose(every_matrix(inside, ball_radii), group.schedule, steps, numbers=RADII)
    kind, schedule = group.jacobians.kind, group.schedule
    return group.with_lifted(named(kind, schedule, found.mapped(value_of), found.mapped(radius_of)))
