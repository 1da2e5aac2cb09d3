"""The command `apc report`.

Takes: words of a command line. Gives: a page, or what differs from one.
Guarantees: a file that can't be written is refused before anything is computed, and is there whole or not at
all.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.cli.options import argument, command, option, tell
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Mistake, Place

if TYPE_CHECKING:
    from apc.present.report_output import KeptScene
    from apc.reports.contents import Report


@command
def report_command(
    *,
    files: tuple[str, ...] = argument(nargs=-1, metavar="[FILE...]"),
    settings: tuple[str, ...],
    out: Path | None = option("Write the page here: .html, or .pdf by Chromium."),
    check: Path | None = option("Compute the numbers of a report.html anew, and say what differs.", "REPORT"),
) -> None:
    """Gather all that is known of scenes in one page.

    One file that opens anywhere and loads nothing: the scene's picture and
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
    from apc.present.report_output import check_report_path, save_report
    from apc.reports.contents import report

    check_report_path(out)
    paths = [Path(file) for file in files] or [find_input(compiled_too=False)]
    for path in paths:
        refuse_model(path, "report")
        check_topology_outputs(path, {"--out": out})
    with at_work("reporting"):
        result = report(paths, settings)
        save_report(result, out)
    tell(str(result))
    tell(f"\n{out} is written")


def _check(path: Path) -> None:
    """Compute a report anew. Raises ApcError (E991) with everything that differs."""
    import tempfile  # most commands need none

    from apc.present.report_output import kept_report, scene_again
    from apc.reports.contents import report

    kept = kept_report(path)
    mistakes, notes = [], []
    for item in kept["scenes"]:
        with tempfile.TemporaryDirectory(prefix="apc-report-") as folder, at_work("reporting"):
            again = report([scene_again(item, Path(folder))], item["settings"])
        place = Place(f"{path}: {item['name']}")
        mistakes += [Mistake("E991", place, what) for what in _differs(item, again)]
        made = dict(again.scenes[0].origin)
        changed = [name for name, digest in item["origin"] if made.get(name) != digest]
        notes += [f"{name} is another one than the report was made with" for name in changed]
        was = dict(kept["versions"])
        other = [(name, now) for name, now in again.versions if was.get(name) != now]
        notes += [f"{name} was {was.get(name, 'not there')}, and is {now} here" for name, now in other]
    for text in dict.fromkeys(notes):
        tell(f"note: {text}", err=True)
    if mistakes:
        raise ApcError(mistakes)
    tell(f"{path}: every number is the same, computed anew")


def _differs(kept_scene: KeptScene, again: Report) -> Iterator[str]:
    """Yield what differs between the sections of a scene that a report keeps and those made anew."""
    from apc.present.report_output import TITLES
    from apc.reports.contents import differences

    [now] = again.to_dict()["scenes"]
    before = {item["key"]: item for item in kept_scene["sections"]}
    for section in now["sections"]:
        title, old = TITLES[section["key"]], before.get(section["key"])
        if old is None:
            yield f"{title} is not in it"
        elif old["refused"] != section["refused"]:
            yield f"{title}: {section['refused'] or 'there is one'}, not: {old['refused'] or 'there is one'}"
        else:
            yield from (f"{title}: {what}" for what in differences(old["results"], section["results"]))
