"""The one-sided linear models of a topology whose peers start at a kink.

Takes: a `NumericModel`.
Gives: `Side`, `SideVerdict`, `sides`, `worst_side`, `severity`.
Guarantees: every combination of the pieces that meet at the start values, up to MOST_SIDES; without kinks
there, the topology itself, and nothing is computed twice.
Does not: determine which combinations a motion of several peers reaches: all are analyzed.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import Group, PeerColumn
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.initial_reception import StartClasses
from apc.lifting.numeric_model import NumericModel
from apc.linearization.branch_conditions import SwitchedPeerType, find_switches
from apc.linearization.evaluation_errors import at_part, finite_equations, part_of
from apc.linearization.jacobians import DECIDING, SubsystemJacobians, with_equations
from apc.linearization.kinks import (
    EQUAL,
    LinearPiece,
    Moving,
    Point,
    at_a_kink,
    equal,
    linear_pieces_at,
    names_of,
    one_sided_peer_type,
    tie_indicators,
)
from apc.linearization.linearize import at_start, of_rows, start_values
from apc.spectrum.peer_classes import start_classes
from apc.verdict import StabilityVerdict

# Combinations of pieces that are analyzed one by one; peers of a group that are divided to find them.
MOST_SIDES, MOST_PEERS = 16, 64
# Inside a nonlinear loop: random directions, steps from the start (SI), and the relative gap of slopes
# between both ends of a step: at a kink it stays, on a curve it shrinks with the step.
DIRECTIONS, STEPS, HALF_STEEP, LEAST_GAP = 8, (1e-7, 1e-8, 1e-9), 0.5, 1e-6

_Selection = tuple[tuple[int, bool], ...]  # the setting of each tied decision of a peer type, by its index


@dataclass(frozen=True, slots=True)
class Side:
    """One combination of linear pieces at the start values: `name` such as "wall.push on", "" without kinks.

    `numeric` has a separate peer type for each group on another side.
    """

    name: str
    numeric: NumericModel


@dataclass(frozen=True, slots=True)
class SideVerdict:
    """The verdict of one combination of linear pieces; the spectral radius is per frame."""

    name: str
    verdict: StabilityVerdict
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float


def worst_side(verdicts: Sequence[SideVerdict]) -> int:
    """Return the index of the worst verdict; with neutral motions a stable side is worse than without."""

    def key(n: int) -> tuple[int, bool, float]:
        """Return the severity of a verdict, neutral motions before the spectral radius."""
        rank, radius = severity(verdicts[n].stable, verdicts[n].spectral_radius)
        return rank, verdicts[n].verdict is not StabilityVerdict.STABLE, radius

    return max(range(len(verdicts)), key=key)


def severity(stable: bool | None, measure: float) -> tuple[int, float]:
    """Return a sort key for the verdict of one side; the side with the largest key is the worst.

    Parameters
    ----------
    stable
        Whether the side is stable; None (undecided) ranks between stable and unstable.
    measure
        Orders sides with equal verdicts, larger is worse: a spectral radius, or the additional damping that
        is required. NaN is worst.
    """
    return {False: 2, None: 1, True: 0}[stable], math.inf if math.isnan(measure) else measure


def sides(numeric: NumericModel) -> tuple[Side, ...]:
    """Return the linear models on all sides of the kinks at the start values.

    Without kinks, the only result is the model itself.

    Parameters
    ----------
    numeric
        The model with its parameter values.

    Raises
    ------
    ApcError
        E808 an equation that jumps at the start values, a kink in a sum over several senders, or more than
        MOST_SIDES combinations.
    """
    model = numeric.model
    if numeric.starting or all(_has_no_kinks(numeric.jacobians[group.peer_type]) for group in model.groups):
        return (Side("", numeric),)
    with finite_equations(model), np.errstate(all="ignore"):
        may_have_kink = [_near_a_kink(numeric, index) for index in range(len(model.groups))]
        if not any(may_have_kink):
            return (Side("", numeric),)
        # Peers of one group may be on different sides.
        origins = [
            index
            for index, group in enumerate(model.groups)
            for _ in range(group.count if may_have_kink[index] and group.count <= MOST_PEERS else 1)
        ]
        parts = _divided_groups(model.groups, origins)
        schedules = tuple(numeric.schedules[index] for index in origins)
        divided = replace(numeric, model=replace(model, groups=parts), given_schedules=schedules)
        try:
            pieces = _pieces_of_groups(divided, [may_have_kink[index] for index in origins])
        except ApcError as error:
            origin = model.origin
            raise ApcError(
                at_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
            ) from None
    if not any(piece.selected for group_pieces in pieces for piece in group_pieces):
        return (Side("", numeric),)
    exchangeable = _interchangeable(divided, origins, pieces)
    count = math.prod(math.comb(len(peers) + len(pieces[peers[0]]) - 1, len(peers)) for peers in exchangeable)
    large = any(
        len(group_pieces) > 1 and group.count > 1 for group, group_pieces in zip(parts, pieces, strict=True)
    )  # not divided
    if count > MOST_SIDES or large:
        raise _combinations_error(divided, pieces)
    names = [
        _piece_names(find_switches(subsystem.equations), group_pieces)
        for subsystem, group_pieces in zip(divided.subsystems, pieces, strict=True)
    ]
    result = []
    choices = (
        itertools.combinations_with_replacement(range(len(pieces[peers[0]])), len(peers))
        for peers in exchangeable
    )
    for indices in itertools.product(*choices):
        side_of = dict(zip(itertools.chain(*exchangeable), itertools.chain(*indices), strict=True))
        texts = [names[n][side_of[n]] for n in range(len(parts))]
        selected = [pieces[n][side_of[n]] for n in range(len(parts))]
        result.append(_side(divided, origins, selected, _combination_name(divided, pieces, texts)))
    return tuple(result)


def _divided_groups(groups: Sequence[Group], origins: Sequence[int]) -> tuple[Group, ...]:
    """Return the groups in the order of `origins`.

    Groups with several entries are divided into single peers.
    """
    counts, result, next_row = Counter(origins), [], Counter[int]()
    for index in origins:
        group = groups[index]
        if counts[index] == 1:
            result.append(group)
            continue
        row = slice(next_row[index], next_row[index] + 1)
        columns = tuple(PeerColumn(column.name, column.values[row]) for column in group.columns)
        result.append(replace(group, count=1, columns=columns))
        next_row[index] += 1
    return tuple(result)


def _interchangeable(
    numeric: NumericModel, origins: Sequence[int], pieces: Sequence[tuple[LinearPiece, ...]]
) -> list[list[int]]:
    """Return the indices of groups in classes whose members may exchange their sides."""
    complete = all(map(numeric.comm_graph.is_complete, numeric.comm_graph.links))
    classes: dict[object, list[int]] = {}
    for n, origin in enumerate(origins):
        parameters = numeric.numbers.parameters[n].tobytes()
        selected = tuple(piece.selected for piece in pieces[n])
        classes.setdefault((origin, parameters, selected) if complete else n, []).append(n)
    return list(classes.values())


def _combination_name(
    numeric: NumericModel, pieces: Sequence[tuple[LinearPiece, ...]], texts: Sequence[str]
) -> str:
    """Return the name of a combination: its sides, each with its groups or peers if several groups have
    kinks.

    `pieces` are the linear pieces of each group at the start, `texts` the side of each group, empty without a
    kink.
    """
    groups, starts = numeric.model.groups, numeric.comm_graph.starts
    totals: Counter[str] = Counter()
    peers: dict[tuple[str, str], list[str]] = {}
    for group, text, first_peer in zip(groups, texts, starts[:-1].tolist(), strict=True):
        totals[group.name] += group.count
        if text:
            peers.setdefault((group.name, text), []).append(numeric.comm_graph.peer_name(first_peer))
    kinked = {group.name for group, group_pieces in zip(groups, pieces, strict=True) if len(group_pieces) > 1}
    words = []
    for (name, text), peer_names in peers.items():
        complete_group = len(peer_names) == totals[name]
        where = name if complete_group else ", ".join(peer_names)
        words.append(text if complete_group and len(kinked) == 1 else f"{text} at {where}")
    return "; ".join(words)


def _has_no_kinks(subsystem: SubsystemJacobians) -> bool:
    """Return whether no decision of a peer type changes a slope, at any point."""
    if subsystem.affine and not subsystem.edges:
        return True
    return not subsystem.edges and subsystem.walkable and tie_indicators(subsystem.equations) is None


def _pieces_of_groups(numeric: NumericModel, near: Sequence[bool]) -> list[tuple[LinearPiece, ...]]:
    """Return the linear pieces of each group at its start values; groups with `near` False have one piece."""
    single_piece = (LinearPiece((), (), np.zeros(0), np.zeros((0, 0))),)
    classes = start_classes(numeric)
    starting = StartClasses(numeric, classes)
    result: list[list[tuple[LinearPiece, ...]]] = [[] for _ in near]
    for class_index, peers in enumerate(classes):
        # A class of equal start values may contain peers of several groups.
        groups = {numeric.comm_graph.group_of(run.start) for run in peers.runs}
        subsystem = starting.subsystems[class_index]
        if not any(near[group] for group in groups):
            continue
        if not subsystem.walkable:
            _refuse_hidden_kink(subsystem, starting, class_index)
            continue
        switched = find_switches(subsystem.equations)
        for point in _points(starting, class_index):
            pieces = linear_pieces_at(switched, point, every=True)
            _refuse_several_senders(switched, starting, class_index, pieces)
            for group in groups:
                result[group].append(pieces)
    return [
        _combined_pieces(pieces_at_points) if pieces_at_points else single_piece
        for pieces_at_points in result
    ]


def _near_a_kink(numeric: NumericModel, index: int) -> bool:
    """Return whether peers of a group may start at a kink; False is proved."""
    subsystem = numeric.subsystems[index]
    if _has_no_kinks(subsystem):
        return False
    start = at_start(subsystem)
    if start is None or start.ties is None:
        return start is None
    (ties,) = of_rows(start.ties, {4: numeric.numbers.parameters[index]})
    return bool((ties > 0).any())


def _points(starting: StartClasses, class_index: int) -> Iterable[Point]:
    """Yield the points at which a class is linearized: one for each combination of different senders'
    values.
    """
    subsystem = starting.subsystems[class_index]
    parameters = starting.parameters[class_index]
    x, u, m = start_values(subsystem, parameters)
    initial_reception, _ = starting.reception(class_index)
    received = iter(initial_reception.values)
    point: dict[str, Sequence[float]] = {
        "x": _to_floats(x),
        "u": _to_floats(u),
        "p": _to_floats(parameters),
        "t": [0.0],
    }
    senders: dict[str, list[list[float]]] = {}
    for p, partition in enumerate(subsystem.equations.clocks):
        point[f"m{p}"] = _to_floats(m[p])
        point[f"r{p}"] = [float(next(received)) for _ in partition.receives]
        for receive in partition.receives:
            if receive.edge is not None:
                size = receive.edge.numel_in(3)
                different = [_to_floats(sent[:size]) for sent in starting.sent_to(receive.link, class_index)]
                senders[f"s{size} {receive.link}"] = different or [[0.0] * size]
    for sent_values in itertools.product(*senders.values()):
        yield {**point, **dict(zip(senders, sent_values, strict=True))}


def _refuse_several_senders(
    switched: SwitchedPeerType, starting: StartClasses, class_index: int, pieces: Sequence[LinearPiece]
) -> None:
    """Raise ApcError for a kink in a term of each sender, if there are several senders.

    Each sender may then be on another side of the kink.

    Parameters
    ----------
    switched, pieces
        The peer type with symbols for its decisions, and its linear pieces at the start.
    starting, class_index
        The classes of peers with equal start, and the index of the receiving class.
    """
    if all(equal(piece.slopes, pieces[0].slopes) for piece in pieces):
        return
    for name, column in switched.columns.items():
        link = name.partition(" ")[2]
        if not link or starting.senders(link, class_index) < 2:
            continue
        indices = [
            index
            for index, _ in pieces[0].selected
            if casadi.depends_on(switched.decisions[index].guard, column)
            and len({dict(piece.selected).get(index) for piece in pieces}) > 1
        ]
        if indices:
            names = names_of(switched, indices)
            kinks = ", ".join(names) or "an equation"
            message = f"{kinks} has a kink for each peer from which it receives over {link}"
            raise at_a_kink(switched.peer_type.name, message, names)


def _refuse_hidden_kink(subsystem: SubsystemJacobians, starting: StartClasses, class_index: int) -> None:
    """Raise an error for a kink inside a nonlinear loop, where no decision can be set.

    Slopes at two points on opposite sides of the start are compared: at a kink their difference does not
    shrink with the distance.
    """
    if not _has_branches(subsystem):
        return
    x, u, m = start_values(subsystem, starting.parameters[class_index])
    received = _to_floats(starting.reception(class_index)[0].values)
    point = [_to_floats(x), _to_floats(u), [float(value) for memories in m for value in memories], received]
    sizes = [len(column) for column in point]
    rng = np.random.default_rng(0)
    for direction in rng.uniform(-1, 1, (DIRECTIONS, sum(sizes))):
        gaps = []
        for step in STEPS:
            ends = [
                np.array(
                    subsystem.function(
                        *np.split(np.concatenate(point) + sign * step * direction, np.cumsum(sizes)[:-1]),
                        _to_floats(starting.parameters[class_index]),
                        0.0,
                    )
                ).ravel()
                for sign in (1, -1)
            ]
            gaps.append(float(np.abs(ends[0] - ends[1]).max() / np.abs(ends).max(initial=1e-300)))
        if min(gaps) > HALF_STEEP * max(gaps) and min(gaps) > LEAST_GAP:
            raise at_a_kink(subsystem.peer_type.name, "a nonlinear loop has a kink", ())


def _has_branches(subsystem: SubsystemJacobians) -> bool:
    """Return whether a function inside a nonlinear loop contains a comparison, max, min, abs or sign."""
    peer_type = subsystem.equations
    outer_functions = [
        peer_type.derivative,
        *(clock.tick for clock in peer_type.clocks),
        *(send.send for send in peer_type.sends),
    ]
    all_functions = [
        candidate for function in outer_functions for candidate in (function, *function.find_functions())
    ]
    scalar_functions = [
        candidate if candidate.is_a("SXFunction") else candidate.oracle()
        for candidate in all_functions
        if _is_scalar(candidate)
    ]
    return any(
        function.instruction_id(k) in DECIDING
        for function in scalar_functions
        for k in range(function.n_instructions())
    )


def _is_scalar(function: Any) -> bool:
    """Return whether a function is given by scalar operations, or is a root finder over a scalar function."""
    return bool(function.is_a("SXFunction") or function.is_a("Rootfinder"))


def _to_floats(values: Iterable[object]) -> list[float]:
    """Return numbers as floats."""
    return [float(value) for value in values]  # type: ignore[arg-type] # Fraction and float


def _combined_pieces(pieces_at_points: Sequence[tuple[LinearPiece, ...]]) -> tuple[LinearPiece, ...]:
    """Return the pieces of one peer type over several points: the combinations with equal common
    decisions.
    """
    distinct: dict[tuple[_Selection, ...], tuple[LinearPiece, ...]] = {}
    for pieces in pieces_at_points:
        distinct.setdefault(tuple(piece.selected for piece in pieces), pieces)
    previous: list[list[LinearPiece]] = []
    result: dict[_Selection, LinearPiece] = {}
    for combination in itertools.product(*distinct.values()):
        selected: dict[int, bool] = {}
        for piece in combination:
            if any(selected.get(index, side) is not side for index, side in piece.selected):
                break
            selected |= dict(piece.selected)
        else:
            # Pieces that have the same slopes at every point are one.
            agreeing = [
                piece
                for pieces in pieces_at_points
                for piece in pieces
                if dict(piece.selected).items() <= selected.items()
            ]
            if any(
                all(equal(a.slopes, b.slopes) for a, b in zip(agreeing, earlier, strict=True))
                for earlier in previous
            ):
                continue
            previous.append(agreeing)
            steepest = max(agreeing, key=lambda piece: float(np.linalg.norm(piece.slopes)))
            key = tuple(sorted(selected.items()))
            result[key] = replace(steepest, selected=key)
        if len(result) > MOST_SIDES:
            break
    return tuple(result.values())


def _piece_names(switched: SwitchedPeerType, pieces: Sequence[LinearPiece]) -> list[str]:
    """Return a name for each piece, such as "wall.push on": "on" is the steeper side of a kink."""
    decisions_by_name: dict[tuple[str, ...], list[int]] = {}
    for index in dict.fromkeys(index for piece in pieces for index, _ in piece.selected):
        decisions_by_name.setdefault(names_of(switched, [index]), []).append(index)
    result: list[list[str]] = [[] for _ in pieces]
    for names, indices in decisions_by_name.items():
        states = [tuple(dict(piece.selected).get(index) for index in indices) for piece in pieces]
        sizes: dict[tuple[bool | None, ...], float] = {}
        for state, piece in zip(states, pieces, strict=True):
            sizes[state] = max(float(np.linalg.norm(piece.slopes)), sizes.get(state, 0.0))
        if len(sizes) == 1:
            continue
        ordered = sorted(sizes, key=lambda state: sizes[state])
        words = [f"on piece {number}" for number in range(1, len(ordered) + 1)]
        if len(ordered) == 2:
            least, most = sorted(sizes.values())
            equal = math.isclose(least, most, rel_tol=EQUAL)
            words = ["on one side", "on the other side"] if equal else ["off", "on"]
        text = ", ".join(names) or "an equation"
        for texts_of_piece, state in zip(result, states, strict=True):
            texts_of_piece.append(f"{text} {words[ordered.index(state)]}")
    return ["; ".join(texts_of_piece) for texts_of_piece in result]


def _side(
    numeric: NumericModel,
    origins: Sequence[int],
    group_pieces: Sequence[LinearPiece],
    name: str,
) -> Side:
    """Return the model on one side of a kink: each group with its linear piece.

    Consecutive groups of equal origin and equal piece are merged.

    Parameters
    ----------
    numeric
        The model with divided groups.
    origins
        The index of the original group of each group.
    group_pieces
        The linear piece of each group.
    name
        The name of the side.
    """
    model = numeric.model
    type_index: dict[tuple[int, _Selection, Moving], int] = {}
    jacobians_of_types: list[SubsystemJacobians] = []
    groups: list[Group] = []
    schedules = []
    previous: tuple[int, int] | None = None
    for group, schedule, origin, piece in zip(
        model.groups, numeric.schedules, origins, group_pieces, strict=True
    ):
        key = group.peer_type, piece.selected, piece.moving
        if key not in type_index:
            type_index[key] = len(jacobians_of_types)
            jacobians_of_types.append(
                _one_sided_peer_type(numeric.jacobians[group.peer_type], piece.selected, piece.moving)
            )
        peer_type = type_index[key]
        if previous == (origin, peer_type):
            last = groups[-1]
            columns = tuple(
                PeerColumn(first.name, np.concatenate([first.values, second.values]))
                for first, second in zip(last.columns, group.columns, strict=True)
            )
            groups[-1] = replace(last, count=last.count + group.count, columns=columns)
            continue
        groups.append(replace(group, peer_type=peer_type))
        schedules.append(schedule)
        previous = origin, peer_type
    peer_types = tuple(model.peer_types[peer_type] for peer_type, *_ in type_index)
    changed = replace(model, peer_types=peer_types, groups=tuple(groups))
    return Side(
        name,
        replace(
            numeric,
            model=changed,
            jacobians=tuple(jacobians_of_types),
            given_schedules=tuple(schedules),
        ),
    )


@functools.lru_cache(maxsize=MOST_SIDES * 4)
def _one_sided_peer_type(
    subsystem: SubsystemJacobians, selected: _Selection, moving: Moving
) -> SubsystemJacobians:
    """Return the Jacobians of a peer type with the selected settings of its tied decisions."""
    if not selected:
        return subsystem
    return with_equations(
        subsystem, one_sided_peer_type(find_switches(subsystem.equations), dict(selected), moving)
    )


def _combinations_error(numeric: NumericModel, pieces: Sequence[Sequence[LinearPiece]]) -> ApcError:
    """Return the error E808 for more combinations than are analyzed, with the names of the kinks."""
    names = [
        name
        for subsystem, group_pieces in zip(numeric.subsystems, pieces, strict=True)
        for name in names_of(
            find_switches(subsystem.equations),
            [index for piece in group_pieces for index, _ in piece.selected],
        )
    ]
    kinks = ", ".join(dict.fromkeys(names))
    message = f"{kinks}: more than {MOST_SIDES} combinations of one-sided slopes at the initial state"
    index = SourceLocation(numeric.model.origin.topology)
    return ApcError(Diagnostic("E808", index, message, subject=part_of(names[0])))
