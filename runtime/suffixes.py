"""Which file names a command can write to.

Takes: the path given to an option, and the suffixes it may have. Gives: `check_suffix`.
Guarantees: a file of an unknown suffix is never written as something else.
Does not: write.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from apc.compiler.errors import ApcError, Mistake, Place


def check_suffix(path: Path, known: Iterable[str], option: str) -> None:
    """Refuse a file whose suffix is not among `known`, the first of which is proposed: ApcError E878."""
    names = tuple(known)
    if path.suffix.lower() not in names:
        wanted = names[0] if len(names) == 1 else f"one of {', '.join(names)}"
        what, hint = f"the suffix of {option}", f"{option} {path.with_suffix(names[0])}"
        raise ApcError(Mistake("E878", Place(str(path)), what, wanted, path.suffix or "none", hint))
