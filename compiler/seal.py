"""What this user's own apc wrote: a folder of the user's own, a secret in it, and seals made with the secret.

Takes: bytes. Gives: `cache_folder`, `seal`, `is_sealed`.
Guarantees: the folder and the secret are the user's, nobody else can write to them or to a folder above them,
and nobody else can read the secret; where that can't be had, nothing is sealed and no seal holds.
Does not: encrypt, or say who else may have written what has no seal.
"""

from __future__ import annotations

import functools
import hmac
import os
import stat
import sys
from pathlib import Path

SECRET = "secret"  # its file in the folder
LENGTH = 32  # bytes of the secret


def cache_folder() -> Path | None:
    """Return the folder of what is kept for this user, made if need be; None if it can't be the user's alone.

    It stands where the system's custom has it.
    """
    folder = _folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.name == "posix":
            found = folder.lstat()
            if not (stat.S_ISDIR(found.st_mode) and _is_safe(found) and found.st_uid == os.geteuid()):
                return None  # what others have put into it can't be told from what is the user's
            if not all(_is_safe(above.stat()) for above in folder.resolve().parents):
                return None
            if stat.S_IMODE(found.st_mode) != 0o700:
                folder.chmod(0o700)
    except OSError:
        return None
    return folder


def seal(content: bytes) -> str:
    """Return the seal of some bytes; empty if there is no secret to make it with."""
    secret = _secret(_folder())
    return hmac.digest(secret, content, "sha256").hex() if secret else ""


def is_sealed(content: bytes, found: str) -> bool:
    """Return whether a seal is the one this user's apc made of some bytes."""
    expected = seal(content)
    return bool(expected) and hmac.compare_digest(expected.encode(), found.encode())


def _folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA", "")
        return Path(base) / "apc" if base else Path.home() / "AppData" / "Local" / "apc"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "apc"
    base = os.environ.get("XDG_CACHE_HOME", "")
    return Path(base) / "apc" if base and Path(base).is_absolute() else Path.home() / ".cache" / "apc"


def _is_safe(found: os.stat_result) -> bool:
    """Return whether nobody but the user and root can replace what of the user's is in a folder."""
    others = found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not found.st_mode & stat.S_ISVTX
    return found.st_uid in (0, os.geteuid()) and not others


@functools.lru_cache(maxsize=1)
def _secret(folder: Path) -> bytes:
    """Return the user's secret, made if there is none; empty if none can be kept."""
    if cache_folder() is None:
        return b""
    path = folder / SECRET
    try:
        if path.exists() and (found := _read(path)):
            return found
        made = folder / f".{SECRET}{os.getpid()}"
        made.unlink(missing_ok=True)
        handle = os.open(made, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(os.urandom(LENGTH))
        made.replace(path)  # of two at once the second stays: what the first has sealed is compiled again
        return _read(path)
    except OSError:
        return b""


def _read(path: Path) -> bytes:
    """Return the secret in a file; empty if it is none, or others may have seen it."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(handle, "rb") as file:
        found = os.fstat(handle)
        if os.name == "posix" and (found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) != 0o600):
            return b""
        content = file.read(LENGTH + 1) if stat.S_ISREG(found.st_mode) else b""
    return content if len(content) == LENGTH else b""
