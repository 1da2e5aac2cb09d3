"""Channels of unreliable links, and topologies and packets over them, for tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apc.network.channel import ChannelLaw, PacketSource
from tests.topologies import AVERAGE, replaced

LINK = "  lan: {clock: network, delay: 8 ms}"
RELIABLE = ChannelLaw(0.0, 1.0, 1.0, 0.0, 0.008, 0.0, "uniform", None)
BURSTS = replace(RELIABLE, p=0.01, r=0.25)
STARTS = "[1 mm, 5 mm, -3 mm]"
SEPARATE = ("{count: 3}", f"{{set: {{cube.x: {STARTS}, device.x: {STARTS}}}}}")


def unreliable(text: str) -> str:
    """Return the three-users topology with a link that says more."""
    return replaced(AVERAGE, (LINK, f"{LINK[:-1]}, {text}}}"))


def apart(text: str, more: str = "") -> str:
    """Return a topology whose users start apart, over a link that says more."""
    return replaced(text, SEPARATE, (LINK, f"{LINK[:-1]}, {more}}}" if more else LINK))


def effective(late: Sequence[float], tick: int, *, newest: bool) -> tuple[int, bool]:
    """Return the packet in effect on a way at a tick of 1 ms, and whether one is missing, by looking at each.

    Packets are sent every 8 ms and are so many seconds late; times are compared to 1 ps.
    """
    arrivals = [(8 * k + round(1000 * d, 9), k) for k, d in enumerate(late) if d < math.inf]
    arrived = [(at, k) for at, k in arrivals if at <= tick]
    number = max((k for _, k in arrived), default=-1) if newest else max(arrived, default=(0, -1))[1]
    gap = max((k for k, d in enumerate(late) if d == math.inf and 8 * k + 8 <= tick), default=-1)
    return number, gap > number


def delays(law: ChannelLaw, count: int, **key: int) -> NDArray[np.float64]:
    """Return the delays of the first packets of one way."""
    return PacketSource(law, "lan", [(0, 1)], **key).take(count)[0]


def recorded(*milliseconds: float) -> ChannelLaw:
    return replace(RELIABLE, trace=np.array(milliseconds) / 1000)
