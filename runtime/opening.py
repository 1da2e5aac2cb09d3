"""The model in a file NAME.apc, whoever wrote the file.

Takes: an `Archive`. Gives: `opened`.
Guarantees: of what this user's own apc did not write only the texts are taken, and compiled; nothing else in
it is read, and no file of this machine but the built-in library.
Does not: ask whether the texts have changed since (see `inputs`).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.cache import HANDS_CHANGE, Archive, program_digest

if TYPE_CHECKING:
    from apc.compiler.compiled import Model


def opened(archive: Archive, folder: Path) -> Model:
    """Return the model of a file: its own if this user's apc wrote it, else what its texts compile to.

    Parameters
    ----------
    archive
        The file.
    folder
        Where it is: there its texts are said to stand in messages.

    Raises
    ------
    ApcError
        The mistakes of its texts.
    """
    if archive.sealed and archive.origin.program == program_digest():
        from apc.compiler import store

        return store.opened(archive)
    from apc.compiler.pipeline import compile_again
    from apc.frame.start_checks import check_values

    system = compile_again(archive.origin, folder)
    check_values(system)
    for change in archive.origin.changes:
        system = _changed_again(system, change)
    return system


def _changed_again(system: Model, change: Sequence[tuple[str, str]]) -> Model:
    """Make a change that a model's origin tells of. Raises ApcError if there can be none such."""
    from apc.frame.devices import with_hands
    from apc.frame.names import find
    from apc.frame.overrides import Override, apply

    for name, value in change:
        if name == HANDS_CHANGE:
            return with_hands(system, value)
    pairs = [(find(system, name, counts=True), Fraction(value)) for name, value in change]
    return apply(system, [Override(free, value) for free, value in pairs])
