"""Optional libraries: those of the extras plot, data and cluster.

Takes: the name of a module, and of the extra that installs it. Gives: `need`, `missing`.
Guarantees: a missing library is an error with the command that installs it. On the command line no library
reads settings from a file of the working folder.
Does not: import a library before its first use.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.support.distribution import install_line

HOME = Path(__file__).parent.parent  # the folder with the settings of matplotlib


def need(module: str, extra: str) -> Any:
    """Return an optional library after importing it. Raises ApcError (E875) if it is not installed."""
    try:
        with _in_own_folder(module):
            return importlib.import_module(module)
    except ImportError as error:
        raise missing(f"{module} is not installed", install_line(extra)) from error


def missing(message: str, fix: str) -> ApcError:
    """Return the error E875 for a missing library or program; `fix` is the suggestion."""
    return ApcError(Diagnostic("E875", SourceLocation("apc"), message, fix=fix))


@contextmanager
def _in_own_folder(module: str) -> Iterator[None]:
    """Run the import of `module` in apc's own folder: matplotlib reads settings from the working folder.

    Such settings can name a program to run. In a user's own program the working folder is not changed.
    """
    if module in sys.modules or "apc.cli" not in sys.modules:
        yield
        return
    try:
        before = Path.cwd()
    except OSError:  # the folder was removed
        yield
        return
    # No windows are opened by apc, and an unknown backend raises an error.
    backend = os.environ.pop("MPLBACKEND", None)
    os.chdir(HOME)
    try:
        yield
    finally:
        os.chdir(before)
        if backend is not None:
            os.environ["MPLBACKEND"] = backend
