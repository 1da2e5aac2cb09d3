"""Numbers in the text: quantities, words that represent numbers, and expressions over named numbers.

Takes: scalars of YAML. Gives: `ValueBinding`, the value as written, by `read_binding` or `read_free`;
`ScalarValue`, the number, by `settle`; `resolve_in_order`, `renamed`; `Bounds`, `is_quantity`,
`text_location`; `AlreadyReportedError`.
Guarantees: dimensions agree and bounds hold, or an error with its location is raised or recorded.
Does not: handle sections, parts or peers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from graphlib import CycleError, TopologicalSorter

from apc.compiler.errors import ApcError, Mistakes, SourceLocation, location_in
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import FUNCTIONS, Expr, Name, format_expression, names, transform
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.unit_check import ANY, dimension_of
from apc.compiler.language.unit_text import format_dimension, format_si
from apc.compiler.language.units import COMMON, parse_quantity, parse_unit, quantity
from apc.compiler.language.vectors import number_of
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import brief, either_comma, fault, named, unknown, value_of
from apc.compiler.wording import choice_fixes, choices_text, with_unit

PEERS = ("peers",)

# A quantity starts with a number or a ratio such as 1/90, followed by nothing or a unit. A unit may start
# with a parenthesis or, after a space, with 1/ as in 1/s. A number followed by an operator is an expression.
_QUANTITY = re.compile(
    r"[+-]?\s*([0-9]|\.[0-9])[0-9.]*([eE][+-]?[0-9]+)?(\s*/\s*[0-9][0-9.]*)?"
    r"(\s*([^\W\d_]|[°%µΩ(]).*|\s+1\s*[*·⋅/].*|\s*)\Z",
    re.DOTALL,
)
# Thousands separators as in 1 000 N/m, a decimal comma, and a product of numbers with a unit: 2*pi*100 N/m.
_SPACED = re.compile(r"[+-]?[0-9]{1,3}([ _'\u00a0\u2009][0-9]{3})+(?![0-9])")
_COMMA = re.compile(r"([+-]?[0-9]+),([0-9]+)([^0-9,].*)?", re.DOTALL)
_COMPUTED = re.compile(r"(?P<numbers>[-+*/^().\d\s]*(?:pi[-+*/^().\d\s]*)*)(?P<unit>[^\W\d_°%µΩ].*)")
_ONE_NUMBER = "one number and its unit"
_WORD_NUMBER = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ValueBinding:
    """A number as written: `number` in SI units with the `unit` of the text, or an `expression`
    over names.
    """

    number: Fraction | None
    expression: Expr | None
    dimension: Dimension
    location: SourceLocation
    unit: str = ""


@dataclass(frozen=True, slots=True)
class ScalarValue:
    """A number in SI units.

    `expression` is its tree if it depends on other numbers; `unit` is the unit of the text.
    """

    number: Fraction
    dimension: Dimension
    expression: Expr | None
    location: SourceLocation
    unit: str = ""

    def __str__(self) -> str:
        """Return the number in the unit of the text; in SI units if there is none."""
        if not self.unit:
            return format_si(float(self.number), self.dimension)
        return with_unit(f"{float(self.number / parse_unit(self.unit, self.location).scale):.6g}", self.unit)


class AlreadyReportedError(ApcError):
    """The error of a name is already reported: a value that depends on the name dependencies no message of
    its own.
    """

    def __init__(self) -> None:
        """Create the error without a mistake."""
        self.mistakes = ()


@dataclass(frozen=True, slots=True)
class Bounds:
    """The range of a number, in SI units; `unit` and `scale` are the unit in messages.

    With `words`, only the values that they name are valid.
    """

    unit: str
    scale: Fraction
    minimum: Fraction | None = None
    exclusive_minimum: bool = False
    maximum: Fraction | None = None
    words: tuple[tuple[str, Fraction], ...] = ()

    def fault(self, number: Fraction) -> str:
        """Return the violated bound as text, empty if there is none."""
        if self.words and number not in dict(self.words).values():
            return choices_text(self.words, self.unit, float(self.scale))
        least = self.minimum
        if least is not None and (number < least or (self.exclusive_minimum and number == least)):
            shown = with_unit(self._shown(least), self.unit)
            return f"more than {shown}" if self.exclusive_minimum else f"{shown} or more"
        if self.maximum is not None and number > self.maximum:
            return f"{with_unit(self._shown(self.maximum), self.unit)} or less"
        return ""

    def check(self, value: ScalarValue, subject: str, mistakes: Mistakes) -> None:
        """Record an error (E207) for a number out of bounds; the fix omits a sign."""
        if not self.fault(value.number):
            return
        bounds = self
        if value.unit:  # the bounds in the unit that the user wrote
            bounds = replace(self, unit=value.unit, scale=parse_unit(value.unit, value.location).scale)
        expected, got = (
            bounds.fault(value.number),
            with_unit(bounds._shown(value.number), bounds.unit),
        )
        fix = choice_fixes(self.words, "" if subject.endswith("]") else f"{subject}: ")
        if value.unit and value.expression is None and value.number < 0 and not self.fault(-value.number):
            fix = got.removeprefix("-") if subject.endswith("]") else f"{subject}: {got.removeprefix('-')}"
        mistakes.add("E207", value.location, subject, expected=expected, got=got, fix=fix)

    def _shown(self, number: Fraction) -> str:
        """Return the text of a number in the unit of messages."""
        return f"{float(number / self.scale):.12g}"


def is_quantity(text: str) -> bool:
    """Return whether a text is a number with or without a unit, in contrast to an expression."""
    return bool(_QUANTITY.match(text) or _WORD_NUMBER.match(text))


def text_location(node: Node) -> SourceLocation:
    """Return the location of a scalar's text: after the opening quote, if there is one."""
    quoted = isinstance(node, Scalar) and not node.plain
    return node.location.shifted(1) if quoted else node.location


def read_binding(
    node: Node,
    subject: str,
    dimension: Dimension,
    unit: str,
    known: Callable[[tuple[str, ...]], Dimension | None],
    names_known: Collection[str],
    words: Collection[tuple[str, Fraction]] = (),
) -> ValueBinding:
    """Return the number of a node: a quantity, a word that represents a number, or an expression.

    Parameters
    ----------
    node
        The YAML node.
    subject
        The name of the number, for messages.
    dimension, unit
        The required dimension and unit.
    known
        The function that returns the dimension of a name in an expression, or None if the name is unknown.
    names_known
        All known names, for messages.
    words
        Words that represent numbers.

    Raises
    ------
    ApcError
        E203 a node that is not a single value, E204 a unit of a wrong dimension, E206 for every unknown name;
        and the errors of `quantity`, `parse_expression` and `dimension_of`.
    """
    text, location = value_of(node, subject, f"1 {unit}".removesuffix(" 1")), node.location
    number, written_unit = dict(words).get(text), ""
    if number is None:
        if words and text.isidentifier() and text not in names_known:
            expected, fix = choices_text(words), choice_fixes(words, f"{subject}: ")
            raise fault("E206", location, subject, expected, brief(text), fix)
        _refuse_marks(text, location, subject)
        _refuse_computed(text, location, subject, unit)
        _refuse_reciprocal(text, location, subject, unit, names_known)
        if not is_quantity(text):
            location = text_location(node)
            tree = _tree(text, location)
            actual = _dimension(tree, text, location, subject, known, names_known)
            if actual is not None and actual != ANY and (actual != dimension or actual.clashes(dimension)):
                got, fix, advice = _misfit(tree, actual, dimension, unit)
                fix = fix and f"{subject}: {fix}"
                expected = "a plain number" if unit == "1" else unit
                raise fault("E204", location, subject, expected, f"{brief(text)}, which {got}", fix, advice)
            return ValueBinding(None, tree, dimension, location)
        _refuse_trailing(text, location, subject, names_known, unit, known)
        _refuse_mixture(text, location, subject, names_known)
        parsed = quantity(text, location, subject=subject, unit=unit)
        number, written_unit = parsed.value, parsed.unit.text
    return ValueBinding(number, None, dimension, location, written_unit)


def _refuse_marks(text: str, location: SourceLocation, subject: str) -> None:
    """Raise ApcError for a number with a decimal comma or with thousands separators."""
    bare = text.strip()
    if (match := _COMMA.fullmatch(bare)) is not None:
        raise fault(
            "E221", location, subject, "a decimal point", brief(text), either_comma(subject, *match.groups())
        )
    if (match := _SPACED.match(bare)) is not None:
        joined = re.sub(r"[^0-9+-]", "", match[0]) + bare[match.end() :]
        expected = "a number without separators"
        raise fault("E221", location, subject, expected, brief(text), f"{subject}: {joined}")


def _refuse_computed(text: str, location: SourceLocation, subject: str, unit: str) -> None:
    """Raise ApcError for a computed number followed by a unit, such as 2*pi*100 N/m."""
    match = _COMPUTED.fullmatch(text.strip())
    if match is None or is_quantity(text) or not match["numbers"].strip():
        return
    fix = ""
    with Mistakes():
        number = evaluate(parse_expression(match["numbers"], location), lambda _: 0, location)
        if parse_unit(match["unit"], location).dimension == parse_unit(unit, location).dimension:
            fix = f"{subject}: {float(number):.9g} {match['unit']}"
    if fix:
        raise fault("E204", location, subject, _ONE_NUMBER, brief(text), fix)


# A number, a slash and a unit.
_RECIPROCAL = re.compile(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*/\s*([A-Za-z]\w*)")


def _refuse_reciprocal(
    text: str, location: SourceLocation, subject: str, unit: str, names_known: Collection[str]
) -> None:
    """Raise ApcError for a number divided by a unit, such as 5 /s; its unit is written 1/s."""
    match = _RECIPROCAL.fullmatch(text.strip())
    if match is None or match[2] not in COMMON or match[2] in names_known:
        return
    right = f"{match[1]} 1/{match[2]}"
    try:
        quantity(right, location, subject=subject, unit=unit)
    except ApcError as error:
        raise ApcError(replace(mistake, got=brief(text)) for mistake in error.mistakes) from None
    raise fault("E204", location, subject, "a numerator before /", brief(text), f"{subject}: {right}")


# A number next to a word, without a sign between them.
_BESIDE = re.compile(r"(?P<number>[+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*(?P<rest>\(*(?P<word>[A-Za-z]\w*))")


def _refuse_trailing(
    text: str,
    location: SourceLocation,
    subject: str,
    names_known: Collection[str],
    unit: str = "",
    known: Callable[[tuple[str, ...]], Dimension | None] = lambda _: None,
) -> None:
    """Raise ApcError for a number next to a name without an operator, such as 2pi*f.

    If the number is in `unit`, a product without a unit has advice instead of a fix; `known` returns the
    dimension of a name.
    """
    implicit_product = _BESIDE.match(text.strip())
    if implicit_product is None or implicit_product["word"] not in {*names_known, "pi", *FUNCTIONS}:
        return
    with Mistakes():
        parse_unit(implicit_product["word"], location)
        return
    right = f"{implicit_product['number']}*{text.strip()[implicit_product.start('rest') :]}"
    fix, advice = f"{subject}: {right}", ""
    if unit not in ("", "1"):
        try:
            _refuse_computed(right, location, subject, unit)
        except ApcError as error:  # a product of numbers with a unit
            raise ApcError(replace(mistake, got=brief(text)) for mistake in error.mistakes) from None
        with Mistakes():
            if (
                _dimension(_tree(right, location), right, location, subject, known, names_known)
                == DIMENSIONLESS
            ):
                fix, advice = "", f"multiply {right} by a parameter in {unit}"
    expected = f"* between {implicit_product['number']} and {implicit_product['word']}"
    raise fault("E204", location, subject, expected, brief(text), fix, advice)


def _refuse_mixture(text: str, location: SourceLocation, subject: str, names_known: Collection[str]) -> None:
    """Raise ApcError for a quantity with a unit that continues as an expression, such as 500
    N/m/(peers - 1).
    """
    for word in re.finditer(r"[A-Za-z]\w*", text):
        before = text[: word.start()].rstrip(" (")
        if word.group() in names_known and before[-1:] in ("*", "/", "+", "-"):
            with Mistakes():
                parse_unit(word.group(), location)
                return
            number, rest = before[:-1].strip(), text[len(before) - 1 :].strip()
            advice = f"define total: {number} in parameters and write {subject}: total{rest}"
            raise fault("E204", location, subject, _ONE_NUMBER, brief(text), advice=advice)


def _misfit(tree: Expr, actual: Dimension, due: Dimension, unit: str) -> tuple[str, str, str]:
    """Return the texts for an expression of a wrong dimension: its actual unit, the value of the fix, and
    the advice.
    """
    if actual == DIMENSIONLESS != due:
        return "has no unit", "", f"multiply it by a parameter in {unit}"
    if actual != due:
        return f"is in {format_dimension(actual)}", "", ""
    # The expression is a name, a sum or a choice: a product has no angle unit.
    text = format_expression(tree)
    whole = text if isinstance(tree, Name) else f"({text})"
    fix = f"2*pi*{whole}" if due.turning == "rad" else f"{whole}/(2*pi)"
    return f"is in {format_dimension(actual)}", fix, ""


def _tree(text: str, location: SourceLocation) -> Expr:
    """Return the parsed expression of a number."""
    return number_of(parse_expression(text, location), text, location)


def _dimension(
    tree: Expr,
    text: str,
    location: SourceLocation,
    subject: str,
    known: Callable[[tuple[str, ...]], Dimension | None],
    names_known: Collection[str],
) -> Dimension | None:
    """Return the dimension of an expression.

    Raises E206 for every unknown name, and the errors of `dimension_of`.
    """
    mistakes = Mistakes()
    for node in names(tree):
        if known(node.parts) is None:
            shown = ".".join(node.parts)
            at, got = location_in(location, text, node.start), f"{subject}: unknown name {named(shown)}"
            error = unknown("E206", at, got, shown, names_known)
            advice = f"write a number with its unit, or define {brief(shown)} in parameters"
            if not error.mistakes[0].fix and (shown in COMMON or set(names_known) <= set(PEERS)):
                advice = "a unit directly follows a number, as in 5 N/m" if shown in COMMON else advice
                error = fault("E206", at, got, advice=advice)
            mistakes.take(error)
    mistakes.raise_if_any()
    return dimension_of(tree, lambda name: known(name.parts), text, location)


def settle(binding: ValueBinding, number_of: Callable[[tuple[str, ...]], Fraction]) -> ScalarValue:
    """Return the value of a binding; `number_of` returns the value of a name."""
    if binding.expression is None:
        assert binding.number is not None
        return ScalarValue(binding.number, binding.dimension, None, binding.location, binding.unit)
    number = Fraction(evaluate(binding.expression, number_of, binding.location))
    return ScalarValue(number, binding.dimension, binding.expression, binding.location)


def read_free(node: Node, subject: str, others: Collection[str]) -> ValueBinding:
    """Return the number of a node with any unit: a quantity, or an expression.

    `others` are the names of other numbers; the names in the expression are checked later.
    """
    text, location = value_of(node, subject, "2000 N/m"), text_location(node)
    if not is_quantity(text):
        return ValueBinding(None, _tree(text, location), DIMENSIONLESS, location)
    _refuse_trailing(text, location, subject, others)
    parsed = parse_quantity(text, node.location)
    return ValueBinding(parsed.value, None, parsed.unit.dimension, node.location, parsed.unit.text)


def resolve_in_order(
    waiting: Mapping[str, ValueBinding], peers: int | None, mistakes: Mistakes
) -> dict[str, ScalarValue]:
    """Return the values of named numbers that depend on each other, evaluated in order of dependence.

    Parameters
    ----------
    waiting
        The numbers as written, by name.
    peers
        The value of the name `peers`; None if its error was reported.
    mistakes
        The collector of errors: E206 an unknown name, E209 a cycle, and errors of evaluation.

    Returns
    -------
    The values, in the order of `waiting`; the error of a missing value is recorded once, at its location.
    """
    dependencies = {
        name: {".".join(node.parts) for node in names(binding.expression)} if binding.expression else set()
        for name, binding in waiting.items()
    }
    try:
        order = [*TopologicalSorter(dependencies).static_order()]
    except CycleError as error:
        chain = error.args[1][:0:-1]
        first = min(range(len(chain)), key=lambda k: [*waiting].index(chain[k]))
        chain = [*chain[first:], *chain[:first], chain[first]]
        mistakes.add(
            "E209", waiting[chain[0]].location, f"cyclic dependency of parameters: {' → '.join(chain)}"
        )
        return {}
    values = {"peers": ScalarValue(Fraction(peers or 0), DIMENSIONLESS, None, SourceLocation(""))}
    if peers is None:
        values.clear()
    for name in order:
        if name in waiting and dependencies[name] & {*waiting, "peers"} <= values.keys():
            with mistakes:
                values[name] = _evaluated(name, waiting[name], values)
    return {name: values[name] for name in waiting if name in values}


def _evaluated(name: str, binding: ValueBinding, values: Mapping[str, ScalarValue]) -> ScalarValue:
    """Return the value of one named number, from the `values` of the numbers it depends on."""

    def dimension(parts: tuple[str, ...]) -> Dimension | None:
        """Return the dimension of a name, None if it has no value."""
        value = values.get(".".join(parts))
        return None if value is None else value.dimension

    if (tree := binding.expression) is not None:
        actual = _dimension(tree, format_expression(tree), binding.location, name, dimension, values)
        binding = replace(binding, dimension=DIMENSIONLESS if actual in (None, ANY) else actual)
    return settle(binding, lambda parts: values[".".join(parts)].number)


def renamed(tree: Expr, qualify: Callable[[tuple[str, ...]], tuple[str, ...]]) -> Expr:
    """Return an expression with every name replaced by its qualified name."""
    return transform(tree, lambda node: Name(qualify(node.parts)) if isinstance(node, Name) else None)
