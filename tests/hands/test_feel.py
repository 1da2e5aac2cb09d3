"""What a hand feels: against a dense system of all users, closed forms, numbers of independent programs."""

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
from apc.compiler.errors import ApcError
from apc.haptics.frequency_response import transparency
from apc.lifting.numeric_model import numeric_model
from tests.hands.handled import responses
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, replaced


def users(count: int, stiffness: float) -> str:
    """Return the paper's topology of so many users."""
    return replaced(AVERAGE, ("count: 3", f"count: {count}"), ("stiffness: 500", f"stiffness: {stiffness}"))


def unlike(masses: np.ndarray, text: str) -> str:
    """Return a topology whose devices weigh so much, one after the other."""
    listed = ", ".join(f"{mass!r} kg" for mass in masses.tolist())
    return re.sub(r"count: \d+", f"set: {{device.mass: [{listed}]}}", text, count=1)


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("count", "ring", "differ"),
    [(2, False, False), (3, False, False), (5, True, False), (4, False, True), (17, False, True)],
)
def test_responses_are_those_of_one_dense_system_of_all_users(count: int, ring: bool, differ: bool) -> None:
    """Equal users by modes; users who all differ as one system."""
    text = users(count, 300)
    if ring:
        text = replaced(text, ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))
    masses = np.full(count, 0.1)
    if differ:
        masses = np.linspace(0.08, 0.13, count)
        text = unlike(masses, text)
    hertz = (0.7, 2.9, 9.7, 21.7, 58.3)
    found = transparency(numeric_model(compiled(text)), hertz, alongside=())
    for place, one in enumerate(hertz):
        here, there, apart = responses(masses, 300.0, one, ring=ring)
        assert found.impedance[place] == pytest.approx(1 / here, rel=1e-9)
        assert found.transmitted_admittance[place] == pytest.approx(there, rel=1e-7)
        assert found.coordination_error[place] == pytest.approx(apart, rel=1e-8)
    assert (found.bound < 1e-6).all()


# By an independent program, which follows harmonics and takes norms by bisection and fast sampling: impedance
# at 1 Hz and 20 Hz; at 20 Hz velocity arriving, error (mm), alias; H∞ of velocity (common, difference) and of
# the error, on ticks and sampled-data, H2 of the error.
PUBLISHED = (
    (
        2,
        (31.421742168544554 - 3.3876062890766288j, 2.8592040243375085 + 2.501112875788781j),
        0.0021133002420831992 + 0.023942180696575152j,
        0.5703125704277588 + 0.35294215416033314j,
        5.694904214390054e-06,
        (0.299461433180675, 0.4729889334388661, 0.0044765666646593835),
        (0.2992905102319901, 0.47273015454639244, 0.004476973205710274),
        0.0005390507317470898,
    ),
    (
        3,
        (39.655654182833935 - 15.869521752731785j, 2.453730629411063 + 0.3608592678348613j),
        -0.07244933505096336 + 0.01377432068631149j,
        0.6092476744197959 + 2.1403332416937313j,
        1.7167909309578182e-05,
        (0.2572214868033621, 0.4963166390275006, 0.0030187083157676695),
        (0.2570494795651829, 0.49599920916108703, 0.0030189582169522842),
        0.0004575212195884317,
    ),
)


@pytest.mark.needs_extension("system_norms")
@pytest.mark.few(1)
@pytest.mark.parametrize(("count", "used", "arrives", "apart", "alias", "ticks", "sampled", "rms"), PUBLISHED)
def test_numbers_of_an_independent_program(
    count: int,
    used: tuple[complex, ...],
    arrives: complex,
    apart: complex,
    alias: float,
    ticks: tuple[float, ...],
    sampled: tuple[float, ...],
    rms: float,
) -> None:
    found = apc.transparency(compiled(users(count, 500)), [1.0, 20.0])
    assert found.impedance.tolist() == pytest.approx(used, rel=1e-11)
    assert found.transmitted_admittance[1] == pytest.approx(arrives, rel=1e-11)
    assert found.coordination_error[1] * 1e3 == pytest.approx(apart, rel=1e-11)
    assert found.aliased_fraction[1] == pytest.approx(alias, rel=1e-8)
    # Its norms are good to 3e-10 (on ticks) and 5e-10 of themselves.
    assert [one.on_ticks.norm for one in found.hinf] == pytest.approx(ticks, rel=1e-9)
    assert [one.sampled_data.norm for one in found.hinf] == pytest.approx(sampled, rel=1e-9)
    error, off = found.h2[0].error_m, found.h2[0].errors[0]
    assert error is not None and off is not None and abs(error - rms) <= off < 1e-10 * rms


@pytest.mark.needs_extension("system_norms")
def test_a_lone_mass_feels_like_itself() -> None:
    """No tick, no network: Z = b + jωm."""
    idle = "{type: SampledSpringDamper, a: device, b: ground, stiffness: 0 N/m, clock: tick}"
    found = apc.transparency(
        compiled(f"{ONE_MASS}clocks: {{tick: 1 ms}}\ncouplers: {{idle: {idle}}}\n"), [0.5, 50.0, 400.0]
    )
    np.testing.assert_allclose(found.impedance, 3 + 2j * np.pi * found.frequency_hz * 2, rtol=1e-13)
    assert (found.aliased_fraction < 1e-13).all()
    slow = found.low_frequency
    assert slow is not None
    for value, expected, off in zip(
        (slow.mass, slow.damping, slow.stiffness), (2, 3, 0), slow.errors, strict=True
    ):
        assert value == pytest.approx(expected, abs=off)
    # |v/F| = 1/|b + jωm| is largest at rest, where it is 1/b.
    assert found.hinf[0].sampled_data.norm == pytest.approx(1 / 3, rel=1e-9)
    # The gains at the frequencies are those of the fundamental, and are evaluated on demand.
    assert str(found) and "gains" not in vars(found.hinf[0])
    np.testing.assert_allclose(found.hinf[0].gains, 1 / np.abs(found.impedance), rtol=1e-7)
    # Each tick's 1 N rms: v⁺ = e^{−bT/m} v + (1 − e^{−bT/m})/b F, whose variance is (1 − a)²/(b²(1 − a²)).
    with mpmath.workdps(50):
        decay = mpmath.exp(mpmath.mpf(-3) / 2000)
        truth = (1 - decay) / 3 / mpmath.sqrt(1 - decay**2)
        hands = next(one for one in found.h2 if one.source == "hands")
        assert hands.velocity_m_s is not None and hands.errors[1] is not None
        assert abs(mpmath.mpf(hands.velocity_m_s) - truth) <= hands.errors[1] < 1e-11 * truth
    # It is the rms at the ticks, which is not that over time.
    assert "white noise, at clock ticks (motion between ticks is not included)" in " ".join(
        str(found).split()
    )
    assert found.to_dict()["h2_rms"] == "at clock ticks (motion between ticks is not included)"


RING = replaced(MESH, ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))


@pytest.mark.needs_extension("system_norms")
@pytest.mark.few(2)
@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize(("text", "received"), [(AVERAGE, 1), (MESH, 4), (RING, 2)])
def test_a_network_feels_viscous_by_as_much_as_dampers_lack(text: str, received: int, count: int) -> None:
    """Copies lag what they hear by half the network's hold and its delay: K ((T_n − T_c)/2 + T_d) of damping.

    Each user has 5 N·s/m at the device and 5 at the copy, and 150 N/m to each other that is heard or to their
    mean. The formula is the first order in the age of what is heard; the rest is some 0.3 %.
    """
    model = compiled(replaced(text, ("count: 3", f"count: {count}"), ("stiffness: 500", "stiffness: 150")))
    found = apc.transparency(model, [1.0])
    assert found.low_frequency is not None and found.network_damping is not None
    network, off = found.network_damping.network, found.network_damping.error
    assert abs(found.low_frequency.damping - 10.0 * count - network) <= off + found.low_frequency.errors[1]
    formula = count * 150.0 * min(received, count - 1) * ((0.008 - 0.001) / 2 + 0.008)
    assert network == pytest.approx(formula, rel=0.02)


@pytest.mark.whole
# Of hands and of sensors, at the first of either group: error and velocity, by an independent program, which
# adds up the answers to each tick's noise.
@pytest.mark.parametrize(
    ("at", "known"),
    [
        ("left[1]", ((0.0006186312153860953, 0.024083674107722355), (0.7540385753605653, 47.12558066384142))),
        (
            "right[1]",
            ((0.0005761712228761279, 0.03485259984618143), (0.41276535974762935, 51.980325413245716)),
        ),
    ],
)
def test_noise_of_groups_whose_forces_switch_at_other_times(
    at: str, known: tuple[tuple[float, float], ...]
) -> None:
    late = "contact.delay: 1.5 ms, device.mass: 0.2 kg"
    groups = f"left: {{count: 2, set: {{{late}}}}}\n  right: {{count: 2}}"
    text = replaced(AVERAGE, ("stiffness: 500", "stiffness: 200"), ("user: {count: 3}", groups))
    for one, (error, velocity) in zip(apc.transparency(compiled(text), [1.0], at=at).h2, known, strict=True):
        assert one.error_m == pytest.approx(error, rel=1e-8)
        assert one.velocity_m_s == pytest.approx(velocity, rel=1e-8)


@pytest.mark.needs_extension("system_norms")
def test_an_unstable_topology_has_no_response_in_time_but_its_map_has_one() -> None:
    found = apc.transparency(compiled(users(3, 1200)), [1.0], unstable=True)
    below = apc.transparency(compiled(users(3, 1090)), [1.0])
    assert found.notes and math.inf in [one.sampled_data.norm for one in found.hinf]
    assert np.allclose([one.gains for one in found.hinf], [one.gains for one in below.hinf], rtol=0.2)
    assert all((one.gains <= one.sampled_data.norm).all() for one in below.hinf)
    assert abs(found.impedance[0] / below.impedance[0] - 1) < 0.2


BARE = """\
topology: bare
clocks: {tick: 8 ms, fast: 1 ms}
peers: {user: {count: 2}}
masses: {cube: {mass: 1 kg, damping: 1 N*s/m, shared: true}}
couplers: {c: {type: AveragePosition, object: cube, stiffness: 9 N/m, clock: fast, link: lan}}
links: {lan: {clock: tick, delay: 8 ms}}
"""
TOOL = (TOPOLOGIES / "two-handed-tool.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "frequency", "at", "why"),
    [
        (AVERAGE, [501.0], "", "E935"),
        (AVERAGE, [0.0], "", "E935"),
        (AVERAGE, [], "", "E935"),
        (AVERAGE, [math.nan], "", "E935"),
        (AVERAGE, [1.0], "nobody[1]", "E936"),
        (AVERAGE, [1.0], "user[0].device", "E936"),
        (AVERAGE, [1.0], "user[1].cub", "E936"),
        (AVERAGE, [1.0], "contact", "E936"),
        (AVERAGE, [1.0], "user[4].device", r'--at "user\[3\].device"'),
        (AVERAGE, [1.0], "usr[2].device", r'--at "user\[2\].device"'),
        (ONE_MASS, [1.0], "", "E935 the topology has no clock; .* Use a coupler with a clock"),
        (BARE, [1.0], "", "E931"),
        (TOOL, [1.0], "", r"E931 user: left is coupled to masses .*, so the device is not unique\.$"),
        (users(3, 1200), [1.0], "", "E934"),
        (unlike(np.linspace(0.08, 0.13, 50), users(50, 300)), [1.0], "", "E933 .* 50 different peers"),
    ],
)
def test_what_can_t_be_felt_is_refused(text: str, frequency: list[float], at: str, why: str) -> None:
    with pytest.raises(ApcError, match=why):
        apc.transparency(compiled(text), frequency, at=at)
    if text == BARE:
        assert apc.transparency(compiled(text), frequency, at="user[1].cube").at == "user[1].cube"


@pytest.mark.parametrize(
    ("name", "at", "others"),
    [
        (
            "planar-users",
            "user[1].device.x[1]",
            ("along one direction; along others: --at user[1].device.x[2]",),
        ),
        ("client-server", "client[1].device", ()),
    ],
)
def test_the_first_device_is_held_along_its_first_direction_which_is_said(
    name: str, at: str, others: tuple[str, ...]
) -> None:
    found = transparency(numeric_model(apc.compile(TOPOLOGIES / f"{name}.yaml")), [1.0], alongside=())
    assert (found.at, tuple(map(str, found.notes))) == (at, others)


def test_in_a_plane_a_hand_feels_along_each_axis_what_it_feels_on_a_line() -> None:
    plane, line = (
        apc.compile(TOPOLOGIES / "planar-users.yaml"),
        transparency(numeric_model(compiled(AVERAGE)), [1.0, 10.0], alongside=()),
    )
    for axis in ("x[1]", "x[2]"):
        found = transparency(numeric_model(plane), [1.0, 10.0], at=f"user[1].device.{axis}", alongside=())
        assert (found.between, found.object) == (f"user[2].device.{axis}", "cube")
        for name in ("impedance", "transmitted_admittance", "coordination_error"):
            np.testing.assert_allclose(getattr(found, name), getattr(line, name), rtol=1e-9, atol=1e-12)


@pytest.mark.needs_extension("system_norms")
def test_copies_of_another_object_are_none_of_those_that_a_copy_differs_from() -> None:
    """Two pairs that nothing couples: each feels what it feels without the other."""
    text = replaced(users(2, 300), (", shared: true", ""))
    own = re.sub(r"(  (?:cube|contact|coordination):) *{", r"\1 {at: [user], ", text)
    parts = "".join(line for line in own.splitlines(keepends=True) if "at: [user]" in line)
    more = re.sub(r"cube|contact|coordination|lan\b", r"\g<0>_b", parts.replace("[user]", "[b]"))
    both = replaced(own, ("{count: 2}", "{count: 2}\n  b: {count: 2}"))
    for pair in zip(parts.splitlines(), more.splitlines(), strict=True):
        both = replaced(both, (pair[0], "\n".join(pair)))
    both = replaced(both, ("links:", "links:\n  lan_b: {clock: network, delay: 8 ms}"))
    apart, together = (
        transparency(numeric_model(compiled(item)), [1.0, 10.0], alongside=("h2",)) for item in (text, both)
    )
    np.testing.assert_allclose(together.coordination_error, apart.coordination_error, rtol=1e-9)
    assert [item.error_m for item in together.h2] == pytest.approx([item.error_m for item in apart.h2])


@pytest.mark.whole
def test_the_command_line_says_what_python_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("three.yaml").write_text(AVERAGE, encoding="utf-8")

    def printed(*words: str, code: int = 0) -> str:
        assert run(["transparency", "three.yaml", *words]) == code
        return "".join(capsys.readouterr())

    words = ["--between", "user[1].device:user[3].device", "--frequencies", "1 Hz, 5 Hz"]
    document = json.loads(printed(*words, "--json"))
    found = apc.transparency("three.yaml", [1.0, 5.0], between="user[3]")
    assert document["frequency_hz"] == [1.0, 5.0]
    assert complex(*document["impedance"][1]) == found.impedance[1]
    assert document["between"] == "user[3].device"
    assert {"transmitted_admittance", "coordination_error", "aliased_fraction", "bound", "hinf", "h2"} < set(
        document
    )
    assert all(len(line) <= 80 for line in printed(*words, "--out", "table.csv").splitlines())
    rows = Path("table.csv").read_text(encoding="utf-8").splitlines()
    assert float(rows[2].split(",")[1]) == found.impedance[1].real
    for code, why, *wrong in (
        (1, "E935", "--to", "600 Hz"),
        (1, "E935", "--from", "2 Hz", "--to", "1 Hz"),
        (1, "E878", "--out", "bode.txt"),
        (1, "got none. Try: --out /dev/stdout\n", "--out", "-"),
        (2, "--frequencies can't be combined with --from", "--frequencies", "1 Hz", "--from", "1 Hz"),
        (2, "", "--at", "user[3]", "--between", "user[1]:user[2]"),
        (2, "", "--nyquist", "--out", "table.csv"),
    ):
        assert why in printed(*wrong, code=code)
    expected = "no response to noise, as the fastest clock has a phase"
    assert expected in printed("--frequencies", "1 Hz", "--set", "haptic.phase=0.3 ms")
    lossy = transparency(numeric_model(apc.compile(TOPOLOGIES / "lossy-average.yaml")), [1.0], alongside=())
    assert "packet loss" in str(lossy).splitlines()[1]
