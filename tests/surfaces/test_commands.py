"""The command line: what it prints and writes, how it ends, and that nothing acts on the terminal."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest

import apc
from apc import cli as commands
from apc.cli import progress
from apc.cli.commands import apc as group
from apc.cli.options import Command
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, visible
from apc.output.formatting import document, json_text
from apc.support.remaining_time import RemainingTime
from tests.commands import Cli, Ran, folder, write
from tests.topologies import AVERAGE, ROOT, TOPOLOGIES, replaced


@pytest.fixture
def topology(cli: Cli) -> Cli:
    """Run commands in a folder with the paper's topology alone."""
    write("topology.yaml", AVERAGE)
    return cli


def test_from_nothing_to_a_verdict_in_three_commands(cli: Cli) -> None:
    assert cli("new") == Ran(0, "topology.yaml is written. Next: apc analyze topology.yaml\n", "")
    compiled, analyzed = cli("compile"), cli("analyze")
    assert (compiled.code, compiled.err, analyzed.code, analyzed.err) == (0, "", 0, "")
    assert compiled.out.startswith("topology → topology.apc\n  8 states per peer")
    assert analyzed.out.startswith("topology: stable up to a common translation\n")
    assert folder() == ["topology.apc", "topology.yaml"]


def test_new_writes_under_the_name_given_and_overwrites_nothing(cli: Cli) -> None:
    assert cli("new my-topology").code == 0
    assert Path("my-topology.yaml").read_text(encoding="utf-8").count("topology: my-topology") == 1
    write("my-topology.yaml", "mine")
    message = "my-topology.yaml: E613 file exists and was not changed. Try: apc new another-name\n"
    assert cli("new my-topology") == Ran(1, "", message)
    assert Path("my-topology.yaml").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("name", ["../evil", "a/b", "a b", ".hidden", "x" * 64, "", "a\nb"])
def test_new_takes_a_plain_name_only(cli: Cli, name: str) -> None:
    ran = cli("new", name)
    assert (ran.code, ran.out) == (1, "")
    assert "E612 name of a topology: expected letters, digits, - and _ (at most 63" in ran.err
    assert folder() == []


def test_check_builds_nothing_and_reports_every_mistake(topology: Cli) -> None:
    assert topology("check") == Ran(0, "topology.yaml: no errors (three-users-average, 3 peers)\n", "")
    write("topology.yaml", AVERAGE.replace("0.1 kg", "0.1").replace("link: lan", "link: lam"))
    ran = topology("check")
    assert (ran.code, ran.out) == (1, "")
    assert [line for line in ran.err.splitlines() if line.startswith("topology.yaml")] == [
        "topology.yaml:9:18: E204 mass: expected kg, got 0.1 (no unit). Try: mass: 0.1 kg",
        "topology.yaml:13:109: E206 coordination: unknown link lam (not in links); the nearest is lan. "
        "Try: lan",
    ]
    assert folder() == ["topology.yaml"]


def test_json_is_one_document_and_nothing_else(topology: Cli) -> None:
    ran = topology("analyze --json")
    assert (ran.code, ran.err) == (0, "")
    reported = json.loads(ran.out)
    assert (reported["topology"], reported["peers"], reported["frame_s"]) == ("three-users-average", 3, 0.008)
    assert (reported["stable"], reported["rigid_modes"]) == (True, 1)
    assert 0 < reported["spectral_radius_error"] < 1e-9
    assert set(reported["modes"][0]) >= {
        *("eigenvalue", "magnitude", "multiplicity", "frequency_hz", "damping_ratio", "family"),
        "participation",
    }
    unstable = topology("analyze --json --set 'coordination.stiffness=5000 N/m'")
    assert (unstable.code, json.loads(unstable.out)["stable"]) == (0, False), "which is an answer"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("analyse topology.yaml", "No such command 'analyse'. Did you mean 'analyze'?"),
        ("critcal", "No such command 'critcal'. Did you mean 'critical'?"),
        ("zzz", "No such command 'zzz'."),
        ("compile --until nowhere", "Invalid value for '--until'"),
        ("analyze --method schur", "Invalid value for '--method'"),
        ("analyze --jsn", "No such option '--jsn'"),
        ("compile a b", "Got unexpected extra argument (b)"),
        ("simulate --jobs 1_0", "is not a whole number"),
        ("simulate --jobs ١", "is not a whole number"),
        ("bench topology.yaml --hard", "--hard can't be combined with FILE"),
    ],
)
def test_a_wrong_call_ends_with_two(cli: Cli, words: str, message: str) -> None:
    ran = cli(words)
    assert (ran.code, ran.out) == (2, "")
    assert message in ran.err.replace("option: --jsn", "option '--jsn'")


@pytest.mark.parametrize(
    ("words", "start"),
    [
        ("tune --free {0} --maximize {0}", "--free: E830 range of {0}"),
        ("critical {0} --over {0}", "--over: E830 range of {0}"),
        ("critical {0} --over user.count=2:4 --criterion nominal", "apc critical: E996 the criterion"),
        ("critical {0} --over '{0}=1 N/m:2 N/m'", "apc critical: E831 {0} has two ranges."),
        ("critical {0} --over user.count=2:3 --upper 9", "--upper: E204 {0}"),
        ("critical {0} --over user.count=2:3 --lower '9 N/m' --upper '5 N/m'", "apc critical: E833"),
        ("critical lan.delay --over '{0}=1 N/m:2 N/m'", "apc critical: E995 lan.delay"),
        ("analyze --box {0}", "--box: E830 range of {0}"),
        ("analyze --box lan.loss=5", "--box: E830 range of lan.loss"),
        ("analyze --set lan.loss=5", "--set: E624 lan.loss: expected at most 100 %, got 500 %."),
    ],
)
def test_an_error_names_the_command_or_option_that_was_typed(cli: Cli, words: str, start: str) -> None:
    lossy = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 5 %}"))
    Path("topology.yaml").write_text(lossy, encoding="utf-8")
    ran = cli(words.format("coordination.stiffness"))
    assert ran.code == 1
    assert ran.err.startswith(start.format("coordination.stiffness"))


def test_a_bug_of_ours_ends_with_three_and_keeps_a_report(
    topology: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("apc.compiler.pipeline.compile_topology", lambda path: 1 // 0)
    ran = topology("check topology.yaml")
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith("apc: internal error, not an error of the input; report: ")
    assert "Traceback" not in ran.err
    text = Path(ran.err.split(" report: ")[1].strip()).read_text(encoding="utf-8")
    assert "ZeroDivisionError" in text
    assert "arguments: ['check', 'topology.yaml']" in text


def test_help_fits_a_terminal_and_every_command_is_one_of_ours(cli: Cli) -> None:
    """So that each asks for one thread before it loads anything, and prints by what escapes."""
    context = click.Context(group)
    assert set(group.list_commands(context)) == {name.removesuffix("_command") for name in commands.__all__}
    for command in ("", *group.list_commands(context)):
        ran = cli(f"{command} --help")
        assert (ran.code, ran.err) == (0, ""), command
        assert max(len(line) for line in ran.out.splitlines()) <= 80
        assert "-h, --help" in ran.out
        assert not command or type(group.get_command(context, command)) is Command, command
    assert cli("--version") == Ran(0, f"apc {apc.__version__}\n", "")


def test_the_help_of_an_option_has_one_line_of_80_columns() -> None:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        formatter = click.HelpFormatter(width=80)
        command.format_options(click.Context(command, help_option_names=["-h", "--help"]), formatter)
        _, *rows = formatter.getvalue().splitlines()
        assert len(rows) >= 2
        assert [row for row in rows if not re.match(r"  -.*\S {2,}\S", row)] == [], name
        assert not any("<=" in row or "(from" in row for row in rows), name


def test_the_commands_are_listed_once_by_section_with_complete_sentences(cli: Cli) -> None:
    shown = cli("--help").out
    sections = re.findall(r"^(\w+):\n((?:  .*\n)+)", shown, re.MULTILINE)
    names = ["Options", "Start", "Analyze", "Design", "Simulate", "Network", "Export", "Benchmark"]
    assert [title for title, _ in sections] == names
    rows = [row.split(maxsplit=1) for _, block in sections[1:] for row in block.splitlines()]
    assert sorted(name for name, _ in rows) == sorted(
        name.removesuffix("_command") for name in commands.__all__
    )
    assert all(text.endswith(".") and not text.endswith("...") for _, text in rows)


@pytest.mark.few(1)
@pytest.mark.skipif(sys.platform == "win32", reason="a shell of another kind")
@pytest.mark.parametrize(
    ("line", "code", "reported"),
    [
        ("{apc} schema | head -c 1 >/dev/null; exit ${{PIPESTATUS[0]}}", 0, ""),
        ("{apc} schema >&-", 1, "stdout is closed"),
    ],
)
def test_an_output_that_is_closed_is_no_bug(line: str, code: int, reported: str) -> None:
    command = line.format(apc=f"{sys.executable} -m apc")
    ran = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ran.returncode == code, ran.stderr
    assert reported in ran.stderr and "bug" not in ran.stderr


# ---- numbers ----


def _finite(word: str) -> float:
    pytest.fail(f"{word} is no JSON")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "command",
    [
        "analyze",
        "critical contact.stiffness",
        "transparency",
        "region --x 'contact.stiffness=1 N/m:100 N/m' --y 'device.mass=1 g:1 kg'",
        "simulate --duration 16ms",
    ],
)
@pytest.mark.parametrize(
    "value", ["device.damping=1e30 N*s/m", "device.mass=1e-300 kg", "device.mass=1e300 kg"]
)
def test_json_has_no_number_that_is_not_finite(cli: Cli, command: str, value: str) -> None:
    ran = cli(command, str(TOPOLOGIES / "three-users-average.yaml"), "--set", value, "--json")
    assert ran.code in (0, 1)
    if not ran.code:
        json.loads(ran.out, parse_constant=_finite)


def test_what_is_not_finite_is_null_wherever_it_stands() -> None:
    values = {"a": float("nan"), "b": [float("inf"), 1.0], "c": np.array([1.0, -np.inf])}
    assert json.loads(json_text(document(values))) == {"a": None, "b": [None, 1.0], "c": [1.0, None]}
    assert json.loads(json_text({"a": [float("nan")]})) == {"a": [None]}


# ---- the terminal ----

ESCAPES = "\x1b[31m\x9b2J\x7f\u202e"


def test_what_is_not_printed_is_written_out_as_json_has_it() -> None:
    assert visible("a b\u00a0ü\n\t→") == "a b\u00a0ü\n\t→"
    assert visible(ESCAPES) == r"\u001b[31m\u009b2J\u007f\u202e"
    assert json.loads(visible(json.dumps({"a": ESCAPES}, ensure_ascii=False))) == {"a": ESCAPES}
    assert json.loads(f'"{visible(chr(0xE0001))}"') == chr(0xE0001)
    text = str(
        ApcError(
            Diagnostic("E101", SourceLocation(f"{ESCAPES}.yaml", 3, 1), "this", "that", ESCAPES, ESCAPES)
        )
    )
    assert text.isprintable()
    assert text.count(r"\u001b") == 3


def test_a_message_fits_the_terminal_and_is_one_line_elsewhere(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("topology.yaml", replaced(AVERAGE, ("haptic: 1 ms", "haptic: 1.0001 ms")))
    piped = cli("check").err
    monkeypatch.setattr("apc.__main__.sys.stderr.isatty", lambda: True)
    shown = cli("check").err
    assert max(map(len, shown.splitlines())) <= 80 < max(map(len, piped.splitlines()))
    assert shown.startswith("topology.yaml:4:11: E805") and shown.split() == piped.split()


@pytest.mark.few(2)
@pytest.mark.parametrize("words", ["check", "compile", "analyze", "analyze --json", "show"])
def test_a_name_in_a_file_does_not_act_on_the_terminal(cli: Cli, words: str) -> None:
    write("topology.yaml", replaced(AVERAGE, ("topology: three-users-average", r'topology: "a\e[31mb"')))
    ran = cli(f"{words} topology.yaml")
    assert ran.code == 0 and "\x1b" not in ran.out and r"\u001b[31m" in ran.out
    for code, names in ((1, ("\x1b[2J.yaml",)), (2, ("a", "\x1b[2J.yaml"))):
        ran = cli("analyze", *names)
        assert ran.code == code and "\x1b" not in ran.err


def test_every_command_prints_by_what_escapes() -> None:
    for path in sorted((ROOT / "runtime" / "cli").glob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        printing = {node.attr for node in nodes if isinstance(node, ast.Attribute)} & {"echo", "secho"}
        assert path.name == "options.py" or not printing, path.name


LONG = "n" * 300


@pytest.mark.parametrize(
    "words",
    [
        "compile .",
        "analyze .",
        f"compile {LONG}.yaml",
        f"analyze {LONG}.apc",
        f"schema --out {LONG}.json",
        f"simulate topology.yaml --duration 1ms --out {LONG}.csv",
        f"sweep topology.yaml --over contact.stiffness=1N/m:2N/m:2 --out {LONG}.csv",
        f"sweep topology.yaml --jobs 1 --over contact.stiffness=1N/m:2N/m:2 --out {LONG[:249]}.csv",
        f"region topology.yaml --out {LONG}.csv",
    ],
)
def test_a_name_that_can_be_none_is_one_message(topology: Cli, words: str) -> None:
    ran = topology(words)
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (1, "", 1)


def test_two_topologies_of_one_model_are_refused_naming_both(cli: Cli) -> None:
    for name in ("x.yaml", "x.yml"):
        write(name, AVERAGE)
    message = "x.yml: E617 same model file, x.apc, as x.yaml. Try: mv x.yml x-2.yml\n"
    assert cli("compile x.yml") == Ran(1, "", message)
    assert not Path("x.apc").exists()


# ---- how far it is, and how long it takes ----


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("compile --force", ["source", "topology", "flat", "clocked", "sorted", "compiled", "save"]),
        ("simulate --duration 0.1s", ["read", "prepare", "simulate", "print"]),
    ],
)
def test_every_command_says_what_its_parts_take_on_stderr(
    topology: Cli, words: str, parts: list[str]
) -> None:
    plain, timed = topology(words), topology(f"{words} --timings")
    assert (plain.code, timed.code, timed.out) == (0, 0, plain.out)
    rows = [line.rsplit(maxsplit=2) for line in timed.err.splitlines()]
    names = [row[0].strip() for row in rows]
    assert [name for name in names if name in parts] == parts
    assert (names[0], names[-2:]) == ("start", ["imports, rest", "all"])
    numbers = [float(row[1]) for row in rows]
    assert sum(numbers[:-1]) == pytest.approx(numbers[-1], abs=1.0)


@pytest.mark.parametrize("steps", [10, 100, 3000])
@pytest.mark.parametrize(
    ("cost", "shown"),
    [
        (lambda part: 1.0, True),
        (lambda part: 1.0 + 0.2 * np.sin(900.0 * part), True),
        (lambda part: part, False),
        (lambda part: 1.0 + 5.0 * part, False),
        (lambda part: part**3, False),
        (lambda part: np.exp(6.0 * part), False),
        (lambda part: 2.0 - part, True),
    ],
)
def test_a_remaining_time_is_estimated_only_at_a_steady_rate(
    cost: Callable[[float], float], shown: bool, steps: int
) -> None:
    """A search whose steps become slower had an estimate of 9 s and took 47 s."""
    ends = np.concatenate([[0.0], np.cumsum([cost((k + 0.5) / steps) for k in range(steps)])])
    now = [0.0]
    remaining = RemainingTime(lambda: now[0])
    pairs = []
    for done in range(steps + 1):
        now[0] = float(ends[done])
        if (estimate := remaining.seconds(done, steps)) is not None:
            pairs.append((done, estimate, float(ends[-1] - ends[done])))
    assert bool(pairs) == shown
    for done, estimate, actual in pairs:
        assert done >= 0.3 * steps and actual <= 1.5 * estimate + 1.0, (done, estimate, actual)
    if cost(0.0) == cost(0.7) == 1.0:
        assert [done for done, _, _ in pairs] == list(range(-(-3 * steps // 10), steps))
        assert max(abs(estimate - actual) for _, estimate, actual in pairs) <= 1e-9 * steps


def test_without_an_estimate_the_elapsed_time_is_printed() -> None:
    now = [0.0]
    remaining = RemainingTime(lambda: now[0])
    texts = []
    for done in range(5):
        now[0] = 100.0 * done
        texts.append(remaining.text(done, 4))
    assert texts[:3] == ["0 s elapsed", "100 s elapsed", "4 min elapsed, about 4 min left"]
    assert texts[4] == "7 min elapsed"


def test_long_work_says_that_it_goes_on_and_what_may_take_long_is_said_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []

    def ended(seconds: float) -> bool:
        waits.append(seconds)
        return len(waits) == 3

    monkeypatch.setattr(progress, "QUIET", 10.0)
    progress._watch("analyzing", ended)
    assert capsys.readouterr().err == "analyzing: 10 s elapsed\nanalyzing: 20 s elapsed\n"
    assert waits == [10.0, 10.0, 20.0]
    monkeypatch.setattr(progress, "QUIET", 1000.0)  # no machine is so busy that a second passes for these
    with at_work("analyzing", about=7500.0), at_work("compiling", about=75.0), at_work("measuring"):
        pass
    assert capsys.readouterr() == ("", "analyzing: estimated time 7,500 s\n")
