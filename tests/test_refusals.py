"""What can't be computed is refused with its reason, instead of answered wrongly or for ever."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from tests.topologies import compiled, library, told

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
    message = refusal(tmp_path, "  p: {type: Push, flange: one, gain: 0, force: 1 N}\n", {"push.yaml": text})
    assert "E511" in message
    assert "p.gain*p.flange.f = p.force" in message


def test_components_that_double_at_every_level_are_refused_at_once(tmp_path: Path) -> None:
    def nested(level: int) -> str:
        inner = "Mass, mass: 1 kg" if level == 0 else f"Nest{level - 1}"
        return f"component: Nest{level}\nparts:\n  a: {{type: {inner}}}\n  b: {{type: {inner}}}\n"

    parts = {f"nest{level}.yaml": nested(level) for level in range(25)}
    message = refusal(tmp_path, "  n: {type: Nest24}\n", parts)
    assert "E216" in message
    assert "1000 are the most" in message


def test_an_array_of_composites_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    text = "component: Pair\nparts:\n  a: {type: Mass, mass: 1 kg}\n  b: {type: Mass, mass: 1 kg}\n"
    message = refusal(tmp_path, "  n: {type: Pair, count: 500}\n", {"pair.yaml": text})
    assert "E216 a peer would have more than 1000 parts" in message


TANK = """\
component: Tank
connectors: {flange: Flange}
parameters: {k: {unit: N/m}, h: {unit: N/m, default: 0 N/m}}
variables: {y: {unit: m}}
equations: [(k - h)*y = flange.x*k, flange.f = k*y]
"""
DEEP = """\
component: Deep
connectors: {flange: Flange}
parameters: {c: {unit: N/m}}
parts: {inner: {type: Tank, flange: flange, k: c - 3*c/c*c + 2*c + c/2}}
"""


@pytest.mark.parametrize(
    ("part", "settings", "refused"),
    [
        ("Tank, k: 1 N/m", "tank.k: [1 N/m, 0 N/m]", True),
        ("Tank, k: 1 N/m", "tank.k: [0 N/m, 1 N/m]", True),
        ("Tank, k: 1 N/m", "tank.k: [3 N/m, 1 N/m]", False),
        ("Tank, k: 1 N/m", "tank.k: [3 N/m, 1 N/m], tank.h: [1 N/m, 3 N/m]", False),
        ("Tank, k: 1 N/m", "tank.k: [3 N/m, 0.1 N/m], tank.h: [1 N/m, 0.1 N/m]", True),
        ("Deep, c: 1 N/m", "tank.c: [1 N/m, 7 N/m]", False),
        ("Deep, c: 1 N/m", "tank.c: [1 N/m, 7 N/m], tank.inner.h: [2 N/m, 3.5 N/m]", True),
    ],
)
def test_a_divisor_that_is_zero_for_one_peer_is_refused_whichever_peer_it_is(
    tmp_path: Path, part: str, settings: str, refused: bool
) -> None:
    """k − h of Tank; Deep gives its Tank k = c/2, so that h = 3.5 N/m is c/2 of the second peer alone."""
    text = f"""\
topology: tanks
peers: {{user: {{count: 2, set: {{{settings}}}}}}}
masses: {{device: {{mass: 0.1 kg, damping: 5 N*s/m}}}}
couplers: {{tank: {{flange: device, type: {part}}}}}
"""
    lines = told(compiled, text, library(tmp_path, TANK, DEEP))
    assert [line.partition("E")[2][:3] for line in lines] == (["511"] if refused else [])
