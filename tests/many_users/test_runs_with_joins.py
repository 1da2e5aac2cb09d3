"""Real-time runs in which users join and leave: the values of a joining peer, and the repeated simulation."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.realtime.peer import PeerLoop
from apc.realtime.peer_run import run_of
from tests.commands import Cli
from tests.hidden import hidden
from tests.surfaces.wire import Other, Wire, loop_at, send_packets
from tests.topologies import AVERAGE, compiled, replaced

pytestmark = pytest.mark.needs_extension("changing_counts")

DIGEST = bytes(32)
TIMES = "{duration: 0.4 s, joins: {'user[3]': 80 ms, 'user[4]': 160 ms}, leaves: {'user[1]': 240 ms}}"


def topology(times: str, cube: str = ", joining: start", count: str = "3") -> str:
    """Return three-users-average with joins and leaves, in motion."""
    start = ", ".join(["3 mm", "0 mm", "-2 mm", "1 mm"][: int(count)])
    return replaced(
        AVERAGE,
        ("{count: 3}", f"{{count: {count}, set: {{device.x: [{start}]}}}}"),
        ("shared: true", f"shared: true{cube}"),
        ("link: lan}", "link: lan, joining: start}"),
        ("studies:", f"experiment: {times}\nstudies:"),
    )


@pytest.mark.parametrize("loss", ["", ", loss: 20 %"])
def test_a_run_is_simulated_with_the_packets_received(
    loss: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With start values at the joins: every signal of every peer while it is present, to rounding."""
    monkeypatch.setattr("apc.realtime.start.claim", tuple)
    monkeypatch.chdir(tmp_path)
    text = topology(TIMES, count="4").replace("delay: 8 ms}", f"delay: 8 ms{loss}}}")
    Path("four.yaml").write_text(text, encoding="utf-8")
    assert run(["run", "--emulate", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["why_not"] == ""
    assert max(far for far, _ in reported["differences"].values()) <= 1e-12
    assert reported["differences"]["N"][1] > 0.1
    ticks = {item["peer"]: item["ticks"] for item in reported["ticks"]}
    assert ticks == {"user[1]": 240, "user[2]": 400, "user[3]": 320, "user[4]": 240}
    # All directed links have packets: those to a later peer are sent in advance.
    assert len(reported["arcs"]) == 12
    assert run(["compare", "four.run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["differences"] == reported["differences"]


def loop_of(text: str, wire: Wire) -> tuple[PeerLoop, list[Other]]:
    """Return the loop of the first of three peers, connected to the others."""
    loop = loop_at(wire, compiled(text), DIGEST, b"", "0.2")
    others = [Other(wire, number, DIGEST, b"") for number in range(1, 3)]
    loop.meet(60)
    return loop, others


def test_a_joining_peer_starts_at_the_mean_of_the_newest_received_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It joins at 80 ms; the newest packets are then those sampled at 72 ms, number 9."""
    loop, others = loop_of(
        topology("{duration: 0.2 s, joins: {'user[1]': 80 ms}}", cube=""), Wire(monkeypatch)
    )
    send_packets(loop, others[:1], 1e-3)
    send_packets(loop, others[1:], 2e-3)
    loop.run()
    record = run_of(loop, DIGEST, ())
    column = record.signals.index("user[1].cube.x")
    assert record.time[0] == pytest.approx(0.08) and record.first == 10 and len(record.time) == 120
    assert record.values[0, column] == pytest.approx((10e-3 + 20e-3) / 2, rel=1e-12)
    assert record.values[0, record.signals.index("user[1].device.x")] == 3e-3
    assert record.arrivals[:, 2].min() == 0  # it receives from the beginning


def test_without_a_packet_before_its_join_a_peer_has_start_values(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, _ = loop_of(topology("{duration: 0.2 s, joins: {'user[1]': 80 ms}}", cube=""), Wire(monkeypatch))
    loop.run()
    record = run_of(loop, DIGEST, ())
    assert record.values[0, record.signals.index("user[1].cube.x")] == 0.0
    assert all((packets == -1).all() for packets in record.packets)


@pytest.mark.parametrize("cube", ["", ", joining: start"])
def test_until_its_first_packet_the_others_hold_the_values_at_the_join(
    cube: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, others = loop_of(
        topology("{duration: 0.2 s, joins: {'user[3]': 80 ms}}", cube=cube), Wire(monkeypatch)
    )
    send_packets(loop, others[:1], 1e-3)
    loop.run()
    record = run_of(loop, DIGEST, ())
    [route], program = loop.player.routes, loop.player.population.exchange_program
    arc = route.pairs.tolist().index([2, 0])
    row = int(np.argmin(abs(record.time - 0.08)))
    own = {name: record.values[row, record.signals.index(f"user[1].cube.{name}")] for name in "xv"}
    for held, keys in zip(loop.player.held[0], program.channels[0], strict=False):
        name = "v" if "v" in program.keys[keys[0]].channel else "x"
        expected = 0.0 if cube else (own[name] + 10e-3) / 2
        assert held[arc] == pytest.approx(expected, rel=1e-12), program.keys[keys[0]].channel


def test_a_peer_that_leaves_ends_and_is_not_received(monkeypatch: pytest.MonkeyPatch) -> None:
    leaving, _ = loop_of(topology("{duration: 0.2 s, leaves: {'user[1]': 80 ms}}"), Wire(monkeypatch))
    leaving.run()
    record = run_of(leaving, DIGEST, ())
    assert record.time[-1] == pytest.approx(0.079)
    assert record.sent == {0: {1: 10, 2: 10}}
    staying, others = loop_of(topology("{duration: 0.2 s, leaves: {'user[3]': 80 ms}}"), Wire(monkeypatch))
    send_packets(staying, others, 1e-3)
    staying.run()
    record = run_of(staying, DIGEST, ())
    assert record.dropped == {"absent": 15} and record.sent == {0: {1: 25, 2: 10}}
    assert (record.packets[0][80:] == -1).any(axis=1).all()


@pytest.mark.parametrize(("late", "present"), [(60, [0, 1, 2]), (168, [0, 1])])
def test_a_peer_that_starts_late_begins_in_the_present_period(
    late: int, present: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One peer joins at 80 ms and leaves at 240 ms; the session began before this peer started."""
    times = "{duration: 0.4 s, joins: {'user[3]': 80 ms}, leaves: {'user[3]': 240 ms}}"
    wire = Wire(monkeypatch)
    loop = loop_at(wire, compiled(topology(times)), DIGEST, b"", "0.4")
    for number in (1, 2):
        other = Other(wire, number, DIGEST, b"")
        other.begins, other.session = wire.time - late * 10**6, 7
    loop.meet(60)
    assert loop.player.period.peers.tolist() == present
    loop.run()
    record = run_of(loop, DIGEST, ())
    assert record.first * 8 > late and record.time[0] == pytest.approx(record.first * 0.008)
    assert record.time[-1] == pytest.approx(0.4, abs=0.008) and np.isfinite(record.values).all()
    assert loop.player.period.peers.tolist() == [0, 1]


BAD = {
    "link: lan, joining: start}": r"joining of coordination in apc run: .*, got mean. Try: joining: start",
    "graph: ring}": r"graph of lan with joins or leaves: expected complete or star, got ring",
    "joins: {'user[9]': 80 ms}": r"E914 joins: expected a peer of the topology",
    "joins: {'user[3]': 81 ms}": r"E914 join of user\[3\]: expected the start of a frame",
}


@pytest.mark.parametrize("change", BAD)
def test_runs_that_are_refused(change: str, cli: Cli, tmp_path: Path) -> None:
    """Before a folder is written; of a ring the links of the present peers are not known in advance."""
    text, path = topology("{duration: 0.2 s, joins: {'user[3]': 80 ms}}"), tmp_path / "topology.yaml"
    text = (
        text.replace(change, "link: lan}")
        .replace("delay: 8 ms}", "delay: 8 ms, " + change if "graph" in change else "delay: 8 ms}")
        .replace("joins: {'user[3]': 80 ms}", change if "joins" in change else "joins: {'user[3]': 80 ms}")
    )
    path.write_text(text, encoding="utf-8")
    ran = cli("run", str(path), "--out", str(tmp_path / "x.run"))
    assert ran.code == 1 and not ran.out and not (tmp_path / "x.run").exists()
    assert re.search(BAD[change], " ".join(ran.err.split())), ran.err
    assert ran.err.count("E914") == 1


def test_without_the_extension_a_run_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    model = compiled(topology("{duration: 0.2 s, joins: {'user[3]': 80 ms}}"))
    with hidden("changing_counts"), pytest.raises(ApcError, match="E882"):
        loop_at(Wire(monkeypatch), model, DIGEST, b"")
