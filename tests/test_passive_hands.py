"""Every passive hand: against Colgate and Schenkel, energies played in time, and hands drawn at random."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis import box_proof
from apc.analysis.analysis import analyze, lifted_groups, prepare
from apc.analysis.box import parse_range
from apc.analysis.cells import closed_over
from apc.compiler.errors import ApcError
from apc.eigen.balls import precision
from apc.eigen.dissipation import least_real
from apc.frame.devices import clamped, held, with_hands
from apc.frame.radius import RADII, value_of
from apc.frame.taylor import taylor
from apc.hands import box as hands_box
from apc.hands.box import prove_box
from apc.hands.certify import certified
from apc.hands.passivity import STABLE, UNSTABLE, passive_growth, passive_hands
from apc.hands.port import open_ports, port_loop, port_loops
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.vary.critical import critical
from tests.handled import Users, work
from tests.joined import LIBRARY, MS, Group, Hands, Table, moved, radii
from tests.random_hands import exceptions, tuned
from tests.topologies import AVERAGE, MESH, SCENES, compiled, library, replaced, wall


def users(count: int, stiffness: float, text: str = AVERAGE) -> str:
    """Return the paper's scene of so many users."""
    return replaced(text, ("count: 3", f"count: {count}"), ("stiffness: 500", f"stiffness: {stiffness}"))


def sampled_wall(stiffness: float, ticks: int, damping: float = 1.0) -> str:
    """Return a device on a fixed spring whose force is so many ticks of 1 ms late."""
    return (
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: 0.3 kg, damping: {damping} N*s/m}}}}\n"
        "couplers: {it: {type: SampledSpringDamper, a: device, b: ground, clock: tick, "
        f"stiffness: {stiffness} N/m, delay: {ticks} ms}}}}\n"
    )


@pytest.mark.parametrize("ticks", [0, 1, 2, 5, 17])
def test_a_wall_needs_what_colgate_and_schenkel_say(ticks: int) -> None:
    """b = K (T/2 + delay), for any delay in ticks."""
    (mode,) = passive_hands(compiled(sampled_wall(800, ticks))).modes
    assert mode.needed == pytest.approx(800 * (0.5e-3 + ticks * 1e-3), rel=1e-9)
    assert mode.stiffness == pytest.approx(800)


@pytest.mark.parametrize("ticks", [0, 1, 4])
def test_a_force_that_switches_between_ticks_costs_more_than_its_delay(ticks: int) -> None:
    """Forces act half a tick after samples, and then some ticks more; a hand hurries through the first half.

    By A and B in the halves of a tick, steadily, S = A + B, it loses b (A² + B²)/τ and gains K S ((n + ½) S
    + A): the best A = S/2 + K S τ/(4 b) leaves b/(2τ) = K (n + 1) + K² τ/(8 b).
    """
    text = sampled_wall(800, ticks).replace(f"delay: {ticks} ms", f"delay: {ticks}.5 ms")
    (mode,) = passive_hands(compiled(text)).modes
    stiffness, half = 800.0, 0.5e-3
    known = np.roots([1 / (2 * half), -stiffness * (ticks + 1), -(stiffness**2) * half / 8]).max()
    assert mode.needed == pytest.approx(known, rel=1e-9)
    assert known > stiffness * (0.5e-3 + (ticks + 0.5) * 1e-3)


@pytest.mark.parametrize("virtual", [0.0, 0.1, 0.3, 0.7])
def test_a_wall_with_a_backward_difference_needs_its_damping_besides(virtual: float) -> None:
    """b > K T/2 + |B| (Colgate and Schenkel, 1997)."""
    (mode,) = passive_hands(wall(1.0, 0.8, 0.0, 500.0, virtual)).modes
    assert mode.needed == pytest.approx(0.25 + virtual, rel=1e-9)
    assert mode.passive is (0.25 + abs(virtual) < 0.8)


# By an independent program: users, stiffness, needed damping of the common and the difference mode and where,
# the spectral radius with devices clamped.
NEEDED = (
    (2, 500, AVERAGE, 1.8555596700358232, 22.720150681607873, None, None, 1.031814805018594),
    (
        3,
        500,
        AVERAGE,
        1.9125555577395834,
        26.777314359819098,
        8.540418397892944,
        14.895765047280076,
        0.9956095975790132,
    ),
    (3, 500, MESH, 1.8838394321612881, 30.21696159521839, None, None, 1.0458005599958966),
    (3, 200, AVERAGE, 1.9877, None, 2.4273, None, None),
)


@pytest.mark.parametrize("known", NEEDED)
def test_damping_that_an_independent_program_found(known: tuple[object, ...]) -> None:
    count, stiffness, text, common, common_at, apart, apart_at, radius = known
    found = passive_hands(compiled(users(int(str(count)), float(str(stiffness)), str(text))))
    first, second = found.modes
    coarse = 2.5e-5 if common_at is None else 1e-11  # four digits behind the point
    assert first.needed == pytest.approx(common, rel=coarse)
    assert second.needed == (None if apart is None else pytest.approx(apart, rel=coarse))
    if common_at is not None:
        assert first.frequency_hz == pytest.approx(common_at, rel=1e-7)
        assert found.clamped_radius == pytest.approx(radius, abs=1e-13)
    if apart_at is not None:
        assert second.frequency_hz == pytest.approx(apart_at, rel=1e-7)
    assert found.stable is (apart is not None and float(str(apart)) < 5)
    assert found.proof


@pytest.mark.parametrize("apart", [False, True])
def test_energies_played_in_time_say_the_same(apart: bool) -> None:
    """With 0.98 of the damping needed the worst motion gets energy out for ever; with 1.02 it doesn't."""
    system = compiled(users(3, 500))
    loop = port_loops(system, prepare(system), option="")[apart]
    assert not isinstance(loop, str)
    a, b, c, d, weight = map(value_of, (loop.maps.a, loop.maps.b, loop.maps.c, loop.maps.d, loop.maps.weight))
    least, angle = least_real(a, b, c, d, weight)
    given = c @ np.linalg.solve(np.exp(1j * angle) * np.eye(len(a)) - a, b + 0j) + d
    motion = np.linalg.eigh((given + given.conj().T) / 2 + weight)[1][:, 0] * np.sqrt(loop.seconds)
    needed = 5 - least
    below, above = (
        work(Users(3, 500.0, damping=share * needed), motion, angle, apart=apart) for share in (0.98, 1.02)
    )
    assert below < 0 < above
    # At the damping needed nothing is gained or lost: the two lie alike about 0.
    assert above == pytest.approx(-below, rel=0.01)


@pytest.mark.parametrize(("count", "limit"), [(2, 276.5935041841296), (3, 539.93), (5, 1052.17)])
def test_clamped_devices_bear_what_an_independent_program_found(count: int, limit: float) -> None:
    system = with_hands(compiled(users(count, 200)), "clamped")
    found = apc.critical(system, "coordination.stiffness")
    assert found.value == pytest.approx(limit, rel=1e-11 if count == 2 else 1e-5)
    assert "devices clamped" in str(found).splitlines()[0]


def test_clamped_is_a_hand_of_a_thousand_million_kilograms() -> None:
    system = compiled(users(3, 500))
    heavy = apc.set_parameters(held(system, option=""), {"hand.mass": "1e9 kg"})
    fast = analyze(clamped(system))
    slow = analyze(heavy)
    # Two motions of each device are slower than anything else there is; the rest is as if it were held fast.
    moving = sorted(abs(mode.eigenvalue) for mode in slow.modes for _ in range(mode.multiplicity))
    known = sorted(abs(mode.eigenvalue) for mode in fast.modes for _ in range(mode.multiplicity))
    assert [one for one in moving if one < 0.99999][-6:] == pytest.approx(known[-6:], abs=1e-8)


def test_a_hand_of_mass_damper_and_spring_is_a_mass_damper_and_spring() -> None:
    """(m + m_h) s² + (b + b_h) s + k_h = 0 of one device alone, over a frame of 1 ms."""
    numbers = {"hand.mass": "0.2 kg", "hand.damping": "3 N*s/m", "hand.stiffness": "250 N/m"}
    alone = compiled(sampled_wall(0, 0))
    found = analyze(apc.set_parameters(held(alone, option=""), numbers))
    roots = np.exp(np.roots([0.5, 4.0, 250.0]) * 1e-3)
    values = [mode.eigenvalue for mode in found.modes if abs(mode.eigenvalue) > 0.5]
    assert abs(values[0]) == pytest.approx(abs(roots[0]), rel=1e-13)


def test_what_shakes_with_clamped_devices_is_proved_to() -> None:
    """Two users at 500 N/m: 1.0318 a frame with devices clamped, by an independent program."""
    system = compiled(users(2, 500))
    found = passive_growth(system, prepare(system))
    assert found.low > 1
    assert found.stable is False


def test_no_damping_helps_where_a_velocity_is_sampled() -> None:
    text = replaced(AVERAGE, ("stiffness: 1000 N/m, clock", "stiffness: 1000 N/m, damping: 2 N*s/m, clock"))
    found = passive_hands(compiled(text))
    assert found.stable is False
    assert "samples the velocity of device" in found.why
    assert "backward difference" in str(found)


def test_no_damping_helps_where_peers_feel_each_other_otherwise_than_springs_do() -> None:
    """Each hears one other, in a circle: what devices feel at rest is no spring's, however it is weighed."""
    round_ = compiled(
        replaced(
            AVERAGE,
            ("stiffness: 500", "stiffness: 100"),
            ("delay: 8 ms}", "delay: 8 ms, graph: {arcs: [[1, 2, 1], [2, 3, 1], [3, 1, 1]]}}"),
        )
    )
    for damping in ("5 N*s/m", "500 N*s/m"):
        found = passive_hands(apc.set_parameters(round_, {"device.damping": damping}))
        assert found.stable is False
        assert found.clamped_stable
        assert found.worst is not None
        assert found.worst.more is None
        assert "not what springs give" in str(found)
        assert "more damping at each device they can't" not in str(found)
    answer = critical(round_, "device.damping", criterion="passive")
    assert not answer.crossings
    assert answer.verdict.startswith("unstable whatever its value: apc analyze --hands passive")


STAR = replaced(AVERAGE, ("count: 3", "count: 4"), ("delay: 8 ms}", "delay: 8 ms, graph: star}"))
UNEVEN = replaced(
    AVERAGE, ("user: {count: 3}", "a: {count: 1, set: {coordination.stiffness: 50 N/m}}\n  b: {count: 2}")
)


@pytest.mark.parametrize("text", [STAR, UNEVEN])
def test_where_one_is_pulled_harder_than_it_pulls_hands_by_themselves_do_no_harm(text: str) -> None:
    """What devices feel at rest is that of springs if energies are weighed: no hand alone gets any out."""
    system = compiled(replaced(text, ("stiffness: 500", "stiffness: 100")))
    found = passive_hands(system)
    assert found.stable
    assert not found.joined
    assert "each by itself" in " ".join(str(found).split())
    random = np.random.default_rng(3)
    ready = held(system, option="")
    drawn = 10 ** random.uniform(-6, [3, 4, 7], size=(60, 3))
    names = ("hand.mass", "hand.damping", "hand.stiffness")
    many = apc.analyze_many(ready, dict(zip(names, drawn.T, strict=True)))
    assert not (many.stable == 0).any()
    # Where the criterion isn't met, nothing is said of them.
    stiff = passive_hands(compiled(replaced(text, ("stiffness: 500", "stiffness: 290"))))
    assert stiff.stable is None or stiff.stable


def test_a_lever_between_hands_shakes_devices_that_pull_each_other_unevenly(tmp_path: Path) -> None:
    """300 kg each, and a spring of 85.7 N/m by what both devices together are aside: no more than passive."""
    one = Group("a", 1, 0.1, 5.0, 300.0, 0.0, MS, "haptic", 100.0, MS)
    groups = one, replace(one, name="b", pull=300.0)
    table = Table(groups, {"haptic": (MS, 0 * MS), "network": (8 * MS, 0 * MS)}, 8 * MS, 0.6, 5.0)
    found = passive_hands(compiled(table.text, library(tmp_path, LIBRARY)))
    assert found.stable
    assert not found.joined
    lever = Hands(300 * np.eye(2), np.zeros((2, 2)), np.diag([85.7, 0]) + 85.7)
    assert radii(table, lever)[-1] > 1.0005
    # With hands that aren't joined, one pull counts for three of the other: nothing is gained going round.
    for hertz in (0.05, 0.2, 1.0, 5.0):
        assert all(radii(table, hands)[-1] < 1 for hands in tuned(table, hertz))


def test_hands_in_the_scene_are_not_doubled() -> None:
    text = AVERAGE + "hands: {grip: {type: SpringDamperArm, flange: device, stiffness: 100 N/m}}\n"
    for hands in ("clamped", "held", "passive"):
        with pytest.raises(ApcError, match=r"E932.*grip"):
            with_hands(compiled(text), hands)
    with pytest.raises(ApcError, match="E930"):
        with_hands(compiled(AVERAGE), "claped")


def test_a_device_touched_at_every_moment_is_refused_by_name() -> None:
    text = replaced(AVERAGE, ("type: Sampled", "type: "), ("N/m, clock: haptic, delay: 1 ms}", "N/m}"))
    with pytest.raises(ApcError, match=r"E933.*cube"):
        passive_hands(compiled(text))


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [8, 15])
def test_no_passive_hand_shakes_what_is_called_passive(draws: int) -> None:
    found = exceptions(0, draws, 20)
    assert not found.wrong
    assert not found.undecided
    assert 2 <= found.passive <= found.scenes - 2  # or the draws would say nothing
    assert found.shaken >= found.tried - 1  # some need more than a mass and a spring


@pytest.mark.parametrize(("count", "limit"), [(2, 233.1357), (3, 458.242), (5, 895.643)])
def test_the_boundary_for_passive_hands_is_where_an_independent_program_finds_nothing_to_spare(
    count: int, limit: float
) -> None:
    """On it, at its frequency, the map of `joined` gives back exactly what it is given; nowhere less."""
    system = compiled(users(count, 200))
    axes = parse_axes(
        system, x="contact.stiffness=600 N/m:1400 N/m", y="coordination.stiffness=50 N/m:1500 N/m"
    )
    found = region(system, axes, criterion="passive")
    assert found.contains(1000.0, limit - 0.001)
    assert not found.contains(1000.0, limit + 0.001)
    for curve in found.curves:
        assert curve.smooth
        assert curve.error < 1e-8
        for place in range(0, len(curve.knots), 9):
            contact, pull = curve.knots[place].tolist()
            one = Group("a", count, 0.1, 5.0, contact, 0.0, MS, "haptic", pull, MS)
            clocks = {"haptic": (MS, 0 * MS), "network": (8 * MS, 0 * MS)}
            truth = moved(Table((one,), clocks, 8 * MS, 0.6, 5.0))
            angle = abs(float(np.angle(curve.eigenvalues[place])))
            assert truth.clamped < 1
            assert truth.least(angle) == pytest.approx(0, abs=2e-7)
            assert min(truth.least(one) for one in np.linspace(1e-3, np.pi, 60)) > -2e-7


@pytest.mark.few(2)
@pytest.mark.parametrize(("count", "limit"), [(2, 233.1357), (3, 458.242), (5, 895.643)])
def test_a_critical_stiffness_is_bounded_to_nine_digits(count: int, limit: float) -> None:
    found = critical(compiled(users(count, 200)), "coordination.stiffness", criterion="passive")
    (crossing,) = found.crossings
    assert crossing.value == pytest.approx(limit, rel=5e-7)
    assert crossing.error < 3e-9 * limit
    assert crossing.proof == "what hands can draw bounded on either side"


@pytest.mark.parametrize(
    ("boxes", "stable"),
    [
        (("contact.stiffness=±1%", "coordination.stiffness=±1%"), True),
        (("device.mass=±10%", "device.damping=±5%"), True),
        (("coordination.stiffness=440 N/m:458.3 N/m",), False),
        (("coordination.stiffness=458.2421 N/m:458.2422 N/m",), False),
    ],
)
def test_a_box_is_proved_where_the_boundary_is_far_and_refuted_where_it_is_inside(
    boxes: tuple[str, ...], stable: bool
) -> None:
    """Three users bear 458.24216 N/m with any passive hand, by an independent program."""
    system = compiled(users(3, 200))
    found = prove_box(system, [parse_range(system, one) for one in boxes])
    assert found.stable is stable
    assert found.verdict == {True: STABLE, False: UNSTABLE}[stable]
    if not stable:
        (stiffness,) = found.point
        assert stiffness > 458.242164


def test_a_box_of_hands_says_that_it_leaves_packets_lost_out_and_has_no_range_of_them() -> None:
    system = compiled(replaced(users(3, 200), ("delay: 8 ms}", "delay: 8 ms, loss: 10 %}")))
    found = prove_box(system, [parse_range(system, "contact.stiffness=±1%")])
    assert found.stable
    left_out = str(found).splitlines()[1]
    assert left_out.startswith("left out: packet loss (10 %) of lan")
    with pytest.raises(ApcError, match=r'E896 .* Write: apc analyze --box "lan.loss=0:0.2"'):
        prove_box(system, [parse_range(system, "lan.loss=0:20 %")])


def test_a_box_of_two_kinds_of_devices_is_proved() -> None:
    text = replaced(
        AVERAGE, ("user: {count: 3}", "a: {count: 1, set: {device.mass: 0.2 kg}}\n  b: {count: 2}")
    )
    system = compiled(replaced(text, ("stiffness: 500", "stiffness: 200")))
    assert passive_hands(system).stable
    assert prove_box(system, [parse_range(system, "contact.stiffness=±0.5%")]).stable


def test_cells_are_halved_where_that_makes_them_easier_to_prove() -> None:
    """At so soft a contact it alone says what damping is needed, and the other range what can be proved."""
    system = compiled(users(2, 75))
    boxes = ("contact.stiffness=100 N/m:120 N/m", "coordination.stiffness=73 N/m:83 N/m")
    found = prove_box(system, [parse_range(system, one) for one in boxes])
    assert found.stable
    assert found.cells < 40


@pytest.mark.parametrize(
    ("text", "boxes"),
    [
        (users(3, 200), ("contact.stiffness=±10%", "coordination.stiffness=±5%")),
        (users(2, 150), ("device.mass=±20%", "device.damping=±20%", "cube.mass=±5%")),
    ],
)
def test_the_map_of_moved_devices_is_within_its_radius_all_over_a_cell(
    text: str, boxes: tuple[str, ...]
) -> None:
    """Against the same map at corners of the cell and inside it, each by itself."""
    system = compiled(text)
    ranges = [parse_range(system, one) for one in boxes]
    generator = np.random.default_rng(4)
    with precision(box_proof.BITS):
        asked = hands_box._question(system, ranges)
        assert not isinstance(asked, str)
        whole = tuple((one.low, one.high) for one in ranges)
        sides = [
            *itertools.product((-1.0, 1.0), repeat=len(ranges)),
            *generator.uniform(-1, 1, (5, len(ranges))),
        ]
        for mode in asked.cuts:
            closed, dampings = closed_over(mode.loop, [whole])
            over = mode.cut.maps(closed[0], dampings[0], taylor(len(ranges)), mode.stands)
            assert over is not None
            for side in sides:
                point = [
                    low + (1 + Fraction(float(one))) / 2 * (high - low)
                    for (low, high), one in zip(whole, side, strict=True)
                ]
                matrix, damping = closed_over(mode.loop, [tuple((one, one) for one in point)])
                here = mode.cut.maps(matrix[0], damping[0], RADII)
                assert here is not None
                for name in ("a", "b", "c", "d", "weight", "static"):
                    found, truth = getattr(over, name), getattr(here, name)
                    held = found[0] + np.tensordot(np.array(side, dtype=float), found[2:], axes=1)
                    room = found[1] + truth[1] + 1e-15 * np.abs(found).sum(axis=0)  # of adding it up here
                    assert (np.abs(held - truth[0]) <= room).all(), name


def test_no_box_is_proved_where_hands_pull_unevenly_or_a_velocity_is_sampled() -> None:
    with pytest.raises(ApcError, match=r"E930.*unevenly"):
        system = compiled(replaced(STAR, ("stiffness: 500", "stiffness: 100")))
        prove_box(system, [parse_range(system, "contact.stiffness=±1%")])
    text = replaced(AVERAGE, ("stiffness: 1000 N/m, clock", "stiffness: 1000 N/m, damping: 2 N*s/m, clock"))
    found = prove_box(compiled(text), [parse_range(compiled(text), "contact.stiffness=±1%")])
    assert found.stable is False
    assert "samples the velocity of device" in str(found)


def test_region_and_sweep_say_what_critical_does(tmp_path: Path) -> None:
    """At 1000 N/m of contact 458.24 N/m are borne, by an independent program."""
    scene = tmp_path / "three.yaml"
    scene.write_text(AVERAGE, encoding="utf-8")
    axes = {"x": "contact.stiffness=900 N/m:1100 N/m", "y": "coordination.stiffness=300 N/m:600 N/m"}
    found = region(apc.compile(scene), parse_axes(apc.compile(scene), **axes), cells=2, criterion="passive")
    assert found.contains(1000.0, 455.0)
    assert not found.contains(1000.0, 461.0)
    assert "stable with every passive hand" in str(found)
    swept = apc.sweep(scene, {"coordination.stiffness": "455,461 N/m"}, criterion="passive", jobs=1)
    assert swept.column("verdict").tolist() == [
        "stable with any passive hands",
        "unstable with some passive hands",
    ]


def test_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("three.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["analyze", "three.yaml", "--hands", "passive", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["hands"] == "passive"
    assert document["stable"] is False
    assert document["modes"][1]["damping_needed"] == pytest.approx(8.540418397892944, rel=1e-11)
    assert run(["analyze", "three.yaml", "--hands", "clamped"]) == 0
    assert "devices clamped: stable" in capsys.readouterr().out
    gentle = ["--set", "coordination.stiffness=200 N/m"]
    assert (
        run(["analyze", "three.yaml", "--hands", "passive", *gentle, "--box", "contact.stiffness=±1%"]) == 0
    )
    assert "proved stable with any passive hands for every value in the box" in capsys.readouterr().out
    assert run(["analyze", "three.yaml", "--hands", "passive", "--buzz"]) == 1
    assert "E930" in capsys.readouterr().err
    assert run(["analyze", "three.yaml", "--hands", ""]) == 1
    assert "E930 no hands are named (free, clamped," in capsys.readouterr().err
    assert run(["analyze", "three.yaml", "--hands", "claped"]) == 1
    assert "clamped" in capsys.readouterr().err


@pytest.mark.parametrize(("stiffness", "stable"), [(458.24, True), (458.25, False), (500.0, False)])
def test_balls_prove_what_floats_say_and_never_the_opposite(stiffness: float, stable: bool) -> None:
    """The paper's three users bear 458.242 N/m (see above): either side of it is proved, neither both."""
    system = compiled(replaced(AVERAGE, ("stiffness: 500", f"stiffness: {stiffness}")))
    found = passive_hands(system, certify=True)
    assert found.stable is stable
    assert found.proof == "proved in ball arithmetic, 128 bits"
    opened = open_ports(system, *lifted_groups(system), option="--hands passive")
    assert not isinstance(opened, str)
    held = [port_loop(opened, loop, option="--hands passive") for loop in opened.loops]
    proved = []
    for loop, (own, cut) in zip(opened.loops, held, strict=True):
        dampings = np.array([float(one) for one in own.dampings])
        angle = least_real(
            *(value_of(one) for one in (own.maps.a, own.maps.b, own.maps.c, own.maps.d, own.maps.weight))
        )[1]
        bits = [bool(certified(loop, cut, dampings, passive=claim, angle=angle)) for claim in (True, False)]
        assert bits.count(True) == 1, own.name
        proved.append(bits[0])
    assert all(proved) is stable


def test_a_box_says_that_it_is_not_proved_in_balls(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--hands", "passive", "--certify", "--box", "contact.stiffness=±1%"]
    assert run(["analyze", str(SCENES / "three-users-average.yaml"), *words]) == 1
    assert "E930 --certify, --box and --hands passive don't go together" in capsys.readouterr().err


def test_a_scene_unstable_clamped_is_proved_so_in_balls() -> None:
    mesh = passive_hands(compiled(MESH), certify=True)
    assert mesh.stable is False
    assert mesh.proof.startswith("with its devices clamped it is unstable: proved unstable with ")


@pytest.mark.few(1)
@pytest.mark.parametrize("highest", [600, 1500])
def test_a_region_that_begins_where_nothing_holds_the_copies_is_drawn_all_the_same(highest: int) -> None:
    """Without contact clamped devices hold no copy: there is no map at that edge, and there is beside it."""
    system = compiled(AVERAGE)
    pulls = f"coordination.stiffness=0 N/m:{highest} N/m"
    axes = parse_axes(system, f"contact.stiffness=0 N/m:{2 * highest} N/m", pulls)
    found = region(system, axes, criterion="passive", cells=4)
    assert found.contains(1000.0, 457.0)
    assert not found.contains(1000.0, 459.0)


def test_a_range_without_a_crossing_says_what_it_is_and_not_that_nothing_matters() -> None:
    found = critical(compiled(AVERAGE), "coordination.stiffness", lower="600 N/m", criterion="passive")
    assert (found.value, found.enters, found.verdict) == (None, True, "unstable at every value scanned")
    assert found.scanned[0] == 600.0


def test_contacts_that_hands_may_close_are_named(tmp_path: Path) -> None:
    """A wall that the device starts beside decides nothing, and the answer says so first."""
    text = (
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}\n"
        "couplers:\n  wall: {type: VirtualWall, flange: device, stiffness: 20000 N/m, clock: tick}\n"
        "hands: {push: {type: ConstantForce, flange: device, force: 1 N}}\n"
    )
    found = passive_hands(compiled(text))
    assert found.left_out[-1].startswith("left out: wall")
    assert "as at the start" in found.left_out[-1]


def test_a_hand_of_the_library_says_where_its_usual_values_stand_for_its_range(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["critical", "contact.stiffness", str(SCENES / "three-users-average.yaml")]
    assert run([*words, "--hands", "StylusArmForward", "--upper", "900 N/m"]) == 0
    assert "note: StylusArmForward by its usual values" in capsys.readouterr().err
    assert run([*words, "--hands", "clamped", "--upper", "900 N/m"]) == 0
    assert "usual values" not in capsys.readouterr().err
