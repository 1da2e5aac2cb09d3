"""A stability bound under arbitrary variation of a link's delay from packet to packet.

Takes: a `Model` and a range of the delay of one of its links.
Gives: `loop_gain`, `unstable_delays`.
Guarantees: with a gain below 1 the model is exponentially stable for every variation of the delays of each
directed link within the range, if the newest arrived packet is in effect; proved with bounds of all rounding
errors. Periodic delay sequences are proved to be destabilizing.
Does not: decide delays between the two bounds.

Let q[k] be the sent value and d[k] = q[k] − q[k−1]. Let the packet in effect at a tick be at most a packets
newer or b packets older than that at the middle of the range. The received value then differs by a sum of at
most as many d. Over all frames, by Cauchy and Schwarz, this is an operator of norm at most √(a² + b²) for all
delays, at each of J ticks of a frame (Kao and Lincoln, Simple stability criteria for systems with
time-varying delays, Automatica 40, 2004). By the small gain theorem (see `small_gain`) the system is stable
if

    ‖d ← r √(a² + b²)‖∞ ‖|W|‖₂ √J < 1
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction

import numpy as np

from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Channel, Model
from apc.extensions.loss_models.loss_patterns import refuse_unheld
from apc.extensions.loss_models.periodic_delays import Packets, trace_radius
from apc.extensions.loss_models.small_gain import change_of_sent, ratios_of, used_rows, weight_of
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.mean_square.class_moments import build_reception
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef
from apc.parameter_values.parameters import scope_of
from apc.spectrum.modes import orthogonal_loops
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import GAIN_BOUND_STATES

# The channel of a link with delayed packets: the newest arrived packet stays in effect until a newer one
# arrives.
HOLDING = Channel(None, None, "uniform", "newest", "hold", None)

# Packets in a row that are tried, of the least delay and then of the largest: all up to the first number, and
# up to the second those with a third, a half and two thirds of the least delay.
LONGEST, LONGER = 8, 12

# The factor on a gain in floats whose proof is tried: the difference leaves room for rounding.
ABOVE = 1 + 1e-3


def loop_gain(model: Model, delay: ParameterRef, low: Fraction, high: Fraction) -> float:
    """Return an upper bound of the small-gain product, proved; infinite if unstable at the middle.

    At a kink the result is the largest over all sides.

    Parameters
    ----------
    model
        The model.
    delay
        The delay of a link, or of some pairs of its peers.
    low, high
        The range of the delay, in seconds.

    Raises
    ------
    NotSupportedError
        The reason why no bound can be computed.
    """
    return max(_loop_gain(side.numeric, delay, low, high) for side in sides(numeric_model(model)))


def _loop_gain(numeric: NumericModel, delay: ParameterRef, low: Fraction, high: Fraction) -> float:
    """Return `loop_gain` on one side of a kink."""
    model = numeric.model
    middle = apply(model, [Override(delay, (low + high) / 2)])
    (link,) = (link for link in model.links if delay.name in link.delays)
    if [name for name in link.delays if delay.name in scope_of(model).needed([name])] != [delay.name]:
        raise NotSupportedError(f"the delays of several pairs of groups depend on {delay.label}")
    if any(
        receive.age or receive.before
        for peer_type in model.peer_types
        for clock in peer_type.clocks
        for receive in clock.receives
    ):
        raise NotSupportedError("receivers use the age of packets, or the previous packet")
    links = tuple(replace(item, channel=HOLDING) if item is link else item for item in middle.links)
    varying_model = replace(middle, links=links)
    reception = build_reception(numeric.at(varying_model))
    refuse_unheld(varying_model, reception)
    loops = orthogonal_loops(reception.peer_classes, reception.comm_graph, GAIN_BOUND_STATES)
    packets = Packets(varying_model, reception)
    lossy = frozenset(link.name for link in links if link.channel is not None)
    ratios, (weight, sizes) = ratios_of(loops[0].peer_classes, lossy), weight_of(loops, lossy)
    received = {row: packets.received(row)[0] for row in packets.rows}
    spread = {
        row: math.hypot(packets.received(row, low)[0] - number, number - packets.received(row, high)[0])
        for row, number in received.items()
        if row.coupling_term.delay == delay.name
    }
    gains = []
    for modal_system in loops:
        nominal_loop = packets.loop(modal_system, received, packets.depths(received.items(), 1))
        rows = reception.of(modal_system)
        error_bound = [
            (g, {line: 0}, spread[rows[g][line]])
            for g, peer_class in enumerate(nominal_loop.peer_classes)
            for line, _ in used_rows(peer_class, link.name)
            if spread.get(rows[g][line])
        ]
        response = change_of_sent(nominal_loop, error_bound, ratios, sizes)
        gain = response.peak * ABOVE
        if not math.isfinite(gain) or not response.is_below(gain):
            return math.inf
        ticks = Counter(
            (g, rows[g][line].coupling_term, rows[g][line].channel)
            for g, lines, _ in error_bound
            for line in lines
        )
        gains.append(gain * math.sqrt(max(ticks.values(), default=0)) * (1 + 8 * UNIT_ROUNDOFF))
    return max(gains) * weight


def unstable_delays(
    model: Model, delay: ParameterRef, low: Fraction, high: Fraction
) -> tuple[int, int] | None:
    """Return a destabilizing periodic sequence of delays: the numbers of packets with the smallest and
    largest delay.

    Parameters
    ----------
    model, delay, low, high
        As for `loop_gain`; None where no such delays of at most `LONGER` packets are proved unstable.
    """
    sequences = [(first, total - first) for total in range(2, LONGEST + 1) for first in range(1, total)]
    longer_periods = range(LONGEST + 1, LONGER + 1)
    sequences += [
        (total * share // 6, total - total * share // 6) for total in longer_periods for share in (2, 3, 4)
    ]
    for first, second in sequences:
        trace = np.array([float(low)] * first + [float(high)] * second)
        channel = replace(HOLDING, trace=trace)
        links = tuple(
            replace(link, channel=channel) if link.delay == delay.name and not link.pairs else link
            for link in model.links
        )
        recorded = replace(model, links=links)
        if links != model.links and trace_radius(numeric_model(recorded)).low > 1:
            return first, second
    return None
