"""The commands `apc check` and `apc compile`.

Takes: words of a command line. Gives: text on stdout, a compiled model in the folder of its topology.
Guarantees: no file is written if there is an error.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

import click

from apc.cli.options import command, echo, option
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import recording
from apc.compiler.wording import counted

STAGES = ("source", "topology", "flat", "clocked", "sorted", "compiled")


@command
def check_command(
    *,
    file: str | None,
) -> None:
    """Check a topology or component and report every error.

    Writes no file. Exit code 0 without errors, 1 otherwise.
    """
    from apc.analysis.nonlinear_elements import replaced_elements
    from apc.compiler.pipeline import check_definition, compile_topology
    from apc.inputs.open_model import find_input
    from apc.lifting.start_checks import check_values
    from apc.output.analysis_output import warning_lines

    path = find_input(file, compiled_too=False)
    if text := check_definition(path):
        echo(f"{path}: no errors ({text})")
        return
    model = compile_topology(path)
    check_values(model)
    if model.experiment.joins or model.experiment.leaves:
        from apc.simulation.simulation import check_joins_and_leaves

        check_joins_and_leaves(model)
    echo(f"{path}: no errors ({model.name}, {counted(model.peers, 'peer')})")
    for line in warning_lines((*model.warnings, *replaced_elements(model))):
        echo(line)


@command
def compile_command(
    *,
    file: str | None,
    until: str = option(
        "Stop after a stage and print its result.",
        "STAGE",
        type=click.Choice(STAGES),
        default="compiled",
        show_default=False,
    ),
    force: bool = option("Compile even if NAME.apc is up to date."),
) -> None:
    """Compile a topology, NAME.yaml, to a model, NAME.apc.

    Prints the model size: states, delays and packets per peer, and the sizes
    of the decoupled subsystems. A model that is up to date is not compiled
    again, except with --force or --timings.

    \b
    STAGE  source, topology, flat, clocked, sorted
    """
    from apc.inputs.open_model import check_model_name, compiled_already, find_input

    path = find_input(file, compiled_too=False)
    if until != "compiled":
        from apc.compiler.pipeline import run_stages
        from apc.compiler.view.stages import describe

        echo(describe(run_stages(path, until=until)))  # type: ignore[arg-type] # click checked the word
        return
    if path.suffix == ".apc":
        raise ApcError(
            Diagnostic(
                "E614", SourceLocation(str(path)), "file is a compiled model", fix=f"apc analyze {path}"
            )
        )
    if not (force or recording()) and compiled_already(path):
        echo(f"{path} → {path.with_suffix('.apc')}: up to date (--force compiles again)")
        return
    check_model_name(path)
    with at_work("compiling"):
        _compile(path)


def _compile(path: Path) -> None:
    """Compile, check, save and report."""
    from apc.analysis.model_size import model_size
    from apc.compiler.pipeline import compile_topology
    from apc.compiler.store import save
    from apc.lifting.start_checks import check_values
    from apc.output.analysis_output import compile_text

    model = compile_topology(path)
    check_values(model)
    save(model, target := path.with_suffix(".apc"), compiled=True)
    echo("\n".join(compile_text(model, model_size(model), target)))
