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

import functools
from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from apc.distribution import program_version

        return program_version()
    lookup, _, public = _attached()
    return public if name == "__all__" else lookup(name)


def __dir__() -> list[str]:
    _, public, _ = _attached()
    return list(public())


@functools.cache
def _attached() -> Any:
    """Look the public names up when one is first used: a command uses none, and imports what it needs."""
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)
