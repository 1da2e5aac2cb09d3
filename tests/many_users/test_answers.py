"""An answer as a whole: plain data, what was left out of it and why, what no mean can be of, empty tables."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.spectrum.ball_arithmetic import precision
from tests.bench.random_topologies import check, truth
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, library, replaced


def test_the_answer_is_plain_data() -> None:
    found = json.loads(json.dumps(apc.analyze(compiled(AVERAGE)).to_dict(), allow_nan=False))
    assert list(found) == [
        *("topology", "peers", "frame_s", "states_per_peer", "method", "verdict", "stable"),
        *("spectral_radius", "spectral_radius_error", "rigid_modes", "modes", "linearized", "notes", "proof"),
        *("limitations", "translations", "rotations", "unobservable", "radius_excess", "sides"),
        "equilibrium",
    ]
    assert (found["peers"], found["frame_s"], found["states_per_peer"]) == (3, 0.008, 8)
    first = found["modes"][0]
    assert abs(complex(*first["eigenvalue"])) == pytest.approx(first["magnitude"], rel=1e-15)
    assert set(first["participation"]) >= {"device.x", "contact.f(-1 ms)", "coordination.x sent(-8 ms)"}


def test_peers_that_differ_only_at_the_start_are_equal_however_many() -> None:
    rows = ", ".join(f"{k} um" for k in range(2000))
    many = compiled(replaced(AVERAGE, ("{count: 3}", f"{{set: {{device.x: [{rows}]}}}}")))
    plain = compiled(replaced(AVERAGE, ("count: 3", "count: 2000")))
    assert apc.analyze(many).method == "modes"
    assert apc.analyze(many).spectral_radius == apc.analyze(plain).spectral_radius


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return what runs `apc analyze` and returns what it prints."""

    def analyze(path: Path, *words: str) -> str:
        assert run(["analyze", str(path), *words]) == 0
        return capsys.readouterr().out

    return analyze


PAPER = TOPOLOGIES / "three-users-average.yaml"


@pytest.mark.needs_extension("event_order", "parameter_boxes")
def test_a_box_and_a_proof_stand_beside_the_answer(printed: Callable[..., str]) -> None:
    words = ("--certify", "--box", "contact.stiffness=±1%", "--event-order", "--json")
    found = json.loads(printed(PAPER, *words))
    assert found["proof"].startswith("proved stable") and {"event_order", "box"} <= found.keys()


def test_a_delay_of_a_thousand_frames_has_its_verdict_and_says_what_it_has_not(
    printed: Callable[..., str],
) -> None:
    text = printed(PAPER, "--set", "lan.delay=8 s")
    assert apc.analyze(PAPER, params={"lan.delay": "8 s"}).verdict in text
    assert "sensitivities not computed: 3 peers form one system of 2,006" in text
    assert "none: the topology is not stable at its present values" in text
    assert all(len(line) <= 80 for line in text.splitlines())


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "name", ["three-users-mesh", "three-users-average", "two-users-waves", "lossy-average"]
)
@pytest.mark.parametrize(
    "settings",
    [
        {"coordination.stiffness": "1e12 N/m"},
        {"contact.stiffness": "0 N/m", "contact.damping": "0 N*s/m"},
        {"device.mass": "1e-12 kg"},
        {"device.damping": "1e9 N*s/m"},
        {"lan.delay": "200 ms"},
    ],
    ids=str,
)
def test_a_table_that_is_empty_says_why(
    name: str, settings: dict[str, str], printed: Callable[..., str]
) -> None:
    path = TOPOLOGIES / f"{name}.yaml"
    known = {row.name for row in apc.parameters(path).rows}
    words = [word for one, value in settings.items() if one in known for word in ("--set", f"{one}={value}")]
    found = json.loads(printed(path, *words, "--json"))
    for one in (found, found["network"]):
        if one:
            assert one["sensitivities"]["derivatives"] or one["sensitivities"]["note"]
            assert one["margins"] or one["margins_note"]


# ---- who hears whom ----


def weighted(edges: str, text: str = MESH) -> str:
    """Return a topology of three users who hear one another over weighted edges or arcs."""
    return replaced(text, ("delay: 8 ms}", f"delay: 8 ms, graph: {{{edges}}}}}"))


@pytest.mark.few(3)
@pytest.mark.parametrize("seed", range(6))
def test_peers_that_weigh_one_another_move_together_freely(seed: int) -> None:
    generator, digits = random.Random(seed), (1, 2, 4, 9, 15, 17)[seed]
    arcs = [
        f"[{sender}, {receiver}, {generator.uniform(0.05, 1.2):.{digits}f}]"
        for sender in (1, 2, 3)
        for receiver in (1, 2, 3)
        if sender != receiver
    ]
    model = compiled(weighted(f"arcs: [{', '.join(arcs)}]"))
    found = apc.analyze(model, certify=True)
    assert found.verdict == "stable up to a common translation"
    assert str(found.proof).startswith("proved stable")
    with precision(256):
        assert check(found, *truth(model)) == ""


def test_rows_of_weights_that_add_up_to_one_as_decimals_are_a_mean(tmp_path: Path) -> None:
    part = """\
component: WeightedMean
description: Pulls a copy to what the weights make of the others.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, clock: clock, link: link}
equations:
  - object.f = hold(f)
  - f = stiffness*(sample(object.x) - sum(others.x))
"""
    text = weighted("arcs: [[1, 2, 0.1], [3, 2, 0.9], [2, 1, 0.3], [3, 1, 0.7], [1, 3, 0.4], [2, 3, 0.6]]")
    text = replaced(text, ("type: FullMesh", "type: WeightedMean"), (", delay: 1 ms, link", ", link"))
    model = compiled(text, library(tmp_path, part))
    assert apc.analyze(model, certify=True).verdict == "stable up to a common translation"


CANCEL = "arcs: [[1, 4, 0.1], [2, 4, 0.2], [3, 4, -0.3], [4, 1], [4, 2], [4, 3]]"
MEAN = ("FullMesh", "AveragePosition")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            weighted("arcs: [[1, 2, 0.3], [2, 1, 0.3], [3, 1, 1.0e-20], [1, 3]]"),
            r"E217 two sums of weights over lan differ by less than rounding",
        ),
        (replaced(weighted(CANCEL), MEAN, ("count: 3", "count: 4")), "E802"),
        (
            replaced(weighted("arcs: [[1, 2, 1], [3, 2, -1], [2, 1, 1], [2, 3, 1]]"), MEAN),
            r"E802 the weights of user\[2\] over lan add up to 0, so mean.. is undefined",
        ),
        (
            replaced(weighted("arcs: [[1, 2, 1], [3, 2, -1]]"), MEAN),
            r"E801 user\[1\] and user\[3\] have no incoming connection over lan, so mean\(\) is undefined",
        ),
    ],
)
def test_what_no_mean_can_be_of_is_refused(text: str, message: str) -> None:
    with pytest.raises(ApcError, match=message):
        apc.analyze(compiled(text))


# ---- what is left out ----

WHEEL = """\
component: Wheel
description: A mass that turns as well, its angle coupled to the others'.
connectors: {a: Flange}
parameters:
  mass: {unit: kg}
  damping: {unit: N*s/m}
  stiffness: {unit: N/m}
  inertia: {unit: kg*m^2}
  turning: {unit: N*m*s}
  twist: {unit: N*m}
  clock: clock
  link: link
sends: {phi: sample(phi)}
variables:
  x: {unit: m, start: 0 m}
  v: {unit: m/s, start: 0 m/s}
  phi: {unit: ANGLE, start: 0}
  w: {unit: ANGLE/s, start: 0 rad/s}
  t: {unit: N*m}
equations:
  - der(x) = v
  - mass*der(v) = a.f - damping*v - stiffness*x
  - der(phi) = w
  - t = twist*(sample(phi) - mean(others.phi))
  - inertia*der(w) = -hold(t) - turning*w
  - a.x = x
"""
WHEELS = """\
topology: wheels
clocks: {haptic: 1 ms, network: 4 ms}
peers: {left: {count: 1}, right: {count: 1, set: {wheel.phi: 0.1}}}
masses:
  wheel: {type: Wheel, mass: 1 kg, damping: 5 N*s/m, stiffness: 0 N/m, inertia: 0.001 kg*m^2,
          turning: 0.01 N*m*s, twist: 0.1 N*m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 4 ms}}
"""
# What is kept follows what the others keep, and pulls nothing.
KEPT = """\
component: Kept
description: Keeps what the others keep.
connectors: {object: Flange}
parameters: {lag: {unit: s, default: 1 s}, clock: clock, link: link}
sends: {s: sample(s)}
variables: {s: {unit: N, start: 1 N}, y: {unit: N, start: 0 N}}
equations:
  - der(s) = (hold(y) - s)/lag
  - y = mean(others.s)
  - object.f = 0*s
"""


@pytest.mark.parametrize("angle", ["rad", "deg", "turn"])
def test_what_turns_freely_is_a_rotation_and_what_shifts_freely_a_translation(
    angle: str, tmp_path: Path
) -> None:
    wheels: Model = compiled(WHEELS, library(tmp_path, WHEEL.replace("ANGLE", angle)))
    free = apc.analyze(wheels)
    assert (free.translations, free.rotations, free.unobservable) == (2, 1, ())
    assert "(2 translations and 1 rotation)" in str(free)
    assert "All motions decay except 2 translations and 1 rotation" in str(free)
    held = apc.analyze(wheels, params={"wheel.stiffness": "300 N/m"})
    assert (held.verdict, held.translations, held.rotations) == ("stable up to a common rotation", 0, 1)
    assert "a common rotation" in str(held)


def test_what_is_left_out_though_some_of_it_moves_in_modes_is_a_common_shift(tmp_path: Path) -> None:
    text = AVERAGE.replace("links:", "  kept: {type: Kept, object: cube, clock: haptic, link: lan}\nlinks:")
    found = apc.analyze(compiled(text, library(tmp_path, KEPT)))
    assert found.unobservable == ("the common shift of kept.s, kept.s sent",)
    assert any(share[0].startswith("kept.s") for mode in found.modes for share in mode.participation)
    assert "the common shift of kept.s" in str(found)
