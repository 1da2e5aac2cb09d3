"""What is called proved is proved: in balls, with as many bits as it takes, or left open."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import flint
import numpy as np
import pytest

from apc.analysis.analysis import Analysis, analyze, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import (
    frame_balls,
    precision,
    unprovable,
)
from apc.eigen.modes import dense, split
from tests.sites import MS, columned, grouped, linked, paper


def _certified(system: CompiledSystem) -> Analysis:
    return analyze(system, certify=True)


def _undamped(**values: Any) -> CompiledSystem:
    system = paper(**values)
    return grouped(system, ("user", system.peers, {"device.damping": 0.0, "cube.damping": 0.0}))


def test_a_drift_is_told_from_a_translation_by_proof() -> None:
    found = _certified(_undamped(kt=0.0, bt=0.0, kc=0.0))
    assert found.verdict == "drifts"
    assert found.proof.startswith("proved to drift")
    assert found.rigid_modes == 6


def test_more_bits_are_taken_as_long_as_they_decide() -> None:
    """At the last float below a boundary, 1 − ρ is 1e-16 or less: too near for floats, not for a proof."""
    low, high = 900.0, 1200.0
    while np.nextafter(low, high) < high:
        middle = (low + high) / 2
        low, high = (middle, high) if analyze(paper(kc=1000.0, kt=middle)).stable else (low, middle)
    below, above = (analyze(paper(kc=1000.0, kt=kt)) for kt in (low, high))
    assert (below.stable, above.stable) == (True, False)
    assert below.proof.startswith("decided with") or below.proof.startswith("proved stable")
    assert above.proof.startswith("proved unstable")
    assert abs(low - 1096.411) < 6e-4  # the reference limit of K_T at K_C = 1000


SCENES = [
    paper(),
    paper("sum", own_delay=True, comp=MS * 5 / 2, comm=11 * MS, bt=1.0, bc=2.0),
    paper(comp=Fraction(0), comm=Fraction(0)),
    paper(network=3 * MS, haptic=2 * MS, haptic_phase=MS / 3, network_phase=MS / 2, comm=5 * MS),
    grouped(paper(), ("left", 2, {"device.mass": 0.2}), ("right", 3, {"contact.stiffness": 100.0})),
    linked(paper(peers=7), "ring"),
    linked(paper(peers=4), [(0, 1, 0.5), (1, 2, 2.0), (2, 3, 1.0), (3, 0, 0.25), (1, 0, 0.75)]),
    columned(paper(), device__mass=[0.1, 0.2, 0.15]),
]


@pytest.mark.few(4)
@pytest.mark.parametrize("system", SCENES)
def test_the_matrix_in_balls_is_the_matrix_in_floats_within_its_error(system: CompiledSystem) -> None:
    groups, exchange = lifted_groups(system)
    for closed in (*split(groups, exchange).systems, dense(groups, exchange)):
        assert unprovable(closed) == ""
        with precision(200):
            matrix = frame_balls(closed)
            middle = [
                float(abs((flint.arb(entry) - value).mid()))
                for entry, value in zip(matrix.ravel(), closed.matrix.ravel().tolist(), strict=True)
            ]
            known = not any(way not in closed.surds for way in closed.doubts if closed.doubts[way])
            radii = max(float(flint.arb(entry).rad()) for entry in matrix.ravel())
        assert np.all(np.array(middle).reshape(closed.matrix.shape) <= closed.error + 1e-300)
        assert radii < (1e-45 if known else 1e-9)
