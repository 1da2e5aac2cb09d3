"""apc: networked haptic cooperation, described in YAML, compiled, and judged.

>>> model = apc.compile("three-users-average.yaml")
>>> apc.analyze(model).verdict
'stable up to a common translation'

Each function does what the command of its name does; results are frozen and print well.

compiler (YAML to CasADi), then a folder a subject: frame (one peer over one frame of time) → network (packets
that get lost or come late) → eigen (all peers) and large (very many) → analysis → vary (many values of some
parameters) → sweeps, simulation, regions → benchmark → present (text, JSON, tables and pictures of every
result) → cli. Each imports only what comes before it: a result names what shows it, and that is found when it
is asked for.
"""

from typing import Any

import lazy_loader

# Looked up when first used, so that `import apc` costs nothing and each command imports what it needs.
_lookup, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from apc.distribution import program_version

        return program_version()
    return _lookup(name)
