"""The command `apc report`.

Takes: words of a command line. Gives: a page, or what differs from one.
Guarantees: a file that can't be written is refused before anything is computed, and is there whole or not at
all.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from apc.cli.options import argument, command, echo, option
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from apc.output.report_output import StoredPage, StoredTopology
    from apc.reports.contents import Report

MOST_LINES = 20  # of a page, that are reported one by one


@command
def report_command(
    *,
    files: tuple[str, ...] = argument(nargs=-1, metavar="[FILE...]"),
    settings: tuple[str, ...],
    out: Path | None = option("Write the page here: .html, or .pdf by Chromium."),
    check: Path | None = option("Compute the numbers of a report.html anew, and say what differs.", "REPORT"),
) -> None:
    """Gather all that is known of topologies in one page.

    One file that opens anywhere and loads nothing: the topology's picture and
    text, what was compiled, the verdict with its bound and proof, modes,
    margins, the stable region, what happens over time, how much may get lost,
    what a hand feels; beside each picture what the command says that makes it,
    and what versions and texts made it. Several FILEs stand side by side.

    \b
        apc report average.yaml mesh.yaml --out report.html
        apc report --check report.html
    """
    if (out is None) == (check is None):
        raise click.UsageError("--out FILE writes a report, --check REPORT reads one: one of them")
    if check is not None:
        if files or settings:
            raise click.UsageError("--check computes what the report itself says: no FILE or --set with it")
        _check(check)
        return
    assert out is not None
    from apc.inputs import check_topology_outputs, find_input, refuse_model
    from apc.output.report_output import check_report_path, save_report
    from apc.reports.contents import report

    check_report_path(out)
    paths = [Path(file) for file in files] or [find_input(compiled_too=False)]
    for path in paths:
        refuse_model(path, "report")
        check_topology_outputs(path, {"--out": out})
    with at_work("reporting"):
        result = report(paths, settings)
        save_report(result, out)
    echo(str(result))
    echo(f"\n{out} is written")


def _check(path: Path) -> None:
    """Compute a report anew. Raises ApcError (E991) with everything that differs."""
    import tempfile  # most commands need none

    from apc.output.report_output import damaged, read_page, topology_again
    from apc.reports.contents import report

    read = read_page(path)
    mistakes, notes = list[Diagnostic](), list[str]()
    with tempfile.TemporaryDirectory(prefix="apc-report-") as folder, at_work("reporting"):
        topologies = []
        for k, item in enumerate(read.stored["topologies"]):
            topologies.append(topology_again(item, Path(folder, str(k))))
        repeated = report(topologies, read.stored["topologies"][0]["settings"])
        lines = [*_lines_that_differ(path, read, repeated)]
    for item, now, topology in zip(
        read.stored["topologies"], repeated.to_dict()["topologies"], repeated.topologies, strict=True
    ):
        location = SourceLocation(f"{path}: {item['name'][:80]}")
        try:
            mistakes += [Diagnostic("E991", location, message) for message in _differs(item, now)]
        except (OverflowError, RecursionError):
            raise damaged(path) from None
        made, texts = dict(topology.origin), dict(item["texts"])
        changed = [name for name, digest in item["origin"] if made.get(name) != digest]
        mistakes += [
            Diagnostic("E991", location, f"the SHA-256 of {name[:80]} is not that of its text")
            for name in changed
            if name in texts
        ]
        notes += [
            f"{name} is another one than the report was made with" for name in changed if name not in texts
        ]
    was = read.stored["versions"]
    other = [(name, now) for name, now in repeated.versions if was.get(name) != now]
    notes += [f"{name} was {was.get(name, 'not there')}, and is {now} here" for name, now in other]
    for text in dict.fromkeys(notes):
        echo(f"note: {text}", err=True)
    if lines or mistakes:
        raise ApcError([*lines, *mistakes])
    echo(f"{path}: every number is the same, computed anew")


def _lines_that_differ(path: Path, read: StoredPage, repeated: Report) -> Iterator[Diagnostic]:
    """Yield what the page shows that it would not show if rendered from the report computed anew.

    Versions and digests are shown as the page holds them; where they differ here, a note says so.
    """
    from dataclasses import replace

    from apc.output.report_output import report_page, split_page
    from apc.reports.shown_lines import line_differences

    origins = [tuple((name, digest) for name, digest in item["origin"]) for item in read.stored["topologies"]]
    topologies = tuple(
        replace(topology, origin=local) for topology, local in zip(repeated.topologies, origins, strict=True)
    )
    versions = tuple(read.stored["versions"].items())
    expected, json = split_page(report_page(replace(repeated, topologies=topologies, versions=versions)))
    differences = [*line_differences(read.shown, expected, exact=json == read.json)]
    for each in differences[:MOST_LINES]:
        message = f"shows {each.shown!r}, but computed anew it is {each.expected!r}"
        yield Diagnostic("E991", SourceLocation(str(path), each.line, 1), message)
    if len(differences) > MOST_LINES:
        yield Diagnostic(
            "E991", SourceLocation(str(path)), f"{len(differences) - MOST_LINES:,} more lines differ"
        )


def _differs(stored_topology: StoredTopology, now: Mapping[str, Any]) -> Iterator[str]:
    """Yield what differs between the sections of a topology that a report keeps and those made anew."""
    from apc.output.report_output import TITLES
    from apc.reports.contents import differences

    for key in ("name", "description"):
        if stored_topology[key] != now[key]:
            yield f"{key} is {now[key]}, not {stored_topology[key]}"
    before = {item["key"]: item for item in stored_topology["sections"]}
    for section in now["sections"]:
        title, old = TITLES[section["key"]], before.get(section["key"])
        if old is None:
            yield f"{title} is not in it"
        elif old["refused"] != section["refused"]:
            yield f"{title}: {section['refused'] or 'there is one'}, not: {old['refused'] or 'there is one'}"
        else:
            yield from (f"{title}: {subject}" for subject in differences(old["results"], section["results"]))
