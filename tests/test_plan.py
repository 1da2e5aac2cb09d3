"""Claims about `apc.analysis.plan`: the method that serves, chosen before anything is built."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import prepare
from apc.analysis.needs import needs
from apc.analysis.plan import Plan, make_plan
from apc.compiler.compiled import CompiledSystem
from apc.frame.exchange import build_exchange
from apc.frame.parameters import resolve
from tests.populations import different
from tests.sites import MS, columned, linked, paper


def _plan(system: CompiledSystem, method: str = "auto") -> Plan:
    prepared, numbers = prepare(system), resolve(system)
    exchange = build_exchange(system, numbers.timings)
    return make_plan(system, prepared.jacobians, prepared.schedules, numbers, exchange, method)


PATH = [(i, i + 1, 1.0) for i in range(1599)] + [(i + 1, i, 1.0) for i in range(1599)]


@pytest.mark.parametrize(
    ("system", "method", "systems"),
    [
        (paper(), "modes", ((2, 8),)),
        (paper(peers=1_000_000), "modes", ((2, 8),)),
        (columned(paper(), device__mass=[0.1, 0.2, 0.3]), "modes", ((1, 24),)),
        (different(60), "determinant", ((1, 2),)),
        (different(3, graph="ring"), "dense", ((1, 24),)),
        (different(60, graph="ring"), "krylov", ((1, 480),)),
        (linked(paper(peers=8), "ring"), "modes", ((5, 8),)),
        (linked(paper(peers=100_000), "ring"), "modes", ((50_001, 8),)),
        (linked(paper("sum", peers=1600), PATH), "krylov", ((1, 12_800),)),
        (paper(comm=8000 * MS), "determinant", ((2, 2),)),
        (paper(comm=80 * MS), "modes", ((2, 26),)),
    ],
)
def test_the_method_is_chosen_by_what_differs(
    system: CompiledSystem, method: str, systems: tuple[tuple[int, int], ...]
) -> None:
    found = _plan(system)
    assert (found.method, found.systems) == (method, systems)


def test_a_determinant_asked_for_is_as_small_as_it_can_be() -> None:
    assert _plan(different(10), "determinant").systems == ((1, 2),)
    assert _plan(paper(), "determinant").systems == ((2, 2),)
    assert _plan(different(3, comm=8000 * MS), "determinant").systems == ((1, 6),)


def test_many_different_peers_are_planned_without_an_object_each() -> None:
    many = 100_000
    found = _plan(columned(paper(peers=many), device__mass=0.1 + 1e-6 * np.arange(many)))
    assert (found.method, found.groups, found.loops) == ("determinant", (), ())


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (different(60), "60 peers; analysed as 1 determinant of 2"),
        (different(60, graph="ring"), "60 peers; analysed as 1 sparse system of 480"),
        (paper(comm=8000 * MS), "3 peers; analysed as 2 determinants of 2"),
    ],
)
def test_what_a_scene_needs_is_said_in_these_words(system: Any, words: str) -> None:
    assert str(needs(system)).endswith(words)
