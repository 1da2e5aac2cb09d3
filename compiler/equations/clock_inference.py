"""Clock inference: which variables and equations tick together, and with which clock.

Takes: equations in whole names, one after the other. Gives: `ClockInference`, `CONTINUOUS`, `domain`.
Guarantees: what stands in one equation belongs to one clock, or a mistake says what would have to cross.
Does not: name crossings (see `clocks`).

Modelica's clock partitioning (Modelica Language Specification 3.6, section 16.7) does the same: variables
that meet in an equation are merged into sets, which `sample`, `hold`, `der` and a part's clock pin down.
"""

from __future__ import annotations

from collections.abc import Container

from apc.compiler.components.component import OTHERS
from apc.compiler.equations.flatten import CONNECTION, FlatEquation
from apc.compiler.equations.reductions import hears_others, of_others
from apc.compiler.errors import Mistakes
from apc.compiler.language.expression import (
    Call,
    Expr,
    Name,
    children,
    format_expression,
    names,
    transform,
)

CONTINUOUS = "continuous"


class ClockInference:
    """The sets of names that must tick together, merged as equations are read (union and find).

    `variables` are the unknowns of the kind; it may grow until the first equation is read.
    """

    def __init__(self, variables: Container[str], mistakes: Mistakes) -> None:
        self.variables = variables
        self.mistakes = mistakes
        self._parents: dict[str, str] = {}
        self._clock_of_set: dict[str, str] = {}
        self._hearing: dict[str, FlatEquation] = {}  # by what hears
        self._given: dict[str, FlatEquation] = {}  # a part's equation, by the name alone on its left
        self._told: set[str] = set()  # parts whose clocked flow was told of

    def visit(self, name: str, equation: FlatEquation) -> None:
        """Join what stands in an equation, which goes by this name."""
        if isinstance(equation.left, Name) and equation.origin != CONNECTION:
            self._given.setdefault(".".join(equation.left.parts), equation)
        for side in (equation.left, equation.right):
            self._visit(side, name, equation)

    def finish(self) -> None:
        """Record what hears the other peers at no clock, once every equation is read."""
        for name, equation in self._hearing.items():
            if self.of(name) == CONTINUOUS:
                what = f"{equation.origin} hears the other peers but has no parameter that names one clock"
                self.mistakes.add("E504", equation.place, what, hint="parameters: {clock: clock}")

    def joined(self, potential: str, flow: str) -> None:
        """Record a flow that a part gives on a clock, beside a potential that it takes as continuous."""
        given, its = self._given.get(flow), self.of(flow)
        beside = self._clock_of_set.get(self._find(potential))
        if given is not None and its != CONTINUOUS and beside == CONTINUOUS:
            self._report_flow(flow, its, given)

    def _find(self, name: str) -> str:
        root = name
        while (parent := self._parents.get(root, root)) != root:
            root = parent
        while (parent := self._parents.get(name, name)) != root:
            self._parents[name] = root
            name = parent
        return root

    def of(self, name: str) -> str:
        """Return the clock of a variable or equation; continuous where nothing asks for a clock."""
        return self._clock_of_set.get(self._find(name), CONTINUOUS)

    def _join(self, one: str, two: str, equation: FlatEquation) -> None:
        a, b = self._find(one), self._find(two)
        if a == b:
            return
        clock_a, clock_b = self._clock_of_set.get(a), self._clock_of_set.get(b)
        if clock_a is not None and clock_b is not None and clock_a != clock_b:
            self._report(two, clock_b, clock_a, equation)
            return
        self._parents[b] = a
        if clock_b is not None:
            self._clock_of_set[a] = clock_b

    def _pin(self, name: str, clock: str, because: str, equation: FlatEquation) -> None:
        root = self._find(name)
        known = self._clock_of_set.setdefault(root, clock)
        if known != clock:
            self._report(because, clock, known, equation)

    def _report(self, name: str, its: str, others: str, equation: FlatEquation) -> None:
        given = self._given.get(name)
        if equation.origin == CONNECTION and others == CONTINUOUS and given is not None:
            self._report_flow(name, its, given)
            return
        if its == CONTINUOUS:
            hint = f"sample({name})"
        elif others == CONTINUOUS:
            hint = f"hold({name})"
        else:
            hint = f"one clock for both, or sample(hold({name}))"
        self.mistakes.add(
            "E505",
            equation.place,
            f"in `{equation.text}` of {equation.origin}, "
            f"{name} is {domain(its)} and the rest is {domain(others)}",
            hint=hint,
        )

    def _report_flow(self, name: str, its: str, given: FlatEquation) -> None:
        """Report a part's clocked flow where the part gives it: one of them holds what the others follow."""
        if given.origin in self._told:
            return
        self._told.add(given.origin)

        def own(node: Expr) -> Expr | None:
            """Write a name as the part does, and a sample at its one clock without that."""
            if isinstance(node, Name):
                heard = node.parts[:1] == (OTHERS,)  # others.part.x
                whole = ".".join(node.parts[heard:]).removeprefix(f"{given.origin}.")
                return Name((*node.parts[:heard], *whole.split(".")))
            if isinstance(node, Call) and node.function == "sample" and node.arguments[1:] == (at,):
                return Call("sample", (transform(node.arguments[0], own),))
            return None

        at = Name((given.clock or "",))
        left, right = (format_expression(transform(side, own)) for side in (given.left, given.right))
        what = f"{name} acts on what it is joined to at all times, and is {domain(its)}"
        self.mistakes.add("E505", given.place, what, hint=f"{left} = hold({right})")

    def _visit(self, expression: Expr, domain: str, equation: FlatEquation, *, heard: bool = False) -> None:
        """Join what ticks together; `heard` is inside a reduction, where alone `others` can be named."""
        if isinstance(expression, Name):
            name = ".".join(expression.parts)
            if name in self.variables:
                self._join(domain, name, equation)
            elif expression.parts[0] == OTHERS and not heard:
                self._report_each(f"others.{expression.parts[-1]}", equation)
        elif isinstance(expression, Call):
            self._visit_call(expression, domain, equation, heard)
        else:
            for child in children(expression):
                self._visit(child, domain, equation, heard=heard)

    def _report_each(self, shown: str, equation: FlatEquation) -> None:
        """Report what is of each other peer outside of a reduction."""
        what = f"{shown} of {equation.origin} is a value of each other peer, and one is due here"
        self.mistakes.add("E506", equation.place, what, hint=f"mean({shown}), or sum, max, min")

    def _visit_call(self, call: Call, domain: str, equation: FlatEquation, heard: bool) -> None:
        text = format_expression(call)
        if of_others(call):
            if not heard:
                (name,) = names(call)
                self._report_each(f"{call.function}(others.{name.parts[-1]})", equation)
            return
        if call.function == "sample":
            assert isinstance(call.arguments[1], Name)
            self._pin(domain, call.arguments[1].parts[0], text, equation)
            inner = f"inside {text} of {equation.origin}"
            self._pin(inner, CONTINUOUS, text, equation)
            self._visit(call.arguments[0], inner, equation)
        elif call.function == "hold":
            self._pin(domain, CONTINUOUS, text, equation)  # its variable was pinned by its own equation
        elif call.function == "der":
            self._pin(domain, CONTINUOUS, text, equation)
            self._visit(call.arguments[0], domain, equation)
        elif hears_others(call):
            for argument in call.arguments:
                self._visit(argument, domain, equation, heard=True)
            if equation.clock is None:
                self._hearing.setdefault(domain, equation)
            else:
                self._pin(domain, equation.clock, text, equation)
        else:
            if call.function == "previous" and equation.clock is not None:
                self._pin(domain, equation.clock, text, equation)
            for argument in call.arguments:
                self._visit(argument, domain, equation, heard=heard)


def domain(clock: str) -> str:
    """Return what belongs to a clock, in words."""
    return "continuous" if clock == CONTINUOUS else f"on clock {clock}"
