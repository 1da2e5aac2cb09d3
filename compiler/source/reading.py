"""Reading of typed values from YAML nodes; a node of the wrong type raises an error with a fix.

Takes: nodes of the stage `source`. Gives: `MappingReader`, a mapping that is read key by key; `mapping_of`,
`list_of`, `text_of`, `value_of`, `name_of`, `whole_number`, `among`; for messages `fault`, `unknown`, `form`,
`brief`, `named`, `quoted`, `either_comma`, `first_use`.
Guarantees: a node of the wrong form is one mistake, an `ApcError` that `with mistakes:` records, so that
the following nodes are read.
Does not: handle sections, components or units.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection, Container
from typing import TypeVar

from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation, equally_near, nearest, visible
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence

T = TypeVar("T")
D = TypeVar("D")

MOST_OFFERED = 2  # values of a list that are offered instead of the list
_NUMBER = re.compile(r"\A\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?(?=\s|\Z)")
IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,62}\Z")


def form(node: Node) -> str:
    """Return the type of a node as text, for a message."""
    if isinstance(node, Mapping):
        return "a mapping"
    if isinstance(node, Sequence):
        return "a list"
    if node.value is None or not node.text.strip():
        return "nothing"
    return brief(node.text) if node.plain else f'"{brief(node.text)}"'


def either_comma(key: str, whole: str, digits: str, rest: str | None) -> str:
    """Return the fixes for a number with a comma: 0,5 is 0.5, and 1,500 is either 1.500 or 1500."""
    decimal = f"{key}: {whole}.{digits}{rest or ''}"
    thousands = len(digits) == 3 and whole.lstrip("+-0")
    return f"{decimal}, or {key}: {whole}{digits}{rest or ''}" if thousands else decimal


def brief(text: str) -> str:
    """Return a text shortened to at most 60 characters of one line, for a message."""
    flat = " ".join(text.split())
    return visible(flat if len(flat) <= 60 else flat[:57] + "...")


def named(text: str) -> str:
    """Return a short name for a message, with the first character that is not ASCII spelled out.

    A text of several words has quotes.
    """
    foreign = next((character for character in text if not character.isascii()), "")
    spelled = f" (U+{ord(foreign):04X}, {unicodedata.name(foreign, 'unnamed character')})" if foreign else ""
    return quoted(text) + spelled


def quoted(text: str) -> str:
    """Return a short text for a message, in quotes if it has several words."""
    return f"'{brief(text)}'" if len(text.split()) > 1 else brief(text)


def fault(
    code: str,
    location: SourceLocation,
    message: str,
    expected: str = "",
    got: str = "",
    fix: str = "",
    advice: str = "",
) -> ApcError:
    """Return an error with one diagnostic, for the caller to raise.

    Parameters
    ----------
    code, location, message, expected, got, fix, advice
        The fields of the `Diagnostic`.
    """
    return ApcError(Diagnostic(code, location, message, expected, got, fix, advice))


def mapping_of(node: Node, subject: str, fix: str = "") -> Mapping:
    """Return a node if it is a mapping.

    Parameters
    ----------
    node
        The node.
    subject
        The name of the value, for the message.
    fix
        The fix.

    Raises
    ------
    ApcError
        E203 the node is not a mapping.
    """
    if isinstance(node, Mapping):
        return node
    raise fault("E203", node.location, subject, "a mapping of keys to values", form(node), fix)


def text_of(node: Node, subject: str, fix: str = "") -> str:
    """Return the text of a scalar that is not empty; arguments and error as for `mapping_of`."""
    if isinstance(node, Scalar) and node.text.strip() and node.value is not None:
        return node.text
    raise fault("E203", node.location, subject, "a single value", form(node), fix)


def value_of(node: Node, key: str, example: str) -> str:
    """Return the text of the value of a key, as `text_of`.

    The fix has the values of a list or mapping that was written instead, else the example.
    """
    values = list(dict.fromkeys(_texts_in(node))) or [example]
    pasted = f'"{key}"' if "[" in key else key  # a bracket ends a name within braces
    fix = ", or ".join(f"{pasted}: {value}" for value in values) if len(values) <= MOST_OFFERED else ""
    return text_of(node, key, fix)


def _texts_in(node: Node) -> list[str]:
    """Return the texts of the scalars directly in a list or mapping that are not empty."""
    if isinstance(node, Scalar):
        return []
    items = node.items if isinstance(node, Sequence) else [value for _, value in node.entries]
    return [item.text for item in items if isinstance(item, Scalar) and item.text.strip()]


def list_of(node: Node, subject: str, size: int, item: str, key: str | None = None) -> tuple[Node, ...]:
    """Return the items of a list node with `size` items.

    Parameters
    ----------
    node, subject
        The node, and its name in messages.
    size
        The required number of items.
    item
        An example of an item, for the message.
    key
        The key of the value in the fix, by default the subject; with an empty key there is no fix.

    Raises
    ------
    ApcError
        E203 another node. The fix adds zeros, or repeats the last value, or omits values that are too many.
    """
    if isinstance(node, Sequence) and len(node.items) == size:
        return node.items
    got = f"a list of {len(node.items)}" if isinstance(node, Sequence) else form(node)
    texts = [node.text] if isinstance(node, Scalar) and node.text.strip() else _texts_in(node)
    if isinstance(node, Mapping) or not texts:
        texts = [item]
    zero, found = _NUMBER.subn("0", texts[-1], count=1)
    fillers = dict.fromkeys([zero, texts[-1]] if found and not isinstance(node, Mapping) else texts[-1:])
    lists = (f"[{', '.join((texts + [filler] * size)[:size])}]" for filler in fillers)
    key = subject if key is None else key
    fix = ", or ".join(f"{key}: {text}" for text in dict.fromkeys(lists)) if key else ""
    raise fault("E203", node.location, subject, f"a list of {size} values", got, fix)


def whole_number(node: Node) -> int | None:
    """Return the integer value of a scalar; None for other nodes, such as `true` or a quoted number."""
    value = node.value if isinstance(node, Scalar) else None
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def name_of(key: Scalar, subject: str, used: dict[str, str] | None = None, words: Container[str] = ()) -> str:
    """Return the text of a scalar that is a valid name: a letter, then letters, digits and underscores.

    Parameters
    ----------
    key, subject
        The scalar, and the noun for the named item, for the message.
    used
        The names that are already used, with their `use`.
    words
        The reserved words of the language.

    Raises
    ------
    ApcError
        E205 the text is not a valid name, or is already used.
    """
    name = key.text
    if not IDENTIFIER.match(name):
        expected = "a letter, then letters, digits or _ (at most 63)"
        raise fault("E205", key.location, f"name of {subject}", expected, brief(name) or "nothing")
    if name in words:
        raise fault("E205", key.location, f"{name} is a reserved word and can't be a name")
    if used and name in used:
        raise fault("E205", key.location, f"{name} is already the name of {used[name]}")
    return name


def first_use(kind: str, location: SourceLocation) -> str:
    """Return what a name is used for, for the message about its second use: `a clock, in line 4`."""
    return f"{kind}, in line {location.line}" if location.line else kind


# Keys of the language before version 0.2, and their names since.
RENAMED = {"about": "description", "above": "exclusive_min"}


class MappingReader:
    """A mapping that is read key by key; an invalid value is recorded and read as missing.

    An invalid key is recorded, with the nearest valid key, and its value is read as the value of the nearest
    key, so that a misspelled key is not reported a second time as a missing one.
    """

    def __init__(self, node: Mapping, allowed: Collection[str], subject: str, mistakes: Mistakes) -> None:
        """Read the keys of a mapping; invalid keys (not in `allowed`) are recorded (E202)."""
        self.location = node.location
        self.mistakes = mistakes
        self.nodes = {key.text: value for key, value in node.entries}
        for key, value in node.entries:
            if key.text not in allowed:
                if (renamed := RENAMED.get(key.text, "")) in allowed:
                    text = f"unknown key {key.text} in {subject}; its present name is {renamed}"
                    mistakes.take(fault("E202", key.location, text, fix=renamed))
                    self.nodes.setdefault(renamed, value)
                    continue
                unused = [
                    known for known in allowed if known not in self.nodes
                ]  # keys present in the mapping are not misspelled
                close = nearest(key.text, unused)
                text = f"unknown key {named(key.text)} in {subject}"
                mistakes.take(unknown("E202", key.location, text, close, [close] if close else allowed))
                if close:
                    self.nodes.setdefault(close, value)

    def read(self, key: str, reader: Callable[[Node, str], T], default: D) -> T | D:
        """Return the result of a reader for the value of a key, else `default`.

        The reader also gets the key.
        """
        if (node := self.nodes.get(key)) is not None:
            with self.mistakes:
                return reader(node, key)
        return default

    def text(self, key: str, fix: str = "") -> str:
        """Return the text of a key, empty if there is none."""
        return self.read(key, lambda node, _: text_of(node, key, fix), "")

    def section(self, key: str, fix: str) -> tuple[tuple[Scalar, Node], ...]:
        """Return the entries of the mapping of a key, empty if missing or invalid; `fix` is for messages."""
        return self.read(key, lambda node, _: mapping_of(node, key, f"{key}: {fix}").entries, ())

    def each(self, key: str, fix: str, reader: Callable[[Scalar, Node], T]) -> list[T]:
        """Return the results of a reader for the entries of a section.

        Invalid entries are recorded and omitted.
        """
        result = []
        for name, node in self.section(key, fix):
            with self.mistakes:
                result.append(reader(name, node))
        return result


def unknown(
    code: str, location: SourceLocation, subject: str, name: str, texts: Collection[str], prefix: str = ""
) -> ApcError:
    """Return the error for an unknown name, with the nearest known name, or with a list of known names.

    Parameters
    ----------
    code, location, subject
        The code and location of the error, and the start of its message.
    name
        The name as written.
    texts
        The known names.
    prefix
        The text before a name in the fix.
    """
    close = nearest(name, texts)
    if len(equal := equally_near(name, close, texts)) > 1:
        return fault(code, location, subject, fix=", or ".join(prefix + text for text in equal))
    if close:
        return fault(code, location, f"{subject}; the nearest is {close}", fix=prefix + close)
    listed = ", ".join(list(texts)[:12]) + (", …" if len(texts) > 12 else "")
    return fault(
        code, location, f"{subject}; available: {listed}" if listed else f"{subject}; none is defined"
    )


def among(
    name: str, texts: Collection[str], location: SourceLocation, subject: str, code: str = "E206"
) -> str:
    """Return a name if it is a known name.

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
    raise unknown(code, location, subject.replace("{}", named(name)), name, texts)
