"""Margins, sensitivities and boxes over an unreliable network: references and event-by-event moments."""

from __future__ import annotations

import re
from contextlib import nullcontext

import pytest

import apc
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.studies.margins import Margins, margins, network_margins
from apc.studies.sensitivity import network_sensitivities
from tests.bruteforce import TopologySource
from tests.held_topologies import system_of, topology
from tests.networks.second_moments import Law, second_moment_radius
from tests.networks.test_loss import STIFFNESS
from tests.topologies import AVERAGE, compiled, replaced


def grown(model: Model) -> Margins:
    return network_margins(numeric_model(model), Margins((), ""))


@pytest.mark.whole
def test_over_another_network_a_margin_is_another() -> None:
    """Of three users, brute force over all patterns: 1384 N/m at a loss of 40 %, to 0.5 N/m."""
    model = system_of(topology(3, 500.0, loss="40 %"))
    nominal, found = (
        {row.parameter: row.value for row in one.rows} for one in (apc.margins(model), grown(model))
    )
    assert nominal[STIFFNESS] == pytest.approx(1096.41, abs=0.01)
    assert found[STIFFNESS] == pytest.approx(1384, abs=1)


def test_a_loss_with_a_name_of_its_own_has_the_margin_of_the_loss() -> None:
    """The name has no largest value: it is varied up to 100 %, as the loss is."""
    text = replaced(AVERAGE, ("count: 3", "count: 2"), ("delay: 8 ms}", "delay: 8 ms, loss: 2 %}"))
    named = replaced(text, ("loss: 2 %", "loss: q"), ("peers:", "parameters: {q: 2 %}\npeers:"))
    direct, found = ({row.parameter: row for row in grown(compiled(one)).rows} for one in (text, named))
    assert found["q"].searched_to == direct["lan.loss"].searched_to
    assert found["q"].value is direct["lan.loss"].value is None


def test_derivatives_are_those_of_moments_followed_event_by_event() -> None:
    model = system_of(topology(2, 900.0))
    found = {row.parameter: row for row in network_sensitivities(numeric_model(model)).rows}

    def radius(stiffness: float = 900.0, loss: float = 0.1) -> float:
        return second_moment_radius(TopologySource(peers=2, kt=stiffness, cube=0.3), Law(loss, 1 - loss))

    for name, step, up, down in (
        (STIFFNESS, 1.0, radius(901.0), radius(899.0)),
        ("lan.loss", 1e-4, radius(loss=0.1001), radius(loss=0.0999)),
    ):
        row, expected = found[name], (up - down) / (2 * step)
        # The program's own differences are right to some 1e-6 of them: 1e-10 of a radius over such a step.
        assert row.derivative == pytest.approx(expected, rel=3e-6)


@pytest.mark.whole
@pytest.mark.parametrize("loss", ["{p: 1.1 %, r: 10 %}", "100 %"])
def test_where_one_value_takes_long_or_is_not_judged_margins_say_so(loss: str) -> None:
    model = system_of(topology(3, 500.0, loss=loss))
    reported = grown(model)
    assert not reported.rows and re.match(
        r"not computed: (one mean-square analysis|the mean-square verdict)", reported.note
    )
    why = network_sensitivities(numeric_model(model)).note
    assert why.startswith("sensitivities not computed")


@pytest.mark.needs_extension("parameter_boxes")
@pytest.mark.few(3)
# Largest stiffness of three users by the share lost (brute force over all patterns, to 0.5 N/m): none
# 1096.4, 5 % 1118, 10 % 1143.2, 40 % 1384.
@pytest.mark.parametrize(
    ("stiffness", "more", "box", "stable"),
    [
        (1098.0, "", {"lan.loss": "12 %:14 %"}, True),
        (1098.0, "", {"lan.loss": "0 %:5 %"}, False),
        (800.0, "", {"contact.stiffness": "±2%", "lan.loss": "0 %:1 %"}, True),
        (800.0, "", {"device.mass": "±0.5%", "cube.damping": "±1%"}, True),
        (500.0, "", {"contact.stiffness": "±10%", STIFFNESS: "±10%"}, True),
        # Peers on a graph of their own are a site each; a ring of three is the complete graph.
        (500.0, "{edges: [[1, 2], [2, 3], [1, 3]]}", {STIFFNESS: "±5%", "lan.loss": "5 %:10 %"}, True),
        (500.0, "{arcs: [[1, 2], [2, 3, 0.7], [3, 1]]}", {STIFFNESS: "±5%", "lan.loss": "5 %:10 %"}, False),
    ],
)
def test_a_box_in_mean_square_is_decided_as_references_say(
    stiffness: float, more: str, box: dict[str, str], *, stable: bool
) -> None:
    found = apc.robust_stability(system_of(topology(3, stiffness, more=more and f", graph: {more}")), box)
    assert found.stable is stable
    assert found.verdict == ("stable in mean square" if stable else "unstable in mean square")
    assert not stable or (found.undecided_fraction == 0 and found.cells < 100)


@pytest.mark.needs_extension("parameter_boxes")
def test_what_is_left_open_of_a_box_is_said() -> None:
    found = apc.robust_stability(system_of(topology(3, 500.0)), {STIFFNESS: "1000 N/m:1143.2 N/m"}, cells=20)
    assert (found.stable, found.cells) == (None, 20)
    assert 0 < found.undecided_fraction <= 1 and 1000 < found.counterexample[0] < 1143.2


@pytest.mark.needs_extension("parameter_boxes")
def test_of_an_ideal_link_a_box_is_nominal_until_it_may_lose_packets() -> None:
    model = system_of(topology(3, 500.0, loss="0 %"))
    assert (
        apc.robust_stability(model, {"contact.stiffness": "±1%"}).verdict
        == "stable up to a common translation"
    )
    assert apc.robust_stability(model, {"lan.loss": "0 %:2 %"}).verdict == "stable in mean square"


@pytest.mark.needs_extension("parameter_boxes")
@pytest.mark.parametrize(
    ("loss", "box", "why"),
    [
        ("10 %, on_loss: zero", "contact.stiffness", "losses of lan with on_loss: zero"),
        ("{p: 1.1 %, r: 10 %}", "contact.stiffness", "over bursts of lan"),
        ("{p: 0.3, r: 0.7}", "lan.loss.r", "over bursts of lan"),
        ("100 %", "contact.stiffness", "no box is proved: every packet of lan is lost"),
    ],
)
def test_a_box_that_is_not_served_is_refused_by_name(loss: str, box: str, why: str) -> None:
    with pytest.raises(ApcError, match="E898 no box is proved") as error:
        apc.robust_stability(system_of(topology(3, 500.0, loss=loss)), {box: "±1%"})
    assert why in str(error.value)
    criterion = "nominal" if loss == "100 %" else "mean-square"
    assert error.value.mistakes[0].fix == f"apc critical {box} --criterion {criterion}"


@pytest.mark.whole
def test_a_frame_that_grows_by_many_decades_is_unstable_and_what_lies_beyond_is_looked_past() -> None:
    """Two rooms with a fast link in each: at a large damping there a slow frame grows 1e14-fold, and more."""
    near = "  inside: {type: AveragePosition, object: cube, stiffness: 300 N/m, clock: haptic, link: near,"
    near += " damping: 2 N*s/m}\n"
    links = "links:\n  near: {clock: fast, delay: 2 ms, graph: {edges: [[1, 2], [3, 4]]}}\n"
    lan = "lan: {clock: network, delay: 40 ms, loss: 5 %, graph: {edges: [[1, 3], [1, 4], [2, 3], [2, 4]]}}"
    changes = ("count: 3", "count: 4"), ("network: 8 ms", "network: 20 ms\n  fast: 2 ms")
    more = ("links:\n", near + links), ("lan: {clock: network, delay: 8 ms}", lan)
    model = compiled(replaced(AVERAGE, *changes, *more))
    for damping in (1000.0, 1e4):
        with pytest.raises(ApcError, match="E806") if damping > 1e3 else nullcontext():
            verdict = apc.mean_square_stability(model, params={"inside.damping": damping})
            assert verdict is not None and verdict.stable is False
    assert apc.critical(model, "inside.damping").value is not None


def test_a_sample_at_the_limit_itself_is_no_end_of_the_search() -> None:
    """A part that no packet reaches has its nominal margin over any network; a search from 0 samples it."""
    post = "post: {type: SampledSpringDamper, a: lone, b: ground, stiffness: 0 N/m, damping: 0.5 N*s/m,"
    text = replaced(
        AVERAGE,
        ("delay: 8 ms}", "delay: 8 ms, loss: 30 %}"),
        ("masses:\n", "masses:\n  lone: {mass: 0.05 kg, damping: 30 N*s/m}\n"),
        ("couplers:\n", f"couplers:\n  {post} clock: haptic, delay: 1 ms}}\n"),
    )
    numeric = numeric_model(compiled(text))
    nominal = margins(numeric)
    (expected,) = (row.value for row in nominal.rows if row.parameter == "post.stiffness")
    (found,) = (row for row in network_margins(numeric, nominal).rows if row.parameter == "post.stiffness")
    assert expected is not None and found.value == pytest.approx(expected, rel=1e-8)
