"""The command `simulate`: what it takes, what it prints, how it is interrupted.

Takes: words of a command line. Gives: the click command `simulate_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; progress goes to a terminal only;
Ctrl-C ends the run and keeps what is done.
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
    note_aside,
    option,
    picture_option,
    print_result,
    seed_option,
    tell,
)
from apc.cli.progress import progress_bar
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import partial_name
from apc.suffixes import check_suffix

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
    signals: tuple[str, ...] = option(
        "Record only what fits, such as cube.x, 'left[2].*' or '*.v'. May be repeated.", "PATTERN"
    ),
    out: Path | None = option(
        "Write the rows to this file: .csv, .parquet, .mat or .npz; or what moves: .gif, .mp4."
    ),
    plot: Path | None = picture_option("Draw them, a panel a quantity: .png, .svg or .pdf."),
    still: Path | None = picture_option(
        "Draw how it begins, the peers' bodies side by side: .png, .svg or .pdf."
    ),
    as_json: bool,
    no_jit: bool = option("Don't compile to machine code."),
    seed: int | None = seed_option("that get lost or come late"),
    runs: int | None = option(
        "Play it so often, with other packets each time, and say what that amounts to.",
        "NUMBER",
        type=WholeNumber(1, 10_000_000),
    ),
    jobs: int = option("Processes that share the runs.", "NUMBER", type=WholeNumber(1, 1024), default=1),
    method: str | None = option(
        "exact, rk4:STEP, semi-implicit:STEP or cvodes:RTOL; exact where linear and CVODES elsewhere if "
        "not given.",
        "METHOD",
    ),
    strike: str | None = option(
        'Strike a peer as it begins, such as "user[1]": its device starts at 0.1 m/s.', "PEER"
    ),
    trace_of: str | None = option(
        "Lose packets by the periodic pattern that analyze finds to shake the scene.",
        type=click.Choice(["worst"]),
    ),
    error: bool = option("Play it a second time, more closely, and say how far off it is."),
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
        apc simulate --out run.gif
        apc simulate --strike "user[1]" --plot run.png
        apc simulate --runs 1000 --seed 1 --jobs 4
        apc simulate --method semi-implicit:1ms --error
    """
    from apc.inputs import open_scene
    from apc.simulation.settings import DEFAULT, Settings, parse_method
    from apc.simulation.trajectory import duration_of, parse_duration

    if runs is not None and (signals or out or plot or error):
        raise click.UsageError("--runs keeps no rows: --signals, --out, --plot and --error are for one run")
    chosen = parse_method(method) if method is not None else DEFAULT
    asked = parse_duration(duration) if duration is not None else None
    if out is not None:
        _check_rows(out)
    system = open_scene(file, settings, {"--out": out, "--plot": plot, "--still": still}, notify=note_aside)
    if trace_of is not None:
        from apc.moments.worst import trace_of_worst

        system = trace_of_worst(system)
    if strike is not None:
        from apc.simulation.strike import WATCHED, impulse_text
        from apc.simulation.strike import strike as struck

        system, what = struck(system, strike)
        note_aside(impulse_text(what))
        asked = asked or system.experiment.duration or WATCHED
    seconds = duration_of(system, asked, runs=runs or 1)
    if still is not None:
        from apc.present.pictures import write_picture
        from apc.present.still import draw_actors

        write_picture(lambda: draw_actors(system)[0], still)
    how = Settings(seconds, chosen, seed, jit=not no_jit)
    if runs is not None:
        _play_many(system, how, runs, jobs, as_json=as_json)
    else:
        _play_one(system, how, _Kept(signals, out, plot, still, error), as_json=as_json)


@dataclass(frozen=True, slots=True)
class _Kept:
    """What is kept of a run: rows of which signals, a picture of them, and its error; `still` is drawn."""

    signals: tuple[str, ...]
    out: Path | None
    plot: Path | None
    still: Path | None
    error: bool


def _check_rows(out: Path) -> None:
    """Refuse a file that can't be written, before anything is computed."""
    from apc.present import animation
    from apc.present.pictures import FORMATS
    from apc.present.recording import SUFFIXES

    if out.suffix.lower() in FORMATS:
        what, known = "the suffix of --out", ", ".join((*SUFFIXES, *animation.SUFFIXES))
        hint = f"--plot {out}"
        raise ApcError(
            Diagnostic("E878", SourceLocation(str(out)), what, f"one of {known}", out.suffix, hint)
        )
    if check_suffix(out, (*SUFFIXES, *animation.SUFFIXES), "--out") in animation.SUFFIXES:
        animation.check_animation(out)


def _play_many(system: Model, how: Settings, runs: int, jobs: int, *, as_json: bool) -> None:
    """Play a scene many times and print what that amounts to."""
    from apc.simulation.ensemble import play_many

    with progress_bar("simulate", "runs") as show:
        many = play_many(
            system,
            how,
            runs=runs,
            jobs=jobs,
            progress=lambda done: show(done, runs),
        )
    print_result(many, as_json=as_json)
    if many.interrupted:
        raise click.Abort


def _play_one(system: Model, how: Settings, kept: _Kept, *, as_json: bool) -> None:
    """Play a scene once, keep what is wanted of it, and print what it amounts to."""
    from apc.simulation.accuracy import compare_with
    from apc.simulation.simulation import prepare
    from apc.simulation.trajectory import Keeper, SimulationReport, provenance_of, trajectory_of

    moving = None
    if kept.out is not None:
        from apc.present.animation import SUFFIXES, save_animation

        moving = kept.out if kept.out.suffix.lower() in SUFFIXES else None
    if moving is not None and kept.signals:
        raise click.UsageError(f"--signals chooses rows: a {moving.suffix} shows all that moves")
    simulation = prepare(system, how, signals=kept.signals)
    keeper = Keeper(simulation) if kept.plot is not None or moving is not None else None
    comparison = compare_with(simulation, signals=kept.signals) if kept.error else None
    sinks = [sink for sink in (keeper, comparison) if sink is not None]
    summary, interrupted, out = _play_into(simulation, kept.out if moving is None else None, sinks)
    estimate = comparison.estimate() if comparison is not None else None
    plot = kept.plot
    if moving is not None and keeper is not None:
        out = partial_name(moving) if interrupted else moving
        save_animation(system, trajectory_of(simulation, keeper, summary, interrupted), out)
    if plot is not None and keeper is not None:
        from apc.present.pictures import write_picture

        plot = partial_name(plot) if interrupted else plot
        write_picture(trajectory_of(simulation, keeper, summary, interrupted).plot, plot)
    played = SimulationReport(
        topology=system.name,
        summary=summary,
        provenance=provenance_of(simulation),
        interrupted=interrupted,
        error=estimate,
    )
    print_result(played, as_json=as_json, written=[out, plot, kept.still], before="  ")
    if interrupted:
        until = f"{summary.end:g} s of {float(how.duration):g} s"
        what = "what was done is kept" if out or not kept.out else f"{kept.out} was not begun"
        tell(f"stopped at {until}; {what}", err=True)
        raise click.Abort


def _play_into(
    simulation: Simulation, out: Path | None, sinks: Sequence[Sink]
) -> tuple[Summary, bool, Path | None]:
    """Play a simulation into sinks and a file, whose name is returned with what `play` returns.

    What was done is in the file even if the run can't go on.
    """
    from apc.present.recording import SUFFIXES, open_recording
    from apc.simulation.simulation import size_note
    from apc.simulation.trajectory import play

    recording = open_recording(out, simulation) if out is not None else None
    if out is not None and (
        note := size_note(simulation, decimal=check_suffix(out, SUFFIXES, "--out") == ".csv")
    ):
        tell(f"{out} {note}", err=True)
    total = float(simulation.settings.duration)
    try:
        with progress_bar("simulate", "s") as show:
            every = sinks if recording is None else [recording, *sinks]
            summary, interrupted = play(simulation, every, progress=lambda done: show(done, total))
        if recording is not None:
            recording.close(partial=interrupted)
    except ApcError:  # the run can't go on: what was done is kept
        if recording is not None:
            recording.close(partial=True)
            if recording.path != out:
                tell(f"{recording.path} holds what was done; {out} is as it was", err=True)
        raise
    except BaseException:
        if recording is not None:
            recording.discard()
        raise
    return summary, interrupted, recording.path if recording is not None and recording.rows else None
