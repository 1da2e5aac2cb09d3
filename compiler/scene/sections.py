"""The sections of a topology that list parts: masses, couplers, links and hands.

Takes: their nodes. Gives: `PartSections`: the entries, the component each is of, and what can't be read.
Guarantees: a name is used once in a topology; what is missing or faulty is reported here, once.
Does not: read what an entry says beyond its type and count (see `instances`).
"""

from __future__ import annotations

import re
from collections.abc import Collection

from apc.compiler.components.definitions import read_type
from apc.compiler.components.library import Library
from apc.compiler.components.parts import Scope, read_count
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.scene.instances import PartEntry
from apc.compiler.scene.named_numbers import NamedNumbers, read_new_name
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import entries, read_mapping

SECTIONS = ("masses", "couplers", "links", "hands")
DEFAULT_TYPES = {"masses": "Mass", "links": "Link"}
_EXAMPLES = {
    "masses": "device: {mass: 0.1 kg}",
    "links": "lan: {clock: network}",
    "couplers": "contact: {type: SampledSpringDamper}",
    "hands": "hand: {type: ConstantForce}",
}
_TYPE_EXAMPLES = {"couplers": "SampledSpringDamper", "hands": "ConstantForce"}


class PartSections:
    """The parts of a topology, before their entries are read.

    `entries` are those of a known component; `faulty` names parts that are there and can't be read;
    `complete` is False when a whole section is missing or is none. All of that was reported.
    """

    def __init__(self, root: Mapping, library: Library, taken: Collection[str], mistakes: Mistakes) -> None:
        self.root = root
        self.library = library
        self.taken = {*taken}
        self.mistakes = mistakes
        self.entries: dict[str, PartEntry] = {}
        self.faulty: set[str] = set()
        self.complete = True
        for section in SECTIONS:
            node = root.get(section)
            self._read(section, node)
            required = section == "masses"
            self.complete &= isinstance(node, Mapping) or (node is None and not required)

    def _read(self, section: str, node: Node | None) -> None:
        """Collect the parts of a section and their components, so that names can be resolved."""
        mistakes = self.mistakes
        hint = f"{section}: {{{_EXAMPLES[section]}}}"
        for key, value in entries(read_mapping(node, section, mistakes, hint=hint)):
            name = read_new_name(key, f"a part of {section}", self.taken, mistakes)
            body = read_mapping(value, key.text, mistakes, hint=_EXAMPLES[section])
            if key.text not in self.entries:
                self.faulty.add(key.text)  # until it has been read
            if name is None or body is None:
                continue
            default = DEFAULT_TYPES.get(section)
            typed = default is not None or body.get("type") is not None
            example = _TYPE_EXAMPLES.get(section, "Mass") if typed else self._example(section, body)
            component = read_type(key, body, default, self.library, mistakes, example=example)
            if component is not None:
                count = read_count(name, body, mistakes, single=section == "links")
                self.entries[name] = PartEntry(section, body, component, key.place, count)
                self.taken.add(name)
                self.faulty.discard(name)

    def _words(self) -> set[str]:
        """Return every word that an entry says."""
        return {
            value.text
            for entry in self.entries.values()
            for _, value in entry.body.entries
            if isinstance(value, Scalar)
        }

    def _example(self, section: str, body: Mapping) -> str:
        """Return a type to propose for an entry without one: with its keys, and as few others as can be."""
        keys = {key.text for key, _ in body.entries} - {"at", "shared", "count"}
        usual = _TYPE_EXAMPLES.get(section, "Mass")
        fitting = []
        for name in dict.fromkeys((usual, *self.library.component_names)):
            try:
                component = self.library.component(name)
            except ApcError:
                continue  # told where it is asked for
            if component is None:
                continue
            connectors = {connector for connector, _ in component.connectors}
            known = connectors | {one.name for one in (*component.parameters, *component.variables)}
            if known >= keys and (section != "hands" or connectors == {"flange"}):
                fitting.append((name != usual, len(known), name))
        return min(fitting)[-1] if fitting else usual

    def is_reported(self, name: str) -> bool:
        """Return whether `part.parameter` is of a part that is missing for a fault that was reported."""
        part = re.split(r"[.\[]", name)[0]
        return part in self.faulty or (not self.complete and part not in self.entries)

    def is_of_link(self, name: str) -> bool:
        """Return whether `part.parameter` is of a link."""
        entry = self.entries.get(name.partition(".")[0])
        return entry is not None and entry.section == "links"

    def scope(self, numbers: NamedNumbers, clocks: Collection[str]) -> Scope:
        """Return what the entries can refer to."""
        links = [name for name, entry in self.entries.items() if entry.section == "links"]

        def references(role: str, word: str, place: Place) -> Collection[str] | None:
            section = f"{role}s"
            node = self.root.get(section)
            if word and node is None:
                example = "clocks: {haptic: 1 ms}" if role == "clock" else "links: {lan: {clock: network}}"
                what = f"the topology has no {section} section"
                self.mistakes.add("E201", self.root.place, what, hint=example)
                return None
            known: Collection[str] = clocks if role == "clock" else links
            if not word:  # what to propose: first what nothing has named yet
                said = self._words()
                known = sorted(known, key=lambda name: name in said)
            reported = word not in known and not (isinstance(node, Mapping) and node.get(word) is None)
            return None if reported else known

        return Scope(
            dimension=numbers.dimension,
            names=numbers.names,
            references=references,
            parts={name: entry.component for name, entry in self.entries.items()},
            counts={name: entry.count for name, entry in self.entries.items() if entry.count is not None},
            faulty=self.faulty,
            whole="this topology",
            complete=self.complete,
        )
