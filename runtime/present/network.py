"""A verdict over an unreliable network as text and plain data.

Takes: a `NetworkVerdict`. Gives: `network_text`, `network_document`.
Guarantees: what was not judged says why.
Does not: compute.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from apc.compiler.words import wrapped
from apc.present.forms import LINEARIZED, labelled, notes, radius_text, record

if TYPE_CHECKING:
    from apc.moments.network import NetworkVerdict
    from apc.moments.worst import LossesInARow

_WORDS = {
    "stable in mean square": "Over the network as it is, the mean square of every motion dies out.",
    "unstable in mean square": "Over the network as it is, the mean square of some motion grows.",
    "undecided": "The growth of mean squares lies nearer to 1 than its error bound.",
}


def network_text(found: NetworkVerdict) -> str:
    """Return what becomes of a scene over its network, in words and numbers."""
    radius = found.mean_square_radius
    where = " over its network" if radius is None else ""
    lines = [f"{found.topology}: {found.verdict}{where}{LINEARIZED if found.linearized else ''}", ""]
    facts = []
    if radius is not None:
        lines += [*wrapped(_WORDS[found.verdict.removeprefix("probably ")], "  ", "  "), ""]
        error, root = found.error or 0.0, math.sqrt(radius)
        rooted = radius_text(root, error / (2 * root) if root else error)
        facts = [
            ("mean squares", f"multiplied by {radius_text(radius, error)} a frame"),
            ("their root", f"{rooted}, to compare with a spectral radius"),
        ]
    if found.rms_error_m is not None:
        apart = f"{found.rms_error_m * 1e3:.4g} mm rms, for 1 N rms at every hand, white from tick to tick"
        facts.append(("copies apart", apart))
    if found.almost_sure is not None:
        low, high = found.almost_sure.interval
        exponent = f"growth e^{found.almost_sure.exponent:.4g} a frame ({low:.4g} to {high:.4g})"
        facts.append(("almost surely", exponent))
    if found.losses_in_a_row is not None:
        facts += _losses(found.losses_in_a_row)
    if found.proof:
        facts.append(("proof", found.proof))
    lines += [line for label, text in facts for line in labelled(label, text)]
    return "\n".join([*lines, *notes(found.notes)]).rstrip()


def _losses(found: LossesInARow) -> list[tuple[str, str]]:
    told = []
    if found.certified is not None:
        harmless = (
            f"any pattern of at most {found.certified}" if found.certified else "not even one at a time"
        )
        told.append(("losses in a row", f"{harmless} is certified harmless"))
    pattern = "".join("×" if lost else "·" for lost in found.unstable_pattern or ())
    grows = f"a motion grows by {found.growth:.6g} a frame" if pattern else ""
    if "×" in pattern:
        grows = grows.replace("a motion grows", "makes a motion grow")
        told.append(("worst pattern", f"{pattern} lost again and again (×) {grows}"))
    elif pattern:
        told.append(("losses in a row", f"with none {grows}"))
    return told


def network_document(found: NetworkVerdict) -> dict[str, Any]:
    """Return what becomes of a scene over its network as plain data."""
    return record(found, {"topology": ...})
