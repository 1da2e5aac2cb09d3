"""The command `apc tune`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; how far the search is goes to a
terminal only.
Does not: compute.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.cli.options import (
    command,
    criterion_with,
    note_aside,
    note_typical_hand,
    option,
    picture_option,
    print_result,
)
from apc.cli.progress import status_line
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from apc.compiler.compiled import Model
    from apc.tuning.tuner import Tuning


@command
def tune_command(
    *,
    file: str | None,
    free: tuple[str, ...] = option(
        "A gain that may be chosen, and from where to where. Repeat it.", "PATH=LO:HI"
    ),
    maximize: str = option("What is to be as large as can be: a gain, or as for --minimize.", "AIM"),
    minimize: str = option(
        "What is to be as small as can be: a gain; settling_time or spectral_radius (the same gains); "
        '"coordination_error at 1 Hz", or impedance, transmitted_velocity; damping of slow motions; '
        "coordination_error_h2, the rms at the ticks for white forces of 1 N rms, "
        "coordination_error_hinf, the largest gain "
        "at any frequency; or a weighted sum in SI of gains and these, "
        '"damping - 0.01*coordination.stiffness".',
        "AIM",
    ),
    constraint: tuple[str, ...] = option(
        'Beside stability: "decay=60 dB in 2 s"; "impedance at 5 Hz < 20 N*s/m", or transmitted_velocity in '
        "m/s/N, coordination_error in m/N, damping, coordination_error_h2, coordination_error_hinf, or "
        "delay=changing: "
        "stable, too, where the delay of --over changes from packet to packet. May be repeated.",
        "DEMAND",
    ),
    tradeoff: str = option(
        "Weigh the aim against what a hand feels, impedance at 5 Hz: the best for each of 20 bounds "
        "(Pareto front).",
        "QUANTITY",
    ),
    over: tuple[str, ...] = option(
        "What the gains have to bear, all of it: user.count=2:10, device.mass=±20%, lan.loss=0:0.05, or "
        '"lan.delay=8 ms:20 ms", at every constant delay. May be repeated.',
        "PATH=LO:HI",
    ),
    hands: str,
    time: str = option("End after this long, with the best found and what is not proved of it.", '"TIME"'),
    settings: tuple[str, ...],
    write: Path | None = option("Write the topology with these gains in it, comments and all (.yaml)."),
    plot: Path | None = picture_option(
        "Draw two gains over the stable regions of what limits them and what a strike comes to, now and "
        "with the gains found; or with --tradeoff the front: .png, .svg or .pdf."
    ),
    as_json: bool,
) -> None:
    """Find the gains that do best, and prove that they do.

    The free gains are chosen so that an aim, as one of them, is as large (or
    small) as can be while the topology is stable in all that stands in --over.
    They are printed to four digits, and proved at these: in boxes, for every
    number of peers, over the network as it is. That no gains in these ranges
    do better by 2 % is proved where that is quick; the answer says so, and how
    many points were looked at. What is left out is as the topology's studies: tune: says.

    \b
        apc tune --free "coordination.stiffness=10 N/m:5000 N/m" \\
                 --free "coordination.damping=0 N*s/m:50 N*s/m" \\
                 --maximize coordination.stiffness \\
                 --over user.count=2:10 --over device.mass=±20%
    """
    from apc.frame.devices import FREE
    from apc.inputs import open_topology
    from apc.output.pictures import write_picture
    from apc.output.tuning_output import panels_of
    from apc.tuning.pareto_front import pareto_front
    from apc.tuning.specification import gripped_as_studied, read_seconds, read_tradeoff, read_tuning_spec
    from apc.tuning.tuner import tune

    note_typical_hand(hands)
    if write is not None and write.suffix not in (".yaml", ".yml"):
        message, got = "the name of a topology", write.suffix or write.name
        raise ApcError(
            Diagnostic(
                "E996",
                SourceLocation("--write"),
                message,
                ".yaml at its end",
                got,
                f"{write.stem}-tuned.yaml",
            )
        )
    if write is not None and tradeoff:
        raise click.UsageError("--write is of one design, and --tradeoff finds several")
    system = open_topology(
        file,
        settings,
        {"--write": write, "--plot": plot},
        hands=hands,
        varied=(*free, *over),
        notify=note_aside,
    )
    criterion = criterion_with(hands, None)
    if hands == FREE:
        system, criterion = gripped_as_studied(system)
    tuning_spec = read_tuning_spec(
        system,
        free,
        maximize=maximize,
        minimize=minimize,
        constraint=constraint,
        over=over,
        criterion=criterion,
    )
    if plot is not None and not tradeoff:  # what can't be drawn is refused before the search
        panels_of(system, len(tuning_spec.free))
    if tradeoff:
        with status_line() as progress:
            weighed = pareto_front(
                system, tuning_spec, read_tradeoff(tradeoff), seconds=read_seconds(time), progress=progress
            )
        if plot is not None:
            write_picture(weighed.plot, plot)
        print_result(weighed, as_json=as_json, written=[plot])
        return
    with status_line() as progress:
        tuning = tune(system, tuning_spec, seconds=read_seconds(time), progress=progress)
    refused: ApcError | None = None
    if write is not None and tuning.feasible:
        try:
            _write(system, tuning, settings, write)
        except ApcError as error:  # the gains are shown all the same
            refused = error
    if plot is not None:
        write_picture(tuning.plot, plot)
    written = write if tuning.feasible and refused is None else None
    print_result(tuning, as_json=as_json, written=[written, plot])
    if refused is not None:
        raise refused


def _write(system: Model, tuning: Tuning, settings: Sequence[str], path: Path) -> None:
    """Write the topology with the gains, and with what else was set."""
    from apc.app.yaml_edit import write_topology
    from apc.compiler.pipeline import compile_again
    from apc.compiler.wording import with_unit
    from apc.frame.overrides import parse_override
    from apc.frame.parameter_names import HELD, find

    as_written = compile_again(replace(system.origin, changes=()), path.parent)
    # The numbers of the hand of --hands held are of no topology.
    names = {setting.partition("=")[0].strip() for setting in settings} - set(HELD)
    names |= {parameter.name for parameter in as_written.parameters}
    values = {
        parse_override(as_written, setting).free: setting.partition("=")[2].strip()
        for setting in settings
        if setting.partition("=")[0].strip() in names
    }
    for gain in tuning.gains:
        number = f"{float(gain.value):.12g}"
        values[find(as_written, gain.parameter)] = with_unit(number, gain.unit).removesuffix(" 1")
    (text,) = (text for name, text in system.origin.texts if name == system.origin.topology)
    write_topology(path, text.decode(), as_written, values)
