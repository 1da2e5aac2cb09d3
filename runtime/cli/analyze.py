"""The command `apc analyze`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.analysis.methods import AUTO, METHODS
from apc.cli.options import command, note_aside, option, picture_option, print_result
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.frame.parameter_names import Range

# Of peers that all differ, by the thousand: 100,000 took 9 s on one core of 2026.
SECONDS_A_PEER = 1e-4


@command
def analyze_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    method: str = option(
        "auto: what serves the topology. modes: a few small systems. dense: all peers in one, to check. "
        "determinant: zeros of a small determinant, for peers that all differ and for long delays. "
        "paper: the lifted matrices of Rakhsha and "
        "Constantinescu, eqs. (18) to (20).",
        "METHOD",
        type=click.Choice(METHODS),
        default=AUTO,
    ),
    certify: bool = option("Prove the verdict in ball arithmetic, for the numbers as doubles."),
    box: tuple[str, ...] = option(
        "Prove stability for every value within, over the network as it is, e.g. "
        '--box contact.stiffness=±1%, or --box "lan.delay=8 ms:20 ms", at every constant delay, and '
        "as it changes from packet to packet. "
        "May be repeated.",
        "PATH=±P%",
    ),
    cells: int | None = option(
        "Divide the box into so many cells at most before it is left undecided; without it, into as many as "
        "take some seconds.",
        "N",
        type=click.IntRange(min=1),
    ),
    every_convention: bool = option(
        "Repeat the analysis under every order of events that coincide.", name="--event-order"
    ),
    margins: bool | None = option(
        "Look for all margins, however long it takes, or for none: how far stiffnesses, dampings and delays "
        "may grow. Without either, for all in a topology where that takes a second or so.",
        name="--margins/--no-margins",
        default=None,
    ),
    nominal: bool = option(
        "Of a network that loses or delays packets, say all of the nominal one, too: modes, sensitivities, "
        "margins."
    ),
    with_limit_cycle: bool = option(
        "Predict how one-sided contacts buzz, and play the topology for up to 80 s to lay it beside.",
        name="--limit-cycle",
    ),
    hands: str,
    plot: Path | None = picture_option("Draw the eigenvalues over the unit circle: .png, .svg or .pdf."),
    as_json: bool,
) -> None:
    """Say whether a topology is stable, by how much, and in which modes.

    FILE is a topology or a compiled model. The spectral radius is per frame,
    the time after which all clocks stand as before; below 1 every motion
    dies out. A motion of all peers together, which nothing hinders, is left
    out of it and named. Beside the verdict stand what moves the radius most,
    how far each coupler and delay may grow, and for contacts that push and
    never pull, which of them make it unstable, and whether they may open and
    close at will.
    """
    from apc.analysis_report import answer
    from apc.frame.devices import HANDS, PASSIVE, published
    from apc.inputs import open_topology

    if cells is not None and not box and hands in (*HANDS, PASSIVE):  # hands of the library make a box
        raise click.UsageError("--cells wants a --box to divide")
    system = open_topology(file, settings, {"--plot": plot}, hands=hands, varied=box, notify=note_aside)
    if hands == PASSIVE:
        requested = {
            "--method": method != AUTO,
            "--event-order": every_convention,
            "--limit-cycle": with_limit_cycle,
        }
        requested |= {"--margins": bool(margins), "--plot": plot is not None}
        refused = [name for name, given in requested.items() if given]
        _absolute_stability(system, refused, box, certify=certify, as_json=as_json)
        return
    if hands not in HANDS:  # one of the library: all that were measured
        box = (*box, *(f"{name}={low}:{high}" for name, (low, high, _) in published(hands).items()))
    ranges = _ranges(system, box)
    listed = sum(group.count for group in system.groups if group.columns)
    with at_work(f"analysing {system.peers:,} peers", about=SECONDS_A_PEER * listed):
        result = answer(
            system,
            method=method,
            certify=certify,
            box=ranges,
            cells=cells,
            every_convention=every_convention,
            margins=margins,
            with_limit_cycle=with_limit_cycle,
        )
    result = replace(result, nominal=nominal)
    if plot is not None:
        from apc.output.pictures import write_picture

        write_picture(result.analysis.plot, plot)
    print_result(result, as_json=as_json, written=[plot])


def _ranges(system: Model, box: tuple[str, ...]) -> list[Range]:
    """Return the ranges of a box as they are written, and those that the topology gives."""
    from apc.analysis.parametric_frames import parse_range
    from apc.frame.parameter_names import given_ranges

    return given_ranges(system, [parse_range(system, text) for text in box])


def _absolute_stability(
    system: Model, requested: list[str], box: tuple[str, ...], *, certify: bool, as_json: bool
) -> None:
    """Say whether a topology is stable with any passive hands, at all delays if asked; refuse anything
    else.
    """
    from apc.haptics.absolute_stability import absolute_stability

    if requested:
        options = " and ".join((*requested, "--hands passive"))
        message = f"{options} don't go together: what hands can draw has no modes of its own"
        raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, hint="--hands clamped"))
    if ranges := _ranges(system, box):
        from apc.analysis_report import robust_stability

        print_result(robust_stability(system, ranges, passive=True), as_json=as_json)
        return
    print_result(absolute_stability(system, certify=certify), as_json=as_json)
