"""The command `apc transparency`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from apc.cli.options import WholeNumber, command, note_aside, option, print_result, result_option
from apc.cli.progress import at_work
from apc.compiler.wording import counted

# The options that --frequencies takes the place of, by parameter.
_SPANNED = {"low": "--from", "high": "--to", "points": "--points"}


@command
def transparency_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    at: str = option(
        "The device a hand holds: left[1].device, or an axis of it, left[1].device.x[2]. The first peer's.",
        "PEER.PART",
    ),
    between: str = option("Two devices, push and arrival: left[1].device:right[1].device.", "A:B"),
    low: str = option("The lowest frequency.", '"F Hz"', name="--from", default="0.1 Hz"),
    high: str | None = option("The highest; 60 Hz, or half the fastest clock.", '"F Hz"', name="--to"),
    points: int = option("How many between.", type=WholeNumber(2, 1_000_000), default=1000),
    frequencies: str | None = option('These instead: "1 Hz, 5 Hz".', '"F Hz, …"'),
    unstable: bool = option("Of an unstable topology, which has no response in time, that of the map."),
    nyquist: bool = option("Draw Nyquist's plot, not Bode's."),
    out: Path | None = result_option(),
    as_json: bool,
) -> None:
    """Say what a hand feels at its device, frequency by frequency.

    The impedance (force by velocity, in N*s/m) at each frequency, all other
    hands as the topology has them; mass, damping and stiffness of slow motions;
    the velocity at another device and how far the copies of the object are
    apart, a newton (transparency); the largest gains at any frequency; the rms
    caused by white noise, at the ticks (motion between ticks is not included).
    FILE is a topology or a compiled model.

    \b
        apc transparency --at "user[1].device" --frequencies "1 Hz, 5 Hz"
        apc transparency --from "0.1 Hz" --to "60 Hz" --out bode.svg
    """
    from apc.haptics.device_port import read_frequencies
    from apc.haptics.frequency_response import transparency
    from apc.inputs import open_topology
    from apc.output.pictures import FORMATS, write_result

    context = click.get_current_context()
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
    system = open_topology(file, settings, {"--out": out}, notify=note_aside)
    with at_work(f"what hands feel of {counted(system.peers, 'peer')}"):
        result = transparency(
            system,
            read_frequencies(system, frequencies, low, high, points),
            at=at or first if colon else at,
            between=second if colon else between,
            unstable=unstable,
        )
    if out is not None:
        write_result(out, result, lambda: result.plot(kind="nyquist" if nyquist else "bode"))
    print_result(result, as_json=as_json, written=[out])
