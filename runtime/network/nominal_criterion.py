"""Limitations of an analysis of the nominal network: loss, jitter, recorded delays, ranges of delay, joins.

Takes: a `Model`.
Gives: `unreliable`, `chance`, `limitations`, `refuse_range`, `channel_numbers`, `refuse_channel_number`.
Guarantees: a question about a number that only lost or late packets depend on is refused by name, as its
answer would be about a network without them.
Does not: answer for an unreliable network (see `mean_square`), or for all of a range (see
`extensions.parameter_boxes.delay_interval_proof`).
"""

from __future__ import annotations

from collections.abc import Collection
from fractions import Fraction

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.network.channel import ChannelLaw, channel_law
from apc.parameter_values.parameter_names import ParameterRef, given_ranges, unit_of
from apc.parameter_values.parameters import scope_of


def unreliable(model: Model) -> list[tuple[Link, ChannelLaw]]:
    """Return the links with random loss, jitter or recorded delays, with each of their channel laws."""
    laws = [
        (link, channel_law(model, link, delay))
        for link in model.links
        if link.channel is not None
        for delay in (link.delay, *(pair.delay for pair in link.pairs if pair.channel is not None))
    ]
    return [(link, law) for link, law in laws if law.mean_loss or law.jitter or law.trace is not None]


def chance(law: ChannelLaw) -> str:
    """Return a description of the loss, jitter and recorded delays of directed links."""
    named = [f"packet loss ({100 * law.mean_loss:.3g} %)"] * bool(law.mean_loss)
    named += ["jitter"] * bool(law.jitter) + ["recorded delays"] * (law.trace is not None)
    return f"{' and '.join(named)} of {law.label}"


def limitations(
    model: Model, *, network: bool = True, varied: Collection[ParameterRef] = ()
) -> tuple[str, ...]:
    """Return a note on each unreliable link, on joins and leaves, and on each delay that is given as a range.

    Parameters
    ----------
    model
        The model.
    network
        Whether the result is that of the nominal network.
    varied
        The varied timings; a range of these is not a limitation.
    """
    notes = []
    for _, law in unreliable(model) if network else ():
        delay = _ms(Fraction(law.delay))
        notes.append(f"excluded: {chance(law)}; every packet has the nominal delay of {delay}")
    if model.experiment.joins or model.experiment.leaves:
        notes.append("excluded: the joins and leaves of the experiment; all peers are present")
    names = {parameter_ref.name for parameter_ref in varied}
    for interval in given_ranges(model):
        if interval.free.name not in names:
            low, middle, high = (
                _ms(value) for value in (interval.low, (interval.low + interval.high) / 2, interval.high)
            )
            notes.append(
                f"excluded: the range {low} to {high} of {interval.free.label}; the midpoint {middle} is used"
            )
    return tuple(notes)


def refuse_range(model: Model) -> None:
    """Raise ApcError E899 for a delay given as a range where a single delay is required (simulate,
    export).
    """
    for interval in given_ranges(model):
        low, middle, high = (
            _ms(value) for value in (interval.low, (interval.low + interval.high) / 2, interval.high)
        )
        message = f"{interval.free.label} is a range, {low} to {high}; this command requires a single value"
        fix = f'--set "{interval.free.label}={middle}"'
        axes = (axis for axis in model.within if axis.parameter == interval.free.name)
        line, column = next(((axis.line, axis.column) for axis in axes), (0, 0))
        raise ApcError(
            Diagnostic("E899", SourceLocation(model.origin.topology, line, column), message, fix=fix)
        )


def _ms(seconds: Fraction) -> str:
    """Return a time as a text in ms."""
    return f"{float(seconds) * 1e3:.6g} ms"


def channel_numbers(model: Model) -> frozenset[str]:
    """Return the names of the parameters of all channels, and of all numbers that these depend on."""
    texts: list[str] = []
    for link in model.links:
        for channel in link.channels:
            loss, jitter = channel.loss, channel.jitter
            texts += [loss.p, loss.r, loss.one_minus_h, loss.one_minus_k] if loss else []
            texts += [jitter] if jitter else []
    return frozenset(scope_of(model).needed(texts))


def refuse_channel_number(
    model: Model, parameter_ref: ParameterRef, location: SourceLocation, *, instead: str = ""
) -> None:
    """Raise an error for a varied parameter of a channel if the verdict is that of the nominal network.

    Parameters
    ----------
    model
        The model.
    parameter_ref
        The parameter to be varied.
    location
        The location of the request.
    instead
        The suggested fix; by default the simulation of one value.

    Raises
    ------
    ApcError
        E896 the parameter affects lost or late packets only.
    """
    if parameter_ref.name in channel_numbers(model):
        message = (
            f"{parameter_ref.label} has no effect on the nominal network, in which no packet is "
            "lost and all delays are nominal"
        )
        value = "2 ms" if unit_of(model, parameter_ref.name) == "s" else "5 %"
        fix = instead or f'apc simulate --set {parameter_ref.label}="{value}"'
        raise ApcError(Diagnostic("E896", location, message, fix=fix))
