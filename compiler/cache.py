"""Whether a compiled model on disk is still what its texts compile to.

Takes: the path of a NAME.apc. Gives: `read_archive`, its document and arrays as they are; `Record`, what it
was made from, and `changed`, the first of it that is different now.
Guarantees: decided by content alone: no modification time, nothing unpickled, no algebra imported; nothing is
unpacked that is larger than a model; a file that is damaged or of another format has no record.
Does not: compile, or read what a model holds (see `store`).

What a model was made from, by name:

    scene.yaml      the topology, beside the model
    ./users.csv     a table the topology names, from the topology's folder
    ./parts/        a folder of the user's own components: all definitions in it
    Mass            a definition of the built-in library
    apc             the compiler itself: all its modules
    casadi          the library that writes the functions, by its version
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import io
import json
import lzma
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from apc.compiler.files import RefusedError, files_below, read_file
from apc.compiler.seal import is_sealed

FORMAT = 12  # of NAME.apc
MEMBER = "model.json"  # of the archive: structure, numbers and the digests of the other members
FIELDS = {"format", "system", "members"}  # of the document
SEAL = "seal"  # of the archive: who wrote the document, see `seal`
LARGEST = 256 * 2**20  # bytes of the file, and of all members
MOST_LISTED = 2**22  # bytes of the archive's list of members: each takes ten times that of memory
MOST_VALUES = 2**22  # in the document: each takes up to a hundred bytes of memory
SUFFIX = ".yaml"  # of the files in a folder of components
PROGRAM = "apc"
LIBRARIES = ("casadi",)  # a newer one may write other functions
# What zipfile, its decompressors, json and our own reading of the document raise at what isn't theirs.
DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, NotImplementedError),
    *(AttributeError, KeyError, IndexError, ValueError, TypeError, RuntimeError, ArithmeticError),
)


@dataclass(frozen=True, slots=True)
class Record:
    """What a model says it was made from: its topology's name, and the digest of every text by name."""

    topology: str
    texts: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Archive:
    """A model's file, unpacked: its JSON, the bytes of its arrays by name, and whether this user wrote it."""

    document: Any
    members: dict[str, bytes]
    sealed: bool


class DamageError(ValueError):
    """What is wrong with a file, for a person."""


def read_archive(path: Path) -> Archive:
    """Unpack a compiled model.

    Raises
    ------
    RefusedError
        The file can't be read.
    DamageError
        It unpacks to more than a model can be, or a member was changed.
    ValueError
        Or another of DAMAGE: it is none. A document of another format is returned without members.
    """
    members = unzipped(read_file(path, LARGEST), LARGEST)
    text = members.pop(MEMBER)
    found = members.pop(SEAL, b"").decode()
    if sum(map(text.count, (b"[", b"{", b","))) > MOST_VALUES:
        raise DamageError(f"it holds more than {MOST_VALUES} values")
    document = json.loads(text)
    if document["format"] != FORMAT:
        return Archive(document, {}, sealed=False)
    if members.keys() != document["members"].keys() or document.keys() != FIELDS:
        raise ValueError("it holds what nothing names")
    for name, digest in document["members"].items():
        if hashlib.sha256(members[name]).hexdigest() != digest:
            raise DamageError(f"its member {name} was changed")
    return Archive(document, members, is_sealed(text, found))


def unzipped(data: bytes, most: int, names: re.Pattern[str] | None = None) -> dict[str, bytes]:
    """Return the members of a ZIP archive.

    Parameters
    ----------
    data
        The archive.
    most
        How many bytes all of them may have.
    names
        What each must be called.

    Raises
    ------
    DamageError
        It unpacks to more, or a member is called otherwise.
    ValueError
        Or another of DAMAGE: it is none, or holds a name twice.
    """
    _check_end(data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        listed = archive.infolist()
        if any(one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for one in listed):
            raise ValueError("it is packed otherwise")
        if sum(one.file_size for one in listed) > most:
            raise DamageError(f"it unpacks to more than {most >> 20} MiB")
        if names is not None and not all(names.fullmatch(one.filename) for one in listed):
            raise DamageError("it holds what does not belong there")
        if len({one.filename for one in listed}) < len(listed):
            raise ValueError("it holds a name twice")
        return {one.filename: _member(archive, one) for one in listed}


def _check_end(data: bytes) -> None:
    """Check that an archive ends where its file does, and that its list of members is no larger than said.

    The last bytes of a ZIP archive: a mark, four numbers of disks and members, how long the list is and where
    it begins, how long a comment. A longer form of the same may be pointed at before: no model needs it.
    """
    end = struct.Struct("<4s4H2LH")
    mark, *_, size, begin, comment = end.unpack(data[-end.size :])
    longer = data[-end.size - 20 :].startswith(b"PK\x06\x07")
    if mark != b"PK\x05\x06" or comment or longer or begin + size + end.size != len(data):
        raise ValueError("there is something else in it")
    if size > MOST_LISTED:
        raise DamageError(f"its list of members is larger than {MOST_LISTED >> 20} MiB")


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return a member, no more of it than the archive's list says, whatever it would unpack to."""
    with archive.open(member) as stream:
        return stream.read(member.file_size)


def record_of(archive: Archive) -> Record:
    """Return what an unpacked model was made from, as far as it may be looked up.

    What has no seal may name any file or folder of the machine: of its texts only the topology beside it is
    looked at, and what comes with the program. Raises one of DAMAGE if it doesn't say.
    """
    origin = archive.document["system"]["origin"]
    topology = str(origin["topology"])
    if topology in ("", "..") or PurePath(topology).name != topology or "\0" in topology:
        raise ValueError("the topology is not beside it")
    texts = tuple((str(name), str(digest)) for name, digest in origin["texts"])
    if not archive.sealed:
        texts = tuple(one for one in texts if one[0] == topology or not _is_path(one[0]))
    return Record(topology, texts)


def changed(record: Record, folder: Path) -> str:
    """Return the name of the first text that is different now, in words; empty when none is.

    Parameters
    ----------
    record
        What the model was made from.
    folder
        Where its topology is.
    """
    if not {PROGRAM, *LIBRARIES, record.topology} <= dict(record.texts).keys():
        return "apc itself"  # a model that doesn't say what it was made from wasn't made by this one
    for name, digest in record.texts:
        if name == PROGRAM:
            now, shown = program_digest(), "apc itself"
        elif name in LIBRARIES:
            now, shown = library_digest(name), name
        elif name == record.topology or _is_path(name):
            now, shown = _path_digest(folder / name), name.removeprefix("./")
        else:
            now, shown = builtin_digest(name), f"the library's {name}"
        if now != digest or not now:
            return shown
    return ""


def origin_texts(
    topology: tuple[str, str],
    files: Iterable[tuple[str, str]],
    folders: Iterable[str],
    definitions: Iterable[tuple[str, str]],
    where: Path,
) -> tuple[tuple[str, str], ...]:
    """Return what a model is made from, in the form `changed` compares.

    Parameters
    ----------
    topology
        The topology's file name and digest.
    files
        The tables the topology names, as it names them, and their digests.
    folders
        The folders of components it names.
    definitions
        The components and connectors read and their digests; those that are not the built-in library's are
        counted with their folder.
    where
        The topology's folder.
    """
    texts = [topology]
    texts += [(_relative(name), digest) for name, digest in files]
    for name in folders:
        shown = _relative(name).rstrip("/") + "/"
        texts.append((shown, _path_digest(where / shown)))
    texts += [(name, digest) for name, digest in definitions if builtin_digest(name) == digest]
    libraries = [(name, library_digest(name)) for name in LIBRARIES]
    return (*dict.fromkeys(texts), *libraries, (PROGRAM, program_digest()))


@functools.cache
def builtin_files() -> dict[str, Path]:
    """Return the built-in library's files by the name of what they define, the file's name in camel case."""
    # Beside the compiler in a checkout and in an installed package alike.
    models = Path(__file__).resolve().parent.parent / "models"
    return {
        "".join(word.capitalize() for word in path.stem.split("-")): path
        for path in sorted(models.rglob("*.yaml"))
        if "scenes" not in path.relative_to(models).parts
    }


def builtin_digest(name: str) -> str:
    """Return the SHA-256 of a definition of the built-in library; empty if there is none of that name."""
    path = builtin_files().get(name)
    return "" if path is None else _path_digest(path)


@functools.cache
def program_digest() -> str:
    """Return the SHA-256 of what compiles: every module of the compiler."""
    whole = hashlib.sha256()
    compiler = Path(__file__).resolve().parent
    for path in sorted(compiler.rglob("*.py")):
        whole.update(f"\0{path.relative_to(compiler)}\0".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()


@functools.cache
def library_digest(name: str) -> str:
    """Return the SHA-256 of an installed library's version; empty if it is not installed.

    The version is in the name of the folder beside it, such as `casadi-3.7.0.dist-info`: importing the
    library, or `importlib.metadata`, takes longer than all else here. One that was built by hand may have no
    such folder, and then has no version.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        return ""
    folder = Path(spec.origin).parent.parent
    versions = sorted(path.name for path in folder.glob(f"{name}-*-info"))
    return hashlib.sha256("/".join(versions).encode()).hexdigest()


def _is_path(name: str) -> bool:
    return name.startswith(("./", "../")) or PurePath(name).is_absolute()


def _relative(name: str) -> str:
    plain = PurePath(name).as_posix()
    return plain if _is_path(plain) else f"./{plain}"


def _path_digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder's YAML files and their names; empty if it isn't read."""
    try:
        if not os.path.isdir(path):  # noqa: PTH112 -- of any name, even one that no file can have
            return hashlib.sha256(read_file(path, LARGEST)).hexdigest()
        whole, rest = hashlib.sha256(), LARGEST
        for file in files_below(path, SUFFIX):
            content = read_file(file, rest)
            rest -= len(content)
            digest = hashlib.sha256(content).hexdigest()
            whole.update(f"{file.relative_to(path).as_posix()}\0{digest}\n".encode())
        return whole.hexdigest()
    except (RefusedError, ValueError):  # ValueError: a name that is no text
        return ""
