"""Growth of second moments under losses beyond independent ones: bursts, substitution, recorded delays.

Takes: a `NumericModel` whose links have burst losses, `on_loss: zero`, or a trace.
Gives: `channel_growth`.
Guarantees: a network that is not supported raises an error with the reason.
Does not: cover independent losses and jitter with the last value held (see `mean_square_stability`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from apc.compiler.compiled import Link, Model
from apc.compiler.multiples import common_multiple
from apc.extensions.loss_models.gilbert_elliott import tagged_error, tagged_radius
from apc.extensions.loss_models.loss_patterns import (
    LossyFrame,
    channels_of,
    hold_frame,
    refuse_unheld,
    substitution_frame,
)
from apc.extensions.loss_models.periodic_delays import trace_radius
from apc.extensions.loss_models.self_substitution import self_substitution
from apc.lifting.numeric_model import NumericModel
from apc.mean_square.class_moments import (
    PerTickReception,
    build_reception,
)
from apc.mean_square.copy_error import forced
from apc.mean_square.mean_square_stability import StabilityMeasure, independent_growth
from apc.mean_square.receiver_memory import is_memoryless
from apc.network.channel import ChannelLaw
from apc.parameter_values.parameters import resolve
from apc.support.not_supported import NotSupportedError

# Number of peers whose bursts are analyzed with all tags, and the largest number of tags; the two orders that
# are compared.
EXACTLY_TAGGED, MOST_TAGGED, ORDERS = 4, 8, (2, 3)
ESTIMATE = f"estimate: joint moments of at most {ORDERS[1]} channel states; with {ORDERS[0]}"

# Number of channels up to which all loss patterns are enumerated.
MOST_CHANNELS = 6

# Number of peers with own-value substitution for which every number of received packets is enumerated: with
# more, quadrature nodes are rounded.
ENUMERATED = 4

# Relative error of an eigenvalue by iteration: tolerance 1e-13; references agree to 1e-11.
ITERATED = 1e-10
ROUNDED = 4e-15

# Factor from the difference of two estimates to the reported error; largest distance of bounds.
UNCERTAINTIES, LOOSE = 10, 1e-9


def channel_growth(
    numeric: NumericModel, lossy: Sequence[tuple[Link, ChannelLaw]], *, bounded: bool
) -> StabilityMeasure:
    """Return the growth factor of second moments per frame of a model without kinks.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    lossy
        Its unreliable links, from `nominal_criterion.unreliable`.
    bounded
        Whether bounds are computed; otherwise they may be equal to the radius.

    Raises
    ------
    NotSupportedError
        The network is not supported.
    """
    model = numeric.model
    if any(law.trace is not None for _, law in lossy):
        return _trace_growth(numeric)
    if any(law.jitter for _, law in lossy):
        raise NotSupportedError("jitter together with bursty losses of another link, or on_loss: zero")
    if not any(law.mean_loss and law.zero for _, law in lossy):
        return _burst_growth(numeric, None)
    first = _arrival_time(model, lossy)
    if all(is_memoryless(law) for _, law in lossy):
        reception = build_reception(numeric, first=first, stand_in=True)
        # With many peers the quadrature nodes are rounded.
        proved = model.peers <= ENUMERATED
        growth = independent_growth(model, reception, self_substitution, arrival=first, bounded=bounded)
        return replace(growth, proved=proved, quick=proved)
    return _burst_growth(numeric, first)


def _trace_growth(numeric: NumericModel) -> StabilityMeasure:
    """Return the growth factor of second moments for recorded delays."""
    result = trace_radius(numeric)

    def errors() -> tuple[float, str]:
        """Raise NotSupportedError: the copy error is not computed for recorded delays."""
        raise NotSupportedError("it is not computed for recorded delays")

    radius, low, high = result.radius**2, result.low**2 * (1 - ROUNDED), result.high**2 * (1 + ROUNDED)
    if low > 1 or high < 1 or high - low < LOOSE:
        return StabilityMeasure(min(max(radius, low), high), low, high, True, proved=True, errors=errors)
    uncertainty = max(UNCERTAINTIES * 2 * result.radius * result.uncertainty, LOOSE)
    note = f"an estimate: rounding of {result.frames:,} frames exceeds the bounds"
    return StabilityMeasure(
        radius, max(radius - uncertainty, 0.0), radius + uncertainty, False, note=note, errors=errors
    )


def _burst_growth(numeric: NumericModel, first: Fraction | None) -> StabilityMeasure:
    """Return the growth factor of second moments under burst losses.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    first
        The nominal arrival time in a frame, in seconds, if receivers substitute their own value; None if they
        keep the last one.
    """
    model = numeric.model
    reception = build_reception(numeric, first=first or Fraction(0), stand_in=first is not None)
    complete = all(link.graph.shape == "complete" for link in model.links)
    interchangeable = complete and len(model.groups) == 1 and not model.groups[0].columns
    channels = MOST_CHANNELS
    if first is None:
        refuse_unheld(model, reception)
        links = [link for link in model.links if link.channel]
        channels = sum(channels_of(link, model.peers) for link in links)
        interchangeable = interchangeable and len(links) == 1 and model.peers <= MOST_TAGGED
        if not interchangeable and channels > MOST_CHANNELS:
            message = f"the limit is {MOST_CHANNELS}, or {MOST_TAGGED} equal peers with on_loss: hold"
            raise NotSupportedError(f"bursts on {channels} directed connections: {message}")
    orders = (channels,) if model.peers <= EXACTLY_TAGGED or channels <= MOST_CHANNELS else ORDERS

    def frame(reception: PerTickReception) -> LossyFrame:
        """Return the frame map of the peers, as a function of the losses."""
        if first is None:
            return hold_frame(model, reception, interchangeable=interchangeable)
        return substitution_frame(model, reception, MOST_CHANNELS, interchangeable=interchangeable)

    def errors() -> tuple[float, str]:
        """Return the copy error in m, and a note."""
        pushed = forced(model, reception, first or Fraction(0))
        whole = frame(pushed.reception)
        rough, *more = (tagged_error(whole, order, pushed.peer_by_peer()) for order in orders)
        return (more[0], f"{ESTIMATE} it is {rough:.9g} m") if more else (rough, "")

    whole = frame(reception)
    rough, *more = (tagged_radius(whole, order) for order in orders)
    if not more:
        return StabilityMeasure(rough, rough * (1 - ITERATED), rough * (1 + ITERATED), True, errors=errors)
    error_bound = abs(more[0] - rough)
    note = f"{ESTIMATE} the radius is {rough:.9g}"
    return StabilityMeasure(
        more[0], more[0] - error_bound, more[0] + error_bound, False, note=note, errors=errors
    )


def _arrival_time(model: Model, lossy: Sequence[tuple[Link, ChannelLaw]]) -> Fraction:
    """Return the arrival time of packets within a frame, in seconds.

    Raises
    ------
    NotSupportedError
        The arrival time is not unique.
    """
    timings = resolve(model).timings
    clocks = {clock.name: clock for clock in model.clocks}
    if len(model.links) > 1 or model.links[0].pairs:
        raise NotSupportedError("substituted values together with packets of another link or delay")
    link = lossy[0][0]
    if link.after:
        raise NotSupportedError(f"substituted values for packets after the ticks ({link.name}: order: after)")
    period, phase = timings[clocks[link.clock].period], timings[clocks[link.clock].phase]
    frame = common_multiple([timings[clock.period] for clock in model.clocks])
    if frame != period:
        raise NotSupportedError(f"several packets of {link.name} in a frame of {float(frame) * 1e3:.6g} ms")
    return (phase + timings[link.delay]) % period
