"""Whether a component is sound: names, units, reductions and balance, checked once, before any use of it.

Takes: a component as it was read. Gives: `ComponentNames`, which infers what is not declared and checks the
equations; `check_balance`.
Guarantees: every name in an equation is declared and every equation's units agree; a mistake is said once.
Does not: read text (see `definitions`).

A component is locally balanced in Modelica's sense (Modelica Language Specification 3.6, section 4.8): it
gives one equation for each of its variables and one for each flow of its connectors; the connections of a
scene give the rest.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import count

from apc.compiler.components.component import (
    OTHERS,
    Component,
    Option,
    Reference,
    Send,
    option_test,
)
from apc.compiler.components.declarations import Sends
from apc.compiler.errors import ApcError, Mistakes, Place, place_in
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import (
    Call,
    Compare,
    Equation,
    Expr,
    Name,
    format_expression,
    interval_of,
    names,
    transform,
    walk,
)
from apc.compiler.language.expression import Number as Literal
from apc.compiler.language.unit_check import ANY, check_equation, dimension_of
from apc.compiler.language.values import PEERS
from apc.compiler.language.vectors import (
    VECTOR_WORDS,
    entries,
    entry,
    sizes_of,
    whole_and_index,
    written_equation,
    written_out,
)
from apc.compiler.source.reading import (
    add_unknown,
    brief,
)
from apc.compiler.words import counted

_TRUE = Compare("==", Literal(Fraction(1)), Literal(Fraction(1)))


class ComponentNames:
    """Resolves a component's names to dimensions, and finds the locals on the way."""

    def __init__(self, component: Component, undefined: Collection[str] = ()) -> None:
        """Take a component, and the names given by equations that couldn't be read: of no known dimension."""
        self.component = component
        self.dimensions: dict[tuple[str, ...], Dimension | None] = {(name,): None for name in undefined}
        self.dimensions |= dict(_visible_names(component))
        passed = {connector for connector, _, _ in component.passed}
        for name, connector in component.connectors:
            if name not in passed:
                for flow in connector.flows:
                    self.dimensions[(name, flow.name)] = flow.unit.dimension
        self.variables = frozenset(self.dimensions)
        self.dimensions |= {PEERS: DIMENSIONLESS, ("time",): SECOND}
        for parameter in component.numbers:
            self.dimensions[(parameter.name,)] = parameter.unit.dimension
            for word, _ in parameter.words:
                self.dimensions.setdefault((word,), parameter.unit.dimension)
        for clock in component.parameters:
            if isinstance(clock, Reference) and clock.role == "clock":
                self.dimensions[(interval_of(clock.name),)] = SECOND
        self.dimensions[(OTHERS,)] = DIMENSIONLESS  # for count(others)
        for send in component.sends:
            self.dimensions[(OTHERS, send.name)] = send.dimension
        # The vectors of these names, and the entries of those found later; None while a size isn't known.
        self.sizes: dict[tuple[str, ...], int | None] = {}
        for vector, size in sizes_of(self.dimensions).items():
            self._add_vector(vector, size, self.dimensions[(*vector[:-1], entry(vector[-1], 1))])
        for table in component.parameters:
            if isinstance(table, Reference) and table.role == "table" and table.unit is not None:
                self.dimensions[(table.name,)] = table.unit.dimension

    def _add_vector(self, parts: tuple[str, ...], size: int, dimension: Dimension | None) -> None:
        """Know a vector, and each of its entries."""
        self.sizes[parts] = size
        self.dimensions |= {(*parts[:-1], one): dimension for one in entries(parts[-1], size)}
        self.dimensions[parts] = dimension

    def _is_of_numbers(self, text: str) -> bool:
        """Return whether a text can hold no vector: it is written out as it is."""
        return not any(self.sizes.values()) and not any(word in text for word in VECTOR_WORDS)

    def size_of(self, parts: tuple[str, ...]) -> int | None:
        """Return the size of a name: 0 for a number, None for what is to be inferred."""
        return self.sizes.get(parts, 0)

    def infer_sends(self, sends: Sends, mistakes: Mistakes) -> tuple[Send, ...]:
        """Return the sends with the dimension of what they send."""
        return tuple(
            Send(name, expression, text, place, _known(self._dimension(expression, text, place, mistakes)))
            for name, expression, text, place in sends
            if self._is_of_numbers(text) or self._is_sized(expression, text, place, mistakes)
        )

    def _is_sized(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> bool:
        """Record sizes that do not fit."""
        try:
            written_out(expression, self.size_of, text, place)
        except ApcError as error:
            mistakes.take(error)
            return False
        return True

    def infer_locals(self, sends: Sends) -> tuple[tuple[str, Dimension], ...]:
        """Return the undeclared names that stand alone on the left of an equation.

        What one is may hang on another, on itself, or on what is sent: each round settles some.
        """
        equations = {
            equation.left.parts: equation
            for equation in reversed(self.component.equations)
            if isinstance(equation.left, Name)
            and len(equation.left.parts) == 1
            and not equation.left.parts[0].endswith("]")
            and equation.left.parts not in self.dimensions
        }
        # An unknown name on the right is reported once, by `check`.
        open_: dict[tuple[str, ...], tuple[Expr, str, Place]] = {
            name: (equation.right, equation.text, equation.place) for name, equation in equations.items()
        }
        open_ = {(OTHERS, name): (expression, text, place) for name, expression, text, place in sends} | open_
        self.dimensions |= dict.fromkeys(open_)
        self._infer_sizes(open_)
        settled = list(open_)
        while settled:
            found = {name: self._dimension(*one, Mistakes()) for name, one in open_.items()}
            settled = [name for name, dimension in found.items() if dimension is not None]
            for name in settled:
                self._add_vector(name, self.sizes[name] or 0, found[name])
            open_ = {name: one for name, one in open_.items() if name not in settled}
        for name in open_:
            self._add_vector(name, self.sizes[name] or 0, None)
        return tuple((name[0], _known(self.dimensions[name])) for name in reversed(equations))

    def _infer_sizes(self, undeclared: Mapping[tuple[str, ...], tuple[Expr, str, Place]]) -> None:
        """Find the sizes of names that are not declared; what hangs on itself alone is a number."""

        def size(expression: Expr, text: str, place: Place) -> int | None:
            try:
                found = written_out(expression, self.size_of, text, place)
            except ApcError:
                return 0  # told of by `check`
            return len(found) if isinstance(found, tuple) else None if found is None else 0

        self.sizes |= dict.fromkeys(undeclared)
        settled: dict[tuple[str, ...], int | None] = {}
        for _ in range(
            len(undeclared) + 1
        ):  # each round settles some; a size that contradicts itself never is
            if settled == (settled := {name: size(*one) for name, one in undeclared.items()}):
                break
            self.sizes |= settled
        self.sizes |= {name: found or 0 for name, found in settled.items()}

    def check(self, component: Component, mistakes: Mistakes) -> Component:
        """Check names, then units and sizes, of every equation, and that what is sent is no reduction.

        Return the component without vectors, everything in terms of their entries.
        """
        for send in component.sends:
            self._check_sent(send, mistakes)
        written: list[Equation] = []
        for equation in component.equations:
            unknown = False
            left, right = self._decided(equation.left), self._decided(equation.right)
            for side in (left, right):
                unknown |= self._check_names(side, equation.text, equation.place, mistakes)
                unknown |= self._check_reductions(side, equation.text, equation.place, mistakes)
            if not unknown:
                try:
                    check_equation(
                        Equation(left, right, equation.text, equation.place),
                        lambda name: self.dimensions.get(name.parts),
                    )
                except ApcError as error:
                    mistakes.take(error)
                if self._is_of_numbers(equation.text):
                    written.append(equation)
                    continue
                try:
                    written += written_equation(equation, self.size_of)
                except ApcError as error:
                    mistakes.take(error)
        locals_ = (
            (one, dimension)
            for name, dimension in component.locals
            for one in entries(name, self.size_of((name,)) or 0)
        )
        sends = (one for send in component.sends for one in self._sent_entries(send))
        return replace(component, locals=tuple(locals_), sends=tuple(sends), equations=tuple(written))

    def _sent_entries(self, send: Send) -> Iterator[Send]:
        """Yield what is sent of each entry of a vector."""
        if self._is_of_numbers(send.text):
            yield send
            return
        found = written_out(send.expression, self.size_of, send.text, send.place)
        each = found if isinstance(found, tuple) else (found or send.expression,)
        for name, one in zip(entries(send.name, len(each) if each is found else 0), each, strict=True):
            yield replace(send, name=name, expression=one)

    def _check_reductions(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> bool:
        """Record a reduction that doesn't run over the other peers."""
        wrong = False
        for node in walk(expression):
            if isinstance(node, Call) and node.function == "age":
                wrong |= self._is_age_of_nothing(node, text, place, mistakes)
                continue
            if not isinstance(node, Call) or any(name.parts[0] == OTHERS for name in names(node)):
                continue
            if node.function in ("mean", "sum", "count"):
                what, expected = f"{node.function} runs over the other peers and", "others.x in it"
            elif node.function in ("max", "min") and len(node.arguments) == 1:
                what, expected = node.function, "two values, or one of the other peers"
            else:
                continue
            wrong = True
            hint = "count(others)" if node.function == "count" else f"{node.function}(others.x)"
            where, got = place_in(place, text, node.start), format_expression(node)
            mistakes.add("E506", where, what, expected=expected, got=got, hint=hint)
        return wrong

    def _is_age_of_nothing(self, call: Call, text: str, place: Place, mistakes: Mistakes) -> bool:
        """Record an age of what is not heard of the others."""
        (argument,) = call.arguments
        if isinstance(argument, Name) and argument.parts[0] == OTHERS and len(argument.parts) > 1:
            return False
        named = next((n for n in names(argument) if n.parts[0] == OTHERS and len(n.parts) > 1), None)
        sent = [*(send.name for send in self.component.sends)] or ["x"]
        shown = format_expression(named) if named is not None else f"others.{sent[0]}"
        mistakes.add(
            "E506",
            place_in(place, text, call.start),
            "age is of one value that is heard of the others, and",
            expected=f"{shown} in it",
            got=format_expression(call),
            hint=f"age({shown})",
        )
        return True

    def _check_sent(self, send: Send, mistakes: Mistakes) -> None:
        """Record a send of what is heard: that is known at ticks of the clock, not of the link."""
        heard = next((n for n in walk(send.expression) if isinstance(n, Name) and n.parts[0] == OTHERS), None)
        if heard is None:
            return
        name = next(one for n in count(1) if (one := f"sent{n}",) not in self.dimensions)
        shown = format_expression(heard)
        what = f"{send.name} is sent at ticks of the link, and {shown} is heard at those of the clock"
        hint = f"{name} = {send.text} among the equations, and sends: {{{send.name}: sample(hold({name}))}}"
        mistakes.add("E505", place_in(send.place, send.text, heard.start), what, hint=hint)

    def _decided(self, expression: Expr) -> Expr:
        """Return the expression without what has no dimension: words of options, and clocks to sample at.

        Each test of an option becomes a true statement: both branches are checked.
        """
        options = {p.name: p for p in self.component.parameters if isinstance(p, Option)}

        def decided(node: Expr) -> Expr | None:
            if isinstance(node, Call) and node.function == "sample" and len(node.arguments) == 2:
                return replace(node, arguments=(transform(node.arguments[0], decided),))
            return _TRUE if option_test(node, options) else None

        return transform(expression, decided)

    def dimension_of_held(self, expression: Expr, text: str, place: Place) -> Dimension | None:
        """Return the dimension of a checked expression, or None if it is a variable, which has its own."""
        if isinstance(expression, Name) and expression.parts in self.variables:
            return None
        return _known(self._dimension(expression, text, place, Mistakes()))

    def _dimension(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> Dimension | None:
        expression = self._decided(expression)
        if self._check_names(expression, text, place, mistakes):
            return None
        try:
            return dimension_of(expression, lambda name: self.dimensions.get(name.parts), text, place)
        except ApcError as error:
            mistakes.take(error)
            return None

    def _check_names(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> bool:
        options = {p.name: p for p in self.component.parameters if isinstance(p, Option)}
        wrong, told = False, set[int]()
        for node in walk(expression):
            if isinstance(node, Compare) and isinstance(node.left, Name) and isinstance(node.right, Name):
                option, word = options.get(".".join(node.left.parts)), ".".join(node.right.parts)
                if option is not None and node.operator in ("==", "!="):  # else it was decided
                    wrong = True
                    told |= {node.left.start, node.right.start}
                    what = f"{option.name} has no option {brief(word)}"
                    at = place_in(place, text, node.right.start)
                    add_unknown("E206", at, what, word, option.words, mistakes)
            if isinstance(node, Name) and node.parts not in self.dimensions and node.start not in told:
                wrong = True
                shown = ".".join(node.parts)
                if node.parts[0] == OTHERS:
                    what = f"{self.component.name} sends nothing called {brief('.'.join(node.parts[1:]))}"
                    mistakes.add(
                        "E303", place_in(place, text, node.start), what, hint="sends: {x: sample(object.x)}"
                    )
                    continue
                if self._is_bad_index(node.parts, place_in(place, text, node.start), mistakes):
                    continue
                known = sorted(
                    ".".join(parts) for parts in self.dimensions if not whole_and_index(parts[-1])[1]
                )
                whole, _ = whole_and_index(shown)
                what = f"{self.component.name} has no {brief(whole)}"
                add_unknown("E303", place_in(place, text, node.start), what, whole, known, mistakes)
        return wrong

    def _is_bad_index(self, parts: tuple[str, ...], place: Place, mistakes: Mistakes) -> bool:
        """Record an entry that a vector hasn't got, or an index behind a number."""
        name, index = whole_and_index(parts[-1])
        whole = (*parts[:-1], name)
        if not index or whole not in self.dimensions:
            return False
        shown, size = ".".join(whole), self.size_of(whole) or 0
        if size:
            expected, got, hint = f"an index from 1 to {size}", f"{index}", entry(shown, size)
        else:
            expected, got, hint = "a vector before the index", f"{shown}, which is a number", shown
        mistakes.add("E408", place, entry(shown, index), expected=expected, got=got, hint=hint)
        return True


def _visible_names(component: Component) -> Iterator[tuple[tuple[str, ...], Dimension]]:
    """Yield what may be named of a component from outside: its variables and its connectors' potentials."""
    for variable in component.variables:
        yield (variable.name,), variable.unit.dimension
    for name, dimension in component.locals:
        yield (name,), dimension
    for name, connector in component.connectors:
        for potential in connector.potentials:
            yield (name, potential.name), potential.unit.dimension
    for inner in component.inner:
        for path, dimension in _visible_names(inner.component):
            yield (inner.name, *path), dimension


def _known(dimension: Dimension | None) -> Dimension:
    """Return a dimension that was inferred; what fits every dimension, such as 0, has none."""
    return DIMENSIONLESS if dimension in (None, ANY) else dimension


def check_balance(component: Component, mistakes: Mistakes) -> None:
    """Record E501 for a component with more or fewer equations than it must have."""
    passed = {connector for connector, _, _ in component.passed}
    flows = [
        f"{name}.{flow.name}"
        for name, connector in component.connectors
        if name not in passed
        for flow in connector.flows
    ]
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals] + flows
    if len(component.equations) == len(unknowns):
        return
    mistakes.add(
        "E501",
        component.place,
        f"{component.name} is unbalanced: {counted(len(component.equations), 'equation')} for "
        f"{counted(len(unknowns), 'unknown')} ({', '.join(unknowns) or 'none'})",
        hint="one equation for each variable and one for each flow of a connector",
    )
