"""The command `apc bench`.

Takes: words of a command line. Gives: text on stdout; exit code 1 when a hard case fails.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click

from apc.cli.options import command, echo, note_aside, option, picture_option, print_result
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.number_parsing import plain_float

HARD = Path("tests/hard")  # of a copy of the repository


@command
def bench_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    plot: Path | None = picture_option("Draw error against time: .png, .svg or .pdf."),
    counts: str | None = option(
        "Measure with these numbers of peers of one group instead: that of the largest written count. "
        "Not with --set or --plot.",
        "3,30,300",
        name="--scale",
    ),
    folder: Path | None = option(
        f"Analyse a folder of topologies whose truth is known instead ({HARD} if not given). "
        "Not with FILE, --set, --plot or --scale.",
        "[FOLDER]",
        name="--hard",
        is_flag=False,
        flag_value=HARD,
    ),
    as_json: bool,
) -> None:
    """Measure speed against error, on this topology and this machine.

    Every method of analysis and of simulation that can serve the topology is
    timed, and its error found: of a spectral radius against the same equations
    in 512-bit balls, to fifty digits; of a motion against the exact transition.
    A star marks those that none is better than in both. FILE is a topology or
    a compiled model. Fifty digits are had where what the topology falls into has
    at most 110 states (equal peers count once), and a true error of motion
    where all of it is linear between ticks; beyond, times and bounds stand
    without a true error.

    \b
        apc bench --plot bench.png
        apc bench --scale 3,30,300,3000
        apc bench --hard tests/hard
    """
    if folder is not None:
        if file or settings or plot or counts:
            raise click.UsageError(
                "--hard has topologies of its own: no FILE, --set, --plot or --scale with it"
            )
        _hard(folder, as_json)
        return
    from apc.inputs import find_input, open_topology

    if counts is not None:
        if settings or plot:
            raise click.UsageError("--scale compiles anew: no --set or --plot with it")
        _scale(find_input(file, compiled_too=False), counts, as_json)
        return
    from apc.benchmark.speed_and_error import bench

    system = open_topology(file, settings, {"--plot": plot}, notify=note_aside)
    with at_work("measuring"):
        result = bench(system)
    print_result(result, as_json=as_json)
    if plot is not None:  # what took minutes is printed already, should it be unable to be written
        from apc.output.bench_output import bench_picture
        from apc.output.pictures import write_picture

        write_picture(lambda: bench_picture(result), plot)
        if not as_json:
            echo(f"  {plot} is written")
    if result.faults:
        message = f"not everything came out right: {'; '.join(result.faults)}"
        raise ApcError(Diagnostic("E922", SourceLocation(result.topology), message))


def _hard(folder: Path, as_json: bool) -> None:
    """Report the hard cases; a failure is exit code 1."""
    from apc.benchmark.hard import run_hard_cases

    hard_report = run_hard_cases(folder)
    print_result(hard_report, as_json=as_json)
    if hard_report.failures:
        names = ", ".join(case.name for case in hard_report.failures)
        raise ApcError(
            Diagnostic("E922", SourceLocation(str(folder)), f"not every hard case came out right: {names}")
        )


def _scale(path: Path, counts: str, as_json: bool) -> None:
    """Report what more peers cost."""
    from apc.benchmark.scale import scale

    if path.suffix == ".apc":
        message = "is a compiled model, whose peers are counted"
        raise ApcError(
            Diagnostic(
                "E921", SourceLocation(str(path)), message, hint=f"apc bench {path.with_suffix('.yaml')}"
            )
        )
    try:
        numbers = [plain_float(text) for text in counts.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(number.is_integer() for number in numbers):
        expected = "numbers of peers like 3,30,300"
        raise ApcError(Diagnostic("E921", SourceLocation("--scale"), "the list", expected, counts[:80]))
    result = scale(path, [int(number) for number in numbers])
    print_result(result, as_json=as_json)
