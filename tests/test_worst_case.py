"""The worst that losses can do, beside reference numbers, frames made by hand, and a scene played in time."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import prepare
from apc.compiler.errors import ApcError
from apc.eigen.dissipation import peak_gain
from apc.frame.radius import value_of
from apc.moments.worst import (
    MANY,
    HeldParts,
    LossesInARow,
    growths,
    held_parts,
    pattern_of,
    trace_of_worst,
    words,
    worst_case,
)
from tests.held_scenes import frames, growth, scene, system_of

# Of an independent program, for the paper's users: peers, stiffness, losses in a row certified, gains of the
# common and the difference mode; per number of losses in a row the growth of a word, gaps from one packet
# heard to the next. Those gains are the largest at some frequencies, and so are a little small.
REFERENCE = (
    (2, 200.0, 7, 0.13008618249962528, 0.19447550250916557, (
        (0.9292213283354882, (1, 1)), (0.9340250046659111, (2,)), (0.941840166614254, (3, 3, 3)),
        (0.9489965057545886, (4,)), (0.956560236613119, (2, 2, 5, 5)), (0.9615036604849657, (1, 1, 6, 6)),
    )),
    (2, 900.0, 0, 0.4053758721672726, 1.6960277573050668, (
        (0.9729427522313283, (1, 1, 1, 1)), (0.9900862106511591, (2, 2)), (1.00595004998628, (1, 3, 3)),
        (1.0324258686693404, (1, 1, 1, 4)), (1.0499465063087625, (1, 1, 5)), (1.060865272817701, (1, 1, 6)),
    )),
    (3, 500.0, 1, 0.3830957862273998, 0.7959235530782178, (
        (0.9571713896250952, (1, 1, 1)), (0.9571713896250952, (1, 1, 1)), (0.9571713896250952, (1, 1, 1)),
        (0.9571713896250952, (1, 1, 1)), (0.9571713896250952, (1, 1, 1)), (0.9636836627392561, (1, 1, 1, 6)),
    )),
    (3, 1000.0, 0, 0.6961393695693204, 10.445985519815636, ((0.9925878051132254, (1,)),) * 6),
    (5, 700.0, 0, 0.7978268554671122, 3.550440324134869, (
        (0.9724454937170446, (1, 1, 1)), (0.9724454937170446, (1, 1, 1)), (0.9844548597768422, (2, 3)),
        (0.9844548597768422, (2, 3)), (0.9844548597768422, (2, 3)), (0.9844548597768422, (2, 3)),
    )),
)  # fmt: skip


def parts_of(text: str) -> HeldParts:
    system = system_of(text)
    found = held_parts(system, prepare(system))
    assert isinstance(found, HeldParts)
    return found


def losses(text: str) -> LossesInARow:
    system = system_of(text)
    return worst_case(system, prepare(system))


@pytest.mark.parametrize(
    ("peers", "stiffness", "certified", "common", "difference", "lower"),
    REFERENCE,
    ids=[f"{one[0]} users, {one[1]:g} N/m" for one in REFERENCE],
)
def test_gains_words_and_certified_losses_are_those_of_the_reference(
    peers: int,
    stiffness: float,
    certified: int,
    common: float,
    difference: float,
    lower: tuple[tuple[float, tuple[int, ...]], ...],
) -> None:
    text = scene(peers, stiffness)
    parts = parts_of(text)
    gains = [peak_gain(*map(value_of, part.off))[0] for part in parts.parts]
    for gain, known in zip(gains, (common, difference), strict=True):
        assert known * (1 - 1e-12) <= gain <= known * (1 + 2e-6)
    most = 0.0
    for number, (known, word) in enumerate(lower):
        own = max(growths(part, [word]).max() for part in parts.parts)
        assert own == pytest.approx(known, rel=1e-12)
        most = max(most, *(growths(part, words(number)).max() for part in parts.parts))
        assert most >= known * (1 - 1e-12)
    found = losses(text)
    assert found.certified == certified
    unstable = [number for number, (known, _) in enumerate(lower) if known > 1]
    if unstable:
        assert found.unstable_pattern is not None
        assert in_a_row(found.unstable_pattern) == unstable[0]


def in_a_row(pattern: tuple[bool, ...]) -> int:
    """Return the most losses in a row of a pattern that repeats."""
    longest = run = 0
    for lost in (*pattern, *pattern):
        run = run + 1 if lost else 0
        longest = max(longest, run)
    return longest


@pytest.mark.parametrize(("peers", "stiffness"), [(2, 900.0), (5, 900.0), (3, 1000.0), (2, 200.0)])
def test_a_pattern_that_shakes_grows_as_it_says_where_every_channel_is_followed(
    peers: int, stiffness: float
) -> None:
    found = losses(scene(peers, stiffness))
    assert found.unstable_pattern is not None
    assert found.growth is not None
    own = frames(peers, stiffness)
    heard = [np.full(len(own.pairs), 0.0 if lost else 1.0) for lost in found.unstable_pattern]
    assert growth([own.matrix(one) for one in heard]) == pytest.approx(found.growth, abs=1e-9)
    assert found.growth > 1


def test_who_drifts_anyhow_is_told_so() -> None:
    # Copies that nothing holds, one of them moving on for ever: no loss makes it grow, and none is harmless.
    text = scene(2, 0.0).replace("1000 N/m", "0 N/m").replace("0.6 kg, damping: 5", "0.6 kg, damping: 0")
    found = losses(text)
    assert found.certified is None
    assert found.unstable_pattern is None
    assert found.note.startswith("the scene is not proved to settle with no packet lost; no pattern tried")


def test_five_users_that_survive_chance_are_shaken_by_two_losses_in_a_row() -> None:
    found = losses(scene(5, 900.0, loss="40 %"))
    assert found.unstable_pattern == (True, False, True, True, False)
    assert found.growth == pytest.approx(1.0151, abs=5e-5)


def test_who_shakes_anyhow_is_shaken_by_no_loss_at_all() -> None:
    found = losses(scene(3, 1100.0))
    assert found.certified is None
    assert found.unstable_pattern == (False,)
    assert found.growth == pytest.approx(math.sqrt(1.0005576554441589), abs=1e-10)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("peers", "stiffness", "damping", "coupler", "operator"),
    [
        (3, 500.0, 0.0, "AveragePosition", "mean"),
        (3, 250.0, 1.0, "FullMesh", "sum"),
        (2, 200.0, 0.0, "AveragePosition", "mean"),
        (4, 300.0, 0.7, "AveragePosition", "mean"),
    ],
)
def test_certified_losses_follow_from_the_gain_over_all_users_and_every_pattern_of_them_settles(
    peers: int, stiffness: float, damping: float, coupler: str, operator: str
) -> None:
    found = losses(scene(peers, stiffness, damping=damping, coupler=coupler))
    own = frames(peers, stiffness, damping, operator)
    # d ← r of all users at once, q = x + B/K v, on a fine grid around its largest.
    n, combine = len(own.a), np.array([1.0, damping / stiffness])
    first = [next(p for p, (_, j) in enumerate(own.pairs) if j == sender) for sender in range(peers)]
    q = np.stack([combine @ own.c[2 * place : 2 * place + 2] for place in first])
    repeated = np.concatenate([own.c[2 * place : 2 * place + 2] for place in range(len(own.pairs))])
    r = np.zeros((n, peers))
    for place, (i, _) in enumerate(own.pairs):
        r[:, i] += own.b[:, 2 * place] / (1 if operator == "mean" else peers - 1)

    def gain(angle: float) -> float:
        z = np.exp(1j * angle)
        # x⁺ = A x + B C x / z + R r, and d = (1 − 1/z) q
        state = np.linalg.solve(z * np.eye(n) - own.a - own.b @ repeated / z, r)
        return float(np.linalg.norm((1 - 1 / z) * q @ state, 2))

    weight = 1.0 if operator == "mean" else peers - 1.0
    angles = np.linspace(1e-3, math.pi, 2000)
    largest = max(map(gain, angles)) * weight
    parts = parts_of(scene(peers, stiffness, damping=damping, coupler=coupler))
    computed = max(peak_gain(*map(value_of, part.off))[0] for part in parts.parts) * parts.weight
    assert parts.weight == pytest.approx(weight, rel=1e-12)
    assert largest <= computed * (1 + 1e-12)
    assert largest == pytest.approx(computed, rel=1e-3)
    assert found.certified is not None
    certified = found.certified
    assert computed < 2 * math.sin(math.pi / (4 * certified + 2))
    assert certified == 0 or computed >= 2 * math.sin(math.pi / (4 * certified + 6))
    # Every channel by itself, at random, with as many losses in a row as are certified.
    luck = np.random.default_rng(7)
    for _ in range(8):
        run = np.zeros(len(own.pairs), np.intp)
        listed = []
        for frame in range(40):
            lost = (run < certified) & (luck.random(len(run)) < 0.7) & (frame > 0)
            run = np.where(lost, run + 1, 0)
            listed.append(own.matrix(1.0 - lost))
        assert growth(listed) < 1


def test_the_norm_of_a_block_of_losses_is_that_of_a_triangle_of_ones() -> None:
    for number in (1, 2, 3, 10, 50):
        norm = np.linalg.norm(np.tril(np.ones((number, number))), 2)
        assert norm == pytest.approx(1 / (2 * math.sin(math.pi / (4 * number + 2))), rel=1e-13)


def test_a_mesh_is_an_average_of_so_many_times_the_stiffness() -> None:
    average, mesh = losses(scene(4, 1000.0)), losses(scene(4, 1000.0 / 3, coupler="FullMesh"))
    assert average.certified == mesh.certified
    assert average.growth is not None
    assert average.unstable_pattern == mesh.unstable_pattern
    assert average.growth == pytest.approx(mesh.growth, rel=1e-12)


def test_a_million_users_are_as_three() -> None:
    assert losses(scene(1_000_000, 100.0)).certified is not None


def test_groups_of_equal_users_are_those_written_one_by_one() -> None:
    text = scene(4, 300.0)
    groups = text.replace(
        "  user: {count: 4}",
        "  left: {count: 1, set: {device.mass: 0.2 kg}}\n  right: {count: 3}",
    )
    single = text.replace(
        "  user: {count: 4}",
        "  left: {count: 1, set: {device.mass: 0.2 kg}}\n"
        "  one: {count: 1}\n  two: {count: 1}\n  three: {count: 1}",
    )
    # A complete graph of which every edge is written is one of any shape: all peers are one system.
    edges = "{edges: [[1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]}"
    dense = groups.replace("delay: 8 ms, loss", f"delay: 8 ms, graph: {edges}, loss")
    found = [parts_of(one) for one in (groups, single, dense)]
    gains = [max(peak_gain(*map(value_of, part.off))[0] for part in one.parts) * one.weight for one in found]
    assert gains == pytest.approx([gains[0]] * 3, rel=1e-10)
    answers = [losses(one) for one in (groups, single, dense)]
    assert len({one.certified for one in answers}) == 1
    assert len({one.unstable_pattern for one in answers}) == 1


@pytest.mark.parametrize(
    ("shape", "edges"),
    [
        ("ring", "[[1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [6, 1]]"),
        ("star", "[[1, 2], [1, 3], [1, 4], [1, 5], [1, 6]]"),
    ],
)
def test_rings_and_stars_are_what_their_edges_make(shape: str, edges: str) -> None:
    own = scene(6, 200.0, more=f", graph: {shape}")
    written = scene(6, 200.0, more=f", graph: {{edges: {edges}}}")
    found, known = losses(own), losses(written)
    assert found.certified == known.certified == 1
    assert found.unstable_pattern == known.unstable_pattern
    assert found.growth == pytest.approx(known.growth, rel=1e-12)
    # In units of their own, means have the norm 1, however many hear one of them.
    assert [parts_of(text).weight for text in (own, written)] == pytest.approx([1.0, 1.0], rel=1e-12)


def test_who_feels_nothing_of_the_others_bears_any_losses() -> None:
    for stiffness in (0.0, 1e-3):
        found = losses(scene(3, stiffness))
        assert found == LossesInARow(
            MANY, None, None, "1,000 losses in a row are harmless, where counting ends"
        )


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (", on_loss: zero", "lan takes no difference where a packet is missed (on_loss: zero)"),
        (", jitter: 2 ms", "lan has jitter"),
    ],
)
def test_what_is_not_served_is_named(more: str, why: str) -> None:
    found = losses(scene(3, 500.0, more=more))
    assert found.certified is None
    assert found.unstable_pattern is None
    assert found.growth is None
    assert found.note == f"losses in a row are left open: {why}"


def test_more_packets_than_one_a_frame_and_too_many_peers_are_refused() -> None:
    twice = losses(scene(3, 500.0).replace("network: 8 ms", "network: 8 ms, slow: 16 ms").replace(
        "  coordination:\n",
        "  other: {type: AveragePosition, object: cube, stiffness: 1 N/m, clock: haptic, link: wan}\n"
        "  coordination:\n",
    ) + "  wan: {clock: slow, delay: 16 ms}\n")  # fmt: skip
    assert "lan sends more than one packet in a frame of 0.016 s" in twice.note
    many = losses(scene(200, 500.0, more=", graph: ring"))
    assert many.certified is None
    assert "200 peers on a graph that is not complete are too many: 120 are the most" in many.note
    masses = ", ".join(f"{0.1 + peer / 1000:.3f} kg" for peer in range(300))
    text = scene(300, 500.0).replace("count: 300", f"count: 300, set: {{device.mass: [{masses}]}}")
    assert "300 different peers have 1,200 states, and 1,000 are the most" in losses(text).note


def test_reliable_links_are_not_asked_about() -> None:
    assert losses(scene(3, 500.0).replace(", loss: 10 %", "")).note.endswith("every link is reliable")


def test_every_short_word_is_tried_once() -> None:
    found = [word for number in range(10) for word in words(number) if sum(word) <= 10]
    turned = {min((*word[k:], *word[:k]) for k in range(len(word))) for word in found}
    assert len(turned) == len(found)
    # Necklaces of 1 to 10 beads that repeat nothing, less the one of a lost packet alone (Moreau, 1872).
    assert len(found) == sum((2, 1, 2, 3, 6, 9, 18, 30, 56, 99)) - 1
    assert pattern_of((1, 3)) == (False, True, True, False)


def test_the_pattern_is_played_and_grows_as_it_says() -> None:
    text = scene(2, 900.0).replace(
        "  user: {count: 2}", "  left: {count: 1, set: {device.x: 1 mm}}\n  right: {count: 1}"
    )
    system = system_of(text)
    found = worst_case(system, prepare(system))
    assert found.unstable_pattern is not None
    assert found.growth is not None
    played = apc.simulate(system, duration="6 s", trace_of="worst", jit=False)
    apart = played["left[1].cube.x"] - played["right[1].cube.x"]
    # The pattern takes three frames of eight rows; many of its periods, far from the start.
    sizes = [float(np.abs(apart[start : start + 600]).max()) for start in (2400, 5280)]
    assert (sizes[1] / sizes[0]) ** (8 / 2880) == pytest.approx(found.growth, abs=1e-4)
    channel = trace_of_worst(system).links[0].channel
    assert channel is not None
    assert channel.trace is not None
    assert channel.trace.tolist() == [math.inf, math.inf, 0.008]


@pytest.mark.parametrize(
    ("delay", "clock"),
    [("6.5 ms", "8 ms"), ("0 ms", "8 ms"), ("27.3 ms", "8 ms"), ("8 ms", "{period: 8 ms, phase: 2.5 ms}")],
)
def test_a_pattern_moves_a_scene_from_period_to_period_by_its_matrices(delay: str, clock: str) -> None:
    # What two copies are apart, period by period, follows the characteristic polynomial of all modes.
    text = scene(3, 900.0, damping=0.5, delay=delay).replace("network: 8 ms", f"network: {clock}")
    system = system_of(
        text.replace("  user: {count: 3}", "  left: {count: 1, set: {device.x: 1 mm}}\n  right: {count: 2}")
    )
    found = held_parts(system, prepare(system))
    assert isinstance(found, HeldParts)
    pattern = pattern_of((1, 3))
    values: list[complex] = []
    for part in found.parts:
        product = np.eye(part.heard.f.shape[-1])
        for lost in pattern:
            product = value_of(part.heard.frame(lost=lost)) @ product
        values += [value for value in np.linalg.eigvals(product).tolist() if abs(value) > 1e-12]
    recurrence = np.poly(np.array(values)).real[::-1]
    link = system.links[0]
    assert link.channel is not None
    seconds = {timing.name: float(timing.value) for timing in system.timings}[link.delay]
    channel = replace(link.channel, loss=None, trace=np.where(pattern, np.inf, seconds))
    played = apc.simulate(replace(system, links=(replace(link, channel=channel),)), duration="1 s", jit=False)
    apart = (played["left[1].cube.x"] - played["right[1].cube.x"])[:: 8 * len(pattern)]
    for start in (6, 8, 10):
        some = apart[start : start + len(recurrence)]
        assert len(some) == len(recurrence)
        assert abs(recurrence @ some) <= 1e-11 * (np.abs(recurrence) @ np.abs(some))


def test_where_nothing_shakes_there_is_nothing_to_play() -> None:
    with pytest.raises(ApcError, match="E897 --trace-of worst has nothing to play: no pattern tried"):
        apc.simulate(system_of(scene(3, 300.0)), trace_of="worst")
    with pytest.raises(ApcError, match=r"E897 --trace-of worst has nothing to play: .* lan has jitter"):
        apc.simulate(system_of(scene(3, 300.0, more=", jitter: 1 ms")), trace_of="worst")


def test_the_command_plays_the_pattern_or_says_why_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lossy.yaml"
    words = ["simulate", str(path), "--trace-of", "worst", "--duration", "0.1 s", "--json", "--no-jit"]
    path.write_text(scene(2, 900.0), encoding="utf-8")
    assert run(words) == 0
    assert json.loads(capsys.readouterr().out)["topology"] == "lossy"
    path.write_text(scene(2, 50.0), encoding="utf-8")
    assert run(words) == 1
    message = "E897 --trace-of worst has nothing to play: no pattern tried of fewer than 40 losses in a row"
    assert message in capsys.readouterr().err
