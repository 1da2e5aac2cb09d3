"""Components that are nearly right have an answer or one message that names the equation."""
# ruff: noqa: E501 -- a case a line reads best

from __future__ import annotations

import math
from pathlib import Path

import pytest

import apc
from apc.compiler.errors import ApcError

SCENE = """
topology: odd
library: ./parts
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


def model(folder: Path, equations: list[str], x: str = "0 m") -> apc.CompiledSystem:
    """Return a mass of 1 kg with 5 N*s/m that an own component joins to the ground."""
    clocked = any("sample" in one for one in equations)
    (folder / "parts").mkdir()
    text = OWN.format(
        clock="  clock: clock\n" if clocked else "", equations="\n".join(f"  - {one}" for one in equations)
    )
    (folder / "parts" / "own.yaml").write_text(text, encoding="utf-8")
    scene = SCENE.format(x=x, clock=", clock: tick" if clocked else "")
    (folder / "scene.yaml").write_text(scene, encoding="utf-8")
    return apc.compile(folder / "scene.yaml")


def sampled_spring(stiffness: float) -> float:
    """Return the spectral radius of 1 kg with 5 N·s/m at a spring that is computed every ms.

    With d = e^(−5T): x⁺ = x + (1 − d)/5·v − K·g·x and v⁺ = d·v − K·(1 − d)/5·x, g = (T − (1 − d)/5)/5.
    """
    period, damping = 1e-3, 5.0
    reach = -math.expm1(-damping * period) / damping
    trace = 1 + math.exp(-damping * period) - stiffness * (period - reach) / damping
    determinant = (1 - stiffness * (period - reach) / damping) * math.exp(-damping * period)
    determinant += stiffness * reach * reach
    assert trace * trace < 4 * determinant
    return math.sqrt(determinant)


@pytest.mark.parametrize(
    ("equations", "stiffness"),
    [
        (["z = sample(a.x)", "a.f = hold(z*K)", "b.f = -a.f"], 100),
        (["z = 0.5*z + sample(a.x)", "a.f = hold(z*K)", "b.f = -a.f"], 200),
        (["z = L*sin(z/L)/2 + sample(a.x)", "a.f = hold(z*K)", "b.f = -a.f"], 200),
        (["z = z*z/L + sample(a.x)", "a.f = hold(z*K)", "b.f = -a.f"], 100),
        (["z = sample(a.x)", "a.f = hold(if z >= 0 then K*z else K*L*(-z/L)^1.5)", "b.f = -a.f"], 100),
        (["z = sample(a.x)", "a.f = hold(if z < 0 then F*log(-z/L) else K*z)", "b.f = -a.f"], 100),
        (["z = sample(a.x)", "a.f = hold(if z < 0 then F*L/z else K*z)", "b.f = -a.f"], 100),
        (["z = sample(a.x)", "a.f = hold(if z < 0 then F*sqrt(z/L) else K*z)", "b.f = -a.f"], 100),
    ],
)
def test_a_good_component_has_the_radius_of_its_spring(
    equations: list[str], stiffness: float, tmp_path: Path
) -> None:
    found = apc.analyze(model(tmp_path, equations))
    assert found.spectral_radius == pytest.approx(sampled_spring(stiffness), abs=1e-12)


@pytest.mark.parametrize("jump", ["floor", "sign"])
def test_a_loop_that_the_value_of_a_jump_opens_is_none(jump: str, tmp_path: Path) -> None:
    """What jumps is asked of ground, which is at 0: nothing but der(a.x) = 0 is left to find the force by."""
    equations = [f"F*{jump}(b.x/L)*sqrt(a.f/F) = K*T0*der(a.x)", "b.f = -a.f", "z = a.x"]
    found = apc.analyze(model(tmp_path, equations))
    assert (found.rigid_modes, found.spectral_radius) == (1, 0)


@pytest.mark.parametrize(
    "equations",
    [
        ["a.x = z", "b.f = -a.f", "z = L*sin(time/T0)"],
        ["z = L*sin(time/T0)", "a.x = z", "b.f = -a.f"],
        ["z = a.x", "a.x = b.x", "b.f = -a.f"],
        ["z = a.x", "a.x = L", "b.f = -a.f"],
    ],
)
def test_a_scene_in_which_nothing_is_free_to_move_is_stable_and_plays(
    equations: list[str], tmp_path: Path
) -> None:
    system = model(tmp_path, equations)
    found = apc.analyze(system)
    assert (found.verdict, found.spectral_radius) == ("stable", 0)
    assert apc.simulate(system, duration="20 ms", jit=False).time[-1] == pytest.approx(0.02)


LINE = r"own\.yaml:\d+:\d+: "


@pytest.mark.parametrize(
    ("equations", "x", "told"),
    [
        (["a.f = F*((z - a.x)/L)^-1", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E512 `own.a.f = .*` .own. holds a constant that is no number"),
        (["a.f = F*(a.x/L)^(1/3)", "b.f = -a.f", "z = a.x"], "-1 mm", r"E808 der\(m.v\) is nan at the start values"),
        (["a.f = F*log(a.x/L)", "b.f = -a.f", "z = a.x"], "-1 mm", r"E808 der\(m.v\) is nan at the start values"),
        (["a.f = F*sqrt(a.x/L)", "b.f = -a.f", "z = a.x"], "0 m", r"E808 the slope of der\(m.v\) is -?inf at the start values"),
        (["a.x = b.x + z", "b.f = -a.f", "z = if a.x <= 0 then z else z"], "0 m", LINE + "E502 `own.z = if own.a.x <= 0 then own.z else own.z` .own. holds no unknown"),
        (["a.x = b.x + z", "b.f = -2*a.f", "der(z) = (F/K + T0*der(a.x))/T0"], "0 m", LINE + r"E502 `der\(own.z\) = .*` .own. holds no unknown"),
        (["F/(if a.x == z then time/T0 else 2) = F", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E502 .* holds no unknown"),
        (["a.x = b.x + (if T0*der(a.x) >= L then L else a.x/2)", "b.f = -a.f", "z = a.x"], "0 m", LINE + "E509 .*since the factor moves"),
        (["z = max(z, z - 0*sample(a.x))", "a.f = hold(z*K)", "b.f = -a.f"], "0 m", LINE + "E503 .* a loop that many values solve, or none"),
        (["z = max(z, sample(a.x))", "a.f = hold(z*K)", "b.f = -a.f"], "0 m", LINE + "E503 .* a loop that many values solve, or none"),
        (["z = max(z + sample(a.x), L)", "a.f = hold(z*K)", "b.f = -a.f"], "0 m", LINE + "E503 .* a loop that many values solve, or none"),
        (["z = sample(a.x)", "a.f = hold(K*z + F*sqrt(((K*z - K*z) - F)/F))", "b.f = -a.f"], "0 m", LINE + "E512 `own.held1 = "),
        (["z = sample(a.x)", "a.f = hold(K*z + F*sqrt((K*sample(b.x) - F)/F))", "b.f = -a.f"], "0 m", "E808 "),
        (["z = z*z/L + z + sample(a.x)", "a.f = hold(z*K)", "b.f = -a.f"], "0 m", "E808 .* at the start values"),
    ],
)  # fmt: skip
def test_what_has_no_answer_is_told_by_name(equations: list[str], x: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(ApcError, match=told):
        apc.analyze(model(tmp_path, equations, x))
