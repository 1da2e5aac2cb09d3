"""Writing of a topology with new values, for commands that determine values.

Takes: a model, values by parameter, the settings of the command.
Gives: `check_topology_name`, `write_values`.
Guarantees: a name that is no YAML file is refused before anything is computed.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from apc.compiler.compiled import Model


def check_topology_name(path: Path | None, ending: str) -> None:
    """Raise ApcError E996 if a path to write is no YAML file; `ending` completes the name in the fix."""
    if path is not None and path.suffix not in (".yaml", ".yml"):
        message, got, fix = "suffix of --write", path.suffix or "none", f"--write {path.stem}-{ending}.yaml"
        raise ApcError(Diagnostic("E996", SourceLocation(str(path)), message, ".yaml", got, fix))


def write_values(
    model: Model, values: Mapping[str, tuple[float, str]], settings: Sequence[str], path: Path
) -> None:
    """Write the topology of a model with new values and the settings of the command.

    Parameters
    ----------
    model
        The model of the command.
    values
        The new values and their units in SI, by name.
    settings
        The settings, each `NAME=QUANTITY`.
    path
        The file to write.

    Raises
    ------
    ApcError
        As `write_topology`.
    """
    from apc.app.yaml_edit import write_topology
    from apc.compiler.pipeline import compile_again
    from apc.compiler.wording import with_unit
    from apc.parameter_values.overrides import parse_override
    from apc.parameter_values.parameter_names import HELD, find

    as_written = compile_again(replace(model.origin, changes=()), path.parent)
    # The numbers of the hand of --hands held are of no topology.
    names = {setting.partition("=")[0].strip() for setting in settings} - set(HELD)
    names |= {parameter.name for parameter in as_written.parameters}
    quantities = {
        parse_override(as_written, setting).free: setting.partition("=")[2].strip()
        for setting in settings
        if setting.partition("=")[0].strip() in names
    }
    for name, (value, unit) in values.items():
        quantities[find(as_written, name)] = with_unit(f"{value:.12g}", unit).removesuffix(" 1")
    (text,) = (text for name, text in model.origin.texts if name == model.origin.topology)
    write_topology(path, text.decode(), as_written, quantities)
