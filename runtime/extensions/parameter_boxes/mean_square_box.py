"""Proof of mean-square stability for all parameter values in a box, over a lossy network.

Takes: a `Model` whose links lose or delay packets independently of each other, and ranges.
Gives: `prove_mean_square`.
Guarantees: a stable verdict is proved for every point of the box, an unstable one at the reported point.
Unsupported models are refused with the reason.
Does not: support substituted values, bursts or traces; treat jitter as uncertain.

The peers' frames are lifted over many cells of the box at once, and follow the parameters to first order with
a radius for all the rest (`lifting.taylor_models`), as do the loss probability of each link and the
interconnected mean loops. A cell is proved if a Y is found with Y − T(Y) ≻ 0 and Y ≻ 0 over the cell
(`second_moment_operator.proves_decay`); otherwise it is halved.
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

from apc.analysis.box_result import UNDECIDED, RobustStability
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.extensions.parameter_boxes.cell_bounds import Cell, ParametricFrames, frames_over, parametric_frames
from apc.extensions.parameter_boxes.parametric_frames import parametric_subsystems
from apc.extensions.parameter_boxes.robust_stability import (
    TOGETHER,
    CellVerdict,
    middle,
    search_box,
)
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.lift import FrameMap
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.lifting.taylor_models import hull, within
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.mean_square.class_moments import (
    Classes,
    build_reception,
    classes_of,
    common_modal_system,
    moments_of,
    stored_of,
)
from apc.mean_square.mean_dynamics import Route, RouteMemory
from apc.mean_square.mean_square_stability import MeanSquareVerdict, mean_square_growth
from apc.mean_square.receiver_memory import is_memoryless
from apc.mean_square.second_moment_operator import proves_decay
from apc.network.channel import channel_law
from apc.network.nominal_criterion import channel_numbers, unreliable
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import Range
from apc.spectrum.interconnection import ModalSystem, without_packets
from apc.spectrum.rigid_modes import stays_rigid
from apc.support.threads import single_threaded

Matrix = NDArray[Any]

LOCATION = SourceLocation("box")

# The cost of a float cell, in ball cells.
WORK = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _BoxProblem:
    """A model with ranges of peer parameters (`local`), and of loss probabilities of links."""

    numeric: NumericModel
    ranges: tuple[Range, ...]
    local: tuple[int, ...]  # the indices of the ranges of peer parameters
    classes: Classes
    subsystems: tuple[LinearSubsystem, ...]  # of all peer classes, over `Fraction` and `Ratio`
    frames: ParametricFrames
    indices: Mapping[str, int]  # the index in `subsystems` of each subsystem of a loop, by its name
    wide: ModalSystem  # the loop of all classes, with frame maps over the box
    memories: Sequence[RouteMemory]


@part("box")
def prove_mean_square(model: Model, ranges: Sequence[Range], *, cells: int | None = None) -> RobustStability:
    """Return a proof of mean-square stability in a box, an unstable point of the box, or neither (undecided).

    Parameters
    ----------
    model
        The model.
    ranges
        The ranges of the parameters, see `extensions.parameter_boxes.parametric_frames.parse_range`.
    cells
        As for `extensions.parameter_boxes.robust_stability.prove_robust_stability`.

    Raises
    ------
    ApcError
        E898 the network has a property, named in the message, without a proof over boxes; E831 and E832 as
        `parametric_frames.parametric_subsystems`.
    """
    with single_threaded(), np.errstate(all="ignore"):
        problem = _box_problem(model, ranges)
        for modal_system in (separation.modal_system for separation in problem.classes.loops):
            loop_without_packets = without_packets(modal_system)
            if not stays_rigid(
                loop_without_packets,
                [
                    problem.subsystems[problem.indices[peer_class.name]]
                    for peer_class in loop_without_packets.peer_classes
                ],
            ):
                note = (
                    f"{modal_system.name}: a rigid mode has a direction that depends on the parameters, "
                    "so no box can be proved"
                )
                return RobustStability(model.name, tuple(ranges), UNDECIDED, None, 0, 1.0, (), (note,))
        is_unstable = partial(_is_unstable, problem)
        cell_tests = partial(_test_cells, problem), is_unstable
        return search_box(
            model.name,
            ranges,
            *cell_tests,
            stable=MeanSquareVerdict.STABLE,
            unstable=MeanSquareVerdict.UNSTABLE,
            cells=cells,
        )


def _box_problem(model: Model, ranges: Sequence[Range]) -> _BoxProblem:
    """Return a model with its parametric frames, and the receiver memory at the middle of the box."""
    numbers = channel_numbers(model)
    peer_ranges = tuple(index for index, interval in enumerate(ranges) if interval.free.name not in numbers)
    numeric = numeric_model(model)

    def lifted(changed: Model) -> Any:
        """Return the peer classes and the communication graph of a model with a row of r for each tick."""
        result = build_reception(numeric.at(changed))
        return result.peer_classes, result.comm_graph

    # The reference point is inside the box, as a link may have loss probability 0 at an end. It is shifted in
    # each range, because probabilities that add up to exactly 1 are those of bursts.
    reference = [interval.low + (interval.high - interval.low) / 3 for interval in ranges]
    _refuse_range(numeric.at(_model_at_point(model, ranges, reference)), ranges[0])
    for index, interval in enumerate(ranges):
        point = [
            *reference[:index],
            interval.high - (interval.high - interval.low) / 3,
            *reference[index + 1 :],
        ]
        _refuse_range(numeric.at(_model_at_point(model, ranges, point)), interval)
    parametric = parametric_subsystems(numeric, [ranges[index] for index in peer_ranges], lifted)
    reception = build_reception(numeric.at(parametric.at))
    subsystems = tuple(parametric.subsystems[peer_class.name] for peer_class in reception.peer_classes)
    frames = parametric_frames(subsystems, reception.peer_classes)
    box = tuple((ranges[index].low, ranges[index].high) for index in peer_ranges)
    maps = [frame_map.mapped(lambda block: hull(block)[0]) for frame_map in frames_over(frames, (box,))]
    lifted_wide = [
        peer_class.with_lifted(frame) for peer_class, frame in zip(reception.peer_classes, maps, strict=True)
    ]
    loop_over_box = common_modal_system(replace(reception, peer_classes=tuple(lifted_wide)))[0]
    memories = stored_of(parametric.at, reception, loop_over_box)
    classes = classes_of(reception)
    indices = {
        peer_class.name: next(
            index
            for index, candidate in enumerate(reception.peer_classes)
            if peer_class.peers.first in candidate.peers
        )
        for peer_class in classes.common.peer_classes
    }
    return _BoxProblem(
        numeric, tuple(ranges), peer_ranges, classes, subsystems, frames, indices, loop_over_box, memories
    )


def _refuse_range(numeric: NumericModel, interval: Range) -> None:
    """Raise ApcError E898 for a network or a range for which no box is proved."""
    model = numeric.model
    message = ""
    for _, law in unreliable(model):
        if law.trace is not None:
            message = f"recorded delays of {law.label}"
        elif not is_memoryless(law):
            message = f"bursts of {law.label}"
        elif law.mean_loss and law.zero:
            message = f"losses of {law.label} with on_loss: zero"
    losses = [channel.loss for link in model.links for channel in link.channels if channel.loss]
    shares = {name for loss in losses for name in (loss.p, loss.r, loss.one_minus_h, loss.one_minus_k)}
    if interval.free.name in channel_numbers(model) - shares:
        message = f"{interval.free.label}, which determines other parameters of a link"
    why = "" if message else mean_square_growth(numeric, bounded=False).why
    if message or why:
        text = f"no box is proved in mean square over {message}" if message else f"no box is proved: {why}"
        fix = f"apc critical {interval.free.label} --criterion {'nominal' if why else 'mean-square'}"
        if why and interval.free.name in channel_numbers(model):
            fix = "apc simulate"
        raise ApcError(Diagnostic("E898", LOCATION, text, fix=fix))


def _model_at_point(
    model: Model, ranges: Sequence[Range], point: Sequence[Fraction], indices: Sequence[int] = ()
) -> Model:
    """Return the model at a point of the box, with all ranges or some set."""
    chosen = indices or range(len(ranges))
    return apply(model, [Override(ranges[index].free, point[index]) for index in chosen])


def _is_unstable(problem: _BoxProblem, point: Sequence[Fraction]) -> bool:
    """Return whether growth of second moments at a point of the box is proved."""
    numeric = problem.numeric.at(_model_at_point(problem.numeric.model, problem.ranges, point))
    if mean_square_growth(numeric, bounded=False).radius < 1:
        return False
    result = mean_square_growth(numeric)
    return result.proved and result.stable is False


def _test_cells(problem: _BoxProblem, cells: Sequence[Cell]) -> Iterator[CellVerdict]:
    """Yield the verdicts of cells, whose frames are lifted in batches, until one is unstable."""
    widths = np.array([float(interval.high - interval.low) for interval in problem.ranges])
    for start in range(0, len(cells), TOGETHER):
        batch = cells[start : start + TOGETHER]
        local = tuple(tuple(cell[index] for index in problem.local) for cell in batch)
        maps = frames_over(problem.frames, local)
        for index, cell in enumerate(batch):
            lifted = [frame_map.mapped(partial(_cell_matrix, index, len(cell))) for frame_map in maps]
            proved, decays = _proves_cell(problem, cell, lifted)
            reach = np.array([float(high - low) for low, high in cell]) / widths
            yield CellVerdict(
                None if proved else reach, not decays and _is_unstable(problem, middle(cell)), WORK
            )


def _cell_matrix(index: int, count: int, block: Matrix) -> Matrix:
    """Return the matrix of one cell (2 + m, n, n') over `count` parameters, from the matrices of
    all cells.
    """
    item = block[min(index, len(block) - 1)]
    return within(item, count - len(item) + 2)


def _proves_cell(problem: _BoxProblem, cell: Cell, lifted: Sequence[FrameMap]) -> tuple[bool, bool]:
    """Return whether decay of second moments is proved over a cell, and whether they decay at its centre in
    floats.
    """
    if not all(np.isfinite(block).all() for frame_map in lifted for block in frame_map.blocks):
        return False, False
    frames = {name: lifted[index] for name, index in problem.indices.items()}
    moments = moments_of(problem.classes, _memories(problem, cell), frames)
    return proves_decay(moments.operator)


def _memories(problem: _BoxProblem, cell: Cell) -> Sequence[RouteMemory]:
    """Return the receiver memory of each route, for all loss probabilities in a cell."""
    shares = [index for index in range(len(cell)) if index not in problem.local]
    if not shares:
        return problem.memories
    model = _model_at_point(problem.numeric.model, problem.ranges, middle(cell), shares)
    changes = _loss_changes(problem, cell, shares)
    return stored_of(model, problem.classes.reception, problem.wide, lost=changes)


def _loss_changes(problem: _BoxProblem, cell: Cell, shares: Sequence[int]) -> dict[Route, tuple[float, ...]]:
    """Return, for each route, the bound of the nonlinear part of its loss probability, and its changes over
    a cell.

    The loss probability is multilinear in the parameters, and so is its nonlinear part, which is largest at a
    corner.
    """
    inner = middle(cell)

    def lost(point: Sequence[Fraction]) -> dict[Route, float]:
        """Return the mean loss probability of each route at a point."""
        changed = _model_at_point(problem.numeric.model, problem.ranges, point, shares)
        links = [link for link in changed.links if link.channel is not None]
        routes = [(link, delay) for link in links for delay in link.delays]
        return {(link.name, delay): channel_law(changed, link, delay).mean_loss for link, delay in routes}

    at_centre, sides = lost(inner), []
    for index in shares:
        ends = [lost([*inner[:index], end, *inner[index + 1 :]]) for end in cell[index]]
        sides.append({name: (ends[1][name] - ends[0][name]) / 2 for name in at_centre})
    error_bound = dict.fromkeys(at_centre, 0.0)
    for corner in itertools.product((0, 1), repeat=len(shares)):
        point = list(inner)
        for index, upper in zip(shares, corner, strict=True):
            point[index] = cell[index][upper]
        for name, share in lost(point).items():
            linear_part = sum((2 * upper - 1) * side[name] for upper, side in zip(corner, sides, strict=True))
            error_bound[name] = max(error_bound[name], abs(share - at_centre[name] - linear_part))
    first = len(problem.local) * (0.0,)
    return {
        name: (error_bound[name] + 16 * UNIT_ROUNDOFF, *first, *(side[name] for side in sides))
        for name in at_centre
    }
