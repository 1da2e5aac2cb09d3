"""Claims about `apc.simulation.blocks`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.simulation.blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.lossy import unreliable
from tests.sites import alone
from tests.topologies import AVERAGE, compiled


def test_blocks_follow_one_another_tick_by_tick_up_to_the_last_one_in_time() -> None:
    simulation = prepare(compiled(AVERAGE), Settings(Fraction(20_0005, 10_000), jit=False))
    time = np.concatenate([block.time for block in blocks(simulation)])
    assert time.tolist() == [k / 1000 for k in range(20_001)]
    assert max(len(block.time) for block in blocks(simulation)) <= simulation.length * 8


def test_runs_of_one_seed_have_packets_of_their_own_and_each_is_the_same_every_time() -> None:
    pushed = unreliable("loss: 30 %").replace("{count: 3}", "{count: 3, set: {device.x: [1 mm, 5 mm, 0 mm]}}")
    simulation = prepare(compiled(pushed), Settings(Fraction(1), jit=False))
    first, again, other = (
        np.concatenate([block.values for block in blocks(simulation, run=run)]) for run in (0, 0, 1)
    )
    assert first.tolist() == again.tolist()
    assert not np.array_equal(first, other)


def test_the_first_block_names_what_left_the_range_of_floats_and_ends_before_it() -> None:
    simulation = prepare(alone(lambda x, u: 2000 * x + 1), Settings(Fraction(1), jit=False))
    *_, block = blocks(simulation)
    assert block.stopped == "peer[1].x"
    assert np.isfinite(block.values).all()
    # (e^2000t − 1)/2000 is beyond 1.8e308 from 0.3588 s on.
    assert block.stopped_at == pytest.approx(0.359, abs=1e-9)


def test_a_pole_is_reached_and_told() -> None:
    played = blocks(prepare(alone(lambda x, u: 50 * (x + 1) ** 2), Settings(Fraction(1, 10), jit=False)))
    assert len(next(played).time) == 19  # 1/(1 − 50 t) − 1: the last whole frame ends at 19 ms
    with pytest.raises(ApcError, match=r"E871 the motion of x can't be integrated"):
        next(played)
