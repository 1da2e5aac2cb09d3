"""The buzz of one-sided contacts: the describing function, the paper's experiment, lines of a spectrum."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import prepare
from apc.analysis.describing import Predicted, gain_of, load_of, predict
from apc.analysis.opened import contact_groups
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.simulation.buzz import LET_GO, _lines, buzz
from tests.topologies import AVERAGE, SCENES, compiled, replaced

AT_ONCE = ("delay: 8 ms}            # negligible", "delay: 0 ms}            # negligible")


def experiment(name: str, *pairs: tuple[str, str]) -> CompiledSystem:
    return compiled(replaced((SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8"), *pairs))


def predicted(system: CompiledSystem) -> Predicted | str:
    groups = contact_groups(system, prepare(system))
    assert not isinstance(groups, str)
    return predict(system, groups)


@pytest.mark.parametrize("bias", [-0.95, -0.4, 0.0, 0.3, 0.8, 0.99])
def test_the_describing_function_is_the_first_terms_of_a_fourier_series(bias: float) -> None:
    turn = np.linspace(0, 2 * np.pi, 2_000_001)[:-1]
    push = np.maximum(0.0, bias + np.cos(turn))
    assert gain_of(bias) == pytest.approx(float(2 * (push * np.cos(turn)).mean()), abs=1e-9)
    assert load_of(bias) == pytest.approx(float(push.mean()), abs=1e-9)
    assert 0.5 + math.asin(bias) / math.pi == pytest.approx(float((push > 0).mean()), abs=1e-5)


def test_the_buzz_of_the_experiment_is_predicted_and_played() -> None:
    # An independent program's figures: predicted 47.10 Hz, 2.437 mm, 80.5 %; played for three seconds
    # 46.95 Hz, 2.545 mm on the right, 1.273 mm on the left, 79.3 %.
    found = buzz(experiment("average", AT_ONCE))
    known = found.predicted
    assert known is not None
    assert known.attracts
    assert known.frequency_hz == pytest.approx(47.10, abs=0.005)
    assert known.in_contact == pytest.approx(0.805, abs=5e-4)
    right, left, other = found.contacts
    assert [one.name for one in found.contacts] == [
        f"{peer}.contact.push" for peer in ("right[1]", "left[1]", "left[2]")
    ]
    assert right.predicted_depth_m == pytest.approx(2.437e-3, abs=5e-7)
    assert left.predicted_depth_m == pytest.approx(2.437e-3 / 2, abs=5e-7)
    # What hands push with, contacts bear on the mean.
    assert [one.load_n for one in found.contacts] == pytest.approx([4.0, 2.0, 2.0], rel=1e-6)
    # Three seconds hold 141 swings: they tell the frequency to some hundredths of 1 Hz, and it still grew
    # then by two parts in a thousand.
    assert len(found.lines) == 1 and found.steady and not found.notes
    assert found.lines[0].frequency_hz == pytest.approx(46.95, abs=0.05)
    assert right.depth_m == pytest.approx(2.545e-3, rel=2e-3)
    assert left.depth_m == other.depth_m == pytest.approx(1.273e-3, rel=2e-3)
    assert right.in_contact == pytest.approx(0.793, abs=5e-4)
    text = str(found)
    assert "frequency                             47.1 Hz    46.99 Hz" in text
    assert "right[1].contact.push: depth         2.437 mm    2.549 mm" in text


def test_the_gain_is_where_contacts_that_never_let_go_are_marginal() -> None:
    system = experiment("average", AT_ONCE)
    known = predicted(system)
    assert isinstance(known, Predicted)
    spring = "{type: SampledSpringDamper, a: device, b: cube"
    weaker = (
        f"stiffness: {3900 * known.gain!r} N/m, damping: {0.05 * known.gain!r} N*s/m",
        "stiffness: 3900 N/m, damping: 0.05 N*s/m",
    )
    marginal = apc.analyze(
        experiment(
            "average",
            AT_ONCE,
            ("{type: OneSidedContact, a: device, b: cube, half_width: 20 mm", spring),
            weaker[::-1],
            ("contact.side: right, ", ""),
            ("contact.side: left, ", ""),
        )
    )
    assert marginal.spectral_radius == pytest.approx(1.0, abs=1e-12)
    assert marginal.modes[0].frequency_hz == pytest.approx(known.frequency_hz, rel=1e-9)


def test_a_cycle_that_motions_leave_is_told_from_one_they_come_to() -> None:
    # Stable with contacts closed, unstable with weaker ones: from its start the scene settles.
    found = buzz(experiment("average"))
    assert found.predicted is not None and not found.predicted.attracts
    assert found.lines == () and found.steady and found.bounded
    assert any("one that motions leave" in text for text in found.notes)
    assert found.settles
    told = str(found).splitlines()
    assert sum(line.endswith("settles") for line in told) == 1 + len(found.contacts)
    assert not any("e-" in line for line in told)


def test_two_lines_in_the_spectrum_are_said_to_defeat_one_sinusoid() -> None:
    found = buzz(experiment("mesh"))
    assert len(found.lines) == 2
    slow, fast = sorted(line.frequency_hz for line in found.lines)
    assert 37 < slow < 38 and 50 < fast < 51
    assert any("one sinusoid says nothing" in text for text in found.notes)


def test_what_goes_on_growing_is_told() -> None:
    found = buzz(experiment("mesh", AT_ONCE))
    assert found.predicted is None
    assert found.reason == "no buzz: with contacts of any part of their stiffness it is unstable"
    assert not found.steady and found.lines == ()
    assert any("still changes" in text for text in found.notes)


def test_lines_are_told_from_multiples_and_mixtures_of_others() -> None:
    time = np.arange(8000) * 1e-3

    def wave(frequency: float, phase: float) -> np.ndarray:
        return np.cos(2 * np.pi * frequency * time + phase)

    one = 1e-3 * wave(46.97, 0.3) + 3e-4 * wave(2 * 46.97, 1.0) + 1e-4 * wave(3 * 46.97, 2.0) + 5e-3
    [line] = _lines(time, one)
    assert line.frequency_hz == pytest.approx(46.97, abs=1e-3)
    assert line.amplitude_m == pytest.approx(1e-3, rel=1e-3)
    two = one + 4e-4 * wave(37.3, 1.0) + 2e-4 * wave(46.97 - 37.3, 0.0)
    assert [line.frequency_hz for line in _lines(time, two)] == pytest.approx([46.97, 37.3], abs=2e-3)


WALL = """\
topology: pressed
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 2 N*s/m}}
couplers:
  it: {type: VirtualWall, flange: device, stiffness: 1500 N/m, clock: tick, delay: 1 ms}
hands: {hand: {type: ConstantForce, flange: device, force: 3 N}}
"""


def test_a_wall_buzzes_under_the_hand_that_presses_it() -> None:
    found = buzz(compiled(WALL))
    assert found.predicted is not None and found.predicted.attracts
    # Alone: m s² + b s + g K e^{−s (T/2 + delay)} = 0 on the axis, but for what a hold is beside a delay.
    [contact] = found.contacts
    assert contact.load_n == pytest.approx(3.0, rel=1e-6)
    [line] = found.lines
    assert line.frequency_hz == pytest.approx(found.predicted.frequency_hz, rel=0.05)
    omega, delay = 2 * math.pi * found.predicted.frequency_hz, 1.5e-3
    assert math.tan(omega * delay) == pytest.approx(2 / (0.1 * omega), rel=0.02)


FORCE = (
    "type: OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 3900 N/m, damping: 0.05 N*s/m"
)


@pytest.mark.parametrize(
    ("instead", "why"),
    [
        ("type: SampledHuntCrossleyContact, a: device, b: cube, stiffness: 3900 N/m^(3/2)", "is not linear"),
        ("type: ForceSaturation, a: device, b: cube, limit: 2 N, stiffness: 3900 N/m", "pulls, too"),
    ],
)
def test_what_is_no_one_sided_spring_is_refused_by_name(instead: str, why: str) -> None:
    with pytest.raises(ApcError) as caught:
        buzz(compiled(replaced(_plain(), (FORCE, instead))))
    assert caught.value.mistakes[0].code == "E864"
    assert "no buzz to predict: contact." in str(caught.value) and why in str(caught.value)


def _plain() -> str:
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8")
    return replaced(text, ("contact.side: right, ", ""), ("contact.side: left, ", ""))


def test_a_contact_at_every_moment_and_a_scene_without_any_are_refused() -> None:
    always = "type: HuntCrossleyContact, a: device, b: cube, stiffness: 3900 N/m^(3/2)"
    with pytest.raises(ApcError, match="contact acts at every moment"):
        buzz(compiled(replaced(_plain(), (f"{FORCE}, clock: haptic", always))))
    with pytest.raises(ApcError, match="nothing touches"):
        apc.buzz(compiled(AVERAGE))


def test_more_peers_than_can_be_played_are_refused() -> None:
    many = replaced(WALL, ("count: 1", "count: 1000000"))
    with pytest.raises(ApcError, match="1,000,000 peers are too many to play for 8 s"):
        buzz(compiled(many))


def test_a_lossy_link_is_said_to_be_played_and_not_predicted() -> None:
    found = buzz(
        experiment("average", ("delay: 8 ms}            # negligible", "delay: 0 ms, loss: 1 %}   #"))
    )
    assert "predicted with every packet on time, played with lost and late ones" in found.notes


def test_it_is_shown_where_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8")
    Path("scene.yaml").write_text(replaced(text, AT_ONCE), encoding="utf-8")
    assert run(["analyze", "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["buzz"] is None and plain["buzz_note"] == "not predicted and played: --buzz"
    assert plain["switching"]["stable"] is False
    assert run(["analyze", "--json", "--buzz"]) == 0
    asked = json.loads(capsys.readouterr().out)
    assert asked["buzz"]["predicted"]["frequency_hz"] == pytest.approx(47.10, abs=0.005)
    assert asked["buzz"]["lines"][0]["frequency_hz"] == pytest.approx(46.95, abs=0.05)
    assert asked["buzz_note"] == ""
    Path("scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["analyze", "--buzz"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("three-users-average: stable")
    assert told.endswith("no buzz to predict: nothing touches.\n")


PRESSED = """\
topology: wall
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 1 N*s/m, x: 1 mm}}
couplers:
  wall: {type: VirtualWall, flange: device, stiffness: 5000 N/m, clock: haptic, x: 1 mm}
hands: {push: {type: ConstantForce, flange: device, force: FORCE}}
"""


def test_a_load_that_pulls_away_lets_go_and_a_poor_prediction_is_called_one() -> None:
    away = buzz(compiled(PRESSED.replace("FORCE", "-1 N")))
    assert away.notes == (LET_GO,)
    assert not away.lines
    assert not away.settles
    held = buzz(compiled(PRESSED.replace("FORCE", "1 N")))
    assert held.predicted is not None
    assert abs(held.lines[0].frequency_hz / held.predicted.frequency_hz - 1) > 0.2
    assert any("far from what is predicted" in note for note in held.notes)
