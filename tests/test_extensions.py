"""Extensions: without its folder an answer loses its line, and nothing else; its own question is refused."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import apc
from apc.support.extension_table import EXTENSIONS, find_extension
from tests.commands import Cli
from tests.hidden import hidden
from tests.topologies import ROOT

FOLDERS = ROOT / "runtime" / "extensions"
TOPOLOGIES = ROOT / "models" / "topologies"
AVERAGE = TOPOLOGIES / "three-users-average.yaml"
PUSH = f"{ROOT / 'docs/howto/push.csv'} {ROOT / 'docs/howto/one-device.yaml'}"
COLGATE = "colgate:K=contact.stiffness,B=contact.damping,b=0,T=haptic.period"
GAIN = '--free "coordination.stiffness=10 N/m:5000 N/m"'

# A command that asks the question of each extension.
QUESTIONS = {
    "changing_counts": f"analyze {AVERAGE} --changing user.count=2:3",
    "event_order": f"analyze {AVERAGE} --event-order",
    "loss_models": f"simulate {TOPOLOGIES / 'lossy-average.yaml'} --trace-of worst --duration '0.1 s'",
    "paper_method": f"analyze {AVERAGE} --method paper",
    "parameter_boxes": f"analyze {AVERAGE} --box contact.stiffness=±1%",
    "parameter_fit": f"fit {PUSH} --free 'device.mass=0.05 kg:1 kg'",
    "pareto_front": f"tune {AVERAGE} {GAIN} --maximize coordination.stiffness --tradeoff 'impedance at 5 Hz'",
    "switching": f"analyze {TOPOLOGIES / 'finger.yaml'} --limit-cycle",
    "system_norms": f"tune {AVERAGE} {GAIN} --minimize coordination_error_h2",
    "wall_conditions": f"region {AVERAGE} --overlay {COLGATE}",
}


@pytest.mark.needs_extension("all")
def test_each_extension_is_a_folder_with_an_entry() -> None:
    assert {path.name for path in FOLDERS.iterdir() if (path / "__init__.py").is_file()} == {*EXTENSIONS}
    assert {*QUESTIONS} == {*EXTENSIONS}
    for name, extension in EXTENSIONS.items():
        assert extension.answers and extension.applies and extension.functions
        for text in extension.functions:
            assert callable(getattr(extension, text.partition(":")[2]))
        if extension.output:
            import_module(f"apc.extensions.{name}.{extension.output}")


def test_the_manual_lists_every_extension() -> None:
    page = (ROOT / "docs" / "developer" / "architecture.md").read_text(encoding="utf-8")
    table = page.rpartition("| extension | answer |")[2]
    assert {*re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)} == {*EXTENSIONS}
    named = re.findall(r"`([a-z_]+(?:\.[a-z_]+){2})`", page)
    assert len(named) > 5
    for name in named:
        module, _, function = name.rpartition(".")
        assert hasattr(import_module(f"apc.{module}"), function), name


def imports(path: Path) -> set[str]:
    """Return the modules that a file imports, except for types only."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typed = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.walk(node)
    }
    return {
        name
        for node in ast.walk(tree)
        if node not in typed
        for name in (
            [f"{node.module}"]
            if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else []
        )
    }


def test_nothing_imports_an_extension_but_the_table() -> None:
    outside = [path for path in (ROOT / "runtime").rglob("*.py") if FOLDERS not in path.parents]
    assert len(outside) > 100
    wrong = {path for path in outside if any(name.startswith("apc.extensions") for name in imports(path))}
    assert not wrong
    for path in FOLDERS.rglob("*.py"):
        others = {name for name in imports(path) if name.startswith("apc.extensions.")}
        assert {name.split(".")[2] for name in others} <= {path.parent.name}, path


@pytest.mark.parametrize("name", sorted(EXTENSIONS))
def test_the_question_of_a_hidden_extension_is_refused_by_name(name: str, cli: Cli) -> None:
    with hidden(name):
        assert find_extension(name) is None
        ran = cli(QUESTIONS[name])
    assert ran.code == 1 and not ran.out
    assert "E882" in ran.err and EXTENSIONS[name].answers in " ".join(ran.err.split()) and name in ran.err


@pytest.mark.few(3)
@pytest.mark.parametrize("path", sorted(TOPOLOGIES.glob("*.yaml")), ids=lambda path: path.stem)
def test_without_any_extension_a_verdict_is_the_same(path: Path, cli: Cli) -> None:
    model = apc.compile(path)
    expected = apc.analyze(model)
    with hidden(*EXTENSIONS):
        found = apc.analyze(model)
        ran = cli(f"analyze {path} --no-margins")
    assert found.verdict == expected.verdict and found.spectral_radius == expected.spectral_radius
    assert ran.code == 0 and "is not installed" in " ".join(ran.out.split())


@pytest.mark.few(4)
@pytest.mark.parametrize(
    "command",
    [
        "analyze {}",
        "analyze {} --hands passive",
        "critical coordination.stiffness {}",
        "transparency {}",
        "compare {}",
        "sweep {} --over 'coordination.stiffness=100 N/m:2000 N/m:3' --out grid.csv",
        "simulate {} --duration '0.1 s'",
        "show {}",
        "tune {} --free 'coordination.stiffness=10 N/m:5000 N/m' --maximize coordination.stiffness",
        "export {} --out loop.npz",
        "report {} --out page.html",
        "bench {}",
        "check {}",
    ],
)
def test_every_command_survives_without_extensions(command: str, cli: Cli) -> None:
    with hidden(*EXTENSIONS):
        ran = cli(command.format(AVERAGE))
    assert ran.code == 0, ran.err


@pytest.mark.whole
def test_tests_that_need_no_extension_pass_without_any() -> None:
    """All tests: `pytest --without-extension all`; here those of four subjects."""
    files = (
        "lifting/test_frame.py",
        "many_users/test_answers.py",
        "networks/test_loss.py",
        "varying/test_margins.py",
    )
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "--without-extension", "all"]
    ran = subprocess.run(
        [*command, *(f"tests/{name}" for name in files)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0 and " passed" in ran.stdout, ran.stdout[-2000:]
