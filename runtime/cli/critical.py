"""The command `apc critical`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; how far the search is goes to a
terminal only.
Does not: compute.
"""

from __future__ import annotations

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

# What the name of a topology ends in.
TOPOLOGIES = (".yaml", ".yml", ".apc")


@command
def critical_command(
    *,
    path: str = argument(),
    file: str | None,
    settings: tuple[str, ...],
    upper: str | None = option("Look no further up than this.", '"VALUE UNIT"'),
    lower: str | None = option("Look no further down than this.", '"VALUE UNIT"'),
    over: tuple[str, ...] = option(
        "Find the largest value that is stable in all of this: user.count=2:10, device.mass=±20%, as for apc "
        "tune. May be repeated.",
        "PATH=LO:HI",
    ),
    criterion: str | None,
    hands: str,
    plot: Path | None = picture_option(
        "Draw where the eigenvalues go as it grows (root locus): .png, .svg or .pdf."
    ),
    as_json: bool,
) -> None:
    """Find the largest stable value of a parameter, with its error.

    PATH names a stiffness, damping, mass or delay, of one group or of all:
    coordination.stiffness, left.device.mass, lan.delay. The values at which
    the topology becomes stable or unstable are looked for, down to a cell size
    that is printed; each is proved where it can be, and on which side of it
    the topology is stable. FILE is a topology or a compiled model.
    """
    from apc.inputs import open_topology
    from apc.parameter_studies.critical_values import critical

    _check_order(path, file)
    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    if plot is not None and requested == "passive":
        message = "--plot and --hands passive don't go together: what hands can draw has no eigenvalues"
        raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, hint="--hands clamped"))
    system = open_topology(
        file, settings, {"--plot": plot}, hands=hands, varied=(path, *over), notify=note_aside
    )
    if over:
        if plot is not None:
            raise click.UsageError(
                "--plot and --over don't go together: there are as many loci as topologies"
            )
        print_result(_over(system, path, (lower, upper), over, requested), as_json=as_json)
        return
    with status_line() as progress:
        result = critical(system, path, lower=lower, upper=upper, criterion=requested, progress=progress)
    if plot is not None:
        from apc.output.pictures import write_picture

        write_picture(result.plot, plot)
    print_result(result, as_json=as_json, written=[plot])


def _over(
    system: Model,
    path: str,
    ends: tuple[str | None, str | None],
    over: tuple[str, ...],
    criterion: str | None,
) -> Tuning:
    """Return the largest value that is stable in all that is given: the best of one gain."""
    from apc.frame.parameter_names import find, unit_of, value_now
    from apc.parameter_studies.margins import GROWTH
    from apc.tuning.specification import read_tuning_spec
    from apc.tuning.tuner import tune

    free = find(system, path, SourceLocation("critical value"))
    present, unit = value_now(system, free), unit_of(system, free.name)
    if not present and ends[1] is None:
        raise click.UsageError(f"{path} is 0 now, which says nothing of how large it may be: give --upper")
    low, high = ends[0] or f"0 {unit}", ends[1] or f"{GROWTH * abs(present):.12g} {unit}"
    tuning_spec = read_tuning_spec(
        system, [f"{path}={low}:{high}"], maximize=path, over=over, criterion=criterion
    )
    with status_line() as progress:
        return tune(system, tuning_spec, progress=progress)


def _check_order(path: str, file: str | None) -> None:
    """Refuse a topology where the parameter belongs: the two were exchanged, or only one was given."""
    if Path(path).suffix.lower() not in TOPOLOGIES:
        return
    got, name = f"{path}, then {file}", file
    if file is None or Path(file).suffix.lower() in TOPOLOGIES:  # then a name of the topology's own is shown
        from apc.inputs import open_topology
        from apc.parameter_studies.margins import coupler_parameters

        got = got if file else f"{path} alone"
        name = next((free.label for free in coupler_parameters(open_topology(path, ()))), None)
    hint = f"apc critical {name} {path}" if name else ""
    requested = "a parameter or delay, then the topology"
    raise ApcError(Diagnostic("E841", SourceLocation("apc critical"), "the command", requested, got, hint))
