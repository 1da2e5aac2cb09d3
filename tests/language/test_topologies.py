"""What a compiled topology holds: exact numbers, groups and kinds, channels, what is left out and warned
of.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import pytest

import apc
from apc.__main__ import run
from apc.compiler.files import read_file
from apc.compiler.pipeline import compile_again, compile_topology
from tests.library.parts import listed, values
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, library, replaced

MS = Fraction(1, 1000)


def changed(*pairs: tuple[str, str]) -> apc.Model:
    return compiled(replaced(AVERAGE, *pairs))


def exact(model: apc.Model) -> dict[str, Any]:
    """Return the exact numbers and times of a topology by name."""
    return {one.name: one.exact for one in model.parameters} | {one.name: one.value for one in model.timings}


# ---- numbers ----


@pytest.mark.parametrize(("text", "weight"), [(AVERAGE, 1), (MESH, 2)])
def test_the_functions_give_the_papers_equations(text: str, weight: int) -> None:
    model = compiled(replaced(text, ("500 N/m,", "500 N/m, damping: 2 N*s/m,")))
    [peer_type] = model.peer_types
    [haptic], [lan] = peer_type.clocks, peer_type.sends
    known = values(model)
    p = [known[name] for name in peer_type.parameters]
    x, v, x_o, v_o = state = [0.01, -0.2, 0.03, 0.5]
    held_contact, held_pull = held = [3.0, -7.0]
    received = [0.04, 0.25]
    assert [one.name for one in peer_type.states] == ["device.x", "device.v", "cube.x", "cube.v"]
    assert [one.name for one in peer_type.holds] == ["contact.f", "coordination.f"]
    # Eqs. (1) and (2): the contact pushes the device back and the cube on; the others pull the cube.
    assert listed(peer_type.derivative(state, held, p, 0)) == pytest.approx(
        [v, (-held_contact - 5 * v) / 0.1, v_o, (held_contact - held_pull - 5 * v_o) / 0.2], rel=1e-15
    )
    # Eqs. (3) and (4).
    pull = 500 * (weight * x_o - received[0]) + 2 * (weight * v_o - received[1])
    assert haptic.outputs == ("contact.f", "coordination.f")
    ticked = listed(haptic.tick(state, held, [], received, p, 0))
    assert ticked == pytest.approx([1000 * (x - x_o), pull], rel=1e-14)
    assert (lan.link, lan.channels, lan.units) == ("lan", ("coordination.x", "coordination.v"), ("m", "m/s"))
    assert listed(lan.send(state, held, p, 0)) == [x_o, v_o]
    operator = "mean" if weight == 1 else "sum"
    assert [(one.operator, one.link, one.channel) for one in haptic.receives] == [
        (operator, "lan", 0),
        (operator, "lan", 1),
    ]


TIMES: list[tuple[tuple[str, str], dict[str, Any]]] = [
    (("haptic: 1 ms", "haptic: 1 ms"), {"contact.delay": MS, "coordination.delay": MS, "lan.delay": 8 * MS,
     "haptic.period": MS, "haptic.phase": 0, "network.period": 8 * MS, "network.phase": 0}),
    (("haptic: 1 ms", "haptic: 1/90 s"), {"haptic.period": Fraction(1, 90)}),
    (("haptic: 1 ms", "haptic: {period: 1 kHz, phase: 0.25 ms}"),
     {"haptic.period": MS, "haptic.phase": MS / 4}),
    (("mass: 0.1 kg", "mass: 100 g"), {"device.mass": Fraction(1, 10)}),
    (("mass: 0.1 kg", "x: 5 mm, mass: 0.1 kg"), {"device.x": 5 * MS}),
    (("1000 N/m", "1 N/mm"), {"contact.stiffness": 1000, "coordination.damping": 0}),
    (("8 ms}", "8 ms, loss: 2%}"),  # what is left out is as tc-netem(8) has it
     {"lan.loss": Fraction(1, 50), "lan.loss.r": Fraction(49, 50),
     "lan.loss.1-h": 1, "lan.loss.1-k": 0}),
    (("8 ms}", "8 ms, loss: 1/50, jitter: 2 ms}"), {"lan.loss": Fraction(1, 50), "lan.jitter": 2 * MS}),
    (("8 ms}", "8 ms, loss: {p: 1 %, r: 25 %, 1-h: 90 %, 1-k: 0.1 %}}"),
     {"lan.loss.p": Fraction(1, 100), "lan.loss.r": Fraction(1, 4), "lan.loss.1-h": Fraction(9, 10),
      "lan.loss.1-k": MS}),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), TIMES)
def test_numbers_and_times_are_exact_in_si(change: tuple[str, str], expected: dict[str, Any]) -> None:
    found = exact(changed(change))
    assert {name: found[name] for name in expected} == expected


SHAKEN = "parameters: {f: 2 Hz, w: 4 rad/s}\nhands: {push: {type: SineForce, flange: device, force: 1 N, "
SHAKEN += "frequency: FREQUENCY, phase: 90 deg}}\n"


@pytest.mark.parametrize("written", ["w/(2*pi)", "(w + w)/(2*pi)/2", "f/pi", "2*(f + f)/pi - f/pi - 2*f/pi"])
def test_a_name_keeps_what_its_unit_counts(written: str) -> None:
    model = compiled(ONE_MASS + SHAKEN.replace("FREQUENCY", written))
    units = {one.name: one.unit for one in model.parameters}
    shown = ("Hz", "rad/s", "Hz", "rad")
    assert tuple(units[name] for name in ("f", "w", "push.frequency", "push.phase")) == shown
    assert values(model)["push.frequency"] == pytest.approx(2 / math.pi)


def test_an_experiment_and_the_axes_of_a_study_are_kept() -> None:
    model = changed(("studies:", "experiment: {duration: 3 s, seed: 7}\nstudies:"))
    assert (model.experiment.duration, model.experiment.seed) == (3, 7)
    assert (compiled(ONE_MASS).experiment.duration, compiled(ONE_MASS).experiment.seed) == (None, 0)
    axes = [("contact.stiffness", 0, 5000), ("coordination.stiffness", 0, 1500)]
    assert [(one.parameter, one.low, one.high) for one in model.region] == axes


@pytest.mark.parametrize(
    ("printed", "axis", "ends"),
    [
        ("loss: 10 %", "lan.loss: [0 %, 60 %]", (0, Fraction(3, 5))),
        ("loss: {p: 1 %, r: 10 %}", "lan.loss.r: [2 %, 0.9]", (Fraction(1, 50), Fraction(9, 10))),
        ("jitter: 2 ms", "lan.jitter: [0 ms, 4 ms]", (0, 4 * MS)),
        ("loss: 10 %", "lan.loss: [0 %, 120 %]", "E207 lan.loss: expected 100 % or less, got 120 %."),
        ("loss: 10 %", "lan.loss.r: [1 %, 90 %]", "the nearest is lan.loss. Try: lan.loss"),
    ],
)
def test_what_a_link_loses_by_can_be_an_axis_of_a_study(printed: str, axis: str, ends: Any) -> None:
    change = (("8 ms}", f"8 ms, {printed}}}"), ("contact.stiffness: [0 N/m, 5000 N/m]", axis))
    if isinstance(ends, str):
        with pytest.raises(apc.ApcError, match=ends):
            changed(*change)
    else:
        assert (changed(*change).region[0].low, changed(*change).region[0].high) == ends


# ---- links ----


def test_a_link_is_reliable_and_a_channel_holds_newest_and_uniform_unless_it_says_otherwise() -> None:
    assert compiled(AVERAGE).links[0].channel is None
    assert not [one.name for one in compiled(AVERAGE).parameters if "lan." in one.name]
    plain = changed(("8 ms}", "8 ms, jitter: 2 ms}")).links[0].channel
    assert plain is not None
    assert (plain.distribution, plain.reorder, plain.on_loss) == ("uniform", "newest", "hold")
    text = "8 ms, jitter: 2 ms, loss: 1 %, distribution: pareto, reorder: all, on_loss: zero}"
    full = changed(("8 ms}", text)).links[0].channel
    assert full is not None
    assert (full.distribution, full.reorder, full.on_loss) == ("pareto", "all", "zero")


def test_a_trace_is_a_column_of_delays_lost_ones_infinite_and_stays_in_the_model(tmp_path: Path) -> None:
    path = tmp_path / "topology.yaml"
    for cells, expected in (
        ('delay [ms]\n8\n8.25\nlost\n""\n\n12e0\n', [0.008, 0.00825, math.inf, math.inf, 0.012]),
        ("packet,delay [us],note\n1,500,\n2,,gone\n3, lost ,\n4,0,late\n", [0.0005, math.inf, math.inf, 0]),
    ):
        (tmp_path / "delays.csv").write_text(cells, encoding="utf-8")
        path.write_text(replaced(AVERAGE, ("8 ms}", "8 ms, trace: delays.csv}")), encoding="utf-8")
        compiled_model = apc.compile(path)
        assert any(name.endswith("delays.csv") for name, _ in compiled_model.origin.texts)
        apc.save(compiled_model, tmp_path / "topology.apc")
        for model in (compiled_model, apc.load(tmp_path / "topology.apc")):
            assert model.links[0].channel is not None and model.links[0].channel.trace is not None
            assert model.links[0].channel.trace.tolist() == expected
    for more in ("loss: 1 %", "jitter: 1 ms", "delays: {user: {user: 3 ms}}"):
        path.write_text(replaced(AVERAGE, ("8 ms}", f"8 ms, trace: delays.csv, {more}}}")), encoding="utf-8")
        with pytest.raises(apc.ApcError, match="E262 lan has a trace, which can't be combined with"):
            apc.compile(path)


# ---- groups, kinds, what is left out ----

LATE = """\
component: LateMean
connectors: {object: Flange}
sends: {x: "hold(w, lag)*1"}
parameters: {stiffness: {unit: N/m}, lag: {unit: s, default: 1 ms}, clock: clock, link: link}
equations:
  - w = sample(object.x)
  - f = stiffness*(sample(object.x) - mean(others.x))
  - object.f = hold(f)
"""


@pytest.mark.parametrize("groups", ["one: {count: 1}", "one: {count: 1, set: {coordination.lag: 5 ms}}"])
def test_a_delay_in_what_is_sent_is_the_groups_own(groups: str, tmp_path: Path) -> None:
    text = f"""\
topology: late
clocks: {{haptic: 1 ms, network: 8 ms}}
peers: {{{groups}, two: {{count: 2, set: {{coordination.lag: 5 ms}}}}}}
masses: {{cube: {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}}}
couplers:
  coordination: {{type: LateMean, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}}
links: {{lan: {{clock: network, delay: 8 ms}}}}
"""
    model = compiled(text, library(tmp_path, LATE))
    assert len(model.peer_types) == 2, "each can be changed on its own"
    assert exact(model)["two.coordination.lag"] == 5 * MS


def test_a_part_of_another_type_at_a_group_has_the_numbers_of_that_type() -> None:
    text = (TOPOLOGIES / "teleoperation-pair.yaml").read_text("utf-8")
    model = compiled(text)
    own = {one.name: one.value for one in model.groups[1].values}
    known = values(model)
    assert (known["device.force_limit"], own["device.force_limit"]) == (3.3, 12.0)
    assert (known["device.mass"], own["device.mass"]) == (0.1, 0.25)
    # The same as masses, and with the two groups' types changed over.
    plain = apc.analyze(compiled(replaced(text, ("device.type: Omega3, ", ""), ("type: Touch, ", ""))))
    leader = "count: 1, set: {device.type: Touch}}"
    over = replaced(
        text, ("count: 1}", leader), ("device.type: Omega3, ", ""), ("type: Touch", "type: Omega3")
    )
    for other in (model, compiled(over)):
        assert apc.analyze(other).spectral_radius == pytest.approx(plain.spectral_radius, rel=1e-12)
    with pytest.raises(
        apc.ApcError, match=r"HapticDevice has no force_limit, .* Try: device.force_limit: 1 N"
    ):
        compiled(replaced(text, ("type: Omega3", "type: HapticDevice")))


def test_a_number_of_another_type_at_a_group_has_the_unit_it_has_elsewhere(tmp_path: Path) -> None:
    device = (TOPOLOGIES.parent / "devices" / "haptic-device.yaml").read_text("utf-8")
    device = device.replace("HapticDevice", "RateMass").replace("N*s/m, min", "1/s, min")
    folder = library(tmp_path, device.replace("- damping*v", "- mass*damping*v"))
    text = (TOPOLOGIES / "teleoperation-pair.yaml").read_text("utf-8").replace("Omega3", "RateMass")
    with pytest.raises(apc.ApcError, match="expected damping in N\\*s/m, got damping in 1/s"):
        compiled(text, folder)


def test_what_nobody_reads_or_hears_is_left_out_and_said(tmp_path: Path) -> None:
    model = changed(
        ("  network: 8 ms", "  network: 8 ms\n  spare: 3 ms"),
        ("  lan: {", "  wan: {clock: network, loss: 2 %, jitter: 1 ms}\n  lan: {"),
    )
    assert model.dropped == (("wan", "its packets are not received"), ("spare", "it is not used"))
    assert [one.name for one in (*model.links, *model.clocks)] == ["lan", "haptic", "network"]
    assert not [name for name in exact(model) if name.startswith("wan")]
    own = (
        "component: Follower\nconnectors: {flange: Flange}\n"
        "sends: {x: sample(flange.x), same: sample(flange.x), v: sample(der(flange.x))}\n"
        "parameters: {clock: clock, link: link, k: {unit: N/m}}\n"
        "equations: ['f = k*mean(others.x) + k*sum(others.same)', 'flange.f = hold(f)']\n"
    )
    text = ONE_MASS.replace("count: 1", "count: 2") + (
        "clocks: {tick: 1 ms}\nlinks: {lan: {clock: tick}}\n"
        "couplers: {all: {type: Follower, flange: device, k: 1 N/m, clock: tick, link: lan}}\n"
    )
    model = compiled(text, library(tmp_path, own))
    assert model.peer_types[0].sends[0].channels == ("all.x", "all.same")
    receives = model.peer_types[0].clocks[0].receives
    assert [(one.operator, one.channel) for one in receives] == [("mean", 0), ("sum", 1)]
    assert ("all.v", "it is not received") in model.dropped


def test_a_held_value_is_sent_though_only_another_kind_of_peer_hears_it(tmp_path: Path) -> None:
    """And what it is multiplied by, a parameter, is one of the sender's."""
    component = """\
component: Told
connectors: {object: Flange}
sends: {x: sample(object.x), f: gain*sample(acting)}
parameters:
  role: {options: [server, client], default: client}
  stiffness: {unit: N/m, min: 0}
  gain: {unit: 1, default: 1}
  clock: clock
  link: link
variables: {pull: {unit: N}, acting: {unit: N}, f: {unit: N}}
equations:
  - pull = stiffness*(sample(object.x) - mean(others.x))
  - acting = hold(pull)
  - f = if role == server and not (role == client) then -sum(others.f) else pull
  - object.f = hold(f)
"""
    text = """\
topology: told
clocks: {tick: 1 ms}
peers: {server: {count: 1, set: {it.role: server}}, client: {count: 2}}
masses: {cube: {mass: 1 kg, damping: 1 N*s/m}}
couplers: {it: {type: Told, object: cube, stiffness: 50 N/m, gain: 0.5, clock: tick, link: lan}}
links: {lan: {clock: tick, delay: 2 ms, graph: star}}
"""
    model = compiled(text, library(tmp_path, component))
    server, client = model.peer_types
    [send] = client.sends
    held = [float(one.name == "it.pull") for one in client.holds]
    p = [values(model)[name] for name in client.parameters]
    sent = listed(casadi.DM(send.send([0.0] * len(client.states), held, p, 0)))
    assert sent[send.channels.index("it.f")] == 0.5
    assert [one.name for one in server.clocks[0].receives][-1] == "sum(others.it.f)"


# ---- what a topology seldom means ----

RANGE = "is a range: analyze and tune cover every constant delay in it and report delays that change "
RANGE += "from packet to packet; other commands use the midpoint; simulate and export need a single delay."
UNSHARED = (
    "is coupled to the other peers by coordination but is not shared; its mass applies to each peer in full. "
    "Use shared: false if each peer has a separate mass. Try: shared: true, or shared: false"
)
ALL_LOST = "W277 every packet of lan is lost, so no packet ever arrives."
ODD: list[tuple[tuple[tuple[str, str], ...], list[str]]] = [
    ((), []),
    ((("links:\n", "links:\n  wan: {clock: network}\n"),), ["15:3: W271 the link wan is not used."]),
    ((("masses:\n", "masses:\n  lone: {mass: 1 kg}\n"),),
     ["9:3: W272 lone is not connected to a coupler, a hand or another mass."]),
    ((("masses:\n", "masses:\n  lone: {mass: 1 kg, flange: device}\n"),), []),
    ((("b: cube, ", "b: ground, "),), []),
    ((("masses:\n", "masses:\n  fixed: {mass: 1 kg, flange: ground}\n"),), []),
    ((("  user: {count: 3}", "  left: {count: 2}\n  right: {count: 2}"),
      ("b: cube, ", "b: cube, at: [left], ")),
     ["10:3: W272 device of right is not connected to a coupler, a hand or another mass."]),
    ((("delay: 8 ms}", "delay: [8 ms, 20 ms]}"),), [f"15:3: W275 lan.delay {RANGE}"]),
    ((("delay: 8 ms}", "delay: 8 ms, loss: 1}"),), [f"15:44: {ALL_LOST} Try: loss: 1 %"]),
    ((("delay: 8 ms}", "delay: 8 ms, loss: 100 %}"),), [f"15:44: {ALL_LOST}"]),
    ((("delay: 8 ms}", "delay: 8 ms, loss: 99 %}"),), []),
    # A bad link that loses everything and never turns good; one that turns good; good links lose all, too.
    ((("delay: 8 ms}", "delay: 8 ms, loss: {p: 1 %, r: 0 %}}"),), [f"15:44: {ALL_LOST}"]),
    ((("delay: 8 ms}", "delay: 8 ms, loss: {p: 1, r: 1 %}}"),), []),
    ((("delay: 8 ms}", "delay: 8 ms, loss: {p: 0, r: 1, 1-k: 100 %}}"),), [f"15:44: {ALL_LOST}"]),
    ((("object: cube", "object: device"),), [f"9:3: W274 device {UNSHARED}"]),
    ((("object: cube", "object: device"), ("damping: 5 N*s/m}", "damping: 5 N*s/m, shared: false}")), []),
    ((("object: cube", "object: device"), ("a: device, b: cube", "a: ground, b: cube"),
      ("count: 3", "count: 3, set: {device.mass: 1 kg}")),
     ["10:3: W273 cube is shared, but no element couples its copies."]),
    (((", shared: true", ""),), [f"10:3: W274 cube {UNSHARED}"]),
]  # fmt: skip


@pytest.mark.parametrize(("pairs", "expected"), ODD)
def test_what_is_seldom_meant_is_told_at_its_place(pairs: Any, expected: list[str]) -> None:
    assert changed(*pairs).warnings == tuple(f"topology.yaml:{one}" for one in expected)


@pytest.mark.whole
def test_every_command_that_judges_says_a_warning_and_a_model_keeps_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "topology.yaml"
    path.write_text(replaced(AVERAGE, *ODD[1][0]), encoding="utf-8")
    warning = f"topology.yaml:{ODD[1][1][0]}"
    for words in (["check", str(path)], ["compile", str(path)], ["analyze", str(path.with_suffix(".apc"))]):
        assert run(words) == 0
        assert f"  Warning: {warning}" in capsys.readouterr().out.splitlines()[:8]
    assert run(["analyze", "--json", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == [warning]


# ---- stages as text ----

GOLDEN = Path(__file__).with_name("golden")
NAMES = ("three-users-average", "three-users-mesh", "experiment-average", "finger", "mixed-clocks")
# What a person or a file gets of the five topologies, as one digest.
DIGEST = f"""
import hashlib, pathlib, apc
from apc.__main__ import run
whole = hashlib.sha256(repr(apc.schema()).encode())
for name in {NAMES!r}:
    path = pathlib.Path({str(TOPOLOGIES)!r}) / f"{{name}}.yaml"
    for stage in ("source", "topology", "flat", "clocked", "sorted"):
        run(["compile", str(path), "--until", stage])
    apc.save(apc.compile(path), "topology.apc")
    whole.update(pathlib.Path("topology.apc").read_bytes())
    for form in ("text", "json", "dot", "svg"):
        whole.update(apc.show(path, format=form).encode())
print(whole.hexdigest())
"""


@pytest.mark.parametrize("path", sorted(GOLDEN.iterdir()), ids=lambda path: path.name)
def test_a_topology_becomes_the_equations_that_were_found_right(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """When they are meant to change: `apc compile TOPOLOGY --until STAGE` prints them; read the
    difference.
    """
    name, stage, _ = path.name.split(".")
    assert run(["compile", str(TOPOLOGIES / f"{name}.yaml"), "--until", stage]) == 0
    assert capsys.readouterr().out == path.read_text(encoding="utf-8")


def test_what_a_link_does_is_listed_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    channel = "8 ms, loss: {p: 1 %, r: 25 %}, jitter: 2 ms, distribution: pareto, reorder: all}"
    (tmp_path / "topology.yaml").write_text(replaced(AVERAGE, ("8 ms}", channel)), encoding="utf-8")
    assert run(["compile", str(tmp_path / "topology.yaml"), "--until", "topology"]) == 0
    lines = ["  Gilbert–Elliott loss: p 1 %, r 25 %, 1-h 100 %, 1-k 0 %", "  jitter 2 ms, pareto"]
    lines += ["  uses the packet that arrived last, holds the previous value on loss"]
    assert set(lines) <= set(capsys.readouterr().out.splitlines())


@pytest.mark.whole
def test_the_same_topology_gives_the_same_bytes_whatever_the_order_of_hashes(tmp_path: Path) -> None:
    printed = set()
    for seed in ("0", "4242"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", DIGEST]
        printed.add(subprocess.check_output(command, cwd=tmp_path, env=environment, text=True))
    assert len(printed) == 1


def test_a_model_holds_every_text_it_was_made_from_and_no_other() -> None:
    path = TOPOLOGIES / "three-users-average.yaml"
    origin = apc.compile(path).origin
    texts = dict(origin.texts)
    assert origin.topology == path.name
    assert set(texts) == {path.name, "AveragePosition", "Flange", "Link", "Mass", "SampledSpringDamper"}
    assert texts[path.name] == path.read_bytes()
    assert texts["Mass"] == (TOPOLOGIES.parent / "mechanics" / "mass.yaml").read_bytes()
    digests = dict(origin.digests)
    assert digests.keys() == {*texts, "apc"}
    assert digests["Mass"] == hashlib.sha256(texts["Mass"]).hexdigest()


def test_a_file_is_read_once_and_none_for_stored_texts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("users-table.yaml", "users.csv"):
        (tmp_path / name).write_bytes((TOPOLOGIES / name).read_bytes())
    read: list[str] = []
    monkeypatch.setattr(
        "apc.compiler.files.read_file",
        lambda path, most, original=read_file: read.append(str(path)) or original(path, most),
    )
    model = compile_topology(tmp_path / "users-table.yaml")
    assert len(read) == len(set(read)) and str(tmp_path / "users.csv") in read
    read.clear()
    (tmp_path / "users.csv").unlink()
    again = compile_again(model.origin, tmp_path)
    assert not read and again.groups[0].columns[0].name == model.groups[0].columns[0].name
