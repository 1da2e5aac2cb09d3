"""Tables as files: every digit, nothing for nothing, the same bytes for the same rows."""

from __future__ import annotations

import csv
import importlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from apc.tables import (
    BLOCK,
    Column,
    Csv,
    Writer,
    blocks_of,
    check_table_path,
    keep_room,
    read_table,
    write_table,
)
from tests.topologies import told

COLUMNS = (Column("x", "m"), Column("verdict", kind="text"), Column("modes", kind="count"))
ABOUT = ("about", "{}")
ROWS = ((0.1 + 0.2, "stable, or so", 1), (5e-324, 'say "no"', None), (None, None, 3), (-1e300, "ρ\nσ", 4))


def test_csv_keeps_every_digit_and_leaves_empty_cells_empty(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    write_table(path, COLUMNS, blocks_of(ROWS), {})
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["x [m]", "verdict", "modes"]
    back = [tuple(float(c) if i != 1 and c else c or None for i, c in enumerate(row)) for row in rows]
    assert back == list(ROWS)
    assert "nan" not in path.read_text(encoding="utf-8")


def test_parquet_keeps_types_and_what_made_it(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS, blocks_of(ROWS), {"model": "abc"})
    table = parquet.read_table(path)
    assert [tuple(row.values()) for row in table.to_pylist()] == list(ROWS)
    assert [str(kind) for kind in table.schema.types] == ["double", "string", "int64"]
    assert json.loads(table.schema.metadata[b"apc"]) == {"model": "abc"}


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_columns_as_arrays_are_the_same_file_as_their_cells(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pyarrow")
    numbers = np.array([math.nan if row[0] is None else row[0] for row in ROWS])
    texts, counts = (np.array([row[place] for row in ROWS], dtype=object) for place in (1, 2))
    paths = [tmp_path / f"{i}.{suffix}" for i in range(2)]
    write_table(paths[0], COLUMNS, blocks_of(ROWS), {})
    write_table(paths[1], COLUMNS, [[numbers, texts, counts]], {})
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_columns_come_back_as_they_were_written(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / f"t.{suffix}"
    write_table(path, COLUMNS, blocks_of(ROWS), {})
    counts, numbers = read_table(path, [COLUMNS[2], COLUMNS[0]])  # some of them, in any order
    (texts,) = read_table(path, COLUMNS[1:2])
    assert counts.tolist() == [row[2] for row in ROWS]
    np.testing.assert_array_equal(numbers, [math.nan if row[0] is None else row[0] for row in ROWS])
    # CSV has no texts that are none.
    assert [text or None for text in texts.tolist()] == [row[1] for row in ROWS]


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_without_rows_comes_back_with_none(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / f"t.{suffix}"
    write_table(path, COLUMNS, [], {})
    assert [len(one) for one in read_table(path, COLUMNS)] == [0, 0, 0]


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_the_same_rows_give_the_same_bytes_over_many_blocks(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pyarrow")
    rows = [(math.sqrt(i), "word", i) for i in range(BLOCK + 10)]
    paths = [tmp_path / f"{i}.{suffix}" for i in range(2)]
    for path in paths:
        write_table(path, COLUMNS, blocks_of(rows), {"a": 1})
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize(("name", "got"), [("t.xlsx", ".xlsx"), ("t", "none")])
def test_another_suffix_is_refused(name: str, got: str) -> None:
    assert told(check_table_path, Path(name), "--out") == [
        f"{name}: E878 the suffix of --out wants one of .csv, .parquet, got {got}. Write: --out t.csv"
    ]


def test_a_missing_pyarrow_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    assert told(check_table_path, Path("t.parquet"), "--out") == [
        "t.parquet: E887 is a Parquet file, which needs pyarrow; without it, the name can end in .csv. "
        "Write: pip install '.[data]'  # in the folder of apc's own pyproject.toml"
    ]
    assert told(check_table_path, Path("t.csv"), "--out") == []


def test_an_unwritable_folder_is_told_and_nothing_is_left(tmp_path: Path) -> None:
    path = tmp_path / "not-there" / "t.csv"
    (message,) = told(write_table, path, COLUMNS, blocks_of(ROWS), {})
    assert message == f"{path}: E601 can't be written: No such file or directory."


def test_a_folder_in_the_way_is_told_before_anything_is_computed(tmp_path: Path) -> None:
    (tmp_path / "r.csv").mkdir()
    path = tmp_path / "r.csv"
    assert told(check_table_path, path, "--out") == [f"{path}: E601 can't be written: it is a folder."]


def test_a_csv_number_reads_back_as_the_very_float(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    values = np.array([[0.1 + 0.2, 1 / 3], [-0.0, 5e-324], [1.7976931348623157e308, 1e-17]])
    writer = Csv(path, [Column("time", "s"), Column("a", "m"), Column("b", "m")], ABOUT)
    writer.rows([np.array([0.0, 0.1, 0.2]), *values.T])
    writer.finish()
    writer.close()
    heading, *rows = path.read_text(encoding="utf-8").splitlines()
    assert heading == "time [s],a [m],b [m]"
    assert [[float(one) for one in row.split(",")][1:] for row in rows] == values.tolist()


def test_room_that_is_kept_is_in_the_file_and_may_be_written_over(tmp_path: Path) -> None:
    path = tmp_path / "room"
    with path.open("w+b") as file:
        file.write(b"abc")
        keep_room(file, 3, 5000)
        assert path.stat().st_size >= 5000
        file.seek(3)
        file.write(b"d")
    assert path.read_bytes()[:4] == b"abcd"


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_room_kept_holds_texts_as_well(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    whole, rooms = Writer.cut, []

    def cut(writer: Writer) -> None:
        written = writer.file.tell()
        rooms.append((written, writer._kept))
        whole(writer)

    monkeypatch.setattr(Writer, "cut", cut)
    rows = [(float(i), f'{i} is stable, "so" to say: ρ < 1' * 9, None if i % 3 else i) for i in range(5000)]
    write_table(tmp_path / f"t{suffix}", COLUMNS, blocks_of(rows), {"model": "a" * 10_000})
    [(written, kept)] = rooms
    assert written <= kept


def test_a_writer_is_abstract() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Writer(Path("x"), COLUMNS, ABOUT)  # type: ignore[abstract] # that is the claim
