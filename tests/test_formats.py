"""Claims about `apc.simulation.formats`; what is in a file is in `test_recording`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apc.simulation import formats
from apc.simulation.formats import Writer, keep_room
from apc.simulation.signals import Signal

SIGNALS = [Signal("user", 1, "cube.x", "m", "state"), Signal("user", 2, "cube.x", "m", "state")]


def test_a_csv_number_reads_back_as_the_very_float(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    values = np.array([[0.1 + 0.2, 1 / 3], [-0.0, 5e-324], [1.7976931348623157e308, 1e-17]])
    writer = formats._Csv(path, SIGNALS, "{}")
    writer.rows(np.array([0.0, 0.1, 0.2]), values)
    writer.finish()
    writer.close()
    heading, *rows = path.read_text(encoding="utf-8").splitlines()
    assert heading == "time [s],user[1].cube.x [m],user[2].cube.x [m]"
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


def test_a_writer_is_abstract() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Writer(Path("x"), SIGNALS, "{}")  # type: ignore[abstract] # that is the claim
