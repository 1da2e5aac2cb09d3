"""Terms written as CasADi's, each definition once.

Takes: `SortedPeerType`. Gives: `CasadiWriter`.
Guarantees: written in the order in which things depend on one another, and nothing that isn't needed; a chain
of definitions may be as long as it likes; what a nonlinear loop finds is a symbol, and a function that needs
it solves the loop by Newton's iteration first.
Does not: choose the written expressions (see `functions`).
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
from apc.compiler.equations.causalization import SortedPeerType
from apc.compiler.equations.flatten import HoldCrossing, PreviousCrossing
from apc.compiler.equations.linear_decomposition import PeerReduction
from apc.compiler.equations.solution import Definition, ImplicitBlock
from apc.compiler.equations.terms import HALF, NAMES, ONE, Symbol, Term, in_order, symbol
from apc.compiler.expression_data import AlgebraicLoop, composed
from apc.compiler.interpolation import Interpolation, function_of
from apc.compiler.language.expression import SMOOTH

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
    """Translates terms of a peer type to CasADi's SX, each definition once.

    `known` are the symbols written so far: what has no definition is a symbol of its own there, which crosses
    into the subsystem, or is one of the `parameters`, the numbers and start values that were needed.
    """

    def __init__(self, peer_type: SortedPeerType) -> None:
        flat = peer_type.clocked.flat
        self.peer_type = peer_type
        self.definitions = peer_type.definitions
        self.tables = {f"{part.name}.{table.name}": table for part in flat.parts for table in part.tables}
        self.started = {variable.name for variable in flat.variables if variable.start}
        self.known: dict[Symbol, Any] = {
            symbol(name): casadi.SX.sym(name) for name in ("time", *peer_type.states)
        }
        self.crossing = {crossing.symbol for crossing in flat.crossings} | {
            receive.symbol for receive in peer_type.receives
        }
        self.parameters: dict[str, Any] = {}
        self.loops: list[tuple[Any, Any, Any]] = []  # unknowns (n,), their start values, the residuals

    def follow(self, received: Collection[str]) -> None:
        """Write the dependencies of states, limited signals and received sends.

        The expression of a used crossing is written too; its dependencies in the next call.
        """
        clocked = self.peer_type.clocked
        stored = [number.variable for number in self.read(clocked.previous)]
        for name in (*self.peer_type.states, *stored):
            self.parameter(name)
        limited = [variable.name for variable in clocked.flat.variables if variable.limit]
        held = [number.variable for number in self.read(clocked.holds)]
        self.column([*map("der({})".format, self.peer_type.states), *limited, *held, *stored])
        edges = [number.edge for number in self.read(self.peer_type.receives) if number.edge is not None]
        for expression in (
            *edges,
            *(send.expression for send in self.peer_type.sends if send.name in received),
        ):
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
        """Return a CasADi function that computes a value from columns of inputs.

        The result is an SX function, unless the value needs a nonlinear loop: then it is an MX function that
        calls SX functions, with Newton's iteration for each loop.

        Parameters
        ----------
        name
            The name of the function.
        inputs
            The column of symbols of each input, by name.
        output
            The name of the output.
        value
            The SX expression to compute.
        """
        words, columns = list(inputs), list(inputs.values())
        solved, requested = list[Any](), value  # the unknowns of the loops that the value needs, in order
        needed: list[tuple[Any, Any, Any]] = []
        for z, begin, residual in reversed(self.loops):
            if casadi.depends_on(requested, z):
                needed.insert(0, (z, begin, residual))
                requested = casadi.vertcat(requested, begin, residual)
        if not needed:
            return casadi.Function(name, columns, [value], words, [output])
        loops = []
        for z, begin, residual in needed:
            q = casadi.vertcat(*(s for s in casadi.symvar(residual) if not casadi.depends_on(s, z)))
            given = casadi.Function("given", [*columns, *solved], [begin, q])
            loops.append(AlgebraicLoop(given, casadi.Function("residual", [z, q], [residual])))
            solved.append(z)
        more = [f"z{index}" for index in range(len(solved))]
        result = casadi.Function("result", [*columns, *solved], [value], [*words, *more], [output])
        return composed(name, loops, result, words)

    def write(self, requested: Term) -> Any:
        """Return the value of an expression, after its dependencies.

        A stack instead of recursion, so that the length of a chain of definitions is no limit.
        """
        work = self._needed(requested)
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
        return self._build(requested)

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

    def _build(self, expression: Term, used: Any = None) -> Any:
        """Return the value of an expression with known symbols.

        `used` is the condition of its branch. CasADi computes every branch, and multiplies the derivatives
        of inactive ones by 0, which is NaN if they are infinite. A singular function therefore gets a regular
        argument if its branch is inactive.
        """
        if expression.is_Symbol:
            return self.known[expression]
        if expression.is_Rational:
            return casadi.SX(expression.p / expression.q)
        if expression.is_NumberSymbol:
            return casadi.SX(float(expression))
        if expression.is_Mul or expression.is_Pow:
            return self._product(expression, used)
        name = "+" if expression.is_Add else NAMES.get(expression.func)
        if name is None:  # a cotangent, which SymPy makes of some tangents
            return self._build(expression.rewrite(tan), used)
        if name == "interpolate":  # a table's value, linear between its rows and constant beyond its ends
            rows = self.tables[expression.args[0].name]
            return function_of(Interpolation(rows.times, rows.numbers))(self._build(expression.args[1]))
        if name == "if":
            holds = self._build(expression.args[0], used)
            within = [holds, casadi.logic_not(holds)]
            if used is not None:
                within = [casadi.logic_and(used, item) for item in within]
            return casadi.if_else(holds, *map(self._build, expression.args[1:], within))
        arguments = [self._build(argument, used) for argument in expression.args]
        if used is not None and name in _SOMEWHERE_NONE:
            arguments = [casadi.if_else(used, argument, HARMLESS) for argument in arguments]
        function = _CASADI[name]
        return functools.reduce(function, arguments) if name in ("+", "max", "min") else function(*arguments)

    def _product(self, term: Term, used: Any) -> Any:
        """Return a product, with division by factors of negative power: a*(1/b) rounds twice."""
        above, below, moving = casadi.SX(1), casadi.SX(1), False
        for factor in Mul.make_args(term):
            base, exponent = factor.args if factor.is_Pow else (factor, ONE)
            if exponent.is_negative:
                below *= self._power(base, -exponent, used)
                moving = moving or bool(base.free_symbols)
            else:
                above *= self._power(base, exponent, used)
        return above / (casadi.if_else(used, below, 1) if used is not None and moving else below)

    def _power(self, base: Term, exponent: Term, used: Any) -> Any:
        """Return a power with a positive exponent."""
        value = self._build(base, used)
        if not exponent.is_Integer and used is not None:
            value = casadi.if_else(used, value, 1)
        if exponent == HALF:
            return casadi.sqrt(value)
        if exponent.is_Integer and exponent <= MOST_FACTORS:
            return functools.reduce(operator.mul, [value] * int(exponent))
        return value ** self._build(exponent, used)
