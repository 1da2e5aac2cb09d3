"""Check of a component, once before its first use: names, units, reductions and balance.

Takes: a component as read from YAML. Gives: `ComponentNames`, which infers undeclared dimensions and checks
the equations; `check_balance`.
Guarantees: every name in an equation is declared, and the units of both sides agree; a mistake is reported
once.
Does not: read text (see `definitions`).

A component is locally balanced in Modelica's sense (Modelica Language Specification 3.6, section 4.8): it has
one equation for each of its variables and one for each flow of its connectors; the connections of a topology
add the other equations.
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

Path = tuple[str, ...]  # a name in an equation, split at its dots
Where = Equation | SentValue  # the source of an expression: its text and location
Written = tuple[Expr, Where]
T = TypeVar("T")


class ComponentNames:
    """The dimensions and vector sizes of a component's names, with inference for undeclared names.

    `dimensions` has the dimension of each name, the same for a vector and its entries; `sizes` the size of
    each vector and of each name under inference; None is unknown. `variables` are the names with computed
    values, a vector as its entries.
    """

    def __init__(self, component: Component, undefined: Collection[str] = ()) -> None:
        """Collect the declared names.

        `undefined` are defined by invalid equations and have an unknown dimension.
        """
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
        """Return the number of entries of a vector, 0 for a scalar, None if not yet inferred."""
        return self.sizes.get(parts, 0)

    def completed(self, sends: Collection[SentValue], mistakes: Mistakes) -> Component:
        """Return the checked component with its local names and `sends`.

        An equation between vectors becomes one equation per entry. The dimensions of `sends` are inferred;
        errors are added to `mistakes`.
        """
        local_names, sent, equations = self._infer_locals(sends), list[SentValue](), list[Equation]()
        for send in sends:
            with mistakes:
                written = written_out(send.expression, self.size_of, send.text, send.location)
                dimension = _known(self._dimension(send.expression, send))
                items = written or (send.expression,)
                entry_names = entries(send.name, len(items) if len(items) > 1 else 0)
                pairs = zip(entry_names, items, strict=True)
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
            locals=(*component.locals, *local_names),
            sends=(*component.sends, *sent),
            equations=tuple(equations),
            linearized=linearized,
        )

    def _checked_linearized(
        self, linearized: Linearized, equations: Collection[Equation], mistakes: Mistakes
    ) -> Linearized:
        """Return the checked equations of a linear analysis.

        Errors are recorded for an equation that replaces no equation of the component, or the same equation
        twice.
        """
        replaced: list[Equation] = []
        lefts = {format_expression(equation.left) for equation in equations}
        for equation in linearized.equations:
            with mistakes:
                for written in self._checked(equation, mistakes):
                    left = format_expression(written.left)
                    if left in [format_expression(other.left) for other in replaced]:
                        raise fault("E514", equation.location, f"linearized: {left} is defined twice")
                    if left not in lefts:
                        message = (
                            f"linearized: no equation of {self.component.name} has {left} on its left side"
                        )
                        raise unknown("E514", equation.location, message, left, sorted(lefts))
                    replaced.append(written)
        return replace(linearized, equations=tuple(replaced))

    def _infer_locals(self, sends: Collection[SentValue]) -> list[tuple[str, Dimension]]:
        """Return the undeclared names that equations define, with their dimensions; a vector as its entries.

        A name is defined by the first equation that has it alone on the left side. Its dimension may depend
        on other local names, on itself, or on sent values. An unknown name on the right side is reported by
        `_checked`.
        """
        # Reversed, so that the first of several definitions is retained.
        undeclared = {
            equation.left.parts: (equation.right, equation)
            for equation in reversed(self.component.equations)
            if isinstance(equation.left, Name)
            and ".".join(equation.left.parts).isidentifier()
            and equation.left.parts not in self.dimensions
        }
        unresolved: dict[Path, Written] = {(OTHERS, send.name): (send.expression, send) for send in sends}
        unresolved |= undeclared
        self.dimensions |= dict.fromkeys(unresolved)
        self.sizes |= dict.fromkeys(unresolved)
        _infer_all(unresolved, self._size, self.sizes)
        # A size that contradicts itself, or depends only on itself, is undefined.
        self.sizes |= {name: self._size(*written) or 0 for name, written in unresolved.items()}
        _infer_all(unresolved, self._inferred, self.dimensions)
        return [
            (entry_name, _known(self.dimensions[name]))
            for name in reversed(undeclared)
            for entry_name in entries(name[0], self.sizes[name] or 0)
        ]

    def _size(self, expression: Expr, where: Where) -> int | None:
        """Return the number of entries of an expression: 0 for a scalar or an invalid expression, None if
        unknown.
        """
        with Mistakes():
            result = written_out(expression, self.size_of, where.text, where.location)
            return None if result is None else len(result) if len(result) > 1 else 0
        return 0

    def _inferred(self, expression: Expr, where: Where) -> Dimension | None:
        """Return the dimension of an expression; None if it is unknown or the expression is invalid."""
        with Mistakes():
            return self._dimension(expression, where)
        return None

    def _checked(self, equation: Equation, mistakes: Mistakes) -> tuple[Equation, ...]:
        """Return a checked equation as one scalar equation per entry.

        Raises ApcError for invalid names and sizes; errors of units are added to `mistakes`.
        """
        sides, name_mistakes = (
            [self._without_options_and_clocks(side) for side in (equation.left, equation.right)],
            Mistakes(),
        )
        for side in sides:
            self._check_names(side, equation, name_mistakes)
            self._check_reductions(side, equation, name_mistakes)
        name_mistakes.raise_if_any()
        with mistakes:
            check_equation(replace(equation, left=sides[0], right=sides[1]), self._lookup)
        return written_equation(equation, self.size_of)

    def _check_reductions(self, expression: Expr, where: Where, mistakes: Mistakes) -> None:
        """Record reductions without a value of the other peers, and ages of values that are not received."""
        for node in (node for node in walk(expression) if isinstance(node, Call)):
            function, others = node.function, [name for name in names(node) if name.parts[0] == OTHERS]
            received = [name for name in others if len(name.parts) > 1]
            message, expected = function, "a value of the other peers, such as others.x"
            fix = "count(others)" if function == "count" else f"{function}(others.x)"
            if function == "age" and node.arguments[0] not in received:
                sent = next((send.name for send in self.component.sends), "x")
                shown = format_expression(received[0]) if received else f"{OTHERS}.{sent}"
                message, expected = function, f"one received value, such as {shown}"
                fix = f"age({shown})"
            elif function in ("mean", "sum", "count") and not others:
                pass
            elif function in ("max", "min") and len(node.arguments) == 1 and not others:
                expected = "two values, or one value of the other peers"
            else:
                continue
            got = format_expression(node)
            mistakes.add("E506", _location(where, node), message, expected=expected, got=got, fix=fix)

    def _check_sent(self, send: SentValue) -> None:
        """Raise ApcError (E505) for a sent value that contains a received value."""
        for received in names(send.expression):
            if received.parts[0] == OTHERS:
                name = next(text for n in count(1) if (text := f"sent{n}",) not in self.dimensions)
                shown, clocks = format_expression(received), self._references("clock")
                message = f"{send.name} is on the clock of the link, and {shown} on the clock of the part"

                def with_clock(node: Expr) -> Expr | None:
                    """Return a sample with the first of several clocks, None if a node remains."""
                    if isinstance(node, Call) and node.function == "sample" and len(node.arguments) == 1:
                        return replace(node, arguments=(*node.arguments, Name((clocks[0],))))  # noqa: B023
                    return None

                text = send.text
                if len(clocks) > 1:
                    text = format_expression(transform(send.expression, with_clock))
                sample = f"{{{send.name}: sample(hold({name}))}}"
                advice = f"add the equation {name} = {text} and use sends: {sample}"
                raise fault("E505", _location(send, received), message, advice=advice)

    def _references(self, role: str) -> list[str]:
        """Return the names of the parameters with a role, such as the clocks, in alphabetical order."""
        return sorted(p.name for p in self.component.parameters if getattr(p, "role", "") == role)

    def _without_options_and_clocks(self, expression: Expr) -> Expr:
        """Return the expression without items that have no dimension: words of options, and clocks in
        `sample`.

        Each test of an option becomes a true statement, so that both branches are checked.
        """

        def replacement(node: Expr) -> Expr | None:
            """Return the replacement of a node, or None if the node remains."""
            match node:
                case Call("sample", (sampled, _)):
                    return replace(node, arguments=(transform(sampled, replacement),))
            return TRUE if option_test(node, self.options) else None

        return transform(expression, replacement)

    def dimension_of_held(self, expression: Expr, text: str, location: SourceLocation) -> Dimension | None:
        """Return the dimension of a checked expression under `hold`; None for a single variable."""
        if isinstance(expression, Name) and expression.parts in self.variables:
            return None
        return _known(
            dimension_of(self._without_options_and_clocks(expression), self._lookup, text, location)
        )

    def _dimension(self, expression: Expr, where: Where) -> Dimension | None:
        """Return the dimension of an expression, None if unknown.

        Raises ApcError for invalid names and units.
        """
        expression, name_mistakes = self._without_options_and_clocks(expression), Mistakes()
        self._check_names(expression, where, name_mistakes)
        name_mistakes.raise_if_any()
        return dimension_of(expression, self._lookup, where.text, where.location)

    def _lookup(self, name: Name) -> Dimension | None:
        """Return the dimension of a name, None if unknown."""
        return self.dimensions.get(_vector_of(name.parts))

    def _check_names(self, expression: Expr, where: Where, mistakes: Mistakes) -> None:
        """Record unknown names, and words of options and tables used as numbers."""
        checked_starts = set[int]()
        for node in walk(expression):
            match node:
                case Call("==" | "!=", (Name((name,)) as left, Name() as right)) if name in self.options:
                    # The word is unknown: a valid test was replaced before.
                    checked_starts |= {left.start, right.start}
                    word, words = format_expression(right), self.options[name].words
                    message, at = f"{name}: unknown option {brief(word)}", _location(where, right)
                    mistakes.take(unknown("E206", at, message, word, words))
                case Call("interpolate", (Name((name,)) as table, _)) if name in self.tables:
                    checked_starts.add(table.start)
                case Call("interpolate", (other, _)):
                    checked_starts.add(other.start)
                    got, known = format_expression(other), ", ".join(sorted(self.tables)) or "none"
                    message, expected = (
                        "interpolate",
                        f"the name of a table ({known} in {self.component.name})",
                    )
                    mistakes.add("E325", _location(where, other), message, expected=expected, got=got)
                case Call("count" | "age", (Name((name,)) as every,)) if name == OTHERS:
                    checked_starts.add(every.start)
                case Name((name,)) if name == OTHERS and node.start not in checked_starts:
                    received = (".".join(path) for path in self.dimensions if path[:-1] == (OTHERS,))
                    message, sent = "value of the other peers", next(received, f"count({OTHERS})")
                    mistakes.add("E506", _location(where, node), message, expected=sent, got=name, fix=sent)
                case Name((name,)) if name in self.tables and node.start not in checked_starts:
                    fix = f"interpolate({name}, time)"
                    mistakes.add("E303", _location(where, node), f"{name} is a table, not a number", fix=fix)
                case Name(parts) if node.start not in checked_starts:
                    self._check_name(parts, _location(where, node), mistakes)

    def example_of(self, sent: str) -> str:
        """Return a variable of a connector, as an example of a sent value: the one of the same name if it
        exists.
        """
        texts = [
            f"{connector}.{whole_and_index(potential.name)[0]}"
            for connector, kind in self.component.connectors
            for potential in kind.potentials
        ]
        return next((text for text in texts if text.endswith(f".{sent}")), next(iter(texts), "object.x"))

    def _check_name(self, parts: Path, location: SourceLocation, mistakes: Mistakes) -> None:
        """Record an unknown name, or an index beyond the size of a vector."""
        vector, index = _vector_of(parts), whole_and_index(parts[-1])[1]
        shown, size = ".".join(vector), self.size_of(vector) or 0
        if vector in self.dimensions and index <= size:
            return
        if parts[0] == OTHERS:
            sent = brief(".".join(vector[1:]))
            message = f"{self.component.name} does not send a value {sent}"
            value = f"{sent}: sample({self.example_of(sent)})"
            advice = f"add the section sends: {{{value}}}"
            if any(path[0] == OTHERS and len(path) > 1 for path in self.dimensions):
                advice = f"add {value} to sends"
            elif not self._references("link"):
                advice += ", and link: link to parameters"
            mistakes.add("E303", location, message, advice=advice)
        elif vector in self.dimensions:
            expected, got, fix = "a vector before the index", f"the number {shown}", shown
            if size:
                expected, got, fix = f"an index from 1 to {size}", f"{index}", ""
            mistakes.add("E408", location, entry(shown, index), expected=expected, got=got, fix=fix)
        else:
            message, known = (
                f"unknown name {brief(shown)} in {self.component.name}",
                map(".".join, self.dimensions),
            )
            mistakes.take(unknown("E303", location, message, shown, sorted(known)))


def _vector_of(path: Path) -> Path:
    """Return the path of the vector that an entry belongs to; for a scalar the path itself."""
    return (*path[:-1], whole_and_index(path[-1])[0])


def _location(where: Where, node: Expr) -> SourceLocation:
    """Return the location of a node of an expression in the source file."""
    return location_in(where.location, where.text, node.start)


def _infer_all(
    unresolved: Mapping[Path, Written],
    infer: Callable[[Expr, Where], T | None],
    known: dict[Path, T | None],
) -> None:
    """Add the inferred values of all names to `known`.

    A value may depend on the values of other names: the inference is repeated until no value is added.

    Parameters
    ----------
    unresolved
        The expression of each name, with its source.
    infer
        The function that returns the value of an expression, or None if a name in it has no value yet.
    known
        The values by name, None where missing; changed in place.
    """
    while True:
        result = {name: infer(*written) for name, written in unresolved.items() if known[name] is None}
        known |= result
        if all(value is None for value in result.values()):
            return


def _visible_names(component: Component) -> Iterator[tuple[Path, Dimension]]:
    """Yield the names of a component that are visible from outside, with dimensions: variables and
    potentials.
    """
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
    """Return an inferred dimension; dimensionless for an expression that fits every dimension, such as 0."""
    return DIMENSIONLESS if dimension in (None, ANY) else dimension


def check_balance(component: Component) -> None:
    """Raise ApcError (E501) for a component with more or fewer equations than unknowns."""
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals]
    unknowns += [f"{name}.{flow.name}" for name, flow in component.flows]
    if len(component.equations) != len(unknowns):
        numbers = f"{counted(len(component.equations), 'equation')} for {counted(len(unknowns), 'unknown')}"
        message = f"{component.name} is unbalanced: {numbers} ({', '.join(unknowns) or 'none'})"
        advice = "write one equation for each"
        raise fault("E501", component.location, message, advice=advice)
