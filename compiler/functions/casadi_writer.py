"""SymPy expressions written as CasADi's, each definition once.

Takes: symbols whose values are known, and what defines the others. Gives: `Writer`, `Definition`.
Guarantees: written in the order in which things depend on one another; a chain of definitions may be as long
as it likes; a nonlinear loop is solved by Newton's iteration inside the expression.
Does not: choose what is written (see `functions`).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import casadi
import sympy

from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.symbolic import symbol
from apc.compiler.language.recordings import TimeTable

Definition: TypeAlias = sympy.Expr | ImplicitBlock
# CasADi's Newton iteration ends before it takes a step smaller than this, in SI. That step is taken
# afterwards and squares the error: the rest is rounding. A bound on the residual would depend on its scale.
NEWTON = {"abstol": 0.0, "abstolStep": 1e-11, "max_iter": 100, "show_eval_warnings": False}
_EXTREMES = {"min": casadi.fmin, "max": casadi.fmax}  # of two values each
_CASADI: dict[str, Callable[..., Any]] = {
    "abs": casadi.fabs,
    "Abs": casadi.fabs,  # what SymPy makes of sqrt(x^2)
    "sign": casadi.sign,
    "floor": casadi.floor,
    "exp": casadi.exp,
    "log": casadi.log,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tanh": casadi.tanh,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "less": operator.lt,
    "less_or_equal": operator.le,
    "more": operator.gt,
    "more_or_equal": operator.ge,
    "equal": operator.eq,
    "unequal": operator.ne,
}


class Writer:
    """Translates SymPy expressions to CasADi, each definition once.

    `type_` is casadi.SX, or casadi.MX where a definition is a loop; `starts` gives the start values of the
    unknowns that have one, where a loop's iteration begins.
    """

    def __init__(
        self,
        type_: Any,
        known: Mapping[sympy.Symbol, Any],
        definitions: Mapping[sympy.Symbol, Definition],
        tables: Mapping[str, TimeTable],
        starts: Mapping[str, Any],
    ) -> None:
        self.type_ = type_
        self.known = dict(known)
        self.definitions = definitions
        self.tables = tables
        self.starts = starts

    def column(self, values: Iterable[Any]) -> Any:
        """Return a dense column of scalars, (0, 1) when there are none."""
        listed = list(values)
        return casadi.densify(casadi.vertcat(*listed)) if listed else self.type_(0, 1)

    def extended(
        self, known: Mapping[sympy.Symbol, Any], definitions: Mapping[sympy.Symbol, Definition]
    ) -> Writer:
        """Return a writer that knows more."""
        return Writer(
            self.type_, {**self.known, **known}, {**self.definitions, **definitions}, self.tables, self.starts
        )

    def write(self, wanted: sympy.Symbol) -> Any:
        """Return the value of a symbol, writing what it depends on first.

        A stack instead of recursion, so that the length of a chain of definitions is no limit.
        """
        work = [wanted]
        while work:
            s = work[-1]
            if s in self.known:
                work.pop()
                continue
            missing = [t for t in self._needed(self.definitions[s]) if t not in self.known]
            if missing:
                work += missing
            else:
                definition = self.definitions[s]
                if isinstance(definition, ImplicitBlock):
                    self.known |= self._solve(definition)
                else:
                    self.known[s] = self._build(definition)
        return self.known[wanted]

    def _solve(self, loop: ImplicitBlock) -> dict[sympy.Symbol, Any]:
        """Return the unknowns of a loop: those torn by Newton's iteration, the others from them."""
        outer = self._needed(loop)
        own = {symbol(name): casadi.SX.sym(name) for name in loop.tearing}
        given = {s: casadi.SX.sym(s.name) for s in outer}
        others = {symbol(name): expression for name, expression in loop.inner}
        inside = Writer(casadi.SX, {**own, **given}, others, self.tables, {})
        z, q = inside.column(own.values()), inside.column(given.values())
        residual = inside.column(inside.translate(expression) for expression in loop.residuals)
        solver = casadi.rootfinder("loop", "newton", {"x": z, "p": q, "g": residual}, NEWTON)
        last_step = casadi.solve(casadi.jacobian(residual, z), residual)
        polish = casadi.Function("polish", [z, q], [z - last_step])
        rest = casadi.Function("rest", [z, q], [inside.column(inside.write(s) for s in others)])
        guess = self.column(self.starts.get(name, self.type_(0)) for name in loop.tearing)
        values = self.column(self.known[s] for s in outer)
        torn = polish(solver(x0=guess, p=values)["x"], values)
        found = rest(torn, values)
        return {s: torn[i] for i, s in enumerate(own)} | {s: found[i] for i, s in enumerate(others)}

    def translate(self, expression: sympy.Expr) -> Any:
        """Return the value of an expression."""
        for s in self._needed(expression):
            self.write(s)
        return self._build(expression)

    def _needed(self, expression: Definition) -> list[sympy.Symbol]:
        return sorted((s for s in expression.free_symbols if s.name not in self.tables), key=str)

    def _build(self, expression: sympy.Expr, taken: Any = None) -> Any:
        """Return the value of an expression whose symbols are known.

        `taken` is the condition of the branch it stands in. CasADi computes every branch, and the slopes of
        one that isn't taken times 0, which is no number where they are infinite. What is singular somewhere
        gets the argument 1 there, where the branch isn't taken.
        """
        if expression.is_Symbol:
            return self.known[expression]
        if expression.is_number and not expression.args:
            return self.type_(float(expression))
        if expression.is_Mul:
            return self._product(expression, taken)
        name = expression.func.__name__
        if name == "interpolate":
            return self._interpolated(*expression.args)
        if name == "if":
            condition, then, otherwise = expression.args
            return self._chosen(condition, then, otherwise, taken)
        arguments = [self._build(argument, taken) for argument in expression.args]
        if expression.is_Add:
            return _fold(arguments, operator.add)
        if taken is not None and _is_singular(expression):
            arguments[0] = casadi.if_else(taken, arguments[0], 1)
        if expression.is_Pow:
            return _power(arguments[0], expression.exp, arguments[1])
        return _fold(arguments, _EXTREMES[name]) if name in _EXTREMES else _CASADI[name](*arguments)

    def _chosen(self, condition: sympy.Expr, then: sympy.Expr, otherwise: sympy.Expr, taken: Any) -> Any:
        """Return the value of a conditional in a branch."""
        holds = self._build(condition, taken)
        first, second = holds, casadi.logic_not(holds)
        if taken is not None:
            first, second = casadi.logic_and(taken, first), casadi.logic_and(taken, second)
        return casadi.if_else(holds, self._build(then, first), self._build(otherwise, second))

    def _interpolated(self, table: sympy.Symbol, time: sympy.Expr) -> Any:
        """Return a table's value, linear between its rows and constant beyond its ends."""
        found = self.tables[table.name]
        start, end = found.times[0], found.times[-1]
        inside = casadi.fmin(casadi.fmax(self._build(time), start), end)
        return casadi.pw_lin(inside, found.times.tolist(), found.numbers.tolist())

    def _product(self, expression: sympy.Expr, taken: Any) -> Any:
        """Return a product, dividing by its factors of negative power: a/b rounds once, a*b**-1 twice."""
        above = [self._build(node, taken) for node in expression.args if not _is_reciprocal(node)]
        below = [self._build(1 / node, taken) for node in expression.args if _is_reciprocal(node)]
        product = _fold(above, operator.mul) if above else self.type_(1)
        if not below:
            return product
        divisor = _fold(below, operator.mul)
        moving = any(node.free_symbols for node in expression.args if _is_reciprocal(node))
        return product / (casadi.if_else(taken, divisor, 1) if taken is not None and moving else divisor)


def _fold(values: Sequence[Any], join: Callable[[Any, Any], Any]) -> Any:
    total = values[0]
    for value in values[1:]:
        total = join(total, value)
    return total


def _is_singular(node: sympy.Expr) -> bool:
    """Return whether a function, or its slope, is infinite or no number for some argument."""
    if node.is_Pow:
        return not (node.exp.is_Integer and node.exp.is_positive)
    return node.func.__name__ in ("log", "exp")


def _is_reciprocal(node: sympy.Expr) -> bool:
    return bool(node.is_Pow and node.exp.is_Number and node.exp.is_negative)


def _power(base: Any, exponent: sympy.Expr, written: Any) -> Any:
    if exponent == -1:
        return 1 / base
    if exponent == sympy.Rational(1, 2):
        return casadi.sqrt(base)
    if exponent.is_Integer and 0 < abs(int(exponent)) <= 100:
        product = _fold([base] * abs(int(exponent)), operator.mul)
        return product if exponent > 0 else 1 / product
    return base**written
