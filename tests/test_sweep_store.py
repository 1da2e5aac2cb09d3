"""Finished parts on disk: whole or not there, one sweep's only, one process at a time."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from apc.runtime.sweep import store as sweep_store
from apc.runtime.sweep.store import open_parts, remove_parts
from tests.topologies import told

ROWS = (("stable", 0.1 + 0.2, None, ""), ("error: E803", None, None, "why"))
MINE = {"model": "abc", "over": [1, 2]}


def claim(target: Path, description: dict[str, object]) -> None:
    with open_parts(target, description):
        pass


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        assert parts.there() == set()
        parts.write(7, ROWS)
    with open_parts(target, MINE) as parts:
        assert parts.there() == {7}
        assert parts.read(7) == ROWS
        assert parts.read(8) is None
        remove_parts(target)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["cut", "changed", "emptied", "moved"])
def test_a_damaged_part_counts_as_not_there(tmp_path: Path, damage: str) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, ROWS)
        path = tmp_path / "r.csv.parts" / "part-0.json"
        content = path.read_bytes()
        if damage == "cut":
            path.write_bytes(content[:-5])
        elif damage == "changed":
            path.write_bytes(content.replace(b"stable", b"Stable"))
        elif damage == "emptied":
            path.write_bytes(b"")
        else:
            path.rename(path.with_name("part-3.json"))
        assert parts.read(0) is None and parts.read(3) is None


def test_parts_of_another_sweep_are_never_mixed_in(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    with open_parts(target, MINE) as parts:
        parts.write(0, ROWS)
    assert told(claim, target, {**MINE, "over": [1, 3]}) == [
        f"{target}.parts: E885 holds unfinished work of another sweep: different are its over. "
        f"Write: another --out than {target}, or delete that folder"
    ]
    (tmp_path / "r.csv.parts" / "manifest.json").write_bytes(b"{")
    (message,) = told(claim, target, MINE)
    assert "E885 holds unfinished work of another sweep: different are its model, over." in message
    assert (tmp_path / "r.csv.parts" / "part-0.json").is_file(), "nothing of it is lost"


def test_a_second_process_on_the_same_target_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    code = (
        "import sys\nfrom pathlib import Path\nfrom apc.runtime.sweep.store import open_parts\n"
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
        parts.write(0, ROWS)
    (tmp_path / "r.csv.parts" / ".part-1.json.abc").write_bytes(b"half")
    (tmp_path / ".r.csv.finished").mkdir()
    (tmp_path / ".r.csv.finished" / "part-0.json").write_bytes(b"old")
    with open_parts(target, MINE):
        names = sorted(path.name for path in (tmp_path / "r.csv.parts").iterdir())
        assert names == ["lock", "manifest.json", "part-0.json"]
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
        parts.write(0, ROWS)
        monkeypatch.setattr(sweep_store, "_fill", full)
        part = tmp_path / "r.csv.parts" / "part-1.json"
        assert told(parts.write, 1, ROWS) == [f"{part}: E601 can't be written: No space left on device."]
        assert parts.there() == {0}
        assert parts.read(0) == ROWS
