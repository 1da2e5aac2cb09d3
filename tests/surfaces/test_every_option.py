"""Every option of every command on every shipped topology: an answer or a refusal, no internal error."""

from __future__ import annotations

import pytest

import apc
from tests.commands import Cli
from tests.topologies import SCENES

HANDS = ("clamped", "held", "passive", "StylusArmForward", "SpringDamperArm")
FLAGS = {
    "check": ("", "--timings"),
    "analyze": (
        "--json",
        "--certify",
        "--conventions",
        "--margins",
        "--no-margins",
        "--nominal",
        "--buzz",
        "--plot a.svg",
        "--method modes",
        "--method dense",
        "--method determinant",
        "--method paper",
        "--box NAME=±1%",
        "--set NAME=VALUE",
        "--set NAME=ZERO",
        *(f"--hands {hands}" for hands in HANDS),
        *(f"--hands {hands} --set NAME=ZERO" for hands in HANDS),
        "--hands clamped --margins",
    ),
    "critical NAME": (
        "--json",
        "--plot a.svg",
        "--in nominal",
        "--in mean-square",
        "--upper VALUE",
        "--over NAME=±1%",
        *(f"--hands {hands}" for hands in HANDS),
    ),
    "critical PERIOD": ("", "--hands passive", "--hands clamped", "--plot a.svg", "--in mean-square"),
    "critical DELAY": ("", "--hands passive", "--hands clamped"),
    "region --x NAME=ZERO:VALUE --y OTHER": (
        "--cells 4",
        "--cells 4 --hands clamped",
        "--cells 4 --normalize",
    ),
    "region --x PERIOD=1ms:2ms --y OTHER": ("--cells 4", "--cells 4 --hands passive"),
    "sweep --over NAME=ZERO:VALUE:3 --out a.csv --jobs 1": ("", "--hands clamped", "--hands passive"),
    "feel": ("--points 5", "--unstable --nyquist --points 5 --out a.svg", "--json --points 3"),
    "simulate --duration 0.05s --no-jit": (
        "",
        "--json",
        "--error",
        "--out a.csv",
        "--plot a.svg",
        "--still b.svg",
    ),
    "compare": ("", "--json", "--hands clamped"),
    "export": (
        "--to control --out a.py",
        "--to fmu --out a.fmu",
        "--to modelica --out a.mo",
        "--to c --out a.c",
    ),
    "show": ("--format json", "--format mermaid", "--format dot", "--parameters"),
}
CASES = [(command, words) for command, options in FLAGS.items() for words in options]
# The commands whose inputs broke before run each time on the topologies on which they did.
OFTEN = [
    ("analyze", "--hands clamped", "finger"),
    ("analyze", "--hands clamped", "limited-motor"),
    ("analyze", "--hands passive --set NAME=ZERO", "finger"),
    ("critical NAME", "--hands passive", "stiff-wall-passivity"),
    ("critical PERIOD", "--hands passive", "stiff-wall-passivity"),
    ("critical PERIOD", "", "mixed-clocks"),
]


def asked(command: str, words: str, scene: str) -> list[str]:
    """Return the words of a command on a topology, with a stiffness, a delay and a period of its own."""
    model = apc.compile(SCENES / f"{scene}.yaml")
    rows = apc.parameters(model).rows
    first = [row for row in rows if row.name.endswith("stiffness")] or list(rows)
    unit = first[0].unit.replace("1", "")
    periods = [row.name for row in rows if row.name.endswith(".period")]
    delays = [row.name for row in rows if row.name.endswith(".delay")]
    others = [row for row in rows if row.name.endswith("damping")] or list(rows[-1:])
    values = {
        "NAME": first[0].name,
        "VALUE": f"100{unit}",
        "ZERO": f"0{unit}",
        "PERIOD": periods[0] if periods else "haptic.period",
        "DELAY": delays[0] if delays else "lan.delay",
        "OTHER": f"{others[0].name}=1{others[0].unit}:5{others[0].unit}",
    }
    listed = [*command.split(), str(SCENES / f"{scene}.yaml"), *words.split()]
    for key, value in values.items():
        listed = [word.replace(key, value) for word in listed]
    return listed


def check(cli: Cli, command: str, words: str, scene: str) -> None:
    """Run a command and assert that it gave an answer, or refused with a code and no internal error."""
    ran = cli("", *asked(command, words, scene))
    assert ran.code in (0, 1, 2), ran


@pytest.mark.parametrize(("command", "words", "scene"), OFTEN)
def test_what_broke_before_has_an_answer(command: str, words: str, scene: str, cli: Cli) -> None:
    check(cli, command, words, scene)


@pytest.mark.whole
@pytest.mark.parametrize("scene", sorted(path.stem for path in SCENES.glob("*.yaml")))
@pytest.mark.parametrize(("command", "words"), CASES)
def test_no_option_ends_in_an_internal_error(command: str, words: str, scene: str, cli: Cli) -> None:
    check(cli, command, words, scene)
