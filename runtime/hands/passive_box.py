"""Proof that a scene is stable with every passive hand, for all values in a box.

Takes: a `CompiledSystem` and ranges.
Gives: `prove_box`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named; what
can't be had is refused by name.
Does not: serve devices that feel each other unevenly, which nothing is said of where the criterion isn't met.

The map of moved devices (see `port`) is followed over a cell of the box to first order, with a radius for all
the rest (`frame.taylor`). One storage that serves at all corners serves in between (see `dissipation`), and
proves the cell. A cell where that fails is halved.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, prepare
from apc.analysis.box import open_sites
from apc.analysis.box_proof import TOGETHER, BoxProof, Looked, middle, search_box
from apc.analysis.cells import Cell, OpenLoop, closed_over, open_loop
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.timings import part
from apc.compiler.words import with_unit
from apc.eigen.closing import ClosedSystem, close_loop
from apc.eigen.dissipation import is_positive, least_real, proves_positive_between
from apc.eigen.modes import split
from apc.eigen.pseudospectrum import balance
from apc.eigen.rigid import find_rigid_modes, stays_rigid
from apc.frame.devices import replaced_hands, without_hands
from apc.frame.exact import evaluate_exact
from apc.frame.names import Range
from apc.frame.overrides import Override, apply
from apc.frame.radius import RADII, value_of
from apc.frame.site import LinearSite
from apc.frame.taylor import corners, hull, taylor
from apc.hands.passivity import OPTION, STABLE, UNSTABLE, circulates, passive_growth
from apc.hands.port import Cut, Maps, Standing, open_ports, port_loop
from apc.network.nominal import left_out, refuse_channel_number
from apc.threads import single_threaded

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

PLACE = Place("box")

# Parts of what is left over for a cell's storage, tried one after the other.
SPARED = (0.1, 1e-2, 1e-3)

# What is this small, relatively, is nothing where exact equations say that something is.
NOTHING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """A mode cut open at its devices, over the open parameters, with their devices' dampings beside.

    `free` (k, d) are the directions in which devices can stand aside, and all else with them; `stands` is
    what follows for them.
    """

    loop: OpenLoop
    cut: Cut
    free: Floats
    stands: Standing


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A scene over a box: its modes, and how much each range matters."""

    system: CompiledSystem
    prepared: Prepared
    ranges: tuple[Range, ...]
    cuts: tuple[_Cut, ...]
    weights: Floats


@part("box")
def prove_box(system: CompiledSystem, ranges: Sequence[Range], *, cells: int | None = None) -> BoxProof:
    """Prove a scene stable with every passive hand in a whole box, or find a point of it where it is not.

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
        E896 a number of an unreliable link; E930 devices that feel each other unevenly; E831 and E832 as
        `box.open_sites`; those of `passivity.passive_hands`.
    """
    of_scene, system = system, without_hands(system, OPTION)
    for one in ranges:
        low, high = (with_unit(f"{float(end):g}", one.unit) for end in (one.low, one.high))
        hint = f'apc analyze --box "{one.free.label}={low}:{high}"'
        refuse_channel_number(system, one.free, PLACE, instead=hint)
    with single_threaded(), np.errstate(all="ignore"):
        asked = _question(system, ranges)
        if isinstance(asked, str):
            inner = tuple(map(float, middle(tuple((one.low, one.high) for one in ranges))))
            found = BoxProof(system.name, tuple(ranges), UNSTABLE, False, 1, 1.0, inner, (asked,))
        else:
            looks = partial(_looked, asked), partial(_is_unstable, asked)
            found = search_box(system.name, ranges, *looks, stable=STABLE, unstable=UNSTABLE, cells=cells)
        return replace(found, left_out=(*replaced_hands(of_scene), *left_out(system)))


def _question(system: CompiledSystem, ranges: Sequence[Range]) -> _Question | str:
    """Leave parameters open; or say why no device is ever passive."""
    prepared = prepare(system)
    opened = open_sites(system, ranges, prepared, lambda changed: lifted_groups(changed, prepared=prepared))
    openings = open_ports(opened.at, opened.groups, opened.exchange, option=OPTION)
    if isinstance(openings, str):
        return openings
    sites, dampings = {}, {}
    for one in openings.groups:
        own, vector = opened.sites[one.group.name], opened.vectors[one.group.name]
        function, velocity = one.device.symbolic, one.device.velocity
        zeros = [[Fraction(0)] * function.numel_in(place) for place in (0, 1, 3)]
        inverse = evaluate_exact(function, [*zeros[:2], list(vector), zeros[2]])[0][0]
        key = id(one.ported.schedule)
        sites[key] = one.site(own, np.array(inverse, dtype=object))
        dampings[key] = -own.a[velocity, velocity] / inverse
    plain = split(opened.groups, opened.exchange).systems
    rigid = {
        one.name: _translates(one, tuple(opened.sites[group.name] for group in one.sites)) for one in plain
    }
    cuts = []
    for loop in openings.loops:
        port, cut = port_loop(openings, loop, option=OPTION)
        if not port.maps.joined or circulates(port):
            what = "no box is proved with passive hands where devices feel each other unevenly"
            raise ApcError(Mistake("E930", PLACE, what, hint="apc analyze --hands passive"))
        keys = [id(group.schedule) for group in loop.sites]
        column = np.array([[dampings[key]] for key in keys], dtype=object)
        open_ = open_loop(close_loop(loop), [sites[key] for key in keys], column)
        free = _unfelt(port.maps, rigid.get(loop.name, 0))
        point: Cell = tuple((value, value) for value in middle(tuple((one.low, one.high) for one in ranges)))
        stands = cut.stands_aside(closed_over(open_, [point])[0][0], free)
        assert stands is not None, "a mode that could be cut in the middle of the box"
        cuts.append(_Cut(open_, cut, free, stands))
    weights = np.sum([_matter(one, ranges) for one in cuts], axis=0)
    return _Question(system, prepared, tuple(ranges), tuple(cuts), weights + np.finfo(np.float64).tiny)


def _matter(mode: _Cut, ranges: Sequence[Range]) -> Floats:
    """Return how much what moves by itself in a mode changes with each range, in units that make it even.

    That is what makes a cell hard to prove, and not how much the damping needed changes.
    """
    closed, dampings = closed_over(mode.loop, [tuple((one.low, one.high) for one in ranges)])
    maps = mode.cut.maps(closed[0], dampings[0], taylor(len(ranges)), mode.stands)
    if maps is None:
        return np.ones(len(ranges))
    scale = balance(np.abs(value_of(maps.a)))
    moved = np.abs(maps.a[2:] / scale[:, None] * scale).max(axis=(1, 2), initial=0.0)
    return np.asarray(moved / [float(one.high - one.low) / 2 for one in ranges])


def _translates(system: ClosedSystem, sites: tuple[LinearSite, ...]) -> int:
    """Return in how many directions a mode moves as one, devices and all, the same all over the box."""
    free = find_rigid_modes(system)
    return 0 if free.drifts or not stays_rigid(system, sites) else free.basis.shape[1]


def _unfelt(maps: Maps, count: int) -> Floats:
    """Return the directions (k, d) in which devices stand aside and all else too; none unless so many."""
    stiffness = value_of(maps.static)
    values, vectors = np.linalg.eigh((stiffness + stiffness.T) / 2)
    size = max(float(np.abs(values).max()), float(np.abs(value_of(maps.weight)).max()))
    unfelt = np.abs(values) <= NOTHING * size
    return np.asarray(vectors[:, unfelt if int(unfelt.sum()) == count else slice(0)])


def _growth_at(asked: _Question, point: Sequence[Fraction], *, bounded: bool) -> Any:
    changed = [Override(one.free, value) for one, value in zip(asked.ranges, point, strict=True)]
    return passive_growth(apply(asked.system, changed), asked.prepared, bounded=bounded)


def _is_unstable(asked: _Question, point: Sequence[Fraction]) -> bool:
    """Say whether it is proved that hands draw energy at a point of the box."""
    if _growth_at(asked, point, bounded=False).radius < 1:
        return False
    return _growth_at(asked, point, bounded=True).stable is False


def _looked(asked: _Question, cells: Sequence[Cell]) -> Iterator[Looked]:
    """Look at cells, closed many at a time, until one is found unstable."""
    for start in range(0, len(cells), TOGETHER):
        some = cells[start : start + TOGETHER]
        over = [closed_over(mode.loop, some) for mode in asked.cuts]
        for place, cell in enumerate(some):
            proved, sound = True, True
            for mode, (closed, dampings) in zip(asked.cuts, over, strict=True):
                if proved:
                    proved, sound = _proved(mode, closed[place], dampings[place])
            reach = asked.weights * [float(high - low) for low, high in cell]
            unstable = not sound and _is_unstable(asked, middle(cell))
            yield Looked(None if proved else reach, unstable)


def _proved(mode: _Cut, closed: Matrix, dampings: Matrix) -> tuple[bool, bool]:
    """Say whether no scene in a cell gives more energy than it got: at rest, and at any frequency.

    And whether, in floats, the one in its middle doesn't.
    """
    numbers = taylor(len(closed) - 2)
    maps = mode.cut.maps(closed, dampings, numbers, mode.stands)
    if maps is None or not maps.joined or not np.isfinite(maps.weight).all():
        return False, False
    static = hull(maps.static)
    twice = RADII.add(static, np.swapaxes(static, -1, -2))
    # Where devices stand aside together and feel nothing, they do so all over the box.
    size = 4 * float(np.abs(twice).sum()) + 1.0
    if not is_positive(RADII.add(twice, RADII.exact(size * mode.free @ mode.free.T))):
        return False, False
    parts = maps.a, maps.b, maps.c, numbers.add(maps.d, maps.weight)
    a, b, c, e = (one[:2] for one in parts)
    # A storage that serves with half of what can be spared leaves the rest for the cell.
    least, _ = least_real(value_of(a), value_of(b), value_of(c), value_of(e), np.zeros(e.shape[-2:]))
    if not 0 < least < np.inf:
        return least > 0, least > 0
    less = RADII.subtract(e, RADII.exact(least / 2 * np.eye(e.shape[-1])))
    at_corners = zip(*map(corners, parts), strict=True)
    return proves_positive_between((a, b, c, less), list(at_corners), spared=SPARED), True
