"""apc: networked haptic cooperation, described in YAML, compiled, and analyzed.

>>> model = apc.compile("three-users-average.yaml")
>>> apc.analyze(model).verdict
'stable up to a common translation'

Each function corresponds to the command of the same name; results are frozen.

The compiler (YAML to CasADi) is `compiler`. Then one folder per subject: `frame` (one peer over one frame) →
`network` (lost and late packets) → `eigen` (all peers) and `large_scale` (very many peers) → `analysis` →
`parameter_studies` → `sweeps`, `simulation`, `regions` → `benchmark` → `output` (text, JSON, tables and
pictures of every result) → `cli`. Each imports only folders before it. A result names its output functions,
which are imported when needed.
"""

import functools
from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from apc.distribution import program_version

        return program_version()
    lookup, _, public = _attached()
    if name == "__all__":
        return public
    from apc.renamed import FUNCTIONS

    if name in FUNCTIONS:
        raise AttributeError(f"apc.{name} is named apc.{FUNCTIONS[name]} now")
    return lookup(name)


def __dir__() -> list[str]:
    _, public, _ = _attached()
    return list(public())


@functools.cache
def _attached() -> Any:
    """Import public names on first use: commands do not use them, and import only their own modules."""
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)
