"""The contract of each module agrees with its code; functions with many arguments document them.

Ruff checks that docstrings exist.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

from tests.topologies import ROOT

HEADS = ("Takes:", "Gives:", "Guarantees:", "Does not:")
SUFFIXES = (".apc", ".py", ".yaml")  # of names of files
MANY = 5  # arguments, too many for one sentence
NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")
FOLDERS = {"compiler": ROOT / "compiler", "": ROOT / "runtime"}  # of the package apc


def _module(path: Path) -> str:
    """Return the name of a file's module below `apc`: `lifting.lift`, `compiler.errors`."""
    folder = "compiler" if path.is_relative_to(FOLDERS["compiler"]) else ""
    parts = [folder, *path.relative_to(FOLDERS[folder]).with_suffix("").parts]
    return ".".join(part for part in parts if part and part != "__init__")


TREES = {
    path: ast.parse(path.read_text(encoding="utf-8"))
    for folder in FOLDERS.values()
    for path in sorted(folder.rglob("*.py"))
}
MODULES = {_module(path): path for path in TREES}


def _functions(tree: ast.Module) -> list[ast.FunctionDef]:
    """Return the functions of a module and the methods of its public classes."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_"]
    return [node for body in (tree, *classes) for node in body.body if isinstance(node, ast.FunctionDef)]


def _targets(node: ast.stmt) -> list[str]:
    """Return the names that a statement of a module or class body defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
    flat = [entry for target in targets for entry in getattr(target, "elts", [target])]
    return [target.id for target in flat if isinstance(target, ast.Name)]


@cache
def _defined(tree: ast.Module) -> set[str]:
    """Return the names that a module defines, with the fields and methods of its classes."""
    bodies = [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))]
    return {name for body in bodies for node in body.body for name in _targets(node)}


@cache
def _imports(tree: ast.Module) -> set[str]:
    """Return the names that a module imports: a function gives values of types from elsewhere, too."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {name.asname or name.name for node in nodes for name in node.names}


def _gives(tree: ast.Module) -> list[str]:
    """Return the texts in backticks of the section Gives."""
    text = (ast.get_docstring(tree) or "").partition("Gives:")[2].partition("\nGuarantees:")[0]
    return re.findall(r"`([^`]+)`", text)


MEMBERS = {name for tree in TREES.values() for name in _defined(tree)}


def _imported() -> dict[str, set[str]]:
    """Return for each module the names that other modules of the product take from it."""
    used = defaultdict(set)
    for tree in TREES.values():
        aliases = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "apc":
                module = (node.module or "").partition(".")[2]
                for name in node.names:
                    used[module].add(name.name)
                    inner = f"{module}.{name.name}".lstrip(".")
                    aliases |= {name.asname or name.name: inner} if inner in MODULES else {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                used[aliases.get(node.value.id, "")].add(node.attr)
    return used


def _exists(name: str, tree: ast.Module | None = None) -> bool:
    """Return whether a dotted name is a module, or defined in a module or in the given tree."""
    parts = name.split(".")
    known = _defined(tree) | _imports(tree) | {node.name for node in _functions(tree)} if tree else set()
    if parts[0] in known and (len(parts) == 1 or parts[0][0].isupper()):
        return set(parts[1:]) <= MEMBERS
    for cut in range(len(parts), 0, -1):
        module = ".".join(parts[:cut])
        paths = [path for full, path in MODULES.items() if f".{full}".endswith(f".{module}")]
        if any(set(parts[cut:]) <= _defined(TREES[path]) for path in paths):
            return True
    return False


def test_modules_state_a_contract_and_functions_their_parameters() -> None:
    missing = []
    for path, tree in TREES.items():
        text = ast.get_docstring(tree) or ""
        if not text or not (path.name.startswith("__") or all(head in text for head in HEADS)):
            missing.append(str(path))
        for node in _functions(tree):
            count = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs)
            # The docstring of a command is its help; options have their own help.
            command = any("command" in ast.unparse(decorator) for decorator in node.decorator_list)
            if count >= MANY and node.name[0] != "_" and not command:
                section = "Parameters\n-" in (ast.get_docstring(node) or "")
                missing += [] if section else [f"{path}: {node.name}"]
    assert not missing, "\n".join(missing)


def test_a_contract_gives_names_that_the_module_defines() -> None:
    stale = [
        f"{module}: {text}"
        for module, path in MODULES.items()
        for text in _gives(TREES[path])
        if NAME.fullmatch(text) and not set(text.split(".")) <= _defined(TREES[path]) | _imports(TREES[path])
    ]
    assert not stale, "\n".join(stale)


def test_a_contract_gives_every_public_name_that_other_modules_import() -> None:
    imported = _imported()
    missing = [
        f"{module}: {node.name}"
        for module, path in MODULES.items()
        if not path.name.startswith("__")
        for node in TREES[path].body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        if node.name[0] != "_" and node.name in imported[module]
        if node.name not in _gives(TREES[path])
    ]
    assert not missing, "\n".join(missing)


def test_a_reference_in_a_docstring_or_comment_names_what_exists() -> None:
    """In "(see `lift`)" the name is a module, a name in one, or a name of the same file."""
    stale = [
        f"{module}: {name}"
        for module, path in MODULES.items()
        for reference in re.findall(r"\(see ([^)]*)\)", path.read_text(encoding="utf-8"))
        for name in re.findall(r"`([\w.]+)`", reference)
        if not _exists(name, TREES[path])
    ]
    assert not stale, "\n".join(stale)


def test_the_description_of_a_package_names_modules_that_exist() -> None:
    stale = [
        f"{module}: {name}"
        for module, path in MODULES.items()
        if path.name == "__init__.py"
        for name in re.findall(r"`([\w.]+)`", ast.get_docstring(TREES[path]) or "")
        if not _exists(name)
    ]
    compiler = ast.get_docstring(TREES[ROOT / "compiler" / "__init__.py"]) or ""
    listed = set(re.findall(r"`(\w+)`", compiler))
    inside = {module.rpartition(".")[2] for module in MODULES if module.startswith("compiler.")}
    assert not stale, "\n".join(stale)
    assert listed == inside


def test_a_readme_names_modules_that_exist() -> None:
    """A dotted name that begins with a folder or module of the product, in backticks or a code block."""
    first_parts = {part for module in MODULES for part in module.split(".")}
    stale = []
    for path in sorted((ROOT / "runtime").rglob("README.md")):
        text = path.read_text(encoding="utf-8")
        names = re.findall(r"`(\w+\.[\w.]+)`", text) + re.findall(r"^    (\w+\.[\w.]+)  ", text, re.MULTILINE)
        stale += [
            f"{path}: {name}"
            for name in names
            if name.partition(".")[0] in first_parts and not name.endswith(SUFFIXES) and not _exists(name)
        ]
        results = re.findall(r"→ (\w+)$", text, re.MULTILINE)
        stale += [f"{path}: {name}" for name in results if name not in MEMBERS]
    assert not stale, "\n".join(stale)
