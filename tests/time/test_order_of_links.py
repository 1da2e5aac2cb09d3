"""Packets that take the values after the ticks at their instant: a relay without an extra period, by hand.

The controller of a motor with a roller runs on the computer of the other peer. It receives a sample without
delay, computes the control, and sends it at the same tick: the control acts after the delay of one packet.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from tests.published.by_hand import growth, held, radius
from tests.topologies import AVERAGE, ROOT, compiled, library, replaced

Floats = NDArray[np.float64]
Relay = Callable[[str], Model]
PUBLISHED = ROOT / "models" / "published" / "cloosterman-2009" / "constant-delay.yaml"
MS = 1e-3


@pytest.fixture
def relay(tmp_path: Path) -> Relay:
    """Return a function that compiles the relay with these keys of the link from controller to actuator."""
    library = f"library: {PUBLISHED.parent / 'components'}"
    text = replaced(
        PUBLISHED.read_text(encoding="utf-8"),
        ("library: ./components", library),
        (", back: {period: 1 ms, phase: 0.2 ms}", ""),
        ("clock: back, delay: 0 ms", "clock: sensor, KEYS"),
    )

    def compiled(keys: str) -> Model:
        path = tmp_path / "relay.yaml"
        path.write_text(text.replace("KEYS", keys), encoding="utf-8")
        return apc.compile(path)

    return compiled


def step(delay: float) -> Floats:
    """Return the map of (x, x', u) over a period, the control of this period acting after a delay."""
    process, force, gain = np.array([[0.0, 1], [0, 0]]), np.array([[0], [126.7]]), np.array([[50, 11.8]])
    free, whole = held(process, force, MS)
    new = held(process, force, MS - delay)[1]
    return np.block([[free - new @ gain, whole - new], [-gain, np.zeros((1, 1))]])


def second_moments(steps: Sequence[Floats], chances: Sequence[float]) -> float:
    """Return the growth of second moments for a step drawn anew in every period."""
    return radius(sum(p * np.kron(one, one) for p, one in zip(chances, steps, strict=True)))


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize(
    ("keys", "delay"),
    [
        ("delay: 0.2 ms, order: after", 0.2),
        ("delay: 0.6 ms, order: after", 0.6),
        ("delay: 0 ms, order: after", 0.2),  # received at the next tick of the actuator
        ("delay: 0 ms, order: before", 1.0),  # what was computed a period before
        ("delay: 0 ms", 1.0),
    ],
)
def test_a_relay_has_the_delay_of_its_packets_alone(relay: Relay, keys: str, delay: float, jit: bool) -> None:
    model = relay(keys)
    assert apc.analyze(model).spectral_radius == pytest.approx(growth(delay * MS), rel=1e-12)
    played = apc.simulate(model, duration="30 ms", params={"roller.v": 1.0}, jit=jit)
    names = [signal.name for signal in played.signals]
    state = np.array([0.0, 1.0, 0.0])
    for _ in range(30):
        state = step(delay * MS) @ state
    assert played.values[-1, names.index("user[1].roller.x")] == pytest.approx(state[0], rel=1e-9)


@pytest.mark.parametrize("delay", [0.05, 0.37, 0.999])
def test_an_actuator_that_ticks_at_arrivals_applies_each_packet_when_it_arrives(delay: float) -> None:
    path = PUBLISHED.with_name("one-clock.yaml")
    late = {"late": f"{delay} ms"}
    assert apc.analyze(path, params=late).spectral_radius == pytest.approx(growth(delay * MS), rel=1e-12)
    played = apc.simulate(path, duration="30 ms", params=late | {"roller.v": 1.0}, jit=False)
    names = [signal.name for signal in played.signals]
    state = np.linalg.matrix_power(step(delay * MS), 30) @ [0.0, 1.0, 0.0]
    assert played.values[-1, names.index("user[1].roller.x")] == pytest.approx(state[0], rel=1e-9)


def test_losses_of_packets_after_the_ticks_are_those_by_hand(relay: Relay) -> None:
    lost = step(MS)
    lost[2] = [0, 0, 1]
    found = apc.mean_square_stability(relay("delay: 0.2 ms, order: after, loss: 20 %"))
    assert found.mean_square_radius == pytest.approx(
        second_moments([step(0.2 * MS), lost], [0.8, 0.2]), rel=1e-9
    )


def test_jitter_of_packets_after_the_ticks_is_that_by_hand(relay: Relay) -> None:
    """The delay is 0.3 ms ± 0.4 ms, at least 0: it is used at the ticks 0.2, 0.4, 0.6 or 0.8 ms later."""
    found = apc.mean_square_stability(relay("delay: 0.3 ms, order: after, jitter: 0.4 ms"))
    chances = [0.3 / 0.8, 0.2 / 0.8, 0.2 / 0.8, 0.1 / 0.8]
    expected = second_moments([step(k * 0.2 * MS) for k in (1, 2, 3, 4)], chances)
    assert found.mean_square_radius == pytest.approx(expected, rel=1e-9)


@pytest.mark.needs_extension("loss_models")
def test_recorded_delays_of_packets_after_the_ticks_are_those_by_hand(relay: Relay, tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("delay [ms]\n0\n0.6\n", encoding="utf-8")
    model = relay("order: after, trace: delays.csv")
    found = apc.mean_square_stability(model)
    assert found.mean_square_radius == pytest.approx(growth(0.2 * MS, 0.6 * MS) ** 2, rel=1e-11)
    played = apc.simulate(model, duration="30 ms", params={"roller.v": 1.0}, jit=False)
    names = [signal.name for signal in played.signals]
    state = np.array([0.0, 1.0, 0.0])
    for period in range(30):
        state = step((0.2, 0.6)[period % 2] * MS) @ state
    assert played.values[-1, names.index("user[1].roller.x")] == pytest.approx(state[0], rel=1e-9)


@pytest.mark.parametrize(("suffix", "code"), [("c", "E960"), ("mo", "E955"), ("fmu", "E960")])
def test_an_export_that_sends_before_the_ticks_refuses_the_order(
    relay: Relay, suffix: str, code: str, tmp_path: Path
) -> None:
    with pytest.raises(ApcError, match=rf"{code}.*down .*order: after"):
        apc.export(
            relay("delay: 0.2 ms, order: after"),
            out=tmp_path / f"out.{suffix}",
            peer="user[1]" if suffix == "c" else "",
        )


@pytest.mark.whole
def test_a_run_in_real_time_does_what_is_simulated(
    relay: Relay, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    relay("delay: 15 ms, order: after")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("apc.realtime.start.claim", tuple)
    text = replaced(
        Path("relay.yaml").read_text(encoding="utf-8"),
        ("sensor: 1 ms, fine: 0.2 ms", "sensor: 40 ms, fine: 10 ms"),
        ("sensor, delay: 0 ms", "sensor, delay: 15 ms"),
        ("k1: 50 N/m, k2: 11.8 N*s/m", "k1: 0.05 N/m, k2: 0.05 N*s/m"),
        ("shared: false", "shared: false, v: 0.1 m/s"),
    )
    Path("relay.yaml").write_text(text, encoding="utf-8")
    assert run(["run", "--duration", "1 s", "--emulate", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["why_not"] == ""
    assert (
        reported["differences"]["N"][1] > 1e-3
        and max(far for far, _ in reported["differences"].values()) <= 1e-9
    )


PAIRS = (
    "AveragePosition, object: cube, stiffness: 500 N/m",
    "SaturatedMesh, object: cube, stiffness: 100 N/m, limit: 0.2 N",
)


@pytest.mark.parametrize("delay", ["8 ms", "3.5 ms"])
@pytest.mark.parametrize("more", ["", ", loss: 20 %", ", jitter: 1 ms"])
@pytest.mark.parametrize("coupling", PAIRS)
def test_packets_of_positions_with_a_delay_are_the_same_in_both_orders(
    delay: str, more: str, coupling: str, tmp_path: Path
) -> None:
    """Positions do not jump at a tick."""
    moving = replaced(
        AVERAGE, (PAIRS[0], coupling), ("{count: 3}", "{count: 2, set: {device.x: [3 mm, 1 mm]}}"),
        ("delay: 8 ms}", f"delay: {delay}{more}, ORDER}}"),
    )  # fmt: skip
    found = []
    for order in ("before", "after"):
        path = tmp_path / "pair.yaml"
        path.write_text(moving.replace("ORDER", f"order: {order}"), encoding="utf-8")
        model = apc.compile(path)
        network = apc.mean_square_stability(model)
        played = apc.simulate(model, duration="0.1 s", jit=False).values
        moments = (network.mean_square_radius or 0.0) if network else 0.0
        found.append(np.array([apc.analyze(model).spectral_radius, moments, *played.ravel()]))
    assert np.ptp(found[0]) > 0.1
    assert found[0] == pytest.approx(found[1], rel=1e-11, abs=1e-13)


@pytest.mark.parametrize(("order", "tick"), [("after", 2), ("before", 3)])
def test_the_relay_of_the_manual(order: str, tick: int, tmp_path: Path) -> None:
    """A constant force K x from this tick on moves a free mass by K x/m T^2/2 until the next row."""
    manual = (ROOT / "docs" / "reference" / "links.md").read_text(encoding="utf-8")
    component = manual.partition("```yaml\ncomponent: Repeater\n")[2].partition("```")[0]
    own = library(tmp_path, f"component: Repeater\n{component}")
    text = (
        "topology: chain\nclocks: {haptic: 1 ms}\npeers:\n  a: {count: 1, set: {device.x: 1 mm}}\n"
        "  relay: {count: 1, set: {repeater.role: relay}}\n  b: {count: 1}\n"
        "masses: {device: {mass: 0.1 kg, shared: false}}\ncouplers:\n"
        "  repeater: {type: Repeater, object: device, stiffness: 100 N/m, clock: haptic, link: lan}\n"
        "links: {lan: {clock: haptic, delay: 2 ms, "
        f"order: {order}, graph: {{arcs: [[a, relay], [relay, b]]}}}}}}\n"
    )
    found = apc.simulate(compiled(text, own), duration="5 ms")
    [column] = [k for k, signal in enumerate(found.signals) if signal.name == "b[1].device.x"]
    assert not found.values[: tick + 1, column].any()
    assert found.values[tick + 1, column] == pytest.approx(100 * MS / 0.1 * MS**2 / 2, rel=1e-9)
