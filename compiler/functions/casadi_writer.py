"""Translation of terms to CasADi expressions, each definition once.

Takes: `SortedPeerType`. Gives: `CasadiWriter`.
Guarantees: only required definitions are translated, in order of dependence; the length of a chain of
definitions is not limited; the solution of a nonlinear loop is a symbol, and a function that requires the
solution solves the loop by Newton's iteration first.
Does not: choose the expressions (see `functions`).
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

MOST_FACTORS = 100  # the largest exponent of a power computed as a product
# Functions that, or whose derivatives, are infinite or undefined for some arguments; a regular argument of
# all.
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
    """The translation of a peer type's terms to CasADi's SX, each definition once.

    `known` are the symbols translated so far. A symbol without a definition becomes an SX symbol: it crosses
    into the subsystem, or it is one of the `parameters`, the required numbers and start values.
    """

    def __init__(self, peer_type: SortedPeerType) -> None:
        """Collect the definitions, tables, start values and crossings of a peer type."""
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
        """Translate the dependencies of states, limited variables and received sends.

        The expressions of used crossings are translated too; their dependencies in the next call.
        """
        clocked = self.peer_type.clocked
        stored = [crossing.variable for crossing in self.read(clocked.previous)]
        for name in (*self.peer_type.states, *stored):
            self.parameter(name)
        limited = [variable.name for variable in clocked.flat.variables if variable.limit]
        held = [crossing.variable for crossing in self.read(clocked.holds)]
        self.column([*map("der({})".format, self.peer_type.states), *limited, *held, *stored])
        edges = [
            crossing.edge for crossing in self.read(self.peer_type.receives) if crossing.edge is not None
        ]
        for expression in (
            *edges,
            *(send.expression for send in self.peer_type.sends if send.name in received),
        ):
            self.write(expression)

    def column(self, names: Iterable[str]) -> Any:
        """Return the values of names as a dense column, (0, 1) if there are none."""
        return casadi.densify(casadi.vertcat(casadi.SX(0, 1), *(self.write(symbol(name)) for name in names)))

    def parameter(self, name: str) -> Any:
        """Return the symbol of a parameter; a start value has the name of its variable."""
        return self.parameters.setdefault(name, casadi.SX.sym(name))

    def read(self, crossings: Iterable[Crossing]) -> list[Crossing]:
        """Return the crossings whose symbols are required."""
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
        solved, required = list[Any](), value  # the unknowns of the loops that the value needs, in order
        loops_in_use: list[tuple[Any, Any, Any]] = []
        for z, begin, residual in reversed(self.loops):
            if casadi.depends_on(required, z):
                loops_in_use.insert(0, (z, begin, residual))
                required = casadi.vertcat(required, begin, residual)
        if not loops_in_use:
            return casadi.Function(name, columns, [value], words, [output])
        loops = []
        for z, begin, residual in loops_in_use:
            q = casadi.vertcat(*(s for s in casadi.symvar(residual) if not casadi.depends_on(s, z)))
            given = casadi.Function("given", [*columns, *solved], [begin, q])
            loops.append(AlgebraicLoop(given, casadi.Function("residual", [z, q], [residual])))
            solved.append(z)
        solved_names = [f"z{index}" for index in range(len(solved))]
        result = casadi.Function("result", [*columns, *solved], [value], [*words, *solved_names], [output])
        return composed(name, loops, result, words)

    def write(self, expression: Term) -> Any:
        """Return the SX value of an expression, after translation of its dependencies.

        An explicit stack replaces recursion, so that the length of a chain of definitions is not limited.
        """
        work = self._needed(expression)
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
        return self._build(expression)

    def _needed(self, expression: Definition) -> list[Symbol]:
        """Return the symbols of an expression that are not yet translated."""
        return [
            s for s in in_order(expression.free_symbols) if s not in self.known and s.name not in self.tables
        ]

    def _tear(self, loop: ImplicitBlock) -> None:
        """Add the tearing unknowns of a nonlinear loop as symbols.

        The other unknowns are computed from them.
        """
        z = casadi.SX.sym("z", len(loop.tearing))
        begin = casadi.vertcat(*(self.parameter(x) if x in self.started else 0 for x in loop.tearing))
        self.known |= {symbol(name): z[i] for i, name in enumerate(loop.tearing)}
        self.definitions |= {symbol(name): expression for name, expression in loop.inner}
        self.loops.append((z, begin, casadi.densify(casadi.vertcat(*map(self.write, loop.residuals)))))

    def _build(self, expression: Term, active: Any = None) -> Any:
        """Return the SX value of an expression whose symbols are translated.

        `active` is the condition of its branch, None outside of branches. CasADi computes every branch, and
        multiplies the derivatives of inactive branches by 0, which is NaN if they are infinite. A singular
        function therefore gets a regular argument if its branch is inactive.
        """
        if expression.is_Symbol:
            return self.known[expression]
        if expression.is_Rational:
            return casadi.SX(expression.p / expression.q)
        if expression.is_NumberSymbol:
            return casadi.SX(float(expression))
        if expression.is_Mul or expression.is_Pow:
            return self._product(expression, active)
        name = "+" if expression.is_Add else NAMES.get(expression.func)
        if name is None:  # a cotangent, to which SymPy converts some tangents
            return self._build(expression.rewrite(tan), active)
        if name == "interpolate":  # linear between the rows of a table, constant beyond its ends
            rows = self.tables[expression.args[0].name]
            return function_of(Interpolation(rows.times, rows.numbers))(self._build(expression.args[1]))
        if name == "if":
            condition = self._build(expression.args[0], active)
            conditions = [condition, casadi.logic_not(condition)]
            if active is not None:
                conditions = [casadi.logic_and(active, item) for item in conditions]
            return casadi.if_else(condition, *map(self._build, expression.args[1:], conditions))
        arguments = [self._build(argument, active) for argument in expression.args]
        if active is not None and name in _SOMEWHERE_NONE:
            arguments = [casadi.if_else(active, argument, HARMLESS) for argument in arguments]
        function = _CASADI[name]
        return functools.reduce(function, arguments) if name in ("+", "max", "min") else function(*arguments)

    def _product(self, term: Term, active: Any) -> Any:
        """Return a product; factors with negative powers are a divisor, since a*(1/b) is rounded twice."""
        numerator, denominator, is_variable = casadi.SX(1), casadi.SX(1), False
        for factor in Mul.make_args(term):
            base, exponent = factor.args if factor.is_Pow else (factor, ONE)
            if exponent.is_negative:
                denominator *= self._power(base, -exponent, active)
                is_variable = is_variable or bool(base.free_symbols)
            else:
                numerator *= self._power(base, exponent, active)
        return numerator / (
            casadi.if_else(active, denominator, 1) if active is not None and is_variable else denominator
        )

    def _power(self, base: Term, exponent: Term, active: Any) -> Any:
        """Return a power with a positive exponent."""
        value = self._build(base, active)
        if not exponent.is_Integer and active is not None:
            value = casadi.if_else(active, value, 1)
        if exponent == HALF:
            return casadi.sqrt(value)
        if exponent.is_Integer and exponent <= MOST_FACTORS:
            return functools.reduce(operator.mul, [value] * int(exponent))
        return value ** self._build(exponent, active)
