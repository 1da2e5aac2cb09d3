"""What can't be computed is refused with its reason, instead of answered wrongly or for ever."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology

TWO_MASSES = """\
topology: joined
library: ./parts
peers: {user: {count: 1}}
masses:
  one: {mass: 1 kg}
  two: {mass: 1 kg}
couplers:
"""


def refusal(folder: Path, couplers: str, parts: dict[str, str] | None = None) -> str:
    """Return what compiling two masses with these couplers and components is refused with."""
    (folder / "parts").mkdir()
    for name, text in (parts or {}).items():
        (folder / "parts" / name).write_text(text, encoding="utf-8")
    path = folder / "joined.yaml"
    path.write_text(TWO_MASSES + couplers, encoding="utf-8")
    with pytest.raises(ApcError) as caught:
        compile_topology(path)
    return str(caught.value)


def test_two_joints_that_say_the_same_with_these_numbers_are_refused(tmp_path: Path) -> None:
    # For ratios that differ both masses would stand still; for equal ones nothing decides the forces.
    gears = "  g: {type: Gear, a: one, b: two, ratio: 1}\n  h: {type: Gear, a: one, b: two, ratio: 1}\n"
    assert "`h.a.x = h.ratio*h.b.x` (h) says what other constraints say already" in refusal(tmp_path, gears)


def test_an_equation_that_loses_its_unknown_with_these_numbers_is_refused(tmp_path: Path) -> None:
    text = """\
component: Push
connectors: {flange: Flange}
parameters: {gain: {unit: 1}, force: {unit: N}}
equations: [gain*flange.f = force]
"""
    told = refusal(tmp_path, "  p: {type: Push, flange: one, gain: 0, force: 1 N}\n", {"push.yaml": text})
    assert "E511" in told
    assert "p.gain*p.flange.f = p.force" in told


def test_components_that_double_at_every_level_are_refused_at_once(tmp_path: Path) -> None:
    def nested(level: int) -> str:
        inner = "Mass, mass: 1 kg" if level == 0 else f"Nest{level - 1}"
        return f"component: Nest{level}\nparts:\n  a: {{type: {inner}}}\n  b: {{type: {inner}}}\n"

    parts = {f"nest{level}.yaml": nested(level) for level in range(25)}
    told = refusal(tmp_path, "  n: {type: Nest24}\n", parts)
    assert "E216" in told
    assert "more than 10 deep" in told


def test_an_array_of_composites_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    text = "component: Pair\nparts:\n  a: {type: Mass, mass: 1 kg}\n  b: {type: Mass, mass: 1 kg}\n"
    told = refusal(tmp_path, "  n: {type: Pair, count: 1000}\n", {"pair.yaml": text})
    assert "E216 a peer would have more than 2000 parts" in told
