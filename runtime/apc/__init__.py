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
    from apc.api import (
        analyze,
        compile,
        contact_modes,
        conventions,
        critical,
        load,
        margins,
        paper_route,
        prove_box,
        region,
        save,
        schema,
        sensitivities,
        set_parameters,
        show,
        simulate,
        sweep,
    )
    from apc.compiler.compiled import CompiledSystem
    from apc.compiler.errors import ApcError
    from apc.runtime.analysis import Analysis
    from apc.runtime.box_proof import BoxProof
    from apc.runtime.contact_modes import ContactModes
    from apc.runtime.conventions import Conventions
    from apc.runtime.critical import Critical
    from apc.runtime.margins import Margins
    from apc.runtime.paper import PaperRoute
    from apc.runtime.region import Region
    from apc.runtime.sensitivity import Sensitivities
    from apc.runtime.sweep import Sweep
    from apc.runtime.trajectory import Trajectory

# Looked up when first used, so that `import apc` costs nothing and each command imports what it needs.
_HOMES = {
    "Analysis": "apc.runtime.analysis",
    "ApcError": "apc.compiler.errors",
    "BoxProof": "apc.runtime.box_proof",
    "CompiledSystem": "apc.compiler.compiled",
    "ContactModes": "apc.runtime.contact_modes",
    "Conventions": "apc.runtime.conventions",
    "Critical": "apc.runtime.critical",
    "Margins": "apc.runtime.margins",
    "PaperRoute": "apc.runtime.paper",
    "Region": "apc.runtime.region",
    "Sensitivities": "apc.runtime.sensitivity",
    "Sweep": "apc.runtime.sweep",
    "Trajectory": "apc.runtime.trajectory",
    "analyze": "apc.api",
    "compile": "apc.api",
    "contact_modes": "apc.api",
    "conventions": "apc.api",
    "critical": "apc.api",
    "load": "apc.api",
    "margins": "apc.api",
    "paper_route": "apc.api",
    "prove_box": "apc.api",
    "region": "apc.api",
    "save": "apc.api",
    "schema": "apc.api",
    "sensitivities": "apc.api",
    "set_parameters": "apc.api",
    "show": "apc.api",
    "simulate": "apc.api",
    "sweep": "apc.api",
}

__all__ = [
    "Analysis",
    "ApcError",
    "BoxProof",
    "CompiledSystem",
    "ContactModes",
    "Conventions",
    "Critical",
    "Margins",
    "PaperRoute",
    "Region",
    "Sensitivities",
    "Sweep",
    "Trajectory",
    "analyze",
    "compile",
    "contact_modes",
    "conventions",
    "critical",
    "load",
    "margins",
    "paper_route",
    "prove_box",
    "region",
    "save",
    "schema",
    "sensitivities",
    "set_parameters",
    "show",
    "simulate",
    "sweep",
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
