"""The worst that losses can do: how many in a row are harmless, and a pattern of them that shakes a scene.

Takes: a `CompiledSystem` whose links lose packets, whose receivers hold what they heard last.
Gives: `LossesInARow`, `worst_case`; `trace_of_worst`; for both, `held_parts`, `harmless`, `shaking`.
Guarantees: what is certified is proved for every pattern on every channel by itself; a pattern's growth above
1 is proved. The cost does not grow with the number of equal peers on complete graphs.
Does not: find the worst pattern of all: between the losses certified and those of the pattern it is open.

A receiver that missed ℓ packets in a row goes on with q[k−ℓ], off by the sum w of the last ℓ differences
d[k] = q[k] − q[k−1]. Losses after one that was heard make a block; over each, w = −T_ℓ d with T_ℓ the lower
triangle of ones, and blocks don't overlap. So each channel is an operator from d to w of norm at most
‖T_L‖₂ = 1 / (2 sin(π/(4L + 2))), whatever its pattern, if L is the most in a row. What peer i hears is off by
r_i = Σ_j W_ij w_ij, ‖r‖ ≤ ‖|W|‖₂ ‖T_L‖₂ ‖d‖ over all peers, and by the small gain theorem the scene is
exponentially stable for all patterns if

    ‖d ← r‖∞ ‖|W|‖₂ < 2 sin(π/(4L + 2))

d ← r splits into the modes, of which the largest gain counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, prepare, timed
from apc.compiler.compiled import CompiledSystem, Link
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import Loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import complete_loops, dense_loop, split_exchangeable
from apc.eigen.peer_group import PeerGroup, used_ways
from apc.frame.discretize import UNIT
from apc.frame.parameters import resolve
from apc.frame.radius import RADII, radius_of, value_of
from apc.frame.schedule import Way
from apc.moments.held import Ear, HeldLoop, held_loop, lossy_rows, unheld
from apc.moments.peak import peak_gain, proves_gain

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# What each channel of a link counts in the one number that receivers combine them into, by link and channel.
Ratios = Mapping[tuple[str, str], Fraction]

ONE = Fraction(1)

# States of one loop worth trying words on; a Hamiltonian matrix of twice as many takes a tenth of a second.
MOST_STATES = 120

# Losses in a row that are not worth telling from any number.
MANY = 1_000_000

# Roundings of a norm of few weights, and of what a gain is compared with.
NORM_ROUNDINGS = 1000

# Words tried: all of so many frames; of so few gaps of up to so many frames; one long gap after a few short.
FRAMES, GAPS, LONGEST, LONE, SHORT = 14, 4, 9, 40, 6

# Work on words, in cubes of the states of their loops: some thousands of the smallest.
WORK, LEAST_STATES = 10_000 * 16**3, 16

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-12


@dataclass(frozen=True, slots=True)
class LossesInARow:
    """What losses in a row do to a scene.

    `certified` in a row are proved harmless, whatever their pattern, on every channel by itself; None where
    that can't be said. `unstable_pattern` is a period of a pattern that shakes the scene, frame by frame
    (True: all packets of the frame get lost), `growth` what that makes of it per frame, proved above 1; both
    are None where no such pattern was met. `note` says more, or why nothing is said.
    """

    certified: int | None
    unstable_pattern: tuple[bool, ...] | None
    growth: float | None
    note: str


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A mode of a scene: `heard` where all channels lose the same packets, `off` for what comes on top.

    `off` holds A, B, C, D of d ← r in coordinates of unit length for each peer.
    """

    name: str
    heard: HeldLoop
    off: tuple[Matrix, Matrix, Matrix, Matrix]


@dataclass(frozen=True, slots=True)
class HeldParts:
    """All modes of a scene; `weight` is ‖|W|‖₂."""

    parts: tuple[HeldPart, ...]
    weight: float


def worst_case(system: CompiledSystem, prepared: Prepared) -> LossesInARow:
    """Say how many losses in a row are harmless, and which pattern shakes a scene.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    """
    found = held_parts(system, prepared)
    if isinstance(found, str):
        return LossesInARow(None, None, None, f"losses in a row are left open: {found}")
    certified = harmless(found)
    if certified == MANY:
        return LossesInARow(MANY, None, None, "any number of losses in a row is harmless")
    return LossesInARow(certified, *shaking(found, known=certified or 0))


def trace_of_worst(system: CompiledSystem) -> CompiledSystem:
    """Return a system whose unreliable links lose packets by the pattern that shakes it, again and again.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to play.

    Raises
    ------
    ApcError
        E897 no such pattern is known, or it can't be played.
    """
    found = worst_case(system, prepare(system))
    pattern = found.unstable_pattern
    if pattern is None:
        what = f"--trace-of worst has nothing to play: {found.note}"
        raise ApcError(Mistake("E897", Place(system.name), what, hint="apc simulate"))
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    for link in system.links:
        delays = {seconds[link.delay], *(seconds[one.delay] for one in link.delays)}
        if link.channel is not None and len(delays) > 1:
            what = f"--trace-of worst gives all packets of {link.name} one delay, and they have several"
            raise ApcError(Mistake("E897", Place(system.name), what, hint="apc simulate"))

    def played(link: Link) -> Link:
        if link.channel is None:
            return link
        trace = np.where(pattern, np.inf, seconds[link.delay])
        return replace(link, channel=replace(link.channel, loss=None, jitter=None, trace=trace))

    return replace(system, links=tuple(map(played, system.links)))


def held_parts(system: CompiledSystem, prepared: Prepared) -> HeldParts | str:
    """Make the modes of a scene whose receivers hold what they heard last, or say why not.

    Parameters
    ----------
    system, prepared
        As for `worst_case`.
    """
    at = timed(system, prepared, resolve(system))
    if why := unheld(system, at.schedules):
        return why
    lossy = frozenset(link.name for link in system.links if link.channel is not None)
    groups, exchange = lifted_groups(system, prepared=at)
    ways = used_ways(group.schedule for group in groups)
    if all(exchange.is_complete(way.link) for way in ways):
        loops = complete_loops(groups, exchange)
        whole = loops[0]
    else:
        count = sum(group.count for group in groups)
        if count > MOST_STATES:
            return f"{count:,} peers on a graph that is not complete are too many: {MOST_STATES} states fit"
        whole = dense_loop(groups, exchange)
        loops = split_exchangeable(whole, exchange)
    parts, ratios = [], _ratios(whole.sites, lossy)
    for loop in loops:
        if loop.states > MOST_STATES:
            return f"peers make one system of {loop.states:,} states, and {MOST_STATES} are the most"
        part = _part(loop, lossy, ratios)
        if part is None:
            return "a packet follows from another one of its frame"
        parts.append(part)
    return HeldParts(tuple(parts), _weight(whole, lossy))


def _part(loop: Loop, lossy: frozenset[str], ratios: Ratios) -> HeldPart | None:
    """Make a mode of a scene, None where packets depend on one another within a frame."""
    listened = [lossy_rows(site, lossy) for site in loop.sites]
    ears, outside = [], []
    for h, site in enumerate(loop.sites):
        for row, sent in enumerate(site.schedule.sent):
            weights = {
                (g, line): loop.coupling[one.way][g][h]
                for g, rows in enumerate(listened)
                for line, one in rows
                if one.sent == sent and loop.coupling[one.way][g][h]
            }
            if weights:
                ears.append(Ear(weights, h, row))
    for g, rows in enumerate(listened):
        for way, sent in dict.fromkeys((one.way, one.sent) for _, one in rows):
            # Of several numbers that are heard as one, that which counts once is what the others add to.
            if ratios.get((sent.link, sent.channel), ONE) == ONE:
                places = [line for line, one in rows if (one.way, one.sent) == (way, sent)]
                outside.append(Ear(dict.fromkeys(((g, line) for line in places), ONE)))
    heard, whole = held_loop(loop, ears, lossy), held_loop(loop, [*ears, *outside], lossy)
    if heard is None or whole is None:
        return None
    # Coordinates of unit length: n peers that move alike by 1 each move by √n.
    counts = [math.sqrt(loop.sites[next(iter(ear.weights))[0]].count) for ear in outside]
    sums: dict[tuple[int, str, str], Floats] = {}
    for place, ear in enumerate(ears):
        assert ear.sender is not None
        site = loop.sites[ear.sender]
        sent = site.schedule.sent[ear.row]
        ratio = ratios.get((sent.link, sent.channel))
        number = (ear.sender, sent.link, sent.channel if ratio is None else "")
        combined = sums.setdefault(number, np.zeros((2, len(ears))))
        combined[:, place] = _scaled(float(ratio or ONE), math.sqrt(site.count))
    adding = np.stack(list(sums.values()), axis=1) if sums else np.zeros((2, 0, len(ears)))
    shares = np.zeros((2, len(outside), len(outside)))
    for place, count in enumerate(counts):
        shares[:, place, place] = _scaled(1.0, 1 / count)
    return HeldPart(
        loop.name,
        heard,
        (
            whole.frame(lost=False),
            RADII.multiply(whole.g[..., len(ears) :], shares),
            RADII.multiply(adding, whole.step),
            np.zeros((2, adding.shape[-2], len(outside))),
        ),
    )


def _scaled(value: float, by: float) -> tuple[float, float]:
    """Return a product of two numbers that are rounded once or twice each, and its radius."""
    return value * by, 8 * UNIT * abs(value * by) if by != 1 or value != 1 else 0.0


def _ratios(sites: Sequence[PeerGroup], lossy: frozenset[str]) -> Ratios:
    """Find the links of which every tick of every site combines all channels into the same number.

    Those of other links are kept apart. The first channel that counts has the ratio 1.
    """
    found: dict[tuple[str, str], Fraction] = {}
    for link in sorted(lossy):
        columns: dict[str, dict[tuple[int, int, int, Way], Fraction]] = {}
        for g, site in enumerate(sites):
            used = {(one.way, one.sent.channel) for _, one in lossy_rows(site, frozenset([link]))}
            for partition, tick in enumerate(site.exact.ticks):
                for receive in range(tick.r.shape[1]):
                    for way, channel in site.schedule.ways(partition, receive):
                        if (way, channel) not in used:
                            continue
                        own = columns.setdefault(channel, {})
                        for row, entry in enumerate(tick.r[:, receive]):
                            if entry:
                                key = (g, partition, row, way)
                                own[key] = own.get(key, Fraction(0)) + entry
        if not columns or any(way.edge for own in columns.values() for *_, way in own):
            continue
        base = next(iter(columns.values()))
        ratios = {}
        for channel, own in columns.items():
            place = next(iter(own), None)
            ratio = own[place] / base[place] if place is not None and base.get(place) else None
            if ratio is None or own != {at: ratio * entry for at, entry in base.items()}:
                break
            ratios[link, channel] = ratio
        else:
            found |= ratios
    return found


def _weight(whole: Loop, lossy: frozenset[str]) -> float:
    """Return ‖|W|‖₂, rounded up, of the loop in which all peers are, alike where they are equal."""
    largest = 0.0
    for link in lossy:
        rows = [
            [
                abs(float(weight)) * math.sqrt(receiver.count / sender.count)
                for weight, sender in zip(whole.coupling[way][g], whole.sites, strict=True)
            ]
            for g, receiver in enumerate(whole.sites)
            for way in dict.fromkeys(one.way for _, one in lossy_rows(receiver, frozenset([link])))
        ]
        if rows:
            largest = max(largest, float(np.linalg.norm(np.array(rows), 2)))
    return largest * (1 + NORM_ROUNDINGS * UNIT)


def harmless(of: HeldParts) -> int | None:
    """Return how many losses in a row are proved harmless, None where not even none are.

    Parameters
    ----------
    of
        The modes of a scene.
    """
    nominal = [part.heard.frame(lost=False) for part in of.parts]
    if any(enclose_eigenvalues(value_of(one), radius_of(one))[1].high >= 1 for one in nominal):
        return None
    gain = max(peak_gain(*map(value_of, part.off)) for part in of.parts) * of.weight
    if gain >= 2:
        return 0
    most = MANY
    if gain > math.pi / (4 * MANY):
        most = min(MANY, math.ceil((math.pi / math.asin(gain / 2) - 2) / 4) - 1)
    # Where the last one is too near to prove it, that before is far enough.
    for losses in range(most, max(most - 2, 0), -1):
        level = 2 * math.sin(math.pi / (4 * losses + 2)) * (1 - 8 * UNIT) / max(of.weight, UNIT)
        if all(proves_gain(*part.off, level) for part in of.parts):
            return losses
    return 0


@cache
def words(losses: int) -> tuple[tuple[int, ...], ...]:
    """Return the words of gaps that are tried, whose longest gap loses so many packets, the shortest first.

    A gap is the number of frames from one packet that is heard to the next. Of all words that turn into one
    another the first is given; none repeats a shorter one.
    """
    return _all_words().get(losses, ())


@cache
def _all_words() -> dict[int, tuple[tuple[int, ...], ...]]:
    found: set[tuple[int, ...]] = {(1,)}
    for pattern in _lyndon_words(2, FRAMES):
        heard = [place for place, symbol in enumerate(pattern) if symbol]
        gaps = np.diff([-1, *heard]).tolist()
        found |= {min((*gaps[k:], *gaps[:k]) for k in range(len(gaps)))} if gaps else set()
    found |= {tuple(gap + 1 for gap in pattern) for pattern in _lyndon_words(LONGEST, GAPS)}
    found |= {(*(1,) * short, long) for long in range(2, LONE + 1) for short in range(SHORT)}
    by_losses: dict[int, list[tuple[int, ...]]] = {}
    for word in sorted(found, key=lambda word: (sum(word), word)):
        by_losses.setdefault(max(word) - 1, []).append(word)
    return {losses: tuple(listed) for losses, listed in by_losses.items()}


def _lyndon_words(symbols: int, length: int) -> Iterator[tuple[int, ...]]:
    """Give the words of up to a length that come before all that they turn into (Duval, 1988)."""
    word = [-1]
    while word:
        word[-1] += 1
        yield tuple(word)
        own = len(word)
        while len(word) < length:
            word.append(word[-own])
        while word and word[-1] == symbols - 1:
            word.pop()


def growths(part: HeldPart, tried: Sequence[tuple[int, ...]]) -> Floats:
    """Return what words make of a mode per frame (n,), all channels losing the same packets.

    Parameters
    ----------
    part
        The mode.
    tried
        Words of gaps.
    """
    heard, lost = (value_of(part.heard.frame(lost=one)) for one in (False, True))
    found = np.zeros(len(tried))
    if not len(heard):
        return found
    gaps = [heard]
    for _ in range(max(map(max, tried)) - 1):
        gaps.append(gaps[-1] @ lost)
    over = np.stack(gaps)
    for length in sorted({len(word) for word in tried}):
        places = [place for place, word in enumerate(tried) if len(word) == length]
        listed = np.array([tried[place] for place in places])
        product = over[listed[:, 0] - 1]
        for column in range(1, length):
            product = over[listed[:, column] - 1] @ product
        size = np.abs(np.linalg.eigvals(product)).max(axis=1)
        found[places] = size ** (1 / listed.sum(axis=1))
    return found


def shaking(of: HeldParts, *, known: int = 0) -> tuple[tuple[bool, ...] | None, float | None, str]:
    """Find a pattern of as few losses in a row as possible that shakes a scene, the shortest of these.

    Parameters
    ----------
    of
        The modes of a scene.
    known
        How many losses in a row are harmless.

    Returns
    -------
    tuple
        A period of the pattern, its growth per frame, and what else there is to say.
    """
    left = WORK // sum(max(part.heard.f.shape[-1], LEAST_STATES) ** 3 for part in of.parts)
    for losses in [0, *range(known + 1, LONE)]:
        tried = words(losses)[:left]
        left -= len(tried)
        if not tried:
            return None, None, f"no pattern tried of fewer than {losses} losses in a row shakes the scene"
        found = np.stack([growths(part, tried) for part in of.parts])
        for place in np.lexsort((-found.max(axis=0), [sum(word) for word in tried])).tolist():
            part = of.parts[int(np.argmax(found[:, place]))]
            if found[:, place].max() > ABOVE and _is_proved(part, tried[place]):
                worst = int(np.argmax(found.max(axis=0)))
                how = "all packets lost at once shake" if losses else "with no packet lost grows"
                note = f"{how} the {part.name} mode"
                if found[:, worst].max() > found[:, place].max():
                    note += (
                        f"; of {losses} in a row, the most met is {found[:, worst].max():.8g} a frame, by "
                        f"{spelled(pattern_of(tried[worst]))}"
                    )
                return pattern_of(tried[place]), float(found[:, place].max()), note
    return None, None, f"no pattern tried of fewer than {LONE} losses in a row shakes the scene"


def pattern_of(word: Sequence[int]) -> tuple[bool, ...]:
    """Return a period of a word of gaps, frame by frame: whether packets get lost."""
    return tuple(lost for gap in word for lost in (*(True,) * (gap - 1), False))


def spelled(pattern: Sequence[bool]) -> str:
    """Return a pattern as a row of dots, crosses where packets get lost."""
    return "".join("×" if lost else "·" for lost in pattern)


def _is_proved(part: HeldPart, word: Sequence[int]) -> bool:
    """Say whether a word is proved to make a mode grow."""
    heard, lost = part.heard.frame(lost=False), part.heard.frame(lost=True)
    product = RADII.exact(np.eye(heard.shape[-1]))
    for gone in pattern_of(word):
        product = RADII.multiply(lost if gone else heard, product)
    return enclose_eigenvalues(value_of(product), radius_of(product))[1].low > 1
