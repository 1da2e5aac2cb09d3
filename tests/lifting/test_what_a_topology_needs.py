"""What each topology of the library keeps, and that what it does not use costs nothing."""

from __future__ import annotations

import pytest

from apc.analysis.analysis import analyze
from apc.analysis.model_size import model_size
from apc.compiler.pipeline import compile_topology
from apc.lifting.numeric_model import numeric_model
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced

# Of every topology: motion, delayed forces and packets of a peer of each kind. Counted by hand: two masses or
# a device with a finger move in one axis (4); a force with a delay of one tick is remembered (one each); a
# packet of a delay of k frames is kept k times, for position and velocity each.
KEPT = {
    "carried-beam": [(10, 5, 6)],  # a point and a body of a plane; of the body all is sent
    "client-server": [(2, 2, 3), (4, 3, 3)],  # forces are held to be sent, and sent as well
    "experiment-average": [(4, 0, 2)],
    "experiment-mesh": [(4, 0, 2)],
    "finger": [(4, 2, 0)],  # the wall's force, and its position at the tick before
    "lifted-box": [(4, 2, 2)],
    "lossy-average": [(4, 2, 2)],
    "mixed-clocks": [(4, 2, 10), (4, 2, 10)],  # 40 ms are five frames
    "observer": [(4, 2, 2)],
    "planar-users": [(8, 4, 4)],  # the paper's, along either axis
    "ring-of-eight": [(4, 2, 2)],
    "sixty-hertz-user": [(4, 2, 4)],  # a packet at each of the two clocks
    "star-lecture": [(4, 2, 4)],  # 20 ms are two frames
    "template": [(4, 2, 2)],
    "three-users-average": [(4, 2, 2)],
    "three-users-mesh": [(4, 2, 2)],
    "three-users-predicted": [(4, 2, 2)],
    "three-users-scheduled": [(4, 2, 1)],  # no velocity is sent
    "two-handed-tool": [(6, 2, 2)],  # two devices and a copy; the tool is midway
    "two-rooms": [(4, 2, 8)],  # 30 ms are four frames
    "two-users-damped": [(4, 2, 2)],
    "two-users-proxies": [(4, 2, 2)],
    "two-users-reported": [(4, 5, 1)],  # the mean as it grows, and what was told, at either clock
    "two-users-filtered-waves": [(4, 5, 2)],  # as below, and the filter
    "two-users-waves": [(4, 4, 2)],  # the outgoing wave until it is sent, and the point that moves
    "unlike-devices": [(4, 2, 2)],
    "users-table": [(4, 2, 2)],
}


@pytest.mark.few(10)
@pytest.mark.parametrize("name", KEPT)
def test_a_topology_keeps_what_it_needs_and_no_more(name: str) -> None:
    model = compile_topology(TOPOLOGIES / f"{name}.yaml")
    found = model_size(model)
    assert [
        (subsystem.motion, subsystem.stored, subsystem.packets) for subsystem in found.subsystems
    ] == KEPT[name]
    assert model.dropped == ()


CONTACT, COORDINATION, LINK = "haptic, delay: 1 ms}", "haptic, delay: 1 ms, link", "network, delay: 8 ms}"


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ((), (4, 2, 2)),
        (((CONTACT, "haptic}"),), (4, 1, 2)),
        (((COORDINATION, "haptic, link"),), (4, 1, 2)),
        (((LINK, "network}"),), (4, 2, 0)),
        (((CONTACT, "haptic}"), (COORDINATION, "haptic, link"), (LINK, "network}")), (4, 0, 0)),
        (((LINK, "network, delay: 16 ms}"),), (4, 2, 4)),
        (((LINK, "network, delay: 4 ms}"),), (4, 2, 2)),
        (((CONTACT, "haptic, delay: 3 ms}"),), (4, 4, 2)),
        (((CONTACT, "haptic, delay: 2.5 ms}"),), (4, 4, 2)),
        (((COORDINATION, "haptic, delay: 1 ms, delays: own, link"),), (4, 2, 2)),
    ],
)
def test_a_peer_keeps_its_motion_its_delayed_forces_and_its_packets_on_their_way(
    changes: tuple[tuple[str, str], ...], counts: tuple[int, int, int]
) -> None:
    model = compiled(replaced(AVERAGE, *changes))
    (subsystem,) = model_size(model).subsystems
    assert (subsystem.motion, subsystem.stored, subsystem.packets) == counts
    assert subsystem.states == sum(counts) == analyze(numeric_model(model)).states_per_peer
