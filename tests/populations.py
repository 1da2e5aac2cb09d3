"""Peers of the paper's topology that all differ."""

from __future__ import annotations

import numpy as np

from apc.compiler.compiled import Model
from tests.bruteforce import TopologySource
from tests.topologies import compiled, replaced
from tests.truths import text_of


def different(peers: int) -> Model:
    """Return peers whose masses, dampings and contacts all differ, by up to 30 %."""
    random, columns = np.random.default_rng(0), []
    for name, least, unit in (
        ("device.mass", 0.1, "kg"),
        ("device.damping", 5.0, "N*s/m"),
        ("contact.stiffness", 1000.0, "N/m"),
    ):
        values = (least * (1 + 0.3 * random.random(peers))).tolist()
        columns.append(f"{name}: [{', '.join(f'{value!r} {unit}' for value in values)}]")
    text = text_of(TopologySource(peers=peers, kt=400.0, bt=1.0, kc=1000.0, bc=1.0))
    return compiled(replaced(text, (f"{{count: {peers}}}", f"{{set: {{{', '.join(columns)}}}}}")))
