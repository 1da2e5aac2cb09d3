"""The distribution name of the program, and the command that installs optional libraries.

Takes: nothing. Gives: `DISTRIBUTION`, `program_version`, `versions`, `install_line`.
Guarantees: one place names the distribution, which is not called `apc` as the package and the command are:
the index has another project of that name.
Does not: install anything.
"""

from __future__ import annotations

DISTRIBUTION = "apc-haptics"


def program_version() -> str:
    """Return the version of the program that is installed."""
    return versions()[0][1]


def versions(*libraries: str) -> tuple[tuple[str, str], ...]:
    """Return the versions of the program and of libraries, each with its name."""
    from importlib.metadata import version  # it reads mail: most commands ask for no version

    return (("apc", version(DISTRIBUTION)), *((name, version(name)) for name in libraries))


def install_line(extra: str) -> str:
    """Return the line that installs an extra (one of pyproject.toml's), from the checkout."""
    return f"pip install '.[{extra}]'  # in the folder of apc's own pyproject.toml"
