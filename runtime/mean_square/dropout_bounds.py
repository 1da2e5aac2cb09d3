"""Worst-case losses: a proved number of harmless consecutive losses, and a destabilizing pattern.

Takes: a `Model` whose links lose packets, whose receivers hold the last received value.
Gives: `ConsecutiveLosses`, `worst_case`; `worst_trace`.
Guarantees: the certified number is proved for every pattern, chosen separately on every channel. A pattern's
growth above 1 is proved. On complete graphs the cost is independent of the number of equal peers.
Does not: find the worst pattern of all: between the certified losses and those of the pattern stability is
undecided.

After ℓ consecutive losses a receiver holds q[k−ℓ], with the error w, the sum of the last ℓ differences d[k] =
q[k] − q[k−1]. The losses between two receptions form a block. Over each block w = −T_ℓ d, with T_ℓ the lower
triangle of ones, and blocks do not overlap. So for at most L consecutive losses each channel is an operator
from d to w of norm at most ‖T_L‖₂ = 1 / (2 sin(π/(4L + 2))) for every pattern. By the small-gain theorem (see
`small_gain`) the system is exponentially stable for all patterns if

    ‖d ← r‖∞ ‖|W|‖₂ < 2 sin(π/(4L + 2))

The map d ← r is block-diagonal in the modes; its norm is the largest gain.
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
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.interconnection import feedback_of, interconnect, lay_out_loop
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.relative_coordinates import relative
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, error_radius, value_of
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.schedule import CouplingTerm, SentSample
from apc.mean_square.class_moments import build_reception
from apc.mean_square.loss_patterns import refuse_unheld
from apc.mean_square.periodic_delays import Packets
from apc.mean_square.small_gain import (
    MOST_STATES,
    Response,
    change_of_sent,
    ratios_of,
    used_rows,
    weight_of,
)
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Consecutive losses that are reported as unlimited.
MANY = 1000

# Parts of the losses in a row that a gain allows for which a proof is tried, where one is not found for all.
PARTS = (1.0, 0.9, 0.5, 0.1)

# Loss patterns searched: all of this many frames; this many gaps of up to this many frames; one long gap
# after a few short ones.
FRAMES, GAPS, LONGEST, LONE, SHORT = 14, 4, 9, 40, 6

# Computational limit on the patterns of one number of consecutive losses, in cubes of loop orders: all
# patterns of two small loops; a few of any.
WORK, LEAST_STATES, FEWEST = 1500 * 16**3, 16, 6

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-12


@dataclass(frozen=True, slots=True)
class ConsecutiveLosses:
    """The effect of consecutive losses on stability.

    `certified` consecutive losses are proved harmless for every pattern, chosen separately on every channel;
    None if no number is certified. `unstable_pattern` is a period of a destabilizing pattern, frame by frame
    (True: all packets of the frame get lost), `growth` its growth factor per frame, proved above 1; both are
    None if no such pattern was found. `note` has remarks, or the reason for a missing result.
    """

    certified: int | None
    unstable_pattern: tuple[bool, ...] | None
    growth: float | None
    note: str


@dataclass(frozen=True, slots=True, eq=False)
class LossMode:
    """A mode of a model: its matrix where all channels lose the packet of a frame, and d ← r if none does."""

    name: str
    lost: Matrix
    received: Response


def worst_case(system: Model, prepared: Prepared) -> ConsecutiveLosses:
    """Return the number of consecutive losses that are harmless, and a destabilizing pattern.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
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
        note = f"the topology is not proved to settle with no packet lost; {note}"
    return ConsecutiveLosses(certified, pattern, growth, note)


def worst_trace(system: Model) -> Model:
    """Return a system whose unreliable links lose packets by the pattern that shakes it, again and again.

    Parameters
    ----------
    system
        The model, with the parameter values to simulate.

    Raises
    ------
    ApcError
        E897 no such pattern is known, or it can't be simulated.
    """
    losses_in_a_row = worst_case(system, prepare(system))
    pattern = losses_in_a_row.unstable_pattern
    if pattern is None:
        message = f"--trace-of worst has nothing to play: {losses_in_a_row.note}"
        raise ApcError(
            Diagnostic("E897", SourceLocation(system.origin.topology), message, hint="apc simulate")
        )
    seconds = {timing.name: float(timing.value) for timing in system.timings}
    for link in system.links:
        delays = {seconds[link.delay], *(seconds[delay.delay] for delay in link.delays)}
        if link.channel is not None and len(delays) > 1:
            message = f"--trace-of worst gives all packets of {link.name} one delay, and they have several"
            raise ApcError(
                Diagnostic("E897", SourceLocation(system.origin.topology), message, hint="apc simulate")
            )

    def played(link: Link) -> Link:
        if link.channel is None:
            return link
        trace = np.where(pattern, np.inf, seconds[link.delay])
        return replace(link, channel=replace(link.channel, loss=None, jitter=None, trace=trace))

    return replace(system, links=tuple(map(played, system.links)))


def _modes(system: Model, prepared: Prepared) -> tuple[list[LossMode], float]:
    """Return the modes of a model whose receivers hold the last received value, and ‖|W|‖₂."""
    reception = build_reception(system, prepared)
    refuse_unheld(system, reception)
    loops = loops_at_right_angles(reception.groups, reception.exchange, MOST_STATES)
    lossy = frozenset(link.name for link in system.links if link.channel is not None)
    packets = Packets(system, reception)
    numbers = {row: packets.received(row)[0] for row in packets.rows}
    depths = packets.depths(numbers.items(), 1)
    # A lost packet is replaced by the previous one, which is sent again.
    before = {row: min(n, -1) if row.coupling_term.link in lossy else n for row, n in numbers.items()}
    ratios, (weight, sizes) = ratios_of(loops[0].subsystems, lossy), weight_of(loops, lossy)
    modes = []
    for loop in loops:
        now = packets.loop(loop, numbers, depths)
        error_bound = []
        for g, subsystem in enumerate(now.subsystems):
            reception_of = dict[
                tuple[CouplingTerm, SentSample], dict[int, int]
            ]()  # all receivers of a packet have the same error
            for link in sorted(lossy):
                for line, received in used_rows(subsystem, link):
                    reception_of.setdefault((received.coupling_term, received.sent), {})[line] = received.lag
            for lags in reception_of.values():
                first = min(lags.values())
                error_bound.append((g, {line: lag - first for line, lag in lags.items()}, 1.0))
        response = change_of_sent(now, error_bound, ratios, sizes)
        missing = packets.loop(loop, before, depths)
        layout = lay_out_loop(missing)
        maps, n = [subsystem.lifted for subsystem in missing.subsystems], len(layout.names)
        states = len(response.at.eliminated) + len(response.at.rest)
        matrix = np.zeros((2, states, states))
        matrix[:, :n, :n] = interconnect(
            maps, feedback_of(missing, layout), layout, numbers=MIDPOINT_RADIUS
        ).matrix
        for packet, index in layout.indices.items():
            if (
                packet.lag == 1
                and missing.subsystems[packet.subsystem].schedule.sent[packet.row].link in lossy
            ):
                matrix[:, index] = 0.0
                matrix[0, index, index] = 1.0
        modes.append(LossMode(loop.name, relative(matrix, response.at, MIDPOINT_RADIUS), response))
    return modes, weight


def _harmless(modes: Sequence[LossMode], weight: float) -> int | None:
    """Return the proved number of harmless consecutive losses, None if not even 0 is proved."""
    nominal = [mode.received.a for mode in modes]
    if any(enclose_eigenvalues(value_of(values), error_radius(values))[1].high >= 1 for values in nominal):
        return None
    gain = max(mode.received.peak for mode in modes) * weight
    if gain >= 2:
        return 0
    most = MANY
    if gain > math.pi / (4 * MANY):
        most = min(MANY, math.ceil((math.pi / math.asin(gain / 2) - 2) / 4) - 1)
    # If the last pattern is too close for a proof, an earlier one or a part of it suffices.
    for losses in sorted({most, *(int(part * (most - 1)) for part in PARTS)} - {0, -1}, reverse=True):
        level = (
            2 * math.sin(math.pi / (4 * losses + 2)) * (1 - 8 * UNIT_ROUNDOFF) / max(weight, UNIT_ROUNDOFF)
        )
        if all(mode.received.is_below(level) for mode in modes):
            return losses
    return 0


@cache
def _words() -> dict[int, list[tuple[int, ...]]]:
    """Return the sequences of gaps to be searched, by their number of consecutive losses, shortest first.

    A gap is the number of frames from one received packet to the next. Of all rotations of a sequence only
    the first is returned.
    """
    tried: set[tuple[int, ...]] = set()
    for frames in range(1, FRAMES + 1):
        for lost in itertools.product((0, 1), repeat=frames - 1):
            received = [index for index, number in enumerate((*lost, 0)) if not number]
            tried.add(tuple(np.diff([-1, *received]).tolist()))
    for count in range(1, GAPS + 1):
        tried |= set(itertools.product(range(1, LONGEST + 1), repeat=count))
    tried |= {(*(1,) * short, long) for long in range(2, LONE + 1) for short in range(SHORT)}
    turned = {min(word[k:] + word[:k] for k in range(len(word))) for word in tried}
    by_losses: dict[int, list[tuple[int, ...]]] = {}
    for word in sorted(turned, key=lambda word: (sum(word), word)):
        by_losses.setdefault(max(word) - 1, []).append(word)
    return by_losses


def _growths(mode: LossMode, words: Sequence[tuple[int, ...]]) -> Floats:
    """Return the growth of a mode per frame for loss patterns (words,), with equal losses on all channels."""
    received, lost = value_of(mode.received.a), value_of(mode.lost)
    gaps = [received]
    for _ in range(max(map(max, words)) - 1):
        gaps.append(gaps[-1] @ lost)
    over, growths = np.stack(gaps), np.zeros(len(words))
    for length in {len(word) for word in words} if len(received) else ():
        indices = [index for index, word in enumerate(words) if len(word) == length]
        listed = np.array([words[index] for index in indices])
        product = over[listed[:, 0] - 1]
        for column in range(1, length):
            product = over[listed[:, column] - 1] @ product
        finite = np.isfinite(product).all(axis=(1, 2))  # the others, beyond all floats, are not tried
        largest = np.abs(np.linalg.eigvals(product[finite])).max(axis=1, initial=0.0)
        growths[np.array(indices)[finite]] = largest ** (1 / listed[finite].sum(axis=1))
    return growths


def _shaking(modes: Sequence[LossMode], harmless: int) -> tuple[tuple[bool, ...] | None, float | None, str]:
    """Find a destabilizing pattern with the fewest consecutive losses, the shortest of these.

    Parameters
    ----------
    modes
        The modes of a model.
    harmless
        The number of consecutive losses proved harmless.

    Returns
    -------
    tuple
        A period of the pattern, its growth per frame, and a note.
    """
    cost = sum(max(mode.lost.shape[-1], LEAST_STATES) ** 3 for mode in modes)
    for losses, listed in sorted(_words().items()):
        if 0 < losses <= harmless:
            continue
        words = listed[: max(FEWEST, WORK // cost)]
        growths = np.stack([_growths(mode, words) for mode in modes])
        growth = growths.max(axis=0)
        for index in np.lexsort((-growth, [sum(word) for word in words])).tolist():
            mode = modes[int(np.argmax(growths[:, index]))]
            if growth[index] <= ABOVE or not _is_proved(mode, words[index]):
                continue
            note = f"the {mode.name} mode grows where all peers lose the same packets"
            if not losses:
                note = f"the {mode.name} mode grows with no packet lost"
            most = int(np.argmax(growth))
            if growth[most] > growth[index] * ABOVE:
                spelled = "".join("×" if lost else "·" for lost in pattern_of(words[most]))
                note += f"; of at most {losses} losses in a row, the most met is "
                note += f"{growth[most]:.8g} a frame, by {spelled}"
            return pattern_of(words[index]), float(growth[index]), note
    return (
        None,
        None,
        f"no periodic pattern tried, of fewer than {LONE} losses in a row, makes the topology unstable",
    )


def pattern_of(word: Sequence[int]) -> tuple[bool, ...]:
    """Return a period of a word of gaps, frame by frame: whether packets get lost."""
    return tuple(lost for gap in word for lost in (*(True,) * (gap - 1), False))


def _is_proved(mode: LossMode, word: Sequence[int]) -> bool:
    """Return whether a sequence of gaps is proved to destabilize a mode."""
    product = MIDPOINT_RADIUS.exact(np.eye(mode.lost.shape[-1]))
    for gone in pattern_of(word):
        product = MIDPOINT_RADIUS.multiply(mode.lost if gone else mode.received.a, product)
    return bool(enclose_eigenvalues(value_of(product), error_radius(product))[1].low > 1)
