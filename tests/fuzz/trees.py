"""Documents as trees of text or of numbers, and one change at random to any of them.

Takes: YAML or JSON. Gives: `of_yaml`, `of_json`, `changed`, `as_yaml`, `as_json`.
Guarantees: what is written is read back as the tree that it was, double keys included, but for scalars that
`as_yaml` is asked to leave without quotation marks now and then.
"""

from __future__ import annotations

import copy
import functools
import json
import random
import re
from collections.abc import Callable
from typing import Any

import yaml

# A tree of YAML that can hold a key twice: mappings are lists of pairs in a `Pairs`.
Tree = Any
_PLAIN = re.compile(r"[\w./*+^()<=·µ-][\w ./*+^()<=·µ-]*\Z")


class Pairs(list[list[Any]]):
    """A mapping as (key, value) pairs, keys not necessarily different."""


class _Loader(yaml.BaseLoader):
    """Everything a string, mappings as `Pairs`."""


def _pairs(loader: _Loader, node: yaml.MappingNode) -> Pairs:
    return Pairs([[loader.construct_object(one, deep=True) for one in pair] for pair in node.value])


_Loader.add_constructor("tag:yaml.org,2002:map", _pairs)


@functools.cache
def _read(text: str) -> Tree:
    return yaml.load(text, Loader=_Loader)


def of_yaml(text: str) -> Tree:
    """Return a YAML text as a tree that can be changed."""
    return copy.deepcopy(_read(text))


def of_json(text: str | bytes) -> Tree:
    """Return a JSON text as a tree that can be changed."""
    return json.loads(text, object_pairs_hook=lambda pairs: Pairs([list(pair) for pair in pairs]))


def spots(tree: Tree) -> list[tuple[Any, int]]:
    """Return every (collection, index) of a tree."""
    places: list[tuple[Any, int]] = []
    waiting: list[Tree] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, list):
            places += [(node, at) for at in range(len(node))]
            waiting += [item[1] for item in node] if isinstance(node, Pairs) else node
    return places


def changed(
    tree: Tree, rng: random.Random, donor: Tree, *, value: Callable[[], Tree], key: Callable[[], str]
) -> None:
    """Change a tree in place, once.

    Parameters
    ----------
    tree
        What is changed.
    rng
        The luck of it.
    donor
        A tree from which a part may come.
    value, key
        Make what may be put in.
    """
    places = spots(tree)
    if not places:
        return
    node, at = rng.choice(places)
    named = isinstance(node, Pairs)
    match rng.randrange(9):
        case 0:
            del node[at]
        case 1:
            node.insert(rng.randrange(len(node) + 1), copy.deepcopy(node[at]))
        case 2:  # moved
            target, _ = rng.choice(places)
            if isinstance(target, Pairs) == named:
                target.append(copy.deepcopy(node[at]))
                if target is not node:
                    del node[at]
        case 3 if named:
            node[at][0] = rng.choice([key(), str(node[at][0])[:-1], f"{node[at][0]}s"])
        case 4 if named:
            node.append([key(), value()])
        case 5:
            other, there = rng.choice(spots(donor))
            if isinstance(other, Pairs) == named:
                node[at] = copy.deepcopy(other[there])
        case _:
            holder, place = (node[at], 1) if named else (node, at)
            old = holder[place]
            numbers = [old + 1, -old, old * 1000] if type(old) in (int, float) else []
            holder[place] = rng.choice(numbers) if numbers and rng.random() < 0.5 else value()


def as_yaml(tree: Tree, rng: random.Random | None = None) -> str:
    """Return a tree as YAML, a line a top key, scalars plain where YAML allows, and sometimes where not."""

    def scalar(value: Any) -> str:
        text = str(value)
        plain = _PLAIN.match(text) and text == text.strip()
        if plain or (rng is not None and rng.random() < 0.05):
            return text
        return json.dumps(text, ensure_ascii=False)

    if isinstance(tree, Pairs):
        return "".join(f"{scalar(key)}: {_flow(value, scalar)}\n" for key, value in tree)
    return f"{_flow(tree, scalar)}\n"


def as_json(tree: Tree) -> str:
    """Return a tree as JSON."""
    return _flow(tree, json.dumps)


def _flow(tree: Tree, scalar: Callable[[Any], str]) -> str:
    if isinstance(tree, Pairs):
        return f"{{{', '.join(f'{scalar(key)}: {_flow(value, scalar)}' for key, value in tree)}}}"
    if isinstance(tree, list):
        return f"[{', '.join(_flow(item, scalar) for item in tree)}]"
    return scalar(tree)
