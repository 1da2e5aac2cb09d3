"""A peer type's functions as expressions of Modelica.

Takes: a `casadi.Function` of scalar operations, and the names of its inputs.
Gives: `Text`, `number`, `identifier`, `unit_of_modelica`; `result_texts`.
Guarantees: parentheses only where Modelica's precedence requires them; a condition is a Boolean, never a
number; a long expression that is used several times is assigned to a variable.
Does not: use the meaning of a variable.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from apc.compiler.expression_data import straight, walk
from apc.compiler.interpolation import Interpolation

# Operator precedence, loosest first.
IF, OR, AND, NOT, RELATION, SUM, PRODUCT, POWER, ATOM = range(9)

NONE = "^("  # a unit that Modelica cannot express

# The largest length of an expression that is repeated at each use.
LONGEST = 120

# Of Modelica 3.6: the keywords (section 2.3.3), the predefined types (4.9), and the names of operators and
# functions that need no import (3.7, 10.3, 16, 17). A name of a model that is one of them is quoted.
RESERVED = frozenset(
    re.findall(
        r"\w+",
        """
        algorithm and annotation block break class connect connector constant constrainedby der discrete
        each else elseif elsewhen encapsulated end enumeration equation expandable extends external
        false final flow for function if import impure in initial inner input loop model not operator or
        outer output package parameter partial protected public pure record redeclare replaceable return
        stream then true type when while within

        Real Integer Boolean String Clock StateSelect ExternalObject AssertionLevel Connections Complex
        Modelica time

        abs sign sqrt div mod rem ceil floor integer sin cos tan asin acos atan atan2 sinh cosh tanh exp
        log log10 delay cardinality homotopy semiLinear inStream actualStream spatialDistribution
        getInstanceName terminal noEvent smooth sample pre edge change reinit assert terminate

        promote ndims size scalar vector matrix transpose outerProduct symmetric cross skew identity
        diagonal zeros ones fill linspace min max sum product array cat

        previous hold subSample superSample shiftSample backSample noClock interval firstTick
        rooted transition initialState activeState ticksInState timeInState
        """,
    )
)
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")


@dataclass(frozen=True, slots=True)
class Text:
    """An expression: its precedence `binds`, and whether it is a Boolean.

    `branch` is (c, v) of `if c then v else 0`.

    For a variable, `unit` is its unit in SI, and `start` its value before the first tick.
    """

    text: str
    binds: int = ATOM
    truth: bool = False
    branch: tuple[Text, Text] | None = None
    unit: str = NONE
    start: Text | None = None

    def within(self, least: int) -> str:
        """Return the text as an operand of an operator of precedence `least`, in parentheses if necessary."""
        return self.text if self.binds >= least else f"({self.text})"


def identifier(name: str) -> str:
    """Return a name as an identifier of Modelica, quoted if it is no plain word or a reserved one."""
    if _PLAIN.match(name) and name not in RESERVED:
        return name
    return "'" + name.replace("\\", "\\\\").replace("'", "\\'") + "'"


def number(value: float) -> Text:
    """Return the text of a number that is read back as the same double."""
    text = repr(int(value)) if value == int(value) and abs(value) < 1e6 else repr(float(value))
    return Text(text, ATOM if math.copysign(1.0, value) > 0 else SUM)


def unit_of_modelica(unit: str) -> str:
    """Return a unit in Modelica's syntax; "" for a unit with a fractional exponent."""
    if "^(" in unit or unit in ("", "1"):
        return "" if "^(" in unit else "1"
    return re.sub(r"\^(-?[0-9]+)", r"\1", unit).replace("*", ".")


def result_texts(
    function: Any,
    names: Sequence[Sequence[Text | Callable[[], Text]]],
    keep: Callable[[Text], Text],
) -> list[Text]:
    """Return the results of a function as texts, entry by entry, in terms of the names of its arguments.

    Parameters
    ----------
    function
        A `casadi.Function` of scalar operations with one output.
    names
        The names of the entries of each input, or functions that return the name of an entry that is used.
    keep
        Assigns a long expression to a variable, and returns the variable.
    """
    plain_function = straight(function)
    uses = Counter(index for _, *indices in plain_function.operations for index in indices)
    used_indices = uses.keys() | set(plain_function.results[0])
    values = [
        name if isinstance(name, Text) else name() if index in used_indices else Text("0")
        for index, name in enumerate(name for entry_names in names for name in entry_names)
    ]
    values += [number(value) for value in plain_function.constants]
    repeated = iter(
        [
            uses[len(values) + len(plain_function.tables) + k] > 1
            for k in range(len(plain_function.operations))
        ]
    )

    def rule(word: str) -> Callable[..., Text]:
        """Return the function that writes an operation."""

        def operation(*operands: Any) -> Text:
            """Return the text of an operation; a long text that is repeated is assigned to a variable."""
            text = _SPECIAL[word](*operands) if word in _SPECIAL else _operation_text(word, *operands)
            return keep(text) if next(repeated) and len(text.text) > LONGEST else text

        return operation

    result = walk(plain_function, values, rule)
    return [result[index] for index in plain_function.results[0]]


def _as_number(operand: Text) -> Text:
    """Return an operand as a number: 1 or 0 for a Boolean."""
    return Text(f"if {operand.text} then 1 else 0", IF) if operand.truth else operand


def _as_condition(operand: Text) -> Text:
    """Return an operand as a Boolean: whether a number is not 0."""
    value = operand.within(SUM)
    return operand if operand.truth else Text(f"{value} < 0 or {value} > 0", OR, truth=True)


def _operation_text(word: str, *operands: Text) -> Text:
    """Return an operation as text by its form, with parentheses around operands of lower precedence."""
    form, binds, *bounds = _FORMS.get(word) or (f"{_CALLED.get(word, word)}({{}})", ATOM, IF)
    convert = _as_condition if word in ("and", "or", "not") else _as_number
    texts = [convert(operand).within(bound) for operand, bound in zip(operands, bounds, strict=True)]
    return Text(form.format(*texts), binds, truth=binds in (OR, AND, NOT, RELATION))


def _add(a: Text, b: Text) -> Text:
    """Return a sum; the sum of two exclusive branches is a choice."""
    if a.branch and b.branch and b.branch[0].text == f"not {a.branch[0].within(NOT + 1)}":
        return Text(f"if {a.branch[0].text} then {a.branch[1].text} else {b.branch[1].text}", IF)
    if b.text.startswith("-") and b.binds == SUM:
        return Text(f"{_as_number(a).within(SUM)} - {b.text[1:]}", SUM)
    return _operation_text("plus", a, b)


def _branch(condition: Text, value: Text) -> Text:
    """Return `if condition then value else 0`."""
    condition, value = _as_condition(condition), _as_number(value)
    return Text(f"if {condition.text} then {value.text} else 0", IF, branch=(condition, value))


def _table_text(table: Interpolation, argument: Text) -> Text:
    """Return a table's value as text: binary search by nested conditions.

    A simulator has an event at each condition on time, and so at each row.
    """
    ends, numbers, rates = table.times.tolist(), table.numbers.tolist(), table.rates.tolist()
    pieces = []
    for start, low, rate in zip(ends[:1] + ends, numbers[:1] + numbers, rates, strict=True):
        increase = _operation_text("mul", number(rate), _operation_text("sub", argument, number(start)))
        pieces.append(_add(number(low), increase) if rate else number(low))
    while len(pieces) > 1:
        joined = [
            Text(
                f"if {_operation_text('lt', argument, number(end)).text} then {low.text} else {high.text}", IF
            )
            for low, high, end in zip(pieces[::2], pieces[1::2], ends[::2], strict=False)
        ]
        pieces, ends = [*joined, *pieces[len(pieces) & ~1 :]], ends[1::2]
    return pieces[0]


_CALLED = {"fabs": "abs"}
# The form of an operation, its precedence, and the least precedence of each operand; all others are function
# calls.
_FORMS: dict[str, tuple[Any, ...]] = {
    "plus": ("{} + {}", SUM, SUM, SUM),
    "neg": ("-{}", SUM, PRODUCT),
    "sq": ("{}^2", POWER, ATOM),
    "twice": ("2*{}", PRODUCT, PRODUCT),
    "inv": ("1/{}", PRODUCT, POWER),
    "sub": ("{} - {}", SUM, SUM, PRODUCT),
    "mul": ("{}*{}", PRODUCT, PRODUCT, PRODUCT),
    "div": ("{}/{}", PRODUCT, PRODUCT, POWER),
    "pow": ("{}^{}", POWER, ATOM, ATOM),
    "constpow": ("{}^{}", POWER, ATOM, ATOM),
    "fmin": ("min({}, {})", ATOM, IF, IF),
    "fmax": ("max({}, {})", ATOM, IF, IF),
    "lt": ("{} < {}", RELATION, SUM, SUM),
    "le": ("{} <= {}", RELATION, SUM, SUM),
    "eq": ("{0} <= {1} and {0} >= {1}", AND, SUM, SUM),  # Modelica has no equality of Reals
    "and": ("{} and {}", AND, AND, AND),
    "or": ("{} or {}", OR, OR, OR),
    "not": ("not {}", NOT, NOT + 1),
}
_SPECIAL: dict[str, Callable[..., Text]] = {
    "add": _add,
    "ne": lambda a, b: _operation_text("not", _operation_text("eq", a, b)),
    "if_else_zero": _branch,
    "interpolate": _table_text,
}
