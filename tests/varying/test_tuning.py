"""The gains that do best: one is the critical value, two the peak of the region; what is proved holds."""

from __future__ import annotations

import itertools
import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import qmc

import apc
from apc.extensions.loss_models.time_varying_delay import loop_gain
from apc.extensions.pareto_front.trade_off import pareto_front
from apc.lifting.numeric_model import numeric_model
from apc.output.formatting import full_digits
from apc.output.tuning_output import panels_of
from apc.parameter_values.parameter_names import ParameterRef
from apc.tuning.constraints import ConstraintSet
from apc.tuning.scenario_optimizer import _halton_points
from apc.tuning.specification import TuningSpec, read_tradeoff, read_tuning_spec
from tests.commands import Cli, write
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, messages_of, replaced, wall
from tests.varying.test_boxes import with_delays

K, B, CONTACT, MASS = "coordination.stiffness", "coordination.damping", "contact.stiffness", "device.mass"
RANGE = {K: (10.0, 7000.0)}


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("text", "peers", "damping"), [*itertools.product((AVERAGE, MESH), (2, 3, 5), (0, 2))]
)
def test_one_gain_is_the_critical_value_and_two_the_peak_of_the_region(
    text: str, peers: int, damping: float
) -> None:
    values = {"user.count": peers, "contact.damping": damping, B: damping}
    model = apc.set_parameters(compiled(text), values)
    one, two = (apc.tune(model, free, maximize=K) for free in (RANGE, RANGE | {CONTACT: (10.0, 5000.0)}))
    critical = apc.critical(model, K).value
    assert critical is not None and abs(one.optimum - critical) <= one.error + 1e-10 * critical
    assert one.proved and two.proved and 0 <= one.optimum - one.value <= 1e-3 * one.optimum
    # A part in a million higher the topology is stable at no stiffness of the contact, as much lower at some.
    apart = np.geomspace(1e-9, 1.0, 400)
    alongside = two.gains[1].optimum * (1 + np.concatenate([-apart, [0.0], apart]))
    contact = np.concatenate([np.clip(alongside, 10.0, 5000.0), np.linspace(10.0, 5000.0, 2000)])
    for share in (-1e-6, 1e-6):
        found = apc.analyze_many(model, {CONTACT: contact}, params={K: two.optimum * (1 + share)})
        assert (found.stable == True).any() == (share < 0)  # noqa: E712 -- None where it is left open


def test_gains_bear_all_that_they_have_to_and_none_on_a_grid_bear_it_better() -> None:
    """What binds lies at ends of the ranges, and is on the boundary there."""
    model = compiled(AVERAGE)
    over = {"user.count": "2:6", MASS: "±20%"}
    found = apc.tune(model, {K: (10.0, 5000.0), B: (0.0, 50.0)}, maximize=K, over=over)
    typed = {one.parameter: float(one.value) for one in found.gains}
    stiffness, damping = np.meshgrid(np.arange(1.01, 2.0, 0.1) * found.value, np.linspace(0, 50, 51))
    bears = np.ones(stiffness.shape, dtype=bool)
    assert found.proved and len(found.proofs) == 5 and found.bound_cells
    for peers, mass in itertools.product(range(2, 7), (0.08, 0.09, 0.12)):
        at = {"user.count": peers, MASS: mass}
        bears &= apc.analyze_many(model, {K: stiffness, B: damping}, params=at).stable.astype(bool)
        assert apc.analyze(model, params=at | typed).stable
    assert not bears.any()
    for one in found.active:
        where = {label: value for label, value, _ in one.where}
        best = {gain.parameter: gain.optimum for gain in found.gains}
        assert where[MASS] in (0.08, 0.12)
        assert apc.analyze(model, params=where | best).spectral_radius == pytest.approx(1, abs=1e-9)


def test_what_binds_may_lie_inside_a_range() -> None:
    model, over = compiled(AVERAGE), {"user.count": "2:5", MASS: "±20%"}
    found = apc.tune(model, {K: (10.0, 5000.0), B: (0.0, 50.0)}, maximize=K, over=over)
    best = {gain.parameter: gain.optimum for gain in found.gains}
    masses = {MASS: np.linspace(0.08, 0.12, 81)}
    radii = apc.analyze_many(model, masses, params=best | {"user.count": 2}).spectral_radius
    assert 0 < int(np.argmax(radii)) < 80
    assert radii.max() == pytest.approx(1, abs=1e-6)  # of a grid, beside the worst point


@pytest.mark.parametrize(
    ("damping", "virtual", "delay"), [(0.2, 0.0, 0.0), (0.2, 0.05, 0.0), (0.2, 0.0, 1e-3)]
)
def test_with_passive_hands_the_limit_is_colgates(damping: float, virtual: float, delay: float) -> None:
    """b > K T/2 + B, and a delay t of the force adds K t."""
    model, free = wall(0.1, damping, delay, 100.0, virtual), {"it.stiffness": (1.0, 5000.0)}
    found = apc.tune(model, free, maximize="it.stiffness", criterion="passive")
    assert found.optimum == pytest.approx((damping - virtual) / (0.0005 + delay), rel=1e-8)
    assert found.proved


PAIR = """\
topology: pair
clocks: {haptic: 1 ms, network: 2 ms}
peers: {user: {count: 2}}
masses: {device: {mass: 0.25 kg, damping: 2 N*s/m}}
couplers:
  coordination: {type: AveragePosition, object: device, stiffness: 50 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 40 ms}}
"""


def test_a_damping_beside_which_hands_get_any_force_for_nothing_stays_at_zero() -> None:
    """k (40 ms + 1.5 ms, half a tick of either clock) < b, where no velocity is sampled."""
    found = apc.tune(compiled(PAIR), {K: (1.0, 500.0), B: (0.0, 20.0)}, maximize=K, criterion="passive")
    assert abs(found.optimum - 2 / 0.0415) <= found.error < 1e-4
    assert found.gains[1].value == 0 and found.proved


@pytest.mark.whole
def test_a_front_is_the_best_of_a_gain_for_each_bound_on_what_is_felt() -> None:
    model = compiled(AVERAGE)
    demands = read_tuning_spec(model, [f"{K}=10 N/m:7000 N/m"], maximize=K)
    found = apc.pareto_front(model, RANGE, "impedance at 5 Hz", maximize=K, points=3)
    used = [abs(apc.transparency(model, 5.0, params={K: one.value}).impedance[0]) for one in found.designs]
    assert [one.transparency for one in found.designs] == pytest.approx(used, rel=1e-9)
    assert all(np.diff([(one.transparency, one.value) for one in found.designs], axis=0).ravel() > 0)
    assert found.designs[-1].value == apc.tune(model, RANGE, maximize=K).value
    requested = apc.tune(
        model, RANGE, maximize=K, constraint=[f"impedance at 5 Hz < {used[1] * 1.001} N*s/m"]
    )
    assert requested.value == pytest.approx(found.designs[1].value, rel=5e-3)
    with pytest.raises(apc.ApcError, match="E996"):
        pareto_front(
            model, demands, read_tradeoff("coordination_error at 1 Hz")
        )  # which is least where it is stiffest


# What is to be best, whether large, and what it is with a stiffness.
AIMS: dict[str, tuple[bool, Callable[[apc.Transparency, float], float]]] = {
    "coordination_error at 1 Hz": (False, lambda used, _: abs(used.coordination_error[0])),
    "impedance at 5 Hz": (True, lambda used, _: abs(used.impedance[1])),
    "coordination_error_h2": (False, lambda used, _: used.h2[0].error_m or np.nan),
    "coordination_error_hinf": (
        False,
        lambda used, _: max(one.sampled_data.norm for one in used.hinf if one.of == "error"),
    ),
    "damping - 0.01*coordination.stiffness": (
        False,
        lambda used, stiffness: (
            used.low_frequency.damping - 0.01 * stiffness if used.low_frequency else np.nan
        ),
    ),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("aim", AIMS)
def test_what_is_felt_is_no_better_with_any_gains_of_a_grid(aim: str) -> None:
    model, free, (larger, worth) = compiled(AVERAGE), {K: (10.0, 5000.0), B: (0.0, 50.0)}, AIMS[aim]
    found = apc.tune(model, free, **{"maximize" if larger else "minimize": aim})
    typed = tuple(float(one.value) for one in found.gains)
    sums, sign = [], -1 if larger else 1
    for stiffness, damping in (typed, *itertools.product(np.linspace(10, 5000, 4), np.linspace(0, 50, 4))):
        at = {K: float(stiffness), B: float(damping)}
        if apc.analyze(model, params=at).stable:
            sums.append(sign * worth(apc.transparency(model, [1.0, 5.0], params=at), stiffness))
    assert sums[0] <= sign * found.value  # what is typed keeps what is said
    assert found.proved == (aim != "coordination_error_hinf")  # which is right to an error, and not bounded
    assert sign * found.optimum <= min(sums[1:]) + 1e-4 * abs(found.optimum)  # where a descent ends


def test_a_picture_of_gains_has_the_intersection_of_the_stable_regions_of_all_scenarios() -> None:
    over = {"user.count": "2:3"}
    model = compiled(AVERAGE)
    found = apc.tune(model, {CONTACT: (10.0, 3000.0), K: (10.0, 3000.0)}, maximize=K, over=over)
    ax = found.plot()
    [boundary] = [line for line in ax.lines if line.get_label() == "stable in all 2 scenarios"]
    points = boundary.get_xydata()
    points = points[np.isfinite(points).all(axis=1) & (points[:, 1] > 20)][::40]
    assert len(points) >= 3
    for x, y in points:
        for share in (0.99, 1.01):  # stable in both below the boundary, unstable in one above it
            verdicts = [
                apc.analyze(model, params={CONTACT: x, K: y * share, "user.count": peers}).stable
                for peers in (2, 3)
            ]
            assert all(verdicts) == (share < 1)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"present", "tuned"} <= set(labels)


def test_where_nothing_moves_nothing_limits_gains() -> None:
    topology = apc.with_hands(apc.compile(str(TOPOLOGIES / "teleoperation-pair.yaml")), "clamped")
    found = apc.tune(topology, RANGE | {B: (0.0, 50.0)}, maximize=K)
    assert found.proved and found.value == RANGE[K][1] and not found.active
    assert apc.critical(topology, "wan.delay").value is None
    assert found.plot().get_xlabel().startswith(K)  # of the topology as it is
    with pytest.raises(apc.ApcError, match="E996 a picture without motion"):
        panels_of(topology, 1)


@pytest.mark.whole
def test_motions_die_out_no_faster_with_any_gains_of_a_grid() -> None:
    free = {K: (10.0, 5000.0), B: (0.0, 50.0)}
    found = apc.tune(compiled(AVERAGE), free, minimize="settling_time")
    assert found.proved and found.value == apc.tune(compiled(AVERAGE), free, minimize="spectral_radius").value
    stiffness, damping = np.meshgrid(np.linspace(10, 5000, 200), np.linspace(0, 50, 100))
    radii = apc.analyze_many(compiled(AVERAGE), {K: stiffness, B: damping}).spectral_radius
    assert found.optimum < radii.min() < found.optimum * 1.01  # a grid that is this coarse
    assert found.error < 1e-6
    # Of a descent that ended on its way nobody knows how far the best is.
    with full_digits():
        assert "±" in str(found) and "±" not in str(replace(found, error=math.inf))
    typed = {one.parameter: float(one.value) for one in found.gains}
    assert apc.analyze(compiled(AVERAGE), params=typed).spectral_radius < found.value


@pytest.mark.parametrize("size", [1, 2, 7])
def test_sample_points_are_the_sequence_of_halton(size: int) -> None:
    """Against SciPy, whose sequence begins at the corner."""
    expected = qmc.Halton(size, scramble=False).random(2049)[1:]
    np.testing.assert_allclose(_halton_points(2048, size), expected, rtol=1e-15)


def test_the_worst_point_of_a_box_is_on_a_ridge_and_at_an_edge() -> None:
    """Inside the range of one mass, where two modes meet, and at the end of the other."""
    gains, over = {K: 2395.42, B: 29.6553}, ["user.count=2:3", f"{MASS}=±20%", "cube.mass=±10%"]
    model, free = compiled(AVERAGE), [f"{K}=10 N/m:5000 N/m", f"{B}=0 N*s/m:50 N*s/m"]
    spec = read_tuning_spec(model, free, maximize=K, over=over)
    worst, value = ConstraintSet(numeric_model(model), spec).worst_case_within(0, np.array([*gains.values()]))
    assert 0.081 < worst.point[0] < 0.119 and worst.point[1] == 0.54
    masses, at = worst.point[0] + np.linspace(-1e-3, 1e-3, 20001), {"user.count": 2, "cube.mass": 0.54}
    radii = apc.analyze_many(model, {MASS: masses}, params=gains | at).spectral_radius
    assert value == pytest.approx(math.log(radii.max()), abs=1e-9)


def test_what_is_asked_beside_stability_is_kept_and_what_time_leaves_open_is_said() -> None:
    model = compiled(AVERAGE)
    found = apc.tune(model, RANGE, maximize=K, constraint=["decay=60 dB in 2 s"], over={MASS: "±20%"})
    masses = {MASS: np.linspace(0.08, 0.12, 41)}
    for value, stored in ((found.value, True), (1.01 * found.value, False)):
        radii = apc.analyze_many(model, masses, params={K: value}).spectral_radius
        assert found.proved and (radii.max() < 10 ** (-60 / 20 * 0.008 / 2)) == stored
    used = apc.tune(model, RANGE, maximize=K, constraint=["impedance at 5 Hz < 15 N*s/m"])
    assert abs(apc.transparency(model, 5.0, params={K: used.optimum}).impedance[0]) == pytest.approx(
        15, rel=1e-6
    )
    late = apc.tune(model, RANGE, maximize=K, over={"user.count": "2:9"}, seconds=0.0)
    assert not late.proved and "; not proved" in " ".join(str(late).split())


@pytest.mark.whole
def test_what_the_study_asks_is_written_into_the_topology(cli: Cli) -> None:
    tune = f"  tune: {{free: {{{K}: [10 N/m, 5 N/mm]}}, maximize: {K}, over: {{lan.loss: '0:0.1'}}}}\n"
    lossy = ("delay: 8 ms}", "delay: 8 ms, loss: 5 %}  # mine")
    write("lossy.yaml", replaced(AVERAGE, lossy, ("studies:\n", f"studies:\n{tune}")))
    ran = cli("tune lossy.yaml --write out.yaml")
    assert ran.code == 0 and "; proved" in " ".join(ran.out.split()), ran.err
    model = apc.compile("out.yaml")
    for loss in (0.01, 0.1):
        verdict = apc.mean_square_stability(model, params={"lan.loss": loss})
        assert verdict is not None and verdict.stable
    robust = cli(f"critical {K} out.yaml --over user.count=2:3")
    assert f"is the largest {K} found" in " ".join(robust.out.split()), robust.err
    limit = apc.critical(model, K, criterion="nominal").value or 0.0
    assert 0.99 * limit <= next(one.value for one in model.parameters if one.name == K) <= limit


@pytest.mark.whole
def test_a_range_of_a_delay_is_of_constant_delays_and_changing_ones_are_reported_or_demanded() -> None:
    """A program of its own, packet by packet: 4 at 20 ms and 8 at 60 ms grow by 1.001684 a frame."""
    model = compiled(
        replaced(
            AVERAGE,
            ("count: 3", "count: 2"),
            ("delay: 8 ms}", "delay: [20 ms, 60 ms]}"),
            ("500 N/m, clock: haptic, delay: 1 ms", "200 N/m, damping: 1 N*s/m, clock: haptic"),
        )
    )
    found = apc.tune(model, {K: "300 N/m:340 N/m"}, maximize=K)
    text = " ".join(str(found).split())
    assert found.proved and found.value == 319.2
    assert "stable for lan.delay from 20 ms to 60 ms, at every constant delay; proved" in text
    assert "unstable if 4 packets with 20 ms and 8 packets with 60 ms alternate" in text
    by_turns = [0.02] * 4 + [0.06] * 8
    assert with_delays(apc.set_parameters(model, {K: found.value}), by_turns) == pytest.approx(
        1.001684, rel=1e-6
    )
    requested = apc.tune(model, {K: "100 N/m:340 N/m"}, maximize=K, constraint=["delay=changing"])
    ((_, proved),) = requested.changing
    assert requested.proved and 180 < requested.value < 313.67 and proved.proved_to == 0.06
    assert "packet to packet; proved" in " ".join(str(requested).split())
    noise, stable = np.random.default_rng(5), apc.set_parameters(model, {K: requested.value})
    assert max(with_delays(stable, noise.uniform(0.02, 0.06, 6).tolist()) for _ in range(5)) < 1
    assert with_delays(stable, by_turns) < 1
    # A part in fifty higher nothing is proved.
    more = apc.set_parameters(model, {K: 1.02 * requested.value})
    assert loop_gain(more, ParameterRef("lan.delay"), Fraction("0.02"), Fraction("0.06")) > 1


def test_what_cannot_be_asked_is_refused() -> None:
    def refused(free: dict[str, str], **given: object) -> str:
        return messages_of(lambda: apc.tune(compiled(AVERAGE), free, **({"maximize": K} | given)))[0]  # type: ignore[arg-type]

    good = {K: "10 N/m:5000 N/m"}
    assert refused({}).startswith("--free: E995 no tunable parameter")
    assert refused({K: "5 N/m:1 N/m"}).startswith("--free: E833")
    assert refused({"coordination.stifness": "1 N/m:5 N/m"}).endswith(f"Try: {K}")
    assert refused(good, over={"user.count": "9:2"}).endswith("Try: user.count=2:9")
    assert refused(good, maximize=MASS).endswith(f"Try: --maximize {K}")
    assert refused(good, constraint=["decay=fast"]).startswith("--constraint: E996")
    message = refused(good, constraint=["delay = changing"])
    assert message.startswith("--constraint: E996") and message.endswith('Try: --over "lan.delay=8 ms:20 ms"')


def _spec(model: apc.Model, free: str, *over: str) -> TuningSpec:
    return read_tuning_spec(model, [free], maximize=free.partition("=")[0], over=over)


def _proposed_value(message: str, start: str, option: str) -> str:
    """Return the value of the option that a message proposes."""
    assert message.startswith(f"{start} Try: {option} ")
    [value] = shlex.split(message.removeprefix(f"{start} Try: {option} "))
    return value


@pytest.mark.parametrize("name", [K, B, MASS, f"user.{MASS}", "cube.mass", "lan.loss", "lan.delay"])
def test_a_name_without_a_range_proposes_a_range_around_its_value(name: str) -> None:
    model = compiled(replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 60 %}")))
    present = {one.name: one.value for one in model.parameters} | {"lan.delay": 0.008}
    problem = f"E830 range of {name}: expected LOW:HIGH or ±PERCENT%, got nothing."
    [message] = messages_of(lambda: _spec(model, f"{CONTACT}=1 N/m:2 N/m", name))
    over = _proposed_value(message, f"--over: {problem}", "--over")
    spec = _spec(model, f"{CONTACT}=1 N/m:2 N/m", over)
    [found] = [spec.delay] if spec.delay else spec.box
    assert found.low < found.high
    assert found.low <= present[name.removeprefix("user.")] <= found.high
    if name != "lan.delay":
        [message] = messages_of(lambda: _spec(model, name))
        free = _proposed_value(message, f"--free: {problem}", "--free")
        assert (free, _spec(model, free).free) == (over, (found,))


@pytest.mark.parametrize("name", ["lan.delay", "user.count"])
def test_a_delay_or_a_number_of_peers_is_proposed_as_an_operating_condition(name: str) -> None:
    model = compiled(AVERAGE)
    [message] = messages_of(lambda: _spec(model, name))
    over = _proposed_value(message, f"--free: E995 {name} can't be tuned continuously.", "--over")
    assert _spec(model, f"{K}=1 N/m:2 N/m", over)
