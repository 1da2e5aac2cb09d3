"""`store`: what is loaded is what was saved, or it is refused by name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apc.compiler import cache, store
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.files import write_file
from apc.compiler.pipeline import compile_topology
from apc.compiler.plain import straight
from apc.inputs import load_fresh
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced, told

CUBIC = """\
component: Cubic
about: A spring that hardens, given the wrong way round.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m, min: 0}, soft: {unit: N^-2, min: 0}}
variables: {f: {unit: N}}
equations:
  - f + soft*f^3 = stiffness*flange.x
  - flange.f = f
"""
LOOP = """\
topology: scene
library: .
peers: {user: {count: 2}}
masses: {device: {mass: 1 kg, damping: 2 N*s/m, x: 1 mm}}
couplers: {tie: {type: Cubic, flange: device, stiffness: 3 N/m, soft: 0.1 N^-2}}
hands: {hand: {type: TableForce, flange: device, force: force.csv}}
"""
TWO_KINDS = replaced(
    AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {device.mass: 1 kg}}\n  two: {count: 2}")
)
TWO_KINDS += "hands:\n  hand: {type: ConstantForce, flange: device, force: 1 N, at: [one]}\n"


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
    found = load_fresh(path)
    assert store.encoded(found) == store.encoded(system)
    assert found.origin == system.origin
    assert [file.name for file in tmp_path.iterdir()] == ["scene.apc"], "no temporary is left"


@pytest.mark.parametrize("scene", sorted(path.stem for path in SCENES.glob("*.yaml")))
def test_every_function_of_every_scene_comes_back_with_the_same_operations_and_numbers(scene: str) -> None:
    system = compile_topology(SCENES / f"{scene}.yaml")
    again = store.decoded(store.encoded(system))
    numbers = np.random.default_rng(1)
    for one, other in zip(functions_of(system), functions_of(again), strict=True):
        assert one.name_in() == other.name_in() and one.name_out() == other.name_out()
        if one.is_a("SXFunction"):
            assert straight(one) == straight(other)
        arguments = [numbers.uniform(-1, 1, one.numel_in(i)) for i in range(one.n_in())]
        for a, b in zip(one.call(arguments), other.call(arguments), strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def functions_of(system: CompiledSystem) -> list[Any]:
    found = []
    for kind in system.kinds:
        found += [kind.derivative, *(one.tick for one in kind.clocks), *(one.send for one in kind.sends)]
        found += [kind.ports.port] if kind.ports else []
        found += [one.edge for part in kind.clocks for one in part.receives if one.edge is not None]
    return found


def test_a_nonlinear_loop_and_a_table_over_time_come_back(tmp_path: Path) -> None:
    (tmp_path / "cubic.yaml").write_text(CUBIC, encoding="utf-8")
    (tmp_path / "force.csv").write_text("time [s],force [N]\n0,0\n1,2\n3,1\n", encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(LOOP, encoding="utf-8")
    [kind] = (system := compile_topology(tmp_path / "scene.yaml")).kinds
    assert kind.derivative.is_a("MXFunction")
    [again] = store.decoded(store.encoded(system)).kinds
    for at in (0.0, 0.4, 2.0, 5.0):
        arguments = [np.full(kind.derivative.numel_in(i), 0.5) for i in range(3)]
        expected, found = kind.derivative(*arguments, at), again.derivative(*arguments, at)
        np.testing.assert_array_equal(np.asarray(found), np.asarray(expected))


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


def test_another_format_version_is_refused_by_number(model: Path) -> None:
    model.write_bytes(model.read_bytes().replace(f"apc {cache.FORMAT} ".encode(), b"apc 99 ", 1))
    assert told(load_fresh, model) == [
        f"{model}: E603 has format version 99, this program reads version {cache.FORMAT}. "
        f"Write: apc compile {model.with_suffix('.yaml')}"
    ]


HEAD = f"apc {cache.FORMAT} compiled\n\n".encode()
EMPTY = b'{"topology": "scene.yaml", "texts": [], "program": "", "changes": []}\n'


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"\n\n\n", b"PK\x03\x04"),
        *(HEAD, HEAD + b"[]\n", HEAD + b"{}\n", HEAD + b"null\n", HEAD + EMPTY),
        HEAD + EMPTY.replace(b'"scene.yaml"', b"3"),
        HEAD + EMPTY.replace(b"[]", b'[["scene.yaml", 3]]', 1),
        HEAD + EMPTY.replace(b"[]", b'[["scene.yaml", "*"]]', 1),
        HEAD + b"[" * 10**6 + b"\n",
    ],
)
def test_what_is_no_model_is_refused(model: Path, content: bytes) -> None:
    model.write_bytes(content)
    assert told(load_fresh, model) == [
        f"{model}: E604 is damaged: it is not what apc compile writes. "
        f"Write: apc compile {model.with_suffix('.yaml')}"
    ]


def test_a_file_that_is_too_large_is_refused(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(cache, "LARGEST_ORIGIN", 100)
        assert "E604 is damaged" in told(load_fresh, model)[0]
    monkeypatch.setattr(cache, "LARGEST", 100)
    assert "E602 is larger than 100 bytes" in told(load_fresh, model)[0]


def test_what_is_not_there_or_a_folder_is_told(tmp_path: Path) -> None:
    gone = tmp_path / "gone.apc"
    assert told(load_fresh, gone) == [f"{gone}: E602 does not exist. Write: apc compile"]
    assert told(load_fresh, tmp_path) == [f"{tmp_path}: E602 is a folder, not a compiled model."]


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
        found = load_fresh(path)
    except ApcError as error:
        assert error.mistakes  # of the file, or of the text in it: then it is compiled again
    else:
        assert found.peers > 0
