"""A verdict over an unreliable network as text and plain data.

Takes: a `NetworkVerdict`. Gives: `network_text`, `network_document`.
Guarantees: what was not judged says why.
Does not: compute.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from apc.compiler.words import measured, wrapped
from apc.present.forms import document, note

if TYPE_CHECKING:
    from apc.moments.network import NetworkVerdict

_WORDS = {
    "stable in mean square": "Over the network as it is, the mean square of every motion dies out.",
    "unstable in mean square": "Over the network as it is, the mean square of some motion grows.",
    "undecided": "The growth of mean squares lies nearer to 1 than its error bound.",
}


def network_text(found: NetworkVerdict) -> str:
    """Return what becomes of a scene over its network, in words and numbers."""
    judged = found.mean_square_radius is not None
    where = "" if judged else " over its network"
    lines = [
        f"{found.topology}: {found.verdict}{where}{', linearized at its start' if found.linearized else ''}"
    ]
    if judged:
        lines += ["", *wrapped(_WORDS[found.verdict.removeprefix("probably ")], "  ", "  ")]
    lines.append("")
    if found.mean_square_radius is not None:
        error = found.error or 0.0
        root = math.sqrt(found.mean_square_radius)
        lines += [
            f"  mean squares     grow by {measured(found.mean_square_radius, error)} a frame",
            f"  its root         {measured(root, error / (2 * root) if root else error)}, beside the "
            "nominal spectral radius",
        ]
    if found.rms_error_m is not None:
        apart = f"{found.rms_error_m * 1e3:.4g} mm rms, as every hand pushes with 1 N rms, anew each tick"
        lines += wrapped(apart, "  copies apart     ", " " * 19)
    if found.almost_sure is not None:
        low, high = found.almost_sure.interval
        lines.append(
            f"  almost surely    growth e^{found.almost_sure.exponent:.4g} a frame ({low:.4g} to {high:.4g})"
        )
    if found.losses_in_a_row is not None:
        lines += _losses(found)
    if found.proof:
        lines.append(f"  proof            {found.proof}")
    for text in found.notes:
        lines += note(text)
    while lines[-1] == "":
        lines.pop()
    return "\n".join(lines)


def _losses(found: NetworkVerdict) -> list[str]:
    row = found.losses_in_a_row
    assert row is not None
    lines = []
    if row.certified is not None:
        harmless = f"any pattern of at most {row.certified}" if row.certified else "not even one at a time"
        lines.append(f"  losses in a row  {harmless} is certified harmless")
    if row.unstable_pattern is not None and not any(row.unstable_pattern):
        lines.append(f"  losses in a row  with none a motion grows by {row.growth:.6g} a frame")
    elif row.unstable_pattern is not None and row.growth is not None:
        pattern = "".join("×" if lost else "·" for lost in row.unstable_pattern)
        lines += wrapped(
            f"{pattern} lost again and again (×) makes a motion grow by {row.growth:.6g} a frame",
            "  worst pattern    ",
            " " * 19,
        )
    return lines


def network_document(found: NetworkVerdict) -> dict[str, Any]:
    """Return what becomes of a scene over its network as plain data."""
    told: dict[str, Any] = document(found)
    del told["topology"]
    return told
