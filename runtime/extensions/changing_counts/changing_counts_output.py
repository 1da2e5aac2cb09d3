"""Output of the stability while users join and leave.

Takes: a `ChangingCounts`. Gives: its text and document.
Guarantees: every line fits 80 columns where its words allow it.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apc.compiler.wording import wrapped
from apc.output.formatting import Lines, Plain, record, table

if TYPE_CHECKING:
    from apc.extensions.changing_counts.joins_and_leaves import ChangingCounts, MotionFamily

LEFT_OUT = "packet losses and random delays are left out"
ASSUMED = "joining: mean is assumed for {}"
NEAR_START = "nonlinear topology: the result holds near the initial state"


def changing_counts_text(result: ChangingCounts) -> Lines:
    """Yield the verdict, the time between changes, the growing sequence, and the families of motions."""
    alone = len(result.sequence) == 1
    example = f"unstable without changes, for example with {result.parameter} = "
    verdict = f"{example}{result.sequence[0]}" if alone else result.verdict
    yield f"{result.topology}: {verdict}{'' if alone else ' of the number of peers'}"
    notes = [NEAR_START] * result.linearized + [LEFT_OUT] * result.lossy
    if result.assumed:
        notes.append(ASSUMED.format(", ".join(result.assumed)))
    for note in notes:
        yield from wrapped(note, "  ", "    ")
    yield ""
    counts = ", ".join(map(str, result.counts))
    yield from wrapped(f"{result.parameter}: {counts}", "  ", "    ")
    if result.dwell_frames is not None:
        text = (
            f"stable if at least {1000 * (result.dwell_s or 0):.6g} ms ({result.dwell_frames} frames) pass "
            "between changes, proved"
        )
        yield from wrapped(text, "  ", "    ")
    if result.sequence and not alone:
        sequence = ", ".join(map(str, result.sequence))
        text = (
            f"grows by a factor of {result.growth:.6g} per frame if {result.parameter} is {sequence} in "
            "successive frames, repeated; proved"
        )
        yield from wrapped(text, "  ", "    ")
    yield "\nFamilies of motions\n"
    rows = [_row(family) for family in result.families]
    yield from table([("family", "states", "common function", "frames", "growing sequence"), *rows], "<><><")
    legend = (
        "common function: one quadratic function that decreases for every number of peers; frames: proved "
        "to suffice between changes; a joining peer starts at the mean of the other peers of its group, the "
        "packets of a leaving peer are dropped; changes at the starts of frames of "
        f"{1000 * result.frame_s:.6g} ms; constant forces are left out"
    )
    yield from wrapped(legend, "  ", "  ")


def _row(family: MotionFamily) -> tuple[str, ...]:
    """Return the row of a family of motions."""
    sequence = ", ".join(map(str, family.sequence)) or "–"
    frames = "–" if family.dwell_frames is None else str(family.dwell_frames)
    return family.name, str(family.states), "proved" if family.common else "none found", frames, sequence


def changing_counts_document(result: ChangingCounts) -> Plain:
    """Return the result as plain data, with the sufficient time between changes in seconds."""
    return record(result, {"dwell_s": result.dwell_s})
