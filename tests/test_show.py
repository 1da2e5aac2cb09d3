"""`show`: graph, equations and schedule of a scene, as text, document, Graphviz text and picture."""

from __future__ import annotations

import itertools
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.view.diagram import Diagram, boxes_of, build_diagram, edges_of
from apc.present.graph import GAP, _places, graph_picture
from tests.topologies import AVERAGE, MESH, ONE_MASS, SCENES, replaced, scene, told

AVERAGE_FILE = SCENES / "three-users-average.yaml"
RING = replaced(AVERAGE, ("count: 3", "count: 8"), ("lan: {", "lan: {graph: ring, "))
STAR = replaced(AVERAGE, ("count: 3", "count: 300"), ("lan: {", "lan: {graph: star, "))
ARCS = replaced(AVERAGE, ("lan: {", "lan: {graph: {arcs: [[1, 2], [2, 3], [3, 1, 0.5]]}, "))
MANY = """\
topology: many
about: A chain on the ground, a rod of two masses, a long array, and groups that differ in much.
clocks: {haptic: 1 ms, video: {period: 1/90 s, phase: 1 ms}, network: 8 ms, wide: 50 ms}
parameters: {kt: 2000 N/m}
peers:
  right: {count: 1, set: {hand.force: -4 N, device.x: 30 mm, contact.clock: video, contact.delay: 2 ms}}
  left:  {set: {hand.force: 2 N, device.x: -30 mm, device.mass: [0.1 kg, 0.2 kg], near.stiffness: 1 N/m}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.3 kg, damping: 5 N*s/m, shared: true}
  chain:  {count: 3, mass: 10 g}
  long:   {count: 40, mass: 1 g}
  end:    {mass: 1 g, flange: cube}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 39 N/m, damping: 1 N*s/m, clock: haptic}
  near: {type: FullMesh, object: device, stiffness: kt/(peers - 1), clock: haptic, link: lan, delays: own}
  far: {type: AveragePosition, object: cube, stiffness: 7 N/m, clock: haptic, link: wan, at: [left]}
  tail: {type: SampledSpringDamper, count: 2, a: "chain[1:2]", b: "chain[2:3]", stiffness: 1 N/m, clock: wide}
  leash: {type: SampledSpringDamper, a: "chain[3]", b: ground, stiffness: 10 N/m, clock: wide}
  links: {type: SampledSpringDamper, count: 39, a: "long[1:39]", b: "long[2:40]", stiffness: 1 N/m,
          clock: wide}
links:
  lan: {clock: network, delay: 8 ms, delays: {left: {right: 12 ms}}}
  wan: {clock: wide, graph: star}
hands:
  hand: {type: ConstantForce, flange: device, force: 0 N}
"""
TEXTS = {
    "average": AVERAGE,
    "mesh": MESH,
    "one": ONE_MASS,
    "ring": RING,
    "star": STAR,
    "arcs": ARCS,
    "many": MANY,
}


def diagram(text: str) -> Diagram:
    return build_diagram(scene(text))


def apart(one: tuple[float, ...], two: tuple[float, ...]) -> bool:
    """Say whether two boxes, each of left, top, width and height, do not overlap."""
    return any(a[k] + a[k + 2] <= b[k] for k in (0, 1) for a, b in ((one, two), (two, one)))


@pytest.mark.parametrize("name", TEXTS)
def test_boxes_stand_apart_and_lines_run_between_columns_that_are_neighbours(name: str) -> None:
    drawn = diagram(TEXTS[name])
    places = _places(boxes_of(drawn), edges_of(drawn))
    for one, two in itertools.combinations(places.values(), 2):
        assert apart(one, two)
    for edge in edges_of(drawn):
        first, second = sorted((places[edge.one], places[edge.two]))
        assert second[0] - (first[0] + first[2]) == pytest.approx(GAP)


@pytest.mark.parametrize("name", TEXTS)
def test_no_text_of_a_picture_overlaps_another_or_leaves_the_page(name: str) -> None:
    figure = graph_picture(diagram(TEXTS[name]))
    figure.draw_without_rendering()
    labels = [label for ax in figure.axes[1:] if ax.axison for label in ax.get_yticklabels()]
    texts = [*(text for ax in figure.axes for text in (*ax.texts, ax.title)), *labels]
    boxes = [text.get_window_extent().bounds for text in texts if text.get_text()]
    for one, two in itertools.combinations(boxes, 2):
        assert apart(one, two)
    for left, low, width, height in boxes:
        assert left >= 0 and left + width <= figure.bbox.width
        assert low >= 0 and low + height <= figure.bbox.height


def test_the_picture_names_every_part_with_its_type_and_numbers() -> None:
    document = ET.fromstring(apc.show(AVERAGE_FILE, format="svg"))
    words = [element.text for element in document.iter("{http://www.w3.org/2000/svg}text")]
    for word in (
        *("three-users-average, one of 3 peers", "device", "mass 0.1 kg", "cube", "shared: 0.2 kg a copy"),
        *("contact", "SampledSpringDamper", "stiffness 1000 N/m", "delay 1 ms", "coordination"),
        *("AveragePosition", "lan", "available 8 ms later", "lan: 3 peers, complete graph"),
        *("haptic: every 1 ms", "ms of one frame, 8 ms"),
    ):
        assert word in words, word


@pytest.mark.parametrize("form", ["svg", "mermaid"])
def test_text_of_a_scene_cannot_break_out_of_the_picture(
    form: Literal["svg", "mermaid"], tmp_path: Path
) -> None:
    about = ("about: Three", 'about: "<script>alert(1)</script> & Three'), ("others.  ", 'others."  ')
    (tmp_path / "scene.yaml").write_text(replaced(AVERAGE, *about), encoding="utf-8")
    drawn = apc.show(tmp_path / "scene.yaml", format=form)
    assert "<script>" not in drawn
    if form == "svg":
        ET.fromstring(drawn)


def test_parts_are_joined_as_the_topology_says() -> None:
    assert diagram(AVERAGE).joints == (("device", "contact"), ("cube", "contact"), ("cube", "coordination"))
    found = diagram(MANY)
    assert ("ground of leash", "leash") in found.joints
    assert ("end and cube", "end") in found.joints and ("cube", "end and cube") in found.joints
    assert ("long", "links") in found.joints, "a long array is one node"
    assert "40 of them" in next(node.about for node in found.parts if node.name == "long")
    assert next(node.links for node in found.parts if node.name == "far") == ("wan",)
    assert "only at left" in next(node.about for node in found.parts if node.name == "far")


def test_a_star_of_hundreds_is_a_small_picture() -> None:
    small = graph_picture(diagram(replaced(STAR, ("count: 300", "count: 3")))).get_size_inches()
    for count in ("300", "1000000"):
        figure = graph_picture(diagram(replaced(STAR, ("count: 300", f"count: {count}"))))
        assert np.allclose(figure.get_size_inches(), small, rtol=0.1)
        assert len(boxes_of(diagram(STAR))) == 6


def test_of_many_groups_the_first_are_drawn_and_the_others_counted() -> None:
    groups = "".join(f"  g{k}: {{count: 1}}\n" for k in range(20))
    found = boxes_of(diagram(replaced(AVERAGE, ("  user: {count: 3}\n", groups))))
    assert [box.lines for box in found if box.role == "group"][-2:] == [
        ("g7: 1 peer",),
        ("and 12 more groups",),
    ]


def test_the_text_tells_graph_equations_and_schedule() -> None:
    lines = apc.show(AVERAGE_FILE).splitlines()
    for line in (
        "  device: mass 0.1 kg, damping 5 N·s/m",
        "    joined to device, cube",
        "    joined to cube, lan",
        "  kind user: 18 equations, 18 unknowns",
        "    device.mass*der(device.v) = device.flange.f - device.damping*device.v #",
        "      der(device.v) := (device.flange.f - device.damping*device.v)/device.mass",
        "  frame of 8 ms, after which every clock stands as before",
        "  clock network, period 8 ms, ticks 1, sends lan",
        "  kind user, hold contact.f, clock haptic, delay 1 ms, held 1 ms",
    ):
        assert line in lines, line
    schedule = " ".join(" ".join(lines[lines.index("SCHEDULE") :]).split())
    assert (
        "link lan, sends coordination.x and coordination.v, period 8 ms, delay 8 ms, on the way 1, "
        "age 8 ms to 16 ms"
    ) in schedule


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_scene_can_be_shown_in_80_columns(path: Path) -> None:
    wide = [line for line in apc.show(path).splitlines() if len(line) > 80]
    assert wide == []
    ET.fromstring(apc.show(path, format="svg"))


def test_a_scene_without_clocks_is_continuous(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(ONE_MASS, encoding="utf-8")
    assert "  No clock ticks: everything is continuous." in apc.show(path).splitlines()


@pytest.mark.parametrize(
    ("delay", "number", "age"),
    [
        ("0 s", 0, (0, 8)),
        ("1 ms", 1, (1, 9)),
        ("8 ms", 1, (8, 16)),
        ("9 ms", 2, (9, 17)),
        ("24 ms", 3, (24, 32)),
    ],
)
def test_the_packets_on_their_way_are_counted(
    tmp_path: Path, delay: str, number: int, age: tuple[int, int]
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(replaced(AVERAGE, ("delay: 8 ms", f"delay: {delay}")), encoding="utf-8")
    (link,) = json.loads(apc.show(path, format="json"))["schedule"]["links"]
    assert link["on_the_way"] == number
    assert link["age_s"] == [pytest.approx(age[0] / 1e3), pytest.approx(age[1] / 1e3)]


def test_the_document_holds_what_the_text_tells() -> None:
    document = json.loads(apc.show(AVERAGE_FILE, format="json"))
    (kind,) = document["kinds"]
    assert len(kind["equations"]) == len(kind["unknowns"]) == 18
    assert kind["states"] == ["device.x", "device.v", "cube.x", "cube.v"]
    assert [p["clock"] for p in kind["partitions"]] == ["continuous", "haptic"]
    assert {c["clock"]: c["ticks"] for c in document["schedule"]["clocks"]} == {"haptic": 8, "network": 1}
    assert [part["name"] for part in document["graph"]["parts"]] == [
        "device",
        "cube",
        "contact",
        "coordination",
    ]


def test_what_costs_a_pair_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    text = replaced(AVERAGE, ("topology: three-users-average", "topology: furthest\nlibrary: ."))
    text = replaced(text, ("type: AveragePosition", "type: Furthest"), ("1 ms, link", "0 s, link"))
    path.write_text(text, encoding="utf-8")
    (tmp_path / "furthest.yaml").write_text(FURTHEST, encoding="utf-8")
    assert "link lan, pairwise" in " ".join(apc.show(path).split())
    assert run(["compile", str(path)]) == 0, capsys.readouterr().err
    report = " ".join(capsys.readouterr().out.split())
    assert re.search(
        r"costs N²: sum\(.*others\.coordination\.x.*\) is evaluated once a pair of peers, as what it "
        "runs over is not linear in what the others send over lan",
        report,
    )


FURTHEST = """\
component: Furthest
about: Pulls by tanh of each distance.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, reach: {unit: m, default: 1}, delay: {unit: s}, clock: clock, link: link}
equations:
  - f = stiffness*sum(reach*tanh((sample(object.x) - others.x)/reach))
  - object.f = hold(f, delay)
"""


def test_graphviz_text_has_every_node_once_and_closes_every_quote() -> None:
    text = apc.show(AVERAGE_FILE, format="dot")
    assert text.startswith('digraph "three-users-average" {\n') and text.endswith("\n}")
    for name in ("device", "cube", "contact", "coordination"):
        assert len(re.findall(rf'^ *"{name}" \[', text, re.MULTILINE)) == 1
    assert '"cube" -> "contact"' in text and '"coordination" -> "link lan" [dir=both, style=dashed]' in text
    assert all(len(re.findall(r'(?<!\\)"', line)) % 2 == 0 for line in text.splitlines())


def test_mermaids_text_joins_what_is_joined() -> None:
    lines = apc.show(AVERAGE_FILE, format="mermaid").splitlines()
    assert lines[0] == "flowchart LR"
    assert lines[1] == '  n0["device<br>mass 0.1 kg<br>damping 5 N·s/m"]'
    assert "  n0 --- n2" in lines and "  n3 -.- n4" in lines


@pytest.mark.parametrize(
    ("suffix", "start"), [("dot", "digraph"), ("mmd", "flowchart"), ("json", "{"), ("txt", "three")]
)
def test_the_file_says_the_format(
    suffix: str, start: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / f"scene.{suffix}"
    assert run(["show", str(AVERAGE_FILE), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out} is written\n"
    assert out.read_text(encoding="utf-8").startswith(start)


KINDS = ".txt, .json, .dot, .gv, .mmd, .svg, .png, .pdf"


@pytest.mark.parametrize(
    ("words", "name", "wanted"),
    [
        ((), "scene.jpg", f"one of {KINDS}, got .jpg. Write: --out scene.txt"),
        ((), "scene", f"one of {KINDS}, got none. Write: --out scene.txt"),
        (("--format", "svg"), "scene.png", ".svg, got .png. Write: --out scene.svg"),
        (("--format", "dot"), "scene.svg", "one of .dot, .gv, got .svg. Write: --out scene.dot"),
    ],
)
def test_no_file_is_written_as_what_its_name_does_not_say(
    words: tuple[str, ...], name: str, wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / name
    assert run(["show", str(AVERAGE_FILE), *words, "--out", str(out)]) == 1
    wanted = wanted.replace("--out ", f"--out {tmp_path}/")
    assert capsys.readouterr().err == f"{out}: E878 the suffix of --out wants {wanted}\n"
    assert list(tmp_path.iterdir()) == []


def test_a_suffix_in_capitals_is_the_same_suffix(tmp_path: Path) -> None:
    assert run(["show", str(AVERAGE_FILE), "--out", str(tmp_path / "SCENE.SVG")]) == 0
    assert "<svg" in (tmp_path / "SCENE.SVG").read_text(encoding="utf-8")


def test_the_command_prints_what_the_function_returns(capsys: pytest.CaptureFixture[str]) -> None:
    for form in ("text", "json", "dot", "mermaid", "svg"):
        assert run(["show", str(AVERAGE_FILE), "--format", form]) == 0
        assert capsys.readouterr().out == apc.show(AVERAGE_FILE, format=form) + "\n"  # type: ignore[arg-type] # a word


def test_a_compiled_model_has_no_equations_to_show() -> None:
    assert told(apc.show, "scene.apc") == [
        "scene.apc: E615 is a compiled model, and this reads the topology that it was made from. "
        "Write: apc show scene.yaml"
    ]


@pytest.mark.parametrize(("suffix", "magic"), [(".pdf", b"%PDF-"), (".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_a_picture_is_what_its_name_says(suffix: str, magic: bytes, tmp_path: Path) -> None:
    out = tmp_path / f"scene{suffix}"
    assert run(["show", str(AVERAGE_FILE), "--out", str(out)]) == 0
    assert out.read_bytes().startswith(magic)


def test_peers_that_a_picture_leaves_out_are_counted(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    text = AVERAGE_FILE.read_text(encoding="utf-8").replace("count: 3", "count: 31")
    scene.write_text(text.replace("lan: {", "lan: {graph: star, "), encoding="utf-8")
    drawn = apc.show(scene, format="svg")
    assert "lan: 31 peers, star graph" in drawn and "16 drawn, 15 left out" in drawn
    assert "left out" not in apc.show(AVERAGE_FILE, format="svg")
