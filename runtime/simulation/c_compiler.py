"""Compilation of a C text to a loaded library by the C compiler of the machine, if one exists.

Takes: the text of a library. Gives: `native`, `compiler`.
Guarantees: operations are rounded in the order of the text (no contraction, no reordering). Compiled
libraries are cached by a digest of the text, the compiler and its options, in a private folder of the user. A
library is written completely or not at all, and loaded only if it is unchanged (see `seal`); a damaged
library is compiled again. None without a compiler or a private folder, or if the compilation fails.
Does not: write the text (see `compiled_engine`).
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from apc.compiler.signing import cache_folder, is_sealed, seal

# Contracted products and sums would round differently from CasADi's virtual machine.
OPTIONS = ("-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
# For loops over many peers, vectorization is worth its threefold compilation time.
MANY, FEW = ("-O3", "-DMANY"), ("-O2",)
COMPILERS = ("cc", "gcc", "clang")
TIMEOUT = 120.0  # seconds; a frame's straight code takes a fraction of one


def native(text: str, *, many: bool = False) -> ctypes.CDLL | None:
    """Return the library compiled from a C text, None if it is unavailable.

    Parameters
    ----------
    text
        The C text.
    many
        Whether its loops are long enough for vectorization; the macro MANY is then defined.
    """
    pair = compiler()
    options = (*(MANY if many else FEW), *OPTIONS)
    library = _library(text, pair, options) if pair is not None else None
    try:
        return None if library is None else ctypes.CDLL(str(library))
    except OSError:  # it can't be loaded: of another machine, or the folder forbids it
        return None


@functools.cache
def compiler() -> tuple[str, str] | None:
    """Return the path of the machine's C compiler and its version text, or None."""
    for name in (os.environ.get("CC", ""), *COMPILERS):
        path = shutil.which(name) if name else None
        if path is None:
            continue
        try:
            completed_process = subprocess.run(
                [path, "--version"], capture_output=True, text=True, timeout=10, check=True
            )
        except (OSError, subprocess.SubprocessError):
            continue
        return str(Path(path).absolute()), completed_process.stdout
    return None


def _library(text: str, pair: tuple[str, str], options: tuple[str, ...]) -> Path | None:
    """Return the path of the library of a text, compiled now or earlier; None if it is unavailable."""
    path, version = pair
    digest = hashlib.sha256("\0".join((text, path, version, *options)).encode()).hexdigest()
    folder = cache_folder()
    if folder is None:
        return None
    try:
        library, mark = folder / f"{digest}.so", folder / f"{digest}.seal"
        if _is_unchanged(library, mark):
            return library
        with tempfile.TemporaryDirectory(dir=folder) as name:
            source, built, sealed = (
                Path(name) / file_name for file_name in ("frames.c", "frames.so", "seal")
            )
            source.write_text(text, encoding="utf-8")
            subprocess.run(
                [path, *options, str(source), "-o", str(built), "-lm"],
                cwd=name,  # linkers look for libraries where they are started
                capture_output=True,
                timeout=TIMEOUT,
                check=True,
            )
            sealed.write_text(seal(_seal_content(library, built)), encoding="ascii")
            built.replace(library)
            sealed.replace(mark)
    except (OSError, subprocess.SubprocessError):
        return None
    return library


def _is_unchanged(library: Path, mark: Path) -> bool:
    """Return whether a library exists and is bit-identical to the one compiled under its name."""
    try:
        return is_sealed(_seal_content(library, library), mark.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def _seal_content(library: Path, content: Path) -> bytes:
    """Return the bytes that the seal of a library covers: its name and its content."""
    return f"{library.name}\0".encode() + content.read_bytes()
