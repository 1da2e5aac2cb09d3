"""Every option of every command on every shipped topology ends in an answer or a diagnostic."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from tests.commands import Cli
from tests.topologies import TOPOLOGIES as FOLDER

TOPOLOGIES = sorted(path.name for path in FOLDER.glob("*.yaml"))
# The words of each call; STIFFNESS and DELAY are the first parameters of that unit that the topology has.
CALLS = (
    "analyze",
    "analyze --hands clamped",
    "analyze --hands passive",
    "analyze --hands held --set hand.stiffness=100_N/m",
    "analyze --hands StylusArmForward --no-margins",
    "analyze --operating-point equilibrium --no-margins",
    "analyze --changing COUNT=2:3",
    "analyze --certify --no-margins",
    "analyze --method dense --no-margins",
    "analyze --method determinant --no-margins",
    "analyze --method paper --no-margins",
    "analyze --event-order --no-margins --nominal --json",
    "analyze --no-margins --box STIFFNESS=±1% --cells 50",
    "critical STIFFNESS",
    "critical STIFFNESS --hands passive",
    "critical STIFFNESS --hands clamped",
    "critical STIFFNESS --criterion nominal --json",
    "critical STIFFNESS --operating-point equilibrium",
    "critical DELAY --upper 20_ms",
    "critical PERIOD",
    "critical COUNT",
    "region --x STIFFNESS=10_N/m:900_N/m --y DAMPING=0_N*s/m:9_N*s/m --cells 4",
    "region --x STIFFNESS=10_N/m:900_N/m --y DAMPING=0_N*s/m:9_N*s/m --cells 4 --hands passive",
    "sweep --over STIFFNESS=10_N/m:900_N/m:3 --out s.csv --jobs 1",
    "tune --free STIFFNESS=10_N/m:900_N/m --maximize STIFFNESS --time 2_s",
    "compare --json",
    "transparency --points 5",
    "transparency --points 5 --operating-point equilibrium",
    "transparency --points 5 --unstable --json",
    "simulate --duration 20_ms --no-jit --json",
    "simulate --duration 20_ms --method rk4:1e-4 --error",
    "simulate --duration 20_ms --impulse PEER --runs 2",
    "simulate --duration 2_s --joins PEER=600_ms --leaves PEER=1200_ms",
    "export --to control --out e.py",
    "export --to modelica --out e.mo",
    "export --to c --peer PEER --out e.c",
    "show --parameters",
    "show --format mermaid",
    "check",
)
UNITS = {"STIFFNESS": "N/m", "DAMPING": "N*s/m"}
# Minutes each: a lossy network's second moments, a hundred states under every option.
SLOW = {
    ("lossy-average.yaml", "region"),
    ("lossy-average.yaml", "tune"),
    ("carried-beam.yaml", "region"),
    ("carried-beam.yaml", "tune"),
    ("star-lecture.yaml", "region"),
    ("ring-of-eight.yaml", "region"),
}


def words_for(call: str, model: apc.Model) -> list[str] | None:
    """Return the words of a call, None if the topology has no parameter that it asks for."""
    known = {
        word: next(
            (
                one.name
                for one in model.parameters
                if one.unit == unit and one.formula is None and "." in one.name
            ),
            None,
        )
        for word, unit in UNITS.items()
    }
    known["DELAY"] = next((f"{link.name}.delay" for link in model.links), None)
    known["PERIOD"] = next((clock.period for clock in model.clocks), None)
    known["COUNT"] = f"{model.groups[0].name}.count"
    known["PEER"] = f"{model.groups[0].name}[1]"
    for word, name in known.items():
        if word in call:
            if name is None:
                return None
            call = call.replace(word, name)
    return [word.replace("_", " ") for word in call.split()]


# All cases take an hour; each call is tried on every eighth topology, another one for each call.
EVERY = 8
CASES = [
    (topology, call)
    for row, topology in enumerate(TOPOLOGIES)
    for column, call in enumerate(CALLS)
    if (row + column) % EVERY == 0 and (topology, call.split()[0]) not in SLOW
]


@pytest.mark.few(8)
@pytest.mark.parametrize(("topology", "call"), CASES)
def test_no_call_is_a_bug(
    topology: str, call: str, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = words_for(call, apc.compile(FOLDER / topology))
    if words is None:
        pytest.skip("the topology has no such parameter")
    monkeypatch.chdir(tmp_path)
    ran = cli(words[0], *words[1:], str(FOLDER / topology))
    assert ran.code in (0, 1, 2), ran.err
    assert (ran.code == 0) or ran.err
