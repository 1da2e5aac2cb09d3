"""The schema for editors: what is accepted fits it, slips do not, the file in the package is current."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import apc
from apc.__main__ import run
from apc.compiler.compiled import LARGEST_COUNT
from apc.compiler.components.parts import DEFAULT_TYPES, LARGEST_ARRAY
from apc.compiler.source.reading import IDENTIFIER
from apc.compiler.topology.channels import PROBABILITIES
from apc.compiler.topology.graphs import SHAPES
from apc.compiler.topology.groups import GROUP
from apc.compiler.topology.topology import TOPOLOGY
from tests.topologies import AVERAGE, ROOT, TOPOLOGIES, replaced

jsonschema = pytest.importorskip("jsonschema")

FILE = ROOT / "models" / "topology.schema.json"
SECTIONS = [
    "topology",
    "description",
    "library",
    "clocks",
    "parameters",
    "peers",
    "masses",
    "couplers",
    "links",
    "hands",
    "experiment",
    "studies",
]
COMMENT = "# yaml-language-server: $schema=../topology.schema.json\n"
ALL = """\
topology: all
library: ./parts
clocks: {haptic: 1 ms, slow: 500 Hz, late: {period: 8 ms, phase: 1/3 ms}}
parameters: {kt: 2000 N/m, half: kt/2, ratio: 0.5}
peers:
  right: {count: 1, set: {contact.clock: slow, device.x: 30 mm, "chain[2].mass": 1 g}}
  left: {set: {device.mass: [0.1 kg, 0.2 kg]}}
  many: {table: users.csv}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m, x: -1 cm}
  chain: {type: Mass, count: 3, mass: kt*1 s^2}
  bar: {type: MyOwn, length: 3}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: "chain[3].flange", stiffness: kt/peers, clock: late}
links:
  lan: {clock: late, delay: 0 s, graph: ring, delays: {left: {right: 12 ms}},
    pairs: {right: {left: {delay: 3 ms, loss: {p: 1 %}, jitter: 1 ms, distribution: normal, on_loss: zero,
      clock: haptic}}}}
  wan: {clock: late, graph: {edges: [[1, 2], ["left[1]", 3, 0.5]]}}
hands:
  hand: {type: ConstantForce, flange: device.flange, force: -4 N, at: [left]}
experiment: {duration: 3 s, seed: 7}
studies: {region: {x: {contact.stiffness: [0 N/m, 5 kN/m]}, y: {device.mass: [1 g, 1 kg]}}}
"""


class _Loader(yaml.SafeLoader):
    """YAML 1.2: true and false alone are no words."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in found if not tag.endswith((":bool", ":timestamp", ":int"))]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile("^(true|false)$"), list("tf"))
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?\d+$"), list("-+0123456789"))


@functools.cache
def validator() -> Any:
    return jsonschema.Draft202012Validator(apc.schema())


def faults(text: str) -> list[str]:
    """Return what the schema says against a topology: the path of each fault."""
    document = yaml.load(text, _Loader)
    found = [fault for error in validator().iter_errors(document) for fault in leaves(error)]
    return sorted({"/".join(map(str, error.absolute_path)) for error in found})


def leaves(error: Any) -> list[Any]:
    return [leaf for inner in error.context for leaf in leaves(inner)] if error.context else [error]


def test_it_is_a_schema_of_draft_2020_12_with_every_section_and_component() -> None:
    schema = apc.schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    jsonschema.Draft202012Validator.check_schema(schema)
    assert list(schema["properties"]) == SECTIONS
    assert {"type", "at", "shared", "count"} < set(schema["$defs"]["Mass"]["properties"])
    assert {"AveragePosition", "Link", "Falcon"} < set(schema["$defs"])


@pytest.mark.few(4)
@pytest.mark.parametrize("path", sorted(TOPOLOGIES.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_topology_fits_and_names_it_in_its_first_line(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert faults(text) == []
    assert text.startswith(COMMENT)


def test_all_that_the_language_has_fits() -> None:
    assert faults(ALL) == []


@pytest.mark.parametrize(
    ("old", "new", "path"),
    [
        ("stiffness: 500 N/m", "stiffness: 500", "couplers/coordination/stiffness"),
        ("stiffness: 500 N/m", "stiffness: 500 kg", "couplers/coordination/stiffness"),
        ("stiffness: 500 N/m", 'stiffness: "500"', "couplers/coordination/stiffness"),
        ("stiffness: 500 N/m", "stifness: 500 N/m", "couplers/coordination"),
        ("stiffness: 500 N/m, ", "", "couplers/coordination"),
        ("type: AveragePosition", "type: AveragePositon", "couplers/coordination/type"),
        ("{type: SampledSpringDamper, ", "{", "couplers/contact"),
        ("a: device", "a: [device]", "couplers/contact/a"),
        ("a: device, b: cube, ", "", "couplers/contact"),
        ("haptic: 1 ms", "haptic: 1", "clocks/haptic"),
        ("haptic: 1 ms", "haptic: 1 mm", "clocks/haptic"),
        ("haptic: 1 ms", "2haptic: 1 ms", "clocks"),
        ("count: 3", "count: 0", "peers/user/count"),
        ("count: 3", "count: three", "peers/user/count"),
        ("count: 3", "number: 3", "peers/user"),
        ("mass: 0.1 kg, ", "", "masses/device"),
        ("shared: true", "shared: yes", "masses/cube/shared"),
        ("link: lan}", "link: lan, delays: some}", "couplers/coordination/delays"),
        ("delay: 8 ms}", "delay: 8 ms, graph: circle}", "links/lan/graph"),
        ("delay: 8 ms}", "delay: 8 ms, count: 2}", "links/lan"),
        ("delay: 8 ms}", "delay: 8 ms, pairs: {user: {user: {graph: ring}}}}", "links/lan/pairs/user/user"),
        ("[0 N/m, 5000 N/m]", "[0 N/m]", "studies/region/x/contact.stiffness"),
        ("links:", "link:", ""),
    ],
)
def test_a_typical_slip_is_caught_at_its_place(old: str, new: str, path: str) -> None:
    assert faults(AVERAGE) == []
    assert path in faults(replaced(AVERAGE, (old, new)))


def test_a_component_of_ones_own_is_taken_on_trust_where_a_library_is_named() -> None:
    text = replaced(AVERAGE, ("type: AveragePosition", "type: MyOwn"))
    assert faults(text) == ["couplers/coordination/type"]
    assert faults(f"{text}library: ./parts\n") == []


def test_any_unit_of_the_right_kind_may_be_written() -> None:
    for stiffness in ("5e2 N/m", "0.5 N/mm", "lbf/inch*3", "3 lbf/inch", "kt/2", "1/2 kN/m", "500 kg/s^2"):
        assert faults(replaced(AVERAGE, ("500 N/m,", f"{stiffness},"))) == [], stiffness


@pytest.mark.whole
def test_the_command_prints_it_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == apc.schema()
    path = tmp_path / "topology.schema.json"
    assert run(["schema", "--out", str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == apc.schema()


def test_the_file_in_the_package_is_current(tmp_path: Path) -> None:
    path = tmp_path / "now.json"
    assert run(["schema", "--out", str(path)]) == 0
    assert FILE.read_bytes() == path.read_bytes(), (
        f"write it again: apc schema --out {FILE.relative_to(ROOT)}"
    )


def test_a_new_topology_names_the_schema_that_lies_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["new", "plain"]) == 0
    assert "$schema" not in Path("plain.yaml").read_text(encoding="utf-8")
    assert run(["schema", "--out", "topology.schema.json"]) == 0
    assert run(["new", "helped"]) == 0
    first = Path("helped.yaml").read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=topology.schema.json"


def test_what_is_written_by_hand_agrees_with_the_compiler() -> None:
    schema = apc.schema()
    definitions, sections = schema["$defs"], schema["properties"]
    assert definitions["count"]["maximum"] == LARGEST_ARRAY
    assert definitions["group"]["properties"]["count"]["maximum"] == LARGEST_COUNT
    assert definitions["name"]["pattern"] == "^" + IDENTIFIER.pattern.replace(r"\Z", "$")
    assert definitions["graph"]["anyOf"][0]["enum"] == list(SHAPES)
    channels = definitions["loss"]["anyOf"][1]["properties"]
    assert {name: one["description"] for name, one in channels.items()} == PROBABILITIES
    assert (tuple(sections), tuple(definitions["group"]["properties"])) == (TOPOLOGY, GROUP)
    for section, default in DEFAULT_TYPES.items():
        assert sections[section]["additionalProperties"]["properties"]["type"]["default"] == default
