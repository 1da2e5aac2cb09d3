"""Users who join and leave: against all peers of the paper's topology, stepped by hand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.compiler.errors import ApcError
from tests.bruteforce import TopologySource, frame_matrix
from tests.commands import Cli
from tests.topologies import TOPOLOGIES

pytestmark = pytest.mark.needs_extension("changing_counts")

Floats = NDArray[np.float64]
SIZE = 14  # values of a peer
AVERAGE, MESH = TOPOLOGIES / "three-users-average.yaml", TOPOLOGIES / "three-users-mesh.yaml"


def source(operator: str, peers: int) -> TopologySource:
    """Return the topology of three-users-average, or of the mesh, with another number of peers."""
    return TopologySource(operator, peers, kt=500.0, cube=0.6 / peers)


def all_peers(operator: str, peers: int) -> Floats:
    """Return the frame matrix of all peers, peer by peer."""
    return np.array(frame_matrix(source(operator, peers)))


def deviation(matrix: Floats, peers: int) -> Floats:
    """Return the map of d over a frame, for deviations d and -d of the first two peers."""
    size = len(matrix) // peers
    return matrix[:size, :size] - matrix[:size, size : 2 * size]


def test_a_sequence_that_grows_does_so_for_all_peers() -> None:
    """Two peers stay; the others join at their mean, and leave two frames later."""
    found = apc.changing_counts(AVERAGE, "user.count=2:5")
    assert found.verdict == "unstable under a sequence of changes" and sorted(found.sequence) == [2, 5, 5]
    steps = {count: all_peers("mean", count) for count in (2, 5)}
    product = np.eye(len(steps[2]) // 2)
    for count in found.sequence:
        product = deviation(steps[count], count) @ product
    radius = abs(np.linalg.eigvals(product)).max()
    assert found.growth == pytest.approx(radius ** (1 / 3), rel=1e-10)
    assert all(apc.analyze(AVERAGE, params={"user.count": count}).stable for count in range(2, 6))


def changed(state: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return the states (n, s) of another number of peers: at random who leaves; who joins is at the mean."""
    while len(state) > count:
        state = np.delete(state, rng.integers(len(state)), axis=0)
    return np.vstack([state, *[state.mean(axis=0)] * (count - len(state))])


@pytest.mark.parametrize(("counts", "frames"), [("2:3", 1), ("3:4", 1), ("2:5", 12)])
def test_under_any_changes_that_are_rare_enough_all_peers_come_to_rest(counts: str, frames: int) -> None:
    found = apc.changing_counts(AVERAGE, f"user.count={counts}")
    assert (found.dwell_frames or 1) == frames
    steps = {count: all_peers("mean", count) for count in found.counts}
    rng, count = np.random.default_rng(0), found.counts[0]
    state = rng.standard_normal((count, len(steps[count]) // count))
    for _ in range(400):
        count = int(rng.choice(found.counts))
        state = changed(state, count, rng)
        for _ in range(frames):
            state = (steps[count] @ state.ravel()).reshape(state.shape)
    assert abs(state[:, 1]).max() < 1e-6 * abs(state[:, 0]).max()  # velocities; positions have a common one
    assert np.ptp(state[:, 0]) < 1e-6


@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_products_up_to_eight_frames_agree_with_the_verdict(operator: str) -> None:
    """All sequences of up to eight numbers from 2 to 4 by brute force."""
    found = apc.changing_counts(AVERAGE if operator == "mean" else MESH, "user.count=2:4")
    steps = {count: deviation(all_peers(operator, count), count) for count in (2, 3, 4)}
    stack, length, growth = np.array([np.eye(len(steps[2]))]), 0, 0.0
    for length in range(1, 9):
        stack = np.concatenate([step @ stack for step in steps.values()])
        growth = max(growth, float((abs(np.linalg.eigvals(stack)).max(axis=1) ** (1 / length)).max()))
    if found.verdict == "stable under arbitrary changes":
        assert growth < 1
    if found.sequence:
        assert 1 < found.growth <= growth * (1 + 1e-9)
    else:
        assert growth < 1


def change(before: int, after: int, first: int) -> Floats:
    """Return the map of all peers' values at a change of their number.

    The peers from index `first` on leave. Those that join have the mean of the others.
    """
    if after < before:
        staying = [peer for peer in range(before) if not first <= peer < first + before - after]
        return np.kron(np.eye(before)[staying], np.eye(SIZE))
    joining = np.kron(np.full((after - before, before), 1 / before), np.eye(SIZE))
    return np.vstack([np.eye(SIZE * before), joining])


def products(operator: str, first: int) -> dict[int, Floats]:
    """Return the products of all sequences of up to eight changes from two peers to two, by their length."""
    steps = {count: all_peers(operator, count) for count in (2, 3, 4)}
    stacks, result = {2: np.eye(2 * SIZE)[None]}, dict[int, Floats]()
    for length in range(1, 9):
        after = {
            count: np.concatenate(
                [step @ (change(before, count, first) @ stack) for before, stack in stacks.items()]
            )
            for count, step in steps.items()
        }
        stacks, result[length] = after, after[2]
    return result


@pytest.mark.parametrize("first", [0, 2])
@pytest.mark.parametrize("operator", ["mean", "sum"])
def test_products_of_frames_joins_and_leaves_agree_with_the_verdict(operator: str, first: int) -> None:
    """All peers, at the mean of the others, and relative to the common translation.

    A growing sequence needs two peers that stay: those that joined leave first.
    """
    found = apc.changing_counts(AVERAGE if operator == "mean" else MESH, "user.count=2:4")
    largest = 0.0
    for length, stack in products(operator, first).items():
        values = np.linalg.eigvals(stack)
        rigid = abs(values - 1).argmin(axis=1)
        assert abs(values[np.arange(len(values)), rigid] - 1).max() < 1e-9
        values[np.arange(len(values)), rigid] = 0.0
        largest = max(largest, float((abs(values).max(axis=1) ** (1 / length)).max()))
    if found.sequence and first == 2:
        assert largest > 1
    else:
        assert largest < 1


def test_a_number_that_is_unstable_alone_is_named() -> None:
    found = apc.changing_counts(MESH, "user.count=2:6")
    assert found.verdict == "unstable under a sequence of changes"
    assert len(found.sequence) == 1 and not apc.analyze(MESH, params={"user.count": found.sequence[0]}).stable
    assert found.dwell_frames is None and "for example with user.count = " in str(found)


BAD = {
    "contact.stiffness=2 N/m:3 N/m": r"E890 .*, got contact.stiffness. Try: .*user.count=2:10",
    "device.mass=2:5": r'E890 .*, got device.mass. Try: --changing "user.count=2:10"',
    "user.count": r"E890 changing count: expected NAME=LOW:HIGH, got user.count",
    "user.count=5:2": r'E881 .*: expected the lower end first, .* Try: --changing "user.count=2:5"',
    "user.count=2:3.5": r'E881 .*: expected whole numbers, .* Try: --changing "user.count=2:3"',
    "user.count=2.5, 4": r"E626 user.count: expected a whole number from 1 .*, got 2.5",
    "user.count=2 kg:3 kg": r'E204 user.count: .* got 2 kg. Try: --changing "user.count=2:3"',
    "user.count=2:5:1": r'E881 .* 2 values or more, got 1. Try: --changing "user.count=2:10"',
    "user.count=2:100": r'E890 .*: expected at most 40 counts, got 99. Try: --changing "user.count=2:41"',
    "user.count=1:3": r"E626 total number of peers: expected at least 2, .* got 1",
    "user.count=0:4": r"E626 user.count: expected a whole number from 1 .*, got 0",
    "people=2:3": r"E622 people",
    "users.count=2:3": r'E622 users.count .* Try: --changing "user.count=2:3"',
    "peers=2:3": r'E623 peers .* Try: --changing "user.count=2:3"',
}


@pytest.mark.parametrize("text", BAD)
def test_bad_counts_are_refused_at_the_option(text: str) -> None:
    with pytest.raises(ApcError) as caught:
        apc.changing_counts(AVERAGE, text)
    [mistake] = caught.value.mistakes
    assert re.match(f"--changing: {BAD[text]}", str(mistake)), mistake
    if mistake.fix.endswith(('=2:3"', '=2:5"')):
        assert apc.changing_counts(AVERAGE, mistake.fix.split('"')[1]).counts[0] == 2


@pytest.mark.parametrize("second", ["user.count=2:3", "contact.stiffness=2 N/m:3 N/m"])
def test_the_option_is_given_once(second: str, cli: Cli) -> None:
    ran = cli("analyze", str(AVERAGE), "--changing", "user.count=2:6", "--changing", second)
    assert ran.code == 1 and not ran.out
    assert " ".join(ran.err.split()).startswith("--changing: E890 --changing is given twice. Give one number")


def test_peers_in_a_ring_are_not_interchangeable() -> None:
    with pytest.raises(ApcError, match=r"E890 .*equal peers that all receive each other"):
        apc.changing_counts(TOPOLOGIES / "ring-of-eight.yaml", "user.count=7:8")


def test_the_command_prints_text_and_json(cli: Cli, tmp_path: Path) -> None:
    printed = cli("analyze", str(AVERAGE), "--changing", "user.count=2:3")
    assert printed.code == 0 and "stable under arbitrary changes" in printed.out
    assert max(map(len, printed.out.splitlines())) <= 80
    reported = cli("analyze", str(AVERAGE), "--changing", "user.count=2:5", "--json")
    assert '"dwell_s": 0.096' in reported.out
