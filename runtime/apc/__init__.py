"""apc: networked haptic cooperation, described in YAML, compiled, and judged.

>>> model = apc.compile("three-users-average.yaml")
>>> apc.analyze(model).verdict
'stable up to a common translation'

Each function does what the command of its name does; results are frozen and print well.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apc.api import analyze, compile, load, save, schema, set_parameters, show
    from apc.compiler.compiled import CompiledSystem
    from apc.compiler.errors import ApcError
    from apc.runtime.analysis import Analysis

# Looked up when first used, so that `import apc` costs nothing and each command imports what it needs.
_HOMES = {
    "Analysis": "apc.runtime.analysis",
    "ApcError": "apc.compiler.errors",
    "CompiledSystem": "apc.compiler.compiled",
    "analyze": "apc.api",
    "compile": "apc.api",
    "load": "apc.api",
    "save": "apc.api",
    "schema": "apc.api",
    "set_parameters": "apc.api",
    "show": "apc.api",
}

__all__ = [
    "Analysis",
    "ApcError",
    "CompiledSystem",
    "analyze",
    "compile",
    "load",
    "save",
    "schema",
    "set_parameters",
    "show",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("apc")
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'apc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
