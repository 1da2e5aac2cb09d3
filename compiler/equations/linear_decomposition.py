"""Reductions over the other peers; a linear reduction is split into reductions of single values.

Takes: `ReceiveCrossing`s. Gives: `PeerReduction`, `linear_decomposition`.
Guarantees: the term has the value of the original reduction.
Does not: use the number of other peers: it is a parameter of the subsystem.

Received values are others.k, previous(others.k), the age of the packet, or age times others.k. A mean or sum
that is linear in received values is a linear combination of their means or sums, so that the cost for N peers
is proportional to N, not N².
"""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass, replace

import sympy

from apc.compiler.compiled import count_of
from apc.compiler.components.component import OTHERS
from apc.compiler.equations.flatten import RECEIVED_AGE, ReceiveCrossing
from apc.compiler.equations.terms import ZERO, Symbol, Term, linear_form, symbol, to_term
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import format_expression, names

AGE = symbol(RECEIVED_AGE)
RECEIVED = re.compile(rf"(?:(age|previous)\()?{OTHERS}\.([^()]*)\)?")
TEXTS = {"": "others.{0}", "factor": "age(others.{0})*others.{0}", "alone": "age(others.{0})"}


@dataclass(frozen=True, slots=True)
class PeerReduction:
    """The reduction `operator` over the peers received over `link`; its value at a tick is `symbol`.

    Without `edge` its operands are the values sent as `send`, with `age` and `before` as in
    `compiled.Receive`; with `edge`, the values of this term for each peer.
    """

    symbol: str
    operator: str
    send: str
    link: str
    clock: str
    location: SourceLocation
    age: str = ""
    before: bool = False
    edge: Term | None = None

    @property
    def sends(self) -> list[str]:
        """The names of the received values."""
        symbols = () if self.edge is None else self.edge.free_symbols - {AGE}
        others = sorted(s.name.removeprefix(f"{OTHERS}.") for s in symbols if s.name.startswith(f"{OTHERS}."))
        return list(dict.fromkeys([self.send, *others]))


def linear_decomposition(crossing: ReceiveCrossing, mistakes: Mistakes) -> tuple[Term, list[PeerReduction]]:
    """Return the value of a reduction as a term, and the reductions of single received values in the term.

    A reduction that is not linear in the received values is returned with an edge term.

    Parameters
    ----------
    crossing
        The reduction.
    mistakes
        The collector of errors: E506 if the previous value of each peer is required, of which only means and
        sums exist.

    Returns
    -------
    Term
        The value, in symbols of the single reductions.
    list of PeerReduction
        The single reductions.
    """
    operator, link = crossing.operator, crossing.link
    count = symbol(count_of(link))
    values: dict[
        Symbol, tuple[str, bool]
    ] = {}  # received values: the name, and whether it is the value of the previous tick
    ages: dict[Symbol, str] = {}
    for name in map(format_expression, names(crossing.argument)):
        if match := RECEIVED.fullmatch(name):
            call, send = match.groups()
            if call == "age":
                ages[symbol(name)] = send
            else:
                values[symbol(name)] = send, call == "previous"
    term = to_term(crossing.argument).xreplace(dict.fromkeys(ages, AGE))
    any_send = next(iter((*ages.values(), *(send for send, _ in values.values()))), "")
    reduction = PeerReduction(crossing.symbol, operator, any_send, link, crossing.clock, crossing.location)
    linear_parts = _linear_parts(term, values.keys()) if operator in ("mean", "sum") else None
    if linear_parts is None or any(
        aged and value in values and values[value][1] for value, aged in linear_parts
    ):
        for previous_send in (send for send, before in values.values() if before):
            previous = f"previous(others.{previous_send.rpartition('.')[2]})"
            fix, expected = f"mean({previous}), or sum", "a mean or sum that is linear in it"
            mistakes.add("E506", crossing.location, previous, expected=expected, fix=fix)
        if term not in values:
            reduction = replace(reduction, edge=term, age="edge" if AGE in term.free_symbols else "")
        if operator == "sum" and reduction.age and values.keys().isdisjoint(term.free_symbols):
            reduction = replace(
                reduction, symbol=f"mean{reduction.symbol.removeprefix(operator)}", operator="mean"
            )
        return symbol(reduction.symbol) * (1 if reduction.operator == operator else count), [reduction]
    sum_of_terms, reductions = ZERO, list[PeerReduction]()
    for (value, aged), coefficient in linear_parts.items():
        send, before = values.get(value, (any_send, False))
        multiplicity = count if operator == "sum" and value is None else 1
        if value is None and not aged:
            sum_of_terms += multiplicity * coefficient
            continue
        age = "" if not aged else "alone" if value is None else "factor"
        # A sum of ages is their mean times the number of senders.
        term_operator = operator if multiplicity == 1 else "mean"
        name = f"{term_operator}({f'previous(others.{send})' if before else TEXTS[age].format(send)})"
        reductions.append(
            replace(reduction, symbol=name, operator=term_operator, send=send, age=age, before=before)
        )
        sum_of_terms += multiplicity * coefficient * symbol(name)
    return sum_of_terms, reductions


def _linear_parts(term: Term, values: Set[Symbol]) -> dict[tuple[Symbol | None, bool], Term] | None:
    """Return the coefficients of a term by sent value, and by whether the value is multiplied by the age.

    The key None is for the term without a sent value. The result is None if the term is not linear.
    """
    nonlinear = any(not atom.free_symbols.isdisjoint({*values, AGE}) for atom in term.atoms(sympy.Function))
    form = None if nonlinear else linear_form(term, values)
    if form is None:
        return None
    parts: dict[tuple[Symbol | None, bool], Term] = {}
    for value, coefficient in (*form[0].items(), (None, form[1])):
        by_age = linear_form(coefficient, {AGE})
        if by_age is None:
            return None
        parts |= {(value, False): by_age[1], (value, True): by_age[0].get(AGE, ZERO)}
    return {key: value for key, value in parts.items() if value != 0}
