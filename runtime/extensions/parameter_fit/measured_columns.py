"""Recordings of force and motion: columns over time from a CSV, Parquet or MAT file.

Takes: a path. Gives: `read_recording`, a `MeasuredTable` of `MeasuredColumn`s.
Guarantees: numbers are finite, columns have equal lengths, and rows have equal intervals, an exact
fraction of a second. Time 0 is the first row.
Does not: relate columns to a model (see `recorded_signals`).
"""

from __future__ import annotations

import io
import zlib
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

    `times` (rows,) are these times; `start` is the recorded time of the first row.
    """

    file: str
    columns: tuple[MeasuredColumn, ...]
    times: Floats
    interval: Fraction
    start: float


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
    suffix = path.with_suffix("").suffix if path.suffix == PACKED else path.suffix
    try:
        columns = {".csv": _read_csv, ".parquet": _read_parquet, ".mat": _read_mat}[suffix.lower()](path)
    except RefusedError as refused:
        raise ApcError(Diagnostic("E701", SourceLocation(str(path)), f"{path} {refused.words}")) from None
    except (ValueError, TypeError, LookupError, OSError, NotImplementedError):  # those of the libraries
        expected = "a table in a .csv, .parquet or .mat file (version 5), or the folder of apc run"
        raise _recording_error(path, "E711", "recording", expected, "another file") from None
    times = [column.numbers for column in columns if column.name == TIME and column.unit.dimension == SECOND]
    if not times:
        names = ", ".join(column.name for column in columns[:6])
        raise _recording_error(path, "E711", "columns", f"a column {EXAMPLE}", names)
    for column in columns:
        for row in np.flatnonzero(~np.isfinite(column.numbers))[:1].tolist():
            got = f"{column.numbers[row]:g}"
            raise _recording_error(path, "E712", f"{column.name}, row {row + 1}", "a finite number", got)
    interval, others = _interval(path, times[0]), (column for column in columns if column.name != TIME)
    even = np.arange(len(times[0])) * interval.numerator / interval.denominator
    return MeasuredTable(str(path), tuple(others), even, interval, float(times[0][0]))


def _read_csv(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a CSV file in SI."""
    table = read_table(InputFile(path, FileReader()), SourceLocation(str(path)), EXAMPLE)
    return [MeasuredColumn(column.name, column.unit, column.numbers) for column in table.columns]


def _read_parquet(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a Parquet file in SI."""
    table = need("pyarrow.parquet", "data").read_table(io.BytesIO(read_file(path, LARGEST)))
    return _columns(path, table.column_names, [column.to_numpy() for column in table.columns])


def _read_mat(path: Path) -> list[MeasuredColumn]:
    """Return the columns of a MAT file in SI."""
    from scipy.io.matlab import MatReadError, loadmat

    try:
        variables = loadmat(io.BytesIO(read_file(path, LARGEST)), variable_names=VARIABLES)
    except (MatReadError, NameError, zlib.error) as error:  # a NameError is SciPy's, of some damaged files
        raise ValueError from error
    time, values, names, units = (variables[name] for name in VARIABLES)
    if time.size != len(values) or not names.size == units.size == values.shape[1]:
        expected = f"{time.size} rows and {names.size} columns, as in time, names and units"
        raise _recording_error(path, "E711", "values", expected, " by ".join(map(str, values.shape)))
    pairs = zip(names.ravel(), units.ravel(), strict=True)
    headings = [EXAMPLE, *(f"{name[0]} [{unit[0]}]" for name, unit in pairs)]
    return _columns(path, headings, [time.ravel(), *values.T])


def _columns(path: Path, headings: list[str], numbers: list[Any]) -> list[MeasuredColumn]:
    """Return columns in SI from their headings and numbers."""
    named = parse_headings(headings, str(path), EXAMPLE)
    return [
        MeasuredColumn(name, unit, np.asarray(column, np.float64) * float(unit.scale))
        for (name, unit, _), column in zip(named, numbers, strict=True)
    ]


def _interval(path: Path, times: Floats) -> Fraction:
    """Return the interval of equidistant times, the simplest fraction of a second. Raises ApcError E712."""
    steps = np.diff(times)
    if not len(steps):
        raise _recording_error(path, "E712", "rows", "two or more", f"{len(times)}")
    step = float(np.median(steps))
    if step <= 0:
        got = f"a step of {1e3 * step:.6g} ms"
        advice = "sort the rows by time"
        raise _recording_error(path, "E712", "time", "increasing times", got, advice)
    gaps = np.flatnonzero(np.abs(steps - step) > UNEVEN * step)
    got = f"{1e3 * steps[gaps[0]]:.6g} ms after row {gaps[0] + 1}" if len(gaps) else "a drift"
    mean = float(times[-1] - times[0]) / len(steps)
    for limit in LIMITS if not len(gaps) else ():
        interval = Fraction(mean).limit_denominator(limit)
        if np.abs(times - times[0] - np.arange(len(times)) * float(interval)).max() <= UNEVEN * mean:
            return interval
    advice = "fit one part of the recording without gaps, or resample it at equal intervals"
    raise _recording_error(path, "E712", "time", f"equal intervals of {1e3 * step:.6g} ms", got, advice)


def _recording_error(
    path: Path, code: str, message: str, expected: str, got: str, advice: str = ""
) -> ApcError:
    """Return an error of a recording."""
    return ApcError(Diagnostic(code, SourceLocation(str(path)), message, expected, got, advice=advice))
