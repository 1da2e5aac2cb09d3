"""Equations of components as LaTeX.

Takes: expression trees of `apc.compiler.language.expression`. Gives: `equation_latex`.
Guarantees: parentheses where the operators need them.
Does not: simplify.
"""

from __future__ import annotations

import re

from apc.compiler.language.expression import LEVELS, PRODUCT, Call, Equation, Expr, Name, NumberLiteral
from apc.compiler.language.expression import format_expression as as_text

OPERATORS = {"*": r"\,", "<=": r"\le", ">=": r"\ge", "!=": r"\ne", "==": "=", "and": r"\land", "or": r"\lor"}
TEMPLATES = {
    "abs": r"\left|{}\right|",
    "sqrt": r"\sqrt{{{}}}",
    "norm": r"\left\|{}\right\|",
    "floor": r"\left\lfloor{}\right\rfloor",
    "der": r"\tfrac{{\mathrm{{d}}}}{{\mathrm{{d}}t}}\,{}",
}
ATOM = len(LEVELS)


def equation_latex(equation: Equation) -> str:
    """Return the LaTeX text of an equation, without delimiters."""
    return f"{_latex(equation.left)[0]} = {_latex(equation.right)[0]}"


def _latex(expr: Expr) -> tuple[str, int]:
    """Return the LaTeX text of an expression, and the precedence of its operator."""
    if isinstance(expr, NumberLiteral):
        text = as_text(expr).replace("pi", r"\pi")
        return re.sub(r"(\d)e(-?\d+)", r"\1\\cdot 10^{\2}", text), ATOM
    if isinstance(expr, Name):
        return _name(expr), ATOM
    word, parts = expr.function, [_latex(argument) for argument in expr.arguments]
    texts = [text for text, _ in parts]
    if word == "/":
        return rf"\frac{{{texts[0]}}}{{{texts[1]}}}", ATOM
    if word == "if":
        return _cases(expr), ATOM
    if word in LEVELS:
        return _operation(word, parts), LEVELS[word]
    if word in TEMPLATES:
        text = texts[0] if word != "der" or parts[0][1] == ATOM else rf"\left({texts[0]}\right)"
        return TEMPLATES[word].format(text), ATOM
    arguments = r",\,".join(texts)
    return rf"\operatorname{{{word}}}\left({arguments}\right)", ATOM


def _operation(word: str, parts: list[tuple[str, int]]) -> str:
    """Return the LaTeX text of an operator with its operands, in parentheses where needed."""
    level = LEVELS[word]
    least = (ATOM, 0) if word == "^" else (level, level + 1)
    texts = [
        text if have >= need else rf"\left({text}\right)"
        for (text, have), need in zip(parts, least, strict=False)
    ]
    if word == "^":
        return rf"{{{texts[0]}}}^{{{texts[1]}}}"
    if word in ("neg", "not"):
        text = texts[0] if parts[0][1] >= PRODUCT else rf"\left({parts[0][0]}\right)"
        return (r"\lnot " if word == "not" else "-") + text
    return f" {OPERATORS.get(word, word)} ".join(texts)


def _cases(expr: Call) -> str:
    """Return the LaTeX text of a conditional expression, one row per branch."""
    rows: list[str] = []
    branch: Expr = expr
    while isinstance(branch, Call) and branch.function == "if":
        condition, value, branch = branch.arguments
        rows.append(rf"{_latex(value)[0]} & \text{{if }} {_latex(condition)[0]}")
    rows.append(rf"{_latex(branch)[0]} & \text{{otherwise}}")
    return r"\begin{cases}" + r" \\ ".join(rows) + r"\end{cases}"


def _name(name: Name) -> str:
    """Return the LaTeX text of a name; the period of a clock is T with the clock as its index."""
    parts = []
    for part in name.parts:
        if clock := re.fullmatch(r"interval\((\w+)\)", part):
            parts.append(rf"T_{{\text{{{clock[1]}}}}}")
            continue
        word, _, index = part.partition("[")
        escaped = word.replace("_", r"\_")
        text = word if len(word) == 1 else rf"\textit{{{escaped}}}"
        parts.append(f"{text}_{{{index[:-1]}}}" if index else text)
    return ".".join(parts)
