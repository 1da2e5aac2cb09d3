"""What a hand feels: against a program that plays it tick by tick, closed forms and published numbers."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import mpmath
import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import prepare
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.frame.devices import devices_of
from apc.hands.feel import feel
from tests.handled import Users, response
from tests.topologies import AVERAGE, MESH, ONE_MASS, SCENES, compiled, replaced

# Ten frequencies in Hz, from where hands move objects to where they hold them still.
TEN = (0.7, 1.3, 2.9, 5.1, 9.7, 14.3, 21.7, 33.1, 47.9, 58.3)


def users(count: int, stiffness: float) -> str:
    """Return the paper's scene of so many users."""
    pairs = ("count: 3", f"count: {count}"), ("stiffness: 500", f"stiffness: {stiffness}")
    return replaced(AVERAGE, *pairs)


@pytest.mark.parametrize("count", [2, 3])
def test_responses_agree_with_a_force_played_tick_by_tick(count: int) -> None:
    found = feel(compiled(users(count, 500)), TEN, quick=True)
    for place, hertz in enumerate(TEN):
        here, there, apart = response(Users(count, 500.0), hertz)
        # What has not died out after 700 frames is 0.957^700, the spectral radius being that.
        assert found.impedance[place] == pytest.approx(1 / here, rel=1e-9)
        assert found.transmitted_admittance[place] == pytest.approx(there, rel=1e-7)
        assert found.error_per_force[place] == pytest.approx(apart, rel=1e-8)
    assert (found.bound < 1e-7).all()


def test_five_in_a_ring_feel_their_neighbours() -> None:
    text = replaced(users(5, 300), ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))
    found = feel(compiled(text), TEN[2::3], quick=True)
    for place, hertz in enumerate(TEN[2::3]):
        here, there, apart = response(Users(5, 300.0, ring=True), hertz)
        assert found.impedance[place] == pytest.approx(1 / here, rel=1e-8)
        assert found.transmitted_admittance[place] == pytest.approx(there, rel=1e-6)
        assert found.error_per_force[place] == pytest.approx(apart, rel=1e-7)


def test_a_lone_mass_feels_like_itself() -> None:
    """No tick, no network: Z = b + jωm."""
    text = ONE_MASS + (
        "clocks: {tick: 1 ms}\n"
        "couplers: {idle: {type: SampledSpringDamper, a: device, b: ground, stiffness: 0 N/m, clock: tick}}\n"
    )
    found = feel(compiled(text), [0.5, 50.0, 400.0])
    expected = 3 + 2j * np.pi * found.frequency_hz * 2
    np.testing.assert_allclose(found.impedance, expected, rtol=1e-13)
    assert (found.alias < 1e-13).all()
    assert found.low_frequency is not None
    slow = found.low_frequency
    assert slow.mass == pytest.approx(2, abs=slow.errors[0])
    assert slow.damping == pytest.approx(3, abs=slow.errors[1])
    assert slow.stiffness == pytest.approx(0, abs=slow.errors[2])
    # |v/F| = 1/|b + jωm| is largest at rest, where it is 1/b.
    (peak,) = found.hinf
    assert peak.sampled_data.norm == pytest.approx(1 / 3, rel=1e-9)
    # Each tick's 1 N rms: v⁺ = e^{−bT/m} v + (1 − e^{−bT/m})/b F, whose variance is (1 − a)²/(b²(1 − a²)).
    with mpmath.workdps(50):
        decay = mpmath.exp(mpmath.mpf(-3) / 2000)
        truth = (1 - decay) / 3 / mpmath.sqrt(1 - decay**2)
        hands = next(one for one in found.h2 if one.source == "hands")
        assert hands.velocity_m_s is not None and hands.errors[1] is not None
        assert abs(mpmath.mpf(hands.velocity_m_s) - truth) <= hands.errors[1] < 1e-11 * truth
    assert (hands.error_m, hands.errors[0]) == (None, None)


# Made by an independent program, which follows harmonics and takes norms by bisection and fast sampling:
# impedance at 1 Hz and 20 Hz; at 20 Hz velocity arriving, error (mm), alias; H∞ of velocity (common,
# difference) and of the error, on ticks and sampled-data, H2 of the error.
PUBLISHED = (
    (
        2,
        31.421742168544554 - 3.3876062890766288j,
        2.8592040243375085 + 2.501112875788781j,
        0.0021133002420831992 + 0.023942180696575152j,
        0.5703125704277588 + 0.35294215416033314j,
        5.694904214390054e-06,
        (0.299461433180675, 0.4729889334388661, 0.0044765666646593835),
        (0.2992905102319901, 0.47273015454639244, 0.004476973205710274),
        0.0005390507317470898,
    ),
    (
        3,
        39.655654182833935 - 15.869521752731785j,
        2.453730629411063 + 0.3608592678348613j,
        -0.07244933505096336 + 0.01377432068631149j,
        0.6092476744197959 + 2.1403332416937313j,
        1.7167909309578182e-05,
        (0.2572214868033621, 0.4963166390275006, 0.0030187083157676695),
        (0.2570494795651829, 0.49599920916108703, 0.0030189582169522842),
        0.0004575212195884317,
    ),
)


@pytest.mark.parametrize("known", PUBLISHED)
def test_numbers_of_an_independent_program(known: tuple[object, ...]) -> None:
    count, at_one, at_twenty, arrives, apart, alias, ticks, sampled, rms = known
    found = feel(compiled(users(int(str(count)), 500)), [1.0, 20.0])
    assert found.impedance[0] == pytest.approx(at_one, rel=1e-11)
    assert found.impedance[1] == pytest.approx(at_twenty, rel=1e-11)
    assert found.transmitted_admittance[1] == pytest.approx(arrives, rel=1e-11)
    assert found.error_per_force[1] * 1e3 == pytest.approx(apart, rel=1e-11)
    assert found.alias[1] == pytest.approx(alias, rel=1e-8)
    # Its norms are good to 3e-10 (on ticks) and 5e-10 of themselves.
    assert [one.on_ticks.norm for one in found.hinf] == pytest.approx(ticks, rel=1e-9)
    assert [one.sampled_data.norm for one in found.hinf] == pytest.approx(sampled, rel=1e-9)
    assert found.h2[0].error_m == pytest.approx(rms, rel=1e-12)
    off = found.h2[0].errors[0]
    assert off is not None and abs(found.h2[0].error_m - float(str(rms))) <= off < 1e-10 * float(str(rms))


@pytest.mark.parametrize(("text", "others"), [(AVERAGE, 1), (MESH, 2)])
def test_a_network_feels_viscous(text: str, others: int) -> None:
    """Copies lag what they hear by half the network's hold and its delay: K ((T_n − T_c)/2 + T_d) of damping.

    A hand that moves slowly moves all three users' devices and copies, of 5 N·s/m each, and three networks.
    """
    found = feel(compiled(text), [1.0]).low_frequency
    assert found is not None
    expected = 3 * (5 + 5 + others * 500 * ((8e-3 - 1e-3) / 2 + 8e-3))
    assert found.damping == pytest.approx(expected, rel=2e-3)


def test_a_million_users_and_groups_are_as_right_as_all_peers_in_one() -> None:
    """Two groups of two: classes and differences against one loop of all four, on the same graph as arcs."""
    groups = replaced(
        AVERAGE, ("user: {count: 3}", "left: {count: 2, set: {device.mass: 0.2 kg}}\n  right: {count: 2}")
    )
    arcs = replaced(
        groups,
        (
            "delay: 8 ms}",
            "delay: 8 ms, graph: {edges: [[1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]}}",
        ),
    )
    for at, between in (("left[1]", "left[2]"), ("left[2]", "right[1]"), ("right[1]", "left[1]")):
        one = feel(compiled(groups), [1.0, 17.0], at=at, between=between, quick=True)
        other = feel(compiled(arcs), [1.0, 17.0], at=at, between=between, quick=True)
        np.testing.assert_allclose(one.impedance, other.impedance, rtol=1e-10)
        np.testing.assert_allclose(one.transmitted_admittance, other.transmitted_admittance, rtol=1e-9)
        np.testing.assert_allclose(one.error_per_force, other.error_per_force, rtol=1e-10)
    many = feel(compiled(users(1_000_000, 500)), [1.0], quick=True)
    assert abs(many.transmitted_admittance[0]) < 1e-5
    assert many.bound[0] < 1e-4


def test_few_frequencies_at_once_are_answered_as_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    system = compiled(AVERAGE)
    whole = repr(feel(system, [0.5, 5.0, 50.0]))  # some numbers of it are none, and equal nothing
    monkeypatch.setattr("apc.hands.response.TOGETHER", 1)
    assert repr(feel(system, [0.5, 5.0, 50.0])) == whole


def test_multiples_of_the_frame_rate_are_as_their_neighbours() -> None:
    """The scene may rest anywhere: e^{sT} = 1 is a pole of its frames, and none of its responses."""
    system = compiled(AVERAGE)
    for rate in (125.0, 250.0):
        found = feel(system, [rate, rate - 0.01, rate + 0.01], quick=True)
        assert np.isfinite(found.bound).all()
        for name, bound in (
            ("impedance", found.bound),
            ("transmitted_admittance", found.transmitted_bound),
            ("error_per_force", found.error_bound),
        ):
            one, *two = getattr(found, name)
            assert abs(one - np.mean(two)) < abs(one) * (1e-6 + bound.max())


def test_a_push_at_a_device_moves_a_copy_as_one_there_moves_the_device() -> None:
    """A copy is a third of the mass of all, and what holds it to its device pulls both alike."""
    text = replaced(AVERAGE, ("stiffness: 500", "stiffness: 0"))
    text = text.replace("type: SampledSpringDamper, ", "type: SpringDamper, ").replace(
        "stiffness: 1000 N/m, clock: haptic, delay: 1 ms", "stiffness: 1000 N/m"
    )
    system = compiled(text)
    ends = "user[1].device", "user[1].cube"
    there, back = (feel(system, [1.0, 7.0], at=a, between=b, quick=True) for a, b in (ends, ends[::-1]))
    assert (there.between, back.between) == ("user[1].cube", "user[1].device")
    np.testing.assert_allclose(there.transmitted_admittance, back.transmitted_admittance, rtol=1e-9)
    s = 2j * np.pi * np.array([1.0, 7.0])
    device, copy, spring = 0.1 * s + 5, 0.2 * s + 5, 1000 / s
    np.testing.assert_allclose(back.impedance, copy + device * spring / (device + spring), rtol=1e-9)
    np.testing.assert_allclose(
        there.transmitted_admittance, spring / (device * copy + spring * (device + copy)), rtol=1e-9
    )


def test_an_advice_about_a_name_keeps_what_was_right_of_it() -> None:
    system = compiled(AVERAGE)
    with pytest.raises(ApcError, match=r'--at "user\[3\].device"'):
        feel(system, [1.0], at="user[4].device")
    with pytest.raises(ApcError, match=r'--at "user\[2\].device"'):
        feel(system, [1.0], at="usr[2].device")


def test_noise_of_sensors_is_that_of_ticks_played() -> None:
    """White noise on samples: 4,000 frames of two users played, whose rms is known to some 3 %."""
    system = compiled(users(2, 500))
    (_, sensors) = feel(system, [1.0]).h2
    told = Users(2, 500.0)
    a, b, _ = told.equations
    from scipy.linalg import expm

    step = expm(np.block([[a, b], [np.zeros((2, 6))]]) * told.tick)[:4]
    random = np.random.default_rng(1)
    z, contact, pull = np.zeros((2, 4)), np.zeros(2), np.zeros(2)
    packets = [np.zeros(2)] * 2
    squares = []
    for _ in range(4000):
        packets = [z[:, 2].copy(), packets[0]]
        for _ in range(8):
            squares.append((z[0, 2] - z[1, 2]) ** 2)
            acting, pulling = contact, pull
            contact = told.contact * (z[:, 0] + random.standard_normal(2) - z[:, 2])
            pull = told.coupling * (packets[1][::-1] - z[:, 2])
            z = np.column_stack([z, acting, pulling]) @ step.T
    assert sensors.error_m == pytest.approx(math.sqrt(np.mean(squares)), rel=0.05)


# Of hands and of sensors, at the first of either group: error and velocity.
LATE = (
    (0.0006186312153860953, 0.024083674107722355),
    (0.7540385753605653, 47.12558066384142),
    (0.0005761712228761279, 0.03485259984618143),
    (0.41276535974762935, 51.980325413245716),
)


def test_noise_of_groups_whose_forces_switch_at_other_times() -> None:
    """By an independent program, which adds up the answers to each tick's noise."""
    late = "contact.delay: 1.5 ms, device.mass: 0.2 kg"
    text = replaced(
        AVERAGE,
        ("stiffness: 500", "stiffness: 200"),
        ("user: {count: 3}", f"left: {{count: 2, set: {{{late}}}}}\n  right: {{count: 2}}"),
    )
    for at, known in (("left[1]", LATE[:2]), ("right[1]", LATE[2:])):
        found = feel(compiled(text), [1.0], at=at).h2
        for one, (error, velocity) in zip(found, known, strict=True):
            assert one.error_m == pytest.approx(error, rel=1e-8)
            assert one.velocity_m_s == pytest.approx(velocity, rel=1e-8)


def test_an_unstable_scene_has_no_response_in_time_but_its_map_has_one(tmp_path: Path) -> None:
    system = compiled(users(3, 1200))
    with pytest.raises(ApcError, match="E934"):
        feel(system, [1.0])
    found = feel(system, [1.0], unstable=True)
    assert found.notes
    assert not found.hinf
    below = feel(compiled(users(3, 1090)), [1.0])
    assert abs(found.impedance[0] / below.impedance[0] - 1) < 0.2


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"frequencies": [501.0]}, "E935"),
        ({"frequencies": [0.0]}, "E935"),
        ({"frequencies": []}, "E935"),
        ({"frequencies": [math.nan]}, "E935"),
        ({"frequencies": [1.0], "at": "nobody[1]"}, "E936"),
        ({"frequencies": [1.0], "at": "user[4]"}, "E936"),
        ({"frequencies": [1.0], "at": "user[0].device"}, "E936"),
        ({"frequencies": [1.0], "at": "user[1].cub"}, "E936"),
        ({"frequencies": [1.0], "at": "contact"}, "E936"),
    ],
)
def test_what_can_t_be_felt_is_refused(options: dict[str, object], code: str) -> None:
    with pytest.raises(ApcError, match=code):
        feel(compiled(AVERAGE), **options)  # type: ignore[arg-type] # of several kinds


def test_a_scene_in_which_nothing_ticks_is_refused_by_name() -> None:
    with pytest.raises(ApcError) as caught:
        feel(compiled(ONE_MASS), [1.0])
    assert str(caught.value) == (
        "scene.yaml: E935 the scene has nothing that ticks, and what is felt is told of samples and "
        "held forces. Write: a coupler with a clock, as SampledSpringDamper"
    )


def test_a_peer_without_a_device_is_told_so() -> None:
    text = "topology: bare\nclocks: {tick: 8 ms, fast: 1 ms}\npeers: {user: {count: 2}}\n" + (
        "masses: {cube: {mass: 1 kg, damping: 1 N*s/m, shared: true}}\n"
        "couplers: {c: {type: AveragePosition, object: cube, stiffness: 9 N/m, clock: fast, link: lan}}\n"
        "links: {lan: {clock: tick, delay: 8 ms}}\n"
    )
    with pytest.raises(ApcError, match="E931"):
        feel(compiled(text), [1.0])
    found = feel(compiled(text), [1.0], at="user[1].cube")  # but a hand may hold the object itself
    assert found.at == "user[1].cube"


def test_the_command_line_says_what_python_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "three.yaml"
    scene.write_text(AVERAGE, encoding="utf-8")
    words = [
        "feel",
        "three.yaml",
        "--between",
        "user[1].device:user[3].device",
        "--frequencies",
        "1 Hz, 5 Hz",
    ]
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = apc.feel(str(scene), [1.0, 5.0], between="user[3]")
    assert document["frequency_hz"] == [1.0, 5.0]
    assert complex(*document["impedance"][1]) == found.impedance[1]
    assert document["between"] == "user[3].device"
    assert document["low_frequency"]["damping"] == pytest.approx(47.25, rel=1e-3)
    assert set(document) >= {
        "at",
        "transmitted_admittance",
        "error_per_force",
        "alias",
        "bound",
        "hinf",
        "h2",
    }
    assert run([*words, "--out", "table.csv"]) == 0
    text = capsys.readouterr().out
    assert all(len(line) <= 80 for line in text.splitlines())
    rows = Path("table.csv").read_text(encoding="utf-8").splitlines()
    assert float(rows[2].split(",")[1]) == found.impedance[1].real
    assert run(["feel", "three.yaml", "--to", "600 Hz"]) == 1
    assert "E935" in capsys.readouterr().err
    assert run(["feel", "three.yaml", "--from", "2 Hz", "--to", "1 Hz"]) == 1
    assert "E935" in capsys.readouterr().err
    assert run(["feel", "three.yaml", "--out", "bode.txt"]) == 1
    assert "E878" in capsys.readouterr().err
    assert run(["feel", "three.yaml", "--out", "-"]) == 1
    assert "got none. Write: --out /dev/stdout\n" in capsys.readouterr().err
    for words_too in (["--from", "1 Hz"], ["--to", "9 Hz", "--points", "3"]):
        assert run(["feel", "three.yaml", "--frequencies", "1 Hz", *words_too]) == 2
        named = " or ".join(words_too[::2])
        assert f"names every frequency there is: no {named} with it" in capsys.readouterr().err
    assert run(["feel", "three.yaml", "--at", "user[3]", "--between", "user[1]:user[2]"]) == 2
    assert run(["feel", "three.yaml", "--nyquist", "--out", "table.csv"]) == 2
    capsys.readouterr()
    assert run(["feel", "three.yaml", "--frequencies", "1 Hz", "--set", "haptic.phase=0.3 ms"]) == 0
    assert "noise" in capsys.readouterr().out.splitlines()[1]


def test_lost_packets_are_left_out_and_that_is_said_first() -> None:
    system = apc.compile(SCENES / "lossy-average.yaml")
    found = feel(system, [1.0], quick=True)
    assert "packet loss" in str(found).splitlines()[1]
    assert prepare(system) is not None


RING = replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))


@pytest.mark.parametrize(("text", "share"), [(AVERAGE, 1), (MESH, 2), (RING, 2)])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_what_the_network_adds_to_damping_is_what_dampers_lack(text: str, share: int, count: int) -> None:
    """Each user has 5 N·s/m at the device and 5 at the copy; K follows from who is heard: 150 N/m each.

    The formula is the first order in the age of what is heard; the rest is the order beyond, some 0.3 %.
    """
    system = compiled(replaced(text, ("count: 3", f"count: {count}"), ("stiffness: 500", "stiffness: 150")))
    found = feel(system, [1.0])
    assert found.low_frequency is not None
    assert found.network_viscosity is not None
    network, off = found.network_viscosity.network, found.network_viscosity.error
    assert abs(found.low_frequency.damping - 10.0 * count - network) <= off + found.low_frequency.errors[1]
    heard = 1 if share == 1 else min(2, count - 1) if text == RING else count - 1
    formula = count * 150.0 * heard * ((0.008 - 0.001) / 2 + 0.008)
    assert found.network_viscosity.formula == pytest.approx(formula, rel=1e-12)
    assert network == pytest.approx(formula, rel=0.02)


def test_what_arms_hold_has_no_viscosity_by_the_formula() -> None:
    star = compile_topology(SCENES / "star-lecture.yaml")
    found = feel(star, [1.0]).network_viscosity
    assert found is not None
    assert found.formula is None
    mixed = compile_topology(SCENES / "mixed-clocks.yaml")
    assert feel(mixed, [1.0]).network_viscosity is None


def test_in_a_plane_a_hand_is_along_an_axis_and_feels_what_it_feels_on_a_line() -> None:
    """Along each axis the scene is that on the line: the same impedance, arrival and error of copies."""
    plane = compiled((SCENES / "planar-users.yaml").read_text(encoding="utf-8").partition("\n")[2])
    line, at = feel(compiled(AVERAGE), [1.0, 10.0], quick=True), "user[1].device"
    for axis in ("x[1]", "x[2]"):
        found = feel(plane, [1.0, 10.0], at=f"{at}.{axis}", quick=True)
        assert (found.at, found.between, found.copy) == (f"{at}.{axis}", f"user[2].device.{axis}", "cube")
        assert found.impedance == pytest.approx(line.impedance, rel=1e-9)
        assert found.transmitted_admittance == pytest.approx(line.transmitted_admittance, rel=1e-9)
        assert found.error_per_force == pytest.approx(line.error_per_force, abs=1e-12)
    told = "a hand may hold any of device.x[1], device.x[2] (user)"
    hint = f'Write: --at "{at}.x[1]"'
    with pytest.raises(ApcError, match=re.escape(f"E931 {told}. {hint}")):
        feel(plane, [1.0], quick=True)
    with pytest.raises(ApcError, match=re.escape(f"E931 --hands: {told}.") + "$"):
        devices_of(plane)


@pytest.mark.parametrize("name", ["planar-users", "god-object", "client-server"])
def test_where_it_is_open_what_is_held_the_line_to_write_is_one_that_works(name: str) -> None:
    scene = compile_topology(SCENES / f"{name}.yaml")
    with pytest.raises(ApcError) as told:
        feel(scene, [1.0], quick=True)
    option, at = (told.value.mistakes[0].hint or "").split(" ", 1)
    assert option == "--at" and feel(scene, [1.0], at=at.strip('"'), quick=True).at == at.strip('"')


def test_where_no_part_can_be_held_alone_it_says_why_and_names_no_line() -> None:
    told = "E931 left moves with masses that move otherwise, and a hand may hold any of them (user)."
    with pytest.raises(ApcError, match=re.escape(told) + "$"):
        feel(compile_topology(SCENES / "two-handed-tool.yaml"), [1.0])
