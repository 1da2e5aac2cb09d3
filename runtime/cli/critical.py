"""The command `apc critical`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; the progress is
printed on stderr.
Does not: compute.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.cli.options import (
    argument,
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
    from apc.compiler.compiled import Model
    from apc.tuning.tuner import Tuning

COMMAND = SourceLocation("apc critical")

# The suffixes of topologies and models.
TOPOLOGIES = (".yaml", ".yml", ".apc")


@command
def critical_command(
    *,
    path: str = argument(),
    file: str | None,
    settings: tuple[str, ...],
    upper: str | None = option("Upper end of the search.", '"VALUE UNIT"'),
    lower: str | None = option("Lower end of the search.", '"VALUE UNIT"'),
    over: tuple[str, ...] = option("Largest value stable over a range (repeatable).", "PATH=LO:HI"),
    criterion: str | None,
    hands: str,
    operating_point: str,
    plot: Path | None = picture_option("Plot the root locus (.png, .svg, .pdf)."),
    as_json: bool,
) -> None:
    """Compute the stability limits of a parameter.

    PATH is a stiffness, damping, mass, delay, period or number of peers:
    coordination.stiffness, left.device.mass, lan.delay, user.count. Limits are
    found up to a printed cell size, with error bounds and proof where possible.
    With --over user.count=2:10, the largest value stable for all numbers of
    users. FILE is a topology or a compiled model.
    """
    from apc.inputs.open_model import open_topology
    from apc.parameter_values.parameter_names import find, refuse_choices
    from apc.studies.critical_values import critical

    _check_order(path, file)
    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    if plot is not None and requested == "passive":
        message = "--plot is not available with --hands passive, which computes no eigenvalues"
        raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, fix="--hands clamped"))
    model = open_topology(
        file,
        settings,
        {"--plot": plot},
        hands=hands,
        operating_point=operating_point,
        varied=(path, *over),
        notify=note_aside,
    )
    refuse_choices(model, find(model, path, COMMAND, counts=True), COMMAND)
    if over:
        if plot is not None:
            raise click.UsageError("--plot can't be combined with --over")
        print_result(_largest_value_over(model, path, (lower, upper), over, requested), as_json=as_json)
        return
    with status_line() as progress:
        result = critical(model, path, lower=lower, upper=upper, criterion=requested, progress=progress)
    if plot is not None:
        from apc.output.pictures import write_picture

        write_picture(result.plot, plot)
    print_result(result, as_json=as_json, written=[plot])


def _largest_value_over(
    model: Model,
    path: str,
    ends: tuple[str | None, str | None],
    over: tuple[str, ...],
    criterion: str | None,
) -> Tuning:
    """Return the largest value that is stable for all operating conditions, as the tuning of one gain."""
    from apc.parameter_values.parameter_names import find, unit_of, value_now
    from apc.studies.margins import GROWTH
    from apc.studies.representative_delays import is_delay
    from apc.support.option_value import option_value
    from apc.tuning.specification import FREE, LOCATION, read_tuning_spec
    from apc.tuning.tuner import tune

    parameter_ref = find(model, path, COMMAND)
    if is_delay(model, parameter_ref):
        message = f"{path} is a delay and can't be searched with --over"
        raise ApcError(Diagnostic("E995", COMMAND, message, fix=f"apc critical {path}"))
    present, unit = value_now(model, parameter_ref), unit_of(model, parameter_ref.name)
    for end_option, end in zip(("--lower", "--upper"), ends, strict=True):
        if end is not None:
            option_value(end_option, end, subject=path, unit=unit)
    if not present and ends[1] is None:
        raise click.UsageError(f"{path} is 0, and needs an upper end: --upper")
    low, high = ends[0] or f"0 {unit}", ends[1] or f"{GROWTH * abs(present):.12g} {unit}"
    try:
        tuning_spec = read_tuning_spec(
            model, [f"{path}={low}:{high}"], maximize=path, over=over, criterion=criterion
        )
        with status_line() as progress:
            return tune(model, tuning_spec, progress=progress)
    except ApcError as error:
        # The options --free and --maximize are not those of this command.
        raise ApcError(
            replace(mistake, location=COMMAND, fix="" if mistake.location == FREE else mistake.fix)
            if mistake.location in (FREE, LOCATION)
            else mistake
            for mistake in error.mistakes
        ) from None


def _check_order(path: str, file: str | None) -> None:
    """Raise ApcError E841 for a topology instead of PATH: arguments exchanged, or PATH omitted."""
    if Path(path).suffix.lower() not in TOPOLOGIES:
        return
    got, name = f"{path}, then {file}", file
    if file is None or Path(file).suffix.lower() in TOPOLOGIES:  # then a name of the topology's own is shown
        from apc.inputs.open_model import open_topology
        from apc.studies.margins import coupler_parameters

        got = got if file else f"{path} alone"
        name = next(
            (parameter_ref.label for parameter_ref in coupler_parameters(open_topology(path, ()))), None
        )
    fix = f"apc critical {name} {path}" if name else ""
    requested = "PATH, then FILE"
    raise ApcError(Diagnostic("E841", COMMAND, "arguments", requested, got, fix))
