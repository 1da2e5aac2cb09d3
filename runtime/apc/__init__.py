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
        bench,
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
    from apc.runtime.analysis.analysis import Analysis
    from apc.runtime.analysis.box_proof import BoxProof
    from apc.runtime.analysis.contact_modes import ContactModes
    from apc.runtime.analysis.conventions import Conventions
    from apc.runtime.analysis.paper import PaperRoute
    from apc.runtime.bench.bench import Bench
    from apc.runtime.region.region import Region
    from apc.runtime.simulate.trajectory import Trajectory
    from apc.runtime.sweep.sweep import Sweep
    from apc.runtime.vary.critical import Critical
    from apc.runtime.vary.margins import Margins
    from apc.runtime.vary.sensitivity import Sensitivities

# Looked up when first used, so that `import apc` costs nothing and each command imports what it needs.
_HOMES = {
    "Analysis": "apc.runtime.analysis.analysis",
    "ApcError": "apc.compiler.errors",
    "Bench": "apc.runtime.bench.bench",
    "BoxProof": "apc.runtime.analysis.box_proof",
    "CompiledSystem": "apc.compiler.compiled",
    "ContactModes": "apc.runtime.analysis.contact_modes",
    "Conventions": "apc.runtime.analysis.conventions",
    "Critical": "apc.runtime.vary.critical",
    "Margins": "apc.runtime.vary.margins",
    "PaperRoute": "apc.runtime.analysis.paper",
    "Region": "apc.runtime.region.region",
    "Sensitivities": "apc.runtime.vary.sensitivity",
    "Sweep": "apc.runtime.sweep.sweep",
    "Trajectory": "apc.runtime.simulate.trajectory",
    "analyze": "apc.api",
    "bench": "apc.api",
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
    "Bench",
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
    "bench",
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
        from apc.runtime.distribution import program_version

        return program_version()
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'apc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
