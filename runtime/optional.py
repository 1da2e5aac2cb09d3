"""Libraries that are there only where somebody asked for them: those of the extras plot, data and cluster.

Takes: the name of a module, and of the extra that installs it. Gives: `need`, `missing`.
Guarantees: a library that isn't there is a mistake with the line that installs it.
Does not: import anything before it is needed.
"""

from __future__ import annotations

import importlib
from typing import Any

from apc.compiler.errors import ApcError, Mistake, Place
from apc.distribution import install_line


def need(module: str, extra: str) -> Any:
    """Import an optional library. Raises ApcError (E875) if it isn't there."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(f"{module} is not installed", install_line(extra)) from error


def missing(what: str, hint: str) -> ApcError:
    """Return the mistake (E875) that a library or program isn't there; `hint` says what to do."""
    return ApcError(Mistake("E875", Place("apc"), what, hint=hint))
