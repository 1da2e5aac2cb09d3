"""What is of a clock, what is held and sampled, memories, and what is heard of the others."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from tests.library.parts import listed, ticked, values
from tests.topologies import ONE_MASS, compiled, library, messages_of, replaced

# ---- the tick before, and what is held ----

FILTER = """\
component: Filter
connectors: {{flange: Flange}}
parameters: {{clock: clock, k: {{unit: N/m}}}}
variables: {{s: {{unit: m, start: 2 mm}}, w: {{unit: m, start: 0}}}}
equations: ['{}', '{}', 'flange.f = {}']
"""
FILTERED = f"{ONE_MASS}clocks: {{tick: 1 ms}}\n"
FILTERED += "couplers: {all: {type: Filter, flange: device, k: 9 N/m, clock: tick}}\n"


def filtered(folder: Path, *equations: str) -> apc.Model:
    return compiled(FILTERED, library(folder, FILTER.format(*equations)))


def test_a_value_of_the_tick_before_is_a_memory_that_starts_as_is_said(tmp_path: Path) -> None:
    model = filtered(tmp_path, "s = 0.5*previous(s) + sample(flange.x)", "w = 2*s", "k*hold(s)")
    [peer_type] = model.peer_types
    [tick] = peer_type.clocks
    assert (tick.outputs, tick.memories, tick.starts) == (("all.s",), (0,), ("all.s",))
    assert ticked(model, {"device.x": 0.25}, [3.0]) == {"all.s": 1.75}
    p = [values(model)[name] for name in peer_type.parameters]
    assert listed(peer_type.derivative([0, 0], [0.5], p, 0)) == [0, -9 * 0.5 / 2]
    assert values(model)["all.s"] == 0.002


# ---- what is heard ----

FOLLOWER = """\
component: Follower
connectors: {{flange: Flange}}
sends: {{x: sample(flange.x)}}
parameters: {{clock: clock, link: link, k: {{unit: N/m}}}}
equations: ['f = {}', flange.f = hold(f)]
"""
FOUR = ONE_MASS.replace("count: 1", "count: 4") + (
    "clocks: {tick: 1 ms}\nlinks: {lan: {clock: tick}}\n"
    "couplers: {all: {type: Follower, flange: device, k: 7 N/m, clock: tick, link: lan}}\n"
)
# By hand of 0.5 m here: a mean of 0.25 m or a sum of 0.75 m is heard of three others.
REDUCTIONS = {
    "k*mean(2*others.x)": 7 * 2 * 0.25,
    "mean(k*(sample(flange.x) - others.x))": 7 * (0.5 - 0.25),
    "sum(k*(sample(flange.x) - others.x))": 7 * (3 * 0.5 - 0.75),
    "k*sample(flange.x)*count(others)": 7 * 0.5 * 3,
    "sum(k*others.x)/count(others) + 0*k*mean(others.x)": 7 * 0.25,
}


@pytest.mark.parametrize(("force", "expected"), REDUCTIONS.items())
def test_a_linear_reduction_of_the_others_is_one_of_what_they_send(
    force: str, expected: float, tmp_path: Path
) -> None:
    model = compiled(FOUR, library(tmp_path, FOLLOWER.format(force)))
    received = {"mean": 0.25, "sum": 0.75, "count": 3.0}
    receives = model.peer_types[0].clocks[0].receives
    assert all(one.edge is None for one in receives)
    found = ticked(model, {"device.x": 0.5}, (), [received[one.operator] for one in receives])
    assert list(found.values()) == [pytest.approx(expected, rel=1e-14)]


def test_a_reduction_that_is_not_linear_is_taken_over_each_pair(tmp_path: Path) -> None:
    """Three others at rest beside one who is 10 mm off pull by what max leaves, each by itself."""
    own = library(tmp_path, FOLLOWER.format("k*sum(max(sample(flange.x) - others.x, 0))"))
    model = compiled(replaced(FOUR, ("count: 4", "count: 4, set: {device.x: [10 mm, 0 m, 0 m, 0 m]}")), own)
    [receive] = model.peer_types[0].clocks[0].receives
    assert (receive.operator, receive.link, receive.edge is None) == ("sum", "lan", False)
    run = apc.simulate(model, duration="2 ms", signals=["*.v"], jit=False)
    assert run["user[1].device.v"][1] == pytest.approx(-7 * 3 * 0.010 / 2 * 1e-3, rel=1e-2)
    assert [run[f"user[{peer}].device.v"][1] for peer in (2, 3, 4)] == [0, 0, 0]


@pytest.mark.parametrize("force", ["sum(max(k*others.x, f/2))", "sum(max(others.x, mean(others.x)))*k"])
def test_a_pair_of_peers_does_not_know_what_all_say_together(force: str, tmp_path: Path) -> None:
    """E506 at the line, where the value of one pair would take what is heard of all at the same tick."""
    more = FOLLOWER.format(f"k*mean(others.x)', 'g = {force}").replace("hold(f)", "hold(f + g)")
    [line] = messages_of(compiled, FOUR, library(tmp_path, more))
    assert "E506 sum(max(" in line
    assert "requests of each other peer a value that depends on all received values" in line


# ---- an expression means in every place what a variable of its name means there ----

TOPOLOGY = """\
topology: places
library: ./parts
clocks: {tick: 1 ms, slow: 4 ms, packets: 2 ms}
peers: {one: {count: 1}, two: {count: 2, set: {device.mass: 0.15 kg}}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}
  cube:   {mass: 0.2 kg, damping: 3 N*s/m, x: 2 mm}
couplers: {own: {type: Own, a: device, b: cube, clock: tick, slow: slow, link: lan}}
links: {lan: {clock: packets, delay: 2 ms}}
"""
OWN = """\
component: Own
connectors: {{a: Flange, b: Flange}}
sends: {{sent: '{sent}'}}
parameters:
  K: {{unit: N/m, default: 100 N/m}}
  L: {{unit: m, default: 1 mm}}
  T: {{unit: s, default: 1 ms}}
  late: {{unit: s, default: 1.5 ms}}
  clock: clock
  slow: clock
  link: link
variables:
  y: {{unit: m, start: 1 mm}}
  z: {{unit: m, start: 2 mm}}
  before: {{unit: m, start: {start}}}
  moving: {{unit: m}}
equations:
  - y = 0.5*previous(y) + 0.5*sample(a.x, clock)
  - z = 1.1*sample(b.x, clock) - 0.1*previous(z)
  - before = {clocked}
  - moving = {continuous}
  - a.f = {force}
  - b.f = -a.f
"""
# At the start y = 1 mm and z = 2 mm: an expression, and its value there.
CLOCKED = {
    "y": "1 mm",
    "2*y - z": "0 mm",
    "-z": "-2 mm",
    "y*z/L": "2 mm",
    "max(y, z + L)": "3 mm",
    "abs(y - z)": "1 mm",
    "if y < z then 3*y else z/2": "3 mm",
    "L*sin((y + z)/L)": "0.1411200080598672 mm",
    "sqrt(y*y + z*z)": "2.23606797749979 mm",
    "(y + z)^2/(y - 3*z)": "-1.8 mm",
}
MOVING = ("a.x", "2*a.x - b.x", "a.x*b.x/L", "T*der(a.x) + b.x", "min(a.x, b.x - L)", "L*tanh(a.x/L)")
PLAIN = "hold(K*(sample(a.x, clock) - mean(others.sent)))"
# A force with an expression, @, in some place of it; or what is sent, beside a plain force.
CLOCKED_PLACES = [
    "K*hold(@)",
    "hold(K*(@))",
    "K*hold(@, T)",
    "hold(K*sample(hold(@), clock))",
    "hold(K*sample(2*hold(@) - b.x, slow))",
    "hold(K*(y + previous(@)))",
    "hold(K*y*initial(@)/L)",
    "hold(if (@) > 1.5*L then K*y else K*z)",
    "hold(if y < z then K*(@) else K*z)",
    "hold(K*max(y, 1.5*(@)))",
    "hold(K*sum(others.sent - (@)))",
    "hold(sum(K*L*tanh((others.sent - (@))/L)))",
    "sent: sample(hold(@))",
]
MOVING_PLACES = [
    "hold(K*sample(@, clock))",
    "hold(K*sample(@, slow))",
    "sent: sample(@)",
    "sent: 2*sample(@) - sample(b.x)",
    "K*(@)",
]
NAMED = {"clocked": "y", "start": "0 m", "continuous": "a.x"}


def same(folder: Path, place: str, expression: str, name: str, **variables: str) -> bool:
    """Return whether a topology moves alike with an expression in a place and with the name of what it is."""
    found = []
    for text in (expression, name):
        _, sends, whole = place.replace("@", text).rpartition("sent: ")
        force, sent = (PLAIN, whole) if sends else (whole, "sample(a.x)")
        own = OWN.format(force=force, sent=sent, **{**NAMED, **variables})
        modes = apc.analyze(compiled(TOPOLOGY, library(folder, own))).modes
        sizes = [abs(mode.eigenvalue) for mode in modes for _ in range(mode.multiplicity)]
        found.append(sorted(size for size in sizes if size > 1e-2))
    return found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.few(1)
@pytest.mark.parametrize(("number", "place"), list(enumerate(CLOCKED_PLACES)))
def test_an_expression_of_a_clock_means_what_a_variable_means(
    number: int, place: str, tmp_path: Path
) -> None:
    """Every third expression in a place, the others in the next ones: each stands in four or more."""
    for expression, start in list(CLOCKED.items())[number % 3 :: 3]:
        assert same(tmp_path, place, expression, "before", clocked=expression, start=start), expression


@pytest.mark.few(1)
@pytest.mark.parametrize("place", MOVING_PLACES)
def test_a_continuous_expression_means_what_a_variable_means(place: str, tmp_path: Path) -> None:
    for expression in MOVING if place != "K*(@)" else MOVING[3:4]:
        assert same(tmp_path, place, expression, "moving", continuous=expression), expression


def test_a_delay_is_an_expression_of_parameters(tmp_path: Path) -> None:
    for delay in ("T + T/2", "3*T/2", "late - 0*T", "min(late, 2*T)", "if L > 0 then late else T"):
        assert same(tmp_path, "hold(K*y, @)", delay, "late"), delay
    assert not same(tmp_path, "hold(K*y, @)", "2*T", "late")


def test_the_line_to_write_for_a_reduction_that_is_sent_works(tmp_path: Path) -> None:
    """What is heard and sent on, over a variable of the clock: each packet holds the newest of them."""
    more = "a.x\n  - relayed = 0.5*sample(a.x, clock) + 0.5*mean(others.sent)"
    named = {**NAMED, "continuous": more}
    own = OWN.format(force="hold(K*(y - relayed))", sent="sample(hold(relayed))", **named)
    assert 0.9 < apc.analyze(compiled(TOPOLOGY, library(tmp_path, own))).spectral_radius < 1.1


@pytest.mark.parametrize("clock", ["peers", "{period: peers}"])
@pytest.mark.parametrize(
    "delay", ["peers", "8 ms, loss: peers", "8 ms, jitter: peers", "8 ms, loss: {p: peers, r: 1 %}"]
)
def test_a_name_with_an_error_is_reported_once_wherever_it_is_used(clock: str, delay: str) -> None:
    text = ONE_MASS.replace("count: 1", "count: none")
    text += f"clocks: {{tick: {clock}}}\nlinks: {{lan: {{clock: tick, delay: {delay}}}}}\n"
    [message] = messages_of(compiled, text)
    assert message.startswith("topology.yaml:2:23: E2")
