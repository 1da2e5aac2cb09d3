"""Claims about `apc.runtime.frame.channel_law`."""

from __future__ import annotations

from fractions import Fraction

import pytest

import apc
from apc.compiler.errors import ApcError
from apc.runtime.frame.channel_law import channel_law, nominal_notes
from tests.lossy import unreliable
from tests.topologies import AVERAGE, compiled


def test_the_numbers_are_the_scenes_and_follow_a_setting() -> None:
    system = compiled(unreliable("loss: 2 %, jitter: 3 ms, distribution: pareto"))
    [link] = system.links
    law = channel_law(system, link, Fraction(8, 1000))
    assert (law.p, law.r, law.one_minus_h, law.one_minus_k) == (0.02, 0.98, 1.0, 0.0)
    assert (law.delay, law.jitter, law.distribution) == (0.008, 0.003, "pareto")
    more = apc.set_parameters(system, {"lan.loss": "5 %", "lan.jitter": "1 ms"})
    law = channel_law(more, more.links[0], Fraction(8, 1000))
    assert (law.p, law.r, law.jitter) == (0.05, 0.95, 0.001)


def test_a_probability_is_kept_within_its_bounds_when_it_is_set() -> None:
    system = compiled(unreliable("loss: {p: 2 %, r: 30 %}"))
    for name, value in (("lan.loss.p", "101 %"), ("lan.loss.1-h", "-1"), ("lan.loss.r", "2")):
        with pytest.raises(ApcError, match=r"E624 lan\.loss"):
            apc.set_parameters(system, {name: value})
    with pytest.raises(ApcError, match=r"E625 lan\.jitter wants a time of 0 s or more"):
        apc.set_parameters(compiled(unreliable("jitter: 1 ms")), {"lan.jitter": "-1 ms"})


def test_a_group_can_not_set_a_number_of_a_link() -> None:
    system = apc.set_parameters(compiled(unreliable("loss: 2 %")), {"user.lan.loss": "5 %"})
    with pytest.raises(ApcError, match=r"E891 lan\.loss is of a link, .*: user can't set it"):
        channel_law(system, system.links[0], Fraction(0))


def test_an_analysis_can_say_what_it_leaves_out() -> None:
    assert nominal_notes(compiled(AVERAGE)) == ()
    assert nominal_notes(compiled(unreliable("loss: 0 %, jitter: 0 ms"))) == ()
    [note] = nominal_notes(compiled(unreliable("loss: {p: 1 %, r: 25 %}, jitter: 2 ms")))
    assert note == (
        "packet loss (3.85 %) and jitter of lan are not in this verdict: every packet takes the nominal "
        "8 ms; see apc simulate"
    )
