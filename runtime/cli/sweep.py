"""The command `apc sweep`.

Takes: words of a command line. Gives: the click command `sweep_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; the progress is printed on stderr;
after an interruption the number of stored points is printed.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from apc.cli.options import (
    WholeNumber,
    command,
    criterion_with,
    echo,
    note_aside,
    note_typical_hand,
    option,
    print_result,
)
from apc.cli.progress import Bar, progress_bar
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import is_special
from apc.support.option_value import option_value


@command
def sweep_command(
    *,
    file: str | None,
    over: tuple[str, ...] = option(
        "Values with units (repeatable).",
        "PATH=VALUES",
        required=True,
    ),
    out: Path = option("Output file (.parquet, .csv)."),
    of: str = option("analyze or critical:PATH.", "WHAT", default="analyze"),
    criterion: str | None,
    hands: str,
    settings: tuple[str, ...],
    jobs: int | None = option("Number of processes.", "N", type=WholeNumber(min=1), show_default="all cores"),
    cluster: str | None = option("Compute on a Dask cluster, tcp://HOST:8786.", "ADDRESS"),
    patience: str | None = option("Longest wait for a result.", '"TIME"', show_default="no limit"),
    as_json: bool,
) -> None:
    """Compute a result over a grid of parameter values.

    Every combination is computed; the last --over varies fastest. Finished
    points are stored next to the output file, and the same command resumes an
    interrupted sweep. analyze: verdict, spectral radius with error, rigid
    modes, frequency and damping of the dominant mode. critical:PATH: the
    stability limit of another parameter, with error.

    \b
    VALUES  LOW:HIGH, LOW:HIGH:COUNT, LOW:HIGH:COUNT:log or V1,V2,…

    \b
        apc sweep --over contact.stiffness="100 N/m:3000 N/m:30" \\
                  --over links.lan.delay="0,8 ms" --out results.csv
    """
    from apc.inputs.open_model import open_topology
    from apc.studies.resumable_sweep import sweep
    from apc.support.processes import Patience
    from apc.support.tables import check_table_path

    check_table_path(out, "--out")
    waiting = Patience(_seconds(patience), lambda text: echo(text, err=True))
    values = _values(over)
    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    model = open_topology(file, settings, {"--out": out}, hands=hands, varied=over, notify=note_aside)
    with _progress(out) as progress:
        result = sweep(
            model,
            values,
            of=of,
            criterion=requested,
            out=out,
            jobs=jobs,
            cluster=cluster,
            progress=progress,
            patience=waiting,
        )
    print_result(result, as_json=as_json, written=[out], names_files=True)


def _seconds(patience: str | None) -> float | None:
    """Return the time of `--patience` in seconds, None if it is not given. Raises ApcError E889."""
    if patience is None:
        return None
    value = float(option_value("--patience", patience, subject="patience", unit="s"))
    if value <= 0:
        form = '--patience "10 min"'
        raise ApcError(
            Diagnostic("E889", SourceLocation("sweep"), "--patience", "more than 0 s", patience[:80], form)
        )
    return value


def _values(over: tuple[str, ...]) -> dict[str, str]:
    """Return the values of each parameter by its name as written."""
    form = "--over contact.stiffness='100 N/m:3000 N/m:30'"
    result: dict[str, str] = {}
    for text in over:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not (equals and name and values):
            raise ApcError(
                Diagnostic("E880", SourceLocation("sweep"), "--over", "PATH=VALUES", text[:80], form)
            )
        if name in result:
            raise ApcError(Diagnostic("E883", SourceLocation("sweep"), f"--over {name[:80]} is given twice"))
        result[name] = values
    return result


@contextmanager
def _progress(out: Path) -> Iterator[Bar]:
    """Yield a function that shows the progress; after an exception print the number of stored points."""
    state = {"done": 0.0, "of": 0.0}
    try:
        with progress_bar("sweep", "points", after=0.0) as show:

            def progress(done: float, points: float) -> None:
                state.update(done=done, of=points)
                show(done, points)

            yield progress
    except BaseException:
        if state["done"] > 0 and not is_special(out):
            stored = f"{state['done']:,.0f} of {state['of']:,.0f} points are stored in {out}.parts"
            echo(f"{stored}; the same command resumes the sweep", err=True)
        raise
