"""The component library: which definitions there are, each read when it is first asked for.

Takes: folders of YAML files. Gives: `Library`, `definition_of`.
Guarantees: a file is read at most once, and only if a topology needs it (or it lies in a user's own folder);
no two files of a user's define one name.
Does not: read what is in a definition (see `definitions`).
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
from apc.compiler.files import RefusedError, files_below, read_file, same_file
from apc.compiler.source.nodes import MAX_BYTES, Mapping, Scalar
from apc.compiler.source.reading import brief, fault
from apc.compiler.source.source import Source, read_source

T = TypeVar("T", Component, Connector)

LONGEST_CHAIN = 50  # of components that are read for one another, each by several calls of Python's stack


class Library:
    """Hands out components by name, each read and checked when it is first asked for.

    A user's component takes the place of the built-in one of its name. In the built-in library a component's
    file has its name in kebab case, so that a topology reads only the files it needs. A user's file that
    can't be read is a mistake; with `aside`, one that is put there.
    """

    def __init__(self, folders: tuple[Path, ...] = (), aside: list[ApcError] | None = None) -> None:
        self._sources: dict[str, Source] = {}
        self._read: dict[str, Any] = {}  # a component, a connector, or what is wrong with it
        self._open: list[str] = []  # the components being read, each asked for by the one before
        local: dict[str, Path] = {}
        for path in (path for folder in folders for path in files_below(folder, SUFFIX)):
            try:
                source = _read(path)
            except ApcError as error:
                if aside is None:
                    raise
                aside.append(error)
                continue
            if name := definition_of(source)[1]:
                if local.setdefault(name, path) != path and not same_file(local[name], path):
                    message = f"{brief(name)} is defined in {local[name]} already"
                    raise fault("E218", source.root.location, message, hint="another name in one of the two")
                self._sources[name] = source
        self.files = builtin_files() | local  # by the name of what each defines

    @property
    def names(self) -> tuple[str, ...]:
        """The names of everything that can be asked for."""
        return tuple(sorted(self.files))

    @property
    def replaced(self) -> dict[str, Path]:
        """The files of a user's components that take the place of built-in ones, by name."""
        built_in = builtin_files()
        return {name: path for name, path in self.files.items() if built_in.get(name, path) != path}

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components among them."""
        return tuple(name for name in self.names if definition_of(self._source(name))[0] == "component")

    def component(self, name: str) -> Component | None:
        """Return a component, or None if there is no such name. Raises ApcError if its text is at fault."""
        return self._definition(name, "component", lambda source: read_component(source, self))

    def connector(self, name: str) -> Connector | None:
        """Return a connector type as `component` does a component."""
        return self._definition(name, "connector", read_connector)

    def _definition(self, name: str, kind: str, read: Callable[[Source], T]) -> T | None:
        """Return the definition of a name and type, read once, even for a hundred parts."""
        if name not in self.files or definition_of(source := self._source(name))[0] != kind:
            return None
        if name not in self._read:
            message = "components contain or extend"
            if name in self._open:
                chain = " → ".join([*self._open[self._open.index(name) :], name])
                raise fault("E212", source.root.location, f"{message} each other: {chain}")
            if len(self._open) == LONGEST_CHAIN:
                message += f" one another more than {LONGEST_CHAIN} deep"
                raise fault("E212", source.root.location, message, hint="fewer of them in one another")
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
        if name not in self._sources:
            path = self.files[name]
            self._sources[name] = read_source(path, shown=path.name)
        return self._sources[name]


def _read(path: Path) -> Source:
    """Read a file of a user's folder; of an unrelated file no text is printed."""
    try:
        return read_source(path)
    except ApcError as error:
        text = b"component"  # the reason contains nothing of the file's text
        with suppress(RefusedError):
            text = read_file(path, MAX_BYTES)
        if b"component" in text or b"connector" in text:
            raise
        message, expected = "a file of a library", "YAML that defines a component or connector"
        locations = [replace(mistake.location, source_line="") for mistake in error.mistakes]
        raise ApcError(Diagnostic("E219", location, message, expected) for location in locations) from None


def definition_of(source: Source) -> tuple[str, str]:
    """Return the type of a definition (component or connector) and its name; two empty texts if neither."""
    if isinstance(source.root, Mapping) and source.root.get("topology") is None:
        for kind in ("component", "connector"):
            node = source.root.get(kind)
            if isinstance(node, Scalar):
                return kind, node.text
    return "", ""
