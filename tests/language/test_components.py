"""Components of the library and of one's own: found, complete, each number in the unit beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from tests.library.parts import values
from tests.topologies import ONE_MASS, ROOT, compiled, library, messages_of

FILES = [
    path
    for path in sorted((ROOT / "models").rglob("*.yaml"))
    if "topologies" not in path.parts and ("published" not in path.parts or "components" in path.parts)
]
BALL = """\
component: Ball
connectors: {flange: Flange}
parameters: {mass: {unit: g, exclusive_min: 1, max: 2 kg, default: 500}}
variables: {x: {unit: m, start: 0 m}, v: {unit: m/s, start: 0 m/s}}
equations:
  - der(x) = v
  - force = mass*der(v)
  - force = flange.f
  - flange.x = x
"""


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_is_named_after_what_it_defines_in_kebab_case(path: Path) -> None:
    name = "".join(word.capitalize() for word in path.stem.split("-"))
    titles = {f"component: {name}", f"connector: {name}"}
    assert titles & set(path.read_text(encoding="utf-8").splitlines())


def test_a_folder_of_ones_own_comes_before_the_library(tmp_path: Path) -> None:
    own = library(tmp_path, BALL.replace("Ball", "Mass"), BALL)
    masses = "masses: {device: {type: Mass}, ball: {type: Ball}}\n"
    model = compiled(f"topology: own\npeers: {{u: {{count: 1}}}}\n{masses}", own)
    assert "device.damping" not in values(model)
    assert apc.analyze(model).rigid_modes == 2


def test_a_bare_number_of_a_declaration_is_in_the_unit_beside_it(tmp_path: Path) -> None:
    text = "topology: own\npeers: {u: {count: 1}}\nmasses: {ball: {type: Ball}}\n"
    model = compiled(text, library(tmp_path, BALL))
    [mass] = [one for one in model.parameters if one.name == "ball.mass"]
    assert (mass.minimum, mass.exclusive_minimum, mass.maximum, mass.value) == (0.001, True, 2.0, 0.5)
    [line] = messages_of(
        compiled, text.replace("type: Ball", "type: Ball, mass: 1 g"), library(tmp_path, BALL)
    )
    assert line.endswith("E207 mass: expected more than 1 g, got 1 g.")


@pytest.mark.parametrize(("other", "code"), [("2*flange.x/L*F", ""), ("flange.x", "E404")])
def test_both_branches_of_an_option_are_checked(other: str, code: str, tmp_path: Path) -> None:
    own = (
        "component: Own\nconnectors: {flange: Flange}\nparameters: {how: {options: [one, two], default: one},"
        " F: {unit: N, default: 1}, L: {unit: m, default: 1}}\n"
        f"equations: ['flange.f = if how == one then F else {other}']\n"
    )
    text = f"{ONE_MASS}hands: {{own: {{type: Own, flange: device}}}}\n"
    lines = messages_of(compiled, text, library(tmp_path, own))
    assert [line.split()[1] for line in lines] == ([code] if code else [])
