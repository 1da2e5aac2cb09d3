"""The plan of the house: data flows one way, each command loads what it needs, nothing is evaluated."""

from __future__ import annotations

import ast
import builtins
import collections.abc
import dataclasses
import functools
import importlib
import inspect
import re
import subprocess
import sys
import typing
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.topologies import AVERAGE, ROOT

# Folder by folder, and in each its modules, earliest first: each may import only those before it.
HOUSE = (
    (
        "apc.compiler",
        "errors digits timings files words multiples weights interpolation plain compiled crowd "
        "formula seal cache",
    ),
    ("apc.compiler.source", "nodes yaml_faults reading compose source"),
    (
        "apc.compiler.language",
        """
        expression lexer grammar evaluation dimensions si_forms unit_grammar unit_names units unit_text
        unit_check vectors values tables probes recordings
        """,
    ),
    ("apc.compiler.components", "component parts declarations component_check definitions library"),
    (
        "apc.compiler.scene",
        "named_numbers timebase instances sections channels graphs links groups oddities studies scene",
    ),
    (
        "apc.compiler.equations",
        """
        connections flatten reductions clock_inference clocks terms symbolic zero_test solution
        matching
        residuals elimination tearing blocks derivatives aliases index structure
        """,
    ),
    ("apc.compiler.functions", "casadi_writer reached exchange functions"),
    ("apc.compiler", "pipeline store"),
    ("apc.compiler.view", "schema catalogue diagram svg layers picture stages listing"),
    (
        "apc",
        """
        threads memory later finite_equations distribution suffixes optional option_value result tables npz
        processes
        """,
    ),
    (
        "apc.frame",
        """
        exact names parameters settable overrides
        discretize radius taylor exchange
        site jacobians start devices linearize
        schedule liveness hyperperiod ages scheduling
        lift nearby ports batch_lift course residues
        """,
    ),
    ("apc.network", "philox channel nominal timetable recorded"),
    (
        "apc.eigen",
        """
        graph_modes peer_group listening peers rest closing graph_loops modes
        eigenpairs dominant ratios rigid dissipation pseudospectrum apart relative enclosure balls winding
        bordered roots certify spectrum
        """,
    ),
    (
        "apc.large",
        """
        diagonal transfer characteristic zeros populations determinant determinant_spectrum
        translation rings sparse_system krylov
        """,
    ),
    (
        "apc.analysis",
        """
        methods switches pushes plan selfcheck analysis needs box cells box_proof openloop paper conventions
        contact_modes opened alternating multipliers switching describing
        """,
    ),
    (
        "apc.moments",
        """
        memory mean_loops gains crowd held worst almost_sure stand_in patterns bursts traces
        hands errors network box
        """,
    ),
    ("apc.hands", "port certify passivity box response norms asked answers populations viscosity feel"),
    (
        "apc.vary",
        """
        wiring batch slopes crossings plane bracket counting loops evaluator ports leading many bends marginal
        delays lags search counts growth critical locus effort margins sensitivity over_network
        """,
    ),
    ("apc.sweeps", "grid quantities work store cluster sweep"),
    (
        "apc.simulation",
        """
        settings integrate propagate flow quadrature forcing
        signals pairs program writing native hearing population machine stepwise
        simulation blocks accuracy limits summary trajectory ensemble buzz
        """,
    ),
    ("apc", "answer"),
    ("apc.loop", "packets realtime device peer run reading start beside"),
    ("apc.comparison", "effort choice comparison"),
    (
        "apc.regions",
        """
        passivity overlay eigenpairs peaks rectangle cells curves boundary_points boundary axes strips region
        panels
        """,
    ),
    (
        "apc.exports",
        """
        words lifted free files expressions modelica peer c_names c_header c_text c_driver chance_text
        scene_text fmu code export
        """,
    ),
    ("apc.benchmark", "timing truth bench hard scale"),
    ("apc", "inputs arguments"),
    ("apc.reports", "contents"),
    (
        "apc.present",
        """
        forms pictures notebook exports code network recorded_network loop hands eigenvalues analysis vary
        comparison_picture comparison region_picture region planar simulation still animation recording bench
        parameters graph report
        """,
    ),
    ("apc.explore", "sliders written motion sections desk figures server page"),
    # what a person calls
    (
        "apc",
        "api",
    ),
    (
        "apc.cli",
        """
        options progress region simulate sweep compare critical feel export explore bench analyze network play
        library report compile show commands
        """,
    ),
    ("apc", "__main__"),
)
ORDER = tuple(f"{package}.{name}" for package, names in HOUSE for name in names.split())
FORBIDDEN_CALLS = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "sympify",
    "parse_expr",
    "lambdify",
    "S",
    "deserialize",
}
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


@functools.cache
def modules() -> dict[str, Path]:
    """Return the file of every module; `runtime/` is the package `apc` itself."""
    found = {}
    for top in ("compiler", "runtime"):
        for path in sorted((ROOT / top).rglob("*.py")):
            names = path.relative_to(ROOT).with_suffix("").parts
            if names[-1] != "__init__":
                found[".".join(("apc", *(names[1:] if top == "runtime" else names)))] = path
    return found


@functools.cache
def tree_of(path: Path) -> tuple[ast.Module, tuple[ast.AST, ...]]:
    """Return a file's tree, and all that is in it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return tree, tuple(ast.walk(tree))


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """Keep the trees of all files no longer than they are looked at."""
    yield
    tree_of.cache_clear()


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return, of every module, the names of our own modules that it imports, anywhere in it."""
    return {name: imports_of(path) & set(ORDER) for name, path in modules().items()}


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in tree_of(path)[1]:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_every_module_has_its_place_in_the_order() -> None:
    assert sorted(modules()) == sorted(ORDER)


def test_a_module_imports_only_what_comes_before_it() -> None:
    assert not {
        name: late for place, name in enumerate(ORDER) if (late := imports()[name] - {*ORDER[:place]})
    }


def test_every_result_is_shown_as_text_and_as_data() -> None:
    for name, path in modules().items():
        for node in tree_of(path)[1]:
            if isinstance(node, ast.ClassDef) and "Result" in map(ast.unparse, node.bases):
                module, _, own = getattr(importlib.import_module(name), node.name).shown_by.partition(":")
                for form in ("text", "document"):
                    shown = importlib.import_module(f"apc.present.{module}")
                    assert callable(getattr(shown, f"{own}_{form}")), f"{name}: {node.name}"


def test_what_is_looked_up_by_name_is_a_result_or_somebody_elses_library() -> None:
    """Or the order would be kept in words only."""
    calling = {name for name, path in modules().items() if "import_module(" in path.read_text("utf-8")}
    assert calling == {"apc.result", "apc.optional", "apc.tables", "apc.threads"}


COMPILER = {name for name in ORDER if name.startswith("apc.compiler.")}


def test_the_compiler_never_imports_the_runtime() -> None:
    assert not {name: wrong for name in COMPILER if (wrong := imports()[name] - COMPILER)}


def test_no_expression_is_read_after_compiling() -> None:
    read = {f"apc.compiler.language.{name}" for name in ("lexer", "grammar", "expression", "evaluation")}
    assert not {name: wrong for name in {*ORDER} - COMPILER if (wrong := imports()[name] & read)}


def test_the_compilers_map_names_every_module_of_it() -> None:
    text = ast.get_docstring(ast.parse((ROOT / "compiler" / "__init__.py").read_text(encoding="utf-8"))) or ""
    names = {name.split(".")[-1] for name in ORDER if name.startswith("apc.compiler.")}
    assert names <= set(re.findall(r"\w+", text))


def test_the_page_on_the_rooms_names_what_there_is() -> None:
    text = (ROOT / "runtime" / "README.md").read_text(encoding="utf-8")
    rooms = {package.split(".")[1] for package, _ in HOUSE if package.count(".") == 1} - {"compiler"}
    assert rooms == set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", text, re.MULTILINE))))
    named = re.findall(r"`([a-z]\w*(?:\.\w+)+)`", text) + re.findall(r"^    (\S+\.\S+)  ", text, re.MULTILINE)
    tops = {one.split(".")[1] for one in ORDER}
    for name in [one for one in named if one.split(".")[0] in tops]:
        module = max((one for one in ORDER if f"apc.{name}.".startswith(f"{one}.")), key=len, default="")
        rest = f"apc.{name}"[len(module) + 1 :]
        assert module, name
        assert not rest or hasattr(importlib.import_module(module), rest), name


def test_nothing_is_evaluated_or_unpickled() -> None:
    for name, path in modules().items():
        tree, nodes = tree_of(path)
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for node in nodes:
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
    """Return the names of the modules that are loaded from somewhere after running code."""
    real = "[n for n, m in sys.modules.items() if getattr(m, '__spec__', None)]"
    out = python(f"{code}\nimport sys; print('LOADED', *{real})", folder)
    return set(out.splitlines()[-1].split())


def test_no_module_is_imported_under_two_names(tmp_path: Path) -> None:
    code = f"import importlib, sys\nfor name in {ORDER!r}:\n    importlib.import_module(name)\n"
    code += "files = [m.__file__ for m in list(sys.modules.values()) if m.__name__.split('.')[0] == 'apc']\n"
    code += "assert len(files) == len(set(files))\n"
    code += "assert not [n for n in ('apc.runtime', 'apc.apc') if importlib.util.find_spec(n)]"
    python(code, tmp_path)


class Known(dict[str, Any]):
    """The names of a module; what it imports for the type checker alone is anything."""

    def __missing__(self, name: str) -> type:
        if name in vars(builtins):
            raise KeyError(name)
        return object


def test_what_holds_arrays_is_not_compared_by_them() -> None:
    """Two arrays compare entry by entry, and have no truth: such an object is equal to itself alone."""

    def arrays(kind: object) -> bool:
        if typing.get_origin(kind) is collections.abc.Callable:
            return False
        return typing.get_origin(kind) is np.ndarray or any(map(arrays, typing.get_args(kind)))

    looked, wrong = 0, []
    for name in modules():
        module = importlib.import_module(name)
        for one in vars(module).values():
            if inspect.isclass(one) and one.__module__ == name and "__dataclass_fields__" in vars(one):
                kinds = {str(field.type) for field in dataclasses.fields(one)} - {"itertools.count[int]"}
                if any(arrays(eval(kind, {}, Known(vars(module)))) for kind in kinds):
                    looked += 1
                    wrong += [f"{name}.{one.__name__}"] if one.__eq__ is not object.__eq__ else []
    assert looked > 100
    assert not wrong


def test_importing_the_package_costs_nothing(tmp_path: Path) -> None:
    heavy = {"numpy", "casadi", "scipy", "sympy", "pint", "yaml", "click", "rich", "flint"}
    assert not heavy & loaded("import apc", tmp_path)


# What a command loads of other people's: each package costs 5 to 60 ms, more than most commands compute for.
SHOWN = {"click", "lazy_loader"}
COMPUTED = SHOWN | {"numpy", "casadi", "flint"}
TEXT = COMPUTED | {"yaml", "sympy", "mpmath", "scipy", "_csparsetools", "_cyutility"}
LOADED = {
    "--help": SHOWN,
    "--version": SHOWN,
    "analyze --help": SHOWN,
    "compile": SHOWN,  # unchanged
    "compile --force": TEXT,
    "check": TEXT,
    "analyze": COMPUTED,
    "analyze scene.apc": COMPUTED,
    "analyze --json scene.apc": COMPUTED,
    "critical contact.stiffness scene.apc": COMPUTED,
    "feel scene.apc": COMPUTED,
    "region scene.apc": COMPUTED,
    "simulate --duration 0.1s scene.apc": COMPUTED,
}
# Parts of NumPy and of the standard library that take as long as a small package.
METADATA = {"importlib.metadata", "email"}
DEAR = METADATA | {"numpy.ma", "numpy.random", "numpy.testing", "asyncio", "logging"}
DEAR |= {"multiprocessing", "concurrent.futures", "traceback", "difflib", "html", "unittest", "xml"}


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a scene and its compiled model."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    python("from apc.__main__ import run\nassert run(['compile']) == 0", folder)
    return folder


@pytest.mark.parametrize("words", LOADED)
def test_a_command_loads_what_it_runs(words: str, compiled: Path) -> None:
    run = f"from apc.__main__ import run\nassert run({words.split()}) == 0"
    found = loaded(run, compiled) - loaded("", compiled)
    packages = {name.partition(".")[0] for name in found if not name.startswith("_sysconfigdata")}
    packages -= sys.stdlib_module_names | {"apc"}
    assert packages <= LOADED[words]
    if "scipy" not in LOADED[words]:  # which loads most of them
        assert not found & (DEAR - METADATA if words == "--version" else DEAR)
    if words != "--help":  # which lists them all
        own = {"options", "progress", "commands", "compile" if words == "check" else words.split()[0]}
        assert {name for name in found if name.startswith("apc.cli.")} <= {f"apc.cli.{name}" for name in own}


def test_a_small_scene_loads_nothing_of_large_ones(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    code = (
        "from apc.__main__ import run\nassert run(['compile']) == 0 and run(['analyze', 'scene.apc']) == 0\n"
    )
    code += "import sys; print(*(n for n in sys.modules if n.startswith('apc.large.')))"
    assert not python(code, tmp_path).splitlines()[-1]


def test_the_text_of_a_scene_is_not_computed_with_numbers_of_the_runtime(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    code = "from apc.compiler.pipeline import run_stages\nfrom pathlib import Path\n"
    code += "run_stages(Path('scene.yaml'), until='compiled')\nimport sys\n"
    code += "assert not [n for n in sys.modules if n.startswith('apc.') and not n.startswith('apc.compiler')]"
    python(code, tmp_path)


def test_the_wheel_brings_one_name_to_site_packages_and_every_model(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    copy = tmp_path / "source"
    for name in ("pyproject.toml", "setup.py", "README.md", "compiler", "runtime", "models"):
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
    assert {top for top in tops if not re.fullmatch(r"apc_haptics-[\d.]+\.dist-info", top)} == {"apc"}
    packed = {name.removeprefix("apc/models/") for name in names if name.endswith(".yaml")}
    here = {str(path.relative_to(ROOT / "models")) for path in (ROOT / "models").rglob("*.yaml")}
    assert packed == here
    assert "apc/py.typed" in names
