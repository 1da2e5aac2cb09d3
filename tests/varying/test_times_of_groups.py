"""A delay that groups set for themselves: without a group, one value for all, in every command.

The truth is the topology with that value written at every group.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from tests.topologies import compiled, replaced

TWO = """topology: two
clocks: {haptic: 1 ms, slow: 2 ms, network: 2 ms}
peers:
  a: {count: 1}
  b: {count: 1, set: {coordination.delay: 1 ms}}
masses:
  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  coordination: {type: AveragePosition, object: cube, stiffness: 200 N/m, clock: haptic, delay: 0 ms,
    link: lan}
links: {lan: {clock: network, delay: 2 ms}}
hands: {arm: {type: SpringDamperArm, flange: cube, stiffness: 50 N/m, damping: 0 N*s/m}}
"""
NAME = "coordination.delay"
OWN = "set: {coordination.delay: 1 ms}"
EVERY = replaced(TWO, ("a: {count: 1}", "a: {count: 1, set: {coordination.delay: 3 ms}}"))
FOLLOWING = replaced(
    TWO,
    ("peers:", "parameters: {lag: 1 ms}\npeers:"),
    (OWN, "set: {coordination.delay: 2*lag}"),
    ("delay: 0 ms", "delay: lag"),
)
CLOCKED = replaced(TWO, (OWN, "set: {coordination.delay: 1 ms, coordination.clock: slow}"))
TEXTS = {"one group": TWO, "every group": EVERY, "by a formula": FOLLOWING, "another clock": CLOCKED}
# Of an event-by-event simulation of two peers, 20 ms at both, and where its radius passes 1.
RADIUS, LIMIT = 1.007662959674, 11.25397e-3


def written(text: str, delay: str) -> str:
    """Return a topology with a delay written at every group."""
    for old in ("coordination.delay: 1 ms", "coordination.delay: 3 ms", "coordination.delay: 2*lag"):
        text = text.replace(old, f"coordination.delay: {delay}")
    return text.replace("delay: 0 ms", f"delay: {delay}").replace("delay: lag", f"delay: {delay}")


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
@pytest.mark.parametrize("delay", ["0 ms", "1.5 ms", "20 ms"])
def test_set_without_a_group_is_one_value_for_all_groups(text: str, delay: str) -> None:
    there = apc.analyze(compiled(written(text, delay)))
    here = apc.analyze(compiled(text), params={NAME: delay})
    assert here.spectral_radius == pytest.approx(there.spectral_radius, rel=1e-12)
    assert here.verdict == there.verdict


def test_analyze_and_critical_have_the_values_of_a_simulation_of_their_own() -> None:
    model = compiled(TWO)
    assert apc.analyze(model, params={NAME: "20 ms"}).spectral_radius == pytest.approx(RADIUS, rel=1e-12)
    assert apc.critical(model, NAME).value == pytest.approx(LIMIT, rel=1e-6)
    assert apc.critical(compiled(EVERY), NAME).value == pytest.approx(LIMIT, rel=1e-6)


def test_a_group_that_is_set_too_has_its_own_value_in_any_order() -> None:
    model = compiled(TWO)
    pairs = [(NAME, "20 ms"), ("b.coordination.delay", "3 ms")]
    text = replaced(TWO, ("delay: 0 ms", "delay: 20 ms"), ("delay: 1 ms", "delay: 3 ms"))
    truth = apc.analyze(compiled(text)).spectral_radius
    for some in itertools.permutations(pairs):
        assert apc.analyze(model, params=dict(some)).spectral_radius == pytest.approx(truth, rel=1e-12)


def test_the_commands_that_set_vary_or_play_a_delay_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("t.yaml").write_text(TWO, encoding="utf-8")
    Path("both.yaml").write_text(written(TWO, "20 ms"), encoding="utf-8")

    def printed(*words: str) -> dict[str, Any]:
        capsys.readouterr()
        assert run([*words, "--json"]) == 0
        return dict(json.loads(capsys.readouterr().out))

    assert run(["sweep", "t.yaml", "--over", f"{NAME}=20 ms:25 ms:2", "--out", "s.csv"]) == 0
    assert float(Path("s.csv").read_text().splitlines()[1].split(",")[2]) == pytest.approx(RADIUS, rel=1e-12)
    for file, setting in (("t.yaml", ["--set", f"{NAME}=20 ms"]), ("both.yaml", [])):
        words = [file, *setting, "--impulse", "a", "--duration", "0.2 s", "--out", f"{file}.csv"]
        assert run(["simulate", *words]) == 0
    here, there = (np.loadtxt(f"{name}.csv", delimiter=",", skiprows=1) for name in ("t.yaml", "both.yaml"))
    np.testing.assert_allclose(here, there, rtol=1e-9, atol=1e-12)
    assert printed("critical", NAME, "t.yaml")["value"] == pytest.approx(LIMIT, rel=1e-6)
    area = ["--x", f"{NAME}=5 ms:25 ms", "--y", "coordination.stiffness=199 N/m:210 N/m"]
    pieces = printed("region", "t.yaml", *area)["boundary"]
    points = np.array(
        sorted((point for piece in pieces for point in piece["points"]), key=lambda point: point[1])
    )
    assert np.interp(200, points[:, 1], points[:, 0]) == pytest.approx(LIMIT, rel=1e-3)


@pytest.mark.whole
@pytest.mark.needs_extension("event_order", "parameter_boxes")
def test_a_box_and_tuned_gains_are_those_of_the_delay_that_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("t.yaml").write_text(TWO, encoding="utf-8")
    Path("both.yaml").write_text(written(TWO, "20 ms"), encoding="utf-8")
    gain = "coordination.stiffness=10 N/m:400 N/m"
    found = []
    for words in (["t.yaml", "--set", f"{NAME}=20 ms"], ["both.yaml"]):
        capsys.readouterr()
        assert run(["tune", *words, "--free", gain, "--maximize", "coordination.stiffness", "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["value"])
        for high, stable in ((0.99, True), (1.01, False)):
            box = f"coordination.stiffness=100 N/m:{high * found[0]} N/m"
            assert run(["analyze", *words, "--no-margins", "--box", box, "--json"]) == 0
            assert json.loads(capsys.readouterr().out)["box"]["stable"] is stable
    assert found[0] == found[1]


def test_the_delay_of_a_pair_is_a_number_of_its_own_in_every_command(tmp_path: Path) -> None:
    text = replaced(TWO, ("delay: 2 ms}", "delay: 2 ms, delays: {a: {b: 4 ms}}}"))
    model = compiled(text)
    there = compiled(replaced(text, ("delay: 2 ms, delays", "delay: 8 ms, delays")))
    truth = apc.analyze(there).spectral_radius
    assert apc.analyze(model, params={"lan.delay": "8 ms"}).spectral_radius == pytest.approx(truth, rel=1e-12)
    for name, value in (("lan.delay", "8 ms"), ("lan.delays.a.b", "4 ms")):
        path = tmp_path / f"{name}.csv"
        apc.sweep(there, {name: [value, "40 ms"]}, out=path)
        radius = float(path.read_text().splitlines()[1].split(",")[2])
        assert radius == pytest.approx(truth, rel=1e-12), name
    assert apc.critical(model, "lan.delays.a.b", params={"lan.delay": "8 ms"}).value == pytest.approx(
        apc.critical(there, "lan.delays.a.b").value, rel=1e-9
    )


def test_what_a_name_without_a_group_replaces_can_not_be_varied_beside_it() -> None:
    with pytest.raises(ApcError, match="E902"):
        apc.region(compiled(TWO), x=f"{NAME}=1 ms:9 ms", y=f"b.{NAME}=1 ms:9 ms")


def test_a_group_without_a_delay_of_its_own_is_refused_with_the_setting_to_write(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "t.yaml"
    path.write_text(TWO, encoding="utf-8")
    assert run(["analyze", str(path), "--set", f"a.{NAME}=20 ms"]) == 1
    fix = "{a: {count: 1, set: {coordination.delay: 0 ms}}}"
    assert fix in " ".join(capsys.readouterr().err.split())
    pasted = compiled(replaced(TWO, ("a: {count: 1}", fix[1:-1])))
    truth = apc.analyze(compiled(replaced(TWO, ("delay: 0 ms", "delay: 20 ms")))).spectral_radius
    assert apc.analyze(pasted, params={f"a.{NAME}": "20 ms"}).spectral_radius == pytest.approx(
        truth, rel=1e-12
    )


def test_a_clock_and_a_link_keep_their_own_names_and_the_answer_names_what_they_do_not_reach(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = replaced(CLOCKED, ("delay: 2 ms}", "delay: 2 ms, delays: {a: {b: 4 ms}}}"))
    path = tmp_path / "t.yaml"
    path.write_text(text, encoding="utf-8")
    assert run(["analyze", str(path), "--set", "haptic.period=0.5 ms", "--set", "lan.delay=8 ms"]) == 0
    notes = capsys.readouterr().err
    assert "haptic.period belongs to clock haptic, which only a uses" in notes
    assert "lan.delay applies to all pairs of groups except those of lan.delays.a.b" in notes
    there = replaced(
        text, ("haptic: 1 ms", "haptic: 0.5 ms"), ("{clock: network, delay: 2", "{clock: network, delay: 8")
    )
    here = apc.analyze(compiled(text), params={"haptic.period": "0.5 ms", "lan.delay": "8 ms"})
    assert here.spectral_radius == pytest.approx(apc.analyze(compiled(there)).spectral_radius, rel=1e-12)
