"""The command `apc compare`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed; the progress is printed on stderr.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

from apc.cli.options import (
    argument,
    command,
    criterion_with,
    note_aside,
    note_typical_hand,
    option,
    print_result,
    result_option,
)
from apc.cli.progress import status_line
from apc.compiler.errors import ApcError


@command
def compare_command(
    *,
    files: tuple[str, ...] = argument(nargs=-1, required=True, metavar="FILE..."),
    over: tuple[str, ...] = option("Stiffness, delay or loss to vary (repeatable).", "PATH"),
    settings: tuple[str, ...],
    criterion: str | None,
    hands: str,
    at: str = option("Device of the impedance.", "PEER.PART", show_default="first device"),
    out: Path | None = result_option(),
    as_json: bool,
) -> None:
    """Compare verdicts, limits, impedance and cost.

    The limits are those of the coupling stiffness, delay and packet loss. The
    impedance is that of the first peer's device at 1 and 10 Hz. --set,
    --criterion and --hands apply to every FILE, a topology or a compiled model.
    --over names the varied parameters where there are several. For stability
    regions in one picture use apc region --compare.

    A folder NAME.run of apc run is compared with simulation and analysis.

    \b
        apc compare average.yaml mesh.yaml --set "lan.delay=16 ms" \\
                    --out schemes.svg
    """
    if len(files) == 1 and Path(files[0]).is_dir():
        _compare_run(Path(files[0]), as_json=as_json)
        return
    from apc.inputs.open_model import open_topology
    from apc.lifting.devices import UNHELD, names_hand
    from apc.output.pictures import write_result
    from apc.studies.comparison import compare

    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    systems, refused = [], {}
    for index, file in enumerate(files):
        try:
            model = open_topology(file, settings, {"--out": out}, hands=hands, notify=note_aside)
        except ApcError as error:
            if error.mistakes[0].code not in UNHELD:
                raise
            others = [text for text in settings if not names_hand(text)]
            model = open_topology(file, others, {"--out": out})
            refused[index] = error.mistakes[0].reason
        systems.append(model)
    with status_line() as progress:
        comparison = compare(
            systems, over=over, criterion=requested, at=at, refused=refused, progress=progress
        )
    if out is not None:
        write_result(out, comparison, comparison.plot)
    print_result(comparison, as_json=as_json, written=[out])


def _compare_run(folder: Path, *, as_json: bool) -> None:
    """Print the comparison of a real-time run with simulation and analysis."""
    from apc.realtime.run_comparison import compare_run
    from apc.realtime.run_folder import read_run

    print_result(compare_run(read_run(folder)), as_json=as_json)
