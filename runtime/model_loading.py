"""The model in a file NAME.apc, whoever wrote the file.

Takes: an `Archive`. Gives: `loaded_model`.
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


def loaded_model(archive: Archive, folder: Path) -> Model:
    """Return the model of a file: the stored one if written by this user's apc, else recompiled.

    Parameters
    ----------
    archive
        The file.
    folder
        Its folder, used as the location of its texts in messages.

    Raises
    ------
    ApcError
        The errors in its texts.
    """
    if archive.sealed and archive.origin.program == program_digest():
        from apc.compiler import store

        return store.opened(archive)
    from apc.compiler.pipeline import compile_again
    from apc.frame.start_checks import check_values

    system = compile_again(archive.origin, folder)
    check_values(system)
    for change in archive.origin.changes:
        system = _reapplied(system, change)
    return system


def _reapplied(system: Model, change: Sequence[tuple[str, str]]) -> Model:
    """Apply a change recorded in a model's origin. Raises ApcError if it is impossible."""
    from apc.frame.devices import with_hands
    from apc.frame.overrides import Override, apply
    from apc.frame.parameter_names import find

    for name, value in change:
        if name == HANDS_CHANGE:
            return with_hands(system, value)
    pairs = [(find(system, name, counts=True), Fraction(value)) for name, value in change]
    return apply(system, [Override(free, value) for free, value in pairs])
