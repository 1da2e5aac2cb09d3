"""The command `apc export`.

Takes: words of a command line. Gives: a file, and what is in it on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed.
Does not: compute, or know a format.
"""

from __future__ import annotations

from pathlib import Path

from apc.cli.options import command, note_aside, option, print_result


@command
def export_command(
    *,
    file: str | None,
    to: str | None = option(
        "control: a script that makes a python-control StateSpace (.py); mat, npz: the same matrices for "
        "MATLAB, SciPy, NumPy; modelica: a flat model with clocks (.mo); c: one tick of a peer in C99, with "
        "header and driver; fmu: the topology or a peer for co-simulation (FMI 2.0). Taken from --out if not "
        "given.",
        "FORMAT",
    ),
    settings: tuple[str, ...],
    open_at: str = option(
        "Cut the loop open at a link or a coupler, for margins and designs of your own: closed again by "
        "u = -y it is the closed loop.",
        "NAME",
    ),
    symbolic: tuple[str, ...] = option(
        "Leave a number free: A, B, C and D are a casadi.Function of it too, `casadi_function` in the "
        "file. May be repeated.",
        "PATH",
    ),
    peer: str = option("For c and fmu: one peer, such as 'left[1]'. An FMU is of all.", "NAME"),
    device: str = option(
        "For c: what the peer's computer doesn't move, several with commas between, or none. What a hand "
        "holds, or others are not told of, if not given.",
        "MASS",
    ),
    method: str = option(
        "For c and fmu: how states move between ticks, as for simulate; rk4:STEP where they are not linear.",
        "METHOD",
    ),
    out: Path = option("The file to write."),
    as_json: bool,
) -> None:
    """Hand a topology over to other tools.

    FILE is a topology or a compiled model. As a state space it is the whole
    loop over one frame, all peers in it: from a force on every mass and noise
    on every measurement to every position, velocity and force. As a Modelica
    model it is every equation, tick and packet; as C or an FMU a peer as it
    computes, or all of them with the packets between.

    \b
        apc export --out loop.mat
        apc export --out topology.mo
        apc export --to control --open-at lan --out open_loop.py
        apc export --symbolic coordination.stiffness --out family.npz
        apc export --peer "left[1]" --out left.c
        apc export --out topology.fmu
    """
    from apc.exports.formats import ExportRequest, export, format_of
    from apc.inputs import open_topology

    chosen = format_of(to, out)
    system = open_topology(file, settings, {"--out": out}, notify=note_aside)
    result = export(system, chosen, ExportRequest(open_at, symbolic, peer, device, method), out)
    print_result(result, as_json=as_json, written=[out])
