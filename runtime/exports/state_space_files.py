"""A state space as an object of python-control, and as files that Python, SciPy and MATLAB read.

Takes: a `StateSpace`. Gives: `as_control`; `write_script`, `write_mat`, `write_npz`.
Guarantees: a file is written completely or not at all; no name of a model is executed as Python code; nothing
is pickled. All contain the same: A, B, C, D, dt in seconds, names and SI units, and the provenance.
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
from apc.support.optional import need

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
    """Write a Python script that creates a `control.StateSpace`. Raises ApcError (E601)."""
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
    """Write a MAT-file. Raises ApcError: E601 if it cannot be written, E951 if a variable is too large."""
    if max(matrix.nbytes for matrix in state_space.matrices) > LARGEST_MAT:
        message = "A is larger than 2 GiB, the limit of a variable in a MAT-file"
        raise ApcError(Diagnostic("E951", SourceLocation(str(path)), message, fix="--to npz"))
    from scipy.io import savemat

    variables = {
        name: np.array(item, dtype=object).reshape(-1, 1) if isinstance(item, list) else item
        for name, item in _variables(state_space).items()
    }
    # The temporary file has another suffix, and SciPy would append its own.
    write_file(path, lambda temporary: savemat(temporary, variables, appendmat=False, do_compression=True))


def write_npz(path: Path, state_space: StateSpace) -> None:
    """Write an archive of arrays, without pickles. Raises ApcError (E601)."""
    arrays: dict[str, Any] = {
        name: np.array(item, dtype=np.str_) if isinstance(item, list | str) else np.asarray(item)
        for name, item in _variables(state_space).items()
    }

    def write(temporary: Path) -> None:
        """Write the arrays to a temporary file."""
        with temporary.open("wb") as file:  # NumPy would append its suffix to a file name
            np.savez_compressed(file, **arrays)

    write_file(path, write)


def _named(state_space: StateSpace) -> list[tuple[str, tuple[ExportedSignal, ...]]]:
    """Return the signals of a state space by category: states, inputs and outputs."""
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
