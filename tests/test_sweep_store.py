"""Finished parts on disk: whole or not there, and only what this user's apc wrote for this sweep."""

from __future__ import annotations

import errno
import hmac
import io
import os
from pathlib import Path

import numpy as np
import pytest

from apc.compiler import seal
from apc.sweeps import store as sweep_store
from apc.sweeps.quantities import Cells
from apc.sweeps.store import Parts, open_parts
from tests.topologies import told

CELLS = (
    np.array(["stable", "error: E803"], dtype=object),
    np.array([0.1 + 0.2, np.nan]),
    np.array([None, None], dtype=object),
    np.array(["", "why"], dtype=object),
)
MINE = {"model": "abc", "over": [1, 2]}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setattr(seal, "_folder", lambda: folder)


def assert_kept(cells: Cells | None) -> None:
    assert cells is not None
    for one, kept in zip(CELLS, cells, strict=True):
        assert one.dtype == kept.dtype
        np.testing.assert_array_equal(one, kept)


def written(target: Path) -> tuple[Parts, Path]:
    """Return the parts of a sweep of which part 0 is done, and its file."""
    parts = open_parts(target, MINE)
    parts.write(0, CELLS)
    [path] = parts.folder.iterdir()
    return parts, path


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    parts = open_parts(target, MINE)
    assert parts.there() == set()
    parts.write(7, CELLS)
    again = open_parts(target, MINE)
    assert again.there() == {7}
    assert_kept(again.read(7))
    assert again.read(8) is None
    again.remove()
    assert list(tmp_path.iterdir()) == []


def repacked(content: bytes, **changed: np.ndarray) -> bytes:
    """Return a part with other numbers, under the seal it had."""
    mark, _, body = content.partition(b"\n")
    with np.load(io.BytesIO(body)) as found:
        arrays = {**found, **changed}
    file = io.BytesIO()
    np.savez(file, **arrays)
    return mark + b"\n" + file.getvalue()


DAMAGES = {
    "cut": lambda content: content[:-5],
    "begun": lambda content: content[:40],
    "only sealed": lambda content: content[:65],
    "emptied": lambda content: b"",
    "changed": lambda content: content.replace(b"stable", b"Stable"),
    "longer": lambda content: content + b"\0",
    "of other numbers": lambda content: repacked(content, numbers=np.zeros((1, 2))),
    "of another shape": lambda content: repacked(content, numbers=np.zeros(2)),
    "of objects": lambda content: repacked(content, texts=np.array([None])),
    "without a seal": lambda content: content.partition(b"\n")[2],
    "sealed by another": lambda content: (
        hmac.digest(b"guess", content[65:], "sha256").hex().encode() + content[64:]
    ),
    "something else": lambda content: b"thesis",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_part_that_is_not_as_it_was_written_counts_as_not_there(tmp_path: Path, damage: str) -> None:
    parts, path = written(tmp_path / "r.csv")
    assert_kept(parts.read(0))
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert parts.read(0) is None
    parts.write(0, CELLS)
    assert_kept(parts.read(0))


def test_a_part_is_no_other_part_and_of_no_other_sweep(tmp_path: Path) -> None:
    parts, path = written(tmp_path / "r.csv")
    path.with_name(path.name.replace("part-0", "part-3")).write_bytes(path.read_bytes())
    other = open_parts(tmp_path / "r.csv", {**MINE, "over": [1, 3]})
    other._path(0).write_bytes(path.read_bytes())
    assert parts.read(3) is None and other.read(0) is None


def test_a_part_of_another_user_counts_as_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts, _ = written(tmp_path / "r.csv")
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "other")
    assert parts.read(0) is None


def test_without_a_secret_a_process_takes_up_what_it_wrote_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(seal, "_folder", lambda: tmp_path / "file" / "cache")
    parts, _ = written(tmp_path / "r.csv")
    assert_kept(parts.read(0))
    monkeypatch.setattr(sweep_store, "_OWN", b"another process")
    assert parts.read(0) is None


@pytest.mark.parametrize("kind", ["pipe", "link to what never ends", "folder"])
def test_what_is_no_file_counts_as_not_there(tmp_path: Path, kind: str) -> None:
    parts, path = written(tmp_path / "r.csv")
    path.unlink()
    make = {"pipe": os.mkfifo, "folder": Path.mkdir}
    make.get(kind, lambda one: one.symlink_to("/dev/zero"))(path)
    assert parts.read(0) is None


def test_sweeps_of_one_target_don_t_touch_each_other_s_parts(tmp_path: Path) -> None:
    parts, path = written(tmp_path / "r.csv")
    other = open_parts(tmp_path / "r.csv", {**MINE, "over": [1, 3]})
    other.write(0, CELLS)
    assert parts.there() == other.there() == {0}
    other.remove()
    assert [one.name for one in parts.folder.iterdir()] == [path.name]
    assert_kept(parts.read(0))


def test_of_a_full_disk_the_finished_parts_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        path.write_bytes(content[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    parts, _ = written(tmp_path / "r.csv")
    with monkeypatch.context() as patched:
        patched.setattr(sweep_store, "_fill", full)
        message = f"{parts._path(1)}: E601 can't be written: No space left on device."
        assert told(parts.write, 1, CELLS) == [message]
        assert told(open_parts(tmp_path / "s.csv", MINE).write, 0, CELLS) != []
    assert parts.there() == {0}
    assert_kept(parts.read(0))
    assert [one.name for one in tmp_path.iterdir()] == ["r.csv.parts"], "nothing came of the other"


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    parts = open_parts(tmp_path / "file" / "r.csv", MINE)
    assert told(parts.write, 0, CELLS) == [f"{parts.folder}: E601 can't be written: Not a directory."]


@pytest.mark.parametrize("kind", ["file", "link"])
def test_what_is_no_folder_in_its_place_is_refused_and_stays(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "w.csv.parts"
    (tmp_path / "other").mkdir()
    folder.write_text("thesis", encoding="utf-8") if kind == "file" else folder.symlink_to("other")
    (message,) = told(open_parts, tmp_path / "w.csv", MINE)
    assert message.startswith(f"{folder}: E885 is there and is no folder")
    assert list((tmp_path / "other").iterdir()) == []


def test_what_others_put_into_the_folder_stays(tmp_path: Path) -> None:
    parts, path = written(tmp_path / "w.csv")
    notes = [
        parts.folder / name for name in ("notes.txt", ".hidden", "part-0.npz", "part-x", "manifest.json")
    ]
    for one in notes:
        one.write_text("mine", encoding="utf-8")
    path.unlink()
    path.symlink_to("notes.txt")  # a part is not written to where a link leads
    parts.write(0, CELLS)
    parts.remove()
    assert {one.read_text() for one in notes} == {"mine"}
    assert sorted(parts.folder.iterdir()) == sorted(notes)
