"""Exported models in words and as plain data.

Takes: results of `exports`: a state space, a Modelica model, a peer's code, an FMU.
Gives: of each its text, and its document; `state_space_control`.
Guarantees: at most 80 columns.
Does not: write files.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from apc.compiler.wording import counted
from apc.output.formatting import Lines, Plain, document, listed, notes, picked, record

if TYPE_CHECKING:
    from apc.exports.code import Code
    from apc.exports.fmu import FmuContent
    from apc.exports.lifted import StateSpace
    from apc.exports.modelica import ModelicaModel


def _numbered(word: str, names: Sequence[str]) -> Lines:
    """Yield the number of items, and the names of the first."""
    return notes(f"{counted(len(names), word)}: {listed(names)}")


def state_space_text(state_space: StateSpace) -> Lines:
    """Yield the contents of a state space."""
    yield (
        f"{state_space.topology}: {state_space.content} over one frame of "
        f"{state_space.frame_s * 1e3:.6g} ms\n"
    )
    for word, ports in (
        ("state", state_space.states),
        ("input", state_space.inputs),
        ("output", state_space.outputs),
    ):
        yield from _numbered(word, [port.name for port in ports])
    if state_space.symbolic:
        symbolic_names = listed([port.name for port in state_space.symbolic])
        yield from notes(f"A, B, C and D are functions of {symbolic_names}")
    yield ""
    yield from notes(state_space.meaning, *state_space.notes)


def state_space_control(state_space: StateSpace) -> Any:
    """Return a state space as python-control's."""
    from apc.exports.state_space_files import as_control  # loaded only on use

    return as_control(state_space)


def state_space_document(state_space: StateSpace) -> Plain:
    """Return a state space as plain data."""
    function = state_space.function and state_space.function.serialize()
    instead = {
        "made_by": json.loads(state_space.made_by),
        "function": function,
        "meaning": state_space.meaning,
    }
    return record(state_space, instead)


def modelica_text(model: ModelicaModel) -> Lines:
    """Yield the contents of a Modelica model."""
    yield f"{model.topology}: Modelica 3.3 model {model.name}\n"
    yield f"  {counted(model.peers, 'peer')}, {counted(model.variables, 'variable')}, one equation each"
    yield from (f"  {clock}" for clock in model.clocks)


def code_text(code: Code) -> Lines:
    """Yield the inputs and outputs of a peer's code."""
    peer = code.code
    period = float(peer.schedule.frame_s) / len(peer.instants) * 1e3
    every = (
        f"every {period:.6g} ms"
        if len({instant.move for instant in peer.instants}) == 1
        else "at its instants"
    )
    yield f"{code.topology}: {peer.name} in C99, {peer.identifier}_tick {every}\n"
    for subject, names in (
        (
            "measures",
            [f"{peer.peer_type.states[i].name} [{peer.peer_type.states[i].unit}]" for i in peer.measured],
        ),
        ("receives", [f"{sender.name} over {line.link}" for line in peer.lines for sender in line.senders]),
        ("outputs", [f"{force.name} [N]" for force in peer.forces.values()]),
        ("sends", [f"{name} over {line.link}" for line in peer.sending for name in line.channels]),
        (
            "integrates",
            [state.name for i, state in enumerate(peer.peer_type.states) if i not in peer.outside],
        ),
    ):
        yield from notes(f"{subject} {listed(names)}")
    yield ""
    yield from notes(f"method between ticks: {code.method}; all numbers in SI units")


def code_document(code: Code) -> Plain:
    """Return a peer's code as plain data."""
    from apc.exports.c_text import source

    peer = code.code
    starts = accumulate((peer.moves[instant.move].quanta for instant in peer.instants), initial=0)
    return {
        **picked(code, "topology", "method"),
        "peer": peer.name,
        "name": peer.identifier,
        "measured": [peer.peer_type.states[index].name for index in peer.measured],
        "heard": [
            {
                "link": line.link,
                "from": [sender.name for sender in line.senders],
                "channels": list(line.channels),
            }
            for line in peer.lines
            if line.senders
        ],
        "forces": [force.name for force in peer.forces.values()],
        "sent": [picked(line, "link", "channels") for line in peer.sending],
        "instants_s": [float(start * peer.schedule.quantum) for start in [*starts][:-1]],
        "source": source(peer, f"{peer.identifier}.h"),
    }


def unit_text(unit: FmuContent) -> Lines:
    """Yield the inputs and outputs of an FMU."""
    subject = unit.peer or counted(len(unit.topology.peers), "peer")
    yield f"{unit.model.name}: {subject} for co-simulation, FMI 2.0\n"
    variables = unit.topology.variables
    fixed = [variable.name for variable in variables if variable.role == "parameter"]
    yield from _numbered("input", [variable.name for variable in variables if variable.given])
    yield from _numbered(
        "output", [variable.name for variable in variables if variable.role in ("output", "state")]
    )
    if fixed:
        yield from _numbered("parameter", fixed)
    step = f"step {unit.step * 1e3:.6g} ms: every tick of the fastest clock, values before the tick"
    received = "received values are inputs, set at their arrival; the FMU has no delays and losses"
    yield ""
    yield from notes(step, received if unit.peer else "")


def unit_document(unit: FmuContent) -> Plain:
    """Return an FMU as plain data."""
    variables = [
        {
            **picked(variable, "name", "unit"),
            "input": variable.given,
            "parameter": variable.role == "parameter",
        }
        for variable in unit.topology.variables
    ]
    return {
        "topology": unit.model.name,
        "peer": unit.peer or None,
        "step_s": unit.step,
        "duration_s": document(unit.duration),
        "variables": variables,
    }
