"""A start at a kink: each side is analyzed, and no slope that no side has."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.analysis.analysis import analyze
from apc.analysis.one_sided_slopes import sides
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameter_names import ParameterRef
from apc.spectrum import spectrum
from apc.studies.clock_periods import NominalPeriodPath
from apc.studies.parameter_path import LOCATION
from apc.studies.timing_values import model_with_time
from tests.language.own import component
from tests.topologies import TOPOLOGIES, compiled, library, messages_of

MASS, DAMPING, PERIOD = 1.0, 20.0, 1e-3  # kg, N·s/m, s


def radius(stiffness: float, velocity_gain: float = 0.0) -> float:
    """Return the spectral radius of a mass with a sampled force, by its exact step; without its rigid mode.

    Over a period x⁺ = x + (1 − e)/a v + (T − (1 − e)/a)/(m a) F and v⁺ = e v + (1 − e)/(m a) F, a = b/m and
    e = exp(−a T), with F = −stiffness x − velocity_gain v.
    """
    rate = DAMPING / MASS
    decay = math.exp(-rate * PERIOD)
    reach = (1 - decay) / rate
    push = np.array([[(PERIOD - reach) / DAMPING], [(1 - decay) / DAMPING]])
    step = np.array([[1.0, reach], [0.0, decay]]) - push @ np.array([[stiffness, velocity_gain]])
    values = np.linalg.eigvals(step)
    if stiffness == 0:
        values = np.delete(values, np.argmin(abs(values - 1)))
    return float(abs(values).max())


def topology(more: str = "", *, x: str = "0 m", count: int = 1) -> str:
    return (
        f"topology: kink\nclocks: {{tick: 1 ms}}\npeers: {{user: {{count: {count}}}}}\n"
        f"masses: {{device: {{mass: {MASS} kg, damping: {DAMPING} N*s/m, x: {x}}}}}\n"
        f"couplers: {{own: {{type: Own, flange: device, clock: tick{more}}}}}\n"
    )


def model(folder: Path, force: str, more: str = ", K: 60000 N/m", x: str = "0 m") -> apc.Model:
    return compiled(
        topology(more, x=x),
        library(folder, component("f = " + force, "flange.f = hold(f)", variables="f=N")),
    )


X = "sample(flange.x)"
FORCES = {  # the stiffness of each side of each, for K = 60 kN/m
    f"max(0, K*{X})": (0, 60e3),
    f"if {X} >= 0 then K*{X} else 0": (0, 60e3),
    f"if {X} > 0 then K*{X} else 0": (0, 60e3),
    f"abs(K*{X})": (-60e3, 60e3),
    f"sqrt((K*{X})^2)": (-60e3, 60e3),
    f"K*norm({{{X}, 2*{X}}})": (-60e3 * math.sqrt(5), 60e3 * math.sqrt(5)),
    f"max(0, K*{X}) - max(0, -K*{X})": (60e3,),  # no kink
    f"max(0, max(K*{X}, 2*K*{X}))": (0, 120e3),
    f"max(0, K*{X}) + min(0, K*{X}/3)": (20e3, 60e3),
    f"if {X} == 0 then 0 else K*{X}": (60e3,),  # equal at an instant at most
    f"max(K*{X}, K*{X})": (60e3,),
}


@pytest.mark.parametrize("force", FORCES)
def test_the_worst_side_is_the_verdict(force: str, tmp_path: Path) -> None:
    found = apc.analyze(model(tmp_path, force), certify=True)
    truths = sorted(radius(stiffness) for stiffness in FORCES[force])
    assert found.spectral_radius == pytest.approx(truths[-1], abs=1e-12)
    assert found.stable is (truths[-1] < 1)
    assert "proved" in str(found.proof)
    each = sorted(side.spectral_radius for side in found.sides)
    assert each == pytest.approx(truths if len(truths) > 1 else [], abs=1e-12)


@pytest.mark.parametrize(
    ("x", "stiffness"), [("-1e-12 m", 0), ("1e-12 m", 60e3), ("-1 mm", 0), ("1 mm", 60e3)]
)
def test_beside_a_kink_one_side_acts(x: str, stiffness: float, tmp_path: Path) -> None:
    found = apc.analyze(model(tmp_path, f"max(0, K*{X})", x=x))
    assert found.spectral_radius == pytest.approx(radius(stiffness), abs=1e-12)
    assert not found.sides


def test_a_tie_is_one_whatever_floats_round(tmp_path: Path) -> None:
    """0.1 + 0.2 − 0.3 is 0 in rationals and 5.6e-17 in floats."""
    text = component("f = max(0, K*(sample(flange.x) + a + b - c))", "flange.f = hold(f)", variables="f=N")
    text = text.replace("parameters:\n", "parameters:\n  a: {unit: m}\n  b: {unit: m}\n  c: {unit: m}\n")
    more = ", K: 60000 N/m, a: 0.1 m, b: 0.2 m, c: 0.3 m"
    found = apc.analyze(compiled(topology(more), library(tmp_path, text)))
    assert [side.spectral_radius for side in found.sides] == pytest.approx(
        [radius(0), radius(60e3)], abs=1e-12
    ) or [side.spectral_radius for side in found.sides] == pytest.approx([radius(60e3), radius(0)], abs=1e-12)


@pytest.mark.parametrize(
    ("constant", "value"),
    [
        ("atan2(1, min(1, 2))", math.pi / 4),
        ("exp(atan2(3, max(1e-9, 1e9)))", math.exp(math.atan2(3, 1e9))),
        ("sin(atan2(3, atan2(4, max(2, 1))))", math.sin(math.atan2(3, math.atan2(4, 2)))),
        ("exp(atan2(pi, sign(atan2(abs(pi), min(1e-9, 1e9)))))", math.exp(math.atan2(math.pi, 1))),
        ("atan2(exp(700), exp(-700))", math.pi / 2),
        ("cos(atan2(3, atan2(3, if 1 < 2 then 1 else 2)))", math.cos(math.atan2(3, math.atan2(3, 1)))),
        ("(if 1 < 2 then sqrt(2) else sqrt(-1))", math.sqrt(2)),
    ],
)
def test_a_choice_of_constants_is_a_number(constant: str, value: float, tmp_path: Path) -> None:
    found = apc.analyze(model(tmp_path, f"K*{X}*{constant}", ", K: 20000 N/m"))
    assert found.spectral_radius == pytest.approx(radius(20e3 * value), abs=1e-12)
    assert not found.sides


def test_a_critical_value_is_that_of_the_worse_side(tmp_path: Path) -> None:
    compiled_model = model(tmp_path, f"max(0, K*{X})", ", K: 100 N/m")
    found = apc.critical(compiled_model, "own.K")
    assert found.value is not None
    assert found.value == pytest.approx(40133.778369378, abs=1e-6)
    assert radius(found.value * (1 - 1e-9)) < 1 < radius(found.value * (1 + 1e-9))


def test_a_margin_at_a_kink_is_that_of_the_side_that_loses_stability(tmp_path: Path) -> None:
    """The free side has the larger radius, and does not depend on K; the other side decides the limit."""
    found = apc.margins(model(tmp_path, f"max(0, K*{X})", ", K: 6000 N/m"))
    (row,) = found.rows
    assert row.value is not None and not found.note
    assert row.value == pytest.approx(40133.778369378, abs=1e-5)
    assert radius(row.value * (1 - 1e-9)) < 1 < radius(row.value * (1 + 1e-9))


@pytest.mark.parametrize("gain", ["gain", "other"])
def test_sides_of_equal_slopes_part_where_a_gain_varies(gain: str, tmp_path: Path) -> None:
    """max(k x, l x) with k = l has one slope; at any other value of k or l it has two."""
    text = component(f"f = K*max(gain*{X}, other*{X})", "flange.f = hold(f)", variables="f=N")
    numbers = "parameters:\n  gain: {unit: 1, default: 1}\n  other: {unit: 1, default: 1}\n"
    text = text.replace("parameters:\n", numbers)
    model = compiled(topology(", K: 10 kN/m"), library(tmp_path, text))
    assert not apc.analyze(model).sides
    found = apc.critical(model, f"own.{gain}")
    assert found.value == pytest.approx(4.0133778369378, rel=1e-9)
    many = apc.analyze_many(model, {f"own.{gain}": [1.0, 2.0, 5.0]})
    assert many.spectral_radius == pytest.approx([radius(10e3), radius(20e3), radius(50e3)], abs=1e-12)


def test_a_side_with_a_neutral_motion_is_worse_than_a_stable_one(tmp_path: Path) -> None:
    """A wall at zero depth: a mass that moves away from it does not return."""
    found = apc.analyze(model(tmp_path, f"max(0, K*{X})", ", K: 1000 N/m"))
    assert found.verdict == "stable up to a common translation"
    assert {side.verdict for side in found.sides} == {"stable", "stable up to a common translation"}
    assert found.spectral_radius == pytest.approx(radius(0), abs=1e-12) and radius(0) < radius(1000)


def test_passive_hands_meet_the_whole_wall() -> None:
    """A wall of stiffness 0 and damping B at zero depth: b > B decides (Colgate and Schenkel), not B/2."""
    for damping, passive in ((1.9, True), (2.1, False)):
        text = (
            "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
            "masses: {device: {mass: 0.5 kg, damping: 2 N*s/m}}\n"
            f"couplers: {{it: {{type: VirtualWall, flange: device, damping: {damping} N*s/m, clock: tick,"
            " stiffness: 0 N/m}}\n"
        )
        assert apc.absolute_stability(compiled(text)).stable is passive


def test_a_force_that_jumps_has_no_linearization(tmp_path: Path) -> None:
    for force in (f"F*sign({X}/L)", f"if {X} > 0 then F else 0"):
        (line,) = messages_of(apc.analyze, model(tmp_path, force))
        assert "E808" in line
        assert "jumps" in line
        alongside = apc.analyze(model(tmp_path, force, x="1 mm"))
        assert alongside.spectral_radius == pytest.approx(radius(0), abs=1e-12)


def test_many_kinks_are_combined_or_refused_by_name(tmp_path: Path) -> None:
    """Each of several groups takes each side: 2^4 combinations are analyzed, 2^5 refused."""
    text = component(f"f = max(0, K*{X})", "flange.f = hold(f)", variables="f=N")
    shelf = library(tmp_path, text)
    for count in (2, 4, 5):
        peers = ", ".join(f"u{k}: {{count: 1, set: {{own.K: {k}0000 N/m}}}}" for k in range(1, count + 1))
        model = compiled(topology().replace("user: {count: 1}", peers), shelf)
        if count == 5:
            (line,) = messages_of(apc.analyze, model)
            assert "E808" in line
            assert "own.f" in line
            continue
        found = apc.analyze(model)
        truths = [
            max(radius(k * 1e4 * on) for k, on in enumerate(chosen, 1))
            for chosen in itertools.product((0, 1), repeat=count)
        ]
        assert sorted(side.spectral_radius for side in found.sides) == pytest.approx(
            sorted(truths), abs=1e-12
        )
        assert found.spectral_radius == pytest.approx(max(truths), abs=1e-12)


def test_peers_of_one_group_take_different_sides(tmp_path: Path) -> None:
    """Of two peers that are coupled none, one or both are on: as two groups of one peer each have it."""
    shelf = library(
        tmp_path,
        component(f"f = max(0, K*{X})", "flange.f = hold(f)", variables="f=N"),
    )
    mean = "tie: {type: AveragePosition, object: device, stiffness: 3000 N/m, clock: tick, link: lan}"
    coupled = topology("}, " + mean[:-1], count=2).replace("own: {type: Own", "own: {type: Own, K: 20000 N/m")
    coupled += "links: {lan: {clock: tick, delay: 1 ms}}\n"
    apart = coupled.replace("user: {count: 2}", "a: {count: 1}, b: {count: 1}")
    found, other = (apc.analyze(compiled(text, shelf)) for text in (coupled, apart))
    assert (len(found.sides), len(other.sides)) == (3, 4)
    assert found.spectral_radius == pytest.approx(other.spectral_radius, abs=1e-12)
    radii = [{round(side.spectral_radius, 9) for side in one.sides} for one in (found, other)]
    assert radii[0] == radii[1]
    assert len(radii[0]) == 3
    assert any("user[1]" in side.name and "user[2]" in side.name for side in found.sides)


def test_peers_of_one_group_with_numbers_of_their_own_have_kinks_of_their_own(tmp_path: Path) -> None:
    """The first peer of the group has no kink, as its stiffness is 0; the second is unstable on one side."""
    shelf = library(tmp_path, component(f"f = max(0, K*{X})", "flange.f = hold(f)", variables="f=N"))
    text = topology(count=2).replace("{count: 2}", "{count: 2, set: {own.K: [0 N/m, 60000 N/m]}}")
    found = apc.analyze(compiled(text, shelf))
    assert found.stable is False
    assert found.spectral_radius == pytest.approx(radius(60e3), abs=1e-12)
    assert [side.spectral_radius for side in found.sides] == pytest.approx(
        [radius(0), radius(60e3)], abs=1e-12
    )


def test_a_kink_for_each_of_several_senders_is_refused(tmp_path: Path) -> None:
    text = (
        "topology: three\nclocks: {tick: 1 ms}\npeers: {a: {count: 1}, b: {count: 2}}\n"
        f"masses: {{cube: {{mass: {MASS} kg, damping: {DAMPING} N*s/m}}}}\n"
        "couplers: {own: {type: Pushes, object: cube, K: 1000 N/m, clock: tick, link: lan}}\n"
        "links: {lan: {clock: tick, delay: 0 ms}}\n"
    )
    (line,) = messages_of(apc.analyze, compiled(text, library(tmp_path, EDGES)))
    assert "E808 own.f has a kink for each peer from which it receives over lan" in line


def test_a_value_at_one_point_alone_is_a_jump(tmp_path: Path) -> None:
    """At rest the force is 0, and 60 kN wherever the device moves to."""
    (line,) = messages_of(
        apc.analyze, model(tmp_path, f"if {X} == 0 then 0 else K*L", ", K: 60000 N/m, L: 1 m")
    )
    assert "E808 own.f jumps at the initial state" in line


def test_a_floor_has_a_side_before_and_behind_each_whole_number(tmp_path: Path) -> None:
    force = f"0.5*K*{X} + K*T*sample(der(flange.x))*floor({X}/L)"
    found = apc.analyze(model(tmp_path, force, ", K: 60000 N/m, T: 2 ms"))
    assert sorted(side.spectral_radius for side in found.sides) == pytest.approx(
        sorted([radius(30e3), radius(30e3, -120.0)]), abs=1e-12
    )
    (line,) = messages_of(apc.analyze, model(tmp_path, f"F*floor({X}/L)"))
    assert "jumps" in line


def radius_at_wall(stiffness: float, damping: float) -> float:
    """Return the radius in contact with a wall that damps the backward difference of the position."""
    decay = math.exp(-DAMPING / MASS * PERIOD)
    reach = (1 - decay) * MASS / DAMPING
    push = np.array([(PERIOD - reach) / DAMPING, (1 - decay) / DAMPING, 0.0])
    step = np.array([[1.0, reach, 0.0], [0.0, decay, 0.0], [1.0, 0.0, 0.0]])
    difference = damping / PERIOD
    step -= np.outer(push, [stiffness + difference, 0.0, -difference])
    return float(abs(np.linalg.eigvals(step)).max())


@pytest.mark.parametrize("stiffness", ["1000 N/m", "100 N/m", "500 kN/m"])
def test_a_critical_value_at_zero_depth_is_that_of_the_contact(stiffness: str) -> None:
    """Whatever the present stiffness: the position of the device and the wall is 7 mm, not 0."""
    damping = 0.4
    text = (
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: {MASS} kg, damping: {DAMPING} N*s/m, x: 7 mm}}}}\n"
        f"couplers: {{it: {{type: VirtualWall, flange: device, stiffness: {stiffness},"
        f" damping: {damping} N*s/m, clock: tick, position: 7 mm, x: 7 mm}}}}\n"
    )
    found = apc.critical(compiled(text), "it.stiffness")
    assert found.value is not None and found.error is not None
    assert found.error < 1e-6 * found.value
    below, above = (radius_at_wall(found.value * factor, damping) for factor in (1 - 1e-8, 1 + 1e-8))
    assert below < 1 < above


def test_sides_that_no_motion_reaches_are_left_out(tmp_path: Path) -> None:
    """Of max(0, x) and max(0, 2 x) both act or neither; with max(0, −x) one of two does."""
    for force, count in (
        (f"max(0, K*{X}) + max(0, 2*K*{X})", 2),
        (f"max(0, K*{X}) + max(0, -2*K*{X})", 2),
        (f"max(0, K*{X}) + max(0, K*T*sample(der(flange.x)))", 4),
    ):
        compiled_model = model(tmp_path, force)
        assert len(sides(numeric_model(compiled_model))) == count


def test_where_a_path_crosses_the_kink_no_mean_slope_is_used(tmp_path: Path) -> None:
    compiled_model = model(tmp_path, f"max(0, K*{X})", x="1 mm")
    many = apc.analyze_many(compiled_model, {"device.x": [-1e-3, 0.0, 1e-3]})
    assert many.spectral_radius[0] == pytest.approx(radius(0), abs=1e-12)
    assert many.spectral_radius[2] == pytest.approx(radius(60e3), abs=1e-12)
    assert math.isnan(many.spectral_radius[1]) or many.spectral_radius[1] == pytest.approx(
        radius(60e3), abs=1e-12
    )


def test_what_has_no_side_is_refused_elsewhere(tmp_path: Path) -> None:
    with pytest.raises(ApcError, match="E808"):
        apc.transparency(model(tmp_path, f"max(0, K*{X})", ", K: 100 N/m"), [5.0])


def test_a_kink_inside_a_nonlinear_loop_is_refused_and_beside_it_is_not(tmp_path: Path) -> None:
    """z + z³/L² = max(0, x): behind the kink dz/dx = 1/(1 + 3 z²/L²)."""
    loop = component("z + z^3/L^2 = max(0, flange.x)", "flange.f = K*z", variables="z:")
    shelf = library(tmp_path, loop)
    text = topology(", K: 100 N/m").replace(", clock: tick", "")
    (line,) = messages_of(apc.analyze, compiled(text, shelf))
    assert "E808" in line
    assert "nonlinear loop" in line
    behind = compiled(text.replace("x: 0 m", "x: 1 mm"), shelf)
    # s² + 20/s s + k = 0 with k = 100/s²/(1 + 3 z²), z + z³ = 1e-3: nearly critically damped.
    z = 1e-3 - 1e-9
    slowest = -10 + math.sqrt(100 - 100 / (1 + 3 * z * z))
    found = apc.analyze(behind)
    assert math.log(found.spectral_radius) / found.frame_s == pytest.approx(slowest, abs=1e-7)


EDGES = """\
component: Pushes
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {K: {unit: N/m, default: 100}, clock: clock, link: link}
variables: {f: {unit: N}}
equations:
  - f = sum(max(0, K*(sample(object.x) - others.x)))
  - object.f = hold(f)
"""


def test_a_kink_between_two_peers_is_one_of_each(tmp_path: Path) -> None:
    """Two masses at one place, each pushed back by what it is beyond the other: both, one or none acts."""
    text = (
        "topology: pair\nclocks: {tick: 1 ms}\npeers: {a: {count: 1}, b: {count: 1}}\n"
        f"masses: {{cube: {{mass: {MASS} kg, damping: {DAMPING} N*s/m}}}}\n"
        "couplers: {own: {type: Pushes, object: cube, K: 60000 N/m, clock: tick, link: lan}}\n"
        "links: {lan: {clock: tick, delay: 0 ms}}\n"
    )
    found = apc.analyze(compiled(text, library(tmp_path, EDGES)))
    rate = DAMPING / MASS
    decay = math.exp(-rate * PERIOD)
    reach = (1 - decay) / rate
    push = np.array([(PERIOD - reach) / DAMPING, (1 - decay) / DAMPING])
    truths = []
    for on_a, on_b in itertools.product((0, 1), repeat=2):
        step = np.zeros((4, 4))
        step[:2, :2] = step[2:, 2:] = [[1.0, reach], [0.0, decay]]
        step[:2, [0, 2]] -= on_a * 60e3 * np.outer(push, [1, -1])
        step[2:, [0, 2]] -= on_b * 60e3 * np.outer(push, [-1, 1])
        values = np.linalg.eigvals(step)
        truths.append(float(abs(values[abs(values - 1) > 1e-9]).max()))
    assert sorted(side.spectral_radius for side in found.sides) == pytest.approx(sorted(truths), abs=1e-9)
    assert found.spectral_radius == pytest.approx(max(truths), abs=1e-9)


def test_a_critical_delay_is_that_of_the_worse_side() -> None:
    """A wall of 1000 N/m and 0.5 N·s/m that is just touched, stepped exactly with a force that acts late."""
    mass, damping, stiffness, virtual = 0.5, 2.0, 1000.0, 0.5
    text = (
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: {mass} kg, damping: {damping} N*s/m}}}}\n"
        f"couplers: {{it: {{type: VirtualWall, flange: device, stiffness: {stiffness} N/m,"
        f" damping: {virtual} N*s/m, clock: tick}}}}\n"
    )

    def radius_at(delay: float) -> float:
        """Return the radius over (x, v, x before, forces of the three ticks before), 2 ms ≤ delay < 3 ms."""
        whole = int(delay / PERIOD)
        assert whole == 2
        step = np.zeros((6, 6))
        step[2, 0] = step[4, 3] = step[5, 4] = 1.0  # one tick older
        step[3, [0, 2]] = stiffness + virtual / PERIOD, -virtual / PERIOD
        late = delay - whole * PERIOD
        motion = np.eye(2)
        for length, force in ((late, 5), (PERIOD - late, 4)):  # of tick k − 3, then of tick k − 2
            e = math.exp(-damping / mass * length)
            coefficient = (1 - e) * mass / damping
            part = np.array([[1.0, coefficient], [0.0, e]])
            step[:2] = part @ step[:2]
            step[:2, force] -= np.array([(length - coefficient) / damping, (1 - e) / damping])
            motion = part @ motion
        step[:2, :2] = motion
        return float(abs(np.linalg.eigvals(step)).max())

    found = apc.critical(compiled(text), "it.delay")
    assert found.value is not None
    assert radius_at(found.value - 1e-9) < 1 < radius_at(found.value + 1e-9)


@pytest.mark.whole
def test_an_unstable_side_decides_a_long_frame_without_proofs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 382 ticks floats leave three of four sides undecided; the fourth is unstable, also in balls."""
    model = apc.compile(str(TOPOLOGIES / "two-users-passivity.yaml"))
    period, value = ParameterRef("haptic.period"), Fraction(1, 9425)
    changed = model_with_time(model, period, value)
    *_, inactive = sides(numeric_model(changed))
    truth = analyze(inactive.numeric, certify=True)
    assert truth.stable is False and truth.proof.bits > 0
    proofs = []
    proved = spectrum.prove
    monkeypatch.setattr(spectrum, "prove", lambda *system: proofs.append(system) or proved(*system))
    found = analyze(numeric_model(changed))
    assert found.stable is False and abs(found.spectral_radius - truth.spectral_radius) <= (
        found.spectral_radius_error + truth.spectral_radius_error
    )
    path = NominalPeriodPath(period, model, None, None, LOCATION, numeric_model(model))
    assert path.verdict_at(value).stable is False
    # Floats leave this side undecided, too, and its proof in a search would take seconds.
    assert path.verdict_at(Fraction(133, 33375)).stable is None
    assert not proofs
