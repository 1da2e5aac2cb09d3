"""The time convention of `compiler/equations/clocks.py`, mirrored event by event.

A scene of two peers, compiled, against a loop written from the convention's four sentences alone: one force
clock, one network clock, one damped mass a peer in closed form. The loop looks values up by the time they
were computed or sent; it never needs one that the compiled model does not keep, or it fails.
"""

from __future__ import annotations

import itertools
import math
import re
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import ClosedSystem
from apc.eigen.modes import dense
from tests.topologies import compiled

MS = Fraction(1, 1000)
M, B, K, D = 0.2, 5.0, 700.0, 3.0
HAPTIC, NETWORK = 2 * MS, 8 * MS


def system(delay: Fraction, late: Fraction, phase: Fraction, first: Fraction, delays: str) -> CompiledSystem:
    def s(time: Fraction) -> str:
        return f"{time.numerator}/{time.denominator} s" if time else "0 s"

    return compiled(f"""\
topology: two
clocks:
  haptic: {{period: {s(HAPTIC)}, phase: {s(phase)}}}
  network: {{period: {s(NETWORK)}, phase: {s(first)}}}
peers: {{user: {{count: 2}}}}
masses:
  cube: {{mass: {M} kg, damping: {B} N*s/m}}
couplers:
  pull: {{type: AveragePosition, object: cube, stiffness: {K} N/m, damping: {D} N*s/m, clock: haptic,
         delay: {s(delay)}, link: lan, delays: {delays}}}
links:
  lan: {{clock: network, delay: {s(late)}}}
""")


class Peer:
    """A peer as the convention sees it: motion, computed forces and sent packets by their own time."""

    def __init__(self, state: dict[str, float]) -> None:
        self.x, self.v = state["cube.x"], state["cube.v"]
        self.own: dict[Fraction, float] = {}
        self.received: dict[Fraction, float] = {}
        self.sent: dict[str, dict[Fraction, float]] = {"pull.x": {}, "pull.v": {}}
        for name, value in state.items():
            found = re.fullmatch(r"(.*)\((-?[\d.]+) ms\)", name)
            if found is None:
                continue
            time = Fraction(found.group(2)) * MS
            match found.group(1):
                case "pull.f":  # both parts held together
                    self.own[time], self.received[time] = value, 0.0
                case "pull.own":
                    self.own[time] = value
                case "pull.received":
                    self.received[time] = value
                case other:
                    self.sent[other.removesuffix(" sent")][time] = value


def one_frame(
    peers: list[Peer], delay: Fraction, late: Fraction, phase: Fraction, first: Fraction, delays: str
) -> None:
    """Step the peers from 0 to the end of the frame, by the four sentences."""

    def newest(times: list[Fraction]) -> Fraction:
        return max(times)

    frame = NETWORK
    ticks = [phase + i * HAPTIC for i in range(-20, 20)]
    sends = [first + i * NETWORK for i in range(-20, 20)]
    switches = sorted({t + d for t in ticks for d in (delay, Fraction(0))})
    instants = sorted({t for t in (*ticks, *sends, *switches, Fraction(0), frame) if 0 <= t <= frame})
    for now, following in itertools.pairwise(instants):
        # 1. Continuous variables are sampled: their value at t⁻.
        samples = [(peer.x, peer.v) for peer in peers]
        # 2. Network clocks tick: the packet takes the sample at t; what has arrived by t is delivered.
        if now in sends:
            for peer, (x, v) in zip(peers, samples, strict=True):
                peer.sent["pull.x"][now], peer.sent["pull.v"][now] = x, v
        # 3. Force clocks tick: forces from the samples at t and the newest delivered values.
        if now in ticks:
            packet = newest([t for t in sends if t + late <= now])
            for one, other, (x, v) in zip(peers, reversed(peers), samples, strict=True):
                one.own[now] = K * x + D * v
                one.received[now] = -K * other.sent["pull.x"][packet] - D * other.sent["pull.v"][packet]
        # 4. Holds switch: a force computed at t acts from t + its delay on, until the next one acts.
        own = newest([t for t in ticks if t + delay <= now])
        heard = own if delays == "all" else newest([t for t in ticks if t <= now])
        seconds = float(following - now)
        for peer in peers:
            force = -peer.own[own] - peer.received[heard]
            decay = math.exp(-B * seconds / M)
            rise = (1 - decay) / B
            peer.x += M * rise * peer.v + (seconds - M * rise) / B * force
            peer.v = decay * peer.v + rise * force


def after(peers: list[Peer], names: tuple[str, ...]) -> list[float]:
    """Return the state at the frame's end under the names the compiled model gives it."""
    values = []
    for name in names:
        which, _, rest = name.partition(".")
        peer = peers[0 if which == "user[1]" else 1]
        if rest in ("cube.x", "cube.v"):
            values.append(peer.x if rest == "cube.x" else peer.v)
            continue
        found = re.fullmatch(r"(.*)\((-?[\d.]+) ms\)", rest)
        assert found is not None
        time = NETWORK + Fraction(found.group(2)) * MS
        match found.group(1):
            case "pull.f":
                values.append(peer.own[time] + peer.received[time])
            case "pull.own":
                values.append(peer.own[time])
            case "pull.received":
                values.append(peer.received[time])
            case other:
                values.append(peer.sent[other.removesuffix(" sent")][time])
    return values


def frame_map(delay: Fraction, late: Fraction, phase: Fraction, first: Fraction, delays: str) -> ClosedSystem:
    return dense(*lifted_groups(system(delay, late, phase, first, delays)))


ZERO = Fraction(0)
CASES = [
    pytest.param(ZERO, ZERO, ZERO, ZERO, "all", id="everything at once"),
    pytest.param(HAPTIC, 8 * MS, ZERO, ZERO, "all", id="one period late each"),
    pytest.param(HAPTIC, 8 * MS, ZERO, ZERO, "own", id="only the own part delayed"),
    pytest.param(ZERO, 4 * MS, ZERO, ZERO, "all", id="a packet arrives exactly at a tick"),
    pytest.param(ZERO, 4 * MS + MS / 1000, ZERO, ZERO, "all", id="a packet arrives just after a tick"),
    pytest.param(ZERO, 3 * MS, ZERO, ZERO, "all", id="a packet arrives between two ticks"),
    pytest.param(2 * MS / 5, 11 * MS, ZERO, ZERO, "all", id="a delay within a tick interval"),
    pytest.param(2 * MS / 5, 11 * MS, ZERO, ZERO, "own", id="two delays of one force within an interval"),
    pytest.param(5 * MS, 20 * MS, ZERO, ZERO, "all", id="delays of several periods"),
    pytest.param(MS, 5 * MS, MS / 2, 3 * MS, "all", id="phases"),
    pytest.param(
        MS, 19 * MS / 2, MS / 2, 3 * MS, "own", id="a packet arrives exactly at a tick, with phases"
    ),
    pytest.param(3 * MS / 8, 21 * MS / 8, MS / 8, 5 * MS / 8, "all", id="eighths"),
]


@pytest.mark.parametrize(("delay", "late", "phase", "first", "delays"), CASES)
def test_one_compiled_frame_is_the_convention_event_by_event(
    delay: Fraction, late: Fraction, phase: Fraction, first: Fraction, delays: str
) -> None:
    closed = frame_map(delay, late, phase, first, delays)
    generator = np.random.default_rng(5)
    state = generator.standard_normal(len(closed.names))
    given: list[dict[str, float]] = [{}, {}]
    for name, value in zip(closed.names, state, strict=True):
        which, _, rest = name.partition(".")
        given[0 if which == "user[1]" else 1][rest] = float(value)
    peers = [Peer(one) for one in given]
    one_frame(peers, delay, late, phase, first, delays)
    expected = np.array(after(peers, closed.names))
    size = np.abs(closed.matrix) @ np.abs(state)
    assert np.max(np.abs(closed.matrix @ state - expected) / size) < 1e-13


def heard_at(late: Fraction) -> list[int]:
    """Return, for each force tick of a frame, how many frames old the packet is that it sees."""
    (group,), _ = lifted_groups(system(ZERO, late, ZERO, ZERO, "all"))
    schedule = group.schedule
    ticks = [event for event in schedule.events if hasattr(event, "heard")]
    # The first thing heard is x, by one packet: the other peers hear and are heard alike.
    rows = [tick.heard[0] for tick in ticks]
    assert all(len(row) == 1 for row in rows)
    return [schedule.heard[row[0]].lag for row in rows]


def test_a_tick_at_exactly_the_time_of_arrival_sees_the_packet() -> None:
    assert heard_at(ZERO) == [0, 0, 0, 0]
    assert heard_at(4 * MS) == [1, 1, 0, 0]
    assert heard_at(4 * MS + MS / 10**6) == [1, 1, 1, 0]
    assert heard_at(8 * MS) == [1, 1, 1, 1]
    assert heard_at(8 * MS + MS / 10**6) == [2, 1, 1, 1]


def test_a_force_without_delay_leaves_nothing_to_remember() -> None:
    closed = frame_map(ZERO, ZERO, ZERO, ZERO, "all")
    assert closed.names == ("user[1].cube.x", "user[1].cube.v", "user[2].cube.x", "user[2].cube.v")
