"""Claims about `apc.vary.over_network`: margins and sensitivities of the growth of mean squares.

Independent: where references are critical (matrix-free second moments, brute force over all patterns of
loss), and `second_moments`, an event-by-event program that shares nothing with `apc.moments`.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

import apc
from apc.analysis.analysis import prepare
from apc.analysis.box import parse_range
from apc.analysis.box_proof import BITS
from apc.analysis.cells import Cell, frames_over
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import precision
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.radius import RADII, radius_of, value_of
from apc.frame.taylor import taylor
from apc.moments import box, network
from apc.moments.crowd import crowd, moments_of
from apc.moments.gains import Moments, gain_of
from apc.threads import single_threaded
from apc.vary import over_network
from apc.vary.margins import Margins, margins
from apc.vary.over_network import network_margins, network_sensitivities
from apc.vary.sensitivity import Sensitivity
from tests.second_moments import Law, second_moment_radius
from tests.test_mean_square import burst, scene
from tests.topologies import compiled


def grown(system: CompiledSystem) -> Margins:
    return network_margins(system, prepare(system), Margins((), ""))


def moved(system: CompiledSystem) -> dict[str, Sensitivity]:
    return {row.parameter: row for row in network_sensitivities(system, prepare(system)).rows}


@pytest.mark.parametrize(
    ("more", "reference"), [("10 %", 1143.224858916119), ("20 %, on_loss: zero", 1354.3615910782753)]
)
def test_a_margin_ends_where_a_reference_is_critical(more: str, reference: float) -> None:
    found = {row.parameter: row for row in grown(scene(more=f", loss: {more}")).rows}
    row = found["coordination.stiffness"]
    assert row.value is not None
    assert row.error is not None
    assert abs(row.value - reference) <= row.error + 1e-8
    assert row.error < 1e-5
    assert row.factor == row.value / 500


def test_over_another_network_a_margin_is_another() -> None:
    system = scene(more=", loss: 40 %")
    nominal = {row.parameter: row for row in margins(system).rows}["coordination.stiffness"]
    found = {row.parameter: row for row in grown(system).rows}["coordination.stiffness"]
    assert nominal.value is not None
    assert found.value is not None
    assert math.isclose(nominal.value, 1096.41, abs_tol=0.01)
    assert math.isclose(found.value, 1384, abs_tol=1)


def test_derivatives_are_those_of_moments_followed_event_by_event() -> None:
    found = moved(scene(peers=2, stiffness=900.0))

    def radius(stiffness: float = 900.0, loss: float = 0.1) -> float:
        system = scene(peers=2, stiffness=stiffness, more=f", loss: {100 * loss!r} %")
        return second_moment_radius(system, {"lan": Law(loss, 1 - loss)})

    for name, step, up, down in (
        ("coordination.stiffness", 1.0, radius(901.0), radius(899.0)),
        ("lan.loss", 1e-4, radius(loss=0.1001), radius(loss=0.0999)),
    ):
        row, expected = found[name], (up - down) / (2 * step)
        # The program's own differences are right to some 1e-6 of them: 1e-10 of a radius over such a step.
        assert abs(row.derivative - expected) <= row.error + 3e-6 * abs(expected)
        assert row.error < 1e-3 * abs(row.derivative)


def test_at_a_kink_the_error_holds_the_slopes_of_both_sides() -> None:
    """A jitter of 2 ms about 8 ms: of a little more, one more tick can miss a packet."""
    row = moved(scene(more=", jitter: 2 ms"))["lan.jitter"]
    slopes = []
    for side in (1.98, 2.02):
        found = moved(scene(more=f", jitter: {side} ms"))["lan.jitter"]
        slopes.append(found.derivative)
    assert abs(slopes[0] - slopes[1]) > 0.1
    assert all(abs(row.derivative - slope) <= 1.05 * row.error for slope in slopes)


@pytest.mark.parametrize("more", [burst(0.1, 10), ", loss: 100 %"])
def test_where_one_value_takes_long_or_is_not_judged_it_says_so(more: str) -> None:
    system = scene(more=more)
    told = grown(system)
    assert not told.rows
    assert told.note.startswith("not looked for: over th")
    assert network_sensitivities(system, prepare(system)).note.startswith(
        "what moves it most: not looked for"
    )


def test_what_is_not_stable_in_mean_square_has_no_margins() -> None:
    told = grown(scene(stiffness=1200.0))
    assert not told.rows
    assert told.note == "none: the scene is not stable in mean square as it is"


# Largest stiffness of three users by the share lost (brute force over all patterns, to 0.5 N/m): none
# 1096.4, 5 % 1118, 10 % 1143.2, 40 % 1384.
@pytest.mark.parametrize(
    ("stiffness", "box", "stable"),
    [
        (500.0, {"coordination.stiffness": "1090 N/m:1100 N/m"}, True),
        (500.0, {"coordination.stiffness": "1143.0 N/m:1143.24 N/m"}, False),
        (1098.0, {"lan.loss": "12 %:14 %"}, True),
        (1098.0, {"lan.loss": "0 %:5 %"}, False),
        (800.0, {"contact.stiffness": "±2%", "lan.loss": "0 %:1 %"}, True),
        (800.0, {"device.mass": "±0.5%", "cube.damping": "±1%"}, True),
    ],
)
def test_a_box_in_mean_square_is_decided_as_references_say(
    stiffness: float, box: dict[str, str], *, stable: bool
) -> None:
    found = apc.prove_box(scene(stiffness=stiffness, more=", loss: 10 %"), box)
    assert found.stable is stable
    assert found.verdict == ("stable in mean square" if stable else "unstable in mean square")


def test_what_is_left_open_of_a_box_is_said() -> None:
    found = apc.prove_box(scene(), {"coordination.stiffness": "1000 N/m:1143.2 N/m"}, cells=20)
    assert (found.stable, found.cells) == (None, 20)
    assert 0 < found.open_share <= 1
    assert 1000 < found.point[0] < 1143.2


ARMED = """\
topology: armed
clocks: {haptic: 1 ms, network: 8 ms}
peers: {user: {count: 2}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.6 kg, damping: 20 N*s/m, shared: true}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
hands:
  arm: {type: MassSpringDamperArm, flange: device, mass: 0.2 kg, stiffness: 100 N/m, damping: 5 N*s/m}
links:
  lan: {clock: network, delay: 20 ms, loss: 5 %}
"""


def test_a_wide_box_far_inside_is_proved_and_points_of_it_are_stable() -> None:
    """Its cells are halved where that makes them easier to prove: the mass, which hardly moves the radius."""
    system = compiled(ARMED)
    box = {"arm.mass": "±20%", "coordination.stiffness": "500 N/m:600 N/m"}
    found = apc.prove_box(system, box, cells=50)
    assert (found.verdict, found.open_share) == ("stable in mean square", 0.0)
    generator = np.random.default_rng(3)
    names = ("arm.mass", "coordination.stiffness")
    for point in generator.uniform([0.16, 500], [0.24, 600], (2, 2)).tolist():
        at = [Override(Free(name), Fraction(value)) for name, value in zip(names, point, strict=True)]
        judged = network.judge_network(apply(system, at))
        assert judged is not None
        assert judged.stable
    beyond = apc.prove_box(system, box | {"coordination.stiffness": "2500 N/m:2650 N/m"}, cells=4)
    assert not beyond.stable, "the largest stable stiffness is 2569 N/m"


def test_of_an_ideal_link_a_box_is_nominal_until_it_may_lose_packets() -> None:
    system = scene(more=", loss: 0 %")
    assert apc.prove_box(system, {"contact.stiffness": "±1%"}).verdict == "stable up to a common translation"
    assert apc.prove_box(system, {"lan.loss": "0 %:2 %"}).verdict == "stable in mean square"


@pytest.mark.parametrize(
    ("more", "box", "why"),
    [
        (
            ", loss: 10 %, on_loss: zero",
            {"contact.stiffness": "±1%"},
            "losses of lan with on_loss: zero",
        ),
        (burst(0.1, 10), {"contact.stiffness": "±1%"}, "over bursts of lan"),
        (burst(0.1, 10), {"lan.loss.r": "±1%"}, "over bursts of lan"),
        (", loss: {p: 0.3, r: 0.7}", {"lan.loss.r": "0.56:0.98"}, "over bursts of lan"),
        (", loss: 100 %", {"contact.stiffness": "±1%"}, "no box is proved: lan loses everything"),
    ],
)
def test_a_box_that_is_not_served_is_refused_by_name(more: str, box: dict[str, str], why: str) -> None:
    with pytest.raises(apc.ApcError, match="E898 no box is proved") as error:
        apc.prove_box(scene(more=more), box)
    assert why in str(error.value)
    assert error.value.mistakes[0].hint == f"apc critical {next(iter(box))} --in mean-square"


def test_peers_on_a_graph_of_their_own_have_boxes_too() -> None:
    """Each of them is a site; a ring of three is the complete graph."""
    ranges = {"coordination.stiffness": "±5%", "lan.loss": "5 %:10 %"}
    graphs = "{edges: [[1, 2], [2, 3], [1, 3]]}", "{arcs: [[1, 2], [2, 3, 0.7], [3, 1]]}"
    for graph, stable in zip(graphs, (True, False), strict=True):
        found = apc.prove_box(scene(more=f", loss: 10 %, graph: {graph}"), ranges)
        assert found.stable is stable


def test_margins_that_take_long_are_looked_for_if_asked_and_never_of_an_unstable_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system, unstable = scene(), scene(stiffness=2000)
    in_passing = partial(network_margins, nominal=Margins((), ""), quick=True)
    assert in_passing(system, prepare(system)).rows
    monkeypatch.setattr(over_network, "MOST_IN_PASSING", 1)
    assert "(apc analyze --margins does)" in in_passing(system, prepare(system)).note
    assert grown(system).rows
    monkeypatch.setattr(network, "QUICK", 0)
    assert grown(system).note.startswith("not looked for: over this network, to judge one value takes long")
    assert grown(unstable).note == "none: the scene is not stable in mean square as it is"


def test_a_jitter_is_no_range_of_a_box() -> None:
    with pytest.raises(apc.ApcError, match=r"E831 lan\.jitter is a time"):
        apc.prove_box(scene(more=", jitter: 2 ms"), {"lan.jitter": "±1%"})
    assert apc.prove_box(scene(more=", jitter: 2 ms"), {"contact.stiffness": "±0.01%"}).stable


def _over(asked: box._Question, cell: Cell) -> Moments:
    """Return the loops and the luck of a scene over a cell."""
    maps, _ = frames_over(asked.frames, [tuple(cell[place] for place in asked.own)])
    here = [one.mapped(partial(box._of_cell, 0, len(cell))) for one in maps]
    frames = {name: here[which] for name, which in asked.places.items()}
    return moments_of(asked.classes, box._memories(asked, cell), frames)


@pytest.mark.parametrize(
    ("more", "ranges"),
    [
        (", loss: 10 %", ("contact.stiffness=±1%", "device.mass=±0.5%", "lan.loss=9 %:11 %")),
        (", loss: 10 %, jitter: 2 ms", ("coordination.stiffness=±1%", "lan.loss=0 %:2 %")),
        (", jitter: 3 ms", ("cube.damping=±2%", "coordination.damping=0 N*s/m:0.2 N*s/m")),
    ],
)
def test_second_moments_over_a_cell_hold_those_of_every_point(more: str, ranges: tuple[str, ...]) -> None:
    """G(1), and each loop that no luck drives, at corners and at random, against analyses of the points."""
    system = scene(more=more)
    listed = [parse_range(system, one) for one in ranges]
    random = np.random.default_rng(3)
    with single_threaded(), np.errstate(all="ignore"), precision(BITS):
        asked = box._question(system, listed)
        cell = tuple((one.low, one.high) for one in listed)
        over, wide = _over(asked, cell), taylor(len(cell))
        own = [*asked.own, *(place for place in range(len(cell)) if place not in asked.own)]
        for turns in (
            0.999 * np.ones(len(cell)),
            -0.999 * np.ones(len(cell)),
            *random.uniform(-1, 1, (4, len(cell))),
        ):
            shares = [Fraction((1 + turn) / 2) for turn in turns]
            at = [low + (high - low) * share for (low, high), share in zip(cell, shares, strict=True)]
            point = crowd(box._changed(system, listed, at), asked.prepared)
            pairs = [(gain_of(over)(1.0, wide), gain_of(point)(1.0, RADII))]
            pairs += zip(over.means[1], point.means[1], strict=True)
            for all_over, one in pairs:
                assert all_over is not None and one is not None
                straight = value_of(all_over) + np.tensordot(turns[own], all_over[2:], 1)
                rounded = 64 * np.finfo(float).eps * np.abs(all_over).sum(axis=0)
                off = radius_of(all_over) + radius_of(one) + rounded
                assert (np.abs(straight - value_of(one)) <= off).all()
        # What is not straight is of the second order: of half a cell, a quarter.
        half = tuple(((3 * low + high) / 4, (low + 3 * high) / 4) for low, high in cell)
        gains = [gain_of(one)(1.0, wide) for one in (over, _over(asked, half))]
        wide_one, narrow = (float(radius_of(one).max()) for one in gains if one is not None)
        assert narrow < 0.35 * wide_one


def test_a_box_as_wide_as_tolerances_are_is_proved() -> None:
    """Three users and a tenth of the packets: in every corner the radius is below 0.98."""
    system = scene(more=", loss: 10 %")
    found = apc.prove_box(system, {"contact.stiffness": "±10%", "coordination.stiffness": "±10%"})
    assert found.stable and found.open_share == 0
    found = apc.prove_box(system, {"lan.loss": "1 %:20 %", "contact.stiffness": "±10%"})
    assert found.stable and found.cells < 100
