"""Terms written as CasADi's, each definition once.

Takes: `SortedPeerType`. Gives: `CasadiWriter`.
Guarantees: written in the order in which things depend on one another, and nothing that isn't needed; a chain
of definitions may be as long as it likes; what a nonlinear loop finds is a symbol, and a function that needs
it solves the loop by Newton's iteration first.
Does not: choose what is written (see `functions`).
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, TypeVar

import casadi
from sympy import Mul, tan

from apc.compiler.components.component import OTHERS
from apc.compiler.equations.flatten import HoldCrossing, PreviousCrossing
from apc.compiler.equations.reductions import PeerReduction
from apc.compiler.equations.solution import Definition, ImplicitBlock
from apc.compiler.equations.structure import SortedPeerType
from apc.compiler.equations.terms import HALF, NAMES, ONE, Symbol, Term, in_order, symbol
from apc.compiler.interpolation import Interpolation, function_of
from apc.compiler.language.expression import SMOOTH
from apc.compiler.plain import AlgebraicLoop, composed

MOST_FACTORS = 100  # of a power that is written as a product
# Functions that are infinite or no number somewhere, or whose slopes are; and where none of them is.
_SOMEWHERE_NONE = ("exp", "log", "tan", "asin", "acos", "sinh", "cosh", "atan2")
HARMLESS = 0.5
Crossing = TypeVar("Crossing", HoldCrossing, PreviousCrossing, PeerReduction)
_CASADI: dict[str, Callable[..., Any]] = {
    "+": operator.add,
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


class CasadiWriter:
    """Translates terms of a kind to CasADi's SX, each definition once.

    `known` are the symbols written so far: what has no definition is a symbol of its own there, which crosses
    into the site, or is one of the `parameters`, the numbers and start values that were needed.
    """

    def __init__(self, kind: SortedPeerType) -> None:
        flat = kind.clocked.flat
        self.kind = kind
        self.definitions = kind.definitions
        self.tables = {f"{part.name}.{table.name}": table for part in flat.parts for table in part.tables}
        self.started = {variable.name for variable in flat.variables if variable.start}
        self.known: dict[Symbol, Any] = {symbol(name): casadi.SX.sym(name) for name in ("time", *kind.states)}
        self.crossing = {crossing.symbol for crossing in flat.crossings} | {
            receive.symbol for receive in kind.receives
        }
        self.parameters: dict[str, Any] = {}
        self.loops: list[tuple[Any, Any, Any]] = []  # unknowns (n,), where they begin, what is to be zero

    def follow(self, heard: Collection[str]) -> None:
        """Write what the motion of any state follows from, what has a limit, and the sends that are heard.

        What a crossing that was read stands for is written too; what that reads, when this is called again.
        """
        clocked = self.kind.clocked
        remembered = [number.variable for number in self.read(clocked.previous)]
        for name in (*self.kind.states, *remembered):
            self.parameter(name)
        limited = [variable.name for variable in clocked.flat.variables if variable.limit]
        held = [number.variable for number in self.read(clocked.holds)]
        self.column([*map("der({})".format, self.kind.states), *limited, *held, *remembered])
        edges = [number.edge for number in self.read(self.kind.receives) if number.edge is not None]
        for expression in (*edges, *(send.expression for send in self.kind.sends if send.name in heard)):
            self.write(expression)

    def column(self, names: Iterable[str]) -> Any:
        """Return the values of some names as a dense column, (0, 1) when there are none."""
        return casadi.densify(casadi.vertcat(casadi.SX(0, 1), *(self.write(symbol(name)) for name in names)))

    def parameter(self, name: str) -> Any:
        """Return the symbol of a parameter; a start value has the name of its variable."""
        return self.parameters.setdefault(name, casadi.SX.sym(name))

    def read(self, crossings: Iterable[Crossing]) -> list[Crossing]:
        """Return the crossings whose symbols were needed."""
        return [crossing for crossing in crossings if symbol(crossing.symbol) in self.known]

    def function(self, name: str, inputs: Mapping[str, Any], output: str, value: Any) -> Any:
        """Return the CasADi function of some columns that gives a value written in them.

        An SX function, unless the value needs a loop: then an MX function that calls SX functions, with
        Newton's iteration for each loop.
        """
        words, columns = list(inputs), list(inputs.values())
        solved, wanted = list[Any](), value  # the unknowns of the loops that the value needs, in order
        needed: list[tuple[Any, Any, Any]] = []
        for z, begin, residual in reversed(self.loops):
            if casadi.depends_on(wanted, z):
                needed.insert(0, (z, begin, residual))
                wanted = casadi.vertcat(wanted, begin, residual)
        if not needed:
            return casadi.Function(name, columns, [value], words, [output])
        loops = []
        for z, begin, residual in needed:
            q = casadi.vertcat(*(s for s in casadi.symvar(residual) if not casadi.depends_on(s, z)))
            given = casadi.Function("given", [*columns, *solved], [begin, q])
            loops.append(AlgebraicLoop(given, casadi.Function("residual", [z, q], [residual])))
            solved.append(z)
        more = [f"z{place}" for place in range(len(solved))]
        result = casadi.Function("result", [*columns, *solved], [value], [*words, *more], [output])
        return composed(name, loops, result, words)

    def write(self, wanted: Term) -> Any:
        """Return the value of an expression, writing what it depends on first.

        A stack instead of recursion, so that the length of a chain of definitions is no limit.
        """
        work = self._needed(wanted)
        while work:
            s, definition = work[-1], self.definitions.get(work[-1])
            if s in self.known:
                work.pop()
            elif definition is None:
                crosses = s.name in self.crossing or s.name.startswith(f"{OTHERS}.")
                start = re.sub(r"^initial\((.*)\)$", r"\1", s.name)
                self.known[s] = casadi.SX.sym(s.name) if crosses else self.parameter(start)
            elif missing := self._needed(definition):
                work += missing
            elif isinstance(definition, ImplicitBlock):
                self._tear(definition)
            else:
                self.known[s] = self._build(definition)
        return self._build(wanted)

    def _needed(self, expression: Definition) -> list[Symbol]:
        """Return the symbols that have to be written before an expression."""
        return [
            s for s in in_order(expression.free_symbols) if s not in self.known and s.name not in self.tables
        ]

    def _tear(self, loop: ImplicitBlock) -> None:
        """Make known the unknowns of a loop that are torn; the others follow from them."""
        z = casadi.SX.sym("z", len(loop.tearing))
        begin = casadi.vertcat(*(self.parameter(x) if x in self.started else 0 for x in loop.tearing))
        self.known |= {symbol(name): z[i] for i, name in enumerate(loop.tearing)}
        self.definitions |= {symbol(name): expression for name, expression in loop.inner}
        self.loops.append((z, begin, casadi.densify(casadi.vertcat(*map(self.write, loop.residuals)))))

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
        if expression.is_Mul or expression.is_Pow:
            return self._product(expression, taken)
        name = "+" if expression.is_Add else NAMES.get(expression.func)
        if name is None:  # a cotangent, which SymPy makes of some tangents
            return self._build(expression.rewrite(tan), taken)
        if name == "interpolate":  # a table's value, linear between its rows and constant beyond its ends
            rows = self.tables[expression.args[0].name]
            return function_of(Interpolation(rows.times, rows.numbers))(self._build(expression.args[1]))
        if name == "if":
            holds = self._build(expression.args[0], taken)
            within = [holds, casadi.logic_not(holds)]
            if taken is not None:
                within = [casadi.logic_and(taken, item) for item in within]
            return casadi.if_else(holds, *map(self._build, expression.args[1:], within))
        arguments = [self._build(argument, taken) for argument in expression.args]
        if taken is not None and name in _SOMEWHERE_NONE:
            arguments = [casadi.if_else(taken, argument, HARMLESS) for argument in arguments]
        function = _CASADI[name]
        return functools.reduce(function, arguments) if name in ("+", "max", "min") else function(*arguments)

    def _product(self, term: Term, taken: Any) -> Any:
        """Return a product, dividing by what has a negative power: a*(1/b) rounds twice."""
        above, below, moving = casadi.SX(1), casadi.SX(1), False
        for factor in Mul.make_args(term):
            base, exponent = factor.args if factor.is_Pow else (factor, ONE)
            if exponent.is_negative:
                below *= self._power(base, -exponent, taken)
                moving = moving or bool(base.free_symbols)
            else:
                above *= self._power(base, exponent, taken)
        return above / (casadi.if_else(taken, below, 1) if taken is not None and moving else below)

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
