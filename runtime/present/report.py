"""A report as one page of HTML, as a PDF, as text and as data; and read again from its page.

Takes: a `Report`. Gives: `report_text`, `report_document`, `report_page`; `check_report_path`, `save_report`;
`kept_report`, `scene_again`.
Guarantees: the page holds everything in itself and forbids its reader to load anything; what a scene says is
text in it and never markup; its numbers stand in it as JSON too. A report read again is data: what it names
is written nowhere but in a folder of its own.
Does not: compute.

A PDF is printed by Chromium, where there is one.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any, TypedDict

import msgspec

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import RefusedError, check_target, read_file, unwritable, write_file, write_text
from apc.compiler.timings import part
from apc.optional import missing, need
from apc.present.comparison_picture import comparison_picture
from apc.present.forms import Lines, document, json_text, notes, record
from apc.present.graph import graph_picture
from apc.present.pictures import svg_image
from apc.reports.contents import Report, SceneReport, Section
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
_KEPT = re.compile(r'<script type="application/json" id="apc-report">(.*?)</script>', re.DOTALL)
# Of a page that loads nothing.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
STYLE = """
:root { color-scheme: light dark; --ink: #1f2933; --faint: #52606d; --page: #fff; --line: #cbd2d9;
  --tint: #f5f7fa; --link: #0b5cad; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e7eb; --faint: #9fb0c0; --page: #15191e;
  --line: #3e4c59; --tint: #1f262d; --link: #7cc0ff; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 110rem; color: var(--ink); background: var(--page);
  font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0; } h2 { margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1rem 0 .3rem; } p { margin: .3rem 0; max-width: 60rem; }
a { color: var(--link); } nav a { margin-right: 1rem; white-space: nowrap; }
.scenes { display: grid; gap: 1.5rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
.scenes > * { min-width: 0; } .faint { color: var(--faint); }
figure { margin: .6rem 0; padding: .5rem; background: #fff; border: 1px solid var(--line); border-radius: 4px;
  overflow-x: auto; }
figure img { display: block; margin: auto; max-width: 100%; height: auto; }
pre { background: var(--tint); padding: .6rem; overflow-x: auto; font-size: .8rem; line-height: 1.4; }
code { background: var(--tint); padding: .1rem .3rem; overflow-wrap: anywhere; }
@media print { body { padding: 0; max-width: none; font-size: 11px; } figure { break-inside: avoid; }
  h2, h3, p:has(+ p, + figure, + h3) { break-after: avoid; } .scenes { display: block; }
  pre { white-space: pre-wrap; } nav { display: none; } }
"""


def report_text(found: Report) -> Lines:
    """Yield what is printed of a report: a line a section, and why those are empty that are."""
    for one in found.scenes:
        if one is not found.scenes[0]:
            yield ""
        yield one.name
        for section in one.sections:
            yield from notes(f"{TITLES[section.key]}: {section.refused or f'as {section.command}'}")


def report_document(found: Report) -> dict[str, Any]:
    """Return a report as plain data: what is needed to compute it again, and all of its tables."""
    scenes = [
        document(one, {"path": ..., "file": one.path.name, "sections": [*map(_kept, one.sections)]})
        for one in found.scenes
    ]
    return {"apc_report": 2, "versions": dict(found.versions), "scenes": scenes}


def _kept(section: Section) -> dict[str, Any]:
    """Return a section as plain data: of its results what is the same wherever it is computed anew."""
    results = [_comparable(one.to_dict()) for one in section.results]
    return record(section, {"drawn": ..., "results": results})


def _comparable(data: Any) -> Any:
    """Return plain data without what is told by `UNLIKE`, and without modes that are not told from zero."""
    if isinstance(data, dict):
        return {key: _comparable(one) for key, one in data.items() if key not in UNLIKE}
    return [_comparable(one) for one in data if not _is_dead(one)] if isinstance(data, list) else data


def _is_dead(one: Any) -> bool:
    """Say whether plain data are of a mode that is not told from zero."""
    mode = isinstance(one, dict) and "magnitude" in one
    return mode and (one["error"] is None or one["magnitude"] <= one["error"])


@part("page")
def report_page(found: Report) -> str:
    """Return a report as one HTML document."""
    named = ", ".join(one.name for one in found.scenes)
    kept = json_text(report_document(found), indent=None).replace("<", "\\u003c")
    parts = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(named)}: a report of apc</title><style>{STYLE}</style></head><body>",
        f"<header><h1>{escape(named)}</h1>",
        '<p class="faint">Every number here is that of the command beside it; '
        "<code>apc report --check FILE</code> computes this page anew and says what differs.</p>",
        f"<nav>{''.join(_link(key, title) for key, title in _titles(found))}</nav></header><main>",
        *_row("scene", "The scene", map(_scene, found.scenes)),
    ]
    if len(found.scenes) > 1:
        shown = _refused(found.refused)
        if found.comparison is not None:
            files = " ".join(one.path.name for one in found.scenes)
            shown = f"<p>Produced by {_code(f'apc compare {files} --out compared.svg')}.</p>"
            shown += _picture(comparison_picture(found.comparison), "schemes side by side")
            shown += f"<pre>{escape(str(found.comparison))}</pre>"
        parts += _row("compared", "Side by side", [shown])
    for key, title in TITLES.items():
        cells = [_section(one, key, len(found.scenes) > 1) for one in found.scenes]
        parts += _row(key, title, cells)
    parts += _row("made", "What made it", [_made(one, found) for one in found.scenes])
    parts += [f'</main><script type="application/json" id="apc-report">{kept}</script></body></html>']
    return "\n".join(parts)


def _titles(found: Report) -> Iterator[tuple[str, str]]:
    yield "scene", "The scene"
    if len(found.scenes) > 1:
        yield "compared", "Side by side"
    yield from TITLES.items()
    yield "made", "What made it"


def _link(key: str, title: str) -> str:
    return f'<a href="#{key}">{escape(title)}</a> '


def _code(text: str) -> str:
    return f"<code>{escape(text)}</code>"


def _refused(why: str) -> str:
    return f'<p class="faint">Not here: {escape(why)}.</p>'


def _row(key: str, title: str, cells: Iterable[str]) -> list[str]:
    """Return a section of the page: the same of all scenes side by side."""
    inner = "".join(f"<div>{cell}</div>" for cell in cells)
    return [f'<section id="{key}"><h2>{escape(title)}</h2><div class="scenes">{inner}</div></section>']


def _scene(one: SceneReport) -> str:
    from apc.compiler.view.listing import diagram_of  # of the topology as written

    diagram = diagram_of(one.path)
    title = f"{diagram.scene.name}. {diagram.scene.about}".strip()
    texts = "".join(f"<h3>{escape(name)}</h3><pre>{escape(text)}</pre>" for name, text in one.texts)
    settings = "".join(f"<li>{_code(text)}</li>" for text in one.settings)
    told = f"<p>{escape(one.about)}</p>" + (f"<p>Set first:</p><ul>{settings}</ul>" if settings else "")
    command = f"<p>Produced by {_code(f'apc show {one.path.name} --out scene.svg')}.</p>"
    return f"<h3>{escape(one.name)}</h3>{told}{_picture(graph_picture(diagram), title)}{command}{texts}"


def _section(one: SceneReport, key: str, several: bool) -> str:
    section = next(each for each in one.sections if each.key == key)
    head = f"<h3>{escape(one.name)}</h3>" if several else ""
    if section.refused:
        return head + _refused(section.refused)
    told = "".join(f"<p>{escape(text)}</p>" for text in section.told)
    title = f"{one.name}: {TITLES[key]}"
    pictures = "".join(_picture(each.plot().figure, title) for each in section.drawn)
    texts = "".join(f"<pre>{escape(str(each))}</pre>" for each in section.results)
    return f"{head}{told}{pictures}{texts}<p>Produced by {_code(section.command)}.</p>"


def _made(one: SceneReport, found: Report) -> str:
    rows = "\n".join(f"{name:<16} {value}" for name, value in (*found.versions, *one.origin))
    return f"<h3>{escape(one.name)}</h3><pre>{escape(rows)}</pre>"


def _picture(figure: Any, title: str) -> str:
    return f"<figure>{svg_image(figure, title)}</figure>"


# ---- files ----


def check_report_path(path: Path) -> None:
    """Refuse a report that can't be written: E878 the suffix, E601 the place, E875 what is not installed."""
    suffix = check_suffix(path, FORMATS, "--out")
    check_target(path)
    need("matplotlib", "plot")
    if suffix == ".pdf":
        _browser(path)


def _browser(path: Path) -> str:
    found = next((one for name in BROWSERS if (one := shutil.which(name))), None)
    if found is None:
        hint = f"--out {path.with_suffix('.html')}, or install it, as by: apt install chromium"
        raise missing("Chromium is not installed, which prints a .pdf", hint)
    return found


def save_report(found: Report, path: Path) -> None:
    """Write a report, its format chosen by the suffix.

    Raises
    ------
    ApcError
        As `check_report_path`; E601 the browser could not print it.
    """
    check_report_path(path)
    page = report_page(found)
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
    results: list[dict[str, Any]]


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


def kept_report(path: Path) -> KeptReport:
    """Return what a report's page keeps of itself.

    Raises
    ------
    ApcError
        E990 it is no page that `apc report` wrote, or is damaged.
    """
    try:
        found = _KEPT.search(read_file(path, LARGEST).decode("utf-8"))
        return msgspec.json.decode(found[1] if found else "", type=KeptReport)
    except RefusedError as refused:
        raise ApcError(Mistake("E990", Place(str(path)), refused.words)) from None
    except (ValueError, RecursionError):
        what = "is no report that apc has written, or is damaged"
        hint = "apc report scene.yaml --out report.html"
        raise ApcError(Mistake("E990", Place(str(path)), what, hint=hint)) from None


def scene_again(kept: KeptScene, folder: Path) -> Path:
    """Write the texts of a scene that a report keeps into an empty folder; return the topology.

    Raises
    ------
    ApcError
        E990 a name among them leads out of the folder.
    """
    for name, text in kept["texts"]:
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or "\\" in name or ":" in name or ".." in parts:
            what = f"names a file outside of the scene's folder: {name[:80]}"
            raise ApcError(Mistake("E990", Place(kept["name"][:80]), what))
        path = folder.joinpath(*parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder / PurePosixPath(kept["file"]).name
