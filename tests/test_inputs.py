"""`inputs`: the only scene of a folder is the one that is meant; a stale model is never used."""

from __future__ import annotations

from pathlib import Path

import pytest

from apc.compiler import store
from apc.compiler.pipeline import compile_topology
from apc.inputs import find_input, load_fresh, open_scene
from tests.topologies import AVERAGE, told


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def find(compiled_too: bool = True) -> Path:
    return find_input(compiled_too=compiled_too)


def model(stem: str = "scene") -> Path:
    Path(f"{stem}.yaml").write_text(AVERAGE, encoding="utf-8")
    path = Path(f"{stem}.apc")
    store.save(compile_topology(Path(f"{stem}.yaml")), path)
    return path


def test_the_only_topology_is_found_among_other_files() -> None:
    Path("a.yaml").write_text(AVERAGE, encoding="utf-8")
    Path("part.yaml").write_text("component: Part\n", encoding="utf-8")
    Path("notes.txt").write_text("topology: no\n", encoding="utf-8")
    Path("folder.yaml").mkdir()
    assert find() == Path("a.yaml")


def test_a_topology_may_start_with_a_mark_or_a_comment() -> None:
    Path("a.yaml").write_bytes(b"\xef\xbb\xbf" + AVERAGE.encode())
    assert find() == Path("a.yaml")
    Path("a.yaml").write_text("# mine\r\n" + AVERAGE, encoding="utf-8")
    assert find() == Path("a.yaml")


def test_a_topology_and_its_model_are_one_scene() -> None:
    model()
    assert find() == Path("scene.yaml")
    assert find(compiled_too=False) == Path("scene.yaml")


def test_a_model_without_its_topology_serves_where_a_model_does() -> None:
    path = model()
    Path("scene.yaml").unlink()
    assert find() == path
    assert told(find, False) == [
        "this folder: E610 holds no topology. Write: apc new  (it writes a topology.yaml to start from)"
    ]


def test_an_empty_folder_is_told_how_to_begin() -> None:
    assert told(find) == [
        "this folder: E610 holds no topology and no compiled model. "
        "Write: apc new  (it writes a topology.yaml to start from)"
    ]


def test_several_scenes_are_listed() -> None:
    for name in ("b", "a"):
        Path(f"{name}.yaml").write_text(AVERAGE, encoding="utf-8")
    assert told(find) == ["this folder: E611 holds 2 scenes: a.yaml, b.yaml. Write: apc … a.yaml"]


def test_a_model_is_fresh_until_its_topology_changes() -> None:
    path = model()
    assert load_fresh(path).name == "three-users-average"
    Path("scene.yaml").write_text(AVERAGE + "# more\n", encoding="utf-8")
    assert told(load_fresh, path) == [
        "scene.apc: E605 is stale: scene.yaml has changed since it was compiled. "
        "Write: apc compile scene.yaml"
    ]
    Path("scene.yaml").unlink()
    assert load_fresh(path).name == "three-users-average", "no topology there to be older than"


@pytest.mark.parametrize("file", [None, "scene.yaml", "scene.apc"])
def test_a_scene_is_opened_with_its_parameters_set(file: str | None) -> None:
    model()

    def stiffness(settings: list[str]) -> float:
        return next(
            one.value for one in open_scene(file, settings).parameters if one.name == "contact.stiffness"
        )

    assert (stiffness([]), stiffness(["contact.stiffness=800 N/m"])) == (1000, 800)
