"""Tables as files: every digit, nothing for nothing, the same bytes for the same rows."""

from __future__ import annotations

import csv
import importlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apc.support.tables import (
    BLOCK,
    TableColumn,
    blocks_of,
    check_table_path,
    keep_room,
    read_table,
    write_table,
)
from tests.topologies import messages_of

COLUMNS = (TableColumn("x", "m"), TableColumn("verdict", kind="text"), TableColumn("modes", kind="count"))
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


@pytest.mark.whole
def test_parquet_keeps_types_and_what_made_it(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS, blocks_of(ROWS), {"model": "abc"})
    table = parquet.read_table(path)
    assert [tuple(row.values()) for row in table.to_pylist()] == list(ROWS)
    assert [str(peer_type) for peer_type in table.schema.types] == ["double", "string", "int64"]
    assert json.loads(table.schema.metadata[b"apc"]) == {"model": "abc"}


@pytest.mark.few(2)
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("rows", [(), ROWS, ROWS * (BLOCK // 3)], ids=["none", "few", "many blocks"])
def test_columns_come_back_as_they_were_written(
    tmp_path: Path, suffix: str, rows: Sequence[tuple[Any, ...]]
) -> None:
    """As cells or as arrays, which gives the same bytes; some of them, in any order."""
    pytest.importorskip("pyarrow")
    numbers = np.array([math.nan if row[0] is None else row[0] for row in rows], float)
    texts, counts = (np.array([row[place] for row in rows], dtype=object) for place in (1, 2))
    paths = [tmp_path / f"{i}.{suffix}" for i in range(2)]
    write_table(paths[0], COLUMNS, blocks_of(rows), {"a": 1})
    write_table(paths[1], COLUMNS, [[numbers, texts, counts]] if rows else [], {"a": 1})
    assert suffix == "parquet" or paths[0].read_bytes() == paths[1].read_bytes()
    for path in paths:
        found_counts, found = read_table(path, [COLUMNS[2], COLUMNS[0]])
        (found_texts,) = read_table(path, COLUMNS[1:2])
        assert found_counts.tolist() == counts.tolist()
        np.testing.assert_array_equal(found, numbers)
        # CSV has no texts that are none.
        assert [text or None for text in found_texts.tolist()] == texts.tolist()


def test_a_missing_pyarrow_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    assert messages_of(check_table_path, Path("t.parquet"), "--out") == [
        "t.parquet: E887 is a Parquet file, which needs pyarrow; without it, the name can end in .csv. "
        "Try: pip install '.[data]'  # in the folder of apc's own pyproject.toml"
    ]
    assert messages_of(check_table_path, Path("t.csv"), "--out") == []


def test_room_that_is_kept_is_in_the_file_and_may_be_written_over(tmp_path: Path) -> None:
    path = tmp_path / "room"
    with path.open("w+b") as file:
        file.write(b"abc")
        keep_room(file, 3, 5000)
        assert path.stat().st_size >= 5000
        file.seek(3)
        file.write(b"d")
    assert path.read_bytes()[:4] == b"abcd"
