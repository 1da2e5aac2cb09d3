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

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import count
from typing import TypeVar

from apc.compiler.components.component import OTHERS, Component, Named, Option, Reference, Send, option_test
from apc.compiler.components.declarations import Written
from apc.compiler.errors import ApcError, Mistakes, Place, place_in
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import (
    FUNCTIONS,
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
from apc.compiler.language.expression import Number as Literal
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
from apc.compiler.words import counted

_TRUE = Call("==", (Literal(Fraction(1)), Literal(Fraction(1))))

Path = tuple[str, ...]  # a name in an equation, between its dots
T = TypeVar("T")


class ComponentNames:
    """Resolves a component's names to dimensions, and finds the locals on the way."""

    def __init__(self, component: Component, undefined: Collection[str] = ()) -> None:
        """Take a component, and the names given by equations that couldn't be read: of no known dimension."""
        self.component = component
        self.options = {p.name: p for p in component.parameters if isinstance(p, Option)}
        self.dimensions: dict[Path, Dimension | None] = {(name,): None for name in undefined}
        self.dimensions |= dict(_visible_names(component))
        self.dimensions |= {(name, flow.name): flow.unit.dimension for name, flow in component.flows}
        self.variables = frozenset(self.dimensions)
        # `others` alone stands for count(others).
        self.dimensions |= {PEERS: DIMENSIONLESS, ("time",): SECOND, (OTHERS,): DIMENSIONLESS}
        words = {(word,): p.unit.dimension for p in component.numbers for word, _ in p.words}
        self.dimensions = words | self.dimensions | {(p.name,): p.unit.dimension for p in component.numbers}
        self.dimensions |= {(OTHERS, send.name): send.dimension for send in component.sends}
        # The vectors of these names, and of those found later; None while a size isn't known.
        self.sizes: dict[Path, int | None] = {}
        for vector, size in sizes_of(self.dimensions).items():
            self._add(vector, size, self.dimensions[(*vector[:-1], entry(vector[-1], 1))])
        for parameter in component.parameters:
            if isinstance(parameter, Reference) and parameter.role == "clock":
                self.dimensions[(interval_of(parameter.name),)] = SECOND
            elif isinstance(parameter, Reference) and parameter.unit is not None:
                self.dimensions[(parameter.name,)] = parameter.unit.dimension

    def _add(self, parts: Path, size: int, dimension: Dimension | None) -> None:
        """Know a number or a vector, and each of its entries."""
        self.sizes[parts] = size
        self.dimensions |= dict.fromkeys([(*parts[:-1], one) for one in entries(parts[-1], size)], dimension)
        self.dimensions[parts] = dimension

    def size_of(self, parts: Path) -> int | None:
        """Return the size of a name: 0 for a number, None for what is to be inferred."""
        return self.sizes.get(parts, 0)

    def completed(self, sends: Mapping[str, Written], mistakes: Mistakes) -> Component:
        """Return the component with its locals and what it sends, checked, its vectors entry by entry."""
        locals_, found = self._infer_locals(sends), []
        for name, (expression, text, place) in sends.items():
            with mistakes:
                written_out(expression, self.size_of, text, place)  # or its sizes do not fit
                dimension = _known(self._dimension(expression, text, place))
                found.append(Send(name, expression, text, place, dimension))
        own = self.component
        component = replace(own, locals=(*own.locals, *locals_), sends=(*own.sends, *found))
        return component if mistakes else self._checked(component, mistakes)

    def _infer_locals(self, sends: Mapping[str, Written]) -> Named[Dimension]:
        """Return the undeclared names that stand alone on the left of an equation.

        What one is may hang on another, on itself, or on what is sent: each round settles some. An unknown
        name on the right is reported once, by `_checked`.
        """
        undeclared: dict[Path, Written] = {
            equation.left.parts: (equation.right, equation.text, equation.place)
            for equation in reversed(self.component.equations)
            if isinstance(equation.left, Name)
            and len(equation.left.parts) == 1
            and not equation.left.parts[0].endswith("]")
            and equation.left.parts not in self.dimensions
        }
        open_: dict[Path, Written] = {(OTHERS, name): written for name, written in sends.items()}
        open_ |= undeclared
        self.dimensions |= dict.fromkeys(open_)
        self.sizes |= dict.fromkeys(open_)
        _settle(open_, self._size, self.sizes.__setitem__)
        # A size that contradicts itself is none.
        self.sizes |= {name: self._size(*written) for name, written in open_.items()}

        def add(name: Path, dimension: Dimension | None) -> None:
            self._add(name, self.sizes[name] or 0, dimension)

        for name in _settle(open_, self._inferred, add):
            add(name, None)
        return tuple((name[0], _known(self.dimensions[name])) for name in reversed(undeclared))

    def _size(self, expression: Expr, text: str, place: Place) -> int | None:
        """Return the size of an expression; 0 of one at fault, which `_checked` reports."""
        with Mistakes():
            found = written_out(expression, self.size_of, text, place)
            return None if found is None else len(found) if len(found) > 1 else 0
        return 0

    def _inferred(self, expression: Expr, text: str, place: Place) -> Dimension | None:
        with Mistakes():
            return self._dimension(expression, text, place)
        return None

    def _checked(self, component: Component, mistakes: Mistakes) -> Component:
        """Check names, then units and sizes, of every equation, and that what is sent is no reduction.

        Return the component without vectors, everything in terms of their entries.
        """
        sends, written = [], list[Equation]()
        for send in component.sends:
            with mistakes:
                self._check_sent(send)
                found = written_out(send.expression, self.size_of, send.text, send.place)
                each = found or (send.expression,)
                named = entries(send.name, len(each) if len(each) > 1 else 0)
                sends += [replace(send, name=n, expression=one) for n, one in zip(named, each, strict=True)]
        for equation in component.equations:
            with mistakes:
                left, right = self._decided(equation.left), self._decided(equation.right)
                wrong = Mistakes()
                for side in (left, right):
                    self._check_names(side, equation.text, equation.place, wrong)
                    self._check_reductions(side, equation.text, equation.place, wrong)
                wrong.raise_if_any()
                with mistakes:
                    check_equation(
                        replace(equation, left=left, right=right),
                        lambda name: self.dimensions.get(name.parts),
                    )
                written += written_equation(equation, self.size_of)
        locals_ = (
            (one, dimension)
            for name, dimension in component.locals
            for one in entries(name, self.size_of((name,)) or 0)
        )
        return replace(component, locals=tuple(locals_), sends=tuple(sends), equations=tuple(written))

    def _check_reductions(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> None:
        """Record a reduction that doesn't run over the other peers, and an age of what is not heard."""
        for node in walk(expression):
            if not isinstance(node, Call) or node.function not in FUNCTIONS:
                continue
            function, others = node.function, [name for name in names(node) if name.parts[0] == OTHERS]
            hint = "count(others)" if function == "count" else f"{function}(others.x)"
            if function == "age":
                heard = [name for name in others if len(name.parts) > 1]
                if heard and heard[0] is node.arguments[0]:
                    continue
                sent = [*(send.name for send in self.component.sends), "x"][0]
                shown = format_expression(heard[0]) if heard else f"{OTHERS}.{sent}"
                what, expected = "age is of one value that is heard of the others, and", f"{shown} in it"
                hint = f"age({shown})"
            elif function in ("mean", "sum", "count") and not others:
                what, expected = f"{function} runs over the other peers and", "others.x in it"
            elif function in ("max", "min") and len(node.arguments) == 1 and not others:
                what, expected = function, "two values, or one of the other peers"
            else:
                continue
            where, got = place_in(place, text, node.start), format_expression(node)
            mistakes.add("E506", where, what, expected=expected, got=got, hint=hint)

    def _check_sent(self, send: Send) -> None:
        """Refuse a send of what is heard: that is known at ticks of the clock, not of the link."""
        heard = next((name for name in names(send.expression) if name.parts[0] == OTHERS), None)
        if heard is None:
            return
        name = next(one for n in count(1) if (one := f"sent{n}",) not in self.dimensions)
        shown = format_expression(heard)
        what = f"{send.name} is sent at ticks of the link, and {shown} is heard at those of the clock"
        hint = f"{name} = {send.text} among the equations, and sends: {{{send.name}: sample(hold({name}))}}"
        raise fault("E505", place_in(send.place, send.text, heard.start), what, hint=hint)

    def _decided(self, expression: Expr) -> Expr:
        """Return the expression without what has no dimension: words of options, and clocks to sample at.

        Each test of an option becomes a true statement: both branches are checked.
        """

        def decided(node: Expr) -> Expr | None:
            if isinstance(node, Call) and node.function == "sample" and len(node.arguments) == 2:
                return replace(node, arguments=(transform(node.arguments[0], decided),))
            return _TRUE if option_test(node, self.options) else None

        return transform(expression, decided)

    def dimension_of_held(self, expression: Expr, text: str, place: Place) -> Dimension | None:
        """Return the dimension of a checked expression, or None if it is a variable, which has its own."""
        if isinstance(expression, Name) and expression.parts in self.variables:
            return None
        return _known(self._dimension(expression, text, place))

    def _dimension(self, expression: Expr, text: str, place: Place) -> Dimension | None:
        """Return the dimension of an expression. Raises ApcError for its names and units."""
        expression, wrong = self._decided(expression), Mistakes()
        self._check_names(expression, text, place, wrong)
        wrong.raise_if_any()
        return dimension_of(expression, lambda name: self.dimensions.get(name.parts), text, place)

    def _check_names(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> None:
        """Record names that nothing of the component has, and words that an option hasn't got."""
        told = set[int]()
        for node in walk(expression):
            match node:
                case Call("==" | "!=", (Name(left), Name(right) as second)):
                    option, word = self.options.get(".".join(left)), ".".join(right)
                    if option is not None:  # else it was decided
                        told |= {part.start for part in node.arguments}
                        what = f"{option.name} has no option {brief(word)}"
                        at = place_in(place, text, second.start)
                        mistakes.take(unknown("E206", at, what, word, option.words))
            if isinstance(node, Name) and node.parts not in self.dimensions and node.start not in told:
                mistakes.take(self._unknown(node.parts, place_in(place, text, node.start)))

    def _unknown(self, parts: Path, place: Place) -> ApcError:
        """Return the mistake of a name there isn't, of an entry that a vector hasn't got among them."""
        name, index = whole_and_index(parts[-1])
        whole = (*parts[:-1], name)
        shown, size = ".".join(whole), self.size_of(whole) or 0
        if parts[0] == OTHERS:
            what = f"{self.component.name} sends nothing called {brief('.'.join(parts[1:]))}"
            return fault("E303", place, what, hint="sends: {x: sample(object.x)}")
        if index and whole in self.dimensions:
            told = entry(shown, index)
            if size:
                return fault(
                    "E408", place, told, f"an index from 1 to {size}", f"{index}", entry(shown, size)
                )
            return fault(
                "E408", place, told, "a vector before the index", f"{shown}, which is a number", shown
            )
        known = sorted(".".join(one) for one in self.dimensions if not whole_and_index(one[-1])[1])
        return unknown("E303", place, f"{self.component.name} has no {brief(shown)}", shown, known)


def _settle(
    waiting: Mapping[Path, Written],
    infer: Callable[[Expr, str, Place], T | None],
    keep: Callable[[Path, T], None],
) -> Collection[Path]:
    """Infer something of each name, which may hang on others': each round settles some. Return the rest."""
    while waiting:
        found = {name: infer(*written) for name, written in waiting.items()}
        for name, value in found.items():
            if value is not None:
                keep(name, value)
        before, waiting = waiting, {name: one for name, one in waiting.items() if found[name] is None}
        if len(before) == len(waiting):
            break
    return waiting


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


def check_balance(component: Component) -> None:
    """Refuse (E501) a component with more or fewer equations than it must have."""
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals]
    unknowns += [f"{name}.{flow.name}" for name, flow in component.flows]
    if len(component.equations) == len(unknowns):
        return
    numbers = f"{counted(len(component.equations), 'equation')} for {counted(len(unknowns), 'unknown')}"
    what = f"{component.name} is unbalanced: {numbers} ({', '.join(unknowns) or 'none'})"
    hint = "one equation for each variable and one for each flow of a connector"
    raise fault("E501", component.place, what, hint=hint)
