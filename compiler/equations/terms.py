"""Sums, products, powers and functions of symbols with exact coefficients: the compiler's algebra.

Takes: symbols, rational numbers, and terms made of them. Gives: `Term` and its five kinds, `symbol`,
`number`, `add`, `multiply`, `power`, `apply`, `NO_NUMBER`.
Guarantees: like terms of a sum and like factors of a product are one; a number times a sum is a sum; terms
are equal whatever the order of their parts, which stays the order in which they were written.
Does not: expand products of sums, or look for simplifications beyond these and those of `apply` and `power`.

Every symbol is a real number. What no number can be, 1/0 or sqrt(-1), is `NO_NUMBER`, and so is all that
holds it.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from fractions import Fraction
from typing import Any, TypeAlias

from apc.compiler.language.expression import (
    COMPARISONS,
    SMOOTH,
    Binary,
    Call,
    Compare,
    Conditional,
    Expr,
    Logic,
    Name,
    Negate,
    Not,
    format_expression,
)
from apc.compiler.language.expression import Number as ExactNumber

Ratio: TypeAlias = int | Fraction
LARGEST = int(sys.float_info.max)
MOST_SYMBOLS = 100_000  # that are kept, so that equal ones are mostly the same object
_VALUES: dict[str, Callable[..., float]] = {name: getattr(math, name) for name in ("atan2", *SMOOTH)}
_ODD, _EVEN = ("sin", "tan", "asin", "atan", "sinh", "tanh"), ("cos", "cosh")


class Term:
    """An expression, abstract. `size` counts its nodes; `_key` is equal for equal ones of one kind."""

    __slots__ = ("_free", "_hash", "_key", "size")

    _key: object
    size: int

    def __init__(self, key: object, size: int) -> None:
        self._key = key
        self._hash = hash(key)
        self.size = size
        self._free: frozenset[Symbol] | None = None

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (
            type(self) is type(other)
            and isinstance(other, Term)
            and self._hash == other._hash
            and self._key == other._key
        )

    @property
    def parts(self) -> tuple[Term, ...]:
        """The terms it is made of, without the numbers between them."""
        return ()

    def rebuilt(self, parts: Iterator[Term]) -> Term:
        """Return the same of other parts."""
        del parts
        return self

    @property
    def free_symbols(self) -> frozenset[Symbol]:
        """The symbols it holds."""
        if self._free is None:
            self._free = frozenset().union(*(part.free_symbols for part in self.parts))
        return self._free

    def replace(self, values: Mapping[Any, Term]) -> Term:
        """Return the term with others in the place of some of its parts."""
        found = values.get(self)
        if found is not None:
            return found
        parts = self.parts
        changed = [part.replace(values) for part in parts]
        if all(new is old for new, old in zip(changed, parts, strict=True)):
            return self
        return self.rebuilt(iter(changed))

    def walk(self) -> Iterator[Term]:
        """Give every term it is made of, itself first."""
        stack: list[Term] = [self]
        while stack:
            node = stack.pop()
            yield node
            stack.extend(reversed(node.parts))

    def __add__(self, other: Term) -> Term:
        return add(self, other)

    def __sub__(self, other: Term) -> Term:
        return _sum(((self, 1), (other, -1)))

    def __mul__(self, other: Term) -> Term:
        return multiply(self, other)

    def __truediv__(self, other: Term) -> Term:
        return multiply(self, power(other, -1))

    def __neg__(self) -> Term:
        return scaled(self, -1)

    def __str__(self) -> str:
        return format_expression(_written(self))

    __repr__ = __str__


def terms_of(term: Term) -> tuple[tuple[Term, Ratio], ...]:
    """Return the terms of a sum and their factors, its constant times 1; of anything else, itself."""
    if isinstance(term, Sum):
        return (*term.terms, (ONE, term.constant)) if term.constant else term.terms
    if isinstance(term, Product):
        return ((_product(1, term.powers), term.coefficient),)
    if isinstance(term, Number):
        return ((ONE, term.value),) if term.value else ()
    return ((term, 1),)


def _nodes(term: Term, factor: Ratio) -> int:
    """Return how many nodes a factor adds to a term."""
    return 0 if factor == 1 else 1 + (not isinstance(term, Product) or len(term.powers) == 1)


class Symbol(Term):
    """A real number known by its name."""

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        super().__init__(name, 1)
        self.name = name
        self._free = frozenset((self,))


class Number(Term):
    """A rational number."""

    __slots__ = ("value",)

    def __init__(self, value: Ratio) -> None:
        super().__init__(value, 1)
        self.value = value


class Sum(Term):
    """Σ coefficient·term + constant; no term is a sum or a number, or a product with a coefficient."""

    __slots__ = ("constant", "terms")

    def __init__(self, terms: tuple[tuple[Term, Ratio], ...], constant: Ratio) -> None:
        size = 1 + (constant != 0) + sum(term.size + _nodes(term, factor) for term, factor in terms)
        super().__init__((constant, frozenset(terms)), size)
        self.terms = terms
        self.constant = constant

    @property
    def parts(self) -> tuple[Term, ...]:
        return tuple(term for term, _ in self.terms)

    def rebuilt(self, parts: Iterator[Term]) -> Term:
        return _sum(
            [(part, factor) for part, (_, factor) in zip(parts, self.terms, strict=True)], self.constant
        )


class Product(Term):
    """coefficient·Π base^exponent; a number is no base unless its exponent is between 0 and 1."""

    __slots__ = ("coefficient", "powers")

    def __init__(self, coefficient: Ratio, powers: tuple[tuple[Term, Ratio], ...]) -> None:
        count = len(powers) + (coefficient != 1)
        size = (count > 1) + (coefficient != 1) + sum(b.size + 2 * (e != 1) for b, e in powers)
        super().__init__((coefficient, frozenset(powers)), size)
        self.coefficient = coefficient
        self.powers = powers

    @property
    def parts(self) -> tuple[Term, ...]:
        return tuple(base for base, _ in self.powers)

    def rebuilt(self, parts: Iterator[Term]) -> Term:
        raised = (power(part, exponent) for part, (_, exponent) in zip(parts, self.powers, strict=True))
        return multiply(Number(self.coefficient), *raised)


class Function(Term):
    """A function, an operator of conditions, or `if`, of its arguments."""

    __slots__ = ("arguments", "name")
    __match_args__ = ("name", "arguments")

    def __init__(self, name: str, arguments: tuple[Term, ...]) -> None:
        super().__init__((name, arguments), 1 + sum(argument.size for argument in arguments))
        self.name = name
        self.arguments = arguments

    @property
    def parts(self) -> tuple[Term, ...]:
        return self.arguments

    def rebuilt(self, parts: Iterator[Term]) -> Term:
        return apply(self.name, *parts)


ZERO, ONE = Number(0), Number(1)
NO_NUMBER = Function("no number", ())
HALF = Fraction(1, 2)


@functools.lru_cache(MOST_SYMBOLS)
def symbol(name: str) -> Symbol:
    """Return the symbol of this name."""
    return Symbol(name)


def number(value: Ratio) -> Number:
    """Return a rational number."""
    return Number(value.numerator if value.denominator == 1 else value)


def _size(value: Ratio) -> Ratio:
    return value if value >= 0 else -value


def add(*terms: Term) -> Term:
    """Return a sum."""
    return _sum([(term, 1) for term in terms])


def _sum(terms: Iterable[tuple[Term, Ratio]], constant: Ratio = 0) -> Term:
    """Return Σ factor·term + constant."""
    found: dict[Term, Ratio] = {}
    for term, factor in terms:
        if isinstance(term, Sum):
            constant += factor * term.constant
            for part, its in term.terms:
                found[part] = found.get(part, 0) + factor * its
        elif isinstance(term, Number):
            constant += factor * term.value
        elif isinstance(term, Product) and term.coefficient != 1:
            part = _product(1, term.powers)
            found[part] = found.get(part, 0) + factor * term.coefficient
        elif term is NO_NUMBER:
            return NO_NUMBER
        else:
            found[term] = found.get(term, 0) + factor
    listed = tuple([(term, factor) for term, factor in found.items() if factor])
    if not listed:
        return Number(constant)
    return Sum(listed, constant) if constant or len(listed) > 1 else scaled(*listed[0])


def scaled(term: Term, factor: Ratio) -> Term:
    """Return a number times a term."""
    if factor == 1 or term is NO_NUMBER:
        return term
    if not factor:
        return ZERO
    if isinstance(term, Number):
        return Number(term.value * factor)
    if isinstance(term, Sum):
        return Sum(tuple([(part, its * factor) for part, its in term.terms]), term.constant * factor)
    if isinstance(term, Product):
        return _product(term.coefficient * factor, term.powers)
    return Product(factor, ((term, 1),))


def _product(coefficient: Ratio, powers: tuple[tuple[Term, Ratio], ...]) -> Term:
    """Return coefficient·Π base^exponent of what is in normal form but for this."""
    if len(powers) != 1 or powers[0][1] != 1:
        return Product(coefficient, powers) if powers else Number(coefficient)
    base = powers[0][0]
    return (
        scaled(base, coefficient)
        if isinstance(base, Sum) or coefficient == 1
        else Product(coefficient, powers)
    )


def multiply(*factors: Term) -> Term:
    """Return a product."""
    coefficient: Ratio = 1
    found: dict[Term, Ratio] = {}
    for factor in factors:
        if isinstance(factor, Number):
            coefficient *= factor.value
        elif isinstance(factor, Product):
            coefficient *= factor.coefficient
            for base, exponent in factor.powers:
                found[base] = found.get(base, 0) + exponent
        elif factor is NO_NUMBER:
            return NO_NUMBER
        else:
            found[factor] = found.get(factor, 0) + 1
    if not coefficient:
        return ZERO
    powers = tuple([(base, exponent) for base, exponent in found.items() if exponent])
    exponentials = [one for one in powers if _is_call(one[0], "exp")]
    if len(exponentials) > 1:
        joined = apply("exp", _sum([(base.parts[0], exponent) for base, exponent in exponentials]))
        return multiply(
            _product(coefficient, tuple([one for one in powers if one not in exponentials])), joined
        )
    if all(_is_reduced(*one) for one in powers):
        return _product(coefficient, powers)
    return multiply(Number(coefficient), *(power(*one) for one in powers))


def _is_call(term: Term, name: str) -> bool:
    return isinstance(term, Function) and term.name == name


def _is_even(exponent: Ratio) -> bool:
    return exponent.denominator == 1 and exponent.numerator % 2 == 0


def _is_reduced(base: Term, exponent: Ratio) -> bool:
    """Return whether a power stands in a product as it is."""
    if isinstance(base, Number):
        return 0 < exponent < 1
    if isinstance(base, Product):
        return exponent.denominator != 1
    if isinstance(base, Function):
        return not ((base.name == "exp" and exponent != 1) or (base.name == "abs" and _is_even(exponent)))
    return True


def power(base: Term, exponent: Ratio) -> Term:
    """Return a power with a rational exponent: of a positive base, or no number, where it isn't whole."""
    if not exponent:
        return ONE
    if exponent == 1 or base is NO_NUMBER:
        return base
    if isinstance(base, Number):
        return _power_of_number(base.value, exponent)
    if isinstance(base, Product):
        return _power_of_product(base, exponent)
    if _is_call(base, "exp"):
        return apply("exp", scaled(base.parts[0], exponent))
    if _is_call(base, "abs") and _is_even(exponent):
        return power(base.parts[0], exponent)
    return _root(base, exponent)


def _root(base: Term, exponent: Ratio) -> Term:
    """Return a power that stands as it is, if it is a number at all."""
    if exponent.denominator != 1 and not base.free_symbols and constant(base) < 0:
        return NO_NUMBER
    return Product(1, ((base, exponent),))


def _power_of_number(value: Ratio, exponent: Ratio) -> Term:
    whole = math.floor(exponent)
    rest = exponent - whole
    if (value < 0 and rest) or (not value and exponent < 0):
        return NO_NUMBER
    if not value:
        return ZERO
    times = number(Fraction(value) ** whole)
    if not rest:
        return times
    above, below = (
        _whole_root(n**rest.numerator, rest.denominator) for n in Fraction(value).as_integer_ratio()
    )
    if above is None or below is None:
        return Product(times.value, ((Number(value), rest),))
    return number(times.value * Fraction(above, below))


def _whole_root(value: int, degree: int) -> int | None:
    """Return the root of a whole number that is no more than a float can be, None if it isn't whole."""
    guess = math.isqrt(value) if degree == 2 else round(min(value, LARGEST) ** (1 / degree))
    return guess if guess**degree == value else None


def _power_of_product(base: Product, exponent: Ratio) -> Term:
    if exponent.denominator == 1:
        raised = (power(one, its * exponent) for one, its in base.powers)
        return multiply(_power_of_number(base.coefficient, exponent), *raised)
    positive = [_power_of_number(_size(base.coefficient), exponent)]
    positive += [power(apply("abs", one), its * exponent) for one, its in base.powers if _is_even(its)]
    rest = _product(
        1 if base.coefficient > 0 else -1, tuple([one for one in base.powers if not _is_even(one[1])])
    )
    left = _root(rest, exponent) if isinstance(rest, Product) else power(rest, exponent)
    return multiply(*positive, left)


def apply(name: str, *arguments: Term) -> Term:
    """Return a function of its arguments, its value where that is a rational number known at once."""
    if any(argument is NO_NUMBER for argument in arguments):
        return NO_NUMBER
    first = arguments[0]
    if name == "sqrt":
        return power(first, HALF)
    if name == "abs" and isinstance(first, Number):
        return Number(_size(first.value))
    if name in ("floor", "sign") and not first.free_symbols:
        value = first.value if isinstance(first, Number) else constant(first)
        if math.isfinite(value):
            return Number(math.floor(value) if name == "floor" else (value > 0) - (value < 0))
    if name == "log":
        if first == ONE or (not first.free_symbols and constant(first) <= 0):
            return ZERO if first == ONE else NO_NUMBER
        return first.parts[0] if _is_call(first, "exp") else Function(name, arguments)
    if name == "exp":
        return (
            ONE if first == ZERO else first.parts[0] if _is_call(first, "log") else Function(name, arguments)
        )
    if name in _ODD or name in _EVEN:
        if first == ZERO:
            return ONE if name in _EVEN else ZERO
        if name == "asin" and _is_beyond_one(first):
            return NO_NUMBER
        if _is_negative(first):
            return scaled(Function(name, (-first,)), 1 if name in _EVEN else -1)
    if name == "acos" and (first == ONE or _is_beyond_one(first)):
        return ZERO if first == ONE else NO_NUMBER
    return Function(name, arguments)


def _is_beyond_one(term: Term) -> bool:
    return not term.free_symbols and abs(constant(term)) > 1


def _is_negative(term: Term) -> bool:
    """Return which of x and −x a term is, in a way that depends on what stands in it alone."""
    if isinstance(term, Number):
        return term.value < 0
    if isinstance(term, Product):
        return term.coefficient < 0
    return isinstance(term, Sum) and min((str(part), factor) for part, factor in term.terms)[1] < 0


def constant(term: Term) -> float:
    """Return the value of a term without symbols, about; nan where it isn't known."""
    try:
        if isinstance(term, Number):
            return float(term.value)
        if isinstance(term, Sum):
            return sum(constant(part) * factor for part, factor in term.terms) + float(term.constant)
        if isinstance(term, Product):
            return math.prod(
                (constant(base) ** exponent for base, exponent in term.powers), start=float(term.coefficient)
            )
        if isinstance(term, Function) and term.name in _VALUES:
            return _VALUES[term.name](*map(constant, term.arguments))
    except (ArithmeticError, ValueError):
        pass
    return math.nan


def _written(term: Term) -> Expr:
    """Return a term in the language's own form."""
    if isinstance(term, Symbol):
        return Name((term.name,))
    if isinstance(term, Number):
        return ExactNumber(Fraction(term.value))
    if isinstance(term, Sum):
        first, *others = terms_of(term)
        total = _written(scaled(*first))
        for part, factor in others:
            total = Binary("-" if factor < 0 else "+", total, _written(scaled(part, _size(factor))))
        return total
    if isinstance(term, Product):
        return _written_product(term)
    assert isinstance(term, Function)
    arguments = tuple(map(_written, term.arguments))
    if term.name == "if":
        return Conditional(*arguments)
    if term.name in COMPARISONS:
        return Compare(term.name, *arguments)
    if term.name in ("and", "or"):
        return Logic(term.name, *arguments)
    return Not(*arguments) if term.name == "not" else Call(term.name, arguments)


def _written_product(term: Product) -> Expr:
    factor = _size(term.coefficient)
    above: list[Expr] = [] if factor == 1 else [ExactNumber(Fraction(factor))]
    below: list[Expr] = []
    for base, exponent in term.powers:
        shown, size = _written(base), _size(exponent)
        if size == HALF:
            shown = Call("sqrt", (shown,))
        elif size != 1:
            shown = Binary("^", shown, ExactNumber(Fraction(size)))
        (above if exponent > 0 else below).append(shown)
    whole = functools.reduce(functools.partial(Binary, "*"), above or [ExactNumber(Fraction(1))])
    if below:
        whole = Binary("/", whole, functools.reduce(functools.partial(Binary, "*"), below))
    return Negate(whole) if term.coefficient < 0 else whole
