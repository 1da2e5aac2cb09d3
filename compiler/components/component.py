"""The definition of a component: its declarations and equations, in local names.

Takes: nothing (data types). Gives: `Component` and its parts: `ComponentVariable`, `Connector`,
`NumberParameter`, `Option`, `Reference`, `SentValue`, `PartBindings`, `Inner`, `Linearized`; `option_test`.
Guarantees: plain frozen data.
Does not: read or check text (see `definitions`, `component_check`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

from apc.compiler.errors import SourceLocation
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import (
    FUNCTIONS,
    KEYWORDS,
    Call,
    Equation,
    Expr,
    Name,
    format_expression,
    names,
)
from apc.compiler.language.units import Unit
from apc.compiler.language.values import Bounds, ValueBinding
from apc.compiler.source.nodes import Node

T = TypeVar("T")
Named = tuple[tuple[str, T], ...]  # values by name, in order
Joined = tuple[
    tuple[str, str, str], ...
]  # connections: own connector, connected part, connector of that part

OTHERS = "others"
# Reserved words of the language, invalid as names.
RESERVED = frozenset(
    {"peers", "others", "time", "pi", "ground", "type", "at", "shared", "joining", "set"}
    | {*FUNCTIONS, *KEYWORDS}
)
# Symbols of published conditions on virtual walls: stiffness and damping of the wall, damping and Coulomb
# friction of the device, sampling period, delay of the loop, resolution of the position.
SYMBOLS = ("K", "B", "b", "c", "T", "t_d", "D")
# Roles of parameters that are no numbers: a clock or a link by name, or the description of a graph, delays,
# pairs of groups, losses, a trace or a table.
ROLES = (
    "clock",
    "link",
    "graph",
    "delays",
    "pairs",
    "loss",
    "trace",
    "table",
)


@dataclass(frozen=True, slots=True)
class ComponentVariable:
    """A variable of a component or connector; `start` is None for a variable without a start value.

    `limit` is the name of the parameter that bounds its absolute value, or empty.
    """

    name: str
    unit: Unit
    start: Fraction | None
    description: str
    location: SourceLocation
    limit: str = ""


@dataclass(frozen=True, slots=True)
class Connector:
    """A connector type: the potentials of connected connectors are equal, their flows sum to zero."""

    name: str
    description: str
    potentials: tuple[ComponentVariable, ...]
    flows: tuple[ComponentVariable, ...]


@dataclass(frozen=True, slots=True)
class NumberParameter:
    """A parameter that is a number, in SI units; if `divided`, a shared part divides it among the peers.

    `words` names values, such as left: -1.
    """

    name: str
    unit: Unit
    default: Fraction | None
    minimum: Fraction | None
    exclusive_minimum: bool
    maximum: Fraction | None
    divided: bool
    words: Named[Fraction]
    description: str
    location: SourceLocation

    @property
    def bounds(self) -> Bounds:
        """The range of valid values."""
        return Bounds(
            self.unit.text, self.unit.scale, self.minimum, self.exclusive_minimum, self.maximum, self.words
        )


@dataclass(frozen=True, slots=True)
class Option:
    """A parameter whose value is one of `words`, fixed when the topology is compiled."""

    name: str
    words: tuple[str, ...]
    default: str | None
    description: str
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Reference:
    """A parameter of a role: it names a clock or link, or describes a graph, pairs, loss or a table."""

    name: str
    role: str
    description: str
    location: SourceLocation
    unit: Unit | None = None  # of a table's numbers


Parameter = NumberParameter | Option | Reference


@dataclass(frozen=True, slots=True)
class SentValue:
    """A value that a component sends to the other peers over its link."""

    name: str
    expression: Expr
    text: str
    location: SourceLocation
    dimension: Dimension


@dataclass(frozen=True, slots=True)
class PartBindings:
    """The entry of a part, in the names of the enclosing scope.

    `described` has the nodes of parameters that describe a graph, pairs, losses, a trace or a table.
    `connections` connect a connector to (part, connector); the part "ground" is fixed, an empty part is the
    enclosing component.
    """

    values: Named[ValueBinding]
    options: Named[str]
    references: Named[str]
    described: Named[Node]
    starts: Named[ValueBinding]
    connections: Joined


@dataclass(frozen=True, slots=True)
class Inner:
    """A part inside a component; its entry is written in the names of the outer component."""

    name: str
    component: Component
    entry: PartBindings
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Linearized:
    """The equations of a component in a linear analysis, where they differ from its own.

    Each of `equations` replaces the equation with the same left side. `valid` describes the motions for which
    they are valid.
    """

    equations: tuple[Equation, ...]
    valid: str


@dataclass(frozen=True, slots=True)
class Component:
    """A component with its declarations and equations.

    `locals` are undeclared names on the left side of an equation; they have the dimension of the right side.
    `passed` are the connectors that belong to an inner part: (connector, inner part, its connector). `grips`
    are the connectors that a hand is connected to by default; `peers` is the required number of peers, 0 for
    any number. `joining` is "mean" or "start": the values of the part at a joining peer, "" if not declared.
    """

    name: str
    description: str
    source: str
    location: SourceLocation
    connectors: Named[Connector] = ()
    parameters: tuple[Parameter, ...] = ()
    variables: tuple[ComponentVariable, ...] = ()
    locals: Named[Dimension] = ()
    sends: tuple[SentValue, ...] = ()
    equations: tuple[Equation, ...] = ()
    inner: tuple[Inner, ...] = ()
    passed: Joined = ()
    grips: tuple[str, ...] = ()
    peers: int = 0
    linearized: Linearized | None = None  # None if the component's own equations are linearized
    symbols: Named[str] = ()  # symbols of published wall conditions, and their parameters
    joining: str = ""

    def parameter(self, name: str) -> Parameter | None:
        """Return the parameter of this name, or None."""
        return next((parameter for parameter in self.parameters if parameter.name == name), None)

    def variable(self, name: str) -> ComponentVariable | None:
        """Return the declared variable of this name, or None."""
        return next((variable for variable in self.variables if variable.name == name), None)

    @property
    def numbers(self) -> Iterator[NumberParameter]:
        """The parameters that are numbers."""
        return (parameter for parameter in self.parameters if isinstance(parameter, NumberParameter))

    @property
    def flows(self) -> Iterator[tuple[str, ComponentVariable]]:
        """The flows of the outer connectors, each with its connector."""
        passed = {connector for connector, _, _ in self.passed}
        return ((name, flow) for name, kind in self.connectors if name not in passed for flow in kind.flows)

    @property
    def linear_equations(self) -> tuple[Equation, ...]:
        """The equations of a linear analysis."""
        if self.linearized is None:
            return self.equations
        replaced = {format_expression(equation.left): equation for equation in self.linearized.equations}
        return tuple(replaced.get(format_expression(equation.left), equation) for equation in self.equations)

    @property
    def depth(self) -> int:
        """The nesting depth of parts: 1 for a component without inner parts."""
        return 1 + max((inner.component.depth for inner in self.inner), default=0)

    @property
    def size(self) -> int:
        """The number of parts: the part itself and all inner parts."""
        return 1 + sum(inner.component.size for inner in self.inner)

    @property
    def receives_from_others(self) -> bool:
        """Whether an equation of the component or of an inner part has a value received from the
        other peers.
        """
        side_names = (names(side) for equation in self.equations for side in (equation.left, equation.right))
        is_receiver = any(name.parts[0] == OTHERS for side in side_names for name in side)
        return is_receiver or any(inner.component.receives_from_others for inner in self.inner)


# A declaration whose value a group of peers can set.
Settable = NumberParameter | Option | Reference | ComponentVariable


def option_test(node: Expr, options: dict[str, Option]) -> tuple[Option, str] | None:
    """Return the option and the word compared in a test such as `delays == all`.

    The result is None for other expressions.
    """
    match node:
        case Call("==" | "!=", (Name((name,)), Name((word,)))) if (
            name in options and word in options[name].words
        ):
            return options[name], word
    return None
