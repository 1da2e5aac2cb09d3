"""`store`: what is loaded is what was saved, or it is refused by name."""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apc.compiler import cache, store
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.files import write_file
from tests.fuzz.models import zipped
from tests.topologies import AVERAGE, MESH, compiled, replaced, told

TWO_KINDS = replaced(
    AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {device.mass: 1 kg}}\n  two: {count: 2}")
)
TWO_KINDS += "hands:\n  hand: {type: ConstantForce, flange: device, force: 1 N, at: [one]}\n"


def same(one: CompiledSystem, other: CompiledSystem) -> bool:
    """Compare two systems, functions by their operations."""
    arrays: tuple[dict[str, bytes], dict[str, bytes]] = ({}, {})
    return store._plain(one, arrays[0]) == store._plain(other, arrays[1]) and arrays[0] == arrays[1]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "scene.apc"
    store.save(compiled(AVERAGE), path)
    return path


@pytest.mark.parametrize("text", [AVERAGE, MESH, TWO_KINDS])
def test_a_model_comes_back_as_it_was(text: str, tmp_path: Path) -> None:
    system = compiled(text)
    path = tmp_path / "scene.apc"
    store.save(system, path)
    assert same(store.load(path), system)
    assert [file.name for file in tmp_path.iterdir()] == ["scene.apc"], "no temporary is left"


def test_the_same_model_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one.apc", "two.apc"):
        store.save(compiled(AVERAGE), tmp_path / name)
    assert (tmp_path / "one.apc").read_bytes() == (tmp_path / "two.apc").read_bytes()


def test_a_model_file_may_be_read_by_whom_the_mask_allows(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        store.save(compiled(AVERAGE), tmp_path / "scene.apc")
    finally:
        os.umask(before)
    assert (tmp_path / "scene.apc").stat().st_mode & 0o777 == 0o640


def rewritten(model: Path, member: str, content: str) -> None:
    """Write the archive again with one member replaced."""
    with zipfile.ZipFile(model) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members[member] = content.encode()
    with zipfile.ZipFile(model, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_a_changed_array_is_refused_by_its_name(model: Path) -> None:
    rewritten(model, "array0", "garbage")
    assert told(store.load, model) == [
        f"{model}: E604 is damaged: its member array0 was changed. "
        f"Write: apc compile {model.with_suffix('.yaml')}"
    ]


def test_another_format_version_is_refused_by_number(model: Path) -> None:
    with zipfile.ZipFile(model) as archive:
        document = json.loads(archive.read("model.json"))
    rewritten(model, "model.json", json.dumps({**document, "format": 99}))
    assert told(store.load, model) == [
        f"{model}: E603 has format version 99, this program reads version {store.FORMAT}. "
        f"Write: apc compile {model.with_suffix('.yaml')}"
    ]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        "null",
        f'{{"format": {store.FORMAT}}}',
        "{",
        f'{{"format": {store.FORMAT}, "functions": 3}}',
    ],
)
def test_a_document_of_another_shape_is_refused(model: Path, content: str) -> None:
    rewritten(model, "model.json", content)
    assert told(store.load, model) == [
        f"{model}: E604 is damaged: it is not what apc compile writes. "
        f"Write: apc compile {model.with_suffix('.yaml')}"
    ]


@pytest.mark.parametrize(
    ("key", "value"), [("name", 3), ("clocks", {}), ("timings", [{}]), ("groups", None), ("kinds", [[]])]
)
def test_a_field_of_another_type_is_refused(model: Path, key: str, value: object) -> None:
    with zipfile.ZipFile(model) as archive:
        document = json.loads(archive.read("model.json"))
    document["system"][key] = value
    rewritten(model, "model.json", json.dumps(document))
    (line,) = told(store.load, model)
    assert "E604 is damaged" in line


def test_a_file_that_unpacks_too_far_is_refused(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(model) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    model.write_bytes(zipped(members))
    monkeypatch.setattr(cache, "LARGEST", model.stat().st_size)
    (line,) = told(store.load, model)
    assert "E604 is damaged: it unpacks to more than 0 MiB" in line


def test_what_is_not_there_or_a_folder_is_told(tmp_path: Path) -> None:
    gone = tmp_path / "gone.apc"
    assert told(store.load, gone) == [f"{gone}: E602 does not exist. Write: apc compile"]
    assert told(store.load, tmp_path) == [f"{tmp_path}: E602 is a folder, not a compiled model."]


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    nowhere = tmp_path / "no" / "scene.apc"
    assert told(store.save, compiled(AVERAGE), nowhere) == [
        f"{nowhere}: E601 can't be written: No such file or directory."
    ]
    taken = tmp_path / "folder.apc"
    taken.mkdir()
    (line,) = told(store.save, compiled(AVERAGE), taken)
    assert "E601 can't be written" in line
    assert [file.name for file in tmp_path.iterdir()] == ["folder.apc"]


def test_an_interrupted_write_leaves_the_old_file(model: Path) -> None:
    before = model.read_bytes()

    def stop(temporary: Path) -> None:
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_file(model, stop)
    assert model.read_bytes() == before
    assert [file.name for file in model.parent.iterdir()] == ["scene.apc"]


_SAVED: dict[str, bytes] = {}


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(place=st.floats(0, 1, exclude_max=True), byte=st.integers(0, 255), cut=st.booleans())
def test_a_byte_changed_or_an_end_cut_off_is_refused_or_harmless(
    tmp_path: Path, place: float, byte: int, cut: bool
) -> None:
    path = tmp_path / "scene.apc"
    if "bytes" not in _SAVED:
        store.save(compiled(AVERAGE), path)
        _SAVED["bytes"] = path.read_bytes()
    data = bytearray(_SAVED["bytes"])
    at = int(place * len(data))
    damaged = bytes(data[:at]) if cut else bytes(data[:at]) + bytes([byte]) + bytes(data[at + 1 :])
    path.write_bytes(damaged)
    try:
        found = store.load(path)
    except ApcError as error:
        assert error.mistakes[0].code in ("E602", "E603", "E604")
    else:
        assert dataclasses.replace(found).name == "three-users-average"


EDGES = replaced(
    AVERAGE,
    ("peers:", "parameters: {half: 250 N/m, full: 2*half, more: full + half}\npeers:"),
    ("type: AveragePosition", "type: SaturatedMesh, limit: 1 N"),
    ("lan: {", "lan: {graph: {edges: [[1, 2], [2, 3]]}, "),
)
WRONG = {
    "a row nobody sends": ("kinds.0.clocks.0.receives.0.channel", 99),
    "a row before the first": ("kinds.0.clocks.0.receives.0.channel", -1),
    "a link nobody sends over": ("kinds.0.sends.0.link", "haptic"),
    "a memory that is no output": ("kinds.0.clocks.0.memories", [99]),
    "a start without a memory": ("kinds.0.clocks.0.starts", ["device.x"]),
    "a start that is no parameter": ("kinds.0.states.0.start", "lan"),
    "a peer that is not there": ("groups.0.count", 2),
    "a graph of another shape": ("links.0.graph.shape", "tree"),
    "a value that its exact one is not": ("parameters.0.exact", "7/3"),
    "a group's value of nothing": ("groups.0.values", [{"name": "no", "unit": "1", "value": 1.0}]),
    "numbers that follow from one another in a circle": ("parameters.1.formula.names", ["more"]),
    "numbers in another order": ("followers", ["more", "full"]),
    "a number that is never followed": ("followers", ["full"]),
    "a number that follows twice": ("followers", ["full", "more", "full"]),
    "a number that follows from none": ("parameters.1.formula.names", ["no"]),
    "a formula of other sizes": ("parameters.1.formula.numbers", []),
    "a formula of no finite number": ("parameters.1.formula.numbers", ["9" * 400]),
    "a formula of a loop": ("parameters.1.formula.function.loops", []),
    "a formula of what no expression holds": ("parameters.1.formula.function.operations.0", ["ceil", 0]),
    "a formula beyond its text": ("parameters.1.formula.spans.0", [0, 99]),
    "an edge of other sizes": ("kinds.0.clocks.0.receives.0.edge", "kinds.0.derivative"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_model_that_names_what_is_not_there_is_refused(tmp_path: Path, wrong: str) -> None:
    model = tmp_path / "scene.apc"
    store.save(compiled(EDGES), model)
    with zipfile.ZipFile(model) as archive:
        document = json.loads(archive.read("model.json"))

    def holder(path: str) -> tuple[Any, Any]:
        *steps, last = [int(step) if step.isdecimal() else step for step in path.split(".")]
        found: Any = document["system"]
        for step in steps:
            found = found[step]
        return found, last

    path, value = WRONG[wrong]
    whole, last = holder(path)
    if isinstance(value, str) and value.startswith("kinds."):
        there, name = holder(value)
        value = there[name]
    if path == "groups.0.values":
        value = [{**document["system"]["parameters"][0], **value[0], "exact": None}]
    whole[last] = value
    rewritten(model, "model.json", json.dumps(document))
    (line,) = told(store.load, model)
    assert "E604 is damaged: it is not what apc compile writes" in line
