"""What follows from a group's settings: the numbers and clocks of parts inside the parts it sets.

Takes: a group's `Settings` and the parts of a scene.
Gives: `with_followers`: the settings, and what depends on them.
Guarantees: a number inside a part that is an expression over one the group sets has the group's value, within
its bounds, and keeps its expression; what the group sets itself stays.
Does not: follow numbers that differ from peer to peer: whoever reads columns evaluates what depends on them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

from apc.compiler.components.component import Number
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import names
from apc.compiler.language.values import PEERS, Value
from apc.compiler.scene.groups import Settings
from apc.compiler.scene.instances import Part


def with_followers(
    settings: Settings,
    parts: Sequence[Part],
    numbers: Mapping[str, Value],
    peers: int,
    place: Place,
    mistakes: Mistakes,
) -> Settings:
    """Return what a group sets, and what follows from it.

    Parameters
    ----------
    settings
        What the group sets.
    parts
        All parts of the scene, each before the parts inside it.
    numbers, peers
        The named numbers, and the number of peers.
    place
        Where the group is, for messages.
    mistakes
        Takes E207 a number out of its bounds, and those of evaluating.
    """
    own, words = dict(settings.values), dict(settings.words)
    by_peer = {name for name, _ in settings.columns}
    known = dict(numbers)
    for part in parts:
        known |= {f"{part.name}.{name}": value for name, value in (*part.values, *part.starts)}

    def number(parts_of: tuple[str, ...]) -> Fraction:
        name = ".".join(parts_of)
        return Fraction(peers) if parts_of == PEERS else (own if name in own else known)[name].number

    for part in parts:
        words = dict(_words_inside(part, words)) | words
        for name, value in (*part.values, *part.starts):
            whole = f"{part.name}.{name}"
            if value.expression is None or whole in own or whole in by_peer:
                continue
            if not any(".".join(node.parts) in own for node in names(value.expression)):
                continue
            try:
                found = Fraction(evaluate(value.expression, number, place))
            except ApcError as error:
                mistakes.take(error)
                continue
            own[whole] = replace(value, number=found, place=place)
            declared = part.component.parameter(name)
            if isinstance(declared, Number):
                declared.bounds.check(own[whole], whole, mistakes)
    return replace(settings, values=tuple(own.items()), words=tuple(words.items()))


def _words_inside(part: Part, words: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the clocks that parts inside a part take over from it, where the group sets the outer one."""
    for inner in part.component.inner:
        for own, outer in inner.entry.references:
            if (word := words.get(f"{part.name}.{outer}")) is not None:
                yield f"{part.name}.{inner.name}.{own}", word
