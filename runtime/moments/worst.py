"""The worst that losses can do: how many in a row are harmless, and a pattern of them that shakes a scene.

Takes: a `CompiledSystem` whose links lose packets, whose receivers hold what they heard last.
Gives: `LossesInARow`, `worst_case`; `trace_of_worst`; for both, `held_parts`, `harmless`, `shaking`;
`ratios_of`, `weight_of`.
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

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Link
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import Loop
from apc.eigen.dissipation import peak_gain, proves_gain
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.peers import PeerGroup
from apc.frame.instance import Prepared, prepare
from apc.frame.radius import RADII, UNIT, radius_of, value_of
from apc.frame.schedule import Way
from apc.moments.held import Ear, HeldLoop, ears_of, held_loop, held_scene, lossy_rows
from apc.moments.unserved import UnservedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# How much the movement of a peer counts beside those of others, by link and site.
Sizes = Mapping[tuple[str, str], float]

# What each channel of a link counts in the one number that receivers combine them into, by link and channel.
Ratios = Mapping[tuple[str, str], Fraction]

ONE = Fraction(1)

# States of one loop worth trying words on; a Hamiltonian matrix of twice as many takes a tenth of a second.
MOST_STATES = 120

# Losses in a row that are not worth telling from any number.
MANY = 1000

# Parts of the losses in a row that a gain allows for which a proof is tried, where one is not found for all.
PARTS = (1.0, 0.9, 0.5, 0.1)

# The least of a peer's unit beside the largest.
LEAST_UNIT = 1e-6

# Roundings of a norm of few weights, and of what a gain is compared with.
NORM_ROUNDINGS = 1000

# Words tried: all of so many frames; of so few gaps of up to so many frames; one long gap after a few short.
FRAMES, GAPS, LONGEST, LONE, SHORT = 14, 4, 9, 40, 6

# Work on the words of so many losses in a row, in cubes of the states of their loops: all words of two small
# loops; a few of any.
WORK, LEAST_STATES, FEWEST = 1500 * 16**3, 16, 6

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


@dataclass(frozen=True, slots=True, eq=False)
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
        From `instance.prepare`, of this system with any numbers.
    """
    try:
        parts = held_parts(system, prepared)
    except UnservedError as why:
        return LossesInARow(None, None, None, f"losses in a row are left open: {why}")
    certified = harmless(parts)
    if certified == MANY:
        return LossesInARow(MANY, None, None, f"{MANY:,} losses in a row are harmless, where counting ends")
    pattern, growth, note = shaking(parts, known=certified or 0)
    if certified is None and pattern is None:
        note = f"the scene is not proved to settle with no packet lost; {note}"
    return LossesInARow(certified, pattern, growth, note)


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
    losses_in_a_row = worst_case(system, prepare(system))
    pattern = losses_in_a_row.unstable_pattern
    if pattern is None:
        what = f"--trace-of worst has nothing to play: {losses_in_a_row.note}"
        raise ApcError(Mistake("E897", Place(system.origin.topology), what, hint="apc simulate"))
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    for link in system.links:
        delays = {seconds[link.delay], *(seconds[delay.delay] for delay in link.delays)}
        if link.channel is not None and len(delays) > 1:
            what = f"--trace-of worst gives all packets of {link.name} one delay, and they have several"
            raise ApcError(Mistake("E897", Place(system.origin.topology), what, hint="apc simulate"))

    def played(link: Link) -> Link:
        if link.channel is None:
            return link
        trace = np.where(pattern, np.inf, seconds[link.delay])
        return replace(link, channel=replace(link.channel, loss=None, jitter=None, trace=trace))

    return replace(system, links=tuple(map(played, system.links)))


def held_parts(system: CompiledSystem, prepared: Prepared) -> HeldParts:
    """Make the modes of a scene whose receivers hold what they heard last.

    Parameters
    ----------
    system, prepared
        As for `worst_case`.
    """
    scene = held_scene(system, prepared)
    loops = loops_at_right_angles(scene.hearing.groups, scene.hearing.exchange, MOST_STATES)
    if isinstance(loops, str):
        raise UnservedError(loops)
    lossy = scene.lossy
    parts, ratios = [], ratios_of(loops[0].sites, lossy)
    weight, sizes = weight_of(loops, lossy)
    for loop in loops:
        if loop.states > MOST_STATES:
            what = f"peers make one system of {loop.states:,} states"
            raise UnservedError(f"{what}, and {MOST_STATES} are the most")
        parts.append(_part(loop, lossy, ratios, sizes))
    return HeldParts(tuple(parts), weight)


def _part(loop: Loop, lossy: frozenset[str], ratios: Ratios, sizes: Sizes) -> HeldPart:
    """Make a mode of a scene."""

    def size(site: int, link: str) -> float:
        """Return how far n peers of a site that move alike by 1 move together: √n, or as they are weighed."""
        return math.sqrt(loop.sites[site].count) * sizes.get((link, loop.sites[site].name), 1.0)

    listened = [lossy_rows(site, lossy) for site in loop.sites]
    ears = ears_of(loop, lossy, range(len(loop.sites)))
    outside: list[Ear] = []
    shares: list[float] = []
    for g, rows in enumerate(listened):
        for way, sent in dict.fromkeys((heard.way, heard.sent) for _, heard in rows):
            # Of several numbers that are heard as one, that which counts once is what the others add to.
            if ratios.get((sent.link, sent.channel), ONE) == ONE:
                places = [line for line, heard in rows if (heard.way, heard.sent) == (way, sent)]
                outside.append(Ear(dict.fromkeys(((g, line) for line in places), ONE)))
                shares.append(1 / size(g, sent.link))
    heard = held_loop(loop, [*ears, *outside], lossy).relative()
    roundings = [8 * UNIT * share if share != 1 else 0.0 for share in shares]
    sums: dict[tuple[int, str, str], Floats] = {}
    for place, ear in enumerate(ears):
        assert ear.sender is not None
        sent = loop.sites[ear.sender].schedule.sent[ear.row]
        ratio = ratios.get((sent.link, sent.channel))
        number = (ear.sender, sent.link, sent.channel if ratio is None else "")
        combined = sums.setdefault(number, np.zeros((2, len(ears))))
        combined[:, place] = _scaled(float(ratio or ONE), size(ear.sender, sent.link))
    adding = np.stack(list(sums.values()), axis=1) if sums else np.zeros((2, 0, len(ears)))
    return HeldPart(
        loop.name,
        heard,
        (
            heard.frame(lost=False),
            RADII.multiply(heard.g[..., len(ears) :], np.stack([np.diag(shares), np.diag(roundings)])),
            RADII.multiply(adding, heard.step),
            np.zeros((2, adding.shape[-2], len(outside))),
        ),
    )


def _scaled(value: float, by: float) -> tuple[float, float]:
    """Return a product of two numbers that are rounded once or twice each, and its radius."""
    return value * by, 8 * UNIT * abs(value * by) if by != 1 or value != 1 else 0.0


def ratios_of(sites: Sequence[PeerGroup], lossy: frozenset[str]) -> Ratios:
    """Find the links of which every tick of every site combines all channels into the same number.

    Those of other links are kept apart. The first channel that counts has the ratio 1.
    """
    result: dict[tuple[str, str], Fraction] = {}
    for link in sorted(lossy):
        columns: dict[str, dict[tuple[int, int, int, Way], Fraction]] = {}
        for g, site in enumerate(sites):
            used = {(heard.way, heard.sent.channel) for _, heard in lossy_rows(site, frozenset([link]))}
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
        if not columns or any(way.edge for column in columns.values() for *_, way in column):
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
            result |= ratios
    return result


def weight_of(loops: Sequence[Loop], lossy: frozenset[str]) -> tuple[float, Sizes]:
    """Return ‖|W|‖₂, rounded up, and the sizes of peers by which it is as small as can be.

    Notes
    -----
    Of loops at right angles |W| is largest on the first, where all peers of a site move alike; of loops of
    one site each, where its eigenvalue is. Each peer may be measured by a unit of its own, as what a channel
    does to a number it does to any multiple: by √(v/u), u and v the vectors of Perron of |W| and |W|ᵀ, the
    norm becomes the spectral radius (Stoer and Witzgall, 1962).
    """
    largest = 0.0
    sizes: dict[tuple[str, str], float] = {}
    for link in sorted(lossy):
        own = frozenset([link])
        used = {heard.way for loop in loops for site in loop.sites for _, heard in lossy_rows(site, own)}
        for loop in loops if len(loops[0].sites) == 1 else loops[:1]:
            count = np.array([site.count for site in loop.sites], np.float64)
            blocks = [
                (np.abs(np.array(rows, np.float64)) + loop.doubts.get(way, 0.0))
                * np.sqrt(count[:, None] / count)
                for way, rows in loop.coupling.items()
                if way in used
            ]
            if not blocks:
                continue
            units = _units(np.sum(blocks, axis=0))
            sizes |= {(link, site.name): unit for site, unit in zip(loop.sites, units.tolist(), strict=True)}
            turned = np.concatenate([units[:, None] * block / units for block in blocks])
            largest = max(largest, float(np.linalg.norm(turned, 2)))
    return largest * (1 + NORM_ROUNDINGS * UNIT), sizes


def _units(weights: Floats) -> Floats:
    """Return units by which a matrix of weights has the smallest norm; 1 where some peers hear nobody."""
    result = []
    for matrix in (weights, weights.T):
        values, vectors = np.linalg.eig(matrix)
        result.append(np.abs(vectors[:, int(np.argmax(values.real))]))
    if min(float(item.min() / item.max()) for item in result) < LEAST_UNIT:
        return np.ones(len(weights))
    units = np.sqrt(result[1] / result[0])
    return np.asarray(units / units.max())


def harmless(of: HeldParts) -> int | None:
    """Return how many losses in a row are proved harmless, None where not even none are.

    Parameters
    ----------
    of
        The modes of a scene.
    """
    nominal = [part.heard.frame(lost=False) for part in of.parts]
    if any(enclose_eigenvalues(value_of(values), radius_of(values))[1].high >= 1 for values in nominal):
        return None
    gain = max(peak_gain(*map(value_of, part.off))[0] for part in of.parts) * of.weight
    if gain >= 2:
        return 0
    most = MANY
    if gain > math.pi / (4 * MANY):
        most = min(MANY, math.ceil((math.pi / math.asin(gain / 2) - 2) / 4) - 1)
    # Where the last one is too near to prove it, that before is far enough, or some part of it.
    for losses in sorted({most, *(int(part * (most - 1)) for part in PARTS)} - {0, -1}, reverse=True):
        level = 2 * math.sin(math.pi / (4 * losses + 2)) * (1 - 8 * UNIT) / max(of.weight, UNIT)
        if all(proves_gain(*part.off, level) for part in of.parts):
            return losses
    return 0


@cache
def _words() -> dict[int, list[tuple[int, ...]]]:
    """Return the words of gaps that are tried, by how many losses in a row they have, the shortest first.

    A gap is the number of frames from one packet that is heard to the next. Of all words that turn into one
    another the first is given.
    """
    tried: set[tuple[int, ...]] = set()
    for frames in range(1, FRAMES + 1):
        for lost in itertools.product((0, 1), repeat=frames - 1):
            heard = [place for place, number in enumerate((*lost, 0)) if not number]
            tried.add(tuple(np.diff([-1, *heard]).tolist()))
    for count in range(1, GAPS + 1):
        tried |= set(itertools.product(range(1, LONGEST + 1), repeat=count))
    tried |= {(*(1,) * short, long) for long in range(2, LONE + 1) for short in range(SHORT)}
    turned = {min(word[k:] + word[:k] for k in range(len(word))) for word in tried}
    by_losses: dict[int, list[tuple[int, ...]]] = {}
    for word in sorted(turned, key=lambda word: (sum(word), word)):
        by_losses.setdefault(max(word) - 1, []).append(word)
    return by_losses


def _growths(part: HeldPart, words: Sequence[tuple[int, ...]]) -> Floats:
    """Return what words make of a mode per frame (words,), all channels losing the same packets."""
    heard, lost = (value_of(part.heard.frame(lost=flag)) for flag in (False, True))
    gaps = [heard]
    for _ in range(max(map(max, words)) - 1):
        gaps.append(gaps[-1] @ lost)
    over, growths = np.stack(gaps), np.zeros(len(words))
    for length in {len(word) for word in words} if len(heard) else ():
        places = [place for place, word in enumerate(words) if len(word) == length]
        listed = np.array([words[place] for place in places])
        product = over[listed[:, 0] - 1]
        for column in range(1, length):
            product = over[listed[:, column] - 1] @ product
        finite = np.isfinite(product).all(axis=(1, 2))  # the others, beyond all floats, are not tried
        largest = np.abs(np.linalg.eigvals(product[finite])).max(axis=1, initial=0.0)
        growths[np.array(places)[finite]] = largest ** (1 / listed[finite].sum(axis=1))
    return growths


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
    cost = sum(max(part.heard.f.shape[-1], LEAST_STATES) ** 3 for part in of.parts)
    for losses, listed in sorted(_words().items()):
        if 0 < losses <= known:
            continue
        words = listed[: max(FEWEST, WORK // cost)]
        growths = np.stack([_growths(part, words) for part in of.parts])
        growth = growths.max(axis=0)
        for place in np.lexsort((-growth, [sum(word) for word in words])).tolist():
            part = of.parts[int(np.argmax(growths[:, place]))]
            if growth[place] <= ABOVE or not _is_proved(part, words[place]):
                continue
            note = f"the {part.name} mode grows where all peers lose the same packets"
            if not losses:
                note = f"the {part.name} mode grows with no packet lost"
            most = int(np.argmax(growth))
            if growth[most] > growth[place] * (2 - 1 / ABOVE):
                spelled = "".join("×" if lost else "·" for lost in pattern_of(words[most]))
                note += f"; of at most {losses} losses in a row, the most met is "
                note += f"{growth[most]:.8g} a frame, by {spelled}"
            return pattern_of(words[place]), float(growth[place]), note
    return (
        None,
        None,
        f"no periodic pattern tried, of fewer than {LONE} losses in a row, makes the scene unstable",
    )


def pattern_of(word: Sequence[int]) -> tuple[bool, ...]:
    """Return a period of a word of gaps, frame by frame: whether packets get lost."""
    return tuple(lost for gap in word for lost in (*(True,) * (gap - 1), False))


def _is_proved(part: HeldPart, word: Sequence[int]) -> bool:
    """Say whether a word is proved to make a mode grow."""
    heard, lost = part.heard.frame(lost=False), part.heard.frame(lost=True)
    product = RADII.exact(np.eye(heard.shape[-1]))
    for gone in pattern_of(word):
        product = RADII.multiply(lost if gone else heard, product)
    return bool(enclose_eigenvalues(value_of(product), radius_of(product))[1].low > 1)
