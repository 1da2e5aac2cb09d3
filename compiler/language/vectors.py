"""Expansion of vectors: one scalar expression for each entry of an expression over vectors.

Takes: `Expr` and `Equation`, and the size of every name: 0 for a number.
Gives: `written_out`, `written_equation`, `number_of`; `entry`, `entries`, `whole_and_index`, `by_vector`,
`sizes_of`.
Guarantees: an expanded expression has no vectors; each part keeps its location in the text; wrong sizes are
errors with a fix.
Does not: check units, or resolve names.

Equations between vectors hold for each entry, as in Modelica (Modelica Language Specification 3.6, section
10.6): terms of a sum and branches have the same size, a number scales a vector, an operator or function of
one number is applied to each entry. The entries of `a.x` are `a.x[1]`, `a.x[2]`, … A product of two vectors
is written `dot` or `cross`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial, reduce
from itertools import islice
from operator import attrgetter
from typing import NoReturn, TypeVar

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, location_in
from apc.compiler.language.expression import (
    CONDITIONS,
    FUNCTIONS,
    MAX_LENGTH,
    Call,
    Equation,
    Expr,
    Name,
    NumberLiteral,
    as_written,
    format_expression,
    walk,
)

T = TypeVar("T")
SIZES = (2, 3)

# The arguments of an operation that must be numbers, and the arguments that are not expanded.
NUMBERS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(CONDITIONS, (0, 1)),
    **dict.fromkeys(("/", "hold", "interpolate"), (1,)),
    "if": (0,),
}
UNCHANGED: dict[str, tuple[int, ...]] = {"sample": (1,), "interpolate": (0,)}

# An expanded expression: the entries of a vector, or one number; None if a size is not yet known.
Written = tuple[Expr, ...] | None
SizeOf = Callable[[tuple[str, ...]], int | None]


def entry(name: str, index: int) -> str:
    """Return the name of an entry of a vector, with an index from 1."""
    return f"{name}[{index}]"


def entries(name: str, size: int) -> tuple[str, ...]:
    """Return the names of the entries of a vector, or the name of a number if `size` is 0."""
    return tuple(entry(name, k + 1) for k in range(size)) if size else (name,)


def whole_and_index(name: str) -> tuple[str, int]:
    """Return the name of the vector and the index of one of its entries; for a number its name and 0."""
    vector, bracket, index = name.rstrip("]").rpartition("[")
    return (vector, int(index)) if bracket and name.endswith("]") else (name, 0)


def by_vector(items: Iterable[T], name: Callable[[T], str] = attrgetter("name")) -> dict[str, list[T]]:
    """Return items grouped by vector name; a scalar item is a group of its own."""
    vectors: dict[str, list[T]] = {}
    for item in items:
        vectors.setdefault(whole_and_index(name(item))[0], []).append(item)
    return vectors


def sizes_of(names: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], int]:
    """Return the size of each vector whose entries are among the names."""
    sizes: dict[tuple[str, ...], int] = {}
    for parts in names:
        if parts[-1].endswith("]"):
            vector, index = whole_and_index(parts[-1])
            sizes[*parts[:-1], vector] = max(index, sizes.get((*parts[:-1], vector), 0))
    return sizes


def written_out(expr: Expr, size_of: SizeOf, text: str, location: SourceLocation) -> Written:
    """Return the expanded expression: one expression for each entry of a vector, or one for a number.

    The result is None if the size is not yet known.

    Parameters
    ----------
    expr
        The tree; its offsets refer to `text`.
    size_of
        The function that returns the size of a name: 0 for a number, None if unknown.
    text, location
        The text, and its location.

    Raises
    ------
    ApcError
        E328 an expanded expression that is too long, E406 different sizes, E407 a vector instead of a number
        or the reverse.
    """
    written = _VectorWriter(size_of, text, location).written(expr)
    for tree in written or (expr,):
        if len(list(islice(walk(tree), MAX_LENGTH + 1))) > MAX_LENGTH:
            message = (
                f"the expression has more than {MAX_LENGTH} terms, all entries included; give a "
                "subexpression a name"
            )
            raise ApcError(Diagnostic("E328", location_in(location, text, expr.start), message))
    return written


def written_equation(equation: Equation, size_of: SizeOf) -> tuple[Equation, ...]:
    """Return one scalar equation for each entry of an equation between vectors.

    Raises the errors of `written_out`, and E406 if the sides have different sizes.
    """
    writer = _VectorWriter(size_of, equation.text, equation.location)
    sides = (equation.left, equation.right)
    written = [written_out(side, size_of, equation.text, equation.location) or (side,) for side in sides]
    writer.agree(sides, written)
    return tuple(replace(equation, left=lhs, right=rhs) for lhs, rhs in zip(*written, strict=True))


def number_of(expr: Expr, text: str, location: SourceLocation) -> Expr:
    """Return an expression over numbers with `dot`, `cross` and `norm` expanded. Raises E407 for a vector."""
    return _VectorWriter(lambda _: 0, text, location).number(expr)


class _VectorWriter:
    """The expansion of one text; raises the first error."""

    def __init__(self, size_of: SizeOf, text: str, location: SourceLocation) -> None:
        self.size_of, self.text, self.location = size_of, text, location

    def fail(
        self, code: str, at: Expr, expected: str, got: str = "", fix: str = "", advice: str = ""
    ) -> NoReturn:
        """Raise an error located at a part of the expression."""
        message, location = as_written(at, self.text), location_in(self.location, self.text, at.start)
        raise ApcError(Diagnostic(code, location, message, expected, got, fix, advice))

    def written(self, expr: Expr) -> Written:
        """Return the expanded expression: a tuple of entries, or of one number.

        The result is None if the size is unknown.
        """
        match expr:
            case NumberLiteral() | Call("count"):  # the number of peers is a number for every argument
                return (expr,)
            case Name(path):
                size = self.size_of(path)
                named = () if size is None else entries(path[-1], size)
                return tuple(replace(expr, parts=(*path[:-1], name)) for name in named) or None
        word, parts = expr.function, expr.arguments
        if word == "{":
            if len(parts) not in SIZES:
                expected = f"{' or '.join(map(str, SIZES))} entries"
                self.fail("E406", expr, expected, f"{len(parts)}")
            return tuple(map(self.number, parts))
        if word in ("dot", "cross", "norm"):
            return self.product(expr)
        if word == "^":
            inner, power = map(format_expression, parts)
            base = self.written(parts[0]) or parts[:1]
            if _is_vector(base):
                fix = f"dot({inner}, {inner})" if power == "2" else f"norm({inner})^{power}"
                self.fail("E407", expr, "a number before ^", _size(base), fix)
            return self.each(expr, [base, parts[1:]])
        numbers, skipped = NUMBERS.get(word, ()), UNCHANGED.get(word, ())
        written = [
            (part,) if k in skipped else (self.number(part),) if k in numbers else self.written(part)
            for k, part in enumerate(parts)
        ]
        if word == "age":  # all entries of a vector are in the same packet, with one age
            return (replace(expr, arguments=(written[0] or parts)[:1]),)
        is_vector = [_is_vector(part) for part in written]
        if word != "*":
            # A function has scalar arguments in addition to vectors.
            equal = [k for k in range(len(parts)) if k not in (*numbers, *skipped)]
            equal = [k for k in equal if is_vector[k] or word not in FUNCTIONS]
            self.agree([parts[k] for k in equal], [written[k] for k in equal])
        elif all(is_vector):
            left, right = map(format_expression, parts)
            got, advice = f"two, {left} and {right}", f"the scalar product is dot({left}, {right})"
            self.fail("E407", expr, "at most one vector in a product", got, advice=advice)
        return self.each(expr, written)

    def product(self, expr: Call) -> Written:
        """Return the expanded `dot`, `cross` or `norm`; every part has the location of the expression."""
        word, vectors = expr.function, list[tuple[Expr, ...]]()
        for argument in expr.arguments:
            if (written := self.written(argument)) is None:
                return None if word == "cross" else (NumberLiteral(Fraction(0)),)
            if not _is_vector(written):
                shown = [format_expression(part) for part in expr.arguments]
                fix = {"norm": f"abs({shown[0]})", "dot": "*".join(shown)}.get(word, "")
                got = f"the number {as_written(argument, self.text)}"
                self.fail("E407", expr, "a vector" if word == "norm" else "two vectors", got, fix)
            vectors.append(written)
        self.agree(expr.arguments, vectors)

        def call(word: str, *parts: Expr) -> Expr:
            """Return a node at the location of the expression."""
            return replace(expr, function=word, arguments=parts)

        a, b = vectors[0], vectors[-1]
        if word == "cross":
            pairs = ((0, 1),) if len(a) == 2 else ((1, 2), (2, 0), (0, 1))
            return tuple(call("-", call("*", a[i], b[j]), call("*", a[j], b[i])) for i, j in pairs)
        if word == "dot":
            return (reduce(partial(call, "+"), map(partial(call, "*"), a, b)),)
        squares = (call("^", x, NumberLiteral(Fraction(2))) for x in a)
        return (call("sqrt", reduce(partial(call, "+"), squares)),)

    def number(self, expr: Expr) -> Expr:
        """Return the expanded expression of a number. Raises E407 for a vector."""
        written = self.written(expr) or (expr,)
        if _is_vector(written):
            self.fail("E407", expr, "a number", _size(written), self.of_vector(expr))
        return written[0]

    def agree(self, parts: Sequence[Expr], written: Sequence[Written]) -> None:
        """Raise E406 if parts have different sizes."""
        pairs = [(part, other) for part, other in zip(parts, written, strict=True) if other is not None]
        for part, other in pairs[1:]:
            model, first = pairs[0]
            if len(first) == len(other):
                continue
            fix = "" if _is_vector(first) else self.of_vector(part)
            if not _is_vector(other):
                fix = self.of_number(part, len(first))
            self.fail("E406", part, f"{_size(first)} like {as_written(model, self.text)}", _size(other), fix)

    def each(self, call: Call, parts: Sequence[Written]) -> Written:
        """Return a call with expanded arguments: one call for each entry if an argument is a vector."""
        size = max(len(part or ()) for part in parts)
        if None in parts and size < 2:
            return None
        replaced = (part or (argument,) for part, argument in zip(parts, call.arguments, strict=True))
        rows = zip(*(part if _is_vector(part) else part * size for part in replaced), strict=True)
        return tuple(replace(call, arguments=row) for row in rows)

    def of_number(self, expr: Expr, size: int) -> str:
        """Return the vector to propose instead of a number, empty if there is none.

        Zero is a vector of zeros, and an entry is the vector that it belongs to. No other number determines
        the direction of a vector.
        """
        if isinstance(expr, NumberLiteral) and not expr.value:
            return "{" + ", ".join("0" * size) + "}"
        if isinstance(expr, Name):
            path = (*expr.parts[:-1], whole_and_index(expr.parts[-1])[0])
            return ".".join(path) if path != expr.parts and self.size_of(path) == size else ""
        return ""

    def of_vector(self, expr: Expr) -> str:
        """Return the text of numbers to propose instead of a vector, empty if there is none."""
        of = format_expression(expr)
        if isinstance(expr, Call) and all(isinstance(part, NumberLiteral) for part in expr.arguments):
            return ""  # of a vector of numbers, such as {1, 2}
        return f"{entry(of, 1)}, or norm({of})" if isinstance(expr, Name) else f"norm({of})"


def _is_vector(written: Written) -> bool:
    """Return whether an expanded expression is a vector."""
    return written is not None and len(written) > 1


def _size(written: tuple[Expr, ...]) -> str:
    """Return the text of the size of an expanded expression."""
    return f"a vector of {len(written)}" if _is_vector(written) else "a number"
