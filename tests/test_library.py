"""`library`: a component that is handed out is complete, balanced and consistent in its units."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from apc.compiler.components.component import Number, Option, Reference, option_test
from apc.compiler.components.library import Library
from apc.compiler.errors import ApcError
from apc.compiler.language.unit_text import format_dimension
from tests.topologies import ROOT, library, told

FILES = [path for path in sorted((ROOT / "models").rglob("*.yaml")) if path.parent.name != "scenes"]
BALL = """\
component: Ball
connectors: {flange: Flange}
parameters: {mass: {unit: kg, above: 0}}
variables: {x: {unit: m, start: 0 m}, v: {unit: m/s, start: 0 m/s}}
equations:
  - der(x) = v
  - mass*der(v) = flange.f
  - flange.x = x
"""


def ball(tmp_path: Path, old: str, new: str) -> list[str]:
    """Return what is told about the ball with one piece of its text replaced."""
    assert old in BALL
    own = library(tmp_path, BALL.replace(old, new))
    return [line.replace(str(tmp_path) + "/", "") for line in told(own.component, "Ball")]


def test_every_built_in_definition_reads_and_balances() -> None:
    built_in = Library()
    assert len(built_in.names) == len(FILES) >= 35
    for name in built_in.component_names:
        component = built_in.component(name)
        assert component is not None
        assert component.name == name
        assert component.about
    connectors = set(built_in.names) - set(built_in.component_names)
    assert connectors == {"Flange", "PlanarFlange", "SpatialFlange"}
    for name in connectors:
        connector = built_in.connector(name)
        assert connector is not None
        assert connector.name == name


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_is_named_after_what_it_defines_in_kebab_case(path: Path) -> None:
    name = "".join(word.capitalize() for word in path.stem.split("-"))
    assert name in Library().names
    titles = {f"component: {name}", f"connector: {name}"}
    assert titles & set(path.read_text(encoding="utf-8").splitlines())


def test_every_number_has_a_unit_and_a_description() -> None:
    built_in = Library()
    for name in built_in.component_names:
        component = built_in.component(name)
        assert component is not None
        for parameter in component.parameters:
            if isinstance(parameter, Number | Option):
                assert parameter.about, f"{name}.{parameter.name}"


def test_a_component_is_typed_whole() -> None:
    mass = Library().component("Mass")
    assert mass is not None
    number = mass.parameter("mass")
    assert isinstance(number, Number)
    assert (number.minimum, number.open_minimum, number.divided) == (0, True, True)
    damping = mass.parameter("damping")
    assert isinstance(damping, Number)
    assert (damping.minimum, damping.open_minimum, damping.default) == (0, False, 0)
    assert [v.name for v in mass.variables] == ["x", "v"]
    coupler = Library().component("AveragePosition")
    assert coupler is not None
    assert coupler.hears_others
    assert not mass.hears_others
    assert coupler.parameter("clock") == Reference("clock", "clock", "", coupler.parameter("clock").place)  # type: ignore[union-attr] # it is there
    assert isinstance(coupler.parameter("delays"), Option)
    assert coupler.parameter("nothing") is None


def test_a_name_nobody_has_gives_nothing() -> None:
    built_in = Library()
    assert built_in.component("Nothing") is None
    assert built_in.connector("Nothing") is None
    assert built_in.component("Flange") is None, "a connector is no component"
    assert built_in.connector("Mass") is None, "a component is no connector"


def test_a_folder_of_ones_own_comes_before_the_built_in_library(tmp_path: Path) -> None:
    own = library(tmp_path, BALL, BALL.replace("Ball", "Mass"))
    found = own.component("Mass")
    assert found is not None
    assert found.parameter("damping") is None
    assert own.component("Ball") is not None


def test_a_bare_number_of_a_declaration_is_in_the_unit_beside_it(tmp_path: Path) -> None:
    text = BALL.replace("{unit: kg, above: 0}", "{unit: g, above: 1, max: 2 kg, default: 500}")
    component = library(tmp_path, text).component("Ball")
    assert component is not None
    mass = component.parameter("mass")
    assert isinstance(mass, Number)
    assert (mass.minimum, mass.maximum, mass.default) == (Fraction(1, 1000), 2, Fraction(1, 2))


def test_words_name_values_of_a_number(tmp_path: Path) -> None:
    text = BALL.replace(
        "parameters: {", "parameters: {side: {unit: '1', options: {left: -1, right: 1}}, "
    ).replace("flange.f", "side*flange.f")
    component = library(tmp_path, text).component("Ball")
    assert component is not None
    side = component.parameter("side")
    assert isinstance(side, Number)
    assert side.words == (("left", -1), ("right", 1))


def test_an_undeclared_left_side_is_a_local_with_the_dimension_of_its_right_side(tmp_path: Path) -> None:
    text = BALL + "  - force = mass*der(v)\n"
    component = library(tmp_path, text).component("Ball")
    assert component is not None
    assert [(name, format_dimension(d)) for name, d in component.locals] == [("force", "N")]


def test_an_unbalanced_component_says_how_many_equations_and_which_unknowns(tmp_path: Path) -> None:
    assert ball(tmp_path, "  - flange.x = x\n", "") == [
        "part0.yaml:1:12: E501 Ball is unbalanced: 2 equations for 3 unknowns (x, v, flange.f). "
        "Write: one equation for each variable and one for each flow of a connector"
    ]


def test_an_unknown_name_gets_the_nearest_at_its_column(tmp_path: Path) -> None:
    assert ball(tmp_path, "mass*der(v)", "mas*der(v)") == [
        "part0.yaml:7:5: E303 Ball has no mas; the nearest is mass. Write: mass"
    ]


def test_an_equation_whose_units_differ_is_refused_at_its_term(tmp_path: Path) -> None:
    (line,) = ball(tmp_path, "der(x) = v", "der(x) = x")
    assert line.startswith("part0.yaml:6:14: E401 ")


def test_both_branches_of_an_option_are_checked(tmp_path: Path) -> None:
    text = BALL.replace("parameters: {", "parameters: {how: {options: [one, two]}, ")
    good = text.replace("= flange.f", "= if how == one then flange.f else 2*flange.f")
    component = library(tmp_path, good).component("Ball")
    assert component is not None
    bad = text.replace("= flange.f", "= if how == one then flange.f else flange.x")
    (line,) = told(library(tmp_path, bad).component, "Ball")
    assert line.endswith("part0.yaml:7:52: E404 flange.x wants N like flange.f, got m.")


def test_an_option_test_names_its_option_and_word(tmp_path: Path) -> None:
    coupler = Library().component("FullMesh")
    assert coupler is not None
    options = {p.name: p for p in coupler.parameters if isinstance(p, Option)}
    condition = coupler.equations[-1].right.condition  # type: ignore[union-attr] # it is there
    assert option_test(condition, options) == (options["delays"], "all")
    assert option_test(condition, {}) is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "{flange: Flange}",
            "{flange: Flanch}",
            "part0.yaml:2:22: E206 there is no connector type Flanch; the nearest is Flange. Write: Flange",
        ),
        (
            "x: {unit: m, start: 0 m}",
            "mass: {unit: m}, x: {unit: m, start: 0 m}",
            "part0.yaml:4:13: E205 the name mass is used twice in this component",
        ),
        (
            "mass: {unit: kg, above: 0}",
            "mass: mass",
            "part0.yaml:3:20: E203 parameter mass wants clock, link,",
        ),
        ("mass: {unit: kg, above: 0}", "mass: {above: 0}", "part0.yaml:3:20: E201 mass has no unit"),
        (
            "mass: {unit: kg, above: 0}",
            "mass: {unit: kg, abov: 0}",
            "part0.yaml:3:31: E202 parameter mass has no key abov; the nearest is above. Write: above",
        ),
        ("mass: {unit: kg, above: 0}", "mass: {unit: kgg}", "part0.yaml:3:27: E223 there is no unit kgg."),
        (
            "parameters: {",
            "parameters: {peers: {unit: '1'}, ",
            "part0.yaml:3:21: E205 peers is a word of the language and can't be a name.",
        ),
        (
            "parameters: {",
            "parameters: {how: {options: [one, two], default: three}, ",
            "part0.yaml:3:50: E206 how has no option three",
        ),
        (
            "{unit: kg, above: 0}",
            "{unit: g, min: 3, above: 1}",
            "part0.yaml:3:45: E203 mass wants either min or above, got both.",
        ),
        (
            "{unit: kg, above: 0}",
            "{unit: g, above: 1, default: 1}",
            "part0.yaml:3:49: E207 the default of mass wants more than 1 g, got 1 g.",
        ),
        (
            "{unit: kg, above: 0}",
            "{unit: g, min: 1, max: 0.5}",
            "part0.yaml:3:43: E207 the max of mass wants 1 g or more, got 0.5 g.",
        ),
        (
            "{unit: kg, above: 0}",
            "{unit: g, max: 2, options: {one: 1, three: 3}}",
            "part0.yaml:3:63: E207 three of mass wants 2 g or less, got 3 g.",
        ),
        ("equations:\n", "equations: 3\nabout:\n", "part0.yaml:5:12: E203 equations wants a list, got 3."),
    ],
)
def test_a_faulty_declaration_is_told_at_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    lines = ball(tmp_path, old, new)
    assert any(line.startswith(message) for line in lines), lines


def test_a_faulty_component_is_never_handed_out(tmp_path: Path) -> None:
    own = library(tmp_path, BALL.replace("  - flange.x = x\n", ""))
    for _ in range(2):
        with pytest.raises(ApcError, match="E501"):
            own.component("Ball")
