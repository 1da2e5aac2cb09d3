"""What a peer hears of the others, linear reductions taken apart.

Takes: `ReceiveCrossing`s. Gives: `PeerReduction`, `taken_apart`.
Guarantees: the term has the value of the reduction it was taken from.
Does not: know how many others there are: that is a parameter of the site.

What is heard is others.k, previous(others.k), the age of its packet, or age times others.k. A mean or sum
that is linear in these is that of each by itself, so that N peers cost N, not N².
"""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass, replace

import sympy

from apc.compiler.compiled import count_of
from apc.compiler.components.component import OTHERS
from apc.compiler.equations.flatten import HEARD_AGE, ReceiveCrossing
from apc.compiler.equations.terms import ZERO, Symbol, Term, linear_form, symbol, to_term
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import format_expression, names

AGE = symbol(HEARD_AGE)
HEARD = re.compile(rf"(?:(age|previous)\()?{OTHERS}\.([^()]*)\)?")
TEXTS = {"": "others.{0}", "factor": "age(others.{0})*others.{0}", "alone": "age(others.{0})"}


@dataclass(frozen=True, slots=True)
class PeerReduction:
    """`symbol` stands at a tick for the `operator` over the peers that are heard over `link`.

    Without an `edge` it is of what they sent as `send`, as `age` and `before` say (see `compiled.Receive`);
    with one, of the value that `edge` has for each of them.
    """

    symbol: str
    operator: str
    send: str
    link: str
    clock: str
    place: SourceLocation
    age: str = ""
    before: bool = False
    edge: Term | None = None

    @property
    def sends(self) -> list[str]:
        """The names of what is read of each other peer."""
        symbols = () if self.edge is None else self.edge.free_symbols - {AGE}
        others = sorted(s.name.removeprefix(f"{OTHERS}.") for s in symbols if s.name.startswith(f"{OTHERS}."))
        return list(dict.fromkeys([self.send, *others]))


def taken_apart(crossing: ReceiveCrossing, mistakes: Mistakes) -> tuple[Term, list[PeerReduction]]:
    """Return a reduction as a term, and what it holds that is heard; an edge where it is not linear.

    Parameters
    ----------
    crossing
        The reduction.
    mistakes
        Takes E506 what is asked of each peer by itself and is known of all together only.
    """
    operator, link = crossing.operator, crossing.link
    count = symbol(count_of(link))
    values: dict[Symbol, tuple[str, bool]] = {}  # what others send: its name, and whether of the tick before
    ages: dict[Symbol, str] = {}
    for name in map(format_expression, names(crossing.argument)):
        if match := HEARD.fullmatch(name):
            call, send = match.groups()
            if call == "age":
                ages[symbol(name)] = send
            else:
                values[symbol(name)] = send, call == "previous"
    term = to_term(crossing.argument).xreplace(dict.fromkeys(ages, AGE))
    first = next(iter((*ages.values(), *(send for send, _ in values.values()))), "")
    whole = PeerReduction(crossing.symbol, operator, first, link, crossing.clock, crossing.place)
    parts = _linear_parts(term, values.keys()) if operator in ("mean", "sum") else None
    if parts is None or any(aged and value in values and values[value][1] for value, aged in parts):
        for earlier in (send for send, before in values.values() if before):
            previous = f"previous(others.{earlier.rpartition('.')[2]})"
            hint, expected = f"mean({previous}), or sum", "a mean or sum that is linear in it"
            mistakes.add("E506", crossing.place, previous, expected=expected, hint=hint)
        if term not in values:
            whole = replace(whole, edge=term, age="edge" if AGE in term.free_symbols else "")
        if operator == "sum" and whole.age and values.keys().isdisjoint(term.free_symbols):
            whole = replace(whole, symbol=f"mean{whole.symbol.removeprefix(operator)}", operator="mean")
        return symbol(whole.symbol) * (1 if whole.operator == operator else count), [whole]
    total, heard = ZERO, list[PeerReduction]()
    for (value, aged), coefficient in parts.items():
        send, before = values.get(value, (first, False))
        many = count if operator == "sum" and value is None else 1
        if value is None and not aged:
            total += many * coefficient
            continue
        age = "" if not aged else "alone" if value is None else "factor"
        kind = operator if many == 1 else "mean"  # a sum of ages is their mean as often as any are heard
        name = f"{kind}({f'previous(others.{send})' if before else TEXTS[age].format(send)})"
        heard.append(replace(whole, symbol=name, operator=kind, send=send, age=age, before=before))
        total += many * coefficient * symbol(name)
    return total, heard


def _linear_parts(term: Term, values: Set[Symbol]) -> dict[tuple[Symbol | None, bool], Term] | None:
    """Return a term's coefficients of what others send, None for the rest, and whether times its age.

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
