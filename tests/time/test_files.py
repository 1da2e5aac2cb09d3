"""What is in a file is what was simulated, every digit of it; a disk that is full loses no finished part."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from apc.compiler.errors import ApcError
from apc.output.recording import SUFFIXES, open_recording
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.trajectory import simulate
from tests.topologies import AVERAGE, compiled, replaced

SYSTEM = compiled(replaced(AVERAGE, ("{count: 3}", "{count: 25, set: {device.x: 3 mm}}")))
DURATION = Fraction(3, 4)
WHOLE = simulate(SYSTEM, duration=DURATION, jit=False)


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    """Return a run in many blocks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("apc.simulation.simulation.CHUNK", 2**13)
        yield prepare(SYSTEM, Settings(DURATION, jit=False))


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


@pytest.mark.few(1)
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
    alongside = {path.name, *([f"{path.name}.json"] if suffix == ".csv" else [])}
    assert {one.name for one in tmp_path.iterdir()} == alongside, "no temporary is left"


def test_what_cannot_be_written_is_refused_before_anything_runs(
    simulation: Simulation, tmp_path: Path
) -> None:
    requested = r"E878 suffix of --out: expected one of .*, got \.xls\. Try: --out .*run\.csv"
    for name, printed in (("run.xls", requested), ("nowhere/run.csv", "E879 can't be written: No such file")):
        with pytest.raises(ApcError, match=printed):
            open_recording(tmp_path / name, simulation)


@contextmanager
def no_room_after(size: int) -> Iterator[None]:
    """Let no file grow beyond so many bytes: a disk that is full, told by the system itself."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def reported_by(simulation: Simulation, path: Path) -> str:
    """Record until there is no more room; return what is told then, "" if all was written."""
    try:
        written(simulation, path)
    except ApcError as error:
        return str(error)
    return ""


def check_kept(path: Path, message: str) -> int:
    """Check that a file holds what a message says; return how many rows."""
    reported = re.search(r"E879 holds the first (\d+) rows only, up to ([\d.e-]+) s: \w+", message)
    assert reported, message
    time, values, names, provenance = read(path)
    rows = int(reported[1])
    assert len(time) == rows and f"{time[-1]:.9g}" == reported[2]
    assert (time == WHOLE.time[:rows]).all() and (values == WHOLE.values[:rows]).all()
    assert len(names) == len(WHOLE.signals) and provenance["topology"] == "three-users-average"
    return rows


@pytest.mark.few(1)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_wherever_the_disk_is_full_the_blocks_before_are_kept(
    simulation: Simulation, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"run{suffix}"
    whole = written(simulation, path).stat().st_size
    found = []
    for share in (0.0, 0.6, 0.9):
        path.unlink()
        path.with_name(f"{path.name}.json").unlink(missing_ok=True)
        with no_room_after(int(share * whole)):
            message = reported_by(simulation, path)
        if not path.exists():
            assert re.search(r"E879 can't be written: \w+", message)
            assert list(tmp_path.iterdir()) == []
            path.touch()
            found.append(0)
        else:
            found.append(check_kept(path, message))
    assert found == sorted(found) and found[0] == 0
    assert found[1] > 0
    if suffix == ".csv":  # what is packed needs room before it is known how small it gets
        assert found[2] == pytest.approx(0.9 * len(WHOLE.time), rel=0.1)
