"""Proof that a scene is stable in mean square, over the network that it has, for all values in a box.

Takes: a `Model` whose links lose or delay packets independently of each other, and ranges.
Gives: `prove_box`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named; what
can't be had is refused by name.
Does not: serve values that stand in, bursts or traces; leave a jitter open.

The peers' frames are lifted over many cells of the box at once, and follow the parameters to first order
with a radius for all the rest (`frame.taylor`), as does the share that each link loses; so do the loops of
means closed of them. A cell is proved where moments Y are found with Y − T(Y) ≻ 0 and Y ≻ 0 all over it
(`operator.dies_out`); one where that fails is halved.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.box import open_sites
from apc.analysis.box_proof import TOGETHER, UNDECIDED, CellVerdict, RobustStability, middle, search_box
from apc.analysis.cells import Cell, ParametricFrames, frames_over, open_frames
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.closing import ModalSystem, without_packets
from apc.eigen.rigid import stays_rigid
from apc.frame.instance import Prepared, prepare
from apc.frame.lift import FrameMap
from apc.frame.names import Range
from apc.frame.overrides import Override, apply
from apc.frame.parameters import resolve
from apc.frame.radius import UNIT
from apc.frame.taylor import hull, within
from apc.moments.crowd import Classes, build_hearing, classes_of, moments_of, peer_classes, remembered_of
from apc.moments.mean_loops import RouteMemory
from apc.moments.network_verdict import MeanSquareVerdict, growth
from apc.moments.operator import dies_out
from apc.moments.packet_memory import is_memoryless
from apc.network.channel import channel_law
from apc.network.nominal import channel_numbers, unreliable
from apc.threads import single_threaded

Matrix = NDArray[Any]

PLACE = SourceLocation("box")

# What a cell takes, in cells in balls.
WORK = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A scene with ranges of what its peers are made of, `own`, and of what links lose."""

    system: Model
    prepared: Prepared
    ranges: tuple[Range, ...]
    own: tuple[int, ...]  # places of the ranges that are no link's
    classes: Classes
    frames: ParametricFrames  # of all groups of peers
    places: Mapping[str, int]  # which of these each site of a loop is, by its name
    wide: ModalSystem  # of all classes, its maps those of the whole box
    memories: Sequence[RouteMemory]


@part("box")
def prove_box(system: Model, ranges: Sequence[Range], *, cells: int | None = None) -> RobustStability:
    """Prove a scene stable in mean square in a whole box, or find a point of it where it is not.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `analysis.box.parse_range`.
    cells
        As of `analysis.box_proof.prove_box`.

    Raises
    ------
    ApcError
        E898 the network can't be judged all over a box, by name; E831 and E832 as `box.open_sites`.
    """
    with single_threaded(), np.errstate(all="ignore"):
        asked = _question(system, ranges)
        for loop in (apart.loop for apart in asked.classes.loops):
            bare = without_packets(loop)
            if not stays_rigid(bare, [asked.frames.sites[asked.places[site.name]] for site in bare.sites]):
                note = f"{loop.name} moves freely in a direction that changes with the parameters"
                return RobustStability(system.name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), (note,))
        is_unstable = partial(_is_unstable, asked)
        looks = partial(_looked, asked), is_unstable
        return search_box(
            system.name,
            ranges,
            *looks,
            stable=MeanSquareVerdict.STABLE,
            unstable=MeanSquareVerdict.UNSTABLE,
            cells=cells,
        )


def _question(system: Model, ranges: Sequence[Range]) -> _Question:
    """Leave parameters open, and see how wide each may be about the middle of the box."""
    numbers = channel_numbers(system)
    own = tuple(place for place, interval in enumerate(ranges) if interval.free.name not in numbers)
    prepared = prepare(system)

    def lifted(changed: Model) -> Any:
        result = build_hearing(changed, prepared)
        return result.groups, result.exchange

    # Inside the box, as a link may lose nothing at an end of it; and moved along each range, as chances that
    # add up to 1 somewhere, by chance, are those of bursts beside it.
    inside = [interval.low + (interval.high - interval.low) / 3 for interval in ranges]
    _refuse(_changed(system, ranges, inside), prepared, ranges[0])
    for place, interval in enumerate(ranges):
        point = [*inside[:place], interval.high - (interval.high - interval.low) / 3, *inside[place + 1 :]]
        _refuse(_changed(system, ranges, point), prepared, interval)
    opened = open_sites(system, [ranges[place] for place in own], prepared, lifted)
    hearing = build_hearing(opened.at, prepared)
    sites = [opened.sites[group.name] for group in hearing.groups]
    frames = open_frames(sites, [group.schedule for group in hearing.groups])
    whole = tuple((ranges[place].low, ranges[place].high) for place in own)
    maps = [frame_map.mapped(lambda block: hull(block)[0]) for frame_map in frames_over(frames, [whole])]
    lifted_wide = [group.with_lifted(frame) for group, frame in zip(hearing.groups, maps, strict=True)]
    wide = peer_classes(replace(hearing, groups=tuple(lifted_wide)))[0]
    memories = remembered_of(opened.at, hearing, wide)
    classes = classes_of(hearing)
    places = {
        site.name: next(
            place for place, group in enumerate(hearing.groups) if site.peers.first in group.peers
        )
        for site in classes.common.sites
    }
    return _Question(system, prepared, tuple(ranges), own, classes, frames, places, wide, memories)


def _refuse(system: Model, prepared: Prepared, interval: Range) -> None:
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
    if interval.free.name in channel_numbers(system) - shares:
        what = f"values of {interval.free.label}, on which other numbers of a link depend"
    why = "" if what else growth(system, prepared, bounded=False).why
    if what or why:
        text = f"no box is proved in mean square over {what}" if what else f"no box is proved: {why}"
        hint = f"apc critical {interval.free.label} --in mean-square"
        raise ApcError(Diagnostic("E898", PLACE, text, hint=hint))


def _changed(
    system: Model, ranges: Sequence[Range], point: Sequence[Fraction], places: Sequence[int] = ()
) -> Model:
    """Return the scene at a point of the box, or with some of its numbers."""
    chosen = places or range(len(ranges))
    return apply(system, [Override(ranges[place].free, point[place]) for place in chosen])


def _is_unstable(asked: _Question, point: Sequence[Fraction]) -> bool:
    """Say whether it is proved that second moments grow at a point of the box."""
    system = _changed(asked.system, asked.ranges, point)
    if growth(system, asked.prepared, bounded=False).radius < 1:
        return False
    result = growth(system, asked.prepared)
    return result.proved and result.stable is False


def _looked(asked: _Question, cells: Sequence[Cell]) -> Iterator[CellVerdict]:
    """Look at cells, their frames lifted many at a time, until one is found unstable."""
    widths = np.array([float(interval.high - interval.low) for interval in asked.ranges])
    for start in range(0, len(cells), TOGETHER):
        some = cells[start : start + TOGETHER]
        maps = frames_over(asked.frames, [tuple(cell[place] for place in asked.own) for cell in some])
        for place, cell in enumerate(some):
            lifted = [frame_map.mapped(partial(_of_cell, place, len(cell))) for frame_map in maps]
            proved, sound = _proved(asked, cell, lifted)
            reach = np.array([float(high - low) for low, high in cell]) / widths
            yield CellVerdict(
                None if proved else reach, not sound and _is_unstable(asked, middle(cell)), WORK
            )


def _of_cell(place: int, count: int, block: Matrix) -> Matrix:
    """Return the matrix of one cell (2 + m, n, n'), of as many parameters, from those of all."""
    item = block[min(place, len(block) - 1)]
    return within(item, count - len(item) + 2)


def _proved(asked: _Question, cell: Cell, lifted: Sequence[FrameMap]) -> tuple[bool, bool]:
    """Say whether second moments die out, proved all over a cell, and in floats in its middle."""
    if not all(np.isfinite(block).all() for frame_map in lifted for block in frame_map.blocks):
        return False, False
    frames = {name: lifted[which] for name, which in asked.places.items()}
    of = moments_of(asked.classes, _memories(asked, cell), frames)
    return dies_out(of.operator)


def _memories(asked: _Question, cell: Cell) -> Sequence[RouteMemory]:
    """Return what is remembered on each route, for all shares lost in a cell."""
    shares = [place for place in range(len(cell)) if place not in asked.own]
    if not shares:
        return asked.memories
    system = _changed(asked.system, asked.ranges, middle(cell), shares)
    moved = _moves(asked, cell, shares)
    return remembered_of(system, asked.classes.hearing, asked.wide, lost=moved)


def _moves(asked: _Question, cell: Cell, shares: Sequence[int]) -> dict[str, tuple[float, ...]]:
    """Return how the share that each link loses changes over a cell, after what of that is not straight.

    It is multilinear in what it is made of, and what is not straight is so too: largest at a corner.
    """
    inner = middle(cell)

    def lost(point: Sequence[Fraction]) -> dict[str, float]:
        changed = _changed(asked.system, asked.ranges, point, shares)
        timings = resolve(changed).timings
        links = [link for link in changed.links if link.channel is not None]
        return {link.name: channel_law(changed, link, timings[link.delay]).mean_loss for link in links}

    still, sides = lost(inner), []
    for place in shares:
        ends = [lost([*inner[:place], end, *inner[place + 1 :]]) for end in cell[place]]
        sides.append({name: (ends[1][name] - ends[0][name]) / 2 for name in still})
    off = dict.fromkeys(still, 0.0)
    for turns in itertools.product((0, 1), repeat=len(shares)):
        point = list(inner)
        for place, turn in zip(shares, turns, strict=True):
            point[place] = cell[place][turn]
        for name, share in lost(point).items():
            straight = sum((2 * turn - 1) * side[name] for turn, side in zip(turns, sides, strict=True))
            off[name] = max(off[name], abs(share - still[name] - straight))
    first = len(asked.own) * (0.0,)
    return {name: (off[name] + 16 * UNIT, *first, *(side[name] for side in sides)) for name in still}
