"""Output of proofs for switching contacts, and of limit cycles.

Takes: an `ArbitrarySwitching` or `LimitCycle`. Gives: its text and document.
Guarantees: every line fits 80 columns where its words allow it.
Does not: compute.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from apc.compiler.wording import in_hertz, wrapped
from apc.output.analysis_output import DECIMALS
from apc.output.formatting import (
    Lines,
    Plain,
    notes,
    record,
    table,
)

if TYPE_CHECKING:
    from apc.extensions.switching.arbitrary_switching import ArbitrarySwitching
    from apc.extensions.switching.limit_cycle import LimitCycle


def arbitrary_switching_text(arbitrary_switching: ArbitrarySwitching) -> Lines:
    """Yield the result for arbitrary switching of contacts, in words."""
    reach = arbitrary_switching.reach
    if arbitrary_switching.stable:
        text = "proved stable by the circle criterion"
        if arbitrary_switching.jumps:
            text += (
                f" within bounds: as {arbitrary_switching.jumps} is discontinuous at separation, the "
                "motion need not come to rest"
            )
    else:
        text = (
            f"{'cannot be proved' if arbitrary_switching.stable is False else 'not decided'}: "
            f"{arbitrary_switching.reason}"
        )
    if reach is not None and math.isfinite(reach):
        times = f"{math.floor(reach * 10**DECIMALS) / 10**DECIMALS:.6g}"
        text += f"; the criterion holds up to {times} times the contact stiffness"
    elif reach is not None:
        text += "; the criterion holds for any contact stiffness"
    yield from wrapped(f"Arbitrary switching of contacts: {text}", "", "  ")


def arbitrary_switching_document(arbitrary_switching: ArbitrarySwitching) -> Plain:
    """Return the result for arbitrary switching of contacts, as plain data."""
    return {"stable": arbitrary_switching.stable, **record(arbitrary_switching)}


def limit_cycle_text(limit_cycle: LimitCycle) -> Lines:
    """Yield a limit cycle: prediction and simulation."""
    predicted = limit_cycle.predicted
    settles = "settles" if limit_cycle.settles else ""
    simulated = in_hertz(limit_cycle.lines[0].frequency_hz) if limit_cycle.lines else settles or "–"
    rows = [
        ("", "predicted", "simulated"),
        ("frequency", in_hertz(predicted.frequency_hz) if predicted else "–", simulated),
    ]
    share = f"{predicted.in_contact:.1%}" if predicted else "–"
    for contact in limit_cycle.contacts:
        depth = "–" if contact.predicted_depth_m is None else f"{contact.predicted_depth_m * 1e3:.4g} mm"
        rows += [
            (f"{contact.name}: depth", depth, settles or f"{contact.depth_m * 1e3:.4g} mm"),
            (f"{contact.name}: in contact", share, f"{contact.in_contact:.1%}"),
        ]
    title = f"limit cycle of the contacts, predicted and simulated ({limit_cycle.simulated_s:g} s)"
    yield from wrapped(f"{limit_cycle.topology}: {title}")
    yield ""
    yield from table(rows, "<>>")
    yield from notes(limit_cycle.reason, *limit_cycle.notes)
