"""Worst-case losses: a proved number of harmless consecutive losses, and a destabilizing pattern.

Takes: a `NumericModel` whose links lose packets, whose receivers hold the last received value.
Gives: `worst_case`; `worst_trace`.
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

With one lossy channel a second certificate is tried. From one reception to the next, over ℓ losses, the
states change by M_ℓ = A_r A_l^ℓ, with the frame maps A_l of a loss and A_r of a reception. If one P ≻ 0
satisfies M_ℓᵀ P M_ℓ ≺ P for ℓ = 0 … L, all patterns of at most L consecutive losses are stable (Xiong and
Lam, Stabilization of linear systems over networks with bounded packet loss, Automatica 43, 2007).
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.extensions.loss_models.loss_patterns import channels_of, refuse_unheld
from apc.extensions.loss_models.periodic_delays import Packets
from apc.extensions.loss_models.small_gain import Response, change_of_sent, ratios_of, used_rows, weight_of
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, error_radius, value_of
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.mean_square.class_moments import build_reception
from apc.mean_square.loss_results import ConsecutiveLosses, LossCertificate
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.enclosure import enclose_eigenvalues
from apc.spectrum.interconnection import feedback_of, interconnect, lay_out_loop
from apc.spectrum.lyapunov_functions import balanced, has_common_function
from apc.spectrum.modes import orthogonal_loops
from apc.spectrum.relative_coordinates import relative
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import GAIN_BOUND_STATES
from apc.timing.schedule import CouplingTerm, SentSample

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Consecutive losses that are reported as unlimited.
MANY = 1000

# Fractions of the consecutive losses allowed by a gain that are tried if a proof fails for the full number.
PARTS = (1.0, 0.9, 0.5, 0.1)

# Consecutive losses and states for which a common quadratic function is sought: one semidefinite program then
# takes at most some seconds.
MOST_LOSSES, MOST_STATES = 40, 16

# Loss patterns searched: all of this many frames; this many gaps of up to this many frames; one long gap
# after a few short ones.
FRAMES, GAPS, LONGEST, LONE, SHORT = 14, 4, 9, 40, 6

# Computational limit on the patterns of one number of consecutive losses, in cubes of loop orders: all
# patterns of two small loops; a few of any.
WORK, LEAST_STATES, FEWEST = 1500 * 16**3, 16, 6

# A growth in floats that is worth proving to be above 1.
ABOVE = 1 + 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LossMode:
    """A mode of a model: `lost` is its matrix if all channels lose packets, `received` d ← r if none does."""

    name: str
    lost: Matrix
    received: Response


def worst_case(numeric: NumericModel) -> ConsecutiveLosses:
    """Return the number of harmless consecutive losses, and a destabilizing pattern of losses.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    """
    try:
        modes, weight = _modes(numeric)
    except NotSupportedError as why:
        return ConsecutiveLosses(None, None, None, f"consecutive losses are undecided: {why}")
    certified = _harmless_losses(modes, weight)
    certificate = LossCertificate.SMALL_GAIN if certified else None
    if certified == MANY:
        note = f"at least {MANY:,} consecutive losses are harmless; more were not analyzed"
        return ConsecutiveLosses(MANY, None, None, note, certificate)
    pattern, growth, note = _unstable_pattern(modes, certified or 0)
    if certified is None:
        note = note if pattern else f"stability without packet loss is not proved; {note}"
    elif _channels(numeric.model) == 1 and max(mode.lost.shape[-1] for mode in modes) <= MOST_STATES:
        most = _longest_burst(pattern) - 1 if pattern else MOST_LOSSES
        try:
            quadratic = _common_function_losses(modes, certified, most)
        except ApcError as missing:
            absent = missing.mistakes[0]
            note += f"; no common quadratic function was sought: {absent.message} ({absent.fix})"
        else:
            if quadratic > certified:
                certified, certificate = quadratic, LossCertificate.COMMON_FUNCTION
    return ConsecutiveLosses(certified, pattern, growth, note, certificate)


def worst_trace(model: Model) -> Model:
    """Return a model whose unreliable links lose packets by the destabilizing pattern, periodically.

    Parameters
    ----------
    model
        The model, with the parameter values to simulate.

    Raises
    ------
    ApcError
        E897 no such pattern is known, or it can't be simulated.
    """
    losses_in_a_row = worst_case(numeric_model(model))
    pattern = losses_in_a_row.unstable_pattern
    if pattern is None:
        message = f"--trace-of worst has no pattern: {losses_in_a_row.note}"
        raise ApcError(Diagnostic("E897", SourceLocation(model.origin.topology), message, fix="apc simulate"))
    seconds = {timing.name: float(timing.value) for timing in model.timings}
    for link in model.links:
        delays = {seconds[name] for name in link.delays}
        if link.channel is not None and len(delays) > 1:
            message = f"--trace-of worst requires one delay of {link.name}; it has several"
            raise ApcError(
                Diagnostic("E897", SourceLocation(model.origin.topology), message, fix="apc simulate")
            )

    def with_pattern(link: Link) -> Link:
        """Return a link whose packets get lost by the pattern."""
        if link.channel is None:
            return link
        trace = np.where(pattern, np.inf, seconds[link.delay])
        return replace(link, channel=replace(link.channel, loss=None, jitter=None, trace=trace), pairs=())

    return replace(model, links=tuple(map(with_pattern, model.links)))


def _modes(numeric: NumericModel) -> tuple[list[LossMode], float]:
    """Return the modes of a model whose receivers hold the last received value, and ‖|W|‖₂."""
    model = numeric.model
    reception = build_reception(numeric)
    refuse_unheld(model, reception)
    if mixed := [
        link.name for link in model.links if len({channel.loss is None for channel in link.channels}) > 1
    ]:
        raise NotSupportedError(f"only some pairs of groups lose packets of {mixed[0]}")
    loops = orthogonal_loops(reception.peer_classes, reception.comm_graph, GAIN_BOUND_STATES)
    lossy = frozenset(link.name for link in model.links if link.channel is not None)
    packets = Packets(model, reception)
    packet_numbers = {row: packets.received(row)[0] for row in packets.rows}
    depths = packets.depths(packet_numbers.items(), 1)
    # A lost packet is replaced by the previous one, which is sent again.
    previous_packets = {
        row: min(n, -1) if row.coupling_term.link in lossy else n for row, n in packet_numbers.items()
    }
    ratios, (weight, sizes) = ratios_of(loops[0].peer_classes, lossy), weight_of(loops, lossy)
    modes = []
    for modal_system in loops:
        received_loop = packets.loop(modal_system, packet_numbers, depths)
        error_bound = []
        for g, peer_class in enumerate(received_loop.peer_classes):
            reception_of = dict[
                tuple[CouplingTerm, SentSample], dict[int, int]
            ]()  # all receivers of a packet have the same error
            for link in sorted(lossy):
                for input_row, received in used_rows(peer_class, link):
                    reception_of.setdefault((received.coupling_term, received.sent), {})[input_row] = (
                        received.lag
                    )
            for lags in reception_of.values():
                first = min(lags.values())
                error_bound.append((g, {input_row: lag - first for input_row, lag in lags.items()}, 1.0))
        response = change_of_sent(received_loop, error_bound, ratios, sizes)
        lost_loop = packets.loop(modal_system, previous_packets, depths)
        layout = lay_out_loop(lost_loop)
        maps, n = [peer_class.lifted for peer_class in lost_loop.peer_classes], len(layout.names)
        states = len(response.coordinates.eliminated) + len(response.coordinates.rest)
        matrix = np.zeros((2, states, states))
        matrix[:, :n, :n] = interconnect(
            maps, feedback_of(lost_loop, layout), layout, numbers=MIDPOINT_RADIUS
        ).matrix
        for packet, index in layout.indices.items():
            if (
                packet.lag == 1
                and lost_loop.peer_classes[packet.subsystem].schedule.sent[packet.row].link in lossy
            ):
                matrix[:, index] = 0.0
                matrix[0, index, index] = 1.0
        modes.append(
            LossMode(modal_system.name, relative(matrix, response.coordinates, MIDPOINT_RADIUS), response)
        )
    return modes, weight


def _harmless_losses(modes: Sequence[LossMode], weight: float) -> int | None:
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


def _channels(model: Model) -> int:
    """Return the number of channels that lose packets."""
    peers = sum(group.count for group in model.groups)
    return sum(channels_of(link, peers) for link in model.links if link.channel is not None)


def _longest_burst(pattern: Sequence[bool]) -> int:
    """Return the largest number of consecutive losses of a pattern that ends with a reception."""
    return max(len(list(run)) for lost, run in itertools.groupby(pattern) if lost)


def _common_function_losses(modes: Sequence[LossMode], certified: int, most: int) -> int:
    """Return the largest number of consecutive losses with a common quadratic function.

    Parameters
    ----------
    modes
        The modes of a model with one lossy channel.
    certified, most
        A number proved harmless, and the largest number that is tried.

    Raises
    ------
    ApcError
        E875 cvxpy is not installed.
    """
    untried = range(certified + 1, most + 1)
    return certified + bisect_left(
        untried, True, key=lambda losses: not all(_has_common_function(mode, losses) for mode in modes)
    )


def _has_common_function(mode: LossMode, losses: int) -> bool:
    """Return whether a mode has a common quadratic function for up to a number of consecutive losses."""
    gaps = [mode.received.a]
    for _ in range(losses):
        gaps.append(MIDPOINT_RADIUS.multiply(gaps[-1], mode.lost))
    return not mode.lost.size or has_common_function(balanced(gaps))


@cache
def _gap_sequences() -> dict[int, list[tuple[int, ...]]]:
    """Return the gap sequences to be searched, by their number of consecutive losses, shortest first.

    A gap is the number of frames from one received packet to the next. Of all rotations of a sequence only
    the first is returned.
    """
    sequences: set[tuple[int, ...]] = set()
    for frames in range(1, FRAMES + 1):
        for losses in itertools.product((0, 1), repeat=frames - 1):
            received = [-1, *(index for index, number in enumerate((*losses, 0)) if not number)]
            sequences.add(tuple(after - before for before, after in itertools.pairwise(received)))
    for count in range(1, GAPS + 1):
        sequences |= set(itertools.product(range(1, LONGEST + 1), repeat=count))
    sequences |= {(*(1,) * short, long) for long in range(2, LONE + 1) for short in range(SHORT)}
    # The first of all rotations starts with a shortest gap.
    starting = (word for word in sequences if word[0] == min(word))
    rotations_removed = {min(word[k:] + word[:k] for k in range(len(word))) for word in starting}
    by_losses: dict[int, list[tuple[int, ...]]] = {}
    for word in sorted(rotations_removed, key=lambda word: (sum(word), word)):
        by_losses.setdefault(max(word) - 1, []).append(word)
    return by_losses


def _growths(mode: LossMode, words: Sequence[tuple[int, ...]]) -> Floats:
    """Return the growth of a mode per frame for gap sequences (words,), with equal losses on all channels."""
    received, lost = value_of(mode.received.a), value_of(mode.lost)
    gaps = [received]
    for _ in range(max(map(max, words)) - 1):
        gaps.append(gaps[-1] @ lost)
    gap_maps, growths = np.stack(gaps), np.zeros(len(words))
    for length in {len(word) for word in words} if len(received) else ():
        indices = [index for index, word in enumerate(words) if len(word) == length]
        gap_numbers = np.array([words[index] for index in indices])
        product = gap_maps[gap_numbers[:, 0] - 1]
        for column in range(1, length):
            product = gap_maps[gap_numbers[:, column] - 1] @ product
        finite = np.isfinite(product).all(axis=(1, 2))  # the others, beyond all floats, are not tried
        largest = largest_magnitudes(product[finite])
        growths[np.array(indices)[finite]] = largest ** (1 / gap_numbers[finite].sum(axis=1))
    return growths


def _unstable_pattern(
    modes: Sequence[LossMode], harmless: int
) -> tuple[tuple[bool, ...] | None, float | None, str]:
    """Return a destabilizing pattern with the fewest consecutive losses, and the shortest of these.

    Parameters
    ----------
    modes
        The modes of a model.
    harmless
        The number of consecutive losses proved harmless.

    Returns
    -------
    tuple
        A period of the pattern, its growth per frame, and a note; None, None and a note without a pattern.
    """
    cost = sum(max(mode.lost.shape[-1], LEAST_STATES) ** 3 for mode in modes)
    for losses, sequences in sorted(_gap_sequences().items()):
        if 0 < losses <= harmless:
            continue
        words = sequences[: max(FEWEST, WORK // cost)]
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
                note += f"; the largest growth with at most {losses} consecutive losses is "
                note += f"{growth[most]:.8g} per frame, by {spelled}"
            return pattern_of(words[index]), float(growth[index]), note
    return (
        None,
        None,
        f"no unstable periodic loss pattern found with fewer than {LONE} consecutive losses",
    )


def pattern_of(word: Sequence[int]) -> tuple[bool, ...]:
    """Return one period of a gap sequence, frame by frame: whether packets get lost."""
    return tuple(lost for gap in word for lost in (*(True,) * (gap - 1), False))


def _is_proved(mode: LossMode, word: Sequence[int]) -> bool:
    """Return whether a sequence of gaps is proved to destabilize a mode."""
    product = MIDPOINT_RADIUS.exact(np.eye(mode.lost.shape[-1]))
    for is_lost in pattern_of(word):
        product = MIDPOINT_RADIUS.multiply(mode.lost if is_lost else mode.received.a, product)
    return bool(enclose_eigenvalues(value_of(product), error_radius(product))[1].low > 1)
