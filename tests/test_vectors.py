# ruff: noqa: E501 -- lists of messages read best as they are
"""Vectors: written out entry by entry as defined; what does not fit is told with what to write."""

from __future__ import annotations

import random
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc.compiler.errors import ApcError, Place
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import format_expression
from apc.compiler.language.grammar import parse_equation, parse_expression
from apc.compiler.language.vectors import sizes_of, whole_and_index, written_equation, written_out
from apc.compiler.pipeline import run_stages
from tests.language.test_messages import MODELS
from tests.topologies import ROOT, compiled, library
from tests.topologies import told as told_of

HERE = Place("a.yaml")
SIZES = {("a", "x"): 2, ("b", "x"): 2, ("r",): 3, ("s",): 3, ("open",): None}


def out(text: str) -> list[str] | str | None:
    found = written_out(parse_expression(text, HERE), lambda parts: SIZES.get(parts, 0), text, HERE)
    if found is None:
        return None
    return [format_expression(e) for e in found] if isinstance(found, tuple) else format_expression(found)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("a.x", ["a.x[1]", "a.x[2]"]),
        ("a.x[2]", "a.x[2]"),
        ("k*(a.x - b.x)", ["k*(a.x[1] - b.x[1])", "k*(a.x[2] - b.x[2])"]),
        ("-a.x/2", ["-a.x[1]/2", "-a.x[2]/2"]),
        ("{1, k} + a.x", ["1 + a.x[1]", "k + a.x[2]"]),
        ("der(a.x)", ["der(a.x[1])", "der(a.x[2])"]),
        ("sample(a.x, clock)", ["sample(a.x[1], clock)", "sample(a.x[2], clock)"]),
        ("hold(a.x, delay)", ["hold(a.x[1], delay)", "hold(a.x[2], delay)"]),
        ("mean(a.x - b.x)", ["mean(a.x[1] - b.x[1])", "mean(a.x[2] - b.x[2])"]),
        ("max(a.x, 0)", ["max(a.x[1], 0)", "max(a.x[2], 0)"]),
        ("if k > 0 then a.x else {0, 0}", ["if k > 0 then a.x[1] else 0", "if k > 0 then a.x[2] else 0"]),
        ("dot(a.x, b.x)", "a.x[1]*b.x[1] + a.x[2]*b.x[2]"),
        ("norm(a.x)", "sqrt(a.x[1]^2 + a.x[2]^2)"),
        ("cross(a.x, b.x)", "a.x[1]*b.x[2] - a.x[2]*b.x[1]"),
        (
            "cross(r, s)",
            ["r[2]*s[3] - r[3]*s[2]", "r[3]*s[1] - r[1]*s[3]", "r[1]*s[2] - r[2]*s[1]"],
        ),
        ("open - a.x", ["open - a.x[1]", "open - a.x[2]"]),
        ("open*2", None),
        ("norm(open)", "0"),  # a number, whichever
        ("k + 1", "k + 1"),
    ],
)
def test_an_expression_of_vectors_is_one_for_each_entry(text: str, written: list[str] | str | None) -> None:
    assert out(text) == written


def test_an_equation_between_vectors_holds_for_each_entry() -> None:
    equation = parse_equation("k*der(a.x) = -b.x", HERE)
    found = written_equation(equation, lambda parts: SIZES.get(parts, 0))
    assert [f"{format_expression(e.left)} = {format_expression(e.right)}" for e in found] == [
        "k*der(a.x[1]) = -b.x[1]",
        "k*der(a.x[2]) = -b.x[2]",
    ]


def test_the_names_of_entries_tell_the_vectors() -> None:
    assert sizes_of([("a", "x[1]"), ("a", "x[2]"), ("chain[2]", "v"), ("k",)]) == {("a", "x"): 2}
    assert whole_and_index("x[2]") == ("x", 2)
    assert whole_and_index("x") == ("x", 0)


class _Made:
    """Random expressions of numbers and vectors, with what they come to by NumPy."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.size = self.chance.choice((2, 3))
        chance = self.chance
        names = ("u", "v")
        self.vectors = {n: np.array([chance.randint(-9, 9) for _ in range(self.size)], float) for n in names}

    def vector(self, depth: int) -> tuple[str, np.ndarray]:
        pick = self.chance.randrange(8) if depth else 0
        if pick < 2:
            name = self.chance.choice(list(self.vectors))
            return name, self.vectors[name]
        if pick == 2:
            entries = [self.number(depth - 1) for _ in range(self.size)]
            return "{" + ", ".join(t for t, _ in entries) + "}", np.array([x for _, x in entries])
        one, two = self.vector(depth - 1), self.vector(depth - 1)
        if pick == 3:
            return f"({one[0]} - {two[0]})", one[1] - two[1]
        if pick == 4 and self.size == 3:
            return f"cross({one[0]}, {two[0]})", np.cross(one[1], two[1])
        if pick == 5:
            text, factor = self.number(depth - 1)
            return f"{text}*{one[0]}", factor * one[1]
        if pick == 6:
            text, left = self.number(depth - 1)
            return f"(if {text} > 1 then {one[0]} else -{two[0]})", one[1] if left > 1 else -two[1]
        return f"max({one[0]}, {two[0]})/3", np.maximum(one[1], two[1]) / 3

    def number(self, depth: int) -> tuple[str, float]:
        if not depth or not self.chance.randrange(4):
            k = self.chance.randrange(1, self.size + 1)
            return f"u[{k}]", self.vectors["u"][k - 1]
        one, two = self.vector(depth - 1), self.vector(depth - 1)
        if self.chance.randrange(2):
            return f"dot({one[0]}, {two[0]})", float(one[1] @ two[1])
        return f"norm({one[0]})", float(np.linalg.norm(one[1]))


@pytest.mark.parametrize("seed", range(100))
def test_what_is_written_out_comes_to_what_numpy_says(seed: int) -> None:
    made = _Made(seed)
    text, expected = made.vector(4)
    found = written_out(
        parse_expression(text, HERE), lambda parts: made.size if parts[0] in made.vectors else 0, text, HERE
    )
    assert isinstance(found, tuple)

    def value(parts: tuple[str, ...]) -> Fraction:
        name, index = whole_and_index(parts[0])
        return Fraction(made.vectors[name][index - 1])

    size = 1 + np.abs(expected).max()
    assert [float(evaluate(one, value)) for one in found] == pytest.approx(expected, abs=1e-12 * size)


def test_what_doubles_at_each_level_is_refused_before_it_fills_the_memory() -> None:
    nested = "cross(r, s)"
    for _ in range(30):
        nested = f"cross({nested}, s)"
    with pytest.raises(
        ApcError, match="entry by entry this has more than 10000 terms: give a part of it a name"
    ):
        out(nested)


# ---- what is told ----

PAD = """\
component: Pad
about: A pad between two points.
connectors: {a: PlanarFlange, b: PlanarFlange}
parameters:
  stiffness: {unit: N/m, min: 0}
  rest: {unit: m, size: 2, default: [0 m, 0 m]}
variables:
  f: {unit: N, size: 2}
equations:
  - f = stiffness*(a.x - b.x - rest)
  - a.f = f
  - b.f = -f
"""
SCENE = """\
topology: plane
library: parts
peers: {user: {count: 2}}
masses:
  device: {type: PlanarMass, mass: 2 kg, x: [1 mm, 2 mm]}
couplers:
  pad: {type: Pad, a: device, b: ground, stiffness: 3 N/m}
"""

COMPONENT = [
    ("a.f = f", "a.f = f + 0", "11:15: E406 0 wants a vector of 2 like f, got a number. Write: {0, 0}"),
    ("a.f = f", "a.f = stiffness*dot(a.x, b.x)/norm(a.x)",
     "11:11: E406 stiffness*dot(a.x, b.x)/norm(a.x) wants a vector of 2 like a.f, got a number."),
    ("a.f = f", "a.f = f + {0, 0, 0}", "11:15: E406 {0, 0, 0} wants a vector of 2 like f, got a vector of 3."),
    ("a.f = f", "a.f = f + {0}", "11:15: E406 {0} wants 2 or 3 entries, got 1."),
    ("a.f = f", "a.f = f[1]", "11:11: E406 f[1] wants a vector of 2 like a.f, got a number. Write: {f[1], f[1]}"),
    ("a.f = f", "a.f[1] = f", "11:14: E406 f wants a number like a.f[1], got a vector of 2. Write: f[1], or norm(f)"),
    ("a.f = f", "a.f = stiffness*a.x*norm(f)/f",
     "11:33: E407 f wants a number, got a vector of 2. Write: f[1], or norm(f)"),
    ("a.f = f", "a.f = f*a.x/norm(a.x)",
     "11:11: E407 f*a.x wants one vector at most in a product, got two. Write: dot(f, a.x)"),
    ("a.f = f", "a.f = f*(a.x/rest[1])^2",
     "11:13: E407 (a.x/rest[1]) wants a number, got a vector of 2. Write: dot(a.x/rest[1], a.x/rest[1])"),
    ("a.f = f", "a.f = if a.x > rest then f else -f",
     "11:14: E407 a.x wants a number, got a vector of 2. Write: a.x[1], or norm(a.x)"),
    ("a.f = f", "a.f = if norm(a.x) > norm(rest) then f else 0",
     "11:49: E406 0 wants a vector of 2 like f, got a number. Write: {0, 0}"),
    ("a.f = f", "a.f = f*norm(stiffness)/stiffness",
     "11:18: E407 stiffness in norm wants a vector, got a number. Write: abs(stiffness)"),
    ("a.f = f", "a.f = f*dot(stiffness, stiffness)/stiffness^2",
     "11:17: E407 stiffness in dot wants a vector, got a number. Write: stiffness*stiffness"),
    ("a.f = f", "a.f = f*cross(a.x/rest[1], {1, 0, 0})",
     "11:32: E406 {1, 0, 0} wants a vector of 2 like a.x/rest[1], got a vector of 3."),
    ("a.f = f", "a.f = f[3]*a.x/norm(a.x)", "11:11: E408 f[3] wants an index from 1 to 2, got 3. Write: f[2]"),
    ("a.f = f", "a.f = stiffness[1]*a.x",
     "11:11: E408 stiffness[1] wants a vector before the index, got stiffness, which is a number. Write: stiffness"),
    ("a.f = f", "a.f = f + rest", "11:15: E401 rest wants N like a.f, got m."),
    ("a.f = f", "a.f = f + {stiffness, 0}", "11:15: E401 {stiffness, 0} wants N like a.f, got N/m."),
    ("a.f = f", "a.f = f + {0*f[1], stiffness}", "11:24: E404 stiffness wants N like 0*f[1], got N/m."),
    ("a.f = f", "a.f = {f[1], f[2]", "11:22: E322 an opened { wants }, got the end of the text."),
    ("a.f = f", "a.f = {f[1], }", "11:18: E322 an entry of a vector is missing behind the comma."),
    ("a.f = f", "a.f = f}", "11:12: E322 this } closes nothing."),
    ("a.f = f", "a.f = g", "11:11: E303 Pad has no g; there are: a.f, a.x, b.f, b.x, f, others, peers, rest, stiffness, time."),
    ("a.f = f", "a.f = g[2]", "11:11: E303 Pad has no g; there are: a.f, a.x, b.f, b.x, f, others, peers, rest, stiffness, time."),
    ("a.f = f", "h[2] = f[1]", "11:5: E303 Pad has no h; there are: a.f, a.x, b.f, b.x, f, others, peers, rest, stiffness, time."),
    ("a.f = f", "rst[2] = f[1]", "11:5: E303 Pad has no rst; the nearest is rest. Write: rest"),
    ("size: 2}", "size: 4}",
     "8:22: E203 the size of f wants 2 or 3, got 4. Write: f: {unit: m, size: 2}"),
    ("size: 2}", "size: 1}", "8:22: E203 the size of f wants 2 or 3, got 1. Write: f: {unit: m}"),
    ("size: 2}", "size: two}", "8:22: E203 the size of f wants 2 or 3, got two. Write: f: {unit: m, size: 2}"),
    ("size: 2}", "size: 3}",
     "10:9: E406 stiffness*(a.x - b.x - rest) wants a vector of 3 like f, got a vector of 2.\n"
     "11:11: E406 f wants a vector of 2 like a.f, got a vector of 3.\n"
     "12:11: E406 -f wants a vector of 2 like b.f, got a vector of 3."),
    ("size: 2, default: [0 m, 0 m]", "size: 2, default: 0 m",
     "6:37: E203 default wants a list of 2 values, got 0 m. Write: default: [0, 0]"),
    ("size: 2, default: [0 m, 0 m]", "size: 2, default: [0 m]",
     "6:37: E203 default wants a list of 2 values, got 1. Write: default: [0, 0]"),
    ("size: 2, default: [0 m, 0 m]", "default: [0 m, 0 m]",
     "6:28: E203 rest wants a single value, got a list."),
    ("size: 2, default: [0 m, 0 m]", "size: 2, default: [0 m, 0 kg]",
     "6:43: E204 rest wants m, got 0 kg. Write: rest: 0 m"),
    ("size: 2, default: [0 m, 0 m]", "size: 2, options: {here: 1}",
     "6:37: E203 rest wants a number, to have names for its values, got a vector."),
    ("f: {unit: N, size: 2}", "f: {unit: N, size: 2}\n  rest: {unit: m}",
     "9:3: E205 the name rest is used twice in this component."),
    ("  - b.f = -f\n", "",
     "1:12: E501 Pad is unbalanced: 4 equations for 6 unknowns (f[1], f[2], a.f[1], a.f[2], b.f[1], b.f[2]). "
     "Write: one equation for each variable and one for each flow of a connector"),
]  # fmt: skip

TOPOLOGY = [
    ("x: [1 mm, 2 mm]", "x: 1 mm", "5:45: E203 x wants a list of 2 values, got 1 mm. Write: x: [1 m, 1 m]"),
    ("x: [1 mm, 2 mm]", "x: [1 mm]", "5:45: E203 x wants a list of 2 values, got 1. Write: x: [1 m, 1 m]"),
    ("x: [1 mm, 2 mm]", "x: [1 mm, 2 kg]", "5:52: E204 x[2] wants m, got 2 kg. Write: x[2]: 2 m"),
    ("x: [1 mm, 2 mm]", '"x[1]": 1 mm',
     "5:42: E202 device (PlanarMass) has no key x[1]; there are: type, at, shared, count, flange, mass, damping, x, v."),
    ("3 N/m", "[3 N/m, 3 N/m]", "7:53: E203 stiffness wants a single value, got a list. Write: stiffness: 1 N/m"),
    ("3 N/m", '"{1, 2}"', "7:54: E407 {1, 2} wants a number, got a vector of 2. Write: norm({1, 2})"),
    ("b: ground", "b: line", "7:34: E206 pad joins its b to line, which is no part of this topology; there are: "
     "device, ground."),
    ("{count: 2}", "{set: {device.x: [1 m, 0 m]}}",
     "3:32: E201 device.x is a vector of 2, and its list doesn't tell how many peers there are. Write: count: 3"),
    ("{count: 2}", "{count: 2, set: {device.x: 1 m}}",
     "3:42: E203 device.x wants a list of 2 values, got 1 m. Write: device.x: [1 m, 1 m]"),
    ("{count: 2}", "{count: 2, set: {device.x: [[1 m, 0 m], [1 m]]}}",
     "3:55: E203 device.x wants a list of 2 values, got 1. Write: device.x: [1 m, 1 m]"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), COMPONENT)
def test_a_slip_with_vectors_is_told_where_it_is_and_what_to_write(
    old: str, new: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert PAD.count(old) == 1
    files = {"scene.yaml": SCENE, "parts/pad.yaml": PAD.replace(old, new)}
    found = [one.splitlines()[0] for one in told(tmp_path, monkeypatch, files)]
    assert found == [f"parts/pad.yaml:{one}" for one in message.split("\n")]


@pytest.mark.parametrize(("old", "new", "message"), TOPOLOGY)
def test_a_vector_in_a_topology_is_a_list_of_its_size(
    old: str, new: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert SCENE.count(old) == 1
    files = {"scene.yaml": SCENE.replace(old, new), "parts/pad.yaml": PAD}
    found = [one.splitlines()[0] for one in told(tmp_path, monkeypatch, files)]
    assert found == [f"scene.yaml:{one}" for one in message.split("\n")]


def test_a_vector_that_is_missing_or_at_fault_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = SCENE.partition("couplers:")[0] + "hands: {push: {type: PlanarConstantForce, flange: device%s}}\n"
    for given, message in (
        ("", "6:9: E201 push has no force. Write: force: [1 N, 1 N]"),
        (", force: 3 N", "6:66: E203 force wants a list of 2 values, got 3 N. Write: force: [1 N, 1 N]"),
        (", force: [3 N, 0]", "6:72: E204 force[2] wants N, got 0 (no unit). Write: force[2]: 0 N"),
    ):
        files = {"scene.yaml": scene % given, "parts/pad.yaml": PAD}
        assert [one.splitlines()[0] for one in told(tmp_path, monkeypatch, files)] == [
            f"scene.yaml:{message}"
        ]


def test_a_vector_that_is_declared_again_keeps_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heavy = "component: Heavy\nabout: A mass.\nextends: PlanarMass\nvariables:\n  x: {unit: m, size: 3}\n"
    files = {
        "scene.yaml": SCENE.replace("PlanarMass", "Heavy"),
        "parts/heavy.yaml": heavy,
        "parts/pad.yaml": PAD,
    }
    [found] = told(tmp_path, monkeypatch, files)
    message = "x is a vector of 2 in what this component extends. Write: another name"
    assert found.splitlines()[0] == f"parts/heavy.yaml:5:3: E205 {message}"


def test_potentials_and_flows_of_a_connector_go_in_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = "connector: Point\nabout: A point.\npotentials: {x: {unit: m, size: 2}}\nflows: {f: {unit: N, size: 3}}\n"
    files = {
        "scene.yaml": SCENE,
        "parts/point.yaml": point,
        "parts/pad.yaml": PAD.replace("PlanarFlange", "Point"),
    }
    [found] = told(tmp_path, monkeypatch, files)
    message = "Point is unbalanced: 2 potentials for 3 flows. Write: a flow for each potential, of its size"
    assert found.splitlines()[0] == f"parts/point.yaml:1:1: E501 {message}"


def test_the_scene_they_slip_in_is_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "pad.yaml").write_text(PAD, encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(SCENE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    run_stages(Path("scene.yaml"), until="compiled")


def test_scenes_of_vectors_compile_or_are_told_what_is_wrong(tmp_path: Path) -> None:
    """Here forty; thousands are `python -m tests.fuzz --inputs 10000 --sort vectors`."""
    command = [sys.executable, "-m", "tests.fuzz", "--inputs", "40", "--sort", "vectors", "--seed", "7"]
    ran = subprocess.run(
        [*command, "--out", str(tmp_path / "failures")], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    outcomes = {sort: int(count) for count, sort in re.findall(r"(\d+)  vectors: (\w+)", ran.stdout)}
    assert outcomes["compiled"] > 8
    assert sum(outcomes.values()) == 40


def test_a_name_whose_size_contradicts_itself_is_told_of(tmp_path: Path) -> None:
    odd = (
        "component: Odd\nconnectors: {flange: Flange}\nparameters: {force: {unit: N}}\n"
        "equations: [flange.f = -force, 'spun = {-spun, force}']\n"
    )
    text = (
        "topology: odd\npeers: {user: {count: 1}}\nmasses: {device: {mass: 1 kg}}\n"
        "hands: {hand: {type: Odd, flange: device, force: 1 N}}\n"
    )
    [line] = told_of(compiled, text, library(tmp_path, odd))
    assert line.partition("E4")[2] == (
        "06 {-spun, force} wants a number like spun, got a vector of 2. Write: norm({-spun, force})"
    )


@pytest.mark.parametrize("text", ["{}", "a.x + {}", "{ }*2"])
def test_a_vector_without_entries_is_told(text: str) -> None:
    with pytest.raises(ApcError, match=r"E322 a vector has entries; one of zeros is \{0, 0\}"):
        parse_expression(text, HERE)
