"""The largest sampling period, alone and beside other clocks: closed forms, and analyses on both sides."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest

import apc
from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.overrides import apply, parse_override
from apc.parameter_values.parameter_names import ParameterRef
from apc.studies.timing_values import model_with_time
from tests.topologies import AVERAGE, compiled, replaced
from tests.varying.closed_forms import built

PULL = 97.3


WALL = """\
topology: wall
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.5 kg, damping: 2 N*s/m, x: 1 mm}}
couplers:
  wall: {type: VirtualWall, flange: device, stiffness: 1000 N/m, damping: 0.5 N*s/m, clock: haptic, x: 1 mm}
"""


def pulled(
    delay_ms: int = 0, clocks: str = "", other: str = "", delay: str = "", tick: str = "2 ms"
) -> Model:
    """Return a position pulled back: x⁺ = x − p (T − d) x − p d x(a tick ago), stable below 2/p + 2 d."""
    return built(
        f"topology: pulled\nclocks: {{tick: {tick}{clocks}}}\npeers: {{user: {{count: 1}}}}\n"
        f"masses:\n  it: {{type: Late, pull: {PULL!r} Hz, growth: 0 Hz, clock: tick, "
        f"delay: {delay or f'{delay_ms} ms'}}}\n{other}"
    )


def alongside(period: str) -> Model:
    """Return the same beside a second one that stays, and decides nothing."""
    other = "  that: {type: Late, pull: 1 Hz, growth: 0 Hz, clock: other, delay: 0 ms}\n"
    return pulled(0, f", other: {period}", other)


@pytest.mark.parametrize("delay_ms", [0, 3])
def test_one_clock_has_the_largest_period_of_the_closed_form(delay_ms: int) -> None:
    found = apc.critical(pulled(delay_ms), "tick.period")
    assert found.value == pytest.approx(2 / PULL + 2e-3 * delay_ms, rel=1e-12)
    assert found.error is not None and found.error < 1e-11 * found.value
    assert [one.stable_side for one in found.crossings] == ["below"]


@pytest.mark.few(2)
@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize(
    ("tick", "declared", "limit"),
    [
        ("1/f", "f: 500 Hz", PULL / 2),
        ("n*step", "{n: 1, step: 2 ms}", 1e3 / PULL),
        ("2*t", "t: 1 ms", 1 / PULL),
    ],
)
def test_a_number_on_which_the_period_depends_has_the_same_limit(
    tick: str, declared: str, limit: float, *, beside: bool
) -> None:
    other = "  that: {type: Late, pull: 1 Hz, growth: 0 Hz, clock: other, delay: 0 ms}\n" * beside
    parameters = "parameters: {" + declared.strip("{}") + "}\n"
    model = pulled(0, ", other: 3 ms" * beside, other + parameters, tick=tick)
    found = apc.critical(model, declared.strip("{")[0])
    (one,) = found.crossings
    assert abs(one.value - limit) <= one.error <= (2e-3 if beside else 1e-11) * limit
    assert one.stable_side == ("above" if tick == "1/f" else "below")


@pytest.mark.parametrize("period", ["1 ms", "3 ms"])
def test_beside_another_clock_the_error_is_the_gap_between_periods(period: str) -> None:
    model = alongside(period)
    found = apc.critical(model, "tick.period")
    (one,) = found.crossings
    assert abs(one.value - 2 / PULL) <= one.error < 1e-3 * one.value and one.kind == "period"
    # The ends are fractions of the other period with short frames.
    unit = Fraction(int(period[0]), 1000)
    for side, stable in ((-1, True), (1, False)):
        end = Fraction((one.value + side * one.error) / float(unit)).limit_denominator(400) * unit
        assert (
            analyze(numeric_model(model_with_time(model, ParameterRef("tick.period"), end))).stable is stable
        )


def test_the_textbook_wall_with_passive_hands_has_its_longest_period() -> None:
    # Colgate and Schenkel (1997): b > K T/2 + |B|.
    found = apc.critical(compiled(WALL), "haptic.period", criterion="passive")
    assert found.value == pytest.approx(2 * (2 - 0.5) / 1000, rel=1e-6)


def test_periods_of_too_long_frames_are_refused_by_name() -> None:
    model = alongside("1 ms")
    with pytest.raises(
        apc.ApcError, match=r"E844 values of tick\.period from .* lead to frames of more than"
    ):
        apc.critical(model, "tick.period", lower="2.00011 ms", upper="2.00012 ms")


@pytest.mark.whole
def test_a_region_over_a_period_is_that_of_the_closed_form() -> None:
    # Stable where pull·T < 2: of pull 50 to 200 Hz and T 5 to 25 ms.
    # ∫ min(2/p, 25 ms) − 5 ms dp = 30·20 ms + ∫_80^200 (2/p − 5 ms) dp.
    truth = 30 * 0.02 + 2 * math.log(200 / 80) - 120 * 0.005
    for model, most in ((pulled(0), 1e-6), (alongside("1 ms"), 0.03)):
        found = apc.region(model, x="tick.period=5 ms:25 ms", y="it.pull=50 Hz:200 Hz")
        assert abs(found.stable_area - truth) <= most * truth


def test_a_limit_of_0_and_a_phase_are_refused() -> None:
    with pytest.raises(apc.ApcError, match=r"E843 limit of haptic\.period"):
        apc.critical(compiled(AVERAGE), "haptic.period", lower="0 ms")
    with pytest.raises(apc.ApcError, match=r"E844 haptic\.phase sets the phase"):
        apc.critical(compiled(AVERAGE), "haptic.phase")
    with pytest.raises(apc.ApcError, match=r"E903 haptic\.phase sets the phase"):
        apc.region(compiled(AVERAGE), x="haptic.phase=0 ms:1 ms", y="contact.stiffness=1 N/m:2 N/m")


RATIOS = """\
topology: ratios
clocks: {haptic: 1 ms, network: 2 ms}
peers: {user: {count: 2}}
masses:
  cube: {mass: 0.6 kg, damping: 4 N*s/m, shared: true}
couplers:
  average: {type: AveragePosition, object: cube, stiffness: 250 N/m, clock: haptic, delay: 0 ms, link: lan}
links: {lan: {clock: network, delay: 2 ms}}
hands: {arm: {type: SpringDamperArm, flange: cube, stiffness: 60 N/m, damping: 0 N*s/m}}
"""


@pytest.mark.whole
def test_a_simple_ratio_of_two_clocks_is_not_taken_for_all_periods_near_it() -> None:
    """By another program, event by event: 1.0281386716 a frame at 13.9 ms, 0.997156 at 14 ms."""
    model = compiled(RATIOS)
    first, *others = apc.critical(model, "haptic.period").crossings
    assert first.stable_side == "below"
    assert 0.0135 < first.value < 0.0137
    assert "13.5" in str(apc.critical(model, "haptic.period")).splitlines()[0]
    assert all(abs(one.value - 0.014) < 1e-4 for one in others)
    assert apc.analyze(model, params={"haptic.period": "13.9 ms"}).spectral_radius == pytest.approx(
        1.0281386716, abs=1e-9
    )


def test_an_upper_end_below_the_first_value_of_a_scan_is_kept() -> None:
    found = apc.critical(pulled(), "tick.period", upper="0.05 ms")
    assert found.searched_to[0] < found.searched_to[1] <= 0.05e-3


def test_a_period_follows_a_rate_that_it_names() -> None:
    """The end of the name is read as a unit of frequency."""
    text = AVERAGE.replace("haptic: 1 ms", "haptic: rate_hz") + "\nparameters: {rate_hz: 1 kHz}\n"
    model = compiled(text)
    changed = apply(model, [parse_override(model, "rate_hz=500 Hz")])
    periods = {timing.name: timing.value for timing in changed.timings}
    assert periods["haptic.period"] == Fraction(1, 500)
    direct = apply(model, [parse_override(model, "haptic.period=2 ms")])
    radius = [analyze(numeric_model(compiled_model)).spectral_radius for compiled_model in (changed, direct)]
    assert radius[0] == radius[1]


def of_sixty_hertz(stiffness: str) -> Model:
    """Return three users who receive at 60 Hz over a link of a network of 125 Hz."""
    pairs = "lan: {clock: network, delay: 8 ms, pairs: {user: {user: {clock: slow}}}}"
    changes = ("network: 8 ms", "network: 8 ms\n  slow: 60 Hz"), ("lan: {clock: network, delay: 8 ms}", pairs)
    return compiled(replaced(AVERAGE, *changes, ("stiffness: 500 N/m", f"stiffness: {stiffness}")))


def test_with_several_constant_periods_the_present_one_and_short_frames_are_searched() -> None:
    """Frames are short at simple ratios to the common multiple of the others, 50 ms."""
    for parameter, ends in (("slow.period", ("5 ms", "200 ms")), ("haptic.period", ("0.5 ms", "8 ms"))):
        model = of_sixty_hertz("900 N/m")
        found = apc.critical(model, parameter, lower=ends[0], upper=ends[1])
        assert found.searched_to[0] <= found.current <= found.searched_to[1]
        edges = [crossing.value for crossing in found.crossings]
        errors = [crossing.error for crossing in found.crossings]
        side = found.crossings[0].stable_side == "below" if edges else str(found.verdict).startswith("stable")
        for milliseconds in (1, 2, 2.5, 4, 5, 10, 20, 25, 50, 100):
            value = milliseconds / 1000
            inside = found.searched_to[0] <= value <= found.searched_to[1]
            near = any(abs(value - edge) <= 2 * error for edge, error in zip(edges, errors, strict=True))
            if inside and not near:
                stable = side ^ bool(sum(edge < value for edge in edges) % 2)
                analysis = analyze(
                    numeric_model(apc.set_parameters(model, {parameter: f"{milliseconds} ms"}))
                )
                assert analysis.stable is stable, (parameter, milliseconds)


def test_a_range_of_periods_without_short_frames_is_said() -> None:
    model = of_sixty_hertz("500 N/m")
    whole = apc.critical(model, "slow.period", lower="10 ms", upper="100 ms")
    assert not any("not searched" in text for text in whole.limitations)
    cut = apc.critical(model, "slow.period", lower="10 ms", upper="5 s")
    assert cut.searched_to[1] < 5 and any("to 5 s not searched" in text for text in cut.limitations)
