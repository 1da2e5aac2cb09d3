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

# The options that --frequencies replaces, by parameter.
_SPANNED = {"low": "--from", "high": "--to", "points": "--points"}


@command
def transparency_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    operating_point: str,
    at: str = option("Device, or an axis of it.", "PEER.PART", show_default="first device"),
    between: str = option("Device of the force and device of the velocity.", "A:B"),
    low: str = option("Lowest frequency.", '"F Hz"', name="--from", default="0.1 Hz"),
    high: str | None = option("Highest frequency.", '"F Hz"', name="--to", show_default="60 Hz or Nyquist"),
    points: int = option("Number of frequencies.", "N", type=WholeNumber(2, 1_000_000), default=1000),
    frequencies: str | None = option("List of frequencies, e.g. 1 Hz, 5 Hz.", '"F Hz, …"'),
    unstable: bool = option("Evaluate an unstable topology."),
    nyquist: bool = option("Draw a Nyquist plot instead of a Bode plot."),
    out: Path | None = result_option(),
    as_json: bool,
) -> None:
    """Compute the impedance and the transmitted velocity.

    Impedance (force/velocity) at each frequency; effective mass, damping and
    stiffness at low frequency; transmitted velocity and coordination error per
    newton; H-infinity and H2 norms at the ticks. The other hands are those of
    the topology. FILE is a topology or a compiled model.

    \b
        apc transparency --at "user[1].device" --frequencies "1 Hz, 5 Hz"
        apc transparency --at "left[1].device.x[2]"
        apc transparency --from "0.1 Hz" --to "60 Hz" --out bode.svg
    """
    from apc.haptics.device_port import read_frequencies
    from apc.haptics.frequency_response import transparency
    from apc.inputs.open_model import open_topology
    from apc.lifting.numeric_model import numeric_model
    from apc.output.pictures import FORMATS, write_result

    context = click.get_current_context()
    given = [name for name in _SPANNED if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    if frequencies is not None and given:
        named = " or ".join(_SPANNED[name] for name in given)
        raise click.UsageError(f"--frequencies can't be combined with {named}")
    first, colon, second = between.partition(":")
    if between and not (first and colon and second and first != second):
        raise click.UsageError('--between requires two devices: "left[1].device:right[1].device"')
    if at and colon and at != first:
        raise click.UsageError("--at can't be combined with another device A of --between A:B")
    if nyquist and (out is None or out.suffix.lower() not in FORMATS):
        raise click.UsageError(f"--nyquist requires --out with {', '.join(FORMATS)}")
    model = open_topology(file, settings, {"--out": out}, operating_point=operating_point, notify=note_aside)
    with at_work(f"computing the impedance for {counted(model.peers, 'peer')}"):
        hertz = read_frequencies(model, frequencies, low, high, points)
        result = transparency(
            numeric_model(model),
            hertz,
            at=at or first if colon else at,
            between=second if colon else between,
            unstable=unstable,
        )
    if out is not None:
        write_result(out, result, lambda: result.plot(kind="nyquist" if nyquist else "bode"))
    print_result(result, as_json=as_json, written=[out])
