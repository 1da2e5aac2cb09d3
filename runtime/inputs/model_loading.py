"""The model in a file NAME.apc of any author.

Takes: an `Archive`. Gives: `loaded_model`.
Guarantees: of a file not written by this user's apc only the texts are used, and compiled again; no other
part of the file is read, and no other file except the built-in library.
Does not: check whether the texts have changed since (see `inputs`).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.cache import EQUILIBRIUM_CHANGE, HANDS_CHANGE, Archive, program_digest

if TYPE_CHECKING:
    from apc.compiler.compiled import Model


def loaded_model(archive: Archive, folder: Path) -> Model:
    """Return the model of a file: the stored model if written by this user's apc, else compiled again.

    Parameters
    ----------
    archive
        The file.
    folder
        The folder of the file, used as the location of the texts in messages.

    Raises
    ------
    ApcError
        The texts have errors.
    """
    if archive.sealed and archive.origin.program == program_digest():
        from apc.compiler import store

        return store.opened(archive)
    from apc.compiler.pipeline import compile_again
    from apc.lifting.start_checks import check_values

    model = compile_again(archive.origin, folder)
    check_values(model)
    for change in archive.origin.changes:
        model = _reapplied(model, change)
    return model


def _reapplied(model: Model, change: Sequence[tuple[str, str]]) -> Model:
    """Return a model after a change recorded in the origin. Raises ApcError if the change is impossible."""
    from apc.lifting.devices import with_hands
    from apc.lifting.rest_position import operating_point_from
    from apc.parameter_values.overrides import Override, apply
    from apc.parameter_values.parameter_names import find

    for name, value in change:
        if name == HANDS_CHANGE:
            return with_hands(model, value)
        if name == EQUILIBRIUM_CHANGE:  # from the start values, wherever the search began
            return operating_point_from(model).model
    pairs = [(find(model, name, counts=True), Fraction(value)) for name, value in change]
    return apply(model, [Override(free, value) for free, value in pairs])
