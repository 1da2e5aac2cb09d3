"""A state space as python-control's, and as files that Python, SciPy and MATLAB read.

Takes: a `StateSpace`. Gives: `as_control`; `write_script`, `write_mat`, `write_npz`.
Guarantees: a file is there whole or not at all; no name out of a scene is read as Python's text; nothing is
pickled. All hold the same: A, B, C, D, dt in seconds, names and SI units, and what made them.
Does not: compute.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_file, write_text
from apc.exports.words import identifier, words
from apc.optional import need

if TYPE_CHECKING:
    from apc.exports.lifted import StateSpace

LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB

_SCRIPT = '''\
"""{title}

{told}

    from {module} import system          # a control.StateSpace
    print(system.poles())
"""

import control

dt = {dt!r}  # s, the sample time: a frame

# The names as apc has them, with their units; python-control takes letters, digits and _ only.
states = {states}
inputs = {inputs}
outputs = {outputs}

A = {a}
B = {b}
C = {c}
D = {d}

made_by = {made_by}

state_words = {state_words}
input_words = {input_words}
output_words = {output_words}

system = control.StateSpace(
    *(A, B, C, D, dt),
    name={name},
    states=state_words,
    inputs=input_words,
    outputs=output_words,
)
'''


def as_control(found: StateSpace) -> Any:
    """Return a state space as `control.StateSpace`. Raises ApcError (E875) without python-control."""
    control = need("control", "control")
    return control.StateSpace(
        *(found.a, found.b, found.c, found.d, found.frame_s),
        name=identifier(found.topology),
        states=words(found.states),
        inputs=words(found.inputs),
        outputs=words(found.outputs),
    )


def write_script(path: Path, found: StateSpace) -> None:
    """Write a Python script that makes a `control.StateSpace`. Raises ApcError (E601)."""
    ports = {"states": found.states, "inputs": found.inputs, "outputs": found.outputs}
    matrices = zip("abcd", found.matrices, strict=True)
    text = _SCRIPT.format(
        title=_quotable(f"{found.topology}, {found.what}, as a state space."),
        told=_quotable("\n".join(textwrap.fill(one, 100) for one in (found.meaning, *found.notes))),
        module=path.stem if path.stem.isidentifier() else "this_file",
        dt=found.frame_s,
        **{name: _listed(repr(row) for row in (matrix + 0.0).tolist()) for name, matrix in matrices},
        **{
            name: _listed(f"({json.dumps(one.name)}, {json.dumps(one.unit)})" for one in listed)
            for name, listed in ports.items()
        },
        **{
            f"{name.removesuffix('s')}_words": _listed(map(json.dumps, words(listed)))
            for name, listed in ports.items()
        },
        made_by=json.dumps(found.made_by),
        name=json.dumps(identifier(found.topology)),
    )
    write_text(path, text.rstrip("\n"))


def write_mat(path: Path, found: StateSpace) -> None:
    """Write a MAT-file. Raises ApcError: E601 where it can't be, E951 where it is too large."""
    if max(matrix.nbytes for matrix in found.matrices) > LARGEST_MAT:
        what = "a variable of a MAT-file holds less than 2 GiB, and A is larger"
        raise ApcError(Mistake("E951", Place(str(path)), what, hint="--to npz"))
    from scipy.io import savemat

    variables = {
        name: np.array(one, dtype=object).reshape(-1, 1) if isinstance(one, list) else one
        for name, one in _variables(found).items()
    }
    # The name has another suffix until the file is whole, and SciPy would add its own.
    write_file(path, lambda temporary: savemat(temporary, variables, appendmat=False, do_compression=True))


def write_npz(path: Path, found: StateSpace) -> None:
    """Write an archive of arrays, without pickles. Raises ApcError (E601)."""
    arrays: dict[str, Any] = {
        name: np.array(one, dtype=np.str_) if isinstance(one, list | str) else np.asarray(one)
        for name, one in _variables(found).items()
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # NumPy would add its suffix to a name
            np.savez_compressed(file, **arrays)

    write_file(path, write)


def _variables(found: StateSpace) -> dict[str, Any]:
    """Return what a file of arrays holds, by name."""
    variables: dict[str, Any] = dict(zip("ABCD", found.matrices, strict=True))
    variables["dt"] = found.frame_s
    for name, ports in (("states", found.states), ("inputs", found.inputs), ("outputs", found.outputs)):
        variables[name] = [port.name for port in ports]
        variables[f"{name.removesuffix('s')}_units"] = [port.unit for port in ports]
    variables["cut"], variables["notes"] = found.cut, [found.meaning, *found.notes]
    variables["provenance"] = found.made_by
    if found.free:
        variables["free"] = [port.name for port in found.free]
        variables["free_units"] = [port.unit for port in found.free]
        variables["casadi_function"] = found.function.serialize()
    return variables


def _listed(texts: Iterable[str]) -> str:
    """Return texts as a list of Python, one a line; JSON's texts are texts of Python too."""
    return f"[\n{''.join(f'    {text},' + chr(10) for text in texts)}]"


def _quotable(text: str) -> str:
    """Return a text that can't end the text it stands in."""
    return text.replace("\\", "/").replace('"', "'")
