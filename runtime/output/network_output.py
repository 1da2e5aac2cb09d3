"""Mean-square verdicts and statistics of packet recordings, as text and plain data.

Takes: a `MeanSquareStability`, a `LinkFit`. Gives: text and document of each; `recording_document`,
`recording_table`, `link_entry`.
Guarantees: a missing verdict has a reason, and assumptions come first. The keys are those of a link's entry.
Does not: compute.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.wording import counted, wrapped
from apc.output.formatting import Lines, Plain, labelled, notes, point_text, radius_text, record, sentences

if TYPE_CHECKING:
    from apc.mean_square.loss_results import ConsecutiveLosses
    from apc.mean_square.mean_square_stability import MeanSquareStability
    from apc.network.link_fit import LinkFit, Share

MEDIAN = 0.5

_WORDS = {
    True: "With the packet losses and delays of the network, the second moments of all motions decay, "
    "apart from common translations if they are free.",
    False: "With the packet losses and delays of the network, the second moment of some motion grows.",
    None: "The second-moment growth is closer to 1 than its error bound.",
}


def network_text(result: MeanSquareStability) -> Lines:
    """Yield the mean-square verdict of a model, in words and numbers."""
    radius = result.mean_square_radius
    where = " over its network" if radius is None else ""
    point = point_text(result.linearized, result.at_equilibrium)
    yield f"{result.topology}: {result.verdict}{where}{point}"
    yield ""
    if radius is not None:
        yield from sentences(_WORDS[result.stable])
        yield ""
        error, root = result.error or 0.0, math.sqrt(radius)
        rooted = radius_text(root, error / (2 * root) if root else error)
        yield from labelled(
            ("second moments", f"growth {radius_text(radius, error)} per frame (stable < 1)"),
            ("square root", f"{rooted} (cf. nominal spectral radius)"),
        )
    if result.rms_error_m is not None:
        separation = f"{result.rms_error_m * 1e3:.4g} mm rms, for white noise of 1 N rms at every hand"
        yield from labelled(("coordination error", separation))
    if result.almost_sure is not None:
        low, high = result.almost_sure.interval
        exponent = f"Lyapunov exponent {result.almost_sure.exponent:.4g} per frame ({low:.4g} to {high:.4g})"
        yield from labelled(("almost surely", exponent))
    if result.losses_in_a_row is not None:
        yield from labelled(*_losses(result.losses_in_a_row))
    yield from labelled(("proof", str(result.proof)))
    yield from notes(*result.notes)


def _losses(losses_in_a_row: ConsecutiveLosses) -> Iterator[tuple[str, str]]:
    """Yield the label and the text of each result on consecutive losses."""
    certified = losses_in_a_row.certified
    if certified is not None:
        most = f"certified stable up to {counted(certified, 'consecutive lost packet')}"
        yield "losses", most if certified else "no loss pattern is certified stable"
    if losses_in_a_row.certificate is not None:
        yield "  certificate", str(losses_in_a_row.certificate)
    pattern = "".join("×" if lost else "·" for lost in losses_in_a_row.unstable_pattern or ())
    growth = f"growth {losses_in_a_row.growth:.6g} per frame" if pattern else ""
    if "×" in pattern:
        yield "unstable pattern", f"{pattern}, repeated (× = lost): {growth}"
    elif pattern:
        yield "losses", f"unstable without any loss: {growth}"


def network_document(result: MeanSquareStability) -> Plain:
    """Return the mean-square verdict of a model as plain data."""
    return record(result, {"topology": ...})


def recording_text(recording: LinkFit) -> Lines:
    """Yield the statistics of a recording in words and numbers, and the corresponding link entry."""
    of = f" by {recording.program}" if recording.program else ""
    file = Path(recording.file).name
    yield f"{file}: {counted(recording.packets, 'packet', ',')} recorded{of}"
    yield ""
    if recording.limitations:
        yield from notes(*recording.limitations)
        yield ""
    yield from labelled(("lost", _share(recording.lost)))
    if recording.lost.count:
        independent = "inconsistent" if recording.bursty else "consistent"
        mean = recording.lost.count / recording.bursts
        bursts = f"{recording.bursts:,}, mean length {mean:.3g}, longest {recording.longest_burst:,}"
        yield from labelled(
            ("bursts", bursts), ("", f"{independent} with independent losses (Fisher's exact test)")
        )
    if recording.distribution is not None:
        several = recording.packets > recording.lost.count + 1
        spread = f", standard deviation {_ms(recording.std)}" if several else ""
        quantiles = (
            (_quantile(share), f"{'' if share == MEDIAN else 'at most '}{_ms(delay)}")
            for share, delay in recording.quantiles
        )
        span = f"{_ms(recording.shortest)} to {_ms(recording.longest)}"
        yield from labelled(("delay", span), ("  mean", f"{_ms(recording.mean)}{spread}"), *quantiles)
    if recording.reordered is not None:
        yield from labelled(("reordered", counted(recording.reordered, "packet", ",")))
    yield from ("", "Link with the fitted values", "")
    yield from wrapped(link_entry(recording), "  ", "   ")
    if recording.distribution is not None and recording.distribution.jitter:
        away = f"the distribution functions differ by at most {100 * recording.distribution.distance:.2g} %"
        yield from notes(f"best fit: {recording.distribution.distribution}; {away}")
    yield from ("", "Link with the recorded packets", "", f"  lan: {{clock: network, trace: {file}}}")


def _quantile(share: float) -> str:
    """Return the label of a quantile of delays."""
    return "  median" if share == MEDIAN else f"  {100 * share:g} %"


def recording_document(recording: LinkFit) -> Plain:
    """Return a recording as plain data: seconds, shares from 0 to 1."""
    shares = {name: getattr(recording, name) for name in ("lost", "p", "r")}
    instead = {name: record(share, {"share": share.value}) for name, share in shares.items()}
    return record(recording, {"delays": ..., "entry": link_entry(recording), **instead})


def recording_table(recording: LinkFit) -> str:
    """Return all delays as the table that a link's `trace` takes."""
    rows = ("lost" if math.isinf(delay) else f"{delay * 1e3:.12g}" for delay in recording.delays)
    return "\n".join(["delay [ms]", *rows])


def link_entry(recording: LinkFit) -> str:
    """Return the entry of a link with the keys that a recording amounts to."""
    keys = ["clock: network"]
    if recording.distribution is not None:
        keys.append(f"delay: {_ms(recording.distribution.delay)}")
        if recording.distribution.jitter:
            keys += [
                f"jitter: {_ms(recording.distribution.jitter)}",
                f"distribution: {recording.distribution.distribution}",
            ]
    if recording.bursty:
        keys.append(f"loss: {{p: {_percent(recording.p.value)}, r: {_percent(recording.r.value)}}}")
    elif recording.lost.count:
        keys.append(f"loss: {_percent(recording.lost.value)}")
    return f"lan: {{{', '.join(keys)}}}"


def _share(share: Share) -> str:
    between = " to ".join(map(_percent, share.interval))
    return f"{share.count:,} of {share.of:,}: {_percent(share.value)} (95 %: {between})"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.4g} ms" if math.isfinite(seconds) else "–"
