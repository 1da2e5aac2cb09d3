"""Terms written as CasADi's, each definition once.

Takes: symbols whose values are known, and what defines the others. Gives: `Writer`, `Definition`.
Guarantees: written in the order in which things depend on one another; a chain of definitions may be as long
as it likes; what a nonlinear loop finds is a symbol, and a function that needs it solves the loop by
Newton's iteration first.
Does not: choose what is written (see `functions`).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi
from sympy import Mul, tan

from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.terms import HALF, NAMES, ONE, Symbol, Term, in_order, symbol
from apc.compiler.interpolation import Interpolation, function_of
from apc.compiler.language.expression import SMOOTH
from apc.compiler.language.recordings import TimeTable
from apc.compiler.plain import Loop, composed

Definition: TypeAlias = Term | ImplicitBlock
MOST_FACTORS = 100  # of a power that is written as a product
# Functions that are infinite or no number somewhere, or whose slopes are; and where none of them is.
_SOMEWHERE_NONE = ("exp", "log", "tan", "asin", "acos", "sinh", "cosh", "atan2")
HARMLESS = 0.5
_CASADI: dict[str, Callable[..., Any]] = {
    "min": casadi.fmin,
    "max": casadi.fmax,
    "abs": casadi.fabs,
    "sign": casadi.sign,
    "floor": casadi.floor,
    **{name: getattr(casadi, name) for name in ("atan2", *SMOOTH)},
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


@dataclass(frozen=True, slots=True)
class _Torn:
    """A loop met while writing: its unknowns `z` (n,), where they begin, its residual of z and `q` (m,)."""

    z: Any
    begin: Any
    q: Any
    residual: Any  # casadi.Function


class Writer:
    """Translates terms to CasADi's SX, each definition once.

    `starts` gives the start values of the unknowns that have one, where a loop's iteration begins.
    """

    def __init__(
        self,
        known: Mapping[Symbol, Any],
        definitions: Mapping[Symbol, Definition],
        tables: Mapping[str, TimeTable],
        starts: Mapping[str, Any],
    ) -> None:
        self.known = dict(known)
        self.definitions = dict(definitions)
        self.tables = tables
        self.starts = starts
        self.torn: list[_Torn] = []

    def column(self, values: Iterable[Any]) -> Any:
        """Return a dense column of scalars, (0, 1) when there are none."""
        listed = list(values)
        return casadi.densify(casadi.vertcat(*listed)) if listed else casadi.SX(0, 1)

    def extended(self, known: Mapping[Symbol, Any], definitions: Mapping[Symbol, Definition]) -> Writer:
        """Return a writer that knows more."""
        more = Writer({**self.known, **known}, {**self.definitions, **definitions}, self.tables, self.starts)
        more.torn = list(self.torn)
        return more

    def function(self, name: str, inputs: Mapping[str, Any], output: str, value: Any) -> Any:
        """Return the CasADi function of some columns that gives a value written in them.

        An SX function, unless the value needs a loop: then an MX function that calls SX functions, with
        Newton's iteration for each loop.
        """
        words, columns = list(inputs), list(inputs.values())
        needed: list[_Torn] = []
        wanted = value
        for one in reversed(self.torn):
            if casadi.depends_on(wanted, one.z):
                needed.insert(0, one)
                wanted = casadi.vertcat(wanted, one.begin, one.q)
        if not needed:
            return casadi.Function(name, columns, [value], words, [output])
        solved = []
        for place, one in enumerate(needed):
            found = [before.z for before in needed[:place]]
            given = casadi.Function(
                f"given{place}",
                [*columns, *found],
                [one.begin, one.q],
                [*words, *(f"z{k}" for k in range(place))],
                ["begin", "q"],
            )
            solved.append(Loop(given, one.residual))
        result = casadi.Function(
            "result",
            [*columns, *(one.z for one in needed)],
            [value],
            [*words, *(f"z{k}" for k in range(len(needed)))],
            [output],
        )
        return composed(name, solved, result, words)

    def write(self, wanted: Symbol) -> Any:
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
                    self._tear(definition)
                else:
                    self.known[s] = self._build(definition)
        return self.known[wanted]

    def _tear(self, loop: ImplicitBlock) -> None:
        """Make known the unknowns of a loop that are torn; the others follow from them."""
        outer = self._needed(loop)
        own = {symbol(name): casadi.SX.sym(name) for name in loop.tearing}
        given = {s: casadi.SX.sym(s.name) for s in outer}
        others = {symbol(name): expression for name, expression in loop.inner}
        inside = Writer({**own, **given}, others, self.tables, {})
        z, q = inside.column(own.values()), inside.column(given.values())
        residual = inside.column(inside.translate(expression) for expression in loop.residuals)
        begin = self.column(self.starts.get(name, casadi.SX(0)) for name in loop.tearing)
        found = casadi.SX.sym("z", len(own))
        self.torn.append(
            _Torn(
                found,
                begin,
                self.column(self.known[s] for s in outer),
                casadi.Function("residual", [z, q], [residual], ["z", "q"], ["r"]),
            )
        )
        self.known |= {s: found[i] for i, s in enumerate(own)}
        self.definitions |= others

    def translate(self, expression: Term) -> Any:
        """Return the value of an expression."""
        for s in self._needed(expression):
            self.write(s)
        return self._build(expression)

    def _needed(self, expression: Definition) -> list[Symbol]:
        return in_order(s for s in expression.free_symbols if s.name not in self.tables)

    def _build(self, expression: Term, taken: Any = None) -> Any:
        """Return the value of an expression whose symbols are known.

        `taken` is the condition of the branch it stands in. CasADi computes every branch, and the slopes of
        one that isn't taken times 0, which is no number where they are infinite. What is singular somewhere
        gets a harmless argument there, where the branch isn't taken.
        """
        if expression.is_Symbol:
            return self.known[expression]
        if expression.is_Rational:
            return casadi.SX(expression.p / expression.q)
        if expression.is_NumberSymbol:
            return casadi.SX(float(expression))
        if expression.is_Add:
            return functools.reduce(operator.add, (self._build(one, taken) for one in expression.args))
        if expression.is_Mul or expression.is_Pow:
            return self._product(expression, taken)
        name = NAMES.get(expression.func)
        if name is None:  # a cotangent, which SymPy makes of some tangents
            return self._build(expression.rewrite(tan), taken)
        if name == "interpolate":
            return self._interpolated(*expression.args)
        if name == "if":
            condition, then, otherwise = expression.args
            return self._chosen(condition, then, otherwise, taken)
        arguments = [self._build(argument, taken) for argument in expression.args]
        if taken is not None and name in _SOMEWHERE_NONE:
            arguments = [casadi.if_else(taken, one, HARMLESS) for one in arguments]
        function = _CASADI[name]
        return functools.reduce(function, arguments) if name in ("max", "min") else function(*arguments)

    def _chosen(self, condition: Term, then: Term, otherwise: Term, taken: Any) -> Any:
        """Return the value of a conditional in a branch."""
        holds = self._build(condition, taken)
        first, second = holds, casadi.logic_not(holds)
        if taken is not None:
            first, second = casadi.logic_and(taken, first), casadi.logic_and(taken, second)
        return casadi.if_else(holds, self._build(then, first), self._build(otherwise, second))

    def _interpolated(self, table: Term, time: Term) -> Any:
        """Return a table's value, linear between its rows and constant beyond its ends."""
        rows = self.tables[table.name]
        return function_of(Interpolation(rows.times, rows.numbers))(self._build(time))

    def _product(self, term: Term, taken: Any) -> Any:
        """Return a product, dividing by what has a negative power: a*(1/b) rounds twice."""
        above, below = [], []
        for factor in Mul.make_args(term):
            base, exponent = factor.args if factor.is_Pow else (factor, ONE)
            if exponent.is_negative:
                below.append((base, -exponent))
            else:
                above.append((base, exponent))
        product, divisor = (
            functools.reduce(operator.mul, [self._power(*one, taken) for one in powers] or [casadi.SX(1)])
            for powers in (above, below)
        )
        if not below:
            return product
        moving = any(base.free_symbols for base, _ in below)
        return product / (casadi.if_else(taken, divisor, 1) if taken is not None and moving else divisor)

    def _power(self, base: Term, exponent: Term, taken: Any) -> Any:
        """Return a power with a positive exponent."""
        value = self._build(base, taken)
        if not exponent.is_Integer and taken is not None:
            value = casadi.if_else(taken, value, 1)
        if exponent == HALF:
            return casadi.sqrt(value)
        if exponent.is_Integer and exponent <= MOST_FACTORS:
            return functools.reduce(operator.mul, [value] * int(exponent))
        return value ** self._build(exponent, taken)
