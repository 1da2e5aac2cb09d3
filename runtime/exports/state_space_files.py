"""A state space as python-control's, and as files that Python, SciPy and MATLAB read.

Takes: a `StateSpace`. Gives: `as_control`; `write_script`, `write_mat`, `write_npz`.
Guarantees: a file is there whole or not at all; no name out of a model is read as Python's text; nothing is
pickled. All hold the same: A, B, C, D, dt in seconds, names and SI units, and what made them.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import write_file, write_text
from apc.exports.identifiers import ExportedSignal, identifier, words
from apc.exports.texts import filled
from apc.optional import need

if TYPE_CHECKING:
    from apc.exports.lifted import StateSpace

LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB


def as_control(state_space: StateSpace) -> Any:
    """Return a state space as `control.StateSpace`. Raises ApcError (E875) without python-control."""
    control = need("control", "control")
    return control.StateSpace(
        *(state_space.a, state_space.b, state_space.c, state_space.d, state_space.frame_s),
        name=identifier(state_space.topology),
        states=words(state_space.states),
        inputs=words(state_space.inputs),
        outputs=words(state_space.outputs),
    )


def write_script(path: Path, state_space: StateSpace) -> None:
    """Write a Python script that makes a `control.StateSpace`. Raises ApcError (E601)."""
    text = filled(
        "control.jinja",
        state_space=state_space,
        module=path.stem if path.stem.isidentifier() else "this_file",
        named=_named(state_space),
        words=words,
        name=identifier(state_space.topology),
    )
    write_text(path, text.rstrip("\n"))


def write_mat(path: Path, state_space: StateSpace) -> None:
    """Write a MAT-file. Raises ApcError: E601 where it can't be, E951 where it is too large."""
    if max(matrix.nbytes for matrix in state_space.matrices) > LARGEST_MAT:
        message = "a variable of a MAT-file holds less than 2 GiB, and A is larger"
        raise ApcError(Diagnostic("E951", SourceLocation(str(path)), message, hint="--to npz"))
    from scipy.io import savemat

    variables = {
        name: np.array(item, dtype=object).reshape(-1, 1) if isinstance(item, list) else item
        for name, item in _variables(state_space).items()
    }
    # The name has another suffix until the file is whole, and SciPy would add its own.
    write_file(path, lambda temporary: savemat(temporary, variables, appendmat=False, do_compression=True))


def write_npz(path: Path, state_space: StateSpace) -> None:
    """Write an archive of arrays, without pickles. Raises ApcError (E601)."""
    arrays: dict[str, Any] = {
        name: np.array(item, dtype=np.str_) if isinstance(item, list | str) else np.asarray(item)
        for name, item in _variables(state_space).items()
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # NumPy would add its suffix to a name
            np.savez_compressed(file, **arrays)

    write_file(path, write)


def _named(state_space: StateSpace) -> list[tuple[str, tuple[ExportedSignal, ...]]]:
    """Return the names in a state space, by category."""
    return [("states", state_space.states), ("inputs", state_space.inputs), ("outputs", state_space.outputs)]


def _variables(state_space: StateSpace) -> dict[str, Any]:
    """Return the contents of a file of arrays, by name."""
    variables: dict[str, Any] = dict(zip("ABCD", state_space.matrices, strict=True))
    variables["dt"] = state_space.frame_s
    for name, ports in _named(state_space):
        variables[name] = [port.name for port in ports]
        variables[f"{name.removesuffix('s')}_units"] = [port.unit for port in ports]
    variables["open_at"], variables["notes"] = state_space.open_at, [state_space.meaning, *state_space.notes]
    variables["provenance"] = state_space.made_by
    if state_space.symbolic:
        variables["symbolic"] = [port.name for port in state_space.symbolic]
        variables["symbolic_units"] = [port.unit for port in state_space.symbolic]
        variables["casadi_function"] = state_space.function.serialize()
    return variables
