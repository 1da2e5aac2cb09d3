"""A model exported as code: a peer in C99, or an FMU of a peer or of all peers.

Takes: a `Model`, a peer's name, a device, a method. Gives: `Code`, `peer_code`, `write_code`;
`topology_unit`.
Guarantees: three texts are written together or not at all: `left.c`, `left.h`, and the driver `left_test.c`.
Does not: compile the C texts.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import write_texts
from apc.exports.c_text import driver, header, source
from apc.exports.external_force import with_external_force
from apc.exports.fmu import FmuContent, unit_of
from apc.exports.peer_step import ExportedPeer, peer_of, refused, subsystems_of
from apc.exports.topology_text import c_topology, single_peer
from apc.linearization.evaluation_errors import finite_equations
from apc.realtime.peer import number_of
from apc.result import Result
from apc.simulation.settings import DEFAULT, Method, parse_method
from apc.simulation.simulation import SimulationPlan, plan_of


@dataclass(frozen=True, slots=True, eq=False)
class Code(Result):
    """One peer of a model in C, and the integration method of its states."""

    topology: str
    code: ExportedPeer
    method: str
    shown_by: ClassVar[str] = "exports_output:code"


def peer_code(model: Model, *, peer: str = "", device: str = "", method: str = "") -> Code:
    """Return one peer as C code.

    Parameters
    ----------
    model
        The model.
    peer
        The name of the peer, such as "left[1]"; optional if all peers are equal.
    device
        The masses outside the peer's computer, separated by commas, or "none"; by default determined from
        the equations.
    method
        The integration method of the peer's computer between ticks, as for `simulate`.

    Raises
    ------
    ApcError
        E963 the peers differ, and no name is given; E970 no such peer; and as `peer_of`, `parse_method`.
    """
    chosen_method, plan = _plan(model, method)
    if not peer and len(set(subsystems_of(plan))) > 1:
        message = "the peers differ; C code is written for one peer"
        fix = f'--peer "{plan.comm_graph.peer_name(0)}"'
        raise ApcError(Diagnostic("E963", SourceLocation(model.origin.topology), message, fix=fix))
    result = peer_of(
        plan, number_of(plan.comm_graph, peer, "--peer") if peer else 0, chosen_method, device=device or None
    )
    return Code(model.name, result, str(chosen_method))


def topology_unit(model: Model, *, peer: str = "", method: str = "") -> FmuContent:
    """Return an FMU of a model, or of one peer of the model; parameters and errors as for `peer_code`."""
    chosen_method, plan = _plan(with_external_force(model), method)
    topology = (
        single_peer(plan, number_of(plan.comm_graph, peer, "--peer"), chosen_method)
        if peer
        else c_topology(plan, chosen_method)
    )
    return unit_of(model, topology, peer=peer)


def _plan(model: Model, method: str) -> tuple[Method, SimulationPlan]:
    """Return the integration method of a text, and the simulation plan of a model."""
    chosen_method = parse_method(method) if method else DEFAULT
    if not model.clocks:
        raise refused(model, f"{model.name} has no clock, so nothing is computed at ticks")
    with finite_equations(model):
        return chosen_method, plan_of(model, chosen_method)


_INCLUDED = re.compile(r"[^\x00-\x1f\"\\]+")


def write_code(path: Path, code: Code) -> None:
    """Write a peer's code with its header and a driver. Raises ApcError (E601) on failure."""
    include = f"{path.stem}.h"
    if not _INCLUDED.fullmatch(include):
        message = f"{include} is not a valid name of a C header"
        raise ApcError(Diagnostic("E601", SourceLocation(str(path)), message, fix="--out peer.c"))
    write_texts(
        {
            path.with_suffix(".h"): header(code.code),
            path: source(code.code, include),
            path.with_name(f"{path.stem}_test.c"): driver(code.code, include),
        }
    )
