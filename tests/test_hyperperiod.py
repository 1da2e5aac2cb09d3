"""Claims about `apc.frame.hyperperiod`."""

from __future__ import annotations

from fractions import Fraction

import pytest

from apc.compiler.errors import ApcError
from apc.frame.hyperperiod import ClockGrid
from apc.frame.schedule import Schedule
from tests.scheduled import schedules
from tests.sites import MS, paper


def _schedule(**values: Fraction) -> Schedule:
    [schedule] = schedules(paper(**values))
    return schedule


def test_the_frame_is_the_least_common_multiple_of_the_periods() -> None:
    assert _schedule(haptic=Fraction(3, 1000), network=Fraction(7, 2000)).frame_s == Fraction(21, 1000)
    assert _schedule(haptic=Fraction(1, 90), network=Fraction(1, 60)).frame_s == Fraction(1, 30)


def test_every_time_is_a_whole_number_of_the_largest_quantum() -> None:
    schedule = _schedule(haptic_phase=MS * 3 / 10, network_phase=MS * 5 / 2, comp=MS * 2 / 5)
    assert schedule.quantum == MS / 10


def test_a_time_that_nobody_uses_takes_no_part() -> None:
    [heard] = schedules(paper("sum", peers=2, comm=MS / 7))
    [alone] = schedules(paper("sum", peers=1, comm=MS / 7))
    assert (heard.quantum, heard.frame_s) == (MS / 7, 8 * MS)
    assert (alone.quantum, alone.frame_s) == (MS, MS)  # nobody to hear: the link's clock doesn't count either


@pytest.mark.parametrize(
    ("limit", "at_or_before", "before"), [(2, 0, -1), (9, 0, 0), (10, 1, 0), (-6, -1, -2)]
)
def test_the_newest_tick_is_at_or_strictly_before_a_limit(limit: int, at_or_before: int, before: int) -> None:
    grid = ClockGrid(phase=2, period=8)
    assert grid.newest(limit) == at_or_before
    assert grid.newest(limit, strictly=True) == before


def test_clocks_that_hardly_ever_stand_as_before_are_refused_with_their_periods() -> None:
    with pytest.raises(ApcError, match=r"E805 all clocks stand as before only after .*haptic 1.00003 ms"):
        _schedule(haptic=Fraction(100003, 10**8))
