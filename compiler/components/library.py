"""The component library: which definitions there are, each read when it is first asked for.

Takes: folders of YAML files. Gives: `Library`.
Guarantees: a file is read at most once, and only if a scene needs it (or it lies in a user's own folder).
Does not: read what is in a definition (see `definitions`).
"""

from __future__ import annotations

from pathlib import Path

from apc.compiler.cache import builtin_files
from apc.compiler.components.component import Component, Connector
from apc.compiler.components.definitions import read_component, read_connector
from apc.compiler.errors import ApcError, Mistake
from apc.compiler.source.nodes import Mapping, Scalar
from apc.compiler.source.source import Source, parse_source, read_source


class Library:
    """Hands out components by name, each read and checked when it is first asked for.

    Folders are searched in order; the built-in library comes last. In the built-in library a component's
    file has its name in kebab case, so that a scene reads only the files it needs.
    """

    def __init__(self, folders: tuple[Path, ...] = ()) -> None:
        self._sources: dict[str, Source] = {}
        self._texts: dict[str, str] = {}
        self._components: dict[str, Component] = {}
        self._connectors: dict[str, Connector] = {}
        self._files: dict[str, Path] = dict(builtin_files())
        self._failed: dict[str, ApcError] = {}
        self._open: list[str] = []  # the components being read, each asked for by the one before
        for folder in folders:
            for path in sorted(folder.rglob("*.yaml")):
                source = read_source(path)
                name = _title(source)
                if name:
                    self._files[name] = path
                    self._sources[name] = source

    @property
    def names(self) -> tuple[str, ...]:
        """The names of everything that can be asked for."""
        return tuple(sorted(self._files))

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components among them."""
        return tuple(name for name in self.names if _is_definition(self._source(name), "component"))

    @property
    def texts(self) -> tuple[tuple[str, str], ...]:
        """The name and SHA-256 of each text handed out so far."""
        return tuple(sorted(self._texts.items()))

    def component(self, name: str) -> Component | None:
        """Return a component, or None if there is no such name. Raises ApcError if its text is at fault."""
        if name not in self._files:
            return None
        if name not in self._components:
            source = self._source(name)
            if not _is_definition(source, "component"):
                return None
            if name in self._open:
                chain = " → ".join([*self._open[self._open.index(name) :], name])
                what = f"components contain or extend each other: {chain}"
                raise ApcError(Mistake("E212", source.root.place, what))
            if name in self._failed:
                raise self._failed[name]  # read once, even if a hundred parts are of it
            self._open.append(name)
            try:
                self._components[name] = read_component(source, self)
            except ApcError as error:
                self._failed[name] = error
                raise
            finally:
                self._open.pop()
        return self._components[name]

    def connector(self, name: str) -> Connector | None:
        """Return a connector type, or None if there is no such name."""
        if name not in self._files:
            return None
        if name not in self._connectors:
            source = self._source(name)
            if not _is_definition(source, "connector"):
                return None
            self._connectors[name] = read_connector(source)
        return self._connectors[name]

    def _source(self, name: str) -> Source:
        if name not in self._sources:
            path = self._files[name]
            self._sources[name] = parse_source(path.read_bytes(), file=path.name, path=path)
        self._texts[name] = self._sources[name].digest
        return self._sources[name]


def _title(source: Source) -> str | None:
    if isinstance(source.root, Mapping):
        for kind in ("component", "connector"):
            node = source.root.get(kind)
            if isinstance(node, Scalar):
                return node.text
    return None


def _is_definition(source: Source, kind: str) -> bool:
    return isinstance(source.root, Mapping) and source.root.get(kind) is not None
