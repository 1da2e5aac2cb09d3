"""What a scene can be handed over as: the table of formats, and who makes each.

Takes: a `Model`, where it goes and what is asked of it.
Gives: `Format`, `FORMATS`; `ExportRequest`; `format_of`, `export`.
Guarantees: a format is chosen by its name or by the suffix, which agree; an option that means nothing to a
format is refused; a maker is imported when it is asked for.
Does not: make anything itself.

A new format is a line of the table, its name, its suffix, what it is, the options it takes, and a case of
`_makers`: a function that makes a result of a compiled scene and what is asked, and one that writes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.network.nominal import refuse_range
from apc.result import Result
from apc.suffixes import check_suffix


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """What is asked of an export, each "" or () where it is not: where to `cut` the loop, `free` numbers.

    `peer` is one alone, `device` what its computer doesn't move, `method` how it moves the others.
    """

    cut: str = ""
    free: tuple[str, ...] = ()
    peer: str = ""
    device: str = ""
    method: str = ""


@dataclass(frozen=True, slots=True)
class Format:
    """A format: its name, its suffix, what it is, and which fields of `ExportRequest` apply to it."""

    name: str
    suffix: str
    about: str
    takes: tuple[str, ...]


FORMATS = (
    Format("control", ".py", "a script that makes a control.StateSpace", ("cut",)),
    Format("mat", ".mat", "a state space for MATLAB and SciPy", ("cut", "free")),
    Format("npz", ".npz", "a state space for NumPy", ("cut", "free")),
    Format("modelica", ".mo", "a flat model of Modelica 3.3 with clocks", ()),
    Format("c", ".c", "one tick of a peer in C99, a header and a driver", ("peer", "device", "method")),
    Format("fmu", ".fmu", "a scene or a peer for co-simulation", ("peer", "method")),
)


def _makers(name: str) -> tuple[Callable[..., Result], Callable[[Path, Any], None]]:
    """Return what makes a format of a compiled scene and what is asked of it, and what writes it."""
    match name:
        case "modelica":
            from apc.exports.modelica import modelica, write_modelica

            return modelica, write_modelica
        case "c":
            from apc.exports.code import peer_code, write_code

            return peer_code, write_code
        case "fmu":
            from apc.exports.code import scene_unit
            from apc.exports.fmu import write_fmu

            return scene_unit, write_fmu
    from apc.exports.free import state_space_of
    from apc.exports.state_space_files import write_mat, write_npz, write_script

    return state_space_of, {"control": write_script, "mat": write_mat, "npz": write_npz}[name]


def format_of(to: str | None, out: Path | None, *, option: str = "--") -> Format:
    """Return the format that a name or a suffix says.

    Parameters
    ----------
    to
        The name, None if the suffix says it.
    out
        The file, None if nothing is written.
    option
        How options are written: "--" before or "=" behind.

    Raises
    ------
    ApcError
        E952 no such format; E878 a suffix that is none, or another one's.
    """
    names = [item.name for item in FORMATS]
    written = "--out" if option == "--" else "out="
    if to is None:
        if out is None:
            raise ApcError(
                Diagnostic(
                    "E952", SourceLocation("export"), "no format is named", f"one of {', '.join(names)}"
                )
            )
        suffix = check_suffix(out, [item.suffix for item in FORMATS], written)
        return next(item for item in FORMATS if item.suffix == suffix)
    result = next((item for item in FORMATS if item.name == to), None)
    if result is None:
        near = nearest(to, names) or names[0]
        place = SourceLocation("--to" if option == "--" else "to")
        raise ApcError(
            Diagnostic("E952", place, "a format", f"one of {', '.join(names)}", to[:40], f"{place} {near}")
        )
    if out is not None:
        check_suffix(out, [result.suffix], written)
    return result


def export(system: Model, chosen: Format, asked: ExportRequest, out: Path | None = None) -> Result:
    """Make what a format says of a scene, and write it.

    Parameters
    ----------
    system
        The compiled scene.
    chosen, asked
        The format, from `format_of`, and what is asked of it.
    out
        The file; None writes nothing.

    Raises
    ------
    ApcError
        E953 an option that means nothing to the format; E899 a delay that is a range; E601 the file can't
        be written; and the maker's.
    """
    for name in ExportRequest.__slots__:
        if getattr(asked, name) and name not in chosen.takes:
            able = ", ".join(item.name for item in FORMATS if name in item.takes)
            what = f"--{name} means nothing to the format {chosen.name}"
            raise ApcError(
                Diagnostic("E953", SourceLocation(f"--{name}"), what, hint=f"--to {able}" if able else "")
            )
    refuse_range(system)
    make, write = _makers(chosen.name)
    parameter = make(system, **{name: getattr(asked, name) for name in chosen.takes})
    if out is not None:
        write(out, parameter)
    return parameter
