"""The command `apc report`.

Takes: words of a command line. Gives: a page, or the differences from a page.
Guarantees: a file that can't be written is refused before anything is computed, and is written completely or
not at all.
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
    out: Path | None = option("Output file (.html, or .pdf with Chromium)."),
    check: Path | None = option("Recompute a report.html and list the differences.", "REPORT"),
) -> None:
    """Write a report of topologies as one page.

    The page is self-contained. It shows picture, text, verdict with proof,
    modes, margins, stability region, simulation, loss limits and impedance,
    each with the command that reproduces it. Several FILEs are shown in
    columns.

    \b
        apc report average.yaml mesh.yaml --out report.html
        apc report --check report.html
    """
    if (out is None) == (check is None):
        raise click.UsageError("one of --out FILE and --check REPORT is required")
    if check is not None:
        if files or settings:
            raise click.UsageError("--check can't be combined with FILE or --set")
        _check(check)
        return
    assert out is not None
    from apc.inputs.open_model import check_topology_outputs, find_input, refuse_model
    from apc.output.report_output import check_report_path, save_report
    from apc.reports.contents import report

    check_report_path(out)
    paths = [Path(file) for file in files] or [find_input(compiled_too=False)]
    for path in paths:
        refuse_model(path, "report")
        check_topology_outputs(path, {"--out": out})
    with at_work("writing the report"):
        result = report(paths, settings)
        save_report(result, out)
    echo(str(result))
    echo(f"\n{out} is written")


def _check(path: Path) -> None:
    """Recompute a report. Raises ApcError (E991) with all differences."""
    import tempfile  # most commands need none

    from apc.output.report_output import damaged, read_page, topology_again
    from apc.reports.contents import report

    read = read_page(path)
    mistakes, notes = list[Diagnostic](), list[str]()
    with tempfile.TemporaryDirectory(prefix="apc-report-") as folder, at_work("writing the report"):
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
            Diagnostic("E991", location, f"SHA-256 of {name[:80]} does not match its text")
            for name in changed
            if name in texts
        ]
        notes += [f"{name} has changed since the report was written" for name in changed if name not in texts]
    was = read.stored["versions"]
    other = [(name, now) for name, now in repeated.versions if was.get(name) != now]
    notes += [f"{name}: {was.get(name, 'none')} in the report, {now} here" for name, now in other]
    for text in dict.fromkeys(notes):
        echo(f"note: {text}", err=True)
    if lines or mistakes:
        raise ApcError([*lines, *mistakes])
    echo(f"{path}: all numbers reproduced")


def _lines_that_differ(path: Path, read: StoredPage, repeated: Report) -> Iterator[Diagnostic]:
    """Yield the lines of the page that differ from a page rendered from the recomputed report.

    Versions and digests are those of the page; a note is printed if they differ from the present ones.
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
        location = SourceLocation(str(path), each.line, 1)
        yield Diagnostic("E991", location, "line", repr(each.expected), repr(each.shown))
    if len(differences) > MOST_LINES:
        yield Diagnostic(
            "E991", SourceLocation(str(path)), f"{len(differences) - MOST_LINES:,} more lines differ"
        )


def _differs(stored_topology: StoredTopology, now: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences between stored and recomputed sections of a topology."""
    from apc.output.report_output import TITLES
    from apc.reports.contents import differences

    for key in ("name", "description"):
        if stored_topology[key] != now[key]:
            yield f"{key}: expected {now[key]}, got {stored_topology[key]}"
    before = {item["key"]: item for item in stored_topology["sections"]}
    for section in now["sections"]:
        title, old = TITLES[section["key"]], before.get(section["key"])
        if old is None:
            yield f"section {title} is missing"
        elif old["refused"] != section["refused"]:
            yield f"{title}: expected {section['refused'] or 'a result'}, got {old['refused'] or 'a result'}"
        else:
            yield from (f"{title}: {subject}" for subject in differences(old["results"], section["results"]))
