"""What a notebook shows of results, and the notebooks of the library, each run from its first cell."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.result import Result
from tests.topologies import AVERAGE, ROOT, compiled, replaced

NOTEBOOKS = sorted((ROOT / "models" / "notebooks").glob("*.ipynb"))


@pytest.mark.few(1)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interactive = pytest.importorskip("IPython.core.interactiveshell")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "agg")
    book = json.loads(path.read_text(encoding="utf-8"))
    assert book["nbformat"] == 4
    shell = interactive.InteractiveShell()
    shell.history_manager.enabled = False
    shown = 0
    assert len(NOTEBOOKS) == 7
    for cell in book["cells"]:
        if cell["cell_type"] != "code":
            continue
        ran = shell.run_cell("".join(cell["source"]), store_history=False)
        ran.raise_error()
        if isinstance(ran.result, Result):
            data, _ = shell.display_formatter.format(ran.result)
            assert {"text/plain", "text/html"} <= data.keys()
            [stored] = [output["data"] for output in cell["outputs"] if "data" in output]
            assert words(data["text/plain"]) == words("".join(stored["text/plain"]))
            shown += 1
    assert shown


def words(text: str) -> str:
    """Return a text without digits and spaces, which rounding and the width of numbers may change."""
    return re.sub(r"[\s\d.]+", " ", text)


def bundle(found: Any) -> dict[str, str]:
    shown: dict[str, str] = found._repr_mimebundle_()
    return shown


@pytest.mark.whole
def test_a_result_is_its_text_and_its_picture_and_elsewhere_a_line() -> None:
    model = compiled(AVERAGE)
    results: tuple[Any, ...] = (
        apc.analyze(model),
        apc.transparency(model, np.geomspace(1, 50, 20)),
        apc.simulate(model, params={"device.v": "0.1 m/s"}, duration="20 ms", jit=False),
    )
    for found in results:
        shown = bundle(found)
        assert shown["text/plain"] == str(found)
        [image] = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', shown["text/html"])
        assert base64.b64decode(image).startswith(b"<svg")
    for found in (*results, apc.parameters(model)):
        assert re.fullmatch(r"<\w+ .{1,80}>", repr(found))
        assert bundle(found)["text/html"].startswith("<pre>")
    assert repr(model) == "<Model three-users-average: 3 peers>"
    assert model._repr_html_() == f"<pre>{model}</pre>"


def test_what_a_topology_says_is_no_markup_in_a_notebook() -> None:
    model = compiled(replaced(AVERAGE, ("description: ", "description: <b>bold</b> ")))
    assert "<b>" not in model._repr_html_() and "&lt;b&gt;" in model._repr_html_()


def test_without_matplotlib_a_notebook_shows_the_text(monkeypatch: pytest.MonkeyPatch) -> None:
    found = apc.analyze(compiled(AVERAGE))
    monkeypatch.setattr("importlib.import_module", _without_matplotlib)
    assert bundle(found)["text/html"].count("<") == 2


def _without_matplotlib(name: str) -> Any:
    if name.startswith("matplotlib"):
        raise ImportError(name)
    return __import__(name, fromlist=["x"])
