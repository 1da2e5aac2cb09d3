"""The command `sweep`: what it takes, what it prints, how it is interrupted.

Takes: words of a command line. Gives: the click command `sweep_command`.
Guarantees: with --json, stdout holds one JSON document and nothing else; progress goes to a terminal only;
an interruption ends with what is kept, and says so.
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
from apc.option_value import option_value


@command
def sweep_command(
    *,
    file: str | None,
    over: tuple[str, ...] = option(
        "Vary a parameter: PATH='LOW:HIGH', 'LOW:HIGH:COUNT', 'LOW:HIGH:COUNT:log' or 'V1,V2,V3', with "
        "units. May be repeated: every combination is computed, the last parameter turning fastest.",
        "PATH=VALUES",
        required=True,
    ),
    out: Path = option("Write the rows to this file, .parquet or .csv."),
    of: str = option("What to compute at each point; see below.", "WHAT", default="analyze"),
    criterion: str | None,
    hands: str,
    settings: tuple[str, ...],
    jobs: int | None = option("Processes to compute with; all cores by default.", type=WholeNumber(min=1)),
    cluster: str | None = option(
        "Compute on a running Dask cluster instead: its scheduler's address, tcp://HOST:8786.", "ADDRESS"
    ),
    patience: str | None = option(
        'End when nothing has come from processes or cluster for so long, such as "10 min"; wait for ever '
        "if not given.",
        '"TIME"',
    ),
    as_json: bool,
) -> None:
    """Compute a result at every combination of parameter values.

    FILE is a topology or a compiled model. What is finished is kept beside
    the target as it comes; a sweep that was stopped, however it was, is taken
    up by the same command.

    \b
        apc sweep --over contact.stiffness="100 N/m:3000 N/m:30" \\
                  --over links.lan.delay="0,8 ms" --out results.csv

    WHAT is "analyze" (verdict, spectral radius per frame with its error,
    rigid modes, frequency and damping of the leading mode) or
    "critical:PATH" (the value of another parameter at which the verdict
    changes, with its error).
    """
    from apc.inputs import open_topology
    from apc.processes import Patience
    from apc.sweeps.resumable_sweep import sweep
    from apc.tables import check_table_path

    check_table_path(out, "--out")
    waiting = Patience(_seconds(patience), lambda text: echo(text, err=True))
    values = _values(over)
    requested = criterion_with(hands, criterion)
    note_typical_hand(hands)
    system = open_topology(file, settings, {"--out": out}, hands=hands, varied=over, notify=note_aside)
    with _progress(out) as progress:
        result = sweep(
            system,
            values,
            of=of,
            criterion=requested,
            out=out,
            jobs=jobs,
            cluster=cluster,
            progress=progress,
            patience=waiting,
        )
    print_result(result, as_json=as_json, written=[out], before=None)


def _seconds(patience: str | None) -> float | None:
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
            raise ApcError(Diagnostic("E883", SourceLocation("sweep"), f"{name[:80]} is swept twice"))
        result[name] = values
    return result


@contextmanager
def _progress(out: Path) -> Iterator[Bar]:
    """Give a function that shows progress on a terminal; say what is kept if the body doesn't end well."""
    state = {"done": 0.0, "of": 0.0}
    try:
        with progress_bar("sweep", "points", after=0.0) as show:

            def progress(done: float, points: float) -> None:
                state.update(done=done, of=points)
                show(done, points)

            yield progress
    except BaseException:
        if state["done"] > 0 and not is_special(out):
            stored = f"{state['done']:,.0f} of {state['of']:,.0f} points are kept in {out}.parts"
            echo(f"{stored}; the same command takes up from there", err=True)
        raise
