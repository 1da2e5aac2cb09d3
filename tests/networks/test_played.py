"""What unreliable links do to a topology that is played: each packet looked at again by hand at each tick."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerColumn
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from tests.lossy import apart
from tests.sites import MS
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced


def rows_of(simulation: Simulation, run: int = 0) -> NDArray[np.float64]:
    return np.concatenate([block.values for block in blocks(simulation, run=run)])


def played(model: Model, *, duration: Fraction = Fraction(1), seed: int = 0) -> NDArray[np.float64]:
    return rows_of(prepare(model, Settings(duration, jit=False, seed=seed)))


def scattered(model: Model) -> Model:
    """Return a system whose peers all start elsewhere."""
    random = np.random.default_rng(1)
    groups = []
    for group in model.groups:
        starts = [one.start for one in model.peer_types[group.peer_type].states if one.unit == "m"]
        columns = tuple(PeerColumn(name, random.uniform(-0.01, 0.01, group.count)) for name in starts)
        stored = tuple(value for value in group.values if value.name not in starts)
        groups.append(replace(group, values=stored, columns=columns))
    return replace(model, groups=tuple(groups))


# Weights, a slow clock and a delay of its own between two groups.
GROUPS = replaced(
    AVERAGE,
    ("user: {count: 3}", "near: {count: 2}\n  far: {count: 1, set: {coordination.clock: slow}}"),
    ("  haptic: 1 ms", "  haptic: 1 ms\n  slow: {period: 2 ms, phase: 1 ms}"),
    (
        "delay: 8 ms}",
        "delay: 8 ms, graph: {arcs: [[1, 2, 0.5], [2, 1], [3, 1], [1, 3]]}, delays: {far: {near: 20 ms}}}",
    ),
)


@pytest.mark.few(1)
@pytest.mark.parametrize("more", ["loss: 0 %", "jitter: 0 ms, reorder: all", "loss: 0 %, on_loss: zero"])
@pytest.mark.parametrize(
    "name",
    [
        "mixed-clocks",
        "groups",
        "star-lecture",
        "experiment-average",
        "0 ms",
        "1/3 ms",
        "20 ms",
        "ring-of-eight",
    ],
)
def test_a_perfect_channel_plays_as_a_reliable_link_whatever_graph_clocks_and_delay(
    name: str, more: str
) -> None:
    if name == "groups":
        text = GROUPS
    elif name.endswith(" ms"):
        text = AVERAGE.replace("delay: 8 ms}", f"delay: {name}}}")
    else:
        text = (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")
    at = text.index("clock: ", text.index("\nlinks:"))
    plain, same = (
        played(scattered(compiled(one)), duration=Fraction(1, 2))
        for one in (text, f"{text[:at]}{more}, {text[at:]}")
    )
    assert np.abs(plain).max() > 0.005
    np.testing.assert_allclose(same, plain, rtol=0, atol=1e-12 * np.abs(plain).max())


@pytest.mark.parametrize("jit", [False, True])
def test_how_finely_time_is_counted_changes_nothing(jit: bool) -> None:
    """A delay longer by 1e-13 s makes quanta of that, and 2 s of them more than a half of 2^63 parts hold."""
    coarse = apart(AVERAGE, "jitter: 25 ms, reorder: all")
    fine = replaced(coarse, ("delay: 8 ms, j", "delay: 8.0000000001 ms, j"))
    topologies = [prepare(compiled(one), Settings(Fraction(2), jit=jit)) for one in (coarse, fine)]
    assert [one.quantum for one in topologies] == [MS, Fraction(1, 10**13)]
    np.testing.assert_array_equal(*map(rows_of, topologies))


def test_a_link_that_loses_everything_leaves_every_copy_where_it_is_or_holds_the_start() -> None:
    """Until the first packet is due nobody knows of a loss: the start values pull for 8 ms, nothing after."""
    topologies = [compiled(apart(AVERAGE, f"loss: 100 %{more}")) for more in ("", ", on_loss: zero")]
    hold, zero = (prepare(one, Settings(Fraction(4), jit=False)) for one in topologies)
    columns = [[one.name for one in hold.signals].index(f"user[{i}].cube.x") for i in (1, 2, 3)]
    assert np.abs(np.diff(rows_of(zero)[-200:, columns], axis=0)).max() < 1e-12
    # Each settles at the mean of the others' start values.
    means = [(5 - 3) / 2e3, (1 - 3) / 2e3, (1 + 5) / 2e3]
    np.testing.assert_allclose(rows_of(hold)[-1, columns], means, atol=1e-6)


@pytest.mark.whole
def test_the_same_seed_gives_the_same_rows_however_long_the_chunks_are() -> None:
    model = compiled(apart(AVERAGE, "loss: 20 %, jitter: 9 ms, distribution: pareto, reorder: all"))
    long, short = (prepare(model, Settings(Fraction(time), jit=False, seed=1)) for time in ("3", "1/10"))
    assert short.length != long.length
    one, other = rows_of(long), rows_of(short)
    assert one[: len(other)].tolist() == other.tolist()
    assert rows_of(replace(short, length=3)).tolist() == other.tolist()
    assert np.abs(played(model, duration=Fraction(3), seed=2) - one).max() > 1e-3
    assert np.abs(rows_of(long, run=1) - one).max() > 1e-3
