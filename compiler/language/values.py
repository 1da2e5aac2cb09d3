"""Numbers in the text: quantities, words that stand for numbers, and expressions over named numbers.

Takes: scalars of YAML. Gives: `ValueBinding` (what was written) and `ScalarValue` (what it comes to).
Guarantees: dimensions agree and bounds hold, or a mistake says so at its place.
Does not: know sections, parts or peers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from graphlib import CycleError, TopologicalSorter

from apc.compiler.errors import ApcError, Mistakes, SourceLocation, place_in
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import FUNCTIONS, Expr, Name, format_expression, names, transform
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.unit_check import ANY, dimension_of
from apc.compiler.language.unit_text import format_dimension, format_si
from apc.compiler.language.units import parse_quantity, parse_unit, quantity
from apc.compiler.language.vectors import number_of
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import brief, either_comma, fault, text_of, unknown
from apc.compiler.words import with_unit

PEERS = ("peers",)

# A quantity starts with a number or a ratio such as 1/90; what follows is nothing or a unit, which may start
# with a parenthesis or, behind a space, as 1/s does. An operator behind the number makes it an expression.
_QUANTITY = re.compile(
    r"[+-]?\s*([0-9]|\.[0-9])[0-9.]*([eE][+-]?[0-9]+)?(\s*/\s*[0-9][0-9.]*)?"
    r"(\s*([^\W\d_]|[°%µΩ(]).*|\s+1\s*[*·⋅/].*|\s*)\Z",
    re.DOTALL,
)
# 1 000 N/m; and 2*pi*100 N/m, a product of numbers alone with a unit behind it.
_SPACED = re.compile(r"[+-]?[0-9]{1,3}([ _'\u00a0\u2009][0-9]{3})+(?![0-9])")
_COMMA = re.compile(r"([+-]?[0-9]+),([0-9]+)([^0-9,].*)?", re.DOTALL)
_COMPUTED = re.compile(r"(?P<numbers>[-+*/^().\d\s]*(?:pi[-+*/^().\d\s]*)*)(?P<unit>[^\W\d_°%µΩ].*)")
_NO_UNITS = "a number with its unit, or an expression without units"
_WORD_NUMBER = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ValueBinding:
    """A number as written: `number` in SI and the `unit` it was written in, or an `expression` over names."""

    number: Fraction | None
    expression: Expr | None
    dimension: Dimension
    place: SourceLocation
    unit: str = ""


@dataclass(frozen=True, slots=True)
class ScalarValue:
    """A number, in SI; `expression` is its tree if it depends on others; `unit` is that of its
    `ValueBinding`.
    """

    number: Fraction
    dimension: Dimension
    expression: Expr | None
    place: SourceLocation
    unit: str = ""

    def __str__(self) -> str:
        """Return the number in the unit in which it was written, without one in SI."""
        if not self.unit:
            return format_si(float(self.number), self.dimension)
        return with_unit(f"{float(self.number / parse_unit(self.unit, self.place).scale):.6g}", self.unit)


class AlreadyReportedError(ApcError):
    """Raised by a look-up for a name whose own fault was reported: what depends on it needs no message."""

    def __init__(self) -> None:
        """Hold no mistake."""
        self.mistakes = ()


@dataclass(frozen=True, slots=True)
class Bounds:
    """Where a number must lie, in SI; `unit` is the one its messages use."""

    unit: str
    scale: Fraction
    minimum: Fraction | None = None
    open_minimum: bool = False
    maximum: Fraction | None = None

    def fault(self, number: Fraction) -> str:
        """Return what the bounds ask for if the number breaks them, else an empty text."""
        least = self.minimum
        if least is not None and (number < least or (self.open_minimum and number == least)):
            shown = f"{self._shown(least)} {self.unit}"
            return f"more than {shown}" if self.open_minimum else f"{shown} or more"
        if self.maximum is not None and number > self.maximum:
            return f"{self._shown(self.maximum)} {self.unit} or less"
        return ""

    def check(self, value: ScalarValue, what: str, mistakes: Mistakes) -> None:
        """Record a number that breaks the bounds."""
        if expected := self.fault(value.number):
            got = f"{self._shown(value.number)} {self.unit}"
            mistakes.add("E207", value.place, what, expected=expected, got=got)

    def _shown(self, number: Fraction) -> str:
        return f"{float(number / self.scale):.12g}"


def is_quantity(text: str) -> bool:
    """Return whether a text is meant as a number with or without a unit, not as an expression."""
    return bool(_QUANTITY.match(text) or _WORD_NUMBER.match(text))


def text_place(node: Node) -> SourceLocation:
    """Return where a scalar's text starts: behind the opening quote, if it has one."""
    quoted = isinstance(node, Scalar) and not node.plain
    return node.place.shifted(1) if quoted else node.place


def read_binding(
    node: Node,
    what: str,
    dimension: Dimension,
    unit: str,
    known: Callable[[tuple[str, ...]], Dimension | None],
    names_known: Collection[str],
    words: Collection[tuple[str, Fraction]] = (),
) -> ValueBinding:
    """Read a number: a quantity, a word that stands for one, or an expression.

    Parameters
    ----------
    node
        Where it stands.
    what
        What it is, for messages.
    dimension, unit
        What it must be in.
    known
        The dimension of a name an expression may use, or None.
    names_known
        All these names, for messages.
    words
        Words that stand for numbers.

    Raises
    ------
    ApcError
        E203 no single value, E204 a unit that does not fit, E206 for every name that isn't known; and those
        of `quantity`, `parse_expression` and `dimension_of`.
    """
    text, place = text_of(node, what, f"{what}: 1 {unit}"), node.place
    number, own = dict(words).get(text), ""
    if number is None:
        _refuse_marks(text, place, what)
        _refuse_computed(text, place, what, unit)
        if not is_quantity(text):
            place = text_place(node)
            tree = _tree(text, place)
            actual = _dimension(tree, text, place, what, known, names_known)
            if actual is not None and actual != ANY and (actual != dimension or actual.clashes(dimension)):
                got, hint = _misfit(tree, actual, dimension, unit)
                raise fault("E204", place, what, unit, f"{brief(text)}, which {got}", f"{what}: {hint}")
            return ValueBinding(None, tree, dimension, place)
        _refuse_beside(text, place, what, names_known)
        _refuse_mixture(text, place, what, names_known)
        read = quantity(text, place, what=what, unit=unit)
        number, own = read.value, read.unit.text
    return ValueBinding(number, None, dimension, place, own)


def _refuse_marks(text: str, place: SourceLocation, what: str) -> None:
    """Raise ApcError for a number with a decimal comma, or whose thousands are set apart."""
    bare = text.strip()
    if (match := _COMMA.fullmatch(bare)) is not None:
        raise fault("E221", place, what, "a decimal point", brief(text), either_comma(what, *match.groups()))
    if (match := _SPACED.match(bare)) is not None:
        joined = re.sub(r"[^0-9+-]", "", match[0]) + bare[match.end() :]
        expected = "a number without spaces or marks inside"
        raise fault("E221", place, what, expected, brief(text), f"{what}: {joined}")


def _refuse_computed(text: str, place: SourceLocation, what: str, unit: str) -> None:
    """Raise ApcError for numbers that are computed and have a unit behind them, as 2*pi*100 N/m."""
    match = _COMPUTED.fullmatch(text.strip())
    if match is None or is_quantity(text) or not match["numbers"].strip():
        return
    hint = ""
    with Mistakes():
        number = evaluate(parse_expression(match["numbers"], place), lambda _: 0, place)
        if parse_unit(match["unit"], place).dimension == parse_unit(unit, place).dimension:
            hint = f"{what}: {float(number):.9g} {match['unit']}"
    if hint:
        raise fault("E204", place, what, _NO_UNITS, brief(text), hint)


# A number beside a word, and no sign between them.
_BESIDE = re.compile(r"(?P<number>[+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*(?P<rest>\(*(?P<word>[A-Za-z]\w*))")


def _refuse_beside(text: str, place: SourceLocation, what: str, names_known: Collection[str]) -> None:
    """Raise ApcError for a number beside a name, with no sign between them, as 2pi*f."""
    beside = _BESIDE.match(text.strip())
    if beside is None or beside["word"] not in {*names_known, "pi", *FUNCTIONS}:
        return
    with Mistakes():
        parse_unit(beside["word"], place)
        return
    hint = f"{what}: {beside['number']}*{text.strip()[beside.start('rest') :]}"
    raise fault("E204", place, what, _NO_UNITS, brief(text), hint)


def _refuse_mixture(text: str, place: SourceLocation, what: str, names_known: Collection[str]) -> None:
    """Raise ApcError for a quantity with a unit that goes on as an expression, as 500 N/m/(peers - 1)."""
    for word in re.finditer(r"[A-Za-z]\w*", text):
        before = text[: word.start()].rstrip(" (")
        if word.group() in names_known and before[-1:] in ("*", "/", "+", "-"):
            with Mistakes():
                parse_unit(word.group(), place)
                return
            number, rest = before[:-1].strip(), text[len(before) - 1 :].strip()
            hint = f"{what}: total{rest}, with parameters: {{total: {number}}}"
            raise fault("E204", place, what, _NO_UNITS, brief(text), hint)


def _misfit(tree: Expr, actual: Dimension, due: Dimension, unit: str) -> tuple[str, str]:
    """Return what is wrong with an expression of another dimension than is due, and what to write."""
    if actual != due:
        got = "has no unit" if actual == DIMENSIONLESS else f"is in {format_dimension(actual)}"
        return got, f"1 {unit}".removesuffix(" 1")
    # Of a name, a sum or a choice: no product counts cycles or radians.
    text = format_expression(tree)
    whole = text if isinstance(tree, Name) else f"({text})"
    hint = f"2*pi*{whole}" if due.turning == "rad" else f"{whole}/(2*pi)"
    return f"is in {format_dimension(actual)}", hint


def _tree(text: str, place: SourceLocation) -> Expr:
    return number_of(parse_expression(text, place), text, place)


def _dimension(
    tree: Expr,
    text: str,
    place: SourceLocation,
    what: str,
    known: Callable[[tuple[str, ...]], Dimension | None],
    names_known: Collection[str],
) -> Dimension | None:
    """Return an expression's dimension. Raises E206 for every name that isn't known, or as `dimension_of`."""
    mistakes = Mistakes()
    for node in names(tree):
        if known(node.parts) is None:
            shown = ".".join(node.parts)
            got = f"{what} names {brief(shown)}, which is no parameter here"
            mistakes.take(unknown("E206", place_in(place, text, node.start), got, shown, names_known))
    mistakes.raise_if_any()
    return dimension_of(tree, lambda name: known(name.parts), text, place)


def settle(binding: ValueBinding, number_of: Callable[[tuple[str, ...]], Fraction]) -> ScalarValue:
    """Return what a binding comes to, given what its names come to. Raises ApcError if it has no value."""
    if binding.expression is None:
        assert binding.number is not None
        return ScalarValue(binding.number, binding.dimension, None, binding.place, binding.unit)
    number = Fraction(evaluate(binding.expression, number_of, binding.place))
    return ScalarValue(number, binding.dimension, binding.expression, binding.place)


def read_free(node: Node, what: str, others: Collection[str]) -> ValueBinding:
    """Read a number of any unit: a quantity, or an expression over others whose names are checked later."""
    text, place = text_of(node, what, f"{what}: 2000 N/m"), text_place(node)
    if not is_quantity(text):
        return ValueBinding(None, _tree(text, place), DIMENSIONLESS, place)
    _refuse_beside(text, place, what, others)
    parsed = parse_quantity(text, node.place)
    return ValueBinding(parsed.value, None, parsed.unit.dimension, node.place, parsed.unit.text)


def resolve_in_order(
    waiting: Mapping[str, ValueBinding], peers: int | None, mistakes: Mistakes
) -> dict[str, ScalarValue]:
    """Settle named numbers that depend on each other, in the order in which they can be known.

    Parameters
    ----------
    waiting
        The numbers as written, by name.
    peers
        What the name `peers` stands for; None where that was reported as faulty.
    mistakes
        Takes E206 a name that isn't known, E209 a circle, and those of evaluating.

    Returns
    -------
    The values, in the order of `waiting`; the fault of one that isn't there was reported once, where it is.
    """
    needs = {
        name: {".".join(node.parts) for node in names(binding.expression)} if binding.expression else set()
        for name, binding in waiting.items()
    }
    try:
        order = [*TopologicalSorter(needs).static_order()]
    except CycleError as error:
        chain = error.args[1][:0:-1]
        first = min(range(len(chain)), key=lambda k: [*waiting].index(chain[k]))
        chain = [*chain[first:], *chain[:first], chain[first]]
        mistakes.add("E209", waiting[chain[0]].place, f"parameters depend in a circle: {' → '.join(chain)}")
        return {}
    settled = {"peers": ScalarValue(Fraction(peers or 0), DIMENSIONLESS, None, SourceLocation(""))}
    if peers is None:
        settled.clear()
    for name in order:
        if name in waiting and needs[name] & {*waiting, "peers"} <= settled.keys():
            with mistakes:
                settled[name] = _settled(name, waiting[name], settled)
    return {name: settled[name] for name in waiting if name in settled}


def _settled(name: str, binding: ValueBinding, settled: Mapping[str, ScalarValue]) -> ScalarValue:
    def dimension(parts: tuple[str, ...]) -> Dimension | None:
        value = settled.get(".".join(parts))
        return None if value is None else value.dimension

    if (tree := binding.expression) is not None:
        actual = _dimension(tree, format_expression(tree), binding.place, name, dimension, settled)
        binding = replace(binding, dimension=DIMENSIONLESS if actual in (None, ANY) else actual)
    return settle(binding, lambda parts: settled[".".join(parts)].number)


def renamed(tree: Expr, whole: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Expr:
    """Return an expression with every name made whole."""
    return transform(tree, lambda node: Name(whole(node.parts)) if isinstance(node, Name) else None)
