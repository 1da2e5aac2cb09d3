"""Recordings of force and motion: columns over time from a CSV, Parquet or MAT file.

Takes: a path. Gives: `read_recording`, a `MeasuredTable` of `MeasuredColumn`s.
Guarantees: numbers are finite, columns have equal lengths, and rows have equal intervals, an exact
fraction of a second. Time 0 is the first row.
Does not: relate columns to a model (see `recorded_signals`).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import FileReader, InputFile, RefusedError, read_file
from apc.compiler.language.csv_tables import PACKED, parse_headings, read_table
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.units import Unit
from apc.support.optional import need

Floats = NDArray[np.float64]

TIME, EXAMPLE = "time", "time [s]"
LARGEST = 1 << 28  # bytes of a Parquet or MAT file
# The largest deviation of a time from equal intervals, relative to an interval: a larger one is a gap.
UNEVEN = 0.01
LIMITS = tuple(10**n for n in range(1, 10))  # denominators of an interval in seconds, the simplest first
# The variables of a MAT file, as `apc simulate --out run.mat` writes them.
VARIABLES = ("time", "values", "names", "units")


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredColumn:
    """A column of a recording: its name, its unit, and its numbers (rows,) in SI."""

    name: str
    unit: Unit
    numbers: Floats


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredTable:
    """The columns of a recording, without the time: row i is at i·`interval` seconds.

    `start` is the recorded time of the first row, in seconds.
    """

    file: str
    columns: tuple[MeasuredColumn, ...]
    rows: int
    interval: Fraction
    start: float

    @property
    def times(self) -> Floats:
        """The times of the rows (rows,) in seconds."""
        return np.arange(self.rows) * self.interval.numerator / self.interval.denominator


def read_recording(path: Path) -> MeasuredTable:
    """Return the recording in a file.

    Parameters
    ----------
    path
        A CSV (also `.csv.gz`) or Parquet file whose headings have units, such as `time [s]`; or a MAT file
        with the variables `time`, `values`, `names` and `units`.

    Raises
    ------
    ApcError
        E701 to E703 as for a table, E711 unsuitable columns, E712 unsuitable times.
    """
    suffix = Path(path.stem).suffix.lower() if path.suffix.lower() == PACKED else path.suffix.lower()
    read = {".csv": _read_csv, ".parquet": _read_parquet, ".mat": _read_mat}.get(suffix)
    if read is None:
        expected = ".csv, .parquet, .mat, or the folder of apc run"
        raise _fault(path, "E711", "suffix of the recording", expected, suffix or "none")
    columns = read(path)
    times = [column for column in columns if column.name == TIME and column.unit.dimension == SECOND]
    if not times:
        raise _fault(path, "E711", "columns", f"a column {EXAMPLE}", ", ".join(c.name for c in columns[:6]))
    for column in columns:
        wrong = np.flatnonzero(~np.isfinite(column.numbers))
        if len(wrong):
            got = f"{column.numbers[wrong[0]]:g}"
            raise _fault(path, "E712", f"{column.name}, row {wrong[0] + 1}", "a finite number", got)
    interval = _interval(path, times[0].numbers)
    others = tuple(column for column in columns if column is not times[0])
    return MeasuredTable(str(path), others, len(times[0].numbers), interval, float(times[0].numbers[0]))


def _read_csv(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a CSV file in SI."""
    table = read_table(InputFile(path, FileReader()), SourceLocation(str(path)))
    return [MeasuredColumn(column.name, column.unit, column.numbers) for column in table.columns]


def _read_parquet(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a Parquet file in SI."""
    parquet = need("pyarrow.parquet", "data")
    try:
        table = parquet.read_table(io.BytesIO(_bytes(path)))
        numbers = [table.column(index).to_numpy() for index in range(table.num_columns)]
        return _columns(path, table.column_names, numbers)
    except (ValueError, TypeError, OSError) as error:  # as those of PyArrow
        raise _unreadable(path, "Parquet") from error


def _read_mat(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a MAT file in SI."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(io.BytesIO(_bytes(path)), variable_names=VARIABLES)
        time, values, names, units = (variables.get(name) for name in VARIABLES)
        if time is None or values is None or names is None or units is None:
            got = ", ".join(sorted(name for name in variables if name in VARIABLES)) or "none"
            raise _fault(path, "E711", "variables", "time, values (rows, signals), names and units", got)
        texts = [[str(np.ravel(cell)[0]) for cell in np.ravel(cells)] for cells in (names, units)]
        if len(values) != time.size or {len(item) for item in texts} != {values.shape[1]}:
            expected = f"{time.size} rows and {len(texts[0])} columns, as in time and names"
            raise _fault(path, "E711", "values", expected, " by ".join(map(str, values.shape)))
        headings = [EXAMPLE, *(f"{name} [{unit}]" for name, unit in zip(*texts, strict=True))]
        return _columns(path, headings, [time.reshape(-1), *values.T])
    except (MatReadError, ValueError, TypeError, IndexError, NotImplementedError, OSError) as error:
        raise _unreadable(path, "MAT (version 5)") from error


def _columns(path: Path, headings: list[str], numbers: list[Any]) -> list[MeasuredColumn]:
    """Return columns in SI from their headings and numbers."""
    named = parse_headings(headings, str(path), EXAMPLE)
    return [
        MeasuredColumn(name, unit, np.asarray(column, np.float64) * float(unit.scale))
        for (name, unit, _), column in zip(named, numbers, strict=True)
    ]


def _bytes(path: Path) -> bytes:
    """Return the bytes of a file. Raises ApcError E701."""
    try:
        return read_file(path, LARGEST)
    except RefusedError as refused:
        message = f"the recording {path} {refused.words}"
        raise ApcError(Diagnostic("E701", SourceLocation(str(path)), message)) from None


def _unreadable(path: Path, kind: str) -> ApcError:
    """Return the error E711 for a file that is not of its format, or has other data than numbers."""
    return _fault(path, "E711", "recording", f"columns of numbers in a {kind} file", "other data")


def _interval(path: Path, times: Floats) -> Fraction:
    """Return the interval of equidistant times, the simplest fraction of a second. Raises ApcError E712."""
    steps = np.diff(times)
    if not len(steps):
        raise _fault(path, "E712", "rows", "two or more", f"{len(times)}")
    back = np.flatnonzero(steps <= 0)
    if len(back):
        got = f"{times[back[0] + 1]:.9g} s after {times[back[0]]:.9g} s in row {back[0] + 2}"
        raise _fault(path, "E712", "time", "increasing times", got)
    step = float(np.median(steps))
    gaps = np.flatnonzero(np.abs(steps - step) > UNEVEN * step)
    if len(gaps):
        after = f"after row {gaps[0] + 1}, at {times[gaps[0]]:.9g} s"
        advice = "fit one part of the recording without gaps, or resample it at equal intervals"
        expected, got = f"equal intervals of {1e3 * step:.6g} ms", f"{1e3 * steps[gaps[0]]:.6g} ms {after}"
        raise _fault(path, "E712", "time", expected, got, advice)
    mean = float(times[-1] - times[0]) / len(steps)
    for limit in LIMITS:
        interval = Fraction(mean).limit_denominator(limit)
        even = times[0] + np.arange(len(times)) * float(interval)
        if np.abs(times - even).max() <= UNEVEN * mean:
            return interval
    expected, advice = f"equal intervals of {1e3 * mean:.6g} ms", "resample the recording at equal intervals"
    raise _fault(path, "E712", "time", expected, "a drifting interval", advice)


def _fault(path: Path, code: str, message: str, expected: str, got: str, advice: str = "") -> ApcError:
    """Return an error of a recording."""
    return ApcError(Diagnostic(code, SourceLocation(str(path)), message, expected, got, advice=advice))
