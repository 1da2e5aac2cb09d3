"""A mass of 2 kg with 3 N·s/m, and a component whose equations are the test's."""

from __future__ import annotations

from pathlib import Path

import apc
from tests.library.parts import rates
from tests.topologies import ONE_MASS, compiled, library

COMPONENT = """\
component: Own
connectors: {{flange: Flange}}
parameters:
  K: {{unit: N/m, default: 100}}
  F: {{unit: N, default: 1}}
  L: {{unit: m, default: 1}}
  T: {{unit: s, default: 1}}
  p: {{unit: 1, default: 0.25}}
{clock}variables: {{{variables}}}
equations:
{equations}
"""


def component(*equations: str, variables: str = "") -> str:
    """Return the text of a component; `y z` are lengths, `u=1/s` has another unit, `s:` a start value."""
    declared = []
    for word in variables.split():
        name, _, unit = word.rstrip(":").partition("=")
        declared.append(f"{name}: {{unit: {unit or 'm'}{', start: 0' if word.endswith(':') else ''}}}")
    clock = "  clock: clock\n" if any("sample" in equation for equation in equations) else ""
    lines = "\n".join(f"  - {equation}" for equation in equations)
    return COMPONENT.format(clock=clock, variables=", ".join(declared), equations=lines)


def topology(text: str, more: str = "", start: str = "0 m") -> str:
    """Return a topology in which the component of a text acts on the mass, with more said of it."""
    clock = ", clock: tick" if "clock: clock" in text else ""
    base = ONE_MASS.replace("3 N*s/m", f"3 N*s/m, x: {start}")
    return f"{base}clocks: {{tick: 1 ms}}\nhands: {{own: {{type: Own, flange: device{clock}{more}}}}}\n"


def model(folder: Path, *equations: str, variables: str = "", more: str = "") -> apc.Model:
    """Return the compiled topology."""
    text = component(*equations, variables=variables)
    return compiled(topology(text, more), library(folder, text))


def force(model: apc.Model, x: float = 0.0, v: float = 0.0) -> float:
    """Return the force of the component on the mass there: 2 kg times its acceleration, and its damping."""
    return 2 * rates(model, {"device.x": x, "device.v": v})["device.v"] + 3 * v
