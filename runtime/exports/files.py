"""A state space as python-control's, and as files that Python, SciPy and MATLAB read.

Takes: a `StateSpace`. Gives: `as_control`; `write_script`, `write_mat`, `write_npz`.
Guarantees: a file is there whole or not at all; no name out of a scene is read as Python's text; nothing is
pickled. All hold the same: A, B, C, D, dt in seconds, names and SI units, and what made them.
Does not: compute.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_file, write_text
from apc.exports.words import word, words
from apc.optional import need

if TYPE_CHECKING:
    from apc.exports.lifted import StateSpace
    from apc.exports.words import Port

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


system = control.StateSpace(
    *(A, B, C, D, dt),
    name={name},
    states={state_words},
    inputs={input_words},
    outputs={output_words},
)
'''


def as_control(found: StateSpace) -> Any:
    """Return a state space as `control.StateSpace`. Raises ApcError (E875) without python-control."""
    control = need("control", "control")
    return control.StateSpace(
        *(found.a, found.b, found.c, found.d, found.frame_s),
        name=word(found.topology),
        states=words(found.states),
        inputs=words(found.inputs),
        outputs=words(found.outputs),
    )


def write_script(path: Path, found: StateSpace) -> None:
    """Write a Python script that makes a `control.StateSpace`. Raises ApcError (E601)."""
    listed = (words(ports) for ports in (found.states, found.inputs, found.outputs))
    state_words, input_words, output_words = map(_listed, listed)
    text = _SCRIPT.format(
        title=_quotable(f"{found.topology}, {found.what}, as a state space."),
        told=_quotable("\n".join(textwrap.fill(one, 100) for one in (found.meaning, *found.notes))),
        module=path.stem if path.stem.isidentifier() else "this_file",
        dt=found.frame_s,
        states=_pairs(found.states),
        inputs=_pairs(found.inputs),
        outputs=_pairs(found.outputs),
        **{name: _rows(matrix) for name, matrix in zip("abcd", found.matrices, strict=True)},
        made_by=json.dumps(found.made_by),
        name=json.dumps(word(found.topology)),
        state_words=state_words,
        input_words=input_words,
        output_words=output_words,
    )
    write_text(path, text.rstrip("\n"))


def write_mat(path: Path, found: StateSpace) -> None:
    """Write a MAT-file. Raises ApcError: E601 where it can't be, E951 where it is too large."""
    if max(matrix.nbytes for matrix in found.matrices) > LARGEST_MAT:
        what = "a variable of a MAT-file holds less than 2 GiB, and A is larger"
        raise ApcError(Mistake("E951", Place(str(path)), what, hint="--to npz"))
    from scipy.io import savemat

    variables: dict[str, Any] = {
        name: np.array(one, dtype=object).reshape(-1, 1) if isinstance(one, list) else one
        for name, one in _variables(found).items()
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            savemat(file, variables, do_compression=True)

    write_file(path, write)


def write_npz(path: Path, found: StateSpace) -> None:
    """Write an archive of arrays, without pickles. Raises ApcError (E601)."""
    arrays = {
        name: np.array(one, dtype=np.str_) if isinstance(one, list | str) else np.asarray(one)
        for name, one in _variables(found).items()
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type] # its stubs forget what it takes

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


def _rows(matrix: Any) -> str:
    """Return a matrix as rows of numbers that are read back to the last bit."""
    rows = [f"    [{', '.join(map(repr, row))}],\n" for row in (matrix + 0.0).tolist()]
    return f"[\n{''.join(rows)}]"


def _pairs(ports: Sequence[Port]) -> str:
    """Return names with their units, as text of Python: JSON's texts are texts of Python too."""
    rows = [f"    ({json.dumps(port.name)}, {json.dumps(port.unit)}),\n" for port in ports]
    return f"[\n{''.join(rows)}]"


def _listed(words: Sequence[str]) -> str:
    return f"[\n{''.join(f'        {json.dumps(word)},' + chr(10) for word in words)}    ]"


def _quotable(text: str) -> str:
    """Return a text that can't end the text it stands in."""
    return text.replace("\\", "/").replace('"', "'")
