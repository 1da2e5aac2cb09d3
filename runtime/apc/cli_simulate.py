"""The command `simulate`: what it takes, what it prints, how it is interrupted.

Takes: words of a command line. Gives: the click command `simulate_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; progress goes to a terminal only;
Ctrl-C ends the run and keeps what is done.
Does not: compute.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from apc.compiler.errors import ApcError
from apc.options import json_option, print_document, print_result, set_option

LONG = 1.0  # seconds of work after which progress is shown


@click.command("simulate")
@click.argument("file", required=False)
@click.option(
    "--duration",
    metavar='"TIME"',
    help='How long, such as "2 s"; that of the scene\'s experiment if not given.',
)
@set_option
@click.option(
    "--signals",
    multiple=True,
    metavar="PATTERN",
    help="Record only what fits, such as cube.x, 'left[2].*' or '*.v'. May be repeated.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the rows to this file: .csv, .parquet, .mat or .npz.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Draw them, a panel a quantity: .png, .svg or .pdf.",
)
@click.option(
    "--still",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Draw how it begins, the peers' bodies side by side: .png, .svg or .pdf.",
)
@json_option
@click.option("--no-jit", is_flag=True, help="Don't compile to machine code.")
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    metavar="NUMBER",
    help="Of packets that get lost or come late; the experiment's if not given.",
)
@click.option(
    "--runs",
    type=click.IntRange(1, 10_000_000),
    metavar="NUMBER",
    help="Play it so often, with other packets each time, and say what that amounts to.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 1024),
    default=1,
    show_default=True,
    metavar="NUMBER",
    help="Processes that share the runs.",
)
@click.option(
    "--method",
    metavar="METHOD",
    help="exact, rk4:STEP, semi-implicit:STEP or cvodes:RTOL; exact where linear and CVODES elsewhere if "
    "not given.",
)
@click.option("--error", is_flag=True, help="Play it a second time, more closely, and say how far off it is.")
def simulate_command(
    file: str | None,
    duration: str | None,
    settings: tuple[str, ...],
    signals: tuple[str, ...],
    out: Path | None,
    plot: Path | None,
    still: Path | None,
    as_json: bool,
    no_jit: bool,
    seed: int | None,
    runs: int | None,
    jobs: int,
    method: str | None,
    error: bool,
) -> None:
    """Play a scene in time.

    FILE is a topology or a compiled model. Devices move by their exact
    transition from event to event, forces are computed at their ticks,
    packets arrive when they are due; there is no step size. What is not
    linear between the ticks is integrated by CVODES. A row is written for
    every tick of the fastest clock, with the values before the tick.

    \b
        apc simulate --duration "3 s" --plot run.png
        apc simulate --signals cube.x --out run.csv
        apc simulate --runs 1000 --seed 1 --jobs 4
        apc simulate --method semi-implicit:1ms --error
    """
    from apc.inputs import open_scene
    from apc.runtime.simulate.accuracy import compare_with
    from apc.runtime.simulate.methods import DEFAULT, parse_method
    from apc.runtime.simulate.recording import open_recording
    from apc.runtime.simulate.simulation import prepare
    from apc.runtime.simulate.trajectory import (
        Keeper,
        duration_of,
        parse_duration,
        play,
        provenance_of,
        result_document,
        result_text,
        trajectory_of,
    )

    if runs is not None and (signals or out or plot or error):
        raise click.UsageError("--runs keeps no rows: --signals, --out, --plot and --error are for one run")
    chosen = parse_method(method) if method is not None else DEFAULT
    if plot is not None:
        from apc.runtime.simulate.figures import check_format

        check_format(plot)
    if still is not None:
        from apc.runtime.simulate.figures import check_format

        check_format(still, "--still")
    system = open_scene(file, settings)
    if still is not None:
        from apc.runtime.simulate.still import save_still

        save_still(system, still)
    seconds = duration_of(system, parse_duration(duration) if duration is not None else None)
    if runs is not None:
        from apc.runtime.simulate.ensemble import play_many

        with _progress(runs, "runs") as progress:
            many = play_many(
                system,
                seconds,
                runs=runs,
                seed=seed,
                jobs=jobs,
                jit=not no_jit,
                method=chosen,
                progress=progress,
            )
        print_result(many, as_json=as_json)
        if many.interrupted:
            raise click.Abort
        return
    simulation = prepare(system, seconds, signals=signals, jit=not no_jit, seed=seed, method=chosen)
    comparison = compare_with(simulation, signals=signals, jit=not no_jit) if error else None
    recording = open_recording(out, simulation) if out is not None else None
    try:
        keeper = Keeper(simulation) if plot is not None else None
        sinks = [sink for sink in (recording, keeper, comparison) if sink is not None]
        with _progress(float(seconds)) as progress:
            summary, interrupted = play(simulation, sinks, progress=progress)
        if recording is not None:
            recording.close()
    except ApcError:  # the run can't go on: what was done is kept
        if recording is not None:
            recording.close()
        raise
    except BaseException:
        if recording is not None:
            recording.discard()
        raise
    estimate = comparison.estimate() if comparison is not None else None
    if plot is not None and keeper is not None:
        from apc.runtime.simulate.figures import save

        save(trajectory_of(simulation, keeper, summary, interrupted), plot)
    if as_json:
        document = result_document(system.name, summary, provenance_of(simulation), interrupted, estimate)
        print_document(document)
    else:
        click.echo(result_text(system.name, summary, provenance_of(simulation), estimate))
        for written in (out, plot, still):
            if written is not None:
                click.echo(f"  {written} is written")
    if interrupted:
        click.echo(f"stopped at {summary.end:g} s of {float(seconds):g} s; what was done is kept", err=True)
        raise click.Abort


@contextmanager
def _progress(total: float, unit: str = "s") -> Iterator[Callable[[float], None]]:
    """Give a function that shows on a terminal how much is done, once the work takes long."""
    import time

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("simulate"),
        BarColumn(),
        TextColumn(f"{{task.completed:.4g}} of {{task.total:g}} {unit}"),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())
    task = bar.add_task("simulate", total=total)
    begun, shown = time.monotonic(), False

    def progress(done: float) -> None:
        nonlocal shown
        if not shown and time.monotonic() - begun > LONG:
            bar.start()
            shown = True
        bar.update(task, completed=done)

    try:
        yield progress
    finally:
        if shown:
            bar.stop()
