"""A topology as a Modelica model, compiled and played by Rumoca beside `apc simulate`."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.exports.expressions import identifier
from apc.exports.modelica import modelica
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced

needs_rumoca = pytest.mark.skipif(
    find_spec("rumoca") is None, reason="Rumoca, which compiles Modelica, is not installed"
)

SEPARATE = replaced(
    AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [3 mm, -1 mm, 0.5 mm], cube.x: [2 mm, -1 mm, 0 mm]}}")
)
# Nothing about its times is even: what is heard when, what acts when, from which instant clocks tick.
TIMES = {
    "3.5 ms": [("delay: 8 ms}", "delay: 3.5 ms}")],
    "11.3 ms": [("delay: 8 ms}", "delay: 11.3 ms}")],
    "at once": [("delay: 8 ms}", "delay: 0 ms}")],
    "a force late by a part of a tick": [("delay: 1 ms, link", "delay: 0.3 ms, link")],
    "forces late by 2.5 ticks and by none": [
        ("delay: 1 ms, link", "delay: 2.5 ms, link"), ("delay: 1 ms}", "delay: 0 ms}"),
    ],
    "a phase of forces": [("haptic: 1 ms", "haptic: {period: 1 ms, phase: 0.25 ms}")],
    "a phase of packets": [
        ("network: 8 ms", "network: {period: 8 ms, phase: 3.5 ms}"), ("delay: 8 ms}", "delay: 5.5 ms}"),
    ],
    "7.5 ms": [("network: 8 ms", "network: 7.5 ms"), ("delay: 8 ms}", "delay: 0 ms}")],
    "90 and 1200 Hz": [("network: 8 ms", "network: 90 Hz"), ("haptic: 1 ms", "haptic: 1200 Hz")],
    "packets faster than forces": [("network: 8 ms", "network: 0.25 ms"), ("delay: 8 ms}", "delay: 0 ms}")],
}  # fmt: skip
# A continuous contact that is not linear, opening and closing, and one computed at ticks.
POUND = """\
topology: pound
clocks: {haptic: 1 ms, network: 8 ms}
peers:
  left:  {count: 1, set: {device.v: 0.4 m/s, device.x: -2 mm}}
  right: {count: 2, set: {device.v: 0.1 m/s, cube.x: 1 mm}}
masses:
  device: {mass: 0.1 kg, damping: 1 N*s/m}
  cube:   {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: HuntCrossleyContact, a: device, b: cube, stiffness: 2e5 N/m^(3/2), damping: 1e5 N*s/m^(5/2)}
  wall: {type: SampledHuntCrossleyContact, a: cube, b: ground, stiffness: 1e5 N/m^(3/2), clock: haptic}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 8 ms}}
"""


def worst(model: apc.Model, seconds: float, method: str | None = None) -> float:
    """Play a topology by Rumoca and by apc; return how far states are apart, of the largest of each kind."""
    rumoca = import_module("rumoca")
    made = modelica(model)
    played = apc.simulate(model, duration=f"{seconds} s", jit=False, method=method)
    step = float(played.time[-1] - played.time[-2])
    config = rumoca.SimConfig(solver="rk-like", rtol=1e-10, atol=1e-13, dt=step / 4)
    found: Any = rumoca.Session().loads(made.text, model=made.name).simulate(t=(0, seconds), config=config)
    time, first = np.unique(np.array(found.time), return_index=True)  # before what happens at an instant
    apart = []
    states = [one for one in played.signals if one.role == "state"]
    for one in states:
        rows = played[one.name]
        size = max(np.abs(played[other.name]).max() for other in states if other.unit == one.unit)
        theirs = np.interp(played.time, time, np.array(found[identifier(one.name)])[first])
        apart.append(float(np.abs(theirs - rows).max() / size))
    return max(apart)


@pytest.mark.few(1)
@needs_rumoca
@pytest.mark.parametrize("times", TIMES)
def test_rumoca_plays_the_papers_topology_at_any_times_as_simulate_does(times: str) -> None:
    assert worst(compiled(replaced(SEPARATE, *TIMES[times])), 0.06) < 1e-9


@pytest.mark.few(1)
# Other groups, couplers that remember, a server, a graph, a plane, forces that change with time.
@needs_rumoca
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("mixed-clocks", {"near.device.x": "2 mm"}),
        ("experiment-average", {}),
        ("client-server", {"server.object.x": "1 mm"}),
        ("ring-of-eight", {"device.x": "2 mm"}),
        ("two-users-waves", {"device.v": "30 mm/s"}),
        ("two-users-passivity", {}),
        ("two-users-set-position", {}),
        ("two-users-dead-reckoning", {}),
        ("limited-motor", {}),
        ("users-table", {}),
        ("god-object", {}),
        ("three-users-scheduled", {"device.v": "30 mm/s"}),
        ("finger", {}),
        ("lifted-box", {}),
    ],
)
def test_rumoca_plays_topologies_of_the_library_as_simulate_does(name: str, settings: dict[str, str]) -> None:
    model = apc.set_parameters(apc.compile(TOPOLOGIES / f"{name}.yaml"), settings)
    assert worst(model, 0.06) < 1e-7  # what switches in time is found by each to its own tolerance


@needs_rumoca
def test_rumoca_plays_contacts_that_are_not_linear_as_simulate_does() -> None:
    model = compiled(POUND)
    assert worst(model, 0.06, "cvodes:1e-10") < 1e-7


HANDS = {
    "StepForce": "force: 2 N, start: 20 ms",
    "RampForce": "force: 2 N, start: 10 ms, rise: 20 ms",
    "SineForce": "force: 2 N, frequency: 7 Hz",
    "TableForce": "force: push.csv",
    "MassSpringDamperArm": "mass: 0.2 kg, stiffness: 100 N/m, damping: 1 N*s/m, position: 3 mm",
}


@pytest.mark.few(2)
@needs_rumoca
@pytest.mark.parametrize("hand", HANDS)
def test_rumoca_plays_hands_as_simulate_does(hand: str, tmp_path: Path) -> None:
    (tmp_path / "push.csv").write_text("time [s],force [N]\n0,0\n0.01,1\n0.02,-1\n", encoding="utf-8")
    path = tmp_path / "topology.yaml"
    held = f"hands:\n  hand: {{type: {hand}, flange: device, {HANDS[hand]}}}\n"
    path.write_text(AVERAGE + held, encoding="utf-8")
    assert worst(apc.compile(path), 0.04) < 1e-9


def test_the_text_is_readable() -> None:
    """Names as in `apc simulate`, units, what each number is, one equation a line, where it comes from."""
    text = modelica(compiled(AVERAGE)).text
    for line in (
        """  parameter Real 'coordination.stiffness'(unit="N/m") = 500 "force per distance from the mean";""",
        '  Clock haptic = Clock(1, 1000) "every 1 ms, from 0 ms";',
        '  Clock network = subSample(haptic, 8) "every 8 ms, from 0 ms";',
        """  Real 'user[1].device.x'(unit="m", start='device.x at the start', fixed=true);""",
        "  'user[1].device.x at haptic' = sample('user[1].device.x', haptic);",
        "  'user[2].coordination.x sent 1 tick ago' = previous('user[2].coordination.x sent');",
        "  'user[1].contact.f acting' = hold('user[1].contact.f 1 tick ago');",
        "end three_users_average;",
    ):
        assert line in text.splitlines()
    assert "StopTime=1.0, Interval=0.001" in text
    assert re.search(r"// Written by apc \S+ from topology.yaml", text)
    declared = set(re.findall(r"^  (?:Real|Boolean) ('.*?'|\w+)[(; ]", text, re.MULTILINE))
    defined = re.findall(r"^  (?:der\()?('.*?'|\w+)\)? = ", text.partition("\nequation\n")[2], re.MULTILINE)
    assert sorted(defined) == sorted(declared)  # as many equations as unknowns, one each


LOSSY = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 2 %}"))
MEET = replaced(
    AVERAGE, ("network: 8 ms", "network: {period: 8 ms, phase: 3 ms}"), ("delay: 8 ms}", "delay: 0 ms}")
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LOSSY, r"E955 no Modelica equivalent of packet loss \(2 %\) of lan"),
        (
            replaced(AVERAGE, ("8 ms}", "8 ms, jitter: 1 ms}")),
            r"E955 no Modelica equivalent of jitter of lan",
        ),
        (MEET, r"E955 no Modelica equivalent of lan without delay to haptic: their ticks coincide"),
        (
            replaced(AVERAGE, ("count: 3", "count: 1000")),
            r"E955 .* 1,000 peers with 999,000 directed connections",
        ),
        (
            replaced(AVERAGE, ("delay: 8 ms}", "delay: 0.0000000000123 s}")),
            r"E955 .* a clock that counts to",
        ),
    ],
)
def test_what_modelica_has_no_words_for_is_refused_by_name(text: str, message: str) -> None:
    with pytest.raises(ApcError, match=message):
        modelica(compiled(text))


SOFT = """\
component: SoftSpring
description: A spring that gives way more the harder it is pulled.
connectors: {a: Flange, b: Flange}
parameters: {stiffness: {unit: N/m}, soft: {unit: 1/N^2}}
variables: {f: {unit: N}}
equations: [f + soft*f^3 = stiffness*(a.x - b.x), a.f = f, b.f = -a.f]
"""


def test_a_loop_that_newtons_method_solves_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "soft.yaml").write_text(SOFT, encoding="utf-8")
    path = tmp_path / "topology.yaml"
    spring = "{type: SoftSpring, a: device, b: cube, stiffness: 100 N/m, soft: 1 1/N^2}"
    couplers = ("couplers:", f"couplers:\n  spring: {spring}")
    path.write_text(replaced(AVERAGE, ("topology:", "library: ./\ntopology:"), couplers), encoding="utf-8")
    with pytest.raises(ApcError, match=r"E955 .* the nonlinear loop of user that Newton's method solves"):
        modelica(apc.compile(path))


def test_a_refused_topology_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "topology.yaml").write_text(LOSSY, encoding="utf-8")
    assert run(["export", "--out", "topology.mo"]) == 1
    assert "E955" in capsys.readouterr().err
    assert run(["export", "--out", "topology.mo", "--set", "lan.loss=0"]) == 0
    assert (tmp_path / "topology.mo").read_text(encoding="utf-8").startswith("model three_users_average")
    assert run(["export", "--out", "topology.mo", "--open-at", "lan"]) == 1
    assert "E953 --open-at has no effect for the format modelica" in capsys.readouterr().err


# Keywords, predefined types, operators and functions of the Modelica Language Specification 3.6.
NAMES = re.findall(r"\w+", """
algorithm and annotation block break class connect connector constant constrainedby der discrete each else
elseif elsewhen encapsulated end enumeration equation expandable extends external false final flow for
function if import impure in initial inner input loop model not operator or outer output package parameter
partial protected public pure record redeclare replaceable return stream then true type when while within
Real Integer Boolean String Clock StateSelect ExternalObject AssertionLevel Connections time abs sign sqrt
div mod rem ceil floor integer sin cos tan asin acos atan atan2 sinh cosh tanh exp log log10 delay
cardinality homotopy semiLinear inStream actualStream spatialDistribution getInstanceName initial terminal
noEvent smooth sample pre edge change reinit assert terminate ndims size scalar vector matrix transpose
outerProduct symmetric cross skew identity diagonal zeros ones fill linspace min max sum product array cat
previous hold subSample superSample shiftSample backSample noClock interval firstTick transition
initialState activeState ticksInState timeInState
""")  # fmt: skip


def test_no_name_of_the_language_is_declared() -> None:
    assert [name for name in NAMES if identifier(name) != f"'{name}'"] == []
    assert identifier("haptic") == "haptic"


@pytest.mark.parametrize(
    ("model", "fast", "slow"),
    [
        ("subSample", "subSample", "superSample"),
        ("when", "shiftSample", "backSample"),
        ("Clock", "Real", "firstTick"),
    ],
)
def test_a_topology_of_such_names_is_a_model(model: str, fast: str, slow: str) -> None:
    """No line declares the name without quotes; Rumoca, where it is installed, compiles the model."""
    text = replaced(AVERAGE, ("topology: three-users-average", f"topology: {model}"))
    text = text.replace("haptic", fast).replace("network", slow)
    made = modelica(compiled(text))
    declared = re.findall(r"^  Clock (\S+) =", made.text, re.MULTILINE)
    assert (made.name, declared) == (f"'{model}'" if model in NAMES else model, [f"'{fast}'", f"'{slow}'"])
    if find_spec("rumoca") is not None:
        import_module("rumoca").Session().loads(made.text, model=made.name)
