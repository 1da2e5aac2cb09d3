"""Limitations of an analysis of the nominal network: loss, jitter, recorded delays, ranges of delay.

Takes: a `Model`.
Gives: `unreliable`, `chance`, `limitations`, `refuse_range`, `channel_numbers`, `refuse_channel_number`.
Guarantees: a question about a number that only lost or late packets depend on is refused by name, as its
answer would be about a network without them.
Does not: answer for an unreliable network (see `mean_square`), or for all of a range (see
`parameter_studies.delay_interval_proof`).
"""

from __future__ import annotations

from collections.abc import Collection
from fractions import Fraction

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.parameter_names import ParameterRef, given_ranges, unit_of
from apc.frame.parameters import resolve, scope_of
from apc.network.channel import ChannelLaw, channel_law


def unreliable(system: Model) -> list[tuple[Link, ChannelLaw]]:
    """Return the links that lose packets or delay them by chance, with their laws."""
    links = [link for link in system.links if link.channel is not None]
    timings = resolve(system).timings if links else {}
    laws = [(link, channel_law(system, link, timings[link.delay])) for link in links]
    return [(link, law) for link, law in laws if law.mean_loss or law.jitter or law.trace is not None]


def chance(link: Link, law: ChannelLaw) -> str:
    """Return the channel of a link in words."""
    named = [f"packet loss ({100 * law.mean_loss:.3g} %)"] * bool(law.mean_loss)
    named += ["jitter"] * bool(law.jitter) + ["recorded delays"] * (law.trace is not None)
    return f"{' and '.join(named)} of {link.name}"


def limitations(
    system: Model, *, network: bool = True, varied: Collection[ParameterRef] = ()
) -> tuple[str, ...]:
    """Return the limitations for each unreliable link, and for each delay that is given as a range.

    Parameters
    ----------
    system
        The model.
    network
        Whether the answer is of the nominal network.
    varied
        The varied timing: its range is not a limitation.
    """
    notes = []
    for link, law in unreliable(system) if network else ():
        delay = _ms(resolve(system).timings[link.delay])
        notes.append(f"left out: {chance(link, law)}; here every packet takes the nominal {delay}")
    names = {free.name for free in varied}
    for interval in given_ranges(system):
        if interval.free.name not in names:
            low, middle, high = (
                _ms(value) for value in (interval.low, (interval.low + interval.high) / 2, interval.high)
            )
            notes.append(f"left out: {interval.free.label} from {low} to {high} but for its middle, {middle}")
    return tuple(notes)


def refuse_range(system: Model) -> None:
    """Refuse a model with a delay range where a fixed delay is required (simulate, export): ApcError E899."""
    for interval in given_ranges(system):
        low, middle, high = (
            _ms(value) for value in (interval.low, (interval.low + interval.high) / 2, interval.high)
        )
        message = f"{interval.free.label} is a range, {low} to {high}, of which this takes one"
        hint = f'--set "{interval.free.label}={middle}"'
        axes = (axis for axis in system.within if axis.parameter == interval.free.name)
        line, column = next(((axis.line, axis.column) for axis in axes), (0, 0))
        raise ApcError(
            Diagnostic("E899", SourceLocation(system.origin.topology, line, column), message, hint=hint)
        )


def _ms(seconds: Fraction) -> str:
    return f"{float(seconds) * 1e3:.6g} ms"


def channel_numbers(system: Model) -> frozenset[str]:
    """Return the names of the losses and delays of links, and of all numbers that these depend on."""
    texts: list[str] = []
    for link in system.links:
        if link.channel is not None and link.channel.loss is not None:
            loss = link.channel.loss
            texts += [loss.p, loss.r, loss.one_minus_h, loss.one_minus_k]
        if link.channel is not None and link.channel.jitter is not None:
            texts.append(link.channel.jitter)
    return frozenset(scope_of(system).needed(texts))


def refuse_channel_number(
    system: Model, free: ParameterRef, location: SourceLocation, *, instead: str = ""
) -> None:
    """Refuse to vary a number of an unreliable link where every packet counts as on time.

    Parameters
    ----------
    system
        The model.
    free
        The timing to be varied.
    location
        The location of the request.
    instead
        The suggested fix; by default the simulation of one value.

    Raises
    ------
    ApcError
        E896 lost or late packets depend on it, and the verdict is of the nominal network.
    """
    if free.name in channel_numbers(system):
        message = (
            f"{free.label} can't be varied: this verdict is of the nominal network, in which no packet is "
            "lost and all take their nominal delay"
        )
        value = "2 ms" if unit_of(system, free.name) == "s" else "5 %"
        hint = instead or f'apc simulate --set {free.label}="{value}"'
        raise ApcError(Diagnostic("E896", location, message, hint=hint))
