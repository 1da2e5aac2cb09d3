"""The one-sided linear models of a topology whose peers start at a kink.

Takes: a `Model`.
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

from apc.compiler.compiled import Group, Model, PeerColumn
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.peer_classes import start_classes
from apc.frame.branch_conditions import SwitchedPeerType, find_switches
from apc.frame.evaluation_errors import at_part, finite_equations, part_of
from apc.frame.initial_reception import StartClasses
from apc.frame.jacobians import DECIDING, SubsystemJacobians, with_equations
from apc.frame.kinks import (
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
from apc.frame.linearize import at_start, of_rows, start_values
from apc.frame.numeric_model import Instance, Prepared, instance
from apc.verdict import StabilityVerdict

# Combinations of pieces that are analyzed one by one; peers of a group that are divided to find them.
MOST_SIDES, MOST_PEERS = 16, 64
# Inside a nonlinear loop: random directions, steps from the start (SI), and the relative gap of slopes
# between both ends of a step: at a kink it stays, on a curve it shrinks with the step.
DIRECTIONS, STEPS, HALF_STEEP, LEAST_GAP = 8, (1e-7, 1e-8, 1e-9), 0.5, 1e-6

_Taken = tuple[tuple[int, bool], ...]  # for each tied decision of a peer type, whether it is taken


@dataclass(frozen=True, slots=True)
class Side:
    """One combination of pieces: `name` such as "wall.push on", "" without kinks.

    `system` has a peer type of its own for each group on another side, `prepared` their Jacobians.
    """

    name: str
    system: Model
    prepared: Prepared


@dataclass(frozen=True, slots=True)
class SideVerdict:
    """The verdict of one side; the radius is per frame."""

    name: str
    verdict: StabilityVerdict
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float


def worst_side(verdicts: Sequence[SideVerdict]) -> int:
    """Return the index of the worst verdict."""
    return max(range(len(verdicts)), key=lambda n: severity(verdicts[n].stable, verdicts[n].spectral_radius))


def severity(stable: bool | None, measure: float) -> tuple[int, float]:
    """Return the rank of a verdict among those of several sides: the largest is the worst.

    Parameters
    ----------
    stable
        The verdict; None is undecided, which is worse than stable and better than unstable.
    measure
        The order of equal verdicts, larger if worse: a spectral radius or a missing damping. NaN is worst.
    """
    return {False: 2, None: 1, True: 0}[stable], math.inf if math.isnan(measure) else measure


def sides(system: Model, prepared: Prepared) -> tuple[Side, ...]:
    """Return the one-sided models at the start values; the topology itself where nothing has a kink.

    Parameters
    ----------
    system
        The compiled model, with the numbers to analyze.
    prepared
        From `numeric_model.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        E808 an equation that jumps at the start values, a kink in a sum over several senders, or more than
        MOST_SIDES combinations.
    """
    if prepared.starting or all(_smooth(prepared.jacobians[group.peer_type]) for group in system.groups):
        return (Side("", system, prepared),)
    with finite_equations(system.origin.topology), np.errstate(all="ignore"):
        whole = instance(system, prepared)
        near = [_near_a_kink(whole, index) for index in range(len(system.groups))]
        if not any(near):
            return (Side("", system, prepared),)
        # Peers of one group may be on different sides.
        origins = [
            index
            for index, group in enumerate(system.groups)
            for _ in range(group.count if near[index] and group.count <= MOST_PEERS else 1)
        ]
        parts = _parts(system.groups, origins)
        schedules = tuple(prepared.schedules[index] for index in origins)
        prepared = replace(prepared, schedules=schedules)
        topology = instance(replace(system, groups=parts), prepared)
        try:
            pieces = _pieces_of_groups(topology, [near[index] for index in origins])
        except ApcError as error:
            origin = system.origin
            raise ApcError(
                at_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
            ) from None
    if not any(piece.selected for listed in pieces for piece in listed):
        return (Side("", system, replace(prepared, schedules=whole.schedules)),)
    exchangeable = _interchangeable(topology, origins, pieces)
    count = math.prod(math.comb(len(peers) + len(pieces[peers[0]]) - 1, len(peers)) for peers in exchangeable)
    large = any(
        len(listed) > 1 and group.count > 1 for group, listed in zip(parts, pieces, strict=True)
    )  # not divided
    if count > MOST_SIDES or large:
        raise _too_many(topology, pieces)
    names = [
        _names(find_switches(subsystem.equations), listed)
        for subsystem, listed in zip(topology.subsystems, pieces, strict=True)
    ]
    result = []
    choices = (
        itertools.combinations_with_replacement(range(len(pieces[peers[0]])), len(peers))
        for peers in exchangeable
    )
    for chosen in itertools.product(*choices):
        side_of = dict(zip(itertools.chain(*exchangeable), itertools.chain(*chosen), strict=True))
        texts = [names[n][side_of[n]] for n in range(len(parts))]
        selected = [pieces[n][side_of[n]] for n in range(len(parts))]
        result.append(_side(topology, prepared, origins, selected, _named(topology, pieces, texts)))
    return tuple(result)


def _parts(groups: Sequence[Group], origins: Sequence[int]) -> tuple[Group, ...]:
    """Return the groups, those that `origins` lists several times divided into single peers."""
    counts, result, before = Counter(origins), [], Counter[int]()
    for index in origins:
        group = groups[index]
        if counts[index] == 1:
            result.append(group)
            continue
        row = slice(before[index], before[index] + 1)
        columns = tuple(PeerColumn(column.name, column.values[row]) for column in group.columns)
        result.append(replace(group, count=1, columns=columns))
        before[index] += 1
    return tuple(result)


def _interchangeable(
    topology: Instance, origins: Sequence[int], pieces: Sequence[tuple[LinearPiece, ...]]
) -> list[list[int]]:
    """Return the groups, by index, in classes whose members may exchange their sides."""
    complete = all(map(topology.exchange.is_complete, topology.exchange.links))
    classes: dict[object, list[int]] = {}
    for n, origin in enumerate(origins):
        vector = topology.numbers.parameters[n].tobytes()
        selected = tuple(piece.selected for piece in pieces[n])
        classes.setdefault((origin, vector, selected) if complete else n, []).append(n)
    return list(classes.values())


def _named(topology: Instance, pieces: Sequence[tuple[LinearPiece, ...]], texts: Sequence[str]) -> str:
    """Return the name of a combination: its sides, and whose they are where several peers have some."""
    groups, starts = topology.system.groups, topology.exchange.starts
    totals: Counter[str] = Counter()
    peers: dict[tuple[str, str], list[str]] = {}
    for group, text, first in zip(groups, texts, starts[:-1].tolist(), strict=True):
        totals[group.name] += group.count
        if text:
            peers.setdefault((group.name, text), []).append(topology.exchange.peer_name(first))
    kinked = {group.name for group, listed in zip(groups, pieces, strict=True) if len(listed) > 1}
    result = []
    for (name, text), listed in peers.items():
        everyone = len(listed) == totals[name]
        where = name if everyone else ", ".join(listed)
        result.append(text if everyone and len(kinked) == 1 else f"{text} at {where}")
    return "; ".join(result)


def _smooth(subsystem: SubsystemJacobians) -> bool:
    """Return whether no decision changes a slope of a peer type, at any point."""
    if subsystem.affine and not subsystem.edges:
        return True
    return not subsystem.edges and subsystem.walkable and tie_indicators(subsystem.equations) is None


def _pieces_of_groups(topology: Instance, near: Sequence[bool]) -> list[tuple[LinearPiece, ...]]:
    """Return the pieces at the start of each group; `near` is False for groups without kinks."""
    smooth = (LinearPiece((), (), np.zeros(0), np.zeros((0, 0))),)
    classes = start_classes(topology)
    starting = StartClasses(topology, classes)
    result: list[list[tuple[LinearPiece, ...]]] = [[] for _ in near]
    for g, peers in enumerate(classes):
        # A class of equal start values may contain peers of several groups.
        groups = {topology.exchange.group_of(run.start) for run in peers.runs}
        subsystem = starting.subsystems[g]
        if not any(near[group] for group in groups):
            continue
        if not subsystem.walkable:
            _refuse_hidden_kink(subsystem, starting, g)
            continue
        switched = find_switches(subsystem.equations)
        for point in _points(starting, g):
            pieces = linear_pieces_at(switched, point, every=True)
            _refuse_several_senders(switched, starting, g, pieces)
            for group in groups:
                result[group].append(pieces)
    return [_joined(listed) if listed else smooth for listed in result]


def _near_a_kink(topology: Instance, index: int) -> bool:
    """Return whether peers of a group may start at a kink; False is certain."""
    subsystem = topology.subsystems[index]
    if _smooth(subsystem):
        return False
    start = at_start(subsystem)
    if start is None or start.ties is None:
        return start is None
    (ties,) = of_rows(start.ties, {4: topology.numbers.parameters[index]})
    return bool((ties > 0).any())


def _points(starting: StartClasses, g: int) -> Iterable[Point]:
    """Return the points at which the functions of a class are linearized: one for each different sender."""
    subsystem = starting.subsystems[g]
    parameters = starting.parameters[g]
    x, u, m = start_values(subsystem, parameters)
    initial_reception, _ = starting.listen(g)
    received = iter(initial_reception.values)
    point: dict[str, Sequence[float]] = {
        "x": _floats(x),
        "u": _floats(u),
        "p": _floats(parameters),
        "t": [0.0],
    }
    senders: dict[str, list[list[float]]] = {}
    for p, partition in enumerate(subsystem.equations.clocks):
        point[f"m{p}"] = _floats(m[p])
        point[f"r{p}"] = [float(next(received)) for _ in partition.receives]
        for receive in partition.receives:
            if receive.edge is not None:
                size = receive.edge.numel_in(3)
                listed = [_floats(sent[:size]) for sent in starting.sent_to(receive.link, g)]
                senders[f"s{size} {receive.link}"] = listed or [[0.0] * size]
    for chosen in itertools.product(*senders.values()):
        yield {**point, **dict(zip(senders, chosen, strict=True))}


def _refuse_several_senders(
    switched: SwitchedPeerType, starting: StartClasses, g: int, pieces: Sequence[LinearPiece]
) -> None:
    """Refuse a kink in a term of each sender where there are several: each may be on another side."""
    if all(equal(piece.slopes, pieces[0].slopes) for piece in pieces):
        return
    for name, column in switched.columns.items():
        link = name.partition(" ")[2]
        if not link or starting.senders(link, g) < 2:
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
            message = f"{kinks} has a kink for each of the peers that it receives from over {link}"
            raise at_a_kink(switched.peer_type.name, message, names)


def _refuse_hidden_kink(subsystem: SubsystemJacobians, starting: StartClasses, g: int) -> None:
    """Refuse a kink inside a nonlinear loop, where no decision can be set.

    Slopes a little to either side are compared: at a kink they differ however small the step.
    """
    if not _decides(subsystem):
        return
    x, u, m = start_values(subsystem, starting.parameters[g])
    received = _floats(starting.listen(g)[0].values)
    point = [_floats(x), _floats(u), [float(value) for part in m for value in part], received]
    sizes = [len(column) for column in point]
    rng = np.random.default_rng(0)
    for direction in rng.uniform(-1, 1, (DIRECTIONS, sum(sizes))):
        gaps = []
        for step in STEPS:
            ends = [
                np.array(
                    subsystem.function(
                        *np.split(np.concatenate(point) + sign * step * direction, np.cumsum(sizes)[:-1]),
                        _floats(starting.parameters[g]),
                        0.0,
                    )
                ).ravel()
                for sign in (1, -1)
            ]
            gaps.append(float(np.abs(ends[0] - ends[1]).max() / np.abs(ends).max(initial=1e-300)))
        if min(gaps) > HALF_STEEP * max(gaps) and min(gaps) > LEAST_GAP:
            raise at_a_kink(subsystem.peer_type.name, "a nonlinear loop has a kink", ())


def _decides(subsystem: SubsystemJacobians) -> bool:
    """Return whether a function inside a nonlinear loop compares, or takes a max, min, abs or sign."""
    peer_type = subsystem.equations
    outer = [
        peer_type.derivative,
        *(clock.tick for clock in peer_type.clocks),
        *(send.send for send in peer_type.sends),
    ]
    inner = [item for function in outer for item in (function, *function.find_functions())]
    scalar = [item if item.is_a("SXFunction") else item.oracle() for item in inner if _scalar(item)]
    return any(
        function.instruction_id(k) in DECIDING
        for function in scalar
        for k in range(function.n_instructions())
    )


def _scalar(function: Any) -> bool:
    return bool(function.is_a("SXFunction") or function.is_a("Rootfinder"))


def _floats(values: Iterable[object]) -> list[float]:
    return [float(value) for value in values]  # type: ignore[arg-type] # Fraction and float


def _joined(listed: Sequence[tuple[LinearPiece, ...]]) -> tuple[LinearPiece, ...]:
    """Return the pieces of one peer type that hold at several points, with equal common decisions."""
    different: dict[tuple[_Taken, ...], tuple[LinearPiece, ...]] = {}
    for pieces in listed:
        different.setdefault(tuple(piece.selected for piece in pieces), pieces)
    stored: list[list[LinearPiece]] = []
    result: dict[_Taken, LinearPiece] = {}
    for chosen in itertools.product(*different.values()):
        selected: dict[int, bool] = {}
        for piece in chosen:
            if any(selected.get(index, side) is not side for index, side in piece.selected):
                break
            selected |= dict(piece.selected)
        else:
            # Pieces that have the same slopes at every point are one.
            agreeing = [
                piece
                for pieces in listed
                for piece in pieces
                if dict(piece.selected).items() <= selected.items()
            ]
            if any(
                all(equal(a.slopes, b.slopes) for a, b in zip(agreeing, other, strict=True))
                for other in stored
            ):
                continue
            stored.append(agreeing)
            steepest = max(agreeing, key=lambda piece: float(np.linalg.norm(piece.slopes)))
            key = tuple(sorted(selected.items()))
            result[key] = replace(steepest, selected=key)
        if len(result) > MOST_SIDES:
            break
    return tuple(result.values())


def _names(switched: SwitchedPeerType, pieces: Sequence[LinearPiece]) -> list[str]:
    """Return a name for each piece, such as "wall.push on": on is the steeper side of a kink."""
    decided: dict[tuple[str, ...], list[int]] = {}
    for index in dict.fromkeys(index for piece in pieces for index, _ in piece.selected):
        decided.setdefault(names_of(switched, [index]), []).append(index)
    result: list[list[str]] = [[] for _ in pieces]
    for names, locations in decided.items():
        states = [tuple(dict(piece.selected).get(index) for index in locations) for piece in pieces]
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
        for parts, state in zip(result, states, strict=True):
            parts.append(f"{text} {words[ordered.index(state)]}")
    return ["; ".join(parts) for parts in result]


def _side(
    topology: Instance, prepared: Prepared, origins: Sequence[int], chosen: Sequence[LinearPiece], name: str
) -> Side:
    """Return the model on one side of a kink: each group with its linear piece.

    Consecutive groups of equal origin and equal piece are merged.

    Parameters
    ----------
    topology
        The instance.
    prepared
        The numeric model.
    origins
        The index of the original group of each group.
    chosen
        The linear piece of each group.
    name
        The name of the side.
    """
    system = topology.system
    numbers: dict[tuple[int, _Taken, Moving], int] = {}
    built: list[SubsystemJacobians] = []
    groups: list[Group] = []
    schedules = []
    before: tuple[int, int] | None = None
    for group, schedule, origin, piece in zip(
        system.groups, prepared.schedules, origins, chosen, strict=True
    ):
        key = group.peer_type, piece.selected, piece.moving
        if key not in numbers:
            numbers[key] = len(built)
            built.append(
                _one_sided_peer_type(topology.jacobians[group.peer_type], piece.selected, piece.moving)
            )
        peer_type = numbers[key]
        if before == (origin, peer_type):
            last = groups[-1]
            columns = tuple(
                PeerColumn(first.name, np.concatenate([first.values, second.values]))
                for first, second in zip(last.columns, group.columns, strict=True)
            )
            groups[-1] = replace(last, count=last.count + group.count, columns=columns)
            continue
        groups.append(replace(group, peer_type=peer_type))
        schedules.append(schedule)
        before = origin, peer_type
    peer_types = tuple(system.peer_types[peer_type] for peer_type, *_ in numbers)
    changed = replace(system, peer_types=peer_types, groups=tuple(groups))
    return Side(name, changed, replace(prepared, jacobians=tuple(built), schedules=tuple(schedules)))


@functools.lru_cache(maxsize=MOST_SIDES * 4)
def _one_sided_peer_type(
    subsystem: SubsystemJacobians, selected: _Taken, moving: Moving
) -> SubsystemJacobians:
    if not selected:
        return subsystem
    return with_equations(
        subsystem, one_sided_peer_type(find_switches(subsystem.equations), dict(selected), moving)
    )


def _too_many(topology: Instance, pieces: Sequence[Sequence[LinearPiece]]) -> ApcError:
    """Return the error for more combinations than are analyzed, with the names of the peer types."""
    names = [
        name
        for subsystem, listed in zip(topology.subsystems, pieces, strict=True)
        for name in names_of(
            find_switches(subsystem.equations), [index for piece in listed for index, _ in piece.selected]
        )
    ]
    kinks = ", ".join(dict.fromkeys(names))
    message = f"{kinks}: more than {MOST_SIDES} combinations of sides meet at the start values"
    index = SourceLocation(topology.system.origin.topology)
    return ApcError(Diagnostic("E808", index, message, subject=part_of(names[0])))
