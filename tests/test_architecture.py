"""The plan of the house: data flows one way, each command loads what it needs, nothing is evaluated."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.topologies import AVERAGE, ROOT

# Every module, earliest first: each may import only those before it.
ORDER = (
    # what the others are written in, and what is handed over
    *("apc.compiler.errors", "apc.compiler.words", "apc.compiler.compiled", "apc.compiler.cache"),
    # text
    *(
        "apc.compiler.source",
        "apc.compiler.reading",
        "apc.compiler.expression",
        "apc.compiler.grammar",
        "apc.compiler.evaluation",
        "apc.compiler.units",
    ),
    *("apc.compiler.dimensions", "apc.compiler.values", "apc.compiler.tables"),
    # components and scenes
    *("apc.compiler.component", "apc.compiler.parts", "apc.compiler.declarations"),
    *("apc.compiler.definitions", "apc.compiler.library"),
    *("apc.compiler.graphs", "apc.compiler.channels", "apc.compiler.groups", "apc.compiler.studies"),
    "apc.compiler.scene",
    # equations
    *("apc.compiler.flatten", "apc.compiler.clocks", "apc.compiler.symbolic", "apc.compiler.blocks"),
    *("apc.compiler.index", "apc.compiler.structure", "apc.compiler.exchange", "apc.compiler.ports"),
    "apc.compiler.functions",
    *("apc.compiler.pipeline", "apc.compiler.store"),
    # what is shown of them
    *("apc.compiler.schema", "apc.compiler.listing", "apc.compiler.diagram", "apc.compiler.picture"),
    # one peer over a frame
    *(
        "apc.runtime.threads",
        "apc.runtime.trouble",
        "apc.runtime.exact",
        "apc.runtime.parameters",
        "apc.runtime.discretize",
    ),
    *(
        "apc.runtime.exchange",
        "apc.runtime.packets",
        "apc.runtime.timetable",
        "apc.runtime.guards",
        "apc.runtime.linearize",
        "apc.runtime.schedule",
        "apc.runtime.gathering",
    ),
    *("apc.runtime.lift", "apc.runtime.batch_lift", "apc.runtime.residues"),
    # all peers, and what their motion tells
    *("apc.runtime.peers", "apc.runtime.modes", "apc.runtime.rigid", "apc.runtime.pseudospectrum"),
    *("apc.runtime.enclosure", "apc.runtime.balls", "apc.runtime.certify"),
    *("apc.runtime.ratios", "apc.runtime.duals"),
    "apc.runtime.spectrum",
    # populations: many different peers, large graphs, long delays
    *("apc.runtime.diagonal", "apc.runtime.transfer", "apc.runtime.counting"),
    *("apc.runtime.characteristic", "apc.runtime.zeros", "apc.runtime.crowds"),
    *("apc.runtime.determinant", "apc.runtime.determinant_spectrum", "apc.runtime.translation"),
    *("apc.runtime.extremes", "apc.runtime.large_graph"),
    *("apc.runtime.sparse_system", "apc.runtime.krylov", "apc.runtime.plan"),
    *("apc.runtime.selfcheck", "apc.runtime.analysis", "apc.runtime.needs"),
    *("apc.runtime.box", "apc.runtime.box_proof"),
    # many values of some parameters at once, and where the verdict changes
    *("apc.runtime.wiring", "apc.runtime.batch", "apc.runtime.evaluator", "apc.runtime.crossings"),
    "apc.runtime.bracket",
    *("apc.runtime.delays", "apc.runtime.search", "apc.runtime.critical", "apc.runtime.margins"),
    "apc.runtime.sensitivity",
    # other ways to analyse: the paper's, other readings of ties, each state of a contact
    *("apc.runtime.openloop", "apc.runtime.paper", "apc.runtime.conventions"),
    *("apc.runtime.switches", "apc.runtime.contact_modes", "apc.runtime.answer"),
    # published conditions, and results at many values of some parameters
    *("apc.runtime.passivity", "apc.runtime.overlay", "apc.runtime.grid", "apc.runtime.quantities"),
    *("apc.runtime.table_file", "apc.runtime.sweep_work", "apc.runtime.sweep_store"),
    *("apc.runtime.sweep_local", "apc.runtime.sweep_cluster", "apc.runtime.sweep"),
    # a scene played in time
    *("apc.runtime.methods", "apc.runtime.scales", "apc.runtime.stepping"),
    *("apc.runtime.integrate", "apc.runtime.propagate", "apc.runtime.flow", "apc.runtime.forcing"),
    *("apc.runtime.pairs", "apc.runtime.program", "apc.runtime.native"),
    *("apc.runtime.population", "apc.runtime.signals", "apc.runtime.simulation", "apc.runtime.blocks"),
    *("apc.runtime.accuracy", "apc.runtime.summary"),
    *("apc.runtime.trajectory", "apc.runtime.formats", "apc.runtime.recording"),
    *("apc.runtime.figures", "apc.runtime.still"),
    "apc.runtime.ensemble",
    # the stable region of two parameters
    *("apc.runtime.eigenpairs", "apc.runtime.surrogate", "apc.runtime.cells", "apc.runtime.curves"),
    *("apc.runtime.boundary_points", "apc.runtime.boundary", "apc.runtime.staircase"),
    *("apc.runtime.region_axes", "apc.runtime.region", "apc.runtime.region_panels"),
    *("apc.runtime.region_report", "apc.runtime.region_figure", "apc.runtime.region_files"),
    "apc.runtime.report",
    # speed against error
    *(
        "apc.runtime.bench_events",
        "apc.runtime.bench_reference",
        "apc.runtime.bench",
        "apc.runtime.bench_hard",
        "apc.runtime.bench_scale",
    ),
    *("apc.runtime.bench_report", "apc.runtime.bench_figure"),
    # what a person calls
    *(
        "apc.inputs",
        "apc.options",
        "apc.contents",
        "apc.api",
        "apc.cli_region",
        "apc.cli_simulate",
        "apc.cli_sweep",
        "apc.cli_critical",
        "apc.cli_bench",
        "apc.cli_analyze",
        "apc.cli",
        "apc.__main__",
    ),
)
# A result prints itself: it asks for the report, which knows it, when it is printed and not before.
BACKWARDS = {
    ("apc.runtime.analysis", "apc.runtime.report"),
    ("apc.runtime.answer", "apc.runtime.report"),
    ("apc.runtime.trajectory", "apc.runtime.figures"),  # likewise a trajectory that draws itself
    ("apc.runtime.bench", "apc.runtime.bench_report"),
    # and a region that prints, draws and lists itself
    *(("apc.runtime.region", f"apc.runtime.region_{late}") for late in ("report", "figure", "files")),
    *(("apc.runtime.region_panels", f"apc.runtime.region_{late}") for late in ("report", "figure")),
}
PACKAGES = {"compiler": "apc.compiler", "runtime": "apc.runtime", "runtime/apc": "apc"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "sympify", "parse_expr", "lambdify", "S"}
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "sympy.parsing"}


def modules() -> dict[str, Path]:
    return {
        f"{package}.{path.stem}": path
        for folder, package in PACKAGES.items()
        for path in sorted((ROOT / folder).glob("*.py"))
        if path.stem != "__init__"
    }


def imports(path: Path) -> set[str]:
    """Return the names of our own modules that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found & set(ORDER)


def test_every_module_has_its_place_in_the_order() -> None:
    assert sorted(modules()) == sorted(ORDER)


@pytest.mark.parametrize("module", ORDER)
def test_a_module_imports_only_what_comes_before_it(module: str) -> None:
    allowed = set(ORDER[: ORDER.index(module)]) | {late for early, late in BACKWARDS if early == module}
    assert imports(modules()[module]) <= allowed


@pytest.mark.parametrize("module", [name for name in ORDER if name.startswith("apc.compiler.")])
def test_the_compiler_never_imports_the_runtime(module: str) -> None:
    text = modules()[module].read_text(encoding="utf-8")
    assert "apc.runtime" not in text


def test_nothing_is_evaluated_or_unpickled() -> None:
    for name, path in modules().items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                function = node.func
                called = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
                # `re.compile` and `apc.compile` are no Python `compile`.
                own = called == "compile" and (isinstance(function, ast.Attribute) or called in defined)
                assert own or called not in FORBIDDEN_CALLS, f"{name}:{node.lineno}: {called}"
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not FORBIDDEN_MODULES & set(names), f"{name}: {names}"


def python(code: str, folder: Path) -> str:
    """Run Python in a fresh process and return what it prints."""
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def loaded(code: str, folder: Path) -> set[str]:
    """Return the names of the top modules that are loaded after running code."""
    out = python(
        code + "\nimport sys; print('LOADED', *sorted({n.split('.')[0] for n in sys.modules}))", folder
    )
    return set(out.splitlines()[-1].split())


def test_importing_the_package_costs_nothing(tmp_path: Path) -> None:
    heavy = {"numpy", "casadi", "scipy", "sympy", "pint", "yaml", "click", "rich", "flint"}
    assert not heavy & loaded("import apc", tmp_path)


def test_analysing_a_compiled_model_needs_no_algebra_and_no_units(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    run = "from apc.__main__ import run\nassert run([{}]) == 0"
    compiled = loaded(run.format("'compile'"), tmp_path)
    assert {"sympy", "casadi"} <= compiled and "pint" not in compiled  # its units are common ones
    for words in ("'analyze'", "'analyze', 'scene.apc'", "'analyze', '--json'"):
        assert not {"sympy", "pint", "scipy", "matplotlib", "pandas"} & loaded(run.format(words), tmp_path)


def test_the_text_of_a_scene_is_not_computed_with_numbers_of_the_runtime(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    code = "from apc.compiler.pipeline import run_stages\nfrom pathlib import Path\n"
    code += "run_stages(Path('scene.yaml'), until='compiled')\nimport sys\n"
    code += "assert not [n for n in sys.modules if n.startswith('apc.runtime')]"
    python(code, tmp_path)


def test_the_wheel_brings_one_name_to_site_packages_and_every_model(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    copy = tmp_path / "source"
    for name in ("pyproject.toml", "README.md", "compiler", "runtime", "models"):
        for path in [ROOT / name] if (ROOT / name).is_file() else sorted((ROOT / name).rglob("*.*")):
            if path.is_file() and "__pycache__" not in path.parts:
                target = copy / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(path.read_bytes())
    ran = subprocess.run([*command, str(copy)], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not re.fullmatch(r"apc-[\d.]+\.dist-info", top)} == {"apc"}
    packed = {name.removeprefix("apc/models/") for name in names if name.endswith(".yaml")}
    here = {str(path.relative_to(ROOT / "models")) for path in (ROOT / "models").rglob("*.yaml")}
    assert packed == here
    assert "apc/py.typed" in names
