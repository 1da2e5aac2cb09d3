"""What a topology may say and seldom means: a link nobody uses, a mass joined to nothing, lone copies.

Takes: parts and links as they were read. Gives: `oddities`, the warnings; `warning_texts`.
Guarantees: nothing here is a mistake: the scene is compiled as it stands; each warning has its place.
Does not: look into equations, or decide what was meant.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from apc.compiler.components.parts import GROUND, PartEntry
from apc.compiler.errors import Mistake, Place
from apc.compiler.scene.instances import Part

# Of each part, those it is joined to, by any number of others too, and itself.
Joined = Mapping[str, frozenset[str]]


def oddities(
    parts: Sequence[Part],
    entries: Mapping[str, PartEntry],
    counts: Mapping[str, int],
    set_by_groups: Collection[str],
) -> tuple[Mistake, ...]:
    """Return the warnings about a scene, in the order of its file.

    Parameters
    ----------
    parts
        The parts of a peer, links too, those inside parts among them.
    entries
        The entries of the topology.
    counts
        The groups, and how many peers each has.
    set_by_groups
        The whole names of what groups set for themselves.
    """
    outer = [part for part in parts if part.name.partition("[")[0] in entries and "." not in part.name]
    apart = {group: _joined(part for part in outer if group in part.groups) for group in counts}
    found = [
        *_idle_links(parts, entries),
        *_alone(outer, apart),
        *_copies(outer, apart, entries, counts, set_by_groups),
    ]
    return tuple(sorted(dict.fromkeys(found), key=lambda one: (one.place, one.code)))


def _joined(parts: Iterator[Part]) -> Joined:
    """Return what is joined to each part of one group, directly or by others; the ground joins nothing."""
    listed = list(parts)
    found = {part.name: {part.name} for part in listed}
    for part in listed:
        for _, other, _ in part.connections:
            if other != GROUND and other in found and found[other] is not found[part.name]:
                found[other] |= found[part.name]
                for name in found[other]:
                    found[name] = found[other]
    return {name: frozenset(together) for name, together in found.items()}


def _idle_links(parts: Sequence[Part], entries: Mapping[str, PartEntry]) -> Iterator[Mistake]:
    """Yield a warning for each link that no part names."""
    named = {word for part in parts for _, word in part.references}
    for name, entry in entries.items():
        if entry.section == "links" and name not in named:
            yield Mistake("W271", entry.place, f"nobody uses the link {name}")


def _alone(outer: Sequence[Part], apart: Mapping[str, Joined]) -> Iterator[Mistake]:
    """Yield a warning for each mass that nothing is joined to and that is joined to nothing."""
    for part in outer:
        groups = [group for group in part.groups if len(apart[group][part.name]) == 1]
        if part.section == "masses" and groups and part.component.connectors and not part.connections:
            where = "" if len(groups) == len(part.groups) else f" of {' and '.join(groups)}"
            what = f"{part.name}{where} is joined to nothing: no coupler, no hand and no other mass"
            yield Mistake("W272", part.place, what)


def _copies(
    outer: Sequence[Part],
    apart: Mapping[str, Joined],
    entries: Mapping[str, PartEntry],
    counts: Mapping[str, int],
    set_by_groups: Collection[str],
) -> Iterator[Mistake]:
    """Yield a warning for each copy that nothing couples, and for each coupled mass that may be meant as one.

    A mass is taken for a copy if a coupler follows the others by it alone, the same in all groups, and
    something else of the peer moves it too.
    """
    hearing = {part.name: part for part in outer if part.component.hears_others}
    for part in outer:
        if part.section != "masses":
            continue
        peers = sum(counts[group] for group in part.groups)
        if part.shared and peers > 1:
            if not any(apart[group][part.name] & hearing.keys() for group in part.groups):
                what = f"{part.name} is shared, and nothing couples its copies"
                yield Mistake("W273", part.place, what)
        elif peers > 1 and entries[part.name.partition("[")[0]].body.get("shared") is None:
            yield from _unshared(part, apart, hearing.values(), outer, set_by_groups)


def _unshared(
    part: Part,
    apart: Mapping[str, Joined],
    hearing: Collection[Part],
    outer: Sequence[Part],
    set_by_groups: Collection[str],
) -> Iterator[Mistake]:
    """Yield a warning for a mass that is taken for a copy, see `_copies`, and is not shared."""
    followed = [one for one in hearing if [other for _, other, _ in one.connections] == [part.name]]
    divided = [number.name for number in part.component.numbers if number.divided]
    divides = {f"{part.name}.{name}" for name in divided}
    divides |= {f"{one.name}.{name}" for one in followed for name, _ in one.options}
    masses = {one.name for one in outer if one.section == "masses"} - {part.name}
    touched = any(apart[group][part.name] & masses for group in part.groups)
    if followed and divided and touched and divides.isdisjoint(set_by_groups):
        what = (
            f"{part.name} follows the other peers' by {followed[0].name} and is not shared: its "
            f"{divided[0]} counts once a peer"
        )
        hint = "shared: true, or shared: false where each is a mass of its own"
        yield Mistake("W274", part.place, what, hint=hint)


def warning_texts(warnings: Collection[Mistake]) -> tuple[str, ...]:
    """Return warnings as texts, each with its place in the topology, whose folder is left out."""
    return tuple(
        f"{Place(one.place.file.rpartition('/')[2], one.place.line, one.place.column)}: "
        f"{one.code} {one.sentence}"
        for one in warnings
    )
