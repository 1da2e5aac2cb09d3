"""Pages of the manual that are made from the program: components, topologies, results, messages, tutorials.

Takes: the sources of this checkout. Gives: `write_pages`.
Guarantees: a page is written only if its text has changed, so that Sphinx reads only those again.
Does not: execute notebooks; their outputs are stored with them.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from latex import equation_latex

import apc
from apc.compiler.components.component import Component
from apc.compiler.components.component_library import Library
from apc.compiler.message_catalogue import catalogue, ranges
from apc.compiler.view.catalogue import component_document, library_document, topologies
from apc.compiler.view.diagram import diagram_of
from apc.output.graph import graph_picture
from apc.output.pictures import svg_text

ROOT = Path(__file__).parent.parent
TUTORIALS = ROOT / "models" / "notebooks"
PUBLISHED = ROOT / "models" / "published" / "results.yaml"
MESSAGES = ROOT / "tests" / "language" / "messages.txt"
TESTS_OF_THRESHOLDS = ROOT / "tests" / "mutants" / "thresholds.json"
# The subpackages whose constants can decide an answer: core and studies, in the order of the layers.
DECIDING = (
    *("parameter_values", "linearization", "timing", "lifting", "network", "spectrum", "analysis"),
    *("mean_square", "haptics", "simulation", "studies", "regions", "tuning", "extensions"),
)
FOLDERS = {
    "contacts": "Contacts",
    "coordination": "Coordination",
    "devices": "Devices",
    "hands": "Operators",
    "mechanics": "Mechanics",
    "network": "Network",
}


def write_pages(docs: Path) -> None:
    """Write all generated pages below a folder of documents."""
    library = Library(())
    for folder, rows in library_document(library).items():
        _write(docs / "reference" / "components" / f"{folder}.md", _components(library, folder, rows))
    _write(docs / "reference" / "topologies.md", "\n".join(_gallery(docs / "_static" / "topologies")))
    _write(docs / "reference" / "published-results.md", "\n".join(_published()) + "\n")
    _write(docs / "reference" / "messages.md", "\n".join(_messages()))
    _write(docs / "developer" / "thresholds.md", "\n".join(_thresholds()) + "\n")
    for notebook in sorted(TUTORIALS.glob("*.ipynb")):
        _write(docs / "tutorial" / notebook.name, notebook.read_text(encoding="utf-8"))


def _write(path: Path, text: str) -> None:
    """Write a text file unless it has this text."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def _folded(title: str, text: str) -> Iterator[str]:
    """Yield a block of YAML that a reader opens."""
    yield from (f"<details><summary>{title}</summary>", "", "```yaml", text, "```", "", "</details>", "")


# ---- components ----


def _components(library: Library, folder: str, rows: list[dict[str, str]]) -> str:
    """Return the page of the components of one folder of the library."""
    lines = [f"# {FOLDERS[folder]}", ""]
    lines += ["| component | description |", "|---|---|"]
    lines += [
        f"| [`{row['name']}`](#{row['name'].lower()}) | {row['description'].partition('. ')[0].rstrip('.')} |"
        for row in rows
    ]
    for row in rows:
        lines += ["", f"## {row['name']}", "", *_component(library, row["name"])]
    return "\n".join(lines) + "\n"


def _component(library: Library, name: str) -> Iterator[str]:
    """Yield the section of a component: description, source, parameters, equations, and definition."""
    facts = component_document(library, name)
    yield facts["description"]
    yield ""
    if facts["source"]:
        yield f"Source: {facts['source']}."
        yield ""
    if facts["connectors"]:
        yield "Connectors: " + ", ".join(f"`{key}` ({value})" for key, value in facts["connectors"].items())
        yield ""
    yield from _parameters(facts["parameters"])
    component = library.component(name)
    if component is not None:
        yield from _equations(component)
    for title, text in facts["definitions"].items():
        yield from _folded(f"Definition of {title}", text)


def _parameters(rows: list[dict[str, str]]) -> Iterator[str]:
    """Yield the table of parameters."""
    if not rows:
        return
    yield "| parameter | unit | default | limits | description |"
    yield "|---|---|---|---|---|"
    for row in rows:
        cells = (f"`{row['name']}`", row["unit"], row["value"], row["limits"], row["description"])
        yield f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"
    yield ""


def _equations(component: Component) -> Iterator[str]:
    """Yield the equations, typeset; those of the entries of a vector are written once, as in the source."""
    entries = {equation.text: [each for each in component.equations if each.text == equation.text]
               for equation in component.equations}  # fmt: skip
    for text, equations in entries.items():
        if len(equations) > 1:  # a vector equation
            yield from ("```text", text, "```", "")
        else:
            yield from ("$$", equation_latex(equations[0]), "$$", "")
    if component.linearized is not None:
        yield f"In a linear analysis (valid for {component.linearized.valid}):"
        yield ""
        for equation in component.linearized.equations:
            yield from ("$$", equation_latex(equation), "$$", "")


# ---- topologies ----


def _gallery(pictures: Path) -> Iterator[str]:
    """Yield the page of the shipped topologies: verdict, picture and text of each."""
    yield "# Topologies"
    yield ""
    yield "`apc new --like NAME` copies a topology to `NAME.yaml`; `apc new --list` lists them."
    yield ""
    for name, path in topologies().items():
        model = apc.compile(path)
        _write(pictures / f"{name}.svg", svg_text(graph_picture(diagram_of(path))))
        yield from (f"## {name}", "", model.description, "")
        yield f"Verdict of `apc analyze`: *{apc.analyze(model).verdict}*."
        yield ""
        yield f"![Peers, parts and links of {name}](../_static/topologies/{name}.svg)"
        yield ""
        yield from _folded("Topology", path.read_text(encoding="utf-8").rstrip())


# ---- published results ----

PUBLISHED_HEAD = """\
# Published results

`apc` reproduces the results of this page, which is generated from `models/published/results.yaml`. The tests
repeat each command and compare its result with the number of the source. All numbers are in SI units.
Commands are called in the folder of a checkout.

| kind | meaning |
|---|---|
| published | the source has the number, or the verdict, at the place that is given |
| closed form | the number follows from a formula of the source |

The tolerance is the permitted relative difference between both numbers. Where a formula is an approximation,
a test also compares the result with an independent computation.
"""


def _published() -> Iterator[str]:
    """Yield the page of published results: a table, commands and topologies of each source."""
    yield PUBLISHED_HEAD
    for source in yaml.load(PUBLISHED.read_text(encoding="utf-8"), yaml.BaseLoader):
        rows = source["results"]
        yield from (f"## {source['title']}", "", f"{source['statement']} {{cite}}`{source['cite']}`", "")
        if place := _place(source):
            yield from (f"{place[0].upper()}{place[1:]}.", "")
        yield "| result | basis | source | `apc` | tolerance |"
        yield "|---|---|---|---|---|"
        yield from (_published_row(row, source | row) for row in rows)
        yield from ("", "Commands, in the order of the table:", "", "```sh")
        yield from dict.fromkeys(row[key] for row in rows for key in ("command", "divided_by") if key in row)
        yield from ("```", "")
        names = {name for row in rows for name in re.findall(r"models/published/\S+\.yaml", row["command"])}
        folders = sorted({(ROOT / name).parent for name in names})
        for path in (path for folder in folders for path in sorted(folder.rglob("*.yaml"))):
            yield from _folded(f"{path.parent.name}/{path.name}", path.read_text(encoding="utf-8").rstrip())


def _published_row(own: dict[str, Any], row: dict[str, Any]) -> str:
    """Return one row of the table of a source; `row` has the keys of the source, too."""
    values = ", ".join(f"{name} = {value}" for name, value in own.get("values", {}).items())
    place = "; ".join(filter(None, (_place(own), values)))
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    words = row["tolerance"] == "none"
    source, found = (text if words else text + unit for text in (row["number"], row["apc"]))
    tolerance = row["reason"] if words else f"{row['tolerance']}: {row['reason']}"
    return f"| {row['result']} | {place} | {source} | {found} | {tolerance} |"


def _place(row: dict[str, Any]) -> str:
    """Return kind, place and formula of a number, of those that a row has."""
    formula = f"`{row['formula']}`" if "formula" in row else ""
    return ": ".join(filter(None, (", ".join(filter(None, (row.get("kind"), row.get("where")))), formula)))


# ---- messages ----


def _messages() -> Iterator[str]:
    """Yield the page of message codes: cause, remedy and an example of each."""
    examples = _examples()
    headings = dict(ranges())
    yield "# Messages"
    yield ""
    yield "Codes that begin with E are errors, codes that begin with W are warnings. A message reads"
    yield "`FILE:LINE:COLUMN: CODE subject: expected …, got …. Advice. Try: FIX`. A fix can be pasted."
    for code, entry in sorted(catalogue().items()):
        if heading := headings.pop(code[:2], ""):
            yield from ("", f"## {code[0]}{code[1]}xx: {heading}")
        yield from ("", f"### {code}: {entry.title}", "", entry.cause, "", entry.remedy, "")
        text = examples.get(code, "")
        if entry.example is not None:
            text = f"$ {entry.example.command}\n{entry.example.message}"
        if text:
            yield from ("```text", text, "```")


def _examples() -> dict[str, str]:
    """Return the first example of each code in the tested list of messages: the edit and the message."""
    examples: dict[str, str] = {}
    for block in MESSAGES.read_text(encoding="utf-8").split("\n\n"):
        if found := re.search(r"^(?:\d+:\d+|\S*?): ([EW]\d{3}) ", block, re.MULTILINE):
            examples.setdefault(found[1], block.strip("\n"))
    return examples


# ---- thresholds ----


def _thresholds() -> Iterator[str]:
    """Yield the page of the numeric constants of each subpackage, with their reasons."""
    yield from ("# Thresholds", "")
    yield "The numeric constants of core, studies and extensions, each with its reason, from the sources."
    yield "The largest numbers of states are those of `support.state_limits`."
    yield "The test is one that fails where the value is ten times larger or smaller, found among the quick"
    yield "tests that use it (`python -m tests.mutants.thresholds`). A dash is a constant that none of them"
    yield "fixes, such as a limit of work or of size; an empty cell is one that was not tried."
    tests = json.loads(TESTS_OF_THRESHOLDS.read_text(encoding="utf-8"))
    for package in DECIDING:
        rows = []
        for path in sorted((ROOT / "runtime" / package).rglob("*.py")):
            for names, value, reason in constants(path):
                found = tests.get(threshold_key(path, names))
                file, _, test = (found or "").rpartition("::")
                shown = f"`{test}` in `{file.removeprefix('tests/')}`" if test else "–" if found == "" else ""
                rows.append(f"| `{names}` | {value} | `{path.stem}` | {reason} | {shown} |")
        yield from (
            "",
            f"## {package}",
            "",
            "| name | value | module | reason | test |",
            "|---|---|---|---|---|",
        )
        yield from rows


def threshold_key(path: Path, names: str) -> str:
    """Return the key of a constant in the table of tests: its module without `runtime`, and its names."""
    return ".".join((*path.relative_to(ROOT / "runtime").with_suffix("").parts, names))


def constants(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the names, the values and the reason of each numeric constant of a module.

    The reason is the comment on its line, or the one above it or above the constants it follows.
    """
    source = path.read_text(encoding="utf-8")
    lines, above, end = source.splitlines(), "", 0
    for node in ast.parse(source).body:
        first = node.lineno - 2
        if not (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name | ast.Tuple)):
            continue
        names = ast.unparse(node.targets[0]).strip("()")
        value = lines[node.lineno - 1].partition("=")[2].partition("#")[0].strip()
        if not (names.replace("_", "").replace(", ", "").isupper() and _is_numeric(node.value)):
            continue
        block = []
        while first >= 0 and lines[first].startswith("# "):
            block.insert(0, lines[first][2:])
            first -= 1
        if block or end != node.lineno - 1:  # a comment of its own, or the first constant of a block
            above = " ".join(block)
        end = node.end_lineno or node.lineno
        comment = " ".join(
            line.partition("  # ")[2] for line in lines[node.lineno - 1 : end] if "  # " in line
        )
        shown = ast.unparse(node.value) if node.end_lineno != node.lineno else value
        yield names, shown.strip("()"), (comment or above).replace("|", "\\|")


def _is_numeric(node: ast.expr) -> bool:
    """Return whether an expression consists of numbers."""
    operations = ast.Tuple | ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop | ast.expr_context
    return all(
        isinstance(part.value, int | float) and not isinstance(part.value, bool)
        if isinstance(part, ast.Constant)
        else isinstance(part, operations)
        for part in ast.walk(node)
    )
