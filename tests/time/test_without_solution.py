"""An equation that loses its solution during a simulation is reported with its instant."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands import Cli, write

TOPOLOGY = """topology: root
library: ./parts
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 1 kg, damping: 1 N*s/m}}
couplers: {root: {type: Root, flange: device, clock: haptic}}
"""
COMPONENT = """component: Root
connectors: {flange: Flange}
parameters: {clock: clock}
variables: {z: {unit: m, start: 0.5 m}}
equations:
  - z^2 = EQUATION
  - flange.f = hold(K*z)
"""


@pytest.mark.parametrize(
    ("right", "after"),
    [
        ("A - sample(time)*B", "0.25"),  # the right side is negative from 250 ms on
        ("A - C*abs(sample(flange.x)) - sample(time)*B", "0.2"),
    ],
)
def test_the_instant_without_a_solution_is_reported(right: str, after: str, cli: Cli) -> None:
    Path("parts").mkdir()
    parameters = "clock: clock, K: {unit: N/m, default: 1 N/m}, A: {unit: m^2, default: 0.25 m^2}, "
    parameters += "B: {unit: m^2/s, default: 1 m^2/s}, C: {unit: m, default: 1 m}"
    text = COMPONENT.replace("EQUATION", right).replace("clock: clock", parameters)
    write("parts/root.yaml", text)
    write("topology.yaml", TOPOLOGY)
    ran = cli("simulate topology.yaml --duration '1 s'")
    assert (ran.code, "E872" in ran.err) == (1, True), ran.err
    assert f"after {after}" in ran.err
