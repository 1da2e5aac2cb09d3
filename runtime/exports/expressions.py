"""A kind's functions as expressions of Modelica.

Takes: a `casadi.Function` of scalar operations, and what its inputs are called.
Gives: `Text`, `number`, `identifier`, `unit_of_modelica`; `written`, `used_inputs`.
Guarantees: parentheses where Modelica's precedence asks for them and nowhere else; a condition is a Boolean,
never a number; a long part that is used again gets a name of its own.
Does not: know what a variable means.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from apc.compiler.interpolation import Interpolation
from apc.compiler.plain import straight, walk

# How tightly a text binds, loosest first.
IF, OR, AND, NOT, RELATION, SUM, PRODUCT, POWER, ATOM = range(9)

# Letters of an expression that is written again wherever it is used.
LONGEST = 120

_KEYWORDS = frozenset(
    re.findall(
        r"\w+",
        """
        algorithm and annotation block break class connect connector constant constrainedby der discrete
        each else elseif elsewhen encapsulated end enumeration equation expandable extends external
        false final flow for function if import impure in initial inner input loop model not operator or
        outer output package parameter partial protected public pure record redeclare replaceable return
        stream then true type when while within time Real Integer Boolean String Clock sample hold
        previous
        """,
    )
)
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_CALLED = {
    **{name: name for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan")},
    **{name: name for name in ("sinh", "cosh", "tanh", "floor", "ceil", "sign")},
    "fabs": "abs",
    "fmin": "min",
    "fmax": "max",
}
_RELATIONS = {"lt": "<", "le": "<="}


@dataclass(frozen=True, slots=True)
class Text:
    """An expression: how tightly it binds, whether it is a Boolean; of `if c then v else 0`, c and v."""

    text: str
    binds: int = ATOM
    truth: bool = False
    branch: tuple[Text, Text] | None = None

    def within(self, least: int) -> str:
        """Return it as an operand of what binds so tightly."""
        return self.text if self.binds >= least else f"({self.text})"


def identifier(name: str) -> str:
    """Return a name as Modelica writes it, in quotes where it is no word."""
    if _PLAIN.match(name) and name not in _KEYWORDS:
        return name
    return "'" + name.replace("\\", "\\\\").replace("'", "\\'") + "'"


def number(value: float) -> Text:
    """Return a number that is read back to the last bit."""
    text = repr(int(value)) if value == int(value) and abs(value) < 1e6 else repr(float(value))
    return Text(text, ATOM if math.copysign(1.0, value) > 0 else SUM)


def unit_of_modelica(unit: str) -> str:
    """Return a unit in Modelica's words, "" for one with a broken exponent, which it has none for."""
    if "^(" in unit or unit in ("", "1"):
        return "" if "^(" in unit else "1"
    return re.sub(r"\^(-?[0-9]+)", r"\1", unit).replace("*", ".")


def written(function: Any, names: Sequence[Sequence[Text]], keep: Callable[[Text], Text]) -> list[Text]:
    """Return what a function gives, entry by entry, in the names of what it takes.

    Parameters
    ----------
    function
        A `casadi.Function` of scalar operations with one output.
    names
        Of each input, those of its entries.
    keep
        Gives a name to an expression that is long.
    """
    plain = straight(function)
    values = [one for listed in names for one in listed] + [number(value) for value in plain.constants]

    taken = Counter(place for _, *places in plain.operations for place in places)
    again = iter([taken[len(values) + k] > 1 for k in range(len(plain.operations))])

    def rule(word: str) -> Callable[..., Text]:
        def operation(*operands: Text) -> Text:
            found = _RULES[word](*operands)
            return keep(found) if next(again) and len(found.text) > LONGEST else found

        return operation

    found = walk(plain, values, rule)
    return [found[place] for place in plain.results[0]]


def used_inputs(function: Any) -> list[list[bool]]:
    """Return of each input which entries a function depends on."""
    plain = straight(function)
    taken = {place for _, *places in plain.operations for place in places} | set(plain.results[0])
    marks, first = [], 0
    for _, rows in plain.inputs:
        marks.append([first + row in taken for row in range(rows)])
        first += rows
    return marks


def _real(one: Text) -> Text:
    return Text(f"if {one.text} then 1 else 0", IF) if one.truth else one


def _truth(one: Text) -> Text:
    return one if one.truth else Text(f"{one.within(SUM)} < 0 or {one.within(SUM)} > 0", OR, truth=True)


def _infix(sign: str, binds: int, right: int) -> Callable[[Text, Text], Text]:
    def rule(a: Text, b: Text) -> Text:
        return Text(f"{_real(a).within(binds)}{sign}{_real(b).within(right)}", binds)

    return rule


def _add(a: Text, b: Text) -> Text:
    """Return a sum; that of two branches of which one is taken is a choice."""
    if a.branch and b.branch and b.branch[0].text == f"not {a.branch[0].within(NOT + 1)}":
        return Text(f"if {a.branch[0].text} then {a.branch[1].text} else {b.branch[1].text}", IF)
    if b.text.startswith("-") and b.binds == SUM:
        return Text(f"{_real(a).within(SUM)} - {b.text[1:]}", SUM)
    return _infix(" + ", SUM, SUM)(a, b)


def _branch(condition: Text, value: Text) -> Text:
    condition, value = _truth(condition), _real(value)
    return Text(f"if {condition.text} then {value.text} else 0", IF, branch=(condition, value))


def _power(a: Text, b: Text) -> Text:
    return Text(f"{_real(a).within(ATOM)}^{_real(b).within(ATOM)}", POWER)


def _call(name: str) -> Callable[..., Text]:
    return lambda *operands: Text(f"{name}({', '.join(_real(one).text for one in operands)})")


def _relation(sign: str) -> Callable[[Text, Text], Text]:
    return lambda a, b: Text(f"{_real(a).within(SUM)} {sign} {_real(b).within(SUM)}", RELATION, truth=True)


def _equal(a: Text, b: Text) -> Text:
    """Return that two numbers are equal, which Modelica asks of no two Reals."""
    a, b = _real(a), _real(b)
    low, high = f"{a.within(SUM)} <= {b.within(SUM)}", f"{a.within(SUM)} >= {b.within(SUM)}"
    return Text(f"{low} and {high}", AND, truth=True)


def _not(a: Text) -> Text:
    return Text(f"not {_truth(a).within(NOT + 1)}", NOT, truth=True)


def _interpolated(table: Interpolation, at: Text) -> Text:
    """Return a table's value as branches, each chosen by so many conditions as halve the rows to one.

    A simulator stops at conditions on time, and so at each row that it reaches.
    """
    at, rows = _real(at), (table.times.tolist(), table.numbers.tolist(), table.rates.tolist())
    starts, lows, rates = rows[0][:1] + rows[0], rows[1][:1] + rows[1], rows[2]
    since = [_RULES["sub"](at, number(start)) for start in starts]
    pieces = [
        _RULES["add"](number(low), _RULES["mul"](number(rate), one)) if rate else number(low)
        for low, rate, one in zip(lows, rates, since, strict=True)
    ]
    ends = rows[0]
    while len(pieces) > 1:
        joined = [
            Text(f"if {at.within(SUM)} < {number(end).within(SUM)} then {one.text} else {other.text}", IF)
            for one, other, end in zip(pieces[::2], pieces[1::2], ends[::2], strict=False)
        ]
        pieces, ends = [*joined, *pieces[len(pieces) & ~1 :]], ends[1::2]
    return pieces[0]


_RULES: dict[str, Callable[..., Text]] = {
    **{word: _call(name) for word, name in _CALLED.items()},
    **{word: _relation(sign) for word, sign in _RELATIONS.items()},
    "neg": lambda a: Text(f"-{_real(a).within(PRODUCT)}", SUM),
    "sq": lambda a: _power(a, number(2)),
    "twice": lambda a: _infix("*", PRODUCT, PRODUCT)(number(2), a),
    "inv": lambda a: _infix("/", PRODUCT, POWER)(number(1), a),
    "add": _add,
    "sub": _infix(" - ", SUM, PRODUCT),
    "mul": _infix("*", PRODUCT, PRODUCT),
    "div": _infix("/", PRODUCT, POWER),
    "pow": _power,
    "constpow": _power,
    "eq": _equal,
    "ne": lambda a, b: _not(_equal(a, b)),
    "and": lambda a, b: Text(f"{_truth(a).within(AND)} and {_truth(b).within(AND)}", AND, truth=True),
    "or": lambda a, b: Text(f"{_truth(a).within(OR)} or {_truth(b).within(OR)}", OR, truth=True),
    "not": _not,
    "if_else_zero": _branch,
    "interpolate": _interpolated,
}
