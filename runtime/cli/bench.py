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
    plot: Path | None = picture_option("Plot error against time (.png, .svg, .pdf)."),
    counts: str | None = option("Measure with these numbers of peers.", "N1,N2,…", name="--scale"),
    folder: Path | None = option(
        "Analyze reference topologies.",
        "[FOLDER]",
        name="--hard",
        is_flag=False,
        flag_value=HARD,
    ),
    as_json: bool,
) -> None:
    """Measure the speed and accuracy of every method.

    Spectral radii are compared with 50 digits in ball arithmetic (up to 110
    states per decoupled subsystem), trajectories with the exact transition
    (linear dynamics). A star marks methods that no other method surpasses in
    both speed and accuracy. FILE is a topology or a compiled model.

    \b
        apc bench --plot bench.png
        apc bench --scale 3,30,300,3000
        apc bench --hard tests/hard
    """
    if folder is not None:
        if file or settings or plot or counts:
            raise click.UsageError("--hard can't be combined with FILE, --set, --plot or --scale")
        _hard(folder, as_json)
        return
    from apc.inputs.open_model import find_input, open_topology

    if counts is not None:
        if settings or plot:
            raise click.UsageError("--scale can't be combined with --set or --plot")
        _scale(find_input(file, compiled_too=False), counts, as_json)
        return
    from apc.benchmark.speed_and_error import bench

    model = open_topology(file, settings, {"--plot": plot}, notify=note_aside)
    with at_work("measuring"):
        result = bench(model)
    print_result(result, as_json=as_json)
    if plot is not None:  # after the result, which may take minutes, is printed
        from apc.output.bench_output import bench_picture
        from apc.output.pictures import write_picture

        write_picture(lambda: bench_picture(result), plot)
        if not as_json:
            echo(f"\n{plot} is written")
    if result.faults:
        message = f"incorrect results: {'; '.join(result.faults)}"
        raise ApcError(Diagnostic("E922", SourceLocation(result.topology), message))


def _hard(folder: Path, as_json: bool) -> None:
    """Print the results of the reference cases. Raises ApcError E922 for a failure."""
    from apc.benchmark.hard import run_hard_cases

    hard_report = run_hard_cases(folder)
    print_result(hard_report, as_json=as_json)
    if hard_report.failures:
        names = ", ".join(case.name for case in hard_report.failures)
        raise ApcError(Diagnostic("E922", SourceLocation(str(folder)), f"failed reference cases: {names}"))


def _scale(path: Path, counts: str, as_json: bool) -> None:
    """Print the computing time for several numbers of peers."""
    from apc.benchmark.scale import scale

    if path.suffix == ".apc":
        message = "compiled models have a fixed number of peers"
        raise ApcError(
            Diagnostic(
                "E921", SourceLocation(str(path)), message, fix=f"apc bench {path.with_suffix('.yaml')}"
            )
        )
    try:
        numbers = [plain_float(text) for text in counts.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(number.is_integer() for number in numbers):
        expected, fix = "whole numbers separated by commas", "--scale 3,30,300"
        raise ApcError(
            Diagnostic("E921", SourceLocation("--scale"), "numbers of peers", expected, counts[:80], fix)
        )
    result = scale(path, [int(number) for number in numbers])
    print_result(result, as_json=as_json)
