"""Vectors written out: an expression of vectors to one for each entry.

Takes: `Expr` and `Equation`, and the size of every name: 0 for a number.
Gives: `written_out`, `written_equation`, `number_of`; `entry`, `entries`, `whole_and_index`, `by_vector`,
`sizes_of`.
Guarantees: what is written out holds no vector; each piece keeps the place it has in the text; sizes that do
not fit are refused with what to write.
Does not: check units, or know what a name is of.

Equations between vectors hold for each entry, as in Modelica (Modelica Language Specification 3.6, section
10.6): sums and branches are of one size, a number scales a vector, an operator or function of one number is
taken of each entry. The entries of `a.x` are `a.x[1]`, `a.x[2]`, … A product of two vectors is written `dot`
or `cross`.
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
    Call,
    Equation,
    Expr,
    Name,
    NumberLiteral,
    as_written,
    format_expression,
    walk,
)
from apc.compiler.language.grammar import MAX_LENGTH

T = TypeVar("T")
SIZES = (2, 3)
LONGEST_REPEATED = 20  # characters of a number that a message writes once for each entry

# Which parts of an operation are numbers, never vectors, and which are left as they are.
NUMBERS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(CONDITIONS, (0, 1)),
    **dict.fromkeys(("/", "hold", "interpolate"), (1,)),
    "if": (0,),
}
AS_THEY_ARE: dict[str, tuple[int, ...]] = {"sample": (1,), "interpolate": (0,)}

# An expression written out: the entries of a vector, one of a number; None where a size isn't known yet.
Written = tuple[Expr, ...] | None
SizeOf = Callable[[tuple[str, ...]], int | None]


def entry(name: str, index: int) -> str:
    """Return the name of a vector's entry, counted from 1."""
    return f"{name}[{index}]"


def entries(name: str, size: int) -> tuple[str, ...]:
    """Return the names that a declaration makes: those of a vector's entries, or the name of a number."""
    return tuple(entry(name, k + 1) for k in range(size)) if size else (name,)


def whole_and_index(name: str) -> tuple[str, int]:
    """Return the vector that an entry is of, and which it is; of a number its name and 0."""
    whole, bracket, index = name.rstrip("]").rpartition("[")
    return (whole, int(index)) if bracket and name.endswith("]") else (name, 0)


def by_vector(items: Iterable[T], name: Callable[[T], str] = attrgetter("name")) -> dict[str, list[T]]:
    """Return items grouped by the vectors of their entries; items of scalars are separate."""
    vectors: dict[str, list[T]] = {}
    for item in items:
        vectors.setdefault(whole_and_index(name(item))[0], []).append(item)
    return vectors


def sizes_of(names: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], int]:
    """Return the vectors whose entries are among names, and the size of each."""
    sizes: dict[tuple[str, ...], int] = {}
    for parts in names:
        if parts[-1].endswith("]"):
            whole, index = whole_and_index(parts[-1])
            sizes[*parts[:-1], whole] = max(index, sizes.get((*parts[:-1], whole), 0))
    return sizes


def written_out(expr: Expr, size_of: SizeOf, text: str, location: SourceLocation) -> Written:
    """Return an expression for each entry of a vector, one for a number; None if its size isn't known yet.

    Parameters
    ----------
    expr
        The tree; its offsets count in `text`.
    size_of
        Returns the size of a name, None if unknown.
    text, location
        The text, and where it starts.

    Raises
    ------
    ApcError
        E328 it gets too long, E406 sizes that differ, E407 a vector where a number is due or the reverse.
    """
    written = _VectorWriter(size_of, text, location).written(expr)
    for tree in written or (expr,):
        if len(list(islice(walk(tree), MAX_LENGTH + 1))) > MAX_LENGTH:
            message = f"entry by entry this has more than {MAX_LENGTH} terms: give a part of it a name"
            raise ApcError(Diagnostic("E328", location_in(location, text, expr.start), message))
    return written


def written_equation(equation: Equation, size_of: SizeOf) -> tuple[Equation, ...]:
    """Return an equation for each entry; raises as `written_out`, also where its sides differ in size."""
    writer = _VectorWriter(size_of, equation.text, equation.location)
    sides = (equation.left, equation.right)
    written = [written_out(side, size_of, equation.text, equation.location) or (side,) for side in sides]
    writer.agree(sides, written)
    return tuple(replace(equation, left=lhs, right=rhs) for lhs, rhs in zip(*written, strict=True))


def number_of(expr: Expr, text: str, location: SourceLocation) -> Expr:
    """Return an expression over numbers without `dot`, `norm` and the like. Raises E407 if it is a vector."""
    return _VectorWriter(lambda _: 0, text, location).number(expr)


class _VectorWriter:
    """Writes one text out; the first mistake is raised."""

    def __init__(self, size_of: SizeOf, text: str, location: SourceLocation) -> None:
        self.size_of, self.text, self.location = size_of, text, location

    def fail(
        self, code: str, at: Expr, expected: str, got: str = "", hint: str = "", within: str = ""
    ) -> NoReturn:
        message, location = (
            as_written(at, self.text) + within,
            location_in(self.location, self.text, at.start),
        )
        raise ApcError(Diagnostic(code, location, message, expected, got, hint))

    def written(self, expr: Expr) -> Written:
        match expr:
            case NumberLiteral() | Call("count"):  # peers are counted, whatever they send
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
            hint = f"dot({inner}, {inner})" if power == "2" else f"norm({inner})^{power}"
            return self.each(expr, [(self.number(parts[0], hint),), parts[1:]])
        numbers, skipped = NUMBERS.get(word, ()), AS_THEY_ARE.get(word, ())
        written = [
            (part,) if k in skipped else (self.number(part),) if k in numbers else self.written(part)
            for k, part in enumerate(parts)
        ]
        if word == "age":  # of a vector, which travels in one packet
            return (replace(expr, arguments=(written[0] or parts)[:1]),)
        is_vector = [_is_vector(part) for part in written]
        if word != "*":
            # A function has scalar arguments in addition to vectors.
            equal = [k for k in range(len(parts)) if k not in (*numbers, *skipped)]
            equal = [k for k in equal if is_vector[k] or word not in FUNCTIONS]
            self.agree([parts[k] for k in equal], [written[k] for k in equal])
        elif all(is_vector):
            hint = f"dot({', '.join(map(format_expression, parts))})"
            self.fail("E407", expr, "one vector at most in a product", "two", hint)
        return self.each(expr, written)

    def product(self, expr: Call) -> Written:
        """Expand `dot`, `cross` and `norm`, each part at the location of the expression."""
        word, vectors = expr.function, list[tuple[Expr, ...]]()
        for argument in expr.arguments:
            if (written := self.written(argument)) is None:
                return None if word == "cross" else (NumberLiteral(Fraction(0)),)
            if not _is_vector(written):
                shown = [format_expression(part) for part in expr.arguments]
                hint = {"norm": f"abs({shown[0]})", "dot": "*".join(shown)}.get(word, "")
                self.fail("E407", argument, "a vector", "a number", hint, f" in {word}")
            vectors.append(written)
        self.agree(expr.arguments, vectors)

        def call(word: str, *parts: Expr) -> Expr:
            return replace(expr, function=word, arguments=parts)

        a, b = vectors[0], vectors[-1]
        if word == "cross":
            pairs = ((0, 1),) if len(a) == 2 else ((1, 2), (2, 0), (0, 1))
            return tuple(call("-", call("*", a[i], b[j]), call("*", a[j], b[i])) for i, j in pairs)
        if word == "dot":
            return (reduce(partial(call, "+"), map(partial(call, "*"), a, b)),)
        squares = (call("^", x, NumberLiteral(Fraction(2))) for x in a)
        return (call("sqrt", reduce(partial(call, "+"), squares)),)

    def number(self, expr: Expr, hint: str = "") -> Expr:
        """Return an expression that has to be a number."""
        written = self.written(expr) or (expr,)
        if _is_vector(written):
            self.fail("E407", expr, "a number", _size(written), hint or self.of_vector(expr))
        return written[0]

    def agree(self, parts: Sequence[Expr], written: Sequence[Written]) -> None:
        """Refuse parts that are not of one size."""
        pairs = [(part, other) for part, other in zip(parts, written, strict=True) if other is not None]
        for part, other in pairs[1:]:
            model, first = pairs[0]
            if len(first) == len(other):
                continue
            text, hint = format_expression(part), "" if _is_vector(first) else self.of_vector(part)
            if not _is_vector(other) and len(text) <= LONGEST_REPEATED:
                hint = "{" + ", ".join([text] * len(first)) + "}"
            self.fail("E406", part, f"{_size(first)} like {as_written(model, self.text)}", _size(other), hint)

    def each(self, call: Call, parts: Sequence[Written]) -> Written:
        """Return a call of other arguments: one for each entry, where one of them is a vector."""
        size = max(len(part or ()) for part in parts)
        if None in parts and size < 2:
            return None
        replaced = (part or (before,) for part, before in zip(parts, call.arguments, strict=True))
        rows = zip(*(part if _is_vector(part) else part * size for part in replaced), strict=True)
        return tuple(replace(call, arguments=row) for row in rows)

    def of_vector(self, expr: Expr) -> str:
        """Return numbers that somebody may have meant who wrote a vector."""
        of = format_expression(expr)
        return f"{entry(of, 1)}, or norm({of})" if isinstance(expr, Name) else f"norm({of})"


def _is_vector(written: Written) -> bool:
    return written is not None and len(written) > 1


def _size(written: tuple[Expr, ...]) -> str:
    return f"a vector of {len(written)}" if _is_vector(written) else "a number"
