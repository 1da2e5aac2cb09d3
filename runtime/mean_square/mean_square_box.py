"""Proof of mean-square stability for all parameter values in a box, over a lossy network.

Takes: a `Model` whose links lose or delay packets independently of each other, and ranges.
Gives: `prove_mean_square`.
Guarantees: a stable verdict is proved for every point of the box, an unstable one at the reported point.
Unsupported models are refused with the reason.
Does not: support substituted values, bursts or traces; treat jitter as uncertain.

The peers' frames are lifted over many cells of the box at once, and follow the parameters to first order with
a radius for all the rest (`frame.taylor_models`), as do the loss probability of each link and the
interconnected mean loops. A cell is proved if a Y is found with Y − T(Y) ≻ 0 and Y ≻ 0 over the cell
(`second_moment_operator.dies_out`); otherwise it is halved.
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

from apc.analysis.cell_bounds import Cell, ParametricFrames, frames_over, parametric_frames
from apc.analysis.parametric_frames import parametric_subsystems
from apc.analysis.robust_stability import (
    TOGETHER,
    UNDECIDED,
    CellVerdict,
    RobustStability,
    middle,
    search_box,
)
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.interconnection import ModalSystem, without_packets
from apc.eigen.rigid_modes import stays_rigid
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.frame.lift import FrameMap
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import Range
from apc.frame.parameters import resolve
from apc.frame.taylor_models import hull, within
from apc.mean_square.class_moments import (
    Classes,
    build_reception,
    classes_of,
    moments_of,
    peer_classes,
    stored_of,
)
from apc.mean_square.mean_dynamics import RouteMemory
from apc.mean_square.mean_square_stability import MeanSquareVerdict, mean_square_growth
from apc.mean_square.receiver_memory import is_memoryless
from apc.mean_square.second_moment_operator import dies_out
from apc.network.channel import channel_law
from apc.network.nominal_criterion import channel_numbers, unreliable
from apc.threads import single_threaded

Matrix = NDArray[Any]

LOCATION = SourceLocation("box")

# The cost of a float cell, in ball cells.
WORK = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A model with ranges of peer parameters, `local`, and of loss probabilities of links."""

    system: Model
    prepared: Prepared
    ranges: tuple[Range, ...]
    local: tuple[int, ...]  # places of the ranges that are no link's
    classes: Classes
    frames: ParametricFrames  # of all groups of peers
    indices: Mapping[str, int]  # which of these each subsystem of a loop is, by its name
    wide: ModalSystem  # of all classes, its maps those of the whole box
    memories: Sequence[RouteMemory]


@part("box")
def prove_mean_square(system: Model, ranges: Sequence[Range], *, cells: int | None = None) -> RobustStability:
    """Prove a model stable in mean square in a whole box, or find a point of it where it is not.

    Parameters
    ----------
    system
        The model.
    ranges
        The parameters left open, see `analysis.parametric_frames.parse_range`.
    cells
        As of `analysis.robust_stability.prove_robust_stability`.

    Raises
    ------
    ApcError
        E898 the network can't be judged all over a box, by name; E831 and E832 as
        `parametric_frames.parametric_subsystems`.
    """
    with single_threaded(), np.errstate(all="ignore"):
        question = _question(system, ranges)
        for loop in (separation.loop for separation in question.classes.loops):
            bare = without_packets(loop)
            if not stays_rigid(
                bare,
                [
                    question.frames.subsystems[question.indices[subsystem.name]]
                    for subsystem in bare.subsystems
                ],
            ):
                note = f"{loop.name} moves freely in a direction that changes with the parameters"
                return RobustStability(system.name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), (note,))
        is_unstable = partial(_is_unstable, question)
        cell_tests = partial(_test_cells, question), is_unstable
        return search_box(
            system.name,
            ranges,
            *cell_tests,
            stable=MeanSquareVerdict.STABLE,
            unstable=MeanSquareVerdict.UNSTABLE,
            cells=cells,
        )


def _question(system: Model, ranges: Sequence[Range]) -> _Question:
    """Leave parameters open, and see how wide each may be about the middle of the box."""
    numbers = channel_numbers(system)
    local = tuple(index for index, interval in enumerate(ranges) if interval.free.name not in numbers)
    prepared = prepare(system)

    def lifted(changed: Model) -> Any:
        result = build_reception(changed, prepared)
        return result.groups, result.exchange

    # The reference point is inside the box, as a link may have loss probability 0 at an end. It is shifted in
    # each range, because probabilities that add up to exactly 1 are those of bursts.
    inside = [interval.low + (interval.high - interval.low) / 3 for interval in ranges]
    _refuse(_changed(system, ranges, inside), prepared, ranges[0])
    for index, interval in enumerate(ranges):
        point = [*inside[:index], interval.high - (interval.high - interval.low) / 3, *inside[index + 1 :]]
        _refuse(_changed(system, ranges, point), prepared, interval)
    opened = parametric_subsystems(system, [ranges[index] for index in local], prepared, lifted)
    reception = build_reception(opened.at, prepared)
    subsystems = [opened.subsystems[group.name] for group in reception.groups]
    frames = parametric_frames(subsystems, [group.schedule for group in reception.groups])
    whole = tuple((ranges[index].low, ranges[index].high) for index in local)
    maps = [frame_map.mapped(lambda block: hull(block)[0]) for frame_map in frames_over(frames, [whole])]
    lifted_wide = [group.with_lifted(frame) for group, frame in zip(reception.groups, maps, strict=True)]
    wide = peer_classes(replace(reception, groups=tuple(lifted_wide)))[0]
    memories = stored_of(opened.at, reception, wide)
    classes = classes_of(reception)
    indices = {
        subsystem.name: next(
            index for index, group in enumerate(reception.groups) if subsystem.peers.first in group.peers
        )
        for subsystem in classes.common.subsystems
    }
    return _Question(system, prepared, tuple(ranges), local, classes, frames, indices, wide, memories)


def _refuse(system: Model, prepared: Prepared, interval: Range) -> None:
    """Refuse a network that a box is not proved over, and a range that is more than a share lost."""
    message = ""
    for link, law in unreliable(system):
        assert link.channel is not None
        if law.trace is not None:
            message = f"recorded delays of {link.name}"
        elif not is_memoryless(law):
            message = f"bursts of {link.name}"
        elif law.mean_loss and link.channel.on_loss == "zero":
            message = f"losses of {link.name} with on_loss: zero"
    losses = [link.channel.loss for link in system.links if link.channel and link.channel.loss]
    shares = {name for loss in losses for name in (loss.p, loss.r, loss.one_minus_h, loss.one_minus_k)}
    if interval.free.name in channel_numbers(system) - shares:
        message = f"values of {interval.free.label}, on which other numbers of a link depend"
    why = "" if message else mean_square_growth(system, prepared, bounded=False).why
    if message or why:
        text = f"no box is proved in mean square over {message}" if message else f"no box is proved: {why}"
        hint = f"apc critical {interval.free.label} --criterion mean-square"
        raise ApcError(Diagnostic("E898", LOCATION, text, hint=hint))


def _changed(
    system: Model, ranges: Sequence[Range], point: Sequence[Fraction], indices: Sequence[int] = ()
) -> Model:
    """Return the model at a point of the box, or with some of its numbers."""
    chosen = indices or range(len(ranges))
    return apply(system, [Override(ranges[index].free, point[index]) for index in chosen])


def _is_unstable(question: _Question, point: Sequence[Fraction]) -> bool:
    """Return whether growth of second moments at a point of the box is proved."""
    system = _changed(question.system, question.ranges, point)
    if mean_square_growth(system, question.prepared, bounded=False).radius < 1:
        return False
    result = mean_square_growth(system, question.prepared)
    return result.proved and result.stable is False


def _test_cells(question: _Question, cells: Sequence[Cell]) -> Iterator[CellVerdict]:
    """Yield the verdicts of cells, whose frames are lifted in batches, until one is unstable."""
    widths = np.array([float(interval.high - interval.low) for interval in question.ranges])
    for start in range(0, len(cells), TOGETHER):
        some = cells[start : start + TOGETHER]
        maps = frames_over(question.frames, [tuple(cell[index] for index in question.local) for cell in some])
        for index, cell in enumerate(some):
            lifted = [frame_map.mapped(partial(_of_cell, index, len(cell))) for frame_map in maps]
            proved, sound = _proved(question, cell, lifted)
            reach = np.array([float(high - low) for low, high in cell]) / widths
            yield CellVerdict(
                None if proved else reach, not sound and _is_unstable(question, middle(cell)), WORK
            )


def _of_cell(index: int, count: int, block: Matrix) -> Matrix:
    """Return the matrix of one cell (2 + m, n, n'), of as many parameters, from those of all."""
    item = block[min(index, len(block) - 1)]
    return within(item, count - len(item) + 2)


def _proved(question: _Question, cell: Cell, lifted: Sequence[FrameMap]) -> tuple[bool, bool]:
    """Return whether second moments decay: proved over a cell, and in floats at its center."""
    if not all(np.isfinite(block).all() for frame_map in lifted for block in frame_map.blocks):
        return False, False
    frames = {name: lifted[which] for name, which in question.indices.items()}
    of = moments_of(question.classes, _memories(question, cell), frames)
    return dies_out(of.operator)


def _memories(question: _Question, cell: Cell) -> Sequence[RouteMemory]:
    """Return the receiver memory of each route, for all loss probabilities in a cell."""
    shares = [index for index in range(len(cell)) if index not in question.local]
    if not shares:
        return question.memories
    system = _changed(question.system, question.ranges, middle(cell), shares)
    moved = _moves(question, cell, shares)
    return stored_of(system, question.classes.reception, question.wide, lost=moved)


def _moves(question: _Question, cell: Cell, shares: Sequence[int]) -> dict[str, tuple[float, ...]]:
    """Return each link's change of loss probability over a cell, after the bound of its nonlinear part.

    It is multilinear in what it is made of, and what is not straight is so too: largest at a corner.
    """
    inner = middle(cell)

    def lost(point: Sequence[Fraction]) -> dict[str, float]:
        changed = _changed(question.system, question.ranges, point, shares)
        timings = resolve(changed).timings
        links = [link for link in changed.links if link.channel is not None]
        return {link.name: channel_law(changed, link, timings[link.delay]).mean_loss for link in links}

    still, sides = lost(inner), []
    for index in shares:
        ends = [lost([*inner[:index], end, *inner[index + 1 :]]) for end in cell[index]]
        sides.append({name: (ends[1][name] - ends[0][name]) / 2 for name in still})
    error_bound = dict.fromkeys(still, 0.0)
    for rotations in itertools.product((0, 1), repeat=len(shares)):
        point = list(inner)
        for index, turn in zip(shares, rotations, strict=True):
            point[index] = cell[index][turn]
        for name, share in lost(point).items():
            straight = sum((2 * turn - 1) * side[name] for turn, side in zip(rotations, sides, strict=True))
            error_bound[name] = max(error_bound[name], abs(share - still[name] - straight))
    first = len(question.local) * (0.0,)
    return {
        name: (error_bound[name] + 16 * UNIT_ROUNDOFF, *first, *(side[name] for side in sides))
        for name in still
    }
