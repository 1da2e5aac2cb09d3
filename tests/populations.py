"""Populations for tests: peers of the paper's scene that all differ, and what they are made of."""

from __future__ import annotations

from typing import Any

import numpy as np

from apc.compiler.compiled import CompiledSystem
from tests.sites import columned, linked, paper


def different(
    peers: int,
    operator: str = "mean",
    graph: Any = "complete",
    *,
    seed: int = 0,
    spread: float = 0.3,
    **values: Any,
) -> CompiledSystem:
    """Return peers whose masses, dampings and contacts all differ; the others share a sum's gains."""
    gains = {"kt": 400.0, "bt": 1.0, "kc": 1000.0, "bc": 1.0, **values}
    if operator == "sum":
        gains |= {"kt": gains["kt"] / peers, "bt": gains["bt"] / peers}
    random = np.random.default_rng(seed)
    return columned(
        linked(paper(operator, peers=peers, **gains), graph),
        device__mass=0.1 * (1 + spread * random.random(peers)),
        device__damping=5 * (1 + spread * random.random(peers)),
        contact__stiffness=gains["kc"] * (1 + spread * random.random(peers)),
    )
