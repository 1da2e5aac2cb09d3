"""The one-sided linear models of a topology whose peers start at a kink.

Takes: a `CompiledSystem`.
Gives: `Side`, `SideVerdict`, `sides`, `worst_side`, `severity`.
Guarantees: every combination of the pieces that meet at the start values, up to MOST_SIDES; where nothing has
a kink there, the topology itself and nothing is computed twice.
Does not: try peers of one group on different sides.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.peers import start_classes
from apc.frame.decisions import SwitchedKind, find_switches
from apc.frame.finite_equations import at_its_part, finite_equations
from apc.frame.instance import Instance, Prepared, instance
from apc.frame.jacobians import DECIDING, SiteJacobians, with_equations
from apc.frame.kinks import EQUAL, Piece, Point, at_a_kink, names_of, one_sided, pieces_at, tie_indicators
from apc.frame.linearize import at_start, of_rows, start_values
from apc.frame.start_classes import StartClasses

# Combinations of pieces that are analyzed one by one.
MOST_SIDES = 16
# Inside a nonlinear loop: random directions, steps from the start (SI), and the relative gap of slopes
# between both ends of a step: at a kink it stays, on a curve it shrinks with the step.
DIRECTIONS, STEPS, HALF_STEEP, LEAST_GAP = 8, (1e-7, 1e-8, 1e-9), 0.5, 1e-6

_Taken = tuple[tuple[int, bool], ...]  # for each tied decision of a kind, whether it is taken


@dataclass(frozen=True, slots=True)
class Side:
    """One combination of pieces: `name` such as "wall.push on", "" where nothing has a kink.

    `system` has a kind of its own for each group on another side, `prepared` their Jacobians.
    """

    name: str
    system: CompiledSystem
    prepared: Prepared


@dataclass(frozen=True, slots=True)
class SideVerdict:
    """The verdict of one side; the radius is per frame."""

    name: str
    verdict: str
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
        What orders equal verdicts, larger if worse: a spectral radius, or a missing damping. NaN is worst.
    """
    return {False: 2, None: 1, True: 0}[stable], math.inf if math.isnan(measure) else measure


def sides(system: CompiledSystem, prepared: Prepared) -> tuple[Side, ...]:
    """Return the one-sided models at the start values; the topology itself where nothing has a kink.

    Parameters
    ----------
    system
        The compiled topology, with the numbers to analyze.
    prepared
        From `instance.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        E808 an equation that jumps at the start values, or more than MOST_SIDES combinations.
    """
    if prepared.starting or all(_smooth(prepared.jacobians[group.kind]) for group in system.groups):
        return (Side("", system, prepared),)
    with finite_equations(system.origin.topology), np.errstate(all="ignore"):
        scene = instance(system, prepared)
        try:
            pieces = _pieces_of_groups(scene)
        except ApcError as error:
            origin = system.origin
            raise ApcError(
                at_its_part(mistake, origin.topology, origin.texts) for mistake in error.mistakes
            ) from None
    if not any(piece.taken for listed in pieces for piece in listed):
        return (Side("", system, prepared),)
    count = math.prod(map(len, pieces))
    if count > MOST_SIDES:
        raise _too_many(scene, pieces, count)
    names = [
        _names(find_switches(site.equations), listed)
        for site, listed in zip(scene.sites, pieces, strict=True)
    ]
    several = sum(len(listed) > 1 for listed in pieces) > 1
    result = []
    for chosen in itertools.product(*(range(len(listed)) for listed in pieces)):
        texts = [
            f"{of_group[k]} at {group.name}" if several else of_group[k]
            for group, of_group, k in zip(system.groups, names, chosen, strict=True)
            if of_group[k]
        ]
        taken = [listed[k] for listed, k in zip(pieces, chosen, strict=True)]
        result.append(_side(scene, prepared, taken, "; ".join(texts)))
    return tuple(result)


def _smooth(site: SiteJacobians) -> bool:
    """Return whether no decision changes a slope of a kind, whatever the point."""
    if site.affine and not site.edges:
        return True
    return not site.edges and site.walkable and tie_indicators(site.equations) is None


def _pieces_of_groups(scene: Instance) -> list[tuple[Piece, ...]]:
    """Return the pieces that meet at the start of each group's peers."""
    near = [_near_a_kink(scene, place) for place in range(len(scene.system.groups))]
    smooth = (Piece((), (), np.zeros(0), np.zeros((0, 0))),)
    if not any(near):
        return [smooth] * len(near)
    classes = start_classes(scene)
    starting = StartClasses(scene, classes)
    found: list[list[tuple[Piece, ...]]] = [[] for _ in near]
    for g, peers in enumerate(classes):
        # A class of equal start values may contain peers of several groups.
        groups = {scene.exchange.group_of(run.start) for run in peers.runs}
        site = starting.sites[g]
        if not any(near[group] for group in groups):
            continue
        if not site.walkable:
            _refuse_hidden_kink(site, starting, g)
            continue
        for point in _points(starting, g):
            pieces = pieces_at(find_switches(site.equations), point)
            for group in groups:
                found[group].append(pieces)
    return [_joined(listed) if listed else smooth for listed in found]


def _near_a_kink(scene: Instance, place: int) -> bool:
    """Return whether peers of a group may start at a kink; False is certain."""
    site = scene.sites[place]
    if _smooth(site):
        return False
    start = at_start(site)
    if start is None or start.ties is None:
        return start is None
    (ties,) = of_rows(start.ties, {4: scene.numbers.parameters[place]})
    return bool((ties > 0).any())


def _points(starting: StartClasses, g: int) -> Iterable[Point]:
    """Return the points at which the functions of a class are linearized: one for each different sender."""
    site = starting.sites[g]
    parameters = starting.parameters[g]
    x, u, m = start_values(site, parameters)
    listening, _ = starting.listen(g)
    received = iter(listening.values)
    point: dict[str, Sequence[float]] = {
        "x": _floats(x),
        "u": _floats(u),
        "p": _floats(parameters),
        "t": [0.0],
    }
    senders: dict[str, list[list[float]]] = {}
    for p, partition in enumerate(site.equations.clocks):
        point[f"m{p}"] = _floats(m[p])
        point[f"r{p}"] = [float(next(received)) for _ in partition.receives]
        for receive in partition.receives:
            if receive.edge is not None:
                size = receive.edge.numel_in(3)
                listed = [_floats(sent[:size]) for sent in starting.sent_to(receive.link, g)]
                senders[f"s{size} {receive.link}"] = listed or [[0.0] * size]
    for chosen in itertools.product(*senders.values()):
        yield {**point, **dict(zip(senders, chosen, strict=True))}


def _refuse_hidden_kink(site: SiteJacobians, starting: StartClasses, g: int) -> None:
    """Refuse a kink inside a nonlinear loop, where no decision can be set.

    Slopes a little to either side are compared: at a kink they differ however small the step.
    """
    if not _decides(site):
        return
    x, u, m = start_values(site, starting.parameters[g])
    received = _floats(starting.listen(g)[0].values)
    point = [_floats(x), _floats(u), [float(value) for part in m for value in part], received]
    sizes = [len(column) for column in point]
    rng = np.random.default_rng(0)
    for direction in rng.uniform(-1, 1, (DIRECTIONS, sum(sizes))):
        gaps = []
        for step in STEPS:
            ends = [
                np.array(
                    site.function(
                        *np.split(np.concatenate(point) + sign * step * direction, np.cumsum(sizes)[:-1]),
                        _floats(starting.parameters[g]),
                        0.0,
                    )
                ).ravel()
                for sign in (1, -1)
            ]
            gaps.append(float(np.abs(ends[0] - ends[1]).max() / np.abs(ends).max(initial=1e-300)))
        if min(gaps) > HALF_STEEP * max(gaps) and min(gaps) > LEAST_GAP:
            raise at_a_kink(site.kind.name, "a nonlinear loop has a kink")


def _decides(site: SiteJacobians) -> bool:
    """Return whether a function inside a nonlinear loop compares, or takes a max, min, abs or sign."""
    kind = site.equations
    outer = [kind.derivative, *(clock.tick for clock in kind.clocks), *(send.send for send in kind.sends)]
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


def _joined(listed: Sequence[tuple[Piece, ...]]) -> tuple[Piece, ...]:
    """Return the pieces of one kind that hold at several points: those that agree on common decisions."""
    different: dict[tuple[_Taken, ...], tuple[Piece, ...]] = {}
    sizes: dict[int, float] = {}
    for pieces in listed:
        different.setdefault(tuple(piece.taken for piece in pieces), pieces)
        for piece in pieces:
            for (place, _), tie in zip(piece.taken, piece.ties, strict=True):
                sizes[place] = max(tie, sizes.get(place, 0.0))
    result: dict[_Taken, Piece] = {}
    for chosen in itertools.product(*different.values()):
        taken: dict[int, bool] = {}
        for piece in chosen:
            if any(taken.get(place, side) is not side for place, side in piece.taken):
                break
            taken |= dict(piece.taken)
        else:
            key = tuple(sorted(taken.items()))
            result[key] = replace(chosen[0], taken=key, ties=tuple(sizes[place] for place, _ in key))
        if len(result) > MOST_SIDES:
            break
    return tuple(result.values())


def _names(switched: SwitchedKind, pieces: Sequence[Piece]) -> list[str]:
    """Return a name for each piece, such as "wall.push on": on is the steeper side of a kink."""
    decided: dict[tuple[str, ...], list[int]] = {}
    for place in dict.fromkeys(place for piece in pieces for place, _ in piece.taken):
        decided.setdefault(names_of(switched, [place]), []).append(place)
    result: list[list[str]] = [[] for _ in pieces]
    for names, places in decided.items():
        states = [tuple(dict(piece.taken).get(place) for place in places) for piece in pieces]
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


def _side(scene: Instance, prepared: Prepared, chosen: Sequence[Piece], name: str) -> Side:
    """Return the model with a piece for each group."""
    system = scene.system
    numbers: dict[tuple[int, _Taken], int] = {}
    built: list[SiteJacobians] = []
    groups = []
    for group, piece in zip(system.groups, chosen, strict=True):
        key = (group.kind, piece.taken)
        if key not in numbers:
            numbers[key] = len(built)
            built.append(_one_sided(scene.jacobians[group.kind], piece.taken, piece.ties))
        groups.append(replace(group, kind=numbers[key]))
    changed = replace(system, kinds=tuple(system.kinds[kind] for kind, _ in numbers), groups=tuple(groups))
    return Side(name, changed, replace(prepared, jacobians=tuple(built)))


@functools.lru_cache(maxsize=MOST_SIDES * 4)
def _one_sided(site: SiteJacobians, taken: _Taken, ties: tuple[float, ...]) -> SiteJacobians:
    if not taken:
        return site
    switched = find_switches(site.equations)
    places = [place for place, _ in taken]
    return with_equations(site, one_sided(switched, dict(taken), dict(zip(places, ties, strict=True))))


def _too_many(scene: Instance, pieces: Sequence[Sequence[Piece]], count: int) -> ApcError:
    """Return the refusal of more combinations than are analyzed, with the names of the kinks."""
    names = [
        name
        for site, listed in zip(scene.sites, pieces, strict=True)
        for name in names_of(
            find_switches(site.equations), [place for piece in listed for place, _ in piece.taken]
        )
    ]
    kinks = ", ".join(dict.fromkeys(names))
    what = (
        f"{kinks}: {count} combinations of sides meet at the start values, and at most {MOST_SIDES} are "
        "analyzed"
    )
    return ApcError(Mistake("E808", Place(scene.system.origin.topology), what))
