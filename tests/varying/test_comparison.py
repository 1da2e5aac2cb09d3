"""Schemes side by side: the numbers of their own commands, and the cost counted by hand."""

from __future__ import annotations

import csv
import json
from functools import cache
from pathlib import Path

import casadi
import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.studies.comparison import Scheme, SchemeComparison
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, replaced

LOSSLESS = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 0 %}"))
LOSSY = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 10 %}"))
SHAKING = replaced(MESH, ("stiffness: 500 N/m", "stiffness: 700 N/m"))
# Two couplers that hear others, over one link.
LEASH = "  leash: {type: FullMesh, object: device, stiffness: 20 N/m, clock: haptic, link: lan}\nlinks:"
TWO_SPRINGS = replaced(AVERAGE, ("links:", LEASH))
FOLLOWING = replaced(
    AVERAGE,
    ("peers:", "parameters: {kt: 250 N/m, late: 8 ms}\npeers:"),
    ("stiffness: 500 N/m", "stiffness: 2*kt"),
    ("delay: 8 ms}", "delay: late}"),
)
ARM = "hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 100 N/m}}\nlinks:"
BOUNCING = """\
topology: bouncing
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}
couplers:
  wall: {type: VirtualWall, flange: device, position: 5 mm, stiffness: 500 N/m, clock: tick}
hands: {push: {type: ConstantForce, flange: device, force: 1 N}}
"""


@cache
def compared(*texts: str) -> SchemeComparison:
    return apc.compare([compiled(text) for text in texts])


def scheme(text: str) -> Scheme:
    return compared(text).schemes[0]


# ---- the numbers ----


@pytest.mark.parametrize(
    "text",
    [AVERAGE, SHAKING, pytest.param(LOSSY, marks=pytest.mark.whole)],
    ids=["average", "shaking", "lossy"],
)
def test_each_number_is_that_of_its_own_command(text: str) -> None:
    model, found = compiled(text), scheme(text)
    assert found.analysis == apc.analyze(model) and found.network == apc.mean_square_stability(model)
    assert found.stiffness == apc.critical(model, "coordination.stiffness")
    assert found.delay is None or found.delay == apc.critical(model, "lan.delay")
    assert found.loss is None or found.loss == apc.critical(model, "lan.loss")
    if found.transparency is not None:
        used = apc.transparency(model, found.transparency.frequency_hz.tolist())
        assert (
            np.array_equal(found.transparency.impedance, used.impedance) and found.transparency.at == used.at
        )


@pytest.mark.whole
def test_the_verdict_is_of_the_network_nominal_or_with_passive_hands_as_asked() -> None:
    model = compiled(LOSSY)
    assert scheme(LOSSY).verdict == "stable in mean square"
    (nominal,) = apc.compare([model], criterion="nominal").schemes
    assert (nominal.verdict, nominal.network) == ("stable up to a common translation", None)
    assert nominal.delay == apc.critical(model, "lan.delay", criterion="nominal")
    model = compiled(AVERAGE)
    (found,) = apc.compare([model], criterion="passive").schemes
    assert found.passive == apc.absolute_stability(model)
    assert found.verdict == "unstable with some passive hands"
    assert found.stiffness == apc.critical(model, "coordination.stiffness", criterion="passive")


@pytest.mark.whole
def test_a_scheme_that_is_not_linear_is_judged_in_time_beside_its_linearization() -> None:
    """A wall is in no linearization about a start before it; in time 1 N rests 2 mm in 500 N/m."""
    model = compiled(f"{BOUNCING}experiment: {{duration: 3 s}}\n")
    found = apc.compare([model, compiled(AVERAGE)])
    (one, linear) = found.schemes
    assert one.analysis is not None and one.analysis.linearized and linear.simulated is None
    played = apc.simulate(model)
    assert one.simulated is not None and one.simulated.to_dict() == played.to_dict()
    words = str(found).splitlines()
    place = words.index("Simulation") + 2
    assert words[place].split() == ["verdict", "duration"]
    settled = f"decays, settling time {played.summary.settled:.3g} s"
    assert words[place + 1 : place + 3] == [
        f"  1  {settled:<36}  3 s",
        "  2  not required: the topology is linear",
    ]
    column = found.to_dataframe()["in time"]
    assert column[0] == "decays" and column.isna()[1]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("experiment", "message"),
    [
        ("", "apc simulate: the topology has no duration."),  # what to write is for that command
        ("experiment: {duration: 1e12 s}\n", "apc simulate: duration: expected at most 1e+06 s"),
    ],
)
def test_what_is_not_played_says_why(experiment: str, message: str) -> None:
    found = scheme(BOUNCING + experiment)
    assert found.simulated is None and dict(found.missing)["simulated"].startswith(message)
    assert "in time" not in str(compared(AVERAGE, MESH))


@pytest.mark.whole
def test_a_scheme_that_refuses_has_its_place_and_says_why(tmp_path: Path) -> None:
    files = []
    for name, text in (("free", AVERAGE), ("held", replaced(AVERAGE, ("links:", ARM)))):
        (tmp_path / name).mkdir()
        files.append(str(tmp_path / name / "topology.yaml"))
        Path(files[-1]).write_text(text, encoding="utf-8")
    out = tmp_path / "found.json"
    assert run(["compare", *files, "--hands", "held", "--set", "hand.mass=0.2 kg", "--out", str(out)]) == 0
    one, other = json.loads(out.read_text(encoding="utf-8"))["schemes"]
    assert one["analysis"] is not None and not one["refused"]
    assert (other["analysis"], other["stiffness"], other["transparency"], other["stable"]) == (None,) * 4
    assert (other["verdict"], other["refused"]) == ("refused", "--hands held: user already has the hand arm.")


@pytest.mark.whole
def test_a_hand_feels_where_it_is_asked_to() -> None:
    planar = TOPOLOGIES / "planar-users.yaml"
    (one,) = apc.compare([planar], at="user[2].device.x[1]").schemes
    assert one.transparency is not None and one.transparency.at == "user[2].device.x[1]"
    assert apc.compare([planar]).schemes[0].transparency is None
    (proxied,) = apc.compare([TOPOLOGIES / "two-users-proxies.yaml"]).schemes
    assert proxied.transparency is not None
    assert proxied.transparency.at == "left[1].device"  # which the hands are joined to, not the proxy


# ---- what it costs ----


def operations(function: casadi.Function) -> int:
    """Count by CasADi's own list of instructions: what is neither input, output nor constant."""
    idle = {casadi.OP_INPUT, casadi.OP_OUTPUT, casadi.OP_CONST}
    return sum(function.instruction_id(k) not in idle for k in range(function.n_instructions()))


@pytest.mark.whole
def test_a_tick_takes_its_arithmetic_and_one_operation_for_each_number_heard() -> None:
    """Position and velocity of two others are four; what is evaluated pair by pair counts once a pair."""
    arcs = "delay: 8 ms, graph: {arcs: [[1, 2], [1, 3], [2, 1]]}}"  # two hear the first, nobody hears two
    for text, received in ((AVERAGE, 2), (MESH, 2), (replaced(AVERAGE, ("delay: 8 ms}", arcs)), 1)):
        effort = scheme(text).effort
        tick = operations(compiled(text).peer_types[0].clocks[0].tick)
        assert (effort.clock, effort.operations) == ("haptic", tick + 2 * received)
    pairs = replaced(MESH, ("FullMesh", "SaturatedMesh"), ("stiffness: 500", "limit: 9 N, stiffness: 500"))
    (clock,) = compiled(pairs).peer_types[0].clocks
    (received,) = clock.receives
    assert received.edge is not None
    total = operations(clock.tick) + 2 * (1 + operations(received.edge))
    assert scheme(pairs).effort.operations == total


FIVE = replaced(AVERAGE, ("count: 3", "count: 5"))
GUESTS = replaced(
    AVERAGE,
    ("user: {count: 3}", "user: {count: 3}\n  guest: {count: 2}"),
    ("stiffness: 500 N/m,", "stiffness: 500 N/m, at: [user],"),
)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("text", "graph", "busiest", "arcs"),
    [
        (FIVE, "complete", 4, 20),
        (FIVE, "ring", 2, 10),
        (FIVE, "star", 4, 8),
        (FIVE, "{edges: [[1, 2], [2, 3], [2, 4], [4, 5]]}", 3, 8),
        (FIVE, "{arcs: [[1, 2, 0.5], [2, 1, 1], [2, 3, 1], [3, 4, 1], [4, 5, 1], [5, 1, 1]]}", *(2, 6)),
        (GUESTS, "complete", 2, 6),  # who have no coupler neither send nor hear
        (replaced(AVERAGE, ("count: 3", "count: 1000000000")), "complete", 10**9 - 1, 10**9 * (10**9 - 1)),
    ],
)
def test_two_numbers_a_packet_go_to_everybody_who_hears_them(
    text: str, graph: str, busiest: int, arcs: int
) -> None:
    """125 packets a second of a position and a velocity each."""
    effort = scheme(replaced(text, ("delay: 8 ms}", f"delay: 8 ms, graph: {graph}}}"))).effort
    assert (effort.sent, effort.sent_by_all) == pytest.approx((2 * 125 * busiest, 2 * 125 * arcs), rel=1e-14)


# ---- which stiffness, delay and loss ----


@pytest.mark.whole
def test_the_stiffness_is_of_the_coupler_that_hears_others_or_of_what_it_follows_from() -> None:
    for text, names in (
        (LOSSLESS, ["coordination.stiffness", "lan.delay", "lan.loss"]),
        (FOLLOWING, ["kt", "late", ""]),
    ):
        one = scheme(text)
        parts = (one.stiffness, one.delay, one.loss)
        assert [part.parameter if part else "" for part in parts] == names


@pytest.mark.parametrize(
    ("texts", "over", "message"),
    [
        (
            [TWO_SPRINGS],
            [],
            "topology.yaml: E941 has 2 parameters that could be compared as stiffness: "
            "coordination.stiffness, "
            "leash.stiffness. Try: --over coordination.stiffness",
        ),
        (
            [AVERAGE],
            ["leash.stifness"],
            "--over: E622 leash.stifness is not a parameter of three-users-average. ",
        ),
        (
            [AVERAGE, MESH],
            ["cube.mass"],
            "--over: E940 cube.mass of three-users-average: expected a stiffness, a delay or a loss, got ",
        ),
    ],
)
def test_a_name_that_is_missing_or_serves_no_topology_is_told(
    texts: list[str], over: list[str], message: str
) -> None:
    with pytest.raises(ApcError) as caught:
        apc.compare([compiled(text) for text in texts], over=over)
    assert str(caught.value).startswith(message)


# ---- what is said ----


@pytest.mark.whole
def test_a_cell_that_cant_be_had_says_why_below_its_dash() -> None:
    found = compared(SHAKING, LOSSY, ONE_MASS)
    missing = [dict(one.missing) for one in found.schemes]
    assert [sorted(one) for one in missing] == [
        ["loss", "transparency"],
        ["delay"],
        ["delay", "loss", "stiffness", "transparency"],
    ]
    assert missing[0]["loss"] == "no link has a loss; write loss: 0 % at lan to vary it"
    assert missing[1]["delay"].startswith("apc critical lan.delay: lan.delay can't be varied in mean square")
    text = " ".join(str(found).split())
    assert all(" ".join(why.split()) in text for one in missing for why in one.values())


@pytest.mark.whole
def test_notes_name_differences_other_than_the_coupling_and_limitations() -> None:
    longer = replaced(AVERAGE, ("network: 8 ms", "network: 10 ms"), ("count: 3", "count: 4"))
    assert compared(AVERAGE, MESH).notes == ()
    found = compared(AVERAGE, longer, LOSSY)
    assert found.notes == (
        "the numbers of peers differ: 3, 4",
        "the frames differ, so spectral radii are per different times: 8 ms, 10 ms",
        "some verdicts are mean-square, others are for the nominal network",
    )
    assert found.limitations == (
        "3: excluded: packet loss (10 %) of lan; every packet has the nominal delay of 8 ms",
    )
    assert "\n  criterion for unreliable links: " in str(found)


# ---- the command ----


@pytest.fixture
def topologies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    Path("average.yaml").write_text(AVERAGE, encoding="utf-8")
    Path("mesh.yaml").write_text(MESH, encoding="utf-8")
    return ["average.yaml", "mesh.yaml"]


@pytest.mark.whole
def test_a_table_has_a_row_a_scheme(topologies: list[str]) -> None:
    assert run(["compare", *topologies, "--out", "out.csv"]) == 0
    with Path("out.csv").open(encoding="utf-8") as file:
        row = list(csv.DictReader(file))[1]
    assert float(row["stiffness [N/m]"]) == apc.critical(compiled(MESH), "coordination.stiffness").value
    assert row["delay parameter"] == "lan.delay"
    used = [float(row[f"impedance at 10 Hz {part} [N*s/m]"]) for part in ("real", "imaginary")]
    assert complex(*used) == pytest.approx(
        complex(apc.transparency(compiled(MESH), 10.0).impedance[0]), rel=1e-12
    )
