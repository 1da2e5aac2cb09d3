"""The almost sure exponent: a closed form, courses multiplied by hand, reference numbers, equal seeds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from apc.analysis.analysis import prepare
from apc.frame.radius import RADII, value_of
from apc.moments.almost_sure import AlmostSure, Chance, almost_sure, every_channel, exponent, unplayed
from apc.moments.held import HeldLoop
from tests.held_scenes import frames, growth, scene, system_of
from tests.lossy import BURSTS, RELIABLE

# Of an independent program, for the paper's users at 10 % loss: peers, stiffness, exponent per frame and half
# of its 95 % interval.
REFERENCE = (
    (2, 500.0, -0.04764991465454064, 8.277265879859296e-05),
    (2, 1100.0, -0.016408064819737413, 8.87988246462047e-05),
    (3, 500.0, -0.04520607980044825, 3.0578907742632605e-05),
    (3, 900.0, -0.01785369642242314, 4.550593369736907e-05),
    (3, 1100.0, -0.003331590098791081, 6.348139654886742e-05),
    (5, 900.0, -0.016734518916488996, 5.323732007715986e-05),
)


def estimate(text: str, *, seed: int = 0) -> AlmostSure | None:
    system = system_of(text)
    return almost_sure(system, prepare(system), seed=seed)


def number(heard: float, lost: float) -> HeldLoop:
    """Return a loop of one number that is multiplied by one factor or another."""
    one, zero = RADII.exact(np.array([[1.0]])), RADII.exact(np.array([[0.0]]))
    return HeldLoop(zero, one, RADII.exact(np.array([[heard]])), RADII.exact(np.array([[lost]])))


@pytest.mark.parametrize("law", ["independent", "bursts"])
def test_intervals_hold_the_exponent_of_one_number_95_times_in_a_hundred(law: str) -> None:
    chance = BURSTS if law == "bursts" else replace(RELIABLE, p=0.3, r=0.7)
    heard, lost = 0.7, 1.4
    share = chance.mean_loss
    known = (1 - share) * math.log(heard) + share * math.log(lost)
    inside = 0
    for seed in range(100):
        found = exponent(number(heard, lost), [Chance(chance, (0,))], seed=seed, courses=40, frames=240)
        inside += found.interval[0] <= known <= found.interval[1]
    # 95 of 100 give or take three standard deviations of such a count
    assert 88 <= inside <= 100


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("peers", "stiffness", "known", "half"),
    REFERENCE,
    ids=[f"{one[0]} users, {one[1]:g} N/m" for one in REFERENCE],
)
def test_exponents_are_those_of_the_reference(
    peers: int, stiffness: float, known: float, half: float
) -> None:
    found = estimate(scene(peers, stiffness))
    assert found is not None
    low, high = found.interval
    assert low < found.exponent < high
    assert high - low < 1e-4
    assert low - half <= known <= high + half


@pytest.mark.parametrize("loss", ["10 %", "{p: 5 %, r: 20 %}"])
def test_exponents_are_those_of_frames_multiplied_by_hand(loss: str) -> None:
    found = estimate(scene(2, 900.0, loss=loss))
    assert found is not None
    own = frames(2, 900.0)
    size, luck = len(own.a), np.random.default_rng(3)
    heard_and_lost = np.array(
        [[own.matrix(np.array([one, other])) for other in (0.0, 1.0)] for one in (0.0, 1.0)]
    )
    p, r = (0.1, 0.9) if loss == "10 %" else (0.05, 0.2)
    courses, frames_each = 200, 1700
    # The translation of all, and what every channel holds of it, is taken out.
    values, vectors = np.linalg.eig(heard_and_lost[1, 1])
    rigid = vectors[:, np.argmin(np.abs(values - 1))].real
    rigid /= rigid[0]
    x = luck.standard_normal((courses, size + 4))
    bad = luck.random((courses, 2)) < p / (p + r)
    total = np.zeros(courses)
    for frame in range(frames_each):
        hears = (~bad).astype(np.intp)
        x = np.einsum("cij,cj->ci", heard_and_lost[hears[:, 0], hears[:, 1]], x)
        x -= x[:, :1] * rigid
        length = np.linalg.norm(x, axis=1)
        x /= length[:, None]
        total += np.log(length) if frame >= 500 else 0.0
        bad = np.where(bad, luck.random(bad.shape) >= r, luck.random(bad.shape) < p)
    own_found = total / (frames_each - 500)
    own_half = 1.97 * own_found.std(ddof=1) / math.sqrt(courses)
    off = abs(own_found.mean() - found.exponent)
    assert off <= own_half + (found.interval[1] - found.interval[0]) / 2


def test_equal_seeds_give_equal_numbers_and_others_others() -> None:
    law = [Chance(BURSTS, (0,))]
    runs = [exponent(number(0.5, 1.5), law, seed=seed, courses=20, frames=100) for seed in (1, 1, 2)]
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


@pytest.mark.parametrize(("loss", "radius"), [("0 %", 0.9163), ("100 %", None)])
def test_without_chance_the_exponent_is_that_of_a_radius(loss: str, radius: float | None) -> None:
    found = estimate(scene(3, 500.0, loss=loss))
    assert found is not None
    if radius is None:  # what each holds of the others stays as it is
        assert found.exponent == pytest.approx(0.0, abs=1e-9)
    else:
        assert found.exponent == pytest.approx(math.log(0.9161770691168368) / 2, abs=1e-10)
    assert found.interval[1] - found.interval[0] < 1e-6


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (scene(3, 500.0, more=", jitter: 2 ms"), "lan has jitter"),
        (
            scene(3, 500.0, more=", on_loss: zero"),
            "lan takes no difference where a packet is missed (on_loss: zero)",
        ),
        (scene(1000, 500.0), "1,000 peers don't fit in one matrix of 180 states"),
        (scene(20, 500.0), "20 peers and their channels have 500 states, and 180 are the most"),
    ],
)
def test_what_is_not_estimated_is_named(text: str, why: str) -> None:
    system = system_of(text)
    prepared = prepare(system)
    assert almost_sure(system, prepared) is None
    assert unplayed(system, prepared) == why


@pytest.mark.parametrize(
    ("peers", "stiffness", "damping", "coupler", "operator"),
    [
        (2, 900.0, 0.0, "AveragePosition", "mean"),
        (3, 300.0, 2.0, "AveragePosition", "mean"),
        (3, 300.0, 0.5, "FullMesh", "sum"),
        (4, 300.0, 0.5, "AveragePosition", "mean"),
    ],
)
def test_frames_that_lose_packets_are_those_made_by_hand(
    peers: int, stiffness: float, damping: float, coupler: str, operator: str
) -> None:
    system = system_of(scene(peers, stiffness, damping=damping, coupler=coupler))
    found = every_channel(system, prepare(system))
    assert not isinstance(found, str)
    held, chances = found
    f, g, s, e = (value_of(one) for one in (held.f, held.g, held.s, held.e))
    own = frames(peers, stiffness, damping, operator)
    luck = np.random.default_rng(5)
    for count in (4, 9, 20):
        listed = (luck.random((count, len(own.pairs))) > 0.4).astype(np.float64)
        listed[0] = 1.0
        product = np.eye(len(f))
        for one in listed:
            heard = np.zeros((len(s), 1))
            for chance, does in zip(chances, one, strict=True):  # by receiver and sender, as the pairs are
                heard[list(chance.ears)] = does
            product = (f + g @ (heard * s + (1 - heard) * e)) @ product
        known = growth([own.matrix(one) for one in listed])
        assert np.abs(np.linalg.eigvals(product)).max() ** (1 / count) == pytest.approx(known, abs=1e-10)
