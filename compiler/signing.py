"""Signatures of this user's files: a private folder, a secret in it, and keyed hashes with the secret.

Takes: bytes. Gives: `cache_folder`, `seal`, `is_sealed`.
Guarantees: the folder and the secret belong to the user. No other user can write to them or to a parent
folder, or read the secret. Otherwise nothing is signed and no signature is valid.
Does not: encrypt, or identify the author of an unsigned file.
"""

from __future__ import annotations

import functools
import hmac
import os
import stat
from pathlib import Path

import platformdirs

SECRET = "secret"  # the file of the secret in the folder
LENGTH = 32  # bytes of the secret


def cache_folder() -> Path | None:
    """Return the user's private cache folder, created if necessary; None if it cannot be private.

    Its location follows the conventions of the system.
    """
    folder = _folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.name == "posix":
            folders = (path.stat() for path in (folder, *folder.resolve().parents))
            if folder.is_symlink() or folder.stat().st_uid != os.geteuid() or not all(map(_is_safe, folders)):
                return None  # files of other users are not distinguishable from the user's own
            folder.chmod(0o700)
    except OSError:
        return None
    return folder


def seal(content: bytes) -> str:
    """Return the seal of bytes, a keyed hash in hexadecimal; empty if there is no secret."""
    secret = _secret(_folder())
    return hmac.digest(secret, content, "sha256").hex() if secret else ""


def is_sealed(content: bytes, text: str) -> bool:
    """Return whether a text is the seal of bytes by this user's secret."""
    expected = seal(content)
    return bool(expected) and hmac.compare_digest(expected.encode(), text.encode())


def _folder() -> Path:
    """Return the path of the user's cache folder."""
    return Path(platformdirs.user_cache_dir("apc", appauthor=False))


def _is_safe(folder: os.stat_result) -> bool:
    """Return whether only the user and root can replace the user's files in a folder."""
    others = folder.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not folder.st_mode & stat.S_ISVTX
    return folder.st_uid in (0, os.geteuid()) and not others


@functools.lru_cache(maxsize=1)
def _secret(folder: Path) -> bytes:
    """Return the user's secret, created if necessary; empty if it cannot be stored privately."""
    if cache_folder() is None:
        return b""
    path = folder / SECRET
    try:
        if not (secret := _read(path)):
            new_file = folder / f".{SECRET}{os.getpid()}"
            new_file.unlink(missing_ok=True)
            new_file.touch(0o600, exist_ok=False)
            new_file.write_bytes(os.urandom(LENGTH))
            # Of two simultaneous secrets the second remains: files sealed with the first are compiled again.
            new_file.replace(path)
            secret = _read(path)
    except OSError:
        return b""
    return secret


def _read(path: Path) -> bytes:
    """Return the secret in a file; empty if there is none, or if other users can read the file."""
    if path.is_symlink() or not path.is_file():
        return b""
    result = path.stat()
    if os.name == "posix" and (result.st_uid != os.geteuid() or stat.S_IMODE(result.st_mode) != 0o600):
        return b""
    return path.read_bytes() if result.st_size == LENGTH else b""
