"""`show`: graph, equations and schedule of a topology, as text, document, Graphviz text and picture."""

from __future__ import annotations

import itertools
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import apc
from apc.compiler.view.diagram import diagram_of
from apc.output.graph import graph_picture
from tests.commands import Cli, Ran, folder, write
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, replaced

FILE = TOPOLOGIES / "three-users-average.yaml"
MANY = """\
topology: many
description: A chain on the ground, a rod of two masses, a long array, and groups that differ in much.
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
    "ring": replaced(AVERAGE, ("count: 3", "count: 8"), ("lan: {", "lan: {graph: ring, ")),
    "star": replaced(AVERAGE, ("count: 3", "count: 300"), ("lan: {", "lan: {graph: star, ")),
    "arcs": replaced(AVERAGE, ("lan: {", "lan: {graph: {arcs: [[1, 2], [2, 3], [3, 1, 0.5]]}, ")),
    "many": MANY,
}


def shown(text: str, form: str, path: Path) -> str:
    path.joinpath("topology.yaml").write_text(text, encoding="utf-8")
    return apc.show(path / "topology.yaml", format=form)  # type: ignore[arg-type] # a word


def words_of(svg: str) -> list[str]:
    return ["".join(one.itertext()) for one in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


@pytest.mark.few(2)
@pytest.mark.parametrize("name", TEXTS)
def test_no_text_of_a_picture_stands_over_another_or_leaves_the_page(name: str, tmp_path: Path) -> None:
    words = words_of(shown(TEXTS[name], "svg", tmp_path))
    figure = graph_picture(diagram_of(tmp_path / "topology.yaml"))
    figure.draw_without_rendering()
    labels = [label for ax in figure.axes[1:] if ax.axison for label in ax.get_yticklabels()]
    drawn = [*(text for ax in figure.axes for text in (*ax.texts, ax.title)), *labels]
    boxes = {one: one.get_window_extent() for one in drawn if one.get_text()}
    assert {line for one in boxes for line in one.get_text().splitlines()} <= set(words)
    for box in boxes.values():
        assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0 and box.y1 <= figure.bbox.height
    for one, two in itertools.combinations(boxes, 2):
        assert not boxes[one].overlaps(boxes[two]), (one.get_text(), two.get_text())


def test_the_picture_names_every_part_with_its_type_and_numbers() -> None:
    words = words_of(apc.show(FILE, format="svg"))
    for word in (
        *("three-users-average, one of 3 peers", "device", "mass 0.1 kg", "cube", "shared: 0.2 kg per copy"),
        *("contact", "SampledSpringDamper", "stiffness 1000 N/m", "delay 1 ms", "coordination"),
        *("AveragePosition", "lan", "delay 8 ms", "lan: 3 peers, complete graph"),
        *("haptic: every 1 ms", "time in a frame of 8 ms [ms]"),
    ):
        assert word in words, word


@pytest.mark.few(1)
@pytest.mark.parametrize("form", ["svg", "mermaid"])
def test_text_of_a_topology_cannot_break_out_of_the_picture(form: str, tmp_path: Path) -> None:
    mark = '"<script>alert(1)</script> & Three'
    about = ("description: Three", f"description: {mark}"), ("others.  ", 'others."  ')
    drawn = shown(replaced(AVERAGE, *about), form, tmp_path)
    assert "<script>" not in drawn
    if form == "svg":
        ET.fromstring(drawn)


@pytest.mark.whole
def test_parts_are_joined_as_the_topology_says(tmp_path: Path) -> None:
    def joints(text: str) -> set[frozenset[str]]:
        dot = shown(text, "dot", tmp_path)
        return {frozenset(pair) for pair in re.findall(r'^ *"([^"]+)" -> "([^"]+)"', dot, re.MULTILINE)}

    average = joints(AVERAGE)
    for pair in (("device", "contact"), ("cube", "contact"), ("cube", "coordination")):
        assert frozenset(pair) in average
    assert frozenset(("device", "coordination")) not in average
    many = joints(MANY)
    for pair in (
        *(("leash", "ground of leash"), ("long", "links"), ("end and cube", "end"), ("cube", "end and cube")),
        ("far", "link wan"),
    ):
        assert frozenset(pair) in many, pair
    words = " ".join(words_of(shown(MANY, "svg", tmp_path)))
    assert "array of 40" in words and "only at left" in words


def test_the_text_tells_graph_equations_and_schedule() -> None:
    lines = apc.show(FILE).splitlines()
    for line in (
        "  device: mass 0.1 kg, damping 5 N·s/m",
        "    connected to device, cube",
        "    connected to cube, lan",
        "Equations of peer type user: 18 equations, 18 unknowns",
        "    device.mass*der(device.v) = device.flange.f - device.damping*device.v",
        "  frame 8 ms (least common multiple of the clock periods)",
        "  clock network, period 8 ms, ticks per frame 1, sends lan",
        "  peer type user, hold contact.f, clock haptic, delay 1 ms, held 1 ms",
    ):
        assert line in lines, line
    schedule = " ".join(" ".join(lines[lines.index("Schedule") :]).split())
    assert (
        "link lan, sends coordination.x and coordination.v, period 8 ms, delay 8 ms, "
        "packets in transit 1, data age 8 ms to 16 ms"
    ) in schedule


@pytest.mark.parametrize("name", ["three-users-average", "teleoperation-pair", "unlike-devices"])
def test_each_equation_of_a_part_is_printed_once(name: str) -> None:
    path = TOPOLOGIES / f"{name}.yaml"
    lines = apc.show(path).splitlines()
    text = "".join("".join(lines[: lines.index("Schedule")]).split())
    peer_types = json.loads(apc.show(path, format="json"))["kinds"]
    different = {tuple(item["equation"] for item in kind["equations"]): kind for kind in peer_types}
    for equations, kind in different.items():
        for equation in {*equations}:
            printed = text.count("".join(equation.split()))
            assert printed == sum(equation in each for each in different), (kind["name"], equation)
    assert "#" not in text and ":=" not in text


@pytest.mark.few(3)
@pytest.mark.parametrize("path", sorted(TOPOLOGIES.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_topology_can_be_shown_in_80_columns(path: Path) -> None:
    assert max(map(len, apc.show(path).splitlines())) <= 80
    ET.fromstring(apc.show(path, format="svg"))


FURTHEST = """\
component: Furthest
description: Pulls by tanh of each distance.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters: {stiffness: {unit: N/m}, reach: {unit: m, default: 1}, delay: {unit: s}, clock: clock, link: link}
equations:
  - f = stiffness*sum(reach*tanh((sample(object.x) - others.x)/reach))
  - object.f = hold(f, delay)
"""


def test_what_costs_a_pair_is_said(cli: Cli) -> None:
    text = replaced(AVERAGE, ("topology: three-users-average", "topology: furthest\nlibrary: ."))
    write(
        "topology.yaml",
        replaced(text, ("type: AveragePosition", "type: Furthest"), ("1 ms, link", "0 s, link")),
    )
    write("furthest.yaml", FURTHEST)
    assert "link lan, pairwise" in " ".join(cli("show topology.yaml").out.split())
    ran = cli("compile topology.yaml")
    assert ran.code == 0, ran.err
    assert re.search(
        r"sum\(.*others\.coordination\.x.*\) is evaluated for each pair of peers, as its argument is not "
        "linear in the values received over lan",
        " ".join(ran.out.split()),
    )


def test_graphviz_text_has_every_node_once_and_closes_every_quote() -> None:
    text = apc.show(FILE, format="dot")
    assert text.startswith('digraph "three-users-average" {\n') and text.endswith("\n}")
    for name in ("device", "cube", "contact", "coordination"):
        assert len(re.findall(rf'^ *"{name}" \[', text, re.MULTILINE)) == 1
    assert '"cube" -> "contact"' in text and '"coordination" -> "link lan" [dir=both, style=dashed]' in text
    assert all(len(re.findall(r'(?<!\\)"', line)) % 2 == 0 for line in text.splitlines())


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("suffix", "start"),
    [
        *(
            ("svg", b"<"),
            ("SVG", b"<"),
            ("dot", b"digraph"),
            ("mmd", b"flowchart"),
            ("json", b"{"),
            ("txt", b"three"),
        ),
        *(("pdf", b"%PDF-"), ("png", b"\x89PNG")),
    ],
)
def test_the_file_says_the_format(suffix: str, start: bytes, cli: Cli) -> None:
    assert cli("show", str(FILE), "--out", f"topology.{suffix}") == Ran(
        0, f"topology.{suffix} is written\n", ""
    )
    assert Path(f"topology.{suffix}").read_bytes().startswith(start)


KINDS = ".txt, .json, .dot, .gv, .mmd, .svg, .png, .pdf"


@pytest.mark.parametrize(
    ("words", "name", "requested"),
    [
        ((), "topology.jpg", f"one of {KINDS}, got .jpg. Try: --out topology.txt"),
        (("--format", "dot"), "topology.svg", "one of .dot, .gv, got .svg. Try: --out topology.dot"),
    ],
)
def test_no_file_is_written_as_what_its_name_does_not_say(
    words: tuple[str, ...], name: str, requested: str, cli: Cli
) -> None:
    message = f"{name}: E878 suffix of --out: expected {requested}\n"
    assert cli("show", str(FILE), *words, "--out", name) == Ran(1, "", message)
    assert folder() == []
