"""A C text as a loaded library, by the C compiler of the machine, where it has one.

Takes: the text of a library. Gives: `native`, `compiler`.
Guarantees: the roundings of the operations as they are written (no contraction, no reordering); what was
compiled once is found again by a digest of its text, the compiler and its options; a library is written whole
or not at all, into a folder of the user's own, and is loaded only as it was written (see `seal`): a damaged
one is compiled again. None without a compiler or such a folder, or where it fails.
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
# Loops over many peers are worth the threefold time that it takes to put them into lanes.
MANY, FEW = ("-O3", "-DMANY"), ("-O2",)
COMPILERS = ("cc", "gcc", "clang")
PATIENCE = 120.0  # seconds; a frame's straight code takes a fraction of one


def native(text: str, *, many: bool = False) -> ctypes.CDLL | None:
    """Return a library, None if it can't be had.

    Parameters
    ----------
    text
        In C.
    many
        Whether its loops run often enough to be put into lanes; it sees the macro MANY then.
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
    """Return the library of a text, compiled now or before; None if it can't be had."""
    path, version = pair
    digest = hashlib.sha256("\0".join((text, path, version, *options)).encode()).hexdigest()
    folder = cache_folder()
    if folder is None:
        return None
    try:
        library, mark = folder / f"{digest}.so", folder / f"{digest}.seal"
        if _is_ours(library, mark):
            return library
        with tempfile.TemporaryDirectory(dir=folder) as name:
            source, built, sealed = (Path(name) / part for part in ("frames.c", "frames.so", "seal"))
            source.write_text(text, encoding="utf-8")
            subprocess.run(
                [path, *options, str(source), "-o", str(built), "-lm"],
                cwd=name,  # linkers look for libraries where they are started
                capture_output=True,
                timeout=PATIENCE,
                check=True,
            )
            sealed.write_text(seal(_sealed(library, built)), encoding="ascii")
            built.replace(library)
            sealed.replace(mark)
    except (OSError, subprocess.SubprocessError):
        return None
    return library


def _is_ours(library: Path, mark: Path) -> bool:
    """Return whether a library exists and is bit-identical to the one compiled under that name."""
    try:
        return is_sealed(_sealed(library, library), mark.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def _sealed(library: Path, content: Path) -> bytes:
    return f"{library.name}\0".encode() + content.read_bytes()
