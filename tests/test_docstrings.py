"""Every public name says what it is; every documented function documents all it takes."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.topologies import ROOT

FILES = sorted([*(ROOT / "compiler").glob("*.py"), *(ROOT / "runtime").rglob("*.py")])
MANY = 5  # arguments that a sentence can't tell apart
Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


@dataclass(frozen=True)
class Name:
    """A public class, function or method: where it stands, what it says of itself, what it takes."""

    name: str
    told: str
    takes: tuple[str, ...] | None  # None of a class
    decorators: tuple[str, ...]


def public(tree: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, Documented]]:
    """Yield the public classes, functions and methods of a module, with their names."""
    for node in tree.body:
        if isinstance(node, Documented) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{prefix}{node.name}.")


def read_file(path: Path) -> tuple[str, list[Name]]:
    """Return what a file says of itself, and its public names."""
    tree, file = ast.parse(path.read_text(encoding="utf-8")), path.relative_to(ROOT)
    found = []
    for name, node in public(tree):
        takes = None
        if not isinstance(node, ast.ClassDef):
            own = node.args
            takes = tuple(one.arg for one in (*own.posonlyargs, *own.args, *own.kwonlyargs))
        decorators = tuple(map(ast.unparse, node.decorator_list))
        found.append(Name(f"{file}: {name}", ast.get_docstring(node) or "", takes, decorators))
    return ast.get_docstring(tree) or "", found


@functools.cache
def read() -> dict[str, tuple[str, list[Name]]]:
    """Return the same of every file, each parsed once."""
    return {str(path.relative_to(ROOT)): read_file(path) for path in FILES}


def names() -> list[Name]:
    return [one for _, listed in read().values() for one in listed]


def test_every_module_says_what_it_takes_gives_guarantees_and_leaves() -> None:
    words = ("Takes:", "Gives:", "Guarantees:", "Does not:")
    for file, (told, _) in read().items():
        assert told, file
        assert Path(file).name.startswith("__") or all(word in told for word in words), file


def test_every_public_name_has_a_docstring() -> None:
    # `_` is the name of the implementations that singledispatch chooses between.
    given = re.compile(r"\.(setter|register)\Z")
    assert not [one.name for one in names() if not one.told and not any(map(given.search, one.decorators))]


def test_who_takes_many_arguments_documents_them() -> None:
    # A command's docstring is its help; its options have a help of their own.
    missing = [
        one.name
        for one in names()
        if len(one.takes or ()) >= MANY
        and not any("command(" in decorator for decorator in one.decorators)
        and "Parameters\n-" not in one.told
    ]
    assert not missing


def test_a_parameters_section_names_every_parameter() -> None:
    wrong = []
    for one in names():
        section = re.search(r"Parameters\n-+\n(.*?)(?:\n\n\w[\w ]*\n-+\n|\Z)", one.told, re.S)
        if section is None or one.takes is None:
            continue
        headings = [line for line in section.group(1).splitlines() if line and not line[0].isspace()]
        listed = {word.strip(" *") for line in headings for word in line.split(":")[0].split(",")}
        if listed != (taken := {*one.takes} - {"self", "cls"}):
            wrong.append(f"{one.name}: {listed ^ taken}")
    assert not wrong
