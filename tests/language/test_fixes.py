"""A fix is text that can be pasted: it is no sentence, and what it calls of `apc` exists.

The fixes are read from the syntax trees of the program. A value that is known at run time only is an `X`.
"""

from __future__ import annotations

import ast
import functools
import re
import shlex
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path

import click
import pytest

from apc.cli.commands import apc
from tests.topologies import ROOT

FILES = [path for folder in ("compiler", "runtime") for path in sorted((ROOT / folder).rglob("*.py"))]
Values = Mapping[str, list[ast.expr]]

# One word or unknown text; an option; a program with arguments; `key: value`, `name = value` and other
# expressions; a heading with its unit; a quantity; quotes and brackets, which are empty here.
PASTABLE = re.compile(
    r"""\S*$ | X+\W | --\w | (apc|apt|chmod|mkdir|mv|pip|rm)\s | -\s | [\w.]+(\[\])?:\s
    | ,\s\w | [\w.]+(\[\])*\s?[=*/^+<-] | [\w.]+\s\[\]$ | -?[\d.]+\s\S+$ | \[\]""",
    re.VERBOSE,
)
SENTENCE = re.compile(
    r"(a|an|another|fewer|more|no|other|smaller|some|such|the|use|wider|with|write)\b", re.I
)


def _assigned(nodes: list[ast.AST]) -> dict[str, list[ast.expr]]:
    """Return the expressions that are assigned to each name, also by tuples."""
    result: dict[str, list[ast.expr]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign):
            pairs = [(target, node.value) for target in node.targets]
        elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.NamedExpr) and node.value is not None:
            pairs = [(node.target, node.value)]
        else:
            continue
        for target, value in pairs:
            names = [(target, value)]
            if isinstance(target, ast.Tuple):
                sides = [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]
                tuples = [side.elts for side in sides if isinstance(side, ast.Tuple)]
                names = [pair for side in tuples for pair in zip(target.elts, side, strict=False)]
            for name, item in names:
                if isinstance(name, ast.Name):
                    result.setdefault(name.id, []).append(item)
    return result


def _texts(node: ast.expr, values: Values, seen: frozenset[str] = frozenset()) -> list[str]:
    """Return the texts that an expression can have; names within a text are known only if constant."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else ["X"]
    if isinstance(node, ast.Name) and node.id in values and node.id not in seen:
        seen |= {node.id}
        return [text for item in values[node.id] for text in _texts(item, values, seen)]
    if isinstance(node, ast.JoinedStr):
        return ["".join(_texts(part, values, seen)[0] for part in node.values)]
    if isinstance(node, ast.FormattedValue):
        texts = _texts(node.value, values, seen) if isinstance(node.value, ast.Name) else []
        return texts if len(texts) == 1 else ["X"]
    if isinstance(node, ast.IfExp):
        return _texts(node.body, values, seen) + _texts(node.orelse, values, seen)
    if isinstance(node, ast.BoolOp):
        return [text for item in node.values for text in _texts(item, values, seen)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        both = _texts(node.left, values, seen), _texts(node.right, values, seen)
        return [left + right for left, right in product(*both)]
    return ["X"]


def _fixes() -> Iterator[tuple[str, str]]:
    """Yield the place and text of each fix in the program."""
    texts = {path: path.read_text(encoding="utf-8") for path in FILES}
    trees = {
        path: ast.parse(text)
        for path, text in texts.items()
        if re.search(r"\bfix\b|Diagnostic\(|fault\(", text)
    }
    scopes = [
        (path, scope, list(ast.walk(scope)))
        for path, tree in trees.items()
        for scope in ast.walk(tree)
        if isinstance(scope, ast.FunctionDef)
    ]
    # By each function with a parameter `fix` its place among the arguments.
    places, private = {"Diagnostic": 5}, dict[tuple[Path, str], int]()
    for path, scope, _ in scopes:
        names = [argument.arg for argument in scope.args.args if argument.arg != "self"]
        if "fix" in names and scope.name.startswith("_"):
            private[path, scope.name] = names.index("fix")
        elif "fix" in names:
            places[scope.name] = names.index("fix")
    constants = {path: _assigned([*tree.body]) for path, tree in trees.items()}
    for path, _, nodes in scopes:
        values = None
        for node in nodes:
            if not isinstance(node, ast.Call):
                continue
            given = [item.value for item in node.keywords if item.arg == "fix"]
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            place = private.get((path, name), places.get(name))
            given += [] if place is None else node.args[place : place + 1]
            for fix in given:
                values = values or constants[path] | _assigned(nodes)
                for text in dict.fromkeys(_texts(fix, values)):
                    yield f"{path.relative_to(ROOT)}:{fix.lineno}", text


@functools.cache
def fixes() -> list[tuple[str, str]]:
    """Return the place and text of each alternative of each fix in the program."""
    return sorted({(place, one) for place, text in _fixes() for one in text.split(", or ") if one})


def _parts(text: str) -> list[str]:
    """Return a text's parts between commas outside of brackets and quotes."""
    bare = text
    while (inner := re.sub(r"\{[^{}]*\}|\[[^\[\]]*\]|\([^()]*\)|\"[^\"]*\"|'[^']*'", "\0", bare)) != bare:
        bare = inner
    return bare.replace("\0", "[]").split(", ")


@pytest.mark.whole
def test_a_fix_is_no_sentence() -> None:
    assert len(fixes()) > 200
    sentences = [
        (place, text)
        for place, text in fixes()
        if SENTENCE.match(text) or not all(PASTABLE.match(part) for part in _parts(text))
    ]
    assert sentences == []


@pytest.mark.parametrize(
    "text",
    [
        "fewer peers that differ",
        "a range up to 1 s",
        "another --out than sweep.csv",
        "names such as 'cube.x'",
        "periods that are simple multiples of one another",
        "peers: {user: {table: users.csv}}, with one row for each peer",
        "apc analyze with --set, one value at a time",
    ],
)
def test_a_sentence_is_recognized(text: str) -> None:
    assert SENTENCE.match(text) or not all(PASTABLE.match(part) for part in _parts(text))


def _accepts(name: str, words: list[str]) -> bool:
    """Return whether a command parses arguments; their values are not converted."""
    command = apc.get_command(click.Context(apc), name)
    assert command is not None, name
    context = click.Context(command, info_name=name, help_option_names=["-h", "--help"])
    try:
        _, rest, _ = command.make_parser(context).parse_args(list(words))
    except click.UsageError:
        return False
    return not rest


@pytest.mark.whole
def test_a_fix_that_calls_apc_is_parsed() -> None:
    names = apc.list_commands(click.Context(apc))
    calls = [(place, text) for place, text in fixes() if re.match("(apc |--)[a-z]", text)]
    wrong = []
    for place, text in calls:
        words = shlex.split(text)
        tried = [words[1]] if words[0] == "apc" else names
        words = words[2:] if words[0] == "apc" else words
        if not any(name in names and _accepts(name, words) for name in tried):
            wrong.append((place, text))
    assert len(calls) > 60 and wrong == []
