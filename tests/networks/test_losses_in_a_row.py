"""The worst that losses can do: certified losses in a row, patterns that shake, and those patterns played.

Reference numbers are of an independent program; patterns are also multiplied by hand, every channel followed.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.extensions.loss_models.dropout_bounds import worst_case
from apc.lifting.numeric_model import numeric_model
from apc.mean_square.loss_results import ConsecutiveLosses, LossCertificate
from tests.held_topologies import frames, growth, system_of, topology
from tests.published.by_hand import held
from tests.topologies import ROOT, replaced


def losses(text: str) -> ConsecutiveLosses:
    return worst_case(numeric_model(system_of(text)))


def longest(pattern: tuple[bool, ...]) -> int:
    """Return the most losses in a row of a pattern that repeats."""
    return max(map(len, "".join(".x"[lost] for lost in (*pattern, *pattern)).split(".")))


# Peers, stiffness, losses in a row certified, the fewest in a row of a pattern that grows.
@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("peers", "stiffness", "certified", "unstable"),
    [(2, 200.0, 7, None), (2, 900.0, 0, 2), (3, 500.0, 1, None), (3, 1000.0, 0, None), (5, 700.0, 0, None)],
)
def test_certified_losses_and_patterns_that_shake_are_those_of_the_reference(
    peers: int, stiffness: float, certified: int, unstable: int | None
) -> None:
    found = losses(topology(peers, stiffness))
    assert found.certified == certified
    if found.unstable_pattern is None:
        assert unstable is None
        return
    # The reference looked at no more than five losses in a row.
    assert longest(found.unstable_pattern) == unstable or (
        unstable is None and len(found.unstable_pattern) > 5
    )
    own = frames(peers, stiffness)
    received = [np.full(len(own.pairs), 0.0 if lost else 1.0) for lost in found.unstable_pattern]
    assert found.growth == pytest.approx(growth([own.matrix(one) for one in received]), abs=1e-9)
    assert found.growth > 1


def test_who_shakes_or_drifts_anyhow_is_told_so() -> None:
    found = losses(topology(3, 1100.0))
    assert (found.certified, found.unstable_pattern) == (None, (False,))
    assert found.growth == pytest.approx(math.sqrt(1.0005576554441589), abs=1e-10)
    # Copies that nothing holds, one of them moving on for ever: no loss makes it grow, and none is harmless.
    text = topology(2, 0.0).replace("1000 N/m", "0 N/m").replace("0.6 kg, damping: 5", "0.6 kg, damping: 0")
    found = losses(text)
    assert (found.certified, found.unstable_pattern) == (None, None)
    assert found.note.startswith("stability without packet loss is not proved; no unstable periodic")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("peers", "stiffness", "damping", "coupler", "operator", "known"),
    [
        (3, 500.0, 0.0, "AveragePosition", "mean", 1),
        (3, 250.0, 1.0, "FullMesh", "sum", 1),
        (2, 200.0, 0.0, "AveragePosition", "mean", 7),
        (4, 300.0, 0.7, "AveragePosition", "mean", 2),
    ],
)
def test_every_pattern_of_certified_losses_settles(
    peers: int, stiffness: float, damping: float, coupler: str, operator: str, known: int
) -> None:
    """Every channel by itself, at random, with as many losses in a row as are certified."""
    certified = losses(topology(peers, stiffness, damping=damping, coupler=coupler)).certified
    own = frames(peers, stiffness, damping, operator)
    assert certified == known
    noise, listed, run_ = np.random.default_rng(7), [], np.zeros(len(own.pairs), np.intp)
    for frame in range(200):
        lost = (run_ < certified) & (noise.random(len(run_)) < 0.7) & (frame > 0)
        run_ = np.where(lost, run_ + 1, 0)
        listed.append(own.matrix(1.0 - lost))
    assert growth(listed) < 1


@pytest.mark.whole
def test_groups_rings_and_stars_are_what_is_written_peer_by_peer_and_edge_by_edge() -> None:
    heavy = "  left: {count: 1, set: {device.mass: 0.2 kg}}\n"
    groups, single = (
        replaced(topology(4, 300.0), ("  user: {count: 4}", heavy + rest))
        for rest in ("  right: {count: 3}", "  one: {count: 1}\n  two: {count: 1}\n  three: {count: 1}")
    )
    edges = "graph: {edges: [[1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]}"
    dense = groups.replace("delay: 8 ms, loss", f"delay: 8 ms, {edges}, loss")
    ring, star = (
        [topology(6, 200.0, more=f", graph: {shape}") for shape in (name, f"{{edges: {listed}}}")]
        for name, listed in (
            ("ring", "[[1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [6, 1]]"),
            ("star", "[[1, 2], [1, 3], [1, 4], [1, 5], [1, 6]]"),
        )
    )
    for interchangeable in ([groups, single, dense], ring, star):
        known, *others = map(losses, interchangeable)
        for found in others:
            assert (found.certified, found.unstable_pattern) == (known.certified, known.unstable_pattern)
            assert (found.growth or 0.0) == pytest.approx(known.growth or 0.0, rel=1e-12)


@pytest.mark.parametrize("stiffness", [0.0, 1e-3])
def test_who_feels_nothing_of_the_others_bears_any_losses(stiffness: float) -> None:
    note = "at least 1,000 consecutive losses are harmless; more were not analyzed"
    found = ConsecutiveLosses(1000, None, None, note, LossCertificate.SMALL_GAIN)
    assert losses(topology(3, stiffness)) == found


TWICE = (
    replaced(topology(3, 500.0), ("network: 8 ms", "network: 8 ms, slow: 16 ms"), ("  coordination:\n", "  other: {type: AveragePosition, object: cube, stiffness: 1 N/m, clock: haptic, link: wan}\n  coordination:\n"))  # noqa: E501
    + "  wan: {clock: slow, delay: 16 ms}\n"
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            topology(3, 500.0, more=", on_loss: zero"),
            "lan does not set the difference to 0 for a lost packet",
        ),
        (topology(3, 500.0, more=", jitter: 2 ms"), "lan has jitter"),
        (TWICE, "lan sends more than one packet in a frame of 0.016 s"),
        # Of two packets between ticks of the forces one is heard only where the other is lost.
        (
            topology(3, 500.0, delay="9 ms").replace("haptic: 1 ms", "haptic: 16 ms"),
            "lan sends more than one",
        ),
        (
            topology(200, 500.0, more=", graph: ring"),
            "200 peers on a graph that is not complete; the limit is",
        ),
    ],
)
def test_what_is_not_served_is_left_open_and_named(text: str, why: str) -> None:
    found = losses(text)
    assert (found.certified, found.unstable_pattern, found.growth) == (None, None, None)
    assert found.note.startswith("consecutive losses are undecided: ") and why in found.note


@pytest.mark.whole
@pytest.mark.parametrize(
    ("delay", "clock"),
    [("8 ms", "8 ms"), ("6.5 ms", "8 ms"), ("27.3 ms", "8 ms"), ("8 ms", "{period: 8 ms, phase: 2.5 ms}")],
)
def test_the_pattern_is_played_and_grows_as_it_says(delay: str, clock: str) -> None:
    apart = "  left: {count: 1, set: {device.x: 1 mm}}\n  right: {count: 1}"
    text = topology(2, 900.0, delay=delay).replace("  user: {count: 2}", apart)
    model = system_of(text.replace("network: 8 ms", f"network: {clock}"))
    found = apc.mean_square_stability(model)
    assert found is not None and found.losses_in_a_row is not None
    pattern, grown = found.losses_in_a_row.unstable_pattern, found.losses_in_a_row.growth
    assert pattern is not None and grown is not None
    played = apc.simulate(model, duration="6 s", trace_of="worst", jit=False)
    moved = played["left[1].cube.x"] - played["right[1].cube.x"]
    # Rows come every millisecond, frames every eight; many periods of the pattern, far from the start.
    many = 360 // len(pattern) * len(pattern)
    sizes = [float(np.abs(moved[start : start + 600]).max()) for start in (2400, 2400 + 8 * many)]
    assert (sizes[1] / sizes[0]) ** (1 / many) == pytest.approx(grown, abs=6e-4)


def test_the_command_plays_the_pattern_or_says_why_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lossy.yaml"
    words = ["simulate", str(path), "--trace-of", "worst", "--duration", "0.1 s", "--json", "--no-jit"]
    path.write_text(topology(2, 900.0), encoding="utf-8")
    assert run(words) == 0
    assert json.loads(capsys.readouterr().out)["topology"] == "lossy"
    path.write_text(topology(2, 50.0), encoding="utf-8")
    assert run(words) == 1
    message = "E897 --trace-of worst has no pattern: no unstable periodic loss pattern found with fewer"
    assert message in capsys.readouterr().err
    with pytest.raises(ApcError, match=r"E897 --trace-of worst has no pattern: .* lan has jitter"):
        apc.simulate(system_of(topology(3, 300.0, more=", jitter: 1 ms")), trace_of="worst")


LOOP = ROOT / "models" / "published" / "xiong-lam-2007" / "lossy-feedback.yaml"
PROCESS, FORCE, GAIN = np.array([[0, 1], [0, -0.1]]), np.array([[0], [0.1]]), np.array([[3.75, 11.5]])
# The period, and the numbers of the common quadratic function and of the small gain.
LOOPS = [(0.8, 1, 0), (0.4, 3, 2), (0.2, 7, 5), (0.16, 9, 7)]


def loop_losses(period: float) -> ConsecutiveLosses:
    found = apc.mean_square_stability(LOOP, params={"tick.period": period})
    assert found is not None and found.losses_in_a_row is not None
    return found.losses_in_a_row


def radii(products: np.ndarray) -> np.ndarray:
    return abs(np.linalg.eigvals(products)).max(axis=-1)


@pytest.mark.parametrize(("period", "certified"), [case[:2] for case in LOOPS])
def test_a_common_function_certifies_more_losses_and_the_next_number_has_an_unstable_pattern(
    period: float, certified: int
) -> None:
    """One channel: all sequences of eight frames, and all of four gaps, of the process stepped by hand."""
    found = loop_losses(period)
    assert (found.certified, found.certificate) == (certified, LossCertificate.COMMON_FUNCTION)
    assert found.unstable_pattern is not None and longest(found.unstable_pattern) == certified + 1
    free, push = held(PROCESS, FORCE, period)
    # The states are x, x' and the held control.
    steps = {
        True: np.block([[free, push], [np.zeros((1, 2)), np.eye(1)]]),
        False: np.block([[free - push @ GAIN, np.zeros((2, 1))], [-GAIN, np.zeros((1, 1))]]),
    }

    def product(pattern: tuple[bool, ...]) -> np.ndarray:
        return np.linalg.multi_dot([np.eye(3), *(steps[lost] for lost in reversed(pattern)), np.eye(3)])

    patterns = [
        pattern
        for frames_ in range(1, 9)
        for pattern in itertools.product((False, True), repeat=frames_)
        if not all(pattern) and longest(pattern) <= certified
    ]
    assert radii(np.array([product(pattern) for pattern in patterns])).max() < 1
    gaps = np.array([product((True,) * lost + (False,)) for lost in range(certified + 1)])
    products = gaps
    for _ in range(3):
        products = (gaps[:, None] @ products).reshape(-1, 3, 3)
        assert radii(products).max() < 1
    growth_ = radii(product(found.unstable_pattern)) ** (1 / len(found.unstable_pattern))
    assert found.growth == pytest.approx(growth_, rel=1e-12) and found.growth > 1


@pytest.mark.parametrize(("period", "certified"), [(period, small) for period, _, small in LOOPS])
def test_without_cvxpy_the_small_gain_certifies_and_the_note_names_what_is_missing(
    period: float, certified: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    found = loop_losses(period)
    assert found.certified == certified
    assert found.certificate == (LossCertificate.SMALL_GAIN if certified else None)
    assert "no common quadratic function was sought: cvxpy is not installed (pip install" in found.note


def test_the_unstable_pattern_of_a_loop_is_simulated() -> None:
    played = apc.simulate(LOOP, params={"body.v": 1.0}, duration="96 s", trace_of="worst", jit=False)
    speed = abs(played["user[1].body.x"])
    assert max(speed[-3:]) > 1e6
