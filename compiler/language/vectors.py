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

from apc.compiler.errors import ApcError, Mistake, Place, place_in
from apc.compiler.language.expression import (
    COMPARISONS,
    Binary,
    Call,
    Equation,
    Expr,
    Name,
    Number,
    Vector,
    children,
    format_expression,
    operation,
    rebuild,
    walk,
)
from apc.compiler.language.grammar import MAX_LENGTH

T = TypeVar("T")
SIZES = (2, 3)
VECTOR_WORDS = ("{", "dot", "norm", "cross")  # what makes or takes vectors is written with one of these
LONGEST_REPEATED = 20  # characters of a number that a message writes once for each entry

# Which parts of an operation are numbers, never vectors, and which are left as they are.
NUMBERS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys((*COMPARISONS, "and", "or", "Not"), (0, 1)),
    **dict.fromkeys(("/", "hold", "interpolate"), (1,)),
    "Conditional": (0,),
}
AS_THEY_ARE: dict[str, tuple[int, ...]] = {"sample": (1,), "interpolate": (0,)}

# An expression written out: a number, a vector's entries, or None where a name's size isn't known yet.
Written = Expr | tuple[Expr, ...] | None
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
    """Return items by the vectors whose entries their names are of; what is of a number stands alone."""
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


def written_out(expr: Expr, size_of: SizeOf, text: str, place: Place) -> Written:
    """Return an expression for each entry of a vector, one for a number.

    Parameters
    ----------
    expr
        The tree; its offsets count in `text`.
    size_of
        Gives the size of a name, None when it isn't known.
    text, place
        The text, and where it starts.

    Returns
    -------
    The entries of a vector, or the tree of a number; None when its size hangs on names without one.

    Raises
    ------
    ApcError
        E328 it gets too long, E406 sizes that differ, E407 a vector where a number is due or the reverse.
    """
    writer = _Writer(size_of, text, place)
    written = writer.written(expr)
    for tree in written if isinstance(written, tuple) else (written or expr,):
        if len(list(islice(walk(tree), MAX_LENGTH + 1))) > MAX_LENGTH:
            what = f"entry by entry this has more than {MAX_LENGTH} terms: give a part of it a name"
            writer.fail("E328", expr, what)
    return written


def written_equation(equation: Equation, size_of: SizeOf) -> tuple[Equation, ...]:
    """Return an equation for each entry; raises as `written_out`, also where its sides differ in size."""
    writer = _Writer(size_of, equation.text, equation.place)
    sides = (equation.left, equation.right)
    left, right = (written_out(side, size_of, equation.text, equation.place) for side in sides)
    writer.agree(sides, (left, right))
    if not isinstance(left, tuple) or not isinstance(right, tuple):
        assert isinstance(left, Expr) and isinstance(right, Expr)
        return (replace(equation, left=left, right=right),)
    return tuple(replace(equation, left=lhs, right=rhs) for lhs, rhs in zip(left, right, strict=True))


def number_of(expr: Expr, text: str, place: Place) -> Expr:
    """Return an expression over numbers without `dot`, `norm` and the like. Raises E407 if it is a vector."""
    return _Writer(lambda _: 0, text, place).number(expr)


class _Writer:
    """Writes one text out; the first mistake is raised."""

    def __init__(self, size_of: SizeOf, text: str, place: Place) -> None:
        self.size_of, self.text, self.place = size_of, text, place

    def source(self, expr: Expr) -> str:
        """Return a part as it is written, or as it would be when it comes from somewhere else."""
        return self.text[expr.start : expr.end] or format_expression(expr)

    def fail(
        self, code: str, at: Expr, what: str, expected: str = "", got: str = "", hint: str = ""
    ) -> NoReturn:
        raise ApcError(Mistake(code, place_in(self.place, self.text, at.start), what, expected, got, hint))

    def written(self, expr: Expr) -> Written:
        match expr:
            case Number() | Call("count"):  # peers are counted, whatever they send
                return expr
            case Name(path):
                size = self.size_of(path)
                if size is None:
                    return None
                names = (replace(expr, parts=(*path[:-1], name)) for name in entries(path[-1], size))
                return tuple(names) if size else expr
            case Vector():
                if len(expr.entries) not in SIZES:
                    got = f"{len(expr.entries)}"
                    self.fail("E406", expr, self.source(expr), f"{_or(SIZES)} entries", got)
                return tuple(map(self.number, expr.entries))
            case Call("dot" | "cross" | "norm"):
                return self.product(expr)
            case Binary("^"):
                inner, power = format_expression(expr.left), format_expression(expr.right)
                hint = f"dot({inner}, {inner})" if power == "2" else f"norm({inner})^{power}"
                return self.each(expr, [self.number(expr.left, hint), expr.right])
        parts, word = children(expr), operation(expr)
        numbers, skipped = NUMBERS.get(word, ()), AS_THEY_ARE.get(word, ())
        written = [
            part if k in skipped else self.number(part) if k in numbers else self.written(part)
            for k, part in enumerate(parts)
        ]
        is_vector = [isinstance(part, tuple) for part in written]
        if word == "age":  # of a vector, which travels in one packet
            return rebuild(expr, written[0][:1]) if isinstance(written[0], tuple) else expr
        if word == "*" and all(is_vector):
            hint = f"dot({', '.join(map(format_expression, parts))})"
            self.fail("E407", expr, self.source(expr), "one vector at most in a product", "two", hint)
        if word != "*":
            # A function takes numbers beside vectors.
            equal = [k for k in range(len(parts)) if k not in (*numbers, *skipped)]
            equal = [k for k in equal if is_vector[k] or not isinstance(expr, Call)]
            self.agree([parts[k] for k in equal], [written[k] for k in equal])
        return self.each(expr, written)

    def product(self, expr: Call) -> Written:
        """Write out `dot`, `cross` and `norm`, each piece of which stands where the whole does."""
        vectors: list[tuple[Expr, ...]] = []
        for argument in expr.arguments:
            written = self.written(argument)
            if written is None:
                return None if expr.function == "cross" else Number(Fraction(0))
            if not isinstance(written, tuple):
                shown = [format_expression(part) for part in expr.arguments]
                hint = {"norm": f"abs({shown[0]})", "dot": "*".join(shown)}.get(expr.function, "")
                self.fail(
                    "E407",
                    argument,
                    f"{self.source(argument)} in {expr.function}",
                    "a vector",
                    "a number",
                    hint,
                )
            vectors.append(written)
        self.agree(expr.arguments, vectors)

        def binary(operator: str, left: Expr, right: Expr) -> Expr:
            return Binary(operator, left, right, start=expr.start, end=expr.end)

        a, b = vectors[0], vectors[-1]
        if expr.function == "cross":
            pairs = ((0, 1),) if len(a) == 2 else ((1, 2), (2, 0), (0, 1))
            turned = [binary("-", binary("*", a[i], b[j]), binary("*", a[j], b[i])) for i, j in pairs]
            return tuple(turned) if len(a) > 2 else turned[0]
        norm, two = expr.function == "norm", Number(Fraction(2))
        terms = (binary("^", x, two) if norm else binary("*", x, y) for x, y in zip(a, b, strict=True))
        total = reduce(partial(binary, "+"), terms)
        return replace(expr, function="sqrt", arguments=(total,)) if norm else total

    def number(self, expr: Expr, hint: str = "") -> Expr:
        """Return an expression that has to be a number."""
        written = self.written(expr)
        if isinstance(written, tuple):
            self.fail(
                "E407", expr, self.source(expr), "a number", _size(written), hint or self.of_vector(expr)
            )
        return expr if written is None else written

    def agree(self, parts: Sequence[Expr], written: Sequence[Written]) -> None:
        """Refuse parts that are not of one size."""
        known = [(part, other) for part, other in zip(parts, written, strict=True) if other is not None]
        for part, other in known[1:]:
            model, first = known[0]
            size, length = _length(first), _length(other)
            if length == size:
                continue
            text, hint = format_expression(part), "" if size else self.of_vector(part)
            if not length and len(text) <= LONGEST_REPEATED:
                hint = "{" + ", ".join([text] * size) + "}"
            expected = f"{_size(first)} like {self.source(model)}"
            self.fail("E406", part, self.source(part), expected, _size(other), hint)

    def each(self, node: Expr, parts: Sequence[Written]) -> Written:
        """Return a node of other parts: one for each entry, where one of them is a vector."""
        size = max(map(_length, parts), default=0)
        if None in parts and not size:
            return None
        known = (before if part is None else part for part, before in zip(parts, children(node), strict=True))
        rows = zip(
            *(part if isinstance(part, tuple) else (part,) * (size or 1) for part in known), strict=True
        )
        nodes = tuple(rebuild(node, row) for row in rows)
        return nodes if size else nodes[0]

    def of_vector(self, expr: Expr) -> str:
        """Return numbers that somebody may have meant who wrote a vector."""
        of = format_expression(expr)
        return f"{entry(of, 1)}, or norm({of})" if isinstance(expr, Name) else f"norm({of})"


def _length(written: Written) -> int:
    return len(written) if isinstance(written, tuple) else 0


def _size(written: Written) -> str:
    return f"a vector of {len(written)}" if isinstance(written, tuple) else "a number"


def _or(numbers: Iterable[int]) -> str:
    return " or ".join(map(str, numbers))
