"""How far copies are from each other while hands push at random, over the network as it is.

Takes: a scene that is stable in mean square, and how its second moments move (`crowd`, `patterns`).
Gives: `Told`; `crowd_error`, `standing_error`, `pattern_error`, `tagged_error`.
Guarantees: a value whose digits rounding leaves in doubt is none.
Does not: say whether the scene is stable (see `network`).

Every device is pushed by a force of its own of variance 1 N², drawn anew at each tick of the fastest clock;
the error of a copy is its position less the mean of the others', as frames begin. Of pushes the loops of
means make moments X, and of these come covariances V₀ of the luck of channels; luck drives itself,
V = V₀ + G(1) V (see `gains`), and the moments of positions are X and what the loops make of V.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.modes import dense_loop
from apc.eigen.relative import Relative, relative_coordinates
from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, radius_of, rounded, solve, value_of
from apc.moments.bursts import tagged_moments
from apc.moments.crowd import crowd, hearing, peer_classes
from apc.moments.gains import Moments, around, gain_of, number_of, stein, units_of
from apc.moments.hands import Copy, Peer, forced
from apc.moments.mean_loops import scaled
from apc.moments.patterns import every_pattern, frames, of_all, resting_moments
from apc.moments.stand_in import Classes, entries_of, luck_after, luck_of_luck, spread_of, standing_in

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# How far rounding may put a variance in doubt, relatively.
DOUBT = 1e-6

# Frames after which the sizes of covariances are known well enough to measure errors by.
SIZED = 40

# By what factor of its rounding a covariance that vanishes is taken to be there.
VANISHING = 1e3

# How far a motion that nothing holds back may move copies apart: those of rational weights are rounded.
APART = 1e-9

NO_COPIES = "no position of a mass is told to others"
IN_DOUBT = "rounding leaves its digits in doubt"
NO_END = "its iteration did not come to an end"
DRIFTING = "nothing holds the copies together: what they differ by grows for ever"


@dataclass(frozen=True, slots=True)
class Told:
    """The largest error of copies in m; or None, and `why`. Of an estimate `why` says what it leaves out."""

    metres: float | None
    why: str = ""


@dataclass(frozen=True, slots=True)
class _Class:
    """Equal peers: how many, and what of their z they got."""

    count: int
    got: Peer


@dataclass(frozen=True, slots=True, eq=False)
class _Spread:
    """Second moments (2, n, n) of all classes' means, or of peers of class `apart` less the mean of these.

    They are over the relative coordinates `at` of states that begin at `offsets`, class by class.
    """

    apart: int | None
    at: Relative
    offsets: tuple[int, ...]
    moments: Matrix


@dataclass(frozen=True, slots=True)
class _Error:
    """The error of a copy of a peer of class `of`: `own` times its position, `means` times those of all."""

    of: int
    copy: Copy
    own: Fraction
    means: tuple[Fraction, ...]


def crowd_error(system: CompiledSystem, prepared: Prepared) -> Told:
    """Return the largest error of copies, or why there is none: what is missed is held, packet by packet.

    Parameters
    ----------
    system
        The compiled scene, stable in mean square, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    """
    pushed = forced(system, hearing(system, prepared))
    if isinstance(pushed, str):
        return Told(None, pushed)
    loops, _ = peer_classes(pushed.told)
    classes = [_Class(site.count, pushed.peers[id(site.schedule)]) for site in loops[0].sites]
    of = crowd(system, prepared, told=pushed.told)
    spreads = [
        _pushed(part.loop.matrix, part.apart, part.loop.at, part.loop.offsets, classes) for part in of.parts
    ]
    known = [one for one in spreads if one is not None]
    if len(known) == len(spreads) and of.luck:
        known = _with_luck(of, known) or []
    return _largest(known, classes) if known else Told(None, IN_DOUBT)


def standing_error(system: CompiledSystem, prepared: Prepared, first: Fraction) -> Told:
    """Return the largest error of copies, or why there is none: own values stand in for missed ones.

    Parameters
    ----------
    system, prepared
        As for `crowd_error`.
    first
        When frames begin: all packets that may be lost are due then.
    """
    pushed = forced(system, hearing(system, prepared, first=first, stand_in=True), first)
    if isinstance(pushed, str):
        return Told(None, pushed)
    loops, _ = peer_classes(pushed.told)
    classes = [_Class(site.count, pushed.peers[id(site.schedule)]) for site in loops[0].sites]
    plain = standing_in(system, prepared, first)
    of = standing_in(system, prepared, first, told=pushed.told)
    if isinstance(plain, str) or isinstance(of, str):
        return Told(None, str(plain))
    # What a peer gets in a frame beside what moves it on the mean: its pushes, and Ω by luck.
    pushes = [np.zeros((2, of.size(d), of.size(d))) for d in range(len(classes))]
    for one, own in zip(classes, pushes, strict=True):
        own[0, one.got.drawn, one.got.drawn] = 1.0
    matrix, start = luck_of_luck(plain, 1.0, RADII), _lucky(of, pushes)
    if matrix is None or start is None:
        return Told(None, IN_DOUBT)
    # What luck adds to what a peer has without them goes on as it does without them.
    lasting = [np.delete(np.arange(of.size(d)), one.got.added) for d, one in enumerate(classes)]
    entries = entries_of(plain)
    places = [np.array(listed, np.intp).T for listed in entries]
    known = [own[:, kept[a], kept[b]] for own, kept, (a, b) in zip(start, lasting, places, strict=True)]
    found = _solved(matrix, np.concatenate(known, axis=-1), _squares(entries))
    if found is None:
        return Told(None, IN_DOUBT)
    number = 0
    whole = [own.copy() for own in pushes]
    for own, kept, (a, b) in zip(whole, lasting, places, strict=True):
        own[:, kept[a], kept[b]] = own[:, kept[b], kept[a]] = found[:, number : number + len(a)]
        number += len(a)
    luck = _lucky(of, whole)
    totals: dict[int | None, Matrix] = {}
    for d, own in enumerate(pushes):
        added = None if luck is None else RADII.add(own, luck[d])
        spread = None if added is None else spread_of(of, d, added[None], 1.0, RADII)
        if spread is None:
            return Told(None, IN_DOUBT)
        for apart, (moments,) in spread.items():
            more = moments
            if apart is not None:
                more = scaled(moments, number_of(1 - 1 / of.counts[d], RADII), RADII)
            totals[apart] = RADII.add(totals[apart], more) if apart in totals else more
    spreads = [
        _Spread(apart, at, of.offsets, totals[apart][:, at.rest[:, None], at.rest])
        for apart, _, at in of.parts
    ]
    return _largest(spreads, classes)


def _lucky(of: Classes, added: Sequence[Matrix]) -> list[Matrix] | None:
    """Return what luck adds to peers of each class who get so much a frame, None where it has no bound."""
    found = [np.zeros_like(own) for own in added]
    for d, own in enumerate(added):
        after = luck_after(of, d, own[None], 1.0, RADII)
        if after is None:
            return None
        found = [RADII.add(one, more[0]) for one, more in zip(found, after, strict=True)]
    return found


def pattern_error(system: CompiledSystem, prepared: Prepared, first: Fraction) -> Told:
    """Return the largest error of copies, or why there is none, pattern by pattern of lost packets.

    It is right to what an iteration and rounding leave, of which there is no bound.

    Parameters
    ----------
    system, prepared, first
        As for `standing_error`.
    """
    pushed = forced(system, hearing(system, prepared, first=first, stand_in=True), first)
    if isinstance(pushed, str):
        return Told(None, pushed)
    peers = dense_loop(pushed.told.groups, pushed.told.exchange).sites
    classes = [_Class(1, pushed.peers[id(site.schedule)]) for site in peers]
    found = frames(system, prepared, first, every_pattern, told=pushed.told)
    of = of_all(found)
    drawn = np.zeros(len(of.at.held) + len(of.at.rest))
    for start, one in zip(found.sites, classes, strict=False):
        drawn[start + np.array(one.got.drawn, np.intp)] = 1.0
    moments = resting_moments(of, np.diag(drawn[of.at.rest]))
    if moments is None:
        return Told(None, NO_END)
    return _largest([_Spread(None, of.at, found.sites, RADII.exact(moments))], classes)


def tagged_error(system: CompiledSystem, prepared: Prepared, first: Fraction, orders: Sequence[int]) -> Told:
    """Return the largest error of copies, or why there is none: bursts between equal peers, tag by tag.

    Parameters
    ----------
    system, prepared, first
        As for `standing_error`.
    orders
        How many tags there are at most; of two, what the last gives is an estimate.
    """
    pushed = forced(system, hearing(system, prepared, first=first, stand_in=True), first)
    if isinstance(pushed, str):
        return Told(None, pushed)
    (got,) = {id(one): one for one in pushed.peers.values()}.values()
    classes = [_Class(1, got)] * system.peers
    told = Told(None, "")
    before: list[float] = []
    for order in orders:
        found = tagged_moments(system, prepared, first, order, told=pushed.told, drawn=got.drawn)
        if found is None:
            return Told(None, NO_END)
        at = relative_coordinates(found[0].basis)
        take = np.zeros((len(at.rest), len(found[1])))
        take[np.arange(len(at.rest)), at.rest], take[:, at.held] = 1.0, -at.weights
        inner = RADII.exact(take @ found[1] @ take.T)
        told = _largest([_Spread(None, at, found[0].sites, inner)], classes)
        if told.metres is None:
            return told
        before.append(told.metres)
    if len(orders) == 1:
        return told
    note = f"an estimate: moments of at most {orders[1]} channels' states together; with {orders[0]} it is "
    return Told(before[-1], f"{note}{before[0]:.9g} m")


def _pushed(
    matrix: Matrix, apart: int | None, at: Relative, offsets: Sequence[int], classes: Sequence[_Class]
) -> _Spread | None:
    """Return the moments that pushes make of a loop of means (2, n, n), None where they have no bound."""
    place = {state: number for number, state in enumerate(at.rest.tolist())}
    drawn = np.zeros((2, len(place), len(place)))
    for g, one in enumerate(classes):
        if apart not in (None, g):
            continue
        start = offsets[g] if apart is None else 0
        variance = Fraction(1, one.count)
        for state in one.got.drawn:
            drawn[:, place[start + state], place[start + state]] = _rounded(
                variance if apart is None else 1 - variance
            )
    moments = stein(matrix, drawn[None], RADII)
    return None if moments is None else _Spread(apart, at, tuple(offsets), moments[0])


def _rounded(number: Fraction) -> tuple[float, float]:
    """Return a number as a float, and what that may be off by."""
    value = float(number)
    return value, UNIT * abs(value) if value != number else 0.0


def _with_luck(of: Moments, spreads: Sequence[_Spread]) -> list[_Spread] | None:
    """Return moments with what the luck of channels adds, None where rounding leaves them open."""
    matrix = gain_of(of)(1.0, RADII)
    if matrix is None:
        return None
    first = _first_luck(of, spreads)
    found = _solved(matrix, first, _squares([slot for kind in of.luck for slot in kind.entries]))
    if found is None:
        return None
    result, starts = [], np.cumsum([0] + [sum(map(len, kind.entries)) for kind in of.luck])
    for part, spread in zip(of.parts, spreads, strict=True):
        total, n = spread.moments, spread.moments.shape[-1]
        for d, channel in part.channels.items():
            kind = of.luck[d]
            units = RADII.exact(units_of(kind).reshape(starts[d + 1] - starts[d], -1).T)
            k = channel.driven.shape[-1]
            covariance = RADII.multiply(units, found[:, starts[d] : starts[d + 1], None]).reshape(2, k, k)
            moved = stein(channel.matrix, around(channel.driven, covariance, RADII)[None], RADII)
            if moved is None:
                return None
            alone = 1 / kind.receivers
            share = kind.heard * (alone if part.apart is None else 1 - alone)
            total = RADII.add(total, scaled(moved[0][:, :n, :n], number_of(share, RADII), RADII))
        result.append(_Spread(spread.apart, spread.at, spread.offsets, total))
    return result


def _first_luck(of: Moments, spreads: Sequence[_Spread]) -> Matrix:
    """Return V₀ (2, entries): the covariances of luck for moments that pushes make."""
    found = []
    for kind in of.luck:
        for slot, listed in enumerate(kind.entries):
            total = np.zeros_like(kind.spreads[slot])
            for part, spread in zip(of.parts, spreads, strict=True):
                for site, sender in enumerate(part.classes):
                    rows = part.loop.misses.get((site, kind.route, slot))
                    if sender == kind.sender and rows is not None:
                        total = RADII.add(total, around(rows, spread.moments, RADII))
            total = scaled(total, kind.spreads[slot], RADII)
            found += [total[:, a, b] for a, b in listed]
    return np.array(found).reshape(-1, 2).T


def _squares(entries: Sequence[Sequence[tuple[int, int]]]) -> list[tuple[int, int]]:
    """Return where the entries (a, a) and (b, b) of the same matrix are, of the entries (a, b) of several."""
    found: list[tuple[int, int]] = []
    for listed in entries:
        own = {entry: len(found) + number for number, entry in enumerate(listed)}
        found += [(own[a, a], own[b, b]) for a, b in listed]
    return found


def _solved(matrix: Matrix, known: Matrix, squares: Sequence[tuple[int, int]]) -> Matrix | None:
    """Return V of V = V₀ + G V with its radius (2, n), None where rounding leaves open whether there is one.

    Notes
    -----
    Entries are solved for beside their sizes, those of covariances, √(V_aa V_bb), of a few frames: `squares`
    says where each entry's a and b are.
    """
    a, b = np.array(squares).T
    few = known[0]
    for _ in range(SIZED):
        few = known[0] + value_of(matrix) @ few
    size = np.sqrt(np.maximum(few[a], 0.0)) * np.sqrt(np.maximum(few[b], 0.0))
    few = np.maximum(few, VANISHING * (radius_of(matrix) @ size))  # where it would vanish but for rounding
    size = np.sqrt(np.maximum(few[a], 0.0)) * np.sqrt(np.maximum(few[b], 0.0))
    kept = np.flatnonzero(size)
    if known[:, size == 0].any() or matrix[:, size == 0].any():
        return None
    found, size = np.zeros_like(known), size[kept]
    inner = matrix[:, kept[:, None], kept] / size[:, None] * size
    inner[1] += 4 * UNIT * np.abs(inner[0])
    of = known[:, kept] / size
    of[1] += 2 * UNIT * np.abs(of[0])
    solved = solve(RADII.subtract(RADII.exact(np.eye(len(kept))), inner), of[..., None])
    if solved is None:
        return None
    solved[1] += 2 * UNIT * np.abs(solved[0])
    found[:, kept] = solved[..., 0] * size
    found[1] *= 1 + 8 * UNIT
    return found


def _largest(spreads: Sequence[_Spread], classes: Sequence[_Class]) -> Told:
    """Return the root of the largest variance of an error, or why there is none."""
    forms = _errors(classes)
    if not forms:
        return Told(None, NO_COPIES)
    largest = 0.0
    for form in forms:
        total = np.zeros((2, 1, 1))
        for one in spreads:
            row = _over(one, form, classes)
            if row is None:
                return Told(None, DRIFTING)
            total = RADII.add(total, around(row, one.moments, RADII))
        variance, radius = total[:, 0, 0].tolist()
        if not radius <= DOUBT * variance and radius:
            return Told(None, IN_DOUBT)
        largest = max(largest, variance)
    return Told(math.sqrt(largest))


def _errors(classes: Sequence[_Class]) -> list[_Error]:
    """Return the error of a copy of each class that has others: x_i − (Σ_j x_j − x_i)/(N − 1)."""
    found = []
    for copy in dict.fromkeys(copy for one in classes for copy in one.got.copies):
        counts = [one.count if copy in one.got.copies else 0 for one in classes]
        others = sum(counts) - 1
        if others:
            means = tuple(Fraction(-count, others) for count in counts)
            of = [place for place, count in enumerate(counts) if count]
            found += [_Error(place, copy, 1 + Fraction(1, others), means) for place in of]
    return found


def _over(spread: _Spread, form: _Error, classes: Sequence[_Class]) -> Matrix | None:
    """Return an error (2, 1, n) over the coordinates of a spread; None where standing motions move it."""
    row: dict[int, Fraction] = {}
    if spread.apart is None:
        for g, weight in enumerate(form.means):
            if weight:
                own = weight + (form.own if g == form.of else 0)
                row[spread.offsets[g] + classes[g].got.copies[form.copy]] = own
    elif spread.apart == form.of:
        row[classes[form.of].got.copies[form.copy]] = form.own
    whole = np.zeros(len(spread.at.held) + len(spread.at.rest))
    for place, weight in row.items():
        whole[place] = float(weight)
    moved = whole[spread.at.held] + whole[spread.at.rest] @ spread.at.weights
    if np.abs(moved).max(initial=0.0) > APART * np.abs(whole).max(initial=0.0):
        return None
    return rounded(whole[spread.at.rest][None])
