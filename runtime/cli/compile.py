"""The commands `apc check` and `apc compile`.

Takes: words of a command line. Gives: text on stdout, a compiled model beside its topology.
Guarantees: nothing is written where there is a mistake.
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
    """Report every mistake in a topology or component; write nothing.

    Exit code 0 if there is none, 1 otherwise.
    """
    from apc.analysis.nonlinear_elements import replaced_elements
    from apc.compiler.pipeline import check_definition, compile_topology
    from apc.frame.start_checks import check_values
    from apc.inputs import find_input
    from apc.output.analysis_output import warning_lines

    path = find_input(file, compiled_too=False)
    if text := check_definition(path):
        echo(f"{path}: no mistakes. {text}.")
        return
    system = compile_topology(path)
    check_values(system)
    echo(f"{path}: no mistakes. {system.name}, {counted(system.peers, 'peer')}.")
    for line in warning_lines((*system.warnings, *replaced_elements(system))):
        echo(line)


@command
def compile_command(
    *,
    file: str | None,
    until: str = option(
        f"Stop after a stage, print what it made and write nothing. One of {', '.join(STAGES[:-1])}.",
        "STAGE",
        type=click.Choice(STAGES),
        default="compiled",
        show_default=False,
    ),
    force: bool = option("Compile even if nothing has changed since it was compiled."),
) -> None:
    """Turn a topology into equations: NAME.yaml to NAME.apc beside it.

    Prints what the topology needed: states, delays and packets kept for a peer,
    and how large the systems are that decide its stability. Compiles nothing
    if the topology, every file it names and apc itself are as they were, and
    no --timings are asked for.
    """
    from apc.inputs import check_model_name, compiled_already, find_input

    path = find_input(file, compiled_too=False)
    if until != "compiled":
        from apc.compiler.pipeline import run_stages
        from apc.compiler.view.stages import describe

        echo(describe(run_stages(path, until=until)))  # type: ignore[arg-type] # click checked the word
        return
    if path.suffix == ".apc":
        raise ApcError(
            Diagnostic("E614", SourceLocation(str(path)), "is compiled already", hint=f"apc analyze {path}")
        )
    if not (force or recording()) and compiled_already(path):
        echo(f"{path} → {path.with_suffix('.apc')}: unchanged, not compiled again (--force does)")
        return
    check_model_name(path)
    with at_work("compiling"):
        _compile(path)


def _compile(path: Path) -> None:
    """Compile, check, save and report."""
    from apc.analysis.model_size import model_size
    from apc.compiler.pipeline import compile_topology
    from apc.compiler.store import save
    from apc.frame.start_checks import check_values
    from apc.output.analysis_output import compile_text

    system = compile_topology(path)
    check_values(system)
    save(system, target := path.with_suffix(".apc"), compiled=True)
    echo("\n".join(compile_text(system, model_size(system), target)))
