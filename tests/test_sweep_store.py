"""Finished parts on disk: whole or not there, one sweep's only, one process at a time."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from apc.sweeps import store as sweep_store
from apc.sweeps.quantities import Cells
from apc.sweeps.store import open_parts, remove_parts
from tests.topologies import told

CELLS = (
    np.array(["stable", "error: E803"], dtype=object),
    np.array([0.1 + 0.2, np.nan]),
    np.array([None, None], dtype=object),
    np.array(["", "why"], dtype=object),
)
MINE = {"model": "abc", "over": [1, 2]}


def assert_kept(cells: Cells | None) -> None:
    assert cells is not None
    for one, kept in zip(CELLS, cells, strict=True):
        assert one.dtype == kept.dtype
        np.testing.assert_array_equal(one, kept)


def claim(target: Path, description: dict[str, object]) -> None:
    with open_parts(target, description):
        pass


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        assert parts.there() == set()
        parts.write(7, CELLS)
    with open_parts(target, MINE) as parts:
        assert parts.there() == {7}
        assert_kept(parts.read(7))
        assert parts.read(8) is None
        remove_parts(target)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["cut", "changed", "emptied", "moved"])
def test_a_damaged_part_counts_as_not_there(tmp_path: Path, damage: str) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
        path = tmp_path / "r.csv.parts" / "part-0.npz"
        content = path.read_bytes()
        if damage == "cut":
            path.write_bytes(content[:-5])
        elif damage == "changed":
            path.write_bytes(content.replace("stable".encode("utf-32-le"), "Stable".encode("utf-32-le")))
        elif damage == "emptied":
            path.write_bytes(b"")
        else:
            path.rename(path.with_name("part-3.npz"))
        assert parts.read(0) is None and parts.read(3) is None


def test_parts_of_another_sweep_are_never_mixed_in(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
    assert told(claim, target, {**MINE, "over": [1, 3]}) == [
        f"{target}.parts: E885 holds unfinished work of another sweep: different are its over. "
        f"Write: another --out than {target}, or delete that folder"
    ]
    (tmp_path / "r.csv.parts" / "manifest.json").write_bytes(b"{")
    (message,) = told(claim, target, MINE)
    assert "E885 is there and was not made by apc sweep" in message
    assert (tmp_path / "r.csv.parts" / "part-0.npz").is_file(), "nothing of it is lost"


def test_a_second_process_on_the_same_target_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    code = (
        "import sys\nfrom pathlib import Path\nfrom apc.sweeps.store import open_parts\n"
        "with open_parts(Path(sys.argv[1]), {}) as parts:\n"
        "    parts.write(0, ())\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, str(target)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        assert told(claim, target, {}) == [
            f"{target}.parts: E885 is being worked on by another process; wait for it, "
            "or choose another --out."
        ]
        other.kill()
    assert told(claim, target, {}) == [], "the lock dies with its holder"


def test_what_a_killed_process_left_half_written_goes(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
    (tmp_path / "r.csv.parts" / ".part-1.npz.abc").write_bytes(b"half")
    shutil.copytree(tmp_path / "r.csv.parts", tmp_path / ".r.csv.finished")
    with open_parts(target, MINE):
        names = sorted(path.name for path in (tmp_path / "r.csv.parts").iterdir())
        assert names == ["lock", "manifest.json", "part-0.npz"]
        assert not (tmp_path / ".r.csv.finished").exists()


def test_a_sweep_of_which_nothing_came_leaves_nothing(tmp_path: Path) -> None:
    claim(tmp_path / "r.csv", MINE)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    target = tmp_path / "file" / "r.csv"
    assert told(claim, target, MINE) == [f"{target}.parts: E601 can't be written: Not a directory."]


def test_a_full_disk_keeps_the_finished_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        path.write_bytes(content[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
        monkeypatch.setattr(sweep_store, "_fill", full)
        part = tmp_path / "r.csv.parts" / "part-1.npz"
        assert told(parts.write, 1, CELLS) == [f"{part}: E601 can't be written: No space left on device."]
        assert parts.there() == {0}
        assert_kept(parts.read(0))


def test_a_folder_that_no_sweep_made_is_refused_and_stays(tmp_path: Path) -> None:
    target = tmp_path / "w.csv"
    folder, finished = tmp_path / "w.csv.parts", tmp_path / ".w.csv.finished"
    for one in (folder, finished):
        one.mkdir()
        (one / "part-0.npz").write_text("thesis", encoding="utf-8")
    (message,) = told(claim, target, MINE)
    assert message.startswith(f"{folder}: E885 is there and was not made by apc sweep")
    (folder / "manifest.json").write_text('{"name": "a page of the web"}', encoding="utf-8")
    assert told(claim, target, MINE) == [message]
    assert [(one / "part-0.npz").read_text() for one in (folder, finished)] == ["thesis", "thesis"]


def test_an_empty_folder_that_no_sweep_made_stays(tmp_path: Path) -> None:
    (tmp_path / "w.csv.parts").mkdir()
    assert len(told(claim, tmp_path / "w.csv", MINE)) == 1
    assert (tmp_path / "w.csv.parts").is_dir()


def test_what_others_put_into_a_folder_of_parts_stays_when_the_sweep_is_done(tmp_path: Path) -> None:
    target = tmp_path / "w.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
        (parts.folder / "notes.txt").write_text("mine", encoding="utf-8")
        (parts.folder / ".hidden").write_text("mine", encoding="utf-8")
        remove_parts(target)
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"notes.txt", ".hidden"}


def test_a_link_in_the_place_of_the_folder_is_refused_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    target, other = tmp_path / "w.csv", tmp_path / "other.csv"
    with open_parts(other, MINE) as parts:
        parts.write(0, CELLS)
    (tmp_path / "w.csv.parts").symlink_to("other.csv.parts")
    (tmp_path / ".w.csv.finished").symlink_to("other.csv.parts")
    assert len(told(claim, target, MINE)) == 1
    assert (tmp_path / "other.csv.parts" / "part-0.npz").is_file()


def test_a_finished_folder_of_somebody_elses_does_not_stop_the_tidying_up(tmp_path: Path) -> None:
    target = tmp_path / "w.csv"
    (tmp_path / ".w.csv.finished").mkdir()
    (tmp_path / ".w.csv.finished" / "mine.txt").write_text("mine", encoding="utf-8")
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
        remove_parts(target)
    assert [path.name for path in tmp_path.rglob("*")] == [".w.csv.finished", "mine.txt"]


def test_a_part_carries_its_sweep_so_that_no_other_takes_it(tmp_path: Path) -> None:
    target, other = tmp_path / "w.csv", {**MINE, "over": [3]}
    with open_parts(target, MINE) as parts:
        parts.write(0, CELLS)
    manifest = tmp_path / "w.csv.parts" / "manifest.json"
    kept = manifest.read_text(encoding="utf-8")
    manifest.unlink()
    (message,) = told(claim, target, other)
    assert "E885 is there and was not made by apc sweep" in message
    manifest.write_text(json.dumps({"made by": "apc sweep", **other}), encoding="utf-8")
    with open_parts(target, other) as parts:
        assert parts.read(0) is None
    manifest.write_text(kept, encoding="utf-8")
    with open_parts(target, MINE) as parts:
        assert_kept(parts.read(0))
