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
    note_usual,
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
        '"feel.error at 1 Hz", or feel.impedance, feel.transmitted; feel.damping of slow motions; '
        "feel.error_h2, the rms at the ticks for white forces of 1 N rms, feel.error_hinf, the largest gain "
        "at any frequency; or a weighted sum in SI of gains and these, "
        '"feel.damping - 0.01*coordination.stiffness".',
        "AIM",
    ),
    subject: tuple[str, ...] = option(
        'Beside stability: "decay=60 dB in 2 s"; "feel.impedance at 5 Hz < 20 N*s/m", or feel.transmitted in '
        "m/s/N, feel.error in m/N, feel.damping, feel.error_h2, feel.error_hinf, or delay=changing: "
        "stable, too, where the delay of --over changes from packet to packet. May be repeated.",
        "DEMAND",
    ),
    against: str = option(
        "Weigh the aim against what a hand feels, feel.impedance at 5 Hz: the best for each of 20 bounds "
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
        "with the gains found; or with --against the front: .png, .svg or .pdf."
    ),
    as_json: bool,
) -> None:
    """Find the gains that do best, and prove that they do.

    The free gains are chosen so that an aim, as one of them, is as large (or
    small) as can be while the scene is stable in all that stands in --over.
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
    from apc.inputs import open_scene
    from apc.present.pictures import write_picture
    from apc.present.tuning_output import panels_of
    from apc.tuning.demands import held_as_studied, read_against, read_demands, read_seconds
    from apc.tuning.front import front
    from apc.tuning.tuner import tune

    note_usual(hands)
    if write is not None and write.suffix not in (".yaml", ".yml"):
        what, got = "the name of a topology", write.suffix or write.name
        raise ApcError(
            Diagnostic(
                "E996", SourceLocation("--write"), what, ".yaml at its end", got, f"{write.stem}-tuned.yaml"
            )
        )
    if write is not None and against:
        raise click.UsageError("--write is of one design, and --against finds several")
    system = open_scene(
        file,
        settings,
        {"--write": write, "--plot": plot},
        hands=hands,
        varied=(*free, *over),
        notify=note_aside,
    )
    criterion = criterion_with(hands, None)
    if hands == FREE:
        system, criterion = held_as_studied(system)
    demands = read_demands(
        system,
        free,
        maximize=maximize,
        minimize=minimize,
        subject=subject,
        over=over,
        criterion=criterion,
    )
    if plot is not None and not against:  # what can't be drawn is refused before the search
        panels_of(system, len(demands.free))
    if against:
        with status_line() as progress:
            weighed = front(
                system, demands, read_against(against), seconds=read_seconds(time), progress=progress
            )
        if plot is not None:
            write_picture(weighed.plot, plot)
        print_result(weighed, as_json=as_json, written=[plot])
        return
    with status_line() as progress:
        tuning = tune(system, demands, seconds=read_seconds(time), progress=progress)
    refused: ApcError | None = None
    if write is not None and tuning.met:
        try:
            _write(system, tuning, settings, write)
        except ApcError as error:  # the gains are shown all the same
            refused = error
    if plot is not None:
        write_picture(tuning.plot, plot)
    written = write if tuning.met and refused is None else None
    print_result(tuning, as_json=as_json, written=[written, plot])
    if refused is not None:
        raise refused


def _write(system: Model, tuning: Tuning, settings: Sequence[str], path: Path) -> None:
    """Write the topology with the gains, and with what else was set."""
    from apc.compiler.pipeline import compile_again
    from apc.compiler.words import with_unit
    from apc.explore.written import write_topology
    from apc.frame.names import HELD, find
    from apc.frame.overrides import parse_override

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
