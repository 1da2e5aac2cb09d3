"""Modules say what they take and give, functions of many arguments document them; the rest Ruff asks for."""

from __future__ import annotations

import ast

from tests.topologies import ROOT

FILES = sorted([*(ROOT / "compiler").glob("*.py"), *(ROOT / "runtime").rglob("*.py")])
HEADS = ("Takes:", "Gives:", "Guarantees:", "Does not:")
MANY = 5  # arguments that a sentence can't tell apart


def test_modules_and_functions_of_many_arguments_say_what_they_take() -> None:
    missing = []
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        told = ast.get_docstring(tree) or ""
        if not told or not (path.name.startswith("__") or all(head in told for head in HEADS)):
            missing.append(str(path))
        classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_"]
        for node in [
            one for body in (tree, *classes) for one in body.body if isinstance(one, ast.FunctionDef)
        ]:
            taken = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs)
            # A command's docstring is its help; its options have a help of their own.
            command = any("command" in ast.unparse(one) for one in node.decorator_list)
            if taken >= MANY and node.name[0] != "_" and not command:
                section = "Parameters\n-" in (ast.get_docstring(node) or "")
                missing += [] if section else [f"{path}: {node.name}"]
    assert not missing
