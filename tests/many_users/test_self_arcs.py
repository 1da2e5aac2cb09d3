"""A peer that sends to itself over a link: one networked loop, stepped by hand."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from tests.topologies import compiled, replaced

MASS, DAMPING, STIFFNESS = 0.1, 1.0, 100.0  # kg, N·s/m, N/m


def topology(graph: str = "{arcs: [[1, 1]]}", loss: str = "", count: int = 1) -> str:
    return (
        "topology: loop\nclocks: {haptic: 1 ms, network: 8 ms}\n"
        f"peers: {{user: {{count: {count}}}}}\n"
        f"masses: {{device: {{mass: {MASS} kg, damping: {DAMPING} N*s/m}}}}\n"
        "couplers:\n  pull: {type: AveragePosition, object: device, stiffness: "
        f"{STIFFNESS} N/m, clock: haptic, link: lan}}\n"
        f"links: {{lan: {{clock: network, delay: 8 ms{loss}, graph: {graph}}}}}\n"
    )


def frame(stiffness: float = STIFFNESS, *, lost: bool = False) -> NDArray[np.float64]:
    """Return the map of (x, v, packet) over 8 ms: F = K (x(t_k - 8 ms) - x) at each millisecond.

    A lost packet is replaced by the one before.
    """
    rate = DAMPING / MASS
    decay = math.exp(-rate * 1e-3)
    reach = (1 - decay) / rate
    step = np.array([[1, reach], [0, decay]])
    push = np.array([(1e-3 - reach) / DAMPING, (1 - decay) / DAMPING])
    columns = []
    for x, v, packet in np.eye(3):
        state = np.array([x, v])
        for _ in range(8):
            state = step @ state + push * stiffness * (packet - state[0])
        columns.append([*state, packet if lost else x])
    return np.array(columns).T


def test_the_loop_is_that_by_hand() -> None:
    found = apc.analyze(compiled(topology()))
    values = sorted(abs(np.linalg.eigvals(frame())))
    assert found.rigid_modes == 1
    assert found.spectral_radius == pytest.approx(values[-2], rel=1e-12)


def test_a_simulation_is_the_same() -> None:
    found = apc.simulate(compiled(topology()), duration="0.4 s", params={"device.v": 1.0})
    state = np.linalg.matrix_power(frame(), 50) @ [0, 1, 0]
    ends = {signal.name: value for signal, value in zip(found.signals, found.values[-1], strict=True)}
    assert ends["user[1].device.x"] == pytest.approx(state[0], rel=1e-9)


def test_its_losses_are_not_judged() -> None:
    found = apc.mean_square_stability(compiled(topology(loss=", loss: 20 %")))
    assert found.stable is None and "a peer sends to itself" in str(found)


def test_without_losses_they_are_not_judged_in_mean_square_either() -> None:
    """At a loss of 0 the packets were left out, and the growth was that of the peer alone."""
    model = compiled(topology(loss=", loss: 20 %"))
    (value,) = apc.sweep(model, {"lan.loss": [0]}, criterion="mean-square", jobs=1).column("verdict")
    assert value == "not judged"


@pytest.mark.needs_extension("loss_models")
def test_its_losses_in_a_row_are_those_by_hand() -> None:
    """All patterns of twelve frames, without the free translation."""
    found = apc.mean_square_stability(compiled(topology(loss=", loss: 20 %")), params={"pull.stiffness": 600})
    assert found is not None and (losses := found.losses_in_a_row) is not None
    assert losses.certified == 2 and losses.unstable_pattern == (True, True, True, False)

    def growth(pattern: tuple[bool, ...]) -> float:
        """Return the growth per frame of (v, packet - x)."""
        change = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 1]])  # of (x, v, packet - x) to (x, v, packet)
        steps = [np.linalg.inv(change) @ frame(600.0, lost=lost) @ change for lost in reversed(pattern)]
        product = np.linalg.multi_dot([*steps, np.eye(3)])[1:, 1:]
        return float(max(abs(np.linalg.eigvals(product))) ** (1 / len(pattern)))

    assert losses.growth == pytest.approx(growth(losses.unstable_pattern), rel=1e-10)
    for pattern in itertools.product((False, True), repeat=12):
        if "111" not in "".join(str(int(lost)) for lost in pattern * 2):
            assert growth(pattern) < 1


@pytest.mark.parametrize("graph", ["{edges: [[1, 1]]}", "complete", "{arcs: [[1, 2]]}"])
def test_one_peer_receives_only_over_an_arc_to_itself(graph: str) -> None:
    with pytest.raises(ApcError, match=r"E208|E213"):
        compiled(topology(graph))


def test_a_pair_within_a_group_applies_to_the_packets_of_a_peer_to_itself() -> None:
    pair = compiled(topology(loss=", pairs: {user: {user: {delay: 3 ms}}}"))
    link = compiled(replaced(topology(), ("delay: 8 ms", "delay: 3 ms")))
    radii = [apc.analyze(model).spectral_radius for model in (pair, link, compiled(topology()))]
    assert pair.warnings == () and radii[0] == radii[1] != radii[2]


@pytest.mark.parametrize(
    ("words", "end"),
    [
        (["critical", "lan.loss"], "Try: apc simulate"),
        (["critical", "pull.stiffness"], "Try: --criterion nominal"),
        (["analyze", "--box", "pull.stiffness=±1%"], "Try: apc critical pull.stiffness --criterion nominal"),
        (["analyze", "--box", "lan.loss=±1%"], "Try: apc simulate"),
        (
            ["tune", "--free", "pull.stiffness=1 N/m:9 N/m", "--maximize", "pull.stiffness"],
            "Tune without losses and jitter.",
        ),
    ],
)
def test_a_refusal_proposes_what_the_command_has(
    words: list[str], end: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No range of losses has a verdict, and `apc tune` has no criterion."""
    path = tmp_path / "loop.yaml"
    path.write_text(topology(loss=", loss: 20 %"), encoding="utf-8")
    assert run([*words, str(path)]) == 1
    assert capsys.readouterr().err.strip().endswith(end)
