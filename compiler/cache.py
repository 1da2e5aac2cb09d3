"""Check whether a compiled model on disk is up to date with its texts.

Takes: the path of a NAME.apc. Gives: `Origin`, the sources of a model, `origin_of`, `replayable`;
`Archive`, the parts of a file, `packed`, `read_archive`; `changed`, the first text that differs now;
`builtin_files`, `program_digest`.
Guarantees: the decision is by content only, without modification times or algebra imports. A model is passed
on unparsed, and only a valid signature marks it as this user's.
Does not: compile, or read the model itself (see `store`).

The name of a text is its reference in the topology:

    topology.yaml         the topology, in the model's folder
    ./users.csv        a table that it names, relative to the topology's folder
    ./parts/           a folder of the user's components: its file names, one per line
    ./parts/tie.yaml   a file in this folder
    Mass               a definition of the built-in library

The file has four lines: `apc`, the format, and whether the model is as compiled ("compiled") or may have been
changed since ("saved"); the signature of the rest and its SHA-256 against damage in transfer; the origin as
JSON; the model.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

import msgspec

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, listing, read_file
from apc.compiler.signing import is_sealed, seal
from apc.compiler.source.reading import fault

FORMAT = 16  # of NAME.apc
LARGEST = 256 * 2**20  # bytes of the file
LARGEST_ORIGIN = 64 * 2**20  # bytes of its third line, each of which takes up to ten of memory
SUFFIX = ".yaml"  # of the files in a folder of components
HANDS_CHANGE = "hands"  # replaces the parameter name if hands were attached to devices
_RATIONAL = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{,4000})?")
FOREIGN = "is damaged: it is not what apc compile writes"


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of a model: its texts.

    `texts` are the topology, whose name is `topology`, and all it needs, in bytes by name; `program` is the
    digest of what compiled them. `changes` were made afterwards, each at once: names of numbers with values
    in SI, or `HANDS_CHANGE` and which hands (see `frame.devices`).
    """

    topology: str
    texts: tuple[tuple[str, bytes], ...] = ()
    program: str = ""
    changes: tuple[tuple[tuple[str, str], ...], ...] = ()

    @property
    def digests(self) -> tuple[tuple[str, str], ...]:
        """The SHA-256 of every text, and of the program, by name."""
        texts = ((name, hashlib.sha256(text).hexdigest()) for name, text in self.texts)
        return (*texts, ("apc", self.program))

    def after(self, *change: tuple[str, str]) -> Origin:
        """Return the origin of a model that is changed once more."""
        return replace(self, changes=(*self.changes, change))


@dataclass(frozen=True, slots=True)
class Archive:
    """A model's file in its parts; `sealed` if this user wrote it, `compiled` if it is as it was compiled."""

    origin: Origin
    model: bytes
    sealed: bool
    compiled: bool


def packed(origin: Origin, model: bytes, *, compiled: bool) -> bytes:
    """Return the content of a model's file, under this user's seal."""
    head = f"apc {FORMAT} {'compiled' if compiled else 'saved'}".encode()
    try:
        body = msgspec.json.encode(origin) + b"\n" + model
    except UnicodeEncodeError:
        message = "the name of a file that it is compiled from is not valid UTF-8"
        raise ApcError(Diagnostic("E601", SourceLocation(origin.topology), message)) from None
    whole = head + b"\n" + body
    mark = f"{seal(whole)} {hashlib.sha256(whole).hexdigest()}"
    return b"\n".join((head, mark.encode(), body))


def read_archive(path: Path) -> Archive:
    """Split a model's file into its parts.

    Raises
    ------
    ApcError
        E602 it can't be read, E603 it is of another format, E604 it is damaged.
    """
    location = SourceLocation(str(path))
    try:
        data = read_file(path, LARGEST)
    except RefusedError as refused:
        hint = "apc compile" if refused.why == "missing" else ""
        other = ", not a compiled model" if refused.why in ("folder", "special") else ""
        raise fault("E602", location, f"{refused.words}{other}", hint=hint) from None
    topology = path.with_suffix(SUFFIX)
    hint = f"apc compile {topology}" if topology.exists() else "the file once more, from whoever made it"
    head, mark, origin, model = (*data.split(b"\n", 3), b"", b"", b"")[:4]
    form = re.fullmatch(rb"apc ([0-9]{1,6}) (compiled|saved)", head)
    if form and int(form[1]) != FORMAT:
        message = f"has format version {int(form[1])}, this program reads version {FORMAT}"
        raise fault("E603", location, message, hint=hint)
    whole = b"\n".join((head, origin, model))
    sealed, _, checksum = mark.decode("latin-1").partition(" ")
    try:
        if form is None or len(origin) > LARGEST_ORIGIN or checksum != hashlib.sha256(whole).hexdigest():
            raise ValueError
        made_from = msgspec.json.decode(origin, type=Origin)
        name = made_from.topology
        if name in ("", "..") or PurePath(name).name != name or name not in dict(made_from.texts):
            raise ValueError
        numbers = (pair for change in made_from.changes for pair in change)
        if not all(name == HANDS_CHANGE or _RATIONAL.fullmatch(value) for name, value in numbers):
            raise ValueError
    except (ValueError, RecursionError):  # nested too deeply
        raise fault("E604", location, FOREIGN, hint=hint) from None
    return Archive(made_from, model, is_sealed(whole, sealed), form[2] == b"compiled")


def changed(archive: Archive, folder: Path) -> str:
    """Return the name of the first changed text, in words; empty if none.

    An unsigned file could reference any path of the machine: only its topology is read.

    Parameters
    ----------
    archive
        A model's file.
    folder
        The folder of its topology.
    """
    for name, text in archive.origin.texts:
        path = builtin_files().get(name)
        if (archive.sealed or name == archive.origin.topology) and _now(path or folder / name, name) != text:
            return f"the library's {name}" if path else name.removeprefix("./")
    return ""


def _now(path: Path, name: str) -> bytes | None:
    """Return the present content of a text, None if it cannot be read."""
    try:
        if name.endswith("/"):
            return listing(path, SUFFIX)
        return read_file(path, LARGEST)
    except (RefusedError, ValueError):  # ValueError: a name that is no text
        return None


def origin_of(topology: Path, read: Mapping[str, bytes]) -> Origin:
    """Return the origin of a model.

    Parameters
    ----------
    topology
        Its file.
    read
        The files recorded by `files.recorded`.
    """
    names = {str(path): name for name, path in builtin_files().items()} | {str(topology): topology.name}
    texts = {names.get(path) or _name(path, topology.parent): text for path, text in read.items()}
    return Origin(topology.name, tuple(sorted(texts.items())), program_digest())


def _name(path: str, folder: Path) -> str:
    """Return a file's name from the topology's folder, with a slash at its end for a folder."""
    plain = PurePath(path)
    if not plain.is_relative_to(folder):
        return path
    return f"./{plain.relative_to(folder).as_posix()}{'/' * path.endswith('/')}"


def replayable(origin: Origin, folder: Path) -> dict[str, bytes]:
    """Return a model's texts, and the built-in library, by the paths where `files.replayed` looks for them.

    Parameters
    ----------
    origin
        The origin of the model.
    folder
        The expected folder of its topology.
    """
    builtin = builtin_files()
    texts = {str(path): path.read_bytes() for path in builtin.values()}
    for name, text in origin.texts:
        path = os.path.abspath(builtin.get(name, folder / name))  # noqa: PTH100 -- Path keeps what is above
        texts[path + "/" * name.endswith("/")] = text
    return texts


@functools.cache
def builtin_files() -> dict[str, Path]:
    """Return the built-in library's files by the name of their definition, the file name in camel case."""
    # In the compiler's folder, both in a checkout and in an installed package.
    models = Path(__file__).resolve().parent.parent / "models"
    return {
        "".join(word.capitalize() for word in path.stem.split("-")): path
        for path in sorted(models.rglob("*.yaml"))
        if "topologies" not in path.relative_to(models).parts
    }


@functools.cache
def program_digest() -> str:
    """Return the SHA-256 of the compiler: all of its source texts, and the version of CasADi."""
    compiler = Path(__file__).resolve().parent
    whole = hashlib.sha256(importlib.metadata.version("casadi").encode())
    for path in sorted(path for path in compiler.rglob("*") if path.suffix in (".py", ".lark", ".txt")):
        whole.update(f"\0{path.relative_to(compiler)}\0".encode() + path.read_bytes())
    return whole.hexdigest()
