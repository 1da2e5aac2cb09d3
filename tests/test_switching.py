"""Contacts that open and close at will: closed forms, scenes played tick by tick by hand, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import apc
from apc.analysis.alternating import alternating
from apc.analysis.analysis import prepare
from apc.analysis.contact_modes import contact_modes
from apc.analysis.opened import open_loops
from apc.analysis.switching import CANNOT, OPEN, STABLE, Switching, switching
from apc.compiler.compiled import CompiledSystem
from tests.topologies import SCENES, compiled, replaced, wall

Floats = NDArray[np.float64]

TICK = 1e-3
HELD = """\
topology: held
clocks: {haptic: 1 ms, network: 8 ms}
peers:
  user: {count: 3}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact: {type: OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 100 N/m, clock: haptic, delay: 1 ms}
  coordination: {type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, delay: 1 ms, link: lan}
links:
  lan: {clock: network, delay: 8 ms}
hands:
  arm: {type: SpringDamperArm, flange: device, stiffness: 100 N/m, damping: 3 N*s/m}
"""  # noqa: E501
ALONE = """\
topology: alone
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube: {mass: 0.6 kg, damping: 5 N*s/m}
couplers:
  contact: {type: OneSidedContact, a: device, b: cube, stiffness: 30 N/m, clock: haptic, delay: 1 ms}
"""


def judged(system: CompiledSystem) -> Switching:
    return switching(system, contact_modes(system))


def stiff(text: str, stiffness: float) -> CompiledSystem:
    return apc.set_parameters(compiled(text), {"contact.stiffness": f"{stiffness!r} N/m"})


def tick(cube: float = 0.2, arm: tuple[float, float] = (100.0, 3.0)) -> Floats:
    """Return what a tick makes of (x, v, x_O, v_O) under a held contact force f and coordination force q."""
    rates = np.zeros((6, 6))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, 0], rates[1, 1], rates[1, 4] = -arm[0] / 0.1, -(5 + arm[1]) / 0.1, -1 / 0.1
    rates[3, 3], rates[3, 4], rates[3, 5] = -5 / cube, 1 / cube, -1 / cube
    return np.asarray(expm(rates * TICK)[:4])


def played(
    count: int,
    stiffness: float,
    patterns: list[list[list[bool]]],
    *,
    tie: float = 200.0,
    damping: float = 0.0,
) -> list[Floats]:
    """Return the matrix of each pattern's frame of the held scene, all peers in one, event by event.

    A pattern says of each tick which peers' contacts are closed. The state is, peer by peer,
    (x, v, x_O, v_O), the last contact and coordination force, and the packet of the frame before.
    """
    step = tick()
    found = []
    for pattern in patterns:
        columns = []
        for unit in np.eye(7 * count):
            peers = unit.reshape(count, 7).copy()
            heard = peers[:, 6].copy()  # sent a frame ago, and there by now
            peers[:, 6] = peers[:, 2]
            for closed in pattern:
                f = stiffness * (peers[:, 0] - peers[:, 2]) + damping * (peers[:, 1] - peers[:, 3])
                f *= np.array(closed)
                others = (heard.sum() - heard) / (count - 1)
                q = tie * (peers[:, 2] - others)
                peers[:, :4] = np.column_stack([peers[:, :4], peers[:, 4:6]]) @ step.T
                peers[:, 4], peers[:, 5] = f, q  # a tick later they act
            columns.append(peers.ravel())
        found.append(np.column_stack(columns))
    return found


def together(closed: int, opened: int, count: int) -> list[list[list[bool]]]:
    """Return the frames of a period in which all contacts close and open by turns."""
    length = closed + opened
    frames = length // math.gcd(length, 8)
    return [[[(8 * k + i) % length < closed] * count for i in range(8)] for k in range(frames)]


def growth(matrices: list[Floats]) -> float:
    """Return what a product of frames grows by per frame, a translation aside."""
    product = np.eye(len(matrices[0]))
    for one in matrices:
        product = one @ product
    return float(np.abs(np.linalg.eigvals(product)).max()) ** (1 / len(matrices))


@pytest.mark.parametrize(
    ("mass", "damping", "delay"), [(0.1, 5.0, 0.0), (0.1, 5.0, 1e-3), (0.3, 2.0, 2.5e-3), (1.0, 20.0, 1e-3)]
)
def test_a_wall_may_be_switched_as_far_as_its_closed_form_says(
    mass: float, damping: float, delay: float
) -> None:
    # Position over force is 1/(s (m s + b)) behind a hold and a delay: with the drift taken out its real part
    # is least at 0 Hz, −(m/b² + (T/2 + delay)/b); times the stiffness that must stay above −1.
    most = 1 / (mass / damping**2 + (TICK / 2 + delay) / damping)
    below, above = (judged(wall(mass, damping, delay, part * most)) for part in (0.999, 1.001))
    assert below.verdict == STABLE and below.stable
    assert below.reach == pytest.approx(1 / 0.999, rel=1e-9)
    assert above.reach == pytest.approx(1 / 1.001, rel=1e-9)
    assert above.verdict == OPEN and above.stable is None
    assert "circle criterion fails" in above.reason


def test_a_device_and_a_cube_move_apart_as_two_bodies_do() -> None:
    # Both give way: the two real parts add up.
    most = 1 / ((0.1 + 0.6) / 25 + 1.5 * TICK * (1 / 5 + 1 / 5))
    found = judged(compiled(ALONE))
    assert found.verdict == STABLE
    assert found.reach is not None and 30 * found.reach == pytest.approx(most, rel=1e-9)


@pytest.mark.parametrize("count", [2, 3])
def test_what_is_proved_never_grows_whatever_switches(count: int) -> None:
    text = replaced(HELD, ("count: 3", f"count: {count}"), ("mass: 0.6 kg", f"mass: {0.2 * count} kg"))
    text = replaced(text, ("stiffness: 500 N/m", "stiffness: 200 N/m"))
    reach = judged(compiled(text)).reach
    assert reach is not None
    stiffness = 0.99 * reach * 100
    assert judged(stiff(text, stiffness)).verdict == STABLE
    generator = np.random.default_rng(1)
    for _ in range(20):
        length = int(generator.integers(1, 6))
        patterns = (generator.random((length, 8, count)) < generator.random()).tolist()
        assert growth(played(count, stiffness, patterns)) <= 1 + 1e-9
    for closed, opened in ((3, 5), (16, 25), (20, 20), (8, 8), (1, 7), (30, 34)):
        assert growth(played(count, stiffness, together(closed, opened, count))) <= 1 + 1e-9
    # A whole run of chance: the cube and what is tied to it ends somewhere, and nothing has grown on the way.
    patterns = (generator.random((60, 8, count)) < 0.5).tolist()
    product = np.eye(7 * count)
    for matrix in played(count, stiffness, patterns):
        product = matrix @ product
        assert np.abs(product[[7 * i + k for i in range(count) for k in (0, 2)]][:, 2::7]).max() < 10


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [6, 12])
def test_what_is_proved_of_random_scenes_never_grows(draws: int) -> None:
    generator = np.random.default_rng(8)
    proved = 0
    for _ in range(draws):
        count, tie = int(generator.integers(2, 4)), float(np.exp(generator.uniform(3, 6.5)))
        stiffness = float(np.exp(generator.uniform(3, 6)))
        text = replaced(HELD, ("count: 3", f"count: {count}"), ("mass: 0.6 kg", f"mass: {0.2 * count} kg"))
        text = replaced(text, ("stiffness: 500 N/m", f"stiffness: {tie!r} N/m"))
        if not judged(stiff(text, stiffness)).stable:
            continue
        proved += 1
        for _ in range(15):
            patterns = (generator.random((3, 8, count)) < generator.random()).tolist()
            assert growth(played(count, stiffness, patterns, tie=tie)) <= 1 + 1e-9
    assert proved >= draws // 3


def test_a_pattern_that_is_told_to_grow_does_so_by_as_much() -> None:
    system = stiff(HELD, 1000.0)
    found = judged(system)
    assert found.verdict == CANNOT and found.stable is False
    loops = open_loops(system, prepare(system))
    assert not isinstance(loops, str)
    pattern = alternating(loops)
    assert pattern is not None
    truth = growth(played(3, 1000.0, together(pattern.closed, pattern.opened, 3), tie=500.0))
    assert pattern.growth == pytest.approx(truth, rel=1e-10)
    assert truth > 1.05
    told = f"closed for {pattern.closed} ticks and open for {pattern.opened} ticks by turns it grows"
    assert told in found.reason
    assert f"{pattern.growth:.6g} a frame" in found.reason


@pytest.mark.few(2)
@pytest.mark.parametrize("stiffness", [100.0, 125.0, 140.0, 2000.0])
def test_groups_of_equal_peers_are_judged_as_one_group(stiffness: float) -> None:
    apart = replaced(HELD, ("  user: {count: 3}", "  one: {count: 1}\n  two: {count: 2}"))
    other = replaced(apart, ("two: {count: 2}", "two: {count: 2, set: {contact.side: right}}"))
    found, *others = (judged(stiff(text, stiffness)) for text in (HELD, apart, other))
    for one in others:
        assert (one.verdict, one.settles) == (found.verdict, found.settles)
        assert one.reach == pytest.approx(found.reach, rel=1e-9)


def test_peers_on_a_ring_are_judged_mode_by_mode_as_on_a_list_of_its_edges() -> None:
    ring = replaced(HELD, ("count: 3", "count: 4"), ("delay: 8 ms}", "delay: 8 ms, graph: ring}"))
    ring = replaced(ring, ("mass: 0.6 kg", "mass: 0.8 kg"), ("stiffness: 500 N/m", "stiffness: 200 N/m"))
    edges = "graph: {edges: [[1, 2], [2, 3], [3, 4], [4, 1]]}"
    listed = replaced(ring, ("graph: ring", edges))
    one, other = judged(compiled(ring)), judged(compiled(listed))
    assert one.verdict == other.verdict == STABLE
    assert one.reach == pytest.approx(other.reach, rel=1e-9)


def test_a_million_peers_cost_what_three_do() -> None:
    # The copies of the cube weigh less and less: let each be as heavy as before.
    many = replaced(HELD, ("count: 3", "count: 1000000"), ("mass: 0.6 kg", "mass: 200000 kg"))
    found = judged(compiled(many))
    fewer = judged(compiled(replaced(many, ("count: 1000000", "count: 100000"), ("200000 kg", "20000 kg"))))
    assert found.verdict == fewer.verdict == STABLE
    # They differ by what a peer is among others.
    assert found.reach == pytest.approx(fewer.reach, rel=1e-4)


def test_an_unstable_mode_of_contact_rules_it_out() -> None:
    text = (SCENES / "experiment-average.yaml").read_text(encoding="utf-8")
    found = apc.switching(compiled(text))
    assert found.stable is False
    assert found.reason == "it is not stable when on at no peer or on at right alone"
    mesh = (SCENES / "experiment-mesh.yaml").read_text(encoding="utf-8")
    assert judged(compiled(mesh)).reason == "it is not stable in any mode"


# More would be unstable with two.
TIES = {2: 200.0, 3: 500.0}

CONTACT = "type: OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 100 N/m"


def test_what_is_in_no_sector_is_refused_by_name() -> None:
    instead = "type: SampledHuntCrossleyContact, a: device, b: cube, stiffness: 100 N/m^(3/2)"
    found = judged(compiled(replaced(HELD, (CONTACT, instead))))
    assert (found.verdict, found.stable, found.settles) == (OPEN, None, False)
    assert "not known when" in found.reason


def test_devices_that_all_drift_are_not_decided_where_no_pattern_grows() -> None:
    free = HELD.split("hands:")[0]
    found = judged(stiff(free, 2.0))
    assert found.verdict == OPEN
    assert found.reason == "with all contacts open, what may drift is of several modes: common and difference"
    undamped = replaced(ALONE, ("mass: 0.6 kg, damping: 5 N*s/m", "mass: 0.6 kg"))
    undamped = replaced(undamped, ("damping: 5 N*s/m", "damping: 0 N*s/m"))
    assert judged(compiled(undamped)).stable is not True


def test_a_limited_force_is_in_a_sector_too() -> None:
    limited = replaced(
        HELD,
        (CONTACT, "type: ForceSaturation, a: device, b: cube, limit: 2 N, stiffness: 100 N/m"),
    )
    assert judged(compiled(limited)).reach == pytest.approx(judged(compiled(HELD)).reach, rel=1e-12)


def test_peers_that_touch_nothing_stand_beside_those_that_do() -> None:
    text = replaced(
        HELD,
        ("  user: {count: 3}", "  user: {count: 2}\n  idle: {count: 1, set: {contact.stiffness: 0 N/m}}"),
    )
    found = judged(compiled(text))
    assert found.verdict == STABLE
    whole = judged(compiled(HELD)).reach
    assert found.reach is not None and whole is not None and found.reach >= whole * (1 - 1e-9)


def test_over_a_lossy_link_nothing_is_called_proved() -> None:
    found = judged(compiled(replaced(HELD, ("delay: 8 ms}", "delay: 8 ms, loss: 1 %}"))))
    assert (found.verdict, found.stable) == (OPEN, None)
    assert found.reason == "packets may be lost or late, and it is looked for on time only"


def settled(count: int, stiffness: float, start: Floats, frames: int, *, tie: float) -> float:
    """Return how far a scene still moves in a frame, played with contacts that never pull.

    `start` is as in `played`; contacts are 20 mm deep at 0.
    """
    peers, step = start.reshape(count, 7).copy(), tick()
    for _ in range(frames):
        heard, before = peers[:, 6].copy(), peers[:, :4].copy()
        peers[:, 6] = peers[:, 2]
        for _ in range(8):
            f = stiffness * np.maximum(0.02 + peers[:, 0] - peers[:, 2], 0)
            q = tie * (peers[:, 2] - (heard.sum() - heard) / (count - 1))
            peers[:, :4] = np.column_stack([peers[:, :4], peers[:, 4:6]]) @ step.T
            peers[:, 4], peers[:, 5] = f, q
    return float(np.abs(peers[:, :4] - before).max())


@pytest.mark.few(2)
@pytest.mark.parametrize(("count", "stiffness"), [(3, 200.0), (2, 1000.0), (3, 1000.0), (3, 2200.0)])
def test_what_is_proved_to_settle_comes_to_rest_though_a_pattern_at_will_may_grow(
    count: int, stiffness: float
) -> None:
    text = replaced(HELD, ("count: 3", f"count: {count}"), ("mass: 0.6 kg", f"mass: {0.2 * count} kg"))
    text = replaced(text, ("stiffness: 500 N/m", f"stiffness: {TIES[count]} N/m"))
    found = judged(stiff(text, stiffness))
    assert found.settles
    assert found.stable is (False if stiffness > 300 else None)
    generator = np.random.default_rng(2)
    for _ in range(2):
        start = generator.normal(size=7 * count) * np.tile([0.05, 0.5, 0.05, 0.5, 0, 0, 0], count)
        assert settled(count, stiffness, start, 3000, tie=TIES[count]) < 1e-9


@pytest.mark.parametrize("part", [0.5, 0.95, 0.98])
def test_a_wall_settles_nearly_as_far_as_it_is_stable_when_always_touched(part: float) -> None:
    # Closed for ever: x⁺ of a device under a held force, which is K times the sample of a tick before.
    rates = np.array([[0, 1, 0], [0, -50, -10], [0, 0, 0]])
    step = expm(rates * TICK)[:2]

    def radius(stiffness: float) -> float:
        whole = np.vstack([step, [stiffness, 0, 0]])
        return float(np.abs(np.linalg.eigvals(whole)).max())

    low, high = 100.0, 1e5
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < 1 else (low, middle)
    found = judged(wall(0.1, 5.0, TICK, part * low))
    assert found.stable is not True and found.settles
    assert "it is proved to come to rest" in " ".join(str(found).split())
    assert not judged(wall(0.1, 5.0, TICK, 1.01 * low)).settles


def test_what_is_left_open_says_so() -> None:
    found = judged(stiff(ALONE, 2500.0))  # with its contacts closed it is stable up to 2557 N/m
    assert not found.settles and found.reach is not None
    assert "come to rest" not in " ".join(str(found).split())
    held = judged(stiff(HELD, 100.0))
    assert held.settles and held.stable


def test_a_damped_contact_may_switch_at_will_and_need_not_come_to_rest() -> None:
    damped = replaced(HELD, (CONTACT, f"{CONTACT}, damping: 0.5 N*s/m"), ("500 N/m", "200 N/m"))
    found = judged(compiled(damped))
    assert found.verdict == STABLE and found.jumps == "contact.push" and not found.settles
    assert "contact.push jumps where it opens" in " ".join(str(found).split())
    generator = np.random.default_rng(5)
    for _ in range(20):
        length = int(generator.integers(1, 6))
        patterns = (generator.random((length, 8, 3)) < generator.random()).tolist()
        assert growth(played(3, 100.0, patterns, damping=0.5)) <= 1 + 1e-9
    for closed, opened in ((3, 5), (16, 25), (20, 20), (1, 7)):
        assert growth(played(3, 100.0, together(closed, opened, 3), damping=0.5)) <= 1 + 1e-9


def test_a_damped_contact_that_grows_by_turns_does_so_by_as_much() -> None:
    system = stiff(replaced(HELD, (CONTACT, f"{CONTACT}, damping: 0.5 N*s/m")), 1000.0)
    found = judged(system)
    assert found.verdict == CANNOT and not found.settles
    loops = open_loops(system, prepare(system))
    assert not isinstance(loops, str)
    pattern = alternating(loops)
    assert pattern is not None
    frames = played(3, 1000.0, together(pattern.closed, pattern.opened, 3), tie=500.0, damping=0.5)
    assert pattern.growth == pytest.approx(growth(frames), rel=1e-10)
