"""The component library: component and connector definitions by name, each read on its first use.

Takes: folders of YAML files. Gives: `Library`, `definition_of`.
Guarantees: a file is read at most once, and only if a topology needs it or it is in a user's folder; no two
files of a user define the same name.
Does not: interpret the contents of a definition (see `definitions`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from apc.compiler.cache import SUFFIX, builtin_files
from apc.compiler.components.component import Component, Connector
from apc.compiler.components.definitions import read_component, read_connector
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.files import FileReader, RefusedError, same_file
from apc.compiler.source.nodes import MAX_BYTES, Mapping, Scalar
from apc.compiler.source.reading import brief, fault
from apc.compiler.source.source import Source, read_source

T = TypeVar("T", Component, Connector)

LONGEST_CHAIN = 50  # nested components: each level uses several frames of Python's call stack


class Library:
    """The components and connector types by name, each read and checked on its first use.

    A user's component replaces the built-in component of the same name. In the built-in library the file of a
    component has its name in kebab case, so that only the required files are read. A user's file that can't
    be read raises ApcError; with the list `aside`, the error is added to this list.
    """

    def __init__(
        self,
        folders: tuple[Path, ...] = (),
        aside: list[ApcError] | None = None,
        reader: FileReader | None = None,
    ) -> None:
        self._reader = reader or FileReader()
        self._sources: dict[str, Source] = {}
        self._read: dict[str, Any] = {}  # components, connectors, or the error of an invalid definition
        self._open: list[str] = []  # the components being read, from outer to inner
        local: dict[str, Path] = {}
        for path in (path for folder in folders for path in self._reader.files_below(folder, SUFFIX)):
            try:
                source = _read_user_file(path, self._reader)
            except ApcError as error:
                if aside is None:
                    raise
                aside.append(error)
                continue
            if name := definition_of(source)[1]:
                if local.setdefault(name, path) != path and not same_file(local[name], path):
                    message = f"{brief(name)} is already defined in {local[name]}"
                    raise fault("E218", source.root.location, message, advice="rename one of the two")
                self._sources[name] = source
        self.files = builtin_files() | local  # by the name of the defined component or connector

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all components and connector types, sorted."""
        return tuple(sorted(self.files))

    @property
    def replaced(self) -> dict[str, Path]:
        """The files of a user's components that replace built-in components, by name."""
        built_in = builtin_files()
        return {name: path for name, path in self.files.items() if built_in.get(name, path) != path}

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of all components, sorted."""
        return tuple(name for name in self.names if definition_of(self._source(name))[0] == "component")

    def component(self, name: str) -> Component | None:
        """Return the component of a name, or None if there is none.

        Raises ApcError for an invalid definition.
        """
        return self._definition(name, "component", lambda source: read_component(source, self))

    def connector(self, name: str) -> Connector | None:
        """Return the connector type of a name, or None if there is none.

        Raises ApcError for an invalid definition.
        """
        return self._definition(name, "connector", read_connector)

    def _definition(self, name: str, kind: str, read: Callable[[Source], T]) -> T | None:
        """Return the definition of a name and kind, or None if there is none; it is read only once.

        Raises ApcError for an invalid definition, or for components that contain each other.
        """
        if name not in self.files or definition_of(source := self._source(name))[0] != kind:
            return None
        if name not in self._read:
            message = "components contain or extend"
            if name in self._open:
                chain = " → ".join([*self._open[self._open.index(name) :], name])
                raise fault("E212", source.root.location, f"{message} each other in a cycle: {chain}")
            if len(self._open) == LONGEST_CHAIN:
                message += f" one another more than {LONGEST_CHAIN} deep"
                raise fault("E212", source.root.location, message, advice="reduce the nesting of components")
            self._open.append(name)
            try:
                self._read[name] = read(source)
            except ApcError as error:
                self._read[name] = error
            self._open.pop()
        result: T | ApcError = self._read[name]
        if isinstance(result, ApcError):
            raise result
        return result

    def _source(self, name: str) -> Source:
        """Return the source of a definition, read on first use."""
        if name not in self._sources:
            path = self.files[name]
            self._sources[name] = read_source(path, self._reader, shown=path.name)
        return self._sources[name]


def _read_user_file(path: Path, reader: FileReader) -> Source:
    """Return the source of a file in a user's folder.

    The error for a file without a component or connector contains no text of the file.
    """
    try:
        return read_source(path, reader)
    except ApcError as error:
        text = b"component"  # the reason contains nothing of the file's text
        with suppress(RefusedError):
            text = reader.read(path, MAX_BYTES)
        if b"component" in text or b"connector" in text:
            raise
        message, expected = "a file of a library", "YAML that defines a component or connector"
        locations = [replace(mistake.location, source_line="") for mistake in error.mistakes]
        raise ApcError(Diagnostic("E219", location, message, expected) for location in locations) from None


def definition_of(source: Source) -> tuple[str, str]:
    """Return the kind of a definition ("component" or "connector") and its name.

    The result has two empty texts for other files.
    """
    if isinstance(source.root, Mapping) and source.root.get("topology") is None:
        for kind in ("component", "connector"):
            node = source.root.get(kind)
            if isinstance(node, Scalar):
                return kind, node.text
    return "", ""
