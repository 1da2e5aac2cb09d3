"""The command `apc feel`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from apc.cli.options import (
    Command,
    WholeNumber,
    beside,
    file_argument,
    file_option,
    json_option,
    note_aside,
    print_result,
    set_option,
    tell,
)

# The options that --frequencies takes the place of, by parameter.
_SPANNED = {"low": "--from", "high": "--to", "points": "--points"}


@click.command("feel", cls=Command)
@file_argument
@set_option
@click.option(
    "--at",
    default="",
    metavar="PEER.PART",
    help="The device a hand holds: left[1].device, or an axis of it, left[1].device.x[2]. The first peer's.",
)
@click.option(
    "--between",
    default="",
    metavar="A:B",
    help="Two devices, push and arrival: left[1].device:right[1].device.",
)
@click.option(
    "--from", "low", default="0.1 Hz", show_default=True, metavar='"F Hz"', help="The lowest frequency."
)
@click.option("--to", "high", metavar='"F Hz"', help="The highest; 60 Hz, or half the fastest clock.")
@click.option(
    "--points", type=WholeNumber(2, 1_000_000), default=1000, show_default=True, help="How many between."
)
@click.option("--frequencies", metavar='"F Hz, …"', help='These instead: "1 Hz, 5 Hz".')
@click.option(
    "--unstable", is_flag=True, help="Of an unstable scene, which has no response in time, that of the map."
)
@click.option("--nyquist", is_flag=True, help="Draw Nyquist's plot, not Bode's.")
@file_option("--out", "Write a picture (.png .svg .pdf), a table (.csv .parquet) or .json.")
@json_option
@click.pass_context
def feel_command(
    context: click.Context,
    file: str | None,
    settings: tuple[str, ...],
    at: str,
    between: str,
    low: str,
    high: str | None,
    points: int,
    frequencies: str | None,
    unstable: bool,
    nyquist: bool,
    out: Path | None,
    as_json: bool,
) -> None:
    """Say what a hand feels at its device, frequency by frequency.

    The impedance (force by velocity, in N*s/m) at each frequency, all other
    hands as the scene has them; mass, damping and stiffness of slow motions;
    the velocity at another device and how far the copies of the object are
    apart, a newton (transparency); the largest gains at any frequency; what
    noise does. FILE is a topology
    or a compiled model.

    \b
        apc feel --at "user[1].device" --frequencies "1 Hz, 5 Hz"
        apc feel --from "0.1 Hz" --to "60 Hz" --out bode.svg
    """
    from apc.hands.asked import read_frequencies
    from apc.hands.feel import feel
    from apc.inputs import open_scene
    from apc.present.hands import write_feel
    from apc.present.pictures import FORMATS, check_result_path

    given = [name for name in _SPANNED if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    if frequencies is not None and given:
        named = " or ".join(_SPANNED[name] for name in given)
        raise click.UsageError(f"--frequencies names every frequency there is: no {named} with it")
    first, colon, second = between.partition(":")
    if between and not (first and colon and second and first != second):
        raise click.UsageError('--between names two hands: --between "left[1].device:right[1].device"')
    if at and colon and at != first:
        raise click.UsageError("--between A:B names the hand's device, A: no --at with it")
    if nyquist and (out is None or out.suffix.lower() not in FORMATS):
        raise click.UsageError(f"--nyquist is for a picture: --out with {', '.join(FORMATS)}")
    if out is not None:
        check_result_path(out)
    system = open_scene(file, settings, {"--out": out}, told=note_aside)
    found = feel(
        system,
        read_frequencies(system, frequencies, low, high, points),
        at=at or first if colon else at,
        between=second if colon else between,
        unstable=unstable,
    )
    if out is not None:
        write_feel(out, found, nyquist=nyquist)
    print_result(found, as_json=as_json, err=beside(out))
    if out is not None and not as_json:
        tell(f"\n{out} is written", err=beside(out))
