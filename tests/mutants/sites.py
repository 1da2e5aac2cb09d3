"""What may be changed in a line of the product: operators, signs, constants, indices, terms, arguments.

Takes a module's text, gives its mutants in the order of the text; the same text gives the same mutants.
"""

from __future__ import annotations

import ast
import itertools
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_SWAPPED_ARITHMETIC = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "//",
    ast.Pow: "*",
    ast.MatMult: "*",
}
_SWAPPED_COMPARISON = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
# A term whose text has one of these words charges an error: leaving it out must make some bound too small.
_CHARGES = ("radius", "radii", "error", "round", "eps", "ulp", "unit")

# Functions whose arguments may stand in any order.
_SYMMETRIC = ("max", "min", "math.gcd", "math.lcm", "np.maximum", "np.minimum", "np.allclose")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: of `path` (relative to the root) from `start` to `end` (offsets into its text)."""

    path: str
    line: int
    start: int
    end: int
    kind: str
    before: str
    after: str

    def applied(self, text: str) -> str:
        """Return the module's text with the change made."""
        return text[: self.start] + self.after + text[self.end :]


def mutants_of(root: Path, path: str) -> list[Mutant]:
    """Return all mutants of a module. Annotations, messages and what only a type checker reads are left."""
    text = (root / path).read_text(encoding="utf-8")
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    lines = text.splitlines()

    def offset(line: int, column: int) -> int:
        # ast counts columns in bytes of UTF-8.
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    found = []
    for node, replaced, kind in _changes(ast.parse(text)):
        start = offset(node.lineno, node.col_offset)
        end = offset(node.end_lineno or node.lineno, node.end_col_offset or 0)
        before = text[start:end]
        found.append(Mutant(path, node.lineno, start, end, kind, before, f"({replaced})"))
    return sorted(found, key=lambda mutant: (mutant.start, mutant.end, mutant.after))


def draw(root: Path, count: int, seed: int, within: str = "") -> list[Mutant]:
    """Return so many mutants of the product, drawn with a seed, as many of one kind as of another."""
    paths = sorted(
        str(path.relative_to(root))
        for folder in ("compiler", "runtime")
        for path in (root / folder).rglob("*.py")
        if str(path.relative_to(root)).startswith(within)
    )
    kinds: dict[str, list[Mutant]] = {}
    for path in paths:
        for mutant in mutants_of(root, path):
            kinds.setdefault(mutant.kind, []).append(mutant)
    chance = random.Random(seed)
    shuffled = [chance.sample(kinds[kind], min(count, len(kinds[kind]))) for kind in sorted(kinds)]
    in_turn = [mutant for row in itertools.zip_longest(*shuffled) for mutant in row if mutant is not None]
    return in_turn[:count]


def _changes(tree: ast.Module) -> Iterator[tuple[ast.expr, str, str]]:
    """Yield an expression, the text that takes its place, and what kind of change that is."""
    for node in _evaluated(tree):
        match node:
            case ast.BinOp(left=left, op=op, right=right) if not _is_text(left) and not _is_text(right):
                a, b = ast.unparse(left), ast.unparse(right)
                if type(op) in _SWAPPED_ARITHMETIC:
                    yield node, f"({a}) {_SWAPPED_ARITHMETIC[type(op)]} ({b})", "operator"
                if isinstance(op, ast.Add | ast.Sub):
                    charge = any(word in b.lower() for word in _CHARGES)
                    yield node, a, "charge of rounding" if charge else "dropped term"
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _SWAPPED_COMPARISON:
                a, b = ast.unparse(left), ast.unparse(right)
                yield node, f"({a}) {_SWAPPED_COMPARISON[type(op)]} ({b})", "comparison"
            case ast.BoolOp(op=op, values=values):
                word = " or " if isinstance(op, ast.And) else " and "
                yield node, word.join(f"({ast.unparse(value)})" for value in values), "operator"
            case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
                yield node, ast.unparse(operand), "sign"
            case ast.Constant(value=bool(value)):
                yield node, str(not value), "constant"
            case ast.Constant(value=int(value)):
                yield node, str(value + 1), "constant"
            case ast.Constant(value=float(value)):
                yield node, repr(value * 1.5 if value else 1.0), "constant"
            case ast.Call(func=func, args=[first, second, *rest]) if not (
                ast.unparse(func) in _SYMMETRIC
                or any(isinstance(value, ast.Starred) for value in (first, second))
            ):
                swapped = [ast.unparse(value) for value in (second, first, *rest, *node.keywords)]
                yield node, f"{ast.unparse(func)}({', '.join(swapped)})", "swapped arguments"


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _evaluated(node: ast.AST) -> Iterator[ast.expr]:
    """Yield the expressions that run: no annotations, no texts of messages, no parts of `__all__`."""
    match node:
        case ast.JoinedStr():
            return
        case ast.Raise():
            return
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return
        case ast.expr():
            yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _evaluated(child)
