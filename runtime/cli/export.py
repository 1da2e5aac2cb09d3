"""The command `apc export`.

Takes: words of a command line. Gives: a file, and a summary of its contents on stdout.
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
    to: str | None = option("Format, see above.", "FORMAT", show_default="from --out"),
    settings: tuple[str, ...],
    open_at: str = option("Open the loop at a link or coupler.", "NAME"),
    symbolic: tuple[str, ...] = option("Keep a parameter symbolic (repeatable).", "PATH"),
    peer: str = option("Peer of the C code or FMU.", "NAME", show_default="fmu: all"),
    device: str = option("Masses outside the C code.", "MASS", show_default="the device"),
    method: str = option("Integration method; see simulate.", "METHOD"),
    out: Path = option("Output file."),
    as_json: bool,
) -> None:
    """Export to MATLAB, python-control, Modelica, C or FMU.

    The state space is the closed loop over one frame: from forces on all masses
    and measurement noise to positions, velocities and forces. The Modelica
    model contains all equations, clocks and packets. C code contains one peer,
    an FMU one peer or all. FILE is a topology or a compiled model.

    \b
    --to        control (.py), mat, npz, modelica (.mo), c or fmu (FMI 2.0)
    --open-at   u = -y closes the loop
    --symbolic  matrices as a casadi.Function of the parameters
    --device    masses separated by commas, or none

    \b
        apc export --out loop.mat
        apc export --out topology.mo
        apc export --to control --open-at lan --out open_loop.py
        apc export --symbolic coordination.stiffness --out family.npz
        apc export --peer "left[1]" --out left.c
        apc export --out topology.fmu
    """
    from apc.exports.formats import ExportRequest, export, format_of
    from apc.inputs.open_model import open_topology

    chosen = format_of(to, out)
    model = open_topology(file, settings, {"--out": out}, notify=note_aside)
    result = export(model, chosen, ExportRequest(open_at, symbolic, peer, device, method), out)
    print_result(result, as_json=as_json, written=[out])
