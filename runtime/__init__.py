"""apc: networked haptic cooperation, described in YAML, compiled, and analyzed.

>>> model = apc.compile("three-users-average.yaml")
>>> apc.analyze(model).verdict
'stable up to a common translation'

Each function corresponds to the command of the same name; results are frozen.

The compiler (YAML to CasADi) is `compiler`. Then one folder per subject: `parameter_values`,
`linearization`, `timing`, `lifting` (one peer over one frame) → `network` (lost and late packets) →
`spectrum` (all peers) → `analysis` → `mean_square`, `haptics`, `simulation`, `studies` (many verdicts),
`regions`, `tuning` → `benchmark` → `output` (text, JSON, tables and pictures of every result) → `cli`. Each
imports only folders before it. A result names its output functions,
which are imported when needed.
"""

import functools
from typing import Any


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from apc.support.distribution import program_version

        return program_version()
    lookup, _, public = _attached()
    if name == "__all__":
        return public
    from apc.support.renamed import FORMER_FUNCTIONS

    if name in FORMER_FUNCTIONS:
        raise AttributeError(f"unknown function apc.{name}; its present name is apc.{FORMER_FUNCTIONS[name]}")
    return lookup(name)


def __dir__() -> list[str]:
    _, public, _ = _attached()
    return list(public())


@functools.cache
def _attached() -> Any:
    """Return the lazy loader of the public names: commands do not use them, and import only their own
    modules.
    """
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)
