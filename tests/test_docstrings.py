"""Every public name says what it is; every documented function documents all it takes."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.topologies import ROOT

FILES = sorted([*(ROOT / "compiler").glob("*.py"), *(ROOT / "runtime").rglob("*.py")])
MANY = 5  # arguments that a sentence can't tell apart
Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def public(tree: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, Documented]]:
    """Yield the public classes, functions and methods of a module, with their names."""
    for node in tree.body:
        if isinstance(node, Documented) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", FILES, ids=named)
def test_every_module_says_what_it_is(path: Path) -> None:
    assert ast.get_docstring(parsed(path)), named(path)


@pytest.mark.parametrize("path", [f for f in FILES if not f.name.startswith("__")], ids=named)
def test_every_module_says_what_it_takes_gives_guarantees_and_leaves(path: Path) -> None:
    text = ast.get_docstring(parsed(path)) or ""
    for word in ("Takes:", "Gives:", "Guarantees:", "Does not:"):
        assert word in text, f"{named(path)}: {word}"


@pytest.mark.parametrize("path", FILES, ids=named)
def test_every_public_name_has_a_docstring(path: Path) -> None:
    # `_` is the name of the implementations that singledispatch chooses between.
    missing = [
        name
        for name, node in public(parsed(path))
        if not ast.get_docstring(node)
        and not any(getattr(d, "attr", "") in ("setter", "register") for d in node.decorator_list)
    ]
    assert not missing


@pytest.mark.parametrize("path", FILES, ids=named)
def test_who_takes_many_arguments_documents_them(path: Path) -> None:
    # A command's docstring is its help; its options have a help of their own.
    missing = [
        name
        for name, node in public(parsed(path))
        if not isinstance(node, ast.ClassDef)
        and len([*node.args.args, *node.args.kwonlyargs]) >= MANY
        and not any("command(" in ast.unparse(one) for one in node.decorator_list)
        and "Parameters\n-" not in (ast.get_docstring(node) or "")
    ]
    assert not missing


@pytest.mark.parametrize("path", FILES, ids=named)
def test_a_parameters_section_names_every_parameter(path: Path) -> None:
    for name, node in public(parsed(path)):
        if isinstance(node, ast.ClassDef):
            continue
        section = re.search(
            r"Parameters\n-+\n(.*?)(?:\n\n\w[\w ]*\n-+\n|\Z)", ast.get_docstring(node) or "", re.S
        )
        if section is None:
            continue
        headings = [line for line in section.group(1).splitlines() if line and not line[0].isspace()]
        listed = {word.strip(" *") for line in headings for word in line.split(":")[0].split(",")}
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        taken = {argument.arg for argument in arguments} - {"self", "cls"}
        assert listed == taken, f"{named(path)}: {name}"
