"""Claims about `apc.vary.critical` and what it searches with: limits, islands, jumps, errors."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

from apc.__main__ import run
from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Place
from apc.compiler.pipeline import compile_topology
from apc.eigen.balls import precision
from apc.frame.names import Free, find
from apc.frame.overrides import Override, apply
from apc.present.vary import critical_document
from apc.vary.critical import critical
from apc.vary.crossings import scan, scan_lines
from apc.vary.delays import borders
from apc.vary.evaluator import PointEvaluator
from apc.vary.lags import LateStretch, late_stretches
from apc.vary.margins import _delays, coupler_parameters, margins
from apc.vary.search import Crossing
from tests.bruteforce import Scene, as_ball, frame_matrices, frame_matrix
from tests.reference import CONTACT_LIMITS, LIMITS
from tests.topologies import AVERAGE, MESH, SCENES, compiled, library, replaced

TEXTS = {"AP": AVERAGE, "VC": MESH}
HARD = Path(__file__).parent / "hard"
NONE = {"contact.delay": "0", "coordination.delay": "0", "lan.delay": "0"}


def scene(
    scheme: str, *, delayed: bool = True, delays: str = "all", b: str = "0", k_c: str = "1000"
) -> CompiledSystem:
    system = compiled(replaced(TEXTS[scheme], ("link: lan", f"link: lan, delays: {delays}")))
    values = {"contact.stiffness": k_c, "contact.damping": b, "coordination.damping": b}
    if not delayed:
        values |= NONE
    return with_values(system, values)


def with_values(system: CompiledSystem, values: dict[str, str]) -> CompiledSystem:
    return apply(system, [Override(Free(name), Fraction(value)) for name, value in values.items()])


def stable_at(system: CompiledSystem, name: str, value: float) -> bool | None:
    return analyze(apply(system, [Override(Free(name), Fraction(value))])).stable


@pytest.mark.parametrize(("delayed", "delays", "b", "k_c", "average", "mesh"), LIMITS)
def test_the_largest_stable_stiffness_is_the_reference_one(
    delayed: bool, delays: str, b: int, k_c: int, average: float, mesh: float
) -> None:
    for scheme, limit in (("AP", average), ("VC", mesh)):
        found = critical(
            scene(scheme, delayed=delayed, delays=delays, b=str(b), k_c=str(k_c)), "coordination.stiffness"
        )
        assert found.value == pytest.approx(limit, abs=6e-4)
        assert found.stable_side == "below"
        assert found.error is not None
        assert found.error <= 1e-12 * limit
        assert found.crossings[0].proof.startswith("proved")
        assert found.whole


@pytest.mark.parametrize(("b", "limit"), CONTACT_LIMITS)
def test_the_contact_alone_has_its_reference_limit(b: int, limit: float) -> None:
    system = with_values(scene("AP"), {"coordination.stiffness": "0", "contact.damping": str(b)})
    assert critical(system, "contact.stiffness").value == pytest.approx(limit, abs=6e-4)


def test_the_error_holds_against_the_full_map_in_50_digits() -> None:
    """At value ± error the largest eigenvalue of all peers' own map lies on either side of the circle."""
    found = critical(scene("AP"), "coordination.stiffness")
    assert found.value is not None
    assert found.error is not None
    sizes = []
    with precision(200):
        for sign in (-1, 1):
            k_t = flint.arb(found.value) + sign * flint.arb(found.error)
            scene_there = Scene(kt=k_t, kc=flint.arb(1000))  # type: ignore[arg-type] # a scene of balls
            rows = frame_matrix(scene_there, number=as_ball, exp=lambda value: value.exp())
            matrix = flint.acb_mat([[flint.acb(entry.mid()) for entry in row] for row in rows])
            mode = np.exp(2j * np.pi * found.crossings[0].frequency_hz * 0.008)
            values = matrix.eig(algorithm="approx")
            sizes.append(abs(min(values, key=lambda value: abs(complex(value.mid()) - mode))).mid())
        assert sizes[0] < 1 < sizes[1]


def test_both_sides_of_every_crossing_are_what_an_analysis_says() -> None:
    system = compiled(AVERAGE)
    for name in ("coordination.damping", "device.mass", "device.damping", "contact.delay"):
        found = critical(system, name)
        assert found.crossings
        for one in found.crossings:
            below = stable_at(system, name, one.value * (1 - 1e-6))
            above = stable_at(system, name, one.value * (1 + 1e-6))
            assert (below, above) == ((True, False) if one.stable_side == "below" else (False, True))


def test_an_island_of_stability_is_found() -> None:
    """Coordination damping of the paper's scene: stable, unstable, stable again, unstable for good."""
    found = critical(compiled(AVERAGE), "coordination.damping")
    assert [one.stable_side for one in found.crossings] == ["below", "above", "below"]
    assert found.value == found.crossings[0].value


def test_islands_of_any_width_above_the_cell_are_found_by_construction() -> None:
    """|λ| = 1 + c ((p − a)² − w²): stable between a − w and a + w and nowhere else."""
    centre = 7.3
    for width in (0.3, 0.03, 0.003):

        def course(p: np.ndarray, width: float = width) -> list[tuple[np.ndarray, np.ndarray]]:
            size = 1 + 0.05 * ((p - centre) ** 2 - width**2)
            slope = 0.1 * (p - centre)
            turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
            return [(size[:, None, None] * turn, slope[:, None, None] * turn)]

        found = scan(course, np.geomspace(0.01, 100, 25), least=0.01)
        assert [root.rising for root in found.roots] == [False, True]
        expected = [centre - width, centre + width]
        assert [root.value for root in found.roots] == pytest.approx(expected, rel=1e-12)


def test_lines_scanned_in_step_have_the_crossings_of_each_and_none_beyond_the_first() -> None:
    """|λ| = 1 + c (p − a)(p − b)(p − d): it rises at a, falls at b and rises again at d."""
    edges = np.array([[1.7, 2.3, 40.0], [0.3, 0.31, 5.0], [200.0, 300.0, 400.0]])

    def course(which: np.ndarray, p: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        a, b, d = edges[which].T
        size = 1 + 1e-6 * (p - a) * (p - b) * (p - d)
        slope = 1e-6 * ((p - b) * (p - d) + (p - a) * (p - d) + (p - a) * (p - b))
        turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
        return [(size[:, None, None] * turn, slope[:, None, None] * turn)]

    points = [np.geomspace(0.01, 100, 25), np.geomspace(0.1, 10, 13), np.geomspace(1, 10, 7)]
    every = scan_lines(course, points, [0.01] * 3)
    assert [[root.value for root in one.roots] for one in every] == [
        pytest.approx(edges[0], rel=1e-7),
        pytest.approx(edges[1], rel=1e-7),
        [],
    ]
    first = scan_lines(course, points, [0.01] * 3, first=True)
    assert [[root.value for root in one.roots] for one in first] == [
        pytest.approx(edges[0][:1], rel=1e-7),
        pytest.approx(edges[1][:1], rel=1e-7),
        [],
    ]
    assert all(one.whole for one in every)
    assert first[0].points[-1] < points[0][-1], "far beyond its crossing nothing is looked at"
    assert first[2].points[-1] == points[2][-1]
    assert scan_lines(course, [np.empty(0)], [1.0])[0].roots == ()


def test_a_link_delay_jumps_where_a_packet_comes_a_tick_later() -> None:
    system = with_values(compiled(AVERAGE), {"coordination.stiffness": "690", "contact.stiffness": "100"})
    found = critical(system, "lan.delay", upper="16 ms")
    assert found.crossings
    first = found.crossings[0]
    assert first.kind == "jump"
    assert first.error == 0.0
    ticks = first.value / 1e-3
    assert ticks == pytest.approx(round(ticks), abs=1e-9)
    assert found.stretches == 16, "a packet comes a tick later after every millisecond"
    assert "16 pieces nothing depends on it: what grows there was counted in floats" in " ".join(
        str(found).split()
    )
    sides = [
        analyze(apply(system, [Override(Free("lan.delay"), Fraction(round(ticks), 1000) + shift)])).stable
        for shift in (Fraction(-1, 10**7), Fraction(1, 10**7))
    ]
    assert sides == ([True, False] if first.stable_side == "below" else [False, True])


def test_what_follows_by_an_expression_moves_along() -> None:
    text = replaced(
        MESH,
        ("masses:", "parameters: {kt: 500 N/m}\nmasses:"),
        (
            "type: FullMesh, object: cube, stiffness: 500 N/m",
            "type: FullMesh, object: cube, stiffness: kt/(peers - 1)",
        ),
    )
    # (N − 1) times less each is the average's limit.
    assert critical(compiled(text), "kt").value == pytest.approx(1096.410868365630, rel=1e-12)


def test_groups_alike_at_present_only_are_kept_apart() -> None:
    """One group's own stiffness, equal to the others' now: its limit is not everybody's."""
    text = replaced(
        AVERAGE,
        ("  user: {count: 3}", "  one: {count: 1, set: {contact.stiffness: 1000 N/m}}\n  two: {count: 2}"),
    )
    system = compiled(text)
    alone = critical(system, "one.contact.stiffness")
    assert alone.parameter == "one.contact.stiffness"
    assert alone.value is not None
    for shift, stable in ((1 - 1e-9, True), (1 + 1e-9, False)):
        changed = apply(system, [Override(Free("contact.stiffness", "one"), Fraction(alone.value * shift))])
        assert analyze(changed).stable is stable
    together = critical(system, "contact.stiffness")
    assert together.value == pytest.approx(1645.35314612339, rel=1e-12)
    assert abs(alone.value - together.value) > 1


def test_no_crossing_is_an_answer_in_words() -> None:
    found = critical(compiled(AVERAGE), "coordination.stiffness", upper="900 N/m")
    assert (found.value, found.error, found.stable_side) == (None, None, None)
    assert found.verdict == "stable at every value scanned"
    assert found.scanned == (0.0, 900.0)
    above = critical(compiled(AVERAGE), "coordination.stiffness", lower="1200 N/m", upper="2000 N/m")
    assert above.verdict == "unstable at every value scanned"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["peers"], "E623 peers is the number of all peers"),
        (["contact.stifness"], "E622 contact.stifness is no parameter"),
        (["haptic.period"], "E844 haptic.period sets the rhythm of a clock"),
        (["haptic.phase"], "E844 haptic.phase sets the rhythm of a clock"),
        (["user.contact.delay"], "contact.delay is one time for all groups. Write: contact.delay"),
        ([""], "E622 an empty name is no parameter of"),
        (["links."], "E622 links. is no parameter of"),
        (["contact.stiffness", "--upper", "3 kg"], "E204 contact.stiffness wants N/m, got 3 kg"),
        (
            ["contact.stiffness", "--upper", "900"],
            "--upper: E204 contact.stiffness wants N/m, got 900 (no",
        ),
        (["contact.stiffness", "--upper", "900"], 'Write: --upper "900 N/m"'),
        (
            ["contact.stiffness", "--lower", "9 N/m", "--upper", "3 N/m"],
            "E842 the range of contact.stiffness wants",
        ),
        (["contact.stiffness", "--lower", "-5 N/m"], "E843 a limit of contact.stiffness wants at least 0"),
    ],
)
def test_a_mistake_is_one_message(words: list[str], message: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["critical", *words]) == 1
    written = capsys.readouterr()
    assert message in written.err
    assert written.out == ""


def test_the_command_prints_one_document_or_lines_of_80_columns(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["critical", "coordination.stiffness", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["value"] == pytest.approx(1096.410868365630, rel=1e-12)
    assert document["unit"] == "N/m"
    assert document["crossings"][0]["stable_side"] == "below"
    assert run(["critical", "coordination.stiffness", "--set", "contact.stiffness=2000 N/m"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("name", ["finger", "limited-motor", "experiment-average"])
def test_a_scene_linearized_at_its_start_goes_the_way_of_a_linear_one(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many values at a time and proved in balls; point by point it takes 15 times as long."""
    alone: list[object] = []
    blocks = PointEvaluator._blocks
    monkeypatch.setattr(PointEvaluator, "_blocks", lambda *given: alone.append(given) or blocks(*given))
    system = compiled((SCENES / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[2])
    stiffness = next(one.label for one in coupler_parameters(system) if one.label.endswith("stiffness"))
    found = critical(system, stiffness)
    assert not alone
    assert found.crossings or found.verdict.startswith("unstable")
    for one in found.crossings:
        assert one.proof.startswith("proved with")
        for side, value in (("below", one.value - 2 * one.error), ("above", one.value + 2 * one.error)):
            assert stable_at(system, stiffness, value) is (one.stable_side == side)


def test_delays_of_a_scene_with_contact_are_those_of_the_springs_it_starts_with() -> None:
    """Pressed at the start, a contact that only pushes is a spring; let go, it is none."""
    contact = "type: OneSidedContact, a: device, b: cube, half_width: 20 mm, side: left"
    pressed = replaced(
        AVERAGE,
        ("count: 3", "count: 3, set: {device.x: -10 mm}"),
        ("type: SampledSpringDamper, a: device, b: cube", contact),
    )
    springs, contacts = (
        critical(compiled(text), "contact.delay", upper="4 ms") for text in (AVERAGE, pressed)
    )
    assert contacts.value == pytest.approx(springs.value, abs=springs.error + contacts.error)
    assert contacts.left_out
    assert not springs.left_out
    apart = replaced(pressed, ("device.x: -10 mm", "device.x: -30 mm"))
    assert critical(compiled(apart), "contact.delay", upper="4 ms").crossings == ()
    rows = {one.parameter: one.value for one in margins(compiled(pressed)).rows}
    assert rows["contact.delay"] == pytest.approx(springs.value, rel=1e-12)


def test_verdicts_on_both_sides_of_a_delay_are_those_of_linearizations_there() -> None:
    text = (SCENES / "finger.yaml").read_text(encoding="utf-8").partition("\n")[2]
    limit = critical(compiled(text), "wall.stiffness", lower="2000 N/m", upper="9000 N/m").value
    assert limit is not None
    system = apply(compiled(text), [Override(Free("wall.stiffness"), Fraction(0.8 * limit))])
    found = critical(system, "wall.delay", upper="3 ms")
    assert found.crossings
    for one in found.crossings:
        for side, factor in (("below", 1 - 1e-6), ("above", 1 + 1e-6)):
            beside = Override(Free("wall.delay"), Fraction(one.value * factor))
            assert analyze(apply(system, [beside])).stable is (one.stable_side == side)


def _uncounted(monkeypatch: pytest.MonkeyPatch) -> None:
    def uncounted(*given: Any) -> list[LateStretch]:
        return [replace(one, stable=None) for one in late_stretches(*given) or []]

    monkeypatch.setattr("apc.vary.search.late_stretches", uncounted)


def test_a_delay_of_which_the_count_leaves_a_stretch_open_is_analysed_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A gain below the boundary by 1e-13 of it: at 7 ms as near, and the count leaves 7 to 8 ms open."""
    scene = compile_topology(HARD / "boundary-inside-13.yaml")
    found = critical(scene, "lan.delay", upper="16 ms")
    assert [(one.value, one.error) for one in found.crossings] == [(0.002, 0.0), (0.007, 0.0)]
    assert found.whole and not found.left_open
    for one in found.crossings:
        for side in (-1, 1):
            beside = Override(Free("lan.delay"), Fraction(one.value) + side * Fraction(1, 2000))
            stable = analyze(apply(scene, [beside])).stable
            assert stable is ((one.stable_side == "below") == (side < 0))
    _uncounted(monkeypatch)
    assert critical(scene, "lan.delay", upper="16 ms").crossings == found.crossings


def test_where_a_search_of_delays_begins_is_looked_at_by_itself() -> None:
    """A packet due at a tick is heard at it, and one a microsecond later at the next."""
    text = (SCENES / "star-lecture.yaml").read_text(encoding="utf-8")
    scene = apply(compiled(text), [Override(Free("coordination.stiffness"), Fraction("873.3965451925634"))])
    for low in (0, 14):
        found = critical(scene, "lecture.delay", lower=f"{low} ms", upper="18 ms")
        at, above = (
            analyze(apply(scene, [Override(Free("lecture.delay"), Fraction(low, 1000) + more)])).stable
            for more in (0, Fraction(1, 10**6))
        )
        assert at is not above
        first = found.crossings[0]
        assert (first.value, first.error, first.stable_side) == (low / 1000, 0.0, "below" if at else "above")


def test_a_jump_beside_what_no_analysis_decides_is_not_said_to_be_exact(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def undecided(system: Any, *, prepared: Any) -> Any:
        found = analyze(system, prepared=prepared)
        late = next(one.value for one in system.timings if one.name == "lan.delay")
        return replace(found, stable=None) if Fraction(6, 1000) < late < Fraction(8, 1000) else found

    _uncounted(monkeypatch)
    monkeypatch.setattr("apc.vary.search.analyze", undecided)
    monkeypatch.setattr("apc.vary.search._settles", lambda *given: False)
    found = critical(compile_topology(HARD / "boundary-inside-13.yaml"), "lan.delay", upper="16 ms")
    last = found.crossings[-1]
    assert (last.value, last.error, last.stable_side) == (0.007, 0.001, "above")
    assert "the verdict between them is left open" in last.proof
    assert not found.whole and found.left_open == ((0.006, 0.007), (0.007, 0.008))
    text = " ".join(str(found).split())
    assert "the verdict is left open from 0.006 s to 0.007 s, 0.007 s to 0.008 s" in text
    assert "an eigenvalue keeps near to the boundary" in text
    assert critical_document(found)["left_open"] == [[0.006, 0.007], [0.007, 0.008]]


def test_a_delay_where_what_is_heard_at_the_start_decides_is_refused() -> None:
    text = replaced(MESH, ("type: FullMesh", "type: SaturatedMesh, limit: 3 N"))
    with pytest.raises(ApcError, match="E845 how the scene moves hangs on what is heard at the start"):
        critical(compiled(text), "contact.delay")


def test_many_packets_on_their_way_give_the_crossings_that_few_give(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a matrix that holds the packets: the argument principle instead, from this many on."""
    system = with_values(compiled(AVERAGE), {"coordination.stiffness": "690", "contact.stiffness": "100"})
    by_matrix = critical(system, "lan.delay", upper="16 ms")
    monkeypatch.setattr("apc.analysis.plan.LONG_LINES", 0)
    by_count = critical(system, "lan.delay", upper="16 ms")
    assert by_matrix.crossings
    for one, other in zip(by_matrix.crossings, by_count.crossings, strict=True):
        assert (one.value, one.stable_side, one.kind) == (other.value, other.stable_side, other.kind)
        assert one.frequency_hz == pytest.approx(other.frequency_hz, rel=1e-6)


@pytest.mark.parametrize("frames", [13, 40, 100])
def test_a_long_delay_has_the_crossing_of_all_peers_by_hand(frames: int) -> None:
    """The spectral radius of the full map, a packet a state, is 1 between the ends of the error."""
    late = Fraction(8 * frames, 1000)
    found = critical(with_values(compiled(AVERAGE), {"lan.delay": str(late)}), "coordination.stiffness")
    assert found.whole and found.known and found.value is not None and found.error is not None
    assert found.crossings[0].proof.startswith("proved")
    assert found.error < 1e-12 * found.value

    def largest(k_t: float) -> float:
        sizes = np.abs(np.linalg.eigvals(frame_matrices(Scene(kt=k_t, comm=late), 1)[0]))
        return float(np.sort(sizes)[-2])  # all can move together

    aside = 1e-6 * found.value
    assert largest(found.value - aside) < 1 < largest(found.value + aside)


@pytest.mark.few(1)
@pytest.mark.parametrize("frames", [100, 300])
def test_a_long_delay_has_the_crossing_of_a_frequency_sweep_by_hand(frames: int) -> None:
    """det(ζ − P − w ζ^(−d) Q S) goes once less around 0 for every eigenvalue beyond the circle."""
    late = f"{Fraction(8 * frames, 1000)}"
    found = critical(with_values(compiled(AVERAGE), {"lan.delay": late}), "coordination.stiffness")
    assert found.value is not None
    place = 2 * np.pi * found.crossings[0].frequency_hz * 0.008
    near = place + 0.02 / frames * np.concatenate([-np.geomspace(1, 1e-9, 3000), np.geomspace(1e-9, 1, 3000)])
    angles = np.unique(
        np.concatenate([np.geomspace(1e-7, np.pi, 3000), np.linspace(1e-3, np.pi, 60_000), near])
    )
    points = np.exp(1j * angles)

    def beyond(k_t: float) -> int:
        # Of two peers who hear each other a frame late: one's motion, what it hears and what it sends.
        full = frame_matrices(Scene(peers=2, kt=k_t), 1)[0]
        size = len(full) // 2
        first = size - 4  # of four packets x and v, the newest first, and older ones nobody hears
        p, q, s = full[:first, :first], full[:first, size + first : 2 * size], full[first:size, :first]
        total = 0
        for weight in (1.0, -0.5):  # of three peers, all alike or apart
            late = (weight * points**-frames)[:, None, None] * (q @ s)
            f = np.linalg.det(points[:, None, None] * np.eye(first) - p - late)
            f /= (1 - 1 / points) if weight == 1.0 else 1.0  # all can move together
            turn = np.angle(f[1:] / f[:-1])
            assert np.abs(turn).max() < 2.5
            total += first - round(float(turn.sum()) / np.pi)
        return total

    aside = 1e-7 * found.value
    assert [beyond(found.value - aside), beyond(found.value + aside)] == [0, 2]


def test_what_does_not_enter_the_analysis_is_said_not_to() -> None:
    found = critical(compiled(AVERAGE), "cube.x")
    assert not found.enters
    assert found.value is None
    assert "stable whatever its value: nothing that decides stability depends on it" in str(found)
    assert critical(compiled(AVERAGE), "coordination.stiffness", upper="900 N/m").enters


def test_how_far_a_search_is_can_be_followed() -> None:
    told: list[str] = []
    critical(compiled(AVERAGE), "coordination.stiffness", told=told.append)
    assert told[0].startswith("looking at ")
    assert told[-1] == "proving crossing 1 of 1"
    critical(compiled(AVERAGE), "lan.delay", upper="10 ms", told=told.append)
    assert told[-1].startswith("looking at lan.delay up to 0.01 s of 0.01 s")


def test_where_a_contact_begins_to_push_is_found_from_either_number_of_free_motions() -> None:
    """The half width of the cube, 20 mm: beyond it a device moves freely, which is one motion more."""
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8").partition("\n")[2]
    found = critical(compiled(text), "left.device.x")
    assert found.enters
    assert found.value == pytest.approx(-0.02, abs=1e-12)
    assert found.scanned[0] < -0.03, "a negative value is within what is scanned"


@pytest.mark.parametrize("b", ["0", "2"])
def test_a_stiffness_that_vanishes_is_no_crossing(b: str) -> None:
    """With the received part at once, what the own force holds follows the stiffness, down to nothing."""
    found = critical(scene("AP", delays="own", b=b), "coordination.stiffness")
    [only] = found.crossings
    assert only.proof.startswith("proved")
    assert only.stable_side == "below"
    assert found.scanned[0] == 0.0
    assert found.verdict == ""


DELAYS = ("contact.delay", "coordination.delay", "lan.delay")


@pytest.mark.few(3)
@pytest.mark.parametrize("name", DELAYS)
@pytest.mark.parametrize("times", [("0.13 ms", "1 ms", "8 ms"), ("1.37 ms", "0.61 ms", "7.19 ms")])
def test_a_scan_of_a_delay_goes_beyond_the_present_value(name: str, times: tuple[str, str, str]) -> None:
    """However many decimals the other times have: events don't coincide at every common divisor of all."""
    contact, coordination, link = times
    text = replaced(
        AVERAGE,
        (
            "stiffness: 1000 N/m, clock: haptic, delay: 1 ms",
            f"stiffness: 1000 N/m, clock: haptic, delay: {contact}",
        ),
        (
            "stiffness: 500 N/m, clock: haptic, delay: 1 ms",
            f"stiffness: 500 N/m, clock: haptic, delay: {coordination}",
        ),
        ("delay: 8 ms", f"delay: {link}"),
    )
    system = compiled(text)
    found = critical(system, name)
    assert found.scanned[0] == 0.0
    assert found.scanned[1] >= 2 * found.present
    for one in found.crossings[:1]:
        for way in (-1, 1):
            value = Fraction(one.value) * (1 + way * Fraction(1, 10**7))
            stable = analyze(apply(system, [Override(Free(name), value)])).stable
            assert stable is ((way < 0) == (one.stable_side == "below"))


def test_a_delay_that_stands_in_a_force_moves_the_force_as_well(tmp_path: Path) -> None:
    part = (
        "component: Late\nabout: A spring, stiffer the later it is.\nconnectors: {a: Flange, b: Flange}\n"
        "parameters: {stiffness: {unit: N/m}, rate: {unit: N/m/s}, clock: clock, delay: {unit: s, min: 0}}\n"
        "equations:\n  - f = (stiffness + rate*delay)*(sample(a.x) - sample(b.x))\n  - a.f = hold(f, delay)\n"
        "  - b.f = -a.f\n"
    )
    text = (
        "topology: late\nclocks: {haptic: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}\n"
        "couplers: {c: {type: Late, a: device, b: ground, stiffness: 100 N/m, rate: 1e6 N/m/s, clock: haptic,"
        " delay: 1 ms}}\n"
    )
    system = compiled(text, library(tmp_path, part))
    found = critical(system, "c.delay")
    [only] = found.crossings
    assert only.proof.startswith("proved")
    for way, stable in ((-1, True), (1, False)):
        value = Fraction(only.value) * (1 + way * Fraction(1, 10**9))
        assert analyze(apply(system, [Override(Free("c.delay"), value)])).stable is stable


def test_a_present_value_on_a_jump_is_on_the_side_of_its_own_verdict() -> None:
    """A packet that comes with a tick is seen by it: 8 ms is one with what is below, and may grow no more."""
    system = compiled(AVERAGE)
    whole = critical(
        with_values(system, {"coordination.stiffness": "690", "contact.stiffness": "100"}), "lan.delay"
    )
    jump = whole.crossings[0]
    assert jump.kind == "jump"
    assert jump.stable_side == "below"
    there = {"coordination.stiffness": "690", "contact.stiffness": "100", "lan.delay": repr(jump.value)}
    moved = with_values(system, there)
    assert analyze(moved).stable
    assert critical(moved, "lan.delay").value == jump.value
    row = next(one for one in margins(moved).rows if one.parameter == "lan.delay")
    assert (row.value, row.factor, row.kind) == (jump.value, 1.0, "jump")


@pytest.mark.parametrize(
    ("words", "got", "line"),
    [
        (["scene.yaml", "lan.delay"], "scene.yaml, then lan.delay", "apc critical lan.delay scene.yaml"),
        (["scene.yaml"], "scene.yaml alone", "apc critical contact.stiffness scene.yaml"),
    ],
)
def test_a_scene_before_its_parameter_is_told_the_order(
    words: list[str], got: str, line: str, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    assert run(["critical", *words]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    wanted = "E841 the command wants a parameter or delay, then the scene"
    assert said.err == f"apc critical: {wanted}, got {got}. Write: {line}\n"
    assert run(line.split()[1:]) == 0


def test_a_scan_from_a_value_that_means_nothing_begins_beyond_it() -> None:
    """A wave impedance of 0 divides by zero: the least value scanned is above it."""
    waves = replaced(
        (SCENES / "two-users-waves.yaml").read_text(encoding="utf-8"), ("delay: 8 ms", "delay: 72 ms")
    )
    found = critical(compiled(waves), "coordination.impedance", upper="1 N*s/m")
    assert found.verdict == "stable at every value scanned"
    assert 0 < found.scanned[0] < 1e-9


def _sides(
    system: CompiledSystem, name: str, one: Crossing, low: float, high: float, wider: int
) -> list[Fraction]:
    """Return a value on either side: some errors outside, of a jump within the stretches beside it."""
    if one.kind == "jump":
        free, at = find(system, name, Place("test")), Fraction(one.value).limit_denominator(10**9)
        following = borders(system, free, place=Place("test"))
        after = following(at + Fraction(one.error))
        before = Fraction(low)
        while (further := following(before)) < at - Fraction(one.error):
            before = further
        inside = Fraction(28_571, 104_729)
        return [before + inside * (at - Fraction(one.error) - before), at + inside * (after - at)]
    width = wider * Fraction(one.error)
    return [max(Fraction(one.value) - width, Fraction(low)), min(Fraction(one.value) + width, Fraction(high))]


FIRST = [HARD / "boundary-inside-13.yaml", SCENES / "three-users-average.yaml", SCENES / "finger.yaml"]


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "path",
    [*FIRST, *sorted({*SCENES.glob("*.yaml"), *HARD.glob("*.yaml")} - {*FIRST})],
    ids=lambda path: path.stem,
)
def test_every_crossing_that_is_answered_is_one_between_two_analyses(path: Path) -> None:
    """Of each delay and the first stiffness: other verdicts on its two sides, none of them open."""
    system = compile_topology(path)
    names = [one.label for one in coupler_parameters(system) if one.label.endswith("stiffness")][:1]
    for name in [*(one.label for one in _delays(system)), *names]:
        try:
            found = critical(system, name, criterion="nominal")
        except ApcError as error:
            assert error.mistakes[0].code in ("E804", "E805", "E844", "E845", "E846"), error
            continue
        for one in found.crossings:
            # A bound of the analysis may be wider than the crossing's own, which pairs of balls have proved.
            for wider in (2, 32, 512):
                below, above = (
                    analyze(apply(system, [Override(find(system, name, Place("test")), value)])).stable
                    for value in _sides(system, name, one, *found.scanned, wider)
                )
                if None not in (below, above):
                    break
            assert (below, above) == ((True, False) if one.stable_side == "below" else (False, True)), one
