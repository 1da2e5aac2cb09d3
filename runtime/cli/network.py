"""The command `apc network`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

from apc.cli.options import argument, command, option, print_result
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation


@command
def network_command(
    *,
    recording: str = argument(),
    interval: str | None = option(
        "What lies between two packets, where RECORDING doesn't say.", '"VALUE UNIT"'
    ),
    out: Path | None = option("Write the delays as a table, a row a packet (.csv)."),
    as_json: bool,
) -> None:
    """Say what a recorded network amounts to, as a link's own keys.

    RECORDING is what `ping HOST > FILE` or `irtt client -o FILE.json HOST`
    wrote, or a table with a column `delay [ms]`. Told are the share of packets
    lost, whether losses come in bursts, delays and how they spread, and the
    entry of a link that says so. A link's `trace` takes the same files.

    \b
        irtt client -i 8ms -d 60s -o lan.json HOST
        apc network lan.json
    """
    from apc.compiler.files import write_text
    from apc.inputs import check_outputs
    from apc.network.link_fit import fit_recording
    from apc.option_value import option_value
    from apc.suffixes import check_suffix

    if out is not None:
        check_suffix(out, (".csv",), "--out")
        check_outputs(Path(recording), (), {"--out": out})
    between = None
    if interval is not None:
        between = float(option_value("--interval", interval, subject="a time", unit="s"))
        if between <= 0:
            expected, hint = "a time above 0", '--interval "8 ms"'
            raise ApcError(
                Diagnostic("E207", SourceLocation("--interval"), "the interval", expected, interval, hint)
            )
    network_recording = fit_recording(recording, between)
    if out is not None:
        from apc.output.network_output import recording_table

        write_text(out, recording_table(network_recording))
    print_result(network_recording, as_json=as_json, written=[out])
