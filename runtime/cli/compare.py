"""The command `apc compare`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; a file that can't be written is
refused before anything is computed; how far the work is goes to a terminal only.
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
    over: tuple[str, ...] = option(
        "Which stiffness, delay or loss is looked at, where a topology has several. May be repeated; a "
        "topology "
        "takes those it has.",
        "PATH",
    ),
    settings: tuple[str, ...],
    criterion: str | None,
    hands: str,
    at: str = option(
        "The device whose hand feels: left[1].device, or an axis of it. The first peer's that has one.",
        "PEER.PART",
    ),
    out: Path | None = result_option(),
    as_json: bool,
) -> None:
    """Put schemes side by side: verdicts, limits, what is felt, costs.

    Of each FILE, a topology or a compiled model: the verdict and spectral
    radius of `apc analyze`; what `apc simulate` says of its experiment, if it
    is not linear and the verdict is that of its linearization; the largest
    stable stiffness of what couples it to others, and the delay and loss of
    the link that break it, as `apc critical` finds them; what the first
    peer's hand feels at 1 and 10 Hz, of `apc transparency`; how much a tick computes
    and how many numbers are sent. --set, --criterion and --hands hold for all files.
    (To lay the stable regions of topologies over each other: apc region
    --compare.)

    A folder NAME.run of `apc run` is laid beside what simulate and analyze
    say for the delays and losses that were measured.

    \b
        apc compare average.yaml mesh.yaml --set "lan.delay=16 ms" \\
                    --out schemes.svg
    """
    if len(files) == 1 and Path(files[0]).is_dir():
        _compare_run(Path(files[0]), as_json=as_json)
        return
    from apc.comparison.comparison import compare
    from apc.frame.devices import UNHELD, names_hand
    from apc.inputs import open_topology
    from apc.output.pictures import write_result

    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    systems, refused = [], {}
    for index, file in enumerate(files):
        try:
            system = open_topology(file, settings, {"--out": out}, hands=hands, notify=note_aside)
        except ApcError as error:
            if error.mistakes[0].code not in UNHELD:
                raise
            others = [text for text in settings if not names_hand(text)]
            system = open_topology(file, others, {"--out": out})
            refused[index] = error.mistakes[0].reason
        systems.append(system)
    with status_line() as progress:
        comparison = compare(
            systems, over=over, criterion=requested, at=at, refused=refused, progress=progress
        )
    if out is not None:
        write_result(out, comparison, comparison.plot)
    print_result(comparison, as_json=as_json, written=[out])


def _compare_run(folder: Path, *, as_json: bool) -> None:
    """Lay a run of `apc run` beside what is said of its topology."""
    from apc.realtime.run_comparison import compare_run
    from apc.realtime.run_folder import read_run

    print_result(compare_run(read_run(folder)), as_json=as_json)
