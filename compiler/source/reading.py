"""Reads typed values out of YAML nodes, recording a mistake where a node is not what it should be.

Takes: nodes of the stage `source`. Gives: texts, mappings, entries.
Guarantees: a node of the wrong form adds one mistake and yields None, so that reading goes on.
Does not: know any section, component or unit.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator

from apc.compiler.errors import Mistakes, Place, nearest, visible
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence

IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}\Z")


def form(node: Node) -> str:
    """Return what a node is, in words, for a message."""
    if isinstance(node, Mapping):
        return "a mapping"
    if isinstance(node, Sequence):
        return "a list"
    if node.value is None or not node.text.strip():
        return "nothing"
    return brief(node.text) if node.plain else f'"{brief(node.text)}"'


def either_comma(key: str, whole: str, digits: str, rest: str | None) -> str:
    """Return what to write for a number with a comma: 0,5 is 0.5, and 1,500 may be 1500 as well."""
    decimal = f"{key}: {whole}.{digits}{rest or ''}"
    thousands = len(digits) == 3 and whole.lstrip("+-0")
    return f"{decimal}, or {key}: {whole}{digits}{rest or ''}" if thousands else decimal


def brief(text: str) -> str:
    """Return a text short enough for one line of a message."""
    flat = " ".join(text.split())
    return visible(flat if len(flat) <= 60 else flat[:57] + "...")


def read_mapping(node: Node | None, what: str, mistakes: Mistakes, *, hint: str = "") -> Mapping | None:
    """Return the node when it is a mapping.

    Parameters
    ----------
    node
        What to read; None gives None.
    what
        What it is the value of, for a message.
    mistakes
        Takes E203 when it is none.
    hint
        The line to write instead.
    """
    if node is None or isinstance(node, Mapping):
        return node
    mistakes.add("E203", node.place, what, expected="a mapping of keys to values", got=form(node), hint=hint)
    return None


def read_text(node: Node | None, what: str, mistakes: Mistakes, *, hint: str = "") -> str | None:
    """Return the text of a scalar that isn't empty.

    Parameters
    ----------
    node, what, mistakes, hint
        As for `read_mapping`.
    """
    if node is None:
        return None
    if isinstance(node, Scalar) and node.text.strip() and node.value is not None:
        return node.text
    mistakes.add("E203", node.place, what, expected="a single value", got=form(node), hint=hint)
    return None


def listed(node: Node, what: str, size: int, one: str, mistakes: Mistakes) -> tuple[Node, ...] | None:
    """Return the items of a list that has as many as a vector has entries.

    Parameters
    ----------
    node, what, mistakes
        As for `read_mapping`.
    size
        How many there must be.
    one
        An item to show in a message.
    """
    if isinstance(node, Sequence) and len(node.items) == size:
        return node.items
    got = f"{len(node.items)}" if isinstance(node, Sequence) else form(node)
    hint = f"{what}: [{', '.join([one] * size)}]"
    mistakes.add("E203", node.place, what, expected=f"a list of {size} values", got=got, hint=hint)
    return None


def whole_number(node: Node) -> int | None:
    """Return the whole number that a scalar is; None if it is none, as `true` or one in quotes."""
    value = node.value if isinstance(node, Scalar) else None
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def read_name(node: Scalar, what: str, mistakes: Mistakes) -> str | None:
    """Return the text of a scalar that can serve as a name: a letter, then letters, digits, underscores."""
    if IDENTIFIER.match(node.text):
        return node.text
    mistakes.add(
        "E205",
        node.place,
        f"the name of {what}",
        expected="a letter followed by letters, digits or underscores (63 at most)",
        got=brief(node.text) or "nothing",
    )
    return None


def check_keys(mapping: Mapping, allowed: Collection[str], what: str, mistakes: Mistakes) -> Mapping:
    """Record every key that isn't allowed, with the nearest allowed one.

    Parameters
    ----------
    mapping
        What to check.
    allowed
        The keys it may have.
    what
        What it is, for a message.
    mistakes
        Takes E202 for each other key.

    Returns
    -------
    The mapping as it was meant: a misspelt key reads as the one nearest to it, so that one slip is not
    reported a second time as something missing.
    """
    meant: dict[str, tuple[Scalar, Node]] = {key.text: (key, node) for key, node in mapping.entries}
    for key, node in mapping.entries:
        if key.text not in allowed:
            told = f"{what} has no key {brief(key.text)}"
            left = [one for one in allowed if one not in meant]  # what stands there already was not meant
            close = nearest(key.text, left)
            add_unknown("E202", key.place, told, close, [close] if close else allowed, mistakes)
            if close and close not in meant:
                meant[close] = (Scalar(close, close, key.plain, key.place), node)
    return Mapping(tuple(meant.values()), mapping.place)


def add_unknown(
    code: str, place: Place, what: str, name: str, known: Collection[str], mistakes: Mistakes
) -> None:
    """Record an unknown name, with the nearest known one or, failing that, a list of them.

    Parameters
    ----------
    code, place, what
        The mistake's code, where it is, and its first words.
    name
        The name as written.
    known
        The names there are.
    mistakes
        Takes the mistake.
    """
    close = nearest(name, known)
    if close:
        mistakes.add(code, place, f"{what}; the nearest is {close}", hint=close)
    elif known:
        listed = ", ".join(list(known)[:12]) + (", …" if len(known) > 12 else "")
        mistakes.add(code, place, f"{what}; there are: {listed}")
    else:
        mistakes.add(code, place, f"{what}; there is none")


def entries(mapping: Mapping | None) -> Iterator[tuple[Scalar, Node]]:
    """Yield the entries of a mapping that may be missing."""
    if mapping is not None:
        yield from mapping.entries
