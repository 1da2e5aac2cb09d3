"""The gains that do best: one is the critical value, two the peak of the region; what is proved holds."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import apc
from tests.commands import Cli, write
from tests.topologies import AVERAGE, MESH, compiled, told, wall

K, B, CONTACT, MASS = "coordination.stiffness", "coordination.damping", "contact.stiffness", "device.mass"
RANGE = {K: (10.0, 7000.0)}
BOTH = RANGE | {CONTACT: (10.0, 5000.0)}


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("text", "peers", "damping"), [*itertools.product((AVERAGE, MESH), (2, 3, 5), (0, 2))]
)
def test_one_gain_is_the_critical_value_and_two_the_peak_of_the_region(
    text: str, peers: int, damping: float
) -> None:
    values = {"user.count": peers, "contact.damping": damping, B: damping}
    model = apc.set_parameters(compiled(text), values)
    one, two = (apc.tune(model, free, maximize=K) for free in (RANGE, BOTH))
    critical = apc.critical(model, K)
    assert critical.value is not None
    assert one.proved
    assert abs(one.best - critical.value) <= one.error + (critical.error or 0.0)
    assert 0 <= one.best - one.value <= 1e-3 * one.best
    # A part in a million higher the scene is stable at no stiffness of the contact, as much lower at some.
    apart = np.geomspace(1e-9, 1.0, 400)
    beside = two.gains[1].best * (1 + np.concatenate([-apart, [0.0], apart]))
    contact = np.concatenate([np.clip(beside, 10.0, 5000.0), np.linspace(10.0, 5000.0, 2000)])
    for share in (-1e-6, 1e-6):
        found = apc.analyze_many(model, {CONTACT: contact}, set={K: two.best * (1 + share)})
        assert (found.stable == True).any() == (share < 0)  # noqa: E712 -- None where it is left open
    assert two.proved
    assert apc.analyze(model, set={one.parameter: float(one.value) for one in two.gains}).stable


def test_gains_bear_all_that_they_have_to_and_none_on_a_grid_bear_it_better() -> None:
    model = compiled(AVERAGE)
    free = {K: (10.0, 5000.0), B: (0.0, 50.0)}
    found = apc.tune(model, free, maximize=K, over={"user.count": "2:6", MASS: "±20%"})
    assert found.proved
    assert len(found.proofs) == 5
    stiffness, damping = np.meshgrid(np.arange(1.01, 2.0, 0.05) * found.value, np.linspace(0, 50, 101))
    bears, holds = np.ones(stiffness.shape, dtype=bool), True
    for peers, mass in itertools.product(range(2, 7), (0.08, 0.09, 0.12)):
        at = {"user.count": peers, MASS: mass}
        bears &= apc.analyze_many(model, {K: stiffness, B: damping}, set=at).stable.astype(bool)
        holds &= bool(
            apc.analyze(model, set=at | {one.parameter: float(one.value) for one in found.gains}).stable
        )
    assert holds
    assert not bears.any()
    # What binds lies at ends of the ranges, and is on the boundary there.
    for one in found.binding:
        at = {label: value for label, value, _ in one.where}
        assert at[MASS] in (0.08, 0.12)
        radius = apc.analyze(
            model, set=at | {gain.parameter: gain.best for gain in found.gains}
        ).spectral_radius
        assert radius == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize(
    ("damping", "virtual", "delay"), [(0.2, 0.0, 0.0), (0.5, 0.0, 0.0), (0.2, 0.05, 0.0), (0.2, 0.0, 0.001)]
)
def test_with_passive_hands_the_limit_is_colgates(damping: float, virtual: float, delay: float) -> None:
    """b > K T/2 + B, and a delay t of the force adds K t."""
    model, free = wall(0.1, damping, delay, 100.0, virtual), {"it.stiffness": (1.0, 5000.0)}
    found = apc.tune(model, free, maximize="it.stiffness", criterion="passive")
    assert found.best == pytest.approx((damping - virtual) / (0.0005 + delay), rel=1e-8)
    assert found.proved


def test_a_decay_is_kept_over_a_box_and_what_time_leaves_open_is_said() -> None:
    model = compiled(AVERAGE)
    found = apc.tune(model, RANGE, maximize=K, subject=["decay=60 dB in 2 s"], over={MASS: "±20%"})
    allowed = 10 ** (-60 / 20 * 0.008 / 2)
    radii = [
        apc.analyze_many(model, {MASS: np.linspace(0.08, 0.12, 41)}, set={K: value}).spectral_radius.max()
        for value in (found.value, 1.01 * found.value)
    ]
    assert found.proved
    assert radii[0] < allowed < radii[1]
    late = apc.tune(model, RANGE, maximize=K, over={"user.count": "2:9"}, seconds=0.0)
    assert not late.proved
    assert "not proved" in str(late)
    assert "the time was up" in str(late)


def test_gains_over_a_lossy_network_are_written_into_the_topology(cli: Cli) -> None:
    text = AVERAGE.replace("delay: 8 ms}", "delay: 8 ms, loss: 5 %}  # mine")
    write("lossy.yaml", text)
    ran = cli(
        f'tune lossy.yaml --free "{K}=10 N/m:5 N/mm" --maximize {K} --over lan.loss=0:0.1 --write out.yaml'
    )
    assert ran.code == 0, ran.err
    assert "it is proved" in " ".join(ran.out.split())
    assert max(map(len, ran.out.splitlines())) <= 80
    model = apc.compile("out.yaml")
    for loss in (0.0, 0.02, 0.1):
        verdict = apc.judge_network(model, set={"lan.loss": loss}) or apc.analyze(
            model, set={"lan.loss": loss}
        )
        assert verdict.stable
    value = apc.critical(model, K, set={"lan.loss": 0.0}, criterion="nominal").value
    assert value is not None
    assert 0.99 * value <= next(one.value for one in model.parameters if one.name == K) <= value


def test_what_cannot_be_asked_is_refused() -> None:
    def tune(free: dict[str, str], **given: object) -> object:
        return apc.tune(compiled(AVERAGE), free, **({"maximize": K} | given))  # type: ignore[arg-type]

    good = {K: "10 N/m:5000 N/m"}
    assert told(tune, {})[0].startswith("--free: E995 no number is free")
    assert told(tune, {K: "5 N/m:1 N/m"})[0].startswith("--free: E833")
    assert told(tune, {"coordination.stifness": "1 N/m:5 N/m"})[0].endswith(f"Write: {K}")
    assert told(lambda: tune(good, over={"user.count": "9:2"}))[0].endswith("Write: user.count=2:9")
    assert told(lambda: tune(good, maximize=MASS))[0].endswith(f"Write: --maximize {K}")
    assert told(lambda: tune(good, subject=["decay=fast"]))[0].startswith("--subject: E996")
