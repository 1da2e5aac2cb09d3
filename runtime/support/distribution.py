"""The distribution name of the program, and the command that installs optional libraries.

Takes: nothing. Gives: `DISTRIBUTION`, `program_version`, `versions`, `install_line`.
Guarantees: the name of the distribution is defined only here; it differs from the package and the command
`apc`, because the package index has another project of this name.
Does not: install anything.
"""

from __future__ import annotations

DISTRIBUTION = "apc-haptics"


def program_version() -> str:
    """Return the version of the installed program."""
    return versions()[0][1]


def versions(*libraries: str) -> tuple[tuple[str, str], ...]:
    """Return the names and versions of the program and of libraries."""
    from importlib.metadata import version  # a slow import (email): most commands print no version

    return (("apc", version(DISTRIBUTION)), *((name, version(name)) for name in libraries))


def install_line(extra: str) -> str:
    """Return the command line that installs an extra of pyproject.toml, from the checkout."""
    return f"pip install '.[{extra}]'  # in the folder of apc's own pyproject.toml"
