"""Reads typed values from YAML nodes; a node of the wrong type raises an error with a suggestion.

Takes: nodes of the stage `source`. Gives: `MappingReader`, a mapping that is read key by key; `mapping_of`,
`list_of`, `text_of`, `name_of`, `whole_number`, `among`; for messages `fault`, `unknown`, `form`, `brief`,
`either_comma`.
Guarantees: a node of the wrong form is one mistake, an `ApcError` that `with mistakes:` records, so that
reading goes on behind it.
Does not: know any section, component or unit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Container
from typing import TypeVar

from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation, nearest, visible
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence

T = TypeVar("T")
D = TypeVar("D")

IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}\Z")


def form(node: Node) -> str:
    """Return the type of a node, in words, for a message."""
    if isinstance(node, Mapping):
        return "a mapping"
    if isinstance(node, Sequence):
        return "a list"
    if node.value is None or not node.text.strip():
        return "nothing"
    return brief(node.text) if node.plain else f'"{brief(node.text)}"'


def either_comma(key: str, whole: str, digits: str, rest: str | None) -> str:
    """Return the suggestion for a number with a comma: 0,5 is 0.5, and 1,500 may be 1500 as well."""
    decimal = f"{key}: {whole}.{digits}{rest or ''}"
    thousands = len(digits) == 3 and whole.lstrip("+-0")
    return f"{decimal}, or {key}: {whole}{digits}{rest or ''}" if thousands else decimal


def brief(text: str) -> str:
    """Return a text short enough for one line of a message."""
    flat = " ".join(text.split())
    return visible(flat if len(flat) <= 60 else flat[:57] + "...")


def fault(
    code: str, location: SourceLocation, message: str, expected: str = "", got: str = "", hint: str = ""
) -> ApcError:
    """Return an error with one diagnostic, for the caller to raise.

    Parameters
    ----------
    code, location, message, expected, got, hint
        The fields of the `Diagnostic`.
    """
    return ApcError(Diagnostic(code, location, message, expected, got, hint))


def mapping_of(node: Node, subject: str, hint: str = "") -> Mapping:
    """Return a node, checked to be a mapping.

    Parameters
    ----------
    node
        The node.
    subject
        The name of the value, for the message.
    hint
        The line to write instead.

    Raises
    ------
    ApcError
        E203 the node is no mapping.
    """
    if isinstance(node, Mapping):
        return node
    raise fault("E203", node.location, subject, "a mapping of keys to values", form(node), hint)


def text_of(node: Node, subject: str, hint: str = "") -> str:
    """Return the text of a scalar that isn't empty; arguments and error as for `mapping_of`."""
    if isinstance(node, Scalar) and node.text.strip() and node.value is not None:
        return node.text
    raise fault("E203", node.location, subject, "a single value", form(node), hint)


def list_of(node: Node, subject: str, size: int, item: str) -> tuple[Node, ...]:
    """Return the items of a list of `size` items; `item` is an example for the message. Raises E203."""
    if isinstance(node, Sequence) and len(node.items) == size:
        return node.items
    got = f"{len(node.items)}" if isinstance(node, Sequence) else form(node)
    hint = f"{subject}: [{', '.join([item] * size)}]"
    raise fault("E203", node.location, subject, f"a list of {size} values", got, hint)


def whole_number(node: Node) -> int | None:
    """Return the whole number that a scalar is; None if it is none, as `true` or one in quotes."""
    value = node.value if isinstance(node, Scalar) else None
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def name_of(
    key: Scalar, subject: str, used: Container[str] = (), whole: str = "", words: Container[str] = ()
) -> str:
    """Return the text of a scalar that can serve as a name: a letter, then letters, digits, underscores.

    Parameters
    ----------
    key, subject
        The scalar, and the noun for the named thing, for the message.
    used, whole
        The names already in use, and the section that has them.
    words
        The words of the language, which can't be names.

    Raises
    ------
    ApcError
        E205 if it can't.
    """
    name = key.text
    if not IDENTIFIER.match(name):
        expected = "a letter followed by letters, digits or underscores (63 at most)"
        raise fault("E205", key.location, f"the name of {subject}", expected, brief(name) or "nothing")
    if name in words:
        raise fault("E205", key.location, f"{name} is a word of the language and can't be a name")
    if name in used:
        raise fault("E205", key.location, f"the name {name} is used twice in {whole}")
    return name


# Keys of the language before version 0.2, and their names since.
RENAMED = {"about": "description", "above": "exclusive_min"}


class MappingReader:
    """A mapping that is read key by key; a value at fault is recorded and reads as one that isn't there.

    A key that isn't allowed is recorded, with the nearest allowed one, and reads as the one it was meant to
    be, so that one slip is not reported a second time as something missing.
    """

    def __init__(self, node: Mapping, allowed: Collection[str], subject: str, mistakes: Mistakes) -> None:
        """Initialize with a mapping, its valid keys, its name for messages, and the collector of E202."""
        self.location = node.location
        self.mistakes = mistakes
        self.nodes = {key.text: value for key, value in node.entries}
        for key, value in node.entries:
            if key.text not in allowed:
                if (renamed := RENAMED.get(key.text, "")) in allowed:
                    text = f"{subject} has no key {key.text}: it is named {renamed} now"
                    mistakes.take(fault("E202", key.location, text, hint=renamed))
                    self.nodes.setdefault(renamed, value)
                    continue
                left = [known for known in allowed if known not in self.nodes]  # what is there was meant
                close = nearest(key.text, left)
                text = f"{subject} has no key {brief(key.text)}"
                mistakes.take(unknown("E202", key.location, text, close, [close] if close else allowed))
                if close:
                    self.nodes.setdefault(close, value)

    def read(self, key: str, reader: Callable[[Node, str], T], default: D) -> T | D:
        """Return the result of a reader for the value of a key; the reader also gets the key."""
        if (node := self.nodes.get(key)) is not None:
            with self.mistakes:
                return reader(node, key)
        return default

    def text(self, key: str, hint: str = "") -> str:
        """Return the text of a key, empty without one."""
        return self.read(key, lambda node, _: text_of(node, key, hint), "")

    def section(self, key: str, hint: str) -> tuple[tuple[Scalar, Node], ...]:
        """Return the entries of the mapping of a key; `hint` is the suggestion otherwise."""
        return self.read(key, lambda node, _: mapping_of(node, key, f"{key}: {hint}").entries, ())

    def each(self, key: str, hint: str, reader: Callable[[Scalar, Node], T]) -> list[T]:
        """Return the results of a reader for the entries of a section, each with its key."""
        result = []
        for name, node in self.section(key, hint):
            with self.mistakes:
                result.append(reader(name, node))
        return result


def unknown(code: str, location: SourceLocation, subject: str, name: str, texts: Collection[str]) -> ApcError:
    """Return the mistake of an unknown name, with the nearest known one or, failing that, a list of them.

    Parameters
    ----------
    code, location, subject
        The mistake's code, where it is, and its first words.
    name
        The name as written.
    texts
        The names there are.
    """
    close = nearest(name, texts)
    if close:
        return fault(code, location, f"{subject}; the nearest is {close}", hint=close)
    listed = ", ".join(list(texts)[:12]) + (", …" if len(texts) > 12 else "")
    return fault(code, location, f"{subject}; there are: {listed}" if listed else f"{subject}; there is none")


def among(
    name: str, texts: Collection[str], location: SourceLocation, subject: str, code: str = "E206"
) -> str:
    """Return a known name.

    Parameters
    ----------
    name, texts
        The name as written, and the known names.
    location, subject, code
        Its location, the message for an unknown name (inserted for `{}`), and its code.

    Raises
    ------
    ApcError
        The name is not known.
    """
    if name in texts:
        return name
    raise unknown(code, location, subject.replace("{}", brief(name)), name, texts)
