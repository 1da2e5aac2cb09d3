"""What an export is, in words and as plain data.

Takes: what `exports` makes.
Gives: `state_space_text`, `state_space_document`, `state_space_control`; `modelica_text`.
Guarantees: at most 80 columns.
Does not: write files.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from apc.compiler.words import counted, wrapped
from apc.present.forms import listed, notes, record

if TYPE_CHECKING:
    from apc.exports.lifted import StateSpace
    from apc.exports.modelica import ModelicaModel


def state_space_text(found: StateSpace) -> str:
    """Return what a state space has."""
    lines = [f"{found.topology}: {found.what} over one frame of {found.frame_s * 1e3:.6g} ms", ""]
    for word, ports in (("state", found.states), ("input", found.inputs), ("output", found.outputs)):
        lines += wrapped(
            f"{counted(len(ports), word)}: {listed([port.name for port in ports])}", "  ", "    "
        )
    if found.free:
        lines += wrapped(
            f"A, B, C and D are a function of {listed([port.name for port in found.free])}", "  ", "    "
        )
    lines += ["", *notes([found.meaning, *found.notes])]
    return "\n".join(lines)


def state_space_control(found: StateSpace) -> Any:
    """Return a state space as python-control's."""
    from apc.exports.files import as_control  # what writes files is asked for where one is written

    return as_control(found)


def state_space_document(found: StateSpace) -> dict[str, Any]:
    """Return a state space as plain data."""
    function = found.function and found.function.serialize()
    instead = {"made_by": json.loads(found.made_by), "function": function, "meaning": found.meaning}
    return record(found, instead)


def modelica_text(found: ModelicaModel) -> str:
    """Return what a Modelica model has."""
    has = f"{counted(found.peers, 'peer')}, {counted(found.variables, 'variable')}, one equation each"
    lines = [f"{found.topology}: the model {found.name} of Modelica 3.3", "", f"  {has}"]
    return "\n".join([*lines, *(f"  {clock}" for clock in found.clocks)])
