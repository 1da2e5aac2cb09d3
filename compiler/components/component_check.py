"""Whether a component is sound: names, units, reductions and balance, checked once, before any use of it.

Takes: a component as it was read. Gives: `ComponentNames`, which infers undeclared dimensions and checks the
equations; `check_balance`.
Guarantees: every name in an equation is declared and every equation's units agree; a mistake is said once.
Does not: read text (see `definitions`).

A component is locally balanced in Modelica's sense (Modelica Language Specification 3.6, section 4.8): it
gives one equation for each of its variables and one for each flow of its connectors; the connections of a
topology give the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import count
from typing import TypeVar

from apc.compiler.components.component import OTHERS, Component, Linearized, Option, SentValue, option_test
from apc.compiler.errors import Mistakes, SourceLocation, location_in
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import (
    Call,
    Equation,
    Expr,
    Name,
    format_expression,
    interval_of,
    names,
    transform,
    walk,
)
from apc.compiler.language.expression import NumberLiteral as Literal
from apc.compiler.language.unit_check import ANY, check_equation, dimension_of
from apc.compiler.language.values import PEERS
from apc.compiler.language.vectors import (
    entries,
    entry,
    sizes_of,
    whole_and_index,
    written_equation,
    written_out,
)
from apc.compiler.source.reading import brief, fault, unknown
from apc.compiler.wording import counted

TRUE = Call("==", (Literal(Fraction(1)), Literal(Fraction(1))))

Path = tuple[str, ...]  # a name in an equation, between its dots
Where = Equation | SentValue  # the context of an expression
Written = tuple[Expr, Where]
T = TypeVar("T")


class ComponentNames:
    """Resolves a component's names to dimensions, and determines its local names.

    `dimensions` are those of all names, one for a vector and its entries; `sizes` those of the vectors among
    them and of what is being inferred; None is one that isn't known. `variables` are the names whose values
    are computed, a vector's entry by entry.
    """

    def __init__(self, component: Component, undefined: Collection[str] = ()) -> None:
        """Take a component, and the names given by equations that couldn't be read: of no known dimension."""
        self.component = component
        self.options = {p.name: p for p in component.parameters if isinstance(p, Option)}
        self.tables = {p.name for p in component.parameters if getattr(p, "role", "") == "table"}
        computed: dict[Path, Dimension | None] = {(name,): None for name in undefined}
        computed |= dict(_visible_names(component))
        computed |= {(name, flow.name): flow.unit.dimension for name, flow in component.flows}
        self.variables = frozenset(computed)
        known: dict[Path, Dimension | None] = {
            (word,): p.unit.dimension for p in component.numbers for word, _ in p.words
        }
        # `others` alone means count(others).
        known |= computed | {PEERS: DIMENSIONLESS, ("time",): SECOND, (OTHERS,): DIMENSIONLESS}
        for parameter in component.parameters:
            if not isinstance(parameter, Option) and parameter.unit is not None:  # a number or a table
                known[(parameter.name,)] = parameter.unit.dimension
            elif getattr(parameter, "role", "") == "clock":
                known[(interval_of(parameter.name),)] = SECOND
        known |= {(OTHERS, send.name): send.dimension for send in component.sends}
        self.dimensions = {_vector_of(path): dimension for path, dimension in known.items()}
        self.sizes: dict[Path, int | None] = {**sizes_of(known)}

    def size_of(self, parts: Path) -> int | None:
        """Return the size of a name: 0 for a scalar, None if to be inferred."""
        return self.sizes.get(parts, 0)

    def completed(self, sends: Collection[SentValue], mistakes: Mistakes) -> Component:
        """Return the component with its local names and sends, checked, its vectors expanded by entry.

        The dimensions of `sends` are found here.
        """
        locals_, sent, equations = self._infer_locals(sends), list[SentValue](), list[Equation]()
        for send in sends:
            with mistakes:
                written = written_out(send.expression, self.size_of, send.text, send.location)
                dimension = _known(self._dimension(send.expression, send))
                each = written or (send.expression,)
                named = entries(send.name, len(each) if len(each) > 1 else 0)
                pairs = zip(named, each, strict=True)
                sent += [replace(send, name=n, expression=item, dimension=dimension) for n, item in pairs]
        component, linearized = self.component, self.component.linearized
        if not mistakes:
            for send in sends:
                with mistakes:
                    self._check_sent(send)
            for equation in component.equations:
                with mistakes:
                    equations += self._checked(equation, mistakes)
            if linearized is not None:
                linearized = self._checked_linearized(linearized, equations, mistakes)
        return replace(
            component,
            locals=(*component.locals, *locals_),
            sends=(*component.sends, *sent),
            equations=tuple(equations),
            linearized=linearized,
        )

    def _checked_linearized(
        self, linearized: Linearized, equations: Collection[Equation], mistakes: Mistakes
    ) -> Linearized:
        """Return the equations of a linear analysis, each checked to replace one of the component."""
        replaced: list[Equation] = []
        lefts = {format_expression(equation.left) for equation in equations}
        for equation in linearized.equations:
            with mistakes:
                for written in self._checked(equation, mistakes):
                    left = format_expression(written.left)
                    if left in [format_expression(other.left) for other in replaced]:
                        raise fault("E514", equation.location, f"linearized: {left} is replaced twice")
                    if left not in lefts:
                        message = f"linearized: no equation of {self.component.name} has {left} on its left"
                        raise unknown("E514", equation.location, message, left, sorted(lefts))
                    replaced.append(written)
        return replace(linearized, equations=tuple(replaced))

    def _infer_locals(self, sends: Collection[SentValue]) -> list[tuple[str, Dimension]]:
        """Return the undeclared names that are the left side of an equation, a vector's entry by entry.

        The dimension of one may depend on another, on itself, or on sent values. An unknown name on the right
        is reported once, by `_checked`.
        """
        undeclared = {
            equation.left.parts: (equation.right, equation)
            for equation in reversed(self.component.equations)
            if isinstance(equation.left, Name)
            and ".".join(equation.left.parts).isidentifier()
            and equation.left.parts not in self.dimensions
        }
        waiting: dict[Path, Written] = {(OTHERS, send.name): (send.expression, send) for send in sends}
        waiting |= undeclared
        self.dimensions |= dict.fromkeys(waiting)
        self.sizes |= dict.fromkeys(waiting)
        _infer_all(waiting, self._size, self.sizes)
        # A size that contradicts itself, or depends only on itself, is undefined.
        self.sizes |= {name: self._size(*written) or 0 for name, written in waiting.items()}
        _infer_all(waiting, self._inferred, self.dimensions)
        return [
            (text, _known(self.dimensions[name]))
            for name in reversed(undeclared)
            for text in entries(name[0], self.sizes[name] or 0)
        ]

    def _size(self, expression: Expr, where: Where) -> int | None:
        """Return the size of an expression; 0 of one at fault, which `_checked` reports."""
        with Mistakes():
            result = written_out(expression, self.size_of, where.text, where.location)
            return None if result is None else len(result) if len(result) > 1 else 0
        return 0

    def _inferred(self, expression: Expr, where: Where) -> Dimension | None:
        with Mistakes():
            return self._dimension(expression, where)
        return None

    def _checked(self, equation: Equation, mistakes: Mistakes) -> tuple[Equation, ...]:
        """Return an equation for each entry of it. Raises ApcError for names and sizes; records units."""
        sides, wrong = [self._decided(side) for side in (equation.left, equation.right)], Mistakes()
        for side in sides:
            self._check_names(side, equation, wrong)
            self._check_reductions(side, equation, wrong)
        wrong.raise_if_any()
        with mistakes:
            check_equation(replace(equation, left=sides[0], right=sides[1]), self._lookup)
        return written_equation(equation, self.size_of)

    def _check_reductions(self, expression: Expr, where: Where, mistakes: Mistakes) -> None:
        """Record a reduction not over the other peers, and an age of a value that is not received."""
        for node in (node for node in walk(expression) if isinstance(node, Call)):
            function, others = node.function, [name for name in names(node) if name.parts[0] == OTHERS]
            received = [name for name in others if len(name.parts) > 1]
            message, expected = function, "others.x in it"
            hint = "count(others)" if function == "count" else f"{function}(others.x)"
            if function == "age" and node.arguments[0] not in received:
                sent = next((send.name for send in self.component.sends), "x")
                shown = format_expression(received[0]) if received else f"{OTHERS}.{sent}"
                message, expected = "age is of one value that is heard of the others, and", f"{shown} in it"
                hint = f"age({shown})"
            elif function in ("mean", "sum", "count") and not others:
                message = f"{function} runs over the other peers and"
            elif function in ("max", "min") and len(node.arguments) == 1 and not others:
                expected = "two values, or one of the other peers"
            else:
                continue
            got = format_expression(node)
            mistakes.add("E506", _location(where, node), message, expected=expected, got=got, hint=hint)

    def _check_sent(self, send: SentValue) -> None:
        """Refuse sending a received value: it is available at ticks of the clock, not of the link."""
        for received in names(send.expression):
            if received.parts[0] == OTHERS:
                name = next(text for n in count(1) if (text := f"sent{n}",) not in self.dimensions)
                message = (
                    f"{send.name} is sent at ticks of the link, and {format_expression(received)} is heard at"
                )
                sample = f"{{{send.name}: sample(hold({name}))}}"
                hint = f"{name} = {send.text} among the equations, and sends: {sample}"
                raise fault("E505", _location(send, received), f"{message} those of the clock", hint=hint)

    def _decided(self, expression: Expr) -> Expr:
        """Return the expression without items that have no dimension: words of options, and sampling clocks.

        Each test of an option becomes a true statement: both branches are checked.
        """

        def decided(node: Expr) -> Expr | None:
            match node:
                case Call("sample", (sampled, _)):
                    return replace(node, arguments=(transform(sampled, decided),))
            return TRUE if option_test(node, self.options) else None

        return transform(expression, decided)

    def dimension_of_held(self, expression: Expr, text: str, location: SourceLocation) -> Dimension | None:
        """Return the dimension of a checked expression, or None if it is a variable, which has its own."""
        if isinstance(expression, Name) and expression.parts in self.variables:
            return None
        return _known(dimension_of(self._decided(expression), self._lookup, text, location))

    def _dimension(self, expression: Expr, where: Where) -> Dimension | None:
        """Return the dimension of an expression. Raises ApcError for its names and units."""
        expression, wrong = self._decided(expression), Mistakes()
        self._check_names(expression, where, wrong)
        wrong.raise_if_any()
        return dimension_of(expression, self._lookup, where.text, where.location)

    def _lookup(self, name: Name) -> Dimension | None:
        return self.dimensions.get(_vector_of(name.parts))

    def _check_names(self, expression: Expr, where: Where, mistakes: Mistakes) -> None:
        """Record names that the component does not have, and words and tables instead of numbers."""
        decided = set[int]()
        for node in walk(expression):
            match node:
                case Call("==" | "!=", (Name((name,)) as left, Name() as right)) if name in self.options:
                    # Else it was decided.
                    decided |= {left.start, right.start}
                    word, words = format_expression(right), self.options[name].words
                    message, at = f"{name} has no option {brief(word)}", _location(where, right)
                    mistakes.take(unknown("E206", at, message, word, words))
                case Call("interpolate", (Name((name,)) as table, _)) if name in self.tables:
                    decided.add(table.start)
                case Call("interpolate", (other, _)):
                    decided.add(other.start)
                    got, known = format_expression(other), ", ".join(sorted(self.tables)) or "none"
                    message, expected = (
                        "interpolate",
                        f"the name of a table ({known} in {self.component.name})",
                    )
                    mistakes.add("E325", _location(where, other), message, expected=expected, got=got)
                case Call("count" | "age", (Name((name,)) as every,)) if name == OTHERS:
                    decided.add(every.start)
                case Name((name,)) if name == OTHERS and node.start not in decided:
                    received = (".".join(path) for path in self.dimensions if path[:-1] == (OTHERS,))
                    message, sent = "a value of the other peers", next(received, f"count({OTHERS})")
                    mistakes.add("E506", _location(where, node), message, expected=sent, got=name, hint=sent)
                case Name((name,)) if name in self.tables and node.start not in decided:
                    hint = f"interpolate({name}, time)"
                    mistakes.add(
                        "E303", _location(where, node), f"{name} is a table and no number", hint=hint
                    )
                case Name(parts) if node.start not in decided:
                    self._check_name(parts, _location(where, node), mistakes)

    def _check_name(self, parts: Path, location: SourceLocation, mistakes: Mistakes) -> None:
        """Record a name there isn't, or an entry that a vector hasn't got."""
        whole, index = _vector_of(parts), whole_and_index(parts[-1])[1]
        shown, size = ".".join(whole), self.size_of(whole) or 0
        if whole in self.dimensions and index <= size:
            return
        if parts[0] == OTHERS:
            message = f"{self.component.name} sends nothing called {brief('.'.join(parts[1:]))}"
            mistakes.add("E303", location, message, hint="sends: {x: sample(object.x)}")
        elif whole in self.dimensions:
            expected, got, hint = "a vector before the index", f"{shown}, which is a number", shown
            if size:
                expected, got, hint = f"an index from 1 to {size}", f"{index}", entry(shown, size)
            mistakes.add("E408", location, entry(shown, index), expected=expected, got=got, hint=hint)
        else:
            message, known = f"{self.component.name} has no {brief(shown)}", map(".".join, self.dimensions)
            mistakes.take(unknown("E303", location, message, shown, sorted(known)))


def _vector_of(path: Path) -> Path:
    """Return the vector that an entry is of; of a number its own path."""
    return (*path[:-1], whole_and_index(path[-1])[0])


def _location(where: Where, node: Expr) -> SourceLocation:
    return location_in(where.location, where.text, node.start)


def _infer_all(
    unresolved: Mapping[Path, Written],
    infer: Callable[[Expr, Where], T | None],
    known: dict[Path, T | None],
) -> None:
    """Add the inferred values of all names to `known`.

    A value may depend on the values of other names: rounds are repeated until none adds a value.

    Parameters
    ----------
    unresolved
        The expression of each name, and its location.
    infer
        Returns the value of an expression, or None while a name in it has no value.
    known
        The values by name, None where missing; changed here.
    """
    while True:
        result = {name: infer(*written) for name, written in unresolved.items() if known[name] is None}
        known |= result
        if all(value is None for value in result.values()):
            return


def _visible_names(component: Component) -> Iterator[tuple[Path, Dimension]]:
    """Yield the names of a component visible from outside: variables and potentials of connectors."""
    yield from (((variable.name,), variable.unit.dimension) for variable in component.variables)
    yield from (((name,), dimension) for name, dimension in component.locals)
    for name, connector in component.connectors:
        yield from (((name, potential.name), potential.unit.dimension) for potential in connector.potentials)
    for inner in component.inner:
        yield from (
            ((inner.name, *path), inner_dimension)
            for path, inner_dimension in _visible_names(inner.component)
        )


def _known(dimension: Dimension | None) -> Dimension:
    """Return an inferred dimension; an expression that fits every dimension, such as 0, is dimensionless."""
    return DIMENSIONLESS if dimension in (None, ANY) else dimension


def check_balance(component: Component) -> None:
    """Refuse (E501) a component with more or fewer equations than it must have."""
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals]
    unknowns += [f"{name}.{flow.name}" for name, flow in component.flows]
    if len(component.equations) != len(unknowns):
        numbers = f"{counted(len(component.equations), 'equation')} for {counted(len(unknowns), 'unknown')}"
        message = f"{component.name} is unbalanced: {numbers} ({', '.join(unknowns) or 'none'})"
        hint = "one equation for each variable and one for each flow of a connector"
        raise fault("E501", component.location, message, hint=hint)
