"""The plan of the house: data flows one way, nothing is evaluated, each command loads what it needs."""

from __future__ import annotations

import ast
import dataclasses
import enum
import functools
import graphlib
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from apc.compiler import store
from apc.compiler.cache import Archive, Origin
from tests.topologies import AVERAGE, ROOT

STAGES = ("source", "language", "components", "topology", "equations", "functions", "view")  # of the compiler
PAGE = (ROOT / "runtime" / "README.md").read_text(encoding="utf-8")
# The folders of the runtime, in the order in which its page names them.
ROOMS = tuple(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE))))
EVALUATING = {"eval", "exec", "compile", "__import__", "sympify", "parse_expr", "lambdify", "S"}
UNPICKLING = {"pickle", "marshal", "shelve", "dill", "cloudpickle"}


@dataclasses.dataclass(frozen=True, slots=True)
class Module:
    """What a module imports, anywhere in it; what it calls by which line; its kinds of results."""

    path: str
    text: str
    imports: set[str]
    calls: list[str]
    results: list[str]


@functools.cache
def modules() -> dict[str, Module]:
    """Return every module by its name; `runtime/` is the package `apc` itself."""
    return {
        ".".join(("apc", *path.relative_to(ROOT / top[0]).with_suffix("").parts)): read(path)
        for top in (("runtime",), (".", "compiler"))
        for path in sorted(ROOT.joinpath(*top).rglob("*.py"))
        if path.name != "__init__.py"
    }


def read(path: Path) -> Module:
    tree = ast.parse(text := path.read_text(encoding="utf-8"))
    module = Module(path.relative_to(ROOT).as_posix(), text, set(), [], [])
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            module.imports.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            module.imports.update([f"{node.module}", *(f"{node.module}.{one.name}" for one in node.names)])
        elif isinstance(node, ast.Call):
            method, name = getattr(node.func, "attr", ""), getattr(node.func, "id", "")
            # `re.compile` and `apc.compile` are no Python `compile`.
            module.calls.append("" if name in defined or method == "compile" else method or name)
        elif isinstance(node, ast.Compare):  # as of a comprehension that hides the variable meant
            assert ast.dump(node.left) != ast.dump(node.comparators[0]), f"{path}:{node.lineno}"
        elif isinstance(node, ast.ClassDef) and "Result" in map(ast.unparse, node.bases):
            module.results.append(node.name)
    return module


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = {name: module.imports & modules().keys() for name, module in modules().items()}
    assert len([*graphlib.TopologicalSorter(graph).static_order()]) == len(graph) > 100
    assert len({name.rpartition(".")[2] for name in graph}) == len(graph), "two modules have one name"


@pytest.mark.parametrize(("package", "folders"), [("apc.", ROOMS), ("apc.compiler.", STAGES)])
def test_a_folder_imports_only_from_those_before_it(package: str, folders: tuple[str, ...]) -> None:
    """There are no folders but these; what stands beside them is held by the test above."""

    def place(module: str) -> int:
        """Return the place of a module's folder; -1 of what stands in none of these."""
        first, _, rest = module.removeprefix(package).partition(".")
        return folders.index(first) if module.startswith(package) and rest and first != "compiler" else -1

    late = [
        f"{name} imports {one}"
        for name, module in modules().items()
        for one in module.imports & modules().keys()
        if -1 < place(name) < place(one)
    ]
    assert not late


def test_the_compiler_never_imports_the_runtime() -> None:
    wrong = {
        name: runtime
        for name, module in modules().items()
        if name.startswith("apc.compiler.")
        and (runtime := {one for one in module.imports if re.match(r"apc\.(?!compiler)", one)})
    }
    assert not wrong


def test_what_is_looked_up_by_name_is_a_result_or_somebody_elses_library() -> None:
    """Or the order would be kept in words only."""
    calling = {name for name, module in modules().items() if "import_module" in module.calls}
    assert calling <= {
        "apc.result",
        "apc.support.extension_table",
        "apc.support.optional",
        "apc.support.tables",
        "apc.support.threads",
    }


def test_the_page_on_the_rooms_names_what_there_is() -> None:
    names = re.findall(r"`([a-z]\w*(?:\.\w+)+)`", PAGE) + re.findall(r"^    (\S+\.\S+)  ", PAGE, re.MULTILINE)
    for name in [one for one in names if one.split(".")[0] in ROOMS]:
        module = max((one for one in modules() if f"apc.{name}.".startswith(f"{one}.")), key=len, default="")
        rest = f"apc.{name}"[len(module) + 1 :]
        assert module and (not rest or hasattr(importlib.import_module(module), rest)), name


def test_nothing_is_evaluated_or_unpickled() -> None:
    for name, module in modules().items():
        assert not EVALUATING & {*module.calls}, name
        assert not UNPICKLING & {one.partition(".")[0] for one in module.imports}, name


def test_what_casadi_reads_is_read_in_one_place_at_most() -> None:
    """Reading its form may run commands that a text names: a file's is read under this user's seal alone."""
    for what, places in (("deserialize", {"store"}), ("decoded", {"processes"})):
        reading = {name.rpartition(".")[2] for name, one in modules().items() if what in one.calls}
        assert reading == places, what
    with pytest.raises(AssertionError):
        store.opened(Archive(Origin("topology.yaml"), b"", sealed=False, compiled=True))


@pytest.mark.needs_extension("all")
def test_what_holds_arrays_is_not_compared_by_them() -> None:
    """Two arrays compare entry by entry, and have no truth: such an object is equal to itself alone."""
    evaluations, wrong = 0, []
    for name in modules():
        for one in vars(importlib.import_module(name)).values():
            if inspect.isclass(one) and one.__module__ == name and "__dataclass_fields__" in vars(one):
                peer_types = [str(field.type) for field in dataclasses.fields(one)]
                if any(re.search(r"\bnp\.ndarray\b|\bNDArray\b", peer_type) for peer_type in peer_types):
                    evaluations += 1
                    wrong += [f"{name}.{one.__name__}"] if one.__eq__ is not object.__eq__ else []
    assert evaluations > 10
    assert not wrong


# Fields of results and messages that hold our own prose, or the data that it is made from.
PROSE = {
    "verdict",
    "proof",
    "note",
    "notes",
    "fix",
    "advice",
    "left_out",
    "what",
    "sentence",
    "reason",
    "warnings",
}
# Fields whose name others use for codes, too: none of them is taken apart as a text.
CODED = {"why", "expected", "got", "refusal", "refused", "summary"}
READING = {"startswith", "endswith", "partition", "rpartition", "split", "replace", "find", "index", "count"}
READING |= {"removeprefix", "removesuffix"}
MATCHING = {"search", "match", "fullmatch", "findall", "finditer", "sub"}
# Sentences put into another one without their full stop, and equal ones listed once.
JOINED = {"runtime/benchmark/speed_and_error.py", "compiler/errors.py"}


def prose_in(node: ast.AST, bound: Mapping[str, str]) -> str:
    """Return the field of prose that an expression is, or an element of which it is; "" of none."""
    if isinstance(node, ast.Attribute) and node.attr in PROSE | CODED:
        return node.attr
    if isinstance(node, ast.Name):
        return bound.get(node.id, node.id if node.id in PROSE - {"what", "reason"} else "")
    return ""


def is_text(node: ast.AST, names: Mapping[str, object]) -> bool:
    """Return whether an expression is a text and no member of an enum, or holds one."""
    if isinstance(node, ast.Tuple | ast.Set | ast.List):
        return any(is_text(item, names) for item in node.elts)
    value = node.value if isinstance(node, ast.Constant) else None
    if isinstance(node, ast.Name):
        value = names.get(node.id)
    values = value if isinstance(value, tuple | set | frozenset | list) else [value]
    return isinstance(node, ast.JoinedStr) or any(
        isinstance(item, str) and not isinstance(item, enum.Enum) and item for item in values
    )


def prose_read(tree: ast.AST, names: Mapping[str, object]) -> Iterator[tuple[int, str]]:
    """Yield the lines at which code reads prose, and how.

    Parameters
    ----------
    tree, names
        A module's code, and the values of its global names.
    """
    bound: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.comprehension | ast.For) and (field := prose_in(node.iter, {})):
            *_, last = [part for part in ast.walk(node.target) if isinstance(part, ast.Name)]
            bound[last.id] = field
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            read = []
            if node.func.attr in READING:
                read = [node.func.value]
            elif node.func.attr in MATCHING:
                read = [part for argument in node.args for part in ast.walk(argument)]
            if any(prose_in(part, bound) for part in read):
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            fields = {prose_in(side, bound) for side in sides} & PROSE
            if fields and any(is_text(side, names) for side in sides):
                yield node.lineno, ast.unparse(node)


@pytest.mark.needs_extension("all")
def test_no_decision_reads_a_sentence() -> None:
    """A verdict, proof or limitation is data: its words are for people."""
    wrong = [
        f"{path}:{line}: {code}"
        for name, module in modules().items()
        for path in [module.path]
        for line, code in prose_read(ast.parse(module.text), vars(importlib.import_module(name)))
        if path not in JOINED
    ]
    assert not wrong, "\n".join(wrong)
    found = 'result.verdict.startswith("stable")', '"bits" in verdict.proof', 'row.proof == "proved"'
    assert all([*prose_read(ast.parse(code), {})] for code in found)


def python(code: str, folder: Path) -> str:
    """Run Python in a fresh process and return what it prints."""
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


HEAVY = {"numpy", "casadi", "scipy", "sympy", "pint", "yaml", "rich", "flint"}
OPTIONAL = {"matplotlib", "bokeh", "pandas", "pyarrow", "IPython", "control", "distributed", "xarray"}


def imports_in_strings(path: Path) -> list[str]:
    """Return the statements in the strings of a file that import from apc."""
    strings = [
        node.value
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    return re.findall(r"\bfrom apc[\w.]* import \w+(?:, \w+)*", "\n".join(strings))


def test_code_in_strings_imports_names_that_exist() -> None:
    """A process of its own runs such code: no rename by tool finds it, and no type checker."""
    found = {line for path in sorted((ROOT / "tests").rglob("*.py")) for line in imports_in_strings(path)}
    assert len(found) > 5
    for line in sorted(found):
        _, module, _, names = line.split(maxsplit=3)
        there = importlib.import_module(module)
        for name in names.split(", "):
            assert hasattr(there, name) or importlib.util.find_spec(f"{module}.{name}"), line


@pytest.mark.whole
def test_a_command_loads_what_it_runs(tmp_path: Path) -> None:
    """Nothing to tell what there is or that nothing has changed; nothing optional to compute."""
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    begin = "import sys\nimport apc\nfrom apc.__main__ import run\n"
    tell = "\nprint('LOADED', *sys.modules)"

    def loaded(code: str) -> set[str]:
        return set(python(begin + code + tell, tmp_path).splitlines()[-1].split())

    assert not OPTIONAL & loaded("assert run(['compile']) == run(['analyze', 'topology.apc', '--json']) == 0")
    # SciPy's optimization and graphs, and the units of a topology, take long to import.
    analyzed = loaded("assert run(['analyze', 'topology.apc']) == 0")
    assert not {"scipy.optimize", "scipy.sparse", "pint", "sympy"} & analyzed
    unchanged = "assert run(['--help']) == run(['analyze', '--help']) == run(['compile']) == 0"
    assert not (OPTIONAL | HEAVY) & loaded(unchanged)


@pytest.mark.whole
def test_no_module_is_imported_under_two_names(tmp_path: Path) -> None:
    code = f"import importlib, sys\nfor name in {[*modules()]!r}:\n    importlib.import_module(name)\n"
    code += "files = [m.__file__ for m in list(sys.modules.values()) if m.__name__.split('.')[0] == 'apc']\n"
    code += "assert len(files) == len(set(files))\n"
    code += "assert not [n for n in ('apc.runtime', 'apc.apc') if importlib.util.find_spec(n)]"
    python(code, tmp_path)


@pytest.mark.whole
def test_the_wheel_brings_one_name_to_site_packages_and_every_model(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    copy = tmp_path / "source"
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "compiler", "runtime", "models"):
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
    packed = {name.removeprefix("apc/models/") for name in names if re.match(r"apc/models/.*\.yaml$", name)}
    assert packed == {str(path.relative_to(ROOT / "models")) for path in (ROOT / "models").rglob("*.yaml")}
    assert "apc/py.typed" in names
