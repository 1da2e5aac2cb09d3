"""The command `apc simulate`.

Takes: words of a command line. Gives: the click command `simulate_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; the progress is printed on stderr;
Ctrl-C ends the run; completed rows are stored.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.cli.options import (
    WholeNumber,
    command,
    echo,
    note_aside,
    option,
    picture_option,
    print_result,
    seed_option,
)
from apc.cli.progress import progress_bar
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import partial_name
from apc.support.suffixes import check_suffix

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.simulation.settings import Settings
    from apc.simulation.simulation import Simulation
    from apc.simulation.summary import Summary
    from apc.simulation.trajectory import Sink


@command
def simulate_command(
    *,
    file: str | None,
    duration: str | None,
    settings: tuple[str, ...],
    signals: tuple[str, ...] = option("Signals to record (repeatable).", "PATTERN", show_default="all"),
    out: Path | None = option("Output: .csv .parquet .mat .npz .gif .mp4."),
    plot: Path | None = picture_option("Plot the signals (.png, .svg, .pdf)."),
    snapshot: Path | None = picture_option("Draw the initial state (.png, .svg, .pdf)."),
    as_json: bool,
    no_jit: bool = option("Disable compilation to machine code."),
    seed: int | None = seed_option(),
    runs: int | None = option("Number of random runs.", "N", type=WholeNumber(1, 10_000_000)),
    jobs: int = option("Processes for --runs.", "N", type=WholeNumber(1, 1024), default=1),
    method: str | None = option(
        "Integration method, see above.",
        "METHOD",
        show_default="exact",
    ),
    impulse: str | None = option("Start the device of a peer at 0.1 m/s.", "PEER"),
    joins: tuple[str, ...] = option("Join of a peer (repeatable).", '"PEER=TIME"'),
    leaves: tuple[str, ...] = option("Leave of a peer (repeatable).", '"PEER=TIME"'),
    trace_of: str | None = option("Use the worst loss pattern of analyze.", type=click.Choice(["worst"])),
    error: bool = option("Estimate the error with a more accurate run."),
) -> None:
    """Simulate a topology in time.

    Linear dynamics follow the exact transition between events, without step
    size; CVODES integrates nonlinear dynamics. Each tick of the fastest clock
    gives one row, with the values before the tick. FILE is a topology or a
    compiled model.

    \b
    --method   exact, rk4:STEP, semi-implicit:STEP or cvodes:RTOL; by default
               exact, of nonlinear dynamics cvodes
    --signals  cube.x, 'left[2].*' or '*.v'

    \b
        apc simulate --duration "3 s" --plot run.png
        apc simulate --signals cube.x --out run.csv
        apc simulate --out run.gif
        apc simulate --impulse "user[1]" --plot run.png
        apc simulate --joins "user[3]=1 s" --leaves "user[1]=2 s"
        apc simulate --runs 1000 --seed 1 --jobs 4
        apc simulate --method semi-implicit:1ms --error
    """
    from apc.inputs.open_model import open_topology
    from apc.simulation.settings import DEFAULT, Settings, parse_method
    from apc.simulation.trajectory import duration_of, parse_duration

    if runs is not None and (signals or out or plot or error):
        raise click.UsageError("--runs can't be combined with --signals, --out, --plot or --error")
    chosen = parse_method(method) if method is not None else DEFAULT
    requested = parse_duration(duration) if duration is not None else None
    if out is not None:
        _check_rows(out)
    model = open_topology(
        file, settings, {"--out": out, "--plot": plot, "--snapshot": snapshot}, notify=note_aside
    )
    if trace_of is not None:
        from apc.support.extension_table import require_extension

        model = require_extension("loss_models").worst_trace(model)
    if joins or leaves:
        from apc.support.extension_table import require_extension

        model = require_extension("changing_counts").with_peer_times(model, joins, leaves)
    if impulse is not None:
        from apc.simulation.initial_velocity import WATCHED, impulse_text
        from apc.simulation.initial_velocity import initial_velocity as struck

        model, subject = struck(model, impulse)
        note_aside(impulse_text(subject))
        requested = requested or model.experiment.duration or WATCHED
    seconds = duration_of(model, requested, runs=runs or 1)
    if snapshot is not None:
        from apc.output.pictures import write_picture
        from apc.output.still_picture import draw_actors

        write_picture(lambda: draw_actors(model)[0], snapshot)
    how = Settings(seconds, chosen, seed, jit=not no_jit)
    if runs is not None:
        _simulate_many(model, how, runs, jobs, as_json=as_json)
    else:
        _simulate_single(model, how, _StoredRows(signals, out, plot, snapshot, error), as_json=as_json)


@dataclass(frozen=True, slots=True)
class _StoredRows:
    """The outputs of a run: rows of `signals`, a picture of them, its error, a `snapshot` of the start."""

    signals: tuple[str, ...]
    out: Path | None
    plot: Path | None
    snapshot: Path | None
    error: bool


def _check_rows(out: Path) -> None:
    """Refuse a file that can't be written, before anything is computed."""
    from apc.output import animation
    from apc.output.pictures import FORMATS
    from apc.output.recording import SUFFIXES

    if out.suffix.lower() in FORMATS:
        message, known = "suffix of --out", ", ".join((*SUFFIXES, *animation.SUFFIXES))
        fix = f"--plot {out}"
        raise ApcError(
            Diagnostic("E878", SourceLocation(str(out)), message, f"one of {known}", out.suffix, fix)
        )
    if check_suffix(out, (*SUFFIXES, *animation.SUFFIXES), "--out") in animation.SUFFIXES:
        animation.check_animation(out)


def _simulate_many(model: Model, how: Settings, runs: int, jobs: int, *, as_json: bool) -> None:
    """Simulate a topology many times and print the statistics."""
    from apc.simulation.monte_carlo import simulate_many

    with progress_bar("simulate", "runs") as show:
        many = simulate_many(
            model,
            how,
            runs=runs,
            jobs=jobs,
            progress=lambda done: show(done, runs),
        )
    print_result(many, as_json=as_json)
    if many.interrupted:
        raise click.Abort


def _simulate_single(model: Model, how: Settings, stored: _StoredRows, *, as_json: bool) -> None:
    """Simulate a topology once, store the requested rows, and print the summary."""
    from apc.simulation.accuracy import compare_with
    from apc.simulation.simulation import prepare
    from apc.simulation.trajectory import Keeper, SimulationReport, provenance_of, trajectory_of

    moving = None
    if stored.out is not None:
        from apc.output.animation import SUFFIXES, save_animation

        moving = stored.out if stored.out.suffix.lower() in SUFFIXES else None
    if moving is not None and stored.signals:
        raise click.UsageError(f"--signals can't be combined with an animation ({moving.suffix})")
    simulation = prepare(model, how, signals=stored.signals)
    if any(channel.loss or channel.jitter for link in model.links for channel in link.channels):
        note_aside(f"packet losses and delays are random, seed {simulation.seed}; statistics: --runs 100")
    keeper = Keeper(simulation) if stored.plot is not None or moving is not None else None
    comparison = compare_with(simulation, signals=stored.signals) if stored.error else None
    sinks = [sink for sink in (keeper, comparison) if sink is not None]
    summary, interrupted, out = _simulate_into(simulation, stored.out if moving is None else None, sinks)
    estimate = comparison.estimate() if comparison is not None else None
    plot = stored.plot
    if moving is not None and keeper is not None:
        out = partial_name(moving) if interrupted else moving
        save_animation(model, trajectory_of(simulation, keeper, summary, interrupted), out)
    if plot is not None and keeper is not None:
        from apc.output.pictures import write_picture

        plot = partial_name(plot) if interrupted else plot
        write_picture(trajectory_of(simulation, keeper, summary, interrupted).plot, plot)
    simulated = SimulationReport(
        topology=model.name,
        summary=summary,
        provenance=provenance_of(simulation),
        interrupted=interrupted,
        error=estimate,
    )
    print_result(simulated, as_json=as_json, written=[out, plot, stored.snapshot])
    if interrupted:
        until = f"{summary.end:g} s of {float(how.duration):g} s"
        message = "completed rows are stored" if out else "no rows are stored"
        echo(f"stopped at {until}; {message}", err=True)
        raise click.Abort


def _simulate_into(
    simulation: Simulation, out: Path | None, sinks: Sequence[Sink]
) -> tuple[Summary, bool, Path | None]:
    """Run a simulation into sinks and a file; return the result of `run_simulation` with the file's name.

    The file contains all completed rows even if the run fails.
    """
    from apc.output.recording import SUFFIXES, open_recording
    from apc.simulation.simulation import size_note
    from apc.simulation.trajectory import run_simulation

    recording = open_recording(out, simulation) if out is not None else None
    if out is not None and (
        note := size_note(simulation, decimal=check_suffix(out, SUFFIXES, "--out") == ".csv")
    ):
        echo(f"{out} {note}", err=True)
    total = float(simulation.settings.duration)
    try:
        with progress_bar("simulate", "s") as show:
            every = sinks if recording is None else [recording, *sinks]
            summary, interrupted = run_simulation(simulation, every, progress=lambda done: show(done, total))
        if recording is not None:
            recording.close(partial=interrupted)
    except ApcError:  # the completed rows are stored
        if recording is not None:
            recording.close(partial=True)
            if recording.path != out:
                echo(f"{recording.path} contains the completed rows; {out} is unchanged", err=True)
        raise
    except BaseException:
        if recording is not None:
            recording.discard()
        raise
    return summary, interrupted, recording.path if recording is not None and recording.rows else None
