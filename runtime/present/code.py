"""What a scene handed over as code is, in words and as plain data.

Takes: a `Code` or a `Unit`. Gives: `code_text`, `code_document`; `unit_text`, `unit_document`.
Guarantees: at most 80 columns.
Does not: write files.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any

from apc.compiler.words import counted, wrapped
from apc.exports.c_text import source
from apc.exports.code import Code
from apc.exports.fmu import Unit
from apc.present.forms import document, listed, note, picked


def code_text(found: Code) -> str:
    """Return what a peer's code takes and gives."""
    peer, name = found.code, found.code.identifier
    period = float(peer.schedule.frame_s) / len(peer.instants) * 1e3
    every = f"every {period:.6g} ms" if len({one.move for one in peer.instants}) == 1 else "at its instants"
    measured = [f"{peer.kind.states[i].name} [{peer.kind.states[i].unit}]" for i in peer.measured]
    inside = [one.name for i, one in enumerate(peer.kind.states) if i not in peer.outside]
    rows = [
        ("measures", measured),
        ("hears", [f"{sender.name} over {line.link}" for line in peer.lines for sender in line.senders]),
        ("puts out", [f"{one.name} [N]" for one in peer.forces.values()]),
        ("sends", [f"{name} over {line.link}" for line in peer.sending for name in line.channels]),
        ("moves itself", inside),
    ]
    lines = [f"{found.topology}: {peer.name} in C99, {name}_tick {every}", ""]
    for what, names in rows:
        lines += wrapped(f"{what} {listed(names)}", "  ", "    ")
    return "\n".join([*lines, "", *note(f"method between ticks: {found.method}; all numbers in SI units")])


def code_document(found: Code) -> dict[str, Any]:
    """Return a peer's code as plain data."""
    peer = found.code
    starts = accumulate((peer.moves[one.move].quanta for one in peer.instants), initial=0)
    return {
        **picked(found, "topology", "method"),
        "peer": peer.name,
        "name": found.code.identifier,
        "measured": [peer.kind.states[place].name for place in peer.measured],
        "heard": [
            {"link": line.link, "from": [one.name for one in line.senders], "channels": list(line.channels)}
            for line in peer.lines
            if line.senders
        ],
        "forces": [one.name for one in peer.forces.values()],
        "sent": [picked(line, "link", "channels") for line in peer.sending],
        "instants_s": [float(start * peer.schedule.quantum) for start in [*starts][:-1]],
        "source": source(found.code, f"{found.code.identifier}.h"),
    }


def unit_text(found: Unit) -> str:
    """Return what an FMU takes and gives."""
    inputs = [one.name for one in found.scene.variables if one.given]
    fixed = [one.name for one in found.scene.variables if one.role == "parameter"]
    outputs = [one.name for one in found.scene.variables if one.role in ("output", "state")]
    what = found.peer or counted(len(found.scene.peers), "peer")
    lines = [f"{found.system.name}: {what} for co-simulation, FMI 2.0", ""]
    lines += wrapped(f"{counted(len(inputs), 'input')}: {listed(inputs)}", "  ", "    ")
    lines += wrapped(f"{counted(len(outputs), 'output')}: {listed(outputs)}", "  ", "    ")
    if fixed:
        lines += wrapped(f"{counted(len(fixed), 'parameter')}: {listed(fixed)}", "  ", "    ")
    told = f"steps of {found.step * 1e3:.6g} ms show every tick of the fastest clock, values before the tick"
    if found.peer:
        told += "; what it hears is set when it has arrived: delays and losses are the network's"
    return "\n".join([*lines, "", *note(told)])


def unit_document(found: Unit) -> dict[str, Any]:
    """Return an FMU as plain data."""
    variables = [
        {**picked(one, "name", "unit"), "input": one.given, "parameter": one.role == "parameter"}
        for one in found.scene.variables
    ]
    return {
        "topology": found.system.name,
        "peer": found.peer or None,
        "step_s": found.step,
        "duration_s": document(found.duration),
        "variables": variables,
    }
