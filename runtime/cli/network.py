"""The command `apc network`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click

from apc.cli.options import Command, beside, file_option, json_option, print_result, tell
from apc.compiler.errors import ApcError, Mistake, Place


@click.command("network", cls=Command)
@click.argument("recording")
@click.option(
    "--interval", metavar='"VALUE UNIT"', help="What lies between two packets, where RECORDING doesn't say."
)
@file_option("--out", "Write the delays as a table, a row a packet (.csv).")
@json_option
def network_command(recording: str, interval: str | None, out: Path | None, as_json: bool) -> None:
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
    from apc.network.recorded import describe
    from apc.option_value import option_value
    from apc.suffixes import check_suffix

    if out is not None:
        check_suffix(out, (".csv",), "--out")
        check_outputs(Path(recording), (), {"--out": out})
    between = None
    if interval is not None:
        between = float(option_value("--interval", interval, what="a time", unit="s"))
        if between <= 0:
            expected, hint = "a time above 0", '--interval "8 ms"'
            raise ApcError(Mistake("E207", Place("--interval"), "the interval", expected, interval, hint))
    found = describe(recording, between)
    if out is not None:
        from apc.present.recorded_network import recording_table

        write_text(out, recording_table(found))
    print_result(found, as_json=as_json, err=beside(out))
    if out is not None and not as_json:
        tell(f"\n{out} is written", err=beside(out))
