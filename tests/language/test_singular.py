"""Components that are nearly right have an answer, or one message that names the equation."""
# ruff: noqa: E501 -- a case a line reads best

from __future__ import annotations

import math
from pathlib import Path

import pytest

import apc
from apc.compiler.errors import ApcError
from tests.topologies import compiled, library, messages_of

TOPOLOGY = """
topology: odd
clocks: {{tick: 1 ms}}
peers: {{user: {{count: 1}}}}
masses: {{m: {{mass: 1 kg, damping: 5 N*s/m, x: {x}}}}}
couplers: {{own: {{type: Own, a: m, b: ground{clock}}}}}
"""
OWN = """
component: Own
connectors: {{a: Flange, b: Flange}}
parameters:
  K:  {{unit: N/m, default: 100}}
  F:  {{unit: N, default: 1}}
  T0: {{unit: s, default: 1}}
  L:  {{unit: m, default: 1}}
{clock}variables: {{z: {{unit: m, start: 0}}}}
equations:
{equations}
"""


def model(folder: Path, equations: list[str], x: str = "0 m") -> apc.Model:
    """Return a mass of 1 kg with 5 N*s/m that an own component joins to the ground."""
    clocked = any("sample" in one for one in equations)
    lines = "\n".join(f"  - {one}" for one in equations)
    library(folder, OWN.format(clock="  clock: clock\n" if clocked else "", equations=lines))
    topology = TOPOLOGY.format(x=x, clock=", clock: tick" if clocked else "")
    (folder / "topology.yaml").write_text(f"library: ./{topology}", encoding="utf-8")
    return apc.compile(folder / "topology.yaml")


def sampled_spring(stiffness: float) -> float:
    """Return the spectral radius of 1 kg with 5 N·s/m at a spring that is computed every ms.

    With d = e^(−5T): x⁺ = x + (1 − d)/5·v − K·g·x and v⁺ = d·v − K·(1 − d)/5·x, g = (T − (1 − d)/5)/5.
    """
    period, damping = 1e-3, 5.0
    reach = -math.expm1(-damping * period) / damping
    determinant = (1 - stiffness * (period - reach) / damping) * math.exp(-damping * period)
    return math.sqrt(determinant + stiffness * reach * reach)


HELD = ["a.f = hold(z*K)", "b.f = -a.f"]


@pytest.mark.parametrize(
    ("equation", "force", "stiffness"),
    [
        ("z = sample(a.x)", "z*K", 100),
        ("z = 0.5*z + sample(a.x)", "z*K", 200),
        ("z = L*sin(z/L)/2 + sample(a.x)", "z*K", 200),
        ("z = z*z/L + sample(a.x)", "z*K", 100),
        ("z = sample(a.x)", "if z >= 0 then K*z else K*L*(-z/L)^1.5", 100),
        ("z = sample(a.x)", "if z < -L then F*log(-z/L) else K*z", 100),
        ("z = sample(a.x)", "if z < -L then F*L/z else K*z", 100),
        ("z = sample(a.x)", "if z < -L then F*sqrt(z/L) else K*z", 100),
    ],
)
def test_a_good_component_has_the_radius_of_its_spring(
    equation: str, force: str, stiffness: float, tmp_path: Path
) -> None:
    found = apc.analyze(model(tmp_path, [equation, f"a.f = hold({force})", "b.f = -a.f"]))
    radii = [side.spectral_radius for side in found.sides] or [found.spectral_radius]
    assert max(radii) == pytest.approx(sampled_spring(stiffness), abs=1e-12)


@pytest.mark.parametrize("branch", ["F*log(-z/L)", "F*L/z", "F*sqrt(z/L - 1)"])
def test_a_branch_that_is_infinite_at_the_start_has_no_linearization(branch: str, tmp_path: Path) -> None:
    force = f"if z < 0 then {branch} else K*z"
    with pytest.raises(ApcError, match="E808"):
        apc.analyze(model(tmp_path, ["z = sample(a.x)", f"a.f = hold({force})", "b.f = -a.f"]))


@pytest.mark.parametrize("jump", ["floor", "sign"])
def test_a_loop_that_the_value_of_a_jump_opens_is_none(jump: str, tmp_path: Path) -> None:
    """What jumps is asked of ground, which is at 0: nothing but der(a.x) = 0 is left to find the force by."""
    equations = [f"F*{jump}(b.x/L)*sqrt(a.f/F) = K*T0*der(a.x)", "b.f = -a.f", "z = a.x"]
    found = apc.analyze(model(tmp_path, equations))
    assert (found.rigid_modes, found.spectral_radius) == (1, 0)


LINE = r":\d+:\d+: "
LOOP = f"{LINE}E503 .* a singular algebraic loop"


@pytest.mark.parametrize(
    ("equations", "x", "expected"),
    [
        (["a.f = F*((z - a.x)/L)^-1", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E512 `own.a.f = .*` .own. has an undefined or too large constant"),
        (["a.f = F*(a.x/L)^(1/3)", "b.f = -a.f", "z = a.x"], "-1 mm", LINE + r"E808 der\(m.v\) is nan at the initial"),
        (["a.f = F*log(a.x/L)", "b.f = -a.f", "z = a.x"], "-1 mm", r"E808 der\(m.v\) is nan at the initial state"),
        (["a.f = F*sqrt(a.x/L)", "b.f = -a.f", "z = a.x"], "0 m", r"E808 the slope of der\(m.v\) is -?inf at the initial state"),
        (["a.x = b.x + z", "b.f = -a.f", "z = if a.x <= 0 then z else z"], "0 m", LINE + "E502 `own.z = if own.a.x <= 0 then own.z else own.z` .own. has no unknown"),
        (["a.x = b.x + z", "b.f = -2*a.f", "der(z) = (F/K + T0*der(a.x))/T0"], "0 m", LINE + r"E502 `der\(own.z\) = .*` .own. has no unknown"),
        (["F/(if a.x == z then time/T0 else 2) = F", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E502 .* has no unknown"),
        (["a.x = b.x + (if T0*der(a.x) >= L then L else a.x/2)", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E509 .*since a factor may become zero"),
        (["z = max(z, z - 0*sample(a.x))", *HELD], "0 m", LOOP),
        (["z = max(z, sample(a.x))", *HELD], "0 m", LOOP),
        (["z = max(z + sample(a.x), L)", *HELD], "0 m", LOOP),
        (["z = sample(a.x)", "a.f = hold(K*z + F*sqrt(((K*z - K*z) - F)/F))", "b.f = -a.f"], "0 m", LINE + "E512 `own.held1 = "),
        (["z = sample(a.x)", "a.f = hold(K*z + F*sqrt((K*sample(b.x) - F)/F))", "b.f = -a.f"], "0 m", "E808 "),
        (["z = z*z/L + z + sample(a.x)", *HELD], "0 m", "E808 .* at the initial state"),
    ],
)  # fmt: skip
def test_what_has_no_answer_is_told_by_name(
    equations: list[str], x: str, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(apc.ApcError, match=expected):
        apc.analyze(model(tmp_path, equations, x))


# ---- singular with these numbers only ----

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
    lines = messages_of(compiled, text, library(tmp_path, TANK, DEEP))
    assert [line.partition("E")[2][:3] for line in lines] == (["511"] if refused else [])


def test_two_joints_that_say_the_same_with_these_numbers_are_refused() -> None:
    """For ratios that differ both masses would stand still; for equal ones nothing decides the forces."""
    text = "topology: joined\npeers: {user: {count: 1}}\nmasses: {one: {mass: 1 kg}, two: {mass: 1 kg}}\n"
    gears = (
        "couplers: {g: {type: Gear, a: one, b: two, ratio: 1}, h: {type: Gear, a: one, b: two, ratio: %d}}\n"
    )
    [line] = messages_of(compiled, text + gears % 1)
    assert "`h.a.x = h.ratio*h.b.x` (h) is redundant" in line
    assert messages_of(compiled, text + gears % 2) == []
