"""Libraries that are there only where somebody asked for them: those of the extras plot, data and cluster.

Takes: the name of a module, and of the extra that installs it. Gives: `need`, `missing`.
Guarantees: a library that isn't there is a mistake with the line that installs it. On the command line none
reads a file of the working folder for its settings.
Does not: import anything before it is needed.
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
from apc.distribution import install_line

HOME = Path(__file__).parent  # with the settings of matplotlib in it


def need(module: str, extra: str) -> Any:
    """Import an optional library. Raises ApcError (E875) if it isn't there."""
    try:
        with _at_home(module):
            return importlib.import_module(module)
    except ImportError as error:
        raise missing(f"{module} is not installed", install_line(extra)) from error


def missing(message: str, hint: str) -> ApcError:
    """Return the error (E875) for a missing library or program; `hint` is the remedy."""
    return ApcError(Diagnostic("E875", SourceLocation("apc"), message, hint=hint))


@contextmanager
def _at_home(module: str) -> Iterator[None]:
    """Import a module in apc's own folder: matplotlib takes a file of the working folder for its settings.

    Such settings can name a program to run. In the user's own program this is the user's decision.
    """
    if module in sys.modules or "apc.cli" not in sys.modules:
        yield
        return
    try:
        before = Path.cwd()
    except OSError:  # it was removed, with all that was in it
        yield
        return
    backend = os.environ.pop("MPLBACKEND", None)  # of windows, which apc opens none of; an unknown one raises
    os.chdir(HOME)
    try:
        yield
    finally:
        os.chdir(before)
        if backend is not None:
            os.environ["MPLBACKEND"] = backend
