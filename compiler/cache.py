"""Check whether a compiled model on disk is up to date with its texts.

Takes: the path of a NAME.apc. Gives: `Origin`, the sources of a model, `origin_of`, `stored_contents`;
`Archive`, the parts of a file, `packed`, `read_archive`; `changed`, the first text that differs now;
`builtin_files`, `program_digest`.
Guarantees: the decision depends on contents only, not on modification times, and imports no algebra. A model
is not parsed here; only a valid signature identifies it as this user's.
Does not: compile, or read the model itself (see `store`).

The name of a text is its reference in the topology:

    topology.yaml         the topology, in the model's folder
    ./users.csv        a table that it names, relative to the topology's folder
    ./parts/           a folder of the user's components: its file names, one per line
    ./parts/tie.yaml   a file in this folder
    Mass               a definition of the built-in library

The file has four lines: `apc`, the format, and whether the model is as compiled ("compiled") or may have been
changed since ("saved"); the signature and the SHA-256 of the other lines, against damage in transfer; the
origin as JSON; the model.
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

FORMAT = 20  # the format version of NAME.apc
LARGEST = 256 * 2**20  # bytes of the file
LARGEST_ORIGIN = 64 * 2**20  # bytes of the third line, which require up to ten times the memory
SUFFIX = ".yaml"  # of the files in a folder of components
WITHOUT_COMPONENTS = {"published", "topologies"}  # folders of models/ outside the component library
HANDS_CHANGE = "hands"  # replaces the parameter name if hands were attached to devices
EQUILIBRIUM_CHANGE = "equilibrium"  # replaces the parameter name if start values are those of an equilibrium
_RATIONAL = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{,4000})?")
FOREIGN = "is damaged, or was not written by apc compile"


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of a model: its source texts.

    `texts` are the topology, whose name is `topology`, and all referenced texts, as bytes by name; `program`
    is the digest of the compiler. `changes` were made to the compiled model in sequence: names of numbers
    with values in SI units, `HANDS_CHANGE` with the attached hands (see `lifting.devices`), or
    `EQUILIBRIUM_CHANGE` with the start of the search (see `lifting.rest_position`).
    """

    topology: str
    texts: tuple[tuple[str, bytes], ...] = ()
    program: str = ""
    changes: tuple[tuple[tuple[str, str], ...], ...] = ()

    @property
    def digests(self) -> tuple[tuple[str, str], ...]:
        """The SHA-256 of every text and of the compiler, by name."""
        texts = ((name, hashlib.sha256(text).hexdigest()) for name, text in self.texts)
        return (*texts, ("apc", self.program))

    def after(self, *change: tuple[str, str]) -> Origin:
        """Return the origin with one more change of the model."""
        return replace(self, changes=(*self.changes, change))


@dataclass(frozen=True, slots=True)
class Archive:
    """The parts of a model's file.

    `sealed` is whether this user wrote the file, `compiled` whether the model is unchanged since its
    compilation.
    """

    origin: Origin
    model: bytes
    sealed: bool
    compiled: bool


def packed(origin: Origin, model: bytes, *, compiled: bool) -> bytes:
    """Return the contents of a model's file, with the seal of this user."""
    head = f"apc {FORMAT} {'compiled' if compiled else 'saved'}".encode()
    try:
        body = msgspec.json.encode(origin) + b"\n" + model
    except UnicodeEncodeError:
        message = "the name of a source file is not valid UTF-8"
        raise ApcError(Diagnostic("E601", SourceLocation(origin.topology), message)) from None
    whole = head + b"\n" + body
    seal_line = f"{seal(whole)} {hashlib.sha256(whole).hexdigest()}"
    return b"\n".join((head, seal_line.encode(), body))


def read_archive(path: Path) -> Archive:
    """Return the parts of a model's file.

    Raises
    ------
    ApcError
        E602 the file cannot be read, E603 another format version, E604 a damaged file.
    """
    location = SourceLocation(str(path))
    try:
        data = read_file(path, LARGEST)
    except RefusedError as refused:
        fix = "apc compile" if refused.why == "missing" else ""
        other = ", not a compiled model" if refused.why in ("folder", "special") else ""
        raise fault("E602", location, f"{refused.words}{other}", fix=fix) from None
    topology = path.with_suffix(SUFFIX)
    fix = f"apc compile {topology}" if topology.exists() else ""
    advice = "" if fix else "obtain the file again from its author"
    head, seal_line, origin, model = (*data.split(b"\n", 3), b"", b"", b"")[:4]
    form = re.fullmatch(rb"apc ([0-9]{1,6}) (compiled|saved)", head)
    if form and int(form[1]) != FORMAT:
        message = f"has format version {int(form[1])}, this program reads version {FORMAT}"
        raise fault("E603", location, message, fix=fix, advice=advice)
    content = b"\n".join((head, origin, model))
    sealed, _, checksum = seal_line.decode("latin-1").partition(" ")
    try:
        if form is None or len(origin) > LARGEST_ORIGIN or checksum != hashlib.sha256(content).hexdigest():
            raise ValueError
        model_origin = msgspec.json.decode(origin, type=Origin)
        name = model_origin.topology
        if name in ("", "..") or PurePath(name).name != name or name not in dict(model_origin.texts):
            raise ValueError
        numbers = (pair for change in model_origin.changes for pair in change)
        if not all(
            name in (HANDS_CHANGE, EQUILIBRIUM_CHANGE) or _RATIONAL.fullmatch(value)
            for name, value in numbers
        ):
            raise ValueError
    except (ValueError, RecursionError):  # nested too deeply
        raise fault("E604", location, FOREIGN, fix=fix, advice=advice) from None
    return Archive(model_origin, model, is_sealed(content, sealed), form[2] == b"compiled")


def changed(archive: Archive, folder: Path) -> str:
    """Return the text for the first source of a model that has changed, empty if none has.

    Only the topology of an unsigned file is compared: the file could refer to any path of the machine.

    Parameters
    ----------
    archive
        The model's file.
    folder
        The folder of the topology.
    """
    for name, text in archive.origin.texts:
        path = builtin_files().get(name)
        if (archive.sealed or name == archive.origin.topology) and _current_content(
            path or folder / name, name
        ) != text:
            return f"the library's {name}" if path else name.removeprefix("./")
    return ""


def _current_content(path: Path, name: str) -> bytes | None:
    """Return the present content of a source, None if it cannot be read."""
    try:
        if name.endswith("/"):
            return listing(path, SUFFIX)
        return read_file(path, LARGEST)
    except (RefusedError, ValueError):  # ValueError: an invalid name
        return None


def origin_of(topology: Path, read: Mapping[str, bytes]) -> Origin:
    """Return the origin of a model from the files read by the compiler.

    Parameters
    ----------
    topology
        The file of the topology.
    read
        The contents of the files by path, from `FileReader`.
    """
    names = {str(path): name for name, path in builtin_files().items()} | {str(topology): topology.name}
    texts = {names.get(path) or _relative_name(path, topology.parent): text for path, text in read.items()}
    return Origin(topology.name, tuple(sorted(texts.items())), program_digest())


def _relative_name(path: str, folder: Path) -> str:
    """Return the name of a file relative to the topology's folder; a folder ends with a slash."""
    plain = PurePath(path)
    if not plain.is_relative_to(folder):
        return path
    return f"./{plain.relative_to(folder).as_posix()}{'/' * path.endswith('/')}"


def stored_contents(origin: Origin, folder: Path) -> dict[str, bytes]:
    """Return the texts of a model and of the built-in library by absolute path, for `FileReader`.

    Parameters
    ----------
    origin
        The origin of the model.
    folder
        The folder assumed for the topology.
    """
    builtin = builtin_files()
    texts = {str(path): path.read_bytes() for path in builtin.values()}
    for name, text in origin.texts:
        path = os.path.abspath(builtin.get(name, folder / name))  # noqa: PTH100 -- Path keeps what is above
        texts[path + "/" * name.endswith("/")] = text
    return texts


@functools.cache
def builtin_files() -> dict[str, Path]:
    """Return the files of the built-in library by definition name, the file name in camel case."""
    # In the compiler's folder, both in a checkout and in an installed package.
    models = Path(__file__).resolve().parent.parent / "models"
    return {
        "".join(word.capitalize() for word in path.stem.split("-")): path
        for path in sorted(models.rglob("*.yaml"))
        if not WITHOUT_COMPONENTS.intersection(path.relative_to(models).parts)
    }


@functools.cache
def program_digest() -> str:
    """Return the SHA-256 of the compiler: its source texts and the version of CasADi."""
    compiler = Path(__file__).resolve().parent
    digest = hashlib.sha256(importlib.metadata.version("casadi").encode())
    for path in sorted(path for path in compiler.rglob("*") if path.suffix in (".py", ".lark", ".txt")):
        digest.update(f"\0{path.relative_to(compiler)}\0".encode() + path.read_bytes())
    return digest.hexdigest()
