"""Claims about `apc.vary.margins`."""

from __future__ import annotations

import re
from fractions import Fraction

from apc.analysis.analysis import analyze
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary.margins import margins
from tests.topologies import AVERAGE, compiled, replaced


def test_every_stiffness_damping_and_delay_of_a_coupler_has_a_margin_that_holds() -> None:
    system = compiled(AVERAGE)
    found = {one.parameter: one for one in margins(system).rows}
    assert list(found) == [
        *("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping"),
        *("contact.delay", "coordination.delay", "lan.delay"),
    ]
    for name, one in found.items():
        if one.value is None or one.error is None:
            assert one.scanned > one.present
            continue
        assert one.value > one.present
        assert one.error <= 1e-12 * one.value
        for side, stable in ((-1e-9, True), (1e-9, False)):
            value = Fraction(one.value * (1 + side))
            assert analyze(apply(system, [Override(Free(name), value)])).stable is stable
        assert one.factor == (one.value / one.present if one.present else None)


def test_a_scene_that_is_not_stable_has_no_margins_and_says_so() -> None:
    found = margins(compiled(replaced(AVERAGE, ("stiffness: 500 N/m", "stiffness: 2000 N/m"))))
    assert found.rows == ()
    assert "not stable" in str(found)


def test_the_table_fits_80_columns() -> None:
    text = str(margins(compiled(AVERAGE)))
    assert max(map(len, text.splitlines())) <= 80
    assert "none found up to" in text


def test_a_delay_that_is_scanned_is_scanned_far_enough_or_said_not_to_be() -> None:
    text = replaced(
        AVERAGE,
        (
            "stiffness: 1000 N/m, clock: haptic, delay: 1 ms",
            "stiffness: 1000 N/m, clock: haptic, delay: 0.13 ms",
        ),
    )
    for one in margins(compiled(text)).rows:
        assert one.value is not None or one.scanned >= 1.5 * one.present
        assert one.note == ""
    # 0.95 ms and 1 ms meet at every twentieth of a millisecond.
    slow = replaced(text, ("network: 8 ms", "network: 0.95 ms"))
    found = margins(compiled(slow))
    row = next(one for one in found.rows if one.parameter == "lan.delay")
    assert row.value is None
    assert re.fullmatch(r"\d+ orders of events up to 0\.012\d* s", row.note)
    assert f"not looked for: {row.note}" in str(found)
