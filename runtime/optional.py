"""Libraries that are there only where somebody asked for them: those of the extras plot, data and cluster.

Takes: the name of a module, and of the extra that installs it. Gives: `need`.
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
        what = f"{module} is not installed"
        raise ApcError(Mistake("E875", Place("apc"), what, hint=install_line(extra))) from error
