"""Former commands, options, functions, arguments, keys and metrics: one message each, with the new name."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from apc import cli
from apc.compiler.source.reading import RENAMED
from apc.support.renamed import FORMER_ARGUMENTS, FORMER_COMMANDS, FORMER_FUNCTIONS, FORMER_OPTIONS
from apc.tuning.specification import FORMER, TRANSPARENCY
from tests.commands import Cli
from tests.topologies import AVERAGE, replaced

EVERY = [(command, old, new) for command, pairs in FORMER_OPTIONS.items() for old, new in pairs.items()]


@pytest.fixture
def topology(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    Path("t.yaml").write_text(AVERAGE, encoding="utf-8")
    return "t.yaml"


@pytest.mark.parametrize("old", FORMER_COMMANDS)
def test_a_former_command_names_the_present_one(old: str, topology: str, cli: Cli) -> None:
    ran = cli(old, topology)
    assert ran.code == 2 and ran.err.strip().endswith(
        f"Error: unknown command {old}; its present name is {FORMER_COMMANDS[old]}."
    )
    assert cli(FORMER_COMMANDS[old], "--help").code == 0


@pytest.mark.parametrize(("command", "old", "new"), EVERY)
def test_a_former_option_names_the_present_one(
    command: str, old: str, new: str, topology: str, cli: Cli
) -> None:
    ran = cli(command or "critical", old, "x", topology)
    assert ran.code == 2 and ran.err.strip().endswith(
        f"Error: unknown option {old}; its present name is {new}."
    )
    assert new in cli(command or "critical", "--help").out


@pytest.mark.needs_extension("all")
def test_a_former_function_names_the_present_one() -> None:
    for old, new in FORMER_FUNCTIONS.items():
        with pytest.raises(
            AttributeError, match=rf"^unknown function apc\.{old}; its present name is apc\.{new}$"
        ):
            getattr(apc, old)
        assert callable(getattr(apc, new)) and old not in dir(apc)


def test_a_former_argument_names_the_present_one(topology: str) -> None:
    calls = {"": apc.analyze, "export": apc.export, "simulate": apc.simulate, "tune": apc.tune}
    for function, pairs in FORMER_ARGUMENTS.items():
        for old, new in pairs.items():
            call = calls.get(function, apc.pareto_front)
            with pytest.raises(
                TypeError, match=rf"^apc\.\w+: unknown argument {old}=; its present name is {new}=$"
            ):
                call(topology, **{old: "x"})  # type: ignore[operator]


@pytest.mark.parametrize("old", FORMER)
def test_a_former_metric_names_the_present_one(old: str, topology: str, cli: Cli) -> None:
    at = " at 5 Hz" if TRANSPARENCY[FORMER[old]][1] else ""
    words = ["--free", "coordination.stiffness=10 N/m:100 N/m", "--time", "1 s"]
    ran = cli("tune", topology, *words, "--minimize", old + at)
    assert ran.code == 1 and f"E996 the present name of {old} is {FORMER[old]}." in ran.err
    assert f'Try: --minimize "{FORMER[old]}{at}"' in ran.err


@pytest.mark.needs_extension("pareto_front")
@pytest.mark.parametrize(
    ("words", "fix"),
    [
        (["--constraint", "feel.error at 1 Hz < 0.1 m/N"], '"coordination_error at 1 Hz < 0.1 m/N"'),
        (["--minimize", "feel.transmitted"], '"transmitted_velocity at 5 Hz"'),
        (
            ["--maximize", "feel.damping - 0.01*coordination.stiffness"],
            '"damping - 0.01*coordination.stiffness"',
        ),
        (["--tradeoff", "feel.error_h2"], '"coordination_error_h2"'),
    ],
)
def test_the_fix_keeps_what_was_written(words: list[str], fix: str, topology: str, cli: Cli) -> None:
    gain = ["--free", "coordination.stiffness=10 N/m:100 N/m", "--time", "1 s"]
    more = [] if "--maximize" in words or "--minimize" in words else ["--maximize", "coordination.stiffness"]
    ran = cli("tune", topology, *gain, *more, *words)
    assert ran.code == 1 and f"Try: {words[0]} {fix}" in ran.err


def test_an_option_that_the_command_never_had_has_no_new_name(topology: str, cli: Cli) -> None:
    ran = cli("analyze", "--in", "nominal", topology)
    assert ran.code == 2 and "No such option" in ran.err


@pytest.mark.parametrize("old", RENAMED)
def test_a_former_key_names_the_present_one(old: str, topology: str, cli: Cli) -> None:
    if old == "about":
        Path(topology).write_text(replaced(AVERAGE, ("clocks:", "about: three users\nclocks:")), "utf-8")
        words = ["check", topology]
    else:
        Path("parts").mkdir()
        Path("parts/pad.yaml").write_text(
            "component: Pad\nconnectors: {a: Flange}\nparameters: {k: {unit: N/m, above: 0}}\n"
            "equations: [a.f = k*a.x]\n",
            encoding="utf-8",
        )
        words = ["library", "Pad", "--folder", "parts"]
    ran = cli(*words)
    assert ran.code == 1 and ran.err.count("E2") == 1
    assert f"; its present name is {RENAMED[old]}. Try: {RENAMED[old]}" in ran.err


def test_no_former_name_is_a_present_one() -> None:
    names = {name.removesuffix("_command") for name in dir(cli)}
    assert not FORMER_COMMANDS.keys() & names and set(FORMER_COMMANDS.values()) <= names
