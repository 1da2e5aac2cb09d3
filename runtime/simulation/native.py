"""CasADi functions in machine code, by the C compiler of the machine, where it has one.

Takes: CasADi functions. Gives: `native`, `compiler`.
Guarantees: the same roundings as CasADi's virtual machine (no contraction, no reordering); what was compiled
once is found again by a digest of its C text, the compiler and its options; a library is written whole or not
at all, into a folder of the user's own, and is loaded only as it was written (see `seal`): a damaged one is
compiled again. Without a compiler or such a folder, or where it fails, the functions as they were.
Does not: decide what is worth compiling.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi

from apc.compiler.seal import cache_folder, is_sealed, seal

# Contracted products and sums would round differently from the virtual machine.
OPTIONS = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
COMPILERS = ("cc", "gcc", "clang")
PATIENCE = 120.0  # seconds; a frame's straight code takes a fraction of one
# Kinds of functions that are written as C whole; solvers are calls into libraries.
STRAIGHT = ("SXFunction", "MXFunction", "Map", "MapSum")
# More instructions than this in one function: optimizing straight code costs more than linear time.
MOST_INSTRUCTIONS = 100_000


def native(functions: Sequence[Any]) -> tuple[Any, ...]:
    """Return the functions in machine code, each as it is if that can't be had.

    Parameters
    ----------
    functions
        CasADi functions, of any names.
    """
    found = compiler()
    # One library holds all that can be compiled, each under a name of its own.
    named = {
        place: _renamed(one, f"kernel{place}") for place, one in enumerate(functions) if _is_worth_it(one)
    }
    library = _library(list(named.values()), found) if found is not None and named else None
    if library is None:
        return tuple(functions)
    try:
        ready = {place: casadi.external(one.name(), str(library)) for place, one in named.items()}
    except RuntimeError:  # it can't be loaded: of another machine, or the folder forbids it
        return tuple(functions)
    return tuple(ready.get(place, one) for place, one in enumerate(functions))


@functools.cache
def compiler() -> tuple[str, str] | None:
    """Return the path of the machine's C compiler and what it says of its version, or None."""
    for name in (os.environ.get("CC", ""), *COMPILERS):
        path = shutil.which(name) if name else None
        if path is None:
            continue
        try:
            said = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=True)
        except (OSError, subprocess.SubprocessError):
            continue
        return path, said.stdout
    return None


def _is_worth_it(function: Any) -> bool:
    """Say whether a function, with all that it calls, is straight code that is not too long."""
    called = [function, *function.find_functions(-1)]
    if not all(one.class_name() in STRAIGHT for one in called):
        return False
    own = [one for one in called if not one.class_name().startswith("Map")]
    return bool(sum(one.n_instructions() for one in own) <= MOST_INSTRUCTIONS)


def _renamed(function: Any, name: str) -> Any:
    arguments = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    return casadi.Function(name, arguments, function.call(arguments), function.name_in(), function.name_out())


def _library(functions: Sequence[Any], found: tuple[str, str]) -> Path | None:
    """Return the library of some functions, compiled now or before; None if it can't be had."""
    path, version = found
    generator = casadi.CodeGenerator("kernels.c")
    for function in functions:
        generator.add(function)
    text = generator.dump()
    digest = hashlib.sha256("\0".join((text, path, version, *OPTIONS)).encode()).hexdigest()
    folder = cache_folder()
    if folder is None:
        return None
    try:
        library, mark = folder / f"{digest}.so", folder / f"{digest}.seal"
        if _is_ours(library, mark):
            return library
        with tempfile.TemporaryDirectory(dir=folder) as name:
            source, built, sealed = (Path(name) / part for part in ("kernels.c", "kernels.so", "seal"))
            source.write_text(text, encoding="utf-8")
            subprocess.run(
                [path, *OPTIONS, str(source), "-o", str(built), "-lm"],
                capture_output=True,
                timeout=PATIENCE,
                check=True,
            )
            sealed.write_text(seal(_sealed(library, built)), encoding="ascii")
            built.replace(library)
            sealed.replace(mark)
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return None
    return library


def _is_ours(library: Path, mark: Path) -> bool:
    """Say whether a library is there, to the last bit as it was when it was compiled under that name."""
    try:
        return is_sealed(_sealed(library, library), mark.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def _sealed(library: Path, content: Path) -> bytes:
    return f"{library.name}\0".encode() + content.read_bytes()
