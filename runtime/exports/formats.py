"""The table of export formats, with their export functions.

Takes: a `Model`, the destination and the options.
Gives: `Format`, `FORMATS`; `ExportRequest`; `format_of`, `export`.
Guarantees: a format is chosen by its name or by the suffix, which agree; an option that does not apply to a
format is refused; the export function of a format is imported when it is used.
Does not: export anything itself.

A new format is a line of the table (name, suffix, description, applicable options) and a case of
`_export_functions`: a function that returns a result for a model and the options, and a function that writes
the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.network.nominal_criterion import refuse_range
from apc.result import Result
from apc.support.suffixes import check_suffix


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """The options of an export, each "" or () by default.

    `open_at` is the link or coupler where the loop is cut, `symbolic` are the parameters that stay symbolic.
    `peer` is the only exported peer, `device` its external device, `method` the integration of its other
    parts.
    """

    open_at: str = ""
    symbolic: tuple[str, ...] = ()
    peer: str = ""
    device: str = ""
    method: str = ""


@dataclass(frozen=True, slots=True)
class Format:
    """A format: its name, its suffix, its description, and the applicable fields of `ExportRequest`."""

    name: str
    suffix: str
    description: str
    takes: tuple[str, ...]


FORMATS = (
    Format("control", ".py", "a script that creates a control.StateSpace", ("open_at",)),
    Format("mat", ".mat", "a state space for MATLAB and SciPy", ("open_at", "symbolic")),
    Format("npz", ".npz", "a state space for NumPy", ("open_at", "symbolic")),
    Format("modelica", ".mo", "a flat model of Modelica 3.3 with clocks", ()),
    Format("c", ".c", "one tick of a peer in C99, a header and a driver", ("peer", "device", "method")),
    Format("fmu", ".fmu", "a topology or a peer for co-simulation", ("peer", "method")),
)


def _export_functions(name: str) -> tuple[Callable[..., Result], Callable[[Path, Any], None]]:
    """Return the function that creates the export of a model and options, and the function that writes it."""
    match name:
        case "modelica":
            from apc.exports.modelica import modelica, write_modelica

            return modelica, write_modelica
        case "c":
            from apc.exports.code import peer_code, write_code

            return peer_code, write_code
        case "fmu":
            from apc.exports.code import topology_unit
            from apc.exports.fmu import write_fmu

            return topology_unit, write_fmu
    from apc.exports.state_space_files import write_mat, write_npz, write_script
    from apc.exports.symbolic_parameters import state_space_of

    return state_space_of, {"control": write_script, "mat": write_mat, "npz": write_npz}[name]


def format_of(to: str | None, out: Path | None, *, option: str = "--") -> Format:
    """Return the format given by a name or a suffix.

    Parameters
    ----------
    to
        The name, None to use the suffix.
    out
        The file, None if nothing is written.
    option
        The notation of options: "--" before, or "=" after, the name.

    Raises
    ------
    ApcError
        E952 no such format; E878 an unknown suffix, or that of another format.
    """
    names = [item.name for item in FORMATS]
    written = "--out" if option == "--" else "out="
    if to is None:
        if out is None:
            raise ApcError(
                Diagnostic("E952", SourceLocation("export"), "no format given", f"one of {', '.join(names)}")
            )
        suffix = check_suffix(out, [item.suffix for item in FORMATS], written)
        return next(item for item in FORMATS if item.suffix == suffix)
    result = next((item for item in FORMATS if item.name == to), None)
    if result is None:
        near = nearest(to, names) or names[0]
        location = SourceLocation("--to" if option == "--" else "to")
        raise ApcError(
            Diagnostic(
                "E952", location, "format", f"one of {', '.join(names)}", to[:40], f"{location} {near}"
            )
        )
    if out is not None:
        check_suffix(out, [result.suffix], written)
    return result


def export(model: Model, chosen: Format, request: ExportRequest, out: Path | None = None) -> Result:
    """Return the export of a model in a format, written to a file if `out` is given.

    Parameters
    ----------
    model
        The model.
    chosen, request
        The format, from `format_of`, and the export options.
    out
        The file; None writes nothing.

    Raises
    ------
    ApcError
        E953 an option that does not apply to the format; E899 a delay that is a range; E601 the file cannot
        be written; and those of the export function.
    """
    for name in ExportRequest.__slots__:
        if getattr(request, name) and name not in chosen.takes:
            able = ", ".join(item.name for item in FORMATS if name in item.takes)
            option = f"--{name.replace('_', '-')}"
            message = f"{option} has no effect for the format {chosen.name}"
            raise ApcError(
                Diagnostic("E953", SourceLocation(option), message, fix=f"--to {able}" if able else "")
            )
    refuse_range(model)
    make, write = _export_functions(chosen.name)
    result = make(model, **{name: getattr(request, name) for name in chosen.takes})
    if out is not None:
        write(out, result)
    return result
