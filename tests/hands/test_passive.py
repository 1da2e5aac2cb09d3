"""Every passive hand: against Colgate and Schenkel, independent numbers, hands drawn or tuned."""

from __future__ import annotations

import itertools
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.haptics.absolute_stability import AbsoluteStability, PassivityVerdict, absolute_stability
from apc.lifting.devices import with_hands
from apc.lifting.numeric_model import numeric_model
from apc.spectrum.kyp_bounds import least_real, peak_gain
from tests.topologies import AVERAGE, MESH, ROOT, TOPOLOGIES, compiled, replaced, wall
from tests.truths import LIBRARY

PULL = "coordination.stiffness"


def users(count: int, stiffness: float, text: str = AVERAGE, *changes: tuple[str, str]) -> Model:
    """Return the paper's topology of so many users."""
    own = ("count: 3", f"count: {count}"), ("stiffness: 500", f"stiffness: {stiffness}")
    return compiled(replaced(text, *own, *changes))


def sampled_wall(ticks: float, stiffness: float = 800) -> Model:
    """Return a device on a fixed spring whose force is so many ticks of 1 ms late."""
    return compiled(
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.3 kg, damping: 1 N*s/m}}\n"
        "couplers: {it: {type: SampledSpringDamper, a: device, b: ground, clock: tick, "
        f"stiffness: {stiffness} N/m, delay: {ticks} ms}}}}\n"
    )


def half_a_tick_later(ticks: int) -> float:
    """Return the damping needed where forces switch in the middle of a tick.

    By A and B in the halves of a tick, steadily, S = A + B, a hand loses b (A² + B²)/τ and gains K S ((n + ½)
    S + A): the best A = S/2 + K S τ/(4 b) leaves b/(2τ) = K (n + 1) + K² τ/(8 b).
    """
    half = 0.5e-3
    return float(np.roots([1 / (2 * half), -800 * (ticks + 1), -(800.0**2) * half / 8]).max())


@pytest.mark.parametrize(
    ("model", "needed"),
    [
        # b = K (T/2 + delay), for any delay in ticks; b > K T/2 + |B| (Colgate and Schenkel, 1997).
        *((sampled_wall(ticks), 800 * (0.5e-3 + ticks * 1e-3)) for ticks in (0, 1, 2, 5, 17)),
        *((sampled_wall(ticks + 0.5), half_a_tick_later(ticks)) for ticks in (0, 1, 4)),
        *((wall(1.0, 0.8, 0.0, 500.0, virtual), 0.25 + virtual) for virtual in (0.0, 0.1, 0.3, 0.7)),
    ],
)
def test_a_wall_needs_the_damping_of_its_closed_form(model: Model, needed: float) -> None:
    (mode,) = apc.absolute_stability(model).modes
    assert mode.needed == pytest.approx(needed, rel=1e-9)
    assert mode.passive is (needed < mode.damping)


# By an independent program: users, stiffness, needed damping of the common and the difference mode and where,
# the spectral radius with devices clamped.
@pytest.mark.parametrize(
    ("count", "text", "needed", "hertz", "radius"),
    [
        (2, AVERAGE, (1.8555596700358232, 0.0), (22.720150681607873,), 1.031814805018594),
        (
            3,
            AVERAGE,
            (1.9125555577395834, 8.540418397892944),
            (26.777314359819098, 14.895765047280076),
            0.9956095975790132,
        ),
        (3, MESH, (1.8838394321612881, 0.0), (30.21696159521839,), 1.0458005599958966),
    ],
)  # fmt: skip
def test_damping_that_an_independent_program_found(
    count: int, text: str, needed: tuple[float, float], hertz: tuple[float, ...], radius: float
) -> None:
    found = apc.absolute_stability(users(count, 500, text))
    # Of a motion that shakes with devices clamped, no damping is told.
    assert [mode.needed or 0.0 for mode in found.modes] == pytest.approx(needed, rel=1e-11)
    for mode, at in zip(found.modes, hertz, strict=False):
        assert mode.frequency_hz == pytest.approx(at, rel=1e-7)
    assert found.clamped_radius == pytest.approx(radius, abs=1e-13)
    assert found.stable is False and found.proof


def random_users(noise: np.random.Generator) -> Model:
    """Return a few users with random numbers, delays and groups."""

    def of(low: float, high: float) -> str:
        return f"{10 ** noise.uniform(low, high):.4g}"

    def late(*values: str) -> str:
        return f"delay: {noise.choice(values)} ms"

    groups = f"a: {{count: {noise.integers(2, 5)}}}"
    if noise.random() < 0.5:
        own = f"device.mass: {of(-2, 0)} kg, contact.delay: {noise.choice(['0', '1', '2'])} ms"
        groups += f"\n  b: {{count: {noise.integers(1, 3)}, set: {{{own}}}}}"
    return compiled(
        replaced(
            AVERAGE if noise.random() < 0.5 else MESH,
            ("user: {count: 3}", groups),
            ("haptic: 1 ms", f"haptic: {noise.choice(['1', '2'])} ms"),
            ("mass: 0.1 kg, damping: 5", f"mass: {of(-1.5, 0)} kg, damping: {of(0, 1.3)}"),
            ("mass: 0.6 kg, damping: 5", f"mass: {of(-1, 1)} kg, damping: {of(0, 1.5)}"),
            ("1000 N/m", f"{of(2.5, 3.2)} N/m"),
            ("500 N/m", f"{of(1.5, 2.5)} N/m"),
            ("delay: 8 ms", late("0", "3", "8", "11")),
            ("delay: 1 ms", late("0", "1", "1.5")),
            ("delay: 1 ms", late("0", "1", "3")),
        )
    )


def shaken(model: Model, hands: np.ndarray) -> bool:
    """Say whether a topology is unstable with any of these (mass, damping, stiffness) at every device."""
    names = ("hand.mass", "hand.damping", "hand.stiffness")
    many = apc.analyze_many(apc.with_hands(model, "held"), dict(zip(names, hands.T, strict=True)))
    return bool((many.stable == 0).any())


def tuned(found: AbsoluteStability) -> np.ndarray:
    """Return heavy masses on springs which sway by themselves at the frequencies told."""
    hertz = [one.frequency_hz for one in found.modes if one.passive is False and one.frequency_hz]
    each = itertools.product((1000.0, 300.0, 10.0, 1.0, 0.1), (0.7, 0.99, 1.0, 1.01), hertz)
    return np.array([(mass, 0.0, mass * (2 * np.pi * part * at) ** 2) for mass, part, at in each])


@pytest.mark.whole
def test_no_passive_hand_shakes_what_is_called_passive_and_a_tuned_one_what_is_not() -> None:
    noise, passive, tried, struck, topologies = np.random.default_rng(1), 0, 0, 0, 30
    for _ in range(topologies):
        model = random_users(noise)
        found = absolute_stability(numeric_model(model))
        assert found.stable is not None
        assert found.clamped_stable is apc.analyze(apc.with_hands(model, "clamped")).stable
        if found.stable:
            passive += 1
            assert not shaken(model, 10 ** noise.uniform(-6, [3, 4, 7], size=(20, 3)))
        elif found.worst_mode is not None and found.worst_mode.more is not None:
            tried += 1
            struck += shaken(model, tuned(found))
            # With so much more damping at each device no hand can, with less some still do.
            for part in (0.999, 1.001):
                value = found.worst_mode.damping + part * found.worst_mode.more
                more = apc.set_parameters(model, {"device.damping": f"{value!r} N*s/m"})
                assert absolute_stability(numeric_model(more)).stable is (part > 1)
    assert min(passive, tried) >= topologies // 8  # or the draws would say nothing
    assert struck >= 0.7 * tried  # some need more than a mass and a spring


def by_critical(model: Model, limit: float) -> None:
    (crossing,) = apc.critical(model, PULL, criterion="passive").crossings
    assert crossing.value == pytest.approx(limit, rel=5e-7)
    assert crossing.error < 3e-9 * limit
    assert str(crossing.proof) == "rigorous passivity bounds"


def by_certificate(model: Model, limit: float) -> None:
    for value, stable in ((limit - 1e-3, True), (limit + 1e-3, False)):
        at = apc.set_parameters(model, {PULL: f"{value!r} N/m"})
        found = absolute_stability(numeric_model(at), certify=True)
        assert (found.stable, str(found.proof)) == (
            stable,
            "proved in floating point with rigorous error bounds",
        )


def by_sweep(model: Model, limit: float) -> None:
    found = apc.sweep(model, {PULL: f"{limit - 1e-3},{limit + 1e-3} N/m"}, criterion="passive", jobs=1)
    assert found.column("verdict").tolist() == [PassivityVerdict.STABLE, PassivityVerdict.UNSTABLE]


def by_region(model: Model, limit: float) -> None:
    """Also from where nothing holds the copies, and there is no map."""
    x, y = "contact.stiffness=0 N/m:1200 N/m", f"{PULL}=0 N/m:600 N/m"
    found = apc.region(model, x=x, y=y, criterion="passive")
    sides = [found.contains(1000.0, limit + by) for by in (-1, 1)]
    assert sides == [True, False] and "any passive operator" in str(found)


@pytest.mark.few(2)
@pytest.mark.parametrize("method", [by_critical, by_certificate, by_sweep, by_region])
def test_every_way_to_ask_finds_what_an_independent_program_found(
    method: Callable[[Model, float], None],
) -> None:
    """Three users bear 458.24216 N/m with any passive hand."""
    method(users(3, 200), 458.24216)


@pytest.mark.parametrize(("count", "limit"), [(2, 233.1357), (5, 895.643)])
def test_two_and_five_users_bear_what_an_independent_program_found(count: int, limit: float) -> None:
    for part in (1 - 1e-6, 1 + 1e-6):
        found = apc.absolute_stability(users(count, 200), params={PULL: f"{part * limit!r} N/m"})
        assert found.stable is (part < 1)


@pytest.mark.parametrize(("count", "limit"), [(2, 276.5935041841296), (3, 539.93), (5, 1052.17)])
def test_clamped_devices_bear_what_an_independent_program_found(count: int, limit: float) -> None:
    found = apc.critical(apc.with_hands(users(count, 200), "clamped"), PULL)
    assert found.value == pytest.approx(limit, rel=1e-11 if count == 2 else 1e-5)
    assert "devices clamped" in str(found).splitlines()[0]


@pytest.mark.parametrize("seed", [2, 9, 23, 42])
def test_what_vanishes_slow_and_fast_has_its_extremes_between(seed: int) -> None:
    """Against 100,000 angles: a response that is 0 at both ends, as what is sent and heard alike."""
    noise = np.random.default_rng(seed)
    a = noise.normal(size=(6, 6))
    a, b = a * 0.99 / np.abs(np.linalg.eigvals(a)).max(), noise.normal(size=(6, 1))
    c = np.linalg.svd(np.hstack([np.linalg.solve(at * np.eye(6) - a, b) for at in (1, -1)]).T)[2][-1:]
    at = np.exp(1j * np.linspace(0, np.pi, 100_001))[:, None, None]
    response = (c @ np.linalg.solve(at * np.eye(6) - a, b[None] + 0j)).ravel()
    found = least_real(a, b, c, np.zeros((1, 1)), np.eye(1))[0], peak_gain(a, b, c, np.zeros((1, 1)))[0]
    assert found == pytest.approx((1 + response.real.min(), np.abs(response).max()), rel=1e-5)


def test_held_is_a_mass_a_damper_and_a_spring_and_clamped_a_very_heavy_hand() -> None:
    """(m + m_h) s² + (b + b_h) s + k_h = 0 of one device alone, over a frame of 1 ms."""
    numbers = {"hand.mass": "0.2 kg", "hand.damping": "3 N*s/m", "hand.stiffness": "250 N/m"}
    found = apc.analyze(apc.with_hands(sampled_wall(0, 0), "held"), params=numbers)
    root = np.exp(np.roots([0.5, 4.0, 250.0]) * 1e-3)[0]
    assert next(abs(one.eigenvalue) for one in found.modes) == pytest.approx(abs(root), rel=1e-13)
    # Two motions of each device are slower than anything else there is; the rest is as if it were held fast.
    slow = apc.analyze(apc.with_hands(users(3, 200), "held"), params={"hand.mass": "1e9 kg"})
    fast = apc.analyze(apc.with_hands(users(3, 200), "clamped"))
    moving, known = (
        sorted(abs(mode.eigenvalue) for mode in one.modes for _ in range(mode.multiplicity))
        for one in (slow, fast)
    )
    assert [one for one in moving if one < 0.99999][-6:] == pytest.approx(known[-6:], abs=1e-8)


def test_no_damping_helps_where_a_velocity_is_sampled() -> None:
    text = replaced(AVERAGE, ("stiffness: 1000 N/m, clock", "stiffness: 1000 N/m, damping: 2 N*s/m, clock"))
    found = absolute_stability(numeric_model(compiled(text)))
    assert found.stable is False
    assert "samples the velocity of device" in " ".join(str(found).split())


def test_no_damping_helps_where_peers_feel_each_other_otherwise_than_springs_do() -> None:
    """Each hears one other, in a circle: what devices feel at rest is no spring's, however it is weighed."""
    graph = "delay: 8 ms, graph: {arcs: [[1, 2, 1], [2, 3, 1], [3, 1, 1]]}}"
    model = users(3, 100, AVERAGE, ("delay: 8 ms}", graph))
    for damping in ("5 N*s/m", "500 N*s/m"):
        found = apc.absolute_stability(model, params={"device.damping": damping})
        assert (found.stable, found.clamped_stable) == (False, True)
        assert found.worst_mode is not None and found.worst_mode.more is None
        assert "are not conservative" in str(found)
    answer = apc.critical(model, "device.damping", criterion="passive")
    assert str(answer.verdict).startswith("unstable at every value (reason: apc analyze --hands passive)")


UNEVEN = "a: {count: 1, set: {coordination.stiffness: 50 N/m}}\n  b: {count: 3}"


@pytest.mark.whole
@pytest.mark.parametrize(
    "change", [("delay: 8 ms}", "delay: 8 ms, graph: star}"), ("user: {count: 4}", UNEVEN)]
)
def test_where_one_is_pulled_harder_than_it_pulls_hands_by_themselves_do_no_harm(
    change: tuple[str, str],
) -> None:
    """What devices feel at rest is that of springs if energies are weighed: no hand alone gets any out."""
    model = users(4, 100, AVERAGE, change)
    found = apc.absolute_stability(model)
    assert found.stable and not found.joined
    assert "independent passive operators" in " ".join(str(found).split())
    assert not shaken(model, 10 ** np.random.default_rng(3).uniform(-6, [3, 4, 7], size=(60, 3)))


@pytest.mark.whole
@pytest.mark.parametrize("file", [*LIBRARY, *(ROOT / "tests" / "hard").glob("*.yaml")], ids=str)
def test_every_topology_has_a_verdict_or_a_reason_why_not(file: Path) -> None:
    try:
        assert apc.absolute_stability(apc.compile(file)).verdict
    except ApcError as error:
        assert error.mistakes[0].code in {"E931", "E932", "E933"}


DIRECT = """\
topology: direct
clocks: {haptic: 1 ms, network: 8 ms}
peers: {master: {count: 1}, slave: {count: 1, set: {device.mass: 0.6 kg, device.damping: 10 N*s/m}}}
masses: {device: {mass: 0.1 kg, damping: 2 N*s/m}}
couplers:
  coordination:
    {type: AveragePosition, object: device, stiffness: 50 N/m, clock: haptic, delay: 1 ms, link: wan}
links: {wan: {clock: network, delay: 16 ms}}
"""


def test_a_star_of_unlike_users_is_passive_up_to_what_rounding_hides_of_its_symmetry() -> None:
    """Its hub counts for as many as hear it; 3.0369563 N*s/m could be spared, by an independent program."""
    text = replaced(
        AVERAGE,
        ("haptic: 1 ms", "haptic: 1 ms\n  fast: {period: 1/2 ms, phase: 1/6 ms}"),
        ("network: 8 ms", "network: 3 ms"),
        (
            "user: {count: 3}",
            "a: {count: 2}\n  b: {count: 2, set: {device.mass: 0.2258 kg, "
            "contact.stiffness: 898.1 N/m, cube.damping: 1.075 N*s/m}}",
        ),
        ("mass: 0.1 kg, damping: 5", "mass: 0.09918 kg, damping: 3.279"),
        ("mass: 0.6 kg, damping: 5", "mass: 1.577 kg, damping: 10.23"),
        ("1000 N/m, clock: haptic, delay: 1 ms", "493 N/m, clock: fast"),
        ("500 N/m, clock: haptic, delay: 1 ms", "57.48 N/m, damping: 2.065 N*s/m, clock: haptic"),
        ("delay: 8 ms", "delay: 3 ms, graph: star"),
    )
    found = absolute_stability(numeric_model(compiled(text)))
    assert found.stable and found.worst_mode is not None
    assert found.worst_mode.more == pytest.approx(-3.036956311616, rel=1e-9)


def test_two_devices_coupled_directly_are_held_each_at_its_only_mass() -> None:
    """Slow motions need (b₁ − K d)(b₂ − K d) ≥ (K D)², own forces d = 1.5 ms late, the other's D = 21 ms."""
    model = compiled(DIRECT)
    found = apc.critical(model, PULL, criterion="passive").value
    slow = float(np.roots([1.5e-3**2 - 21e-3**2, -12 * 1.5e-3, 20]).max())
    assert found is not None and 0.99 * slow < found <= slow
    below = apc.set_parameters(model, {PULL: f"{0.99 * found!r} N/m"})
    assert not shaken(below, 10 ** np.random.default_rng(3).uniform(-6, [3, 4, 7], size=(100, 3)))
    assert apc.transparency(below, [0.01]).low_frequency.damping > 12


def test_in_a_plane_every_direction_is_held() -> None:
    """Both axes of the paper's topology in a plane are the line's, which don't act on one another."""
    plane, line = apc.compile(TOPOLOGIES / "planar-users.yaml"), apc.absolute_stability(users(3, 500))
    found = apc.absolute_stability(plane)
    assert found.stable is line.stable and found.clamped_radius == pytest.approx(line.clamped_radius)
    for mode, own in zip(found.modes, line.modes * 2, strict=True):
        assert mode.name[:-6] == own.name and mode.needed == pytest.approx(own.needed, rel=1e-9)
    by_critical(plane, 458.24216)


def test_a_server_without_a_device_is_not_held() -> None:
    model = apc.compile(TOPOLOGIES / "client-server.yaml")
    found = apc.critical(model, "contact.stiffness", criterion="passive").value
    assert found is not None
    hands = 10 ** np.random.default_rng(3).uniform(-6, [3, 4, 7], size=(100, 3))
    for part in (0.99, 1.01):
        at = apc.set_parameters(model, {"contact.stiffness": f"{part * found!r} N/m"})
        reported = absolute_stability(numeric_model(at))
        assert reported.stable is (part < 1)
        assert shaken(at, hands if reported.stable else tuned(reported)) is (part > 1)


@pytest.mark.parametrize("name", ["lifted-box", "star-lecture"])
def test_in_the_place_of_a_topologies_own_arms_stands_any_passive_hand(name: str) -> None:
    text = (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")
    bare = re.sub(r"^hands:.*\n(  .*\n)+|, arm.stiffness: 400 N/m", "", text, flags=re.MULTILINE)
    assert bare != text
    found, alone = (apc.absolute_stability(compiled(one)) for one in (text, bare))
    assert (found.modes, found.verdict) == (alone.modes, alone.verdict)
    assert found.limitations[0].endswith("replaced by any passive operator")


def test_what_is_not_judged_is_refused_by_name() -> None:
    text = AVERAGE + "hands: {grip: {type: SpringDamperArm, flange: device, stiffness: 100 N/m}}\n"
    with pytest.raises(ApcError, match=r"E932.*grip"):
        apc.with_hands(compiled(text), "held")
    with pytest.raises(ApcError, match="E930"):
        apc.with_hands(compiled(AVERAGE), "claped")
    text = replaced(AVERAGE, ("type: Sampled", "type: "), ("N/m, clock: haptic, delay: 1 ms}", "N/m}"))
    with pytest.raises(ApcError, match=r"E933.*cube"):
        apc.absolute_stability(compiled(text))
    mesh = absolute_stability(numeric_model(compiled(MESH)), certify=True)
    assert str(mesh.proof).startswith("unstable with clamped devices: proved unstable with ")


def test_contacts_that_hands_may_close_are_named() -> None:
    """A wall that the device starts beside decides nothing, and the answer says so first."""
    found = apc.absolute_stability(
        compiled(
            "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
            "masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}\n"
            "couplers:\n  wall: {type: VirtualWall, flange: device, stiffness: 20000 N/m, clock: tick}\n"
            "hands: {push: {type: ConstantForce, flange: device, force: 1 N}}\n"
        )
    )
    assert (
        found.limitations[-1].startswith("excluded: opening and closing of contacts (wall.push)")
        and "initial state" in found.limitations[-1]
    )


@pytest.mark.whole
def test_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    topology = str(TOPOLOGIES / "three-users-average.yaml")

    def printed(command: str, *words: str, code: int = 0) -> str:
        assert run([*command.split(), topology, *words]) == code
        return "".join(capsys.readouterr())

    document = json.loads(printed("analyze", "--hands", "passive", "--json"))
    assert (document["hands"], document["stable"]) == ("passive", False)
    assert document["modes"][1]["damping_needed"] == pytest.approx(8.540418397892944, rel=1e-11)
    assert "devices clamped: stable" in printed("analyze", "--hands", "clamped")
    for words, why in (
        (["passive", "--limit-cycle"], "E930"),
        (["passive", "--box", "contact.stiffness=±1%"], "E930 with passive operators only a range"),
        ([""], "E930 no hands given (free, clamped,"),
        (["claped"], "clamped"),
    ):
        assert why in printed("analyze", "--hands", *words, code=1)
    typical = "note: StylusArmForward: typical values are used"
    requested = ("critical contact.stiffness", "--upper", "900 N/m", "--hands")
    assert typical in printed(*requested, "StylusArmForward") and typical not in printed(
        *requested, "clamped"
    )
    found = apc.critical(topology, PULL, lower="600 N/m", criterion="passive")
    assert (found.value, str(found.verdict)) == (None, "unstable at every evaluated value")


@pytest.mark.needs_extension("event_order", "parameter_boxes")
def test_held_hands_without_a_number_are_asked_for_one_and_the_fix_runs(
    capsys: pytest.CaptureFixture[str],
) -> None:
    topology = str(TOPOLOGIES / "three-users-average.yaml")
    for command in ("analyze", "critical contact.stiffness", "compare"):
        assert run([*command.split(), topology, "--hands", "held", "--json"]) == 1
        message = capsys.readouterr().err
        assert "E930" in message and "hand.mass, hand.damping, hand.stiffness" in " ".join(message.split())
    fix = shlex.split(" ".join(message.split()).rpartition("Try: ")[2])
    assert run(["analyze", topology, *fix, "--json"]) == 0
    # At rest each device holds to the ground by its hand: nothing moves freely any more.
    assert json.loads(capsys.readouterr().out)["verdict"] == "stable"
    for words in (["--set", "hand.damping=0 N*s/m"], ["--box", "hand.mass=0 kg:0.1 kg"]):
        assert run(["analyze", topology, "--hands", "held", *words, "--json"]) == 0
    assert run(["critical", "hand.mass", topology, "--hands", "held", "--upper", "1 kg", "--json"]) == 0


def test_no_model_has_every_passive_hand() -> None:
    with pytest.raises(
        apc.ApcError, match=r"E930 passive hands are a set .*Try: apc\.absolute_stability\(model\)"
    ):
        apc.with_hands(users(3, 200), "passive")


WALL = """\
topology: wall
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.5 kg, damping: 2 N*s/m, x: START}}
couplers:
  wall: {type: VirtualWall, flange: device, stiffness: 1000 N/m, damping: DAMPING, clock: haptic, x: START}
"""


def textbook(damping: str, start: str = "1 mm") -> Model:
    """Return a sampled wall before a device of 2 N·s/m, which is passive below K = 2 (b − |B|)/T."""
    return compiled(WALL.replace("DAMPING", damping).replace("START", start))


@pytest.mark.parametrize(("damping", "truth"), [("0 N*s/m", 4000.0), ("0.5 N*s/m", 3000.0)])
def test_the_critical_value_of_the_textbook_wall(damping: str, truth: float) -> None:
    found = apc.critical(textbook(damping), "wall.stiffness", criterion="passive")
    assert found.value == pytest.approx(truth, rel=1e-9) and (found.error or 1) < 1e-8 * truth


def test_a_critical_value_on_an_end_of_a_cell_is_held() -> None:
    # K = 2 b/T = 10,000 N/m is one of the values scanned.
    values = {"device.mass": "0.1 kg", "device.damping": "5 N*s/m"}
    found = apc.critical(textbook("0 N*s/m"), "wall.stiffness", params=values, criterion="passive")
    assert found.value == pytest.approx(1e4, rel=1e-9) and (found.error or 1) < 1e-2


@pytest.mark.parametrize("damping", ["2 N*s/m", "3 N*s/m", "20 N*s/m"])
def test_a_wall_of_more_damping_than_its_device_is_never_passive(damping: str) -> None:
    found = apc.critical(textbook(damping), "wall.stiffness", criterion="passive")
    assert (found.value, found.crossings) == (None, ())
    assert str(found.verdict) == "unstable at every evaluated value"


def test_a_wall_that_is_only_touched_has_the_critical_value_of_the_wall_pressed() -> None:
    """The start is at a kink: the side in contact decides, b = K T/2 + B."""
    found = apc.critical(textbook("0.5 N*s/m", "0 m"), "wall.stiffness", criterion="passive")
    assert found.value == pytest.approx(3000, abs=1e-3)


TWO_MASSES = """\
topology: two
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 1e6 kg, damping: 1e6 N*s/m}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic}
"""


@pytest.mark.parametrize("hands", ["passive", "clamped", "held"])
def test_what_a_hand_holds_is_named_by_the_line_of_the_message(hands: str, tmp_path: Path) -> None:
    """The line, pasted, is understood; a cube that does not move is a wall, which needs K T/2 of damping."""
    path = tmp_path / "two.yaml"
    path.write_text(TWO_MASSES, encoding="utf-8")
    with pytest.raises(ApcError, match=r"E931 .*the device of \w+ is not unique: device, cube") as refused:
        with_hands(apc.compile(path), hands) if hands != "passive" else apc.absolute_stability(
            apc.compile(path)
        )
    fix = refused.value.mistakes[0].fix
    assert fix == "hands: {grip: {type: ConstantForce, flange: device, force: 0 N}}"
    path.write_text(f"{TWO_MASSES}{fix}\n", encoding="utf-8")
    model = apc.compile(path)
    assert with_hands(model, hands).peer_types
    (mode,) = apc.absolute_stability(model).modes
    assert mode.needed == pytest.approx(1000 * 1e-3 / 2, rel=1e-4)


def test_a_hand_holds_what_has_a_grip() -> None:
    """A Falcon's mass and damping are those of the device above."""
    falcon = replaced(TWO_MASSES, ("device: {mass: 0.1 kg, damping: 5 N*s/m}", "device: {type: Falcon}"))
    (mode,) = apc.absolute_stability(compiled(falcon)).modes
    assert mode.needed == pytest.approx(1000 * 1e-3 / 2, rel=1e-4)


def test_the_named_part_is_held_where_it_is(tmp_path: Path) -> None:
    """A group without the part is left out of the entry."""
    text = replaced(TWO_MASSES, ("{user: {count: 1}}", "{user: {count: 1}, server: {count: 1}}"))
    text = text.replace("{mass", "{at: [user], mass").replace("{type: S", "{at: [user], type: S")
    own = "type: SampledSpringDamper, a: ball, b: ground, stiffness: 1 N/m, clock: haptic"
    text += f"  spring: {{at: [server], {own}}}\n"
    text = text.replace("masses:\n", "masses:\n  ball: {at: [server], mass: 1 kg}\n")
    with pytest.raises(ApcError, match="E931") as refused:
        apc.absolute_stability(compiled(text))
    fix = refused.value.mistakes[0].fix
    assert fix == "hands: {grip: {type: ConstantForce, flange: device, force: 0 N, at: [user]}}"
    assert apc.absolute_stability(compiled(f"{text}{fix}\n")).verdict


@pytest.mark.parametrize("name", ["teleoperation-pair", "three-users-average", "stiff-wall-passivity"])
def test_the_table_of_modes_has_numbers_below_each_heading(name: str) -> None:
    """Required damping is none below 0, the reserve is what is left of the devices', and no cell is empty."""
    found = apc.absolute_stability(TOPOLOGIES / f"{name}.yaml")
    lines = str(found).splitlines()
    assert all(len(line) <= 80 for line in lines)
    first = next(k for k, line in enumerate(lines) if line.split()[:3] == ["mode", "damping", "required"])
    for mode, line in zip(found.modes, lines[first + 1 :][: len(found.modes)], strict=True):
        cells = re.split(r" {2,}", line.strip())
        assert len(cells) == 7
        damping, required, reserve = (np.nan if cell == "–" else float(cell) for cell in cells[1:4])
        assert np.isnan(required) or required >= 0
        assert mode.more is not None and reserve == pytest.approx(-mode.more, rel=1e-3)
        if not np.isnan(damping) and required > 0:
            assert damping - required == pytest.approx(reserve, rel=1e-3, abs=1e-3)


def test_a_long_headline_fits_a_terminal() -> None:
    found = apc.analyze(TOPOLOGIES / "carried-beam.yaml")
    assert found.linearized and all(len(line) <= 80 for line in str(found).splitlines())
