"""What a switching part follows, and whether its force is in a sector, part by part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import apc
from apc.analysis.analysis import prepare
from apc.analysis.pushes import Push, push_of
from apc.analysis.switches import find_switches, switching_parts
from apc.compiler.compiled import CompiledSystem
from apc.frame.parameters import resolve
from tests.topologies import compiled, library

OWN = """\
component: Own
connectors: {{a: Flange}}
parameters:
  k: {{unit: N/m}}
  force: {{unit: N, default: 1 N}}
  length: {{unit: m, default: 1 mm}}
  span: {{unit: s, default: 10 ms}}
  clock: clock
variables:
  d: {{unit: m}}
  f: {{unit: N}}
equations:
  - d = sample(a.x) - length
  - f = {law}
  - a.f = hold(f)
"""
SCENE = """\
topology: one
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 2 N*s/m}}
couplers: {it: {type: Own, a: device, k: 700 N/m, clock: tick}}
"""


def push(system: CompiledSystem) -> Push | str | None:
    switched, vector = find_switches(system.kinds[0]), resolve(system).parameters[0][0]
    [part] = switching_parts(switched, vector)
    return push_of(switched, part, prepare(system).jacobians[0], vector)


def own(law: str, folder: Path) -> Push | str | None:
    return push(compiled(SCENE, library(folder, OWN.format(law=law))))


@pytest.mark.parametrize(
    ("law", "sector", "one_sided", "shares"),
    [
        ("k*max(0, d)", "", True, True),
        ("if d > 0 then k*d else 0", "", True, True),
        ("max(-force, min(force, k*d))", "", False, False),
        ("if d > 0 then k*d else k*d/2", "", False, True),
        ("if d > length then k*d else 0", "it.f jumps", False, True),
        ("if d > 0 then k*d + force else 0", "it.f jumps", False, True),
        ("k*abs(d)", "it.f falls, or grows faster in some piece than where it is on", False, False),
        (
            "if d > 0 then max(0, k*(d + span*sample(der(a.x)))) else 0",
            "it.f depends on more than one number, such as a depth and its rate",
            True,
            True,
        ),
    ],
)
def test_a_law_of_force_is_in_a_sector_or_not(
    law: str, sector: str, one_sided: bool, shares: bool, tmp_path: Path
) -> None:
    found = own(law, tmp_path)
    assert isinstance(found, Push)
    assert (found.sector, found.one_sided, found.shares) == (sector, one_sided, shares)
    assert abs(found.slopes[0]) == pytest.approx(700.0)
    assert found.states == 2 and not np.asarray(found.slopes[2:]).any()


@pytest.mark.parametrize(
    ("law", "why"),
    [
        ("k*max(0, d)^2/length", "it.f is not linear where it pushes"),
        ("k*max(0, d)*(1 + time/span)", "it.f depends on what is heard or on time"),
    ],
)
def test_a_law_that_is_no_piece_of_straight_lines_is_named(law: str, why: str, tmp_path: Path) -> None:
    assert own(law, tmp_path) == why


def test_a_spring_without_stiffness_pushes_nothing(tmp_path: Path) -> None:
    system = compiled(SCENE, library(tmp_path, OWN.format(law="k*max(0, d)")))
    assert push(apc.set_parameters(system, {"it.k": "0 N/m"})) is None
