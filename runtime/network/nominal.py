"""What an answer about the nominal network leaves out: lost packets, jitter, recorded delays.

Takes: a `CompiledSystem`.
Gives: `left_out`, `channel_numbers`, `refuse_channel_number`.
Guarantees: a question about a number that only lost or late packets depend on is refused by name, as its
answer would be about a network without them.
Does not: answer for an unreliable network (see `moments`).
"""

from __future__ import annotations

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.names import Free, unit_of
from apc.frame.parameters import scope_of
from apc.network.channel import channel_law


def left_out(system: CompiledSystem, *, network: bool = True) -> tuple[str, ...]:
    """Return what an analysis of the nominal network leaves out, for each unreliable link.

    Parameters
    ----------
    system
        The compiled scene.
    network
        Whether the answer is of the nominal network.
    """
    timings = {timing.name: timing.value for timing in system.timings}
    notes = []
    for link in system.links:
        if link.channel is None or not network:
            continue
        law = channel_law(system, link, timings[link.delay])
        named = []
        if law.mean_loss:
            named.append(f"packet loss ({100 * law.mean_loss:.3g} %)")
        if law.jitter:
            named.append("jitter")
        if law.trace is not None:
            named.append("recorded delays")
        if named:
            delay = f"{float(timings[link.delay]) * 1e3:.6g} ms"
            notes.append(
                f"left out: {' and '.join(named)} of {link.name}; here every packet takes the nominal {delay}"
            )
    return tuple(notes)


def channel_numbers(system: CompiledSystem) -> frozenset[str]:
    """Return the names of what links lose and delay packets by, and of all that these follow from."""
    found: list[str] = []
    for link in system.links:
        if link.channel is not None and link.channel.loss is not None:
            loss = link.channel.loss
            found += [loss.p, loss.r, loss.one_minus_h, loss.one_minus_k]
        if link.channel is not None and link.channel.jitter is not None:
            found.append(link.channel.jitter)
    return frozenset(scope_of(system).needed(found))


def refuse_channel_number(system: CompiledSystem, free: Free, place: Place, *, instead: str = "") -> None:
    """Refuse to vary a number of an unreliable link where every packet counts as on time.

    Parameters
    ----------
    system
        The compiled scene.
    free
        What is to vary.
    place
        Where it was asked for.
    instead
        What to write; the simulation of one value if not given.

    Raises
    ------
    ApcError
        E896 lost or late packets depend on it, and the verdict is of the nominal network.
    """
    if free.name in channel_numbers(system):
        what = (
            f"{free.label} can't be varied: this verdict is of the nominal network, in which no packet is "
            "lost and all take their nominal delay"
        )
        value = "2 ms" if unit_of(system, free.name) == "s" else "5 %"
        hint = instead or f'apc simulate --set {free.label}="{value}"'
        raise ApcError(Mistake("E896", place, what, hint=hint))
