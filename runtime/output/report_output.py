"""A report as an HTML page, PDF, text and data; and read back from its page.

Takes: a `Report`. Gives: `report_text`, `report_document`, `report_page`; `check_report_path`, `save_report`;
`StoredPage`, `StoredTopology`, `read_page`, `split_page`, `topology_again`, `damaged`.
Guarantees: the page is self-contained, and its content policy forbids loading. Texts of a topology are
escaped; numbers are included as JSON, too. A report read back is data only: named files are written to a new
folder only.
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
from apc.output.formatting import Lines, Plain, json_text, notes, record
from apc.output.graph import graph_picture
from apc.output.pages import inert, page
from apc.reports.contents import Report, Section
from apc.support.optional import missing, need
from apc.support.suffixes import check_suffix

FORMATS = (".html", ".pdf")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PRINTED = 120.0  # seconds that a browser may take
LARGEST = 200 * 2**20  # bytes of a report that is read again
TITLES = {
    "compiled": "Model",
    "verdict": "Verdict, modes and margins",
    "limits": "Stiffness and delay limits",
    "region": "Stable region",
    "response": "Response",
    "network": "Packet loss limit",
    "transparency": "Impedance",
}
# Fields that differ between runs, between machines, or with the order of equal modes.
UNLIKE = {"provenance", "origin", "points", "handles", "participation"}
EMBEDDED = '<script type="application/json" id="apc-report">', "</script>"


def report_text(report: Report) -> Lines:
    """Yield the text of a report: a line per section, with the reasons for empty ones."""
    for topology in report.topologies:
        if topology is not report.topologies[0]:
            yield ""
        yield topology.name
        for section in topology.sections:
            yield from notes(f"{TITLES[section.key]}: {section.refused or section.command}")


def report_document(report: Report) -> Plain:
    """Return a report as plain data: the inputs for recomputation, and all tables."""
    topologies = [
        record(
            topology,
            {"path": ..., "file": topology.path.name, "sections": [*map(_stored, topology.sections)]},
        )
        for topology in report.topologies
    ]
    return {"apc_report": 2, "versions": dict(report.versions), "topologies": topologies}


def _stored(section: Section) -> Plain:
    """Return a section as plain data: the reproducible parts of its results."""
    results = [_comparable(result.to_dict()) for result in section.results]
    return record(section, {"figures": ..., "results": results})


def _comparable(data: Any) -> Any:
    """Return plain data without the fields in `UNLIKE`, and without modes indistinguishable from zero."""
    if isinstance(data, dict):
        return {key: _comparable(item) for key, item in data.items() if key not in UNLIKE}
    return [_comparable(item) for item in data if not _is_dead(item)] if isinstance(data, list) else data


def _is_dead(item: Any) -> bool:
    """Return whether plain data describe a mode indistinguishable from zero."""
    mode = isinstance(item, dict) and "magnitude" in item
    return mode and (item["error"] is None or item["magnitude"] <= item["error"])


@part("page")
def report_page(report: Report) -> str:
    """Return a report as one HTML document."""
    from apc.compiler.view.diagram import diagram_of  # of the topologies as written

    text = json_text(report_document(report), indent=None)
    drawing = {"diagram_of": diagram_of, "graph_picture": graph_picture}
    return page("report.html", report=report, titles=TITLES, stored=inert(text), **drawing)


# ---- files ----


def check_report_path(path: Path) -> None:
    """Refuse a report that cannot be written: E878 the suffix, E601 the path, E875 a missing program."""
    suffix = check_suffix(path, FORMATS, "--out")
    check_target(path)
    need("matplotlib", "plot")
    if suffix == ".pdf":
        _browser(path)


def _browser(path: Path) -> str:
    """Return the path of an installed Chromium; an error E875 without one. `path` is the .pdf to write."""
    result = next((text for name in BROWSERS if (text := shutil.which(name))), None)
    if result is None:
        fix = f"--out {path.with_suffix('.html')}, or apt install chromium"
        raise missing("Chromium is not installed, which prints a .pdf", fix)
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
    """Print a page to a PDF by a browser with an empty user profile."""
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


class StoredSection(TypedDict):
    """A section that a page keeps."""

    key: str
    refused: str
    results: list[Plain]


class StoredTopology(TypedDict):
    """A model that a page keeps: its texts by name, the digests of all it is made of, its sections."""

    name: str
    description: str
    file: str
    settings: list[str]
    texts: list[tuple[str, str]]
    origin: list[tuple[str, str]]
    sections: list[StoredSection]


class StoredReport(TypedDict):
    """The report stored in a page, in the form of `report_document`."""

    versions: dict[str, str]
    topologies: list[StoredTopology]


class StoredPage(NamedTuple):
    """A page that was read: the HTML without its embedded data, these as JSON, and decoded."""

    shown: str
    json: str
    stored: StoredReport


def split_page(text: str) -> tuple[str, str]:
    """Return the HTML of a page without its embedded data, and these as JSON."""
    begin, end = EMBEDDED
    before, _, rest = text.partition(begin)
    stored, _, after = rest.partition(end)
    return f"{before}{begin}{end}{after}", stored


def read_page(path: Path) -> StoredPage:
    """Return a report's page and the data that it holds.

    Raises
    ------
    ApcError
        E990 `apc report` did not write it, or it is damaged, or it has no topology.
    """
    try:
        shown, text = split_page(read_file(path, LARGEST).decode("utf-8-sig"))
        stored = msgspec.json.decode(text, type=StoredReport)
    except RefusedError as refused:
        raise ApcError(Diagnostic("E990", SourceLocation(str(path)), refused.words)) from None
    except (ValueError, RecursionError):
        raise damaged(path) from None
    if not stored["topologies"]:
        raise damaged(path, "holds no topology: nothing in it can be computed anew")
    if any(item["settings"] != stored["topologies"][0]["settings"] for item in stored["topologies"]):
        raise damaged(path, "holds topologies with different settings, which no report has")
    return StoredPage(shown, text, stored)


def damaged(path: Path, message: str = "is no report that apc has written, or is damaged") -> ApcError:
    """Return the message E990 of a page."""
    return ApcError(
        Diagnostic(
            "E990", SourceLocation(str(path)), message, fix="apc report topology.yaml --out report.html"
        )
    )


def topology_again(stored_topology: StoredTopology, folder: Path) -> Path:
    """Write the texts of a model that a report keeps into an empty folder; return the topology.

    Raises
    ------
    ApcError
        E990 a name among them leads out of the folder or can't be a file's, or none is the topology's.
    """
    for name, text in stored_topology["texts"]:
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or "\\" in name or ":" in name or ".." in parts:
            message = f"names a file outside of the topology's folder: {name[:80]}"
            raise ApcError(Diagnostic("E990", SourceLocation(stored_topology["name"][:80]), message))
        path = folder.joinpath(*parts)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except (OSError, ValueError):
            message = f"names a file that can't be written: {name[:80]!r}"
            raise ApcError(
                Diagnostic("E990", SourceLocation(stored_topology["name"][:80]), message)
            ) from None
    file = PurePosixPath(stored_topology["file"]).name
    if file not in dict(stored_topology["texts"]):
        raise ApcError(
            Diagnostic(
                "E990", SourceLocation(stored_topology["name"][:80]), f"holds no text of {file[:80]!r}"
            )
        )
    return folder / file
