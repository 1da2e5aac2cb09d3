"""Proof that a scene is stable with every passive hand, for all values in a box.

Takes: a `CompiledSystem` and ranges.
Gives: `prove_box`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named; what
can't be had is refused by name.
Does not: serve devices that feel each other unevenly, which nothing is said of where the criterion isn't met.

About the middle c of a cell of the box, the map of moved devices (see `port`) is M(c) + Σ_k S_k (p_k − c_k),
each S_k a slope somewhere in the cell: radii hold all of them. One storage that serves at all corners serves
in between (see `dissipation`), and proves the cell. A cell where that fails is halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, prepare
from apc.analysis.box import open_sites
from apc.analysis.box_proof import (
    BITS,
    BoxProof,
    ball_radii,
    middle,
    range_ball,
    search_box,
    site_at,
)
from apc.analysis.cells import Cell
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.frozen import dataclass
from apc.compiler.timings import part
from apc.eigen.balls import (
    Balls,
    Dual,
    closed_frame,
    frame_steps,
    mapped,
    precision,
    rational_ball,
    slope_of,
    step_duals,
)
from apc.eigen.closing import ClosedSystem, close_loop
from apc.eigen.dissipation import is_positive, least_real, proves_positive_between
from apc.eigen.modes import split
from apc.eigen.pseudospectrum import balance
from apc.eigen.ratios import Ratio
from apc.eigen.rigid import find_rigid_modes, stays_rigid
from apc.frame.devices import refuse_hands
from apc.frame.discretize import UNIT
from apc.frame.exact import evaluate_exact
from apc.frame.names import Range
from apc.frame.overrides import Override, apply
from apc.frame.radius import RADII, value_of
from apc.frame.site import LinearSite
from apc.hands.passivity import OPTION, STABLE, UNSTABLE, circulates, passive_growth
from apc.hands.port import Cut, Maps, open_ports, port_loop
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
    """A mode cut open at its devices: its sites over the open parameters, and their devices' dampings.

    `free` (k, d) are the directions in which devices can stand aside, and all else with them.
    """

    system: ClosedSystem
    sites: tuple[LinearSite, ...]
    dampings: tuple[Any, ...]
    cut: Cut
    free: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """A scene over a box: its modes, and how much each range matters."""

    system: CompiledSystem
    prepared: Prepared
    ranges: tuple[Range, ...]
    cuts: tuple[_Cut, ...]
    weights: Floats


@part("box")
def prove_box(system: CompiledSystem, ranges: Sequence[Range]) -> BoxProof:
    """Prove a scene stable with every passive hand in a whole box, or find a point of it where it is not.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `analysis.box.parse_range`.

    Raises
    ------
    ApcError
        E930 devices that feel each other unevenly; E831 and E832 as `box.open_sites`; those of
        `passivity.passive_hands`.
    """
    refuse_hands(system, OPTION)
    with single_threaded(), np.errstate(all="ignore"), precision(BITS):
        asked = _question(system, ranges)
        if isinstance(asked, str):
            inner = tuple(map(float, middle(tuple((one.low, one.high) for one in ranges))))
            return BoxProof(system.name, tuple(ranges), UNSTABLE, False, 1, 1.0, inner, (asked,))
        looks = partial(_reach_out, asked), partial(_is_unstable, asked)
        return search_box(system.name, ranges, *looks, stable=STABLE, unstable=UNSTABLE)


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
        own_sites, own_dampings = (tuple(held[key] for key in keys) for held in (sites, dampings))
        cuts.append(
            _Cut(close_loop(loop), own_sites, own_dampings, cut, _unfelt(port.maps, rigid.get(loop.name, 0)))
        )
    weights = np.sum([_matter(one, ranges) for one in cuts], axis=0)
    return _Question(system, prepared, tuple(ranges), tuple(cuts), weights + np.finfo(np.float64).tiny)


def _matter(mode: _Cut, ranges: Sequence[Range]) -> Floats:
    """Return how much what moves by itself in a mode changes with each range, in units that make it even.

    That is what makes a cell hard to prove, and not how much the damping needed changes.
    """
    inner = [rational_ball((one.low + one.high) / 2) for one in ranges]
    whole = ball_radii(_whole(mode, inner, None))
    maps = mode.cut.maps(whole, np.zeros(len(mode.dampings)), RADII)
    found = np.ones(len(ranges))
    if maps is None:
        return found
    scale = balance(np.abs(value_of(maps.a)))
    for by in range(len(ranges)):
        slope = ball_radii(mapped(slope_of, _whole(mode, inner, by)))
        moved = mode.cut.slopes(whole, slope, _dampings(mode, inner, by), mode.free)
        if moved is not None:
            found[by] = np.abs(value_of(moved[0]) / scale[:, None] * scale).max(initial=0.0)
    return found


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


def _reach_out(asked: _Question, cell: Cell) -> Floats | None:
    """Return None when a cell is proved, or else how much each range matters in it."""
    if all(_proved(mode, cell) for mode in asked.cuts):
        return None
    return asked.weights * [float(high - low) for low, high in cell]


def _proved(mode: _Cut, cell: Cell) -> bool:
    """Say whether no scene in a cell gives more energy than it got: at rest, and at any frequency."""
    balls = [range_ball(low, high) for low, high in cell]
    inner = [rational_ball(value) for value in middle(cell)]
    middles = mode.cut.maps(ball_radii(_whole(mode, inner, None)), _dampings(mode, inner)[0, :, 0], RADII)
    duals = [_whole(mode, balls, by) for by in range(len(cell))]
    whole = ball_radii(mapped(_value, duals[0]))
    everywhere = mode.cut.maps(whole, np.zeros(len(mode.dampings)), RADII)
    if middles is None or everywhere is None or not everywhere.joined:
        return False
    twice = RADII.add(everywhere.static, np.swapaxes(everywhere.static, -1, -2))
    # Where devices stand aside together and feel nothing, they do so all over the box.
    size = 4 * float(np.abs(twice).sum()) + 1.0
    if not is_positive(RADII.add(twice, RADII.exact(size * mode.free @ mode.free.T))):
        return False
    loop = (middles.a, middles.b, middles.c, RADII.add(middles.d, middles.weight))
    moved = []
    for by, (low, high) in enumerate(cell):
        slope = ball_radii(mapped(slope_of, duals[by]))
        found = mode.cut.slopes(whole, slope, _dampings(mode, balls, by), mode.free)
        if found is None:
            return False
        reach = float(high - low) / 2 * (1 + 4 * UNIT)
        moved.append([RADII.multiply(RADII.exact(reach * np.eye(one.shape[-2])), one) for one in found])
    corners: list[tuple[Matrix, ...]] = [loop]
    for change in moved:
        corners = [
            tuple(turn(one, by) for one, by in zip(corner, change, strict=True))
            for corner in corners
            for turn in (RADII.add, RADII.subtract)
        ]
    # A storage that serves with half of what can be spared leaves the rest for the cell.
    a, b, c, e = loop
    least, _ = least_real(value_of(a), value_of(b), value_of(c), value_of(e), np.zeros(e.shape[-2:]))
    if not 0 < least < np.inf:
        return least > 0
    less = RADII.subtract(e, RADII.exact(least / 2 * np.eye(e.shape[-1])))
    return proves_positive_between((a, b, c, less), corners, spared=SPARED)


def _whole(mode: _Cut, point: Sequence[Any], by: int | None) -> Balls:
    """Return the closed matrix (n, n) of a mode at a point of balls; `by` a parameter, with its slope."""
    sites = [site_at(site, point, by) for site in mode.sites]
    steps = [
        frame_steps(site, group.schedule, step_duals)
        for site, group in zip(sites, mode.system.sites, strict=True)
    ]
    return closed_frame(mode.system, sites, steps)


def _dampings(mode: _Cut, point: Sequence[Any], by: int | None = None) -> Floats:
    """Return the dampings of a mode's devices (2, sites, 1) at a point of balls, or how they change there."""
    entries = np.zeros((len(mode.dampings), 1), dtype=object)
    for place, one in enumerate(mode.dampings):
        known = one if by is None else one.slope(by) if isinstance(one, Ratio) else Fraction(0)
        entries[place, 0] = known.at(point) if isinstance(known, Ratio) else rational_ball(known)
    return ball_radii(entries)


def _value(entry: Any) -> Any:
    return entry.value if isinstance(entry, Dual) else entry
