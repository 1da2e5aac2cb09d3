"""The definition of a component: its declarations and equations, in local names.

Takes: nothing (data types). Gives: `Component` and its parts: `ComponentVariable`, `Connector`,
`NumberParameter`, `Option`, `Reference`, `SentValue`, `PartBindings`, `Inner`, `Linearized`; `option_test`.
Guarantees: plain frozen data.
Does not: read or check text (see `library`).
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
Joined = tuple[tuple[str, str, str], ...]  # connectors, each with a part and a connector of it

OTHERS = "others"
# Words of the language, which nothing may have as its name.
RESERVED = frozenset(
    {"peers", "others", "time", "pi", "ground", "type", "at", "shared", "set", *FUNCTIONS, *KEYWORDS}
)
# Symbols of published conditions on virtual walls: stiffness and damping of the wall, damping and Coulomb
# friction of the device, sampling period, delay of the loop, resolution of the position.
SYMBOLS = ("K", "B", "b", "c", "T", "t_d", "D")
# A parameter of one of these roles isn't a number: it names, or describes, something of the topology.
ROLES = (
    "clock",
    "link",
    "graph",
    "delays",
    "loss",
    "trace",
    "table",
)


@dataclass(frozen=True, slots=True)
class ComponentVariable:
    """A variable of a component or connector; `start` is None for one that needs no start value.

    `limit` is the parameter that its size should stay within, empty if there is none.
    """

    name: str
    unit: Unit
    start: Fraction | None
    description: str
    location: SourceLocation
    limit: str = ""


@dataclass(frozen=True, slots=True)
class Connector:
    """A connector type: potentials are equal where connectors meet, flows sum to zero."""

    name: str
    description: str
    potentials: tuple[ComponentVariable, ...]
    flows: tuple[ComponentVariable, ...]


@dataclass(frozen=True, slots=True)
class NumberParameter:
    """A parameter that is a number, in SI; with `divided`, a shared part divides it among the peers.

    `words` gives names to values, such as left: -1.
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
        return Bounds(self.unit.text, self.unit.scale, self.minimum, self.exclusive_minimum, self.maximum)


@dataclass(frozen=True, slots=True)
class Option:
    """A parameter that is a word, decided when the topology is compiled."""

    name: str
    words: tuple[str, ...]
    default: str | None
    description: str
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Reference:
    """A parameter of a role: it names a clock or link, or describes a graph, delays, loss or a table."""

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

    `described` are the nodes of parameters that describe something (a graph, a table). `connections` join a
    connector to (part, connector); the part "ground" is fixed, an empty part is the component around.
    """

    values: Named[ValueBinding]
    options: Named[str]
    references: Named[str]
    described: Named[Node]
    starts: Named[ValueBinding]
    connections: Joined


@dataclass(frozen=True, slots=True)
class Inner:
    """A part inside a component; its entry is in the terms of the outer component."""

    name: str
    component: Component
    entry: PartBindings
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Linearized:
    """The linear representation of a component in a linear analysis.

    Each of `equations` replaces the equation with the same left side. `valid` describes the motions it
    applies to.
    """

    equations: tuple[Equation, ...]
    valid: str


@dataclass(frozen=True, slots=True)
class Component:
    """A complete component.

    `locals` are undeclared names that are the left side of an equation; they have the dimension of the right
    side. `passed` are the connectors that belong to an inner part: (connector, inner part, its connector).
    `grips` are the connectors a hand is joined to where it names none; `peers` is for how many peers it is, 0
    for any number.
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
    linearized: Linearized | None = None  # None where the equations themselves are linearized
    symbols: Named[str] = ()  # symbols of published wall conditions, and their parameters

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
        """Return the nesting depth of parts: 1 for a component without any."""
        return 1 + max((inner.component.depth for inner in self.inner), default=0)

    @property
    def size(self) -> int:
        """The number of parts, including the part itself and inner ones."""
        return 1 + sum(inner.component.size for inner in self.inner)

    @property
    def receives_from_others(self) -> bool:
        """Whether an equation, here or in an inner part, reads the other peers."""
        read = (names(side) for equation in self.equations for side in (equation.left, equation.right))
        local = any(name.parts[0] == OTHERS for side in read for name in side)
        return local or any(inner.component.receives_from_others for inner in self.inner)


Settable = (
    NumberParameter | Option | Reference | ComponentVariable
)  # what a group of peers can set for itself


def option_test(node: Expr, options: dict[str, Option]) -> tuple[Option, str] | None:
    """Return the option and the word that a comparison such as `delays == all` is about."""
    match node:
        case Call("==" | "!=", (Name((name,)), Name((word,)))) if (
            name in options and word in options[name].words
        ):
            return options[name], word
    return None
