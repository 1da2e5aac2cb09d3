"""What a recording of packets amounts to, as text, plain data, and a trace.

Takes: a `NetworkRecording`. Gives: `recording_text`, `recording_document`, `recording_table`, `link_entry`.
Guarantees: what is taken for granted stands first; the keys are those of a link's entry as it is.
Does not: compute.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apc.compiler.words import counted, wrapped
from apc.present.forms import Lines, document, labelled, notes, record

if TYPE_CHECKING:
    from apc.network.recorded import NetworkRecording, Share


def recording_text(found: NetworkRecording) -> Lines:
    """Yield what a recording amounts to, in words and numbers, and a link's entry that says so."""
    of = f" by {found.program}" if found.program else ""
    file = Path(found.file).name
    yield f"{file}: {counted(found.packets, 'packet', ',')} recorded{of}"
    yield ""
    if found.left_out:
        yield from notes(*found.left_out)
        yield ""
    yield from labelled(("lost", _share(found.lost)))
    if found.lost.count:
        how = "losses follow losses" if found.bursty else "no more than luck makes of independent losses"
        average = f"{found.lost.count / found.bursts:.3g} packets on average"
        bursts = f"{found.bursts:,}, {average}, {found.longest_burst:,} the longest"
        yield from labelled(("bursts", bursts), ("", f"{how} (Fisher's exact test)"))
    if found.law is not None:
        several = found.packets > found.lost.count + 1
        spread = f", standard deviation {_ms(found.deviation)}" if several else ""
        quantiles = ((f"  {100 * share:g} %", f"at most {_ms(delay)}") for share, delay in found.quantiles)
        span = f"{_ms(found.shortest)} to {_ms(found.longest)}"
        yield from labelled(("delay", span), ("  mean", f"{_ms(found.mean)}{spread}"), *quantiles)
    if found.overtaken is not None:
        yield from labelled(("overtaken", counted(found.overtaken, "packet", ",")))
    yield "\n  as keys of a link"
    yield from wrapped(link_entry(found), "    ", "     ")
    if found.law is not None and found.law.jitter:
        away = f"shares of packets below a delay differ by at most {100 * found.law.distance:.2g} %"
        nearest = f"{found.law.distribution} is the nearest of the distributions: {away}"
        yield from wrapped(nearest, "    ", "    ")
    yield f"  or packet by packet\n    lan: {{clock: network, trace: {file}}}"


def recording_document(found: NetworkRecording) -> dict[str, Any]:
    """Return a recording as plain data: seconds, shares from 0 to 1."""
    shares = {name: getattr(found, name) for name in ("lost", "turns_bad", "turns_good")}
    instead = {name: document(share, {"share": share.value}) for name, share in shares.items()}
    return record(found, {"delays": ..., "entry": link_entry(found), **instead})


def recording_table(found: NetworkRecording) -> str:
    """Return all delays as the table that a link's `trace` takes."""
    rows = ("lost" if math.isinf(delay) else f"{delay * 1e3:.12g}" for delay in found.delays)
    return "\n".join(["delay [ms]", *rows])


def link_entry(found: NetworkRecording) -> str:
    """Return the entry of a link with the keys that a recording amounts to."""
    keys = ["clock: network"]
    if found.law is not None:
        keys.append(f"delay: {_ms(found.law.delay)}")
        if found.law.jitter:
            keys += [f"jitter: {_ms(found.law.jitter)}", f"distribution: {found.law.distribution}"]
    if found.bursty:
        keys.append(f"loss: {{p: {_percent(found.turns_bad.value)}, r: {_percent(found.turns_good.value)}}}")
    elif found.lost.count:
        keys.append(f"loss: {_percent(found.lost.value)}")
    return f"lan: {{{', '.join(keys)}}}"


def _share(share: Share) -> str:
    between = " to ".join(map(_percent, share.interval))
    return f"{share.count:,} of {share.of:,}: {_percent(share.value)} (95 %: {between})"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.4g} ms" if math.isfinite(seconds) else "–"
