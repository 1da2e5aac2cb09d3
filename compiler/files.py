"""Reading and writing of files on disk, named by any source.

Takes: paths. Gives: `read_file`, `check_file`, `RefusedError`, `files_below`, `listing`, `same_file`;
`recorded`, `replayed`; `write_file`, `write_bytes`, `write_text`, `write_texts`, `check_target`,
`unwritable`, `is_special`, `is_stdout`, and for incremental writing `Temporary`, `begin_file`, `finish_file`,
`drop_file`, `partial_name`; `unlink_link`.
Guarantees: only regular files of bounded size are read, also through links, without blocking. Files are
written completely or not at all. A file is replaced by one of the same mode and owner unless it is read-only;
for a link its target is written. A device, a pipe, or the target of standard output is written to, never
replaced.
Does not: handle formats, or locations of references.
"""

from __future__ import annotations

import os
import shlex
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

# Of a folder of a user's components: the largest library we know of has a hundred files, three deep.
MOST_ENTRIES = 10_000
MOST_DEPTH = 8
NO_NAME = OSError, ValueError  # messages of the system and of Python for impossible names
STDOUT = 1  # the descriptor of standard output
KERNELS = ("/proc", "/sys")  # file systems whose files are answers of the kernel
KERNELS_LOCAL = "is an answer of the system's kernel"

T = TypeVar("T")
Why = Literal["missing", "folder", "special", "large", "forbidden", "unreadable"]


class RefusedError(Exception):
    """A file is not read: `why`, and the same in words that follow its name."""

    def __init__(self, why: Why, words: str) -> None:
        super().__init__(words)
        self.why, self.words = why, words


# What is read is put into the one by its path, and comes from the other alone (see `recorded`, `replayed`).
_record: ContextVar[dict[str, bytes] | None] = ContextVar("record", default=None)
_replay: ContextVar[Mapping[str, bytes] | None] = ContextVar("replay", default=None)


@contextmanager
def _during(variable: ContextVar[T], value: T) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def recorded(texts: dict[str, bytes]) -> AbstractContextManager[None]:
    """Put the bytes of every file that is read meanwhile into `texts`, by its path.

    Of a folder, by its path and a slash, these are the names of the files in it (see `listing`).
    """
    return _during(_record, texts)


def replayed(texts: Mapping[str, bytes]) -> AbstractContextManager[None]:
    """Replace file access by recorded contents, by absolute path, within the body."""
    return _during(_replay, texts)


def _replayed(path: str, texts: Mapping[str, bytes]) -> bytes:
    """Return the stored content for a file or, with a slash at its end, for a folder. Raises RefusedError."""
    key = os.path.abspath(path) + "/" * path.endswith("/")  # noqa: PTH100 -- a folder's slash would be lost
    if key not in texts:
        raise RefusedError("missing", "does not exist")
    return texts[key]


def _note(path: str, data: bytes) -> None:
    if (texts := _record.get()) is not None:
        texts[path] = data


def read_file(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file, or its stored content (see `replayed`).

    Parameters
    ----------
    path
        The file, or a link to it.
    most
        Its largest size in bytes.

    Raises
    ------
    RefusedError
        It does not exist, is not a regular file, is larger, or can't be read.
    """
    texts = _replay.get()
    data = _read(path, most) if texts is None else _replayed(str(path), texts)
    _check_size(len(data), most)  # it may have grown meanwhile
    _note(str(path), data)
    return data


def _read(path: Path, most: int) -> bytes:
    check_file(path, most)  # first, as opening a device can already do something
    with _refusing(), open(path, "rb", opener=_without_waiting) as stream:
        result = os.fstat(stream.fileno())
        _check(result, most)  # of what was opened
        data = stream.read(result.st_size + 1)  # as many bytes are set aside
        if len(data) > result.st_size:
            data += stream.read(most + 1 - len(data))
    return data


def check_file(path: Path, most: int) -> None:
    """Refuse a file by its type, as `read_file` does, without opening it."""
    with _refusing():
        _check(path.stat(), most)


@contextmanager
def _refusing() -> Iterator[None]:
    """Convert system errors to RefusedError."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise RefusedError("missing", "does not exist") from None
    except PermissionError:
        raise RefusedError("forbidden", "may not be read (no permission)") from None
    except (OSError, ValueError) as error:  # a name too long, a loop of links, a NUL in the name
        raise RefusedError("unreadable", f"can't be read: {_reason(error)}") from None


def _check(result: os.stat_result, most: int) -> None:
    if stat.S_ISDIR(result.st_mode):
        raise RefusedError("folder", "is a folder")
    if not stat.S_ISREG(result.st_mode):
        raise RefusedError("special", "is a device, pipe or socket")
    if result.st_dev in _kernels_devices():
        raise RefusedError("special", KERNELS_LOCAL)
    _check_size(result.st_size, most)


def _check_size(size: int, most: int) -> None:
    if size > most:
        limit = f"{most >> 20} MiB" if most % (1 << 20) == 0 else f"{most:,} bytes"
        raise RefusedError("large", f"is larger than {limit}, the most it may have")


def _kernels_devices() -> set[int]:
    return {os.stat(name).st_dev for name in KERNELS if os.path.ismount(name)}  # noqa: PTH116 -- no path of a user's


def _without_waiting(name: str, flags: int) -> int:
    """Open a file without blocking, should it have become a pipe."""
    return os.open(name, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))


def _reason(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def files_below(folder: Path, suffix: str) -> tuple[Path, ...]:
    """Return the files of a folder and the folders in it by their suffix, in order.

    Links to folders are not followed.

    Raises
    ------
    RefusedError
        It can't be read, is or holds a folder of the kernel's, has more than `MOST_ENTRIES` entries, or is
        more than `MOST_DEPTH` folders deep.
    """
    texts = _replay.get()
    names = listing(folder, suffix) if texts is None else _replayed(f"{folder}/", texts)
    _note(f"{folder}/", names)
    return tuple(folder / name for name in os.fsdecode(names).split("\0") if name)


def listing(folder: Path, suffix: str) -> bytes:
    """Return the names, from the folder, of the files that `files_below` gives, NUL between two."""
    paths: list[Path] = []
    kernels, entries = _kernels_devices(), 0
    with _refusing():
        for name, folders, files in os.walk(folder, onerror=_raise):
            below = Path(name).relative_to(folder)
            if len(below.parts) >= MOST_DEPTH:
                raise RefusedError("large", f"is more than {MOST_DEPTH} folders deep")
            if Path(name).stat().st_dev in kernels:
                raise RefusedError("special", KERNELS_LOCAL)
            entries += len(folders) + len(files)
            if entries > MOST_ENTRIES:
                raise RefusedError("large", f"holds more than {MOST_ENTRIES} files and folders")
            paths += [below / file for file in files if file.endswith(suffix)]
    return os.fsencode("\0".join(map(str, sorted(paths))))


def _raise(error: OSError) -> None:
    raise error


def same_file(path: Path, other: Path) -> bool:
    """Return whether two paths lead to one file that exists."""
    with suppress(OSError, ValueError):
        return path.samefile(other)
    return False


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file, then put it where it belongs.

    Parameters
    ----------
    path
        Where: a name in a folder that exists, a file, a link to one, a device or a pipe.
    write
        Takes the path of the temporary file, which exists and is empty.

    Raises
    ------
    ApcError
        E601 it can't be written; then what was there before is as it was.
    """
    _write_all({path: write})


def _write_all(writers: Mapping[Path, Callable[[Path], object]]) -> None:
    """Fill a temporary file for each path, then put all where they belong, or none. Raises ApcError E601."""
    ready: dict[Path, Temporary] = {}
    try:
        for path, write in writers.items():
            with _writing(path, *NO_NAME):
                ready[path] = begin_file(path)
            with _writing(path, OSError):
                write(ready[path].path)
        for path in writers:
            with _writing(path, OSError):
                finish_file(ready[path], path)
                del ready[path]
    finally:
        for temporary in ready.values():
            drop_file(temporary)


@contextmanager
def _writing(path: Path, *peer_types: type[Exception]) -> Iterator[None]:
    """Convert an error on an output file to ApcError (E601), if of such a type."""
    try:
        yield
    except peer_types as error:
        raise unwritable(path, error) from error


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all. Raises ApcError (E601) if it can't be written."""
    write_file(path, partial(Path.write_bytes, data=content))


def write_text(path: Path, text: str) -> None:
    """Write a text and the end of its last line, whole or not at all. Raises ApcError (E601) if it can't."""
    write_bytes(path, f"{text}\n".encode())


def write_texts(texts: Mapping[Path, str]) -> None:
    """Write texts that belong together, all or none. Raises ApcError (E601) if one can't be written."""
    _write_all({path: partial(Path.write_bytes, data=text.encode()) for path, text in texts.items()})


def check_target(path: Path) -> None:
    """Refuse a place where nothing can be written, before anything is computed: ApcError E601."""
    with _writing(path, *NO_NAME):
        drop_file(begin_file(path))


def unwritable(path: Path, error: Exception) -> ApcError:
    """Return the message (E601) of a file or folder that can't be written."""
    lacking = isinstance(error, FileNotFoundError) and not path.parent.exists()
    hint = f"mkdir -p {shlex.quote(str(path.parent))}" if lacking else ""
    return ApcError(
        Diagnostic("E601", SourceLocation(str(path)), f"can't be written: {_reason(error)}", hint=hint)
    )


@dataclass(frozen=True, slots=True)
class Temporary:
    """A temporary file: `name` in the folder of descriptor `folder`, open for writing as `descriptor`.

    `path` is where to write: by the descriptor where the system has such names, so that a link that somebody
    else puts in place of the file is not followed.
    """

    path: Path
    descriptor: int
    folder: int | None
    name: Path


def begin_file(path: Path) -> Temporary:
    """Create the empty temporary file of a path in the folder of its target, for a later rename.

    Raises
    ------
    OSError
        It cannot be created: the folder does not exist or allows no new files, or the target is a folder or a
        read-only file.
    ValueError
        The name is impossible.
    """
    target = _target(path)
    if target.is_dir():
        raise IsADirectoryError(None, "it is a folder")
    folder = target.parent
    if is_special(path):
        folder = Path(tempfile.gettempdir())
    elif target.exists() and not (target.stat().st_mode & 0o222 and os.access(target, os.W_OK)):
        raise PermissionError(None, "it is read-only")
    # The name of the target need not fit: a temporary's is longer. No link is followed, and no file opened.
    descriptor, text = tempfile.mkstemp(".unfinished", f".{target.name[:24]}.", folder)
    name, by_descriptor = Path(text), Path(f"/proc/{os.getpid()}/fd/{descriptor}")
    try:
        # A folder need not be readable.
        only = getattr(os, "O_PATH", os.O_RDONLY) | getattr(os, "O_DIRECTORY", 0)
        directory = os.open(folder, only) if os.rename in os.supports_dir_fd else None
    except OSError:
        os.close(descriptor)
        name.unlink(missing_ok=True)
        raise
    return Temporary(by_descriptor if by_descriptor.exists() else name, descriptor, directory, name)


def finish_file(temporary: Temporary, path: Path) -> None:
    """Put a temporary file where it belongs: in place of a file, with its mode; into a device or pipe.

    Then there is no temporary file any more: its name may be that of another writer's.

    Raises
    ------
    OSError
        It can't be put there, or another user has put something else in its place.
    """
    if is_special(path):
        with temporary.path.open("rb") as source, os.fdopen(_drain(path), "wb") as drain:
            shutil.copyfileobj(source, drain)
        drop_file(temporary)
        return
    target = _target(path)
    try:
        before = target.stat()
        mode = stat.S_IMODE(before.st_mode)
        with suppress(OSError, AttributeError):  # only root may give it away; and not on Windows
            os.fchown(temporary.descriptor, before.st_uid, before.st_gid)
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        mode = 0o666 & ~mask
    if hasattr(os, "fchmod"):
        os.fchmod(temporary.descriptor, mode)
    else:
        temporary.name.chmod(mode)
    if not _is_ours(temporary, temporary.name.name):
        raise OSError(None, "another program has replaced its temporary file")
    if temporary.folder is None:
        os.close(temporary.descriptor)  # an open file can't be moved there
        try:
            temporary.name.replace(target)
        except OSError:
            temporary.name.unlink(missing_ok=True)
            raise
        return
    os.replace(temporary.name.name, target.name, src_dir_fd=temporary.folder, dst_dir_fd=temporary.folder)
    result = os.stat(target.name, dir_fd=temporary.folder, follow_symlinks=False)
    # Another run of the same user may have written the same file since.
    regular = stat.S_ISREG(result.st_mode)
    if result.st_uid != os.fstat(temporary.descriptor).st_uid or not regular:
        if not regular:
            with suppress(OSError):  # what came in its place leads elsewhere
                os.unlink(target.name, dir_fd=temporary.folder)
        raise OSError(None, "another program has replaced its temporary file")
    _close(temporary)


def _is_ours(temporary: Temporary, name: str) -> bool:
    """Return whether a name in the folder is that of the temporary file, and no link."""
    try:
        result = os.stat(
            name if temporary.folder is not None else temporary.name,
            dir_fd=temporary.folder,
            follow_symlinks=False,
        )
        return os.path.samestat(result, os.fstat(temporary.descriptor))
    except OSError:  # it is gone, or closed
        return False


def _close(temporary: Temporary) -> None:
    for descriptor in (temporary.descriptor, temporary.folder):
        with suppress(OSError, TypeError):
            os.close(descriptor)  # type: ignore[arg-type] # None where folders have no descriptors


def partial_name(path: Path) -> Path:
    """Return the path of a partial output, distinct from an existing complete file."""
    target = _target(path)
    new = is_special(path) or not target.is_file()
    return path if new else target.with_name(f"{target.stem}.partial{target.suffix}")


def unlink_link(path: Path) -> None:
    """Remove a link where a file of a name that nobody chose is to be written: it may lead anywhere.

    Raises ApcError (E601) if it can't be removed.
    """
    with _writing(path, OSError):
        if path.is_symlink():
            path.unlink()


def drop_file(temporary: Temporary) -> None:
    """Remove a temporary file that was not put where it belongs."""
    if _is_ours(temporary, temporary.name.name):
        with suppress(OSError):
            os.unlink(
                temporary.name.name if temporary.folder is not None else temporary.name,
                dir_fd=temporary.folder,
            )
    _close(temporary)


def _target(path: Path) -> Path:
    """Return the target of a path, existing or not."""
    try:
        if not path.is_symlink() or is_special(path):
            return path
        target = path.resolve()  # refuses a loop of links
        step = path
        while step.is_symlink():
            link, folder = step.lstat(), step.parent.stat()
            # Stricter than Linux's protected_symlinks, which holds in sticky folders alone: nobody else's
            # link in a folder of ours or of a third user.
            if hasattr(os, "geteuid") and link.st_uid not in (os.geteuid(), folder.st_uid):
                raise PermissionError(None, "it is a link of another user")
            step = step.parent / step.readlink()
        return target
    except RuntimeError as error:  # a loop of links
        raise OSError(None, "its links lead to one another") from error


def is_special(path: Path) -> bool:
    """Return whether a path's target is written in place: a device, a pipe, our standard output."""
    with suppress(OSError, ValueError):
        mode = path.stat().st_mode
        return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)) or is_stdout(path)
    return False


def is_stdout(path: Path) -> bool:
    """Return whether a path leads to where our standard output goes, by whatever name, a file included."""
    with suppress(OSError, ValueError):
        return os.path.samestat(path.stat(), os.fstat(STDOUT))
    return False


def _drain(path: Path) -> int:
    """Open an existing file without creating one; standard output continues at its position."""
    if not is_stdout(path):
        return os.open(path, os.O_WRONLY | getattr(os, "O_CLOEXEC", 0))
    sys.stdout.flush()
    return os.dup(STDOUT)
