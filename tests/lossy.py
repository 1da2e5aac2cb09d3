"""Channels of unreliable links, for tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from apc.network.channel import ChannelLaw, PacketSource
from tests.topologies import AVERAGE, replaced

LINK = "  lan: {clock: network, delay: 8 ms}"
RELIABLE = ChannelLaw(0.0, 1.0, 1.0, 0.0, 0.008, 0.0, "uniform", None)
BURSTS = replace(RELIABLE, p=0.01, r=0.25)
JITTER = replace(BURSTS, jitter=0.006, distribution="normal")


def unreliable(text: str) -> str:
    """Return the three-users scene with a link that says more."""
    return replaced(AVERAGE, (LINK, f"{LINK[:-1]}, {text}}}"))


def delays(law: ChannelLaw, count: int, **key: int) -> NDArray[np.float64]:
    """Return the delays of the first packets of one way."""
    return PacketSource(law, "lan", [(0, 1)], **key).take(count)[0]


def recorded(*milliseconds: float) -> ChannelLaw:
    return replace(RELIABLE, trace=np.array(milliseconds) / 1000)
