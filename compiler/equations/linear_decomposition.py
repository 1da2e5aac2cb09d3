"""Reductions over the other peers, with linear ones split into terms.

Takes: `ReceiveCrossing`s. Gives: `PeerReduction`, `linear_decomposition`.
Guarantees: the term has the value of the original reduction.
Does not: use the number of others: it is a parameter of the subsystem.

Received values are others.k, previous(others.k), the age of the packet, or age times others.k. A mean or sum
that is linear in these is a combination of the means or sums of each, so that N peers cost N, not N².
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
    """`symbol` represents, at a tick, the `operator` over the peers received over `link`.

    Without an `edge` its operands are the values sent as `send`, with `age` and `before` as in
    `compiled.Receive`; with one, the values of `edge` for each peer.
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
        """The names of received values."""
        symbols = () if self.edge is None else self.edge.free_symbols - {AGE}
        others = sorted(s.name.removeprefix(f"{OTHERS}.") for s in symbols if s.name.startswith(f"{OTHERS}."))
        return list(dict.fromkeys([self.send, *others]))


def linear_decomposition(crossing: ReceiveCrossing, mistakes: Mistakes) -> tuple[Term, list[PeerReduction]]:
    """Return a reduction as a term, with its received values; with an edge if it is not linear.

    Parameters
    ----------
    crossing
        The reduction.
    mistakes
        Collects E506 a value required for each peer that is available only as an aggregate.
    """
    operator, link = crossing.operator, crossing.link
    count = symbol(count_of(link))
    values: dict[Symbol, tuple[str, bool]] = {}  # what others send: its name, and whether of the tick before
    ages: dict[Symbol, str] = {}
    for name in map(format_expression, names(crossing.argument)):
        if match := RECEIVED.fullmatch(name):
            call, send = match.groups()
            if call == "age":
                ages[symbol(name)] = send
            else:
                values[symbol(name)] = send, call == "previous"
    term = to_term(crossing.argument).xreplace(dict.fromkeys(ages, AGE))
    first = next(iter((*ages.values(), *(send for send, _ in values.values()))), "")
    whole = PeerReduction(crossing.symbol, operator, first, link, crossing.clock, crossing.location)
    parts = _linear_parts(term, values.keys()) if operator in ("mean", "sum") else None
    if parts is None or any(aged and value in values and values[value][1] for value, aged in parts):
        for earlier in (send for send, before in values.values() if before):
            previous = f"previous(others.{earlier.rpartition('.')[2]})"
            hint, expected = f"mean({previous}), or sum", "a mean or sum that is linear in it"
            mistakes.add("E506", crossing.location, previous, expected=expected, hint=hint)
        if term not in values:
            whole = replace(whole, edge=term, age="edge" if AGE in term.free_symbols else "")
        if operator == "sum" and whole.age and values.keys().isdisjoint(term.free_symbols):
            whole = replace(whole, symbol=f"mean{whole.symbol.removeprefix(operator)}", operator="mean")
        return symbol(whole.symbol) * (1 if whole.operator == operator else count), [whole]
    total, received = ZERO, list[PeerReduction]()
    for (value, aged), coefficient in parts.items():
        send, before = values.get(value, (first, False))
        many = count if operator == "sum" and value is None else 1
        if value is None and not aged:
            total += many * coefficient
            continue
        age = "" if not aged else "alone" if value is None else "factor"
        peer_type = (
            operator if many == 1 else "mean"
        )  # a sum of ages is their mean times the number of senders
        name = f"{peer_type}({f'previous(others.{send})' if before else TEXTS[age].format(send)})"
        received.append(replace(whole, symbol=name, operator=peer_type, send=send, age=age, before=before))
        total += many * coefficient * symbol(name)
    return total, received


def _linear_parts(term: Term, values: Set[Symbol]) -> dict[tuple[Symbol | None, bool], Term] | None:
    """Return a term's coefficients of sent values, None for the rest, and whether multiplied by the age.

    None if it isn't a sum of such.
    """
    bent = any(not atom.free_symbols.isdisjoint({*values, AGE}) for atom in term.atoms(sympy.Function))
    form = None if bent else linear_form(term, values)
    if form is None:
        return None
    parts: dict[tuple[Symbol | None, bool], Term] = {}
    for value, coefficient in (*form[0].items(), (None, form[1])):
        by_age = linear_form(coefficient, {AGE})
        if by_age is None:
            return None
        parts |= {(value, False): by_age[1], (value, True): by_age[0].get(AGE, ZERO)}
    return {key: value for key, value in parts.items() if value != 0}
