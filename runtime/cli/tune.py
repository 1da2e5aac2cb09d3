"""The command `apc tune`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; the progress is
printed on stderr.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

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
from apc.cli.topology_writing import check_topology_name, write_values
from apc.compiler.errors import ApcError


@contextmanager
def _without_criterion() -> Iterator[None]:
    """Replace the fix of E898, which is for other commands, by advice."""
    try:
        yield
    except ApcError as error:
        raise ApcError(
            replace(mistake, fix="", advice="tune without losses and jitter")
            if mistake.code == "E898" and mistake.fix
            else mistake
            for mistake in error.mistakes
        ) from None


@command
def tune_command(
    *,
    file: str | None,
    free: tuple[str, ...] = option("Gain to tune, with its range (repeatable).", "PATH=LO:HI"),
    maximize: str = option("Objective to maximize.", "OBJECTIVE"),
    minimize: str = option("Objective to minimize.", "OBJECTIVE"),
    constraint: tuple[str, ...] = option("Further requirement (repeatable).", "CONSTRAINT"),
    tradeoff: str = option("Compute a Pareto front against a quantity.", "QUANTITY"),
    over: tuple[str, ...] = option("Operating range (repeatable).", "PATH=LO:HI"),
    hands: str,
    operating_point: str,
    time: str = option("Time limit of the search.", '"TIME"', show_default="no limit"),
    settings: tuple[str, ...],
    write: Path | None = option("Write the tuned topology (.yaml)."),
    plot: Path | None = picture_option("Plot region and response (.png, .svg, .pdf)."),
    as_json: bool,
) -> None:
    """Tune gains for an objective, with a proof of stability.

    The gains are stable for all values of --over, and printed and proved with
    four digits. Global optimality within 2 % is proved where that is fast.
    Omitted options are taken from studies: tune: of the topology.

    \b
    OBJECTIVE   a gain, settling_time, spectral_radius, "impedance at 5 Hz",
                "transmitted_velocity at 5 Hz", "coordination_error at 1 Hz",
                damping, coordination_error_h2, coordination_error_hinf, or a
                weighted sum, "damping - 0.01*coordination.stiffness"
    CONSTRAINT  "decay=60 dB in 2 s", "impedance at 5 Hz < 20 N*s/m" or another
                of these quantities, delay=changing (delays that vary in time)
    --over      user.count=2:10, device.mass=±20%, lan.loss=0:0.05
    --tradeoff  one of these quantities, e.g. "impedance at 5 Hz"

    \b
        apc tune --free "coordination.stiffness=10 N/m:5000 N/m" \\
                 --free "coordination.damping=0 N*s/m:50 N*s/m" \\
                 --maximize coordination.stiffness \\
                 --over user.count=2:10 --over device.mass=±20%
    """
    from apc.inputs.open_model import open_topology
    from apc.lifting.devices import FREE
    from apc.lifting.rest_position import linearized_at
    from apc.output.pictures import write_picture
    from apc.output.tuning_output import panels_of
    from apc.support.extension_table import require_extension
    from apc.tuning.specification import gripped_as_studied, read_seconds, read_tradeoff, read_tuning_spec
    from apc.tuning.tuner import tune

    note_typical_hand(hands)
    check_topology_name(write, "tuned")
    if write is not None and tradeoff:
        raise click.UsageError("--write can't be combined with --tradeoff")
    model = open_topology(
        file,
        settings,
        {"--write": write, "--plot": plot},
        hands=hands,
        varied=(*free, *over),
        notify=note_aside,
    )
    criterion = criterion_with(hands, None)
    if hands == FREE:
        model, criterion = gripped_as_studied(model)
    model = linearized_at(model, operating_point)  # with the hands of the study
    tuning_spec = read_tuning_spec(
        model,
        free,
        maximize=maximize,
        minimize=minimize,
        constraint=constraint,
        over=over,
        criterion=criterion,
    )
    if plot is not None and not tradeoff:  # an impossible picture is refused before the search
        panels_of(model, len(tuning_spec.free))
    if tradeoff:
        with status_line() as progress, _without_criterion():
            weighed = require_extension("pareto_front").pareto_front(
                model, tuning_spec, read_tradeoff(tradeoff), seconds=read_seconds(time), progress=progress
            )
        if plot is not None:
            write_picture(weighed.plot, plot)
        print_result(weighed, as_json=as_json, written=[plot])
        return
    with status_line() as progress, _without_criterion():
        tuning = tune(model, tuning_spec, seconds=read_seconds(time), progress=progress)
    refused: ApcError | None = None
    if write is not None and tuning.feasible:
        try:
            values = {gain.parameter: (float(gain.value), gain.unit) for gain in tuning.gains}
            write_values(model, values, settings, write)
        except ApcError as error:  # the gains are shown all the same
            refused = error
    if plot is not None:
        write_picture(tuning.plot, plot)
    written = write if tuning.feasible and refused is None else None
    print_result(tuning, as_json=as_json, written=[written, plot])
    if refused is not None:
        raise refused
