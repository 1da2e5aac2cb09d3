"""`recording`: what is in a file is what was simulated, and a file is whole or not there."""

from __future__ import annotations

import errno
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from apc.compiler.errors import ApcError
from apc.runtime import recording as module
from apc.runtime.recording import SUFFIXES, open_recording
from apc.runtime.simulation import Simulation, blocks, prepare
from apc.runtime.trajectory import simulate
from tests.topologies import AVERAGE, compiled, replaced

SYSTEM = compiled(replaced(AVERAGE, ("{count: 3}", "{count: 100, set: {device.x: 3 mm}}")))
DURATION = Fraction(1)
WHOLE = simulate(SYSTEM, duration=DURATION)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return prepare(SYSTEM, DURATION)


def written(simulation: Simulation, path: Path) -> Path:
    recording = open_recording(path, simulation)
    for block in blocks(simulation):
        recording.take(block)
    recording.close()
    return path


def read(path: Path) -> tuple[np.ndarray, np.ndarray, list[str], dict[str, Any]]:
    """Return time, values, names or headings, and the provenance of a file."""
    match path.suffix:
        case ".csv":
            headings = path.read_text(encoding="utf-8").splitlines()[0].split(",")
            table = np.loadtxt(path, delimiter=",", skiprows=1)
            provenance = json.loads(path.with_name(f"{path.name}.json").read_text(encoding="utf-8"))
            return table[:, 0], table[:, 1:], headings[1:], provenance
        case ".parquet":
            parquet = pytest.importorskip("pyarrow.parquet")
            found = parquet.read_table(path)
            columns = np.array([found[name].to_numpy() for name in found.column_names])
            return (
                columns[0],
                columns[1:].T,
                found.column_names[1:],
                json.loads(found.schema.metadata[b"provenance"]),
            )
        case ".mat":
            mat = scipy.io.loadmat(path)
            names = [str(one[0]) for one in mat["names"][:, 0]]
            return mat["time"][:, 0], mat["values"], names, json.loads(str(mat["provenance"][0]))
        case _:
            with np.load(path, allow_pickle=False) as npz:
                return npz["time"], npz["values"], npz["names"].tolist(), json.loads(str(npz["provenance"]))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_holds_every_digit_of_every_row(simulation: Simulation, tmp_path: Path, suffix: str) -> None:
    path = written(simulation, tmp_path / f"run{suffix}")
    time, values, names, provenance = read(path)
    assert (time == WHOLE.time).all()
    assert (values == WHOLE.values).all()
    by_heading = suffix in (".csv", ".parquet")
    assert names == [one.heading if by_heading else one.name for one in WHOLE.signals]
    assert names[2] == ("user[1].cube.x [m]" if by_heading else "user[1].cube.x")
    assert provenance["topology"] == "three-users-average"
    assert provenance["method"] == "exact"
    assert provenance["parameters"]["contact.stiffness"] == {"value": 1000.0, "unit": "N/m"}
    assert provenance["versions"].keys() == {"apc", "casadi", "numpy"}
    beside = {path.name, *([f"{path.name}.json"] if suffix == ".csv" else [])}
    assert {one.name for one in tmp_path.iterdir()} == beside, "no temporary is left"


def test_the_same_run_gives_the_same_bytes(simulation: Simulation, tmp_path: Path) -> None:
    one, two = (written(simulation, tmp_path / f"{name}.csv").read_bytes() for name in "ab")
    assert one == two


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_of_a_run_cut_short_the_finished_part_is_kept(
    simulation: Simulation, tmp_path: Path, suffix: str
) -> None:
    recording = open_recording(tmp_path / f"run{suffix}", simulation)
    first = next(blocks(simulation))
    recording.take(first)
    recording.close()
    time, values, _, _ = read(tmp_path / f"run{suffix}")
    assert (time == first.time).all()
    assert (values == first.values).all()


def test_an_unknown_suffix_is_refused_before_anything_runs(simulation: Simulation, tmp_path: Path) -> None:
    with pytest.raises(
        ApcError, match=r"E878 the suffix of --out wants one of .*, got \.xls\. Write: run\.csv"
    ):
        open_recording(tmp_path / "run.xls", simulation)


def test_a_folder_that_isnt_there_is_told(simulation: Simulation, tmp_path: Path) -> None:
    with pytest.raises(ApcError, match="E879 can't be written: No such file"):
        open_recording(tmp_path / "nowhere" / "run.csv", simulation)


class _Full:
    """A file on a disk that is full after so many bytes."""

    def __init__(self, file: Any, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: bytes) -> int:
        if self._file.tell() + len(data) > self._room:
            self._file.write(data[: self._room - self._file.tell()])  # half a line
            self._file.flush()
            raise OSError(errno.ENOSPC, "No space left on device")
        return int(self._file.write(data))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def test_on_a_full_disk_the_whole_rows_of_a_csv_are_kept(
    simulation: Simulation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.csv"
    recording = open_recording(path, simulation)
    parts = list(blocks(simulation))
    recording.take(parts[0])
    size = recording._writer.file.tell()
    monkeypatch.setattr(recording._writer, "file", _Full(recording._writer.file, size + 1000))
    with pytest.raises(ApcError, match=r"E879 holds the first \d+ rows only: No space left on device"):
        recording.take(parts[1])
    time, values, _, _ = read(path)
    assert (values == parts[0].values).all()
    assert (time == parts[0].time).all()


def test_on_a_full_disk_a_file_that_needs_its_end_is_not_left_half(
    simulation: Simulation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.npz"
    recording = open_recording(path, simulation)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module._Npz, "rows", full)
    with pytest.raises(ApcError, match="E879 can't be written: No space left on device"):
        recording.take(next(blocks(simulation)))
    assert list(tmp_path.iterdir()) == []
