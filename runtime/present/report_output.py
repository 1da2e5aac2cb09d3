"""A report as one page of HTML, as a PDF, as text and as data; and read again from its page.

Takes: a `Report`. Gives: `report_text`, `report_document`, `report_page`; `check_report_path`, `save_report`;
`StoredPage`, `read_page`, `split_page`, `kept_report`, `scene_again`.
Guarantees: the page holds everything in itself and forbids its reader to load anything; what a scene says is
text in it and never markup; its numbers stand in it as JSON too. A report read again is data: what it names
is written nowhere but in a folder of its own.
Does not: compute.

A PDF is printed by Chromium, where there is one.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypedDict

import msgspec

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, check_target, read_file, unwritable, write_file, write_text
from apc.compiler.timings import part
from apc.optional import missing, need
from apc.present.forms import Lines, Plain, json_text, notes, record
from apc.present.graph import graph_picture
from apc.present.pages import inert, page
from apc.reports.contents import Report, Section
from apc.suffixes import check_suffix

FORMATS = (".html", ".pdf")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PRINTED = 120.0  # seconds that a browser may take
LARGEST = 200 * 2**20  # bytes of a report that is read again
TITLES = {
    "compiled": "What was compiled",
    "verdict": "Verdict, modes and margins",
    "limits": "How stiff, how late",
    "region": "Where it is stable",
    "response": "What happens over time",
    "network": "How much may get lost",
    "feel": "What a hand feels",
}
# What differs from run to run, from machine to machine, or with which of equal motions is named first.
UNLIKE = {"provenance", "origin", "points", "handles", "participation"}
EMBEDDED = '<script type="application/json" id="apc-report">', "</script>"


def report_text(report: Report) -> Lines:
    """Yield what is printed of a report: a line a section, and why those are empty that are."""
    for scene in report.scenes:
        if scene is not report.scenes[0]:
            yield ""
        yield scene.name
        for section in scene.sections:
            yield from notes(f"{TITLES[section.key]}: {section.refused or f'as {section.command}'}")


def report_document(report: Report) -> Plain:
    """Return a report as plain data: what is needed to compute it again, and all of its tables."""
    scenes = [
        record(scene, {"path": ..., "file": scene.path.name, "sections": [*map(_kept, scene.sections)]})
        for scene in report.scenes
    ]
    return {"apc_report": 2, "versions": dict(report.versions), "scenes": scenes}


def _kept(section: Section) -> Plain:
    """Return a section as plain data: of its results what is the same wherever it is computed anew."""
    results = [_comparable(result.to_dict()) for result in section.results]
    return record(section, {"drawn": ..., "results": results})


def _comparable(data: Any) -> Any:
    """Return plain data without what is told by `UNLIKE`, and without modes that are not told from zero."""
    if isinstance(data, dict):
        return {key: _comparable(item) for key, item in data.items() if key not in UNLIKE}
    return [_comparable(item) for item in data if not _is_dead(item)] if isinstance(data, list) else data


def _is_dead(item: Any) -> bool:
    """Say whether plain data are of a mode that is not told from zero."""
    mode = isinstance(item, dict) and "magnitude" in item
    return mode and (item["error"] is None or item["magnitude"] <= item["error"])


@part("page")
def report_page(report: Report) -> str:
    """Return a report as one HTML document."""
    from apc.compiler.view.listing import diagram_of  # of the topologies as written

    text = json_text(report_document(report), indent=None)
    drawing = {"diagram_of": diagram_of, "graph_picture": graph_picture}
    return page("report.html", report=report, titles=TITLES, kept=inert(text), **drawing)


# ---- files ----


def check_report_path(path: Path) -> None:
    """Refuse a report that can't be written: E878 the suffix, E601 the place, E875 what is not installed."""
    suffix = check_suffix(path, FORMATS, "--out")
    check_target(path)
    need("matplotlib", "plot")
    if suffix == ".pdf":
        _browser(path)


def _browser(path: Path) -> str:
    result = next((text for name in BROWSERS if (text := shutil.which(name))), None)
    if result is None:
        hint = f"--out {path.with_suffix('.html')}, or install it, as by: apt install chromium"
        raise missing("Chromium is not installed, which prints a .pdf", hint)
    return result


def save_report(report: Report, path: Path) -> None:
    """Write a report, its format chosen by the suffix.

    Raises
    ------
    ApcError
        As `check_report_path`; E601 the browser could not print it.
    """
    check_report_path(path)
    page = report_page(report)
    if path.suffix.lower() == ".pdf":
        write_file(path, lambda temporary: _print(page, temporary, path))
    else:
        write_text(path, page)


@part("print")
def _print(page: str, target: Path, path: Path) -> None:
    """Print a page to a PDF by a browser that knows nothing of its user."""
    with tempfile.TemporaryDirectory(prefix="apc-report-") as folder:
        source, printed = Path(folder, "report.html"), Path(folder, "report.pdf")
        source.write_text(page, encoding="utf-8")
        words = ["--headless", "--disable-gpu", "--no-pdf-header-footer", f"--print-to-pdf={printed}"]
        words += [f"--user-data-dir={folder}/user", "--no-first-run"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.append("--no-sandbox")  # Chromium refuses to start as root with one
        command = [_browser(path), *words, source.as_uri()]
        try:
            subprocess.run(command, capture_output=True, timeout=PRINTED, check=True)
            shutil.copyfile(printed, target)
        except (OSError, subprocess.SubprocessError) as error:
            raise unwritable(path, OSError(None, f"{Path(command[0]).name} has not printed it")) from error


class KeptSection(TypedDict):
    """A section that a page keeps."""

    key: str
    refused: str
    results: list[Plain]


class KeptScene(TypedDict):
    """A scene that a page keeps: its texts by name, the digests of all it is made of, its sections."""

    name: str
    about: str
    file: str
    settings: list[str]
    texts: list[tuple[str, str]]
    origin: list[tuple[str, str]]
    sections: list[KeptSection]


class KeptReport(TypedDict):
    """What a page keeps of its report, as `report_document` has it."""

    versions: dict[str, str]
    scenes: list[KeptScene]


class StoredPage(NamedTuple):
    """A page that was read: the HTML without its embedded data, these as JSON, and decoded."""

    shown: str
    json: str
    kept: KeptReport


def split_page(text: str) -> tuple[str, str]:
    """Return the HTML of a page without its embedded data, and these as JSON."""
    begin, end = EMBEDDED
    before, _, rest = text.partition(begin)
    kept, _, after = rest.partition(end)
    return f"{before}{begin}{end}{after}", kept


def read_page(path: Path) -> StoredPage:
    """Return a report's page and the data that it holds.

    Raises
    ------
    ApcError
        E990 `apc report` did not write it, or it is damaged, or it has no topology.
    """
    try:
        shown, text = split_page(read_file(path, LARGEST).decode("utf-8-sig"))
        kept = msgspec.json.decode(text, type=KeptReport)
    except RefusedError as refused:
        raise ApcError(Diagnostic("E990", SourceLocation(str(path)), refused.words)) from None
    except (ValueError, RecursionError):
        raise damaged(path) from None
    if not kept["scenes"]:
        raise damaged(path, "holds no topology: nothing in it can be computed anew")
    if any(item["settings"] != kept["scenes"][0]["settings"] for item in kept["scenes"]):
        raise damaged(path, "holds topologies with different settings, which no report has")
    return StoredPage(shown, text, kept)


def kept_report(path: Path) -> KeptReport:
    """Return the data that a report's page holds. Raises ApcError as `read_page`."""
    return read_page(path).kept


def damaged(path: Path, what: str = "is no report that apc has written, or is damaged") -> ApcError:
    """Return the message E990 of a page."""
    return ApcError(
        Diagnostic("E990", SourceLocation(str(path)), what, hint="apc report scene.yaml --out report.html")
    )


def scene_again(kept_scene: KeptScene, folder: Path) -> Path:
    """Write the texts of a scene that a report keeps into an empty folder; return the topology.

    Raises
    ------
    ApcError
        E990 a name among them leads out of the folder or can't be a file's, or none is the topology's.
    """
    for name, text in kept_scene["texts"]:
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or "\\" in name or ":" in name or ".." in parts:
            what = f"names a file outside of the scene's folder: {name[:80]}"
            raise ApcError(Diagnostic("E990", SourceLocation(kept_scene["name"][:80]), what))
        path = folder.joinpath(*parts)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except (OSError, ValueError):
            what = f"names a file that can't be written: {name[:80]!r}"
            raise ApcError(Diagnostic("E990", SourceLocation(kept_scene["name"][:80]), what)) from None
    file = PurePosixPath(kept_scene["file"]).name
    if file not in dict(kept_scene["texts"]):
        raise ApcError(
            Diagnostic("E990", SourceLocation(kept_scene["name"][:80]), f"holds no text of {file[:80]!r}")
        )
    return folder / file
