"""A clock of the packets between two groups: against two links, and event by event by hand."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.peer_counts import clocks_in_use
from apc.studies.effort import effort
from tests.topologies import compiled, replaced

Floats = NDArray[np.float64]
MS = Fraction(1, 1000)
FAST, SLOW = Fraction(1, 125), Fraction(1, 60)


def topology(
    coupler: str = "AveragePosition",
    stiffness: float = 200,
    users: int = 3,
    link: str = "",
    slow: str = "60 Hz",
) -> str:
    """Return users who send at 125 Hz and one who sends at another rate, over one link."""
    pairs = link or "pairs: {mobile: {user: {clock: slow}}}"
    return f"""\
topology: rates
clocks: {{haptic: 1 ms, fast: 125 Hz, slow: {slow}}}
peers: {{user: {{count: {users}}}, mobile: {{count: 1}}}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube:   {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact: {{type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}}
  pull: {{type: {coupler}, object: cube, stiffness: {stiffness} N/m, clock: haptic, delay: 1 ms, link: lan}}
links:
  lan: {{clock: fast, delay: 8 ms, {pairs}}}
"""


@dataclass(frozen=True)
class Clock:
    """The times at which a peer sends, and the delay of its packets, in seconds."""

    period: Fraction
    phase: Fraction = Fraction(0)
    delay: Fraction = 8 * MS

    @property
    def stored(self) -> int:
        """The number of packets that are stored between sending and arrival."""
        return math.ceil(self.delay / self.period) + 1


@dataclass(frozen=True)
class ByHand:
    """Peers in a complete graph, all with equal numbers; peer k sends at the ticks of `clocks[k]`.

    The state has (x, v, x_O, v_O) of each peer, its two acting and its two computed forces, and for each
    directed link the sample in effect and the last packets, newest first, as (x_O, v_O).
    """

    clocks: tuple[Clock, ...]
    stiffness: float
    mean: bool = True

    @property
    def peers(self) -> int:
        return len(self.clocks)

    @property
    def arcs(self) -> list[tuple[int, int]]:
        return [(j, i) for i in range(self.peers) for j in range(self.peers) if i != j]

    def rows(self, arc: tuple[int, int]) -> slice:
        """Return the rows of a directed link: the sample in effect, then its packets."""
        first = 8 * self.peers
        for other in self.arcs:
            length = 2 * (1 + self.clocks[other[0]].stored)
            if other == arc:
                return slice(first, first + length)
            first += length
        raise AssertionError(arc)

    @property
    def size(self) -> int:
        return self.rows(self.arcs[-1]).stop

    def coast(self, duration: Fraction) -> Floats:
        """Return the map of all motions under the acting forces."""
        whole, t = np.eye(self.size), float(duration)
        for i in range(self.peers):
            for first, mass, forces in ((0, 0.1, {0: -1.0}), (2, 0.6 / self.peers, {0: 1.0, 1: -1.0})):
                rate = np.zeros((4, 4))  # of x, v and two forces
                rate[0, 1], rate[1, 1] = 1.0, -5.0 / mass
                for force, sign in forces.items():
                    rate[1, 2 + force] = sign / mass
                step, at = expm(rate * t), 8 * i + first
                whole[at : at + 2, at : at + 2] = step[:2, :2]
                whole[at : at + 2, 8 * i + 4 : 8 * i + 6] = step[:2, 2:]
        return whole

    def tick(self) -> Floats:
        """Return the map of a haptic tick: the forces of the last tick act, and new ones are computed."""
        whole = np.eye(self.size)
        for i in range(self.peers):
            at = 8 * i
            whole[at + 4 : at + 8] = 0.0
            whole[at + 4, at + 6] = whole[at + 5, at + 7] = 1.0
            whole[at + 6, at], whole[at + 6, at + 2] = 1000.0, -1000.0
            others = self.peers - 1
            whole[at + 7, at + 2] = self.stiffness * (1 if self.mean else others)
            for j in range(self.peers):
                if j != i:
                    whole[at + 7, self.rows((j, i)).start] = -self.stiffness / (others if self.mean else 1)
        return whole

    def send(self, arc: tuple[int, int]) -> Floats:
        whole, rows = np.eye(self.size), self.rows(arc)
        whole[rows.start + 2 : rows.stop] = np.eye(self.size)[rows.start : rows.stop - 2]
        whole[rows.start + 2 : rows.start + 4] = np.eye(self.size)[8 * arc[0] + 2 : 8 * arc[0] + 4]
        return whole

    def arrive(self, arc: tuple[int, int], age: int) -> Floats:
        """Return the map of an arrival: of the packet that `age` others followed."""
        whole, first = np.eye(self.size), self.rows(arc).start
        whole[first : first + 2] = np.eye(self.size)[first + 2 * age + 2 : first + 2 * age + 4]
        return whole

    def events(self, frame: Fraction) -> list[tuple[str, Floats, tuple[int, int]]]:
        """Return the maps of a frame's events in order, each with its kind and its directed link."""
        none = (-1, -1)
        found = [(k * MS, 2, "tick", self.tick(), none) for k in range(int(frame / MS))]
        for arc in self.arcs:
            clock = self.clocks[arc[0]]
            for k in range(-clock.stored, int(frame / clock.period)):
                sent = clock.phase + k * clock.period
                arrival = sent + clock.delay
                if 0 <= sent < frame:
                    found.append((sent, 1, "send", self.send(arc), arc))
                if 0 <= arrival < frame:  # before the packets of its instant are sent
                    age = sum(sent + n * clock.period < arrival for n in range(1, clock.stored + 1))
                    found.append((arrival, 0, "arrive", self.arrive(arc, age), arc))
        found.sort(key=lambda one: one[:2])
        result = []
        for (now, _, *event), following in zip(found, [*(one[0] for one in found[1:]), frame], strict=True):
            result.append((*event,))
            if following > now:
                result.append(("coast", self.coast(following - now), none))
        return result

    def frame(self, length: Fraction) -> Floats:
        whole = np.eye(self.size)
        for _, step, _ in self.events(length):
            whole = step @ whole
        return whole


def poles(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the eigenvalues that are neither 0 nor that of the common translation."""
    return values[(np.abs(values) > 1e-6) & (np.abs(values - 1) > 1e-9)]


def found_poles(model: Model) -> NDArray[np.complex128]:
    modes = apc.analyze(model).modes
    return poles(np.array([one.eigenvalue for one in modes for _ in range(one.multiplicity)]))


def distance(one: NDArray[np.complex128], other: NDArray[np.complex128]) -> float:
    """Return the largest difference between eigenvalues, each with a partner of its own."""
    between = np.abs(one[:, None] - other)
    assert between.shape[0] == between.shape[1] > 0
    return float(between[linear_sum_assignment(between)].max())


TWO_LINKS = (
    replaced(
        topology("FullMesh", 60),
        (
            "  pull:",
            "  slower: {type: FullMesh, object: cube, stiffness: 60 N/m, clock: haptic, delay: 1 ms, "
            "link: wan}\n  pull:",
        ),
        ("pairs: {mobile: {user: {clock: slow}}}", "graph: {arcs: [[user, user], [user, mobile]]}"),
    )
    + "  wan: {clock: slow, delay: 8 ms, graph: {arcs: [[mobile, user]]}}\n"
)


def test_a_clock_of_pairs_replaces_a_second_link() -> None:
    one, two = compiled(topology("FullMesh", 60)), compiled(TWO_LINKS)
    assert apc.analyze(one).spectral_radius == pytest.approx(apc.analyze(two).spectral_radius, rel=1e-12)
    assert distance(found_poles(one), found_poles(two)) < 1e-12


SLOWER = {
    "60 Hz": Clock(SLOW),
    "{period: 16 ms, phase: 3 ms}": Clock(16 * MS, 3 * MS),
    "{period: 5 ms, phase: 1 ms}": Clock(5 * MS, MS),
}


@pytest.mark.parametrize("slow", SLOWER)
@pytest.mark.parametrize("coupler", ["AveragePosition", "FullMesh"])
def test_the_poles_are_those_of_the_events_by_hand(coupler: str, slow: str) -> None:
    model = compiled(topology(coupler, 120, slow=slow))
    hand = ByHand((*[Clock(FAST)] * 3, SLOWER[slow]), 120, coupler == "AveragePosition")
    frame = hand.frame(Fraction(apc.analyze(model).frame_s).limit_denominator(1000))
    assert distance(found_poles(model), poles(np.linalg.eigvals(frame))) < 1e-9


@pytest.mark.parametrize(
    ("coupler", "loss", "jit"),
    [
        ("AveragePosition", "", False),
        ("FullMesh", "", False),
        ("FullMesh", "loss: 1.0e-9, ", False),  # over an unreliable link
        ("AveragePosition", "loss: 1.0e-9, ", False),
        ("AveragePosition", "loss: 1.0e-9, ", True),
    ],
)
def test_a_simulation_is_the_events_by_hand(coupler: str, loss: str, jit: bool) -> None:
    pairs = f"{loss}pairs: {{mobile: {{user: {{clock: slow}}}}}}"
    model = compiled(topology(coupler, 120, link=pairs))
    found = apc.simulate(model, duration="0.4 s", params={"mobile.device.v": 1.0}, jit=jit)
    hand = ByHand((*[Clock(FAST)] * 3, Clock(SLOW)), 120, coupler == "AveragePosition")
    start = np.eye(hand.size)[8 * 3 + 1]
    state = np.linalg.matrix_power(hand.frame(Fraction(1, 5)), 2) @ start
    ends = {signal.name: value for signal, value in zip(found.signals, found.values[-1], strict=True)}
    for peer, at in (("user[2]", 8), ("mobile[1]", 24)):
        assert ends[f"{peer}.cube.x"] == pytest.approx(state[at + 2], rel=1e-11)


# The lossy link has one name in both: its packets get lost alike.
QUICK = {"slow": "{period: 16 ms, phase: 3 ms}"}
LOSSY = topology("FullMesh", 60, link="pairs: {mobile: {user: {clock: slow, loss: 30 %}}}", **QUICK)
LOSSY_LINK = replaced(
    TWO_LINKS,
    ("slow: 60 Hz", "slow: {period: 16 ms, phase: 3 ms}"),
    ("wan: {clock: slow,", "lan: {clock: slow, loss: 30 %,"),
    ("lan: {clock: fast", "other: {clock: fast"),
    ("1 ms, link: lan}\n", "1 ms, link: other}\n"),
    ("link: wan", "link: lan"),
)


def test_lost_packets_of_the_pairs_are_those_of_a_second_link() -> None:
    reliable = topology("FullMesh", 60, **QUICK)
    one, two, none = (
        apc.simulate(
            compiled(text), duration="0.4 s", params={"mobile.device.v": 1.0}, signals=["*.x"], jit=False
        )
        for text in (LOSSY, LOSSY_LINK, reliable)
    )
    assert np.abs(one.values - two.values).max() < 1e-14
    assert np.abs(one.values - none.values).max() > 1e-5


def growth(model: Model) -> float:
    found = apc.mean_square_stability(model)
    assert found is not None and found.exact and found.mean_square_radius is not None, found
    return found.mean_square_radius


def test_second_moments_are_those_of_a_second_link() -> None:
    assert growth(compiled(LOSSY)) == pytest.approx(growth(compiled(LOSSY_LINK)), rel=1e-9)


@pytest.mark.parametrize("slow", ["{period: 16 ms, phase: 3 ms}", "{period: 4 ms, phase: 1 ms}"])
def test_second_moments_are_those_of_the_events_by_hand(slow: str) -> None:
    """At a stiffness where they grow: the expectation of M ⊗ M is a product over the events of a frame."""
    clock = Clock(16 * MS, 3 * MS) if "16" in slow else Clock(4 * MS, MS)
    pairs = "loss: 20 %, pairs: {mobile: {user: {clock: slow, loss: 40 %}}}"
    model = compiled(topology("AveragePosition", 2500, users=1, link=pairs, slow=slow))
    hand = ByHand((Clock(FAST), clock), 2500)
    operator = np.eye(hand.size**2)
    for kind, step, arc in hand.events(16 * MS if "16" in slow else 8 * MS):
        after = np.kron(step, step)
        if kind == "arrive":
            loss = 0.2 if arc == (0, 1) else 0.4
            after = (1 - loss) * after + loss * np.eye(hand.size**2)
        operator = after @ operator
    moments = float(np.abs(np.linalg.eigvals(operator)).max())
    assert moments > 1.01
    assert growth(model) == pytest.approx(moments, rel=1e-8)


def saturated(text: str) -> str:
    """Return the same with a coupling that is evaluated for each pair of peers."""
    coupling = "SaturatedMesh, object: cube, stiffness: 200 N/m, limit: 0.05 N"
    return text.replace("FullMesh, object: cube, stiffness: 60 N/m", coupling)


def test_couplings_of_each_pair_receive_at_both_clocks() -> None:
    """The links without and with routes of packets, and two links."""
    start = {"mobile.device.v": 1.0}
    one = topology("FullMesh", 60, **QUICK)
    rarely_lost = replaced(one, ("delay: 8 ms, pairs", "delay: 8 ms, loss: 1.0e-9, pairs"))
    two = replaced(TWO_LINKS, ("slow: 60 Hz", "slow: {period: 16 ms, phase: 3 ms}"))
    one_values, *others = (
        apc.simulate(
            compiled(saturated(text)), duration="0.16 s", params=start, signals=["*.x"], jit=False
        ).values
        for text in (one, rarely_lost, two)
    )
    assert np.abs(one_values).max() > 1e-3
    assert all(np.abs(one_values - other).max() < 1e-15 for other in others)


def test_the_age_of_samples_is_analyzed_if_all_packets_of_a_peer_have_one_clock() -> None:
    dead_reckoning = ("FullMesh, object", "DeadReckoning, threshold: 0 m, object")
    one = replaced(topology("FullMesh", 60, users=1, **QUICK), dead_reckoning)
    with pytest.raises(
        ApcError, match="E811 the age of samples received by user and mobile over lan differs"
    ):
        apc.analyze(compiled(one))
    both = replaced(one, ("{clock: slow}}", "{clock: slow}}, user: {mobile: {clock: slow}}"))
    slow = replaced(both, ("{clock: fast", "{clock: slow"))
    pairs, link = (apc.analyze(compiled(text)).spectral_radius for text in (both, slow))
    assert pairs == pytest.approx(link, rel=1e-12)


def test_the_clock_of_the_link_is_no_other_clock() -> None:
    model = compiled(topology(link="pairs: {mobile: {user: {clock: fast}}}"))
    assert model.links[0].clocks == ("fast",) and {clock.name for clock in model.clocks} == {
        "haptic",
        "fast",
    }


def test_a_period_of_pairs_is_varied_as_that_of_a_clock() -> None:
    model = compiled(topology("FullMesh", 120, **QUICK))
    found = apc.sweep(model, {"slow.period": ["8 ms", "40 ms"]}, jobs=1).column("spectral_radius")
    written = topology("FullMesh", 120, slow="{period: 40 ms, phase: 3 ms}")
    assert found[1] == pytest.approx(apc.analyze(compiled(written)).spectral_radius, rel=1e-12)
    periods = apc.critical(model, "slow.period")  # those with short frames
    assert periods.searched_to[1] == pytest.approx(0.32) and periods.evaluations > 40


def test_numbers_sent_per_second_are_those_of_both_clocks() -> None:
    """Three users send two values to three others, 125 times per second; the fourth sends at 60 Hz."""
    cost = effort(compiled(topology("FullMesh", 60)))
    assert cost.sent == 125 * 3 * 2 and cost.sent_by_all == 3 * cost.sent + 60 * 3 * 2


def test_what_requires_one_clock_of_a_link_refuses_others_by_name(tmp_path: Path) -> None:
    model = compiled(topology("FullMesh", 60, **QUICK))
    for suffix, code, peer in (("c", "E960", "user[1]"), ("fmu", "E960", ""), ("mo", "E955", "")):
        with pytest.raises(ApcError, match=rf"{code} .*pairs of groups of lan"):
            apc.export(model, out=tmp_path / f"out.{suffix}", peer=peer)
    with pytest.raises(ApcError, match=r"E861 .*one network clock \(got fast and slow\)"):
        apc.analyze(model, method="paper")


@pytest.mark.needs_extension("loss_models")
def test_bursts_at_two_clocks_are_not_judged() -> None:
    text = replaced(
        topology("FullMesh", 60, users=1, **QUICK), ("8 ms, pairs", "8 ms, loss: {p: 1 %, r: 30 %}, pairs")
    )
    found = apc.mean_square_stability(compiled(text))
    assert found is not None and found.stable is None
    assert "pairs of groups of lan have different clocks" in str(found)
    lossy = apc.mean_square_stability(compiled(LOSSY))
    assert lossy is not None and lossy.losses_in_a_row is not None


@pytest.mark.needs_extension("changing_counts")
def test_a_change_after_which_no_packets_have_the_clock_is_refused() -> None:
    keys = "pairs: {user: {user: {clock: slow}}}"
    model = compiled(topology("FullMesh", 60, users=2, link=keys, **QUICK))
    with pytest.raises(ApcError, match=r"E914 packets from 0\.016 s on: expected all delays and clocks"):
        apc.simulate(model, duration="0.1 s", leaves={"user[1]": "16 ms"}, jit=False)


@pytest.mark.needs_extension("changing_counts")
@pytest.mark.parametrize("loss", ["", "loss: 30 %, "])
def test_peers_that_join_and_leave_receive_at_both_clocks(loss: str) -> None:
    """Two clocks with the same ticks are one clock."""
    keys = f"{loss}pairs: {{mobile: {{user: {{clock: slow}}}}}}"
    values, others = (
        apc.simulate(
            compiled(topology("FullMesh", 60, link=text, slow="8 ms")),
            duration="0.16 s",
            params={"mobile.device.v": 1.0},
            signals=["*.x"],
            joins={"user[2]": "48 ms"},
            leaves={"user[3]": "96 ms"},
            jit=False,
        ).values
        for text in (keys, keys.replace("slow", "fast"))
    )
    assert np.nanmax(np.abs(values)) > 1e-3 and np.nanmax(np.abs(values - others)) < 1e-15


@pytest.mark.whole
def test_a_run_in_real_time_does_what_is_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("apc.realtime.start.claim", tuple)
    text = replaced(
        topology("AveragePosition", 5, users=2, link="loss: 10 %, pairs: {mobile: {user: {clock: slow}}}"),
        ("1 ms, fast: 125 Hz, slow: 60 Hz", "10 ms, fast: 20 ms, slow: 50 ms"),
        ("1000 N/m", "10 N/m"),
        ("shared: true", "shared: true, v: 0.1 m/s"),
    )
    Path("rates.yaml").write_text(text, encoding="utf-8")
    assert run(["run", "--duration", "1 s", "--emulate", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["why_not"] == "" and reported["differences"]["N"][1] > 1e-3
    assert max(far for far, _ in reported["differences"].values()) <= 1e-9


def test_a_clock_of_a_link_that_sends_no_packet_has_no_effect() -> None:
    """All packets of two peers are sent at another clock than that of the link."""
    both = "pairs: {mobile: {user: {clock: slow}}, user: {mobile: {clock: slow}}}"
    text = topology("FullMesh", 60, users=1, link=both, **QUICK)
    unused = compiled(replaced(text, ("fast: 125 Hz", "fast: 0.3 ms")))
    link = compiled(replaced(text, ("{clock: fast", "{clock: slow"), (f", {both}", "")))
    assert apc.analyze(unused).spectral_radius == pytest.approx(apc.analyze(link).spectral_radius, rel=1e-12)
    assert clocks_in_use(unused) == clocks_in_use(link) == {"haptic", "slow"}
    assert apc.transparency(unused, [1.0, 10.0]) is not None
    more = apc.set_parameters(unused, {"user.count": "2"})
    assert clocks_in_use(more) == {"haptic", "fast", "slow"}
