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
    interval: str | None = option("Time between packets.", '"VALUE UNIT"', show_default="from RECORDING"),
    out: Path | None = option("Write the delay of each packet as a table (.csv)."),
    as_json: bool,
) -> None:
    """Fit delay, jitter and loss of a link to a recorded network.

    RECORDING is the output of ping HOST > FILE or irtt client -o FILE.json
    HOST, or a table with a column "delay [ms]". Printed are loss, bursts,
    delays, and the entry of the link. The key trace of a link accepts the same
    files.

    \b
        irtt client -i 8ms -d 60s -o lan.json HOST
        apc network lan.json
    """
    from apc.compiler.files import write_text
    from apc.inputs.open_model import check_outputs
    from apc.network.link_fit import fit_recording
    from apc.support.option_value import option_value
    from apc.support.suffixes import check_suffix

    if out is not None:
        check_suffix(out, (".csv",), "--out")
        check_outputs(Path(recording), (), {"--out": out})
    between = None
    if interval is not None:
        between = float(option_value("--interval", interval, subject="a time", unit="s"))
        if between <= 0:
            expected, fix = "more than 0 s", '--interval "8 ms"'
            raise ApcError(
                Diagnostic("E207", SourceLocation("--interval"), "interval", expected, interval, fix)
            )
    network_recording = fit_recording(recording, between)
    if out is not None:
        from apc.output.network_output import recording_table

        write_text(out, recording_table(network_recording))
    print_result(network_recording, as_json=as_json, written=[out])
