"""Simulations in which users join and leave: against all peers of the paper's topology, stepped by hand."""

from __future__ import annotations

import re
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.compiler.errors import ApcError
from apc.network.packet_schedule import Timetable
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.bruteforce import TopologySource, frame_matrix
from tests.commands import Cli
from tests.hidden import hidden
from tests.topologies import TOPOLOGIES, compiled

pytestmark = pytest.mark.needs_extension("changing_counts")

Floats = NDArray[np.float64]
AVERAGE, MESH = TOPOLOGIES / "three-users-average.yaml", TOPOLOGIES / "three-users-mesh.yaml"
FRAME = 0.008
SIZE = 14  # values of a peer: x, v, x_O, v_O, (contact, own, received) of two ticks, two packets (x_O, v_O)
STATES = ("device.x", "device.v", "cube.x", "cube.v")
OWN = [
    0,
    1,
    4,
    7,
]  # values of the device and of the contact, which a joining peer does not take from the others


def step(operator: str, peers: int) -> Floats:
    """Return the frame matrix of all peers, peer by peer."""
    return np.array(frame_matrix(TopologySource(operator, peers, kt=500.0, cube=0.6 / peers)))


def by_hand(
    operator: str, start: dict[int, Floats], sets: list[set[int]], own: list[int]
) -> list[dict[int, Floats]]:
    """Return the values of the present peers at the start of each frame, for the peers present in each."""
    peers, steps, result = start, dict[int, Floats](), []
    for present in sets:
        mean = np.mean([values for peer, values in peers.items() if peer in present], axis=0)
        new = mean.copy()
        new[own] = 0.0
        peers = {peer: peers.get(peer, new) for peer in sorted(present)}
        result.append(peers)
        count = len(peers)
        steps.setdefault(count, step(operator, count))
        after = steps[count] @ np.concatenate([*peers.values()])
        peers = dict(zip(peers, np.split(after, count), strict=True))
    return result


def random_sets(rng: np.random.Generator, changes: int, most: int = 4) -> list[set[int]]:
    """Return the peers present in successive frames, with some random changes; each joins once at most."""
    present, newest, sets = {1, 2}, 2, [{1, 2}] * 3
    for _ in range(changes):
        leaving = {peer for peer in present if rng.random() < 0.4}
        stay = present - leaving or {max(present)}
        count = int(rng.integers(max(2, len(stay)), most + 1))
        joining = set(range(newest + 1, newest + 1 + count - len(stay)))
        newest += len(joining)
        present = stay | joining
        sets += [present] * int(rng.integers(1, 4))
    return sets


def times(sets: list[set[int]]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the joins and leaves of peers present in successive frames, in seconds."""
    joins, leaves = dict[str, float](), dict[str, float]()
    for frame, (before, after) in enumerate(pairwise(sets), 1):
        joins |= {f"user[{peer}]": round(frame * FRAME, 6) for peer in after - before}
        leaves |= {f"user[{peer}]": round(frame * FRAME, 6) for peer in before - after}
    return joins, leaves


def at_mean(path: Path, tmp_path: Path) -> Path:
    """Return a topology in which the devices and contacts too join at the mean of the others."""
    text = path.read_text(encoding="utf-8").replace("device: {", "device: {joining: mean, ")
    changed = tmp_path / "at-mean.yaml"
    changed.write_text(text.replace("contact:      {", "contact: {joining: mean, "), encoding="utf-8")
    return changed


@pytest.mark.parametrize("joining", ["mean", "start"])
@pytest.mark.parametrize("jit", [True, False])
@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_a_simulation_agrees_with_all_peers_stepped_by_hand(
    operator: str, jit: bool, joining: str, tmp_path: Path
) -> None:
    """Up to eight changes of up to four present peers, at random."""
    path = AVERAGE if operator == "mean" else MESH
    path = at_mean(path, tmp_path) if joining == "mean" else path
    rng = np.random.default_rng(3)
    for _ in range(4):
        sets = random_sets(rng, 8)
        joins, leaves = times(sets)
        count = max(map(max, sets))
        start = {1: np.eye(SIZE)[1] * 0.1, 2: np.zeros(SIZE)}
        run = apc.simulate(
            path,
            params={"user.count": count},
            duration=len(sets) * FRAME,
            impulse="user[1]",
            joins=joins,
            leaves=leaves,
            jit=jit,
        )
        own = OWN if joining == "start" else []
        for frame, peers in enumerate(by_hand(operator, start, sets, own)):
            for peer in range(1, count + 1):
                row = [run[f"user[{peer}].{name}"][8 * frame] for name in STATES]
                expected = peers[peer][:4] if peer in peers else [np.nan] * 4
                assert row == pytest.approx(expected, rel=1e-9, abs=1e-14, nan_ok=True)


def opposed(tmp_path: Path, count: int) -> Path:
    """Return the topology in which the devices of the first two peers move in opposite directions."""
    speeds = ", ".join(["0.1 m/s", "-0.1 m/s", *["0 m/s"] * (count - 2)])
    text = AVERAGE.read_text(encoding="utf-8").replace("{count: 3}", f"{{set: {{device.v: [{speeds}]}}}}")
    path = tmp_path / "opposed.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_growing_sequence_grows_at_its_rate(tmp_path: Path) -> None:
    """Two peers stay; in each repetition new peers join and leave again."""
    found = apc.changing_counts(AVERAGE, "user.count=2:5")
    cycles, sets, newest = 30, list[set[int]](), 2
    for count in found.sequence * cycles:
        stay = {peer for peer in sets[-1] if peer > 2} if sets and count > 2 else set[int]()
        joining = set(range(newest + 1, newest + 1 + count - 2 - len(stay)))
        newest += len(joining)
        sets.append({1, 2} | stay | joining)
    joins, leaves = times(sets)
    joins = {peer: at for peer, at in joins.items() if at}
    run = apc.simulate(
        opposed(tmp_path, newest),
        duration=len(sets) * FRAME,
        signals=["user[1].cube.x", "user[2].cube.x"],
        joins=joins,
        leaves=leaves,
    )
    half = (run["user[1].cube.x"] - run["user[2].cube.x"])[:-1:8] / 2  # at the starts of frames
    largest = np.abs(half).reshape(cycles, -1).max(axis=1)[10:]
    growth = np.exp(np.polyfit(np.arange(len(largest)), np.log(largest), 1)[0] / len(found.sequence))
    assert growth == pytest.approx(found.growth, rel=2e-3)


@pytest.mark.parametrize("joining", ["mean", "start"])
def test_motions_proved_to_decay_do_so_under_random_changes(joining: str, tmp_path: Path) -> None:
    """Two or three users come and go at any frame: proved stable if all values of a new peer are means."""
    path = at_mean(AVERAGE, tmp_path) if joining == "mean" else AVERAGE
    found = apc.changing_counts(path, "user.count=2:3")
    assert found.verdict == "stable under arbitrary changes"
    assert found.assumed == (() if joining == "mean" else ("device", "contact"))
    assert ("joining: mean is assumed for device, contact" in str(found)) == (joining == "start")
    rng = np.random.default_rng(5)
    for _ in range(3):
        sets = random_sets(rng, 60, most=3)
        joins, leaves = times(sets)
        count = max(map(max, sets))
        run = apc.simulate(
            path,
            params={"user.count": count},
            duration=len(sets) * FRAME,
            signals=["*.v"],
            impulse="user[1]",
            joins=joins,
            leaves=leaves,
        )
        assert np.nanmax(np.abs(run.values[-80:])) < 0.05 * np.nanmax(np.abs(run.values))


def test_with_the_same_numbers_at_all_times_nothing_changes() -> None:
    """A peer that joins with the values of the others does not change their motion."""
    still = apc.simulate(AVERAGE, duration="0.4 s", params={"user.count": 4}, joins={"user[4]": "80 ms"})
    assert np.isnan(still["user[4].cube.x"][:80]).all()
    assert not np.nan_to_num(still.values).any()


def test_the_work_of_a_peer_that_leaves_remains() -> None:
    common = {"impulse": "user[1]", "signals": ["cube.x"]}
    before = apc.simulate(AVERAGE, duration="0.8 s", **common)  # type: ignore[arg-type]
    after = apc.simulate(AVERAGE, duration="0.84 s", leaves={"user[1]": 0.8}, **common)  # type: ignore[arg-type]
    assert dict(after.summary.work) == pytest.approx(dict(before.summary.work), rel=1e-4)


def test_the_summary_is_that_of_the_peers_at_the_end() -> None:
    run = apc.simulate(
        AVERAGE, duration="2 s", impulse="user[1]", joins={"user[3]": "0.4 s"}, leaves={"user[1]": "0.8 s"}
    )
    extents = {extent.name: extent for extent in run.summary.extents}
    for name, extent in extents.items():
        values = run[name][np.isfinite(run[name])]
        expected = values[0], values[-1], values.min(), values.max()
        assert (extent.first, extent.last, extent.low, extent.high) == expected
    last = [run[f"user[{peer}].cube.x"][-1] for peer in (2, 3)]
    assert dict(run.summary.copies)["cube.x"] == pytest.approx(abs(last[0] - last[1]), rel=1e-12)
    assert run.summary.verdict == "decays"
    # Decay and frequency are those of two users.
    analysis = apc.analyze(AVERAGE, params={"user.count": 2})
    assert run.summary.fit is not None and run.summary.fit.oscillation is not None
    assert run.summary.fit.rate == pytest.approx(np.log(analysis.spectral_radius) / FRAME, rel=1e-4)
    found = [mode.frequency_hz for mode in analysis.modes]
    assert min(abs(run.summary.fit.oscillation.frequency - frequency) for frequency in found) < 1e-3


def test_files_have_gaps_where_a_peer_is_absent(cli: Cli, tmp_path: Path) -> None:
    times = ["--joins", "user[3]=80 ms", "--leaves", "user[1]=160 ms", "--duration", "0.2 s"]
    outputs = ["--out", str(tmp_path / "run.csv"), "--plot", str(tmp_path / "run.svg")]
    ran = cli("simulate", str(AVERAGE), *times, "--impulse", "user[1]", *outputs)
    assert ran.code == 0 and "user[3] joins at 80 ms, user[1] leaves at 160 ms" in " ".join(ran.out.split())
    lines = (tmp_path / "run.csv").read_text(encoding="utf-8").splitlines()
    columns = lines[0].split(",")
    first, third = columns.index("user[1].cube.x [m]"), columns.index("user[3].cube.x [m]")
    rows = [line.split(",") for line in lines[1:]]
    assert [row[first] == "" for row in rows] == [at >= 160 for at in range(201)]
    assert [row[third] == "" for row in rows] == [at < 80 for at in range(201)]
    assert (tmp_path / "run.svg").stat().st_size > 10_000
    reported = cli("simulate", str(AVERAGE), *times, "--json")
    assert '"joins_s": {\n      "user[3]": "2/25"' in reported.out


def test_the_peer_of_a_group_of_one_needs_no_number(tmp_path: Path) -> None:
    """Its join is understood, and refused since each group has a peer at every instant."""
    path, text = tmp_path / "topology.yaml", AVERAGE.read_text(encoding="utf-8")
    path.write_text(text.replace("{count: 3}", "{count: 2}\n  late: {count: 1}"), encoding="utf-8")
    with pytest.raises(ApcError, match="E914 peers of late from 0 s on: expected at least 1, got 0"):
        apc.simulate(path, duration="0.2 s", joins={"late": 0.08})


def test_the_experiment_of_a_topology_has_joins_and_leaves(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "topology.yaml"
    keys = 'experiment:\n  duration: 0.2 s\n  joins:\n    user[3]: 80 ms\n  leaves: {"user[1]": 160 ms}\n'
    path.write_text(
        AVERAGE.read_text(encoding="utf-8").replace("studies:", f"{keys}studies:"), encoding="utf-8"
    )
    run = apc.simulate(path)
    assert np.isfinite(run["user[3].cube.x"]).sum() == 121 and np.isfinite(run["user[1].cube.x"]).sum() == 160


NAMED = """parameters: {late: 80 ms, early: 160 ms}
experiment: {duration: 2*early, joins: {"user[3]": late}, leaves: {"user[1]": early}}
"""


@pytest.fixture
def named(tmp_path: Path) -> Path:
    """Return a topology whose instants and duration depend on parameters."""
    path = tmp_path / "topology.yaml"
    path.write_text(f"{AVERAGE.read_text(encoding='utf-8')}\n{NAMED}", encoding="utf-8")
    return path


@pytest.mark.parametrize("is_compiled", [False, True])
def test_instants_follow_the_parameters_they_depend_on(
    named: Path, cli: Cli, tmp_path: Path, is_compiled: bool
) -> None:
    """The run is that of a topology with the changed instants as numbers."""
    text = named.read_text(encoding="utf-8")
    for old, number in (("2*early", "400 ms"), (": late", ": 120 ms"), (": early", ": 200 ms")):
        text = text.replace(old, number)
    (tmp_path / "numbers.yaml").write_text(text, encoding="utf-8")
    assert cli("compile", str(named)).code == 0
    source = named.with_suffix(".apc") if is_compiled else named
    found = apc.simulate(source, params={"late": "120 ms", "early": "200 ms"}, impulse="user[2]")
    expected = apc.simulate(tmp_path / "numbers.yaml", impulse="user[2]")
    np.testing.assert_array_equal(found.values, expected.values)
    assert np.isfinite(found["user[3].cube.x"]).sum() == 401 - 120
    assert np.isfinite(found["user[1].cube.x"]).sum() == 200 and found.time[-1] == 0.4


def test_an_analysis_states_that_all_peers_are_present(named: Path) -> None:
    note = "excluded: the joins and leaves of the experiment; all peers are present"
    analysis = apc.analyze(named)
    assert note in " ".join(str(analysis).split()) and note not in str(apc.analyze(AVERAGE))
    assert analysis.spectral_radius == apc.analyze(AVERAGE).spectral_radius


BAD_VALUES = {
    "late=81_ms": r'E914 join of user\[3\]: expected the start .*, got 0.081 s. Try: "user\[3\]": 0.08 s',
    "late=-8_ms": r"E914 join of user\[3\]: expected more than 0 s .*, got -0.008 s",
    "early=0_s": r"E625 duration: expected a time above 0 s, got 0 ms",
    "user.late=88_ms": r"E622 late is a number of the topology, but depends on a value of user",
}


@pytest.mark.parametrize("value", BAD_VALUES)
def test_bad_values_of_instants_are_refused(value: str, named: Path, cli: Cli) -> None:
    ran = cli("simulate", str(named), "--set", value.replace("_", " "))
    assert ran.code == 1 and not ran.out
    assert re.search(BAD_VALUES[value], " ".join(ran.err.split())), ran.err


BAD = {
    "--joins user[4]=400_ms": r"E914 joins: .* of the topology .*, got user\[4\]. Try: --set user.count=4",
    "--joins user[0]=400_ms": r"E914 joins: expected a peer of the topology .*, got user\[0\]\.$",
    "--joins users[3]=400_ms": r"E914 joins: expected a peer of the topology .*, got users\[3\]",
    "--joins user=400_ms": r'one peer of the group, .*, got user. Try: --joins "user\[1\]=0.4 s"',
    "--leaves user=400_ms": r'E914 leaves: expected one peer .* Try: --leaves "user\[1\]=0.4 s"',
    "--joins user[3]=0_s": r"E914 join of user\[3\]: expected more than 0 s .*, got 0 s",
    "--joins user[3]=-1_s": r"E914 join of user\[3\]: expected more than 0 s .*, got -1 s",
    "--leaves user[3]=1_s": r"E914 leave of user\[3\]: .* less than the duration, 1 s, got 1 s",
    "--joins user[3]=401_ms": r'0.4 s or 0.408 s, got 0.401 s. Try: --joins "user\[3\]=0.4 s"',
    "--joins user[3]=4_kg": r'E204 user\[3\]: expected s, got 4 kg. Try: --joins "user\[3\]=4 s"',
    "--joins user[3]=4": r'E204 user\[3\]: expected s, got 4 \(no unit\). Try: --joins "user\[3\]=4 s"',
    "--joins user[3]": r"E914 joins: expected PEER=TIME, got user\[3\]",
    "--joins user[3]=400_ms --joins user[3]=800_ms": r"E914 user\[3\]: expected one instant .*, got two",
    "--joins user[3]=800_ms --leaves user[3]=400_ms": r"E914 leave of user\[3\]: .* after its join at 0.8 s",
    "--joins user[3]=800_ms --leaves user[3]=800_ms": r"E914 leave of user\[3\]: .* after its join at 0.8 s",
    "--leaves user[3]=400_ms --leaves user[2]=800_ms": r"E914 peers of user from 0.8 s on: .* at least 2",
    "--joins user[3]=400_ms --joins user[2]=400_ms": r"E914 peers of user from 0 s on: .* at least 2, got 1",
}


@pytest.mark.parametrize("options", BAD)
def test_bad_joins_and_leaves_are_refused(options: str, cli: Cli, tmp_path: Path) -> None:
    words = [word.replace("_", " ") for word in options.split()]
    out = tmp_path / "run.csv"
    ran = cli("simulate", str(AVERAGE), "--duration", "1 s", *words, "--out", str(out))
    assert ran.code == 1 and not ran.out and not out.exists()
    assert re.search(BAD[options], " ".join(ran.err.split())), ran.err


BAD_LINKS = {
    "delay: 8 ms, graph: ring": None,
    "delay: 8 ms, loss: 5 %": None,
    "delay: 8 ms, loss: 5 %, graph: ring": "graph of lan .*: expected complete, got ring. Try: graph",
    "delay: 8 ms, graph: {edges: [[1, 2], [2, 3], [3, 4], [4, 1]]}": "graph of lan .* or ring, got a list",
    "delay: 8 ms, graph: star": "graph of lan .*: expected complete or ring, got star",
    "delay: 8 ms, loss: 5 %, on_loss: zero": "on_loss of lan .*: expected hold, got zero. Try: on_loss: hold",
    "delay: 8 ms, jitter: 9 ms, reorder: all": "reorder of lan .*: expected newest, got all",
}


@pytest.mark.parametrize("link", BAD_LINKS)
def test_links_that_refuse_leaves(link: str, tmp_path: Path, cli: Cli) -> None:
    path, text = tmp_path / "topology.yaml", AVERAGE.read_text(encoding="utf-8")
    path.write_text(
        text.replace("delay: 8 ms}", link + "}").replace("count: 3", "count: 4"), encoding="utf-8"
    )
    ran = cli("simulate", str(path), "--duration", "0.2 s", "--leaves", "user[1]=80 ms")
    expected = BAD_LINKS[link]
    assert ran.code == (expected is not None)
    assert expected is None or re.search(f"E914 {expected}", " ".join(ran.err.split())), ran.err


def test_without_the_extension_joins_are_refused_by_name(cli: Cli) -> None:
    with hidden("changing_counts"):
        ran = cli("simulate", str(AVERAGE), "--duration", "1 s", "--joins", "user[3]=400 ms")
    assert ran.code == 1 and not ran.out and "E882" in ran.err and "changing_counts" in ran.err


def test_a_copy_starts_at_the_mean_of_its_group_and_a_device_at_its_start() -> None:
    path = TOPOLOGIES / "experiment-average.yaml"
    run = apc.simulate(path, duration="0.4 s", joins={"left[2]": "0.2 s"})
    right, left = (run[f"{peer}.cube.x"][200] for peer in ("right[1]", "left[1]"))
    assert run["left[2].cube.x"][200] == pytest.approx(left, rel=1e-12) and left != right
    assert run["left[2].device.x"][200] == -0.03 and run["left[2].device.v"][200] == 0
    alone = apc.simulate(path, duration="0.2 s", params={"left.count": 1})
    assert run["left[1].device.x"][:200].tolist() == alone["left[1].device.x"][:200].tolist()


def test_absent_peers_of_a_table_are_as_if_their_row_were_missing(tmp_path: Path) -> None:
    text, table = (
        (TOPOLOGIES / name).read_text(encoding="utf-8") for name in ("users-table.yaml", "users.csv")
    )
    rows = table.splitlines()
    (tmp_path / "users.csv").write_text("\n".join([rows[0], *rows[2:]]) + "\n", encoding="utf-8")
    (tmp_path / "users-table.yaml").write_text(text, encoding="utf-8")
    expected = apc.simulate(tmp_path / "users-table.yaml", duration="0.2 s")
    found = apc.simulate(TOPOLOGIES / "users-table.yaml", duration="0.25 s", joins={"user[1]": "0.24 s"})
    assert expected.signals
    for signal in expected.signals:
        name = f"user[{signal.peer + 1}].{signal.local}"
        assert found[name][:201].tolist() == expected[signal.name].tolist()


def test_nonlinear_motion_and_planar_bodies_join(tmp_path: Path) -> None:
    """Runge-Kutta and the exact transition agree; a planar copy starts at the mean in every coordinate."""
    times = {"joins": {"user[3]": "0.08 s"}, "leaves": {"user[2]": "0.16 s"}, "impulse": "user[1]"}
    exact = apc.simulate(AVERAGE, duration="0.3 s", **times)  # type: ignore[arg-type]
    other = apc.simulate(AVERAGE, duration="0.3 s", method="rk4:0.1 ms", **times)  # type: ignore[arg-type]
    np.testing.assert_allclose(other.values, exact.values, rtol=0, atol=1e-7)
    planar = apc.simulate(TOPOLOGIES / "planar-users.yaml", duration="0.3 s", **times)  # type: ignore[arg-type]
    copies = [signal.local for signal in planar.signals if signal.peer == 3 and signal.role == "state"]
    at = int(np.flatnonzero(planar.time == 0.08)[0])
    means = {name: np.mean([planar[f"user[{peer}].{name}"][at] for peer in (1, 2)]) for name in copies}
    shared = [name for name in copies if not name.startswith("device")]
    assert shared
    for name in shared:
        assert planar[f"user[3].{name}"][at] == pytest.approx(means[name], rel=1e-12, abs=1e-18)


LOSSY = """
topology: lossy
clocks: {haptic: 1 ms, network: 8 ms}
peers:
  user: {set: {cube.x: [1 mm, -2 mm, 0 mm, 0 mm]}}
masses: {cube: {mass: 0.8 kg, damping: 2 N*s/m, shared: true}}
couplers: {coordination: {type: AveragePosition, object: cube, stiffness: 100 N/m, clock: haptic, link: lan}}
links: {lan: {clock: network, delay: 8 ms, loss: 75 %}}
experiment:
  duration: 0.4 s
  seed: 7
  joins: {"user[3]": 80 ms, "user[4]": 160 ms}
  leaves: {"user[1]": 240 ms}
"""


def lossy_by_hand(arrived: dict[tuple[int, int], set[int]]) -> Floats:
    """Return the positions (401, 4) of the peers of LOSSY; `arrived` are the packets on each link."""
    joins, leaves = {1: 0, 2: 0, 3: 80, 4: 160}, {1: 240}
    x, v = {1: 1e-3, 2: -2e-3}, {1: 0.0, 2: 0.0}
    held, sent, rows = {(1, 2): 1e-3, (2, 1): -2e-3}, dict[tuple[int, int], float](), []
    for now in range(401):
        for peer in [peer for peer, at in leaves.items() if at == now]:
            del x[peer], v[peer]
        for peer in [peer for peer, at in joins.items() if at == now > 0]:
            held |= {(other, peer): x[other] for other in x}
            x[peer], v[peer] = np.mean([*x.values()]), np.mean([*v.values()])
            held |= {(peer, other): x[peer] for other in x if other != peer}
        rows.append([x.get(peer, np.nan) for peer in joins])
        for sender, receiver in held:
            number = now // 8 - 1
            first = max(joins[sender], joins[receiver]) // 8
            if now % 8 == 0 and number >= first and number in arrived[sender, receiver] and sender in x:
                held[sender, receiver] = sent[sender, number]
        if now % 8 == 0:
            sent |= {(peer, now // 8): x[peer] for peer in x}
        mass, damping = 0.8 / len(x), 2.0
        decay = np.exp(-damping / mass * 1e-3)
        rise = mass * (1 - decay) / damping
        for peer in x:
            force = -100 * (x[peer] - np.mean([held[other, peer] for other in x if other != peer]))
            steady = force / damping
            x[peer], v[peer] = (
                x[peer] + rise * v[peer] + steady * (1e-3 - rise),
                decay * v[peer] + (1 - decay) * steady,
            )
    return np.array(rows)


@pytest.mark.parametrize("jit", [True, False])
def test_joins_over_a_lossy_link_agree_with_a_simulation_by_hand(tmp_path: Path, jit: bool) -> None:
    path = tmp_path / "lossy.yaml"
    path.write_text(LOSSY, encoding="utf-8")
    run = apc.simulate(path, jit=jit)
    # The losses of all peers.
    everyone = prepare(apc.compile(path), Settings(Fraction(4, 10), jit=jit))
    routes = everyone.population.exchange_program.routes
    [delivered] = Timetable(routes, everyone.arrival_processes, seed=7).take(51 * everyone.frame)
    arrived = {
        (sender + 1, receiver + 1): set(delivered.packets[:, index].tolist())
        for index, (sender, receiver) in enumerate(routes[0].pairs.tolist())
    }
    assert 0 < sum(map(len, arrived.values())) / len(arrived) < 40
    expected = lossy_by_hand(arrived)
    for peer in range(1, 5):
        np.testing.assert_allclose(run[f"user[{peer}].cube.x"], expected[:, peer - 1], rtol=0, atol=1e-15)


def test_many_runs_with_joins(cli: Cli) -> None:
    path = TOPOLOGIES / "lossy-average.yaml"
    ran = cli(
        "simulate",
        str(path),
        "--duration",
        "1 s",
        "--joins",
        "user[3]=0.4 s",
        "--runs",
        "5",
        "--impulse",
        "user[1]",
    )
    assert ran.code == 0 and "5 runs of 1 s" in ran.out and "Verdict" not in ran.out


JOINING = """
component: GroundedMass
description: A mass that joins at the mean of the others.
extends: Mass
joining: mean
"""


@pytest.mark.parametrize(
    ("entry", "expected"), [("", "mean"), (", joining: start", "start"), (", joining: mean", "mean")]
)
def test_a_component_declares_the_values_of_a_joining_peer(entry: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "grounded-mass.yaml").write_text(JOINING, encoding="utf-8")
    text = AVERAGE.read_text(encoding="utf-8").replace("clocks:", "library: ./parts\nclocks:", 1)
    text = text.replace("device: {", f"device: {{type: GroundedMass{entry}, ")
    path = tmp_path / "topology.yaml"
    path.write_text(text, encoding="utf-8")
    run = apc.simulate(path, duration="0.1 s", impulse="user[1]", joins={"user[3]": "80 ms"})
    mean = np.mean([run[f"user[{peer}].device.x"][80] for peer in (1, 2)])
    assert (
        run["user[3].device.x"][80] == pytest.approx(mean if expected == "mean" else 0.0, rel=1e-12) and mean
    )
    assert ("device" in apc.changing_counts(path, "user.count=2:3").assumed) == (expected == "start")


@pytest.mark.parametrize(
    ("key", "at", "duration", "verdict"),
    [
        ("joins", "0.8 s", "4 s", "diverges"),
        ("leaves", "0.8 s", "4 s", "decays"),
        ("joins", "1 s", "1.2 s", "not determined"),
        ("joins", "1.16 s", "1.2 s", "not determined"),
    ],
)
def test_the_verdict_is_that_of_the_peers_at_the_end(key: str, at: str, duration: str, verdict: str) -> None:
    """Three users of the mesh are stable, four are not."""
    times = {key: {"user[4]": at}}
    run = apc.simulate(MESH, params={"user.count": 4}, duration=duration, impulse="user[1]", **times)  # type: ignore[arg-type]
    assert run.summary.verdict == verdict
    analysis = apc.analyze(MESH, params={"user.count": 4 if key == "joins" else 3})
    if verdict == "not determined":
        assert "apc analyze: unstable" in run.summary.reason
    else:
        assert run.summary.fit is not None
        rate = np.log(analysis.spectral_radius) / FRAME
        assert run.summary.fit.rate == pytest.approx(rate, rel=1e-3)


def test_a_float_next_to_the_start_of_a_frame_is_that_instant() -> None:
    """21000 µs as 21000*1e-6 s is a float below 0.021."""
    assert 21_000 * 1e-6 < 0.021
    text = AVERAGE.read_text(encoding="utf-8").replace("8 ms", "3 ms")
    runs = [
        apc.simulate(compiled(text), duration=0.06, joins={"user[3]": at}) for at in (21_000 * 1e-6, "21 ms")
    ]
    assert np.array_equal(runs[0].values, runs[1].values, equal_nan=True)
