"""The commands: what they take, what they call, what they print.

Takes: words of a command line. Gives: text on stdout, messages on stderr.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute, or decide exit codes (see `__main__`).
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from apc.cli.analyze import analyze_command
from apc.cli.bench import bench_command
from apc.cli.compare import compare_command
from apc.cli.critical import critical_command
from apc.cli.explore import explore_command
from apc.cli.export import export_command
from apc.cli.feel import feel_command
from apc.cli.library import library_command, new_command
from apc.cli.network import network_command
from apc.cli.options import Group, beside, file_argument, file_option, tell
from apc.cli.play import play_command
from apc.cli.progress import at_work
from apc.cli.region import region_command
from apc.cli.report import report_command
from apc.cli.simulate import simulate_command
from apc.cli.sweep import sweep_command
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_text
from apc.compiler.timings import recording
from apc.compiler.words import counted
from apc.present.forms import json_text
from apc.suffixes import check_suffix
from apc.threads import start_single_threaded

STAGES = ("source", "scene", "flat", "clocked", "sorted", "compiled")
FORMATS = {".txt": "text", ".json": "json", ".dot": "dot", ".gv": "dot", ".svg": "svg"}
FORMATS |= {".png": "picture", ".pdf": "picture"}
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 80}


def _print_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted:
        from apc.distribution import program_version

        tell(f"apc {program_version()}")
        context.exit()


@click.group(cls=Group, context_settings=CONTEXT)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the version.",
)
def apc() -> None:
    """Is a shared virtual object stable in the hands of all its users?

    Describe users, masses, couplers and network links in a YAML file, a
    topology. Compile it to equations and read the verdict:

    \b
        apc new            write a topology.yaml to start from
        apc compile        check it and turn it into topology.apc
        apc analyze        stable or not, by how much, in which modes
        apc critical       the largest stable value of a parameter
        apc compare        schemes side by side: the same asked of several files
        apc explore        all of it in the browser, with sliders
        apc feel           what a hand feels at its device, at each frequency
        apc simulate       what happens over time, as rows and a picture
        apc region         where it is stable over two parameters: curves, areas
        apc sweep          any of it at many values of some parameters
        apc network        what a recording of ping or irtt amounts to
        apc play           the same in real time, over a network
        apc export         files that other tools read
        apc report         all of it as one page, to keep and to mail
        apc show           what the scene is made of, as text or a picture
        apc library        the components there are, and what one is

    Without FILE a command takes the only topology of the folder.
    """


apc.add_command(analyze_command)
apc.add_command(bench_command)
apc.add_command(compare_command)
apc.add_command(critical_command)
apc.add_command(export_command)
apc.add_command(explore_command)
apc.add_command(feel_command)
apc.add_command(library_command)
apc.add_command(new_command)
apc.add_command(report_command)
apc.add_command(simulate_command)
apc.add_command(network_command)
apc.add_command(play_command)
apc.add_command(region_command)
apc.add_command(sweep_command)


@apc.command()
@file_argument
def check(file: str | None) -> None:
    """Report every mistake in a topology or component; write nothing.

    Exit code 0 if there is none, 1 otherwise.
    """
    start_single_threaded()
    from apc.analysis.selfcheck import check_frame
    from apc.compiler.pipeline import check_definition, compile_topology
    from apc.inputs import find_input

    path = Path(file) if file else find_input(compiled_too=False)
    if found := check_definition(path):
        tell(f"{path}: no mistakes. {found}.")
        return
    system = compile_topology(path)
    check_frame(system)
    tell(f"{path}: no mistakes. {system.name}, {counted(system.peers, 'peer')}.")


@apc.command("compile")
@file_argument
@click.option(
    "--until",
    type=click.Choice(STAGES),
    default="compiled",
    metavar="STAGE",
    help=f"Stop after a stage, print what it made and write nothing. One of {', '.join(STAGES[:-1])}.",
)
@click.option("--force", is_flag=True, help="Compile even if nothing has changed since it was compiled.")
def compile_command(file: str | None, until: str, force: bool) -> None:
    """Turn a topology into equations: NAME.yaml to NAME.apc beside it.

    Prints what the scene needed: states, delays and packets kept for a peer,
    and how large the systems are that decide its stability. Compiles nothing
    if the topology, every file it names and apc itself are as they were, and
    no --timings are asked for.
    """
    start_single_threaded()
    from apc.inputs import check_model_name, compiled_already, find_input

    path = Path(file) if file else find_input(compiled_too=False)
    if until != "compiled":
        from apc.compiler.pipeline import run_stages
        from apc.compiler.view.stages import describe

        tell(describe(run_stages(path, until=until)))  # type: ignore[arg-type] # click checked the word
        return
    if path.suffix == ".apc":
        raise ApcError(Mistake("E614", Place(str(path)), "is compiled already", hint=f"apc analyze {path}"))
    if not (force or recording()) and compiled_already(path):
        tell(f"{path} → {path.with_suffix('.apc')}: unchanged, not compiled again (--force does)")
        return
    check_model_name(path)
    with at_work("compiling"):
        _compile(path)


def _compile(path: Path) -> None:
    """Compile, check, save and report."""
    from apc.analysis.needs import needs
    from apc.analysis.selfcheck import check_frame
    from apc.compiler.pipeline import compile_topology
    from apc.compiler.store import save
    from apc.present.analysis import compile_text

    system = compile_topology(path)
    difference = check_frame(system)
    save(system, target := path.with_suffix(".apc"), sealed=True)
    tell(compile_text(system, needs(system), target, difference))


@apc.command()
@file_argument
@click.option(
    "--format",
    "format_",
    type=click.Choice(["text", "json", "dot", "svg"]),
    help="text: graph, equations, schedule. json: the same as one document. dot: the graph for Graphviz. "
    "svg: the graph as a picture. Taken from --out if not given, else text.",
)
@click.option(
    "--parameters",
    is_flag=True,
    help="List what may be set instead: names, values, units, limits; as text or json.",
)
@file_option("--out", "Write to this file: .txt .json .dot .svg, or as a picture .png .pdf.")
def show(file: str | None, format_: str | None, parameters: bool, out: Path | None) -> None:
    """Show what a scene is made of: its graph, equations and schedule.

    The graph has the parts of one peer and how they are joined, and the
    peers and the links between them. The schedule says what ticks when, how
    long what it computes is held, and which packets are on their way.
    """
    from apc.api import show as shown
    from apc.inputs import check_topology_outputs, find_input

    wanted = format_ or "text"
    formats = {name: of for name, of in FORMATS.items() if not parameters or of in ("text", "json")}
    if out is not None and (out.suffix or not format_):
        known = [suffix for suffix in formats if format_ in (None, formats[suffix])]
        wanted = formats[check_suffix(out, known, "--out")]
    if parameters:
        _show_parameters(file, wanted, out)
        return
    path = Path(file) if file else find_input(compiled_too=False)
    check_topology_outputs(path, {"--out": out})
    if wanted == "picture":
        from apc.present.graph import save_graph

        assert out is not None
        save_graph(path, out)
        tell(f"{out} is written", err=beside(out))
        return
    _print_or_write(shown(path, format=wanted), out)  # type: ignore[arg-type] # click checked the word


def _show_parameters(file: str | None, wanted: str, out: Path | None) -> None:
    """List what may be set of a scene."""
    from apc.frame.settable import parameters
    from apc.inputs import open_scene

    if wanted not in ("text", "json"):
        raise click.UsageError("--parameters is a table: --format text or json")
    found = parameters(open_scene(file, (), {"--out": out}))
    _print_or_write(json_text(found.to_dict()) if wanted == "json" else str(found), out)


@apc.command()
@file_option("--out", "Write to this file instead of the terminal.")
def schema(out: Path | None) -> None:
    """Print the JSON Schema of topologies, for editors.

    An editor that knows YAML schemas completes and checks a topology whose
    first line is, with the schema beside it as topology.schema.json,

    \b
        # yaml-language-server: $schema=topology.schema.json

    `apc new` writes that line where the schema is.
    """
    from apc.api import schema as generated

    if out is not None:
        check_suffix(out, (".json",), "--out")
    _print_or_write(json.dumps(generated(), ensure_ascii=False, indent=1), out)


def _print_or_write(text: str, out: Path | None) -> None:
    if out is None:
        tell(text)
        return

    write_text(out, text)
    tell(f"{out} is written", err=beside(out))
