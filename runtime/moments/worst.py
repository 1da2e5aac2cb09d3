"""The worst that losses can do: how many in a row are harmless, and a pattern of them that shakes a scene.

Takes: a `Model` whose links lose packets, whose receivers hold what they heard last.
Gives: `ConsecutiveLosses`, `worst_case`; `trace_of_worst`.
Guarantees: what is certified is proved for every pattern on every channel by itself; a pattern's growth above
1 is proved. The cost does not grow with the number of equal peers on complete graphs.
Does not: find the worst pattern of all: between the losses certified and those of the pattern it is open.

A receiver that missed ℓ packets in a row goes on with q[k−ℓ], off by the sum w of the last ℓ differences
d[k] = q[k] − q[k−1]. Losses after one that was heard make a block; over each, w = −T_ℓ d with T_ℓ the lower
triangle of ones, and blocks don't overlap. So each channel is an operator from d to w of norm at most
‖T_L‖₂ = 1 / (2 sin(π/(4L + 2))), whatever its pattern, if L is the most in a row, and by the small gain
theorem (see `small_gain`) the scene is exponentially stable for all patterns if

    ‖d ← r‖∞ ‖|W|‖₂ < 2 sin(π/(4L + 2))

d ← r splits into the modes, of which the largest gain counts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import close, feedback_of, lay_out_loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.relative import relative
from apc.frame.instance import Prepared, prepare
from apc.frame.radius import RADII, UNIT, radius_of, value_of
from apc.frame.schedule import CouplingTerm, SentSample
from apc.moments.crowd import build_hearing
from apc.moments.frames import refuse_unheld
from apc.moments.small_gain import (
    MOST_STATES,
    Response,
    change_of_sent,
    felt_rows,
    ratios_of,
    weight_of,
)
from apc.moments.traces import Packets
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Losses in a row that are not worth telling from any number.
MANY = 1000

# Parts of the losses in a row that a gain allows for which a proof is tried, where one is not found for all.
PARTS = (1.0, 0.9, 0.5, 0.1)

# Words tried: all of so many frames; of so few gaps of up to so many frames; one long gap after a few short.
FRAMES, GAPS, LONGEST, LONE, SHORT = 14, 4, 9, 40, 6

# Work on the words of so many losses in a row, in cubes of the states of their loops: all words of two small
# loops; a few of any.
WORK, LEAST_STATES, FEWEST = 1500 * 16**3, 16, 6

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-12


@dataclass(frozen=True, slots=True)
class ConsecutiveLosses:
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
class LossMode:
    """A mode of a scene: its matrix where all channels lose the packet of a frame, and d ← r if none does."""

    name: str
    lost: Matrix
    off: Response


def worst_case(system: Model, prepared: Prepared) -> ConsecutiveLosses:
    """Say how many losses in a row are harmless, and which pattern shakes a scene.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    """
    try:
        modes, weight = _modes(system, prepared)
    except NotSupportedError as why:
        return ConsecutiveLosses(None, None, None, f"losses in a row are left open: {why}")
    certified = _harmless(modes, weight)
    if certified == MANY:
        return ConsecutiveLosses(
            MANY, None, None, f"{MANY:,} losses in a row are harmless, where counting ends"
        )
    pattern, growth, note = _shaking(modes, certified or 0)
    if certified is None and pattern is None:
        note = f"the scene is not proved to settle with no packet lost; {note}"
    return ConsecutiveLosses(certified, pattern, growth, note)


def trace_of_worst(system: Model) -> Model:
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
        raise ApcError(Diagnostic("E897", SourceLocation(system.origin.topology), what, hint="apc simulate"))
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    for link in system.links:
        delays = {seconds[link.delay], *(seconds[delay.delay] for delay in link.delays)}
        if link.channel is not None and len(delays) > 1:
            what = f"--trace-of worst gives all packets of {link.name} one delay, and they have several"
            raise ApcError(
                Diagnostic("E897", SourceLocation(system.origin.topology), what, hint="apc simulate")
            )

    def played(link: Link) -> Link:
        if link.channel is None:
            return link
        trace = np.where(pattern, np.inf, seconds[link.delay])
        return replace(link, channel=replace(link.channel, loss=None, jitter=None, trace=trace))

    return replace(system, links=tuple(map(played, system.links)))


def _modes(system: Model, prepared: Prepared) -> tuple[list[LossMode], float]:
    """Return the modes of a scene whose receivers hold what they heard last, and ‖|W|‖₂."""
    hearing = build_hearing(system, prepared)
    refuse_unheld(system, hearing)
    loops = loops_at_right_angles(hearing.groups, hearing.exchange, MOST_STATES)
    lossy = frozenset(link.name for link in system.links if link.channel is not None)
    packets = Packets(system, hearing)
    numbers = {row: packets.heard(row)[0] for row in packets.rows}
    depths = packets.depths(numbers.items(), 1)
    # Where a packet is lost, that before is heard in its place, and sent again.
    before = {row: min(n, -1) if row.way.link in lossy else n for row, n in numbers.items()}
    ratios, (weight, sizes) = ratios_of(loops[0].sites, lossy), weight_of(loops, lossy)
    modes = []
    for loop in loops:
        now = packets.loop(loop, numbers, depths)
        off = []
        for g, site in enumerate(now.sites):
            hearing_of = dict[
                tuple[CouplingTerm, SentSample], dict[int, int]
            ]()  # all that hear a packet are off by the same
            for link in sorted(lossy):
                for line, heard in felt_rows(site, link):
                    hearing_of.setdefault((heard.way, heard.sent), {})[line] = heard.lag
            for lags in hearing_of.values():
                first = min(lags.values())
                off.append((g, {line: lag - first for line, lag in lags.items()}, 1.0))
        response = change_of_sent(now, off, ratios, sizes)
        missing = packets.loop(loop, before, depths)
        layout = lay_out_loop(missing)
        maps, n = [site.lifted for site in missing.sites], len(layout.names)
        states = len(response.at.held) + len(response.at.rest)
        matrix = np.zeros((2, states, states))
        matrix[:, :n, :n] = close(maps, feedback_of(missing, layout), layout, numbers=RADII).matrix
        for packet, place in layout.places.items():
            if packet.lag == 1 and missing.sites[packet.site].schedule.sent[packet.row].link in lossy:
                matrix[:, place] = 0.0
                matrix[0, place, place] = 1.0
        modes.append(LossMode(loop.name, relative(matrix, response.at, RADII), response))
    return modes, weight


def _harmless(modes: Sequence[LossMode], weight: float) -> int | None:
    """Return how many losses in a row are proved harmless, None where not even none are."""
    nominal = [mode.off.a for mode in modes]
    if any(enclose_eigenvalues(value_of(values), radius_of(values))[1].high >= 1 for values in nominal):
        return None
    gain = max(mode.off.peak for mode in modes) * weight
    if gain >= 2:
        return 0
    most = MANY
    if gain > math.pi / (4 * MANY):
        most = min(MANY, math.ceil((math.pi / math.asin(gain / 2) - 2) / 4) - 1)
    # Where the last one is too near to prove it, that before is far enough, or some part of it.
    for losses in sorted({most, *(int(part * (most - 1)) for part in PARTS)} - {0, -1}, reverse=True):
        level = 2 * math.sin(math.pi / (4 * losses + 2)) * (1 - 8 * UNIT) / max(weight, UNIT)
        if all(mode.off.is_below(level) for mode in modes):
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


def _growths(mode: LossMode, words: Sequence[tuple[int, ...]]) -> Floats:
    """Return what words make of a mode per frame (words,), all channels losing the same packets."""
    heard, lost = value_of(mode.off.a), value_of(mode.lost)
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


def _shaking(modes: Sequence[LossMode], harmless: int) -> tuple[tuple[bool, ...] | None, float | None, str]:
    """Find a pattern of as few losses in a row as possible that shakes a scene, the shortest of these.

    Parameters
    ----------
    modes
        The modes of a scene.
    harmless
        How many losses in a row are.

    Returns
    -------
    tuple
        A period of the pattern, its growth per frame, and what else there is to say.
    """
    cost = sum(max(mode.lost.shape[-1], LEAST_STATES) ** 3 for mode in modes)
    for losses, listed in sorted(_words().items()):
        if 0 < losses <= harmless:
            continue
        words = listed[: max(FEWEST, WORK // cost)]
        growths = np.stack([_growths(mode, words) for mode in modes])
        growth = growths.max(axis=0)
        for place in np.lexsort((-growth, [sum(word) for word in words])).tolist():
            mode = modes[int(np.argmax(growths[:, place]))]
            if growth[place] <= ABOVE or not _is_proved(mode, words[place]):
                continue
            note = f"the {mode.name} mode grows where all peers lose the same packets"
            if not losses:
                note = f"the {mode.name} mode grows with no packet lost"
            most = int(np.argmax(growth))
            if growth[most] > growth[place] * ABOVE:
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


def _is_proved(mode: LossMode, word: Sequence[int]) -> bool:
    """Say whether a word is proved to make a mode grow."""
    product = RADII.exact(np.eye(mode.lost.shape[-1]))
    for gone in pattern_of(word):
        product = RADII.multiply(mode.lost if gone else mode.off.a, product)
    return bool(enclose_eigenvalues(value_of(product), radius_of(product))[1].low > 1)
