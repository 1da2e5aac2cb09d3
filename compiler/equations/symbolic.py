"""The language's expressions as terms, and what is asked of terms: derivatives, pieces, linear forms.

Takes: `Expr`. Gives: `Term`; `differential`, `smooth_pieces`, `linear_form` of one.
Guarantees: functions with a corner or a jump (min, max, if, …) stay as they are.
Does not: know clocks or crossings, or which symbols move (see `index`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from fractions import Fraction

from apc.compiler.equations.terms import (
    HALF,
    LARGEST,
    NO_NUMBER,
    ONE,
    ZERO,
    Function,
    Number,
    Product,
    Sum,
    Symbol,
    Term,
    add,
    apply,
    multiply,
    number,
    power,
    scaled,
    symbol,
)
from apc.compiler.language.expression import (
    Binary,
    Call,
    Compare,
    Conditional,
    Expr,
    Logic,
    Name,
    Negate,
    Not,
    fold,
)
from apc.compiler.language.expression import Number as ExactNumber


def derivative_symbol(name: str) -> Symbol:
    """Return the symbol for the time derivative of a variable."""
    return symbol(f"der({name})")


def to_term(expression: Expr, differentiate: Callable[[Term], Term]) -> Term:
    """Build the term; `differentiate` gives the time derivative of one, for `der`."""

    def leaf(node: Name | ExactNumber) -> Term:
        return symbol(".".join(node.parts)) if isinstance(node, Name) else number(node.value)

    def operation(node: Expr, *operands: Term) -> Term:
        match node:
            case Negate():
                return -operands[0]
            case Binary("^"):
                assert isinstance(operands[1], Number)
                return power(operands[0], operands[1].value)
            case Binary("/"):
                return operands[0] / operands[1]
            case Binary("*"):
                return operands[0] * operands[1]
            case Binary("-"):
                return operands[0] - operands[1]
            case Binary():
                return operands[0] + operands[1]
            case Compare() | Logic():
                return apply(node.operator, *operands)
            case Not():
                return apply("not", *operands)
            case Conditional():
                return apply("if", *operands)
            case Call("der"):
                return differentiate(*operands)
        assert isinstance(node, Call)
        return apply(node.function, *operands)

    return fold(expression, leaf, operation)


def is_no_number(expression: Term) -> bool:
    """Return whether an expression holds a constant that no float can be: 1/0, sqrt(-1), 1e300^2."""
    return expression is NO_NUMBER or any(map(_no_float, expression.walk()))


def _no_float(part: Term) -> bool:
    """Return whether a number in a term is larger than a float can be."""
    if isinstance(part, Sum):
        return any(map(_too_large, (part.constant, *(factor for _, factor in part.terms))))
    if isinstance(part, Product):
        return _too_large(part.coefficient)
    return isinstance(part, Number) and _too_large(part.value)


def _too_large(value: int | Fraction) -> bool:
    return abs(value.numerator) > LARGEST * value.denominator


class NoDerivativeError(Exception):
    """A value was to be differentiated that has no derivative, because it jumps or bends: which, and why."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}, {why}")


def differential(expression: Term, rate: Callable[[Symbol], Term]) -> Term:
    """Return Σ ∂expression/∂s · rate(s) over the symbols s, by the chain rule.

    Where min, max, abs and if have a corner, the derivative is that of the branch taken; sign, floor and
    conditions are constant between their jumps. Raises NoDerivativeError for other opaque functions.
    """

    def go(node: Term) -> Term:
        match node:
            case Symbol():
                return rate(node)
            case Sum():
                return add(*(scaled(go(term), factor) for term, factor in node.terms))
            case Product():
                return add(
                    *(
                        multiply(slope, scaled(power(base, exponent - 1), exponent), _without(node, base))
                        for base, exponent in node.powers
                        if (slope := go(base)) != ZERO
                    )
                )
            case Function():
                return of_function(node.name, node)
        return ZERO

    def of_function(name: str, node: Function) -> Term:
        if name == "if":
            condition, then, otherwise = node.arguments
            return _choice(condition, go(then), go(otherwise))
        if name in ("min", "max"):
            best, slope = node.arguments[0], go(node.arguments[0])
            for argument in node.arguments[1:]:
                order = (best, argument) if name == "min" else (argument, best)
                slope = _choice(apply("<=", *order), slope, go(argument))
                best = apply(name, best, argument)
            return slope
        if name in _SLOPES:
            slope = go(node.arguments[0])
            return slope if slope == ZERO else _SLOPES[name](node.arguments[0]) * slope
        if name == "atan2":
            y, x = node.arguments
            turned = multiply(x, go(y)) - multiply(y, go(x))
            return turned if turned == ZERO else turned / add(power(x, 2), power(y, 2))
        if name in ("sign", "floor"):
            return ZERO
        why = "a value that jumps at its ticks" if name in ("hold", "sample") else "which has none"
        raise NoDerivativeError(str(node), why)

    return go(expression)


_SLOPES: dict[str, Callable[[Term], Term]] = {
    "abs": lambda x: apply("sign", x),
    "exp": lambda x: apply("exp", x),
    "log": lambda x: power(x, -1),
    "sin": lambda x: apply("cos", x),
    "cos": lambda x: -apply("sin", x),
    "tan": lambda x: ONE + power(apply("tan", x), 2),
    "asin": lambda x: power(ONE - power(x, 2), -HALF),
    "acos": lambda x: -power(ONE - power(x, 2), -HALF),
    "atan": lambda x: power(ONE + power(x, 2), -1),
    "sinh": lambda x: apply("cosh", x),
    "cosh": lambda x: apply("sinh", x),
    "tanh": lambda x: ONE - power(apply("tanh", x), 2),
}


def _without(product: Product, base: Term) -> Term:
    """Return a product without one of its powers."""
    others = (power(*one) for one in product.powers if one[0] is not base)
    return multiply(Number(product.coefficient), *others)


def smooth_pieces(expressions: Sequence[Term], most: int) -> list[tuple[Term, ...]] | None:
    """Return what expressions may be between their corners and jumps, None if that is more than `most`.

    Each min and max is one of its arguments, each `if` one of its branches, abs(x) is x or −x; sign and floor
    are constant.
    """
    pieces = [tuple(expressions)]
    while True:
        bent = next(
            (node for piece in pieces for one in piece for node in one.walk() if _is_bent(node)), None
        )
        if not isinstance(bent, Function):
            return pieces
        match bent.name:
            case "if":
                choices = bent.arguments[1:]
            case "min" | "max":
                choices = bent.arguments
            case "abs":
                choices = (bent.arguments[0], -bent.arguments[0])
            case _:
                choices = (symbol(f"constant {bent}"),)
        pieces = list(
            dict.fromkeys(
                tuple(one.replace({bent: choice}) for one in piece) for piece in pieces for choice in choices
            )
        )
        if len(pieces) > most:
            return None


def _is_bent(node: Term) -> bool:
    return isinstance(node, Function) and node.name in ("if", "min", "max", "abs", "sign", "floor")


def _choice(condition: Term, then: Term, otherwise: Term) -> Term:
    return then if then == otherwise else apply("if", condition, then, otherwise)


LinearForm = tuple[dict[Symbol, Term], Term]


def linear_form(expression: Term, unknowns: Set[Symbol]) -> LinearForm | None:
    """Return the coefficients and the rest of Σ coefficient·unknown + rest, or None if it isn't linear.

    Reads the terms as they stand: no differentiation, no expansion, so its cost is the expression's size.
    """
    if unknowns.isdisjoint(expression.free_symbols):
        return {}, expression
    match expression:
        case Symbol():
            return {expression: ONE}, ZERO
        case Sum():
            found: dict[Symbol, list[Term]] = {}
            rests: list[Term] = [Number(expression.constant)] if expression.constant else []
            for term, factor in expression.terms:
                form = linear_form(term, unknowns)
                if form is None:
                    return None
                for unknown, coefficient in form[0].items():
                    found.setdefault(unknown, []).append(scaled(coefficient, factor))
                rests.append(scaled(form[1], factor))
            return {u: add(*several) for u, several in found.items()}, add(*rests)
        case Product():
            moving = [one for one in expression.powers if not unknowns.isdisjoint(one[0].free_symbols)]
            base, exponent = moving[0]
            form = linear_form(base, unknowns) if len(moving) == 1 and exponent == 1 else None
            if form is None:
                return None
            scale = _without(expression, base)
            return {u: scale * coefficient for u, coefficient in form[0].items()}, scale * form[1]
        case Function("if", (condition, *branches)) if unknowns.isdisjoint(condition.free_symbols):
            then, otherwise = (linear_form(branch, unknowns) for branch in branches)
            if then is None or otherwise is None:
                return None
            names = dict.fromkeys((*then[0], *otherwise[0]))
            return {
                u: _choice(condition, then[0].get(u, ZERO), otherwise[0].get(u, ZERO)) for u in names
            }, _choice(condition, then[1], otherwise[1])
    return None


def no_derivative(expression: Term) -> Term:
    """Stand in for `differentiate` where `der` can't occur."""
    raise AssertionError(f"der of {expression} stands in a clocked equation")
